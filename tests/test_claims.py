"""The only place for tests that claims drawn at random are tested: each violated by hand, found."""

from __future__ import annotations

import os
from functools import cache
from typing import TYPE_CHECKING, Final

import pytest
from planted import Violation, violations

from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.guard import Guarded
from ecatspec.conformance.runner import Runner
from ecatspec.conformance.verdict import FOUND, Outcome
from ecatspec.generators.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.compiled import Model
from ecatspec.model.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from ecatspec.generators.case import Case
    from ecatspec.spec.language.ir import Protocol

VIOLATIONS: Final = tuple(violations())
DRAWN: Final = 60
FOUND_AT_LEAST: Final = 57
WHOLE: Final = bool(os.environ.get("ECATSPEC_WHOLE"))
"""All violations are planted, not each fourth, as `make test` does for its time."""
WAYS: Final = 12
"""So many cases that need an AL state tell whether a device ever comes there."""


@cache
def cases(device: str) -> dict[str, Case]:
    return {case.name: case for case in all_cases(Model(load_device(device)), NO_LIMITS)}


def runner(device: str, protocol: Protocol) -> Runner:
    made = VirtualAdapter(VirtualSubDevice(protocol), described(protocol))
    adapter = Guarded(made)
    return Runner(Model(load_device(device)), adapter, adapter.describe())


def test_sixty_claims_are_drawn_and_all_but_few_found() -> None:
    assert len({violation.claim for violation in VIOLATIONS}) == len(VIOLATIONS) == DRAWN
    assert sum(bool(violation.case) for violation in VIOLATIONS) >= FOUND_AT_LEAST


@pytest.mark.parametrize(
    "violation", VIOLATIONS if WHOLE else VIOLATIONS[::4], ids=lambda violation: violation.claim
)
def test_a_violation_is_found(violation: Violation) -> None:
    sound = load_device(violation.device)
    protocol = violation.protocol()
    assert protocol != sound
    assert any(violation.claim in clause.claims for clause in sound.clauses.values())
    if not violation.case:
        pytest.skip("no case finds it")
    case = cases(violation.device)[violation.case]
    assert runner(violation.device, sound).judge(case).outcome not in FOUND
    wrong = runner(violation.device, protocol)
    outcome = wrong.judge(case).outcome
    if outcome is Outcome.INCONCLUSIVE:  # it never comes to the state: the run shows nothing
        needing = [each for each in cases(violation.device).values() if each.needs == case.needs]
        wrong.needed = {str(case.needs)}
        for each in sorted(needing, key=lambda each: len(each.stimuli))[:WAYS]:
            wrong.judge(each)
        assert wrong.unreached()
    else:
        assert outcome in FOUND
