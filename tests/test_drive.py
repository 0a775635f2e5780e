"""Tests of process data and drives, and that no freedom of them is blamed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations
from random import Random
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapters.model import SnapshotAdapter, VirtualAdapter, make
from ecatspec.conformance.base.adapter import AdapterError, Description, raise_local
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.capture.monitor import monitor_file
from ecatspec.conformance.run import device_link
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.bringup import request, way_to
from ecatspec.generators.cases.case import (
    NO_LIMITS,
    Case,
    Happen,
    Hurry,
    SetUpProcessData,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.cases.play import play
from ecatspec.generators.cases.transfers import download, upload
from ecatspec.generators.covers.drive_cover import commands
from ecatspec.generators.suite import GENERATORS
from ecatspec.model.core import interpreter
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.expressions import Environment
from ecatspec.model.esc import subdevice
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Pin
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.spec.language.ir import Choice, Condition, Protocol

REFERENCE = load_device("reference-drive")
UNPINNED = replace(REFERENCE, pins={})
"""Every choice open, as before a device has shown its ways."""
MODEL = Model(REFERENCE)
NEW = ("process", "configuration", "drive")
EVENTS = frozenset({"ds402.fault", "ds402.fault_gone", "ds402.mains_off", "ds402.mains_on"})


def word(name: str) -> WriteOutputs:
    return WriteOutputs({"control_word": commands(MODEL)[name]})


def description(protocol: Protocol, *, events: Iterable[str] | None = None) -> Description:
    """What an adapter tells of a virtual SubDevice; `events` that it can raise, else all."""
    told = make(protocol.name, {}).describe()
    return told if events is None else replace(told, locals=frozenset(events))


def runner(
    device: VirtualSubDevice, judge: Protocol = REFERENCE, *, events: Iterable[str] | None = None
) -> Runner:
    told = description(REFERENCE, events=events)
    return Runner(Model(judge), VirtualAdapter(device, told), told)


def case(*stimuli: Stimulus, state: str = "OP") -> Case:
    way = way_to(MODEL, state)
    return Case("ds402/tried", "tried", "ds402", (*way, *stimuli), state, len(way))


@cache
def cases(device: str) -> tuple[Case, ...]:
    model = Model(load_device(device))
    return tuple(c for name in NEW for c in GENERATORS[name](model, NO_LIMITS))


# --- the covers -----------------------------------------------------------------------------------

LEVELS = (
    "initialised_1",
    "shutdown_2",
    "switch_on_3",
    "enable_operation_4",
    "disable_operation_5",
    "shutdown_6",
    "disable_voltage_7",
    "shutdown_8",
    "disable_voltage_9",
    "disable_voltage_10",
    "disable_voltage_12",
    "fault_13",
    "reaction_done_14",
    "fault_reset_15",
    "enable_operation_16",
)
TRANSITIONS = {
    "reference-drive": [*LEVELS, "quick_stop_11", "stopped_12"],
    "kollmorgen-akd": [*LEVELS, "quick_stop_11_stays"],
    "kollmorgen-s300": [
        "initialised_1",
        *(f"row_{number}" for number in range(2, 13)),
        "fault_13",
        "reaction_done_14",
        "row_15",
        "number_16",
    ],
}
"""The rules of the transitions of each drive; 0 is the power-on."""


@pytest.mark.parametrize("device", TRANSITIONS)
def test_the_virtual_drive_passes_and_makes_all_transitions(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: set[str] = set()
    real = interpreter.step

    def watched(*arguments: object) -> object:
        steps = real(*arguments)  # type: ignore[arg-type]
        made.update(rule.name for rule in steps[0].rules if rule.machine == "ds402")
        return steps

    monkeypatch.setattr(subdevice, "step", watched)
    protocol = load_device(device)
    told = description(protocol)
    run = Runner(Model(protocol), VirtualAdapter(VirtualSubDevice(protocol), told), told)
    for each in cases(device)[::3]:
        verdict = run.executor.judge(each)
        assert verdict.outcome is Outcome.PASS, (each.name, verdict)
    assert set(TRANSITIONS[device]) <= made


def test_every_drive_state_has_a_status_word_of_its_own() -> None:
    model = Model(replace(REFERENCE, pins=REFERENCE.pins | {"drive_coupling": decoupled()}))
    key = REFERENCE.words["status_word"].key
    assert key is not None
    slot = model.slots["ds402.state"]
    found = {}
    for value, name in model.state_names("ds402").items():
        state = model.initial.having(slot, value)
        pattern = model.dictionary.shown[key](Environment(state.slots, state.objects, {}))
        found[name] = pattern
    assert len(found) == 8
    words = range(1 << 7)
    for one, other in combinations(found.values(), 2):
        both = [w for w in words if admitted(one, w) and admitted(other, w)]
        assert not both, (one, other, both)


def decoupled() -> Pin:
    return Pin("drive_coupling", "decoupled", ())


def admitted(pattern: object, value: int) -> bool:
    return bool(pattern.admits(value.to_bytes(2, "little")))  # type: ignore[attr-defined]


# --- nobody is wronged ----------------------------------------------------------------------------

CONCERNED = ("DRV", "PD")
WAYS = [
    (choice, alternative.name)
    for choice in REFERENCE.choices.values()
    for alternative in choice.alternatives
    if choice.clauses[0].startswith(CONCERNED)
]
TRUTHS = [c for c in REFERENCE.conditions.values() if c.clauses[0].startswith(CONCERNED)]


def sample(step: int) -> list[Case]:
    """Every so many of the new cases, which differ from their neighbours in one thing."""
    return list(cases("reference-drive"))[::step]


@cache
def unpinned() -> Model:
    """What judges drives of every kind; what it has worked out once it knows."""
    return Model(UNPINNED)


def blamed(device: VirtualSubDevice, tried: Iterable[Case]) -> list[str]:
    # a snapshot has no part of what a device of a test holds beside
    plain = type(device) is VirtualSubDevice
    kind = SnapshotAdapter if plain else VirtualAdapter
    told = description(REFERENCE)
    run = Runner(unpinned(), kind(device, told), told)
    verdicts = [run.executor.judge(each) for each in tried]
    return [f"{v.case}: {v.observed} {v.clauses}" for v in verdicts if v.outcome in BLAMING]


@pytest.mark.parametrize(("choice", "way"), WAYS, ids=[f"{c.name}-{w}" for c, w in WAYS])
def test_no_way_at_a_choice_is_blamed(choice: Choice, way: str) -> None:
    pins = REFERENCE.pins | {choice.name: Pin(choice.name, way, ())}
    device = VirtualSubDevice(replace(REFERENCE, pins=pins))
    assert blamed(device, sample(71)) == []


@pytest.mark.parametrize("condition", TRUTHS, ids=lambda c: c.name)
def test_no_truth_of_a_condition_is_blamed(condition: Condition) -> None:
    other = replace(condition, assumed=not condition.assumed)
    conditions = REFERENCE.conditions | {condition.name: other}
    device = VirtualSubDevice(replace(REFERENCE, conditions=conditions))
    assert blamed(device, sample(73)) == []


WATCHDOG = "process_data", "expired"


class Tardy(VirtualSubDevice):
    """A device that looks at its outputs, and does what comes by itself, as late as it may."""

    def __init__(self, protocol: Protocol, seed: int) -> None:
        self._random = Random(seed)
        self._ready = 0
        super().__init__(protocol)

    def reset(self) -> None:
        self._ready = 0
        super().reset()

    def _take_outputs(self) -> None:
        limit = self.model.parameter("outputs_time")
        if not self._ready:
            self._ready = self._clock + self._random.randrange(limit)
        if self._clock >= self._ready:
            self._ready = 0
            super()._take_outputs()
        elif WATCHDOG in self._alarms:
            # the watchdog is the controller's: a write restarts it, looked at or not
            environment = Environment(self.state.slots, {}, {})
            time = self.model.definition("watchdog_time")(environment)
            assert isinstance(time, int)
            self._alarms[WATCHDOG] = (self._clock + time, self._alarms[WATCHDOG][1])


@pytest.mark.parametrize("seed", range(3))
def test_a_drive_that_looks_late_is_not_blamed(seed: int) -> None:
    assert blamed(Tardy(REFERENCE, seed), sample(29)) == []


def test_what_raise_locals_a_drive_by_itself_is_not_its_fault() -> None:
    class Unlucky(VirtualSubDevice):
        def write(self, address: int, data: bytes) -> int:
            counter = super().write(address, data)
            if self.model.state_names("ds402").get(self._drive()) == "OPERATION_ENABLED":
                self.happen("ds402", "fault", {})
            return counter

        def _drive(self) -> int:
            value = self.state.slots[self.model.slots["ds402.state"]]
            return value if isinstance(value, int) else -1

    way = [word(name) for name in ("shutdown", "switch_on", "enable_operation", "enable_operation")]
    verdict = runner(Unlucky(REFERENCE), events=()).executor.judge(case(*way, Wait(100_000)))
    assert verdict.outcome is Outcome.INCONCLUSIVE
    assert "ds402.fault" in verdict.reason
    verdict = runner(Unlucky(REFERENCE), events=EVENTS).executor.judge(case(*way, Wait(100_000)))
    assert verdict.outcome is Outcome.FAIL


def test_what_an_adapter_cannot_raise_is_skipped_with_the_reason() -> None:
    verdict = runner(VirtualSubDevice(REFERENCE), events=()).executor.judge(
        case(Happen("ds402.fault"))
    )
    assert verdict.outcome is Outcome.SKIPPED
    assert "cannot raise ds402.fault" in verdict.reason
    adapter = VirtualAdapter(VirtualSubDevice(REFERENCE), description(REFERENCE, events=()))
    with pytest.raises(AdapterError, match="cannot raise"):
        raise_local(adapter, "ds402.fault")


# --- what is said ---------------------------------------------------------------------------------


def refused(settings: SetUpProcessData) -> list[str]:
    safeop = request(MODEL.row("al_state", "SAFEOP"))
    run = runner(VirtualSubDevice(REFERENCE))
    verdict = run.executor.judge(case(settings, safeop, state="PREOP"))
    assert verdict.outcome is Outcome.PASS
    return [line.what for line in run.executor.session.trace if line.who == "reason"]


def test_a_refusal_is_explained_with_its_values() -> None:
    assert refused(SetUpProcessData(longer={"sync_manager_2": 11})) == [
        "SyncManager 2 length 17, assigned PDOs are 6 bytes: 0x1600"
    ]
    off = refused(SetUpProcessData({"sync_manager_3_activation": {"enabled": 0}}))
    assert off[0].startswith("SyncManager 3 is disabled, assigned PDOs are")
    assert refused(SetUpProcessData()) == []


def test_the_refusal_of_a_real_drive_is_explained(shared: Path) -> None:
    (result,) = monitor_file(shared / "captures" / "soem-sdinfo-akd.pcapng", "kollmorgen-akd")
    told = [note for note in result.notes if note.startswith("refused")]
    assert told[0].startswith("refused: SyncManager 2 length 17 is that of the assigned PDOs")
    assert any("more than once" in note for note in told)


# --- as a MainDevice with FMMUs sees it -----------------------------------------------------------


def fmmu(number: int, logical: int, area: str, length: int, *, write: bool) -> WriteRegister:
    start = MODEL.parameter(area, "start")
    fields = {
        "logical_start": logical,
        "length": length,
        "last_bit": 7,
        "start": start,
        "read": int(not write),
        "write": int(write),
        "enabled": 1,
    }
    return WriteRegister(f"fmmu_{number}", fields)


def test_a_drive_is_enabled_through_logical_addresses() -> None:
    device = VirtualSubDevice(REFERENCE)
    play(MODEL, device, way_to(MODEL, "SAFEOP"))
    sizes = [device.esc.process_channel(name) for name in ("sync_manager_2", "sync_manager_3")]
    outputs, inputs = (channel.length for channel in sizes if channel is not None)
    base = 0x10000
    play(
        MODEL,
        device,
        (
            fmmu(0, base, "process_data_out", outputs, write=True),
            fmmu(1, base + outputs, "process_data_in", inputs, write=False),
        ),
    )

    def cycle(control: int) -> int:
        data = control.to_bytes(outputs, "little") + bytes(inputs)
        counter, back = device.logical("LRW", base, data)
        assert counter == 3
        device.advance(0.001)
        return int.from_bytes(back[outputs : outputs + 2], "little")

    cycle(0)
    play(MODEL, device, (request(MODEL.row("al_state", "OP")),))
    known = commands(MODEL)
    for name in ("shutdown", "switch_on", "enable_operation", "enable_operation"):
        cycle(known[name])
    assert cycle(known["enable_operation"]) & 0x6F == 0x27
    assert device.logical("LRD", base + outputs, bytes(inputs))[0] == 1
    assert device.logical("LRD", base + 100, b"\0")[0] == 0


# --- the order of things --------------------------------------------------------------------------


def test_the_watchdog_takes_op_away_only_in_its_time() -> None:
    run = runner(VirtualSubDevice(REFERENCE))
    assert run.executor.judge(case(StopOutputs(), Wait(1_700_000))).outcome is Outcome.PASS
    assert run.executor.session.oracle.known.al_states() == {"OP"}
    assert run.executor.judge(case(StopOutputs(), Wait(2_500_000))).outcome is Outcome.PASS
    assert run.executor.session.oracle.known.al_states() == {"SAFEOP"}


def test_what_follows_a_hurry_is_looked_at_once() -> None:
    up = tuple(word(name) for name in ("shutdown", "switch_on", "enable_operation"))
    run = runner(VirtualSubDevice(REFERENCE))
    for hurry, stopping in (((), False), ((Hurry(),), True)):
        assert run.executor.judge(case(*up, *hurry, word("quick_stop"))).outcome is Outcome.PASS
        assert run.executor.session.oracle.known.may_be("ds402", "QUICK_STOP_ACTIVE") is stopping


def test_a_write_of_the_assignment_is_learned_and_forgotten() -> None:
    run = runner(VirtualSubDevice(REFERENCE))
    clear = download(0x1C12, 0, b"\0")
    assert run.executor.judge(case(clear, upload(0x1C12, 0), state="PREOP")).outcome is Outcome.PASS
    assert run.executor.judge(case(state="OP")).outcome is Outcome.PASS


def test_where_time_is_real_exchanges_take_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A watchdog that expires between slow exchanges is no fault."""
    clock = [0.0]
    device = VirtualSubDevice(REFERENCE)

    class Slow(VirtualAdapter):
        def read(self, address: int, length: int) -> tuple[int, bytes]:
            clock[0] += 0.02
            device.advance(0.02)
            return super().read(address, length)

        def advance(self, seconds: float) -> None:
            clock[0] += seconds
            super().advance(seconds)

    monkeypatch.setattr(device_link, "monotonic", lambda: clock[0])
    told = replace(description(REFERENCE), virtual_time=False)
    run = Runner(Model(REFERENCE), Slow(device, told), told)
    uploads = [upload(0x1000, 0)] * 20
    verdict = run.executor.judge(case(StopOutputs(), *uploads))
    assert verdict.outcome is Outcome.PASS, verdict
    assert run.executor.session.oracle.known.al_states() == {"SAFEOP"}
    assert run.executor.session.time >= 2_000_000


def test_a_mode_by_sdo_is_open_while_process_data_bring_one() -> None:
    assign = (
        download(0x1C12, 0, b"\0"),
        download(0x1C12, 1, b"\0\x17"),
        download(0x1C12, 0, b"\1"),
    )
    up = way_to(MODEL, "OP")[len(way_to(MODEL, "PREOP")) :]
    cyclic = WriteOutputs({"chosen_mode": 3})
    chosen = (cyclic, upload(0x6061, 0), download(0x6060, 0, b"\x08"), upload(0x6061, 0))
    for judge, device in ((REFERENCE, REFERENCE), (REFERENCE, taking_modes())):
        verdict = runner(VirtualSubDevice(device), judge).executor.judge(
            case(*assign, *up, *chosen, state="PREOP")
        )
        assert verdict.outcome is Outcome.PASS, verdict


def taking_modes() -> Protocol:
    """The device that takes a mode by SDO although process data bring one."""
    machine = REFERENCE.machines["ds402"]
    value = next(r for r in machine.rules if r.name == "mode_taken").updates
    rules = tuple(
        replace(r, updates=value) if r.name == "mode_unclear" else r for r in machine.rules
    )
    return replace(
        REFERENCE, machines=REFERENCE.machines | {"ds402": replace(machine, rules=rules)}
    )
