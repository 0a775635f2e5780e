"""Tests of devices as finite machines: AL, drive, SDO server."""

from __future__ import annotations

import random
from functools import cache
from typing import TYPE_CHECKING

import pytest

from ecatspec.generators.cases.play import play
from ecatspec.generators.complete.certificate import certify
from ecatspec.generators.complete.chain import chain_suite
from ecatspec.generators.complete.faults import kills
from ecatspec.generators.complete.machines import (
    Abstraction,
    al_drive_machine,
    al_machine,
    drive_machine,
    driven_again,
    sdo_machine,
)
from ecatspec.generators.complete.suites import Checked, hsi_suite
from ecatspec.model.automata.exploration import disagreement, explore
from ecatspec.model.automata.mealy import minimise
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

DRIVE = "reference-drive"
MACHINES: dict[str, Callable[[Model], Abstraction | None]] = {
    "al": al_machine,
    "drive": drive_machine,
    "al_drive": al_drive_machine,
    "sdo": sdo_machine,
}
each_machine = pytest.mark.parametrize("name", sorted(MACHINES))


@cache
def model() -> Model:
    return Model(load_device(DRIVE))


@cache
def found(name: str) -> Abstraction:
    abstraction = MACHINES[name](model())
    assert abstraction is not None
    return abstraction


class Counter:
    """Counts to `most` and then begins again; `blind` does not tell 1 from 2."""

    def __init__(self, most: int, *, blind: bool = False) -> None:
        self.most, self.blind, self.count = most, blind, 0

    def reset(self) -> None:
        self.count = 0

    def give(self, symbol: str) -> str:
        self.count = 0 if symbol == "clear" else (self.count + 1) % (self.most + 1)
        return "full" if self.count == self.most else "not"

    def key(self) -> Hashable:
        return min(self.count, 1) if self.blind else self.count

    def name(self) -> str:
        return "zero" if self.count == 0 else "more"


def test_what_can_be_driven_becomes_a_machine() -> None:
    machine = explore(Counter(3), ("up", "clear"))
    assert machine.states == ("zero", "more", "more #2", "more #3")
    assert machine.next == (1, 0, 2, 0, 3, 0, 0, 0)
    assert [machine.outputs[o] for o in machine.out] == ["not"] * 4 + ["full"] + ["not"] * 3


def test_a_key_that_does_not_tell_states_apart_shows_when_the_machine_is_compared() -> None:
    machine = explore(Counter(3, blind=True), ("up", "clear"))
    assert disagreement(Counter(3), machine, (0, 0, 0)) == 2


def test_too_many_states_are_noticed() -> None:
    with pytest.raises(ValueError, match="more than 10 states"):
        explore(Counter(1000), ("up",), 10)


@each_machine
def test_a_machine_is_minimal_and_does_what_the_device_does(name: str) -> None:
    abstraction = found(name)
    machine = abstraction.machine
    assert minimise(machine).machine == machine
    driven = driven_again(model(), abstraction)
    draw = random.Random(2)
    for _ in range(3):
        word = tuple(draw.randrange(len(machine.inputs)) for _ in range(25))
        assert disagreement(driven, machine, word) is None


def test_sizes() -> None:
    sizes = {
        name: (len(m.states), len(m.inputs)) for name in MACHINES if (m := found(name).machine)
    }
    assert sizes == {"al": (68, 21), "drive": (19, 14), "al_drive": (17, 8), "sdo": (9, 14)}


def test_states_and_inputs_have_names() -> None:
    machine = found("al").machine
    assert machine.states[0].startswith("INIT")
    assert {"request_PREOP", "acknowledge_PREOP", "set_up", "outputs"} <= set(machine.inputs)
    up = machine.word(["set_up", "request_PREOP", "request_SAFEOP", "outputs", "request_OP"])
    assert [machine.outputs[o] for o in machine.run(up)][1::3] == ["PREOP", "OP"]
    refused = machine.word(["request_PREOP"])
    assert machine.outputs[machine.run(refused)[0]].startswith("INIT with error")


@pytest.mark.parametrize("name", ["al", "drive", "al_drive"])
def test_a_word_becomes_stimuli(name: str) -> None:
    abstraction = found(name)
    draw = random.Random(4)
    word = tuple(draw.randrange(len(abstraction.machine.inputs)) for _ in range(6))
    device = VirtualSubDevice(model().protocol)
    play(model(), device, abstraction.stimuli_of(word))
    machine = abstraction.machine
    status = machine.outputs[machine.run(word)[-1]]
    names = {r.value: r.name for r in model().protocol.tables["al_state"].rows}
    value = device.state.slots[device.model.slots["al.state"]]
    assert isinstance(value, int)
    assert names[value] in status


@each_machine
def test_suites_kill_every_fault_of_a_machine(name: str) -> None:
    machine = found(name).machine
    for suite in (hsi_suite(machine), chain_suite(machine)):
        assert kills(machine, suite.trie()).score == 1.0


@pytest.mark.parametrize("name", ["drive", "al_drive", "sdo"])
def test_suites_of_a_machine_are_complete(name: str) -> None:
    machine = found(name).machine
    for suite in (hsi_suite(machine), chain_suite(machine)):
        assert certify(machine, suite).checked is Checked.EXACT


def test_suites_of_the_al_machine_are_complete() -> None:
    machine = found("al").machine
    assert certify(machine, hsi_suite(machine)).checked is Checked.EXACT
    chained = certify(machine, chain_suite(machine), 50_000)
    assert chained.checked is not Checked.NONE
    assert chained.counterexample is None


def test_a_device_without_a_drive_has_no_drive_machine() -> None:
    terminal = Model(load_device("beckhoff-el6720"))
    assert drive_machine(terminal) is None
    assert al_drive_machine(terminal) is None


def test_choices_are_given() -> None:
    stay = al_machine(model(), {"refused_in_op": "stay"})
    drop = al_machine(model(), {"refused_in_op": "drop_to_safeop"})
    up = ["set_up", "request_PREOP", "request_SAFEOP", "outputs", "request_OP", "request_BOOT"]
    ends = [m.machine.outputs[m.machine.run(m.machine.word(up))[-1]] for m in (stay, drop)]
    assert [end.split()[0] for end in ends] == ["OP", "SAFEOP"]
