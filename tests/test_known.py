"""Tests of known deviations: their file, and that a run goes on past them."""

from __future__ import annotations

import json
import tomllib
from datetime import date
from functools import cache
from typing import TYPE_CHECKING, Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.base.verdict import Conclusion, Outcome, Result, TraceLine, Verdict
from ecatspec.conformance.cli import main
from ecatspec.conformance.reports import REPORTS
from ecatspec.conformance.results import known_deviations
from ecatspec.conformance.results.known_deviations import Accepted, Known
from ecatspec.conformance.run import runner as runner_module
from ecatspec.conformance.run.runner import Runner, run_device
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import load_device, load_faults, plant

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

DEVICE: Final = "reference-drive"
TODAY: Final = date(2030, 5, 17)
WIDE: Final = "shutdown_switches_on"
"""No drive comes from switch on disabled to operation enabled as it should."""
NARROW: Final[Mapping[str, str]] = {
    "quick_stop_ignored": "inputs DRV-14 quick_stop",
    "disable_operation_to_ready": "inputs DRV-08 switched_on",
    "reset_ignored": "inputs DRV-18 fault switch_on_disabled",
}
HIDDEN: Final = ("quick_stop_ignored", "disable_operation_to_ready")
"""Those that show in operation enabled only."""
TOLD: Final = "inputs DRV-05 switched_on"
"""The identity of the wide one."""


def told(runner: Runner) -> dict[str, set[Outcome]]:
    found: dict[str, set[Outcome]] = {}
    for verdict in runner.verdicts:
        if verdict.outcome is not Outcome.PASS:
            found.setdefault(verdict.signature, set()).add(verdict.outcome)
    return found


@cache
def judged(faults: tuple[str, ...], *accepted: str) -> Runner:
    """Judge a drive with these faults in cases of quick stop, disabling and resets."""
    sound = load_device(DEVICE)
    protocol = sound
    for name in faults:
        protocol = plant(protocol, load_faults()[name])
    adapter = VirtualAdapter(VirtualSubDevice(protocol), described(protocol))
    reasons = dict.fromkeys(accepted, "known: it is old")
    runner = Runner(Model(sound), adapter, adapter.describe(), accepted=reasons)
    words = ("quick_stop", "reset", "disable")
    every = all_cases(runner.model, NO_LIMITS, "quick")
    cases = [c for c in every if c.layer == "ds402" and any(word in c.name for word in words)]
    runner.run(cases, None, len(cases))
    return runner


def result(runner: Runner, **changes: object) -> Result:
    fields: dict[str, object] = {
        "device": DEVICE,
        "subject": "a drive",
        "verdicts": tuple(runner.verdicts),
        "rules_covered": (),
        "rules_total": 1,
        "clauses_covered": (),
        "clauses_total": 1,
        "seconds": 1.0,
    }
    return Result(**(fields | changes))  # type: ignore[arg-type]


# --- a run ----------------------------------------------------------------------------------------


def test_a_wide_mistake_hides_others_until_it_is_known() -> None:
    hidden = {NARROW[name] for name in HIDDEN}
    first = judged((WIDE, *NARROW))
    assert TOLD in told(first)
    assert hidden.isdisjoint(told(first))
    drafted = tomllib.loads(known_deviations.draft(DEVICE, [result(first)], Accepted()))
    second = judged((WIDE, *NARROW), *(each["finding"] for each in drafted["known"]))
    assert {TOLD, *NARROW.values()} <= told(second).keys()
    assert told(second)[TOLD] == {Outcome.KNOWN}
    assert all(told(second)[name] == {Outcome.FAIL} for name in hidden)


def test_what_comes_after_a_known_deviation_blames_nobody() -> None:
    assert told(judged((WIDE,), TOLD)) == {TOLD: {Outcome.KNOWN}}


@pytest.mark.parametrize("name", NARROW)
def test_a_known_deviation_is_that_one_only(name: str) -> None:
    other = next(each for each in NARROW if each != name)
    assert told(judged((name,), NARROW[other]))[NARROW[name]] == {Outcome.FAIL}


def test_a_finding_behind_a_known_one_says_so() -> None:
    runner = judged((WIDE, *NARROW), TOLD)
    found = [v for v in runner.verdicts if v.signature == NARROW["quick_stop_ignored"]]
    assert all("behind another finding" in verdict.reason for verdict in found)
    (reason,) = {v.reason for v in runner.verdicts if v.outcome is Outcome.KNOWN}
    assert reason == "known: it is old"


# --- the file -------------------------------------------------------------------------------------


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


ENTRY: Final = '[[known]]\nfinding = "a b"\nreason = "old"\n'


def test_a_file_says_what_is_accepted_and_how_long(tmp_path: Path) -> None:
    text = f'device = "{DEVICE}"\n{ENTRY}until = 2030-05-17\n'
    text += '[[known]]\nfinding = "c"\nreason = "older"\nuntil = 2030-05-16\n'
    accepted = known_deviations.read(written(tmp_path / "known.toml", text), DEVICE, TODAY)
    assert accepted.reasons == {"a b": "known: old (until 2030-05-17)"}
    assert [each.finding for each in accepted.ended] == ["c"]
    assert list(accepted.notes({"a b"}, whole=True)) == [
        "no longer accepted since 2030-05-16: c (older)"
    ]
    assert list(accepted.notes(set(), whole=False)) == list(accepted.notes({"a b"}, whole=True))
    (_, gone) = accepted.notes(set(), whole=True)
    hint = f"take it out of {tmp_path / 'known.toml'}"
    assert gone == f"known, and did not occur: a b (old); {hint}"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('device = "a"\nfinding = x\n', "(at line 2, column 11)"),
        ("known = []", "missing required field `device`"),
        (f'device = "{DEVICE}"\n[[known]]\nfinding = "a"\n', "missing required field `reason`"),
        (f'device = "{DEVICE}"\n{ENTRY}unto = 3\n', "unknown field `unto` - at `$.known[0]`"),
        (f'device = "{DEVICE}"\n{ENTRY}until = "x"\n', "got `str` - at `$.known[0].until`"),
        (f'device = "other"\n{ENTRY}', f"is about other, not {DEVICE}; give the file of {DEVICE}"),
        (f'device = "{DEVICE}"\n{ENTRY}{ENTRY}', "has 'a b' 2 times; leave one of them"),
        (
            f'device = "{DEVICE}"\n[[known]]\nfinding = "a"\nreason = " "\n',
            "gives no reason for 'a'; say why it is accepted",
        ),
    ],
)
def test_what_is_wrong_with_a_file_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = written(tmp_path / "known.toml", text)
    with pytest.raises(UserError) as error:
        known_deviations.read(path, DEVICE, TODAY)
    assert said in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_or_no_text(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="No such file"):
        known_deviations.read(tmp_path / "none", DEVICE, TODAY)
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="no file of known deviations"):
        known_deviations.read(tmp_path / "bytes", DEVICE, TODAY)
    with pytest.raises(UserError, match="is no path"):
        known_deviations.of("a\0b", DEVICE)


TEXTS: Final = st.text(st.characters(exclude_categories=["Cs"]))


@given(st.dictionaries(TEXTS, st.tuples(TEXTS, st.dates()), max_size=4))
def test_what_is_drafted_is_read_again(findings: dict[str, tuple[str, date]]) -> None:
    before = tuple(
        Known(name, f"because {reason}", until) for name, (reason, until) in findings.items()
    )
    verdicts = tuple(Verdict(n, Outcome.FAIL, n, signature=n) for n in (*findings, "new"))
    runs = [Result(DEVICE, "", verdicts, (), 0, (), 0, 0.0)]
    drafted = known_deviations.draft(DEVICE, runs, Accepted(known=before))
    read = tomllib.loads(drafted)["known"]
    kept = {each["finding"]: (each["reason"], each.get("until")) for each in read}
    new = kept.pop("new") if "new" not in findings else None
    assert kept == {n: (f"because {reason}", until) for n, (reason, until) in findings.items()}
    assert new is None or "nobody has given a reason" in new[0]


# --- the command line -----------------------------------------------------------------------------

FAULTY: Final = ("run", "standard", "--depth", "quick", "--only", "al", "--dut")
FAULT: Final = "model:fault=upper_bits_compared"


def test_a_draft_lets_the_same_device_pass(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "known.toml")
    assert main([*FAULTY, FAULT, "--write-known", path]) == 1
    capsys.readouterr()
    assert main([*FAULTY, FAULT, "--known", path, "--json"]) == 0
    (run,) = json.loads(capsys.readouterr().out)["results"]
    assert (run["conclusion"], run["conforms"]) == ("deviates as is known", True)
    assert {found["outcome"] for found in run["findings"]} == {"known"}
    assert all(f"--known {path}" in found["command"] for found in run["findings"])
    # with both, nothing is forgotten
    text = (tmp_path / "known.toml").read_text(encoding="utf-8")
    mine = text.replace(tomllib.loads(text)["known"][0]["reason"], "my reason")
    (tmp_path / "known.toml").write_text(mine, encoding="utf-8")
    assert main([*FAULTY, FAULT, "--known", path, "--write-known", path]) == 0
    assert "my reason" in (tmp_path / "known.toml").read_text(encoding="utf-8")


def test_workers_know_what_one_process_knows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "known.toml")
    assert main([*FAULTY, FAULT, "--write-known", path]) == 1
    capsys.readouterr()
    assert main([*FAULTY, FAULT, "--known", path, "--workers", "2"]) == 0
    assert "deviates as is known" in capsys.readouterr().out


def test_a_sound_device_is_told_what_did_not_occur(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = list(all_cases(Model(load_device(DEVICE)), NO_LIMITS, "quick"))[:3]
    monkeypatch.setattr(runner_module, "all_cases", lambda *_: iter(cases))
    monkeypatch.setattr(Runner, "complete", lambda *_: [])
    path = written(tmp_path / "known.toml", f'device = "{DEVICE}"\n{ENTRY}')
    accepted = known_deviations.of(str(path), DEVICE)
    found = run_device(DEVICE, "model", depth="quick", known=accepted)
    assert [note for note in found.notes if "did not occur: a b (old)" in note]
    assert found.conclusion is Conclusion.CONFORMS
    part = run_device(DEVICE, "model", depth="quick", known=accepted, only=("sdo",))
    assert not [note for note in part.notes if "did not occur" in note]


def test_a_bad_place_for_the_draft_is_said_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*FAULTY, FAULT, "--write-known", str(tmp_path / "none" / "k")]) == 2
    assert main([*FAULTY, FAULT, "--known", str(tmp_path / "none")]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert len(err.splitlines()) == 2


# --- reports --------------------------------------------------------------------------------------


def test_reports_show_what_is_known_as_such() -> None:
    line = TraceLine(0, "SubDevice", "shows something")
    verdict = Verdict(
        "c", Outcome.KNOWN, "t", "known: old", clauses=("AL-04",), trace=(line,), signature="s"
    )
    protocol = load_device(DEVICE)
    found = [Result(DEVICE, "a", (verdict,), (), 1, (), 1, 0.0)]
    said = REPORTS["text"](found, protocol)
    assert "deviates as is known, and conforms otherwise: 1 finding" in said
    assert "KNOWN: t" in said
    assert "identity  s" in said
    assert "Deviates as is known" in REPORTS["html"](found, protocol)
    assert REPORTS["github"](found, protocol).startswith("::notice title=known%3A t::")
    junit = REPORTS["junit"](found, protocol)
    assert 'failures="0"' in junit.partition(">")[2].partition(">")[0]
    assert '<skipped message="known: old"' in junit
