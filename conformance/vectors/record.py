"""Records a case as a test vector, played on the virtual SubDevice.

The oracle follows. What it would allow at each look, whatever way a device goes, becomes the
expectation; where another way leads to other states than the recorded one, the test ends there as
acceptable. All that a device may be busy with is awaited before a look, so that a look shows the
same on every device that goes the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import msgspec

from ecatspec.conformance.run.device_link import AL, MAIN_OUT, NOTHING, SessionSnapshot
from ecatspec.conformance.vectors.expectations import (
    DATA_IN,
    MAIN_IN,
    STATUS,
    Expectations,
    Made,
    at_rest,
)
from ecatspec.generators.cases.case import Happen
from ecatspec.generators.vectors.schema import (
    Cycle,
    Local,
    Read,
    Send,
    Step,
    Write,
)
from ecatspec.model.core.register_map import field_of
from ecatspec.model.oracle.expansion import is_idle
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping

    from ecatspec.conformance.base.adapter import Restorable
    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.generators.vectors.schema import Expected, Input
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.model.oracle.explanations import Exchange
    from ecatspec.spec.language.ir import Register

    Rules = tuple[RuleName, ...]

_LONGEST: Final = 3_600_000_000
"""Microseconds after which a device that is still busy counts as never coming to rest."""
_ROUNDS: Final = 16
"""Maximum number of awaited changes in a row, where each one starts the wait for the next."""
_TRIES: Final = 64
"""Maximum number of waits before a device counts as never coming to rest."""


_RECORDED: Final = (
    "steps",
    "_draft",
    "_cycled",
    "_waiting",
    "_unread",
    "_rests",
    "_peeks",
    "_looks",
    "_since",
    "_full_before",
    "_rules_told",
    "_states",
)
"""What a recorder has of its case besides what a session has."""


class RestlessError(Exception):
    """A case after which the virtual SubDevice does not come to rest: it has no vector."""


class Recorder(Expectations):
    """A session with the virtual SubDevice that keeps what was done and what may be seen."""

    def __init__(self, adapter: Restorable, model: Model, oracle: Oracle) -> None:
        """Take what a session takes; the device goes the ways that the vectors are to go."""
        super().__init__(adapter, model, oracle)
        self.steps: list[Step] = []
        self._draft = _Draft()
        self._cycled: tuple[int, bytes] | None = None
        """What was written while time passed; None: time does not pass."""
        self._waiting = False
        self._unread = False
        self._rests = True
        """Whether it is waited for what a device may be busy with."""
        self._looks: list[Exchange] = []
        self._since: tuple[Oracle, int] | None = None
        """Before and when it was begun to wait in this step; None: it is told how long to wait."""
        self._full_before: Oracle | None = None
        self._states: dict[str, str] = {}

    # --- points to go back to ---------------------------------------------------------------------

    def snapshot(self) -> SessionSnapshot:
        """Give what the session is now in its case, and what was recorded of it."""
        recorded = {name: _apart(getattr(self, name)) for name in _RECORDED}
        return SessionSnapshot({**super().snapshot().values, **recorded})

    def restore(self, snapshot: SessionSnapshot) -> None:
        """Be as the session was then."""
        values = dict(snapshot.values)
        for name in _RECORDED:
            setattr(self, name, _apart(values.pop(name)))
        super().restore(SessionSnapshot(values))

    def _begun_with(
        self,
        choices: Mapping[str, str],
        objects: Mapping[ObjectKey, bytes],
        cold: bool,  # noqa: FBT001
    ) -> Hashable:
        return super()._begun_with(choices, objects, cold), self.acknowledges

    # --- what is done -----------------------------------------------------------------------------

    def begin(
        self,
        choices: dict[str, str],
        objects: Mapping[ObjectKey, bytes] = NOTHING,
        *,
        cold: bool = True,
    ) -> None:
        """Power cycle the device, and forget the steps before."""
        self.steps = []
        self._draft = _Draft()
        self._rules_told = 0
        self._states = {}
        super().begin(choices, objects, cold=cold)
        self._close()

    def apply(self, stimulus: Stimulus) -> None:
        """Give one stimulus, and keep the steps that it takes."""
        if isinstance(stimulus, Happen):
            self._draft.given = Local(stimulus.event)
        super().apply(stimulus)
        self._close()

    def _write(self, address: int, data: bytes) -> int:
        if self._waiting:
            counter = super()._write(address, data)
            self._cycled = (address, data)
            return counter
        self._close()
        before = self.oracle.fork()
        counter = super()._write(address, data)
        self._draft.given = self._input(before, self._exchange(address, data, counter, write=True))
        return counter

    def _input(self, before: Oracle, exchange: Exchange) -> Input:
        address, data = exchange.address, exchange.data
        if address == self._area(MAIN_OUT)[0] and exchange.working_counter:
            message = self.model.decode(data)
            name = "bytes" if message is None else message.frame
            return Send(address, data.rstrip(b"\0").hex(), name)
        names = [r.name for r in self.model.protocol.registers.values() if _touches(r, exchange)]
        symbol = " ".join(names) or "process_data"
        other = replace(exchange, working_counter=1 - exchange.working_counter)
        effect = self._effect(before, [other])
        return Write(address, data.hex(), symbol, 1 if exchange.working_counter else 0, effect)

    def _wait(self, microseconds: int) -> None:
        if self._draft.expect:
            self._close()
        self._waiting, self._cycled = True, None
        try:
            super()._wait(microseconds)
        finally:
            self._waiting = False
        self._draft.us += microseconds
        if self._cycled is not None:
            address, data = self._cycled
            self._draft.cycle = Cycle(address, data.hex(), self._every)

    def _settle(self, *, unread: bool = False) -> None:
        self._unread = unread
        if self._hurries:
            self._rests = False
            super()._settle(unread=unread)
            self._rests = True
            return
        self._peek()
        for _ in range(_TRIES):
            self._rest()
            self._look(unread=unread)
            if not self.oracle.to_come(self.time, unread=unread):
                return
        raise RestlessError

    def _peek(self) -> None:
        """Look at once too, where a device may be busy: it may be wrong for a moment only.

        All that may be seen goes on, since a slower device shows it later.
        """
        time = self.time
        if self.oracle.known.open_until(time) > time or _busy_until(self.oracle, time) == time:
            return
        spans = [self._span(*AL)]
        if (area := self.oracle.known.process_area(DATA_IN)) is not None:
            spans.append(area)
        self._peeks = True
        for address, length in spans:
            counter, data = self.adapter.read(address, length)
            made = self._expected(self.oracle, self._exchange(address, data, counter))
            if isinstance(made.expected, Read) and _tells(made.expected):
                self._draft.expect.append(made.expected)
        self._peeks = False

    def _rest(self) -> None:
        """Wait until nothing is left that a device may be busy with."""
        began = self.time
        for _ in range(_TRIES):
            until = _busy_until(self.oracle, self.time)
            if until == self.time:
                return
            if self._draft.expect:
                self._close()
            if not self._draft.us:
                self._since, self._looks = (self.oracle.fork(), self.time), []
            self._wait(until - self.time)
            if self.time > began + _LONGEST:
                raise RestlessError
        raise RestlessError

    def _full(self) -> bool:
        if self._rests:
            self._rest()  # what follows a message may take its time
        return super()._full()

    def _shows_early(self, before: Oracle, time: int, cycle: Cycle | None) -> bool:
        """Tell whether a device that shows this at once has nothing left to do."""
        for exchange in self._looks:
            if before.observe(replace(exchange, time=time)) is not None:
                return False
        if before.to_come(time, unread=self._unread):
            return False
        timers = cycle is None and any(
            pending.timer and not is_idle(self.model, candidate.state, pending.event)
            for candidate in (*before.candidates, *self.oracle.candidates)
            for pending in candidate.inbox
        )
        return not timers and at_rest(before.candidates) == at_rest(self.oracle.candidates)

    def _close(self) -> None:
        """End the step that is being taken."""
        draft, self._draft = self._draft, _Draft()
        since, self._since = self._since, None
        if draft == _Draft():
            return
        states = self._known_states()
        changed = {name: state for name, state in states.items() if self._states.get(name) != state}
        self._states |= changed
        covers = self._recent_rules()
        if draft.given is None and self.steps and not self.steps[-1].covers:
            # what was looked at at once is what this has been waited for
            self.steps[-1] = msgspec.structs.replace(self.steps[-1], covers=covers)
        self.steps.append(
            Step(
                given=draft.given,
                us=draft.us,
                early=since is not None and self._shows_early(*since, draft.cycle),
                cycle=draft.cycle,
                expect=draft.expect,
                state=changed,
                covers=covers,
            )
        )

    def _known_states(self) -> dict[str, str]:
        found: dict[str, str] = {}
        for machine in self.model.protocol.machines:
            slot = self.model.slots[f"{machine}.state"]
            names = self.model.state_names(machine)
            if len(names) == 1:
                continue
            values = {candidate.state.slots[slot] for candidate in self.oracle.candidates}
            if len(values) == 1 and isinstance(value := values.pop(), int):
                found[machine] = names[value]
        return found

    def _recent_rules(self) -> list[str]:
        histories = list(self.oracle.candidates.values())
        recent = [set(history[self._rules_told :]) for history in histories]
        self._rules_told = min(map(len, histories), default=0)
        return sorted(map(str, set.intersection(*recent))) if recent else []

    # --- what may be seen -------------------------------------------------------------------------

    def _observe(self, exchange: Exchange) -> None:
        if exchange.write:
            super()._observe(exchange)
            return
        before = self.oracle.fork()
        super()._observe(exchange)
        self._looks.append(exchange)
        if self.acknowledges and exchange.address == self.model.protocol.registers[STATUS].address:
            self._draft.expect.append(self._acknowledged(before, exchange))
        made = self._expected(before, exchange)
        if made.expected is not None:
            self._draft.expect.append(made.expected)
        if made.besides:
            # which of these ways the device went does not matter: it may go any of them later
            self.oracle.candidates = {**dict(made.besides), **self.oracle.candidates}

    def _expected(self, before: Oracle, exchange: Exchange) -> Made:
        status = self.model.protocol.registers[STATUS]
        if exchange.address == status.address and exchange.working_counter:
            raw = int.from_bytes(exchange.data[: status.size], "little")
            full = bool(field_of(self.model.protocol, STATUS, "full", raw))
            if self._unread:
                return Made(self._fullness(before, exchange, full=full))
            if full:
                self._full_before = before
                return Made(None)
            return self._remembered(before, exchange, self._nothing)
        if exchange.address == self._area(MAIN_IN)[0]:
            before, self._full_before = self._full_before or before, None
            return self._remembered(before, exchange, self._message)
        if before.known.process_area(DATA_IN) == exchange.span():
            return self._remembered(before, exchange, self._inputs)
        return self._remembered(before, exchange, self._registers)


def _apart(value: object) -> object:
    """Give a value that does not change with the one in a recorder."""
    match value:
        case list() | dict():
            return value.copy()
        case _Draft():
            return replace(value, expect=[*value.expect])
        case (Oracle() as oracle, int(time)):
            return oracle.fork(), time
        case _:
            return value


def _tells(expected: Read) -> bool:
    """Tell whether there are bytes that are not allowed."""
    return all(int(allowed.mask, 16) for allowed in expected.anyOf)


def _touches(register: Register, exchange: Exchange) -> bool:
    end = exchange.address + len(exchange.data)
    return register.address < end and exchange.address < register.address + register.size


@dataclass(slots=True)
class _Draft:
    """A step that is being taken."""

    given: Input | None = None
    us: int = 0
    cycle: Cycle | None = None
    expect: list[Expected] = field(default_factory=list)


def _busy_until(oracle: Oracle, time: int) -> int:
    """Give the time (us) by which all is done that a device may be busy with; `time`: nothing."""
    for _ in range(_ROUNDS):
        deadlines = oracle.to_come(time)
        if not deadlines:
            break
        time = max(deadlines) + 1
    return time
