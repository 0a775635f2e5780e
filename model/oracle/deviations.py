"""What a device may be that goes on otherwise than the explanations have it."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

from msgspec import structs

from ecatspec.model.core.interpreter import afterwards
from ecatspec.model.core.observables import machines_of, words_in
from ecatspec.model.core.values import UNKNOWN
from ecatspec.model.oracle.cyclic_outputs import widened
from ecatspec.model.oracle.expansion import served
from ecatspec.model.oracle.explanations import Loose
from ecatspec.model.oracle.reads import left, registers_inside
from ecatspec.model.oracle.writes import DATA_IN

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName, State
    from ecatspec.model.core.values import Value
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Candidate, Exchange
    from ecatspec.model.oracle.knowledge import Knowledge


def is_mail(known: Knowledge, exchange: Exchange) -> bool:
    """Tell whether a read is one of the mailbox: of no register, and not of inputs."""
    inside = registers_inside(known.model, *exchange.span())
    return not inside and not known.concerned(DATA_IN, exchange)


def deviated(model: Model, before: Explanations, *, mail: bool) -> Explanations:
    """Give what a device may be that answered otherwise (`mail`), or went on otherwise too."""
    ways = _answered if mail else _strayed
    return widened(way for each in before.items() for way in ways(model, *each))


def shown_anywhere(known: Knowledge, exchange: Exchange) -> Explanations:
    """Give the explanations with the machines that an exchange shows in any of their states."""
    return {
        candidate.having(state): history
        for candidate, history in known.candidates.items()
        for state in _shown_in(known, candidate.state, exchange)
    }


def _shown_in(known: Knowledge, state: State, exchange: Exchange) -> Iterator[State]:
    model = known.model
    names = [register.name for register in registers_inside(model, *exchange.span())]
    if known.concerned(DATA_IN, exchange):
        names = [name for name, _ in words_in(model, state, exchange.data)]
    machines = sorted({each for name in names for each in machines_of(model, name)})
    slots = [model.slots[f"{machine}.state"] for machine in machines]
    for values in product(*map(model.state_names, machines)):
        found = state
        for slot, value in zip(slots, values, strict=True):
            found = found.having(slot, value)
        if not model.broken(found):
            yield found


def _strayed(
    model: Model, candidate: Candidate, history: tuple[RuleName, ...]
) -> Iterator[tuple[Candidate, tuple[RuleName, ...]]]:
    """Yield what a device may be that goes on otherwise than an explanation has it."""
    yield from _answered(model, candidate, history)
    yield structs.replace(candidate, loose=Loose.ONE), history
    yield candidate.expecting(()), history
    for position, pending in enumerate(candidate.inbox):
        others = candidate.inbox[:position] + candidate.inbox[position + 1 :]
        for rest, rules in served(model, candidate, pending, others, guarded=False):
            yield rest, history + rules


def _answered(
    model: Model, candidate: Candidate, history: tuple[RuleName, ...]
) -> Iterator[tuple[Candidate, tuple[RuleName, ...]]]:
    """Yield what a device may be that answered otherwise, or not at all."""
    if not candidate.outbox:
        yield candidate, history
    for output in candidate.outbox[:1]:
        for taken in afterwards(model, candidate.state, output, {}):
            rest = left(model, candidate, taken, candidate.outbox[1:], 0)
            state = rest.state
            for _, into in model.replies[output.frame].values():
                if into is not None:
                    state = state.having(model.slots[into], UNKNOWN)
            yield rest.having(state), history + taken.rules
            # a refusal may have ended what the answer was a part of
            for name, slot in model.slots.items():
                if name.startswith(f"{output.rule.machine}."):
                    state = state.having(slot, model.initial.slots[slot])
            state = _unsure(model, state, dict(output.asked).get("index"))
            yield rest.having(state), history + taken.rules


def _unsure(model: Model, state: State, index: Value | None) -> State:
    """Give the state in which it is not known what an object holds."""
    for key in model.dictionary.entries:
        if key[0] == index:
            state = state.forgetting(key)
            word = model.words.get(key)
            if word is not None:
                state = state.having(model.slots[f"word {word.name}"], UNKNOWN)
    return state
