"""Tests of the public strategies, and of the state machine of a device."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import pytest
from hypothesis import HealthCheck, Phase, find, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import run_state_machine_as_test

from ecatspec.conformance.adapters.model import VirtualAdapter, make
from ecatspec.conformance.base.adapter import AdapterError, DeviceCrash
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.run.session import Session
from ecatspec.conformance.run.state_machine import state_machine
from ecatspec.generators.cases.bringup import WAY_UP, way_to
from ecatspec.generators.cases.case import (
    NO_LIMITS,
    Happen,
    Limits,
    Repeat,
    SendFrame,
    Stimulus,
    WriteRegisters,
)
from ecatspec.generators.cases.case_codec import case_of
from ecatspec.generators.cases.message_mutation import request_frames
from ecatspec.generators.random import strategies
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.object_dictionary import decode_value, size_of, size_varies
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import ObjectEntry

ROOT = Path(__file__).resolve().parent.parent
DEVICE = "reference-drive"
MODEL = Model(load(DEVICE))
OTHER_FRAMES = ("mailbox_error", "emergency", "sdo_upload_expedited")
FIRST = settings(database=None, phases=[Phase.generate], max_examples=5000)
"""The first that is found will do; a rare one may take many."""
QUICK = settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])


# --- strategies -----------------------------------------------------------------------------------


@QUICK
@given(strategies.objects(MODEL))
def test_values_are_taken(drawn: tuple[ObjectEntry, bytes]) -> None:
    entry, value = drawn
    assert len(value) <= size_of(entry)
    if not size_varies(entry):
        assert len(value) == size_of(entry)
    if entry.low is not None and entry.high is not None:
        assert entry.low <= decode_value(entry, value) <= entry.high


@pytest.mark.parametrize("device", ["kollmorgen-akd", "afag-se-power"])
def test_every_entry_has_values(device: str) -> None:
    kinds = {}
    for entry in load(device).objects:
        kinds[type(entry.type), entry.low is None] = entry
    for entry in kinds.values():
        value = find(strategies.values_of(entry), lambda _: True, settings=FIRST)
        assert len(value) <= size_of(entry)


@QUICK
@given(strategies.frames(MODEL))
def test_requests_are_valid(request: SendFrame) -> None:
    data = MODEL.codec.encode(request.frame, request.fields)
    message = MODEL.decode(data)
    assert message is not None
    assert message.frame == request.frame
    assert len(data) <= MODEL.parameter("mailbox_out", "length")


@pytest.mark.parametrize("name", ["sdo_download_expedited", "sdo_download_segment", *OTHER_FRAMES])
def test_every_frame_can_be_drawn(name: str) -> None:
    assert find(strategies.frames(MODEL, [name]), lambda _: True, settings=FIRST).frame == name


@QUICK
@given(strategies.malformed(MODEL))
def test_what_is_malformed_is_no_valid_request(request: SendFrame) -> None:
    data = MODEL.codec.encode(request.frame, request.fields)
    again = MODEL.decode(data.ljust(MODEL.parameter("mailbox_out", "length"), b"\0"))
    if again is not None and again.frame in request_frames(MODEL):
        own = MODEL.protocol.frames[again.frame].fields
        chosen = [f.name for f in own if strategies.is_chosen(MODEL, again.frame, f)]
        assert MODEL.codec.encode(again.frame, {n: again.fields[n] for n in chosen}) != data


def test_stimuli_are_all_that_a_main_device_can_do() -> None:
    drawn = strategies.stimuli(MODEL, NO_LIMITS, ["al.sync_lost"])
    missing = {"ReadConfiguration", "ReadInitial", "WriteUntilTaken"}  # many requests at once
    for kind in get_args(Stimulus):
        if kind.__name__ not in missing:
            found = find(drawn, partial(lambda k, s: isinstance(s, k), kind), settings=FIRST)
            assert isinstance(found, kind)


@QUICK
@given(strategies.traces(MODEL, Limits(without=frozenset({"malformed", "repeat"})), 5))
def test_traces_begin_at_power_on(stimuli: list[Stimulus]) -> None:
    ways = [way_to(MODEL, state) for state in WAY_UP]
    assert any(tuple(stimuli[: len(way)]) == way for way in ways)
    assert len(stimuli) <= len(ways[-1]) + 5
    assert isinstance(stimuli[0], WriteRegisters)
    assert not any(isinstance(s, Repeat | Happen) for s in stimuli)


@settings(QUICK, max_examples=15)
@given(data=st.data())
def test_no_sound_device_is_blamed_for_a_trace(data: st.DataObject) -> None:
    stimuli = data.draw(strategies.traces(MODEL, NO_LIMITS, 6, ["al.sync_lost"]))
    session = bench()
    session.begin({})
    for stimulus in stimuli:
        session.apply(stimulus)


@cache
def bench() -> Session:
    model = Model(load(DEVICE), closed=True)
    adapter = make(DEVICE, {})
    oracle = Oracle(model)
    oracle.raised = adapter.describe().locals
    return Session(adapter, model, oracle)


# --- the state machine ----------------------------------------------------------------------------


def test_the_sound_device_passes() -> None:
    machine = state_machine(DEVICE, lambda: make(DEVICE, {}))
    search = settings(machine.TestCase.settings, max_examples=12, derandomize=True, database=None)
    run_state_machine_as_test(machine, settings=search)


@pytest.mark.parametrize(
    ("device", "fault", "clause", "observed"),
    [
        ("reference", "toggle_ignored", "SDO-30 must", "sdo_download_segment_response"),
    ],
)
def test_a_fault_is_found_and_told(device: str, fault: str, clause: str, observed: str) -> None:
    machine = state_machine(device, lambda: make(device, {"fault": fault}))
    search = settings(machine.TestCase.settings, max_examples=300, derandomize=True, database=None)
    with pytest.raises(AssertionError) as caught:
        run_state_machine_as_test(machine, settings=search)
    told = str(caught.value).strip().splitlines()
    assert told[0].startswith("expected: ")
    assert told[1].startswith(f"observed: {observed}")
    assert any(line.startswith(f"clause {clause}: ") for line in told)
    trace = told[told.index("trace:") + 1 : -1]
    assert all(" ms MainDevice " in line or " ms SubDevice " in line for line in trace)
    assert len(trace) <= 30
    case = case_of(told[-1].removeprefix("token: "))
    assert len(case.stimuli) <= 12
    session = Session(make(device, {}), Model(load(device)), Oracle(Model(load(device))))
    session.begin({})
    for stimulus in case.stimuli:
        session.apply(stimulus)


@pytest.mark.parametrize("fault", ["outputs_unchecked", "inputs_unchecked"])
def test_settings_that_are_not_checked_are_found_soon(fault: str) -> None:
    machine = state_machine(DEVICE, lambda: make(DEVICE, {"fault": fault}))
    search = settings(
        machine.TestCase.settings,
        max_examples=100,
        stateful_step_count=15,
        derandomize=True,
        database=None,
    )
    with pytest.raises(AssertionError, match="SAFEOP"):
        run_state_machine_as_test(machine, settings=search)


class Mortal(VirtualAdapter):
    """A device that dies of the second message of its life."""

    def __init__(self) -> None:
        protocol = load("reference")
        super().__init__(VirtualSubDevice(protocol), make("reference", {}).describe())
        self.mails = 0
        self.start = Model(protocol).parameter("mailbox_out", "start")

    def reset(self) -> None:
        super().reset()
        self.mails = 0

    def write(self, address: int, data: bytes) -> int:
        self.mails += address == self.start
        if self.mails > 1:
            raise DeviceCrash("it ended with signal 11")
        return super().write(address, data)


def test_a_crash_is_a_failure_with_its_trace() -> None:
    machine = state_machine("reference", Mortal)
    search = settings(machine.TestCase.settings, max_examples=30, derandomize=True, database=None)
    with pytest.raises(AssertionError, match="signal 11") as caught:
        run_state_machine_as_test(machine, settings=search)
    told = str(caught.value)
    assert "expected: an answer, and a device that lives" in told
    assert len(case_of(told.rpartition("token: ")[2]).stimuli) <= 6


def test_a_device_that_is_not_there_is_told_at_once() -> None:
    with pytest.raises(AdapterError, match="does not come up"):
        state_machine("reference", f"exec:{sys.executable} -c 'exit(3)'")


# --- the example ----------------------------------------------------------------------------------


def test_the_example_runs(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull]
    done = subprocess.run(
        [*command, f"--rootdir={tmp_path}", str(ROOT / "examples" / "test_my_slave.py")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed" in done.stdout


def test_the_page_tells_of_what_there_is() -> None:
    page = (ROOT / "docs" / "own-tests.md").read_text(encoding="utf-8")
    for name in ("frames", "malformed", "objects", "values_of", "keys", "moves", "stimuli"):
        assert f"`{name}(" in page
        assert callable(getattr(strategies, name))
