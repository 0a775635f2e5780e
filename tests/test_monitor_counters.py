"""Tests of what the monitor says of working counters that do not fit the FMMUs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import dpkt

from ecatspec.conformance.capture.monitor import monitor_file

if TYPE_CHECKING:
    from pathlib import Path

FPWR, LRW = 5, 12
STATION, FMMUS = 0x1001, 0x0600
OUT = bytes.fromhex("00000000 0100 00 07 0011 00 02 01 000000")
IN = bytes.fromhex("00000000 0100 00 07 0012 00 01 01 000000")
CYCLES = 5


def pair(
    command: int, index: int, place: tuple[int, int], data: bytes, counter: int
) -> list[bytes]:
    """Give a frame with one datagram as it went out, and as it came back."""
    adp, ado = (half.to_bytes(2, "little") for half in place)
    size = len(data).to_bytes(2, "little")
    head = bytes([command, index]) + adp + ado + size + bytes(2) + data
    length = (len(head) + 2 | 1 << 12).to_bytes(2, "little")
    return [
        bytes.fromhex("ffffffffffff")
        + bytes([first, 1, 1, 1, 1, 1])
        + b"\x88\xa4"
        + length
        + head
        + working.to_bytes(2, "little")
        for first, working in ((1, 0), (3, counter))
    ]


def notes(path: Path, counter: int) -> str:
    """Give the notes of a capture with cycles that come back with this working counter."""
    frames = pair(FPWR, 0, (STATION, FMMUS), OUT + IN, 1)
    for cycle in range(CYCLES):
        frames += pair(LRW, 1 + cycle, (0, 0), b"\x55", counter)
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, nano=True)
        for moment, data in enumerate(frames):
            writer.writepkt(data, ts=moment / 1000)
    (result,) = monitor_file(path, "standard")
    return "\n".join(result.notes)


def test_a_wrong_working_counter_is_no_lost_return(tmp_path: Path) -> None:
    said = notes(tmp_path / "wrong.pcap", 9)
    assert "return was not captured" not in said
    assert f"{2 * CYCLES} accesses whose working counter" in said
    assert "first 9 in frame 4" in said


def test_the_expected_working_counter_is_no_note(tmp_path: Path) -> None:
    said = notes(tmp_path / "right.pcap", 3)
    assert "working counter" not in said
    assert "not captured" not in said
