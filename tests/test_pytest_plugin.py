"""Tests of the pytest plugin: the suite of a device as tests of pytest."""

from __future__ import annotations

import random
import re
import subprocess
import sys
import textwrap
import time
import tomllib
from dataclasses import replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast
from xml.etree import ElementTree as ET

import pytest

from ecatspec.conformance import pytest_plugin
from ecatspec.conformance.adapters import model, open_adapter
from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.adapter import AdapterError, Unheard
from ecatspec.conformance.base.devices import going, load
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.pytest_plugin import bench
from ecatspec.conformance.run.case_executor import CaseExecutor
from ecatspec.conformance.run.dut_knowledge import SHAPE
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice

if TYPE_CHECKING:
    from collections.abc import Callable

    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.generators.cases.case import Case, Limits
    from ecatspec.spec.language.ir import Protocol

pytest_plugins = ["pytester"]

ROOT = Path(__file__).resolve().parent.parent
NAME = "ecatspec"
WARNING = f"{pytest_plugin.__name__}.{pytest_plugin.EcatWarning.__name__}"
INSTALLED = bool(entry_points(group="pytest11", name=NAME))
LOADED = () if INSTALLED else ("-p", pytest_plugin.__name__)
TEXT = """
device tiny extends standard "a device with little to try"
clause TINY-1 must "these objects" source "this text"
dictionary closed [TINY-1]
objects
  0x1000 : 0 device_type u32 ro constant = 0 [TINY-1]
  0x2001 : 0 name text(20) rw = "long enough" [TINY-1]
"""
SLAVE = """
import json, os, sys
from ecatspec.conformance.adapters.model import make
device = make("tiny.ecs", {})
with open(f"pid.{os.getpid()}", "w"):
    pass
mailbox, dies = device._device.model.parameter("mailbox_out", "start"), "die" in sys.argv
for line in sys.stdin:
    match json.loads(line):
        case {"op": "describe"}:
            reply = {"description": device.describe().to_json()}
        case {"op": "read", "address": address, "length": length}:
            counter, data = device.read(address, length)
            reply = {"wkc": counter, "data": data.hex()}
        case {"op": "write", "address": address, "data": data}:
            if dies and address == mailbox:
                os.abort()
            reply = {"wkc": device.write(address, bytes.fromhex(data))}
        case {"op": "advance", "seconds": seconds}:
            reply = device.advance(seconds) or {}
        case {"op": "reset"}:
            reply = device.reset() or {}
        case _:
            reply = {}
    print(json.dumps({"ok": True, **reply}), flush=True)
"""
SOUND = f"exec:{sys.executable} slave.py"
PATIENT = ("--ecat-hang-timeout", "600")
"""Options for a device that loads its text first, which takes long on a busy machine."""


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Protocol:
    path = tmp_path_factory.mktemp("text") / "tiny.ecs"
    path.write_text(TEXT, encoding="utf-8")
    return load(str(path))


@pytest.fixture(scope="module")
def cases(tiny: Protocol) -> Callable[[Limits], tuple[Case, ...]]:
    return cache(lambda limits: tuple(all_cases(Model(tiny), limits, "quick")))


@pytest.fixture
def desk(
    pytester: pytest.Pytester,
    monkeypatch: pytest.MonkeyPatch,
    tiny: Protocol,
    cases: Callable[[Limits], tuple[Case, ...]],
) -> pytest.Pytester:
    """A folder with a text, and with a program that is such a device.

    In this process text and cases are made once for all tests; worker processes make their own.
    """
    pytester.path.joinpath("tiny.ecs").write_text(TEXT, encoding="utf-8")
    pytester.path.joinpath("slave.py").write_text(SLAVE, encoding="utf-8")

    def kept(name: str, mailbox: str = "") -> Protocol:
        known = name == "tiny.ecs" and not mailbox and Path(name).read_text("utf-8") == TEXT
        return tiny if known else load(name, mailbox)

    monkeypatch.setattr(bench, "load", kept)
    monkeypatch.setattr(model, "load", kept)
    monkeypatch.setattr(bench, "all_cases", lambda _model, limits, _depth: cases(limits))
    return pytester


def run(desk: pytest.Pytester, *options: str) -> pytest.RunResult:
    given = ["--ecat-device", "tiny.ecs", "--ecat-depth", "quick", "--strict-markers"]
    if any(option.startswith("exec:") for option in options):
        given += PATIENT
    return desk.runpytest_inprocess(*LOADED, *given, *options)


def outcomes(result: pytest.RunResult) -> dict[str, int]:
    found = result.parseoutcomes()
    return {name: n for name, n in found.items() if name not in {"deselected", "warnings"}}


def words_of(result: pytest.RunResult) -> str:
    return result.stdout.str()


def devices(desk: pytest.Pytester) -> list[int]:
    return [int(path.suffix[1:]) for path in desk.path.glob("pid.*")]


def lives(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def end(desk: pytest.Pytester) -> bool:
    """Whether all devices of a run have ended, a moment later."""
    until = time.monotonic() + 5
    while any(map(lives, devices(desk))) and time.monotonic() < until:
        time.sleep(0.02)
    return not any(map(lives, devices(desk)))


# --- outcomes -------------------------------------------------------------------------------------


def test_a_sound_device_passes_in_another_process_and_is_closed(desk: pytest.Pytester) -> None:
    found = run(desk, "--ecat-dut", SOUND, "-k", "mailbox/repeat", "-v")
    assert outcomes(found) == {"passed": 11}
    assert found.ret == pytest.ExitCode.OK
    found.stdout.fnmatch_lines(["tiny::mailbox::mailbox/repeat_in_safeop PASSED*"])
    assert len(devices(desk)) == 1
    assert end(desk)


def test_a_failure_explains_itself_once(
    desk: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CI", "1")  # there pytest cuts nothing from its summary
    dut = "model:fault=toggle_ignored"
    found = run(desk, "--ecat-dut", dut, "-k", "wrong_second_toggle", "--junitxml=junit.xml")
    assert outcomes(found) == {"failed": 1}
    found.stdout.fnmatch_lines(
        [
            "*_ sdo/transfer/wrong_second_toggle _*",
            "FAIL: *",
            "  broken    SDO-30 must: a segment with the wrong toggle bit is refused with*",
            "            source: facts 5.3, D-27",
            "  expected  sdo_abort:*",
            "*code 0x05030000 toggle_not_alternated",
            "  observed  >sdo_download_segment_response<:*",
            "  trace  MainDevice  SubDevice",
            "    0.000 ms  |---------->|  writes al_control: requested 2 PREOP*",
            f"  replay    ecatspec run tiny.ecs --dut {dut} --replay sdo/transfer/wrong_second_*",
            "FAILED tiny::sdo::sdo/transfer/wrong_second_toggle - Failed: FAIL:*",
        ]
    )
    assert words_of(found).count(" --replay ") == 1
    case = ET.parse(desk.path / "junit.xml").getroot().find("testsuite/testcase")
    assert case is not None
    assert (case.get("classname"), case.get("name")) == (
        "tiny.sdo",
        "sdo/transfer/wrong_second_toggle",
    )
    assert case.find("failure") is not None
    clauses = case.find("properties/property[@name='clauses']")
    assert clauses is not None
    assert "SDO-30" in (clauses.get("value") or "").split()


def test_a_device_that_dies_fails_and_lives_again(desk: pytest.Pytester) -> None:
    found = run(
        desk,
        "--ecat-dut",
        f"{SOUND} die",
        "-k",
        "upload/1000_00 or upload/2001_00 or register/station",
    )
    assert outcomes(found) == {"passed": 1, "failed": 2}
    found.stdout.fnmatch_lines(
        [
            "CRASH: *",
            "*observed  the device ended: killed by SIGABRT*",
            "*|---------->|  sends sdo_up*",
        ]
    )
    assert len(devices(desk)) == 3  # one more after each death
    assert end(desk)


def test_what_cannot_be_judged_is_skipped_with_its_reason(desk: pytest.Pytester) -> None:
    found = run(
        desk, "--ecat-dut", "canopen", *PATIENT, "-k", "mailbox/repeat or malformed/sdo_ab", "-rs"
    )
    assert set(outcomes(found)) == {"skipped"}
    found.stdout.fnmatch_lines_random(
        [
            "SKIPPED [[]*[]] tiny: mailbox is not the device's own: *",
            "SKIPPED [[]*[]] tiny: *cannot carry it: malformed, see its notes",
        ]
    )


def test_trouble_of_an_adapter_is_an_error_and_no_failure(
    desk: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reset(_: VirtualAdapter) -> None:
        raise AdapterError("the cable is out; put it in")

    monkeypatch.setattr(VirtualAdapter, "reset", reset)
    found = run(desk, "-k", "register/station")
    assert outcomes(found) == {"errors": 1}
    found.stdout.fnmatch_lines(["ERROR: *", "*the cable is out; put it in*"])


def test_a_should_is_a_warning_that_can_be_made_a_failure(
    desk: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    judge = CaseExecutor.judge

    def mild(runner: CaseExecutor, case: Case) -> Verdict:
        return replace(judge(runner, case), outcome=Outcome.WARNING)

    monkeypatch.setattr(CaseExecutor, "judge", mild)
    fault = ("--ecat-dut", "model:fault=toggle_ignored", "-k", "wrong_second_toggle")
    found = run(desk, *fault, "-W", "default")
    assert outcomes(found) == {"passed": 1}
    found.stdout.fnmatch_lines(["*EcatWarning: WARNING: *", "*broken    SDO-30 must: *"])
    assert outcomes(run(desk, *fault, "-W", f"error::{WARNING}")) == {"failed": 1}


def test_what_is_made_while_it_runs_is_judged_too(desk: pytest.Pytester) -> None:
    made = ("--ecat-depth", "default", "-k", "complete/ or walk/0 or random/", "-v")
    found = run(desk, *made)
    assert outcomes(found) == {"passed": 3}
    for name in ("complete::complete/default", "random::walk/0_60", "random::random/seed_0"):
        found.stdout.fnmatch_lines([f"tiny::{name} PASSED*"])
    few = ("--ecat-depth", "default", "-k", "complete/", "-v")
    found = run(desk, *few, "--ecat-dut", "model:fault=refused_without_error")
    found.stdout.fnmatch_lines(["tiny::complete::complete/default FAILED*"])
    found.stdout.fnmatch_lines(["  case      al/complete/*", "  also      * other case* the same"])
    found = run(desk, *made, "--ecat-only", "mailbox", "-rs")
    assert outcomes(found) == {"skipped": 1}
    found.stdout.fnmatch_lines(["SKIPPED *tiny: there is nothing to try in these layers"])


# --- selection ------------------------------------------------------------------------------------


def test_clauses_and_layers_are_markers(
    desk: pytest.Pytester,
    monkeypatch: pytest.MonkeyPatch,
    cases: Callable[[Limits], tuple[Case, ...]],
) -> None:
    few = [case for case in cases(NO_LIMITS) if case.name.startswith(("sdo/transfer", "mailbox"))]
    monkeypatch.setattr(bench, "all_cases", lambda *_: few)
    found = run(desk, "-m", "SDO-30 and sdo", "--co", "-q")
    found.stdout.fnmatch_lines(["ecatspec: looks which of * tests exercise SDO-30*"])
    chosen = {line for line in found.outlines if line.startswith("tiny::")}
    assert "tiny::sdo::sdo/transfer/wrong_second_toggle" in chosen
    assert 3 < len(chosen) < 15
    # the second time it is known
    again = run(desk, "-m", "SDO-30 and not mailbox", "--co", "-q")
    again.stdout.no_fnmatch_line("*looks which*")
    assert {line for line in again.outlines if line.startswith("tiny::")} == chosen


def test_workers_have_a_device_each_that_ends_with_them(desk: pytest.Pytester) -> None:
    desk.makepyfile(
        """
        import os
        def test_that_kills_its_worker(ecat_device):
            os._exit(1)
        """
    )
    few = "mailbox/repeat or kills_its_worker"
    found = run(desk, "--ecat-dut", SOUND, "-k", few, "-n", "2", "-v")
    assert outcomes(found) == {"passed": 11, "failed": 1}
    assert "crashed while running" in words_of(found)
    assert all(f"[gw{number}]" in words_of(found) for number in (0, 1))
    # one that was asked whether it is there, one for each worker, and for the one that follows
    assert len(devices(desk)) == 4
    assert end(desk)


def test_a_device_ends_with_the_interrupt(desk: pytest.Pytester) -> None:
    desk.makepyfile(
        """
        def test_that_is_interrupted(ecat_session):
            raise KeyboardInterrupt
        """
    )
    given = ("--ecat-device", "tiny.ecs", "--ecat-depth", "quick", "--ecat-dut", SOUND, *PATIENT)
    found = desk.runpytest_subprocess(*LOADED, *given, "-k", "is_interrupted")
    assert found.ret == pytest.ExitCode.INTERRUPTED
    assert len(devices(desk)) == 1
    assert end(desk)


# --- options --------------------------------------------------------------------------------------


def test_a_known_deviation_is_an_expected_failure(desk: pytest.Pytester) -> None:
    dut, name = "model:fault=toggle_ignored", "sdo/transfer/wrong_second_toggle"
    runner = Runner(Model(load("tiny.ecs")), *_reached(dut))
    runner.run([c for c in all_cases(runner.model, NO_LIMITS, "quick") if c.name == name], None, 0)
    (verdict,) = runner.verdicts
    file = desk.path / "known.toml"
    text = 'device = "tiny"\n\n[[known]]\nfinding = "{}"\nreason = "mended in 2.1"\n'
    file.write_text(text.format(verdict.signature), encoding="utf-8")
    wanted = ("--ecat-dut", dut, "-k", "wrong_second_toggle", "--ecat-known", "known.toml", "-rx")
    found = run(desk, *wanted)
    assert outcomes(found) == {"xfailed": 1}
    assert found.ret == pytest.ExitCode.OK
    found.stdout.fnmatch_lines([f"XFAIL tiny::sdo::{name} - known: mended in 2.1"])
    file.write_text(text.format("another"), encoding="utf-8")
    found = run(desk, *wanted)
    assert outcomes(found) == {"failed": 1}
    found.stdout.fnmatch_lines(["*--known known.toml*"])


def _reached(dut: str) -> tuple[Adapter, Description]:
    adapter = open_adapter(dut, "tiny.ecs")
    return adapter, adapter.describe()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--ecat-known", "none.toml"), "none.toml is no file of known deviations *"),
        (("--ecat-only", "sd"), "no layer is called 'sd'; did you mean 'sdo'?"),
        (("--ecat-dut", "exec:/none"), "cannot start '/none': No such file or directory; *"),
        (("--ecat-dut", "exec:/none", "-n", "2"), "cannot start '/none': *"),
        (("--ecat-device", "slave.py"), "'slave.py' is no device; give a name, *"),
        (("--ecat-mailbox", "3"), "'3' is no mailbox size; *"),
        (("--ecat-depth", "deep"), "*invalid choice: 'deep'*"),
        (("--ecat-seed", "-1"), "*'-1' is no number from 0 on"),
        (("--ecat-hang-timeout", "nan"), "*'nan' is no number of seconds above 0"),
    ],
)
def test_a_bad_option_is_one_line(
    desk: pytest.Pytester, options: tuple[str, ...], said: str
) -> None:
    found = run(desk, *options)
    assert found.ret == pytest.ExitCode.USAGE_ERROR
    found.stderr.fnmatch_lines([f"*{said}"])
    assert "Traceback" not in words_of(found) + found.stderr.str()


def test_a_wrong_text_is_told_with_its_place(desk: pytest.Pytester) -> None:
    desk.path.joinpath("tiny.ecs").write_text("devise", encoding="utf-8")
    found = run(desk)
    assert found.ret == pytest.ExitCode.USAGE_ERROR
    found.stderr.fnmatch_lines(["ERROR: *tiny.ecs:1:1: ECS001 *"])


def test_without_a_device_there_is_nothing_but_a_group_of_options(desk: pytest.Pytester) -> None:
    desk.makepyfile(
        """
        import sys
        def test_own(): pass
        def test_needing(ecat_session): pass
        """
    )
    found = desk.runpytest_inprocess(*LOADED, "-rs")
    assert outcomes(found) == {"passed": 1, "skipped": 1}
    found.stdout.fnmatch_lines(["SKIPPED*no device under test: give --ecat-device*"])
    found = desk.runpytest_inprocess(*LOADED, "--ecat-dut", "model")
    assert found.ret == pytest.ExitCode.USAGE_ERROR
    found.stderr.fnmatch_lines(["ERROR: --ecat-dut needs --ecat-device; *"])


def test_the_plugin_is_light_and_declared() -> None:
    code = f"import sys, pytest; before = set(sys.modules); import {pytest_plugin.__name__}"
    code += "; print(*(m for m in set(sys.modules) - before if not m.startswith('ecatspec')))"
    code += "; print(*sorted(m for m in sys.modules if m.startswith('ecatspec.')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    foreign, own = done.stdout.splitlines()
    assert foreign == ""
    assert own.split() == [
        "ecatspec.conformance",
        "ecatspec.conformance.pytest_plugin",
        "ecatspec.conformance.pytest_plugin.warned",
        "ecatspec.generators",
        "ecatspec.generators.cases",
        "ecatspec.generators.cases.depths",
    ]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["entry-points"]["pytest11"] == {NAME: pytest_plugin.__name__}


# --- tests of users -------------------------------------------------------------------------------


def test_users_have_a_device_and_a_judged_session(desk: pytest.Pytester) -> None:
    desk.makepyfile(
        test_mine="""
        from ecatspec.generators.suite import all_cases

        def case_of(session):
            cases = all_cases(session.model, session.limits)
            return next(c for c in cases if c.name == "sdo/transfer/wrong_second_toggle")

        def test_bytes(ecat_device):
            assert ecat_device.describe().virtual_time
            ecat_device.write(0x120, bytes([1, 0]))
            counter, data = ecat_device.read(0x130, 2)
            assert (counter, data) == (1, bytes([1, 0]))

        def test_way(ecat_session):
            ecat_session.go_to("PREOP")
            assert ecat_session.state == "PREOP"
            ecat_session.read(0x2001, 0)

        def test_case(ecat_session):
            assert ecat_session.judge(case_of(ecat_session)).outcome == "pass"

        def test_steps(ecat_session):
            ecat_session.apply(*case_of(ecat_session).stimuli)
        """
    )
    assert outcomes(run(desk, "-k", "test_mine")) == {"passed": 4}
    found = run(desk, "-k", "test_mine", "--ecat-dut", "model:fault=toggle_ignored")
    assert outcomes(found) == {"passed": 2, "failed": 2}
    found.stdout.fnmatch_lines(
        [
            "*_ test_steps _*",
            "FAIL: sdo_download_segment_response, but a segment with the wrong toggle bit*",
            "  broken    SDO-30 must: *",
            "  replay    ecatspec run tiny.ecs --dut model:fault=toggle_ignored --replay case.*",
        ]
    )


def test_a_session_that_loses_an_exchange_is_skipped(
    desk: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(*_: object) -> int:
        raise Unheard("a frame got lost")

    monkeypatch.setattr(VirtualAdapter, "write", write)
    desk.makepyfile(test_mine="def test_way(ecat_session): ecat_session.go_to('PREOP')")
    found = run(desk, "-k", "test_mine", "-rs")
    assert outcomes(found)["skipped"] == 1
    found.stdout.fnmatch_lines(["SKIPPED *a frame got lost"])


def test_the_tests_of_the_page_pass(desk: pytest.Pytester) -> None:
    page = (ROOT / "docs" / "pytest.md").read_text(encoding="utf-8")
    block = page.partition("## Tests of your own\n\n")[2].partition("\n| fixture")[0]
    desk.makepyfile(test_page=textwrap.dedent(block))
    assert outcomes(run(desk, "-k", "test_page")) == {"passed": 2}


def test_the_page_has_the_options_and_outcomes() -> None:
    page = (ROOT / "docs" / "pytest.md").read_text(encoding="utf-8")
    options: list[str] = []
    group = SimpleNamespace(addoption=lambda name, **_: options.append(name))
    pytest_plugin.pytest_addoption(
        cast("pytest.Parser", SimpleNamespace(getgroup=lambda *_: group))
    )
    assert re.findall(r"^\| `(--[\w-]+)` \|", page, re.MULTILINE) == options
    shown = set(re.findall(r"--ecat-[\w-]+", page))
    assert shown == set(options)
    for outcome in Outcome:
        assert re.search(rf"^\| .*\b{outcome}\b", page, re.MULTILINE), outcome
    assert f"-W error::{WARNING}`" in page


# --- the order of tests ---------------------------------------------------------------------------


@pytest.mark.parametrize("way", [0, -1])
def test_no_order_and_no_choice_of_cases_blames_a_right_device(
    way: int, tiny: Protocol, cases: Callable[[Limits], tuple[Case, ...]]
) -> None:
    ways = {name: choice.alternatives[way].name for name, choice in tiny.choices.items()}
    device = going(tiny, ways | SHAPE)
    adapter = VirtualAdapter(VirtualSubDevice(device), described(device))
    sample = random.Random(way).sample(cases(NO_LIMITS), 60)
    runner = Runner(Model(tiny), adapter, adapter.describe())
    runner.run(sample, None, 0)
    for case in sample[:20]:
        alone = Runner(Model(tiny), adapter, adapter.describe())
        alone.run((case,), None, 0)
        runner.verdicts += alone.verdicts
    assert {verdict.outcome for verdict in runner.verdicts} == {Outcome.PASS}
    assert runner.known.choices.items() <= (ways | SHAPE).items()
