"""How benchmarks measure: figures, rows, taking turns, profiles, the machine.

A topic is a list of parts. A part says beforehand which rows it will give, so that what cannot be
measured here is told by name, with the reason, and nothing is left out in silence.
"""

from __future__ import annotations

import cProfile
import gc
import math
import os
import platform
import pstats
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import psutil

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

_T = TypeVar("_T")

ROOT: Final = Path(__file__).resolve().parent.parent
COMMAND: Final = (sys.executable, "-P", "-m", "ecatspec.conformance.cli")
"""Our command as a process of its own."""
LARGEST: Final = 8
"""Rows of a profile."""
_LOOK: Final = 0.05
"""Seconds between two looks at the memory of a process."""
_MEGABYTE: Final = 1_000_000


class Effort(Enum):
    """How much is measured: all, little (`--quick`), or just so much that it works (tests)."""

    WHOLE = "whole"
    QUICK = "quick"
    TINY = "tiny"

    def of(self, whole: _T, quick: _T, tiny: _T) -> _T:
        """Give the size that belongs to this effort."""
        return {Effort.WHOLE: whole, Effort.QUICK: quick, Effort.TINY: tiny}[self]


class Absent(Exception):  # noqa: N818
    """What is needed for a measurement is not there; the message says what."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Median and spread of several rounds."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Figure:
        return cls(statistics.median(values), min(values), max(values))

    @classmethod
    def single(cls, value: float) -> Figure:
        """Give what was found once, or is the same each time."""
        return cls(value, value, value)

    def __str__(self) -> str:
        if self.low == self.high:
            return number(self.median)
        return f"{number(self.median)} ({number(self.low)} to {number(self.high)})"


def number(value: float) -> str:
    """Give a number with about three digits that count."""
    size = abs(value)
    if size >= 100 or value == int(value):
        return f"{value:,.0f}"
    return f"{value:.1f}" if size >= 10 else f"{value:.3g}"


class Of(Enum):
    """What of a row a target speaks of; the value has the places for its words."""

    FIGURE = "{sign} {limit} {unit}"
    RATIO = "{sign} {limit}x"
    INVERSE = "{sign} {limit}x less"
    """The rival's figure in ours: how many times fewer, or how many times sooner."""
    ADDED = "{sign} {limit} {unit} more"


@dataclass(frozen=True, slots=True)
class Target:
    """A figure to reach; `goal` is one to reach later, told beside it."""

    of: Of
    limit: float
    least: bool = False
    goal: float | None = None

    def words(self, unit: str) -> str:
        sign = ">=" if self.least else "<="
        said = self.of.value.format(sign=sign, limit=number(self.limit), unit=unit)
        return said if self.goal is None else f"{said}, goal {number(self.goal)}"


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table: ours beside a rival's, which do the same work in the same process run.

    Without `ecatspec` it was not measured, and `note` says why. `why` is the reason in plain words
    where the target is missed, as far as it is known.
    """

    name: str
    what: str
    unit: str
    beside: str = "-"
    target: Target | None = None
    why: str = ""
    ecatspec: Figure | None = None
    rival: Figure | None = None
    note: str = ""

    def found(self, ecatspec: Figure, rival: Figure | None = None, note: str = "") -> Row:
        """Give the row with its figures."""
        return replace(self, ecatspec=ecatspec, rival=rival, note=note)

    @property
    def ratio(self) -> float | None:
        """Ours in units of the rival's."""
        if self.ecatspec is None or self.rival is None:
            return None
        return self.ecatspec.median / self.rival.median

    @property
    def measured(self) -> float | None:
        """What is held against the target."""
        if self.target is None or self.ecatspec is None:
            return None
        match self.target.of:
            case Of.FIGURE:
                return self.ecatspec.median
            case Of.RATIO:
                return self.ratio
            case Of.INVERSE:
                return None if self.ratio is None else 1 / self.ratio
            case Of.ADDED:
                return None if self.rival is None else self.ecatspec.median - self.rival.median

    @property
    def reached(self) -> bool | None:
        """Whether the target is reached; None: there is none, or nothing was measured."""
        if self.target is None or self.measured is None:
            return None
        if self.target.least:
            return self.measured >= self.target.limit
        return self.measured <= self.target.limit

    def cells(self) -> tuple[str, ...]:
        """Give the row as words: what, rival, ecatspec, its figure, ratio, target, reached."""
        ours = f"{self.ecatspec} {self.unit}" if self.ecatspec else "not measured"
        ratio = "" if self.ratio is None else f"{number(self.ratio)}x"
        if self.ratio is not None and self.target is not None and self.target.of is Of.INVERSE:
            ratio = f"1/{number(1 / self.ratio)}"
        reached = {True: "yes", False: "no", None: "-"}[self.reached]
        target = "-" if self.target is None else self.target.words(self.unit)
        rival = "" if self.rival is None else str(self.rival)
        return self.what, self.beside, ours, rival, ratio, target, reached


HEADS: Final = ("what", "rival", "ecatspec", "rival's", "ratio", "target", "reached")
"""The columns of the table."""


@dataclass(frozen=True, slots=True)
class Table:
    """Details that have no rival and no target."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Curve:
    """How the time grows with a size; the seconds are those above what a size of nothing takes."""

    name: str
    unit: str
    points: tuple[tuple[int, float], ...]

    @property
    def slope(self) -> float:
        """The power of the size that the time grows with, by least squares: 1 is a line."""
        pairs = [(math.log(size), math.log(seconds)) for size, seconds in self.points]
        return statistics.linear_regression(*zip(*pairs, strict=True)).slope

    @property
    def worst(self) -> float:
        """The worst doubling in units of a line: twice the time is 1."""
        pairs = zip(self.points, self.points[1:], strict=False)
        return max((t / s) / (n / m) for (m, s), (n, t) in pairs)


@dataclass(frozen=True, slots=True)
class Found:
    """What a part came to."""

    rows: tuple[Row, ...]
    tables: tuple[Table, ...] = ()
    curves: tuple[Curve, ...] = ()


@dataclass(frozen=True, slots=True)
class Share:
    """One line of a profile: a function or a module, and its part of all the time."""

    part: float
    where: str
    calls: int | None = None


@dataclass(frozen=True, slots=True)
class Profile:
    """Where the time goes."""

    how: str
    seconds: float
    shares: tuple[Share, ...]


@dataclass(frozen=True, slots=True)
class Part:
    """Rows that are measured together; `profiles` are those that can be taken, by row."""

    rows: tuple[Row, ...]
    measure: Callable[[tuple[Row, ...], Effort], Found]
    profiles: Mapping[str, Callable[[Effort], Profile]] = field(default_factory=dict)


def measured(part: Part, effort: Effort) -> Found:
    """Measure a part; what is not there, or went wrong, is a row that says so."""
    try:
        return part.measure(part.rows, effort)
    except (Absent, AssertionError, OSError, subprocess.SubprocessError) as error:
        return Found(tuple(replace(row, note=f"not measured: {error}") for row in part.rows))


# --- taking time ----------------------------------------------------------------------------------


def seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def in_turns(
    rounds: int, *works: Callable[[], object], warm: bool = True
) -> tuple[list[float], ...]:
    """Give the seconds of each work in each round; with `warm`, after one that is not counted."""
    for work in works if warm else ():
        work()
    found = [[seconds(work) for work in works] for _ in range(rounds)]
    return tuple(list(column) for column in zip(*found, strict=True))


def rate(count: int, times: Sequence[float]) -> Figure:
    """Give how many there were in a second."""
    return Figure.of([count / each for each in times])


def each(count: int, times: Sequence[float], unit: float = 1e6) -> Figure:
    """Give the time of one, in microseconds where nothing else is said."""
    return Figure.of([one / count * unit for one in times])


# --- processes ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Ran:
    """A process that was watched: its seconds, and its megabytes of memory with the second."""

    seconds: float
    memory: tuple[tuple[float, float], ...]
    status: int

    @property
    def peak(self) -> float:
        """The most memory that was seen."""
        return max(size for _, size in self.memory)


def ran(command: Sequence[str], longest: float = float("inf"), look: float = _LOOK) -> Ran:
    """Run a command to its end, or for a number of seconds, and watch its memory meanwhile."""
    began = time.perf_counter()
    memory = []
    quiet = subprocess.DEVNULL
    with psutil.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet) as process:
        while process.poll() is None:
            now = time.perf_counter() - began
            try:
                memory.append((now, process.memory_info().rss / _MEGABYTE))
            except psutil.Error:
                break  # it ended just now
            if now > longest:
                process.terminate()
            try:
                process.wait(look)
            except psutil.TimeoutExpired:
                continue
        status = process.wait()
    return Ran(time.perf_counter() - began, tuple(memory), status)


def shared(folder: str, name: str) -> Path:
    """Give a file of the folder of evidence.

    Raises:
        Absent: It is not there.

    """
    named = os.environ.get("ECATSPEC_SHARED")
    place = Path(named) if named else ROOT.parent / "shared"
    path = place / folder / name
    if not path.is_file():
        raise Absent(f"{folder}/{name} is not there; ECATSPEC_SHARED names the folder")
    return path


# --- profiles -------------------------------------------------------------------------------------


def profiled(work: Callable[[], object], how: str = "cProfile") -> Profile:
    """Give the functions of a work with the largest shares of its time, without what they call."""
    profile = cProfile.Profile()
    gc.collect()  # else whoever is called just then pays for what others left
    profile.runcall(work)
    return _largest(pstats.Stats(profile), how)


def profiled_file(path: Path, how: str) -> Profile:
    """Give the largest shares of what another process kept in a file."""
    return _largest(pstats.Stats(str(path)), how)


def _largest(stats: pstats.Stats, how: str) -> Profile:
    functions = stats.get_stats_profile()
    total = functions.total_tt
    rows: list[Share] = []
    # the key of get_stats_profile is the bare name, so equal names of two files would be one
    every: dict[tuple[str, int, str], tuple[int, int, float, float, object]] = stats.stats  # type: ignore[attr-defined]
    for (file, line, name), (_, calls, own, _, _) in every.items():
        rows.append(Share(own / total, _where(file, line, name), calls))
    rows.sort(key=lambda share: (-share.part, share.where))
    return Profile(how, total, tuple(rows[:LARGEST]))


def _where(file: str, line: int, name: str) -> str:
    """Give a function without the folder that this machine happens to have it in."""
    if file == "~":
        return name
    parts = Path(file).parts
    for top in ("spec", "model", "generators", "conformance"):
        if top in parts:
            place = "/".join(parts[parts.index(top) :])
            return f"{place}:{line} {name}"
    return f"{Path(file).name}:{line} {name}"


# --- the machine ----------------------------------------------------------------------------------


def machine() -> dict[str, str]:
    """Say on what was measured, and when."""
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
        "load": " ".join(f"{load:.1f}" for load in psutil.getloadavg()),
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text("utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
