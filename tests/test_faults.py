"""The only place for tests of the planted faults: each is sound as a text, and a run finds it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import pytest

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.devices import load
from ecatspec.conformance.runner import Runner
from ecatspec.conformance.verdict import BLAMING, Outcome
from ecatspec.generators.case import NO_LIMITS, Case
from ecatspec.generators.suite import all_cases
from ecatspec.model.compiled import Model
from ecatspec.model.subdevice import Quirk
from ecatspec.spec.language.check import check_words
from ecatspec.spec.language.ir import Fault, Remove, Replace
from ecatspec.spec.language.load import load_device, load_faults, plant

DEVICE = "reference"
DEPTH = "quick"
FAULTS = load_faults()
SMALL = "40"
"""The mailbox for SDO information, so that a list takes several messages."""
LONG = 16
"""After so many stimuli a transfer is the same over and over; the sound device stops there."""


@dataclass(slots=True)
class Suite:
    """The cases for one size of mailbox, each with rules that a sound device goes by in it."""

    model: Model
    options: dict[str, str]
    cases: list[tuple[Case, frozenset[str]]] = field(default_factory=list)
    blamed: list[str] = field(default_factory=list)

    def runner(self, options: dict[str, str]) -> Runner:
        adapter = make(DEVICE, self.options | options)
        return Runner(self.model, adapter, adapter.describe())

    def ordered(self, fault: Fault) -> list[Case]:
        """The cases that go by rare rules of the fault first: short ones, then the longest."""
        layer = Path(fault.at.file).stem
        own = {f"{c.machine}.{c.rule}" for c in fault.changes if isinstance(c, Replace | Remove)}
        near = {
            f"{machine.name}.{rule.name}"
            for machine in self.model.protocol.machines.values()
            for rule in machine.rules
            if fault.clauses[0] in rule.clauses
        }
        often = Counter(rule for _, fired in self.cases for rule in fired)

        def key(row: tuple[Case, frozenset[str]]) -> tuple[float, float, bool, bool, int]:
            case, fired = row
            length = len(case.stimuli)
            return (
                -sum(1 / often[rule] for rule in own & fired),
                -sum(1 / often[rule] for rule in near & fired),
                case.layer != layer,
                length > LONG,
                -length if length > LONG else length,
            )

        return [case for case, _ in sorted(self.cases, key=key)]


@cache
def suite(mailbox: str) -> Suite:
    """Run the sound device once: what it goes by, and what it is blamed for."""
    model = Model(load(DEVICE, mailbox))
    made = Suite(model, {"mailbox": mailbox} if mailbox else {})
    runner = made.runner({})
    for case in all_cases(model, NO_LIMITS, DEPTH):
        if mailbox and case.layer != "sdo_information":
            continue
        runner.rules = set()
        verdict = runner.judge(replace(case, stimuli=case.stimuli[:LONG]))
        if verdict.outcome is not Outcome.PASS:
            made.blamed.append(f"{verdict.case}: {verdict.outcome} {verdict.observed}")
        made.cases.append((case, frozenset(map(str, runner.rules))))
    return made


def test_there_are_faults_of_every_service() -> None:
    assert len(FAULTS) >= 75
    texts = {fault.at.file for fault in FAULTS.values()}
    clauses = load_device(DEVICE).clauses
    for fault in FAULTS.values():
        assert set(fault.clauses) <= set(clauses), fault.name
        assert any(clauses[name].level == "must" for name in fault.clauses), fault.name
    assert len(texts) > 1


def test_no_two_faults_are_one() -> None:
    assert not [n for n, times in Counter(f.wording for f in FAULTS.values()).items() if times > 1]
    changes = [(f.quirk, f.changes) for f in FAULTS.values()]
    assert all(quirk or changed for quirk, changed in changes)
    assert all(changes.count(change) == 1 for change in changes)


def test_every_quirk_is_planted() -> None:
    assert {fault.quirk for fault in FAULTS.values()} == {None, *(quirk.value for quirk in Quirk)}


def test_a_faulty_text_names_what_exists() -> None:
    for fault in FAULTS.values():
        findings = check_words(plant(load_device(DEVICE), fault))
        assert not findings, (fault.name, findings)


@pytest.mark.parametrize("mailbox", ["", SMALL])
def test_the_sound_device_is_not_blamed(mailbox: str) -> None:
    assert not suite(mailbox).blamed


@pytest.mark.parametrize("name", FAULTS)
def test_a_run_finds_the_fault(name: str) -> None:
    fault = FAULTS[name]
    made = suite(SMALL if "information" in fault.at.file else "")
    runner = made.runner({"fault": name})
    other: set[tuple[str, ...]] = set()
    for case in made.ordered(fault):
        verdict = runner.judge(case)
        if verdict.outcome in BLAMING:
            if set(verdict.clauses) & set(fault.clauses):
                return
            other.add(verdict.clauses)
    pytest.fail(f"blamed for {sorted(other) or 'nothing'}, not for {fault.clauses}")
