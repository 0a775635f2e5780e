"""The only place that drives a device through one case and asks the oracle after every exchange."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import count
from time import monotonic
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.conformance.adapter import raise_local, read_all
from ecatspec.conformance.verdict import BEFALLEN, MAIN_DEVICE, REASON, SUB_DEVICE, WAITS, TraceLine
from ecatspec.generators.case import (
    Happen,
    Hurry,
    Probe,
    ReadConfiguration,
    ReadRegister,
    Repeat,
    SendFrame,
    SendSegments,
    SetUpProcessData,
    Stimulus,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
)
from ecatspec.generators.mailbox_cover import probe_entry
from ecatspec.generators.process_data import image, settings
from ecatspec.generators.stimulus import frame_bytes, register_bytes, registers_bytes
from ecatspec.generators.transfers import upload, upload_segment
from ecatspec.model.candidates import Exchange, Mismatch
from ecatspec.model.esc import PROCESS_DATA, SYNC_MANAGERS, field_mask, field_of
from ecatspec.model.evaluate import Environment
from ecatspec.model.process_image import INPUTS, OUTPUTS
from ecatspec.model.values import bits_of
from ecatspec.model.words import message_words, register_words

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ecatspec.conformance.adapter import Adapter
    from ecatspec.model.codec import Message
    from ecatspec.model.compiled import Model
    from ecatspec.model.oracle import Oracle
    from ecatspec.model.values import ObjectKey, Value

MAIN_OUT, MAIN_IN = SYNC_MANAGERS
DATA_OUT, DATA_IN = PROCESS_DATA
NOTHING: Final[Mapping[ObjectKey, bytes]] = MappingProxyType({})
_SECOND = 1_000_000
_FIRST_WAIT = 500
_SLOWER = {True: 400, False: 4}
"""Each wait for the same is so much longer than the one before, in virtual and in real time: to
wait costs nothing in one, to look nothing in the other."""
_SLOWEST = 500_000
"""Microseconds between two writes of the same process data at most."""
_OFTEN = {True: 2, False: 4}
"""Writes of process data in the time of the watchdog, in virtual and in real time: one is exact."""
AL = ("al_status", "al_status_code")
_MAIL = (f"{MAIN_IN}_status", f"{MAIN_IN}_pdi_control")
WATCHED = (*AL, *_MAIL)
"""The registers that are read after every stimulus: what the device shows."""
_FLOOD = 64
"""More messages at once than a device can have reason for."""


class Deviation(Exception):  # noqa: N818
    """The device did what no state of the texts allows."""

    def __init__(self, mismatch: Mismatch) -> None:
        """Keep the mismatch."""
        super().__init__(mismatch.observed)
        self.mismatch = mismatch


@dataclass(slots=True)
class Session:
    """One device, one oracle, one clock in microseconds, and the trace in words."""

    adapter: Adapter
    model: Model
    oracle: Oracle
    time: int = 0
    exchanges: int = 0
    attempt: Exchange | None = None
    _told: list[tuple[int, str, str | Callable[[], str], bytes]] = field(default_factory=list)
    """When, by whom, what was done or shown (in words only once somebody asks), and its bytes."""
    _counter: int = 0
    _shown: dict[str, int] = field(default_factory=dict)
    _shown_words: dict[str, str] = field(default_factory=dict)
    _outputs: dict[str, int] | None = None
    """The words that are written cyclically, None where nothing is."""
    _hurries: bool = False
    _batches: bool = False
    """The device can be asked for several reads at once."""
    _ahead: dict[tuple[int, int], tuple[int, bytes]] = field(default_factory=dict)
    """What was read at once and not looked at yet."""
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

    def forget_trace(self) -> None:
        """Begin with an empty trace."""
        self._told = []

    def begin(self, choices: dict[str, str], objects: Mapping[ObjectKey, bytes] = NOTHING) -> None:
        """Power cycle the device."""
        self.adapter.reset()
        self.time = 0
        description = self.adapter.describe()
        self._batches = description.batch
        self._ahead = {}
        self._began = None if description.virtual_time else monotonic()
        self.forget_trace()
        self.attempt = None
        self._counter = 0
        self._shown = {}
        self._shown_words = {}
        self._outputs = None
        self._hurries = False
        self.oracle.power_on(choices, objects)
        self._look()

    def apply(self, stimulus: Stimulus) -> None:
        """Give one stimulus and watch until nothing more may happen; raise Deviation."""
        match stimulus:
            case WriteRegister():
                address, data = register_bytes(self.model, stimulus)
                self._say(MAIN_DEVICE, partial(_writes, self.model, stimulus))
                self._write(address, data)
            case WriteRegisters():
                address, data = registers_bytes(self.model, stimulus)
                self._say(MAIN_DEVICE, partial(_writes, self.model, *stimulus.writes))
                self._write(address, data)
            case ReadRegister(register=name):
                self._say(MAIN_DEVICE, f"reads {name.replace('_', ' ')}")
                self._read_registers(name, demanded=True)
            case SendFrame():
                self._send(stimulus)
                if stimulus.unread:
                    self._settle(unread=True)
                    return
            case SendSegments():
                self._send_segments()
            case Repeat():
                self._repeat()
            case Probe():
                entry = probe_entry(self.model)
                if entry is not None:
                    self._send(upload(entry.index, entry.subindex))
            case ReadConfiguration():
                self._read_configuration()
            case SetUpProcessData():
                for writes in settings(self.model, self.oracle.example(), stimulus):
                    self.apply(writes)
            case WriteOutputs():
                self._outputs = {**(self._outputs or {}), **stimulus.words}
                self._say(MAIN_DEVICE, partial(_outputs_words, self.model, stimulus.words))
                self._write_outputs()
            case StopOutputs():
                self._outputs = None
                self._say(MAIN_DEVICE, "writes no process data any more")
            case Wait():
                self._say(MAIN_DEVICE, f"{WAITS} {stimulus.microseconds / 1000:.1f} ms")
                self._wait(stimulus.microseconds)
            case Hurry():
                self._hurries = True
                return
            case Happen():
                self._befall(stimulus)
            case _:
                assert_never(stimulus)
        self._settle()

    def _befall(self, stimulus: Happen) -> None:
        machine, _, event = stimulus.event.partition(".")
        self._say(SUB_DEVICE, f"{BEFALLEN} {event.replace('_', ' ')}")
        raise_local(self.adapter, stimulus.event)
        self.oracle.happened(machine, event, self.time)

    # --- process data -----------------------------------------------------------------------------

    def _read_configuration(self) -> None:
        for name in (OUTPUTS, INPUTS):
            assignment = self.model.image.assignments[name]
            for pdo in self._read_object(assignment):
                self._read_object(pdo)
        for key in self.model.settings:
            self._ask(*key)

    def _read_object(self, index: int) -> list[int]:
        """Read the entries that an object counts; give those that are known then."""
        if (index, 0) not in self.model.dictionary.entries:
            return []
        self._ask(index, 0)
        known = self.oracle.example().known()
        count = known.get((index, 0), b"\0")[0]
        for subindex in range(1, count + 1):
            self._ask(index, subindex)
        known = self.oracle.example().known()
        found = (known.get((index, subindex)) for subindex in range(1, count + 1))
        return [int.from_bytes(value, "little") for value in found if value]

    def _ask(self, index: int, subindex: int) -> None:
        entry = self.model.dictionary.entries.get((index, subindex))
        if entry is not None and not (entry.constant and entry.default is not None):
            self._send(upload(index, subindex))
            self._settle()

    def _write_outputs(self) -> None:
        if self._outputs is not None and self.oracle.al_states() & {"SAFEOP", "OP"}:
            data = image(self.model, self.oracle.example(), self._outputs)
            if data is not None:
                self._write(self.model.parameter("process_data_out", "start"), data)

    def _cycle(self) -> int:
        """Give the time between two writes of process data that keeps the watchdog quiet."""
        environment = Environment(self.oracle.example().slots, {}, {})
        time = self.model.definition("watchdog_time")(environment)
        return (
            max(1, min(_SLOWEST, time // _OFTEN[self._virtual]))
            if isinstance(time, int) and time
            else _SLOWEST
        )

    def _read_inputs(self) -> None:
        area = self.oracle.process_area(DATA_IN)
        if area is not None:
            counter, data = self._read(*area)
            self._show_inputs(data if counter else b"")
            self._observe(self._exchange(area[0], data, counter))

    def _show_inputs(self, data: bytes) -> None:
        for name, words in self.oracle.words_in(data):
            if self._shown_words.get(name) != words:
                self._shown_words[name] = words
                self._say(SUB_DEVICE, f"shows {words}")

    # --- mailbox ----------------------------------------------------------------------------------

    def _send(self, stimulus: SendFrame) -> None:
        if not stimulus.same_counter:
            self._counter = self._counter % self.model.parameter("highest_counter") + 1
        data = frame_bytes(self.model, stimulus, self._counter)
        message = self.model.decode(data)
        if message is not None:
            self._say(MAIN_DEVICE, partial(_message, self.model, "sends", message), data)
        start, length = self._area(MAIN_OUT)
        # refused for longer than the request time, the oracle calls it a deviation
        limit = self.time + self.model.parameter("request_timeout")
        wait = _FIRST_WAIT
        while not self._write(start, data[:length].ljust(length, b"\0")) and self.time <= limit:
            self._wait(wait)
            wait *= _SLOWER[self._virtual]

    def _send_segments(self) -> None:
        # each segment brings a byte at least, so an upload ends after as many as it has bytes
        for number in count():
            over = not self.oracle.may_be("sdo", "UPLOADING") or self.oracle.may_be("sdo", "IDLE")
            if over or number > self.oracle.most("sdo.size"):
                return
            self._send(upload_segment(toggle=number % 2 == 1))
            self._settle()

    def _repeat(self) -> None:
        register = self.model.protocol.registers[f"{MAIN_IN}_activation"]
        mask = field_mask(self.model.protocol, register.name, "repeat")
        raw = int.from_bytes(self.adapter.read(register.address, register.size)[1], "little")
        self._say(MAIN_DEVICE, "toggles the repeat bit")
        self._write(register.address, (raw ^ mask).to_bytes(register.size, "little"))

    def _area(self, name: str) -> tuple[int, int]:
        parameter = {MAIN_OUT: "mailbox_out", MAIN_IN: "mailbox_in"}[name]
        return self.model.parameter(parameter, "start"), self.model.parameter(parameter, "length")

    # --- watching ---------------------------------------------------------------------------------

    def _settle(self, *, unread: bool = False) -> None:
        if self._hurries:
            self._hurries = False
            self._look(unread=unread)
            return
        wait = _FIRST_WAIT
        # where anything may happen there is nothing to see before it has
        left = self.oracle.open_until(self.time) - self.time
        if left > 0:
            self._wait(left + 1)
        while True:
            self._look(unread=unread)
            if self.oracle.settled(self.time, unread=unread):
                return
            deadline = self.oracle.deadline(self.time)
            left = 0 if deadline is None else deadline - self.time + 1
            self._wait(max(1, min(wait, left)))
            wait *= _SLOWER[self._virtual]

    def _look(self, *, unread: bool = False) -> None:
        if self._batches:
            self._read_ahead()
        self._look_at_all(unread=unread)
        self._ahead = {}

    def _look_at_all(self, *, unread: bool) -> None:
        # the code is judged only once the state is known, so the state comes first
        self._read_registers(*AL)
        self._read_inputs()
        if unread:
            self._full()
            return
        for _ in range(_FLOOD):
            if not self._full():
                return
            start, length = self._area(MAIN_IN)
            counter, data = self.adapter.read(start, length)
            message = self.model.decode(data) if counter else None
            said = data if message is None else data[: self.model.codec.length(message)]
            self._say(SUB_DEVICE, partial(_message, self.model, "answers", message), said)
            self._observe(self._exchange(start, data, counter))
            if not counter:
                return

    def _read_ahead(self) -> None:
        """Read by one exchange with the adapter what a look begins with."""
        inputs = self.oracle.process_area(DATA_IN)
        spans = (self._span(*AL), *([] if inputs is None else [inputs]), self._span(*_MAIL))
        self._tick()
        self._ahead = dict(zip(spans, read_all(self.adapter, spans), strict=True))

    def _read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read, if it was not read ahead."""
        found = self._ahead.pop((address, length), None)
        return self.adapter.read(address, length) if found is None else found

    def _span(self, *names: str) -> tuple[int, int]:
        """Give where registers lie, the lowest first: address and length."""
        first, last = (self.model.protocol.registers[name] for name in (names[0], names[-1]))
        return first.address, last.address + last.size - first.address

    def _full(self) -> bool:
        status = self._read_registers(*_MAIL)[0]
        return bool(field_of(self.model.protocol, _MAIL[0], "full", status))

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
            mismatch = self.oracle.unreadable(names[0], exchange)
            if mismatch is not None:
                raise Deviation(mismatch)
        told = self.oracle.reasons() if names == AL else ()
        self._observe(exchange)
        if names == AL:
            for reason in self.oracle.reasons():
                if reason not in told:
                    self._say(REASON, reason)
        return found if counter else [0] * len(found)

    def _show_register(self, name: str, raw: int) -> None:
        if not self.model.views[name] or self._shown.get(name) == raw:
            return
        first = name not in self._shown
        self._shown[name] = raw
        if not first:
            shown = {
                view.name: field_of(self.model.protocol, name, view.name, raw)
                for view in self.model.views[name]
            }
            self._say(SUB_DEVICE, partial(_shows, self.model, name, shown))

    def _write(self, address: int, data: bytes) -> int:
        self.attempt = self._exchange(address, data, 1, write=True)
        counter = self.adapter.write(address, data)
        self.attempt = None
        self._tick()
        self._observe(self._exchange(address, data, counter, write=True))
        return counter

    def _exchange(
        self, address: int, data: bytes, counter: int, *, write: bool = False
    ) -> Exchange:
        return Exchange(self.time, write, address, data, counter)

    def _observe(self, exchange: Exchange) -> None:
        self.exchanges += 1
        mismatch = self.oracle.observe(exchange)
        if mismatch is not None:
            raise Deviation(mismatch)

    def _tick(self) -> None:
        """Look at the clock: exchanges take time too, where it is real."""
        if self._began is not None:
            self.time = max(self.time, round((monotonic() - self._began) * _SECOND))

    def _wait(self, microseconds: int) -> None:
        until = self.time + microseconds
        cycle = microseconds if self._outputs is None else self._cycle()
        while self.time < until:
            part = min(cycle, until - self.time)
            self.adapter.advance(part / _SECOND)
            self.time += part
            self._write_outputs()

    def _say(self, who: str, what: str | Callable[[], str], data: bytes = b"") -> None:
        self._told.append((self.time, who, what, data))


def _writes(model: Model, *writes: WriteRegister) -> str:
    return f"writes {'; '.join(register_words(model, w.register, w.fields) for w in writes)}"


def _shows(model: Model, name: str, fields: Mapping[str, Value]) -> str:
    return f"shows {register_words(model, name, fields)}"


def _message(model: Model, verb: str, message: Message | None) -> str:
    return f"{verb} {'no message' if message is None else message_words(model, message)}"


def _outputs_words(model: Model, words: Mapping[str, int]) -> str:
    told = [
        register_words(
            model,
            name,
            {
                bits.name: bits_of(raw, bits.low, bits.high)
                for bits in model.protocol.words[name].fields
            },
        )
        for name, raw in words.items()
    ]
    return f"writes process data {'; '.join(told)}".strip()
