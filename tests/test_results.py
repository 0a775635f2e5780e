"""Tests of results files: what is kept, what is resumed, what a death loses."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from short import DRIVE, FAULT, SMALL, same, shorten

from ecatspec.conformance import cli
from ecatspec.conformance.base.devices import UserError, load
from ecatspec.conformance.base.verdict import Outcome, TraceLine, Verdict
from ecatspec.conformance.base.work_items import Judged, Learned
from ecatspec.conformance.reports import REPORTS
from ecatspec.conformance.results import run_file
from ecatspec.conformance.results.run_file import Basis, FoundWay, begin, read
from ecatspec.conformance.run.runner import run_device

Call = Callable[..., tuple[int, str, str]]

BASIS = Basis("mine", "00", "exec:x", {"name": "a board"}, "quick", 0, "", ())
JUDGED = (
    Judged("one", Verdict("one", Outcome.PASS, "first", rules=("al.a", "al.b")), Learned()),
    Judged(
        "two",
        Verdict(
            "two",
            Outcome.FAIL,
            "second",
            "a reason",
            ("this", "that"),
            "other",
            ("AL-01",),
            ("AKD-001",),
            (TraceLine(3, "MainDevice", "asks"), TraceLine(4, "SubDevice", "answers")),
            "0.0 ms",
            "a signature",
            ("a cause", "another"),
            "a flag",
            ("al.b",),
            "case.x",
        ),
        Learned({"way": "left"}, ("right",), ("for no reason",), ("al.b", "al.c"), True),  # noqa: FBT003
    ),
)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    def run(*arguments: str) -> tuple[int, str, str]:
        status = cli.main(arguments)
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


def kept(path: Path) -> None:
    """Keep a finished run."""
    with begin(path, BASIS) as journal:
        for judged in JUDGED:
            journal.keep(judged)
        journal.finish()


# --- a file ---------------------------------------------------------------------------------------


def test_a_run_comes_back_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "run"
    kept(file)
    run = read(file)
    assert run.basis == BASIS
    assert run.verdicts == tuple(judged.verdict for judged in JUDGED)
    assert run.finished
    assert list(tmp_path.iterdir()) == [file], "one file, without companions"
    file.chmod(0o444)
    assert read(file) == run


def test_a_resumed_run_gets_what_was_judged(tmp_path: Path) -> None:
    file = tmp_path / "run"
    kept(file)
    with begin(file, BASIS, resume=True) as journal:
        first, second = (journal.again(judged.name) for judged in JUDGED)
        assert journal.again("three") is None
        third = Judged(
            "three", Verdict("three", Outcome.PASS, "", rules=("al.d", "al.a")), Learned()
        )
        journal.keep(third)
    assert first is not None
    assert second is not None
    assert (first.verdict, second.verdict) == (JUDGED[0].verdict, JUDGED[1].verdict)
    told = replace(second.learned, rules=tuple(sorted(second.learned.rules)))
    assert told == JUDGED[1].learned
    assert read(file).verdicts == (first.verdict, second.verdict, third.verdict)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"device": "other"}, "has device 'mine', this one 'other'"),
        ({"digest": "01"}, "is of other texts"),
        ({"dut": "exec:y"}, "has dut 'exec:x', this one 'exec:y'"),
        ({"description": {"name": "x"}}, "its adapter describes otherwise"),
        ({"depth": "default"}, "has depth 'quick', this one 'default'"),
        ({"seed": 1}, "has seed 0, this one 1"),
        ({"mailbox": "64"}, "has mailbox '', this one '64'"),
        ({"only": ("al",)}, "has only (), this one ('al',)"),
        ({"version": "0.0"}, "this one '0.0'"),
    ],
)
def test_a_run_is_resumed_as_it_was_begun(
    tmp_path: Path, changed: dict[str, object], words: str
) -> None:
    file = tmp_path / "run"
    kept(file)
    with pytest.raises(UserError) as caught:
        begin(file, replace(BASIS, **changed), resume=True)  # type: ignore[arg-type]
    assert words in str(caught.value)
    assert read(file).finished


def test_a_suite_that_goes_on_otherwise_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "run"
    kept(file)
    with begin(file, BASIS, resume=True) as journal, pytest.raises(UserError) as caught:
        journal.again("another")
    assert "goes on with 'one' where this run has 'another'" in str(caught.value)


def test_a_new_run_takes_the_place_of_a_finished_one_only(tmp_path: Path) -> None:
    file = tmp_path / "run"
    kept(file)
    with begin(file, BASIS) as journal:
        journal.keep(JUDGED[0])
    assert len(read(file).verdicts) == 1
    with pytest.raises(UserError, match="not finished; go on with it by --resume"):
        begin(file, BASIS)
    other = tmp_path / "notes"
    other.write_text("what I did today", encoding="utf-8")
    with pytest.raises(UserError, match="is no results file"):
        begin(other, BASIS)
    assert other.read_text(encoding="utf-8") == "what I did today"


def elsewhere(file: Path, code: str) -> str:
    """Give what another process prints that does this with a file."""
    code = f"import sys; sys.path = {sys.path}\n{_OTHER}    {code}\n{_OTHERWISE}"
    done = subprocess.run(
        [sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=False
    )
    assert not done.stderr
    return done.stdout


_OTHER = """
from pathlib import Path
from ecatspec.conformance.results import run_file
from ecatspec.conformance.base.devices import UserError
path = Path(sys.argv[1])
run_file._PATIENCE = 0.1
try:
"""
_OTHERWISE = """
except UserError as error:
    print(error)
"""
_READ = "run = run_file.read(path); print(len(run.verdicts), run.finished)"


def test_one_run_writes_a_file_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "run"
    refused = f"a run is writing {file}; wait for its end"
    monkeypatch.setattr(run_file, "_PATIENCE", 0.1)
    with begin(file, BASIS) as journal:
        for judged in JUDGED:
            journal.keep(judged)
            assert elsewhere(file, "run_file.begin(path, None, resume=True)") == f"{refused}\n"
            assert elsewhere(file, "run_file.begin(path, None)") == f"{refused}\n"
            for resume in (True, False):
                with pytest.raises(UserError) as caught:
                    begin(file, BASIS, resume=resume)
                assert str(caught.value) == refused
        assert elsewhere(file, _READ) == "2 False\n"
        journal.finish()
        assert elsewhere(file, "run_file.begin(path, None)") == f"{refused}\n", (
            "it may come to more"
        )
    assert read(file).verdicts == tuple(judged.verdict for judged in JUDGED)
    assert list(tmp_path.iterdir()) == [file]


def test_a_run_is_read_while_it_goes_on(tmp_path: Path) -> None:
    file = tmp_path / "run"
    with begin(file, BASIS) as journal:
        assert elsewhere(file, _READ) == "0 False\n"
        for number, judged in enumerate(JUDGED, 1):
            journal.keep(judged)
            assert elsewhere(file, _READ) == f"{number} False\n"
            assert read(file).verdicts == tuple(judged.verdict for judged in JUDGED[:number])
            assert file.with_name("run-wal").exists(), "who reads takes nothing away"
        journal.finish()
        assert elsewhere(file, _READ) == "2 True\n"
    assert list(tmp_path.iterdir()) == [file]


def test_what_is_read_is_of_one_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "run"
    with begin(file, BASIS) as journal:
        journal.keep(JUDGED[0])

        def meanwhile(path: Path, base: sqlite3.Connection) -> Basis:
            basis = basis_of(path, base)
            journal.keep(JUDGED[1])
            journal.finish()
            return basis

        basis_of = run_file._basis_of  # noqa: SLF001
        monkeypatch.setattr(run_file, "_basis_of", meanwhile)
        run = read(file)
        monkeypatch.undo()
        assert (run.verdicts, run.finished) == ((JUDGED[0].verdict,), False)
        assert (len(read(file).verdicts), read(file).finished) == (2, True)


def test_who_reads_for_long_takes_the_companions_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "run"
    monkeypatch.setattr(run_file, "_PATIENCE", 0.1)
    with begin(file, BASIS) as journal:
        journal.keep(JUDGED[0])
        reader = run_file._opened(file)  # noqa: SLF001
        reader.execute("BEGIN")
        assert reader.execute("SELECT count(*) FROM step").fetchone() == (1,)
        journal.keep(JUDGED[1])
        journal.finish()
    assert reader.execute("SELECT count(*) FROM step").fetchone() == (1,)
    assert len(read(file).verdicts) == 2
    reader.close()
    assert list(tmp_path.iterdir()) == [file]
    assert read(file).finished


@pytest.mark.parametrize("damage", ["text", "empty", "cut", "torn", "other", "newer", "folder"])
def test_what_is_no_results_file_is_one_line(call: Call, tmp_path: Path, damage: str) -> None:
    good, file = tmp_path / "good", tmp_path / "run"
    kept(good)
    kept(file)
    whole = good.read_bytes()
    match damage:
        case "text":
            file.write_text("what I did today\n" * 200, encoding="utf-8")
        case "empty":
            file.write_bytes(b"")
        case "cut":
            file.write_bytes(whole[: len(whole) // 2])
        case "torn":
            file.write_bytes(whole[:4096] + bytes(len(whole) - 4096))
        case "other":
            file.unlink()
            with sqlite3.connect(file) as base:
                base.execute("CREATE TABLE run (name TEXT, value TEXT)")
            base.close()
        case "newer":
            with sqlite3.connect(file) as base:
                base.execute("PRAGMA user_version = 99")
            base.close()
        case _:
            file.unlink()
            file.mkdir()
    with pytest.raises(UserError) as caught:
        read(file)
    assert str(file) in str(caught.value)
    for first, second in ((file, good), (good, file)):
        status, out, err = call("compare", str(first), str(second))
        assert (status, out) == (2, "")
        assert str(file) in err
        assert err.count("\n") == 1


# --- what a run found out -------------------------------------------------------------------------


def test_choices_come_back_with_the_cases_that_told_them(tmp_path: Path) -> None:
    file = tmp_path / "run"
    told = (
        Learned({"way": "left", "speed": "low"}),
        Learned(),
        Learned({"counter": "zero"}, risks={"counter": "not to be told apart"}),
        Learned({"way": "left"}),
        Learned({"speed": "high"}),
    )
    with begin(file, BASIS) as journal:
        for number, learned in enumerate(told):
            case = f"case {number}"
            journal.keep(Judged("a step", Verdict(case, Outcome.PASS, case), learned))
    assert read(file).choices == {
        "way": FoundWay("left", ("case 0", "case 3")),
        "speed": FoundWay("high", ("case 4",)),
        "counter": FoundWay("zero", ("case 2",), "not to be told apart"),
    }


def test_a_file_from_before_there_were_risks_is_read(tmp_path: Path) -> None:
    file = tmp_path / "run"
    kept(file)
    with sqlite3.connect(file) as base:
        base.execute("UPDATE step SET learned = json_remove(learned, '$.risks')")
    base.close()
    assert read(file).choices == {"way": FoundWay("left", ("two",))}


def test_a_run_tells_why_a_way_is_risky(tmp_path: Path) -> None:
    file = tmp_path / "run"
    case = "ds402/shutdown/enable_operation/quick_stop/enable_operation"
    result = run_device("metronix-dis2", "model", replay=case, keep=partial(begin, file))
    name, why = "return_from_quick_stop", "the transition is not recommended"
    assert read(file).choices[name] == FoundWay("served", (case,), why)
    report = REPORTS["text"]((result,), load("metronix-dis2"))
    assert f"  choices   {name} = served (found) RISKY: the" in report


# --- a run that goes on ---------------------------------------------------------------------------


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize(("device", "dut"), [(SMALL, "model"), (SMALL, FAULT), (DRIVE, "model")])
def test_a_resumed_run_is_as_one_that_nobody_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, dut: str
) -> None:
    file = tmp_path / "run"
    whole = run_device(device, dut)
    count = len(whole.verdicts)
    told = 0

    def progress(_number: int, _total: int, _name: str) -> None:
        nonlocal told
        told += 1
        if told == stop:
            raise KeyboardInterrupt

    # where choices were found out, in a complete suite, in the random part
    for stop in (1, 9, count // 2, count - 15, count - 2):
        told = 0
        keep = partial(begin, file, resume=file.exists())
        part = run_device(device, dut, keep=keep, progress=progress)
        assert part.interrupted
        assert read(file).verdicts == part.verdicts == whole.verdicts[: stop - 1]
    asked: list[str] = []

    def counted(journal: run_file.Journal, judged: Judged) -> None:
        asked.append(judged.name)
        keep_it(journal, judged)

    keep_it = run_file.Journal.keep
    monkeypatch.setattr(run_file.Journal, "keep", counted)
    same(run_device(device, dut, keep=partial(begin, file, resume=True)), whole)
    assert len(asked) == count - len(part.verdicts), "nothing is judged twice"
    same(run_device(device, dut, keep=partial(begin, file, resume=True)), whole)
    assert len(asked) == count - len(part.verdicts)
    assert read(file).finished


@pytest.mark.usefixtures("short")
def test_a_run_that_goes_on_by_command(call: Call, tmp_path: Path) -> None:
    file = str(tmp_path / "run")
    run = ("run", SMALL, "--only", "al", "--json")
    status, out, _ = call(*run, "--results", file)
    assert status == 0
    (first,) = json.loads(out)["results"]
    # a walk is one of AL, wherever it leads
    assert {v.case.partition("/")[0] for v in read(Path(file)).verdicts} == {"al", "walk"}
    with sqlite3.connect(file) as base:
        (spent,) = base.execute("SELECT max(seconds) FROM step").fetchone()
    status, out, _ = call(*run, "--results", file, "--resume")
    assert status == 0
    (again,) = json.loads(out)["results"]
    del first["set_up"]["began"], again["set_up"]["began"]
    assert first | {"seconds": 0} == again | {"seconds": 0}
    assert again["seconds"] >= spent > 0
    for more, words in (
        (("--resume", "--results", f"{file}0"), "there is no run in"),
        (("--resume", "--results", file, "--seed", "1"), "has seed 0, this one 1"),
        (("--replay", "x", "--results", file), "leave out --replay"),
        (("--results", str(tmp_path / "none" / "run")), "cannot be written"),
        (("--only", "la"), "no layer is called 'la'"),
    ):
        status, out, err = call(*run[:2], "--json", *run[2:4] * ("--only" not in more), *more)
        assert (status, out) == (2, ""), more
        assert words in err
        assert err.count("\n") == 1


# --- death ----------------------------------------------------------------------------------------

_DEATHS = """
import sys; sys.path = {path}
import os, random, signal, time
from functools import partial
from pathlib import Path
from ecatspec.conformance.results import run_file
from ecatspec.conformance.run import runner
from ecatspec.conformance.base.devices import load
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model

file, chosen = Path(sys.argv[1]), random.Random(11)
cases = [c for c in all_cases(Model(load("reference")), NO_LIMITS, "quick") if c.layer == "al"]
runner.all_cases = lambda *_: cases

def child(told):
    def progress(number, total, name):
        os.write(told, number.to_bytes(4, "big"))
    keep = partial(run_file.begin, file, resume=file.exists())
    options = dict(depth="quick", only=("al",), keep=keep, progress=progress)
    runner.run_device("reference", "model", **options)
    os._exit(0)

deaths = count = 0
while deaths < 20:
    if file.exists() and count == len(cases):
        file.unlink()
        count = 0
    reader, writer = os.pipe()
    process = os.fork()
    if not process:
        child(writer)
    os.close(writer)
    last = os.read(reader, 4)
    time.sleep(chosen.uniform(0, 0.12))
    os.kill(process, signal.SIGKILL)
    status = os.waitpid(process, 0)[1]
    while more := os.read(reader, 4):
        last = more
    os.close(reader)
    deaths += os.WIFSIGNALED(status)
    # what was told to be next: all before it is judged
    judged, before = int.from_bytes(last, "big"), count
    run = run_file.read(file)
    count = len(run.verdicts)
    names = [verdict.case for verdict in run.verdicts]
    assert names == [case.name for case in cases[:count]], "none lost, none twice"
    assert count >= judged, (count, judged)
    assert count >= before, (count, before)
    print(count, flush=True)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a process is forked and killed")
def test_twenty_deaths_lose_nothing_that_was_judged(tmp_path: Path) -> None:
    code = _DEATHS.format(path=sys.path)
    command = [sys.executable, "-c", code, str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    counts = [int(line) for line in done.stdout.split()]
    assert len(counts) >= 20
    assert len(set(counts)) > 5, "deaths were at many places"


def test_whatever_a_power_cut_leaves_is_a_run_as_far_as_it_goes(tmp_path: Path) -> None:
    file = tmp_path / "run"
    with begin(file, BASIS) as journal:
        for number in range(30):
            case = f"case {number}"
            journal.keep(Judged(case, Verdict(case, Outcome.PASS, case), Learned()))
        log = file.with_name("run-wal").read_bytes()
        base = file.read_bytes()
    left = tmp_path / "left"
    found = set()
    for length in range(0, len(log), len(log) // 60):
        for path in tmp_path.glob("left*"):
            path.unlink()
        left.write_bytes(base)
        (tmp_path / "left-wal").write_bytes(log[:length])
        verdicts = read(left).verdicts
        assert [v.case for v in verdicts] == [f"case {n}" for n in range(len(verdicts))]
        assert read(left).verdicts == verdicts
        found.add(len(verdicts))
    assert len(found) > 20
    assert max(found) >= 29


def test_what_is_judged_is_forced_onto_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    with begin(tmp_path / "run", BASIS) as journal:
        modes = []
        for clock[0] in (0.1, 0.15, 0.3, 0.4, 0.51):
            journal.keep(JUDGED[0])
            modes.append(journal._base.execute("PRAGMA synchronous").fetchone()[0])  # noqa: SLF001
    assert modes == [1, 1, 2, 1, 2]


def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    with begin(tmp_path / "run", BASIS) as journal:
        journal._base.execute("PRAGMA max_page_count = 40")  # noqa: SLF001
        case = "case" * 1000
        long = Judged(case, Verdict(case, Outcome.PASS, case), Learned())
        with pytest.raises(UserError) as caught:
            any(map(journal.keep, [long] * 1000))
    assert "cannot be written (database or disk is full)" in str(caught.value)
    assert len(read(tmp_path / "run").verdicts) < 1000
