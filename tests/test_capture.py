"""Tests of conformance/capture: captures made, broken and real."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import dpkt
import dpkt.pcapng
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ecatspec.conformance.capture.transactions import (
    LOST_AFTER,
    Capture,
    CaptureError,
    Statistics,
)
from ecatspec.model.esc.fmmu import fmmu_registers
from ecatspec.model.esc.wire import Bits, WireFormat
from ecatspec.spec.language.load import load_standard

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ecatspec.conformance.capture.segment import Transaction

NUMBER: Final = {
    "NOP": 0,
    "APRD": 1,
    "APWR": 2,
    "APRW": 3,
    "FPRD": 4,
    "FPWR": 5,
    "FPRW": 6,
    "BRD": 7,
    "BWR": 8,
    "BRW": 9,
    "LRD": 10,
    "LWR": 11,
    "LRW": 12,
    "ARMW": 13,
    "FRMW": 14,
}
WIRE: Final = WireFormat(
    ethertype=0x88A4,
    vlan_ethertype=0x8100,
    vlan_tag_size=4,
    source_mac_offset=6,
    source_mac_size=6,
    source_mac_returned_bit=0x02,
    ethercat_header_size=2,
    ethercat_length=Bits(0, 11),
    ethercat_type=Bits(12, 4),
    ethercat_type_datagrams=1,
    datagram_header_size=10,
    command=Bits(0, 8),
    index=Bits(8, 8),
    adp=Bits(16, 16),
    ado=Bits(32, 16),
    length=Bits(48, 11),
    more=Bits(63, 1),
    interrupt=Bits(64, 16),
    working_counter_size=2,
    working_counter_read=1,
    working_counter_write=2,
    commands=NUMBER,
    station_address_register=0x0010,
    station_address_size=2,
    fmmus=fmmu_registers(load_standard()),
)
SENT: Final = bytes.fromhex("ffffffffffff 010101010101")
BACK: Final = bytes.fromhex("ffffffffffff 030101010101")
LOCAL: Final = bytes.fromhex("ffffffffffff 020101010101")
VLAN: Final = bytes.fromhex("8100 2005")
Datagram = tuple[str, int, int, int, bytes, int]
"""Command, index, ADP, ADO, data, working counter."""


def frame(ethernet: bytes, *datagrams: Datagram) -> bytes:
    """Build an Ethernet frame with datagrams."""
    body = b""
    for number, (name, index, adp, ado, data, counter) in enumerate(datagrams, 1):
        more = 0x8000 if number < len(datagrams) else 0
        header = struct.pack("<BBHHHH", NUMBER[name], index, adp, ado, len(data) | more, 0)
        body += header + data + struct.pack("<H", counter)
    return ethernet + b"\x88\xa4" + struct.pack("<H", len(body) | 0x1000) + body


def both(
    name: str, adp: int, ado: int, sent: bytes, back: bytes | None = None, counter: int = 1
) -> list[bytes]:
    """Build the request and the return of one datagram on a segment of one SubDevice."""
    after = adp if name.startswith("F") else (adp + 1) % 0x10000
    returned = sent if back is None else back
    return [
        frame(SENT, (name, 5, adp, ado, sent, 0)),
        frame(BACK, (name, 5, after, ado, returned, counter)),
    ]


def write_capture(path: Path, frames: Sequence[bytes], *, pcapng: bool = False) -> Path:
    """Write frames one millisecond apart."""
    with path.open("wb") as file:
        writer = dpkt.pcapng.Writer(file) if pcapng else dpkt.pcap.Writer(file)
        for number, data in enumerate(frames):
            writer.writepkt(data, 1000 + number / 1000)
    return path


def read(path: Path, frames: Sequence[bytes]) -> tuple[list[Transaction], Capture]:
    """Write a capture and read it back."""
    capture = Capture(write_capture(path / "made.pcap", frames), WIRE)
    return list(capture), capture


@pytest.mark.parametrize("pcapng", [False, True])
def test_datagrams_of_a_frame_become_transactions(tmp_path: Path, *, pcapng: bool) -> None:
    sent = frame(
        SENT,
        ("FPRD", 7, 0x1001, 0x0130, bytes(2), 0),
        ("FPWR", 7, 0x1001, 0x0120, b"\x02\x00", 0),
        ("LRW", 7, 0, 1, bytes(4), 0),
        ("BRD", 7, 0, 0x0130, bytes(2), 0),
    )
    back = frame(
        BACK,
        ("FPRD", 7, 0x1001, 0x0130, b"\x01\x00", 1),
        ("FPWR", 7, 0x1001, 0x0120, b"\x02\x00", 1),
        ("LRW", 7, 0, 1, b"abcd", 3),
        ("BRD", 7, 1, 0x0130, b"\x01\x00", 1),
    )
    arp = SENT + b"\x08\x06" + bytes(46)
    path = write_capture(tmp_path / "made", [arp, sent, back], pcapng=pcapng)
    capture = Capture(path, WIRE)
    station = 0x10000
    assert [(t.command, t.device, t.write, t.address, t.data) for t in capture] == [
        ("FPRD", station, False, 0x0130, b"\x01\x00"),
        ("FPWR", station, True, 0x0120, b"\x02\x00"),
        ("BRD", None, False, 0x0130, b"\x01\x00"),
    ]
    for transaction in capture:
        assert (transaction.frame, transaction.working_counter) == (3, 1)
        assert transaction.confirmed
        assert transaction.time == pytest.approx(0.002)
        assert transaction.sent == pytest.approx(0.001)
    assert capture.statistics == Statistics(
        frames=3, ethercat_frames=2, requests=1, returns=1, datagrams=8
    )
    assert capture.segment.size == 1
    assert capture.segment.name(station) == "0x1001"
    assert capture.segment.name(None) == "all"


def test_a_frame_inside_a_vlan_tag_is_read(tmp_path: Path) -> None:
    frames = [one[:12] + VLAN + one[12:] for one in both("FPRD", 0x1001, 0x0130, bytes(2))]
    found, _ = read(tmp_path, frames)
    assert [t.address for t in found] == [0x0130]


def test_read_and_write_in_one_command_are_two_transactions(tmp_path: Path) -> None:
    found, _ = read(tmp_path, both("FPRW", 0x1001, 0x0F00, b"new!", b"old!", counter=1))
    assert [(t.write, t.data, t.working_counter, t.done) for t in found] == [
        (False, b"old!", 1, True),
        (True, b"new!", 1, False),
    ]


def test_a_read_for_many_is_a_read_of_the_one_addressed(tmp_path: Path) -> None:
    found, _ = read(tmp_path, both("FRMW", 0x1001, 0x0910, bytes(8), b"12345678"))
    assert [(t.write, t.data) for t in found] == [(False, b"12345678")]


def test_a_position_and_its_station_address_are_one_device(tmp_path: Path) -> None:
    found, capture = read(
        tmp_path,
        [
            *both("APRD", 0, 0x0000, bytes(1)),
            *both("APWR", 0, 0x0010, b"\x01\x10"),
            *both("FPRD", 0x1001, 0x0130, bytes(2)),
            *both("FPWR", 0x1001, 0x0010, b"\x02\x10"),
            *both("FPRD", 0x1002, 0x0130, bytes(2)),
        ],
    )
    assert [t.device for t in found] == [0, 0, 0, 0, 0]
    assert capture.segment.devices == (0,)
    assert capture.segment.name(0) == "0x1002"


def test_a_position_without_station_address_is_named_by_position(tmp_path: Path) -> None:
    found, capture = read(tmp_path, both("APRD", 0xFFFE, 0x0000, bytes(1)))
    assert [t.device for t in found] == [2]
    assert capture.segment.name(2) == "position 2"


def test_a_refused_station_address_maps_nothing(tmp_path: Path) -> None:
    found, capture = read(
        tmp_path,
        [
            *both("APWR", 0, 0x0010, b"\x01\x10", counter=0),
            *both("FPRD", 0x1001, 0x0130, bytes(2), counter=0),
        ],
    )
    assert [(t.device, t.done) for t in found] == [(0, False), (0x10000, False)]
    assert capture.segment.devices == ()


def test_a_read_of_the_station_address_joins_two_identities(tmp_path: Path) -> None:
    found, capture = read(
        tmp_path,
        [
            *both("FPRD", 0x1001, 0x0130, bytes(2)),
            *both("APRD", 0, 0x0010, bytes(2), b"\x01\x10"),
            *both("FPRD", 0x1001, 0x0130, bytes(2)),
        ],
    )
    assert [t.device for t in found] == [0x10000, 0, 0]
    assert [capture.segment.canonical(t.device) for t in found if t.device is not None] == [0, 0, 0]
    assert capture.segment.devices == (0,)


def test_a_broadcast_takes_all_station_addresses_away(tmp_path: Path) -> None:
    found, _ = read(
        tmp_path,
        [
            *both("APWR", 0, 0x0010, b"\x01\x10"),
            *both("BWR", 0, 0x0010, b"\x00\x00"),
            *both("FPRD", 0x1001, 0x0130, bytes(2)),
        ],
    )
    assert [t.device for t in found] == [0, None, 0x10000]


def test_a_write_that_never_came_back_is_unconfirmed(tmp_path: Path) -> None:
    lost = both("FPWR", 0x1001, 0x0120, b"\x04\x00")[0]
    lost_read = both("FPRD", 0x1001, 0x0500, bytes(2))[0]
    polls = both("FPRD", 0x1001, 0x0130, bytes(2)) * (LOST_AFTER // 2 + 1)
    after = both("FPWR", 0x1001, 0x0120, b"\x02\x00")
    found, capture = read(tmp_path, [lost, lost_read, *polls, *after])
    assert [(t.frame, t.confirmed, t.data) for t in found if t.write] == [
        (1, False, b"\x04\x00"),
        (LOST_AFTER + 6, True, b"\x02\x00"),
    ]
    assert found[-1].write
    assert capture.statistics.lost_requests == 2


def test_a_lost_request_does_not_take_the_return_of_the_next(tmp_path: Path) -> None:
    write = both("FPWR", 0x1001, 0x0120, b"\x02\x00")
    found, _ = read(tmp_path, [write[0], *both("FPRD", 0x1001, 0x0130, bytes(2)), *write])
    assert [(t.frame, t.confirmed) for t in found] == [(1, False), (3, True), (5, True)]
    assert found[2].sent == pytest.approx(0.003)


def test_returns_alone_are_enough(tmp_path: Path) -> None:
    frames = [
        *both("APRD", 0, 0x0000, bytes(1)),
        *both("BRD", 0, 0x0130, bytes(2)),
        *both("APWR", 0, 0x0010, b"\x01\x10"),
        *both("FPRD", 0x1001, 0x0130, bytes(2)),
    ]
    found, capture = read(tmp_path, frames[1::2])
    assert [(t.command, t.device) for t in found] == [("BRD", None), ("APWR", 0), ("FPRD", 0)]
    assert capture.statistics.unplaced == 1
    assert capture.statistics.unmatched_returns == 4


def test_requests_alone_confirm_nothing(tmp_path: Path) -> None:
    frames = [*both("FPRD", 0x1001, 0x0130, bytes(2)), *both("FPWR", 0x1001, 0x0120, b"\x02\x00")]
    found, _ = read(tmp_path, frames[::2])
    assert [(t.write, t.confirmed) for t in found] == [(False, False), (True, False)]


@pytest.mark.parametrize("ethernet", [SENT, LOCAL])
def test_frames_without_a_telling_mark_are_paired(tmp_path: Path, ethernet: bytes) -> None:
    frames = [
        *both("APWR", 0, 0x0010, b"\x01\x10"),
        *both("FPRD", 0x1001, 0x0130, bytes(2), b"\x01\x00"),
        *both("FPRD", 0x1001, 0x1C00, bytes(2), counter=0),
    ]
    found, capture = read(tmp_path, [ethernet + one[12:] for one in frames])
    assert [(t.device, t.address, t.done) for t in found] == [
        (0, 0x0010, True),
        (0, 0x0130, True),
        (0, 0x1C00, False),
    ]
    assert capture.statistics.lost_requests == 0


def test_truncation_loses_no_complete_frame(tmp_path: Path) -> None:
    frames = both("FPWR", 0x1001, 0x0120, b"\x02\x00") * 2
    for pcapng in (False, True):
        whole = write_capture(tmp_path / "whole", frames, pcapng=pcapng).read_bytes()
        path = tmp_path / "cut"
        most = 0
        for size in range(len(whole) + 1):
            path.write_bytes(whole[:size])
            capture = Capture(path, WIRE)
            try:
                confirmed = sum(t.confirmed for t in capture)
            except CaptureError as error:
                assert "\n" not in str(error)  # noqa: PT017
                continue
            assert confirmed >= most
            most = confirmed
            if capture.truncated:
                assert "the file ends in the middle of" in capture.truncated
        assert most == 2
        assert capture.truncated is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"just a text, no capture", "not a capture"),
        (b"\x1f\x8b\x08\x00 more", "compressed"),
        (b"\xd4\xc3\xb2\xa1\x02", "the file ends in the middle of the file header"),
    ],
)
def test_a_file_that_is_no_capture_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match=message):
        list(Capture(path, WIRE))


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(CaptureError, match="cannot be read"):
            list(Capture(path, WIRE))


def test_a_capture_without_ethercat_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no EtherCAT frame"):
        read(tmp_path, [SENT + b"\x08\x06" + bytes(46)])


def test_malformed_frames_are_counted_and_their_good_datagrams_used(tmp_path: Path) -> None:
    poll = ("FPRD", 5, 0x1001, 0x0130, bytes(2), 0)
    two = [frame(SENT, poll, poll), frame(BACK, poll, poll)]
    found, capture = read(tmp_path, [one[:-1] for one in two] + [SENT + b"\x88\xa4", SENT[:9]])
    assert len(found) == 1
    assert capture.statistics.malformed == 3


def test_clock_resolution_of_each_interface_is_used(tmp_path: Path) -> None:
    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        size = struct.pack(">I", len(body) + 12)
        return struct.pack(">I", kind) + size + body + size

    def packet(interface: int, ticks: int, data: bytes) -> bytes:
        return block(6, struct.pack(">IIIII", interface, 0, ticks, len(data), len(data)) + data)

    request, back = both("FPRD", 0x1001, 0x0130, bytes(2))
    content = (
        block(0x0A0D0D0A, struct.pack(">IHHq", 0x1A2B3C4D, 1, 0, -1))
        + block(1, struct.pack(">HHI", 1, 0, 0))
        + block(1, struct.pack(">HHI", 1, 0, 0) + struct.pack(">HHB3xI", 9, 1, 9, 0))
        + packet(0, 1_000_000, request)
        + packet(1, 1_500_000_000, back)
        + block(3, struct.pack(">I", len(request)) + request)
    )
    path = tmp_path / "big.pcapng"
    path.write_bytes(content)
    capture = Capture(path, WIRE)
    assert [(t.sent, t.time) for t in capture if t.confirmed] == [(0.0, 0.5)]
    assert capture.statistics.frames == 3


HEADERS: Final = (b"", b"\xd4\xc3\xb2\xa1\x02\x00\x04\x00" + bytes(12) + b"\x01\x00\x00\x00")


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(header=st.sampled_from(HEADERS), content=st.binary(max_size=200))
def test_random_bytes_raise_nothing_else(tmp_path: Path, header: bytes, content: bytes) -> None:
    path = tmp_path / "random"
    path.write_bytes(header + content)
    try:
        list(Capture(path, WIRE))
    except CaptureError as error:
        assert error.remedy  # noqa: PT017


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=8))
def test_damaged_captures_raise_nothing_else(tmp_path: Path, flips: list[tuple[int, int]]) -> None:
    for pcapng in (False, True):
        frames = both("FPRW", 0x1001, 0x0F00, b"new!") + both("APWR", 0, 0x0010, b"\x01\x10")
        path = write_capture(tmp_path / "damaged", frames, pcapng=pcapng)
        content = bytearray(path.read_bytes())
        for at, value in flips:
            content[at % len(content)] = value
        path.write_bytes(content)
        try:
            list(Capture(path, WIRE))
        except CaptureError as error:
            assert error.where  # noqa: PT017


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(payloads=st.lists(st.tuples(st.booleans(), st.binary(max_size=60)), min_size=1, max_size=6))
def test_random_ethercat_frames_raise_nothing(
    tmp_path: Path, payloads: list[tuple[bool, bytes]]
) -> None:
    frames = [(BACK if back else SENT) + b"\x88\xa4" + payload for back, payload in payloads]
    read(tmp_path, frames)


@pytest.mark.parametrize(
    ("name", "frames", "datagrams", "lost", "devices"),
    [
        ("replay-ek1914-el3004-mailbox", 994, 994, 0, ("0x1000", "0x1001")),
        ("replay-ek1914-segmented-upload", 964, 964, 0, ("0x1000", "0x1001")),
        ("soem-sdinfo-akd", 6762, 6759, 3, ("0x1001",)),
        ("soem-sdinfo-ek1100-el1004", 594, 580, 0, ("0x1001", "0x1002")),
        ("soem-single-lan9252", 999, 998, 0, ("0x1001",)),
    ],
)
def test_real_captures_are_read_whole(
    shared: Path, name: str, frames: int, datagrams: int, lost: int, devices: tuple[str, ...]
) -> None:
    capture = Capture(shared / "captures" / f"{name}.pcapng", WIRE)
    for transaction in capture:
        assert 0 <= transaction.sent <= transaction.time or not transaction.confirmed
    statistics = capture.statistics
    assert (statistics.frames, statistics.datagrams) == (frames, datagrams)
    assert (statistics.malformed, statistics.unmatched_returns) == (0, 0)
    assert statistics.lost_requests == lost
    assert tuple(capture.segment.name(device) for device in capture.segment.devices) == devices
    assert capture.truncated is None


def test_the_akd_capture_holds_its_state_changes(shared: Path) -> None:
    capture = Capture(shared / "captures" / "soem-sdinfo-akd.pcapng", WIRE)
    writes = [t.data for t in capture if t.write and t.device == 0 and t.address == 0x0120]
    assert writes == [b"\x12\x00", b"\x04\x00"]


# --- logical datagrams ----------------------------------------------------------------------------


def fmmu(logical: int, length: int, physical: int, kind: int, bits: int = 0x0700) -> bytes:
    """Give the content of an FMMU register; `kind` is 1 for a read, 2 for a write."""
    return struct.pack("<IHHHBBBxxx", logical, length, bits, physical, 0, kind, 1)


def mapped(station: int, number: int, content: bytes) -> list[bytes]:
    return both("FPWR", station, 0x0600 + 16 * number, content)


def logical(
    name: str, address: int, sent: bytes, back: bytes | None = None, counter: int = 1
) -> list[bytes]:
    low, high = address & 0xFFFF, address >> 16
    returned = sent if back is None else back
    return [
        frame(SENT, (name, 9, low, high, sent, 0)),
        frame(BACK, (name, 9, low, high, returned, counter)),
    ]


OUT_AND_IN: Final = [
    *mapped(0x1001, 0, fmmu(0x10000, 2, 0x1100, 2)),
    *mapped(0x1001, 1, fmmu(0x10002, 3, 0x1400, 1)),
]
Access = tuple[bool, int, bytes, int, bool, bool]
"""Write, address, data, working counter, done, confirmed."""


def logical_accesses(found: list[Transaction]) -> list[Access]:
    return [
        (t.write, t.address, t.data, t.working_counter, t.done, t.confirmed)
        for t in found
        if t.command.startswith("L")
    ]


def test_a_logical_datagram_is_an_access_for_each_fmmu(tmp_path: Path) -> None:
    frames = [*OUT_AND_IN, *logical("LRW", 0x10000, b"ab...", b"ab123", counter=3)]
    found, _ = read(tmp_path, frames)
    assert logical_accesses(found) == [
        (False, 0x1400, b"123", 1, True, True),
        (True, 0x1100, b"ab", 1, True, True),
    ]
    assert [t.device for t in found] == [0x10000] * 4
    assert (found[-1].frame, found[-1].command) == (6, "LRW")
    frames = [*OUT_AND_IN, *logical("LRD", 0x10003, bytes(9), b"23" + bytes(7))]
    assert logical_accesses(read(tmp_path, frames)[0]) == [(False, 0x1401, b"23", 1, True, True)]
    frames = [*OUT_AND_IN, *logical("LWR", 0xFFFF, b".ab..")]
    assert logical_accesses(read(tmp_path, frames)[0]) == [(True, 0x1100, b"ab", 1, True, True)]


@pytest.mark.parametrize(
    ("counter", "was_read", "was_written"), [(0, False, False), (1, True, False), (2, False, True)]
)
def test_the_counter_of_one_device_tells_its_halves(
    tmp_path: Path, counter: int, *, was_read: bool, was_written: bool
) -> None:
    found, _ = read(tmp_path, [*OUT_AND_IN, *logical("LRW", 0x10000, bytes(5), None, counter)])
    assert [(t.write, t.working_counter, t.done, t.confirmed) for t in found[2:]] == [
        (False, int(was_read), was_read, True),
        (True, int(was_written), was_written, True),
    ]


def test_a_counter_of_several_devices_is_shared(tmp_path: Path) -> None:
    set_up = [*OUT_AND_IN, *mapped(0x1002, 0, fmmu(0x10005, 1, 0x1400, 1))]

    def outcome(counter: int) -> list[tuple[int | None, bool, bool, bool]]:
        frames = [*set_up, *logical("LRW", 0x10000, bytes(6), None, counter)]
        found, _ = read(tmp_path, frames)
        return [(t.device, t.write, t.done, t.confirmed) for t in found[3:]]

    one, two = 0x10000, 0x10001
    assert outcome(4) == [
        (one, False, True, True),
        (two, False, True, True),
        (one, True, True, True),
    ]
    assert outcome(0) == [
        (one, False, False, True),
        (two, False, False, True),
        (one, True, False, True),
    ]
    for counter in (1, 2, 3, 5):
        assert outcome(counter) == [
            (one, False, False, False),
            (two, False, False, False),
            (one, True, False, False),
        ]


def test_a_counter_beyond_what_is_known_tells_nothing(tmp_path: Path) -> None:
    found, _ = read(tmp_path, [*OUT_AND_IN, *logical("LRW", 0x10000, bytes(5), None, 5)])
    assert [t.confirmed for t in found[2:]] == [False, False]


@pytest.mark.parametrize(
    "set_up",
    [
        [],
        both("FPWR", 0x1001, 0x0600, fmmu(0x10000, 5, 0x1100, 3)[:8]),
        both("FPWR", 0x1001, 0x0600, fmmu(0x10000, 5, 0x1100, 3), counter=0),
        mapped(0x1001, 0, fmmu(0x10000, 5, 0x1100, 3))[:1],
        [*OUT_AND_IN, *both("BWR", 0, 0x0600, bytes(48))],
        mapped(0x1001, 0, fmmu(0x10000, 1, 0x080D, 1, bits=0x0303)),
        [*OUT_AND_IN, *mapped(0x1001, 0, bytes(16)), *mapped(0x1001, 1, bytes(16))],
    ],
    ids=["not seen", "in part", "refused", "not returned", "all cleared", "one bit", "cleared"],
)
def test_without_settings_a_logical_datagram_says_nothing(
    tmp_path: Path, set_up: list[bytes]
) -> None:
    found, _ = read(tmp_path, [*set_up, *logical("LRW", 0x10000, bytes(5), None, 3)])
    assert logical_accesses(found) == []


def test_the_state_of_a_mailbox_counts_but_is_no_access(tmp_path: Path) -> None:
    frames = [
        *mapped(0x1001, 0, fmmu(0x10000, 2, 0x1100, 2)),
        *mapped(0x1001, 2, fmmu(0x10002, 1, 0x080D, 1, bits=0x0303)),
        *logical("LRW", 0x10000, b"ab.", b"ab\x08", counter=3),
    ]
    assert logical_accesses(read(tmp_path, frames)[0]) == [(True, 0x1100, b"ab", 1, True, True)]


def test_settings_in_pieces_by_position_or_read_back_are_followed(tmp_path: Path) -> None:
    content = fmmu(0, 2, 0x1100, 2)
    data = logical("LWR", 0, b"ab")
    for set_up in (
        [*both("BWR", 0, 0x0600, bytes(48)), *both("FPWR", 0x1001, 0x0600, content[:13])],
        [
            *both("FPWR", 0x1001, 0x0600, content[:8]),
            *both("FPWR", 0x1001, 0x0608, content[8:]),
        ],
        [*both("BWR", 0, 0x0600, content), *both("FPRD", 0x1001, 0x0600, bytes(1), b"\0")],
        both("APWR", 0, 0x0600, content),
        both("FPRD", 0x1001, 0x0600, bytes(13), content[:13]),
    ):
        found, _ = read(tmp_path, [*set_up, *data])
        assert logical_accesses(found) == [(True, 0x1100, b"ab", 1, True, True)]


def test_mappings_follow_a_device_that_was_taken_for_two(tmp_path: Path) -> None:
    frames = [
        *OUT_AND_IN,
        *both("APRD", 0, 0x0010, bytes(2), b"\x01\x10"),
        *logical("LWR", 0x10000, b"ab"),
    ]
    found, _ = read(tmp_path, frames)
    assert (found[-1].device, found[-1].address) == (0, 0x1100)


def test_a_logical_request_that_got_lost_is_unconfirmed(tmp_path: Path) -> None:
    lost = logical("LRW", 0x10000, b"ab...")[0]
    found, _ = read(tmp_path, [*OUT_AND_IN, lost, *both("FPRD", 0x1001, 0x0130, bytes(2))])
    assert logical_accesses(found) == [
        (False, 0x1400, b"...", 0, False, False),
        (True, 0x1100, b"ab", 0, False, False),
    ]


def test_of_a_logical_return_alone_the_data_written_is_unknown(tmp_path: Path) -> None:
    frames = [*OUT_AND_IN, logical("LRW", 0x10000, b"ab...", b"ab123", counter=3)[1]]
    found, _ = read(tmp_path, frames)
    assert logical_accesses(found) == [(False, 0x1400, b"123", 1, True, True)]


def test_without_registers_logical_datagrams_are_left_out(tmp_path: Path) -> None:
    path = write_capture(tmp_path / "made", [*OUT_AND_IN, *logical("LRW", 0x10000, bytes(5))])
    found = list(Capture(path, replace(WIRE, fmmus=())))
    assert [t.command for t in found] == ["FPWR", "FPWR"]


def test_a_real_capture_shows_where_process_data_lie(shared: Path, tmp_path: Path) -> None:
    """It ends in SAFEOP before the first process data, so one exchange is put behind it."""
    with (shared / "captures" / "soem-single-lan9252.pcapng").open("rb") as file:
        frames = [data for _, data in dpkt.pcapng.Reader(file)]
    found, _ = read(tmp_path, [*frames, *logical("LRW", 0, b"ab......", b"ab123456", counter=3)])
    assert logical_accesses(found) == [
        (False, 0x1400, b"123456", 1, True, True),
        (True, 0x1100, b"ab", 1, True, True),
    ]
    assert {t.device for t in found[-2:]} == {0}
