"""Expands explanations: what each becomes once the device serves its pending inputs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from ecatspec.model.core.compilation import MAILBOX
from ecatspec.model.core.interpreter import by_any_rule, step
from ecatspec.model.core.memo import once
from ecatspec.model.core.object_dictionary import CROWDED
from ecatspec.model.core.observables import definitely
from ecatspec.model.core.state import Output
from ecatspec.model.oracle.explanations import Candidate, Loose, with_alarms
from ecatspec.model.oracle.havoc import after_open, is_open

if TYPE_CHECKING:
    from typing import TypeAlias

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import Event, RuleName, State, Step
    from ecatspec.model.oracle.explanations import Pending

    Explanations: TypeAlias = dict[Candidate, tuple[RuleName, ...]]

REFUSAL = "mailbox_error"
"""The frame that may overtake an answer: the request came while another was in work."""
LIMIT = 256
"""More explanations are not followed."""


@dataclass(frozen=True, slots=True)
class _Way:
    """One way to serve an input, as far as the state and the input alone tell it."""

    taken: Step
    due: tuple[Output, ...]
    refuses: bool
    """Its answer may come before those that are due."""
    was_alive: bool
    alive: bool
    shut: bool
    """The state has no mailbox, though the SyncManagers have one."""
    opened: tuple[State, ...]
    """Where the device may be after what the texts leave open; empty: they do not."""


@dataclass(frozen=True, slots=True)
class Grown:
    """Explanations with all that may have been served: the same for every time in [since, until).

    They hold for those that they grew from, and for themselves.
    """

    source: Explanations
    found: Explanations
    since: int
    until: float
    surprised: dict[int, Grown] = field(default_factory=dict)
    """What they grow to once the device did something by itself, by the time (us) of a look."""

    def of(self, explanations: Explanations, time: int) -> bool:
        """Tell whether these are what `explanations` grow to at `time`."""
        mine = explanations is self.source or explanations is self.found
        return mine and self.since <= time < self.until


def is_alive(model: Model, state: State) -> bool:
    """Tell whether the mailbox may be alive."""
    return definitely(model, state, "mailbox_alive") is not False


def is_shut(model: Model, state: State) -> bool:
    """Tell whether the state has no mailbox, though the SyncManagers have one."""
    return definitely(model, state, "mailbox_shut") is True


def may_hold_anything(model: Model, candidate: Candidate) -> bool:
    """Tell whether no text speaks of what lies in the mailbox."""
    judged = is_alive(model, candidate.state) or is_shut(model, candidate.state)
    return bool(candidate.loose) or not judged


@once
def is_idle(model: Model, state: State, event: Event) -> bool:
    """Tell whether an input makes no difference in a state."""
    return all(
        taken.state == state and not taken.outputs and not taken.alarms
        for taken in step(model, state, event)
    )


def grown(model: Model, explanations: Explanations, time: int) -> Grown | None:
    """Give the explanations with inputs served or, until their deadline, not yet.

    A negative time: inputs may be served that come by themselves later. None: too many to follow.
    """
    found: Explanations = {}
    overdue: list[Candidate] = []
    work = list(explanations.items())
    until = float("inf")
    while work:
        if len(found) - len(overdue) > LIMIT:
            return None
        candidate, history = work.pop()
        if any(p.optional and p.deadline < time for p in candidate.inbox):
            left = tuple(p for p in candidate.inbox if not p.optional or p.deadline >= time)
            candidate = candidate.expecting(left)
        if candidate in found:
            continue
        found[candidate] = history
        late = False
        first: set[tuple[str, bool]] = set()
        for position, pending in enumerate(candidate.inbox):
            event = pending.event
            if pending.deadline >= time:
                until = min(until, pending.deadline + 1)
            elif not pending.optional and not (candidate.outbox and event.trail):
                late = True
            # a message waits for the answer before it, a register does not
            lane = event.machine, bool(event.trail)
            if not pending.timer and lane in first:
                continue
            if 0 <= time < pending.since:
                until = min(until, pending.since)
                continue
            if not pending.timer and not pending.optional:
                first.add(lane)  # what may never have come holds nothing up
            rest = candidate.inbox[:position] + candidate.inbox[position + 1 :]
            for after, rules in served(model, candidate, pending, rest):
                if after not in found:
                    work.append((after, history + rules))
        if late:
            overdue.append(candidate)
    for candidate in overdue:
        del found[candidate]
    return Grown(explanations, found, time, until)


def served(
    model: Model,
    candidate: Candidate,
    pending: Pending,
    rest: tuple[Pending, ...],
    *,
    guarded: bool = True,
) -> list[tuple[Candidate, tuple[RuleName, ...]]]:
    """Give what a candidate may be after it served an input, `rest` is left, and the rules.

    Where it is not `guarded` it may go by rules that do not hold.
    """
    event = pending.event
    mail = bool(event.trail)
    found = []
    for way in _ways(model, candidate.state, event, guarded):
        taken, outbox = way.taken, candidate.outbox
        if not (mail and outbox):
            outbox += way.due
        elif way.refuses:
            # a device answers in order, but it may refuse at once what comes too early
            outbox = way.due + outbox
        else:
            continue
        loose, last = candidate.loose, candidate.last
        if taken.resend is not None:
            again = Output(MAILBOX, (), taken.resend, again=last or b"", chain=(taken.resend,))
            outbox = (again, *outbox)
        if mail and taken.unspecified:
            loose = max(loose, Loose.ONE)
        if way.alive != way.was_alive:
            # an answer that was due, or a message that came by itself, may lie there unread
            due = candidate.outbox or any(other.event.trail for other in rest)
            left = Loose.ALL if due or not way.shut else Loose.ONE
            outbox, loose, last = (), Loose.NONE if way.alive else left, None
        if mail and way.alive and not taken.unspecified and not candidate.outbox:
            loose = Loose.NONE
        if way.opened:
            found += [
                (Candidate(state, rest, loose=Loose.ALL), taken.rules) for state in way.opened
            ]
            continue
        inbox = with_alarms(rest, taken, pending.since, pending.deadline) if taken.alarms else rest
        after = Candidate(
            taken.state, inbox, outbox, loose, candidate.ready, last, candidate.spontaneous
        )
        found.append((after, taken.rules))
    return found


@once
def _ways(model: Model, state: State, event: Event, guarded: bool) -> tuple[_Way, ...]:  # noqa: FBT001
    was_alive = is_alive(model, state)
    return tuple(
        _Way(
            taken,
            tuple(replace(output, chain=taken.rules) for output in taken.outputs),
            bool(
                event.parameters.get(CROWDED)
                and taken.outputs
                and taken.outputs[0].frame == REFUSAL
            ),
            was_alive,
            is_alive(model, taken.state),
            is_shut(model, taken.state),
            after_open(model, taken.state) if is_open(model, taken) else (),
        )
        for taken in (step if guarded else by_any_rule)(model, state, event)
    )
