"""Tests that the covers of registers and of worked examples find mistakes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.base.adapter import AdapterError
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS, ReadRegister
from ecatspec.generators.covers.example_cover import example_cover
from ecatspec.generators.covers.register_cover import register_cover
from ecatspec.generators.covers.sdo_cover import named_indexes, sdo_cover
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.generators.cases.case import Case

DEVICE = "kollmorgen-akd"


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(load_device(DEVICE))


@pytest.fixture
def adapter() -> Adapter:
    return make(DEVICE, {})


def outcome(model: Model, adapter: Adapter, case: Case) -> tuple[Outcome, tuple[str, ...]]:
    verdict = Runner(model, adapter, adapter.describe()).executor.judge(case)
    return verdict.outcome, verdict.clauses


def test_each_register_is_read_once(model: Model, adapter: Adapter) -> None:
    cases = list(register_cover(model, NO_LIMITS))
    read = [s.register for case in cases for s in case.stimuli if isinstance(s, ReadRegister)]
    assert read == list(model.protocol.registers)
    assert {outcome(model, adapter, case)[0] for case in cases} == {Outcome.PASS}


@pytest.mark.parametrize("name", ["al_control", "al_status_code", "sync_manager_2"])
def test_a_register_that_cannot_be_read_is_found(
    model: Model, adapter: Adapter, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    hidden = model.protocol.registers[name]
    plain = adapter.read

    def read(address: int, length: int) -> tuple[int, bytes]:
        return (
            (0, b"")
            if (address, length) == (hidden.address, hidden.size)
            else plain(address, length)
        )

    monkeypatch.setattr(adapter, "read", read)
    (case,) = (c for c in register_cover(model, NO_LIMITS) if c.name == f"al/register/{name}")
    found, clauses = outcome(model, adapter, case)
    assert found is Outcome.FAIL
    assert set(clauses) & set(hidden.clauses)


def test_what_depends_on_the_controller_is_not_demanded(
    model: Model, adapter: Adapter, monkeypatch: pytest.MonkeyPatch
) -> None:
    register = model.protocol.registers["fmmu_3"]
    plain = adapter.read

    def read(address: int, length: int) -> tuple[int, bytes]:
        return (0, b"") if address == register.address else plain(address, length)

    monkeypatch.setattr(adapter, "read", read)
    (case,) = (c for c in register_cover(model, NO_LIMITS) if c.name == "al/register/fmmu_3")
    assert outcome(model, adapter, case)[0] is Outcome.PASS


def test_what_a_text_names_as_missing_is_asked_for() -> None:
    model = Model(load_device("metronix-dis2"))
    assert set(named_indexes(model)) == {0x1008, 0x100A, 0x60C4, 0x6089, 0x608E, 0x1C32, 0x1C33}
    asked = {case.name for case in sdo_cover(model, NO_LIMITS)}
    assert {"sdo/no_object/upload/60C4", "sdo/no_object/download/60C4"} <= asked


def test_a_case_that_did_not_reach_the_device_has_no_rules(
    model: Model, adapter: Adapter, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner = Runner(model, adapter, adapter.describe())
    (case,) = example_cover(model, NO_LIMITS)
    runner.run([case], None, 1)

    def reset() -> None:
        raise AdapterError("unplugged; plug it in")

    monkeypatch.setattr(adapter, "reset", reset)
    runner.run([case], None, 1)
    reached, unreached = runner.verdicts
    assert reached.rules
    assert (unreached.outcome, unreached.rules) == (Outcome.ERROR, ())


def test_an_example_that_is_answered_wrongly_is_found(model: Model) -> None:
    (case,) = example_cover(model, NO_LIMITS)
    assert outcome(model, make(DEVICE, {}), case)[0] is Outcome.PASS
    found, clauses = outcome(model, make(DEVICE, {"fault": "configuration_confirmed"}), case)
    assert found is Outcome.FAIL
    assert clauses
