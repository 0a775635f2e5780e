"""The only place that drives a device through one case and asks the oracle after every exchange."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING

from ecatspec.conformance.verdict import TraceLine
from ecatspec.generators.case import (
    Probe,
    Repeat,
    SendFrame,
    SendSegments,
    Stimulus,
    WriteRegister,
    WriteRegisters,
)
from ecatspec.generators.mailbox_cover import probe_entry
from ecatspec.generators.stimulus import frame_bytes, register_bytes, registers_bytes
from ecatspec.generators.transfers import upload, upload_segment
from ecatspec.model.esc import SYNC_MANAGERS, field_mask, field_of
from ecatspec.model.oracle import Exchange, Mismatch, Oracle
from ecatspec.model.words import message_words, register_words

if TYPE_CHECKING:
    from ecatspec.conformance.adapter import Adapter
    from ecatspec.model.compiled import Model

MAIN_OUT, MAIN_IN = SYNC_MANAGERS
_SECOND = 1_000_000
_FIRST_WAIT = 500
_SLOWER = 4
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
    trace: list[TraceLine] = field(default_factory=list)
    exchanges: int = 0
    attempt: Exchange | None = None
    _counter: int = 0
    _shown: dict[str, int] = field(default_factory=dict)

    def begin(self, choices: dict[str, str]) -> None:
        """Power cycle the device."""
        self.adapter.reset()
        self.time = 0
        self.trace = []
        self.attempt = None
        self._counter = 0
        self._shown = {}
        self.oracle.power_on(choices)
        self._look()

    def apply(self, stimulus: Stimulus) -> None:
        """Give one stimulus and watch until nothing more may happen; raise Deviation."""
        match stimulus:
            case WriteRegister():
                address, data = register_bytes(self.model, stimulus)
                words = register_words(self.model, stimulus.register, stimulus.fields)
                self._say("MainDevice", f"writes {words}")
                self._write(address, data)
            case WriteRegisters():
                address, data = registers_bytes(self.model, stimulus)
                words = "; ".join(
                    register_words(self.model, write.register, write.fields)
                    for write in stimulus.writes
                )
                self._say("MainDevice", f"writes {words}")
                self._write(address, data)
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
        self._settle()

    # --- mailbox ----------------------------------------------------------------------------------

    def _send(self, stimulus: SendFrame) -> None:
        if not stimulus.same_counter:
            self._counter = self._counter % self.model.parameter("highest_counter") + 1
        data = frame_bytes(self.model, stimulus, self._counter)
        message = self.model.decode(data)
        if message is not None:
            self._say("MainDevice", f"sends {message_words(self.model, message)}")
        start, length = self._area(MAIN_OUT)
        # refused for longer than the request time, the oracle calls it a deviation
        limit = self.time + self.model.parameter("request_timeout")
        wait = _FIRST_WAIT
        while not self._write(start, data[:length].ljust(length, b"\0")) and self.time <= limit:
            self._wait(wait)
            wait *= _SLOWER

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
        self._say("MainDevice", "toggles the repeat bit")
        self._write(register.address, (raw ^ mask).to_bytes(register.size, "little"))

    def _area(self, name: str) -> tuple[int, int]:
        parameter = {MAIN_OUT: "mailbox_out", MAIN_IN: "mailbox_in"}[name]
        return self.model.parameter(parameter, "start"), self.model.parameter(parameter, "length")

    # --- watching ---------------------------------------------------------------------------------

    def _settle(self, *, unread: bool = False) -> None:
        wait = _FIRST_WAIT
        while True:
            self._look(unread=unread)
            if self.oracle.settled(self.time, unread=unread):
                return
            deadline = self.oracle.deadline()
            left = 0 if deadline is None else deadline - self.time + 1
            self._wait(max(1, min(wait, left)))
            wait *= _SLOWER

    def _look(self, *, unread: bool = False) -> None:
        # the code is judged only once the state is known, so the state comes first
        self._read_register("al_status")
        self._read_register("al_status_code")
        self._read_register(f"{MAIN_IN}_pdi_control")
        if unread:
            self._full()
            return
        for _ in range(_FLOOD):
            if not self._full():
                return
            start, length = self._area(MAIN_IN)
            counter, data = self.adapter.read(start, length)
            message = self.model.decode(data) if counter else None
            words = "no message" if message is None else message_words(self.model, message)
            self._say("SubDevice", f"answers {words}")
            self._observe(self._exchange(start, data, counter))
            if not counter:
                return

    def _full(self) -> bool:
        status = self._read_register(f"{MAIN_IN}_status")
        return bool(field_of(self.model.protocol, f"{MAIN_IN}_status", "full", status))

    def _read_register(self, name: str) -> int:
        register = self.model.protocol.registers[name]
        counter, data = self.adapter.read(register.address, register.size)
        raw = int.from_bytes(data, "little")
        if self.model.views[name] and self._shown.get(name) != raw:
            first = name not in self._shown
            self._shown[name] = raw
            if not first:
                shown = {
                    view.name: field_of(self.model.protocol, name, view.name, raw)
                    for view in self.model.views[name]
                }
                self._say("SubDevice", f"shows {register_words(self.model, name, shown)}")
        self._observe(self._exchange(register.address, data, counter))
        return raw if counter else 0

    def _write(self, address: int, data: bytes) -> int:
        self.attempt = self._exchange(address, data, 1, write=True)
        counter = self.adapter.write(address, data)
        self.attempt = None
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

    def _wait(self, microseconds: int) -> None:
        self.adapter.advance(microseconds / _SECOND)
        self.time += microseconds

    def _say(self, who: str, what: str) -> None:
        self.trace.append(TraceLine(self.time, who, what))
