"""Tests of judging: faults planted in a virtual SubDevice, found by clause."""

from __future__ import annotations

import random
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import pytest
from msgspec import structs

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.base.adapter import Description
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.device_link import Deviation
from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.run.session import Session
from ecatspec.generators.cases.bringup import WAY_UP, mailbox_settings, request, way_to
from ecatspec.generators.cases.case import (
    Case,
    Probe,
    Repeat,
    SendFrame,
    SendSegments,
    SetUpProcessData,
    Wait,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.cases.case_codec import case_of
from ecatspec.generators.cases.transfers import (
    download,
    normal_download,
    unsized,
    upload,
    upload_segment,
)
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.register_map import SYNC_MANAGERS
from ecatspec.model.core.state import Event, Output, RuleName, Step
from ecatspec.model.core.values import UNKNOWN, Octets, Pattern, Unknown, concrete
from ecatspec.model.esc import subdevice
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.oracle.explanations import Exchange
from ecatspec.model.oracle.oracle import Oracle
from ecatspec.spec.language.ir import Bytes, InputKind, Pin
from ecatspec.spec.language.load import load_device
from ecatspec.spec.language.references import ConditionRef
from ecatspec.spec.language.scope import frame_fields

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.expressions import Getter
    from ecatspec.model.core.state import State
    from ecatspec.model.core.values import Value
    from ecatspec.model.oracle.explanations import Mismatch
    from ecatspec.spec.language.ir import Choice, Condition, Protocol
    from ecatspec.spec.language.references import Ref
    from ecatspec.spec.language.scope import Scope

AKD = load_device("kollmorgen-akd")
STANDARD = load_device("standard")
SHAPE = {"emulation": "none", "mailbox_support": "present"}
NO_STATE = 15


@dataclass(slots=True)
class Faulty:
    """A virtual SubDevice with a fault: what it shows, what it answers, or when it answers."""

    device: VirtualSubDevice
    shown: Callable[[str, int], int] | None = None
    reply: Callable[[bytes], bytes] | None = None
    delay: float = 0.0
    silent: bool = False
    _clock: float = 0.0
    _due: list[float] = field(default_factory=list)

    def _place(self, register: str) -> tuple[int, int]:
        text = self.device.model.protocol.registers[register]
        return text.address, text.size

    def reset(self) -> None:
        self.device.reset()
        self._clock, self._due = 0.0, []

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        into = self.device.model.parameter("mailbox_in", "start")
        full = self._place("sync_manager_1_status")
        late = self.silent or any(self._clock < due for due in self._due)
        if late and address in {full[0], into}:
            return (1, bytes(length)) if address == full[0] else (0, bytes(length))
        counter, data = self.device.read(address, length)
        for register in ("al_status", "al_status_code"):
            start, size = self._place(register)
            low = start - address
            if self.shown is not None and 0 <= low <= length - size:
                raw = self.shown(register, int.from_bytes(data[low : low + size], "little"))
                data = data[:low] + raw.to_bytes(size, "little") + data[low + size :]
        if self.reply is not None and counter and address == into:
            data = self.reply(data)
        return counter, data

    def write(self, address: int, data: bytes) -> int:
        if address == self.device.model.parameter("mailbox_out", "start"):
            self._due = [self._clock + self.delay]
        return self.device.write(address, data)

    def advance(self, seconds: float) -> None:
        self._clock += seconds
        self.device.advance(seconds)

    def close(self) -> None:
        pass

    def describe(self) -> Description:
        return Description("faulty", frozenset({"al", "mailbox", "sdo"}), *(True, True))


KNOWN: list[Model] = []


def judge_of(protocol: Protocol) -> Model:
    """Give what judges a device of a text; what it has worked out once it knows."""
    for model in KNOWN:
        if model.protocol is protocol:
            return model
    model = Model(protocol, closed=True)
    KNOWN.append(model)
    return model


def judged(
    device: Faulty, stimuli: Sequence[Stimulus], choices: dict[str, str] | None = None
) -> tuple[Mismatch | None, dict[str, str]]:
    """Run from power-on: the mismatch, and the choices that the device has shown."""
    model = judge_of(device.device.model.protocol)
    session = Session(device, model, Oracle(model))
    try:
        session.begin(SHAPE | (choices or {}))
        for stimulus in stimuli:
            session.apply(stimulus)
    except Deviation as deviation:
        return deviation.mismatch, {}
    return None, session.oracle.known.choices()


def fault(device: Faulty, stimuli: Sequence[Stimulus]) -> Mismatch:
    sound, _ = judged(Faulty(VirtualSubDevice(device.device.model.protocol)), stimuli)
    assert sound is None, "the same stimuli without the fault"
    mismatch, _ = judged(device, stimuli)
    assert mismatch is not None, "the fault was not detected"
    return mismatch


def standard() -> VirtualSubDevice:
    return VirtualSubDevice(STANDARD)


def akd() -> VirtualSubDevice:
    return VirtualSubDevice(AKD)


MODEL = Model(STANDARD)
DRIVE = Model(AKD)
VALUE = {name: MODEL.row("al_state", name) for name in (*WAY_UP, "BOOT")}
PREOP = way_to(MODEL, "PREOP")
DRIVE_PREOP = way_to(DRIVE, "PREOP")
SKIP = request(VALUE["OP"])
ASK = upload(0x1018, 1)


# --- the AL state machine -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stimuli", "clause"),
    [
        ((request(VALUE["SAFEOP"]),), "AL-08"),
        ((request(NO_STATE),), "AL-09"),
        ((request(VALUE["PREOP"]),), "AL-04"),
        ((request(VALUE["BOOT"]),), "AL-06"),
        ((*PREOP, SKIP), "AL-08"),
        ((*PREOP, WriteRegister("sync_manager_0_activation", {})), "AL-20"),
    ],
)
def test_a_wrong_status_code(stimuli: tuple[Stimulus, ...], clause: str) -> None:
    wrong = Faulty(standard(), lambda name, raw: 1 if name == "al_status_code" and raw else raw)
    mismatch = fault(wrong, stimuli)
    assert clause in mismatch.clauses
    assert mismatch.subject == "al_status_code"
    assert "0x0001" in mismatch.observed


def test_an_error_indication_that_never_comes() -> None:
    mute = Faulty(standard(), lambda name, raw: raw & ~0x10 if name == "al_status" else raw)
    mismatch = fault(mute, (*PREOP, SKIP))
    assert "AL-08" in mismatch.clauses
    assert mismatch.subject == "al_status"


class Forgiving(VirtualSubDevice):
    """Takes every request as one with acknowledge."""

    def write(self, address: int, data: bytes) -> int:
        control = self.model.protocol.registers["al_control"]
        if address == control.address:
            data = bytes([data[0] | 0x10, *data[1:]])
        return super().write(address, data)


def test_a_change_of_state_without_acknowledge() -> None:
    stimuli = (*PREOP, SKIP, request(VALUE["SAFEOP"]))
    mismatch = fault(Faulty(Forgiving(STANDARD)), stimuli)
    assert "AL-16" in mismatch.clauses


def test_a_request_that_nothing_follows() -> None:
    stuck = Faulty(standard(), lambda name, _: 1 if name == "al_status" else 0)
    assert "AL-03" in fault(stuck, PREOP).clauses


# --- the mailbox ----------------------------------------------------------------------------------


class Repeating(VirtualSubDevice):
    """Does not know duplicates: forgets the counter after every message."""

    def poll(self) -> None:
        super().poll()
        self.state = self.state.having(self.model.slots["mailbox.last"], 0)


def test_a_duplicate_that_is_answered() -> None:
    twin = SendFrame(ASK.frame, ASK.fields, same_counter=True)
    mismatch = fault(Faulty(Repeating(STANDARD)), (*PREOP, ASK, twin))
    assert "MBX-04" in mismatch.clauses
    # a full mailbox alone may be an emergency: it is the message that gives the device away
    assert mismatch.observed.startswith("sdo_upload_expedited")


def test_no_reply_at_all() -> None:
    mismatch = fault(Faulty(standard(), silent=True), (*PREOP, ASK))
    assert "SDO-22" in mismatch.clauses
    assert mismatch.observed == "mailbox empty: no reply"


def test_a_reply_that_is_too_late() -> None:
    mismatch = fault(Faulty(standard(), delay=3.0), (*PREOP, ASK))
    assert "SDO-22" in mismatch.clauses
    assert "no reply" in mismatch.observed


def test_a_reply_after_a_second_is_in_time() -> None:
    mismatch, _ = judged(Faulty(standard(), delay=1.0), (*PREOP, ASK, ASK))
    assert mismatch is None


def altered(frame: str, change: Callable[[int], int], name: str) -> Callable[[bytes], bytes]:
    """Change one field of a reply of the layout `frame`."""

    def reply(data: bytes) -> bytes:
        message = DRIVE.codec.decode(data, "mailbox")
        if message is None or frame not in message.trail:
            return data
        before = message.fields[name]
        assert isinstance(before, int)
        fields = dict(message.fields) | {name: change(before)}
        del fields["payload"], fields["length"]
        if message.frame != "coe":
            fields.pop("body", None)
        return DRIVE.codec.encode(message.frame, fields).ljust(len(data), b"\0")

    return reply


def test_a_counter_that_does_not_count() -> None:
    stuck = Faulty(akd(), reply=altered("mailbox", lambda _: 5, "counter"))
    mismatch = fault(stuck, (*DRIVE_PREOP, ASK, ASK))
    assert mismatch.subject == "reply"
    assert "counter 5" in mismatch.observed
    assert any("but not 5" in expected for expected in mismatch.expected)


def test_a_device_that_never_counts_is_allowed() -> None:
    zero = Faulty(standard(), reply=altered("mailbox", lambda _: 0, "counter"))
    mismatch, choices = judged(zero, (*PREOP, ASK, ASK))
    assert mismatch is None
    assert choices["reply_counter"] == "zero"


# --- SDO ------------------------------------------------------------------------------------------


def test_a_wrong_index_in_an_abort() -> None:
    wrong = Faulty(akd(), reply=altered("sdo_abort", lambda index: index ^ 1, "index"))
    mismatch = fault(wrong, (*DRIVE_PREOP, upload(0xFFFF, 0)))
    assert {"SDO-03", "SDO-07"} <= set(mismatch.clauses)


def test_a_wrong_abort_code() -> None:
    wrong = Faulty(akd(), reply=altered("sdo_abort", lambda code: code + 1, "code"))
    mismatch = fault(wrong, (*DRIVE_PREOP, upload(0x1000, 1)))
    assert "SDO-08" in mismatch.clauses


class Forgetful(VirtualSubDevice):
    """Confirms every download and keeps none."""

    def poll(self) -> None:
        kept = self.state.objects
        super().poll()
        if kept:
            self.state = type(self.state)(self.state.slots, kept)


def test_a_value_that_is_confirmed_and_not_stored() -> None:
    stimuli = (*DRIVE_PREOP, download(0x60C2, 1, b"\x05"), upload(0x60C2, 1))
    mismatch = fault(Faulty(Forgetful(AKD)), stimuli)
    assert "SDO-23" in mismatch.clauses
    assert any("value 05" in expected for expected in mismatch.expected)


def test_a_wrong_size() -> None:
    wrong = Faulty(akd(), reply=altered("sdo_upload_expedited", lambda _: 1, "unused"))
    mismatch = fault(wrong, (*DRIVE_PREOP, upload(0x1000, 0)))
    assert "SDO-04" in mismatch.clauses


def test_a_probe_is_a_request_that_is_answered() -> None:
    assert "SDO-22" in fault(Faulty(standard(), silent=True), (*PREOP, Probe())).clauses


# --- choices --------------------------------------------------------------------------------------


def going(way: str) -> Faulty:
    """A device that goes one of both ways when a request is refused in OP."""
    device = standard()
    slot = device.model.slots["choice refused_in_op"]
    device._power_on = device._power_on.having(slot, way)  # noqa: SLF001  no text pins it
    return Faulty(device)


REFUSED = (*way_to(MODEL, "OP"), request(VALUE["BOOT"]))
WAYS = ("drop_to_safeop", "stay")


@pytest.mark.parametrize("way", WAYS)
def test_either_way_is_right_and_learned(way: str) -> None:
    mismatch, choices = judged(going(way), REFUSED)
    assert mismatch is None
    assert choices["refused_in_op"] == way
    again, _ = judged(going(way), REFUSED, choices)
    assert again is None


@pytest.mark.parametrize(("first", "then"), [WAYS, WAYS[::-1]])
def test_both_ways_in_one_device_are_a_deviation(first: str, then: str) -> None:
    _, choices = judged(going(first), REFUSED)
    mismatch, _ = judged(going(then), REFUSED, choices)
    assert mismatch is not None
    assert {"AL-08", "AL-10"} <= set(mismatch.clauses)


class _Stuck(VirtualSubDevice):
    """Takes no request for some of its time after the first."""

    seconds = 0.0
    left = 0.0
    taken = 0

    def write(self, address: int, data: bytes) -> int:
        mailbox = self.esc.mailbox(SYNC_MANAGERS[0])
        if mailbox is not None and address == mailbox.channel.start:
            if self.taken and self.left > 0:
                return 0
            self.taken += 1
            self.left = self.seconds
        return super().write(address, data)

    def advance(self, seconds: float) -> None:
        self.left -= seconds
        super().advance(seconds)

    def close(self) -> None:
        self.left = 0.0

    def describe(self) -> Description:
        return Description("stuck", frozenset(), virtual_time=True, closed_dictionary=True)


@pytest.mark.parametrize(("seconds", "stuck"), [(0.05, False), (5.0, True)])
def test_a_request_must_be_taken_within_the_request_time(seconds: float, *, stuck: bool) -> None:
    model = Model(AKD)
    device = _Stuck(AKD)
    device.seconds = seconds
    session = Session(device, model, Oracle(model))
    session.begin(SHAPE)
    for stimulus in way_to(model, "PREOP"):
        session.apply(stimulus)
    session.apply(Probe())
    if stuck:
        with pytest.raises(Deviation, match="refused") as found:
            session.apply(Probe())
        assert "MBX-10" in found.value.mismatch.clauses
    else:
        session.apply(Probe())


def test_a_wrong_power_on_value_cites_its_clause() -> None:
    def awake(register: str, raw: int) -> int:
        return Model(AKD).row("al_state", "OP") if register == "al_status" else raw

    session = Session(Faulty(VirtualSubDevice(AKD), shown=awake), Model(AKD), Oracle(Model(AKD)))
    with pytest.raises(Deviation) as found:
        session.begin(SHAPE)
    assert "AL-01" in found.value.mismatch.clauses


# --- freedom: what the texts leave open is never blamed -------------------------------------------

REFERENCE = replace(load_device("reference"), pins={})
"""Every choice of the standard open, as before a device has shown its ways."""
JUDGE = Model(REFERENCE, closed=True)
OPEN = replace(REFERENCE, dictionary=replace(REFERENCE.dictionary, closed=False))
SEGMENTS = SendSegments()


def segment(toggle: int, value: bytes, *, last: bool = False) -> SendFrame:
    fields: dict[str, Value] = {"toggle": toggle, "value": value, "last": int(last)}
    return SendFrame("sdo_download_segment", fields)


def segments(first: int, *values: bytes) -> tuple[Stimulus, ...]:
    """Segments with toggle bits that alternate, the last one marked."""
    return tuple(
        segment((first + place) % 2, value, last=place == len(values) - 1)
        for place, value in enumerate(values)
    )


def asked(toggle: int, **fields: Value) -> SendFrame:
    return SendFrame("sdo_upload_segment", {"toggle": toggle, **fields})


def normal(index: int, subindex: int, value: bytes, **fields: Value) -> SendFrame:
    given = {"index": index, "subindex": subindex, "value": value, **fields}
    return SendFrame("sdo_download_normal", given)


def odd(stimulus: SendFrame, **fields: Value) -> SendFrame:
    return replace(stimulus, fields={**stimulus.fields, **fields})


def coe(service: int, body: bytes) -> SendFrame:
    return SendFrame("coe", {"service": service, "body": body})


def raw(kind: int, payload: bytes, **fields: Value) -> SendFrame:
    return SendFrame("mailbox", {"type": kind, "payload": payload, **fields})


def listed(kind: int, **fields: Value) -> SendFrame:
    return SendFrame("information_list_request", {"list_type": kind, **fields})


def described(index: int, **fields: Value) -> SendFrame:
    return SendFrame("information_object_request", {"index": index, **fields})


def entry(index: int, subindex: int, **fields: Value) -> SendFrame:
    given = {"index": index, "subindex": subindex, "value_info": 0, **fields}
    return SendFrame("information_entry_request", given)


def information(opcode: int, content: bytes) -> SendFrame:
    return SendFrame("sdo_information", {"opcode": opcode, "information": content})


def kept(stimulus: SendFrame) -> SendFrame:
    """The same request, its answer left in the mailbox."""
    return replace(stimulus, unread=True)


END = SendFrame("sdo_abort", {"index": 0x2023, "subindex": 0, "code": 0x08000000})
BLOCK = normal(0x2023, 0, b"a" * 112, size=200)
"""The first message of a transfer of 200 bytes; 88 are left."""
TEXT = upload(0x2023, 0)
BYTE = upload(0x2000, 0)

STIMULI: dict[str, tuple[Stimulus, ...]] = {
    "uploads": (
        *(s for i in (0x1001, 0x1008, 0x2000, 0x2004, 0x2021) for s in (upload(i, 0), SEGMENTS)),
        *(upload(0x2010, 1), upload(0x2010, 9), upload(0x3000, 0), upload(0x200A, 0)),
        *(upload(0x2012, 2), upload(0x2020, 0), SEGMENTS, TEXT, SEGMENTS),
        *(upload(0x2014, 3), SEGMENTS, upload(0x2030, 0)),
        *(TEXT, asked(1), asked(0), asked(0), asked(1), asked(0)),
        *(TEXT, segment(0, b"a"), asked(0), TEXT, asked(0), END, asked(1), BYTE, asked(0)),
    ),
    "downloads": (
        *(download(0x2000, 0, b"\5"), BYTE, normal(0x2000, 0, b"\6"), BYTE),
        *(odd(download(0x2000, 0, b"\7\0\0\0"), size_indicated=0, unused=0), BYTE),
        *(download(0x2000, 0, b"\1\2"), download(0x2001, 0, b"\1"), download(0x1008, 0, b"a")),
        *(download(0x2005, 0, b"\6"), download(0x2005, 0, b"\xf0"), download(0x2005, 0, b"\4")),
        *(upload(0x2005, 0), normal(0x2004, 0, bytes(range(8))), upload(0x2004, 0), SEGMENTS),
        *(download(0x3000, 0, b"a"), download(0x2010, 9, b"a"), download(0x2041, 0, b"\1\1")),
        *(download(0x2020, 0, b"ab"), upload(0x2020, 0), SEGMENTS),
        *(normal(0x2021, 0, b""), upload(0x2021, 0), SEGMENTS, normal(0x2000, 0, b"", size=1)),
        *(segment(0, b"\1", last=True), normal(0x3000, 0, b"", size=1), *segments(0, b"a")),
    ),
    "segments": (
        *(BLOCK, *segments(0, b"b" * 88), TEXT, SEGMENTS),
        *(BLOCK, segment(1, b"b" * 88, last=True), *segments(0, b"b" * 88), TEXT, SEGMENTS),
        *(BLOCK, *segments(0, b"b" * 80), TEXT, SEGMENTS),
        *(BLOCK, segment(0, b"b" * 80), segment(1, b"c" * 80), TEXT, SEGMENTS),
        *(BLOCK, *segments(0, b"b" * 88, b""), TEXT, SEGMENTS),
        *(normal(0x2023, 0, b"a" * 20, size=200), *segments(0, b"b" * 100, b"c" * 80)),
        *(normal(0x2023, 0, b"a" * 112, size=400), *segments(0, b"b" * 119, b"b" * 119, b"b" * 50)),
        *(normal(0x2001, 0, b"", size=2), *segments(0, b"\1\2"), upload(0x2001, 0)),
        *(normal(0x2001, 0, b"", size=3), *segments(0, b"\1\2\3"), upload(0x2001, 0)),
        *(BLOCK, BYTE, segment(0, b"b" * 88), BLOCK, asked(0), segment(0, b"b" * 88), BYTE),
        *(BLOCK, END, segment(0, b"b" * 88), BYTE),
        *(normal(0x2014, 3, b"x" * 112, size=1000), *segments(0, *[b"y" * 119] * 7, b"z" * 55)),
        *(upload(0x2014, 3), SEGMENTS),
    ),
    "complete": (
        *(
            stimulus
            for index in (0x2010, 0x2011, 0x2012, 0x2013, 0x2015, 0x3000)
            for subindex in (0, 1)
            for stimulus in (upload(index, subindex, complete=True), SEGMENTS)
        ),
        *(upload(0x2010, 2, complete=True), upload(0x2000, 2, complete=True)),
        *(upload(0x2009, 0, complete=True), SEGMENTS, upload(0x2014, 0, complete=True), SEGMENTS),
        *(normal(0x2011, 1, bytes(range(16)), complete_access=1), upload(0x2011, 3)),
        *(upload(0x2011, 1, complete=True), SEGMENTS),
        normal(0x2011, 0, b"\x08\0" + bytes(range(16)), complete_access=1),
        *(normal(0x2011, 1, bytes(14), complete_access=1), upload(0x2011, 1, complete=True)),
        *(SEGMENTS, normal(0x2011, 1, bytes(20), complete_access=1), upload(0x2011, 8)),
        *(download(0x2015, 1, b"\1\2", complete=True), upload(0x2015, 1)),
        *(download(0x2015, 0, b"\1\0\3\4", complete=True), upload(0x2015, 1)),
        *(
            download(0x2000, 0, b"\3", complete=True),
            BYTE,
            download(0x2000, 2, b"\3", complete=True),
        ),
        *(download(0x3000, 0, b"\1", complete=True), download(0x3000, 2, b"\1", complete=True)),
        normal(0x2010, 1, b"\1\2\0\3\0\0\0\4\0five\0\0\0\0", complete_access=1),
        *(upload(0x2010, 5), SEGMENTS, upload(0x2010, 1, complete=True), SEGMENTS),
        normal(0x2010, 1, b"\1\2\0\xff\xff\xff\xff\4\0five\0\0\0\0", complete_access=1),
        *(upload(0x2010, 1, complete=True), SEGMENTS),
        *(normal(0x2013, 1, b"\1\2\3\4", complete_access=1), upload(0x2013, 1)),
        *(normal(0x2012, 0, b"\3\0" + bytes(8), complete_access=1), upload(0x2012, 1)),
        normal(0x2014, 1, b"q" * 112, size=1640, complete_access=1),
        *segments(0, *[b"y" * 119] * 12, b"z" * 100),
        *(upload(0x2014, 1, complete=True), SEGMENTS, upload(0x2014, 1), SEGMENTS),
        normal(0x2014, 1, b"q" * 112, size=1639, complete_access=1),
        *segments(0, b"y" * 119, b"y" * 5),
    ),
    "information": (
        *(listed(kind) for kind in (0, 1, 2, 5, 6, 77)),
        *(described(index) for index in (0x1018, 0x2000, 0x2010, 0x2020, 0x3000, 5)),
        *(entry(0x1018, 1), entry(0x2000, 0), entry(0x2009, 0), entry(0x200A, 0)),
        *(entry(0x2010, 9), entry(0x3000, 0), entry(5, 0), entry(0x2041, 0), entry(0x2020, 0)),
        *(listed(1, incomplete=1), listed(1, fragments_left=3)),
        *(described(0x2000, fragments_left=3), described(0x3000, reserved_info=3)),
        *(entry(0x2000, 0, incomplete=1), entry(5, 0, incomplete=1)),
        *(information(opcode, b"\1\0\0") for opcode in (0, 1, 2, 3, 5, 7, 9)),
        *(described(5), upload(0x2000, 0), listed(1)),
    ),
    "mailbox": (
        *(raw(3, b""), raw(3, b"\0"), raw(3, b"\0\x20"), BYTE, raw(0, b""), raw(6, b"abc")),
        *(raw(14, b""), raw(2, b"abcd"), BYTE, odd(BYTE, channel=5), odd(BYTE, reserved=1)),
        *(odd(BYTE, address=7), odd(BYTE, number=5), odd(BYTE, reserved_coe=1)),
        *(raw(3, b"\0\x20\x40", length=200), raw(6, b"\0\x20\x40", length=2000), BYTE),
        *(coe(service, b"12345678") for service in (0, 1, 3, 9, 15, 4)),
        *(coe(2, b""), coe(8, b""), coe(8, b"\1"), coe(2, b"\x40"), BYTE),
        *(BYTE, Repeat(), upload(0x2001, 0), Repeat(), Repeat()),
        *(replace(BYTE, same_counter=True), upload(0x2001, 0), kept(BYTE), Repeat()),
        *(upload(0x2001, 0), kept(BYTE), upload(0x2003, 0), kept(BYTE), kept(upload(0x2001, 0))),
        *(BYTE, kept(BYTE), odd(BYTE, channel=3), kept(listed(1)), BYTE, listed(1), Repeat()),
        *(TEXT, Repeat(), SEGMENTS, Repeat(), Probe()),
    ),
    "malformed": (
        *(coe(2, b"\x40\0\0\0"), asked(0), coe(2, b"\x40\0\0\0"), *segments(0, b"1234567")),
        *(BYTE, coe(2, b"\x20\0\x20\0"), coe(2, b"\x80"), coe(2, b"\x81" + bytes(7))),
        *(coe(2, b"\xa0" + bytes(7)), coe(2, b"\xe0"), coe(2, b"\xc0")),
        *(
            odd(BYTE, excess=b"12"),
            asked(0),
            odd(BYTE, reserved_bits=2),
            odd(BYTE, reserved_data=2),
        ),
        *(segment(0, b"1"), odd(download(0x2000, 0, b"\3"), excess=b"12"), asked(0), BYTE),
        *(normal(0x2001, 0, b"\1\2", size=1), segment(0, b"1"), upload(0x2001, 0)),
        *(normal(0x2001, 0, b"\1\2", size_indicated=0), upload(0x2001, 0)),
        *(asked(0, excess=b"1"), asked(0), BLOCK, odd(segment(0, b"abc"), unused=0, padding=b"")),
        *(segment(0, b"123456789"), segment(1, b"123456789"), TEXT, SEGMENTS),
        *(BLOCK, coe(2, b"\xa0" + bytes(7)), segment(0, b"123456789"), TEXT, SEGMENTS),
        *(TEXT, coe(2, b"\xa0" + bytes(7)), asked(0), TEXT, asked(0, excess=b"1"), asked(0), BYTE),
    ),
}
CONCERNED = {
    "MBX": ("mailbox",),
    "COE": ("mailbox",),
    "SDO": ("uploads", "downloads", "segments", "complete", "malformed"),
    "INF": ("information",),
}
"""Which stimuli try a freedom, by the text that its clauses stand in."""


def of_the_mailbox(clauses: tuple[str, ...]) -> str | None:
    text = clauses[0].partition("-")[0]
    return text if text in CONCERNED else None


WAYS_TO_GO = [
    (choice, way.name)
    for choice in REFERENCE.choices.values()
    if of_the_mailbox(choice.clauses) and choice.name != "mailbox_support"
    for way in choice.alternatives[1:]
]
"""All but the first ways, which a device goes that nothing is said of."""
TRUTHS = [c for c in REFERENCE.conditions.values() if of_the_mailbox(c.clauses)]


def blamed(device: VirtualSubDevice, judge: Model, *names: str) -> str:
    """What a device is blamed for, with the last lines of the trace; empty if it is not."""
    session = Session(Faulty(device), judge, Oracle(judge))
    way = way_to(judge, "PREOP")
    for name in names:
        try:
            session.begin({"emulation": "none"})
            # repeats before anything was read, without and with a mailbox that works
            for stimulus in (*way[:2], Repeat(), *way[2:], Repeat(), *STIMULI[name]):
                session.apply(stimulus)
        except Deviation as deviation:
            last = "\n".join(f"{line.who} {line.what}" for line in session.trace[-6:])
            return f"{name}: {deviation.mismatch.observed}\n{last}"
    return ""


@pytest.mark.parametrize(
    ("choice", "way"), WAYS_TO_GO, ids=[f"{choice.name}-{way}" for choice, way in WAYS_TO_GO]
)
def test_no_way_at_a_choice_is_blamed(choice: Choice, way: str) -> None:
    pins = REFERENCE.pins | {choice.name: Pin(choice.name, way, ())}
    device = VirtualSubDevice(replace(REFERENCE, pins=pins))
    assert blamed(device, JUDGE, *CONCERNED[of_the_mailbox(choice.clauses) or ""]) == ""


@pytest.mark.parametrize("condition", TRUTHS, ids=lambda condition: condition.name)
def test_no_truth_of_a_condition_is_blamed(condition: Condition) -> None:
    other = replace(condition, assumed=not condition.assumed)
    conditions = REFERENCE.conditions | {condition.name: other}
    device = VirtualSubDevice(replace(REFERENCE, conditions=conditions))
    assert blamed(device, JUDGE, *CONCERNED[of_the_mailbox(condition.clauses) or ""]) == ""


def test_the_first_ways_and_the_assumed_truths_are_not_blamed() -> None:
    assert blamed(VirtualSubDevice(REFERENCE), JUDGE, *STIMULI) == ""


@pytest.mark.parametrize("target", ["IDLE", None])
@pytest.mark.parametrize("way", ["short_abort_silent", "short_abort_erred"])
def test_an_abort_that_is_too_short_may_end_the_transfer_or_not(
    target: str | None, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sdo = REFERENCE.machines["sdo"]
    rules = tuple(replace(r, target=target) if r.name == way else r for r in sdo.rules)
    unheard = replace(
        REFERENCE.conditions["short_abort_unheard"], assumed=way == "short_abort_silent"
    )
    device = replace(
        REFERENCE,
        machines=REFERENCE.machines | {"sdo": replace(sdo, rules=rules)},
        conditions=REFERENCE.conditions | {unheard.name: unheard},
    )
    short = odd(END, length=JUDGE.codec.size("coe") + 1)
    stimuli = (BLOCK, segment(0, b"b" * 88), short, segment(1, b"c" * 80), BYTE, short, BYTE)
    monkeypatch.setitem(STIMULI, "cut", stimuli)
    assert blamed(VirtualSubDevice(device), JUDGE, "cut") == ""


def test_a_device_without_a_mailbox_is_not_blamed() -> None:
    pins = REFERENCE.pins | {"mailbox_support": Pin("mailbox_support", "absent", ())}
    assert blamed(VirtualSubDevice(replace(REFERENCE, pins=pins)), JUDGE, *STIMULI) == ""


class Whims(Model):
    """A model whose conditions hold or not at every event anew."""

    dice: random.Random
    truths: dict[str, bool]

    def _getter(self, ref: Ref, scope: Scope) -> Getter:
        if isinstance(ref, ConditionRef):
            name = ref.name
            return lambda _: self.truths.setdefault(name, self.dice.random() < 0.5)
        return super()._getter(ref, scope)


class Whimsical(VirtualSubDevice):
    """A device that the texts allow and that nobody can foresee; `fired` are its rules."""

    def __init__(
        self,
        protocol: Protocol,
        seed: int,
        monkeypatch: pytest.MonkeyPatch,
        *,
        knows_all: bool = True,
    ) -> None:
        self.dice = random.Random(seed)
        self.fired: set[str] = set()

        def whims(protocol: Protocol, *, assuming: bool, closed: bool) -> Whims:
            model = Whims.__new__(Whims)
            model.dice, model.truths = self.dice, {}
            model.__init__(  # type: ignore[misc]
                protocol, assuming=assuming, closed=closed and knows_all
            )
            return model

        with monkeypatch.context() as patch:
            patch.setattr(subdevice, "Model", whims)
            super().__init__(self._drawn(protocol))
        monkeypatch.setattr(subdevice, "concrete", self._any_of)

    def _drawn(self, protocol: Protocol) -> Protocol:
        ways = {
            choice.name: Pin(choice.name, self.dice.choice(choice.alternatives).name, ())
            for choice in protocol.choices.values()
            if choice.name not in SHAPE
        }
        return replace(protocol, pins=ways)

    def _any_of(self, value: Value, after: int = -1) -> Value:
        taken = concrete(value, after)
        if not isinstance(value, Pattern):
            return taken
        if isinstance(value, Octets):
            assert isinstance(taken, bytes)
            return taken[: self.dice.choice((len(taken), self.dice.randint(*self._few(value))))]
        if isinstance(value, Unknown):
            return self.dice.choice((taken, self.dice.randint(0, 1)))
        drawn = self.dice.randint(*self.dice.choice(value.ranges))
        return taken if drawn == value.excluded else drawn

    def _few(self, value: Octets) -> tuple[int, int]:
        most = len(value.taken())
        return min(most, value.lengths[0]), most

    def _concrete(self, fields: dict[str, Value], frame: str) -> dict[str, Value]:
        kinds = frame_fields(self.model.protocol, frame)
        bodies = {n for n, v in fields.items() if isinstance(kinds[n], Bytes) and v == UNKNOWN}
        given = fields | {name: self.dice.randbytes(self.dice.randint(1, 4)) for name in bodies}
        return super()._concrete(given, frame)

    def _run(self, event: Event, message: Message | None = None) -> None:
        assert isinstance(self.model, Whims)
        self.model.truths.clear()
        self.model.answers.clear()
        super()._run(event, message)

    def _send(self, outputs: tuple[Output, ...]) -> None:
        self.fired |= {str(output.rule) for output in outputs}
        super()._send(outputs)


@pytest.mark.parametrize("seed", range(6))
def test_no_mixture_of_freedoms_is_blamed(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Choices drawn once, conditions and acceptable values at every event, half of them with
    objects that no text declares.
    """
    known = bool(seed % 2)
    device = Whimsical(REFERENCE, seed, monkeypatch, knows_all=known)
    judge = JUDGE if known else Model(OPEN)
    assert blamed(device, judge, *STIMULI) == ""
    assert len(device.fired) > 20


def test_what_a_freedom_forbids_is_still_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests above can fail: one wrong bit in one answer is blamed."""
    device = Whimsical(REFERENCE, 0, monkeypatch)
    monkeypatch.setattr(device, "_concrete", lambda fields, _: wrong(fields))

    def wrong(fields: dict[str, Value]) -> dict[str, Value]:
        given = {name: device._any_of(value) for name, value in fields.items()}  # noqa: SLF001
        index = given.get("index")
        return given | ({"index": index ^ 1} if isinstance(index, int) else {})

    assert "index 0x" in blamed(device, JUDGE, "uploads")


# --- devices that take their time -----------------------------------------------------------------


class Busy(VirtualSubDevice):
    """A device that takes and answers requests when it likes to."""

    take = 0.0
    """Seconds until a request is taken from the mailbox."""
    answer = 0.0
    """Seconds from there until its answer is in the mailbox."""
    eager = False
    """It takes the next request although the answer before was not read."""
    refuses = False
    """It answers what comes too early at once: error 9, service in work."""
    before = after = 0
    """How many emergencies come before and after each answer."""
    _now = 0.0
    _came: float | None = None
    _due: tuple[float, ...] = ()

    def reset(self) -> None:
        self._now, self._came, self._due = 0.0, None, ()
        super().reset()

    def advance(self, seconds: float) -> None:
        self._now += seconds
        super().advance(seconds)

    def _serve_mailbox(self) -> None:
        inbox, outbox = (self.esc.mailbox(name) for name in SYNC_MANAGERS)
        if inbox is None or outbox is None:
            self._unread, self._came, self._due = None, None, ()
            return
        if len(self._due) > len(self._queue):  # the mailbox was started anew
            self._due = self._due[len(self._due) - len(self._queue) :]
        if inbox.full and self._came is None:
            self._came = self._now
        crowded = outbox.full or bool(self._queue)
        ready = self._came is not None and self._now >= self._came + self.take
        if inbox.full and ready and (self.eager or self.refuses or not crowded):
            message = self.model.decode(
                self.esc.pdi_read(inbox.channel.start, inbox.channel.length)
            )
            self._came = None
            if message is not None:
                self._served_one(message, crowded=crowded)
        if self._queue and not outbox.full and self._now >= self._due[0]:
            self._due = self._due[1:]
            self._unread = self._queue.pop(0)
            area = outbox.channel
            self.esc.pdi_write(area.start, self._unread.ljust(area.length, b"\0"))

    def _served_one(self, message: Message, *, crowded: bool) -> None:
        if crowded and self.refuses:
            slot = self.model.slots["mailbox.last"]
            counter = message.fields["counter"]
            if counter != self.state.slots[slot] or not counter:
                self.state = self.state.having(slot, counter)
                detail = self.model.row("mailbox_error_detail", "service_in_work")
                fields = self._defaults("mailbox") | {"detail": detail}
                self._queue.insert(0, self.model.codec.encode("mailbox_error", fields))
                self._due = (self._now, *self._due)
            return
        self._storm(self.before)
        self._run(self.model.mail(message, crowded=crowded), message)
        self._storm(self.after)
        late = len(self._queue) - len(self._due)
        self._due += (self._now + self.answer,) * late

    def _storm(self, count: int) -> None:
        fields: dict[str, Value] = {
            "error_code": self.model.row("emergency_code", "generic_error"),
            "error_register": 1,
            "manufacturer": bytes(5),
        }
        for _ in range(count):
            self._run(Event("emergency", "arises", fields))


TIMING: dict[str, dict[str, float]] = {
    "takes a request late": {"take": 0.09},
    "answers late": {"answer": 1.9},
    "takes and answers late": {"take": 0.05, "answer": 1.0},
    "takes the next request early": {"eager": True},
    "takes the next request early and answers late": {"eager": True, "answer": 1.5},
    "refuses what comes too early": {"refuses": True},
    "refuses what comes too early and answers late": {"refuses": True, "answer": 1.0},
    "has an emergency before": {"before": 1},
    "has an emergency after": {"after": 1},
    "has emergencies around": {"before": 2, "after": 2, "eager": True},
    "has emergencies and answers late": {"before": 1, "after": 1, "answer": 0.3},
}
SHORT = upload(0x2001, 0)
CROWD: tuple[Stimulus, ...] = (
    *(BYTE, SHORT, TEXT, SEGMENTS, download(0x2000, 0, b"\3"), BYTE),
    *(kept(BYTE), SHORT, kept(BYTE), kept(SHORT), BYTE, kept(TEXT), SEGMENTS, BYTE),
    *(kept(download(0x2000, 0, b"\4")), BYTE, kept(BYTE), replace(BYTE, same_counter=True)),
    *(kept(upload(0x3000, 0)), kept(described(0x2000)), listed(1), kept(raw(6, b"abc")), BYTE),
    *(kept(BYTE), request(VALUE["INIT"]), request(VALUE["PREOP"]), BYTE, Probe()),
)


@pytest.mark.parametrize("manner", TIMING)
def test_no_order_of_a_busy_device_is_blamed(manner: str, monkeypatch: pytest.MonkeyPatch) -> None:
    device = Busy(REFERENCE)
    for name, value in TIMING[manner].items():
        monkeypatch.setattr(device, name, value)
    monkeypatch.setitem(STIMULI, "crowd", CROWD)
    assert blamed(device, JUDGE, "crowd") == ""


@pytest.mark.parametrize(("take", "answer"), [(3.0, 0.0), (0.0, 3.0)])
def test_a_busy_device_that_is_too_late_is_blamed(
    take: float, answer: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = Busy(REFERENCE)
    device.take, device.answer = take, answer
    monkeypatch.setitem(STIMULI, "crowd", CROWD)
    assert blamed(device, JUDGE, "crowd")


# --- what a capture has lost ----------------------------------------------------------------------


class Deaf(Session):
    """A session whose first mailbox reads the oracle does not see, only that they may have been."""

    unheard = 1

    def _observe(self, exchange: Exchange) -> None:
        place = self.model.parameter("mailbox_in", "start")
        if self.unheard and exchange.address == place and not exchange.write:
            self.unheard -= 1
            self.oracle.perhaps(exchange)
            return
        super()._observe(exchange)


@pytest.mark.parametrize(
    "stimuli",
    [
        (upload(0x2023, 0), *(upload_segment(toggle=bool(n % 2)) for n in range(3)), ASK),
        (upload(0x2003, 0), Repeat(), ASK),
        (*normal_download(MODEL, (0x2023, 0), b"x" * 20, first=0, piece=10), ASK),
        (SendFrame("information_list_request", {"list_type": 1}), ASK),
    ],
)
def test_an_answer_that_was_not_captured_blames_nobody(stimuli: tuple[Stimulus, ...]) -> None:
    reference = load_device("reference")
    model = Model(reference)
    adapter = Faulty(VirtualSubDevice(reference))
    session = Deaf(adapter, model, Oracle(model))
    session.begin(SHAPE)
    for stimulus in (*way_to(model, "PREOP"), *stimuli):
        session.apply(stimulus)
    assert not session.unheard


# --- what random walks found ----------------------------------------------------------------------

UNSET = WriteRegister("sync_manager_0_activation", {"enabled": 0})
NOTHING_ASKED = WriteRegister("al_control", {})
"""No state is requested: an error is pending then, and the AL state is kept."""


def walked(device: VirtualSubDevice, stimuli: Sequence[Stimulus]) -> str:
    """Run from power-on, with objects that were read before; give what it was blamed for."""
    adapter = Faulty(device)
    runner = Runner(judge_of(device.model.protocol), adapter, adapter.describe())
    verdict = runner.executor.judge(Case("walk", "a walk", "al", tuple(stimuli)))
    return "" if verdict.outcome is Outcome.PASS else f"{verdict.reason}: {verdict.observed}"


@pytest.mark.parametrize("name", ["reference", "afag-se-power", "metronix-dis2", "beckhoff-el6720"])
@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("meanwhile", [(), (upload(0x1018, 1), Repeat())])
def test_nothing_is_demanded_of_a_mailbox_that_is_off(
    name: str, meanwhile: tuple[Stimulus, ...], *, silent: bool
) -> None:
    """With an error pending the texts leave open what the loss of a mailbox leads to."""
    text = load_device(name)
    model = Model(text)
    device = Faulty(VirtualSubDevice(text))
    session = Session(device, model, Oracle(model))
    session.begin(SHAPE)
    for stimulus in (*way_to(model, "PREOP"), ASK, NOTHING_ASKED, UNSET):
        session.apply(stimulus)
    device.silent = silent
    for stimulus in (*meanwhile, *mailbox_settings(model), Repeat(), ASK, Probe()):
        session.apply(stimulus)
    device.silent = False
    # in INIT and back the mailbox starts anew, and all of it is demanded again
    for state in ("INIT", "PREOP"):
        session.apply(request(model.row("al_state", state)))
    session.apply(ASK)
    device.silent = True
    with pytest.raises(Deviation, match="no reply"):
        session.apply(ASK)


def test_an_answer_is_demanded_where_the_settings_of_the_mailbox_were_not_seen() -> None:
    device = Faulty(VirtualSubDevice(REFERENCE))
    model = Model(REFERENCE)
    session = Session(device, model, Oracle(model))
    session.begin(SHAPE)
    for stimulus in way_to(model, "PREOP"):
        session.apply(stimulus)
    session.oracle.unknown()
    session.apply(ASK)
    session.apply(ASK)
    device.silent = True
    with pytest.raises(Deviation, match="no reply"):
        session.apply(ASK)


class Sparing(VirtualSubDevice):
    """Looks only at the SyncManagers that were written since it looked last."""

    _seen: State | None = None

    def reset(self) -> None:
        self._seen = None
        super().reset()

    def _take_settings(self) -> None:
        self._seen = self.state
        super()._take_settings()

    def react(self, event: Event) -> Step:
        inputs = self.model.protocol.machines[event.machine].inputs
        source = next(i for i in inputs if i.name == event.input)
        if source.kind != InputKind.WRITE or event.input == "request" or self._seen is None:
            return super().react(event)
        slots = [self.model.slots[f"register {name}"] for name in source.origin]
        if all(self._seen.slots[slot] == self.state.slots[slot] for slot in slots):
            return Step(self.state, (), (), 0)
        return super().react(event)


@pytest.mark.parametrize("kind", [VirtualSubDevice, Sparing])
@pytest.mark.parametrize(
    "stimuli",
    [
        # repeat and its acknowledge differ when the mailbox starts; then others are written
        (*PREOP[:-1], Repeat(), PREOP[-1], request(VALUE["SAFEOP"]), SetUpProcessData()),
        # the mailbox is lost with an error pending, and found lost without one
        (
            *(*PREOP, NOTHING_ASKED, UNSET, SetUpProcessData()),
            *(request(VALUE["SAFEOP"], acknowledge=True), WriteOutputs(), request(VALUE["OP"])),
            SetUpProcessData({"sync_manager_2_activation": {"enabled": 0}}),
        ),
    ],
)
def test_a_change_event_may_make_a_device_look_at_all_sync_managers(
    kind: type[VirtualSubDevice], stimuli: tuple[Stimulus, ...]
) -> None:
    assert walked(kind(load_device("reference-drive")), stimuli) == ""


def test_the_same_outputs_count_again_after_a_control_word_by_sdo() -> None:
    text = load_device("kollmorgen-s300")
    model = Model(text)
    same = WriteOutputs({"control_word": 0x02})
    by_sdo = [download(0x6040, 0, bytes([low, 0])) for low in (0x55, 0xF3)]
    sent: tuple[Stimulus, ...] = (same, *by_sdo, same)
    on = WriteOutputs({"control_word": 0x07})
    assert walked(VirtualSubDevice(text), (*way_to(model, "OP"), *sent, on)) == ""


def test_inputs_that_are_not_kept_up_to_date_are_not_judged() -> None:
    """The drive's modes are known here, so a mode that it has must be the active one."""
    text = load_device("reference-drive")
    model = Model(text)
    preop = request(VALUE["PREOP"])
    way = (*way_to(model, "PREOP"), SetUpProcessData(), request(VALUE["SAFEOP"]), preop)
    stimuli = (*way, unsized(model, 0x6060, 0, b"\1"), NOTHING_ASKED)
    up = request(VALUE["SAFEOP"], acknowledge=True)
    assert walked(VirtualSubDevice(text), (*stimuli, up)) == ""


MANY_WAYS = (
    "case.eNrNVV1LwzAU_SvlPge61FlH3_a-fyAjxPauhqVJTW4dY_S_mwXUKbRaO8W3kJ6cj9xDegItj-i"
    "gAKmBgZENxnVa2qbVSJiuN2K_SLM8fPWkmk4rKO5PUNmAOzhFKBzWyhM6HyBxx0fETqGuwjJglcOSlDV"
    "QcAYaTU2PUNzyjEFjqyCYnbmlIyhyvlz2DF4pg4Y_mlI00sganVhAzy6Z0cgHjVXgHTskZFB_ltFBvz0"
    "zTHE_6veO56sRaf4Tv3zAr0cSXStaZ0v0XlSSJHwKYztqO4pRrIuS_UDcAHm35fCpw7AbjGUfjUktSmv"
    "IWQ0TiZZziK53duRmv5FHlntjD2FiNcbuXuRbfe3Rk23fRjK1drOqMqsNI6H_Rzt-YQxD9DfX8jnv5ub"
    "18I9mPVTlCU_zlgEp0ud_0HrDkkBFSZYndpfwVQ79CyIJVtg"
)
"""A long test of the AL state machine in which too many explanations arise."""


def test_an_input_that_may_never_have_come_holds_nothing_up() -> None:
    adapter = make("kollmorgen-akd", {})
    runner = Runner(Model(load_device("kollmorgen-akd")), adapter, adapter.describe())
    assert runner.executor.judge(case_of(MANY_WAYS)).outcome is Outcome.PASS


class Thorough(Oracle):
    """An oracle that works out every look."""

    def observe(self, exchange: Exchange) -> Mismatch | None:
        self._idle = set()
        return super().observe(exchange)


class Counted(Oracle):
    """An oracle that counts the reads that it works out."""

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.reads = 0

    def _read(self, exchange: Exchange) -> Mismatch | None:
        self.reads += 1
        return super()._read(exchange)


@pytest.mark.parametrize("delay", [0.0, 0.5, 3.0])
def test_a_look_that_told_nothing_tells_nothing_again(delay: float) -> None:
    found = []
    for kind in (Oracle, Thorough):
        device = Faulty(standard(), delay=delay)
        model = judge_of(STANDARD)
        session = Session(device, model, kind(model))
        session.begin(SHAPE)
        mismatch = None
        try:
            for stimulus in (*PREOP, Wait(100_000), ASK, Wait(100_000), ASK):
                session.apply(stimulus)
        except Deviation as deviation:
            mismatch = deviation.mismatch
        found.append((mismatch, session.oracle.candidates, session.time))
    assert found[0] == found[1]


def test_a_look_is_worked_out_once_while_nothing_happens() -> None:
    model = judge_of(STANDARD)
    oracle = Counted(model)
    oracle.power_on(SHAPE)
    register = model.protocol.registers["al_status"]

    def look(time: int, state: int) -> Mismatch | None:
        data = state.to_bytes(register.size, "little")
        return oracle.observe(Exchange(time, False, register.address, data, 1))  # noqa: FBT003

    assert [look(time, 1) for time in range(5)] == [None] * 5
    assert oracle.reads == 1
    assert look(9, 2) is not None


def test_a_reply_that_is_due_is_missed_however_often_its_mailbox_was_empty() -> None:
    model = judge_of(STANDARD)
    session = Session(Faulty(standard()), model, Oracle(model))
    session.begin(SHAPE)
    for stimulus in PREOP:
        session.apply(stimulus)
    oracle, now = session.oracle, session.time
    due = Output("mailbox_error", (), RuleName("mailbox", "mail_refused"))
    (candidate,) = oracle.candidates
    oracle.candidates = {structs.replace(candidate, outbox=(due,), ready=now + 100): ()}
    status = model.protocol.registers[f"{SYNC_MANAGERS[1]}_status"]
    empty = bytes(status.size)
    found = [
        oracle.observe(Exchange(now + later, False, status.address, empty, 1))  # noqa: FBT003
        for later in (1, 2, 101)
    ]
    assert found[:2] == [None, None]
    assert found[2] is not None
    assert found[2].observed.startswith("mailbox empty")


def test_looks_that_tell_nothing_are_not_remembered_without_end() -> None:
    model = judge_of(STANDARD)
    oracle = Oracle(model)
    oracle.power_on(SHAPE)
    status = model.protocol.registers["al_status"]
    init = Exchange(0, False, status.address, (1).to_bytes(status.size, "little"), 1)  # noqa: FBT003
    assert oracle.observe(init) is None
    for time in range(3000):  # a clock of the controller, of which the texts say nothing
        assert oracle.observe(Exchange(time, False, 0x0910, time.to_bytes(4, "little"), 1)) is None  # noqa: FBT003
    assert len(oracle._idle) <= 1024  # noqa: SLF001
