"""Devices that go free ways which no changed text describes: none is blamed."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.verdict import FOUND, Outcome
from ecatspec.conformance.run.runner import Runner, run_device
from ecatspec.generators.cases.bringup import case_in
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.cases.transfers import upload
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Fault
from ecatspec.spec.language.load import load_device, load_file, plant
from ecatspec.spec.language.parse import parse_text

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import Protocol

DEVICES = Path(__file__).parent / "devices"
_SECOND = 1_000_000


class Slow(VirtualSubDevice):
    """A device that takes `late` microseconds to go back to PREOP or INIT."""

    def __init__(self, protocol: Protocol, late: int) -> None:
        self.late = late
        self.waits: int | None = None
        self.waited = 0
        super().__init__(protocol)

    def reset(self) -> None:
        super().reset()
        self.waits = None

    def _take_request(self) -> None:
        states = self.model.state_names("al")
        now = states[int(str(self.state.slots[self.model.slots["al.state"]]))]
        asked = states.get(self.esc.register("al_control") & 0xF)
        if now in {"SAFEOP", "OP"} and asked in {"PREOP", "INIT"}:
            if self.waits is None:
                self.waits = self._clock + self.late
            if self._clock < self.waits:
                return
            self.waited += 1
        self.waits = None
        super()._take_request()


def test_a_device_may_take_its_time_on_the_way_back() -> None:
    sound = load_device("reference-drive")
    device = Slow(sound, 4 * _SECOND)
    adapter = VirtualAdapter(device, described(sound))
    runner = Runner(Model(sound), adapter, adapter.describe())
    cases = [c for c in all_cases(runner.model, NO_LIMITS, "quick") if c.layer in {"al", "mailbox"}]
    runner.run(cases, None, len(cases))
    assert not [v.case for v in runner.verdicts if v.outcome in FOUND]
    assert device.waited > 10


def test_a_terminal_without_mailbox_and_controller_is_a_device_like_others() -> None:
    result = run_device(str(DEVICES / "terminal.ecs"), "model")
    assert result.conforms
    assert Counter(v.outcome for v in result.verdicts).keys() == {Outcome.PASS}
    assert result.choices["emulation"] == "copied"
    assert {"al.copied_op", "al.copied_safeop", "process_data.inputs_started"} <= set(
        result.rules_covered
    )
    layers = {verdict.case.partition("/")[0] for verdict in result.verdicts}
    assert layers == {"al", "process_data", "walk"}


def test_a_device_that_takes_too_long_is_blamed() -> None:
    sound = load_device("reference-drive")
    adapter = VirtualAdapter(Slow(sound, 6 * _SECOND), described(sound))
    runner = Runner(Model(sound), adapter, adapter.describe())
    named = "mailbox/upload_in_INIT_after_OP"
    (case,) = (c for c in all_cases(runner.model, NO_LIMITS, "quick") if c.name == named)
    verdict = runner.executor.judge(case)
    assert verdict.outcome is Outcome.FAIL
    assert "AL-15" in verdict.clauses


CHANNELS = """
faults channels "kinds of SyncManagers that no text declares"

fault told "0x1C00:01 tells that SyncManager 0 carries {told}" [PD-32]
  extend sdo
    rule kind_told [PD-32]
      from   IDLE, DOWNLOADING, UPLOADING, UNCLEAR on read
      when   not complete and index == 0x1C00 and subindex == 1
      goto   IDLE
      send   sdo_upload_expedited(index = index, subindex = subindex, value = cut(word({told}), 1))
      within response_timeout
  replace rule sdo.upload_no_object [PD-32]
    when   not complete and no_object and index != 0x1C00
"""


@pytest.mark.parametrize(
    ("told", "outcome"), [(0, Outcome.PASS), (1, Outcome.PASS), (3, Outcome.FAIL)]
)
def test_what_no_text_declares_holds_certain_numbers(told: int, outcome: Outcome) -> None:
    sound = load_device("kollmorgen-s300")
    text = CHANNELS.format(told=told)
    (fault,) = (d for d in parse_text(text, "channels").declarations if isinstance(d, Fault))
    protocol = plant(sound, fault)
    description = replace(described(protocol), closed_dictionary=False)
    runner = Runner(
        Model(sound), VirtualAdapter(VirtualSubDevice(protocol), description), description
    )
    verdict = runner.executor.judge(case_in(runner.model, "sdo/kind", "", [upload(0x1C00, 1)]))
    assert verdict.outcome is outcome
    assert told < 2 or "PD-32" in verdict.clauses


PICKY = """
device picky extends standard "a device with single bits, a signature and a value that stays"

clause PCK-01 must "the device has exactly these objects" source "this text"

dictionary closed [PCK-01]

objects
  0x2000 : 0  signature  u32  rw guarded = 1   [PCK-01]
  0x2001 : 0  remains    u32  rw stored = 2    [PCK-01]
  0x2002 : 0  plain      u32  rw = 3           [PCK-01]
  0x2003 : 0  bits       u3   rw = 4           [PCK-01]
  0x2004 : 0  truth      bool rw = 1           [PCK-01]
"""


def test_marks_say_which_values_nobody_searches_or_expects(tmp_path: Path) -> None:
    text = tmp_path / "picky.ecs"
    text.write_text(PICKY)
    names = {case.name for case in all_cases(Model(load_file(text)), NO_LIMITS)}
    assert {n[-7:-3] for n in names if n.startswith("sdo/takes/")} == {
        "2001",
        "2002",
        "2003",
        "2004",
    }
    assert {n[-7:-3] for n in names if "/default/" in n} == {"2000", "2002", "2003", "2004"}
    result = run_device(str(text), "model", depth="quick", only=("sdo", "sdo_information"))
    assert result.conforms
