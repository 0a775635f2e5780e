"""Measures whole commands: their start, proofs, runs with workers, memory."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from measure import (
    COMMAND,
    LARGEST,
    ROOT,
    Absent,
    Effort,
    Figure,
    Found,
    Of,
    Part,
    Profile,
    Row,
    Share,
    Target,
    in_turns,
    number,
    profiled,
    profiled_file,
    ran,
)

from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Sequence

DEVICE: Final = "kollmorgen-akd"
SMALL: Final = "reference"
FEW: Final = "beckhoff-el6720"
"""The device with the shortest run."""
TEXT: Final = str(ROOT / "spec" / "devices" / f"{DEVICE}.ecs")
STARTS: Final = {
    "start-help": ("--help",),
    "start-show": ("show", DEVICE),
    "start-check": ("check", TEXT),
}
"""The arguments of what is started, by row."""
MINUTE: Final = 60.0


def command() -> tuple[str, ...]:
    """Give our command as users start it: the console script, where it is installed."""
    script = Path(sys.executable).with_name("ecatspec")
    return (str(script),) if script.is_file() else COMMAND


def quietly(asked: Sequence[str]) -> None:
    """Run a command to its end; nobody reads what it says."""
    quiet = subprocess.DEVNULL
    status = subprocess.run(asked, check=False, stdin=quiet, stdout=quiet, stderr=quiet).returncode
    assert status in {0, 1}, f"{' '.join(asked)} ended with {status}"


# --- the start ------------------------------------------------------------------------------------


def starts(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Start commands beside Python itself."""
    works = [partial(quietly, (*command(), *STARTS[row.name])) for row in rows]
    python = partial(quietly, (sys.executable, "-c", "pass"))
    *ours, bare = in_turns(effort.of(15, 7, 1), *works, python)
    rival = Figure.of([one * 1000 for one in bare])
    note = "console script" if command() != COMMAND else "no console script here: python -m"
    return Found(
        tuple(
            row.found(Figure.of([one * 1000 for one in times]), rival, note)
            for row, times in zip(rows, ours, strict=True)
        )
    )


def imports(name: str, effort: Effort) -> Profile:
    """Give the modules whose import takes longest, each without what it imports itself."""
    asked = (sys.executable, "-X", "importtime", *COMMAND[1:], *STARTS[name])
    lines = []
    for _ in range(effort.of(5, 3, 1)):
        done = subprocess.run(asked, capture_output=True, text=True, check=False)
        found = re.findall(
            r"^import time:\s+(\d+) \|\s+(\d+) \| ( *)(\S+)$", done.stderr, re.MULTILINE
        )
        lines.append({module: int(own) for own, _, _, module in found})
    quickest = min(lines, key=lambda line: sum(line.values()))
    total = sum(quickest.values())
    largest = sorted(quickest.items(), key=lambda item: -item[1])[:LARGEST]
    return Profile(
        f"python -X importtime, {len(quickest)} modules",
        total / 1e6,
        tuple(Share(own / total, module) for module, own in largest),
    )


def started(name: str, _: Effort) -> Profile:
    """Give the functions of a command, imports included."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "profile"
        profile = (sys.executable, "-P", "-m", "cProfile", "-o", str(path), "-m", COMMAND[-1])
        quietly((*profile, *STARTS[name]))
        return profiled_file(path, "cProfile of the whole command")


# --- proofs ---------------------------------------------------------------------------------------


def proofs(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Prove all texts that are shipped."""
    asked = (*COMMAND, "prove", *effort.of((), (), (SMALL,)))
    (times,) = in_turns(effort.of(2, 1, 1), partial(quietly, asked), warm=False)
    names = effort.of(("standard", *device_names()), ("standard", *device_names()), (SMALL,))
    note = f"{len(names)} specifications: {', '.join(names)}; as many at once as there are cores"
    return Found((rows[0].found(Figure.of(times), note=note),))


def proved(effort: Effort) -> Profile:
    from ecatspec.conformance.prove import prove  # noqa: PLC0415  it needs the solver

    name = effort.of(DEVICE, DEVICE, SMALL)
    return profiled(partial(prove, name, load_device(name)), f"cProfile, {name} alone")


# --- runs -----------------------------------------------------------------------------------------


def workers(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Share a run among two workers."""
    if (os.cpu_count() or 1) < 2:
        raise Absent("two workers need two cores")
    device = effort.of(DEVICE, FEW, FEW)
    depth = effort.of("default", "default", "quick")
    only = effort.of((), (), ("--only", "mailbox"))
    with tempfile.TemporaryDirectory() as folder:

        def work(count: int) -> None:
            path = Path(folder) / f"{count}.sqlite"
            path.unlink(missing_ok=True)
            asked = (*COMMAND, "run", device, "--results", str(path), "--depth", depth, *only)
            quietly((*asked, "--workers", str(count)))

        two, one = in_turns(effort.of(2, 1, 1), partial(work, 2), partial(work, 1), warm=False)
    note = f"{device}, depth {depth}; start-up of both included"
    return Found((rows[0].found(Figure.of(two), Figure.of(one), note),))


def memory(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Watch the memory of an exhaustive run for some minutes."""
    longest, warm = effort.of(4 * MINUTE, 40.0, 4.0), effort.of(MINUTE, 20.0, 2.0)
    most, growth = rows
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.sqlite"
        asked = (*COMMAND, "run", DEVICE, "--depth", "exhaustive", "--results", str(path))
        found = ran(asked, longest, look=0.2)
    early = max(size for at, size in found.memory if at <= warm)
    late = [size for at, size in found.memory if at > warm] or [early]
    note = f"{DEVICE}, stopped after {number(found.seconds)} s; {number(early)} MB at most in the "
    note += f"first {number(warm)} s, {number(max(late))} MB at most afterwards"
    after = growth.found(Figure.single(max(late)), Figure.single(early), note)
    return Found((most.found(Figure.single(found.peak), note=note), after))


def judged(effort: Effort) -> Profile:
    """Profile a run in one process: what workers could share, and what they could not."""
    from ecatspec.conformance.run.runner import run_device  # noqa: PLC0415

    device = effort.of(DEVICE, FEW, FEW)
    work = partial(run_device, device, "model", depth="quick")
    return profiled(work, f"cProfile, one process, {device}, depth quick")


PARTS: Final = (
    Part(
        (
            Row(
                "start-help",
                "`ecatspec --help`",
                "ms",
                "`python -c pass`",
                Target(Of.RATIO, 4.0),
                "Modules are imported for the command line and its help pages; the profile has the "
                "largest.",
            ),
            Row(
                "start-show",
                f"`ecatspec show {DEVICE}`",
                "ms",
                "`python -c pass`",
                Target(Of.FIGURE, 300.0),
                "The profile has the largest shares.",
            ),
            Row(
                "start-check",
                f"`ecatspec check {DEVICE}.ecs`",
                "ms",
                "`python -c pass`",
                Target(Of.FIGURE, 300.0),
                "A text that changed is parsed and checked anew; another one is remembered.",
            ),
        ),
        starts,
        {
            "start-help": partial(imports, "start-help"),
            "start-show": partial(started, "start-show"),
            "start-check": partial(started, "start-check"),
        },
    ),
    Part(
        (
            Row(
                "prove",
                "`ecatspec prove`, all texts",
                "s",
                target=Target(Of.FIGURE, 60.0, goal=15.0),
                why="Determinism and completeness are asked of the solver rule by rule.",
            ),
        ),
        proofs,
        {"prove": proved},
    ),
    Part(
        (
            Row(
                "workers",
                f"default run of {DEVICE}, 2 workers",
                "s",
                "the same with 1 worker",
                Target(Of.INVERSE, 1.8, least=True),
                "Each worker starts, reads the texts and compiles the rules for itself, and random "
                "searches and the first cases wait for each other.",
            ),
        ),
        workers,
        {"workers": judged},
    ),
    Part(
        (
            Row(
                "memory",
                "memory of an exhaustive run",
                "MB",
                target=Target(Of.FIGURE, 300.0),
                why="It grows with the run; what holds it was not measured.",
            ),
            Row(
                "memory-growth",
                "memory of an exhaustive run after the first minute",
                "MB",
                "the most in the first minute",
                Target(Of.RATIO, 1.05),
                "Verdicts are kept until the report, and what was worked out once is kept for all "
                "of the run; how much each of them holds was not measured.",
            ),
        ),
        memory,
    ),
)
