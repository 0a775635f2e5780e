"""Tests of the text of the Kollmorgen S300: its evidence and its commands."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from ecatspec.model.core.compilation import Model
from ecatspec.model.core.interpreter import fields_with_before, step
from ecatspec.model.core.state import Event
from ecatspec.spec.language.ir import Binary, Call, Gap, Level, Literal, Name, OneOf, Rule, Unary
from ecatspec.spec.language.load import load_device, load_faults

if TYPE_CHECKING:
    from ecatspec.model.core.state import State
    from ecatspec.spec.language.ir import Expression, Protocol


BITS: Final = ("fault_reset", "enable_operation", "quick_stop", "enable_voltage", "switch_on")
"""The columns of the manual's table: bits 7, 3, 2, 1 and 0 of the control word."""

COMMANDS: Final = """
row_1          NOT_READY          SWITCH_ON_DISABLED  X X X 0 X
row_2          SWITCH_ON_DISABLED READY_TO_SWITCH_ON  X X X 1 0
row_3          READY_TO_SWITCH_ON SWITCHED_ON         X X 1 1 P
row_4          SWITCHED_ON        OPERATION_ENABLED   X P 1 1 1
row_5          OPERATION_ENABLED  SWITCHED_ON         X N 1 1 1
row_5_second   OPERATION_ENABLED  SWITCHED_ON         X X N 1 1
row_6          SWITCHED_ON        READY_TO_SWITCH_ON  X X X 1 N
row_7          READY_TO_SWITCH_ON SWITCH_ON_DISABLED  X X X N X
row_8          OPERATION_ENABLED  READY_TO_SWITCH_ON  X X X 1 N
row_9          OPERATION_ENABLED  SWITCH_ON_DISABLED  X X X N X
row_10         SWITCHED_ON        SWITCH_ON_DISABLED  X X X N X
row_11         OPERATION_ENABLED  QUICK_STOP_ACTIVE   X 1 N 1 1
row_12         QUICK_STOP_ACTIVE  SWITCH_ON_DISABLED  X X X N X
row_15         FAULT              SWITCH_ON_DISABLED  P X X X X
"""
"""Lines 769 to 784 of the manual. 0, 13 and 14 come by themselves, a row for 16 is missing."""

ADDED: Final = {("row_5_second", "enable_operation"): "0"}
"""Where a guard is closer than its row: ANOM-087, transition 11 goes before the second row 5."""

OTHER_CONDITIONS: Final = {"command_counts", "tested", "power", "not cause", "drive_release"}
"""What rows want beside the control word."""


@pytest.fixture(scope="module")
def s300() -> Protocol:
    return load_device("kollmorgen-s300")


def own_clauses(protocol: Protocol) -> set[str]:
    return {name for name in protocol.clauses if name.startswith("S300-C")}


# --- evidence -------------------------------------------------------------------------------------


def unobservable(protocol: Protocol) -> set[str]:
    levels = {name: protocol.clauses[name].level for name in own_clauses(protocol)}
    return {name for name, level in levels.items() if level is Level.UNOBSERVABLE}


# --- AL state machine -----------------------------------------------------------------------------


def test_areas(s300: Protocol) -> None:
    def area(name: str) -> list[int | bool]:
        return [part.value for part in s300.parameters[name].value if isinstance(part, Literal)]

    assert area("process_data_out") == [0x1100, 64]
    assert area("process_data_in") == [0x1140, 72]
    assert area("mailbox_out") == [0x1800, 512]
    assert area("mailbox_in") == [0x1C00, 512]


def test_pins(s300: Protocol) -> None:
    assert {name: pin.alternative for name, pin in s300.pins.items()} == {
        "application_bits": "used",
        "bootstrap": "supported",
        "drive_coupling": "coupled",
        "emulation": "none",
        "enabled_in_one": "switched_on_only",
        "identification_support": "unanswered",
        "mailbox_support": "present",
        "quick_stop_end": "stays",
        "refused_in_op": "stay",
    }


def test_what_the_extract_does_not_say_stays_open(s300: Protocol) -> None:
    assert set(s300.opened) == {
        "complete_access_support",
        "drive_power",
        "drive_release",
        "information_support",
        "mailbox_address",
        "mailbox_length",
        "mains_needed",
        "op_without_outputs",
        "other_protocols",
        "pdo_services",
        "process_data_address",
        "reply_counter",
        "return_from_quick_stop",
        "segmented_download",
        "upload_form",
    }


def codes_of(protocol: Protocol, rule: Rule) -> set[int]:
    """The AL status codes that a rule sets."""
    rows = {row.name: row.value for row in protocol.tables["al_status_code"].rows}
    found: set[int] = set()
    for update in rule.updates:
        if update.variable == "code":
            items = update.value.items if isinstance(update.value, OneOf) else (update.value,)
            for item in items:
                assert isinstance(item, Name), f"{rule.name} sets a code that is no row"
                found.add(rows[item.path])
    return found


def test_every_code_is_one_of_the_four(s300: Protocol) -> None:
    table = s300.tables["al_status_code"]
    assert table.closed
    assert sorted(row.value for row in table.rows) == [0x0000, 0x0011, 0x0017, 0x001A]
    for rule in s300.machines["al"].rules:
        codes_of(s300, rule)


@pytest.mark.parametrize(
    ("name", "codes", "target"),
    [
        ("preop_to_safeop_refused", {0x0017}, None),
        ("safeop_to_op_refused", {0x0017}, None),
        ("synchronisation_failed", {0x001A}, None),
        ("sync_lost_in_op", {0x001A}, "SAFEOP"),
        ("op_skipping_stays", {0x0011}, None),
    ],
)
def test_codes_as_in_the_table(
    s300: Protocol, name: str, codes: set[int], target: str | None
) -> None:
    (rule,) = (rule for rule in s300.machines["al"].rules if rule.name == name)
    assert (codes_of(s300, rule), rule.target) == (codes, target)


def test_a_failed_synchronisation_is_a_fault_of_the_drive_too(s300: Protocol) -> None:
    (rule,) = (r for r in s300.machines["al"].rules if r.name == "synchronisation_failed")
    (given,) = rule.gives
    assert given.target == "ds402.synchronisation_failed"


def test_the_faults_are_faults_of_this_drive(s300: Protocol) -> None:
    faults = [f for f in load_faults().values() if Path(f.at.file).stem == "kollmorgen_s300"]
    assert len(faults) >= 10
    for fault in faults:
        assert set(fault.clauses) <= set(s300.clauses) - unobservable(s300), fault.name


# --- table of commands ----------------------------------------------------------------------------


def table_rows() -> list[tuple[str, str, str, tuple[str, ...]]]:
    rows = [line.split() for line in COMMANDS.strip().splitlines()]
    return [(name, source, target, tuple(cells)) for name, source, target, *cells in rows]


def conjuncts(value: Expression) -> list[Expression]:
    """The parts of a guard that must all hold."""
    match value:
        case Binary("and", left, right):
            return [*conjuncts(left), *conjuncts(right)]
        case _:
            return [value]


def cell(value: Expression) -> tuple[str, str]:
    """The column and the cell that a part of a guard stands for; no cell for another condition."""
    match value:
        case Call("rises", (Name(bit),)):
            return bit, "P"
        case Call("falls", (Name(bit),)):
            return bit, "N"
        case Name(bit) if bit in BITS:
            return bit, "1"
        case Unary("not", Name(bit)) if bit in BITS:
            return bit, "0"
        case Unary("not", Name(name)):
            return f"not {name}", ""
        case Binary("==", Name(name), _) | Name(name):
            return name, ""
        case _:
            pytest.fail(f"{value} is no cell of the table")


@pytest.mark.parametrize(("name", "source", "target", "cells"), table_rows())
def test_the_guard_is_the_row_of_the_manual(
    s300: Protocol, name: str, source: str, target: str, cells: tuple[str, ...]
) -> None:
    (rule,) = (rule for rule in s300.machines["ds402"].rules if rule.name == name)
    assert (rule.input, rule.sources, rule.target) == ("written", (source,), target)
    assert rule.guard is not None
    found = [cell(part) for part in conjuncts(rule.guard)]
    columns = dict(found)
    assert len(columns) == len(found)
    assert "command_counts" in columns
    assert {column for column, mark in found if not mark} <= OTHER_CONDITIONS
    expected = tuple(ADDED.get((name, bit), mark) for bit, mark in zip(BITS, cells, strict=True))
    assert tuple(columns.get(bit, "X") for bit in BITS) == expected


def test_no_rule_goes_by_levels_where_the_manual_wants_an_edge(s300: Protocol) -> None:
    moving = {
        rule.name
        for rule in s300.machines["ds402"].rules
        if rule.input in {"written", "command", "operational"} and rule.target is not None
    }
    by_levels = {"shutdown_2", "row_2_in_op"}  # transition 2 has no edge
    assert moving == {name for name, *_ in table_rows()} | by_levels | {"number_16"}


# --- what the drive does --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model(s300: Protocol) -> Model:
    return Model(s300)


def drive_state(model: Model, state: State) -> str:
    value = state.slots[model.slots["ds402.state"]]
    return next(r.name for r in model.protocol.tables["ds402_state"].rows if r.value == value)


def placed(model: Model, state: str, **variables: bool) -> State:
    """A drive in OP, in a state of its own, that goes no way which is a matter of choice."""
    choices = {
        "drive_power": "available",
        "drive_release": "given",
        "mains_needed": "yes",
        "return_edge": "of_either",
        "return_from_quick_stop": "served",
    }
    placed = model.initial.having(model.slots["al.state"], model.row("al_state", "OP"))
    placed = placed.having(model.slots["ds402.state"], model.row("ds402_state", state))
    for name, way in choices.items():
        placed = placed.having(model.slots[f"choice {name}"], way)
    for name, value in variables.items():
        placed = placed.having(model.slots[f"ds402.{name}"], value)
    return placed


def word(bits: tuple[bool, ...]) -> int:
    return sum(on << at for on, at in zip(bits, (7, 3, 2, 1, 0), strict=True))


def matches(mark: str, before: bool, now: bool) -> bool:  # noqa: FBT001
    return {
        "X": True,
        "0": not now,
        "1": now,
        "P": now and not before,
        "N": before and not now,
    }[mark]


def rows_that_hold(state: str, before: tuple[bool, ...], now: tuple[bool, ...]) -> set[str]:
    """The rows of the manual, with transition 11 before the second row 5."""
    found = {
        name
        for name, source, _, cells in table_rows()
        if source == state and all(map(matches, cells, before, now))
    }
    return found - {"row_5_second"} if "row_11" in found else found


STATES: Final = (
    "NOT_READY",
    "SWITCH_ON_DISABLED",
    "READY_TO_SWITCH_ON",
    "SWITCHED_ON",
    "OPERATION_ENABLED",
    "QUICK_STOP_ACTIVE",
    "FAULT_REACTION_ACTIVE",
    "FAULT",
)


def guard_holds(
    protocol: Protocol, value: Expression, before: dict[str, bool], now: dict[str, bool]
) -> bool:
    """Judge a guard over the bits of the control word; every other condition is in favour."""
    match value:
        case Binary("and", left, right):
            return guard_holds(protocol, left, before, now) and guard_holds(
                protocol, right, before, now
            )
        case Binary("or", left, right):
            return guard_holds(protocol, left, before, now) or guard_holds(
                protocol, right, before, now
            )
        case Unary("not", operand):
            return not guard_holds(protocol, operand, before, now)
        case Call("rises", (Name(bit),)):
            return now[bit] and not before[bit]
        case Call("falls", (Name(bit),)):
            return before[bit] and not now[bit]
        case Binary("==", Name(), Name(way)):
            return way in {"given", "served"}
        case Binary("!=", Name("return_edge"), _):
            return True
        case Name(bit) if bit in now:
            return now[bit]
        case Name("command_counts" | "power" | "tested"):
            return True
        case Name("cause"):
            return False
        case Name(name):
            return guard_holds(protocol, protocol.definitions[name].value, before, now)
        case _:
            pytest.fail(f"{value} is nothing that a word decides")


@pytest.mark.parametrize("state", STATES)
def test_every_change_of_the_word_has_one_rule(s300: Protocol, state: str) -> None:
    machine = s300.machines["ds402"]
    both: tuple[Rule | Gap, ...] = (*machine.rules, *machine.gaps)
    rows = [row for row in both if row.input == "written" and state in row.sources]
    every = tuple(itertools.product((False, True), repeat=len(BITS)))
    for before, now in itertools.product(every, every):
        old, new = dict(zip(BITS, before, strict=True)), dict(zip(BITS, now, strict=True))
        fired = {
            row.name: row
            for row in rows
            if row.guard is not None and guard_holds(s300, row.guard, old, new)
        }
        assert len(fired) == 1, (state, word(before), word(now), sorted(fired))
        wanted = rows_that_hold(state, before, now)
        moving = {
            name for name, row in fired.items() if isinstance(row, Rule) and row.target is not None
        }
        assert moving - {"number_16"} == wanted, (word(before), word(now))


def written(model: Model, before: int, now: int) -> Event:
    """The drive took a control word from process data."""
    word = model.protocol.words["control_word"]
    parameters = fields_with_before(word.fields, now, before)
    return Event("ds402", "written", {**parameters, "cyclic": True})


SHORT: Final = {
    "D": "SWITCH_ON_DISABLED",
    "R": "READY_TO_SWITCH_ON",
    "S": "SWITCHED_ON",
    "E": "OPERATION_ENABLED",
    "Q": "QUICK_STOP_ACTIVE",
}


@pytest.mark.parametrize(
    ("words", "states"),
    [
        ((0x00, 0x06, 0x0F, 0x0F), "DRSS"),  # ANOM-089: two edges in one word are one transition
        ((0x06, 0x07, 0x0F, 0x07), "RSES"),
        ((0x06, 0x07, 0x0F, 0x03), "RSES"),  # the second row 5
        ((0x06, 0x07, 0x0F, 0x0B), "RSEQ"),  # ANOM-087: 11 goes before it
        ((0x06, 0x07, 0x0F, 0x0B, 0x0F), "RSEQE"),
        ((0x06, 0x07, 0x0F, 0x0B, 0x09), "RSEQD"),
        ((0x06, 0x07, 0x0F, 0x0E), "RSER"),
        ((0x06, 0x07, 0x0F, 0x00), "RSED"),
        ((0x06, 0x07, 0x03, 0x07), "RSSS"),  # no transition 10 by bit 2
        ((0x07, 0x06, 0x04), "DRD"),
    ],
)
def test_ways_through_the_machine(model: Model, words: tuple[int, ...], states: str) -> None:
    state, before = placed(model, "SWITCH_ON_DISABLED", mains=True, cause=False), 0
    for now, expected in zip(words, states, strict=True):
        (taken,) = step(model, state, written(model, before, now))
        assert not taken.unspecified
        assert drive_state(model, taken.state) == SHORT[expected], hex(now)
        state, before = taken.state, now


def test_held_words_move_nothing_but_transition_2(model: Model) -> None:
    for state in STATES:
        for now in range(0x100):
            begun = placed(model, state, mains=True, cause=False, tested=False)
            for taken in step(model, begun, written(model, now, now)):
                after = drive_state(model, taken.state)
                if state == "SWITCH_ON_DISABLED" and now & 0b11 == 0b10:
                    assert after == "READY_TO_SWITCH_ON"
                else:
                    assert after == state


def test_a_word_below_op_has_no_effect(model: Model) -> None:
    begun = placed(model, "SWITCH_ON_DISABLED", mains=True)
    begun = begun.having(model.slots["al.state"], model.row("al_state", "SAFEOP"))
    (taken,) = step(model, begun, written(model, 0, 0x06))
    assert drive_state(model, taken.state) == "SWITCH_ON_DISABLED"


def test_combinations_without_a_row_are_gaps(model: Model) -> None:
    for state, before, now in (
        ("READY_TO_SWITCH_ON", 0x02, 0x03),
        ("QUICK_STOP_ACTIVE", 0x0B, 0x0A),
    ):
        (taken,) = step(model, placed(model, state), written(model, before, now))
        assert taken.unspecified
