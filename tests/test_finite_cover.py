"""Tests of complete suites as cases: what they name, promise, and find."""

from __future__ import annotations

from functools import cache
from itertools import islice
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import Runner, run_device
from ecatspec.generators.cases.case import NO_LIMITS, Limits
from ecatspec.generators.cases.case_codec import case_of
from ecatspec.generators.complete.finite_cover import complete_suites
from ecatspec.generators.complete.machines import ALL_EVENTS
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from ecatspec.generators.complete.finite_cover import Complete

DRIVE = "reference-drive"
SMALL = "reference"
FAULT = "preop_to_op_taken"
"""A mistake of the AL state machine that any device can have."""


@cache
def model_of(device: str) -> Model:
    return Model(load_device(device))


@cache
def suites(device: str, depth: str, most: int = 2) -> tuple[Complete, ...]:
    """Give the first suites of a device."""
    found = complete_suites(model_of(device), NO_LIMITS, ALL_EVENTS, {}, depth)
    return tuple(islice(found, most))


def runner_of(device: str, fault: str = "") -> Runner:
    adapter = make(device, {"fault": fault} if fault else {})
    return Runner(Model(load_device(device)), adapter, adapter.describe())


def test_a_quick_run_has_no_complete_suites() -> None:
    assert suites(DRIVE, "quick") == ()


def test_what_is_suited_by_depth() -> None:
    assert [(s.layer, s.found.name, s.suite.k) for s in suites(DRIVE, "default")] == [
        ("al", "AL", 0),
        ("ds402", "DS402", 0),
    ]
    assert [(s.layer, s.found.name, s.suite.k) for s in suites(DRIVE, "exhaustive")] == [
        ("ds402", "DS402", 1),
        ("ds402", "AL x DS402", 1),
    ]
    assert [(s.layer, s.found.name, s.suite.k) for s in suites(SMALL, "exhaustive")] == [
        ("sdo", "SDO", 1),
        ("al", "AL", 1),
    ]


def test_names_are_unique_and_say_the_machine() -> None:
    every = [
        s
        for d in ((DRIVE, "default"), (DRIVE, "exhaustive"), (SMALL, "exhaustive"))
        for s in suites(*d)
    ]
    names = [case.name for suite in every for case in suite.cases()]
    assert len(names) == len(set(names)) == sum(suite.suite.tests for suite in every)
    assert {name.rpartition("/")[0] for name in names} == {
        "al/complete/AL_k0",
        "ds402/complete/DS402_k0",
        "ds402/complete/DS402_k1",
        "ds402/complete/AL_x_DS402_k1",
        "sdo/complete/SDO_k1",
        "al/complete/AL_k1",
    }
    assert all(" " not in name for name in names)


@pytest.mark.parametrize(
    ("device", "number", "needs"), [(DRIVE, 0, "OP"), (DRIVE, 1, "OP"), (SMALL, 0, "PREOP")]
)
def test_a_case_begins_with_the_way_to_its_machine(device: str, number: int, needs: str) -> None:
    suite = suites(device, "exhaustive")[number]
    word = next(suite.suite.words())
    case = next(suite.cases())
    assert (case.layer, case.needs) == (suite.layer, needs)
    assert case.stimuli[: case.prelude] == suite.found.prelude
    assert case.prelude > 0
    assert case.stimuli == suite.found.stimuli_of(word)
    assert case.title == f"{suite.found.name}, test 1 of {suite.suite.tests}"


def test_the_al_machine_begins_at_power_on() -> None:
    case = next(suites(SMALL, "default")[0].cases())
    assert (case.needs, case.prelude) == (None, 0)


def test_a_guarantee_is_one_line_with_method_and_proof() -> None:
    (suite,) = suites(SMALL, "default")
    tests, symbols = suite.suite.trie().size()
    assert suite.guarantee() == (
        f"AL, 30 states, 15 inputs: CHAIN, m = 30, k = 0: {tests} tests, {symbols} symbols; "
        "checked: exact"
    )


def test_what_cannot_raise_local_the_device_is_no_input() -> None:
    every = {name.partition(".")[2] for name in ALL_EVENTS}
    found = complete_suites(model_of(DRIVE), NO_LIMITS, {"ds402.fault"}, {}, "exhaustive")
    drive, both = islice(found, 2)
    assert set(drive.found.machine.inputs) & every == {"fault"}
    assert set(suites(DRIVE, "exhaustive")[0].found.machine.inputs) & every == every
    (quiet,) = islice(complete_suites(model_of(DRIVE), NO_LIMITS, (), {}, "exhaustive"), 1, 2)
    assert "fault" in both.found.machine.inputs
    assert "fault" not in quiet.found.machine.inputs


def test_what_cannot_be_carried_is_left_out() -> None:
    limits = Limits(without=frozenset({"malformed"}))
    found = complete_suites(model_of(SMALL), limits, (), {}, "exhaustive")
    assert next(found).found.name == "AL"


def test_a_suite_is_of_the_device_that_goes_as_it_says() -> None:
    choices = {"refused_in_op": "stay"}
    found = next(complete_suites(model_of(SMALL), NO_LIMITS, (), choices, "default"))
    (usual,) = suites(SMALL, "default")
    assert usual.assumed["refused_in_op"] == "drop_to_safeop"
    assert found.assumed == {**usual.assumed, **choices}
    assert found.assumed.keys() == model_of(SMALL).protocol.choices.keys()
    assert found.found.machine != usual.found.machine


# --- runs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("device", "depth", "number", "tests"),
    [
        (SMALL, "default", 0, 5),
        (DRIVE, "default", 1, 3),
        (DRIVE, "exhaustive", 1, 2),
        (SMALL, "exhaustive", 0, 5),
    ],
    ids=["AL", "DS402", "AL x DS402", "SDO"],
)
def test_the_sound_device_passes(device: str, depth: str, number: int, tests: int) -> None:
    suite = suites(device, depth)[number]
    runner = runner_of(device)
    runner.run_long(islice(suite.cases(), tests), None, tests)
    assert [verdict.outcome for verdict in runner.verdicts] == [Outcome.PASS] * tests
    assert {verdict.case for verdict in runner.verdicts} <= {case.name for case in suite.cases()}


def test_a_fault_is_found_shortened_and_replayed() -> None:
    (suite,) = suites(SMALL, "default")
    cases = list(islice(suite.cases(), 3))
    runner = runner_of(SMALL, FAULT)
    told: list[tuple[int, int, str]] = []
    runner.run_long(cases, lambda *what: told.append(what), 3)
    assert told == [(number, 3, case.name) for number, case in enumerate(cases)]
    assert [v.case for v in runner.verdicts] == [case.name for case in cases]
    first, *others = [v for v in runner.verdicts if v.outcome is Outcome.FAIL]
    assert "AL-08" in first.clauses
    short = case_of(first.replay)
    (long,) = (case for case in cases if case.name == first.case)
    assert (short.name, short.layer) == (long.name, "al")
    assert len(long.stimuli) > 30
    # both SyncManagers of the mailbox, PREOP, and what should have been refused
    assert len(short.stimuli) == 4
    # of each cause the first is made short, and what fails for the same cause is left as it is
    assert others
    known: set[str] = set()
    for verdict in (first, *others):
        left = len(case_of(verdict.replay).stimuli)
        assert left > 30 if verdict.signature in known else left <= 6
        known.add(verdict.signature)
    assert len(known) < 1 + len(others)

    again = run_device(SMALL, f"model:fault={FAULT}", replay=first.replay)
    (verdict,) = again.verdicts
    assert (verdict.outcome, verdict.signature) == (Outcome.FAIL, first.signature)
    assert (verdict.observed, verdict.expected) == (first.observed, first.expected)
    assert len(verdict.trace) == len(first.trace)
    sound = run_device(SMALL, "model", replay=first.replay)
    assert [verdict.outcome for verdict in sound.verdicts] == [Outcome.PASS]
    assert (sound.guarantees, again.guarantees) == ((), ())
