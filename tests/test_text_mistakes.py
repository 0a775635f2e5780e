"""Typical mistakes in a device text, each an edit of a small sound text."""

from __future__ import annotations

from pathlib import Path

import pytest

from ecatspec.spec.language.diagnostics import SpecError
from ecatspec.spec.language.load import compile_texts, standard_texts
from ecatspec.spec.language.parse import parse_text

SOUND = (Path(__file__).resolve().parents[1] / "examples" / "c_slave" / "slave.ecs").read_text(
    "utf-8"
)
AREA = "parameter mailbox_out = area(0x1000, 48)"
INPUTS = "parameter mailbox_in  = area(0x1080, 48)"
MISTAKES = [
    ("extends standard", "extends standart", "ECS106"),
    ("pin bootstrap ", "pin bootstrp ", "ECS401"),
    ("= unsupported", "= unsuported", "ECS401"),
    (INPUTS, INPUTS.replace("mailbox_in ", "mailbox_inn"), "ECS401"),
    (AREA, AREA.replace("48", "33"), "ECS512"),
    (AREA, AREA.replace("48", "0"), "ECS512"),
    (INPUTS, INPUTS.replace("48", "20"), "ECS512"),
    (INPUTS, INPUTS.replace("0x1080", "0x1000"), "ECS511"),
    (INPUTS, INPUTS.replace("0x1080", "0x102F"), "ECS511"),
    ("rw in { PREOP }", "rw in { PREOPP }", "ECS106"),
    ("readable in { SAFEOP, OP }", "readable in { SAFE, OP }", "ECS106"),
    ("rw in { PREOP }", "rw in { no_error }", "ECS106"),
    ("gain_of_velocity       u8 ", "gain_of_velocity       u12", "ECS503"),
    ("limit                  u16", "limit                  u15", "ECS503"),
    ("range 10 .. 1000 = 100  ", "range 10 .. 1000 = 5    ", "ECS405"),
    ("range 10 .. 1000", "range 1000 .. 10", "ECS405"),
    ("range 10 .. 1000", "range 10 .. 70000", "ECS405"),
    ("text(16) ", "text(15) ", "ECS405"),
    (
        "gain_entries           u8        ro constant = 2",
        "gain_entries u8 ro constant = 3",
        "ECS504",
    ),
    (
        "rx_pdo_count           u8        ro constant = 2",
        "rx_pdo_count u8 ro constant = 3",
        "ECS504",
    ),
    ("inputs_assigned        u8        ro constant = 1", "inputs_assigned u8 ro = 2", "ECS504"),
    ("identity_entries       u8        ro constant = 4", "identity_entries u8 ro = 1", "ECS507"),
    ("identity_entries       u8        ro constant = 4", "identity_entries u8 ro = 5", "ECS504"),
    ("gain_of_velocity ", "gain_of_position ", "ECS502"),
    (
        "outputs_pdo_1          u16       ro constant = 0x1600",
        "outputs_pdo_1 u16 ro = 0x1601",
        "ECS508",
    ),
    (
        "outputs_pdo_1          u16       ro constant = 0x1600",
        "outputs_pdo_1 u16 ro = 0x1A00",
        "ECS508",
    ),
    (
        "inputs_pdo_1           u16       ro constant = 0x1A00",
        "inputs_pdo_1 u16 ro = 0x1600",
        "ECS508",
    ),
    ("= 0x607A0020", "= 0x607B0020", "ECS509"),
    ("= 0x607A0020", "= 0x607A0120", "ECS509"),
    ("= 0x60640020", "= 0x60650020", "ECS509"),
    ("= 0x607A0020", "= 0x607A0010", "ECS510"),
    ("= 0x607A0020", "= 0x60640020", "ECS510"),
    ("= 0x607A0020", "= 0x60600008", "ECS510"),
    ("= 0x60610008", "= 0x20030020", "ECS510"),
    ("control_word           u16", "control_word           u8 ", "ECS505"),
    ("status_word            u16", "status_word            u32", "ECS505"),
    ("mode                   i8 ", "mode                   i16", "ECS505"),
    ("rw = 7                                   [CSL-11]", "rw = 7", "ECS501"),
    ("rw = 7                                   [CSL-11]", "rw = 7 [CSL-99]", "ECS104"),
]


def found(text: str) -> set[tuple[str, int]]:
    """Give code and line of everything that is wrong with a device text."""
    try:
        compile_texts([*standard_texts(), parse_text(text, "slave.ecs")])
    except SpecError as error:
        return {(each.code.name, each.at.line) for each in error.diagnostics}
    return set()


def test_the_text_without_a_mistake_is_sound() -> None:
    assert found(SOUND) == set()


@pytest.mark.parametrize(("old", "new", "code"), MISTAKES)
def test_a_mistake_is_found_at_its_line(old: str, new: str, code: str) -> None:
    before, _, _ = SOUND.partition(old)
    assert before != SOUND
    assert (code, before.count("\n") + 1) in found(SOUND.replace(old, new, 1))


def test_a_control_word_needs_a_status_word() -> None:
    text = SOUND.replace("0x6041 : 0  status_word", "0x5041 : 0  status_word", 1)
    line = SOUND.partition("0x6040 : 0")[0].count("\n") + 1
    assert ("ECS506", line) in found(text)
