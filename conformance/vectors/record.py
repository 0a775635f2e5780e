"""Records a case as a test vector, played on the virtual SubDevice.

The oracle follows. What it would allow at each look, whatever way a device goes, becomes the
expectation; where another way leads to other states than the recorded one, the test ends there as
acceptable. All that a device may be busy with is awaited before a look, so that a look shows the
same on every device that goes the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, Literal

import msgspec

from ecatspec.conformance.run.device_link import AL, NOTHING, SessionSnapshot
from ecatspec.conformance.run.snapshot_session import SnapshotSession
from ecatspec.generators.cases.case import Happen
from ecatspec.generators.vectors.schema import (
    Allowed,
    Cycle,
    Full,
    Local,
    Mail,
    Read,
    Send,
    Step,
    Write,
)
from ecatspec.model.core.byte_masks import Form, input_form, message_forms, register_forms
from ecatspec.model.core.cache import Cache
from ecatspec.model.core.compilation import MAILBOX
from ecatspec.model.core.observables import decided, process_area
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS, field_mask, field_of
from ecatspec.model.core.values import bits_of
from ecatspec.model.oracle.expansion import is_idle, may_hold_anything
from ecatspec.model.oracle.explanations import Exchange
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable, Mapping

    from ecatspec.conformance.base.adapter import Restorable
    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.generators.vectors.schema import Effect, Expected, Input
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Candidate
    from ecatspec.spec.language.ir import Register

    Rules = tuple[RuleName, ...]

MAIN_OUT, MAIN_IN = SYNC_MANAGERS
DATA_OUT, DATA_IN = PROCESS_DATA
_STATUS, _ACKNOWLEDGE = f"{MAIN_IN}_status", f"{MAIN_IN}_pdi_control"
COUNTER, LENGTH = "counter", "length"
_BYTE: Final = 8
_KEPT: Final = 4096
"""Expectations that are kept at most: many tests begin alike."""
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


class Recorder(SnapshotSession):
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
        self._peeks = False
        """Whether what is seen is not believed: whatever may be seen goes on."""
        self.acknowledges = False
        """Whether what the device says of repeats is looked at too."""
        self._looks: list[Exchange] = []
        self._since: tuple[Oracle, int] | None = None
        """Before and when it was begun to wait in this step; None: it is told how long to wait."""
        self._full_before: Oracle | None = None
        self._rules_told = 0
        self._states: dict[str, str] = {}
        self._kept: Cache[object, _Made] = Cache(_KEPT)
        self._besides: Explanations = {}
        """What explains something that is only seen where the device did something by itself."""
        low, width = model.codec.place(MAILBOX, COUNTER)
        self._counter_bits = (1 << width) - 1 << low

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
        return not timers and _at_rest(before.candidates) == _at_rest(self.oracle.candidates)

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
        if self.acknowledges and exchange.address == self.model.protocol.registers[_STATUS].address:
            self._draft.expect.append(self._acknowledged(before, exchange))
        made = self._expected(before, exchange)
        if made.expected is not None:
            self._draft.expect.append(made.expected)
        if made.besides:
            # which of these ways the device went does not matter: it may go any of them later
            self.oracle.candidates = {**dict(made.besides), **self.oracle.candidates}

    def _expected(self, before: Oracle, exchange: Exchange) -> _Made:
        status = self.model.protocol.registers[_STATUS]
        if exchange.address == status.address and exchange.working_counter:
            raw = int.from_bytes(exchange.data[: status.size], "little")
            full = bool(field_of(self.model.protocol, _STATUS, "full", raw))
            if self._unread:
                return _Made(self._fullness(before, exchange, full=full))
            if full:
                self._full_before = before
                return _Made(None)
            return self._remembered(before, exchange, self._nothing)
        if exchange.address == self._area(MAIN_IN)[0]:
            before, self._full_before = self._full_before or before, None
            return self._remembered(before, exchange, self._message)
        if before.known.process_area(DATA_IN) == exchange.span():
            return self._remembered(before, exchange, self._inputs)
        return self._remembered(before, exchange, self._registers)

    def _remembered(
        self,
        before: Oracle,
        exchange: Exchange,
        make: Callable[[Oracle, Exchange], Expected | None],
    ) -> _Made:
        """Give what `make` gives, which is the same whenever the same is looked at.

        What is kept has times from now on, and the rules since the last step.
        """
        found, time, told = before.expanded(exchange.time), exchange.time, self._rules_told

        def from_now(explanations: Explanations) -> tuple[tuple[Candidate, Rules], ...]:
            return tuple((_later(c, -time), rules[told:]) for c, rules in explanations.items())

        key = (
            from_now(found),
            make.__name__,
            exchange.span(),
            exchange.data,
            exchange.working_counter,
            self._peeks,
            self.acknowledges,
        )
        if key not in self._kept:
            self._besides = {}
            expected = make(before, exchange)
            self._kept.keep(key, _Made(expected, from_now(self._besides)))
        made = self._kept[key]
        earlier = next(iter(before.candidates.values()), ())[:told]
        besides = tuple((_later(c, time), earlier + rules) for c, rules in made.besides)
        return _Made(made.expected, besides)

    def _fullness(self, before: Oracle, exchange: Exchange, *, full: bool) -> Full:
        other = self._status_read(exchange, full=not full)
        return Full(full, self._effect(before, [other]))

    def _nothing(self, before: Oracle, exchange: Exchange) -> Mail | None:
        """Give what else may come where no message came; where anything may, all is taken away."""
        found = before.expanded(exchange.time)
        loose = [may_hold_anything(self.model, c) for c in found]
        if all(loose):
            return Mail([], none="passes", otherwise="passes")
        others = self._allowed_mail(before, exchange, b"")
        return Mail(others, none="passes", otherwise="ends" if any(loose) else None)

    def _message(self, before: Oracle, exchange: Exchange) -> Mail | None:
        found = before.expanded(exchange.time)
        loose = [may_hold_anything(self.model, c) for c in found]
        if all(loose):
            return None
        message = self.model.decode(exchange.data)
        size = len(exchange.data) if message is None else self._size(exchange.data)
        data = exchange.data[:size]
        allowed = self._allowed_mail(before, exchange, data)
        if not any(each.effect == "passes" and each.admits(data) for each in allowed):
            allowed.insert(0, self.allowed(Form(size, int.from_bytes(data, "little"))))
        again = any(c.outbox and c.outbox[0].again is not None for c in found)
        none = self._effect(before, [self._status_read(exchange, full=False)])
        return Mail(
            allowed,
            "bytes" if message is None else message.frame,
            none,
            "ends" if any(loose) else None,
            "same" if again else self._counts(found),
        )

    def _counts(self, found: Iterable[Candidate]) -> Literal["new", "any"]:
        """Tell whether the counter has to be another than that of the message before."""
        slot = self.model.slots["mailbox.sent"]
        sent = [candidate.state.slots[slot] for candidate in found]
        return "new" if all(isinstance(each, int) and each for each in sent) else "any"

    def _allowed_mail(self, before: Oracle, exchange: Exchange, data: bytes) -> list[Allowed]:
        start, length = self._area(MAIN_IN)
        full = self._status_read(exchange, full=True)
        message = self.model.decode(data) if data else None
        observed = {} if message is None else message.fields

        def shown(content: bytes) -> list[Exchange]:
            whole = content[:length].ljust(length, b"\0")
            return [Exchange(exchange.time, False, start, whole, 1)]  # noqa: FBT003

        forms: dict[Form, None] = {}
        for candidate in self._possible(before, exchange):
            for output in candidate.outbox[:1]:
                if output.again is not None:
                    again = output.again[: self._size(output.again)] if output.again else b""
                    forms[Form(len(again), int.from_bytes(again, "little"))] = None
                else:
                    made = message_forms(self.model, candidate.state, output, observed, COUNTER)
                    forms |= dict.fromkeys(f for form in made if (f := form.within(length)))
        waits = before.fork()
        if not waits.allows(full):
            return []
        return self._allowed(waits, forms, data, shown, self._counter_bits)

    def _possible(self, before: Oracle, exchange: Exchange) -> Explanations:
        """Give the explanations, with what a device may have done by itself."""
        return before.expanded(exchange.time, surprised=True)

    def _size(self, data: bytes) -> int:
        """Give the bytes of a message: what follows is never compared."""
        low, width = self.model.codec.place(MAILBOX, LENGTH)
        announced = bits_of(int.from_bytes(data, "little"), low, low + width - 1)
        return min(len(data), self.model.codec.size(MAILBOX) + announced)

    def _status_read(self, exchange: Exchange, *, full: bool) -> Exchange:
        register = self.model.protocol.registers[_STATUS]
        raw = field_mask(self.model.protocol, _STATUS, "full") if full else 0
        data = raw.to_bytes(register.size, "little")
        return Exchange(exchange.time, False, register.address, data, 1)  # noqa: FBT003

    def _acknowledged(self, before: Oracle, exchange: Exchange) -> Read:
        """Give what the register may show that lies behind the status of the mailbox."""
        register = self.model.protocol.registers[_ACKNOWLEDGE]
        place = register.address - exchange.address
        data = exchange.data[place : place + register.size]

        def shown(content: bytes) -> list[Exchange]:
            whole = exchange.data[:place] + content + exchange.data[place + register.size :]
            return [replace(exchange, data=whole)]

        forms: dict[Form, None] = {}
        for candidate in self._possible(before, exchange):
            forms |= dict.fromkeys(register_forms(self.model, candidate.state, [register]))
        allowed = self._allowed(before, forms, data, shown, 0)
        return Read(register.address, register.size, register.name, allowed, "passes")

    def _inputs(self, before: Oracle, exchange: Exchange) -> Read:
        forms: dict[Form, None] = {}
        free = (1 << len(exchange.data) * _BYTE) - 1
        for candidate in self._possible(before, exchange):
            if process_area(self.model, candidate.state, DATA_IN) != exchange.span():
                forms[Form(len(exchange.data), 0, (free,))] = None
                continue
            for state in decided(self.model, candidate.state, exchange.data):
                forms[input_form(self.model, state, exchange.data)] = None
        return self._read_of(before, exchange, forms, "inputs")

    def _registers(self, before: Oracle, exchange: Exchange) -> Read:
        end = exchange.address + len(exchange.data)
        inside = [
            register
            for register in self.model.protocol.registers.values()
            if exchange.address <= register.address and register.address + register.size <= end
        ]
        forms: dict[Form, None] = {}
        for candidate in self._possible(before, exchange):
            forms |= dict.fromkeys(register_forms(self.model, candidate.state, inside))
        symbol = " ".join(register.name for register in inside) or "memory"
        return self._read_of(before, exchange, forms, symbol)

    def _read_of(
        self, before: Oracle, exchange: Exchange, forms: dict[Form, None], symbol: str
    ) -> Read:
        data = exchange.data

        def shown(content: bytes) -> list[Exchange]:
            return [replace(exchange, data=content, working_counter=1)]

        nothing = replace(exchange, data=bytes(len(data)), working_counter=0)
        refused = self._effect(before, [nothing])
        allowed = self._allowed(before, forms, data, shown, 0)
        return Read(exchange.address, len(data), symbol, allowed, refused)

    def allowed(self, form: Form) -> Allowed:
        """Give a message that may come; its counter is compared elsewhere."""
        return _allowed(form.size, form.value, form.open_bits | self._counter_bits, "passes")

    # --- what becomes of it -----------------------------------------------------------------------

    def _allowed(
        self,
        before: Oracle,
        forms: Iterable[Form],
        data: bytes,
        shown: Callable[[bytes], list[Exchange]],
        unseen: int,
    ) -> list[Allowed]:
        """Give what the oracle makes of forms; bits that are `unseen` are compared elsewhere."""
        found: dict[tuple[str, str], Allowed] = {}

        def effect(form: Form, raw: int) -> Effect | None:
            return self._effect(before, shown(raw.to_bytes(form.size, "little")))

        def allow(form: Form, raw: int, free: int, what: Effect) -> None:
            made = _allowed(form.size, raw, free | unseen, what, form.least)
            found[made.value, made.mask] = made

        for form in forms:
            kept = form.having(data) if len(data) >= form.size else form
            raw = kept.value
            what = None if form.least is not None else effect(form, raw)
            if what is None:
                if form.free:  # what fits together is not known
                    allow(form, raw, form.open_bits, "passes" if self._peeks else "ends")
                continue
            parts = [mask & ~unseen for mask in form.free if mask & ~unseen]
            passing = self._indifferent(form, raw, parts, what, effect)
            allow(form, raw, passing, what)
            if what == "passes" and passing != form.open_bits & ~unseen:
                ending = self._indifferent(form, raw, parts, None, effect)
                if ending != passing:
                    allow(form, raw, ending, "ends")
        return sorted(found.values(), key=lambda each: each.effect != "passes")

    def _indifferent(
        self,
        form: Form,
        raw: int,
        parts: list[int],
        what: Effect | None,
        effect: Callable[[Form, int], Effect | None],
    ) -> int:
        """Give the bits that may change with the same effect, or with any that is allowed."""

        def same(mask: int) -> bool:
            seen = effect(form, raw ^ mask)
            return seen is not None and what in {None, seen}

        whole = 0
        for part in parts:
            whole |= part
        if not whole or same(whole):
            return whole
        alone = 0
        for part in parts:
            if same(part):
                alone |= part
        return alone if alone and same(alone) else 0

    def _effect(self, before: Oracle, exchanges: list[Exchange]) -> Effect | None:
        """Give what it means to see this instead; None: it is not allowed.

        Where a device may come from what was recorded to this by itself, it may go on with both.
        """
        other = before.fork()
        if not all(map(other.allows, exchanges)):
            return None
        if self._peeks or _alike(other.candidates) == _alike(self.oracle.candidates):
            return "passes"
        possible = self._possible(self.oracle, exchanges[-1]) if self.model.own else {}
        if _at_rest(other.candidates) <= _at_rest(possible):
            self._go_on_with(other.candidates)
            return "passes"
        return "ends"

    def _go_on_with(self, explanations: Explanations) -> None:
        known = {_bare(c) for c in (*self._besides, *self.oracle.candidates)}
        for candidate, history in explanations.items():
            # which message was read last matters where it may be asked for again
            if self.acknowledges or _bare(candidate) not in known:
                self._besides.setdefault(candidate, history)


def _allowed(size: int, raw: int, free: int, effect: Effect, least: int | None = None) -> Allowed:
    mask = (1 << size * _BYTE) - 1 & ~free
    value = (raw & mask).to_bytes(size, "little").hex()
    return Allowed(value, mask.to_bytes(size, "little").hex(), effect, least)


def _later(candidate: Candidate, by: int) -> Candidate:
    """Give an explanation with all its times later, in microseconds."""
    inbox = tuple(
        msgspec.structs.replace(p, deadline=p.deadline + by, since=p.since + by)
        for p in candidate.inbox
    )
    return msgspec.structs.replace(candidate, inbox=inbox, ready=candidate.ready + by)


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


def _alike(candidates: Iterable[Candidate]) -> frozenset[Candidate]:
    return frozenset(map(_bare, candidates))


def _bare(candidate: Candidate) -> Candidate:
    return msgspec.structs.replace(candidate, last=None)


def _tells(expected: Read) -> bool:
    """Tell whether there are bytes that are not allowed."""
    return all(int(allowed.mask, 16) for allowed in expected.anyOf)


def _at_rest(candidates: Iterable[Candidate]) -> frozenset[object]:
    """Give explanations without their times."""
    return frozenset(
        (c.state, c.outbox, c.loose, frozenset(p.target() for p in c.inbox)) for c in candidates
    )


def _touches(register: Register, exchange: Exchange) -> bool:
    end = exchange.address + len(exchange.data)
    return register.address < end and exchange.address < register.address + register.size


@dataclass(frozen=True, slots=True)
class _Made:
    """An expectation, and explanations besides those of what was recorded that go on with it."""

    expected: Expected | None
    besides: tuple[tuple[Candidate, Rules], ...] = ()


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
