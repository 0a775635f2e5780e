"""Tests of model/esc/data_link.py, model/esc/sii.py and the texts in spec/link."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ecatspec.generators.cases.bringup import way_to
from ecatspec.generators.cases.play import play
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.data_link import LinkedSubDevice, linked
from ecatspec.model.esc.fmmu import fmmu_registers
from ecatspec.model.esc.sii import checksum, sii_image
from ecatspec.model.esc.wire import COMMANDS, Datagram, Wire, wire_format
from ecatspec.spec.language.load import compile_texts, device_names, load_device, load_link
from ecatspec.spec.language.parse import parse_text

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parent.parent
DEVICE = "reference-drive"
SOURCE = bytes.fromhex("001122334455")
STATION, ALIAS, DL_CONTROL, DL_STATUS, AL_CONTROL, AL_STATUS = (
    0x10,
    0x12,
    0x100,
    0x110,
    0x120,
    0x130,
)
MASK, REQUEST, RX_ERRORS, FREE, MAIL_OUT, MAIL_IN = 0x200, 0x210, 0x300, 0x2000, 0x1000, 0x1080
EEPROM, CONTROL, PLACE, DATA = 0x500, 0x502, 0x504, 0x508
WATCHDOG_TIME, WATCHDOG = 0x420, 0x440
READ, WRITE, RELOAD, ENABLE = 0x0100, 0x0200, 0x0400, 0x0001
BUSY, WRITE_ERROR, COMMAND_ERROR, CHECKSUM_ERROR = 0x8000, 0x4000, 0x2000, 0x0800
UNUSED_WORD = 0x3F0
"""A word near the end of the EEPROM, behind its categories."""
MODEL = Model(linked(load_device("reference-drive"), load_link()))
MAILBOXES = bytes.fromhex("0010300026000100 8010300022000100")


@dataclass
class Segment:
    """SubDevices one behind the other."""

    devices: list[LinkedSubDevice]
    wire: Wire

    def send(self, *datagrams: tuple[str, int, int, bytes]) -> list[tuple[int, bytes, int]]:
        """Give ADP, data and working counter of each datagram as it comes back."""
        asked = (Datagram(COMMANDS[n], 7, adp, ado, data, 0) for n, adp, ado, data in datagrams)
        frame = bytearray(self.wire.frame(SOURCE, asked))
        assert self.wire.pass_on(frame, [device.visit for device in self.devices])
        assert self.wire.source(bytes(frame)) == (SOURCE, True)
        payload = self.wire.payload(bytes(frame))
        assert payload is not None
        found, good = self.wire.datagrams(payload)
        assert good
        assert {one.index for one in found} <= {7}
        return [(one.adp, one.data, one.working_counter) for one in found]

    def one(self, name: str, adp: int, ado: int, data: bytes) -> tuple[int, bytes, int]:
        return self.send((name, adp, ado, data))[0]


def segment(count: int, device: str = DEVICE) -> Segment:
    protocol = linked(load_device(device), load_link())
    devices = [LinkedSubDevice(protocol, follower=n < count - 1) for n in range(count)]
    return Segment(devices, Wire(wire_format(devices[0].device.model)))


@pytest.fixture
def three() -> Segment:
    """Three SubDevices with the station addresses 0x1001 to 0x1003."""
    made = segment(3)
    for number in range(3):
        station = struct.pack("<H", 0x1001 + number)
        assert made.one("APWR", -number & 0xFFFF, STATION, station)[2] == 1
    return made


@pytest.fixture
def alone() -> LinkedSubDevice:
    return segment(1).devices[0]


def question(counter: int) -> bytes:
    """Ask for the vendor, in a message with this counter."""
    header = bytes.fromhex("0a0000000003")[:5] + bytes([counter << 4 | 3])
    return (header + bytes.fromhex("0020 4018100100000000")).ljust(48, b"\0")


# --- commands -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "adp", "after", "data", "counter"),
    [
        ("NOP", 5, 5, "aabb", 0),
        ("APRD", 0xFFFF, 2, "0210", 1),
        ("APRD", 0xFFFD, 0, "aabb", 0),
        ("FPRD", 0x1003, 0x1003, "0310", 1),
        ("FPRD", 0x1004, 0x1004, "aabb", 0),
        ("BRD", 0, 3, "abbb", 3),
        ("APWR", 0xFFFF, 2, "aabb", 1),
        ("APRW", 0xFFFF, 2, "0210", 3),
        ("FPWR", 0x1002, 0x1002, "aabb", 1),
        ("FPRW", 0x1002, 0x1002, "0210", 3),
        ("BWR", 0, 3, "aabb", 3),
        ("BRW", 0, 3, "abbb", 9),
        ("ARMW", 0, 3, "0110", 3),
        ("ARMW", 0xFFFF, 2, "0210", 3),
        ("FRMW", 0x1001, 0x1001, "0110", 3),
    ],
)
def test_each_command_finds_its_device_and_counts(
    three: Segment, name: str, adp: int, after: int, data: str, counter: int
) -> None:
    sent = bytes.fromhex("aabb")
    assert three.one(name, adp, STATION, sent) == (after, bytes.fromhex(data), counter)


def test_what_the_one_addressed_has_all_behind_it_get(three: Segment) -> None:
    assert three.one("APWR", 0, FREE, b"\x55")[2] == 1
    assert three.one("ARMW", 0, FREE, b"\x00") == (3, b"\x55", 3)
    assert [device.read(FREE, 1) for device in three.devices] == [(1, b"\x55")] * 3


def test_a_broadcast_write_counts_who_took_it(three: Segment) -> None:
    # AL Control is locked where the device has not read it; registers of the device are refused
    assert three.one("BWR", 0, AL_STATUS, b"\x08\x00")[2] == 0
    assert three.one("BWR", 0, 0x0000, b"\x08")[2] == 0
    assert three.one("BWR", 0, AL_CONTROL, b"\x01\x00")[2] == 3


def test_a_full_mailbox_is_refused(alone: LinkedSubDevice) -> None:
    assert alone.write(0x800, MAILBOXES) == 1
    assert alone.write(AL_CONTROL, b"\2\0") == 1
    # the first is answered, the second waits for the answer to be read
    assert [alone.write(MAIL_OUT, question(1 + number)) for number in range(3)] == [1, 1, 0]
    assert alone.read(MAIL_OUT, 48)[0] == 0
    assert alone.read(MAIL_IN, 48)[0] == 1
    assert alone.write(MAIL_OUT, question(3)) == 1


def test_logical_commands_count_reads_and_writes(three: Segment) -> None:
    def fmmu(logical: int, physical: int, kind: int) -> bytes:
        return struct.pack("<IHBBHBBB3x", logical, 2, 0, 7, physical, 0, kind, 1)

    for number, device in enumerate(three.devices):
        base = 0x0100_0000 + 2 * number
        assert device.write(0x600, fmmu(base, FREE, 2)) == 1
        assert device.write(0x610, fmmu(base + 0x100, FREE + 0x100, 1)) == 1
        device.write(FREE + 0x100, bytes([number, 0xA0]))
    low, high = 0x0000, 0x0100
    assert three.one("LWR", low, high, bytes(range(6))) == (low, bytes(range(6)), 3)
    assert [device.read(FREE, 2)[1] for device in three.devices] == [b"\0\1", b"\2\3", b"\4\5"]
    assert three.one("LRD", low + 0x100, high, bytes(6))[1:] == (bytes.fromhex("00a001a002a0"), 3)
    assert three.one("LRW", low, high, bytes(6))[2] == 3 * 2
    assert three.one("LRW", low + 0x100, high, bytes(6))[2] == 3 * 1


def test_a_frame_with_rubbish_passes_as_it_is(three: Segment) -> None:
    frame = bytearray(three.wire.frame(SOURCE, ()))
    assert three.wire.pass_on(frame, [device.visit for device in three.devices])
    assert not three.wire.pass_on(bytearray(60), [])
    long = Datagram(COMMANDS["BRD"], 1, 0, 0, bytes(4), 0)
    whole = three.wire.frame(SOURCE, (long, long))
    cut = bytearray(whole[:-5])
    three.wire.pass_on(cut, [device.visit for device in three.devices])
    payload = three.wire.payload(bytes(cut))
    assert payload is not None
    found, good = three.wire.datagrams(payload)
    assert not good
    assert [one.working_counter for one in found] == [3]


@pytest.mark.parametrize("name", sorted(COMMANDS))
@pytest.mark.parametrize("address", [0xFFFF, 0xFFF8])
def test_an_access_that_ends_behind_the_memory_is_refused(
    three: Segment, name: str, address: int
) -> None:
    adp = 0x1002 if name.startswith("F") else 0
    sent = bytes(range(9))
    (_, data, counter), after = three.send(
        (name, adp, address, sent), ("APRD", 0, STATION, bytes(2))
    )
    assert (data, counter) == (sent, 0)
    assert after == (3, b"\x01\x10", 1)


ADDRESSES = st.one_of(
    st.integers(0, 0xFFFF),
    st.sampled_from([r.address for r in MODEL.protocol.registers.values()]),
    st.sampled_from([MAIL_OUT, MAIL_IN, MAIL_OUT + 47, FREE, 0x0F80, 0xFFFF]),
)
DATAGRAMS = st.builds(
    Datagram,
    st.sampled_from(sorted(COMMANDS.values(), key=lambda command: command.name)),
    st.integers(0, 255),
    st.sampled_from([0, 1, 0xFFFF, 0xFFFE, 0x1001, 0x1002, 0x1003]),
    ADDRESSES,
    st.binary(max_size=60) | st.integers(0, 1400).map(bytes),
    st.integers(0, 0xFFFF),
)


@st.composite
def frames(draw: st.DrawFn) -> bytes:
    """Draw an Ethernet frame, whole or with bytes changed, cut off, tagged."""
    frame = bytearray(segment_wire().frame(SOURCE, draw(st.lists(DATAGRAMS, max_size=4))))
    changed = draw(st.dictionaries(st.integers(12, 60), st.integers(0, 255), max_size=2))
    for at, value in changed.items():
        if at < len(frame):
            frame[at] = value
    if draw(st.booleans()):
        del frame[draw(st.integers(0, len(frame))) :]
    tag = bytes.fromhex("81000005") if draw(st.booleans()) else b""
    return bytes(frame[:12] + tag + frame[12:])


def segment_wire() -> Wire:
    return Wire(wire_format(MODEL))


@given(st.lists(st.tuples(frames(), st.integers(0, 400_000)), max_size=12))
def test_no_frame_ends_a_segment_or_changes_its_length(
    sent: list[tuple[bytes, int]],
) -> None:
    made, now = segment(2), 0
    for frame, waited in sent:
        now += waited
        for device in made.devices:
            device.advance(now)
        passed = bytearray(frame)
        made.wire.pass_on(passed, [device.visit for device in made.devices])
        assert len(passed) == len(frame)
        assert passed[:6] + passed[7:14] == frame[:6] + frame[7:14]
    for device in made.devices:
        device.reset()
        model = device.device.model
        play(model, device.device, way_to(model, "OP"))
        assert device.al_state == "OP"


def test_the_alias_counts_where_dl_control_says_so() -> None:
    made = segment(1)
    device = made.devices[0]
    _write_word(device, 4, 0x2222)
    device.reset()
    assert device.read(ALIAS, 2) == (1, b"\x22\x22")
    assert made.one("FPRD", 0x2222, STATION, b"\1\1")[2] == 0
    assert device.write(DL_CONTROL, struct.pack("<I", 0x0107_0001)) == 1
    assert made.one("FPRD", 0x2222, STATION, b"\1\1")[2] == 1
    assert made.one("FPRD", 0, STATION, b"\1\1")[2] == 1


# --- registers ------------------------------------------------------------------------------------


def test_dl_status_shows_the_neighbours(three: Segment) -> None:
    found = [int.from_bytes(device.read(DL_STATUS, 2)[1], "little") for device in three.devices]
    assert [hex(raw) for raw in found] == ["0x5a33", "0x5a33", "0x5613"]


def test_counters_are_cleared_by_any_write(alone: LinkedSubDevice) -> None:
    assert alone.write(RX_ERRORS, b"\x01\x02\x03") == 1
    assert alone.read(RX_ERRORS, 8) == (1, bytes(8))


def test_events_come_back_in_each_datagram(alone: LinkedSubDevice) -> None:
    read = COMMANDS["APRD"]
    assert alone.visit(read, 0, STATION, b"\0")[3] == 0
    assert alone.write(MASK, b"\xff\x00") == 1
    assert alone.write(0x800, MAILBOXES) == 1
    assert alone.write(AL_CONTROL, b"\2\0") == 1
    assert alone.visit(read, 0, STATION, b"\0")[3] == 1 << 3
    assert alone.read(REQUEST, 2) == (1, b"\x08\x00")
    assert alone.read(AL_STATUS, 2) == (1, b"\2\0")
    assert alone.visit(read, 0, STATION, b"\0")[3] == 0
    assert alone.write(MAIL_OUT, question(1)) == 1
    assert alone.visit(read, 0, STATION, b"\0")[3] == 1 << 5


def test_the_watchdog_shows_and_is_counted(alone: LinkedSubDevice) -> None:
    play(alone.device.model, alone.device, way_to(alone.device.model, "SAFEOP"))
    assert alone.write(WATCHDOG_TIME, b"\x64\x00") == 1  # 10 ms
    assert alone.read(WATCHDOG, 2) == (1, b"\0\0")
    outputs = alone.device.model.parameter("process_data_out", "start")
    for expired in range(1, 3):
        assert alone.write(outputs, bytes(6)) == 1
        assert alone.read(WATCHDOG, 2) == (1, b"\1\0")
        alone.advance(alone.now + 9_000)
        assert alone.read(WATCHDOG, 2) == (1, b"\1\0")
        alone.advance(alone.now + 2_000)
        assert alone.read(WATCHDOG, 4) == (1, bytes([0, 0, expired, 0]))
    assert alone.write(WATCHDOG + 2, b"\0") == 1
    assert alone.read(WATCHDOG + 2, 1) == (1, b"\0")
    assert alone.write(WATCHDOG_TIME, b"\0\0") == 1
    assert alone.read(WATCHDOG, 2) == (1, b"\1\0")


def test_time_passes_as_commanded_only_where_that_is_wanted() -> None:
    protocol = linked(load_device(DEVICE), load_link())
    passed = []
    for commanded in (False, True):
        device = LinkedSubDevice(protocol, commanded=commanded)
        device.write(CONTROL, struct.pack("<HI", READ, 8))
        device.write(0x0F80, struct.pack("<I", 5000))
        passed.append(not int.from_bytes(device.read(CONTROL, 2)[1], "little") & BUSY)
    assert passed == [False, True]


# --- EEPROM ---------------------------------------------------------------------------------------


def _status(device: LinkedSubDevice) -> int:
    return int.from_bytes(device.read(CONTROL, 2)[1], "little")


def _later(device: LinkedSubDevice) -> None:
    device.advance(device.now + 2000)


def _command(device: LinkedSubDevice, command: int, place: int = 0, data: bytes = b"") -> int:
    counter = device.write(CONTROL, struct.pack("<HI", command, place) + data)
    _later(device)
    return counter


def _read_word(device: LinkedSubDevice, place: int) -> int:
    _command(device, READ, place)
    return int.from_bytes(device.read(DATA, 2)[1], "little")


def _write_word(device: LinkedSubDevice, place: int, value: int) -> None:
    """Write a word; where it is in the part with the checksum, that too."""
    _command(device, WRITE | ENABLE, place, struct.pack("<H", value))
    area = b"".join(struct.pack("<H", _read_word(device, n)) for n in range(7))
    if place < 7:
        right = checksum(device.device.model, area)
        _command(device, WRITE | ENABLE, 7, struct.pack("<H", right))


def test_the_eeprom_is_read_eight_bytes_at_a_time(alone: LinkedSubDevice) -> None:
    image = sii_image(alone.device.model)
    found = b""
    for place in range(0, len(image) // 2, 4):
        assert alone.write(CONTROL, struct.pack("<HI", READ, place)) == 1
        assert _status(alone) & BUSY
        assert alone.write(CONTROL, struct.pack("<HI", READ, place)) == 0
        _later(alone)
        assert not _status(alone) & (BUSY | READ)
        found += alone.read(DATA, 8)[1]
    assert found == image


def test_a_word_is_written_only_where_that_is_enabled(alone: LinkedSubDevice) -> None:
    _command(alone, WRITE, UNUSED_WORD, b"\x34\x12")
    assert _status(alone) & WRITE_ERROR
    assert _read_word(alone, UNUSED_WORD) == 0xFFFF
    _command(alone, WRITE | ENABLE, UNUSED_WORD, b"\x34\x12")
    assert not _status(alone) & WRITE_ERROR
    alone.reset()
    assert _read_word(alone, UNUSED_WORD) == 0x1234
    _command(alone, WRITE | ENABLE, 0x0010_0000, b"\x34\x12")
    assert _read_word(alone, 0x0010_0000) == 0xFFFF


def test_a_wrong_checksum_shows_once_it_is_loaded(alone: LinkedSubDevice) -> None:
    _command(alone, WRITE | ENABLE, 4, b"\x22\x22")
    assert not _status(alone) & CHECKSUM_ERROR
    _command(alone, RELOAD)
    assert _status(alone) & CHECKSUM_ERROR
    assert alone.read(ALIAS, 2)[1] == bytes(2)
    _read_word(alone, 0)
    assert _status(alone) & CHECKSUM_ERROR, "a read command does not make the checksum right"
    _write_word(alone, 4, 0x2222)
    _command(alone, RELOAD)
    assert not _status(alone) & CHECKSUM_ERROR
    assert alone.read(ALIAS, 2)[1] == b"\x22\x22"


def test_a_device_that_has_the_eeprom_keeps_it(alone: LinkedSubDevice) -> None:
    assert alone.write(EEPROM, b"\x01") == 1
    _command(alone, READ, 8)
    assert _status(alone) & COMMAND_ERROR
    assert alone.write(EEPROM, b"\x02") == 1
    assert alone.write(EEPROM, b"\x00") == 1
    _command(alone, 0)
    assert not _status(alone) & COMMAND_ERROR
    _command(alone, 0x0700)
    assert _status(alone) & COMMAND_ERROR


@given(st.binary(min_size=14, max_size=14))
def test_the_checksum_is_the_remainder_bit_by_bit(data: bytes) -> None:
    rest = 0xFF
    for bit in (byte >> n & 1 for byte in data for n in reversed(range(8))):
        rest = (rest << 1 & 0xFF) ^ (0x07 if rest >> 7 ^ bit else 0)
    assert checksum(MODEL, data) == rest


def categories(image: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0x80
    while (kind := int.from_bytes(image[at : at + 2], "little")) != 0xFFFF:
        size = 2 * int.from_bytes(image[at + 2 : at + 4], "little")
        yield kind, image[at + 4 : at + 4 + size]
        at += 4 + size


@pytest.mark.parametrize("name", device_names())
def test_every_device_has_a_whole_image(name: str) -> None:
    device = segment(1, name).devices[0]
    image, model = sii_image(device.device.model), device.device.model
    assert len(image) & (len(image) - 1) == 0
    assert int.from_bytes(image[0x7C:0x7E], "little") == len(image) // 128 - 1
    assert image[14] == checksum(model, image[:14])
    mailbox = struct.unpack_from("<5H", image, 0x30)
    assert mailbox[4] == 4
    out, back = (
        (model.parameter(area, "start"), model.parameter(area, "length"))
        for area in ("mailbox_out", "mailbox_in")
    )
    assert mailbox[:4] == (*out, *back)
    found = dict(categories(image))
    assert {10, 30, 40, 41} <= set(found)
    assert len(found[30]) == 32
    managers = [struct.unpack_from("<HHBBBB", found[41], 8 * n) for n in range(4)]
    assert [row[-1] for row in managers] == [1, 2, 3, 4]
    assert [row[2] for row in managers] == [0x26, 0x22, 0x64, 0x20]
    assert managers[0][:2] == out
    assert list(found[40]) == [1, 2, 3, 0][: len(found[40])]


def test_the_image_of_a_drive_in_full() -> None:
    image = sii_image(segment(1).devices[0].device.model)
    assert struct.unpack_from("<4I", image, 0x10) == (0, 402, 1, 1)
    found = dict(categories(image))
    assert found[10].startswith(b"\x0b\x0freference-drive\x0ccontrol_word\x0ftarget_position")
    assert found[30][:6] == bytes([0, 0, 1, 1, 0, 0b101111])
    rx, tx = found[51], found[50]
    assert rx[:8] == bytes.fromhex("0016 02 02 00 00 0000")
    assert rx[8:24] == bytes.fromhex("4060 00 02 06 10 0000  7a60 00 03 04 20 0000")
    assert rx[24:28] == bytes.fromhex("0116 02 ff")
    assert tx[:4] == bytes.fromhex("001a 03 03")


# --- texts ----------------------------------------------------------------------------------------


def test_the_texts_of_the_link_stand_alone() -> None:
    files = sorted((ROOT / "spec" / "link").glob("*.ecs"))
    protocol = compile_texts([parse_text(f.read_text("utf-8"), str(f)) for f in files], "standard")
    assert (len(protocol.clauses), len(protocol.registers), len(protocol.frames)) == (23, 30, 9)
    link = load_link()
    assert link.registers == protocol.registers
    standard = load_device("standard")
    assert link.clauses.keys().isdisjoint(standard.clauses)
    assert link.registers.keys().isdisjoint(standard.registers)
    assert link.registers["number_of_fmmus"].reset == len(fmmu_registers(standard))
    managers = [name for name in standard.registers if name.endswith("_activation")]
    assert link.registers["number_of_sync_managers"].reset == len(managers)


def test_what_a_device_says_goes_before_the_link() -> None:
    drive = load_device("kollmorgen-akd")
    together = linked(drive, load_link())
    assert "interrupt_enable" in together.registers
    assert "al_event_mask" not in together.registers
    assert load_device("kollmorgen-akd") == drive
