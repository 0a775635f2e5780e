"""Tests of the command line: exit statuses, and what each wrong input says.

The runner and the monitor have tests of their own: here most runs are played.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import textwrap
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field, replace
from importlib import import_module, resources
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any

import click
import pytest
from click.testing import CliRunner

from ecatspec.conformance import cli
from ecatspec.conformance.adapters import HANG_TIMEOUT
from ecatspec.conformance.base.adapter import AdapterError
from ecatspec.conformance.base.verdict import Outcome, Result, Verdict
from ecatspec.conformance.capture import monitor
from ecatspec.conformance.cli import export as export_command
from ecatspec.conformance.cli.options import EXAMPLES
from ecatspec.conformance.describe.text_tables import machine_sheets, sheets
from ecatspec.conformance.mutation import kill_analysis
from ecatspec.conformance.mutation.fates import Analysis, Fate, Fated, TableKills
from ecatspec.conformance.results import run_history
from ecatspec.conformance.run import runner
from ecatspec.conformance.vectors import replay
from ecatspec.conformance.vectors.record import Recorder, RestlessError
from ecatspec.generators.cases.case import Case
from ecatspec.generators.cases.case_codec import token_of
from ecatspec.generators.cases.depths import DEPTHS
from ecatspec.generators.complete.faults import Kills
from ecatspec.generators.formats import FORMATS, Format
from ecatspec.generators.mutation.mutants import Mutant, Operator
from ecatspec.generators.suite import all_cases
from ecatspec.spec.language.ir import Span
from ecatspec.spec.language.load import device_names, load_device, load_faults, load_standard

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from ecatspec.conformance.base.work_items import Crew
    from ecatspec.conformance.results.known_deviations import Accepted
    from ecatspec.conformance.results.run_file import Basis, Journal
    from ecatspec.generators.cases.case import Limits
    from ecatspec.generators.vectors.schema import Test
    from ecatspec.model.core.compilation import Model

    Call = Callable[..., tuple[int, str, str]]

DEVICE = "kollmorgen-akd"
COMMAND = [sys.executable, "-P", "-m", "ecatspec.conformance.cli"]
DEVICE_TEXT = 'device mine extends standard "x"\n'


def result(*outcomes: Outcome) -> Result:
    verdicts = tuple(
        Verdict(f"case/{number}", outcome, "title", "a reason")
        for number, outcome in enumerate(outcomes)
    )
    return Result(DEVICE, "played", verdicts, (), 3, (), 4, 0.5)


@dataclass
class Played:
    """Stands for the runner and the monitor, and keeps what they were asked."""

    results: tuple[Result, ...] = (result(Outcome.PASS),)
    error: BaseException | None = None
    asked: dict[str, object] = field(default_factory=dict)

    def run_device(
        self,
        device: str,
        dut: str,
        *,
        depth: str,
        seed: int,
        mailbox: str,
        only: tuple[str, ...],
        replay: str,
        hang_timeout: float,
        progress: Callable[[int, int, str], None] | None,
        known: Accepted,
        choices: tuple[str, ...],
        keep: Callable[[Basis], Journal | None] | None = None,
        crew: Crew | None = None,
    ) -> Result:
        self.asked = {
            "device": device,
            "dut": dut,
            "depth": depth,
            "seed": seed,
            "mailbox": mailbox,
            "only": only,
            "replay": replay,
            "known": known.path,
            "choices": choices,
            "hang_timeout": hang_timeout,
            "progress": progress,
            "kept": keep is not None,
            "crew": crew is not None,
        }
        if self.error is not None:
            raise self.error
        return self.results[0]

    def monitor_file(
        self, path: Path, device: str, progress: Callable[[int, int, str], None] | None
    ) -> tuple[Result, ...]:
        self.asked = {"path": str(path), "device": device, "progress": progress}
        if self.error is not None:
            raise self.error
        return self.results


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Played:
    stand_in = Played()
    monkeypatch.setattr(runner, "run_device", stand_in.run_device)
    monkeypatch.setattr(monitor, "monitor_file", stand_in.monitor_file)
    return stand_in


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    def run(*arguments: str) -> tuple[int, str, str]:
        status = cli.main(arguments)
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


# --- help -----------------------------------------------------------------------------------------


def command_of(name: str) -> click.Command:
    found = cli.cli.get_command(click.Context(cli.cli), name)
    assert found is not None
    return found


@pytest.mark.parametrize("command", sorted(EXAMPLES))
def test_each_command_shows_an_example_that_parses(command: str) -> None:
    words = EXAMPLES[command].split()
    shown = CliRunner().invoke(cli.cli, [command, "--help"])
    assert shown.exit_code == 0
    assert EXAMPLES[command] in shown.output
    assert words[:2] == ["ecatspec", command]
    command_of(command).make_context(command, words[2:])


def test_the_help_of_all_shows_all_examples() -> None:
    modules = [each.name for each in iter_modules(cli.__path__) if not each.name.startswith("_")]
    loaded = {name: import_module(f"{cli.__name__}.{name}") for name in modules}
    found = {name for name, each in loaded.items() if hasattr(each, name)}
    assert set(EXAMPLES) == found
    shown = CliRunner().invoke(cli.cli, ["--help"])
    assert shown.exit_code == 0
    assert all(example in shown.output for example in EXAMPLES.values())
    commands = shown.output.partition("Commands:")[2]
    assert "..." not in commands, "a summary is too long for a line of 80 columns"


def test_no_command_is_no_success(call: Call) -> None:
    status, out, _ = call()
    assert status == 2
    assert "Usage: ecatspec" in out


def test_version(call: Call) -> None:
    status, out, err = call("--version")
    assert (status, err) == (0, "")
    assert out.startswith("ecatspec ")


def test_the_depths_are_those_of_the_runner() -> None:
    for command in ("run", "mutate", "export"):
        (option,) = [p for p in command_of(command).params if p.name == "depth"]
        assert isinstance(option.type, click.Choice)
        assert tuple(option.type.choices) == DEPTHS
    assert set(DEPTHS) == set(runner.EXAMPLES)


# --- wrong input: one line on stderr, status 2 ----------------------------------------------------


def assert_refused(outcome: tuple[int, str, str], *words: str) -> None:
    status, out, err = outcome
    assert status == 2
    assert out == ""
    assert err.startswith("ecatspec: ")
    assert err.count("\n") == 1
    assert err.endswith("\n")
    assert ";" in err
    for word in words:
        assert word in err


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["bogus"], "bogus"),
        (["--bogus"], "--bogus"),
        (["run"], "DEVICE"),
        (["run", DEVICE, "--bogus"], "--bogus"),
        (["run", DEVICE, "extra"], "extra"),
        (["run", DEVICE, "--depth", "deepest"], "deepest"),
        (["run", DEVICE, "--seed", "x"], "x"),
        (["run", DEVICE, "--hang-timeout", "0"], "0"),
        (["run", DEVICE, "--hang-timeout", "nan"], "nan"),
        (["run", DEVICE, "--hang-timeout", "inf"], "inf"),
        (["run", "reference", "--replay", "al/request_PREOP/request_INI"], "request_INIT'?"),
        (["run", "reference", "--replay", "zzz"], "for instance 'sdo/"),
        (["run", "reference", "--replay", "case.x"], "damaged; copy the whole token"),
        (["mutate"], "DEVICE"),
        (["mutate", "kolmorgen-akd"], "did you mean `kollmorgen-akd`?"),
        (["mutate", DEVICE, "--depth", "deepest"], "deepest"),
        (["mutate", DEVICE, "--workers", "0"], "0"),
        (["mutate", DEVICE, "--at-least", "101"], "101"),
        (["monitor"], "FILE"),
        (["check"], "FILE"),
        (["show"], "DEVICE"),
        (["run", "kolmorgen-akd"], "did you mean `kollmorgen-akd`?"),
        (["show", "kolmorgen-akd"], "did you mean `kollmorgen-akd`?"),
        (["monitor", "x.pcap", "--device", "kolmorgen-akd"], "did you mean `kollmorgen-akd`?"),
        (["show", "nothing-like-it-at-all"], "there are standard, "),
        (["show", "a\nb"], "a b"),
        (["show", DEVICE, "all"], "did you mean 'al'?"),
        (["run", DEVICE, "--dut", "mode"], "did you mean 'model'?"),
        (["run", DEVICE, "--dut", "exec:/nonexistent/program"], "/nonexistent/program"),
        (["run", DEVICE, "--dut", "exec:'"], "command"),
        (
            ["run", DEVICE, "--dut", "model:fault=nonsense"],
            "no fault is called 'nonsense'; did you",
        ),
        (["run", DEVICE, "--dut", "model:fault=toggleignored"], "did you mean 'toggle_ignored'?"),
        (["run", DEVICE, "--dut", "model:nonsense=1"], "nonsense"),
        (["show", "a/b.ecs"], "No such file"),
        (["run", "a/b.ecs"], "No such file"),
        (["export", DEVICE], "--format"),
        (["export", DEVICE, "--format", "xml"], "xml"),
        (["export", "kolmorgen-akd", "--format", "json"], "did you mean `kollmorgen-akd`?"),
        (["export", DEVICE, "--format", "json", "--only", "al,sdoo"], "did you mean 'sdo'?"),
        (["export", DEVICE, "--format", "json", "--choice", "bootstrap"], "NAME=WAY"),
        (["export", DEVICE, "--format", "json", "--choice", "bootstap=x"], "did you mean 'boot"),
        (["export", DEVICE, "--format", "json", "--choice", "bootstrap=x"], "way at bootstrap"),
        (["export", DEVICE, "--format", "json", "-o", "a/b.json"], "No such file"),
        (["export", DEVICE, "--format", "json", "-o", "."], "it is no file"),
        (["export", DEVICE, "--format", "json", "-o", "a\0b"], "a\\x00b"),
        (["replay"], "FILE"),
        (["replay", "a/b.json"], "No such file"),
        (["replay", "a\0b.json"], "a\\x00b.json"),
        (["replay", "."], "Is a directory"),
        (["vectors", "lint"], "FILE"),
        (["vectors", "lint", "a/b.json"], "No such file"),
        (["vectors", "lint", "pyproject.toml"], "no JSON"),
        (["vectors", "lint", "/dev/null"], "the file is empty"),
        (["check", "a/b.ecs"], "No such file"),
        (["check", "a/b.txt"], "ends in .ecs"),
        (["check", "a\0.ecs"], "a\\x00.ecs"),
        (["monitor", "a/b.pcap"], "No such file"),
        (["monitor", "a\0b.pcap"], "a\\x00b.pcap"),
    ],
)
def test_wrong_arguments(call: Call, arguments: list[str], word: str) -> None:
    assert_refused(call(*arguments), word)


@pytest.mark.parametrize(
    "size", ["33", "1487", "abc", "64:", ":64", "1:2:3", "64:33", "-64", "6 4"]
)
def test_wrong_mailbox_sizes(call: Call, size: str) -> None:
    assert_refused(
        call("run", DEVICE, f"--mailbox={size}"), repr(size), "SIZE or OUT:IN", "34 to 1486"
    )


@pytest.mark.parametrize("content", [None, b"", bytes(range(256)) * 20, b"\xd4\xc3\xb2\xa1\x02"])
def test_wrong_captures(call: Call, tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "capture.pcap"
    if content is None:
        file.mkdir()
    else:
        file.write_bytes(content)
    assert_refused(call("monitor", str(file)), str(file))


def test_a_folder_is_no_text(call: Call, tmp_path: Path) -> None:
    folder = tmp_path / "folder.ecs"
    folder.mkdir()
    for command in ("check", "show", "run"):
        assert_refused(call(command, str(folder)), str(folder))
        assert_refused(call(command, str(tmp_path)), "ends in .ecs")


@pytest.mark.parametrize("content", [b"", b"# nothing\n", bytes(range(256)), b"standard", b'"'])
@pytest.mark.parametrize("command", ["check", "show", "run"])
def test_wrong_texts_give_diagnostics(
    call: Call, tmp_path: Path, content: bytes, command: str
) -> None:
    file = tmp_path / "bad.ecs"
    file.write_bytes(content)
    status, out, err = call(command, str(file))
    assert status == 2
    said, silent = (out, err) if command == "check" else (err, out)
    assert silent == ""
    assert said
    assert all(line.startswith(f"{file}:") and " ECS" in line for line in said.splitlines())


def test_a_deep_expression_is_no_traceback(call: Call, tmp_path: Path) -> None:
    file = tmp_path / "deep.ecs"
    deep = "not " * 20_000 + "true"
    file.write_text(f'{DEVICE_TEXT}define x "x" = {deep} [AL-01]\n', "utf-8")
    status, _, err = call("check", str(file))
    assert status == 2
    assert "Traceback" not in err


# --- check ----------------------------------------------------------------------------------------


def shipped(tmp_path: Path, name: str) -> Path:
    file = tmp_path / f"{name}.ecs"
    text = resources.files("ecatspec.spec").joinpath("devices", f"{name}.ecs")
    file.write_bytes(text.read_bytes())
    return file


@pytest.mark.parametrize("name", device_names())
def test_check_accepts_the_shipped_texts(call: Call, tmp_path: Path, name: str) -> None:
    file = shipped(tmp_path, name)
    protocol = load_device(name)
    rules = sum(len(machine.rules) for machine in protocol.machines.values())
    line = f"{file}: ok, {len(protocol.clauses)} clauses, {rules} rules\n"
    assert call("check", str(file)) == (0, line, "")


def test_check_goes_on_after_a_bad_file(call: Call, tmp_path: Path) -> None:
    good = shipped(tmp_path, DEVICE)
    bad = tmp_path / "bad.ecs"
    bad.write_bytes(b"")
    status, out, err = call("check", "none.ecs", str(bad), str(good))
    assert status == 2
    assert err.count("\n") == 1
    assert [line.split(":")[0] for line in out.splitlines()] == [str(bad), str(good)]


def test_check_as_json(call: Call, tmp_path: Path) -> None:
    good = shipped(tmp_path, DEVICE)
    bad = tmp_path / "bad.ecs"
    bad.write_bytes(b"\xff")
    status, out, err = call("check", "--json", str(bad), str(good))
    assert (status, err) == (2, "")
    first, second = json.loads(out)["files"]
    assert first["diagnostics"][0]["code"] == "ECS003"
    assert first["diagnostics"][0]["line"] == 1
    assert (second["ok"], second["clauses"]) == (True, len(load_device(DEVICE).clauses))


# --- show -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["standard", *device_names()])
def test_show_has_everything_of_a_device(
    call: Call, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("COLUMNS", "500")
    protocol = load_device(name)
    status, out, err = call("show", name)
    assert (status, err) == (0, "")
    words = set(out.replace(",", " ").split())
    assert set(protocol.registers) <= words
    assert set(protocol.parameters) <= words
    assert set(protocol.machines) <= words
    assert set(protocol.tables) <= words
    assert set(protocol.choices) <= words
    assert {pin.alternative for pin in protocol.pins.values()} <= words
    ways = [way for choice in protocol.choices.values() for way in choice.alternatives]
    assert all(f"  {way.name} " in out and way.risk.wording in out for way in ways if way.risk)
    assert {anomaly.id for anomaly in protocol.anomalies} <= words
    assert {entry.name for entry in protocol.objects} <= words
    assert {example.name for example in protocol.examples} <= words
    assert {row.name for table in protocol.tables.values() for row in table.rows} <= words
    for table in protocol.tables.values():
        assert f"code table {table.name} ({'closed' if table.closed else 'open'}" in out


@pytest.mark.parametrize("machine", sorted(load_standard().machines))
def test_show_has_every_rule_of_a_machine(
    call: Call, monkeypatch: pytest.MonkeyPatch, machine: str
) -> None:
    monkeypatch.setenv("COLUMNS", "500")
    status, out, err = call("show", "standard", machine)
    assert (status, err) == (0, "")
    words = set(out.replace(",", " ").split())
    rules = load_standard().machines[machine].rules
    assert {rule.name for rule in rules} <= words
    assert {clause for rule in rules for clause in rule.clauses} <= words


def test_show_as_json(call: Call) -> None:
    protocol = load_device(DEVICE)
    _, out, _ = call("show", DEVICE, "--json")
    data = json.loads(out)
    assert data["digest"] == protocol.digest
    assert [table["name"] for table in data["tables"]] == [sheet.name for sheet in sheets(protocol)]
    _, out, _ = call("show", DEVICE, "al", "--json")
    tables = {table["name"]: table["rows"] for table in json.loads(out)["tables"]}
    assert len(tables["rules"]) == len(protocol.machines["al"].rules)
    assert [row["rule"] for row in tables["rules"]] == [
        rule.name for rule in protocol.machines["al"].rules
    ]


def test_every_row_of_a_sheet_has_all_columns() -> None:
    protocol = load_device(DEVICE)
    machines = [sheet for name in protocol.machines for sheet in machine_sheets(protocol, name)]
    for sheet in (*sheets(protocol), *machines):
        assert {len(row) for row in sheet.rows} == {len(sheet.columns)}


@pytest.mark.parametrize("width", ["1", "20", "80"])
def test_show_fits_the_terminal(call: Call, monkeypatch: pytest.MonkeyPatch, width: str) -> None:
    monkeypatch.setenv("COLUMNS", width)
    status, out, _ = call("show", DEVICE, "mailbox")
    assert status == 0
    assert max(map(len, out.splitlines())) <= max(80, int(width))


# --- run and monitor ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("outcomes", "status"),
    [
        ([Outcome.PASS], 0),
        ([Outcome.PASS, Outcome.SKIPPED, Outcome.INCONCLUSIVE], 0),
        ([Outcome.WARNING], 0),
        ([Outcome.PASS, Outcome.FAIL], 1),
        ([Outcome.CRASH], 1),
        ([Outcome.FAIL, Outcome.ERROR], 1),
        ([Outcome.PASS, Outcome.ERROR], 2),
        ([Outcome.SKIPPED], 2),
        ([], 2),
    ],
)
def test_exit_statuses(
    call: Call,
    played: Played,
    outcomes: list[Outcome],
    status: int,
) -> None:
    played.results = (result(*outcomes),)
    for arguments in (["run", DEVICE], ["monitor", "x.pcap"]):
        code, out, err = call(*arguments)
        assert code == status
        assert out.startswith(f"{DEVICE}, tested: played\n")
        assert err.count("\n") == (1 if status == 2 else 0)


def test_a_device_that_was_never_where_cases_needed_it_does_not_conform(
    call: Call, played: Played
) -> None:
    silent = replace(result(Outcome.PASS, Outcome.INCONCLUSIVE), unreached=("SAFEOP", "OP"))
    played.results = (silent,)
    status, out, _ = call("run", DEVICE)
    assert status == 1
    assert out.splitlines()[1].startswith("  NOT SHOWN: SAFEOP, OP were never reached")


def test_an_interrupted_run_shows_what_was_found(call: Call, played: Played) -> None:
    for outcome in (Outcome.PASS, Outcome.FAIL):
        played.results = (replace(result(outcome), interrupted=True, planned=9),)
        status, out, _ = call("run", DEVICE)
        assert status == 130
        assert "(interrupted after 1 of 9 cases; --resume goes on)" in " ".join(out.split())
        played.results = (replace(result(outcome), interrupted=True),)
        assert "(interrupted after 1 case)" in " ".join(call("run", DEVICE)[1].split())


def test_ctrl_c_elsewhere_is_one_line(call: Call, played: Played) -> None:
    played.error = KeyboardInterrupt()
    status, out, err = call("monitor", "x.pcap")
    assert (status, out, err.strip()) == (130, "", "ecatspec: interrupted")


def test_a_set_up_that_fails_later_is_one_line(call: Call, played: Played) -> None:
    played.error = AdapterError("the cable\nis out; plug it in")
    assert_refused(call("run", DEVICE), "the cable is out; plug it in")


def test_a_defect_of_ecatspec_is_no_verdict(call: Call, played: Played) -> None:
    played.error = ZeroDivisionError()
    status, out, err = call("run", DEVICE)
    assert (status, out) == (2, "")
    assert "a defect of ecatspec (ZeroDivisionError)" in err


def test_options_reach_the_runner(call: Call, played: Played, tmp_path: Path) -> None:
    call("run", DEVICE)
    assert played.asked == {
        "device": DEVICE,
        "dut": "model",
        "depth": "default",
        "seed": 0,
        "mailbox": "",
        "only": (),
        "replay": "",
        "known": "",
        "choices": (),
        "hang_timeout": HANG_TIMEOUT,
        "progress": None,
        "kept": True,
        "crew": False,
    }
    file = str(shipped(tmp_path, DEVICE))
    options = ["--depth", "quick", "--seed", "7", "--mailbox", "64:1486", "--hang-timeout", "0.5"]
    options += ["--only", "al,sdo", "--replay", "al/up"]
    options += ["--choice", "reply_counter=zero", "--choice", "bad_service=abort"]
    call("run", file, "--dut", "exec:x --y", *options)
    assert played.asked == {
        "device": file,
        "dut": "exec:x --y",
        "depth": "quick",
        "seed": 7,
        "mailbox": "64:1486",
        "only": ("al", "sdo"),
        "replay": "al/up",
        "known": "",
        "choices": ("reply_counter=zero", "bad_service=abort"),
        "hang_timeout": 0.5,
        "progress": None,
        "kept": False,
        "crew": False,
    }


@pytest.mark.parametrize("size", ["34", "1486", "34:1486", "1486:34", "128:64"])
def test_mailbox_sizes_reach_the_runner(call: Call, played: Played, size: str) -> None:
    assert call("run", DEVICE, "--mailbox", size)[0] == 0
    assert played.asked["mailbox"] == size


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Real runs, of few cases."""

    def chosen(model: Model, limits: Limits, depth: str) -> Iterator[Case]:
        assert depth == "quick"
        for case in all_cases(model, limits, depth):
            if case.name.startswith("sdo/transfer/wrong_"):
                yield case

    monkeypatch.setattr(runner, "all_cases", chosen)
    monkeypatch.setitem(runner.EXAMPLES, "quick", 1)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("size", ["34", "64:1486"])
def test_a_run_with_another_mailbox(call: Call, size: str) -> None:
    status, out, _ = call("run", "reference", "--depth", "quick", "--mailbox", size, "--json")
    assert status == 0
    (one,) = json.loads(out)["results"]
    assert one["cases"]["pass"] == sum(one["cases"].values()) > 2


@pytest.mark.usefixtures("few")
def test_a_planted_fault_is_found_and_its_clause_named(call: Call) -> None:
    clauses = set(load_faults()["toggle_ignored"].clauses)
    dut = "model:fault=toggle_ignored"
    status, out, err = call("run", "reference", "--depth", "quick", "--dut", dut, "--json")
    assert (status, err) == (1, "")
    (one,) = json.loads(out)["results"]
    blamed = {clause["id"] for finding in one["findings"] for clause in finding["clauses"]}
    assert clauses & blamed
    status, out, _ = call("run", "reference", "--depth", "quick", "--dut", dut)
    assert status == 1
    assert all(f"{clause} must" in out for clause in clauses & blamed)
    assert call("run", "reference", "--depth", "quick")[0] == 0


@pytest.mark.usefixtures("few")
def test_a_replay_leaves_the_record_of_the_last_run(call: Call) -> None:
    protocol = load_device("reference")
    assert call("run", "reference", "--depth", "quick")[0] == 0
    kept = run_history.load(protocol)
    assert kept is not None
    assert len(kept.cases) > 2
    token = token_of(Case("one", "one", "al", ()))
    assert call("run", "reference", "--replay", token)[0] == 0
    assert run_history.load(protocol) == kept
    fault = ("--dut", "model:fault=toggle_ignored")
    assert call("run", "reference", "--depth", "quick", *fault)[0] == 1
    assert run_history.load(protocol) != kept


@pytest.mark.usefixtures("few")
def test_a_run_that_cannot_be_kept_says_so_and_judges(call: Call, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        (tmp_path / "ecatspec").write_text("a file where a folder should be", encoding="utf-8")
        patch.setenv("XDG_STATE_HOME", str(tmp_path))
        status, out, err = call("run", "reference", "--depth", "quick", "--json")
    assert status == 0
    assert json.loads(out)["conforms"]
    assert "no record of the run is kept in" in err


def test_the_monitor_judges_by_the_standard(call: Call, played: Played) -> None:
    call("monitor", "x.pcap")
    assert played.asked == {"path": "x.pcap", "device": "standard", "progress": None}


def test_a_capture_that_breaks_off_is_a_warning(call: Call, played: Played) -> None:
    cut = replace(result(Outcome.PASS), notes=("9 exchanges", "x.pcap, offset 7: ends; again"))
    played.results = (cut, cut)
    status, _, err = call("monitor", "x.pcap")
    assert (status, err) == (0, "ecatspec: warning: x.pcap, offset 7: ends; again\n")


def test_one_bad_subdevice_is_enough(call: Call, played: Played) -> None:
    played.results = (result(Outcome.PASS), result(Outcome.FAIL), result(Outcome.SKIPPED))
    assert call("monitor", "x.pcap")[0] == 1


def test_results_as_json(call: Call, played: Played) -> None:
    played.results = (result(Outcome.FAIL),)
    for arguments in (["run", DEVICE, "--json"], ["monitor", "x.pcap", "--json"]):
        status, out, err = call(*arguments)
        assert (status, err) == (1, "")
        assert json.loads(out)["conforms"] is False


def test_a_real_capture_is_judged(call: Call, shared: Path, tmp_path: Path) -> None:
    whole = (shared / "captures" / "soem-single-lan9252.pcapng").read_bytes()
    cut = tmp_path / "cut.pcapng"
    cut.write_bytes(whole[: len(whole) // 2])
    status, out, err = call("monitor", str(cut), "--json")
    assert status in {0, 1}
    assert len(json.loads(out)["results"]) == 1
    assert err.startswith(f"ecatspec: warning: {cut}")
    cut.write_bytes(whole[:100])
    assert_refused(call("monitor", str(cut)), str(cut))


# --- mutate ---------------------------------------------------------------------------------------

PLACE = Span("mine.ecs", 7, 3)


def analysis(*fates: Fate, killed: int = 4) -> Analysis:
    protocol = load_standard()
    mutant = Mutant(
        "al.to_init",
        Operator.NEGATED,
        "free",
        "not (free)",
        PLACE,
        frozenset({"al"}),
        follows=False,
        protocol=protocol,
    )
    fated = tuple(
        Fated(mutant, fate, "al/up", ("AL-01",)) if fate is Fate.KILLED else Fated(mutant, fate)
        for fate in fates
    )
    table = TableKills("AL", 2, 3, "a promise", Kills(5, killed, 1, ()))
    return Analysis(DEVICE, "quick", 9, (table,), fated)


NINE_OF_TEN = (*(Fate.KILLED,) * 9, Fate.UNNOTICED, Fate.TOLERATED, Fate.EQUIVALENT)


@pytest.mark.parametrize(
    ("found", "at_least", "status"),
    [
        (analysis(*NINE_OF_TEN), "90", 0),
        (analysis(*NINE_OF_TEN), "90.1", 1),
        (analysis(*NINE_OF_TEN), "", 1),
        (analysis(Fate.KILLED, Fate.TOLERATED), "100", 0),
        (analysis(Fate.KILLED, killed=3), "0", 1),
        (analysis(), "100", 0),
    ],
)
def test_a_score_that_is_too_low_is_status_1(
    call: Call, monkeypatch: pytest.MonkeyPatch, found: Analysis, at_least: str, status: int
) -> None:
    monkeypatch.setattr(kill_analysis, "analyse", lambda *_, **__: found)
    options = ["--at-least", at_least] if at_least else []
    assert call("mutate", DEVICE, *options)[::2] == (status, "")


def test_options_reach_the_analysis(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    def analyse(*arguments: object, **options: object) -> Analysis:
        asked.append((arguments, options))
        return analysis()

    monkeypatch.setattr(kill_analysis, "analyse", analyse)
    call("mutate", DEVICE, "--own", "--only", "al.", "--depth", "quick", "--workers", "3")
    options = {"own": True, "only": "al.", "depth": "quick", "workers": 3, "progress": None}
    assert asked == [((DEVICE,), options)]
    call("mutate", DEVICE)
    options = {"own": False, "only": "", "depth": "default", "workers": os.cpu_count()}
    assert asked[1:] == [((DEVICE,), {**options, "progress": None})]


def test_an_analysis_for_people(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kill_analysis, "analyse", lambda *_, **__: analysis(*NINE_OF_TEN))
    monkeypatch.setenv("COLUMNS", "200")
    _, out, _ = call("mutate", DEVICE)
    lines = [line.split() for line in out.splitlines()]
    assert ["AL", "2", "3", "a", "promise", "5", "1", "4", "100.0", "%"] in lines
    assert ["guard", "negated", "12", "9", "1", "1", "1", "90.0", "%"] in lines
    assert ["off", "by", "one", "0", "0", "0", "0", "0", "100.0", "%"] in lines
    assert ["all", "12", "9", "1", "1", "1", "90.0", "%"] in lines
    assert "mutants of the texts, 9 cases of depth quick\n" in out
    said = "al.to_init: guard negated: free -> not (free)"
    assert out.endswith(f"not noticed: {PLACE}: {said}\n")
    assert out.count("not noticed: ") == 1


def test_an_analysis_as_json(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        kill_analysis, "analyse", lambda *_, **__: analysis(Fate.KILLED, Fate.UNNOTICED)
    )
    status, out, err = call("mutate", DEVICE, "--json")
    assert (status, err) == (1, "")
    wrong = {
        "place": "al.to_init",
        "mistake": "negated",
        "before": "free",
        "after": "not (free)",
        "at": str(PLACE),
    }
    table = {"machine": "AL", "states": 2, "inputs": 3, "guarantee": "a promise"}
    assert json.loads(out) == {
        "schema": "ecatspec.mutate",
        "schema_version": 1,
        "device": DEVICE,
        "depth": "quick",
        "cases": 9,
        "score": 0.5,
        "tables": [{**table, "faults": 5, "equivalent": 1, "killed": 4}],
        "mutants": [
            {**wrong, "fate": "killed", "case": "al/up", "clauses": ["AL-01"]},
            {**wrong, "fate": "unnoticed", "case": "", "clauses": []},
        ],
    }


# --- test vectors ---------------------------------------------------------------------------------


def exported(call: Call, file: Path, *arguments: str, layer: str = "coe") -> dict[str, Any]:
    wanted = ("reference", "--depth", "quick", "--only", layer, "-o", str(file), *arguments)
    status, out, err = call("export", "--format", "json", *wanted)
    data = json.loads(file.read_bytes())
    assert (status, out, err) == (0, "", f"ecatspec: {data['numberOfTests']} tests\n")
    return dict(data)


def test_vectors_are_exported_checked_and_replayed(call: Call, tmp_path: Path) -> None:
    file = tmp_path / "vectors.json"
    data = exported(call, file, "--mailbox", "256", "--choice", "bad_service=abort")
    assert data["choices"]["bad_service"] == "abort"
    assert (data["generator"]["mailbox"], data["config"]["mailboxIn"]["length"]) == ("256", 256)
    assert [path.name for path in tmp_path.iterdir()] == ["vectors.json"]
    assert call("vectors", "lint", str(file)) == (0, "", "")
    assert call("replay", str(file))[0] == 1, "the virtual device goes another way"


def test_the_same_goes_to_standard_output(call: Call, tmp_path: Path) -> None:
    file = tmp_path / "vectors.json"
    exported(call, file)
    wanted = ("reference", "--depth", "quick", "--only", "coe", "--format", "json")
    status, out, _ = call("export", *wanted)
    assert (status, out.encode()) == (0, file.read_bytes())


def test_a_replay_gives_the_report_of_a_run(call: Call, tmp_path: Path) -> None:
    file = tmp_path / "vectors.json"
    data = exported(call, file)
    status, out, err = call("replay", str(file), "--json")
    assert (status, err) == (0, "")
    report = json.loads(out)
    assert report["specification"] == {"name": "reference", "digest": data["spec"]["sha256"]}
    (one,) = report["results"]
    assert one["cases"]["pass"] == sum(one["cases"].values()) == data["numberOfTests"]
    assert one["choices"] == data["choices"]
    assert set(one["rules"]["covered"]) <= set(data["rules"])
    assert one["notes"] == []
    fault = "model:fault=service_unanswered"
    status, out, _ = call("replay", str(file), "--dut", fault)
    assert status == 1
    assert "DOES NOT CONFORM" in out
    assert "CoE service" in out
    assert "sends coe" in out
    assert all(f"{c} must" in out for c in load_faults()["service_unanswered"].clauses)


def edited(file: Path, old: str, new: str) -> str:
    text = file.read_text("utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), "utf-8")
    return str(file)


def test_a_replay_says_what_the_text_has_to_do_with_it(call: Call, tmp_path: Path) -> None:
    file = tmp_path / "vectors.json"
    data = exported(call, file)
    path = edited(file, data["spec"]["sha256"], "0" * 64)
    status, out, _ = call("replay", path, "--json")
    assert status == 0
    assert "is not the one" in json.loads(out)["results"][0]["notes"][0]
    path = edited(file, '"name":"reference"', '"name":"my-own"')
    assert_refused(call("replay", path), str(file), "'my-own'", "--dut")
    assert_refused(call("replay", path, "--dut", "exec:/nonexistent"), "/nonexistent")
    assert_refused(call("replay", path, "--dut", "modle"), "did you mean 'model'?")


def test_a_file_with_a_fault_is_refused_before_anything_is_played(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "vectors.json"
    data = exported(call, file)
    monkeypatch.setattr(replay.Player, "judge", None)
    last = data["testGroups"][-1]["tests"][-1]["id"]
    path = edited(file, f'"id":"{last}"', f'"name":"{last}"')
    assert_refused(call("replay", path), f"{file}: testGroups[0].tests[29]", "`name`")


def test_an_interrupted_replay_shows_what_was_found(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "vectors.json"
    exported(call, file)
    judge = replay.Player.judge

    def interrupted(player: replay.Player, test: Test) -> Verdict:
        if test.tcId == 4:
            raise KeyboardInterrupt
        return judge(player, test)

    monkeypatch.setattr(replay.Player, "judge", interrupted)
    status, out, _ = call("replay", str(file), "--json")
    assert status == 130
    (one,) = json.loads(out)["results"]
    assert (one["interrupted"], one["cases"]["pass"]) == (True, 3)


def test_cases_without_a_test_are_named(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def restless(*_: object) -> None:
        raise RestlessError

    monkeypatch.setattr(Recorder, "apply", restless)
    wanted = ("--depth", "quick", "--only", "coe", "-o", str(tmp_path / "x"))
    status, _, err = call("export", "reference", "--format", "json", *wanted)
    assert status == 0
    assert err.startswith("ecatspec: 0 tests; the virtual SubDevice does not come to rest in 30 ")
    assert "coe/unknown_service/0, " in err
    assert err.count("\n") == 1


def test_what_goes_wrong_leaves_the_file_before(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    file = tmp_path / "vectors.json"
    file.write_text("before", "utf-8")
    monkeypatch.setattr(Recorder, "begin", stopped)
    wanted = ("--depth", "quick", "--only", "coe", "-o", str(file))
    assert call("export", "reference", "--format", "json", *wanted)[0] == 130
    assert [path.read_text("utf-8") for path in tmp_path.iterdir()] == ["before"]


def test_no_binary_on_a_terminal(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    binary = Format("bytes", "bin", FORMATS["json"].write, text=False)
    monkeypatch.setattr(export_command, "FORMATS", {**FORMATS, "json": binary})
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert_refused(call("export", "reference", "--format", "json"), "-o FILE")


@pytest.mark.parametrize(
    ("of", "package"), [("vectors", "generators"), ("report", "conformance.reports")]
)
def test_schemas(call: Call, of: str, package: str) -> None:
    status, out, _ = call("schema", of)
    shipped = resources.files(f"ecatspec.{package}").joinpath(f"{of}.schema.json")
    assert (status, out) == (0, shipped.read_text("utf-8"))


# --- as a process ---------------------------------------------------------------------------------


def process(*arguments: str, **options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, **options},
    )


def test_the_status_of_the_process() -> None:
    refused = process("show", "nothing")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.startswith("ecatspec: no device text is called `nothing`; ")
    assert process("show", "standard").returncode == 0


def test_a_pipe_gets_no_escape_codes() -> None:
    for arguments in (["--help"], ["show", DEVICE], ["show", "nothing"]):
        done = process(*arguments, TERM="xterm-256color")
        assert "\x1b" not in done.stdout + done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["show", DEVICE],
        ["check", "--json", DEVICE],
        ["export", "reference", "--format", "c", "--depth", "quick", "--only", "coe"],
    ],
)
def test_a_reader_who_goes_away_is_no_error(arguments: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [*COMMAND, *arguments],
            stdout=writer,
            stderr=subprocess.PIPE,
            check=False,
            timeout=120,
        )
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def test_an_output_that_is_full_is_one_line() -> None:
    if not os.path.exists("/dev/full"):  # noqa: PTH110  no Path at run time
        pytest.skip("no /dev/full here")
    with open("/dev/full", "wb") as full:  # noqa: PTH123  no Path at run time
        done = subprocess.run(
            [*COMMAND, "show", DEVICE], stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert done.returncode == 2
    assert done.stderr.startswith(b"ecatspec: cannot write to standard output")
    assert done.stderr.count(b"\n") == 1


def test_nothing_heavy_is_imported_for_the_help() -> None:
    code = """
        import sys
        from ecatspec.conformance import cli
        assert cli.main(["--help"]) == 0
        heavy = {"lark", "rich", "hypothesis", "dpkt", "canopen", "z3", "importlib.metadata"}
        heavy |= {"ecatspec.conformance.run.runner", "ecatspec.generators.cases.case"}
        print(sorted(heavy & set(sys.modules)))
    """
    done = subprocess.run(
        [sys.executable, "-P", "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "[]"


# --- reports in files, and annotations ------------------------------------------------------------


def test_reports_are_written_beside_what_is_said(
    call: Call, played: Played, tmp_path: Path
) -> None:
    played.results = (result(Outcome.FAIL),)
    page, tests = tmp_path / "r.html", tmp_path / "r.xml"
    status, out, err = call("run", DEVICE, "--html", str(page), "--junit", str(tests))
    assert (status, err) == (1, "")
    assert "DOES NOT CONFORM" in out
    assert page.read_text("utf-8").startswith("<!doctype html>")
    assert ET.parse(tests).getroot().get("failures") == "1"


@pytest.mark.parametrize("option", ["--html", "--junit"])
@pytest.mark.parametrize("place", ["no/such/folder/r", ".", "a\0b"])
def test_a_report_that_cannot_be_written_is_said_before_the_run(
    call: Call,
    played: Played,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    option: str,
    place: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, err = call("run", DEVICE, option, place)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert not played.asked


def test_a_run_that_fails_to_begin_leaves_the_report_before(
    call: Call, played: Played, tmp_path: Path
) -> None:
    page = tmp_path / "r.html"
    page.write_text("before", "utf-8")
    played.error = AdapterError("no such adapter; there are others")
    status, _, _ = call("run", DEVICE, "--html", str(page))
    assert status == 2
    assert page.read_text("utf-8") == "before"
    assert list(tmp_path.iterdir()) == [page]


def test_github_is_told_after_the_report(call: Call, played: Played) -> None:
    played.results = (result(Outcome.FAIL),)
    _, out, _ = call("run", DEVICE, "--github")
    assert out.splitlines()[-1].startswith("::error title=fail%3A title::")
    status, out, err = call("run", DEVICE, "--github", "--json")
    assert (status, out) == (2, "")
    assert "--github and --json" in err


@pytest.mark.usefixtures("played")
def test_the_report_has_colours_on_a_terminal_alone(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert "\x1b" not in call("run", DEVICE)[1]
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    assert "\x1b" in call("run", DEVICE)[1]
    assert "\x1b" not in call("run", DEVICE, "--json")[1]


def bad_text(folder: Path) -> str:
    path = folder / "bad text.ecs"
    path.write_text("standard x\n  nonsense here\n", "utf-8")
    return str(path)


def test_check_gives_sarif(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bad_text(tmp_path)
    monkeypatch.chdir(tmp_path)
    status, out, err = call("check", "bad text.ecs", "missing.ecs", "--sarif")
    assert status == 2
    assert err.count("\n") == 1
    data = json.loads(out)
    assert data["version"] == "2.1.0"
    (run,) = data["runs"]
    rules = run["tool"]["driver"]["rules"]
    (found,) = run["results"]
    assert rules[found["ruleIndex"]]["id"] == found["ruleId"]
    (place,) = found["locations"]
    where = place["physicalLocation"]
    assert where["artifactLocation"] == {"uri": "bad%20text.ecs", "uriBaseId": "%SRCROOT%"}
    assert where["region"]["startLine"] >= 1
    (invocation,) = run["invocations"]
    assert invocation["executionSuccessful"] is False
    assert "missing.ecs" in invocation["toolExecutionNotifications"][0]["message"]["text"]


def test_sarif_of_a_sound_text_has_no_results(call: Call) -> None:
    file = str(resources.files("ecatspec.spec").joinpath("devices/reference.ecs"))
    status, out, _ = call("check", file, "--sarif")
    assert status == 0
    (run,) = json.loads(out)["runs"]
    assert run["results"] == []
    assert run["invocations"][0]["executionSuccessful"] is True


def test_check_gives_annotations(call: Call, tmp_path: Path) -> None:
    file = bad_text(tmp_path)
    status, out, _ = call("check", file, "--github")
    assert status == 2
    (line,) = out.splitlines()
    assert re.match(rf"::error file={re.escape(file)},line=\d+,col=\d+,title=ECS\d+::", line)


def test_progress_on_a_terminal_says_how_long_it_will_take(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ran(*_: object, progress: Callable[[int, int, str], None], **__: object) -> Result:
        progress(5, 10, "sdo/1")
        return result(Outcome.PASS)

    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr(runner, "run_device", ran)
    _, _, err = call("run", DEVICE)
    assert "5/10" in err
    assert re.search(r"(-:--:--|\d:\d\d:\d\d)", err)
