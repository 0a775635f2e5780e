"""Measures suites of finite machines: ours beside AALpy's, in one run.

Machines are those of the folder of evidence and those made of device texts. Seconds are those of
the processor, the best of the rounds. FSMlib is a C++ program that is not run here: its figures
were measured once, and stand here.
"""

from __future__ import annotations

import gc
import time
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

from measure import (
    Absent,
    Effort,
    Figure,
    Found,
    Of,
    Part,
    Profile,
    Row,
    Table,
    Target,
    number,
    profiled,
    shared,
)

from ecatspec.generators.complete.certificate import certify
from ecatspec.generators.complete.chain import chain_suite
from ecatspec.generators.complete.faults import kills
from ecatspec.generators.complete.machines import al_machine, drive_machine
from ecatspec.generators.complete.suites import Checked, Suite, hsi_suite, w_suite
from ecatspec.model.automata.mealy import Mealy, distinguishing_word, minimise, read_machine
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

FILES: Final = ("esm", "cia402_64", "comp1", "r1000_64", "comp7")
SMALL: Final = ("esm", "cia402_64")
"""Those for `--quick`."""
DEVICE: Final = "kollmorgen-akd"
ENOUGH: Final = 100_000_000
"""Steps of a certificate: none of a device needs a tenth of it."""
SLOW_FOR_AALPY: Final = {"comp7"}
"""Machines that AALpy works on for minutes."""
FSMLIB: Final = {"esm": (56, 825), "cia402_64": (492, 5_900), "comp1": (2_037, 160_000)}
"""Tests and symbols of FSMlib S, by machine."""
METHODS: Final = ("A-HSI", "CHAIN", "W", "AALpy W", "AALpy Wp", "A-HSI k=1", "CHAIN k=1")

Measured = dict[str, Any]
"""What is known of a machine, by method: tests, symbols and seconds."""


def best(work: Callable[[], object], rounds: int) -> tuple[float, Any]:
    """Give the least seconds of processor time, and what the last round gave."""
    times = []
    for _ in range(rounds):
        gc.collect()  # what others left behind is not ours
        began = time.process_time()
        found = work()
        times.append(time.process_time() - began)
    return min(times), found


def machine_of(name: str) -> Mealy:
    """Read a machine of the folder of evidence; raise Absent where it is not there."""
    return read_machine(shared("bench", f"{name}.txt").read_text("utf-8"))


def machines(effort: Effort) -> Iterator[tuple[str, Mealy]]:
    for name in effort.of(FILES, SMALL, ("esm",)):
        try:
            yield name, machine_of(name)
        except Absent:
            continue  # its rows say so
    if effort is Effort.TINY:
        return
    model = Model(load_device(DEVICE))
    yield f"AL of {DEVICE}", al_machine(model).machine
    drive = drive_machine(model)
    if drive is not None:
        yield f"DS402 of {DEVICE}", drive.machine


def of_aalpy(machine: Mealy) -> Any:  # noqa: ANN401  the package has no types
    """Give the machine as one of AALpy's."""
    if not find_spec("aalpy"):
        raise Absent("aalpy is not installed")
    from aalpy.automata import MealyMachine, MealyState  # noqa: PLC0415

    states = [MealyState(str(number)) for number in range(len(machine.states))]
    width = len(machine.inputs)
    for place, (target, output) in enumerate(zip(machine.next, machine.out, strict=True)):
        states[place // width].transitions[place % width] = states[target]
        states[place // width].output_fun[place % width] = output
    return MealyMachine(states[machine.initial], states)


def aalpy_w(machine: Mealy) -> tuple[int, int]:
    """Give tests and symbols of the suite of AALpy's W method, made as its oracle makes it."""
    automaton = of_aalpy(machine)
    from aalpy.oracles import WMethodEqOracle  # noqa: PLC0415

    automaton.compute_prefixes()
    alphabet = list(range(len(machine.inputs)))
    oracle = WMethodEqOracle(alphabet, None, len(machine.states))
    cover = [(*state.prefix, letter) for state in automaton.states for letter in alphabet]
    words = automaton.compute_characterization_set()
    tests = set(oracle.test_suite(cover, 1, words))
    return len(tests), sum(map(len, tests))


def aalpy_wp(machine: Mealy) -> tuple[int, int]:
    """Give tests and symbols of the suite of AALpy's Wp method, made as its oracle makes it."""
    automaton = of_aalpy(machine)
    from aalpy.oracles.WpMethodEqOracle import first_phase_it, second_phase_it  # noqa: PLC0415

    automaton.compute_prefixes()
    alphabet = list(range(len(machine.inputs)))
    words = automaton.compute_characterization_set()
    reached = {state.prefix for state in automaton.states}
    cover = {(*state.prefix, letter) for state in automaton.states for letter in alphabet}
    first = first_phase_it(alphabet, reached, 1, words)
    tests = set(chain(first, second_phase_it(automaton, alphabet, cover - reached, 1)))
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


def measured_one(name: str, machine: Mealy, effort: Effort) -> Measured:
    """Measure all methods on one machine."""
    rounds = effort.of(3, 1, 1)
    data: Measured = {"states": len(machine.states), "inputs": len(machine.inputs)}

    def note(what: str, work: Callable[[], tuple[int, int]], rounds: int = rounds) -> None:
        took, (tests, symbols) = best(work, rounds)
        data[what] = {"tests": tests, "symbols": symbols, "seconds": took}

    big = len(machine.next) > 10_000
    note("A-HSI", partial(of_suite, machine, hsi_suite))
    note("CHAIN", partial(of_suite, machine, chain_suite))
    if name not in SLOW_FOR_AALPY:
        note("W", partial(of_suite, machine, w_suite), 1)
        if find_spec("aalpy"):
            note("AALpy W", partial(aalpy_w, machine), 1)
            note("AALpy Wp", partial(aalpy_wp, machine), 1)
    if not big:
        note("A-HSI k=1", partial(planned, machine, 1))
        note("CHAIN k=1", partial(of_suite, machine, partial(chain_suite, k=1)))
    wrong = list(machine.out)
    wrong[-1] = (wrong[-1] + 1) % len(machine.outputs)
    other = replace(machine, out=tuple(wrong))
    data["compare"] = best(partial(distinguishing_word, machine, other), rounds)[0]
    data["minimise"] = best(partial(minimise, machine), rounds)[0]
    if len(machine.states) < 1000:
        suites = {"A-HSI": hsi_suite(machine), "CHAIN": chain_suite(machine)}
        took, found = best(partial(kills, machine, suites["A-HSI"].trie()), 1)
        chained = kills(machine, suites["CHAIN"].trie())
        data["mutants"] = {"a second": found.faults / took}
        data["mutants"] |= {"A-HSI": found.score, "CHAIN": chained.score}
        for what, suite in suites.items():
            took, known = best(partial(certify, machine, suite), 1)
            data[f"certificate {what}"] = {"seconds": took, "checked": known.checked.value}
    return data


def proofs(effort: Effort) -> tuple[Table, dict[int, float | None]]:
    """Prove the suites of all devices; give by k the slowest certificate where all are exact."""
    rows = []
    slowest: dict[int, float | None] = {0: 0.0, 1: 0.0}
    for device in effort.of(device_names(), ("reference-drive",), ("reference-drive",)):
        model = Model(load_device(device))
        for found in filter(None, (al_machine(model), drive_machine(model))):
            machine = found.machine
            size = f"{len(machine.states)} x {len(machine.inputs)}"
            for k in effort.of((0, 1), (0, 1), (0,)):
                for suite in (hsi_suite(machine, k), chain_suite(machine, k=k)):
                    took, known = best(partial(certify, machine, suite, ENOUGH), 1)
                    sizes = f"{suite.tests:,} / {suite.symbols:,}"
                    checked = f"{known.checked}, {took:.2f} s"
                    rows.append(
                        (device, found.name, size, str(k), suite.method.value, sizes, checked)
                    )
                    sofar = slowest[k]
                    exact = known.checked == Checked.EXACT and sofar is not None
                    slowest[k] = max(sofar or 0, took) if exact else None
    heads = (
        "device",
        "machine",
        "states x inputs",
        "k",
        "method",
        "tests / symbols",
        "certificate",
    )
    return Table("What is proved of the suites of devices", heads, tuple(rows)), slowest


def measure(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Measure all machines and fill the rows from what was found."""
    every = {name: measured_one(name, machine, effort) for name, machine in machines(effort)}
    table, slowest = proofs(effort)
    filled = tuple(_filled(row, every, slowest) for row in rows)
    return Found(filled, (_sizes(every), _times(every), table))


def _filled(row: Row, every: dict[str, Measured], slowest: dict[int, float | None]) -> Row:
    """Give a row its figures: its name says machine, method, what, and the method beside it."""
    _, machine, method, what, *beside = row.name.split(":")
    if machine == "devices":
        took = slowest[int(method)]
        if not took:
            return replace(row, note="not measured: a certificate is not exact, or not asked for")
        return row.found(Figure.single(took), note="of all devices the slowest")
    if machine not in every:
        return replace(
            row, note=f"not measured: the machine {machine} is not there, or is left out here"
        )
    found: Any = every[machine].get(method)
    value = found.get(what) if isinstance(found, dict) else found
    if value is None:
        return replace(row, note=f"not measured: {method} on {machine}")
    rival: float | None = None
    note = ""
    match beside:
        case ["FSMlib S"]:
            rival = FSMLIB[machine][("tests", "symbols").index(what)]
            note = "the rival is not run here: a figure that was measured once"
        case [other]:
            if other not in every[machine]:
                return replace(row, note="not measured: aalpy is not installed")
            rival = every[machine][other][what]
            took, theirs = found["seconds"], every[machine][other]["seconds"]
            note = f"both complete for as many states; made in {number(took * 1000)} ms, "
            note += f"the rival's in {number(theirs * 1000)} ms"
    return row.found(Figure.single(value), None if rival is None else Figure.single(rival), note)


def _sizes(every: dict[str, Measured]) -> Table:
    def cell(data: Measured, method: str) -> str:
        found = data.get(method)
        return "" if found is None else f"{found['tests']:,} / {found['symbols']:,}"

    return Table(
        "Suites: tests / symbols",
        ("machine", *METHODS),
        tuple(
            (f"{name}, {data['states']} x {data['inputs']}", *(cell(data, m) for m in METHODS))
            for name, data in every.items()
        ),
        "k = 1 is complete for one state more. The price of a reset is 5 symbols.",
    )


def _times(every: dict[str, Measured]) -> Table:
    columns = (*METHODS, "compare", "minimise", "certificate A-HSI", "certificate CHAIN")

    def cell(data: Measured, column: str) -> str:
        found = data.get(column)
        took = found["seconds"] if isinstance(found, dict) else found
        said = "" if took is None else f"{took * 1000:,.3g}"
        return (
            f"{said} {found['checked']}" if isinstance(found, dict) and "checked" in found else said
        )

    return Table(
        "Suites: milliseconds of processor time",
        ("machine", *columns, "mutants a second", "killed by A-HSI, CHAIN"),
        tuple(
            (
                name,
                *(cell(data, column) for column in columns),
                *(
                    (
                        f"{data['mutants']['a second']:,.0f}",
                        f"{data['mutants']['A-HSI']:.2%}, {data['mutants']['CHAIN']:.2%}",
                    )
                    if "mutants" in data
                    else ("", "")
                ),
            )
            for name, data in every.items()
        ),
        "A-HSI for k = 1 is planned, not written out. Ours include the tree of the words.",
    )


def profile(name: str, make: Callable[[Mealy], Suite], effort: Effort) -> Profile:
    machine = machine_of(effort.of(name, name, "esm"))
    return profiled(partial(of_suite, machine, make))


def _certified(effort: Effort) -> Profile:
    model = Model(load_device(effort.of("beckhoff-el6720", "reference-drive", "reference-drive")))
    machine = al_machine(model).machine
    suite = chain_suite(machine, k=effort.of(1, 1, 0))
    return profiled(partial(certify, machine, suite, ENOUGH))


def _against(machine: str, other: str, limit: float | None) -> Row:
    return Row(
        f"suites:{machine}:CHAIN:tests:{other}",
        f"complete suite of {machine}, CHAIN",
        "tests",
        other,
        None if limit is None else Target(Of.INVERSE, limit, least=True),
    )


def _beside_fsmlib(machine: str, what: str) -> Row:
    tests, symbols = FSMLIB[machine]
    limit = tests if what == "tests" else 1.05 * symbols
    return Row(
        f"suites:{machine}:CHAIN:{what}:FSMlib S",
        f"complete suite of {machine}, CHAIN, {what}",
        what,
        "FSMlib S",
        Target(Of.FIGURE, limit),
    )


def _within(machine: str, method: str, limit: float, why: str = "") -> Row:
    what = f"{method} suite of {machine}"
    target = Target(Of.FIGURE, limit)
    return Row(f"suites:{machine}:{method}:seconds", what, "s", target=target, why=why)


PARTS: Final = (
    Part(
        (
            _against("esm", "AALpy W", 10),
            _against("cia402_64", "AALpy W", 6),
            _against("comp1", "AALpy W", 40),
            _against("esm", "AALpy Wp", None),
            _against("cia402_64", "AALpy Wp", None),
            _against("comp1", "AALpy Wp", None),
            *(_beside_fsmlib(name, what) for name in FSMLIB for what in ("tests", "symbols")),
            Row(
                "suites:esm:CHAIN k=1:tests",
                "complete suite of esm, CHAIN, k = 1",
                "tests",
                "FSMlib S: 1,645",
                Target(Of.FIGURE, 1645),
            ),
            _within("esm", "CHAIN k=1", 0.7),
            _within("comp1", "A-HSI", 0.05),
            _within("comp7", "A-HSI", 0.3),
            _within(
                "comp7",
                "CHAIN",
                2.0,
                "After each word it looks which transition lets most tests go on; on 114,176 "
                "transitions that choice is most of the time.",
            ),
            *(
                Row(
                    f"suites:devices:{k}:seconds",
                    f"exact certificate of a suite, k = {k}",
                    "s",
                    target=Target(Of.FIGURE, limit),
                )
                for k, limit in ((0, 1.0), (1, 60.0))
            ),
            *(
                Row(
                    f"suites:{name}:mutants:a second",
                    f"mutants of {name} judged",
                    "a second",
                    target=Target(Of.FIGURE, 1e6, least=True),
                )
                for name in ("esm", "comp1")
            ),
            *(
                Row(
                    f"suites:{name}:{what}:seconds",
                    f"{what} {name}",
                    "s",
                    target=Target(Of.FIGURE, limit),
                )
                for name, what, limit in (
                    ("comp1", "compare", 0.002),
                    ("comp7", "compare", 0.015),
                    ("comp1", "minimise", 0.003),
                )
            ),
        ),
        measure,
        {
            "suites:comp7:CHAIN:seconds": partial(profile, "comp7", chain_suite),
            "suites:comp1:A-HSI:seconds": partial(profile, "comp1", hsi_suite),
            "suites:comp7:A-HSI:seconds": partial(profile, "comp7", hsi_suite),
            "suites:devices:1:seconds": _certified,
        },
    ),
)
