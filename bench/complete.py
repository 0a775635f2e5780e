"""The only place that measures suites of finite machines: ours beside AALpy's, in one run.

    python bench/complete.py [--json] [--quick]

Machines are those of the folder of evidence (`../shared/bench`, or below ECATSPEC_SHARED) and those
made of device texts. A figure is the best of the rounds. What is not installed is absent; nothing
here passes or fails. The second table has what is proved of the suites of all devices, the last one
says which targets were reached.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import random
import sys
import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console
from rich.table import Table

from ecatspec.generators.complete.certificate import certify
from ecatspec.generators.complete.chain import chain_suite
from ecatspec.generators.complete.faults import kills
from ecatspec.generators.complete.machines import al_machine, drive_machine
from ecatspec.generators.complete.suites import Checked, Suite, hsi_suite, w_suite
from ecatspec.model.compiled import Model
from ecatspec.model.mealy import Mealy, distinguishing_word, minimise, read_machine
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

ROOT: Final = Path(__file__).resolve().parent.parent
FILES: Final = ("esm", "cia402_64", "comp1", "r1000_64", "comp7")
DEVICE: Final = "kollmorgen-akd"
ENOUGH: Final = 100_000_000
"""Steps of a certificate: none of a device needs a tenth of it."""
SLOW_FOR_AALPY: Final = {"comp7"}
"""Machines that AALpy works on for minutes."""
ROUNDS: Final = 3
_PIPE_WIDTH: Final = 130

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Proof:
    """What is known of a suite of a device; seconds of processor time for the certificate."""

    device: str
    machine: str
    states: int
    inputs: int
    method: str
    tests: int
    symbols: int
    k: int
    certificate: str
    seconds: float


@dataclass(frozen=True, slots=True)
class Target:
    """A figure to reach, and what was measured; `reached` is None where there was nothing."""

    what: str
    wanted: str
    measured: str
    reached: bool | None


def best(work: Callable[[], object], rounds: int) -> tuple[float, object]:
    """Give the least seconds of processor time, and what the last round gave."""
    times = []
    for _ in range(rounds):
        gc.collect()  # what others left behind is not ours
        began = time.process_time()
        found = work()
        times.append(time.process_time() - began)
    return min(times), found


def machines() -> Iterator[tuple[str, Mealy]]:
    named = os.environ.get("ECATSPEC_SHARED")
    folder = (Path(named) if named else ROOT.parent / "shared") / "bench"
    for name in FILES:
        path = folder / f"{name}.txt"
        if path.is_file():
            yield name, read_machine(path.read_text("utf-8"))
    model = Model(load_device(DEVICE))
    yield f"AL of {DEVICE}", al_machine(model).machine
    drive = drive_machine(model)
    if drive is not None:
        yield f"DS402 of {DEVICE}", drive.machine


def proofs(*, quick: bool) -> Iterator[Proof]:
    """Prove the suites of all devices, k = 0 and k = 1; of one device where it must be quick."""
    for device in ("reference-drive",) if quick else device_names():
        model = Model(load_device(device))
        for found in (al_machine(model), drive_machine(model)):
            if found is None:
                continue
            machine = found.machine
            for k in (0, 1):
                for suite in (hsi_suite(machine, k), chain_suite(machine, k=k)):
                    seconds, known = best(partial(certify, machine, suite, ENOUGH), 1)
                    yield Proof(
                        device,
                        found.name,
                        len(machine.states),
                        len(machine.inputs),
                        suite.method,
                        suite.tests,
                        suite.symbols,
                        k,
                        known.checked,  # type: ignore[attr-defined]
                        seconds,
                    )


def of_aalpy(machine: Mealy) -> tuple[int, int]:
    """Give tests and symbols of the suite of AALpy's W method, made as its oracle makes it."""
    from aalpy.automata import MealyMachine, MealyState  # noqa: PLC0415
    from aalpy.oracles import WMethodEqOracle  # noqa: PLC0415

    states = [MealyState(str(number)) for number in range(len(machine.states))]
    width = len(machine.inputs)
    for place, (target, output) in enumerate(zip(machine.next, machine.out, strict=True)):
        states[place // width].transitions[place % width] = states[target]
        states[place // width].output_fun[place % width] = output
    automaton = MealyMachine(states[machine.initial], states)
    automaton.compute_prefixes()
    automaton.characterization_set = automaton.compute_characterization_set()
    alphabet = list(range(width))
    oracle = WMethodEqOracle(alphabet, None, len(states))
    cover = [(*state.prefix, letter) for state in automaton.states for letter in alphabet]
    tests = set(oracle.test_suite(cover, 1, automaton.characterization_set))
    return len(tests), sum(map(len, tests))


def of_suite(machine: Mealy, make: Callable[[Mealy], Suite]) -> tuple[int, int]:
    """Give tests and symbols of a suite of ours, with the tree of its words in memory."""
    suite = make(machine)
    assert len(suite.trie()) > 1
    return suite.tests, suite.symbols


def planned(machine: Mealy, k: int) -> tuple[int, int]:
    """Give tests and symbols of a suite of ours, planned and not written out."""
    suite = hsi_suite(machine, k)
    return suite.tests, suite.symbols


def measure(name: str, machine: Mealy, rounds: int, *, quick: bool) -> Row:
    row: Row = {"machine": name, "states": len(machine.states), "inputs": len(machine.inputs)}

    def note(what: str, work: Callable[[], tuple[int, int]], rounds: int = rounds) -> None:
        seconds, found = best(work, rounds)
        row[what] = {"tests": found[0], "symbols": found[1], "seconds": seconds}  # type: ignore[index]

    big = len(machine.next) > 10_000
    note("A-HSI", partial(of_suite, machine, hsi_suite))
    note("CHAIN", partial(of_suite, machine, chain_suite))
    if name not in SLOW_FOR_AALPY:
        note("W", partial(of_suite, machine, w_suite), 1)
        if find_spec("aalpy") and not (quick and big):
            note("AALpy W", partial(of_aalpy, machine), 1)
    if not big:
        note("A-HSI k=1", partial(planned, machine, 1))
        note("CHAIN k=1", partial(of_suite, machine, partial(chain_suite, k=1)))
    wrong = list(machine.out)
    wrong[-1] = (wrong[-1] + 1) % len(machine.outputs)
    other = replace(machine, out=tuple(wrong))
    row["compare"] = best(lambda: distinguishing_word(machine, other), rounds)[0]
    row["minimise"] = best(lambda: minimise(machine), rounds)[0]
    if len(machine.states) < 1000 and not (quick and big):
        suites = {"A-HSI": hsi_suite(machine), "CHAIN": chain_suite(machine)}
        seconds, found = best(partial(kills, machine, suites["A-HSI"].trie()), 1)
        row["mutants"] = {
            "per_second": found.faults / seconds,  # type: ignore[attr-defined]
            "A-HSI": found.score,  # type: ignore[attr-defined]
            "CHAIN": kills(machine, suites["CHAIN"].trie()).score,
        }
        for what, suite in suites.items():
            seconds, known = best(partial(certify, machine, suite), 1)
            row[f"certificate {what}"] = {"seconds": seconds, "checked": known.checked.value}  # type: ignore[attr-defined]
    return row


def walk(machine: Mealy) -> float:
    """Give the steps a second of a seeded walk over the tables."""
    draw = random.Random(1)
    next_, width = machine.next, len(machine.inputs)
    symbols = draw.choices(range(width), k=200_000)

    def steps() -> None:
        state = machine.initial
        for symbol in symbols:
            state = next_[state * width + symbol]

    return len(symbols) / best(steps, ROUNDS)[0]


def targets(rows: dict[str, Row], proved: list[Proof], steps: float) -> list[Target]:
    """Compare with the figures that were set."""
    found: list[Target] = []

    def add(what: str, wanted: float, measured: float | None, *, least: bool, unit: str) -> None:
        reached = None if measured is None else measured >= wanted if least else measured <= wanted
        sign = ">=" if least else "<="
        shown = "absent" if measured is None else f"{measured:,.3g} {unit}"
        found.append(Target(what, f"{sign} {wanted:,.3g} {unit}", shown, reached))

    def get(machine: str, *keys: str) -> float | None:
        value: Any = rows.get(machine)
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return value if isinstance(value, (int, float)) else None

    for machine, wanted in (("esm", 10), ("comp1", 40), ("cia402_64", 6)):
        ours, theirs = get(machine, "CHAIN", "tests"), get(machine, "AALpy W", "tests")
        ratio = theirs / ours if ours and theirs else None
        add(f"AALpy W against CHAIN, tests, {machine}", wanted, ratio, least=True, unit="times")
    for machine, tests, symbols in (
        ("esm", 56, 825),
        ("cia402_64", 492, 5_900),
        ("comp1", 2_037, 160_000),
    ):
        what = f"CHAIN against FSMlib S, {machine}"
        add(f"{what}, tests", tests, get(machine, "CHAIN", "tests"), least=False, unit="")
        limit = 1.05 * symbols
        add(f"{what}, symbols", limit, get(machine, "CHAIN", "symbols"), least=False, unit="")
    chained, took = (get("esm", "CHAIN k=1", key) for key in ("tests", "seconds"))
    add("CHAIN against FSMlib S, k = 1, esm, tests", 1_645, chained, least=False, unit="")
    add("CHAIN, k = 1, esm", 0.7, took, least=False, unit="s")
    for machine, method, wanted_s in (
        ("comp1", "A-HSI", 0.05),
        ("comp7", "A-HSI", 0.3),
        ("comp7", "CHAIN", 2.0),
    ):
        seconds = get(machine, method, "seconds")
        add(f"{method}, {machine}", wanted_s, seconds, least=False, unit="s")
    for machine, limit in (("comp1", 0.002), ("comp7", 0.015)):
        add(f"compare, {machine}", limit, get(machine, "compare"), least=False, unit="s")
    add("minimise, comp1", 0.003, get("comp1", "minimise"), least=False, unit="s")
    for k, limit in ((0, 1), (1, 60)):
        known = [
            each.seconds for each in proved if each.k == k and each.certificate == Checked.EXACT
        ]
        all_known = len(known) == sum(each.k == k for each in proved)
        slowest = max(known) if known and all_known else None
        what = f"exact certificates, k = {k}, all devices, the slowest"
        add(what, limit, slowest, least=False, unit="s")
    for machine in ("esm", "comp1"):
        rate = get(machine, "mutants", "per_second")
        add(f"mutants, {machine}", 1e6, rate, least=True, unit="a second")
    # 5,000 to 10,000 rule steps a second are what Hypothesis makes
    add("seeded walk against Hypothesis", 300, steps / 10_000, least=True, unit="times")
    return found


def figure(row: Row, key: str) -> str:
    value = row.get(key)
    if value is None:
        return "absent"
    return f"{value['tests']:,} / {value['symbols']:,}\n{value['seconds'] * 1e3:,.1f} ms"


def show(rows: list[Row], proved: list[Proof], reached: list[Target]) -> None:
    console = Console()
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    methods = ("A-HSI", "CHAIN", "W", "AALpy W", "A-HSI k=1", "CHAIN k=1")
    table = Table(
        title="tests / symbols, and the time to make them",
        caption=f"Python {platform.python_version()}, {os.cpu_count()} cores",
        show_lines=True,
    )
    table.add_column("machine")
    for method in methods:
        table.add_column(method, justify="right")
    table.add_column("compare, minimise", justify="right")
    for row in rows:
        times = f"{row['compare'] * 1e3:.2f} ms\n{row['minimise'] * 1e3:.2f} ms"
        head = f"{row['machine']}\n{row['states']} x {row['inputs']}"
        table.add_row(head, *(figure(row, method) for method in methods), times)
    console.print(table)
    table = Table(title="what is proved of the suites of devices")
    table.add_column("device")
    for column in ("machine", "states x inputs", "method", "tests / symbols", "k", "certificate"):
        table.add_column(column)
    table.add_column("seconds", justify="right")
    for proof in proved:
        table.add_row(
            proof.device,
            proof.machine,
            f"{proof.states} x {proof.inputs}",
            proof.method,
            f"{proof.tests:,} / {proof.symbols:,}",
            str(proof.k),
            proof.certificate,
            f"{proof.seconds:.2f}",
        )
    console.print(table)
    table = Table(title="targets")
    for column in ("what", "wanted", "measured", "reached"):
        table.add_column(column)
    for each in reached:
        said = "-" if each.reached is None else "yes" if each.reached else "no"
        table.add_row(each.what, each.wanted, each.measured, said)
    console.print(table)


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure complete suites beside AALpy's.")
    parser.add_argument("--json", action="store_true", help="give the figures as JSON")
    parser.add_argument("--quick", action="store_true", help="one round, small machines only")
    arguments = parser.parse_args()
    rounds = 1 if arguments.quick else ROUNDS
    found = [
        measure(name, machine, rounds, quick=arguments.quick)
        for name, machine in machines()
        if not arguments.quick or len(machine.next) < 20_000
    ]
    rows = {row["machine"]: row for row in found}
    steps = walk(next(machine for _, machine in machines()))
    proved = list(proofs(quick=arguments.quick))
    reached = targets(rows, proved, steps)
    if arguments.json:
        shown = {"proofs": [asdict(p) for p in proved], "targets": [asdict(t) for t in reached]}
        print(json.dumps({"rows": found, **shown}, indent=2))
    else:
        show(found, proved, reached)
    return 0


if __name__ == "__main__":
    sys.exit(main())
