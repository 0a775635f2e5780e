"""Tests of the text of the Kollmorgen AKD: its evidence and what it declares."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ecatspec.generators.cases.bringup import mailbox_settings, request
from ecatspec.generators.cases.play import play
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Access, Level, Literal, Name, OneOf, Protocol, UInt
from ecatspec.spec.language.load import load_device, load_faults


@pytest.fixture(scope="module")
def akd() -> Protocol:
    return load_device("kollmorgen-akd")


def own_clauses(protocol: Protocol) -> set[str]:
    return {name for name in protocol.clauses if name.startswith("AKD-C")}


def unobservable(protocol: Protocol) -> set[str]:
    levels = {name: protocol.clauses[name].level for name in own_clauses(protocol)}
    return {name for name, level in levels.items() if level is Level.UNOBSERVABLE}


def test_what_happens_inside_the_drive_is_unobservable(akd: Protocol) -> None:
    hidden = unobservable(akd)
    for inside in (13, 23, 136, 140, 143):  # interrupts, polling, parameters without an object
        assert f"AKD-C{inside}" in hidden
    for outside in (34, 75, 96, 146):  # codes, modes, command bytes, what a lost clock does
        assert f"AKD-C{outside}" not in hidden


def test_mailbox_areas(akd: Protocol) -> None:
    def area(name: str) -> list[int | bool]:
        return [part.value for part in akd.parameters[name].value if isinstance(part, Literal)]

    assert area("mailbox_out") == [0x1800, 512]
    assert area("mailbox_in") == [0x1C00, 512]


def test_pins(akd: Protocol) -> None:
    assert {name: pin.alternative for name, pin in akd.pins.items()} == {
        "application_bits": "used",
        "emulation": "none",
        "enabled_in_one": "goes_on",
        "identification_support": "unanswered",
        "mailbox_support": "present",
        "process_data_address": "refuse",
        "refused_in_op": "stay",
        "return_from_quick_stop": "served",
        "upload_form": "expedited",
    }


def test_what_the_manual_does_not_say_stays_open(akd: Protocol) -> None:
    assert set(akd.opened) == {
        "bad_service",
        "bootstrap",
        "complete_access_support",
        "drive_coupling",
        "empty_service",
        "information_support",
        "mailbox_address",
        "mailbox_length",
        "mains_needed",
        "op_without_outputs",
        "other_protocols",
        "pdo_services",
        "quick_stop_end",
        "reply_counter",
        "reserved_service",
        "segmented_download",
        "unsized_download",
    }


def test_no_rule_sets_a_code_that_the_drive_does_not_have(akd: Protocol) -> None:
    table = akd.tables["al_status_code"]
    rows = {row.name: row.value for row in table.rows}
    assert table.closed
    assert sorted(rows.values()) == [0x0000, 0x0011, 0x0017]
    for rule in akd.machines["al"].rules:
        codes = [update.value for update in rule.updates if update.variable == "code"]
        for code in codes:
            for item in code.items if isinstance(code, OneOf) else (code,):
                match item:
                    case Name(path=path):
                        assert path in rows, rule.name
                    case Literal(value=value):
                        assert value in rows.values(), rule.name
                    case _:
                        pytest.fail(f"{rule.name} sets a code that is no constant")


def test_mappings_fit_their_counts(akd: Protocol) -> None:
    entries = {(entry.index, entry.subindex): entry for entry in akd.objects}
    fixed = [e for e in akd.objects if e.index >> 8 in {0x17, 0x1B} and e.subindex == 0]
    assert len(fixed) == 15  # nine RxPDOs, six TxPDOs
    # of 0x1704 the manual has the number alone
    for count in (count for count in fixed if count.index != 0x1704):
        assert count.constant
        assert isinstance(count.default, int)
        for subindex in range(1, count.default + 1):
            entry = entries[count.index, subindex]
            assert entry.access is Access.READ
            assert entry.type == UInt(32)
        assert (count.index, count.default + 1) not in entries


def test_mapped_objects_are_declared_with_their_width(akd: Protocol) -> None:
    widths = {(e.index, e.subindex): getattr(e.type, "width", 0) for e in akd.objects}
    mapped = [
        entry.default
        for entry in akd.objects
        if entry.type == UInt(32) and isinstance(entry.default, int) and entry.subindex
    ]
    assert len(mapped) == 22 + 32 + 2  # fixed Rx, fixed Tx, the first entries of 0x1600 and 0x1A00
    for value in mapped:
        assert widths[value >> 16, value >> 8 & 0xFF] == value & 0xFF, hex(value)


def test_the_example_is_the_normative_reading(akd: Protocol) -> None:
    (example,) = akd.examples
    request, response = example.request, example.response
    assert len(request) == len(response) == 16
    assert request[0] == response[0] == len(request) - 6
    assert (request[7], response[7]) == (0x20, 0x30)
    assert request[9:12] == response[9:12]
    assert response[12:] == bytes(4)


# bytes of each fixed PDO as sections 4.5 and 4.6 have them, or their entries added
FIXED = {
    0x1701: 6,
    0x1702: 6,
    0x1703: 4,
    0x1720: 12,
    0x1721: 8,
    0x1722: 14,
    0x1723: 14,
    0x1724: 8,
    0x1B01: 6,
    0x1B20: 32,
    0x1B21: 6,
    0x1B22: 32,
    0x1B23: 32,
    0x1B24: 6,
}


@pytest.mark.parametrize(("pdo", "size"), FIXED.items(), ids=map(hex, FIXED))
def test_fixed_mappings_have_the_size_of_the_manual(akd: Protocol, pdo: int, size: int) -> None:
    bits = 0
    for entry in akd.objects:
        if entry.index == pdo and entry.subindex:
            assert (entry.maps is None) == isinstance(entry.default, int)
            bits += entry.default & 0xFF if isinstance(entry.default, int) else entry.maps or 0
    assert bits == size * 8


def test_process_data_objects_change_in_preop_only(akd: Protocol) -> None:
    for entry in akd.objects:
        writable = entry.access is Access.BOTH
        if writable and 0x1600 <= entry.index <= 0x1C13:
            assert entry.states == ("PREOP",), hex(entry.index)


def test_what_is_mapped_can_be_mapped(akd: Protocol) -> None:
    mappable = {(e.index, e.subindex) for e in akd.objects if e.mappable}
    for entry in akd.objects:
        if entry.type == UInt(32) and isinstance(entry.default, int) and entry.subindex:
            assert (entry.default >> 16, entry.default >> 8 & 0xFF) in mappable
    assert len(mappable) == 6 + 10  # section 4.7


def test_a_lost_synchronisation_leaves_the_al_state(akd: Protocol) -> None:
    in_op = [r for r in akd.machines["al"].rules if r.input == "sync_lost" and "OP" in r.sources]
    assert {(rule.target, rule.updates) for rule in in_op} == {(None, ())}
    faults = {r.target for r in akd.machines["ds402"].rules if r.name == "fault_125"}
    assert faults == {"FAULT_REACTION_ACTIVE"}


def test_remote_is_always_set_where_the_word_is_valid(akd: Protocol) -> None:
    (remote,) = (field for field in akd.words["status_word"].fields if field.name == "remote")
    assert remote.low == remote.high == 9
    assert remote.shows is not None
    assert remote.shows.value == Literal(True)  # noqa: FBT003
    assert remote.shows.condition == Name("status_valid")


# --- the file that describes the drive ------------------------------------------------------------


def described(akd: Protocol) -> dict[str, int | str]:
    return {entry.path: entry.value for entry in akd.esi}


@pytest.mark.parametrize(
    ("number", "kind", "parameter"),
    [
        (0, "MBoxOut", "mailbox_out"),
        (1, "MBoxIn", "mailbox_in"),
        (2, "Outputs", "process_data_out"),
        (3, "Inputs", "process_data_in"),
    ],
)
def test_described_sync_managers_are_those_of_the_parameters(
    akd: Protocol, number: int, kind: str, parameter: str
) -> None:
    rows, model = described(akd), Model(akd)
    assert rows[f"Device/Sm[{number}]"] == kind
    assert rows[f"Device/Sm[{number}]/@StartAddress"] == model.parameter(parameter, "start")
    size = rows[f"Device/Sm[{number}]/@DefaultSize"]
    if kind in {"Outputs", "Inputs"}:  # those of the PDOs that are assigned by default
        assert size == FIXED[0x1701] == FIXED[0x1B01]
    else:
        assert size == model.parameter(parameter, "length")


def test_described_pdos_are_the_declared_ones(akd: Protocol) -> None:
    rows = described(akd)
    entries = {(entry.index, entry.subindex): entry for entry in akd.objects}
    pdos = {path: value for path, value in rows.items() if re.fullmatch(r".*Pdo\[\d+]/Index", path)}
    assert len(pdos) == 8 + 10
    for path, index in pdos.items():
        assert isinstance(index, int)
        fixed = rows.get(path.replace("Index", "@Fixed"))
        if fixed is not None:
            access = entries[index, 0].access
            assert access is (Access.READ if fixed else Access.BOTH), hex(index)
        first = path.replace("Index", "Entry[0]")
        if f"{first}/Index" in rows:
            parts = [rows[f"{first}/{part}"] for part in ("Index", "SubIndex", "BitLen")]
            high, middle, low = (part for part in parts if isinstance(part, int))
            assert entries[index, 1].default == high << 16 | middle << 8 | low


def test_the_default_pdo_excludes_all_others(akd: Protocol) -> None:
    rows = described(akd)
    offered = {rows[f"Device/RxPdo[{number}]/Index"] for number in range(8)}
    excluded = {value for path, value in rows.items() if "RxPdo[4]/Exclude" in path}
    assert rows["Device/RxPdo[4]/Index"] == 0x1701
    assert excluded == offered - {0x1701}


# --- what the drive does --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"sync_manager_0": {"length": 0}}, 0x0017),
        ({"sync_manager_1": {"length": 33}}, 0x0017),
        ({}, None),
    ],
    ids=["empty", "too_short", "right"],
)
def test_mailbox_areas_are_checked_on_the_way_to_preop(
    akd: Protocol, settings: dict[str, dict[str, int]], code: int | None
) -> None:
    model = Model(akd)
    device = VirtualSubDevice(akd)
    preop = request(model.row("al_state", "PREOP"))
    play(model, device, (*mailbox_settings(model, settings), preop))
    if code is None:
        assert device.esc.register("al_status") == model.row("al_state", "PREOP")
    else:
        assert device.esc.register("al_status_code") == code


def test_the_faults_are_faults_of_this_drive(akd: Protocol) -> None:
    faults = [f for f in load_faults().values() if Path(f.at.file).stem == "kollmorgen_akd"]
    assert len(faults) >= 10
    for fault in faults:
        assert set(fault.clauses) <= set(akd.clauses) - unobservable(akd), fault.name
