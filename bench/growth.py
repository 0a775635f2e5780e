"""Measures how the time grows: with cases, objects, rules and frames.

Each size is twice the one before, and the time of a size of nothing is taken off, so that what a
start costs does not hide how the rest grows. Texts of any size are made here.
"""

from __future__ import annotations

import io
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from captures import LARGE, repeated
from complete import best
from measure import Curve, Effort, Figure, Found, Of, Part, Profile, Row, Target, profiled
from walks import runner_of

from ecatspec.conformance.capture.monitor import monitor_file
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_device, load_file

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ecatspec.generators.cases.case import Case

    Sized = Callable[[int], Callable[[], object]]
    """Give the work of a size, made ready so that only the work is timed."""

DEVICE: Final = "beckhoff-el6720"
DOUBLINGS: Final = 4
BLOCK: Final = 32
"""Cases that are repeated, so that each size has the same mix."""
ON_AN_INPUT: Final = 8
"""Rules that take the same input; a text with more rules has more inputs."""
LEAST: Final = 1e-4
"""Seconds above nothing that can be told from it."""
_CLAUSE: Final = '\nclause GRO-01 must "it grows" source "this text"\n\n'


# --- texts ----------------------------------------------------------------------------------------


def text_of_objects(count: int) -> str:
    """Give a device with a number of objects."""
    rows = [
        f"  0x{0x2000 + n:04X} : 0 entry_{n} u16 rw = {n % 1000} [GRO-01]" for n in range(count)
    ]
    head = f'device grown extends standard "a device with objects"\n{_CLAUSE}'
    closed = "dictionary closed [GRO-01]"
    return "\n".join((head, closed, *(("", "objects", *rows) if rows else ()), ""))


def text_of_rules(count: int, on_an_input: int = ON_AN_INPUT) -> str:
    """Give a text of the standard with a machine with a number of rules."""
    lines = [f'standard grown "a machine with rules"\n{_CLAUSE}table grown_state u4 closed']
    lines += ['  1 IDLE "idle" [GRO-01]', "", 'machine grown "what grows"']
    lines += ["  states   grown_state { IDLE } initial IDLE", "  variable last : u16 = 0"]
    inputs = range(max(1, -(-count // on_an_input)))
    lines += [f"  input    stroke_{number} local (number: u16)" for number in inputs]
    for rule in range(count):
        lines += [
            "",
            f"  rule rule_{rule} [GRO-01]",
            f"    from IDLE on stroke_{rule // on_an_input}",
        ]
        lines += [f"    when number == {rule}", "    goto IDLE", f"    set last = {rule}"]
    return "\n".join((*lines, ""))


def checked(text: str) -> Callable[[], object]:
    """Give the work of checking and compiling a text."""

    def work() -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "grown.ecs"
            path.write_text(text, "utf-8")
            Model(load_file(path))

    return work


# --- what grows -----------------------------------------------------------------------------------


@cache
def _block() -> list[Case]:
    """Give cases of all kinds."""
    every = list(all_cases(Model(load_device(DEVICE)), NO_LIMITS, "quick"))
    return every[:: len(every) // BLOCK][:BLOCK]


def _cases(count: int) -> Callable[[], object]:
    runner = runner_of(DEVICE)
    block = _block()
    cases = (block * -(-count // BLOCK))[:count]
    runner.run(block, None, 0)
    return partial(runner.run, cases, None, 0)


def _generated(count: int) -> Callable[[], object]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "grown.ecs"
        path.write_text(text_of_objects(count), "utf-8")
        protocol = load_file(path)

    def work() -> None:
        for _ in all_cases(Model(protocol), NO_LIMITS):
            pass

    return work


def _objects(count: int) -> Callable[[], object]:
    return checked(text_of_objects(count))


def _rules(count: int) -> Callable[[], object]:
    return checked(text_of_rules(count))


def _rules_of_one(count: int) -> Callable[[], object]:
    return checked(text_of_rules(count, count or 1))


def _frames(count: int) -> Callable[[], object]:
    def work() -> None:
        with repeated(LARGE, count) as (path, _):
            monitor_file(path, "standard")

    # a capture without frames is refused: its start is the model
    return work if count else partial(Model, load_device("standard"))


KINDS: Final[Mapping[str, tuple[str, Sized, tuple[int, int, int]]]] = {
    "growth-cases": ("cases", _cases, (128, 64, 4)),
    "growth-objects": ("objects", _objects, (1500, 500, 20)),
    "growth-generated": ("objects", _generated, (100, 50, 4)),
    "growth-rules": ("rules", _rules, (250, 150, 8)),
    "growth-rules-of-one": ("rules", _rules_of_one, (50, 25, 4)),
    "growth-frames": ("repeats", _frames, (8, 4, 1)),
}
"""By row: what is counted, the work, and its smallest size by effort."""


def measure(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Time all sizes in turns, the quickest of some rounds; take off what nothing takes.

    The time is that of the processor: other work of the machine must not bend the curve.
    """
    found, curves = [], []
    for row in rows:
        unit, sized, smallest = KINDS[row.name]
        sizes = [effort.of(*smallest) << n for n in range(effort.of(DOUBLINGS, DOUBLINGS, 1) + 1)]
        works = [sized(size) for size in (0, *sizes)]
        works[0]()  # what is worked out once, by the first of them
        rounds = [[best(work, 1)[0] for work in works] for _ in range(effort.of(3, 2, 1))]
        nothing, *least = (min(column) for column in zip(*rounds, strict=True))
        points = [(n, max(one - nothing, LEAST)) for n, one in zip(sizes, least, strict=True)]
        curve = Curve(row.what, unit, tuple(points))
        note = (
            f"{sizes[0]:,} to {sizes[-1]:,} {unit}, {points[-1][1]:.2f} s for the most; the worst "
        )
        note += f"doubling takes {2 * curve.worst:.2f} times as long"
        found.append(row.found(Figure.single(curve.slope), note=note))
        curves.append(curve)
    return Found(tuple(found), (), tuple(curves))


def profile(name: str, effort: Effort) -> Profile:
    _, sized, smallest = KINDS[name]
    return profiled(sized(effort.of(*smallest) << effort.of(DOUBLINGS, DOUBLINGS, 1)))


# --- the drawing ----------------------------------------------------------------------------------


def drawing(curves: Sequence[Curve]) -> str:
    """Draw the curves beside a straight line; the same curves give the same bytes."""
    import matplotlib as mpl  # noqa: PLC0415  only who draws needs it
    from matplotlib.figure import Figure as Sheet  # noqa: PLC0415

    with mpl.rc_context({"svg.hashsalt": "ecatspec", "svg.fonttype": "none", "font.size": 9}):
        sheet = Sheet(figsize=(9, 3 * -(-len(curves) // 3)), layout="constrained")
        for place, curve in enumerate(curves, 1):
            axes = sheet.add_subplot(-(-len(curves) // 3), 3, place)
            sizes, times = zip(*curve.points, strict=True)
            line = [times[-1] * size / sizes[-1] for size in sizes]
            axes.loglog(sizes, line, color="0.7", linestyle="--", base=2)
            axes.loglog(sizes, times, color="tab:blue", marker="o", markersize=4, base=2)
            axes.set_title(f"{curve.name}\npower {curve.slope:.2f}", fontsize=9)
            axes.set_xticks(sizes, [f"{size:,}" for size in sizes], fontsize=7)
            axes.set_yticks(times, [f"{each:.2g}" for each in times], fontsize=7)
            axes.minorticks_off()
            axes.set_xlabel(curve.unit)
            axes.set_ylabel("seconds")
        file = io.StringIO()
        sheet.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return "".join(f"{line.rstrip()}\n" for line in file.getvalue().splitlines())


def _row(name: str, what: str, why: str) -> Row:
    return Row(name, what, "power of the size", target=Target(Of.FIGURE, 1.1), why=why)


PARTS: Final = (
    Part(
        (
            _row(
                "growth-cases", "time of a run by cases", "Something is looked up in all verdicts."
            ),
            _row("growth-objects", "time of a check by objects", "See the profile."),
            _row("growth-generated", "time to make all cases by objects", "See the profile."),
            _row(
                "growth-rules",
                f"time of a check by rules, {ON_AN_INPUT} on an input",
                "See the profile.",
            ),
            _row(
                "growth-rules-of-one",
                "time of a check by rules of one input",
                "Rules that nothing keeps apart by a constant are compared, each with each.",
            ),
            _row("growth-frames", "time of the monitor by repeated frames", "See the profile."),
        ),
        measure,
        {name: partial(profile, name) for name in KINDS},
    ),
)
