"""Tests of cases that go on where the one before was."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapters.model import VirtualAdapter, make, planted
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.bringup import way_to
from ecatspec.generators.cases.case import NO_LIMITS, Case
from ecatspec.generators.cases.transfers import upload
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from ecatspec.conformance.base.verdict import Verdict

DEVICE = "reference-drive"
STEP = 31
"""Every 31st case of a quick suite is taken."""


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(load_device(DEVICE))


def judged(runner: Runner, case: Case) -> tuple[Verdict, object]:
    runner.known.rules = set()
    verdict = runner.executor.judge(case)
    learned = (
        runner.known.choices,
        runner.known.untold,
        runner.known.refusals,
        runner.executor.configured,
    )
    return verdict, (frozenset(runner.known.rules), *map(repr, learned))


@pytest.mark.parametrize("fault", ["", "toggle_ignored"])
def test_all_is_as_from_power_on(model: Model, fault: str) -> None:
    options = {"fault": fault} if fault else {}
    adapter = make(DEVICE, options)
    told = adapter.describe()
    quick = Runner(model, adapter, told)
    protocol, quirks = planted(load_device(DEVICE), fault or None)
    plain = Runner(model, VirtualAdapter(VirtualSubDevice(protocol, quirks=quirks), told), told)
    outcomes = set()
    for number, case in enumerate(all_cases(model, NO_LIMITS, "quick")):
        if number % STEP and not case.name.startswith("sdo/transfer/wrong"):
            continue
        expected = judged(plain, case)
        assert judged(quick, case) == expected
        outcomes.add(expected[0].outcome)
    assert bool(outcomes & BLAMING) == bool(fault)


def test_what_is_common_is_done_once(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    adapter = make(DEVICE, {})
    given: list[bytes] = []
    write = adapter.write

    def counted(address: int, data: bytes) -> int:
        given.append(data)
        return write(address, data)

    monkeypatch.setattr(adapter, "write", counted)
    runner = Runner(model, adapter, adapter.describe())
    way = way_to(model, "PREOP")
    short = Case("sdo/short", "a way", "sdo", way, "PREOP", len(way))
    longer = replace(short, stimuli=(*way, upload(0x1018, 1)))
    other = replace(short, stimuli=(*way, upload(0x1018, 2)))
    for case in (longer, longer, other):
        runner.executor.judge(case)  # it shows which way it goes, which is known from then on
    needed = []
    for case in (longer, longer, short, other):
        given.clear()
        assert runner.executor.judge(case).outcome is Outcome.PASS
        needed.append(len(given))
    assert needed == [1, 0, 0, 1]
