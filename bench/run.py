"""The only place that measures speed: ecatspec beside the bare thing, in one run of one process.

    python bench/run.py [--json]

Every pair takes turns, round by round, so that both see the same machine. A figure is the median
of the rounds with the lowest and the highest; nothing here passes or fails.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias, cast

import dpkt.pcapng
from rich.console import Console
from rich.table import Table

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.monitor import monitor_file
from ecatspec.conformance.process import ProcessAdapter
from ecatspec.conformance.session import Session
from ecatspec.generators.case import NO_LIMITS
from ecatspec.generators.sdo_cover import sdo_cover
from ecatspec.model.compiled import Model
from ecatspec.model.oracle import Oracle
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ecatspec.conformance.adapter import Adapter, Description
    from ecatspec.generators.case import Case
    from ecatspec.model.candidates import Exchange, Mismatch
    from ecatspec.model.values import ObjectKey
    from ecatspec.spec.language.ir import Protocol

Call: TypeAlias = tuple[str, tuple[object, ...]]
"""A method by name, and its arguments."""

DEVICE: Final = "kollmorgen-akd"
HOST: Final = "ecatspec.conformance.host"
CAPTURE: Final = "soem-sdinfo-akd.pcapng"
CASES: Final = "sdo/upload/"
CHOICES: Final = {"emulation": "none", "mailbox_support": "present"}
ROUNDS: Final = 7
STARTS: Final = 15
ROOT: Final = Path(__file__).resolve().parent.parent
_PIPE_WIDTH: Final = 120


@dataclass(frozen=True, slots=True)
class Figure:
    """Median and spread of several rounds."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Figure:
        return cls(statistics.median(values), min(values), max(values))

    def __str__(self) -> str:
        return f"{self.median:,.0f} ({self.low:,.0f} to {self.high:,.0f})"


@dataclass(frozen=True, slots=True)
class Row:
    """One measurement; `ecatspec` and `bare` are None when there was nothing to measure."""

    what: str
    unit: str
    ecatspec: Figure | None
    bare: Figure | None
    beside: str
    note: str


@dataclass(slots=True)
class Recorder:
    """A device that remembers what was asked of it; as an adapter, as far as a session goes."""

    device: Adapter
    calls: list[Call] = field(default_factory=list)

    def describe(self) -> Description:
        return self.device.describe()

    def reset(self) -> None:
        self.calls.append(("reset", ()))
        self.device.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        self.calls.append(("read", (address, length)))
        return self.device.read(address, length)

    def write(self, address: int, data: bytes) -> int:
        self.calls.append(("write", (address, data)))
        return self.device.write(address, data)

    def advance(self, seconds: float) -> None:
        self.calls.append(("advance", (seconds,)))
        self.device.advance(seconds)


class RecordingOracle(Oracle):
    """An oracle that remembers what a session asked of it."""

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.calls: list[Call] = []

    def power_on(
        self,
        choices: dict[str, str] | None = None,
        objects: Mapping[ObjectKey, bytes] | None = None,
    ) -> None:
        self.calls.append(("power_on", (choices, objects)))
        super().power_on(choices, objects)

    def observe(self, exchange: Exchange) -> Mismatch | None:
        self.calls.append(("observe", (exchange,)))
        return super().observe(exchange)

    def settled(self, time: int, *, unread: bool = False) -> bool:
        assert not unread, "the cases of the benchmark read every answer"
        self.calls.append(("settled", (time,)))
        return super().settled(time)

    def deadline(self, time: int) -> int | None:
        self.calls.append(("deadline", (time,)))
        return super().deadline(time)


# --- measuring ------------------------------------------------------------------------------------


def seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def in_turns(rounds: int, *works: Callable[[], object]) -> list[list[float]]:
    """Give the seconds of each work in each round; one more round before that is not counted."""
    found = [[seconds(work) for work in works] for _ in range(rounds + 1)][1:]
    return [list(column) for column in zip(*found, strict=True)]


def rate(count: int, times: Sequence[float]) -> Figure:
    return Figure.of([count / each for each in times])


def bound(
    target: object, calls: Sequence[Call]
) -> list[tuple[Callable[..., object], tuple[object, ...]]]:
    """Look the methods up before the clock runs."""
    return [(getattr(target, name), arguments) for name, arguments in calls]


def perform(calls: Sequence[tuple[Callable[..., object], tuple[object, ...]]]) -> None:
    for method, arguments in calls:
        method(*arguments)


def check(session: Session, cases: Sequence[Case]) -> None:
    """Drive a device through the cases as a run does; a deviation ends the measurement."""
    for case in cases:
        session.begin(CHOICES)
        for stimulus in case.stimuli:
            session.apply(stimulus)


# --- what is measured -----------------------------------------------------------------------------


def exchanges(protocol: Protocol) -> list[Row]:
    """Compare checked with bare exchanges: in the process, then with the device in another."""
    model = Model(protocol)
    model.dictionary.close()  # as a run does for a device that is made of the text
    cases = [case for case in sdo_cover(model, NO_LIMITS) if case.name.startswith(CASES)]
    recorder, recording = Recorder(make(DEVICE, {})), RecordingOracle(model)
    recorded = Session(cast("Adapter", recorder), model, recording)
    check(recorded, cases)
    count = recorded.exchanges

    device = make(DEVICE, {})
    session = Session(device, model, Oracle(model))
    checked, bare, judged = in_turns(
        ROUNDS,
        partial(check, session, cases),
        partial(perform, bound(device, recorder.calls)),
        partial(perform, bound(Oracle(model), recording.calls)),
    )
    shares = _shares(checked, bare, judged)
    note = f"{len(cases)} cases, {count} exchanges; {shares}"
    inside = Row(
        "checked exchanges, virtual device in the process",
        "per second",
        rate(count, checked),
        rate(count, bare),
        "the same calls on the device alone",
        note,
    )

    asked = json.dumps({"device": DEVICE, "options": {}})
    adapter = ProcessAdapter((sys.executable, "-P", "-m", HOST, "model", asked))
    try:
        session = Session(adapter, model, Oracle(model))
        checked, bare, judged = in_turns(
            ROUNDS,
            partial(check, session, cases),
            partial(perform, bound(adapter, recorder.calls)),
            partial(perform, bound(Oracle(model), recording.calls)),
        )
    finally:
        adapter.close()
    outside = Row(
        "checked exchanges, process adapter",
        "per second",
        rate(count, checked),
        rate(count, bare),
        "the same calls through the adapter alone",
        f"the same exchanges; {_shares(checked, bare, judged)}",
    )
    return [inside, outside]


def _shares(checked: list[float], bare: list[float], judged: list[float]) -> str:
    whole = statistics.median(checked)
    oracle = statistics.median(judged) / whole
    device = statistics.median(bare) / whole
    rest = 1 - oracle - device  # what the session does itself; not measured, only left over
    return f"oracle {oracle:.0%} of the time, device {device:.0%}, rest {rest:.0%}"


def capture_file() -> Path:
    named = os.environ.get("ECATSPEC_SHARED")
    folder = Path(named) if named else ROOT.parent / "shared"
    return folder / "captures" / CAPTURE


def count_packets(path: Path) -> int:
    with path.open("rb") as stream:
        return sum(1 for _ in dpkt.pcapng.Reader(stream))


def frames() -> Row:
    """Compare judging a capture with reading it."""
    path = capture_file()
    what, beside = f"monitor, {CAPTURE}", "dpkt reads the same file"
    if not path.is_file():
        return Row(what, "frames per second", None, None, beside, "absent")
    count = count_packets(path)
    judged, read = in_turns(
        ROUNDS, partial(monitor_file, path, DEVICE), partial(count_packets, path)
    )
    note = f"{count} frames; with compiling the model, without parsing the text"
    return Row(what, "frames per second", rate(count, judged), rate(count, read), beside, note)


def start_up() -> Row:
    """Compare the start of the command with that of Python."""
    script = Path(sys.executable).with_name("ecatspec")
    module = [sys.executable, "-m", "ecatspec.conformance.cli"]
    command = [str(script)] if script.is_file() else module
    ours, python = in_turns(
        STARTS,
        partial(_start, [*command, "--help"]),
        partial(_start, [sys.executable, "-c", "pass"]),
    )
    ours_ms, python_ms = (Figure.of([1000 * each for each in times]) for times in (ours, python))
    note = "console script" if script.is_file() else "no console script: python -m"
    return Row("ecatspec --help", "milliseconds", ours_ms, python_ms, "python -c pass", note)


def _start(command: list[str]) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stdin=subprocess.DEVNULL)


# --- saying it ------------------------------------------------------------------------------------


def show(rows: Sequence[Row]) -> None:
    table = Table(
        title=f"median (lowest to highest) of {ROUNDS} rounds, start-up of {STARTS}",
        caption=f"Python {platform.python_version()}, {os.cpu_count()} cores",
        show_lines=True,
    )
    table.add_column("what")
    table.add_column("unit")
    table.add_column("ecatspec", justify="right", no_wrap=True)
    table.add_column("bare", justify="right", no_wrap=True)
    table.add_column("bare is")
    table.add_column("note")
    for row in rows:
        figures = ["absent" if f is None else str(f) for f in (row.ecatspec, row.bare)]
        table.add_row(row.what, row.unit, *figures, row.beside, row.note)
    console = Console()
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    console.print(table)


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure ecatspec beside the bare thing.")
    parser.add_argument("--json", action="store_true", help="give the figures as JSON")
    as_json: bool = parser.parse_args().json
    rows = [*exchanges(load_device(DEVICE)), frames(), start_up()]
    if as_json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    else:
        show(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
