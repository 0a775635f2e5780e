"""Tests of captures in which frames are missing, and of addresses that do not answer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import dpkt
import pytest

from ecatspec.conformance.base.verdict import BLAMING
from ecatspec.conformance.capture.frames import Sequence
from ecatspec.conformance.capture.monitor import monitor_file

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

GAPS = (
    ("replay-ek1914-el3004-mailbox", 929, 13),
    ("replay-ek1914-segmented-upload", 676, 67),
    ("soem-sdinfo-akd", 6541, 59),
    ("soem-sdinfo-ek1100-el1004", 165, 46),
    ("soem-single-lan9252", 230, 72),
    ("soem-single-lan9252", 544, 93),
)
"""Captures, the first frame left out, how many are: each was blamed for it once."""
PHANTOM = 0x1FFF


def packets(path: Path) -> list[tuple[float, bytes]]:
    with path.open("rb") as file:
        return [(moment, bytes(data)) for moment, data in dpkt.pcapng.Reader(file)]


def written(path: Path, frames: Iterable[tuple[float, bytes]]) -> Path:
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, nano=True)
        for moment, data in frames:
            writer.writepkt(data, ts=moment)
    return path


@pytest.mark.parametrize(("name", "first", "length"), GAPS)
def test_a_gap_blames_no_device(
    shared: Path, tmp_path: Path, name: str, first: int, length: int
) -> None:
    frames = packets(shared / "captures" / f"{name}.pcapng")
    cut = written(tmp_path / "gap.pcap", frames[: first - 1] + frames[first - 1 + length :])
    results = monitor_file(cut, "standard")
    assert not [v for result in results for v in result.verdicts if v.outcome in BLAMING]
    assert any("could not be followed" in note for result in results for note in result.notes)


@pytest.mark.parametrize("name", sorted({name for name, *_ in GAPS}))
def test_a_whole_capture_has_no_gap(shared: Path, name: str) -> None:
    results = monitor_file(shared / "captures" / f"{name}.pcapng", "standard")
    assert not [note for result in results for note in result.notes if "missing" in note]


def jumps(indices: Iterable[int]) -> list[int]:
    sequence = Sequence()
    return [place for place, index in enumerate(indices) if sequence.jumps_to(index)]


def test_a_jump_of_the_index_is_a_gap() -> None:
    counted = [number % 16 for number in range(64)]
    assert jumps(counted) == []
    assert jumps(counted[:40] + counted[43:]) == [40]


def test_a_main_device_that_does_not_count_shows_no_gap() -> None:
    assert jumps([7] * 64) == []


def test_an_address_that_does_not_answer_is_no_sub_device(shared: Path, tmp_path: Path) -> None:
    name = "soem-single-lan9252"
    frames = packets(shared / "captures" / f"{name}.pcapng")
    whole = monitor_file(shared / "captures" / f"{name}.pcapng", "standard")
    moment, _ = frames[-1]
    datagram = bytes([4, 0]) + PHANTOM.to_bytes(2, "little") + bytes([0x30, 1, 2, 0, 0, 0])
    payload = b"\x88\xa4" + bytes([14, 0x10]) + datagram + bytes(4)
    poll = [bytes.fromhex(f"ffffffffffff 0{n}0101010101") + payload for n in (1, 3)]
    more = [(moment + 1, data) for data in poll]
    results = monitor_file(written(tmp_path / "more.pcap", frames + more), "standard")
    assert len(results) == len(whole) == 1
