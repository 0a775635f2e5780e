"""The data of judging: exchanges, explanations of them, mismatches."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

from msgspec import Struct, structs

if TYPE_CHECKING:
    from ecatspec.model.core.state import Event, Output, RuleName, State, Step


@dataclass(frozen=True, slots=True)
class Exchange:
    """One access of the MainDevice; `time` in microseconds on the device's clock."""

    time: int
    write: bool
    address: int
    data: bytes
    working_counter: int
    reference: str = ""

    def span(self) -> tuple[int, int]:
        """Give address and length."""
        return self.address, len(self.data)


class Pending(Struct, frozen=True, cache_hash=True):
    """An input that the device has, and until when it may leave it unserved (`within` from now).

    A `timer` comes by itself, not before `since`; for others that is when they came.
    """

    event: Event
    deadline: int
    within: int = 0
    since: int = 0
    timer: bool = False
    optional: bool = False
    """It may have been served already, when too much was possible to follow."""

    def target(self) -> tuple[str, str]:
        """Give the machine and the input."""
        return self.event.machine, self.event.input


class Loose(IntEnum):
    """How much the mailbox may hold that no text speaks of."""

    NONE = 0
    ONE = 1
    """The answer to a message that the texts leave open."""
    ALL = 2
    """Anything: the beginning was not seen, or the mailbox is not alive."""


class Candidate(Struct, frozen=True, cache_hash=True):
    """One explanation: a state, inputs not yet served, replies not yet read.

    The first reply lies in the mailbox, at the latest from `ready` on. `last` is the message that
    the MainDevice read last.
    """

    state: State
    inbox: tuple[Pending, ...] = ()
    outbox: tuple[Output, ...] = ()
    loose: Loose = Loose.NONE
    ready: int = 0
    last: bytes | None = None
    spontaneous: tuple[str, ...] = ()
    """Local events that the device met without a stimulus of the run."""

    def having(self, state: State) -> Candidate:
        """Give the explanation with another state."""
        if state is self.state:
            return self
        return structs.replace(self, state=state)

    def expecting(self, inbox: tuple[Pending, ...]) -> Candidate:
        """Give the explanation with other inputs to serve."""
        return structs.replace(self, inbox=inbox)

    def beside_inbox(self) -> tuple[object, ...]:
        """Give all but the inputs to serve."""
        return self.state, self.outbox, self.loose, self.ready, self.last, self.spontaneous


@dataclass(frozen=True, slots=True)
class Mismatch:
    """An observation that no candidate allows."""

    exchange: Exchange
    subject: str
    expected: tuple[str, ...]
    observed: str
    rules: tuple[RuleName, ...]
    clauses: tuple[str, ...]
    signature: str
    """What was observed and what demands otherwise: the same wherever it is observed."""
    causes: tuple[str, ...] = ()
    """What it has in common with others of the same cause: they share one of these at least."""
    reasons: tuple[str, ...] = ()
    """Why the device had to refuse, where it had to."""
    differing: tuple[str, ...] = ()
    """The fields that are not as expected, of the alternative with the fewest; or the frame."""
    silent: bool = False
    """Nothing was observed where an answer was due."""
    clear: bool = False
    """The state of the device is known all the same: the oracle can overlook it."""
    beside: tuple[Mismatch, ...] = ()
    """What else is wrong with the same observation."""


_FASTER = 10
"""A device's clock may be faster than ours by one part in this number."""


def with_alarms(
    inbox: tuple[Pending, ...], taken: Step, since: int, until: int
) -> tuple[Pending, ...]:
    """Give the inputs with those that a step makes come by itself; the step was in this time."""
    for alarm in taken.alarms:
        late = Pending(
            alarm.event,
            until + alarm.within,
            since=since + alarm.after - alarm.after // _FASTER,
            timer=True,
        )
        inbox = (*(p for p in inbox if not p.timer or p.target() != late.target()), late)
    return inbox
