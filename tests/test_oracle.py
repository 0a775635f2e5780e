"""The only place for tests of judging: faults planted in a virtual SubDevice, found by clause."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapter import Description
from ecatspec.conformance.session import Deviation, Session
from ecatspec.generators.bringup import WAY_UP, request, row, way_to
from ecatspec.generators.case import Probe, SendFrame, WriteRegister
from ecatspec.generators.sdo_cover import download, upload
from ecatspec.model.compiled import Model
from ecatspec.model.esc import SYNC_MANAGERS
from ecatspec.model.oracle import Oracle
from ecatspec.model.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ecatspec.generators.case import Stimulus
    from ecatspec.model.oracle import Mismatch

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


def judged(
    device: Faulty, stimuli: Sequence[Stimulus], choices: dict[str, str] | None = None
) -> tuple[Mismatch | None, dict[str, str]]:
    """Run from power-on: the mismatch, and the choices that the device has shown."""
    model = Model(device.device.model.protocol)
    model.dictionary.close()
    session = Session(device, model, Oracle(model))
    try:
        session.begin(SHAPE | (choices or {}))
        for stimulus in stimuli:
            session.apply(stimulus)
    except Deviation as deviation:
        return deviation.mismatch, {}
    return None, session.oracle.choices()


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
VALUE = {name: row(MODEL, "al_state", name) for name in (*WAY_UP, "BOOT")}
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
    assert mismatch.observed == "mailbox full"


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
    stimuli = (*DRIVE_PREOP, download(0x1C12, 1, b"\x04\x17"), upload(0x1C12, 1))
    mismatch = fault(Faulty(Forgetful(AKD)), stimuli)
    assert "SDO-23" in mismatch.clauses
    assert any("04 17" in expected for expected in mismatch.expected)


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
        mailbox = self.esc.channel(SYNC_MANAGERS[0])
        if mailbox is not None and address == mailbox[0]:
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
        return row(Model(AKD), "al_state", "OP") if register == "al_status" else raw

    session = Session(Faulty(VirtualSubDevice(AKD), shown=awake), Model(AKD), Oracle(Model(AKD)))
    with pytest.raises(Deviation) as found:
        session.begin(SHAPE)
    assert "AL-01" in found.value.mismatch.clauses
