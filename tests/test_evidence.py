"""Tests of evidence: what violates a clause, and the case that finds it."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Final

import pytest

from ecatspec.conformance import cli
from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.cli import exit_status
from ecatspec.conformance.cli import trace as trace_command
from ecatspec.conformance.results.run_history import CaseRecord, Record
from ecatspec.conformance.traceability import evidence
from ecatspec.conformance.traceability.evidence import Evidence, Violations, digest_of, fresh
from ecatspec.conformance.traceability.measure import Measurement, measure
from ecatspec.conformance.traceability.trace import Standing, Trace, demands, trace_device
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.mutation.data_mutants import data_mutants
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.ir import Level
from ecatspec.spec.language.load import device_names, load_device, load_file, load_standard

if TYPE_CHECKING:
    from pathlib import Path

    from ecatspec.generators.mutation.data_mutants import DataMutant

TEXT: Final = """
device mine extends standard "a device"

manual "a manual" "its edition" claims MINE-001 .. MINE-006

clause MINE-C1 must "OP is kept" source "1" claims [MINE-001]
clause MINE-C2 must "a limit" source "2" claims [MINE-002, MINE-003]
clause MINE-C3 must "it is there" source "3" claims [MINE-004] because "nobody looks"
clause MINE-C4 must "the motor turns" source "4" claims [MINE-005] because "needs a motor"
clause MINE-C5 may "it is free" source "5" claims [MINE-006]

pin refused_in_op = stay [MINE-C1]

objects
  0x2000 : 0 limit  u16 rw range 10 .. 1000 = 100 [MINE-C2]
  0x2001 : 0 number u16 ro = 7 [MINE-C3]
  0x2002 : 0 free   u16 ro = 7 [MINE-C5]

condition turns "the motor turns" assumed true [MINE-C4]
"""
DEVICES: Final = tuple(name for name in device_names() if load_device(name).manuals)
SAMPLE: Final = 3
"""Pieces of evidence of each device that are tried again."""
SEED: Final = 20


@pytest.fixture(scope="module")
def mine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("text") / "mine.ecs"
    file.write_text(TEXT, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def model(mine: Path) -> Model:
    return Model(load_file(str(mine)))


@pytest.fixture(scope="module")
def ran(model: Model) -> Record:
    """A run in which each AL case went by the rules that MINE-C1 rests on."""
    rules = frozenset({"al.op_skipping_stays", "al.unknown_state_stays"})
    cases = (case for case in all_cases(model, NO_LIMITS) if "OP/request_BOOT" in case.name)
    return Record("a board", {case.name: CaseRecord(Outcome.PASS, rules) for case in cases})


@pytest.fixture(scope="module")
def measured(model: Model, ran: Record) -> dict[str, Evidence]:
    return measure(trace_device(model, ran), model, ran, {}, lambda _: None)


def standings(trace: Trace) -> dict[str, Standing]:
    return {row.clause.id: row.standing for row in trace.rows}


# --- mutants of data ------------------------------------------------------------------------------


@cache
def of_data(device: str) -> list[DataMutant]:
    protocol = load_device(device)
    standard = load_standard()
    own = [clause.id for clause in protocol.clauses.values() if clause.claims]
    return [m for clause in own for m in data_mutants(protocol, standard, clause)]


@pytest.mark.parametrize("device", DEVICES)
def test_a_mutant_of_data_is_another_text(device: str) -> None:
    protocol = load_device(device)
    found = of_data(device)
    assert all(mutant.protocol != protocol for mutant in found)
    assert all(set(mutant.clauses) <= set(protocol.clauses) for mutant in found)
    kinds = {mutant.place.partition(" ")[0] for mutant in found}
    assert {"object", "pin", "field", "replace", "register", "condition"} <= kinds


def test_there_are_mutants_of_each_kind() -> None:
    kinds = {m.place.partition(" ")[0] for device in DEVICES for m in of_data(device)}
    assert kinds == {
        "condition",
        "field",
        "frame",
        "object",
        "parameter",
        "pin",
        "register",
        "remove",
        "replace",
        "row",
    }
    mistakes = {m.mistake for device in DEVICES for m in of_data(device)}
    assert {mistake.partition(" of ")[0].partition(", with")[0] for mistake in mistakes} == {
        "another default",
        "another range",
        "another reply",
        "another reset value",
        "another right",
        "another type",
        "another value",
        "as in the standard",
        "elsewhere",
        "mappable",
        "maps more bits",
        "missing",
        "not mappable",
        "one bit higher",
        "one bit lower",
        "shows",
        "the contrary",
        "the other way",
        "there",
        "written in other states",
    }


def test_a_closed_dictionary_and_states_to_read_in_have_mutants_too(tmp_path: Path) -> None:
    file = tmp_path / "mine.ecs"
    late = "  0x2003 : 0 late u16 ro readable in { OP } = 7 [MINE-C2]\n"
    text = TEXT.replace("\ncondition", f"{late}\ndictionary closed [MINE-C2]\n\ncondition")
    file.write_text(text, encoding="utf-8")
    found = data_mutants(load_file(str(file)), load_standard(), "MINE-C2")
    mistakes = {mutant.mistake: mutant for mutant in found}
    assert mistakes["one object more"].place == "dictionary"
    assert mistakes["read in other states"].place == "object 0x2003:00"


# --- measuring ------------------------------------------------------------------------------------


def test_a_violation_that_a_case_finds_is_evidence(
    model: Model, ran: Record, measured: dict[str, Evidence]
) -> None:
    way = "pin refused_in_op: the other way: stay -> drop_to_safeop"
    assert measured["MINE-C1"].violation == way
    assert measured["MINE-C2"].violation.startswith("object 0x2000:00: ")
    assert "MINE-C5" not in measured  # a freedom cannot be violated
    trace = trace_device(model, ran, measured)
    assert standings(trace) == {
        "MINE-C1": Standing.CARRIED,
        "MINE-C2": Standing.CARRIED,
        "MINE-C3": Standing.REASONED,
        "MINE-C4": Standing.REASONED,
        "MINE-C5": Standing.FREE,
    }
    # what is only touched does not count as carried
    bare = trace_device(model, ran)
    assert standings(bare)["MINE-C2"] is Standing.ROW_ONLY
    assert "MINE-C2" in {row.clause.id for row in bare.missing}


def test_a_reason_that_evidence_disproves_is_told(
    mine: Path, model: Model, ran: Record, measured: dict[str, Evidence]
) -> None:
    (line,) = trace_device(model, ran, measured).disproved
    place = model.protocol.clauses["MINE-C3"].at
    assert line.startswith(f"{mine}:{place.line}:")
    assert 'MINE-C3 has it that nothing exercises it ("nobody looks"), but ' in line
    assert "finds object 0x2001:00: " in line


def test_the_command_ends_with_1_where_a_reason_is_disproved(
    mine: Path,
    model: Model,
    ran: Record,
    measured: dict[str, Evidence],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(trace_command, "known_run", lambda *_: ran)
    evidence.write(tmp_path, model.protocol.name, measured)
    command = ["trace", str(mine), "--evidence", str(tmp_path)]
    assert cli.main(command) == exit_status.DOES_NOT_CONFORM
    assert capsys.readouterr().err.count("MINE-C3 has it") == 1
    left = {name: each for name, each in measured.items() if name != "MINE-C3"}
    evidence.write(tmp_path, model.protocol.name, left)
    assert cli.main(command) == exit_status.CONFORMS
    assert "MINE-C3 has it" not in capsys.readouterr().err
    assert cli.main([*command, "--measure"]) == exit_status.DOES_NOT_CONFORM  # it is found again
    assert evidence.read(tmp_path, model.protocol.name) == measured


def test_evidence_of_something_else_counts_no_more(
    model: Model, measured: dict[str, Evidence]
) -> None:
    names = {case.name for case in all_cases(model, NO_LIMITS)}
    own = measured["MINE-C2"]
    work = Measurement(model)
    assert set(fresh(model, measured, names)) == set(measured)
    for other in (
        replace(own, digest="0"),
        replace(own, violation="object 0x2000:00: another range: 10 .. 1000 -> 1 .. 2"),
        replace(own, case="sdo/upload/2003_00"),
    ):
        assert fresh(model, {"MINE-C2": other}, names) == {}
        # and it is looked for anew
        assert work.again("MINE-C2", other) is None
    clause = model.protocol.clauses["MINE-C2"]
    clauses = model.protocol.clauses | {"MINE-C2": replace(clause, wording="another limit")}
    changed = replace(model.protocol, clauses=clauses)
    assert digest_of(changed, "MINE-C2") != digest_of(model.protocol, "MINE-C2")


@pytest.mark.parametrize("damage", ["", "[]", '{"clauses": {"A": {"digest": "0"}}}', "\udcff"])
def test_a_file_that_holds_no_evidence_is_refused(tmp_path: Path, damage: str) -> None:
    assert evidence.read(tmp_path, "mine") == {}
    (tmp_path / "mine.json").write_bytes(damage.encode("utf-8", "surrogateescape"))
    with pytest.raises(UserError, match="no file of evidence"):
        evidence.read(tmp_path, "mine")


# --- what is shipped ------------------------------------------------------------------------------


@cache
def shipped(device: str) -> tuple[Model, dict[str, Evidence]]:
    return Model(load_device(device)), evidence.read(evidence.shipped(), device)


@pytest.mark.parametrize("device", DEVICES)
def test_shipped_evidence_fits_the_texts(device: str) -> None:
    model, known = shipped(device)
    names = {case.name for case in all_cases(model, NO_LIMITS)}
    stale = known.keys() - fresh(model, known, names).keys()
    assert not stale, f"measure again: ecatspec trace {device} --measure"
    assert all(demands(model.protocol.clauses[name]) for name in known)
    levels = {model.protocol.clauses[name].level for name in known}
    assert Level.MAY not in levels
    assert not trace_device(model, None, known).disproved


@pytest.mark.parametrize("device", DEVICES)
def test_shipped_evidence_holds(device: str) -> None:
    model, known = shipped(device)
    work = Measurement(model)
    for name in random.Random(SEED).sample(sorted(known), SAMPLE):
        assert work.again(name, known[name]) is not None, (name, known[name])


@pytest.mark.parametrize("device", DEVICES)
def test_hardly_anything_hangs_on_rows_only(device: str) -> None:
    model, known = shipped(device)
    standing = trace_device(model, None, known).standing_of_claims()
    counts = Counter(standing.values())
    assert counts[Standing.ROW_ONLY] * 50 <= sum(counts.values())


def test_violations_are_named_apart() -> None:
    model, _ = shipped("beckhoff-el6720")
    violations = Violations(model)
    for clause in model.protocol.clauses:
        names = Counter(violation.name for violation in violations.of(clause))
        assert not [name for name, times in names.items() if times > 1], clause
