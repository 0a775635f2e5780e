"""Tests of test vectors: recorded from a virtual device, played on others."""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import msgspec
import pytest
from c_device import SOURCES, TEXT, WHERE, sanitizes

from ecatspec.conformance.adapters.in_process import Guarded
from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.adapter import Description
from ecatspec.conformance.base.devices import UserError, going, load
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.dut_knowledge import SHAPE
from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.run.worker_pools import Died
from ecatspec.conformance.vectors import export as exporting
from ecatspec.conformance.vectors.export import OTHER_WAYS, Wanted, export
from ecatspec.conformance.vectors.replay import Player
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.formats import FORMATS, c_format
from ecatspec.generators.suite import all_cases
from ecatspec.generators.vectors.schema import (
    CONFIGURATION,
    Allowed,
    Full,
    Head,
    Mail,
    Read,
    Step,
    Vectors,
)
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.generators.cases.case import Case, Limits
    from ecatspec.generators.vectors.schema import Test
    from ecatspec.spec.language.ir import Protocol

SAMPLE = 80
"""Of the cases of a quick suite every one of so many is taken."""
RUNNER = Path(c_format.__file__).with_name("runner.h")
OFTEN = 8
DRIVE, PLAIN = "kollmorgen-akd", "reference"
TERMINAL = "beckhoff-el6720"
REAL = tuple(name for name in device_names() if load_device(name).manuals)


def sampled(model: Model, limits: Limits, depth: str, step: int = SAMPLE) -> Iterator[Case]:
    """Give some of the cases of each kind."""
    return islice(all_cases(model, limits, depth), 0, None, step)


@cache
def vectors(device: str, only: tuple[str, ...] = (), step: int = SAMPLE, **choices: str) -> Vectors:
    """Give the vectors of some cases of a device, as they are read from a file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "all_cases", partial(sampled, step=step))
        file = io.BytesIO()
        export(Wanted(device, "quick", only, choices=choices), "json", file)
    return msgspec.json.decode(file.getvalue(), type=Vectors)


def played(found: Vectors, device: VirtualSubDevice, protocol: Protocol) -> Iterator[Verdict]:
    """Play vectors on a virtual SubDevice."""
    adapter = Guarded(VirtualAdapter(device, described(protocol)))
    player = Player(found, adapter, adapter.describe(), lambda symbol, _: symbol)
    for group in found.testGroups:
        for test in group.tests:
            yield player.judge(test)


def by_name(found: Vectors) -> dict[str, Test]:
    return {test.id: test for group in found.testGroups for test in group.tests}


# --- what is recorded -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*REAL, PLAIN])
def test_the_device_of_a_text_gets_the_verdicts_of_a_run(name: str) -> None:
    found = vectors(name)
    protocol = load(name)
    verdicts = {v.case: v for v in played(found, VirtualSubDevice(protocol), protocol)}
    model = Model(protocol)
    adapter = VirtualAdapter(VirtualSubDevice(protocol), described(protocol))
    runner = Runner(model, adapter, adapter.describe())
    for case in sampled(model, NO_LIMITS, "quick"):
        verdict = verdicts.pop(case.name)
        assert (verdict.outcome, verdict.reason) == (Outcome.PASS, ""), verdict
        assert runner.executor.judge(case).outcome is verdict.outcome
    assert all(verdict.outcome is Outcome.PASS for verdict in verdicts.values())
    assert verdicts.keys() <= {CONFIGURATION}


def open_choices(name: str) -> list[tuple[str, str, str]]:
    """Give device, choice and way for all ways that the recorded device does not go."""
    protocol = load(name)
    own = going(protocol, SHAPE).pins
    return [
        (name, choice.name, way.name)
        for choice in protocol.choices.values()
        for way in choice.alternatives
        if choice.name not in protocol.pins | SHAPE and own[choice.name].alternative != way.name
    ]


@pytest.mark.parametrize(("name", "choice", "way"), [*open_choices(PLAIN), *open_choices(DRIVE)])
def test_no_other_way_at_a_choice_is_blamed(name: str, choice: str, way: str) -> None:
    protocol = going(load(name), SHAPE | {choice: way})
    for verdict in played(vectors(name), VirtualSubDevice(protocol), protocol):
        assert verdict.outcome is Outcome.PASS, verdict


@pytest.mark.parametrize("name", [PLAIN, DRIVE])
def test_no_other_truth_of_a_condition_is_blamed(name: str) -> None:
    protocol = load(name)
    ended = 0
    for condition in protocol.conditions.values():
        other = replace(condition, assumed=not condition.assumed)
        device = replace(protocol, conditions=protocol.conditions | {condition.name: other})
        for verdict in played(vectors(name), VirtualSubDevice(device), device):
            assert verdict.outcome is Outcome.PASS, (condition.name, verdict)
            ended += bool(verdict.reason)
    assert ended


def test_a_pinned_choice_is_demanded() -> None:
    protocol = going(load(PLAIN), SHAPE | {"refused_in_op": "stay"})
    device = VirtualSubDevice(protocol)
    free = vectors(PLAIN, ("al",), OFTEN)
    assert free.open["refused_in_op"] != "stay"
    verdicts = list(played(free, device, protocol))
    assert all(verdict.outcome is Outcome.PASS for verdict in verdicts)
    assert any(verdict.reason for verdict in verdicts)
    bound = vectors(PLAIN, ("al",), OFTEN, refused_in_op=free.open["refused_in_op"])
    assert bound.choices["refused_in_op"] == free.open["refused_in_op"]
    assert any(v.outcome is Outcome.FAIL for v in played(bound, device, protocol))


def test_what_a_test_says_of_itself() -> None:
    found = vectors(DRIVE)
    tests = by_name(found)
    assert found.numberOfTests == len(tests)
    assert [test.tcId for test in tests.values()] == list(range(1, len(tests) + 1))
    assert next(iter(tests)) == CONFIGURATION
    assert not tests[CONFIGURATION].requires
    assert any(test.requires for test in tests.values())
    assert any(test.needs for test in tests.values())
    for test in tests.values():
        ends = '"ends"' in msgspec.json.encode(test).decode()
        assert (test.result == "acceptable") is ends is (OTHER_WAYS in test.flags)
        assert set(test.flags) <= found.notes.keys()
        assert test.clauses
        assert set(test.clauses) <= found.clauses.keys()
        assert {rule for step in test.steps for rule in step.covers} <= found.rules.keys()
    kinds = {type(e) for test in tests.values() for step in test.steps for e in step.expect}
    assert kinds == {Read, Mail}
    assert any(step.cycle for test in tests.values() for step in test.steps)
    assert any(step.early for test in tests.values() for step in test.steps)


def test_an_answer_that_is_left_unread_is_only_seen() -> None:
    made = exporting.Export(Wanted(PLAIN, "quick"))
    case = next(c for c in all_cases(Model(load(PLAIN)), NO_LIMITS) if "unread" in c.name)
    test = made.record(case)
    assert test is not None
    assert any(isinstance(e, Full) and e.full for step in test.steps for e in step.expect)


def test_the_same_input_gives_the_same_bytes() -> None:
    script = (
        "import sys; from itertools import islice;"
        "from ecatspec.conformance.vectors import export as e;"
        "every = e.all_cases;"
        "e.all_cases = lambda *a: islice(every(*a), 0, None, 80);"
        f"e.export(e.Wanted({PLAIN!r}, 'quick', ('sdo', 'al')), 'json', sys.stdout.buffer)"
    )
    files = [
        subprocess.run(
            [sys.executable, "-P", "-c", script],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    ]
    assert files[0] == files[1]
    assert files[0]


def written(monkeypatch: pytest.MonkeyPatch, workers: int) -> bytes:
    every = all_cases
    with monkeypatch.context() as patch:
        patch.setattr(exporting, "all_cases", lambda *a: islice(every(*a), 0, None, 80))
        patch.setattr(exporting, "_ALONE", 5)
        patch.setattr(exporting, "_SHARD", 7)
        out = io.BytesIO()
        exporting.export(Wanted(PLAIN, "quick", ("sdo", "al")), "json", out, workers=workers)
    return out.getvalue()


def test_any_number_of_workers_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert written(monkeypatch, 2) == written(monkeypatch, 1)


def test_what_a_dead_worker_had_is_recorded_here(monkeypatch: pytest.MonkeyPatch) -> None:
    class Dead:
        def result(self) -> NoReturn:
            raise Died

    class Pool:
        def submit(self, *_: object) -> Dead:
            return Dead()

    alone = written(monkeypatch, 1)
    monkeypatch.setattr(exporting, "process_pool", lambda *_: nullcontext(Pool()))
    assert written(monkeypatch, 2) == alone


def test_a_test_is_the_same_wherever_it_comes() -> None:
    """The times and the rules of cases before it leave nothing behind."""
    cases = list(all_cases(Model(load(TERMINAL)), NO_LIMITS, "quick"))
    cases = [case for case in cases if case.layer == "process_data"]
    orders = cases, cases[::-1]
    found = []
    for order in orders:
        made = exporting.Export(Wanted(TERMINAL, "quick"))
        made.configure()
        found.append({case.name: made.play(case) for case in order})
    assert found[0] == found[1]


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        (Wanted("kollmorgen-ak"), "no device"),
        (Wanted(PLAIN, choices={"reply_conter": "zero"}), "did you mean 'reply_counter'"),
        (Wanted(PLAIN, choices={"reply_counter": "zeros"}), "did you mean 'zero'"),
        (Wanted(DRIVE, choices={"refused_in_op": "drop_to_safeop"}), "the text pins refused_in_op"),
        (Wanted(PLAIN, only=("sdos",)), "did you mean 'sdo'"),
    ],
)
def test_what_is_not_there_is_told(wanted: Wanted, said: str) -> None:
    with pytest.raises(UserError, match=said):
        exporting.Export(wanted)


# --- the device in C ------------------------------------------------------------------------------

COMPILER = shutil.which("cc")


@cache
def header() -> bytes:
    """Give vectors of the device in C, as a header: some of all, and all where a fault shows."""

    def chosen(model: Model, limits: Limits, depth: str) -> Iterator[Case]:
        few = {place for place in WHERE.values() if place != "al/"}
        for number, case in enumerate(all_cases(model, limits, depth)):
            if number % OFTEN == 0 or case.name.startswith(tuple(few)):
                yield case

    file = io.BytesIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "all_cases", chosen)
        export(Wanted(TEXT, "quick"), "c", file)
    return file.getvalue()


def build(folder: Path, fault: str, *more: str) -> subprocess.CompletedProcess[str]:
    """Build the device with a fault and the runner in C; run it."""
    runner = folder / "replay.o"
    strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
    if not runner.exists():
        (folder / "vectors.h").write_bytes(header())
        place = f'-DVECTORS="{folder / "vectors.h"}"'
        compile_only = [str(COMPILER), *strict, *more, place, "-c", str(SOURCES / "replay.c")]
        subprocess.run([*compile_only, "-o", str(runner)], check=True)
    others = {"main.c", "replay.c", "library.c", "stack.c"}
    sources = [str(p) for p in SOURCES.glob("*.c") if p.name not in others]
    program = str(folder / fault)
    built = [str(COMPILER), *strict, *more, f"-DFAULT=FAULT_{fault}", *sources, str(runner)]
    subprocess.run([*built, "-o", program], check=True)
    return ran(program)


def ran(program: str) -> subprocess.CompletedProcess[str]:
    """Run a program to its end; one without an end is stopped."""
    return subprocess.run([program], capture_output=True, text=True, timeout=600, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give a place for programs."""
    if COMPILER is None:
        pytest.skip("there is no C compiler")
    return tmp_path_factory.mktemp("vectors")


@pytest.mark.xdist_group("vectors in C")
def test_the_device_in_c_passes_its_vectors(folder: Path) -> None:
    done = build(folder, "NONE")
    assert (done.returncode, done.stderr) == (0, ""), done.stdout[-2000:]
    passed = int(done.stdout.split()[0])
    assert passed > 400


@pytest.mark.xdist_group("vectors in C")
@pytest.mark.parametrize("fault", WHERE)
def test_the_runner_in_c_alone_finds_a_fault(folder: Path, fault: str) -> None:
    done = build(folder, fault)
    assert done.returncode == 1
    assert "FAILED" in done.stdout


@pytest.mark.xdist_group("vectors in C")
def test_the_runner_in_c_is_small_and_stays_in_its_bounds(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    runner = header().decode().split("/* --- the tables")
    assert len(RUNNER.read_text().splitlines()) <= 300
    assert set(re.findall(r"#include (.*)", runner[0])) == {
        "<stddef.h>",
        "<stdint.h>",
        "<string.h>",
    }
    if not sanitizes(folder):
        pytest.skip("this compiler cannot link sanitizers")
    safe = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    done = build(tmp_path_factory.mktemp("sanitized"), "NONE", *safe)
    assert (done.returncode, done.stderr) == (0, "")


# --- a device that never comes to the answer ------------------------------------------------------


class Talking:
    """A device whose mailbox has one emergency after the other."""

    def __init__(self, head: Vectors, told: bytes) -> None:
        self.back, self.told = head.config.mailboxIn.address, told

    def reset(self) -> None:
        pass

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        told = self.told if address == self.back else b"\xff"
        return 1, told.ljust(length, b"\0")

    def write(self, address: int, data: bytes) -> int:
        raise NotImplementedError

    def advance(self, seconds: float) -> None:
        pass

    def close(self) -> None:
        pass

    def describe(self) -> Description:
        return Description("talking", frozenset({"sdo"}), virtual_time=True, closed_dictionary=True)


def waiting() -> tuple[Vectors, bytes]:
    """Give a file with one test, which waits for a reply, and an emergency."""
    found = vectors(PLAIN, ("mailbox",), 10)
    mail = Mail([Allowed("0a00000000f3", "ff00000000ff")], "reply", none="passes")
    test = msgspec.structs.replace(found.testGroups[0].tests[0], steps=[Step(expect=[mail])])
    test = msgspec.structs.replace(test, tcId=1, requires=False)
    only = msgspec.structs.replace(found.testGroups[0], tests=[test])
    fields: dict[str, int | bytes] = {"counter": 1, "error_code": 0x1000, "error_register": 0}
    fields["manufacturer"] = bytes(5)
    told = Model(load_device(PLAIN)).codec.encode("emergency", fields)
    assert any(unasked.admits(told) for unasked in found.config.passOver)
    return msgspec.structs.replace(found, numberOfTests=1, testGroups=[only]), told


def test_messages_without_end_end_a_test_and_are_no_verdict() -> None:
    found, told = waiting()
    device = Talking(found, told)
    verdict = Player(found, device, device.describe(), lambda symbol, _: symbol).judge(
        found.testGroups[0].tests[0]
    )
    assert verdict.outcome is Outcome.INCONCLUSIVE
    assert verdict.reason == "sends messages without end in step 1: 64 were unsolicited"


TALKING = """
#include <stdio.h>
#include "vectors.h"
static const uint8_t told[] = { @TOLD@ };
static void reset(void *context) { (void)context; }
static int get(void *context, uint16_t address, uint8_t *data, size_t length)
{
    (void)context;
    memset(data, address == ECATSPEC_IN_ADDRESS ? 0 : 255, length);
    if (address == ECATSPEC_IN_ADDRESS) memcpy(data, told, sizeof told);
    return 1;
}
static int put(void *context, uint16_t address, const uint8_t *data, size_t length)
{
    (void)context, (void)address, (void)data, (void)length;
    return 1;
}
static void advance(void *context, uint32_t us) { (void)context, (void)us; }
int main(void)
{
    struct ecatspec_target target = { NULL, reset, get, put, advance, NULL };
    return ecatspec_run(&target, 0).outcome == ECATSPEC_ENDED ? 0 : 1;
}
"""


def test_messages_without_end_end_a_test_of_the_runner_in_c(tmp_path: Path) -> None:
    if COMPILER is None:
        pytest.skip("there is no C compiler")
    found, told = waiting()
    file = io.BytesIO()
    head = Head(**{name: getattr(found, name) for name in Head.__struct_fields__})
    tests = [(group.type, test) for group in found.testGroups for test in group.tests]
    FORMATS["c"].write(head, iter(tests), file)
    (tmp_path / "vectors.h").write_bytes(file.getvalue())
    source = TALKING.replace("@TOLD@", ", ".join(map(str, told)))
    (tmp_path / "main.c").write_text(source, encoding="utf-8")
    program = str(tmp_path / "main")
    subprocess.run([str(COMPILER), "-std=c99", str(tmp_path / "main.c"), "-o", program], check=True)
    assert ran(program).returncode == 0
