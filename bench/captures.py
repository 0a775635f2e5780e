"""Measures the monitor: large captures, judged by us and written by tshark.

The captures are those of the folder of evidence, repeated with their times shifted until the file
is as large as wanted. The rival dissects the same frames and writes of each what the monitor looks
at: number, time, command, addresses, length, data, working counter.
"""

from __future__ import annotations

import shutil
import tempfile
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import dpkt
from measure import (
    COMMAND,
    Absent,
    Effort,
    Figure,
    Found,
    Of,
    Part,
    Profile,
    Ran,
    Row,
    Target,
    number,
    profiled,
    ran,
    rate,
    shared,
)

from ecatspec.conformance.capture.monitor import monitor_file

if TYPE_CHECKING:
    from collections.abc import Iterator

LARGE: Final = "soem-sdinfo-akd"
"""A drive from its start on, with its mailbox."""
OTHERS: Final = (("soem-single-lan9252", 20), ("replay-ek1914-el3004-mailbox", 20))
"""Smaller captures, and how often each is repeated."""
FIELDS: Final = (
    "frame.number",
    "frame.time_epoch",
    *(f"ecat.{name}" for name in ("cmd", "adp", "ado", "cnt", "data")),
    "ecat.subframe.length",
)
MEGABYTE: Final = 1_000_000


@contextmanager
def repeated(name: str, times: int | None = None, size: int = 0) -> Iterator[tuple[Path, int]]:
    """Give a capture that repeats one of ours, by count or to a size in bytes, and its frames."""
    with shared("captures", f"{name}.pcapng").open("rb") as stream:
        packets = list(dpkt.pcapng.Reader(stream))
    span = packets[-1][0] - packets[0][0] + 1
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.pcap"
        number = 0
        with path.open("wb") as file:
            writer = dpkt.pcap.Writer(file)
            while number < times if times is not None else file.tell() < size:
                for time, frame in packets:
                    writer.writepkt(frame, ts=time + number * span)
                number += 1
        yield path, number * len(packets)


def tshark() -> str:
    """Give the program of the rival."""
    program = shutil.which("tshark")
    if program is None:
        raise Absent("tshark is not installed")
    return program


def judged(path: Path) -> Ran:
    """Run the monitor on a capture, as a command."""
    found = ran((*COMMAND, "monitor", str(path), "--json"))
    assert found.status in {0, 1, 2}, f"the monitor ended with {found.status}"
    return found


def written(path: Path) -> Ran:
    """Have tshark write the fields of a capture."""
    chosen = [option for name in FIELDS for option in ("-e", name)]
    found = ran((tshark(), "-n", "-r", str(path), "-T", "fields", *chosen))
    assert found.status == 0, f"tshark ended with {found.status}"
    return found


def speed(path: Path, frames: int, rounds: int) -> tuple[Figure, Figure, float]:
    """Give frames a second of both, in turns, and the most memory of ours."""
    pairs = [(judged(path), written(path)) for _ in range(rounds)]
    ours, rival = zip(*pairs, strict=True)
    speeds = [rate(frames, [one.seconds for one in column]) for column in (ours, rival)]
    return speeds[0], speeds[1], max(one.peak for one in ours)


def large(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Judge a large capture, and a quarter of it for the memory."""
    tshark()
    fast, flat = rows
    size = effort.of(100, 8, 1) * MEGABYTE
    with repeated(LARGE, size=size // 4) as (path, frames):
        ours, rival, small = speed(path, frames, effort.of(3, 1, 1))
    with repeated(LARGE, size=size) as (path, all_frames):
        whole = judged(path)
    quarter, full = f"{number(size / 4 / MEGABYTE)} MB", f"{number(size / MEGABYTE)} MB"
    note = f"{LARGE} repeated to {quarter}, {frames:,} frames, start-up of both included; of the "
    note += (
        f"{all_frames:,} frames of {full} ours judged {all_frames / whole.seconds:,.0f} a second"
    )
    told = f"resident at most {number(small)} MB at {quarter}, {number(whole.peak)} MB at {full}"
    memory = flat.found(Figure.single(whole.peak), Figure.single(small), told)
    return Found((fast.found(ours, rival, note), memory))


def others(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Judge smaller captures."""
    tshark()
    found = []
    for row, (name, times) in zip(rows, OTHERS, strict=True):
        with repeated(name, effort.of(times, times, 1)) as (path, frames):
            ours, rival, _ = speed(path, frames, effort.of(3, 1, 1))
        note = f"repeated to {frames:,} frames, start-up of both included"
        found.append(row.found(ours, rival, note))
    return Found(tuple(found))


def profile(name: str, times: int, effort: Effort) -> Profile:
    with repeated(name, effort.of(times, times, 1)) as (path, _):
        return profiled(partial(monitor_file, path, "standard"))


_FRAMES: Final = Target(Of.RATIO, 1.0, least=True)
_BESIDE: Final = "tshark writes the same fields"
_WHY: Final = (
    "tshark is C, and only takes frames apart; the monitor is Python, follows each SubDevice "
)

PARTS: Final = (
    Part(
        (
            Row(
                "monitor",
                "monitor of a large capture",
                "frames a second",
                _BESIDE,
                _FRAMES,
                f"{_WHY}and asks the texts about each frame.",
            ),
            Row(
                "monitor-memory",
                "monitor, memory of four times the capture",
                "MB",
                "the same at a quarter of the size",
                Target(Of.RATIO, 1.1),
                "Something is kept for each frame.",
            ),
        ),
        large,
        {"monitor": partial(profile, LARGE, 20)},
    ),
    Part(
        tuple(
            Row(
                f"monitor-{name}",
                f"monitor of a small capture, {name}",
                "frames a second",
                _BESIDE,
                _FRAMES,
                f"{_WHY}with all states that may explain it, which are many where the capture "
                "lacks a message.",
            )
            for name, _ in OTHERS
        ),
        others,
        {f"monitor-{name}": partial(profile, name, times) for name, times in OTHERS},
    ),
)
