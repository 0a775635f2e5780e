"""Tests of traceability: from a clause to its cases, and out to other tools."""

from __future__ import annotations

import csv
import io
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner
from reqif.parser import ReqIFParser

from ecatspec.conformance import cli
from ecatspec.conformance.base.atomic_write import write_whole
from ecatspec.conformance.base.verdict import Outcome, Result, Verdict
from ecatspec.conformance.base.work_items import Judged, Learned
from ecatspec.conformance.results import run_history
from ecatspec.conformance.results.run_file import Basis
from ecatspec.conformance.results.run_history import CaseRecord, Record
from ecatspec.conformance.run import runner
from ecatspec.conformance.traceability.case_footprint import Touch
from ecatspec.conformance.traceability.requirements import reqif
from ecatspec.conformance.traceability.trace import (
    Standing,
    Trace,
    clause_sheet,
    total_sheet,
    trace_device,
)
from ecatspec.generators.cases.case import NO_LIMITS, Case
from ecatspec.generators.cases.transfers import download, upload
from ecatspec.generators.suite import all_cases
from ecatspec.model.analysis.citations import Foundations, citations, object_name
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_device, load_file

if TYPE_CHECKING:
    from collections.abc import Callable

    from ecatspec.spec.language.ir import Protocol

DEVICE = "kollmorgen-s300"
TEXT = """
device mine extends standard "my <device> & more"

manual "a manual" "its edition" claims MINE-001 .. MINE-007

clause MINE-C1 must "OP is kept" source "1" claims [MINE-001]
clause MINE-C2 must "a limit" source "2" claims [MINE-002, MINE-003]
clause MINE-C3 unobservable "a <light> & a plug" source "3" claims [MINE-004] because "not in it"
clause MINE-C4 must "the motor turns" source "4" claims [MINE-005] because "needs a motor"
clause MINE-C5 must "what the file says" source "5" claims [MINE-006]
clause MINE-C6 should "forgotten" source "6" claims [MINE-007]

pin refused_in_op = stay [MINE-C1]

objects
  0x2000 : 0 limit u16 rw range 10 .. 1000 = 100 [MINE-C2]

esi
  "Vendor/Id" = 0xE4 [MINE-C5]

condition turns "the motor turns" assumed true [MINE-C4]
condition forgotten "nothing asks for it" assumed true [MINE-C6]

anomaly ANOM-900 motor
  printed   "it turns left"
  normative "it turns right"
  treatment "misprint"
  [MINE-C4]
"""


@pytest.fixture(scope="module")
def mine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("text") / "mine.ecs"
    file.write_text(TEXT, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def model(mine: Path) -> Model:
    return Model(load_file(str(mine)))


@pytest.fixture(scope="module")
def traced(model: Model) -> Trace:
    return trace_device(model, ran(model, "al.unknown_state_stays", Outcome.PASS))


def ran(model: Model, rule: str, outcome: Outcome) -> Record:
    """A record in which one case went by one rule."""
    case = next(c for c in all_cases(model, NO_LIMITS) if c.layer == "al")
    return Record("a board", {case.name: CaseRecord(outcome, frozenset({rule}))})


def by_id(trace: Trace) -> dict[str, Standing]:
    return {row.clause.id: row.standing for row in trace.rows}


# --- what rests on what ---------------------------------------------------------------------------


def test_a_rule_rests_on_all_that_it_mentions() -> None:
    protocol = load_device("kollmorgen-akd")
    of = Foundations(protocol).of["al.init_to_preop"]
    assert {"AL-03", "AL-05", "AL-22", "MBX-15"} <= of  # rule, choice, time limit, parameter
    assert set(protocol.parameters["mailbox_out"].clauses) <= of  # by two definitions
    assert set(protocol.registers["al_control"].clauses) <= of  # the register of its input
    assert set(protocol.registers["al_status"].clauses) <= of  # the register that shows it
    preop = next(row for row in protocol.tables["al_state"].rows if row.name == "PREOP")
    assert set(preop.clauses) <= of
    safeop = next(row for row in protocol.tables["al_state"].rows if row.name == "SAFEOP")
    assert not set(safeop.clauses) <= of


def test_of_a_set_of_codes_no_row_counts_as_seen() -> None:
    protocol = load_device(DEVICE)
    of = Foundations(protocol).of["al.init_to_preop_refused"]
    codes = {row.name: row for row in protocol.tables["al_status_code"].rows}
    assert not of.intersection(codes["invalid_sync_manager_configuration"].clauses)
    assert set(protocol.closed["al_status_code"].clauses) <= of


def test_every_citation_has_a_place_and_names_clauses_that_exist() -> None:
    protocol = load_device(DEVICE)
    found = list(citations(protocol))
    kinds = {citation.kind for citation in found}
    assert {"rule", "register", "row", "parameter", "pin", "object", "remove", "closed"} <= kinds
    assert all(set(citation.clauses) <= set(protocol.clauses) for citation in found)
    assert all(citation.at.line for citation in found if citation.clauses)


def test_what_stimuli_touch(model: Model) -> None:
    def touched(*stimuli: object) -> set[str]:
        case = Case("sdo/x", "x", "sdo", stimuli)  # type: ignore[arg-type]
        return {name for name in Touch(model).of(case) if not name.startswith("register")}

    akd = Model(load_device("kollmorgen-akd"))
    assert touched(upload(0x2000, 0)) == {object_name((0x2000, 0))}
    assert touched(upload(0x2001, 0)) == set()
    chosen = Case("sdo/x", "x", "sdo", (download(0x1C12, 1, b"\x02\x17"),))
    names = Touch(akd).of(chosen)
    assert {"0x1C12:01", "0x1702:01", "0x6040:00"} <= names
    assert "0x1703:01" not in names


# --- the standing of clauses ----------------------------------------------------------------------


def test_each_clause_stands_as_it_should(traced: Trace) -> None:
    assert by_id(traced) == {
        "MINE-C1": Standing.ROW_ONLY,  # the rule of the record asks for the choice
        "MINE-C2": Standing.ROW_ONLY,  # cases read the object
        "MINE-C3": Standing.UNOBSERVABLE,
        "MINE-C4": Standing.REASONED,
        "MINE-C5": Standing.DATA,
        "MINE-C6": Standing.MISSING,
    }
    assert [row.clause.id for row in traced.missing] == ["MINE-C1", "MINE-C2", "MINE-C6"]
    assert len(traced.claims) == 7
    assert set(traced.standing_of_claims()) == set(traced.claims)


def test_without_a_run_no_rule_counts(model: Model) -> None:
    trace = trace_device(model, None)
    standing = by_id(trace)
    assert standing["MINE-C1"] is Standing.MISSING
    assert standing["MINE-C2"] is Standing.ROW_ONLY
    assert {row.verdict for row in trace.rows} == {"", "not run"}


def test_the_worst_outcome_comes_first(model: Model) -> None:
    record_ = ran(model, "al.unknown_state_stays", Outcome.FAIL)
    row = trace_device(model, record_).rows[0]
    assert (row.clause.id, row.verdict) == ("MINE-C1", "1 fail")


def test_totals_count_each_claim_once(traced: Trace) -> None:
    sheet = total_sheet((traced, traced))
    rows = [dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows]
    assert [row["device"] for row in rows] == ["mine", "mine", "all"]
    assert [row["claims"] for row in rows] == [7, 7, 14]
    assert [row["accounted"] for row in rows] == [7, 7, 14]
    assert [row["row only"] for row in rows] == [3, 3, 6]
    assert [row["anomalies"] for row in rows] == [1, 1, 1]  # the same one


# --- records --------------------------------------------------------------------------------------


def keep(protocol: Protocol, rule: str, only: tuple[str, ...] = ()) -> Path:
    """Keep a run of one case, which went by one rule."""
    board = {"name": "a board"}
    basis = Basis(protocol.name, protocol.digest, "exec:x", board, "quick", 0, "", only)
    with run_history.begin(basis) as journal:
        case = next(iter(ran(Model(protocol), rule, Outcome.WARNING).cases))
        verdict = Verdict(case, Outcome.WARNING, "a case", rules=(rule,))
        journal.keep(Judged(case, verdict, Learned()))
    return run_history.files(protocol.name)[0]


def test_a_record_comes_back_as_it_was(model: Model, state_folder: Path) -> None:
    file = keep(model.protocol, "al.to_init")
    assert run_history.load(model.protocol) == ran(model, "al.to_init", Outcome.WARNING)
    assert file.parent == state_folder / "ecatspec" / "runs" / "mine"
    assert [each.name for each in file.parent.glob(f"{file.name}*")] == [file.name]


@pytest.mark.parametrize("damage", ["", "[]", "SQLite format 3\0", "\udcff"])
def test_a_damaged_record_counts_as_none(model: Model, damage: str) -> None:
    forget(model.protocol)
    keep(model.protocol, "al.to_init").write_bytes(damage.encode("utf-8", "surrogateescape"))
    assert run_history.load(model.protocol) is None


def test_a_record_of_other_texts_counts_as_none(model: Model, tmp_path: Path) -> None:
    keep(model.protocol, "al.to_init")
    file = tmp_path / "mine.ecs"
    file.write_text(TEXT.replace("= 100", "= 101"), encoding="utf-8")
    assert run_history.load(load_file(str(file))) is None


def test_a_run_of_some_layers_is_no_record_of_all(model: Model) -> None:
    keep(model.protocol, "al.to_init")
    keep(model.protocol, "al.unknown_state_stays", only=("al",))
    assert run_history.load(model.protocol) == ran(model, "al.to_init", Outcome.WARNING)


def test_the_last_runs_of_a_device_are_kept(model: Model) -> None:
    forget(model.protocol)
    kept = [keep(model.protocol, "al.to_init") for _ in range(12)]
    assert run_history.files(model.protocol.name) == kept[:1:-1]
    assert (run_history.named("last"), run_history.named("previous")) == (kept[-1], kept[-2])
    assert run_history.named("here") == Path("here")


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("before", encoding="utf-8")
    with pytest.raises(UnicodeEncodeError):
        write_whole(file, "half \udcff")
    assert [f.read_text(encoding="utf-8") for f in tmp_path.iterdir()] == ["before"]
    write_whole(file, "after")
    assert file.read_text(encoding="utf-8") == "after"
    (tmp_path / "plain").write_text("", encoding="utf-8")
    assert file.stat().st_mode == (tmp_path / "plain").stat().st_mode


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[int, str, str]]:
    """The command line with a runner that only says that it ran."""

    def run_device(device: str, dut: str, **options: object) -> Result:
        assert (dut, options["depth"]) == ("model", "quick")
        rule = "al.unknown_state_stays"
        keep(load_file(device), rule)
        (case,) = ran(Model(load_file(device)), rule, Outcome.WARNING).cases
        verdicts = (Verdict(case, Outcome.WARNING, "a case", rules=(rule,)),)
        return Result(device, "the model", verdicts, (), 0, (), 0, 0.0)

    def call(*arguments: str) -> tuple[int, str, str]:
        result = CliRunner().invoke(cli.cli, list(arguments), standalone_mode=False)
        if result.exception is not None:
            raise result.exception
        return result.return_value or 0, result.stdout, result.stderr

    monkeypatch.setattr(runner, "run_device", run_device)
    return call


def forget(protocol: Protocol) -> None:
    for file in run_history.files(protocol.name):
        file.unlink()


def test_without_a_record_the_model_runs_once(
    mine: Path, model: Model, called: Callable[..., tuple[int, str, str]]
) -> None:
    forget(model.protocol)
    status, out, err = called("trace", str(mine), "--missing")
    assert status == 0
    assert "no run of mine is on record" in err
    assert "MINE-C6" in out
    assert "MINE-C5" not in out
    assert called("trace", str(mine))[2] == ""


def test_json_and_csv_say_the_same(
    mine: Path, model: Model, called: Callable[..., tuple[int, str, str]]
) -> None:
    forget(model.protocol)
    (device,) = json.loads(called("trace", str(mine), "--json")[1])["devices"]
    rows = list(csv.DictReader(io.StringIO(called("trace", str(mine), "--csv")[1])))
    assert [row["clause"] for row in rows] == [clause["id"] for clause in device["clauses"]]
    assert [int(row["cases"]) for row in rows] == [len(c["cases"]) for c in device["clauses"]]
    assert device["totals"]["accounted"] == len(device["claims"]) == 7
    assert (
        device["clauses"][0]["specified"][0]["line"] == TEXT.count("\n", 0, TEXT.index("pin")) + 1
    )
    assert device["anomalies"][0]["clauses"] == ["MINE-C4"]


def test_reqif_reads_back(traced: Trace, tmp_path: Path) -> None:
    file = tmp_path / "mine.reqif"
    now = datetime(2026, 1, 2, tzinfo=UTC)
    file.write_text(reqif([traced], now), encoding="utf-8")
    assert reqif([traced], now) == file.read_text(encoding="utf-8")
    content = ReqIFParser.parse(str(file)).core_content.req_if_content
    texts = {
        o.attribute_map["ecatspec-id"].value: o.attribute_map["ecatspec-text"].value
        for o in content.spec_objects
    }
    assert texts == {row.clause.id: row.clause.wording for row in traced.rows}
    (specification,) = content.specifications
    assert specification.long_name == "my <device> & more"
    children = [child.spec_object for child in specification.children]
    assert children == [o.identifier for o in content.spec_objects]


def test_what_a_rule_carries_is_told_from_what_is_only_looked_up(mine: Path) -> None:
    rule = "confirm rule al.unknown_state_stays [MINE-C1]"
    mine.with_name("ruled.ecs").write_text(TEXT.replace("esi\n", f"{rule}\n\nesi\n"))
    model = Model(load_file(str(mine.with_name("ruled.ecs"))))
    trace = trace_device(model, ran(model, "al.unknown_state_stays", Outcome.PASS))
    assert by_id(trace)["MINE-C1"] is Standing.EXERCISED


def test_the_sheet_tells_why_nothing_exercises(traced: Trace) -> None:
    rows = {row[0]: row for row in clause_sheet(traced, traced.rows).rows}
    assert rows["MINE-C4"][5] == ("not exercised, with the reason: needs a motor",)
    assert rows["MINE-C3"][5] == ("not observable through the protocol: not in it",)
    assert rows["MINE-C2"][5] == ("row only",)
    assert rows["MINE-C1"][4] == ("pin refused_in_op",)
