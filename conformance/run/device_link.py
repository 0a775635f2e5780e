"""One device, one oracle, one clock: exchanges are judged one by one, and said in a trace."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, fields
from functools import partial
from time import monotonic
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.verdict import (
    REASON,
    SUB_DEVICE,
    TraceLine,
)
from ecatspec.generators.cases.process_data import image
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.register_map import (
    AREAS,
    PROCESS_DATA,
    SYNC_MANAGERS,
    field_of,
)
from ecatspec.model.core.wording import message_words, register_words
from ecatspec.model.oracle.advice import unreadable
from ecatspec.model.oracle.explanations import Exchange, Mismatch
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from ecatspec.conformance.base.adapter import Adapter, Reading, Span
    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import ObjectKey, Value

MAIN_OUT, MAIN_IN = SYNC_MANAGERS
DATA_OUT, DATA_IN = PROCESS_DATA
NOTHING: Final[Mapping[ObjectKey, bytes]] = MappingProxyType({})
SECOND: Final = 1_000_000
_SLOWEST = 500_000
"""Microseconds between two writes of the same process data at most."""
_OFTEN = {True: 2, False: 4}
"""Writes of process data in the time of the watchdog, in virtual and in real time: one is exact."""
AL = ("al_status", "al_status_code")
MAIL: Final = (f"{MAIN_IN}_status", f"{MAIN_IN}_pdi_control")
CYCLES: Final = 1000
"""Writes of process data after which they come once for each wait, however short the watchdog is:
for one stimulus, and for one request."""


class Deviation(Exception):  # noqa: N818
    """The device did what no state of the texts allows."""

    def __init__(self, mismatch: Mismatch) -> None:
        """Keep the mismatch."""
        super().__init__(mismatch.observed)
        self.mismatch = mismatch


class InconclusiveError(Exception):
    """No verdict can rest on what was seen, so nothing that follows is tried."""


TOO_MUCH: Final = "more may have happened in the device than can be followed"


@dataclass(frozen=True, slots=True)
class Advice:
    """What should have been otherwise, with the trace until then and the time in microseconds."""

    mismatch: Mismatch
    trace: tuple[TraceLine, ...]
    time: int


@dataclass(frozen=True, slots=True)
class SessionSnapshot:
    """All that a session is at one time, without its device."""

    values: Mapping[str, object]


@dataclass(slots=True)
class DeviceLink:
    """One device, one oracle, one clock in microseconds, and the trace in words."""

    adapter: Adapter
    model: Model
    oracle: Oracle
    time: int = 0
    exchanges: int = 0
    attempt: Exchange | None = None
    moved: bool = False
    """AL Status has changed, in this case or one before."""
    _told: list[tuple[int, str, str | Callable[[], str], bytes]] = field(default_factory=list)
    """When, by whom, what was done or shown (in words only once somebody asks), and its bytes."""
    advice: dict[str, Advice] = field(default_factory=dict)
    """What should have been otherwise, by signature."""
    overlooks: bool = False
    """A deviation after which the state of the device is clear does not end a case."""
    accepted: Collection[str] = ()
    """The identities of deviations that are known: the oracle goes on with them."""
    overlooked: dict[str, Advice] = field(default_factory=dict)
    """What did not end this case though it deviates, by signature."""
    _answers: list[Message] = field(default_factory=list)
    """The messages that the device sent since somebody began to count."""
    _counter: int = 0
    _unasked: int = 0
    """Messages that were read in this case, less the requests that were sent."""
    _shown: dict[str, int] = field(default_factory=dict)
    _shown_words: dict[str, str] = field(default_factory=dict)
    _outputs: dict[str, int] | None = None
    """The words that are written cyclically, None where nothing is."""
    _cycles: int = CYCLES
    """Writes of process data that are left."""
    _every: int = 0
    """Microseconds between two writes while it was waited last."""
    _hurries: bool = False
    _batches: bool = False
    """The device can be asked for several reads at once."""
    _ahead: dict[Span, Reading] = field(default_factory=dict)
    """What was read at once and not looked at yet."""
    _seen: dict[Span, Reading] = field(default_factory=dict)
    """What looks gave last."""
    _mail_waits: bool = False
    """The mailbox was full when it was looked at last."""
    _runs_ahead: bool = False
    """The device can be asked for several waits at once, each with a look behind it."""
    _passed: deque[dict[Span, Reading] | Exception] = field(default_factory=deque)
    """What waits and looks gave that the device has behind it and the session has not: in turn
    nothing and what was read, and last perhaps what went wrong."""
    _began: float | None = None
    """When the clock of a device in real time was 0; None: time passes by waiting alone."""

    @property
    def _virtual(self) -> bool:
        return self._began is None

    @property
    def trace(self) -> list[TraceLine]:
        """What was done and shown, in words."""
        return [
            TraceLine(time, who, what if isinstance(what, str) else what(), data)
            for time, who, what, data in self._told
        ]

    @property
    def refusals(self) -> list[str]:
        """Why the device refused what it was asked."""
        return [what for _, who, what, _ in self._told if who == REASON and isinstance(what, str)]

    def snapshot(self) -> SessionSnapshot:
        """Give what the session is now in its case, without its device."""
        values = {name: getattr(self, name) for name in _OWN}
        return SessionSnapshot(MappingProxyType({n: _apart(v) for n, v in values.items()}))

    def restore(self, snapshot: SessionSnapshot) -> None:
        """Be as a session with this device was then; a snapshot may be restored again."""
        for name, value in snapshot.values.items():
            setattr(self, name, _apart(value))

    def forget_trace(self) -> None:
        """Begin with an empty trace."""
        self._told = []

    def _read_registers(self, *names: str, demanded: bool = False) -> list[int]:
        """Read registers by one exchange, the lowest first; give what they hold."""
        registers = [self.model.protocol.registers[name] for name in names]
        start, length = self._span(*names)
        if (start, length) not in self._ahead:
            self._tick()
        counter, data = self._read(start, length)
        found = []
        for register in registers:
            offset = register.address - start
            found.append(int.from_bytes(data[offset : offset + register.size], "little"))
            self._show_register(register.name, found[-1])
        exchange = self._exchange(start, data, counter)
        if demanded and not counter:
            mismatch = unreadable(self.model, names[0], exchange)
            if mismatch is not None:
                self._deviates(mismatch, exchange)
        before = self.oracle.known
        self._observe(exchange)
        if names == AL and self.oracle.candidates != before.candidates:
            told = before.reasons()
            for reason in self.oracle.known.reasons():
                if reason not in told:
                    self._say(REASON, reason)
        return found if counter else [0] * len(found)

    def _show_register(self, name: str, raw: int) -> None:
        if not self.model.views[name] or self._shown.get(name) == raw:
            return
        first = name not in self._shown
        self._shown[name] = raw
        if not first:
            self.moved |= name in AL
            shown = {
                view.name: field_of(self.model.protocol, name, view.name, raw)
                for view in self.model.views[name]
            }
            self._say(SUB_DEVICE, partial(_shows, self.model, name, shown))

    def _read(self, address: int, length: int) -> Reading:
        """Read, if it was not read ahead."""
        span = address, length
        found = self._ahead.pop(span, None)
        self._seen[span] = self.adapter.read(address, length) if found is None else found
        return self._seen[span]

    def _read_inputs(self) -> None:
        area = self.oracle.known.process_area(DATA_IN)
        if area is not None:
            counter, data = self._read(*area)
            self._show_inputs(data if counter else b"")
            self._observe(self._exchange(area[0], data, counter))

    def _show_inputs(self, data: bytes) -> None:
        for name, words in self.oracle.known.words_in(data):
            if self._shown_words.get(name) != words:
                self._shown_words[name] = words
                self._say(SUB_DEVICE, f"shows {words}")

    def _write(self, address: int, data: bytes) -> int:
        self.attempt = self._exchange(address, data, 1, write=True)
        counter = self.adapter.write(address, data)
        self.attempt = None
        self._tick()
        self._observe(self._exchange(address, data, counter, write=True))
        return counter

    def _write_outputs(self, *, anywhere: bool = False) -> None:
        """Write what is written cyclically, in other states than SAFEOP and OP when asked to."""
        if self._outputs is None:
            return
        used = bool(self.oracle.known.al_states() & {"SAFEOP", "OP"})
        data = image(self.model, self.oracle.known.example(), self._outputs)
        start = self.model.parameter("process_data_out", "start")
        if data is None or not (used or anywhere):
            return
        if used or self.oracle.known.process_area(DATA_OUT) == (start, len(data)):
            self._write(start, data)

    def _cycle(self) -> int:
        """Give the time between two writes of process data that keeps the watchdog quiet."""
        environment = Environment(self.oracle.known.example().slots, {}, {})
        time = self.model.definition("watchdog_time")(environment)
        cycle = time // _OFTEN[self._virtual] if isinstance(time, int) and time else _SLOWEST
        return max(1, min(_SLOWEST, cycle))

    def _wait(self, microseconds: int) -> None:
        until = self.time + microseconds
        self._every = microseconds
        if self._outputs is not None:
            self._every = max(self._cycle(), -(-microseconds // max(1, self._cycles)))
        while self.time < until:
            self._cycles -= 1
            part = min(self._every, until - self.time)
            if self._passed:
                self._next_passed()
            else:
                self.adapter.advance(part / SECOND)
            self.time += part
            self._write_outputs()

    def _next_passed(self) -> dict[Span, Reading]:
        """Give what the next of the waits and looks gave that the device has behind it."""
        given = self._passed.popleft()
        if isinstance(given, Exception):
            raise given
        return given

    def _keep_up(self) -> None:
        """End the case where there was too much to follow: nothing is known from there on."""
        if self.oracle.lost:
            raise InconclusiveError(TOO_MUCH)

    def _start_clock(self, *, real: bool) -> None:
        self._began = monotonic() if real else None

    def _tick(self) -> None:
        """Look at the clock: exchanges take time too, where it is real."""
        if self._began is not None:
            self.time = max(self.time, round((monotonic() - self._began) * SECOND))

    def _exchange(
        self, address: int, data: bytes, counter: int, *, write: bool = False
    ) -> Exchange:
        return Exchange(self.time, write, address, data, counter)

    def _observe(self, exchange: Exchange) -> None:
        self.exchanges += 1
        mismatch = self.oracle.observe(exchange)
        if mismatch is not None:
            self._keep_up()
            self._deviates(mismatch, exchange)
        self._take_advice()

    def _deviates(self, mismatch: Mismatch, exchange: Exchange) -> None:
        """Go on where the state of the device is clear, or the deviation is known.

        Raises:
            Deviation: It cannot be gone on.

        """
        clear = mismatch.clear and self.overlooks
        known = self._known(mismatch, exchange)
        if not clear and known is None:
            raise Deviation(mismatch)
        for each in (known or mismatch, *mismatch.beside):
            self.overlooked.setdefault(each.signature, Advice(each, tuple(self.trace), self.time))
        if clear:
            self.oracle.overlook()
        else:
            self.oracle.accept(exchange)

    def _known(self, mismatch: Mismatch, exchange: Exchange) -> Mismatch | None:
        """Give the mismatch as it is known, None where it is not.

        Behind another that is known there are more explanations, and one of them may know it.
        """
        if mismatch.signature in self.accepted:
            return mismatch
        behind = any(signature in self.accepted for signature in self.overlooked)
        every = list(self.oracle.mismatches(exchange)) if behind and not exchange.write else []
        return next((each for each in every if each.signature in self.accepted), None)

    def _take_advice(self) -> None:
        for signature in self.oracle.advice.keys() - self.advice.keys():
            self._advise(self.oracle.advice[signature])

    def _advise(self, advice: Mismatch) -> None:
        self.advice.setdefault(advice.signature, Advice(advice, tuple(self.trace), self.time))

    def _span(self, *names: str) -> Span:
        """Give where registers lie, the lowest first: address and length."""
        first, last = (self.model.protocol.registers[name] for name in (names[0], names[-1]))
        return first.address, last.address + last.size - first.address

    def _area(self, name: str) -> tuple[int, int]:
        """Give where a mailbox lies as it is set, or as the device's description has it."""
        start, length = (self.model.parameter(AREAS[name], part) for part in ("start", "length"))
        return self.oracle.known.area(name) or (start, length)

    def _say(self, who: str, what: str | Callable[[], str], data: bytes = b"") -> None:
        self._told.append((self.time, who, what, data))


_OF_ALL_CASES: Final = frozenset({"adapter", "model", "exchanges", "moved"})
"""What a session has beyond one case."""
_OWN: Final = tuple(item.name for item in fields(DeviceLink) if item.name not in _OF_ALL_CASES)


def _apart(value: object) -> object:
    """Give a value that does not change with the one in a session."""
    match value:
        case Oracle():
            return value.fork()
        case list() | dict() | deque():
            return value.copy()
        case _:
            return value


def _shows(model: Model, name: str, fields: Mapping[str, Value]) -> str:
    return f"shows {register_words(model, name, fields)}"


def message_said(model: Model, verb: str, message: Message | None) -> str:
    """Say a message in words, with what was done to it."""
    return f"{verb} {'no message' if message is None else message_words(model, message)}"
