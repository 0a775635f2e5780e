"""Tests of the reports: what people and machines are told of a result."""

from __future__ import annotations

import importlib
import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ecatspec.conformance import reports
from ecatspec.conformance.base.verdict import Outcome, Result, SetUp, TraceLine, Verdict
from ecatspec.conformance.cli.colours import coloured
from ecatspec.conformance.render.marks import parts
from ecatspec.conformance.reports import REPORTS, judged
from ecatspec.conformance.reports.json_report import SCHEMA, VERSION, json_schema
from ecatspec.conformance.reports.text import WIDTH
from ecatspec.conformance.run.machine_coverage import Mark, Reached, lacking, reached
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.ir import Level, Pin, Protocol
from ecatspec.spec.language.load import load_device, load_standard

PROTOCOL = load_standard()
DRIVE = load_device("reference-drive")
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
    differing=("code",),
    blamed=("al.preop_skipping_refused",),
)
LONGER = replace(FAIL, case="al/refused/2", trace=(*FAIL.trace, *FAIL.trace))
CRASH = Verdict("sdo/7", Outcome.CRASH, "unknown command", observed="the device ended: 70")
SKIPPED = tuple(
    Verdict(f"al/{number}", Outcome.SKIPPED, "t", "al is not its own") for number in range(3)
)
PASS = Verdict("sdo/1", Outcome.PASS, "upload")


SET_UP = SetUp("standard", "exec:./my slave", "quick", 3, "40", "2026-01-02T03:04:05+00:00")


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
        set_up=SET_UP,
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
    assert lines[9:13] == [
        "",
        "findings",
        "   1  crash: unknown command, 1 case",
        "   2  fail: a change that the matrix does not allow [AL-08], 2 cases",
    ]


def risky(*pinned: str) -> tuple[Result, Protocol]:
    """A result with risky ways, some of which are from the text."""
    ways = {**ALL.choices, "repeat_service": "absent", "reply_counter": "zero"}
    pins = {name: Pin(name, ways[name], ()) for name in pinned}
    return replace(ALL, choices=ways), replace(PROTOCOL, pins=pins)


def test_risky_ways_that_were_found_come_first() -> None:
    found, protocol = risky()
    lines = REPORTS["text"]((found,), protocol).splitlines()
    assert lines[6:13] == [
        "  choices   repeat_service = absent (found) RISKY: a MainDevice cannot get a",
        "            lost reply: its request, sent again, is dropped as a duplicate",
        "            reply_counter = zero (found) RISKY: a MainDevice cannot tell a",
        "            repeated message from a new one",
        "            bootstrap = supported (found)",
        "            refused_in_op = stay (found)",
        "  time      1.3 s",
    ]
    (data,) = json.loads(REPORTS["json"]((found,), protocol))["results"]
    assert data["risky"] == protocol.risks(found.choices)
    assert list(data["risky"]) == ["repeat_service", "reply_counter"]
    assert data["choices"] == found.choices
    page = REPORTS["html"]((found,), protocol)
    assert page.count('<span class="badge warning">risky</span>') == 2
    first, _, rest = page.partition("Table of choices")[2].partition("repeat_service")
    assert 'scope="row"' in first
    assert first.count("</tr>") == 1, "only the head stands before it"
    assert '<span class="badge warning">risky</span> a MainDevice cannot get' in rest


def test_a_risky_way_that_the_text_states_is_known() -> None:
    found, protocol = risky("repeat_service")
    report = REPORTS["text"]((found,), protocol)
    assert "repeat_service = absent (from the text)\n" in report
    assert report.count("RISKY") == 1
    (data,) = json.loads(REPORTS["json"]((found,), protocol))["results"]
    assert list(data["risky"]) == ["reply_counter"]
    assert REPORTS["html"]((found,), protocol).count(">risky<") == 1


def test_what_a_device_cannot_reach_is_told_apart() -> None:
    bounded = replace(ALL, rules_beyond=("al.d", "al.c"), clauses_beyond=("AL-28",))
    assert text(bounded).splitlines()[4:6] == [
        "  rules     2 of 7 that the device can reach (2 more are not its own)",
        "  clauses   1 of 9 that the device can reach (1 more is not its own)",
    ]
    results = loaded(bounded)["results"]
    assert isinstance(results, list)
    assert results[0]["rules"] == {
        "covered": ["al.a", "al.b"],
        "total": 7,
        "beyond": ["al.c", "al.d"],
    }
    assert results[0]["clauses"]["beyond"] == ["AL-28"]


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
    command = "ecatspec run standard --dut 'exec:./my slave' --mailbox 40"
    assert f"  replay    {command} --replay al/refused/1" in lines
    assert f"  replay    {command} --replay case.eNqr" in lines
    results = loaded(found)["results"]
    assert isinstance(results, list)
    replays = {finding["case"]: finding["replay"] for finding in results[0]["findings"]}
    assert replays == {"al/refused/1": "al/refused/1", "sdo/7": "case.eNqr"}
    commands = {finding["case"]: finding["command"] for finding in results[0]["findings"]}
    assert commands["sdo/7"] == f"{command} --replay case.eNqr"


def test_what_was_no_run_is_not_run_again() -> None:
    captured = replace(result(FAIL), set_up=None)
    assert "replay" not in text(captured)
    assert "case      al/refused/1" in text(captured)
    results = loaded(captured)["results"]
    assert isinstance(results, list)
    assert results[0]["set_up"] is results[0]["findings"][0]["command"] is None


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
    assert "one of - al_status_code: >code 0x0011< - al_status_code: >code 0x0012<" in said
    assert "observed al_status_code: >code 0x0000<" in said


def chart(*lines: TraceLine, outcome: Outcome = Outcome.FAIL) -> list[str]:
    """The sequence chart of a verdict, from its heading on."""
    said = text(result(replace(FAIL, outcome=outcome, trace=lines))).splitlines()
    first = next(n for n, line in enumerate(said) if line.startswith("  trace"))
    return said[first : said.index("", first) - 1]


def test_the_shortest_trace_is_a_sequence_chart() -> None:
    lines = text(ALL).splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("  trace"))
    assert lines[first : first + 4] == [
        "  trace   MainDevice  SubDevice",
        "     0.000 ms  |---------->|  writes x",
        "    12.345 ms  |<----------|  shows y shows y shows y shows y shows y shows y",
        "               |           |  shows y shows y shows y shows y shows y shows y",
    ]
    assert sum("writes x" in line for line in lines) == 1


def test_a_chart_has_the_bytes_of_messages() -> None:
    assert chart(TraceLine(0, "SubDevice", "answers x", b"\x0a\x00\xff"))[1:] == [
        "    0.000 ms  |<----------|  answers x",
        "              |           |  0A 00 FF",
    ]


def test_what_does_not_go_over_the_bus_has_no_arrow() -> None:
    lines = chart(
        TraceLine(0, "MainDevice", "waits 5.0 ms"),
        TraceLine(0, "SubDevice", "has the local event sync lost"),
        TraceLine(0, "reason", "SyncManager 2 length 3"),
    )
    assert [line[14:27] for line in lines[1:]] == ["|           |"] * 3


def test_a_crash_ends_the_line_of_the_device() -> None:
    lines = chart(
        TraceLine(0, "MainDevice", "sends x"),
        TraceLine(0, "SubDevice", "the device ended"),
        outcome=Outcome.CRASH,
    )
    assert [line[14:27] for line in lines[1:]] == ["|---------->|", "|           X"]


@pytest.mark.parametrize(
    ("words", "differing", "marked"),
    [
        ("sdo_abort: counter 2, index 0x1000", ("index",), ["index 0x1000"]),
        ("sdo_abort: counter 2, index 0x1000", ("sdo_abort",), ["sdo_abort"]),
        (
            "a: state 2 PREOP, error no; b: code 0x0011",
            ("error", "code"),
            ["error no", "code 0x0011"],
        ),
        ("a: index 1, subindex 2", ("index",), ["index 1"]),
        ("a: state in OP", ("in",), []),
        ("mailbox empty: no reply", (), []),
    ],
)
def test_the_fields_that_differ_are_marked(
    words: str, differing: tuple[str, ...], marked: list[str]
) -> None:
    found = list(parts(words, differing))
    assert "".join(part for part, _ in found) == words
    assert [part for part, differs in found if differs] == marked


def test_colours_change_no_letter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    said = coloured(text(ALL))
    assert "\x1b[1;31m1. CRASH" in said
    assert re.sub(r"\x1b\[[0-9;]*m", "", said) == text(ALL)
    monkeypatch.setenv("NO_COLOR", "1")
    plain = coloured(text(ALL))
    assert not re.search(r"\x1b\[[0-9;]*3[0-9]m", plain)


def test_a_clause_that_no_text_declares_is_named() -> None:
    unknown = replace(FAIL, clauses=("XX-99",))
    assert "broken    XX-99" in text(result(unknown))
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


def test_what_was_not_shown_is_no_success() -> None:
    inconclusive = replace(PASS, outcome=Outcome.INCONCLUSIVE, reason="needs AL state OP, why")
    missing = replace(result(PASS, inconclusive), unreached=("OP",))
    assert not missing.conforms
    assert "  NOT SHOWN: OP was never reached (needs AL state OP, why)" in text(missing)
    data = json.loads(REPORTS["json"]((missing,), PROTOCOL))
    assert (data["conforms"], data["results"][0]["conclusion"]) == (False, "not shown")
    assert data["results"][0]["unreached"] == ["OP"]
    assert "Not shown: OP was never reached" in REPORTS["html"]((missing,), PROTOCOL)
    # what blames the device goes first, and an interrupted run was not done
    assert "DOES NOT CONFORM" in text(replace(missing, verdicts=(FAIL,)))
    assert "conforms (interrupted" in text(replace(missing, interrupted=True))


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
    assert one["rules"] == {"covered": ["al.a", "al.b"], "total": 7, "beyond": []}
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


def test_the_schema_of_json_is_shipped() -> None:
    shipped = resources.files("ecatspec.conformance.reports").joinpath("report.schema.json")
    wanted = json.dumps(json_schema(), indent=2, sort_keys=True) + "\n"
    assert shipped.read_text("utf-8") == wanted, (
        "make it again: ecatspec schema report > conformance/reports/report.schema.json"
    )
    jsonschema.Draft202012Validator.check_schema(json_schema())


def validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(json_schema())


@given(st.lists(verdicts, max_size=4), st.sampled_from((SET_UP, None)))
def test_json_is_what_its_schema_says(said: list[Verdict], set_up: SetUp | None) -> None:
    validator().validate(loaded(replace(result(*said), set_up=set_up)))


def test_the_schema_is_closed() -> None:
    for place in ([], ["results", 0], ["results", 0, "findings", 0], ["results", 0, "verdicts", 0]):
        data: Any = loaded(ALL)
        part = data
        for key in place:
            part = part[key]
        part["surplus"] = 1
        assert not validator().is_valid(data), place
        del part["surplus"]
        validator().validate(data)


# --- JUnit ----------------------------------------------------------------------------------------


def junit(*results: Result) -> ET.Element:
    return ET.fromstring(REPORTS["junit"](results, PROTOCOL))


def case_of(root: ET.Element, name: str) -> ET.Element:
    (found,) = (case for case in root.iter("testcase") if case.get("name") == name)
    return found


def test_junit_has_one_test_for_each_clause() -> None:
    root = junit(ALL)
    names = [case.attrib["name"] for case in root.iter("testcase")]
    assert sorted(names) == sorted([*PROTOCOL.clauses, "run"])
    told = {p.attrib["name"]: p.attrib["value"] for p in case_of(root, "AL-08").iter("property")}
    assert told == {"level": "must", "wording": CLAUSE.wording, "source": CLAUSE.source}


def test_junit_counts_what_is_there() -> None:
    root = junit(ALL)
    for holder in (root, *root.iter("testsuite")):
        cases = list(holder.iter("testcase"))
        assert int(holder.attrib["tests"]) == len(cases)
        for key, kind in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
            assert int(holder.attrib[key]) == sum(c.find(kind) is not None for c in cases)


def test_junit_tells_what_went_wrong() -> None:
    root = junit(ALL)
    failure = case_of(root, "AL-08").find("failure")
    assert failure is not None
    assert failure.attrib == {"message": FAIL.title, "type": "fail"}
    assert "observed: al_status_code: code 0x0000" in str(failure.text)
    assert "also in 1 other case" in str(failure.text)
    assert "--replay al/refused/1" in str(failure.text)
    crash = case_of(root, "run").find("failure")  # it cites no clause
    assert crash is not None
    assert crash.get("type") == "crash"


def test_junit_says_what_was_not_shown() -> None:
    skipped = case_of(junit(ALL), "AL-01").find("skipped")
    assert skipped is not None
    held = replace(PASS, rules=("al.init_to_preop",))
    assert case_of(junit(result(held)), "AL-03").find("skipped") is None


def test_junit_has_no_test_of_what_the_device_cannot_reach() -> None:
    held = replace(PASS, rules=("al.init_to_preop",))
    beyond = ("DRV-05", "AL-03", "AL-08", "AL-99")
    root = junit(replace(result(FAIL, held), clauses_beyond=beyond))
    names = {case.attrib["name"] for case in root.iter("testcase")}
    # what was seen of a device after all is told
    assert PROTOCOL.clauses.keys() - names == {"DRV-05"}
    (number,) = (
        each.get("value")
        for each in root.iter("property")
        if each.get("name") == "clauses not of this device"
    )
    assert number == "1"


def test_nothing_judged_is_an_error_in_junit() -> None:
    root = junit(result(*SKIPPED))
    assert case_of(root, "run").find("error") is not None
    assert root.get("errors") == "1"


def test_a_warning_is_no_failure_in_junit() -> None:
    case = case_of(junit(result(replace(FAIL, outcome=Outcome.WARNING))), "AL-08")
    assert case.find("failure") is None
    assert "warning: a change" in str(case.findtext("system-out"))


def test_a_clause_that_allows_does_not_fail_in_junit() -> None:
    root = junit(result(replace(FAIL, clauses=("AL-08", "AL-10"))))
    assert PROTOCOL.clauses["AL-10"].level is Level.MAY
    assert case_of(root, "AL-10").find("failure") is None
    assert case_of(root, "AL-08").find("failure") is not None
    lonely = junit(result(replace(CRASH, clauses=("AL-10",))))
    assert case_of(lonely, "run").find("failure") is not None  # somewhere it has to be told


def test_names_in_junit_are_unique() -> None:
    root = junit(ALL, result(PASS))
    names = [(c.attrib["classname"], c.attrib["name"]) for c in root.iter("testcase")]
    assert len(set(names)) == len(names)


def test_junit_stays_small() -> None:
    """GitLab takes 30 MB: a finding for every clause and many more, each with a long trace."""
    long = tuple(TraceLine(n, "MainDevice", "writes " * 200) for n in range(500))
    findings = [
        replace(FAIL, case=f"al/{n}", signature=str(n), clauses=tuple(PROTOCOL.clauses), trace=long)
        for n in range(100)
    ]
    size = len(REPORTS["junit"]((result(*findings),), PROTOCOL))
    assert size / len(PROTOCOL.clauses) < 30_000_000 / 800  # no device has so many clauses


@settings(max_examples=10)  # each looks through all texts
@given(st.lists(verdicts, max_size=4))
def test_junit_holds_whatever_is_said(said: list[Verdict]) -> None:
    junit(result(*said))


# --- HTML -----------------------------------------------------------------------------------------


def page(*results: Result) -> str:
    return REPORTS["html"](results, PROTOCOL)


def test_the_page_needs_nothing_else() -> None:
    said = page(ALL)
    outside = re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?([^"'#)\s>][^"')\s>]*)""", said)
    assert set(outside) == {"data:,"}
    assert "@import" not in said


def test_every_link_of_the_page_has_its_place() -> None:
    said = page(ALL, result(PASS))
    places = re.findall(r' id="([^"]+)"', said)
    assert len(set(places)) == len(places)
    assert set(re.findall(r'href="#([^"]+)"', said)) <= set(places)


def test_words_of_a_device_do_not_become_markup() -> None:
    evil = "<script>alert(1)</script>"
    said = page(replace(result(replace(FAIL, observed=evil, title=evil)), subject=evil))
    assert evil not in said
    assert said.count("&lt;script&gt;alert(1)") >= 3


def test_the_page_tells_which_bytes_are_which_field() -> None:
    data = bytes.fromhex("0a000000000300304300100000000000")
    lines = (TraceLine(0, "SubDevice", "answers x", data),)
    said = page(result(replace(FAIL, trace=lines, differing=("index",))))
    assert re.search(
        r'<tr class="differs"><td>9 to 10</td><td><code>00 10</code></td>'
        r'<th scope="row">index</th><td><mark>0x1000</mark></td>',
        said,
    )
    assert "<td>6 to 7, bits 0 to 8</td>" in said
    assert '<td>5, bits 0 to 3</td><td><code>03</code></td><th scope="row">type</th>' in said


def test_the_page_colours_what_was_exercised_and_blamed() -> None:
    gone = replace(result(FAIL), rules_covered=("al.init_to_preop",))
    said = page(gone)
    assert re.search(r'<text [^>]*class="exercised"[^>]*>init_to_preop<', said)
    assert re.search(r'<text [^>]*class="blamed"[^>]*>preop_skipping_refused<', said)


def test_the_page_says_where_it_comes_from() -> None:
    said = page(ALL)
    for word in (PROTOCOL.digest, "exec:./my slave", "2026-01-02T03:04:05+00:00", "quick"):
        assert word in said


def diagrams(said: str) -> list[str]:
    return re.findall(r'aria-label="Diagram of the machine (\w+)"', said)


def test_the_page_draws_every_machine_that_the_device_has() -> None:
    several = [name for name, machine in DRIVE.machines.items() if len(machine.states) > 1]
    assert {"al", "ds402", "process_data", "sdo", "sdo_information"} <= set(several)
    assert diagrams(REPORTS["html"]((result(),), DRIVE)) == several
    # the standard declares no words of a drive
    assert set(several) - set(diagrams(page(result()))) == {"ds402"}
    assert "ds402: the texts declare no control and status word" in page(result())


def test_the_page_names_each_rule_once_in_the_whole_run() -> None:
    ran = replace(result(FAIL), rules_covered=("al.init_to_preop", "ds402.cause_gone"))
    said = page(ran)
    whole = said[said.index(' id="run-1-whole"') : said.index(' id="run-1-machines"')]
    named = re.findall(r"<span title=[^>]*>(\w+)</span>", whole)
    rules = [
        rule.name for name, m in PROTOCOL.machines.items() if name != "ds402" for rule in m.rules
    ]
    assert sorted(named) == sorted(rules)
    (counts,) = re.findall(r"#run-1-rules-al.*", whole)
    numbers = [int(number) for number in re.findall(r"<td[^>]*>(\d+)</td>", counts)]
    assert numbers[:2] == [1, 1]
    assert sum(numbers[:4]) == numbers[4] == len(PROTOCOL.machines["al"].rules)
    # every group says in words what its colour says
    groups = re.findall(r'<p class="(\w+)"><b>(\S) ([^,:]+)', whole)
    assert {kind: (sign, words) for kind, sign, words in groups} == {
        "exercised": ("\N{CHECK MARK}", "exercised"),
        "blamed": ("\N{BALLOT X}", "blamed"),
        "unreached": ("\N{WHITE CIRCLE}", "not exercised"),
        "impossible": ("\N{EN DASH}", "cannot fire"),
    }


def test_the_page_stays_small() -> None:
    """Pictures and the whole run say of each rule once on what it fires, and by which clauses."""
    said = REPORTS["html"]((result(),), DRIVE)
    rules = sum(len(machine.rules) for machine in DRIVE.machines.values())
    clauses = said[said.index(' id="run-1-clauses"') : said.index(' id="run-1-choices"')]
    assert len(said) - len(clauses) < 700 * rules


# --- whole run ------------------------------------------------------------------------------------

DRIVEN = replace(PASS, case="ds402/1")


def found(ran: Result, protocol: Protocol, rule: str) -> Reached:
    machine, _, name = rule.partition(".")
    (one,) = (r for r in reached(ran, Model(protocol))[machine] if r.rule.name == name)
    return one


def why(ran: Result, rule: str) -> str:
    one = found(ran, DRIVE, rule)
    assert one.mark is Mark.UNREACHED
    return one.why


def test_a_rule_is_exercised_or_blamed() -> None:
    ran = replace(result(FAIL), rules_covered=("al.init_to_preop", *FAIL.blamed))
    assert found(ran, PROTOCOL, "al.init_to_preop").mark is Mark.EXERCISED
    assert found(ran, PROTOCOL, FAIL.blamed[0]).mark is Mark.BLAMED  # whatever else it showed
    warned = replace(result(replace(FAIL, outcome=Outcome.WARNING)), rules_covered=())
    assert found(warned, PROTOCOL, FAIL.blamed[0]).mark is Mark.UNREACHED


def test_a_rule_that_the_choices_rule_out_cannot_fire() -> None:
    one = found(result(PASS), DRIVE, "al.copied_down")
    assert one.mark is Mark.IMPOSSIBLE
    assert one.why == "the device goes another way: emulation = none (from the text)"
    refused = "al.op_skipping_drops"
    assert found(replace(result(PASS), choices={}), DRIVE, refused).mark is Mark.UNREACHED
    told = found(replace(result(PASS), choices={"refused_in_op": "stay"}), DRIVE, refused)
    assert told.mark is Mark.IMPOSSIBLE
    assert told.why == "the device goes another way: refused_in_op = stay (found)"


def test_a_rule_of_states_that_were_never_reached_says_so() -> None:
    needs = replace(
        DRIVEN, case="al/1", outcome=Outcome.INCONCLUSIVE, reason="needs AL state OP, x"
    )
    tried = replace(PASS, case="al/2")
    missing = replace(result(tried, needs), rules_covered=("al.init_to_preop",), unreached=("OP",))
    assert why(missing, "al.op_to_safeop") == "OP was never reached (needs AL state OP, x)"
    assert why(missing, "al.boot_kept") == "the machine was never surely in BOOT"
    assert why(missing, "al.preop_kept") == "no case of the depth quick surely went by it"
    said = REPORTS["html"]((missing,), DRIVE)
    assert re.search(r"OP <span[^>]*>\(OP never reached\)</span></th>", said)


def test_a_machine_that_no_case_tried_says_so() -> None:
    assert why(result(PASS), "al.init_to_preop") == "no case of al was run"
    skipped = "al is not the device's own: X supplies sdo"
    left = tuple(replace(each, reason=skipped) for each in SKIPPED)
    words = f"every case of al was left unjudged: {skipped}"
    assert why(result(PASS, *left), "al.init_to_preop") == words


def test_a_rule_whose_event_cannot_be_raised_says_so() -> None:
    words = "X cannot raise fault, mains_off"
    refused = replace(DRIVEN, case="ds402/2", outcome=Outcome.SKIPPED, reason=words)
    assert why(result(DRIVEN, refused), "ds402.fault_13") == words
    assert "depth quick" in why(result(DRIVEN, refused), "ds402.cause_gone")


def test_a_rule_without_another_reason_says_what_the_run_was() -> None:
    ran = result(DRIVEN)
    rule = "ds402.fault_13"
    assert why(ran, rule) == "no case of the depth quick surely went by it"
    assert why(replace(ran, set_up=replace(SET_UP, depth="exhaustive")), rule).startswith(
        "no case s"
    )
    assert why(replace(ran, interrupted=True), rule) == "the run was interrupted"
    assert why(replace(ran, set_up=None), rule) == "nothing that was captured surely went by it"


def test_a_device_lacks_machines() -> None:
    assert lacking(Model(DRIVE)) == {}
    assert set(lacking(Model(PROTOCOL))) == {"ds402"}
    silent = replace(PROTOCOL, pins={"mailbox_support": Pin("mailbox_support", "absent", ())})
    gone = {"ds402", "mailbox", "coe", "sdo", "sdo_information", "emergency"}
    assert set(lacking(Model(silent))) == gone
    # what is blamed is shown all the same
    blamed = result(replace(FAIL, blamed=("ds402.fault_13",)))
    assert set(reached(blamed, Model(silent))) == {"al", "process_data", "ds402"}


# --- annotations ----------------------------------------------------------------------------------


def test_github_gets_a_line_for_each_finding() -> None:
    lines = REPORTS["github"]((ALL,), PROTOCOL).splitlines()
    assert [line.partition("::")[2].partition(" ")[0] for line in lines] == ["error", "error"]
    assert lines[1].startswith("::error title=fail%3A a change that the matrix does not allow::")
    assert "%0Aobserved: al_status_code: code 0x0000%0A" in lines[1]


def test_a_device_cannot_give_github_commands() -> None:
    evil = replace(FAIL, observed="100%\n::set-output name=x::y", title="a,b:c")
    (line,) = REPORTS["github"]((result(evil),), PROTOCOL).splitlines()
    assert "title=fail%3A a%2Cb%3Ac::" in line
    assert "100%25 ::set-output" in line


def test_github_gets_no_more_than_it_shows() -> None:
    many = [replace(FAIL, case=str(n), signature=str(n)) for n in range(60)]
    lines = REPORTS["github"]((result(*many),), PROTOCOL).splitlines()
    assert len(lines) == 51
    assert lines[-1] == "::notice::10 findings more, see the report"


def test_reports_are_loaded_when_used(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    real = importlib.import_module

    def note(name: str, package: str | None = None) -> object:
        asked.append(name)
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", note)
    REPORTS["json"]((), PROTOCOL)
    assert asked == ["ecatspec.conformance.reports.json_report"]


# --- all forms together ---------------------------------------------------------------------------

OTHER = replace(FAIL, case="al/x", signature="other", causes=("b", "c"), clauses=("AL-09",))
SAME = replace(OTHER, case="al/y", signature="another", causes=("c", "d"), title="y, but no")
WARNED = replace(FAIL, case="al/w", outcome=Outcome.WARNING, signature="w", clauses=("AL-10",))
KNOWN = replace(FAIL, case="al/k", outcome=Outcome.KNOWN, signature="k", clauses=("AL-11",))
EVERY = result(PASS, FAIL, LONGER, OTHER, SAME, WARNED, KNOWN, CRASH)


def test_all_forms_count_the_same_findings() -> None:
    made = {name: REPORTS[name]((EVERY,), PROTOCOL) for name in REPORTS}
    findings = EVERY.findings()
    assert [finding.verdict.case for finding in findings] == [
        "sdo/7",
        "al/refused/1",
        "al/x",
        "al/w",
        "al/k",
    ]
    assert ": 5 findings" in made["text"]
    assert len(re.findall(r"^\d+\. ", made["text"], re.MULTILINE)) == len(findings)
    (data,) = json.loads(made["json"])["results"]
    assert len(data["findings"]) == len(findings)
    assert made["html"].count("<article ") == len(findings)
    assert len(made["github"].splitlines()) == len(findings)
    (run,) = json.loads(made["sarif"])["runs"]
    assert len(run["results"]) == len(findings)
    # a test for each clause that is broken, and the run for what breaks none
    assert ET.fromstring(made["junit"]).get("failures") == "3"
    levels = [found["level"] for found in run["results"]]
    assert levels == ["error", "error", "error", "warning", "note"]


def test_what_else_was_seen_of_a_cause_is_told_with_it() -> None:
    (finding,) = result(OTHER, SAME, SAME).findings()
    assert [(kind.case, count) for kind, count in finding.kinds] == [("al/y", 2)]
    assert finding.also == ("al/y", "al/y")
    said = "y, but no [AL-09]: al/y, 2 cases"
    plain = " ".join(text(result(OTHER, SAME, SAME)).split())
    assert f"seen too - {said}" in plain
    for name in ("html", "junit", "sarif", "github"):
        assert said in REPORTS[name]((result(OTHER, SAME, SAME),), PROTOCOL).replace("%2C", ",")
    (data,) = json.loads(REPORTS["json"]((result(OTHER, SAME, SAME),), PROTOCOL))["results"]
    assert data["findings"][0]["kinds"] == [
        {
            "signature": "another",
            "title": "y, but no",
            "case": "al/y",
            "clause": "AL-09",
            "cases": 2,
        }
    ]


def test_causes_are_put_together_over_others() -> None:
    one, two, three = (
        replace(FAIL, signature=name, causes=causes)
        for name, causes in (("1", ("a",)), ("2", ("b",)), ("3", ("a", "b")))
    )
    assert len(result(one, two).findings()) == 2
    assert len(result(one, two, three).findings()) == 1
    assert len(result(one, replace(three, outcome=Outcome.WARNING)).findings()) == 2


def test_sarif_names_the_clause_its_place_and_the_identity(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def first() -> dict[str, Any]:
        (run,) = json.loads(REPORTS["sarif"]((result(FAIL, LONGER),), PROTOCOL))["runs"]
        (found,) = run["results"]
        assert run["tool"]["driver"]["rules"][found["ruleIndex"]] == {
            "id": "AL-08",
            "shortDescription": {"text": CLAUSE.wording},
        }
        assert isinstance(found, dict)
        return found

    found = first()
    assert found["partialFingerprints"] == {"ecatspec/identity": "same cause"}
    assert (found["occurrenceCount"], found["ruleId"]) == (2, "AL-08")
    assert "--replay al/refused/1" in found["message"]["text"]
    (where,) = found["locations"]
    assert where == {"logicalLocations": [{"fullyQualifiedName": "al/refused/1"}]}
    file = tmp_path / CLAUSE.at.file
    file.parent.mkdir(parents=True)
    file.write_text("", encoding="utf-8")
    (where,) = first()["locations"]
    place = where["physicalLocation"]
    assert place["artifactLocation"]["uri"] == CLAUSE.at.file
    assert place["region"]["startLine"] == CLAUSE.at.line
