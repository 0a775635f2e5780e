"""Drives a device through one case and asks the oracle after every exchange."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, fields
from functools import partial
from time import monotonic
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.conformance.base.adapter import (
    AdapterError,
    DeviceFault,
    advance_until,
    raise_local,
    read_all,
)
from ecatspec.conformance.base.verdict import (
    LOCAL_EVENT,
    MAIN_DEVICE,
    REASON,
    SUB_DEVICE,
    WAITS,
    TraceLine,
)
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
from ecatspec.generators.cases.process_data import image, settings
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
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.object_dictionary import size_varies
from ecatspec.model.core.process_image import INPUTS, OUTPUTS
from ecatspec.model.core.register_map import (
    AREAS,
    PROCESS_DATA,
    SYNC_MANAGERS,
    field_mask,
    field_of,
)
from ecatspec.model.core.values import bits_of
from ecatspec.model.core.wording import message_words, register_words
from ecatspec.model.oracle.advice import of_default, takes_nothing, unreadable, unreasoned
from ecatspec.model.oracle.explanations import Exchange, Mismatch
from ecatspec.model.oracle.oracle import Oracle
from ecatspec.model.oracle.waiting import unseen

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from ecatspec.conformance.base.adapter import Adapter, Reading, Span
    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import ObjectKey, Value
    from ecatspec.spec.language.ir import ObjectEntry

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
ABORT = "sdo_abort"
_FLOOD = 64
"""More messages at once than a device can have reason for."""
UNASKED: Final = 1024
"""Unsolicited messages that are read in a case at most."""
LOOKS: Final = 64
"""Maximum number of looks for what is still to come of one stimulus."""
SEGMENTS: Final = 4096
"""Segments of one upload at most."""
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
class Session:
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
        self._began = None if description.virtual_time else monotonic()
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

    # --- entries ----------------------------------------------------------------------------------

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

    # --- process data -----------------------------------------------------------------------------

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

    # --- mailbox ----------------------------------------------------------------------------------

    def _send(self, stimulus: SendFrame) -> None:
        if not stimulus.same_counter:
            self._counter = self._counter % self.model.parameter("highest_counter") + 1
        self._unasked -= 1
        self._cycles = CYCLES
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
                self.adapter.advance(self.model.parameter("response_timeout") / _SECOND)
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

    def _area(self, name: str) -> tuple[int, int]:
        """Give where a mailbox lies as it is set, or as the device's description has it."""
        start, length = (self.model.parameter(AREAS[name], part) for part in ("start", "length"))
        return self.oracle.known.area(name) or (start, length)

    # --- watching ---------------------------------------------------------------------------------

    def _settle(self, *, unread: bool = False) -> None:
        if self._hurries:
            self._hurries = False
            self._look(unread=unread)
            self._keep_up()
            return
        wait = _FIRST_WAIT
        # where anything may happen there is nothing to see before it has
        open_for = self.oracle.known.open_until(self.time) - self.time
        if open_for > 0:
            self._wait(open_for + 1)
        for looks_left in reversed(range(LOOKS)):
            self._look(unread=unread)
            coming = self.oracle.to_come(self.time, unread=unread)
            self._keep_up()
            if not coming:
                break
            if self._runs_ahead and not self._passed:
                waits = self._foreseen(wait, coming, unread=unread)[:looks_left]
                if waits:
                    self._run_ahead(waits)
            self._wait(min(wait, min(coming) - self.time + 1))
            wait *= _SLOWER[self._virtual]
        else:
            raise InconclusiveError(f"the device does not come to rest, looked at {LOOKS} times")
        if not unread and unseen(self.model, self.oracle.expanded(self.time), self.time):
            why = "a reply is due, and whether it is there cannot be seen: working counter 0"
            raise InconclusiveError(why)

    def _foreseen(self, wait: int, coming: Collection[int], *, unread: bool) -> list[int]:
        """Give the waits, in microseconds, that follow while looks give what they gave last.

        They end with the first behind which something must have come: what is to be done then the
        oracle has to tell, and until then what it makes of a look that shows nothing new costs
        next to nothing. No wait: what a look begins with is not all that is done meanwhile.
        """
        looked = {span: self._seen.get(span) for span in self._spans(self.oracle)}
        shown = {span: reading for span, reading in looked.items() if reading is not None}
        reads_mail = self._mail_waits and not unread
        if self._outputs is not None or len(shown) < len(looked) or reads_mail:
            return []
        oracle, time = self.oracle.fork(), self.time
        waits: list[int] = []
        while coming and not oracle.lost:
            due = min(coming) - time + 1
            waits.append(min(wait, due))
            if wait >= due:
                break
            time += wait
            wait *= _SLOWER[self._virtual]
            for (address, _), (counter, data) in shown.items():
                read = Exchange(
                    time, write=False, address=address, data=data, working_counter=counter
                )
                if oracle.observe(read) is not None or self._spans(oracle) != tuple(shown):
                    return waits
            coming = oracle.to_come(time, unread=unread)
        return waits

    def _run_ahead(self, waits: Sequence[int]) -> None:
        """Let the device go through these waits by one exchange, as far as looks show nothing new.

        `_wait` and `_look` take from `_passed` what came of it, step by step.
        """
        seen = {span: self._seen[span] for span in self._spans(self.oracle)}
        marks = 0

        def mark() -> None:
            nonlocal marks
            self._passed.append(seen if marks % 2 else {})
            marks += 1

        steps = [wait / _SECOND for wait in waits]
        try:
            passed, found = advance_until(self.adapter, steps, seen, mark)
        except (AdapterError, DeviceFault) as error:
            self._passed.append(error)
        else:
            if marks < 2 * passed:
                self._passed.append(dict(zip(seen, found, strict=True)))

    def _keep_up(self) -> None:
        """End the case where there was too much to follow: nothing is known from there on."""
        if self.oracle.lost:
            raise InconclusiveError(TOO_MUCH)

    def _look(self, *, unread: bool = False) -> None:
        if self._passed:
            self._ahead = self._next_passed().copy()
        elif self._batches:
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
            if message is not None:
                self._answers.append(message)
            said = data if message is None else data[: self.model.codec.length(message)]
            self._say(SUB_DEVICE, partial(_message, self.model, "answers", message), said)
            self._observe(self._exchange(start, data, counter))
            if not counter:
                return
            self._unasked += self.oracle.known.judges_mail()
            if self._unasked > UNASKED:
                why = f"the device sends messages without end: {UNASKED} were unsolicited"
                raise InconclusiveError(why)

    def _next_passed(self) -> dict[Span, Reading]:
        """Give what the next of the waits and looks gave that the device has behind it."""
        given = self._passed.popleft()
        if isinstance(given, Exception):
            raise given
        return given

    def _read_ahead(self) -> None:
        """Read by one exchange with the adapter what a look begins with."""
        spans = self._spans(self.oracle)
        self._tick()
        self._ahead = dict(zip(spans, read_all(self.adapter, spans), strict=True))

    def _spans(self, oracle: Oracle) -> tuple[Span, ...]:
        """Give what a look begins with, in order, as this oracle has it."""
        inputs = oracle.known.process_area(DATA_IN)
        return (self._span(*AL), *([] if inputs is None else [inputs]), self._span(*_MAIL))

    def _read(self, address: int, length: int) -> Reading:
        """Read, if it was not read ahead."""
        span = address, length
        found = self._ahead.pop(span, None)
        self._seen[span] = self.adapter.read(address, length) if found is None else found
        return self._seen[span]

    def _span(self, *names: str) -> Span:
        """Give where registers lie, the lowest first: address and length."""
        first, last = (self.model.protocol.registers[name] for name in (names[0], names[-1]))
        return first.address, last.address + last.size - first.address

    def _full(self) -> bool:
        status = self._read_registers(*_MAIL)[0]
        self._mail_waits = bool(field_of(self.model.protocol, _MAIL[0], "full", status))
        return self._mail_waits

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

    def _tick(self) -> None:
        """Look at the clock: exchanges take time too, where it is real."""
        if self._began is not None:
            self.time = max(self.time, round((monotonic() - self._began) * _SECOND))

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
                self.adapter.advance(part / _SECOND)
            self.time += part
            self._write_outputs()

    def _say(self, who: str, what: str | Callable[[], str], data: bytes = b"") -> None:
        self._told.append((self.time, who, what, data))


_OF_ALL_CASES: Final = frozenset({"adapter", "model", "exchanges", "moved"})
"""What a session has beyond one case."""
_OWN: Final = tuple(item.name for item in fields(Session) if item.name not in _OF_ALL_CASES)


def _apart(value: object) -> object:
    """Give a value that does not change with the one in a session."""
    match value:
        case Oracle():
            return value.fork()
        case list() | dict() | deque():
            return value.copy()
        case _:
            return value


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
