"""Cyclic outputs: the same again, and new ones for those before."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.model.core.interpreter import step
from ecatspec.model.core.memo import once
from ecatspec.model.oracle.explanations import Candidate, Pending, with_alarms
from ecatspec.spec.language.functions import IMAGE

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import Event, RuleName, State, Step
    from ecatspec.model.oracle.expansion import Explanations

FED, HELD = "process_data.fed", "process_data.image"
"""The variables that tell whether the device has outputs, and which it had last."""


def fed(model: Model, candidate: Candidate, outputs: Iterable[Event], time: int) -> Candidate:
    """Give the explanation in which the device has these outputs; they replace older ones."""
    inbox = candidate.inbox
    for event in outputs:
        own = event.machine, event.input
        old = [p.deadline for p in inbox if p.target() == own]
        rest = tuple(p for p in inbox if p.target() != own) if old else inbox
        steps, within, nothing_new = _taken(model, candidate.state, event)
        until = time + within
        if nothing_new:
            # the same outputs once more: only what they put off has news of them
            inbox = with_alarms(rest, steps[0], time, until)
        else:
            # the device looks by then, at these outputs or at those before
            inbox = (*rest, Pending(event, min(old, default=until), within, time))
    return candidate.expecting(inbox)


@once
def _taken(model: Model, state: State, event: Event) -> tuple[tuple[Step, ...], int, bool]:
    """Give what a device may do with outputs, by when, and whether nothing is new in them."""
    steps = step(model, state, event)
    fed = model.slots[FED]
    same = state.slots[model.slots[HELD]] == event.parameters[IMAGE] and all(
        taken.state.slots[fed] == state.slots[fed] and _same_words(model, state, taken.state)
        for taken in steps
    )
    idle = all(taken.state == state for taken in steps)
    return steps, max(taken.within for taken in steps), same or idle


def _same_words(model: Model, before: State, after: State) -> bool:
    """Tell whether all words are what they were; an SDO may have written them meanwhile."""
    slots = (model.slots[f"word {word.name}"] for word in model.words.values())
    return all(before.slots[slot] == after.slots[slot] for slot in slots)


def widened(found: Iterable[tuple[Candidate, tuple[RuleName, ...]]]) -> Explanations:
    """Give the explanations; of those that differ in times only one is left, which holds all."""
    kinds: dict[tuple[object, ...], tuple[Candidate, tuple[RuleName, ...]]] = {}
    for candidate, history in found:
        inputs = tuple([(p.event, p.timer, p.within, p.optional) for p in candidate.inbox])
        kind = (*candidate.beside_inbox(), inputs)
        other, known = kinds.get(kind, (candidate, history))
        if other.inbox != candidate.inbox:
            inbox = tuple(
                Pending(
                    a.event,
                    max(a.deadline, b.deadline),
                    a.within,
                    min(a.since, b.since),
                    a.timer,
                    a.optional,
                )
                for a, b in zip(candidate.inbox, other.inbox, strict=True)
            )
            other = candidate.expecting(inbox)
        kinds[kind] = other, known
    return dict(kinds.values())
