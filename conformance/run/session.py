"""Drives a device through one case and asks the oracle after every exchange."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.conformance.base.adapter import (
    AdapterError,
    DeviceFault,
    raise_local,
)
from ecatspec.conformance.base.verdict import (
    LOCAL_EVENT,
    MAIN_DEVICE,
    SUB_DEVICE,
    WAITS,
)
from ecatspec.conformance.run.device_link import (
    CYCLES,
    MAIN_IN,
    MAIN_OUT,
    NOTHING,
    SECOND,
    Deviation,
    InconclusiveError,
    message_said,
)
from ecatspec.conformance.run.watch import FIRST_WAIT, SLOWER, Watch
from ecatspec.generators.cases.case import (
    Happen,
    Hurry,
    Probe,
    ReadConfiguration,
    ReadInitial,
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
    WriteUntilTaken,
)
from ecatspec.generators.cases.process_data import settings
from ecatspec.generators.cases.stimulus import frame_bytes, registers_bytes
from ecatspec.generators.cases.transfers import (
    read,
    sample,
    several_values,
    upload,
    upload_segment,
    write,
)
from ecatspec.generators.covers.mailbox_cover import probe_entry
from ecatspec.model.core.object_dictionary import size_varies
from ecatspec.model.core.process_image import INPUTS, OUTPUTS
from ecatspec.model.core.register_map import (
    field_mask,
)
from ecatspec.model.core.values import bits_of
from ecatspec.model.core.wording import register_words
from ecatspec.model.oracle.advice import of_default, takes_nothing, unreasoned

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.spec.language.ir import ObjectEntry


SEGMENTS: Final = 4096
"""Segments of one upload at most."""
ABORT = "sdo_abort"


@dataclass(slots=True)
class Session(Watch):
    """A device that gets the stimuli of a case."""

    def begin(
        self,
        choices: dict[str, str],
        objects: Mapping[ObjectKey, bytes] = NOTHING,
        *,
        cold: bool = True,
    ) -> None:
        """Power cycle the device; where it is not `cold` its objects may hold anything after it."""
        self.adapter.reset()
        self.time = 0
        description = self.adapter.describe()
        self._batches = description.batch
        # in real time it is the clock that tells when a look was
        self._runs_ahead = description.advance_until and description.virtual_time
        self._ahead = {}
        self._seen = {}
        self._passed.clear()
        self._start_clock(real=not description.virtual_time)
        self.forget_trace()
        self.attempt = None
        self._counter = 0
        self._unasked = 0
        self._shown = {}
        self._shown_words = {}
        self._answers = []
        self._outputs = None
        self._hurries = False
        self.advice = {}
        self.overlooked = {}
        self.oracle.power_on(choices, objects, cold=cold)
        self._look()

    def apply(self, stimulus: Stimulus) -> None:
        """Give one stimulus and watch until nothing more may happen.

        Raises:
            Deviation: The device did what the texts do not allow.
            InconclusiveError: What it does has no end, or cannot be followed.

        """
        self._cycles = CYCLES
        match stimulus:
            case WriteRegister():
                self._write_registers(WriteRegisters((stimulus,)))
            case WriteRegisters():
                self._write_registers(stimulus)
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
            case ReadInitial(index, subindex):
                self._read_initial((index, subindex))
            case WriteUntilTaken(index, subindex):
                self._write_until_taken((index, subindex))
            case ReadConfiguration():
                self._read_configuration()
            case SetUpProcessData():
                for writes in settings(self.model, self.oracle.known.example(), stimulus):
                    self.apply(writes)
            case WriteOutputs():
                self._outputs = {**(self._outputs or {}), **stimulus.words}
                self._say(MAIN_DEVICE, partial(_outputs_words, self.model, stimulus.words))
                self._write_outputs(anywhere=True)
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
                self._raise_local(stimulus)
            case _:
                assert_never(stimulus)
        self._settle()

    def _write_registers(self, stimulus: WriteRegisters) -> None:
        address, data = registers_bytes(self.model, stimulus)
        self._say(MAIN_DEVICE, partial(_writes, self.model, *stimulus.writes), data)
        self._write(address, data)

    def _raise_local(self, stimulus: Happen) -> None:
        machine, _, event = stimulus.event.partition(".")
        self._say(SUB_DEVICE, f"{LOCAL_EVENT} {event.replace('_', ' ')}")
        raise_local(self.adapter, stimulus.event)
        self.oracle.happened(machine, event, self.time)

    def _uploaded(self, key: ObjectKey) -> bytes | None:
        """Read an entry to its end; give its value, None where the device refused."""
        self._answers = []
        for stimulus in read(*key):
            self.apply(stimulus)
        if not self._answers or any(answer.frame == ABORT for answer in self._answers):
            return None
        values = (answer.fields.get("value") for answer in self._answers)
        return b"".join(value for value in values if isinstance(value, bytes))

    def _read_initial(self, key: ObjectKey) -> None:
        """Note a value that is not the default, on a device that was switched off and on."""
        entry = self.model.dictionary.entries.get(key)
        held = self._uploaded(key)
        if entry is None or held is None or not self.adapter.describe().power_cycles:
            return
        default = sample(entry)
        same = (
            held.rstrip(b"\0") == default.rstrip(b"\0") if size_varies(entry) else held == default
        )
        if not same:
            exchange = self._exchange(0, b"", 1)
            if advice := of_default(self.oracle.known, exchange, entry, default, held):
                self._advise(advice)

    def _write_until_taken(self, key: ObjectKey) -> None:
        """Raise a deviation where every value is refused for no reason, what is held too."""
        entry = self.model.dictionary.entries.get(key)
        held = self._uploaded(key)
        if entry is None or held is None:
            return
        values = tuple(dict.fromkeys((held, *several_values(entry))))
        if all(self._refused(entry, value) for value in values):
            exchange = self._exchange(0, b"", 1)
            raise Deviation(takes_nothing(self.model, exchange, entry, len(values)))

    def _refused(self, entry: ObjectEntry, value: bytes) -> bool:
        """Write a value; tell whether the device refused it and no text nor its code says why."""
        for stimulus in write(self.model, entry, value):
            self._answers = []
            self.apply(stimulus)
            aborts = [answer for answer in self._answers if answer.frame == ABORT]
            if aborts:
                return all(unreasoned(self.oracle.known, answer) for answer in aborts)
        return False

    def _read_configuration(self) -> None:
        for name in (OUTPUTS, INPUTS):
            assignment = self.model.image.assignments[name]
            for pdo in dict.fromkeys(self._read_object(assignment)):
                self._read_object(pdo)
        for key in self.model.settings:
            self._ask(*key)

    def _read_object(self, index: int) -> list[int]:
        """Read the entries that an object counts; give those that are known then."""
        if (index, 0) not in self.model.dictionary.entries:
            return []
        self._ask(index, 0)
        known = self.oracle.known.example().objects
        count = known.get((index, 0), b"\0")[0]
        for subindex in range(1, count + 1):
            self._ask(index, subindex)
        known = self.oracle.known.example().objects
        found = (known.get((index, subindex)) for subindex in range(1, count + 1))
        return [int.from_bytes(value, "little") for value in found if value]

    def _ask(self, index: int, subindex: int) -> None:
        entry = self.model.dictionary.entries.get((index, subindex))
        if entry is not None and not (entry.constant and entry.default is not None):
            self._send(upload(index, subindex))
            self._settle()

    def _send(self, stimulus: SendFrame) -> None:
        if not stimulus.same_counter:
            self._counter = self._counter % self.model.parameter("highest_counter") + 1
        self._unasked -= 1
        self._cycles = CYCLES
        data = frame_bytes(self.model, stimulus, self._counter)
        message = self.model.decode(data)
        if message is not None:
            self._say(MAIN_DEVICE, partial(message_said, self.model, "sends", message), data)
        start, length = self._area(MAIN_OUT)
        # refused for longer than the request time, the oracle calls it a deviation
        limit = self.time + self.model.parameter("request_timeout")
        wait = FIRST_WAIT
        while not self._write(start, data[:length].ljust(length, b"\0")) and self.time <= limit:
            self._wait(wait)
            wait *= SLOWER[self._virtual]

    def is_deaf(self) -> bool:
        """Tell whether the mailbox answers nothing any more, where an answer was missed.

        A device that cannot be asked, or dies of it, is not: that is another cause.
        """
        entry = probe_entry(self.model)
        if entry is None:
            return False
        start, length = self._area(MAIN_OUT)
        # one of two counters differs from that of the request before
        for counter in (self.model.parameter("highest_counter"), 1):
            data = frame_bytes(self.model, upload(entry.index, entry.subindex), counter)
            try:
                self.adapter.write(start, data[:length].ljust(length, b"\0"))
                self.adapter.advance(self.model.parameter("response_timeout") / SECOND)
                if self.adapter.read(*self._area(MAIN_IN))[0]:
                    return False
            except (AdapterError, DeviceFault):
                return False
        return True

    def _send_segments(self) -> None:
        # each segment brings a byte at least, so an upload ends after as many as it has bytes
        for number in range(SEGMENTS):
            known = self.oracle.known
            over = not known.may_be("sdo", "UPLOADING") or known.may_be("sdo", "IDLE")
            if over or number > known.most("sdo.size"):
                return
            self._send(upload_segment(toggle=number % 2 == 1))
            self._settle()
        raise InconclusiveError(f"the upload does not end after {SEGMENTS} segments")

    def _repeat(self) -> None:
        register = self.model.protocol.registers[f"{MAIN_IN}_activation"]
        mask = field_mask(self.model.protocol, register.name, "repeat")
        raw = int.from_bytes(self.adapter.read(register.address, register.size)[1], "little")
        self._say(MAIN_DEVICE, "toggles the repeat bit")
        self._write(register.address, (raw ^ mask).to_bytes(register.size, "little"))


def _writes(model: Model, *writes: WriteRegister) -> str:
    return f"writes {'; '.join(register_words(model, w.register, w.fields) for w in writes)}"


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
