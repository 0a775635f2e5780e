"""Tests of what a device can never reach."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from fault_suites import GROUNDS, REFERENCE, Ground, apart, suite

from ecatspec.conformance.base.devices import load
from ecatspec.conformance.run.coverage import extent_of
from ecatspec.conformance.run.dut_knowledge import shape_of
from ecatspec.conformance.run.runner import run_device
from ecatspec.model.analysis.unreachable import clauses_beyond, rules_beyond
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.compiled import rows_of
from ecatspec.model.core.state import RuleName

TERMINAL = str(Path(__file__).parent / "devices" / "terminal.ecs")
EACH_GROUND = [
    pytest.param(ground, marks=apart(ground), id=f"{ground.device} {' '.join(ground.layers)}")
    for ground in dict.fromkeys((REFERENCE, *GROUNDS.values()))
]


def model_of(device: str, *, closed: bool = False) -> Model:
    return Model(load(device), closed=closed)


def beyond(device: str, *, closed: bool = False, **ways: str) -> frozenset[str]:
    return rules_beyond(model_of(device, closed=closed), frozenset(ways.items()))


def rows(model: Model) -> set[str]:
    machines = model.protocol.machines.values()
    return {f"{machine.name}.{row.name}" for machine in machines for row in rows_of(machine)}


@pytest.mark.parametrize("ground", EACH_GROUND)
def test_no_rule_that_a_run_goes_by_is_beyond_the_device(ground: Ground) -> None:
    made = suite(ground)
    ways = frozenset(shape_of(made.model.protocol).items())
    gone = {rule for _, fired in made.cases for rule in fired}
    assert gone
    assert not gone & rules_beyond(made.model, ways)


def test_a_pin_shuts_the_other_ways() -> None:
    found = beyond("beckhoff-el6720")
    assert "al.bootstrap_refused" in found
    assert "al.bootstrap_entered" not in found
    model = model_of("beckhoff-el6720")
    clauses = clauses_beyond(model, found)
    assert "AL-06" in clauses
    assert not {"AL-25", "EL6720-C20"} & clauses
    assert {"al.copied_op", "al.held_back"}.isdisjoint(found)
    assert "al.copied_op" in beyond("beckhoff-el6720", emulation="none")
    assert "al.held_back" in beyond(TERMINAL)


def test_what_only_rules_beyond_lead_to_is_beyond_too() -> None:
    found = beyond(TERMINAL)
    inner = {name for name in rows(model_of(TERMINAL)) if name.startswith(("sdo", "coe."))}
    assert len(inner) > 100
    assert inner <= found
    assert "mailbox.mail_unheard" not in found
    # no BOOT: what can be asked of it there comes to nothing
    boot = {"al.boot_kept", "al.boot_skipping_refused", "al.boot_mailbox_taken_away"}
    assert boot <= beyond("reference-drive")
    assert boot.isdisjoint(beyond("beckhoff-el6720"))


def test_a_device_without_the_words_of_a_drive_is_none() -> None:
    found = beyond("reference")
    commands = {"ds402.command_taken", "ds402.shutdown_2", "ds402.enable_operation_4"}
    own = {"ds402.initialised_1", "ds402.operational_untested"}
    unreachable = {"ds402.fault_13", "ds402.operational_without_drive"}
    assert commands | own <= found
    assert unreachable.isdisjoint(found)
    drive = beyond("reference-drive")
    assert (commands | own | {"ds402.fault_13"}).isdisjoint(drive)
    assert "ds402.operational_without_drive" in drive
    assert "DRV-09" in clauses_beyond(model_of("reference"), found)


def test_a_word_that_the_device_lacks_stays_as_it_is() -> None:
    protocol = load("reference-drive")
    (word,) = (word for word in protocol.words.values() if word.name == "control_word")
    kept = tuple(each for each in protocol.objects if (each.index, each.subindex) != word.key)
    found = rules_beyond(Model(replace(protocol, objects=kept)), frozenset())
    assert {"ds402.initialised_1", "ds402.disabled_stays"}.isdisjoint(found)
    assert "ds402.shutdown_2" in found


def test_entries_decide_what_can_be_asked_of_them() -> None:
    asked = {"sdo.upload_write_only", "sdo.upload_wrong_state", "sdo.value_too_high"}
    assert asked.isdisjoint(beyond("reference"))
    assert asked <= beyond("beckhoff-el6720")
    # one entry is read, another one has a range: no one entry has to have it all
    assert "sdo.value_too_high" in beyond("kollmorgen-akd")


def test_objects_that_no_text_declares_are_there_where_the_dictionary_is_open() -> None:
    undeclared = {"sdo.upload_undeclared_normal", "sdo_information.object_undeclared_missing"}
    assert undeclared.isdisjoint(beyond("beckhoff-el6720"))
    assert undeclared <= beyond("beckhoff-el6720", closed=True)
    missing = {"sdo.upload_no_object", "sdo.upload_no_subindex"}
    assert missing.isdisjoint(beyond("beckhoff-el6720", closed=True))
    assert missing <= beyond("beckhoff-el6720")


def test_behind_a_gap_a_drive_may_be_in_any_state() -> None:
    protocol = load("reference-drive")
    drive = protocol.machines["ds402"]
    rules = tuple(rule for rule in drive.rules if rule.target is None)
    gaps = tuple(
        replace(gap, sources=("NOT_READY",), input="mains_off", guard=None) for gap in drive.gaps
    )
    assert gaps
    found = {}
    for left in ((), gaps):
        machines = protocol.machines | {"ds402": replace(drive, rules=rules, gaps=left)}
        found[left] = rules_beyond(Model(replace(protocol, machines=machines)), frozenset())
    assert "ds402.fault_stays" in found[()]
    assert "ds402.fault_stays" not in found[gaps]


def test_without_process_data_no_outputs_come() -> None:
    assert "process_data.outputs_taken" in beyond("reference")
    assert "process_data.outputs_taken" not in beyond("beckhoff-el6720")


def test_what_a_run_counts_is_what_the_device_can_reach() -> None:
    result = run_device("reference", "model", replay="sdo/download/2000_00")
    assert result.rules_covered
    every = rows(model_of("reference"))
    assert result.rules_total + len(result.rules_beyond) == len(every)
    assert set(result.rules_covered) <= every - set(result.rules_beyond)
    assert "al.copied_op" in result.rules_beyond
    assert set(result.clauses_covered).isdisjoint(result.clauses_beyond)
    assert 0 < len(result.clauses_covered) < result.clauses_total


def test_where_a_device_went_after_all_is_counted() -> None:
    model = model_of("beckhoff-el6720")
    rule = RuleName("al", "bootstrap_refused")
    without, gone = extent_of(model, set(), {}), extent_of(model, {rule}, {})
    assert gone.rules_total == without.rules_total + 1
    assert set(without.rules_beyond) - set(gone.rules_beyond) == {str(rule)}
    assert "AL-06" in set(without.clauses_beyond) - set(gone.clauses_beyond)
    assert gone.clauses_covered == ("AL-06", "AL-27")
