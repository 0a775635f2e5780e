"""Tests of generators/: how many cases there are and what they reach."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapters.model import SnapshotAdapter, make
from ecatspec.conformance.base.adapter import Description
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.dut_knowledge import SHAPE
from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.run.snapshot_session import SnapshotSession
from ecatspec.generators.cases.bringup import has_process_data
from ecatspec.generators.cases.case import (
    NO_LIMITS,
    Case,
    Happen,
    Probe,
    SendFrame,
    SetUpProcessData,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
)
from ecatspec.generators.cases.message_mutation import NOTES
from ecatspec.generators.cases.play import at_power_on, play
from ecatspec.generators.cases.stimulus import frame_bytes, register_bytes, registers_bytes
from ecatspec.generators.covers.drive_cover import drive_cover
from ecatspec.generators.covers.process_cover import process_cover
from ecatspec.generators.covers.transition_cover import transition_cover
from ecatspec.generators.suite import GENERATORS, all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.compiled import rows_of
from ecatspec.model.esc import subdevice
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Literal, Pin
from ecatspec.spec.language.nodes import names_in

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import Expression, Protocol

GOLDEN = {
    "kollmorgen-akd": {
        "initial": 11,
        "registers": 38,
        "transitions": 838,
        "process": 68,
        "events": 36,
        "configuration": 208,
        "drive": 715,
        "mailbox": 90,
        "examples": 1,
        "sdo": 693,
        "named": 40,
        "transfers": 692,
        "complete": 301,
        "server": 182,
        "information": 160,
        "families": 491,
        "quick": 3158,
        "default": 3841,
    },
    "reference": {
        "initial": 41,
        "registers": 37,
        "transitions": 570,
        "process": 3,
        "events": 38,
        "configuration": 0,
        "drive": 0,
        "mailbox": 90,
        "examples": 0,
        "sdo": 474,
        "named": 10,
        "transfers": 725,
        "complete": 252,
        "server": 294,
        "information": 138,
        "families": 485,
        "quick": 2811,
        "default": 2947,
    },
    "standard": {
        "initial": 0,
        "registers": 37,
        "transitions": 570,
        "process": 3,
        "events": 38,
        "configuration": 0,
        "drive": 0,
        "mailbox": 88,
        "examples": 0,
        "sdo": 36,
        "named": 10,
        "transfers": 18,
        "complete": 12,
        "server": 51,
        "information": 28,
        "families": 491,
        "quick": 1370,
        "default": 1376,
    },
    "reference-drive": {
        "initial": 61,
        "registers": 37,
        "transitions": 758,
        "process": 70,
        "events": 38,
        "configuration": 123,
        "drive": 780,
        "mailbox": 90,
        "examples": 0,
        "sdo": 775,
        "named": 0,
        "transfers": 864,
        "complete": 282,
        "server": 300,
        "information": 136,
        "families": 485,
        "quick": 3490,
        "default": 4119,
    },
    "kollmorgen-s300": {
        "initial": 4,
        "registers": 38,
        "transitions": 838,
        "process": 68,
        "events": 38,
        "configuration": 55,
        "drive": 732,
        "mailbox": 90,
        "examples": 0,
        "sdo": 103,
        "named": 6,
        "transfers": 115,
        "complete": 56,
        "server": 180,
        "information": 46,
        "families": 491,
        "quick": 2750,
        "default": 2809,
    },
}
"""Cases of each generator and of a quick run: a change of a text changes them knowingly."""
SIZES = ("34", "128", "1486")
OF_HEADERS = {"service_unknown", "routing_value", "channel_set", "counter_edge", "garbage_after"}
"""Flags of what lies around a frame, so that the frame matters little."""
BEYOND = "mailbox/beyond_in_INIT"
TOO_LONG = {"length_beyond"}
"""Flags of cases whose messages need not fit into the mailbox."""

NOT_FIRED = {
    "boot_kept": "the virtual SubDevice has no BOOT: it takes the first alternative",
    "boot_skipping_refused": "no BOOT",
    "bootstrap_entered": "no BOOT",
    "bootstrap_mailbox_refused": "no BOOT",
    "mailbox_prepared": "changes nothing and owes nothing: the oracle has no need to serve it",
    "mailbox_unchanged": "changes nothing and owes nothing",
    "process_data_prepared": "changes nothing and owes nothing",
    "process_data_unchanged": "changes nothing and owes nothing",
    "sync_lost_elsewhere": "changes nothing and owes nothing",
    "watchdog_in_safeop": "the condition watchdog_in_safeop is assumed false",
    "preop_to_safeop_held": "the condition own_reasons is assumed false",
    "safeop_to_op_held": "the condition own_reasons is assumed false",
    "safeop_to_op_refused": "the device might have had a reason of its own",
    "boot_mailbox_found_wrong": "no BOOT",
    "boot_mailbox_taken_away": "no BOOT",
    "boot_mailbox_unchanged": "no BOOT",
    "mailbox_found_wrong": "the condition mailbox_checked is assumed false",
    "process_data_found_wrong": "the condition process_data_checked is assumed false",
    **dict.fromkeys(
        (
            "copied_boot",
            "copied_down",
            "copied_no_state",
            "copied_op",
            "copied_op_on",
            "copied_preop",
            "copied_safeop",
            "copied_safeop_on",
            "sync_lost_without_controller",
            "watchdog_without_controller",
        ),
        "the device has a controller; tests of a terminal go by them",
    ),
}
WITHOUT_PROCESS_DATA = {"process_data_taken_away", "watchdog_in_op", "preop_to_safeop_refused"}
"""Rules that need process data."""
OTHER_WAY = {
    "kollmorgen-akd": {
        "op_skipping_drops",
        "unknown_state_drops",
        "sync_lost_without_code",
        "watchdog_unheard",
    },
    "reference": {"op_skipping_stays", "unknown_state_stays"},
    "standard": {"op_skipping_stays", "unknown_state_stays"},
}
"""Rules of alternatives and conditions that the device does not take, or that change nothing."""


def of_one(device: str) -> pytest.MarkDecorator:
    """Keep what looks at the cases of a device in one process: they are made once there."""
    return pytest.mark.xdist_group(f"cases of {device}")


def each_of(devices: Iterable[str]) -> pytest.MarkDecorator:
    params = [pytest.param(device, marks=of_one(device)) for device in sorted(devices)]
    return pytest.mark.parametrize("device", params)


each_device = each_of(OTHER_WAY)


@cache
def model_of(device: str, mailbox: str = "") -> Model:
    return Model(load(device, mailbox))


@cache
def cases_of(device: str, depth: str = "default", mailbox: str = "") -> tuple[Case, ...]:
    return tuple(all_cases(model_of(device, mailbox), NO_LIMITS, depth))


@each_of(GOLDEN)
def test_the_number_of_cases(device: str) -> None:
    model = model_of(device)
    counts = {name: len(list(make(model, NO_LIMITS))) for name, make in GENERATORS.items()}
    depths = {depth: len(cases_of(device, depth)) for depth in ("quick", "default")}
    assert counts | depths == GOLDEN[device]


@each_device
@pytest.mark.parametrize("mailbox", ["", *SIZES])
def test_names_are_unique_and_start_with_the_layer(device: str, mailbox: str) -> None:
    cases = cases_of(device, mailbox=mailbox)
    machines = model_of(device).protocol.machines
    standard = load("standard").machines
    assert len({case.name for case in cases}) == len(cases)
    for case in cases:
        assert case.name.startswith(f"{case.layer}/")
        assert case.layer in machines
        assert 0 <= case.prelude < len(case.stimuli)
        assert case.flag in {"", *NOTES}
        machine, _, rule = case.about.partition(".")
        rules = standard[machine].rules if machine else ()
        assert not machine or rule in {rule.name for rule in rules}


@each_of(["reference", "reference-drive"])
def test_two_generations_are_equal(device: str) -> None:
    for depth in ("quick", "default"):  # those of `exhaustive` have tests of their own
        assert tuple(all_cases(model_of(device), NO_LIMITS, depth)) == cases_of(device, depth)


@each_of(["reference-drive"])
def test_stimuli_lead_on_from_a_device_that_was_kept(device: str) -> None:
    """As they do from power-on, whatever else began where it was kept."""
    model = model_of(device)
    start = at_power_on(model)
    for case in [*transition_cover(model, NO_LIMITS), *drive_cover(model, NO_LIMITS)][::40]:
        if not plain(case):
            continue
        whole = VirtualSubDevice(model.protocol)
        words = play(model, whole, case.stimuli)
        half = len(case.stimuli) // 2
        for begun in (start.by(model, case.stimuli[:half]),) * 2:
            found = begun.by(model, case.stimuli[half:])
            assert found.words == words
            assert found.device.state == whole.state
            assert found.device.esc.registers() == whole.esc.registers()


def plain(case: Case) -> bool:
    """Tell whether no stimulus depends on what the device answers."""
    return all(
        isinstance(each, WriteRegister | WriteRegisters | WriteOutputs | SetUpProcessData | Happen)
        for each in case.stimuli
    )


@pytest.mark.parametrize(
    ("device", "mailbox"),
    [
        *(pytest.param(device, "", marks=of_one(device)) for device in sorted(OTHER_WAY)),
        *(pytest.param("reference", size, marks=of_one("reference")) for size in SIZES),
    ],
)
def test_a_quick_run_is_part_of_a_whole_one(device: str, mailbox: str) -> None:
    whole = {case.name: case for case in cases_of(device, mailbox=mailbox)}
    quick = cases_of(device, "quick", mailbox)
    assert all(whole[case.name] == case for case in quick)
    assert [name for name in whole if name in {c.name for c in quick}] == [c.name for c in quick]
    assert {c.flag for c in quick} == {c.flag for c in whole.values()}
    if len(model_of(device).protocol.objects) > 10:
        assert len(quick) < len(whole)


@each_device
@pytest.mark.parametrize("mailbox", ["", *SIZES])
def test_every_stimulus_fits_its_register_or_its_mailbox(device: str, mailbox: str) -> None:
    model = model_of(device, mailbox)
    flags = set()
    for case in cases_of(device, mailbox=mailbox):
        for stimulus in case.stimuli:
            match stimulus:
                case WriteRegister(register=name):
                    _, data = register_bytes(model, stimulus)
                    assert len(data) == model.protocol.registers[name].size
                case WriteRegisters(writes=writes):
                    start, data = registers_bytes(model, stimulus)
                    last = model.protocol.registers[writes[-1].register]
                    assert start + len(data) == last.address + last.size
                case SendFrame():
                    data = frame_bytes(model, stimulus, 1)
                    fits = len(data) <= model.parameter("mailbox_out", "length")
                    assert fits or case.flag in TOO_LONG, case.name
                    announced = model.decode(data)
                    beyond = announced is None or announced.trail[0] == "mailbox_beyond"
                    assert not beyond or case.flag or case.name == BEYOND, case.name
                    flags.add(case.flag)
    assert flags >= TOO_LONG


@each_device
def test_the_transition_cover_fires_every_rule_of_al(device: str) -> None:
    model = Model(load(device))
    adapter = make(device, {})
    runner = Runner(model, adapter, adapter.describe())
    for cover in (transition_cover, process_cover):
        runner.run(cover(model, NO_LIMITS), None, 0)
    assert {verdict.outcome for verdict in runner.verdicts} == {Outcome.PASS}
    fired = {rule.name for rule in runner.known.rules if rule.machine == "al"}
    rules = {rule.name for rule in model.protocol.machines["al"].rules}
    without = set() if has_process_data(model) else WITHOUT_PROCESS_DATA
    assert rules - fired == (set(NOT_FIRED) & rules) | OTHER_WAY[device] | without


# --- what the cases fire in devices of every kind -------------------------------------------------

MACHINES = ("mailbox", "coe", "sdo", "sdo_information", "emergency")
REFERENCE = "reference"
LONG = 60
"""Cases with more stimuli are the same over and over."""
FEW = 2
"""So many cases of one kind are tried in a device that differs in one point."""
KINDS = 15
ENTRIES = 6
WHOLE = {"sdo/transfer", "mailbox", "sdo/complete_upload", "sdo/upload"}
LEAST = 10
TOGETHER: tuple[dict[str, str | bool], ...] = (
    {"size_judged_late": True, "size_judged_now": False},
    {"partial_refused": True, "odd_aborted": True, "unclear_answered": True},
    {"short_abort_unheard": False, "odd_aborted": True},
    {"inexact_taken": True, "value_accepted": False},
    {"bootstrap": "supported", "refused_in_boot": False},
)
"""Points that matter only together."""

UNCERTAIN = {
    "mailbox.repeat_ignored": "a device without the repeat service does the same",
    "emergency.emergency_lost": "nothing is seen of an emergency that is not sent",
    "mailbox.nothing_to_repeat": "changes nothing and owes nothing",
    "mailbox.read_by_main_device": "owes nothing, and every explanation may have had it later",
    "sdo.value_of_wrong_size": "the same abort as `segment_of_wrong_size`, a message later",
}
"""Rules that fire in a device, while what is seen of it has another explanation too."""
NEVER = {
    "sdo.configuration_refused": "the device has no process data; a drive goes by it",
    "sdo.configuration_refused_early": "the same",
    "sdo.upload_certain_number": "the same",
    "sdo.value_shorter": "the texts of the device say of each string whether its size varies",
    "sdo_information.description_fragment": "the virtual SubDevice puts a description into one",
    "sdo_information.description_goes_on": "the same",
}
"""Rules that no case fires in any of the devices."""

Way = dict[str, "str | bool"]


@dataclass(slots=True)
class Fired:
    """What was seen: rules that must have fired, and those that did in the virtual device."""

    certain: set[str] = field(default_factory=set)
    inside: set[str] = field(default_factory=set)
    blamed: list[str] = field(default_factory=list)


class Listened(SnapshotAdapter):
    """A device with the rules that fired in it since power-on."""

    def __init__(self, device: VirtualSubDevice, told: Description, inside: set[str]) -> None:
        super().__init__(device, told)
        self.inside = inside

    def reset(self) -> None:
        self.inside.clear()
        super().reset()

    def snapshot(self) -> object:
        return super().snapshot(), frozenset(self.inside)

    def restore(self, snapshot: object) -> None:
        assert isinstance(snapshot, tuple)
        device, inside = snapshot
        super().restore(device)
        self.inside.clear()
        self.inside.update(inside)


class Excited(Listened):
    """A device that has something to report once its mailbox works, and before that."""

    def write(self, address: int, data: bytes) -> int:
        counter = super().write(address, data)
        parameters: dict[str, Value] = {
            "error_code": 0x1000,
            "error_register": 1,
            "manufacturer": bytes(5),
        }
        self._device.happen("emergency", "arises", parameters)
        return counter


def mentioned(protocol: Protocol, guard: Expression | None) -> frozenset[str]:
    """All names that a guard depends on, through the definitions."""
    found: set[str] = set()
    waiting = [] if guard is None else list(names_in(guard))
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            if name in protocol.definitions:
                waiting += names_in(protocol.definitions[name].value)
    return frozenset(found)


def changed(protocol: Protocol, way: Way) -> Protocol:
    """The device that goes this way where the texts leave it free."""
    for name, value in way.items():
        if isinstance(value, str):
            pin = Pin(name, value, (), protocol.choices[name].at)
            protocol = replace(protocol, pins={**protocol.pins, name: pin})
        else:
            condition = replace(protocol.conditions[name], assumed=value)
            protocol = replace(protocol, conditions={**protocol.conditions, name: condition})
    return protocol


def with_least_transfers(protocol: Protocol) -> Protocol:
    """Texts in which no transfer may be longer than a few bytes."""
    parameter = replace(protocol.parameters["longest_transfer"], value=(Literal(LEAST),))
    return replace(protocol, parameters=protocol.parameters | {"longest_transfer": parameter})


def ways(protocol: Protocol) -> list[Way]:
    found: list[Way] = [
        {choice.name: alternative.name}
        for choice in protocol.choices.values()
        for alternative in choice.alternatives[1:]
        if choice.name not in SHAPE
    ]
    found += [{c.name: not c.assumed} for c in protocol.conditions.values()]
    return [*found, *TOGETHER]


class Sweep:
    """Runs cases against virtual devices and keeps what fired."""

    def __init__(self, fired: Fired, protocol: Protocol, oracle: Model, inside: set[str]) -> None:
        self.fired = fired
        self.protocol = protocol
        self.oracle = oracle
        self.inside = inside
        self.kinds: dict[str, dict[tuple[str, str], list[Case]]] = defaultdict(
            lambda: defaultdict(list)
        )
        """Rule -> kind of case -> cases that fire it."""

    def run(
        self,
        cases: list[Case],
        way: Way,
        *,
        closed: bool = True,
        adapter: type[Listened] = Listened,
    ) -> None:
        shape = Description(
            "a device", frozenset(MACHINES), virtual_time=True, closed_dictionary=closed
        )
        device = VirtualSubDevice(changed(self.protocol, way))
        runner = Runner(self.oracle, adapter(device, shape, self.inside), shape)
        takes_none = way.get("value_accepted") is False
        for case in cases:
            if takes_none and case.name.startswith("sdo/takes"):
                continue  # it is blamed there, and rightly
            runner.known.rules = set()
            verdict = runner.executor.judge(case)
            assert isinstance(runner.executor.session, SnapshotSession)
            runner.executor.session.arrive()
            if verdict.outcome not in {Outcome.PASS, Outcome.INCONCLUSIVE}:
                self.fired.blamed.append(f"{way} {case.name}: {verdict.outcome} {verdict.reason}")
            self.fired.inside |= self.inside
            self.fired.certain |= set(map(str, runner.known.rules))
            for rule in self.inside:
                self.kinds[rule]["/".join(case.name.split("/")[:2]), case.flag].append(case)

    def matter(self, names: frozenset[str], mentions: Mapping[str, frozenset[str]]) -> list[Case]:
        """Some cases of every kind that fire a rule whose guard speaks of `names`."""
        chosen: dict[str, Case] = {}
        for rule, kinds in self.kinds.items():
            if names & mentions[rule]:
                rare = sum(map(len, kinds.values())) <= KINDS
                flags: set[str] = set()
                for number, ((_, flag), cases) in enumerate(kinds.items()):
                    if rare or number < KINDS or flag not in flags:
                        found = sorted(cases, key=lambda case: len(case.stimuli))
                        chosen |= {c.name: c for c in (found if rare else found[:FEW])}
                    flags.add(flag)
        return list(chosen.values())


def brief(cases: tuple[Case, ...], *layers: str) -> list[Case]:
    """The cases of these machines, without the proof of life at the end.

    Of variants that every frame has, those of one frame of each machine; of cases that many
    entries have, those of some entries.
    """
    groups: dict[tuple[str, ...], list[Case]] = {}
    for case in cases:
        if case.layer in layers and len(case.stimuli) <= LONG:
            what, _, last = case.name.rpartition("/")
            key = (case.layer, last) if case.flag in OF_HEADERS else (what,)
            alive = case.stimuli[-1] == Probe()
            done = replace(case, stimuli=case.stimuli[:-1] if alive else case.stimuli)
            groups.setdefault((case.name,) if what in WHOLE else key, []).append(done)
    return [
        case
        for (what, *others), found in groups.items()
        for case in spread(found, 1 if others else len(found) if "/sdo_" in what else ENTRIES)
    ]


def spread(cases: list[Case], most: int) -> list[Case]:
    """Some of many, from the first to the last."""
    return cases[:: max(1, -(-len(cases) // most))]


@pytest.fixture
def inside(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """The rules that fire in virtual devices."""
    found: set[str] = set()
    for name in ("step", "afterwards"):
        real = getattr(subdevice, name)

        def watched(*arguments: object, real: Callable[..., tuple[object, ...]] = real) -> object:
            steps = real(*arguments)
            found.update(map(str, steps[0].rules))  # type: ignore[attr-defined]
            return steps

        monkeypatch.setattr(subdevice, name, watched)
    return found


def test_the_cases_fire_every_rule_in_some_device(inside: set[str]) -> None:
    fired = Fired()
    protocol = replace(load(REFERENCE), pins={})
    mentions = {
        f"{machine.name}.{row.name}": mentioned(protocol, row.guard)
        for machine in protocol.machines.values()
        for row in rows_of(machine)
    }
    cases = brief(cases_of(REFERENCE, "quick"), *MACHINES)
    plain = Sweep(fired, protocol, Model(protocol), inside)
    plain.run(cases, {})
    kinds = plain.kinds
    for way in ways(protocol):
        plain.kinds = kinds
        chosen = plain.matter(frozenset(way), mentions)
        plain.kinds = defaultdict(lambda: defaultdict(list))
        plain.run(chosen, way)
    within = [case for case in cases_of(REFERENCE, "quick") if "/downloading/" in case.name]
    plain.run(within, {"initiate_in_download": "refused"})
    plain.run([case for case in cases if case.name.startswith("mailbox/")], {}, adapter=Excited)
    small = load(REFERENCE, "34")
    told = brief(cases_of(REFERENCE, "default", "34"), "sdo_information")
    Sweep(fired, small, Model(small), inside).run(told, {})
    unknown = [case for case in cases if not case.name.startswith("sdo/transfer/")]
    unknown = [case for case in unknown if not case.flag and case.layer not in {"mailbox", "coe"}]
    Sweep(fired, protocol, Model(load("standard")), inside).run(unknown, {}, closed=False)
    short = [case for case in unknown if case.name.startswith("sdo/complete_upload/")]
    both: Way = {"complete_expedited": True, "variable_complete_served": True}
    Sweep(fired, protocol, Model(load("standard")), inside).run(short, both, closed=False)
    limited = with_least_transfers(protocol)
    reads = [case for case in cases if case.name.startswith("sdo/upload/")]
    Sweep(fired, limited, Model(limited), inside).run(reads, {})

    assert fired.blamed == []
    rules = {f"{name}.{rule.name}" for name in MACHINES for rule in protocol.machines[name].rules}
    assert (rules - fired.certain) & fired.inside == set(UNCERTAIN)
    assert (rules - fired.certain) - fired.inside == set(NEVER)
