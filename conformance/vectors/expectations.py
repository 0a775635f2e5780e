"""What may be seen instead of what was seen, by all ways that the texts allow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import msgspec

from ecatspec.conformance.run.snapshot_session import SnapshotSession
from ecatspec.generators.vectors.schema import (
    Allowed,
    Full,
    Mail,
    Read,
)
from ecatspec.model.core.byte_masks import Form, input_form, message_forms, register_forms
from ecatspec.model.core.cache import Cache
from ecatspec.model.core.compilation import MAILBOX
from ecatspec.model.core.observables import decided, process_area
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS, field_mask
from ecatspec.model.core.values import bits_of
from ecatspec.model.oracle.expansion import may_hold_anything
from ecatspec.model.oracle.explanations import Exchange

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from ecatspec.conformance.base.adapter import Restorable
    from ecatspec.generators.vectors.schema import Effect, Expected
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Candidate
    from ecatspec.model.oracle.oracle import Oracle

    Rules = tuple[RuleName, ...]

DATA_IN: Final = PROCESS_DATA[1]
MAIN_IN: Final = SYNC_MANAGERS[1]
STATUS: Final = f"{MAIN_IN}_status"
_ACKNOWLEDGE: Final = f"{MAIN_IN}_pdi_control"
COUNTER, LENGTH = "counter", "length"
_BYTE: Final = 8
_KEPT: Final = 4096
"""Maximum number of expectations that are kept: many tests begin alike."""


@dataclass(frozen=True, slots=True)
class Made:
    """An expectation, and explanations besides those of what was recorded that go on with it."""

    expected: Expected | None
    besides: tuple[tuple[Candidate, Rules], ...] = ()


class Expectations(SnapshotSession):
    """A session that works out what may be seen at each look."""

    def __init__(self, adapter: Restorable, model: Model, oracle: Oracle) -> None:
        """Take what a session takes."""
        super().__init__(adapter, model, oracle)
        self._peeks = False
        """Whether what is seen is not believed: whatever may be seen goes on."""
        self.acknowledges = False
        """Whether what the device says of repeats is looked at too."""
        self._rules_told = 0
        self._kept: Cache[object, Made] = Cache(_KEPT)
        self._besides: Explanations = {}
        """What explains something that is only seen where the device did something by itself."""
        low, width = model.codec.place(MAILBOX, COUNTER)
        self._counter_bits = (1 << width) - 1 << low

    def _remembered(
        self,
        before: Oracle,
        exchange: Exchange,
        make: Callable[[Oracle, Exchange], Expected | None],
    ) -> Made:
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
            self._kept.keep(key, Made(expected, from_now(self._besides)))
        made = self._kept[key]
        earlier = next(iter(before.candidates.values()), ())[:told]
        besides = tuple((_later(c, time), earlier + rules) for c, rules in made.besides)
        return Made(made.expected, besides)

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
        register = self.model.protocol.registers[STATUS]
        raw = field_mask(self.model.protocol, STATUS, "full") if full else 0
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
        if at_rest(other.candidates) <= at_rest(possible):
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


def _alike(candidates: Iterable[Candidate]) -> frozenset[Candidate]:
    return frozenset(map(_bare, candidates))


def _bare(candidate: Candidate) -> Candidate:
    return msgspec.structs.replace(candidate, last=None)


def at_rest(candidates: Iterable[Candidate]) -> frozenset[object]:
    """Give explanations without their times."""
    return frozenset(
        (c.state, c.outbox, c.loose, frozenset(p.target() for p in c.inbox)) for c in candidates
    )
