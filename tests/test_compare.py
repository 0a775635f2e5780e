"""Tests of comparing runs: what is better, what is worse, what says nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from short import FAULT, SMALL, shorten

from ecatspec.conformance import cli
from ecatspec.conformance.base.devices import UserError, load
from ecatspec.conformance.base.verdict import Outcome, Verdict
from ecatspec.conformance.base.work_items import Judged, Learned
from ecatspec.conformance.results import run_file, run_history
from ecatspec.conformance.results.compare import as_data, compare, headline, sheets
from ecatspec.conformance.results.run_file import Basis, FoundWay, Run, begin

if TYPE_CHECKING:
    from pathlib import Path

Call = Callable[..., tuple[int, str, str]]

BASIS = Basis("mine", "00", "exec:x", {"name": "a board"}, "quick", 0, "", ())


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    def run(*arguments: str) -> tuple[int, str, str]:
        status = cli.main(arguments)
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


def run_of(**outcomes: str) -> Run:
    """Give a run: for each case an outcome, and where it has one a cause, which is its clause."""
    verdicts = []
    for case, words in outcomes.items():
        outcome, _, cause = words.partition(" ")
        clauses = (cause,) if cause else ()
        verdict = Verdict(case, Outcome(outcome), case, clauses=clauses, signature=cause)
        verdicts.append(verdict)
    return Run(BASIS, tuple(verdicts), finished=True)


@pytest.mark.parametrize(
    ("before", "after", "worse"),
    [
        ("pass", "pass", False),
        ("pass", "fail A", True),
        ("fail A", "pass", False),
        ("fail A", "fail A", False),
        ("fail A", "crash A", True),
        ("crash A", "fail A", True),  # less severe, and a finding that was not there
        ("fail A", "fail B", True),
        ("pass", "warning A", True),
        ("pass", "inconclusive", True),
        ("inconclusive", "skipped", False),
        ("skipped", "pass", False),
        ("error", "pass", False),
        ("pass", "error", True),
    ],
)
def test_what_is_worse(before: str, after: str, *, worse: bool) -> None:
    assert compare(run_of(a=before, z="pass"), run_of(a=after, z="pass")).worse is worse


def test_causes_and_clauses_are_counted() -> None:
    first = run_of(a="fail A", b="fail A", c="fail B", d="pass", e="fail D")
    second = run_of(a="fail A", b="pass", c="pass", d="fail C", e="fail D")
    found = compare(first, second)
    assert [(c.case, c.worse) for c in found.changes] == [("d", True), ("b", False), ("c", False)]
    assert [(f.clauses, f.standing) for f in found.findings] == [
        (("C",), "new"),
        (("A",), "2 before"),
        (("D",), "1 before"),
        (("B",), "gone"),
    ]
    assert [(c.name, c.before, c.after) for c in found.clauses] == [
        ("C", 0, 1),
        ("A", 2, 1),
        ("D", 1, 1),
        ("B", 1, 0),
    ]
    assert headline(found) == (
        "5 cases in common: 1 cases worse, 2 better; 1 findings new, 1 gone, 2 still there; "
        "0 choices changed"
    )


def test_what_only_one_run_tried_says_nothing() -> None:
    found = compare(run_of(a="pass", b="fail A"), run_of(a="pass", c="fail B", d="fail B"))
    assert not found.worse
    assert (found.common, found.findings, found.clauses) == (1, (), ())
    assert found.notes() == (
        "only the first run has 1 of its cases",
        "only the second run has 2 of its cases",
    )


def test_runs_of_two_kinds_are_told_apart() -> None:
    first = run_of(a="pass")
    other = replace(BASIS, seed=7, digest="1" * 64, only=("al",), dut="exec:y")
    second = Run(other, first.verdicts, finished=False)
    assert compare(first, second).notes() == (
        "other texts: 00 and 111111111111",
        "other seed: 0 and 7",
        "other only: none and al",
        "the second run is not finished: 1 cases",
    )


def going(way: str, case: str, risk: str = "") -> Run:
    """Give a run that found one choice."""
    found = {"counter": FoundWay(way, (case,), risk)}
    return Run(BASIS, run_of(a="pass").verdicts, finished=True, choices=found)


@pytest.mark.parametrize(
    ("before", "after", "standing"),
    [
        (("counts", ""), ("zero", "no order"), "worse"),
        (("zero", "no order"), ("counts", ""), "better"),
        (("counts", ""), ("backwards", ""), "other"),
        (("zero", "no order"), ("one", "no order either"), "other"),
    ],
)
def test_a_choice_that_changed(
    before: tuple[str, str], after: tuple[str, str], standing: str
) -> None:
    first, second = going(before[0], "one", before[1]), going(after[0], "two", after[1])
    found = compare(first, second)
    assert found.worse is (standing == "worse")
    assert headline(found).endswith("; 1 choices changed")
    risk = after[1] or f"before: {before[1]}" * bool(before[1])
    (sheet,) = sheets(found)
    assert sheet.rows == ((standing, "counter", before[0], after[0], ("one",), ("two",), risk),)
    assert as_data(found)["choices"] == [
        {
            "choice": "counter",
            "standing": standing,
            "worse": standing == "worse",
            "before": {"way": before[0], "cases": ("one",), "risk": before[1]},
            "after": {"way": after[0], "cases": ("two",), "risk": after[1]},
        }
    ]


def test_the_choice_that_is_worse_comes_first() -> None:
    first, second = (
        Run(BASIS, (), finished=True, choices={n: FoundWay(way, (), risk) for n, risk in each})
        for way, each in (("x", (("a", ""), ("b", ""))), ("y", (("a", ""), ("b", "bad"))))
    )
    assert [turn.choice for turn in compare(first, second).choices] == ["b", "a"]


def test_a_choice_that_only_one_run_found_says_nothing() -> None:
    for first, second in (
        (going("counts", "one"), going("counts", "two")),
        (going("counts", "one"), run_of(a="pass")),
        (run_of(a="pass"), going("zero", "two", "no order")),
    ):
        found = compare(first, second)
        assert (found.worse, found.choices) == (False, ())
        assert headline(found).endswith("; 0 choices changed")


def test_the_command_tells_choices(call: Call, tmp_path: Path) -> None:
    counted, zero = tmp_path / "counted", tmp_path / "zero"
    for file, way, risks in (
        (counted, "counts", {}),
        (zero, "zero", {"reply_counter": "no order"}),
    ):
        with begin(file, BASIS) as journal:
            verdict = Verdict("mailbox/one", Outcome.PASS, "one")
            learned = Learned({"reply_counter": way}, risks=risks)
            journal.keep(Judged("mailbox/one", verdict, learned))
            journal.finish()
    status, out, err = call("compare", str(counted), str(zero))
    assert (status, err) == (1, "")
    assert "choices of the device that changed" in out
    assert " ".join(out.splitlines()[-1].split()) == (
        "worse reply_counter counts zero mailbox/one mailbox/one no order"
    )
    status, out, _ = call("compare", str(zero), str(counted), "--json")
    assert status == 0
    (turn,) = json.loads(out)["choices"]
    assert (turn["standing"], turn["before"]["cases"]) == ("better", ["mailbox/one"])


def test_a_run_that_goes_on_is_the_last(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    protocol = load(SMALL)
    basis = replace(BASIS, device=SMALL, digest=protocol.digest)
    cases = [Judged(case, Verdict(case, Outcome.PASS, case), Learned()) for case in ("a", "b")]
    with run_history.begin(basis) as journal:
        for judged in cases:
            journal.keep(judged)
        journal.finish()
    finished = run_history.named("last")
    with run_history.begin(basis) as journal:
        journal.keep(cases[0])
        assert run_history.named("previous") == finished
        status, out, err = call("compare", "previous", "last")
        assert (status, err) == (0, "")
        assert out.startswith("1 cases in common: 0 cases worse, 0 better")
        assert "note: the second run is not finished: 1 cases\n" in out
        known = run_history.load(protocol)
        assert known is not None
        assert set(known.cases) == {"a", "b"}, "what goes on says too little"
        monkeypatch.setattr(run_file, "_PATIENCE", 0.1)
        with pytest.raises(UserError, match="a run is writing"):
            run_history.begin(basis, resume=True)
        finished.unlink()
        known = run_history.load(protocol)
        assert known is not None
        assert set(known.cases) == {"a"}


def test_the_command(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    status, out, err = call("compare", "previous", "last")
    assert (status, out) == (2, "")
    assert "no run is kept in" in err
    assert call("run", SMALL)[0] == 0
    assert "only one run of reference is kept" in call("compare", "previous", "last")[2]
    assert call("run", SMALL, "--dut", FAULT)[0] == 1
    status, out, err = call("compare", "previous", "last")
    assert (status, err) == (1, "")
    assert "findings new, 0 gone" in out
    assert "AL-08" in out
    status, out, _ = call("compare", "last", "previous", "--json")
    assert status == 0
    better = json.loads(out)
    assert (better["schema"], better["worse"]) == ("ecatspec.compare", False)
    assert {change["after"] for change in better["cases"]} == {"pass"}
    assert all(finding["after"] == 0 for finding in better["findings"])
    assert [run["dut"] for run in better["runs"]] == [FAULT, "model"]
    status, out, _ = call("compare", "last", str(run_history.named("last")))
    assert status == 0
    assert "0 cases worse, 0 better; 0 findings new, 0 gone" in out
    gone = str(tmp_path / "none")
    assert call("compare", "last", gone) == (
        2,
        "",
        f"ecatspec: there is no file '{gone}'; give a results file\n",
    )


def test_a_case_that_stands_twice_counts_at_its_worst() -> None:
    twice = Run(BASIS, (*run_of(a="fail A").verdicts, *run_of(a="pass").verdicts), finished=True)
    assert compare(run_of(a="pass"), twice).worse
