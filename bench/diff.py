"""Measures comparisons: of two finite machines, and `ecatspec diff`.

The rival of a comparison is AALpy on the same Mealy machines, which are made before the clock runs:
`bisimilar` gives one word that tells two machines apart, `compare_automata` looks for several.
"""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Final

from complete import machine_of, of_aalpy
from measure import (
    COMMAND,
    Effort,
    Figure,
    Found,
    Of,
    Part,
    Profile,
    Row,
    Table,
    Target,
    in_turns,
    number,
    profiled,
    rate,
)

from ecatspec.conformance.diff.behaviour import product
from ecatspec.conformance.diff.machines import BOTH, Explored, ObservedDevice, explored, setups
from ecatspec.model.automata.mealy import alike, distinguishing_word
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.automata.mealy import Mealy

PAIR: Final = ("kollmorgen-akd", "kollmorgen-s300")
TARGET: Final = Target(Of.RATIO, 10.0, least=True)
SOUGHT: Final = 10
"""Words that `compare_automata` looks for if nothing else is said."""


def with_one_wrong(machine: Mealy) -> Mealy:
    """Give the machine with another output at its last transition."""
    wrong = list(machine.out)
    wrong[-1] = (wrong[-1] + 1) % len(machine.outputs)
    return replace(machine, out=tuple(wrong))


def machines(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Compare a machine with one that has a wrong output, and with its equal."""
    from aalpy.utils.ModelChecking import bisimilar  # noqa: PLC0415

    found = []
    rounds = effort.of(7, 3, 1)
    for row in rows:
        _, name, way = row.name.split(":")
        machine = machine_of(effort.of(name, name, "esm"))
        other = with_one_wrong(machine) if way == "differing" else replace(machine)
        theirs = of_aalpy(machine), of_aalpy(other)
        ours, rival = in_turns(
            rounds,
            partial(distinguishing_word, machine, other),
            partial(bisimilar, *theirs, return_cex=True),
        )
        word = distinguishing_word(machine, other)
        length = 0 if word is None else len(word)
        assert length == len(bisimilar(*theirs, return_cex=True) or ()), "they do not agree"
        size = f"{len(machine.states)} states, {len(machine.inputs)} inputs"
        said = f"the shortest word has {length} inputs" if word else "they are equal"
        note = f"{size}; {said}, and both say so"
        found.append(row.found(rate(1, ours), rate(1, rival), note))
    return Found(tuple(found))


def pair(first: str, second: str) -> tuple[Explored, Explored] | None:
    """Give AL x DS402 of two devices with their common inputs; None: one of them is no drive."""
    devices = [ObservedDevice(load_device(name)) for name in (first, second)]
    plans = [setups(device.model).get(BOTH) for device in devices]
    if plans[0] is None or plans[1] is None:
        return None
    inputs = [name for name in plans[0].alphabet if name in plans[1].alphabet]
    return explored(devices[0], plans[0], inputs, {}), explored(devices[1], plans[1], inputs, {})


def products(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Search the product of two devices for all that differs."""
    from aalpy.utils.ModelChecking import compare_automata  # noqa: PLC0415

    both = pair(*PAIR)
    assert both is not None
    left = both[0].machine
    theirs = of_aalpy(left), of_aalpy(alike(left, both[1].machine))
    ours, rival = in_turns(
        effort.of(7, 3, 1), partial(product, *both), partial(compare_automata, *theirs, SOUGHT)
    )
    searched = product(*both)
    words = compare_automata(*theirs, SOUGHT)
    note = (
        f"{' and '.join(PAIR)}: {searched.pairs} pairs of states, {len(searched.met)} transitions "
    )
    note += f"differ, each with its shortest word; the rival found {len(words)} words at random"
    return Found((rows[0].found(rate(1, ours), rate(1, rival), note),))


def told(first: str, second: str) -> dict[str, list[object]]:
    """Run the command once and give its JSON."""
    command = (*COMMAND, "diff", first, second, "--json")
    done = subprocess.run(command, capture_output=True, check=False)
    found: dict[str, list[object]] = json.loads(done.stdout)
    return found


def _into(data: dict[str, list[object]], first: str, second: str) -> None:
    data.update(told(first, second))


def pairs(effort: Effort) -> Iterator[tuple[str, str]]:
    names = [name for name in device_names() if load_device(name).manuals]
    every = list(combinations(names, 2))
    return iter(every[: effort.of(len(every), 2, 1)])


def commands(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Run `ecatspec diff` on all pairs of devices that have a manual."""
    shown, slowest = [], 0.0
    for first, second in pairs(effort):
        data: dict[str, list[object]] = {}
        work = partial(_into, data, first, second)
        (times,) = in_turns(effort.of(3, 1, 1), work, warm=False)
        figure = Figure.of(times)
        slowest = max(slowest, figure.median)
        counts = (str(len(data["facts"])), str(len(data["answers"])))
        shown.append((first, second, str(figure), *counts))
    heads = ("A", "B", "seconds", "facts", "answers that differ")
    table = Table("`ecatspec diff A B`, start-up included", heads, tuple(shown))
    note = f"the slowest of {len(shown)} pairs of devices, {number(slowest)} s; start-up included"
    return Found((rows[0].found(Figure.single(slowest), note=note),), (table,))


def profile(name: str, way: str, effort: Effort) -> Profile:
    machine = machine_of(effort.of(name, name, "esm"))
    other = with_one_wrong(machine) if way == "differing" else replace(machine)
    return profiled(lambda: [distinguishing_word(machine, other) for _ in range(20)])


def profile_product(_: Effort) -> Profile:
    both = pair(*PAIR)
    assert both is not None
    return profiled(lambda: [product(*both) for _ in range(20)])


def profile_command(_: Effort) -> Profile:
    both = [ObservedDevice(load_device(name)) for name in PAIR]
    plans = [setups(device.model)[BOTH] for device in both]
    inputs = [name for name in plans[0].alphabet if name in plans[1].alphabet]
    return profiled(
        lambda: [explored(d, plan, inputs, {}) for d, plan in zip(both, plans, strict=True)],
        "cProfile, walking AL x DS402 of both devices",
    )


SIZES: Final = (("comp1", "differing"), ("comp1", "equal"), ("comp7", "differing"))

PARTS: Final = (
    Part(
        tuple(
            Row(
                f"compare:{name}:{way}",
                f"comparison of two machines, {name}, {way}",
                "a second",
                "AALpy `bisimilar`, with its counterexample",
                TARGET,
                "Both look at each pair of states and each input once, in Python; ours has flat "
                "tables, the rival dictionaries and a queue with locks.",
            )
            for name, way in SIZES
        ),
        machines,
        {f"compare:{n}:{w}": partial(profile, n, w) for n, w in SIZES},
    ),
    Part(
        (
            Row(
                "compare:devices",
                "product search of AL x DS402 of two devices, all differences",
                "a second",
                "AALpy `compare_automata`, up to 10 words",
                TARGET,
            ),
        ),
        products,
        {"compare:devices": profile_product},
    ),
    Part(
        (
            Row(
                "diff-command",
                "`ecatspec diff A B`, the slowest pair",
                "s",
                target=Target(Of.FIGURE, 2.0),
                why="The first start walks both devices; later ones find the tables again.",
            ),
        ),
        commands,
        {"diff-command": profile_command},
    ),
)
