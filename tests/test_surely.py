"""Tests of how sure a finding is: ways it depends on, and no power cycle."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import pytest

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.base.devices import UserError, load
from ecatspec.conformance.base.verdict import Outcome, SetUp
from ecatspec.conformance.cli import main
from ecatspec.conformance.render.marks import interruption
from ecatspec.conformance.run import runner as runner_module
from ecatspec.conformance.run.case_executor import CaseExecutor
from ecatspec.conformance.run.dut_knowledge import ways_of
from ecatspec.conformance.run.runner import Runner, run_device
from ecatspec.generators.cases.bringup import way_to
from ecatspec.generators.cases.case import NO_LIMITS, Case, Probe
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.values import UNKNOWN
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.conformance.base.adapter import Description
    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.generators.cases.case import Limits

DEVICE: Final = "reference"
DRIVE: Final = "reference-drive"
MODEL: Final = Model(load(DEVICE))
COUNTED: Final = "reply_counter=counts"


class Device:
    """The virtual SubDevice; after some power cycles the replies have no counter any more."""

    def __init__(self, counted: int, *, power_cycles: bool = True) -> None:
        self.device = make(DEVICE, {})
        self.left = counted
        self.power_cycles = power_cycles
        start, length = (MODEL.parameter("mailbox_in", part) for part in ("start", "length"))
        self.mailbox = start, length

    def reset(self) -> None:
        self.left -= 1
        self.device.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        counter, data = self.device.read(address, length)
        if (address, length) == self.mailbox and counter and self.left < 0:
            data = data[:5] + bytes([data[5] & 0x0F]) + data[6:]
        return counter, data

    def write(self, address: int, data: bytes) -> int:
        return self.device.write(address, data)

    def advance(self, seconds: float) -> None:
        self.device.advance(seconds)

    def close(self) -> None:
        self.device.close()

    def describe(self) -> Description:
        return replace(self.device.describe(), power_cycles=self.power_cycles)


def case(name: str) -> Case:
    up = way_to(MODEL, "PREOP")
    return Case(name, name, "sdo", (*up, Probe(), Probe()), None, len(up))


def runner(device: Device, *given: str) -> Runner:
    choices = ways_of(MODEL.protocol, given)
    return Runner(Model(load(DEVICE)), device, device.describe(), given=choices)


# --- choices --------------------------------------------------------------------------------------


def test_a_finding_names_the_ways_without_which_it_is_none() -> None:
    judge = runner(Device(counted=1))
    judge.run([case("counted"), case("zero")], None, 2)
    first, second = judge.verdicts
    assert first.outcome is Outcome.PASS
    assert judge.known.choices["reply_counter"] == "counts"
    assert (second.outcome, second.differing) == (Outcome.FAIL, ("counter",))
    assert second.depends == (COUNTED,)


def test_the_case_alone_has_the_same_verdict_by_these_ways_only() -> None:
    alone = runner(Device(counted=0))
    alone.run([case("zero")], None, 1)
    assert alone.verdicts[0].outcome is Outcome.PASS
    told = runner(Device(counted=0), COUNTED)
    told.run([case("zero")], None, 1)
    (verdict,) = told.verdicts
    assert (verdict.outcome, verdict.differing) == (Outcome.FAIL, ("counter",))
    assert verdict.depends == (), "what was given need not be told"


def test_a_finding_that_is_one_in_any_case_depends_on_nothing() -> None:
    adapter = make(DEVICE, {})
    judge = Runner(Model(load(DEVICE)), adapter, adapter.describe())
    judge.run([case("counted")], None, 1)
    before = dict(judge.known.choices)
    assert before["reply_counter"] == "counts"
    faulty = make(DEVICE, {"fault": "toggle_ignored"})
    other = Runner(Model(load(DEVICE)), faulty, faulty.describe())
    other.known.choices |= before
    cases = [c for c in all_cases(other.model, NO_LIMITS, "quick") if "toggle" in c.name]
    other.run(cases, None, len(cases))
    found = [v for v in other.verdicts if v.outcome is Outcome.FAIL]
    assert found
    assert not any(verdict.depends for verdict in found)
    assert other.known.choices.items() >= before.items()


def test_the_command_of_a_finding_gives_its_ways() -> None:
    judge = runner(Device(counted=1))
    judge.run([case("counted"), case("zero")], None, 2)
    set_up = SetUp(DEVICE, "exec:x", "quick", 0, "", "", "k.toml", ("a=b",))
    assert set_up.command(judge.verdicts[1]) == (
        "ecatspec run reference --dut exec:x --known k.toml --choice a=b "
        f"--choice {COUNTED} --replay zero"
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("reply_count=counts", "no choice is called 'reply_count'; did you mean 'reply_counter'?"),
        (
            "reply_counter=count",
            "no way of reply_counter is called 'count'; did you mean 'counts'?",
        ),
        ("reply_counter", "no way of reply_counter is called ''; there are counts, zero"),
        ("bootstrap=unsupported", "kollmorgen-s300 says that bootstrap is supported"),
    ],
)
def test_a_way_that_there_is_not_is_one_line(
    given: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    device = "kollmorgen-s300"
    with pytest.raises(UserError):
        ways_of(load(device), (given,))
    assert main(["run", device, "--choice", given]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_a_way_that_the_text_states_too_may_be_given() -> None:
    protocol = load("kollmorgen-s300")
    for name, pin in protocol.pins.items():
        assert ways_of(protocol, (f"{name}={pin.alternative}",)) == {name: pin.alternative}


# --- how far a run came ---------------------------------------------------------------------------


def test_an_interrupted_run_says_how_far_it_came(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def few(_model: Model, _limits: Limits, _depth: str) -> Iterator[Case]:
        yield from (case(name) for name in "abcde")

    def progress(number: int, _total: int, _name: str) -> None:
        if number == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(runner_module, "all_cases", few)
    result = run_device(DEVICE, "model", depth="quick", progress=progress)
    assert interruption(result) == "interrupted after 3 of 5 cases; --resume goes on"

    judge = CaseExecutor.judge

    def stopped(self: CaseExecutor, one: Case) -> Verdict:
        if one.name == "c":
            raise KeyboardInterrupt
        return judge(self, one)

    monkeypatch.setattr(CaseExecutor, "judge", stopped)
    assert main(["run", DEVICE, "--depth", "quick", "--json"]) == 130
    (data,) = json.loads(capsys.readouterr().out)["results"]
    assert data["interrupted"]


# --- without a power cycle ------------------------------------------------------------------------


def failing(device: str, fault: str, part: str) -> list[tuple[Outcome, str]]:
    adapter = make(device, {"fault": fault})
    model = Model(load(device))
    judge = Runner(model, adapter, replace(adapter.describe(), power_cycles=False))
    cases = [c for c in all_cases(model, NO_LIMITS, "quick") if c.name.startswith(part)][:60]
    judge.run(cases, None, len(cases))
    return [(v.outcome, v.reason) for v in judge.verdicts if v.outcome is not Outcome.PASS]


@pytest.mark.parametrize(
    ("device", "fault", "part"),
    [
        (DEVICE, "refused_without_error", "al/"),
        (DRIVE, "watchdog_ignored", "process_data/watchdog"),
        (DRIVE, "quick_stop_ignored", "ds402/shutdown/enable_operation/quick_stop"),
    ],
)
def test_what_shows_again_after_init_is_a_failure(device: str, fault: str, part: str) -> None:
    found = failing(device, fault, part)
    assert found
    assert {outcome for outcome, _ in found} == {Outcome.FAIL}
    assert all("shows again after INIT" in reason for _, reason in found)


def test_what_shows_once_is_a_warning() -> None:
    once = Device(counted=0, power_cycles=False)
    judge = runner(once, COUNTED)
    read = once.read
    judge.executor.session.adapter = once

    def only_first(address: int, length: int) -> tuple[int, bytes]:
        return read(address, length) if once.left == -1 else once.device.read(address, length)

    once.read = only_first  # type: ignore[method-assign]
    judge.run([case("zero")], None, 1)
    (verdict,) = judge.verdicts
    assert verdict.outcome is Outcome.WARNING
    assert "an earlier case left something" in verdict.reason


def test_what_earlier_cases_may_have_left_is_not_known_after_init() -> None:
    oracle = Oracle(Model(load(DRIVE)))
    oracle.power_on()
    cold = oracle.known.example()
    oracle.power_on(cold=False)
    warm = oracle.known.example()
    slots = oracle.model.slots
    assert cold.slots[slots["ds402.state"]] == 0
    assert warm.slots[slots["ds402.state"]] is UNKNOWN
    assert warm.slots[slots["word control_word"]] is UNKNOWN
    same = [n for n in slots if n.startswith(("al.", "mailbox.", "register ", "choice "))]
    assert all(cold.slots[slots[name]] == warm.slots[slots[name]] for name in same)
