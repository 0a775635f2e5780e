"""Tests of a run: verdict kinds, devices that die, and the canopen package."""

from __future__ import annotations

import importlib.util
import os
import shlex
import sys
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from causes import CANOPEN, told

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.adapters.model import VirtualAdapter, described, make
from ecatspec.conformance.base.adapter import AdapterError, Description
from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.base.verdict import BLAMING, Outcome, Verdict
from ecatspec.conformance.run import runner as runner_module
from ecatspec.conformance.run.case_executor import limits_of
from ecatspec.conformance.run.device_link import Deviation
from ecatspec.conformance.run.dut_knowledge import SHAPE, shape_of
from ecatspec.conformance.run.runner import Runner, run_device
from ecatspec.generators.cases.bringup import request, way_to
from ecatspec.generators.cases.case import NO_LIMITS, Case, Happen, Probe, WriteOutputs
from ecatspec.generators.cases.case_codec import case_of, token_of
from ecatspec.generators.cases.transfers import upload
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.state import RuleName
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Fault, Pin
from ecatspec.spec.language.load import load_device, plant
from ecatspec.spec.language.parse import parse_text

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.conformance.base.verdict import Result
    from ecatspec.generators.cases.case import Limits

DEVICE = "kollmorgen-akd"
MODEL = Model(load_device(DEVICE))
PREOP = way_to(MODEL, "PREOP")


def case(name: str, *stimuli: object, layer: str = "sdo", needs: str | None = None) -> Case:
    requests = tuple(stimuli) or (Probe(),)
    return Case(name, name, layer, (*PREOP, *requests), needs, len(PREOP))  # type: ignore[arg-type]


class Wrapped:
    """The virtual SubDevice with another description, or with trouble at a write."""

    def __init__(self, protocols: frozenset[str], trouble: Exception | None = None) -> None:
        self.device = make(DEVICE, {})
        self.protocols = protocols
        self.trouble = trouble

    def reset(self) -> None:
        self.device.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        counter, data = self.device.read(address, length)
        at = MODEL.protocol.registers["al_status"].address
        if self.trouble is None and "wrong" in self.protocols and address == at:
            return counter, bytes([data[0] | 0x10, *data[1:]])
        return counter, data

    def write(self, address: int, data: bytes) -> int:
        if self.trouble is not None:
            raise self.trouble
        return self.device.write(address, data)

    def advance(self, seconds: float) -> None:
        self.device.advance(seconds)

    def close(self) -> None:
        pass

    def describe(self) -> Description:
        return Description("wrapped", self.protocols, virtual_time=True, closed_dictionary=True)


def verdict_of(adapter: Adapter, one: Case) -> Verdict:
    return Runner(Model(load_device(DEVICE)), adapter, adapter.describe()).executor.judge(one)


ALL = frozenset({"al", "mailbox", "sdo"})


def test_a_pass() -> None:
    assert verdict_of(Wrapped(ALL), case("probe")).outcome is Outcome.PASS


def test_a_failure_cites_clauses_and_shows_its_trace() -> None:
    verdict = verdict_of(Wrapped(ALL | {"wrong"}), case("probe"))
    assert verdict.outcome is Outcome.FAIL
    assert verdict.observed
    assert verdict.expected


def test_a_layer_that_is_not_the_devices_own_is_skipped() -> None:
    verdict = verdict_of(Wrapped(frozenset({"sdo"})), case("up", layer="al"))
    assert verdict.outcome is Outcome.SKIPPED
    assert "al is not the device's own" in verdict.reason


def test_a_state_that_is_not_reached_is_inconclusive() -> None:
    verdict = verdict_of(Wrapped(ALL), case("in OP", needs="OP"))
    assert verdict.outcome is Outcome.INCONCLUSIVE
    assert verdict.reason == "needs AL state OP, the device is in PREOP"


def test_trouble_of_the_adapter_is_no_fault_of_the_device() -> None:
    verdict = verdict_of(Wrapped(ALL, AdapterError("no cable")), case("probe"))
    assert verdict.outcome is Outcome.ERROR
    assert verdict.reason == "no cable"


# --- devices that die -----------------------------------------------------------------------------

HOST = """
import json, os, signal, sys, time
from ecatspec.conformance.adapters.model import VirtualAdapter, described, make
how, after = sys.argv[1], int(sys.argv[2])
device, sent = make("standard", {}), 0
out = device._device.model.parameter("mailbox_out", "start")
for line in sys.stdin:
    call = json.loads(line)
    answer = {"ok": True}
    match call["op"]:
        case "reset":
            device.reset()
        case "read":
            answer["wkc"], data = device.read(call["address"], call["length"])
            answer["data"] = data.hex()
        case "write":
            sent += call["address"] == out
            if sent == after and call["address"] == out:
                if how == "kill":
                    os.kill(os.getpid(), signal.SIGKILL)
                if how == "sleep":
                    time.sleep(1000)
                if how == "rubbish":
                    sys.stdout.buffer.write(bytes(range(128, 256)) + b"\\n")
                    sys.stdout.flush()
                    continue
            answer["wkc"] = device.write(call["address"], bytes.fromhex(call["data"]))
        case "describe":
            answer["description"] = device.describe().to_json()
        case "close":
            break
    print(json.dumps(answer), flush=True)
"""


@pytest.fixture
def host(tmp_path: Path) -> str:
    script = tmp_path / "host.py"
    script.write_text(HOST, encoding="utf-8")
    return f"exec:{shlex.quote(sys.executable)} {shlex.quote(str(script))}"


@pytest.mark.parametrize(
    ("how", "kind", "words"),
    [
        ("kill", "DeviceCrash", "SIGKILL"),
        ("sleep", "DeviceHang", "no answer within 5 s"),
        ("rubbish", "DeviceRubbish", "not JSON"),
    ],
)
def test_a_death_is_a_verdict_and_the_run_goes_on(
    host: str, how: str, kind: str, words: str
) -> None:
    # long enough for the interpreter to start on a busy machine
    adapter = open_adapter(f"{host} {how} 3", "standard", hang_timeout=5.0)
    model = Model(load_device("standard"))
    try:
        runner = Runner(model, adapter, adapter.describe())
        way = way_to(model, "PREOP")
        asks = upload(0x1018, 2), upload(0x1018, 3)
        probe = Case("probe", "", "sdo", (*way, Probe()))
        deadly = Case("deadly", "", "sdo", (*way, *asks))
        runner.run([probe, deadly, probe], None, 3)
    finally:
        adapter.close()
    first, second, third = runner.verdicts
    assert (first.outcome, third.outcome) == (Outcome.PASS, Outcome.PASS)
    assert second.outcome is Outcome.CRASH
    assert second.reason.startswith("last stimulus: sends sdo_upload_request")
    assert "index 0x1018, subindex 3" in second.reason
    assert words in second.observed
    assert second.signature.startswith(kind)
    assert "SDO-22" in second.clauses
    assert second.trace[-1].what == second.observed


# --- the end of a run -----------------------------------------------------------------------------


def children() -> set[int]:
    """Processes whose parent is this one."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            parts = entry.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        if int(parts[1]) == os.getpid():
            found.add(int(entry.parent.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="counts children in /proc")
def test_an_interrupt_gives_what_was_found_and_leaves_no_process(host: str) -> None:
    before = children()
    during: set[int] = set()

    def progress(number: int, _total: int, _name: str) -> None:
        if number == 5:
            during.update(children() - before)
            raise KeyboardInterrupt

    result = run_device("standard", f"{host} never 0", depth="quick", progress=progress)
    assert result.interrupted
    assert len(result.verdicts) == 5
    assert during
    assert children() <= before


def test_an_interrupt_of_the_random_part(monkeypatch: pytest.MonkeyPatch) -> None:
    def few(_model: Model, _limits: Limits, _depth: str) -> Iterator[Case]:
        yield case("probe")

    def progress(_number: int, _total: int, name: str) -> None:
        if name == "random requests":
            raise KeyboardInterrupt

    monkeypatch.setattr(runner_module, "all_cases", few)
    result = run_device(DEVICE, "model", depth="quick", progress=progress)
    assert result.interrupted
    assert [verdict.case for verdict in result.verdicts] == ["probe"]


def test_the_random_part_of_the_virtual_device_passes() -> None:
    adapter = make(DEVICE, {})
    runner = Runner(Model(load_device(DEVICE)), adapter, adapter.describe())
    runner.explore(10, 0, None)
    assert [verdict.outcome for verdict in runner.verdicts] == [Outcome.PASS]


def test_a_case_begins_from_power_on() -> None:
    adapter = make(DEVICE, {})
    runner = Runner(Model(load_device(DEVICE)), adapter, adapter.describe())
    there = Case("op", "op", "al", way_to(MODEL, "OP"))
    refused = Case("skip", "skip", "al", (request(8),))
    runner.run([there, refused, there], None, 3)
    assert {verdict.outcome for verdict in runner.verdicts} == {Outcome.PASS}


# --- one case again -------------------------------------------------------------------------------

REPEATED = "al/request_PREOP/request_INIT"


def test_a_case_is_run_again_by_its_name() -> None:
    again = run_device("reference", "model", replay=REPEATED)
    assert [(v.case, v.outcome) for v in again.verdicts] == [(REPEATED, Outcome.PASS)]
    assert again.guarantees == ()


def test_a_case_is_run_again_by_its_token() -> None:
    token = token_of(case("mine"))
    again = run_device(DEVICE, "model", replay=token)
    assert [(v.case, v.outcome) for v in again.verdicts] == [("mine", Outcome.PASS)]


@pytest.mark.parametrize(
    ("replay", "words"),
    [
        ("al/request_PREOP/request_INI", f"did you mean {REPEATED!r}?"),
        ("case.", "is no token of a case"),
        ("case.eNpz", "damaged; copy the whole token"),
        (token_of(case("mine"))[:-9], "damaged; copy the whole token"),
        (token_of(Case("x", "x", "al", (Happen("al.rain"),))), "has no local event 'al.rain'"),
        (token_of(Case("x", "x", "al", (WriteOutputs({"wind": 1}),))), "has no word 'wind'"),
    ],
)
def test_what_cannot_be_run_again_is_one_line(replay: str, words: str) -> None:
    with pytest.raises(UserError) as caught:
        run_device("reference", "model", replay=replay)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


# --- complete suites in a run ---------------------------------------------------------------------


@dataclass(frozen=True)
class Promised:
    """Stands for a complete suite of a few cases."""

    own: tuple[Case, ...]
    layer: str = "sdo"
    assumed: Mapping[str, str] = field(default_factory=dict)

    @property
    def suite(self) -> Promised:
        return self

    @property
    def tests(self) -> int:
        return len(self.own)

    def cases(self) -> Iterator[Case]:
        return iter(self.own)

    def guarantee(self) -> str:
        return "a promise"


def completed(
    monkeypatch: pytest.MonkeyPatch, suite: Promised, protocols: frozenset[str] = ALL
) -> tuple[Runner, list[str]]:
    adapter = Wrapped(protocols)
    runner = Runner(Model(load_device(DEVICE)), adapter, adapter.describe())
    runner.known.choices["refused_in_op"] = "stay"
    monkeypatch.setattr(runner_module, "complete_suites", lambda *_: [suite])
    return runner, runner.complete("default", None)


def test_a_suite_that_passes_keeps_its_promise(monkeypatch: pytest.MonkeyPatch) -> None:
    suite = Promised((case("one"), case("two")), assumed={"refused_in_op": "stay", "x": "y"})
    runner, told = completed(monkeypatch, suite)
    assert told == ["a promise; passed"]
    assert [v.case for v in runner.verdicts] == ["one", "two"]


def test_a_suite_that_fails_promises_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    suite = Promised((case("one"), case("two"), case("op", needs="OP")))
    _, told = completed(monkeypatch, suite)
    assert told == ["a promise; promises nothing: 1 inconclusive"]
    _, told = completed(monkeypatch, suite, ALL | {"wrong"})
    assert told == ["a promise; promises nothing: 3 fail"]


def test_a_suite_of_another_way_promises_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    suite = Promised((case("one"),), assumed={"refused_in_op": "drop_to_safeop"})
    _, told = completed(monkeypatch, suite)
    assert told == ["a promise; promises nothing: the device goes another way at refused_in_op"]


@pytest.mark.parametrize(
    ("way", "words"),
    [
        ("refused", "a promise; passed"),
        (
            "accepted",
            "a promise; promises nothing: the device goes another way at op_without_outputs",
        ),
    ],
)
def test_what_a_suite_believes_of_a_device_blames_nobody(
    monkeypatch: pytest.MonkeyPatch, way: str, words: str
) -> None:
    texts = load_device(DEVICE)
    pin = Pin("op_without_outputs", way, ())
    device = VirtualSubDevice(replace(texts, pins={**texts.pins, pin.choice: pin}))
    runner = Runner(MODEL, VirtualAdapter(device, described(texts)), described(texts))
    safeop, op = way_to(MODEL, "SAFEOP"), request(MODEL.row("al_state", "OP"))
    one = Case("one", "one", "al", (*safeop, op), None, 0)
    runner.known.untold.add(pin.choice)
    suite = Promised((one,), "al", {pin.choice: "refused"})
    monkeypatch.setattr(runner_module, "complete_suites", lambda *_: [suite])
    assert runner.complete("default", None) == [words]
    (verdict,) = runner.verdicts
    assert verdict.outcome is Outcome.PASS
    # that a refusal was one for want of outputs is believed, not known
    assert RuleName("al", "safeop_to_op_refused") not in runner.known.rules
    assert RuleName("al", "preop_to_safeop") in runner.known.rules
    assert (RuleName("al", "safeop_to_op") in runner.known.rules) == (way == "accepted")


def test_what_is_not_conclusive_under_belief_is_judged_without_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runner = Runner(MODEL, make(DEVICE, {}), make(DEVICE, {}).describe())
    runner.known.untold.add("op_without_outputs")
    suite = Promised((case("one"),), assumed={"op_without_outputs": "refused"})
    monkeypatch.setattr(runner_module, "complete_suites", lambda *_: [suite])

    def judged(one: Case) -> Verdict:
        outcome = Outcome.INCONCLUSIVE if runner.known.believed else Outcome.PASS
        return Verdict(one.name, outcome, one.title)

    monkeypatch.setattr(runner.executor, "_judge", judged)
    (told,) = runner.complete("default", None)
    assert [verdict.outcome for verdict in runner.verdicts] == [Outcome.PASS]
    assert told.endswith("goes another way at op_without_outputs")


def test_in_virtual_time_looks_are_where_something_must_have_happened() -> None:
    adapter = make("reference-drive", {"fault": "fault_unnoticed"})
    runner = Runner(Model(load_device("reference-drive")), adapter, adapter.describe())
    op = runner.model.row("al_state", "OP")
    (case,) = (
        case for case in all_cases(runner.model, NO_LIMITS, "quick") if case.name == "ds402/fault"
    )
    *before, fault = case.stimuli
    runner.executor.session.begin(SHAPE, runner.executor.configuration())
    for stimulus in before:
        runner.executor.session.apply(stimulus)
    began, exchanges = runner.executor.session.time, runner.executor.session.exchanges
    runner.executor.session.apply(request(op))  # nothing shows that it was taken
    assert runner.executor.session.time - began == 200_001
    # the request; three looks of three reads, at once, soon and at the deadline; outputs between
    assert runner.executor.session.exchanges - exchanges == 1 + 3 * 3 + 2
    began = runner.executor.session.time
    with pytest.raises(Deviation) as found:
        runner.executor.session.apply(fault)
    # long before the reaction to the fault must have ended
    assert runner.executor.session.time - began < 10_000_000
    assert "DRV-16" in found.value.mismatch.clauses


NEVER_UP = """
faults never_up "a device that is never where cases need it"

fault never_up "SAFEOP is always refused, for a reason of the device's own" [AL-11]
  remove rule al.preop_to_safeop [AL-11]
  replace rule al.preop_to_safeop_held [AL-11]
    when   heard and requested == SAFEOP and not outputs_wrong and not inputs_wrong
"""


def test_the_states_that_were_never_reached_are_known() -> None:
    sound = load_device("reference-drive")
    (never,) = (d for d in parse_text(NEVER_UP, "x").declarations if isinstance(d, Fault))
    for protocol, unreached in ((sound, ()), (plant(sound, never), ("SAFEOP", "OP"))):
        adapter = VirtualAdapter(VirtualSubDevice(protocol), described(protocol))
        runner = Runner(Model(sound), adapter, adapter.describe())
        named = ("process_data/op_with_outputs", "process_data/disabled_sync_manager_2/OP")
        cases = [c for c in all_cases(runner.model, NO_LIMITS, "quick") if c.name in named]
        runner.run(cases, None, len(cases))
        assert runner.unreached() == unreached
        assert not any(verdict.outcome in BLAMING for verdict in runner.verdicts)


def test_a_choice_that_nothing_tells_is_kept_in_mind() -> None:
    adapter = make(DEVICE, {})
    runner = Runner(MODEL, adapter, adapter.describe())
    safeop, op = way_to(MODEL, "SAFEOP"), request(MODEL.row("al_state", "OP"))
    runner.executor.judge(Case("one", "one", "al", (*safeop, op), None, 0))
    assert "op_without_outputs" in runner.known.untold
    assert "op_without_outputs" not in runner.known.choices


def test_a_suite_of_a_layer_that_is_not_the_devices_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runner, told = completed(monkeypatch, Promised((case("one"),), layer="ds402"))
    assert (told, runner.verdicts) == ([], [])


def test_a_suite_is_asked_for_with_what_the_device_showed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[object, ...]] = []

    def suites(*arguments: object) -> list[Promised]:
        asked.append(arguments)
        return []

    monkeypatch.setattr(runner_module, "complete_suites", suites)
    adapter = make(DEVICE, {})
    description = replace(adapter.describe(), locals=frozenset({"ds402.fault"}))
    runner = Runner(Model(load_device(DEVICE)), adapter, description)
    runner.known.choices |= {"refused_in_op": "stay", "not of these texts": "x"}
    assert runner.complete("exhaustive", None) == []
    ((model, limits, events, ways, depth),) = asked
    assert (model, limits) == (runner.model, limits_of(description))
    assert (events, depth) == ({"ds402.fault"}, "exhaustive")
    assert ways == {**shape_of(MODEL.protocol), "refused_in_op": "stay"}


def test_a_long_run_shortens_each_cause_once() -> None:
    adapter = Wrapped(ALL | {"wrong"})
    runner = Runner(Model(load_device(DEVICE)), adapter, adapter.describe())
    long = case("long", Probe(), upload(0x1018, 1), Probe())
    runner.run_long([long, long], None, 2)
    first, second = runner.verdicts
    assert first.signature == second.signature
    assert case_of(first.replay).stimuli[len(PREOP) :] == ()
    assert case_of(second.replay).name == second.case


# --- the package canopen --------------------------------------------------------------------------

FOUND = {
    ("SDO-07", "sdo_download_response"): "server.py:134 a missing object is found with the data",
    ("SDO-08", "sdo_upload_expedited"): "local.py:131 the subindex of a variable is not looked at",
    ("SDO-08", "sdo_abort"): "local.py:131 the same, refused for the right of the variable",
    ("SDO-10", "sdo_download_response"): "server.py:135 the right is looked at with the data",
    (
        "SDO-11",
        "sdo_download_response",
    ): "server.py:135 the same, of a right that depends on a state",
    ("SDO-11", "sdo_abort"): "local.py:113 the same, refused for the size of the value",
    ("SDO-13", "sdo_download_response"): "local.py:113 the size of a truth value is not looked at",
    ("SDO-15", "sdo_download_segment_response"): "local.py:100 min and max are not looked at",
    ("SDO-17", "struct.error"): "server.py:188 an abort needs the index of an earlier request",
    ("SDO-18", "sdo_download_segment_response"): "server.py:160 nothing ends a download",
    ("SDO-18", "sdo_abort"): "server.py:88 the toggle bit of what is over",
    ("SDO-32", "sdo_download_segment_response"): "server.py:151 the announced size is not kept",
    ("SDO-33", "sdo_download_segment_response"): "server.py:151 the same, of too few bytes",
}
"""Broken clause and word of the observation -> the line of canopen 2.4.1 that is to blame."""


def found(result: Result) -> dict[str, set[tuple[str, str]]]:
    """Give the rows of FOUND that explain each finding."""
    return {
        verdict.case: {
            (clause, word)
            for clause, word in FOUND
            if clause == verdict.broken and word in verdict.observed
        }
        for finding in result.findings()
        for verdict in (finding.verdict, *(kind for kind, _ in finding.kinds))
    }


alone = pytest.mark.xdist_group("canopen")
"""All on one worker, so that the run is made once."""


@cache
def canopen() -> Result:
    if importlib.util.find_spec("canopen") is None:
        pytest.skip('the package canopen is not installed: pip install "ecatspec[canopen]"')
    return run_device("reference", "canopen", depth="quick")


@alone
def test_canopen_has_the_findings_that_were_checked_by_hand_and_no_other() -> None:
    explained = found(canopen())
    assert {case for case, rows in explained.items() if not rows} == set()
    assert set(FOUND) - set().union(*explained.values()) == set()
    causes, findings = told()[CANOPEN]
    assert len({text.partition(" ")[0] for text in FOUND.values()}) == causes
    assert len(canopen().findings()) == findings


@alone
def test_what_frames_of_canopen_do_not_carry_is_skipped_and_said() -> None:
    words = {
        verdict.reason.rpartition(": ")[2].partition(",")[0]
        for verdict in canopen().verdicts
        if verdict.outcome is Outcome.SKIPPED and "cannot carry it" in verdict.reason
    }
    notes = {note.partition(":")[0].removeprefix("without ") for note in canopen().notes}
    assert {"complete_access", "malformed", "oversized", "mailbox_restart"} <= words <= notes
    sent = [line.what for v in canopen().verdicts for line in v.trace if line.who == "MainDevice"]
    begun = [what for what in sent if what.startswith("sends sdo_download_normal")]
    assert begun
    assert all(what.endswith("value empty") for what in begun)


@alone
def test_canopen_dies_of_an_unknown_command_as_first_request() -> None:
    (verdict,) = [v for v in canopen().verdicts if v.case == "sdo/unknown_command/7"]
    assert verdict.outcome is Outcome.CRASH
    assert "command 7" in verdict.reason
    assert "SDO-17" in verdict.clauses
    assert "struct.error" in verdict.observed


@alone
def test_canopen_knows_a_subindex_of_a_plain_variable() -> None:
    (verdict,) = [v for v in canopen().verdicts if v.case == "sdo/no_subindex/upload/1000_01"]
    assert verdict.outcome is Outcome.FAIL
    assert "SDO-08" in verdict.clauses
    assert verdict.observed.startswith("sdo_upload_expedited")


@alone
def test_every_finding_of_canopen_is_short() -> None:
    lengths = {f.verdict.case: len(f.verdict.trace) for f in canopen().findings()}
    # a transfer in frames of eight bytes is as long as its value
    short = {case: n for case, n in lengths.items() if not case.startswith("sdo/transfer/")}
    assert short
    # 4 lines of bring-up, two looks at the entry and its neighbours, two exchanges
    assert max(short.values()) <= 4 + 2 * 3 * 2 + 2 * 2, short
