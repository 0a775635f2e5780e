"""The only place for tests of generators/: how many cases there are and what they reach."""

from __future__ import annotations

import pytest

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.runner import Runner
from ecatspec.conformance.verdict import Outcome
from ecatspec.generators.case import SendFrame, WriteRegister, WriteRegisters
from ecatspec.generators.sdo_cover import sdo_cover
from ecatspec.generators.stimulus import frame_bytes, register_bytes, registers_bytes
from ecatspec.generators.transition_cover import transition_cover
from ecatspec.model.compiled import Model
from ecatspec.spec.language.load import load_device

GOLDEN = {"kollmorgen-akd": (620, 629), "standard": (544, 54)}
"""Cases of the transition cover and of the SDO cover: a change of a text changes them knowingly."""

NOT_FIRED = {
    "boot_kept": "the virtual SubDevice has no BOOT: it takes the first alternative",
    "boot_skipping_refused": "no BOOT",
    "bootstrap_entered": "no BOOT",
    "bootstrap_mailbox_refused": "no BOOT",
    "mailbox_prepared": "changes nothing and owes nothing: the oracle has no need to serve it",
    "mailbox_unchanged": "changes nothing and owes nothing",
    "preop_to_safeop_refused": "the condition process_data_accepted is assumed true",
    "safeop_to_op_refused": "the condition outputs_accepted is assumed true",
}
OTHER_WAY = {
    "kollmorgen-akd": {"op_skipping_drops", "unknown_state_drops"},
    "standard": {"op_skipping_stays", "unknown_state_stays"},
}
"""Rules of the alternative of `refused_in_op` that the device does not take."""

each_device = pytest.mark.parametrize("device", sorted(GOLDEN))


@pytest.fixture(scope="module")
def models() -> dict[str, Model]:
    return {device: Model(load_device(device)) for device in GOLDEN}


@each_device
def test_the_number_of_cases(models: dict[str, Model], device: str) -> None:
    model = models[device]
    counts = len(list(transition_cover(model))), len(list(sdo_cover(model)))
    assert counts == GOLDEN[device]


@each_device
def test_names_are_unique_and_start_with_the_layer(models: dict[str, Model], device: str) -> None:
    cases = [*transition_cover(models[device]), *sdo_cover(models[device])]
    assert len({case.name for case in cases}) == len(cases)
    for case in cases:
        assert case.name.startswith(f"{case.layer}/")
        assert 0 <= case.prelude < len(case.stimuli)


@each_device
def test_two_generations_are_equal(models: dict[str, Model], device: str) -> None:
    model = models[device]
    assert list(transition_cover(model)) == list(transition_cover(model))
    assert list(sdo_cover(model)) == list(sdo_cover(model))


@each_device
def test_every_stimulus_fits_its_register_or_its_mailbox(
    models: dict[str, Model], device: str
) -> None:
    model = models[device]
    for case in (*transition_cover(model), *sdo_cover(model)):
        for stimulus in case.stimuli:
            match stimulus:
                case WriteRegister(register=name):
                    _, data = register_bytes(model, stimulus)
                    assert len(data) == model.protocol.registers[name].size
                case WriteRegisters(writes=writes):
                    start, data = registers_bytes(model, stimulus)
                    last = model.protocol.registers[writes[-1].register]
                    assert start + len(data) == last.address + last.size
                case SendFrame():
                    data = frame_bytes(model, stimulus, 1)
                    assert len(data) <= model.parameter("mailbox_out", "length")


@each_device
def test_the_transition_cover_fires_every_rule_of_al(models: dict[str, Model], device: str) -> None:
    model = models[device]
    adapter = make(device, {})
    runner = Runner(model, adapter, adapter.describe())
    runner.run(transition_cover(model), None, 0)
    assert {verdict.outcome for verdict in runner.verdicts} == {Outcome.PASS}
    fired = {rule.name for rule in runner.rules if rule.machine == "al"}
    rules = {rule.name for rule in model.protocol.machines["al"].rules}
    assert rules - fired == set(NOT_FIRED) | OTHER_WAY[device]
