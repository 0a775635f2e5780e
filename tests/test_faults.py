"""The only place for tests of the planted faults: each is sound as a text, and a run finds it."""

from __future__ import annotations

from collections import Counter

import pytest
from grounds import GROUNDS, REFERENCE, Ground, apart, ground_of, suite

from ecatspec.conformance.verdict import BLAMING
from ecatspec.model.subdevice import Quirk
from ecatspec.spec.language.load import load_device, load_faults

FAULTS = load_faults()


def test_there_are_faults_of_every_service() -> None:
    assert len(FAULTS) >= 230
    texts = {fault.at.file for fault in FAULTS.values()}
    for fault in FAULTS.values():
        clauses = load_device(ground_of(fault).device).clauses
        assert set(fault.clauses) <= set(clauses), fault.name
        assert any(clauses[name].level == "must" for name in fault.clauses), fault.name
    assert len(texts) > 1


def test_no_two_faults_are_one() -> None:
    grounds = {name: ground_of(fault).device for name, fault in FAULTS.items()}
    wordings = Counter((grounds[name], fault.wording) for name, fault in FAULTS.items())
    assert not [wording for wording, times in wordings.items() if times > 1]
    changes = [(grounds[name], f.quirk, f.changes) for name, f in FAULTS.items()]
    assert all(quirk or changed for _, quirk, changed in changes)
    assert all(changes.count(change) == 1 for change in changes)


def test_every_quirk_is_planted() -> None:
    assert {fault.quirk for fault in FAULTS.values()} == {None, *(quirk.value for quirk in Quirk)}


@pytest.mark.parametrize(
    "ground",
    [
        pytest.param(ground, id=name, marks=apart(ground))
        for name, ground in {"reference": REFERENCE, **GROUNDS}.items()
    ],
)
def test_the_sound_device_is_not_blamed(ground: Ground) -> None:
    made = suite(ground)
    assert made.cases
    assert not made.blamed


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=apart(ground_of(fault))) for name, fault in FAULTS.items()],
)
def test_a_run_finds_the_fault(name: str) -> None:
    fault = FAULTS[name]
    made = suite(ground_of(fault))
    runner = made.runner({"fault": name})
    other: set[tuple[str, ...]] = set()
    for case in made.ordered(fault):
        verdict = runner.judge(case)
        if verdict.outcome in BLAMING:
            if set(verdict.clauses) & set(fault.clauses):
                return
            other.add(verdict.clauses)
    pytest.fail(f"blamed for {sorted(other) or 'nothing'}, not for {fault.clauses}")
