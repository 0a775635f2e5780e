"""Tests of the text of the Beckhoff EL6720: its page, BOOT, and its checks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest
from drive_fixture import to

from ecatspec.generators.cases.bringup import mailbox_settings, way_to
from ecatspec.generators.cases.case import SetUpProcessData, Stimulus, WriteOutputs
from ecatspec.generators.cases.play import play
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.interpreter import step
from ecatspec.model.core.state import Event
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Access, Level, Literal, OneOf, Range, Text
from ecatspec.spec.language.load import load_device, load_faults

if TYPE_CHECKING:
    from ecatspec.model.core.state import State
    from ecatspec.spec.language.ir import Protocol


@pytest.fixture(scope="module")
def terminal() -> Protocol:
    return load_device("beckhoff-el6720")


@pytest.fixture(scope="module")
def model(terminal: Protocol) -> Model:
    return Model(terminal)


def own_clauses(protocol: Protocol) -> set[str]:
    return {name for name in protocol.clauses if name.startswith("EL6720-C")}


# --- evidence -------------------------------------------------------------------------------------


def test_what_shows_at_the_clamps_only_is_unobservable(terminal: Protocol) -> None:
    hidden = {n for n, c in terminal.clauses.items() if c.level is Level.UNOBSERVABLE}
    assert hidden == {f"EL6720-C{number}" for number in (11, 13, 14, 16, 19, 32)}
    assert all(terminal.clauses[name].because for name in hidden)


# --- what stays open ------------------------------------------------------------------------------


def test_what_the_page_says_and_what_it_does_not(terminal: Protocol) -> None:
    assert {name: pin.alternative for name, pin in terminal.pins.items()} == {
        "bootstrap": "supported",
        "mailbox_support": "present",
    }
    assert set(terminal.opened) == {
        "bootstrap_mailbox",
        "complete_access_support",
        "op_without_outputs",
        "process_data_address",
        "segmented_download",
    }


def test_nothing_is_closed(terminal: Protocol) -> None:
    """A page in the middle of a manual closes no list."""
    assert not terminal.closed
    assert not terminal.dictionary.closed


def test_a_name_is_longer_than_what_travels_expedited(terminal: Protocol) -> None:
    entries = {(entry.index, entry.subindex): entry for entry in terminal.objects}
    name = entries[0x1008, 0]
    assert isinstance(name.type, Text)
    assert (name.default, name.access) == ("EL6720", Access.READ)
    # who it is never changes; which number that is, the page does not say
    for subindex in (1, 4):
        assert entries[0x1018, subindex].constant
        assert entries[0x1018, subindex].default is None


def test_settings_of_process_data_change_in_preop_only(terminal: Protocol) -> None:
    written = [e for e in terminal.objects if e.access is Access.BOTH]
    assert {entry.index for entry in written} == {0x1C12, 0x1C13}
    assert {entry.states for entry in written} == {("PREOP",)}


def test_refused_clocks_have_codes_of_clocks(terminal: Protocol) -> None:
    (rule,) = (r for r in terminal.machines["al"].rules if r.name == "clocks_refused")
    assert (rule.sources, rule.target) == (("PREOP",), None)
    (code,) = (update.value for update in rule.updates if update.variable == "code")
    assert isinstance(code, OneOf)
    ranges = [(item.low, item.high) for item in code.items if isinstance(item, Range)]
    assert ranges == [(Literal(0x27), Literal(0x29)), (Literal(0x30), Literal(0x37))]


# --- what the terminal does -----------------------------------------------------------------------


def shown(model: Model, device: VirtualSubDevice) -> tuple[str, bool, int]:
    """The AL state, whether there is an error, and the code that the MainDevice reads then."""
    status = device.esc.register("al_status")
    names = {r.value: r.name for r in model.protocol.tables["al_state"].rows}
    error = bool(status & 0x10)
    return names[status & 0xF], error, device.esc.register("al_status_code") if error else 0


def after(model: Model, *stimuli: Stimulus) -> tuple[str, bool, int]:
    device = VirtualSubDevice(model.protocol)
    play(model, device, stimuli)
    return shown(model, device)


def test_boot_is_reached_from_init(model: Model) -> None:
    assert after(model, *mailbox_settings(model), to(model, "BOOT")) == ("BOOT", False, 0)


@pytest.mark.parametrize("state", ["PREOP", "SAFEOP", "OP"])
def test_boot_is_reached_from_nowhere_else(model: Model, state: str) -> None:
    reached, error, code = after(model, *way_to(model, state), to(model, "BOOT"))
    assert reached == {"OP": "SAFEOP"}.get(state, state)  # the standard lets OP drop
    assert (error, code) == (True, 0x0011)


@pytest.mark.parametrize("state", ["PREOP", "SAFEOP", "OP"])
def test_boot_is_left_to_init_only(model: Model, state: str) -> None:
    up = (*mailbox_settings(model), to(model, "BOOT"))
    assert after(model, *up, to(model, state)) == ("BOOT", True, 0x0011)
    assert after(model, *up, to(model, state), to(model, "INIT")) == ("INIT", False, 0)


def test_boot_wants_a_mailbox(model: Model) -> None:
    assert after(model, to(model, "BOOT")) == ("INIT", True, 0x0015)


def having(model: Model, choices: dict[str, str]) -> State:
    """A terminal in INIT that goes these ways."""
    device = VirtualSubDevice(model.protocol)
    play(model, device, mailbox_settings(model))
    state = device.state
    for name, way in choices.items():
        state = state.having(model.slots[f"choice {name}"], way)
    return state


@pytest.mark.parametrize(
    ("way", "rules"),
    [
        ("stated", {"bootstrap_entered"}),
        ("own", {"bootstrap_entered", "bootstrap_mailbox_refused"}),
    ],
)
def test_the_mailbox_of_boot_may_be_another(model: Model, way: str, rules: set[str]) -> None:
    ways = {"bootstrap_mailbox": way, "mailbox_address": "refuse", "emulation": "none"}
    asked = {"requested": model.row("al_state", "BOOT"), "acknowledge": False, "application": 0}
    request = Event("al", "request", {**asked, "identification": False})
    found = {str(taken.rules[0]) for taken in step(model, having(model, ways), request)}
    assert found == {f"al.{rule}" for rule in rules}


def test_the_terminal_may_refuse_safeop_for_its_clocks(model: Model) -> None:
    device = VirtualSubDevice(model.protocol)
    play(model, device, (*way_to(model, "PREOP"), SetUpProcessData()))
    asked = {"requested": model.row("al_state", "SAFEOP"), "acknowledge": False}
    event = Event("al", "request", {**asked, "identification": False})
    ways = {str(taken.rules[0]) for taken in step(model, device.state, event)}
    assert ways == {"al.preop_to_safeop", "al.preop_to_safeop_held", "al.clocks_refused"}


def test_syncmanagers_are_checked_before_safeop(model: Model) -> None:
    up = way_to(model, "PREOP")
    wrong = SetUpProcessData(longer={"sync_manager_3": 1})
    assert after(model, *up, wrong, to(model, "SAFEOP")) == ("PREOP", True, 0x0017)
    assert after(model, *up, SetUpProcessData(), to(model, "SAFEOP")) == ("SAFEOP", False, 0)


def test_inputs_are_there_when_safeop_is_shown(model: Model) -> None:
    start = model.parameter("process_data_in", "start")
    device = VirtualSubDevice(model.protocol)
    play(model, device, (*way_to(model, "PREOP"), SetUpProcessData()))
    assert device.read(start, 2)[0] == 0
    play(model, device, (to(model, "SAFEOP"),))
    assert device.read(start, 2)[0] == 1


def test_op_comes_with_outputs(model: Model) -> None:
    up = way_to(model, "SAFEOP")
    assert after(model, *up, to(model, "OP"))[:2] == ("SAFEOP", True)
    assert after(model, *up, WriteOutputs(), to(model, "OP")) == ("OP", False, 0)


def test_the_watchdog_is_on_by_default(terminal: Protocol) -> None:
    register = terminal.registers["watchdog_process_data"]
    assert register.reset > 0
    assert "EL6720-C12" in register.clauses


# --- faults ---------------------------------------------------------------------------------------

LEAST_FAULTS: Final = 10


def test_the_faults_are_of_ways_that_this_terminal_has(terminal: Protocol) -> None:
    faults = [f for f in load_faults().values() if Path(f.at.file).stem == "beckhoff_el6720"]
    assert len(faults) >= LEAST_FAULTS
    for fault in faults:
        assert set(fault.clauses) <= set(terminal.clauses), fault.name
    assert any(set(fault.clauses) & own_clauses(terminal) for fault in faults)
