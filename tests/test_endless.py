"""Tests that a run ends, whatever a device answers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from random import Random
from typing import TYPE_CHECKING, Final

import pytest
from c_device import SOURCES, build
from hypothesis import given, settings
from hypothesis import strategies as st

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.run import session as session_module
from ecatspec.conformance.run.device_link import TOO_MUCH, InconclusiveError
from ecatspec.conformance.run.dut_knowledge import shape_of
from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.run.session import Session
from ecatspec.generators.cases.bringup import request, way_to
from ecatspec.generators.cases.case import (
    NO_LIMITS,
    Case,
    ReadConfiguration,
    SendSegments,
    Wait,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.cases.transfers import upload
from ecatspec.generators.random.walks import walk
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.oracle import expansion
from ecatspec.model.oracle.oracle import Oracle
from ecatspec.spec.language.ir import Fault
from ecatspec.spec.language.load import load_device, plant
from ecatspec.spec.language.parse import parse_text

if TYPE_CHECKING:
    from pathlib import Path

    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.spec.language.ir import Protocol

MOST: Final = 20_000
"""Calls of the adapter in which each case here ends, whatever the device does."""
FULL: Final = 0x08
DEVICES: Final = """
faults endless "devices on which a run did not end"

fault size_only_accepted "a download whose first message brings no data is taken as done" [SDO-28]
  replace rule sdo.download_begun [SDO-28]
    when   not complete and present and writable_now(index, subindex)
           and length(value) < size and length(value) > 0
           and size_allowed(index, subindex, size) and segmented_download == served
  extend sdo
    rule size_only_taken [SDO-28]
      from   IDLE, DOWNLOADING, UPLOADING, UNCLEAR on write
      when   not complete and present and writable_now(index, subindex)
             and length(value) < size and length(value) == 0
             and size_allowed(index, subindex, size) and segmented_download == served
      goto   IDLE
      send   sdo_download_response(index = index, subindex = subindex)
      within response_timeout

fault empty_write_confirmed "an empty write is confirmed, and the old value stays" [SDO-12]
  replace rule sdo.value_taken [SDO-12]
    when   value_fits and in_range(index, subindex, value) and accepted and not segmented
           and length(value) > 0
  replace rule sdo.value_empty_refused [SDO-12]
    when   not complete and present and size_allowed(index, subindex, length(value))
           and not empty_fits and segmented
  extend sdo
    rule empty_confirmed [SDO-12]
      from   IDLE on commit
      when   not complete and present and size_allowed(index, subindex, length(value))
             and not segmented and length(value) == 0
      send   sdo_download_response(index = index, subindex = subindex)
      within response_timeout
"""


class Counted:
    """An adapter that counts its calls, and fails the test when there are too many."""

    def __init__(self, adapter: Adapter, most: int = MOST) -> None:
        self.adapter = adapter
        self.most = most
        self.calls = 0

    def count(self) -> None:
        self.calls += 1
        assert self.calls <= self.most, f"no end after {self.most} calls"

    def reset(self) -> None:
        self.calls = 0
        self.adapter.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        self.count()
        return self.adapter.read(address, length)

    def write(self, address: int, data: bytes) -> int:
        self.count()
        return self.adapter.write(address, data)

    def advance(self, seconds: float) -> None:
        self.count()
        self.adapter.advance(seconds)

    def close(self) -> None:
        self.adapter.close()

    def describe(self) -> Description:
        return replace(self.adapter.describe(), locals=frozenset(), batch=False)


def virtual(protocol: Protocol, device: VirtualSubDevice | None = None) -> VirtualAdapter:
    return VirtualAdapter(device or VirtualSubDevice(protocol), described(protocol))


def judged(protocol: Protocol, adapter: Adapter, case: Case) -> Verdict:
    return Runner(Model(protocol), adapter, adapter.describe()).executor.judge(case)


def in_preop(model: Model, *stimuli: Stimulus, layer: str = "sdo") -> Case:
    way = way_to(model, "PREOP")
    return Case("endless", "endless", layer, (*way, *stimuli), "PREOP", len(way))


# --- devices of which too much is possible --------------------------------------------------------


def faults() -> dict[str, Fault]:
    found = parse_text(DEVICES, "endless.ecs").declarations
    return {each.name: each for each in found if isinstance(each, Fault)}


@pytest.mark.parametrize(
    ("name", "cases"),
    [("size_only_accepted", "sdo/size_only/20"), ("empty_write_confirmed", "sdo/length_0/20")],
)
def test_a_device_that_keeps_no_value_ends_each_case(name: str, cases: str) -> None:
    sound = load_device("reference")
    adapter = Counted(virtual(plant(sound, faults()[name])), 1000)
    runner = Runner(Model(sound), adapter, adapter.describe())
    tried = [c for c in all_cases(runner.model, NO_LIMITS, "quick") if c.name.startswith(cases)]
    runner.run(tried, None, len(tried))
    outcomes = {verdict.outcome for verdict in runner.verdicts}
    assert outcomes & {Outcome.FAIL, Outcome.INCONCLUSIVE}
    reasons = {v.reason for v in runner.verdicts if v.outcome is Outcome.INCONCLUSIVE}
    assert reasons <= {TOO_MUCH}


def switched(adapter: Adapter, text: str, limit: int, monkeypatch: pytest.MonkeyPatch) -> Session:
    """Switch SyncManager 0 off and on, as a random run did, with so many explanations at most."""
    monkeypatch.undo()
    model = Model(load(text))
    session = Session(Counted(adapter, 1000), model, Oracle(model))
    session.begin(shape_of(model.protocol))
    for stimulus in (*way_to(model, "PREOP"), upload(0x1018, 1)):
        session.apply(stimulus)
    monkeypatch.setattr(expansion, "LIMIT", limit)
    for enabled in (0, 1, 0):
        session.apply(WriteRegister("sync_manager_0_activation", {"enabled": enabled}))
    session.apply(request(model.row("al_state", "SAFEOP")))
    return session


def test_too_much_to_follow_is_no_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    adapter = virtual(load_device("reference"))
    switched(adapter, "reference", expansion.LIMIT, monkeypatch)
    with pytest.raises(InconclusiveError, match=TOO_MUCH):
        switched(adapter, "reference", 0, monkeypatch)


def test_too_much_to_follow_on_level_b(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    example = SOURCES.parent / "c_level_b"
    folder = build(tmp_path, sources=example)
    text = str(example / "thermostat.ecs")
    # long enough for the interpreter to start on a busy machine
    adapter = open_adapter(f"lib:{folder}/libthermostat.so,poll=0.01", text, hang_timeout=600.0)
    try:
        switched(adapter, text, expansion.LIMIT, monkeypatch)
        with pytest.raises(InconclusiveError, match=TOO_MUCH):
            switched(adapter, text, 0, monkeypatch)
    finally:
        adapter.close()


def test_a_finding_before_there_was_too_much_is_one() -> None:
    """What is wrong in any state stays a finding, however many accidents are thought of."""
    sound = load_device("reference")

    class Nowhere(Counted):
        def read(self, address: int, length: int) -> tuple[int, bytes]:
            counter, data = super().read(address, length)
            status = sound.registers["al_status"].address
            return counter, bytes([0x07, *data[1:]]) if address == status else data

    verdict = judged(sound, Nowhere(virtual(sound)), in_preop(Model(sound)))
    assert verdict.outcome is Outcome.FAIL


# --- answers without end --------------------------------------------------------------------------


class Altered(Counted):
    """A device whose answers come otherwise from the first request on."""

    def __init__(self, protocol: Protocol, most: int = MOST) -> None:
        super().__init__(virtual(protocol), most)
        self.model = Model(protocol)
        self.status = protocol.registers["sync_manager_1_status"].address
        self.out, self.back = (
            self.model.parameter(name, "start") for name in ("mailbox_out", "mailbox_in")
        )
        self.asked = False

    def reset(self) -> None:
        self.asked = False
        super().reset()

    def write(self, address: int, data: bytes) -> int:
        self.asked |= address == self.out
        return super().write(address, data)


class Talking(Altered):
    """A device that has emergencies to tell, and never comes to answer."""

    number = 0

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        counter, data = super().read(address, length)
        if self.asked and address == self.status:
            return counter, bytes([data[0] | FULL, *data[1:]])
        if self.asked and address == self.back:
            self.number = self.number % 7 + 1
            fields = {"counter": self.number, "error_code": 0x1000, "error_register": 0}
            told = self.model.codec.encode("emergency", {**fields, "manufacturer": bytes(5)})
            return 1, told.ljust(length, b"\0")
        return counter, data


def test_emergencies_without_end_are_no_verdict() -> None:
    sound = load_device("reference")
    verdict = judged(sound, Talking(sound), in_preop(Model(sound), upload(0x1018, 1)))
    assert verdict.outcome is Outcome.INCONCLUSIVE
    assert verdict.reason == "the device sends messages without end: 1024 were unsolicited"


def test_a_mailbox_that_cannot_be_looked_at_is_no_verdict() -> None:
    sound = load_device("reference")

    class Hidden(Altered):
        def read(self, address: int, length: int) -> tuple[int, bytes]:
            counter, data = super().read(address, length)
            return (0, bytes(length)) if self.asked and address == self.status else (counter, data)

    verdict = judged(sound, Hidden(sound, 500), in_preop(Model(sound), upload(0x1018, 1)))
    assert verdict.outcome is Outcome.INCONCLUSIVE
    assert "cannot be seen" in verdict.reason


@pytest.mark.parametrize("content", [b"", b"\xff" * 128, b"\x0a" + bytes(127)])
def test_a_mailbox_that_is_always_full_is_a_finding(content: bytes) -> None:
    sound = load_device("reference")

    class Full(Altered):
        def read(self, address: int, length: int) -> tuple[int, bytes]:
            counter, data = super().read(address, length)
            if self.asked and address == self.status:
                data = bytes([data[0] | FULL, *data[1:]])
            elif self.asked and address == self.back:
                counter, data = 1, content[:length].ljust(length, b"\0")
            return counter, data

    verdict = judged(sound, Full(sound, 500), in_preop(Model(sound), upload(0x1018, 1)))
    assert verdict.outcome is Outcome.FAIL


class Growing(Altered):
    """A device with an object that no text declares, of which each segment is a byte."""

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        counter, data = super().read(address, length)
        if not self.asked or address not in {self.status, self.back}:
            return counter, data
        if address == self.status:
            return 1, bytes([data[0] | (FULL if self.answer else 0), *data[1:]])
        answer, self.answer = self.answer, b""
        return 1, answer.ljust(length, b"\0")

    answer = b""

    def write(self, address: int, data: bytes) -> int:
        if address != self.out:
            return super().write(address, data)
        self.count()
        self.asked = True
        message = self.model.decode(data)
        assert message is not None
        counter = {"counter": message.fields["counter"]}
        if message.frame == "sdo_upload_request":
            key = {name: message.fields[name] for name in ("index", "subindex")}
            first = {"size": 0x7FFFFFFF, "value": b"x", **key, **counter}
            self.answer = self.model.codec.encode("sdo_upload_normal", first)
        else:
            more = {"value": b"x", "toggle": message.fields["toggle"], "last": False, **counter}
            self.answer = self.model.codec.encode("sdo_upload_segment_response", more)
        return 1


def test_an_upload_without_end_is_no_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "SEGMENTS", 200)
    sound = load_device("standard")
    adapter = Growing(sound)
    runner = Runner(Model(sound), adapter, replace(adapter.describe(), closed_dictionary=False))
    verdict = runner.executor.judge(in_preop(runner.model, upload(0x2FFF, 0), SendSegments()))
    assert verdict.outcome is Outcome.INCONCLUSIVE
    assert verdict.reason == "the upload does not end after 200 segments"


def test_a_short_watchdog_takes_no_more_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "CYCLES", 100)
    sound = load_device("reference-drive")
    adapter = Counted(virtual(sound), 5000)
    model = Model(sound)
    way = way_to(model, "OP")
    short = (
        WriteRegister("watchdog_divider", {"value": 0}),
        WriteRegister("watchdog_process_data", {"time": 25}),
    )
    case = Case("watchdog", "", "process_data", (*way, *short, WriteOutputs(), Wait(10_000_000)))
    assert judged(sound, adapter, case).outcome not in BLAMING


def test_a_configuration_is_read_once_whatever_is_counted() -> None:
    """A device says that the same PDO is assigned 255 times."""
    sound = load_device("reference-drive")

    class Many(Altered):
        def read(self, address: int, length: int) -> tuple[int, bytes]:
            counter, data = super().read(address, length)
            message = self.model.decode(data) if address == self.back and counter else None
            if message is not None and message.fields.get("index") in {0x1C12, 0x1C13}:
                data = (
                    data[:12]
                    + (b"\xff" if message.fields["subindex"] == 0 else data[12:13])
                    + data[13:]
                )
            return counter, data

    judged(sound, Many(sound), in_preop(Model(sound), ReadConfiguration()))


# --- a device that answers at random --------------------------------------------------------------


class Wayward(Altered):
    """The virtual SubDevice, with answers changed at random as often as each habit says."""

    def __init__(self, protocol: Protocol, seed: int, habits: dict[str, float]) -> None:
        super().__init__(protocol)
        self.habits = habits
        self.seed = seed
        self.random = Random(seed)
        self.seen: list[bytes] = []
        self.al = protocol.registers["al_status"].address

    def reset(self) -> None:
        super().reset()
        self.random = Random(self.seed)
        self.seen = []

    def does(self, habit: str) -> bool:
        return self.random.random() < self.habits.get(habit, 0)

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        counter, data = super().read(address, length)
        if self.does("silent"):
            return 0, bytes(length)
        if address == self.status and self.does("full"):
            return counter, bytes([data[0] | FULL, *data[1:]])
        if address == self.status and self.does("empty"):
            return counter, bytes([data[0] & ~FULL, *data[1:]])
        if address == self.back:
            return self.message(counter, data)
        if address == self.al and self.does("state"):
            return counter, bytes([self.random.randrange(256), *data[1:]])
        return counter, data

    def message(self, counter: int, data: bytes) -> tuple[int, bytes]:
        if counter:
            self.seen = [*self.seen[-3:], data]
        if self.does("rubbish"):
            return 1, self.random.randbytes(len(data))
        if self.seen and self.does("again"):
            return 1, self.random.choice(self.seen)
        if self.does("bits"):
            changed = bytearray(data)
            changed[self.random.randrange(min(16, len(data)))] ^= 1 << self.random.randrange(8)
            return 1, bytes(changed)
        return counter, data

    def write(self, address: int, data: bytes) -> int:
        if self.does("deaf"):
            self.count()
            return 0
        if self.does("forgetful"):
            self.count()
            return 1
        return super().write(address, data)


HABITS: Final = (
    "silent",
    "full",
    "empty",
    "state",
    "rubbish",
    "again",
    "bits",
    "deaf",
    "forgetful",
)
OFTEN: Final = (0.01, 0.1, 0.5, 1.0)


@cache
def ground(device: str) -> tuple[Protocol, Model, list[Case]]:
    protocol = load_device(device)
    model = Model(protocol)
    cases = list(all_cases(model, NO_LIMITS, "quick"))
    return protocol, model, cases


@pytest.mark.parametrize("device", ["reference", "reference-drive"])
@settings(deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 1 << 32),
    habits=st.dictionaries(st.sampled_from(HABITS), st.sampled_from(OFTEN), min_size=1),
    number=st.integers(0, 1 << 32),
    walks=st.booleans(),
)
def test_each_case_ends_on_a_device_that_answers_at_random(
    device: str,
    seed: int,
    habits: dict[str, float],
    number: int,
    walks: bool,  # noqa: FBT001
) -> None:
    protocol, model, cases = ground(device)
    case = walk(model, NO_LIMITS, frozenset(), number, 30) if walks else cases[number % len(cases)]
    adapter = Wayward(protocol, seed, habits)
    runner = Runner(model, adapter, adapter.describe())
    runner.executor.judge(case)
    assert len(runner.executor.session.oracle.candidates) <= 4 * expansion.LIMIT
    assert len(runner.executor.session.trace) <= MOST


def test_a_session_that_is_given_stimuli_says_that_it_is_inconclusive() -> None:
    sound = load_device("reference")
    session = Session(Talking(sound), Model(sound), Oracle(Model(sound)))
    session.begin(shape_of(sound))
    for stimulus in way_to(session.model, "PREOP"):
        session.apply(stimulus)
    with pytest.raises(InconclusiveError, match="without end"):
        session.apply(upload(0x1018, 1))
