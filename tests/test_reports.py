"""The only place for the tests of the reports: what people and machines are told of a result."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ecatspec.conformance import reports
from ecatspec.conformance.reports import REPORTS, judged
from ecatspec.conformance.reports.json_report import SCHEMA, VERSION
from ecatspec.conformance.reports.text import WIDTH
from ecatspec.conformance.verdict import Outcome, Result, TraceLine, Verdict
from ecatspec.spec.language.load import load_standard

PROTOCOL = load_standard()
CLAUSE = PROTOCOL.clauses["AL-08"]

FAIL = Verdict(
    "al/refused/1",
    Outcome.FAIL,
    "a change that the matrix does not allow",
    "no state explains it",
    ("al_status_code: code 0x0011", "al_status_code: code 0x0012"),
    "al_status_code: code 0x0000",
    ("AL-08",),
    ("AKD-C31",),
    (TraceLine(0, "MainDevice", "writes x"), TraceLine(12_345, "SubDevice", "shows y " * 20)),
    "12.3 ms",
    "same cause",
)
LONGER = replace(FAIL, case="al/refused/2", trace=(*FAIL.trace, *FAIL.trace))
CRASH = Verdict("sdo/7", Outcome.CRASH, "unknown command", observed="the device ended: 70")
SKIPPED = tuple(
    Verdict(f"al/{number}", Outcome.SKIPPED, "t", "al is not its own") for number in range(3)
)
PASS = Verdict("sdo/1", Outcome.PASS, "upload")


def result(*verdicts: Verdict) -> Result:
    return Result(
        "standard",
        "a device",
        verdicts,
        ("al.b", "al.a"),
        7,
        ("AL-08",),
        9,
        1.26,
        {"refused_in_op": "stay", "bootstrap": "supported"},
        ("a note",),
    )


ALL = result(PASS, FAIL, LONGER, CRASH, *SKIPPED)


def text(*results: Result) -> str:
    return REPORTS["text"](results, PROTOCOL)


def loaded(*results: Result) -> dict[str, object]:
    data = json.loads(REPORTS["json"](results, PROTOCOL))
    assert isinstance(data, dict)
    return data


def test_every_report_of_the_folder_is_in_the_table() -> None:
    folder = Path(reports.__path__[0])
    files = {path.stem.removesuffix("_report") for path in folder.glob("*.py")} - {"__init__"}
    assert set(REPORTS) == files


@pytest.mark.parametrize("name", sorted(REPORTS))
def test_no_results_is_a_report_too(name: str) -> None:
    assert isinstance(REPORTS[name]((), PROTOCOL), str)


def test_the_summary_comes_first() -> None:
    lines = text(ALL).splitlines()
    assert lines[:9] == [
        "standard, tested: a device",
        "  DOES NOT CONFORM: 2 findings",
        "",
        "  cases     1 pass, 2 fail, 3 skipped, 1 crash",
        "  rules     2 of 7 covered",
        "  clauses   1 of 9 covered",
        "  choices   bootstrap = supported (found)",
        "            refused_in_op = stay (found)",
        "  time      1.3 s",
    ]


def test_the_suites_of_a_run_stand_in_the_summary() -> None:
    promises = ("AL, 30 states: checked: exact; passed", "DS402: promises nothing: 1 fail")
    promised = replace(ALL, guarantees=promises)
    lines = text(promised).splitlines()
    assert lines[8:11] == [
        f"  suites    {promises[0]}",
        f"            {promises[1]}",
        "  time      1.3 s",
    ]
    results = loaded(promised)["results"]
    assert isinstance(results, list)
    assert results[0]["guarantees"] == list(promises)


def test_a_finding_says_how_to_see_it_again() -> None:
    found = result(FAIL, replace(CRASH, replay="case.eNqr"))
    lines = text(found).splitlines()
    assert "  replay    --replay al/refused/1" in lines
    assert "  replay    --replay case.eNqr" in lines
    results = loaded(found)["results"]
    assert isinstance(results, list)
    replays = {finding["case"]: finding["replay"] for finding in results[0]["findings"]}
    assert replays == {"al/refused/1": "al/refused/1", "sdo/7": "case.eNqr"}


def test_a_long_token_stays_whole() -> None:
    token = "case." + "aB3_-" * 60
    assert f"--replay {token}" in text(result(replace(FAIL, replay=token)))


def test_findings_come_once_and_crashes_first() -> None:
    said = text(ALL)
    assert said.index("1. CRASH: unknown command") < said.index("2. FAIL: a change that")
    assert said.count("FAIL:") == 1
    assert "1 other case shows the same" in said
    assert "3 cases skipped: al is not its own" in said


def test_a_finding_cites_its_clause() -> None:
    said = " ".join(text(ALL).split())
    assert f"AL-08 must: {CLAUSE.wording} source: {CLAUSE.source}" in said
    assert "claims AKD-C31" in said
    assert "expected one of - al_status_code: code 0x0011 - al_status_code: code 0x0012" in said
    assert "observed al_status_code: code 0x0000" in said


def test_the_shortest_trace_is_shown_in_columns() -> None:
    lines = text(ALL).splitlines()
    first = lines.index("  trace") + 1
    assert lines[first] == "     0.000 ms  MainDevice  writes x"
    assert lines[first + 1].startswith("    12.345 ms  SubDevice   shows y shows y")
    assert lines[first + 2].startswith(" " * 27 + "y")
    assert sum("MainDevice" in line for line in lines) == 1


def test_a_clause_that_no_text_declares_is_named() -> None:
    unknown = replace(FAIL, clauses=("XX-99",))
    assert "clause    XX-99" in text(result(unknown))
    assert '"id": "XX-99"' in REPORTS["json"]((result(unknown),), PROTOCOL)


def test_a_device_cannot_speak_to_the_terminal() -> None:
    said = text(result(replace(FAIL, observed="\x1b[2Jgone\nnext\x07\u202e")))
    assert "\x1b" not in said
    assert "\x07" not in said
    assert r"\x1b[2Jgone next\x07\u202e" in said


def test_nothing_judged_is_no_success() -> None:
    silent = result(*SKIPPED)
    assert not judged(silent)
    assert "NOT JUDGED" in text(silent)
    assert "conforms" not in text(silent)
    assert judged(ALL)


def test_an_interrupted_run_says_so() -> None:
    assert "conforms (interrupted" in text(replace(result(PASS), interrupted=True))


def test_several_results_stand_one_after_the_other() -> None:
    assert text(ALL, result(PASS)).count("tested: a device") == 2


words = st.text(max_size=200)
verdicts = st.builds(
    Verdict,
    words,
    st.sampled_from(Outcome),
    words,
    words,
    st.lists(words, max_size=3).map(tuple),
    words,
    st.lists(words, max_size=3).map(tuple),
    st.lists(words, max_size=3).map(tuple),
    st.lists(st.builds(TraceLine, st.integers(0), words, words), max_size=3).map(tuple),
    words,
    words,
)


@given(st.lists(verdicts, max_size=4))
def test_whatever_is_said_fits_the_page(said: list[Verdict]) -> None:
    lines = text(result(*said)).split("\n")
    assert all(line.isprintable() for line in lines)
    lines = [line for line in lines if not line.startswith("  replay ")]  # to be copied whole
    assert all(len(line) <= WIDTH for line in lines)
    assert not any(line != line.rstrip() for line in lines)


@given(st.lists(verdicts, max_size=4))
def test_json_holds_whatever_is_said(said: list[Verdict]) -> None:
    data = loaded(result(*said))
    results = data["results"]
    assert isinstance(results, list)
    assert len(results[0]["verdicts"]) == len(said)


def test_json_has_what_the_text_has() -> None:
    data = loaded(ALL)
    assert (data["schema"], data["schema_version"]) == (SCHEMA, VERSION)
    assert data["conforms"] is False
    assert data["specification"] == {"name": "standard", "digest": PROTOCOL.digest}
    results = data["results"]
    assert isinstance(results, list)
    (one,) = results
    assert one["rules"] == {"covered": ["al.a", "al.b"], "total": 7}
    assert one["cases"]["skipped"] == 3
    assert [finding["outcome"] for finding in one["findings"]] == ["crash", "fail"]
    fail = one["findings"][1]
    assert fail["clauses"][0]["wording"] == CLAUSE.wording
    assert fail["also"] == ["al/refused/2"]
    assert fail["trace"][1]["microseconds"] == 12_345
    assert [verdict["case"] for verdict in one["verdicts"]] == sorted(v.case for v in ALL.verdicts)


def test_json_differs_in_the_time_alone() -> None:
    first = REPORTS["json"]((ALL,), PROTOCOL)
    again = replace(
        ALL,
        seconds=99.0,
        rules_covered=ALL.rules_covered[::-1],
        choices=dict(reversed(ALL.choices.items())),
    )
    second = REPORTS["json"]((again,), PROTOCOL)
    differing = [
        one for one, two in zip(first.splitlines(), second.splitlines(), strict=True) if one != two
    ]
    assert [line.strip() for line in differing] == ['"seconds": 1.26,']


def test_reports_are_loaded_when_used(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    real = importlib.import_module

    def note(name: str, package: str | None = None) -> object:
        asked.append(name)
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", note)
    REPORTS["json"]((), PROTOCOL)
    assert asked == ["ecatspec.conformance.reports.json_report"]
