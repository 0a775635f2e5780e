"""Tests of the text of the Afag SE-Power: four PDOs, 4 bytes, CoE alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest
from drive_fixture import STATES, WAYS, Desk, shown, to, way

from ecatspec.generators.cases.case import Happen, SetUpProcessData, WriteOutputs, WriteRegister
from ecatspec.generators.cases.play import play
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.interpreter import step
from ecatspec.model.core.state import Event
from ecatspec.model.core.values import admits
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Access, AnyValue, Conditional, Literal, UInt
from ecatspec.spec.language.load import load_device, load_faults

if TYPE_CHECKING:
    from ecatspec.model.core.state import State
    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import ObjectEntry, Protocol

FAULTS = 20
PDOS: Final = 4
TEXTS: Final = (0x1008, 0x1009, 0x100A)
CONTAINERS: Final = range(0x6089, 0x608F)
LENGTH_CODES: Final = {0x06070010, 0x06070012}


@pytest.fixture(scope="module")
def drive() -> Protocol:
    return load_device("afag-se-power")


@pytest.fixture(scope="module")
def model(drive: Protocol) -> Model:
    return Model(drive)


def entries(protocol: Protocol) -> dict[tuple[int, int], ObjectEntry]:
    return {(entry.index, entry.subindex): entry for entry in protocol.objects}


# --- evidence -------------------------------------------------------------------------------------


def test_the_faults_are_the_drives_own() -> None:
    mine = [f for f in load_faults().values() if Path(f.at.file).stem == "afag_se_power"]
    assert len(mine) == FAULTS
    for fault in mine:
        assert any(name.startswith("AFAG-C") for name in fault.clauses), fault.name


# --- what the manual says and what it leaves open -------------------------------------------------


def test_pins_and_what_stays_open(drive: Protocol) -> None:
    assert {name: pin.alternative for name, pin in drive.pins.items()} == {
        "bootstrap": "unsupported",
        "complete_access_support": "refused",
        "emulation": "none",
        "mailbox_support": "present",
        "other_protocols": "absent",
        "pdo_services": "absent",
    }
    assert not set(drive.opened) & set(drive.pins)
    # ANOM-020, ANOM-039, ANOM-040, and the areas that the manual does not print
    wanted = {"refused_in_op", "bad_service", "unknown_command", "upload_form", "mailbox_address"}
    assert wanted <= set(drive.opened)


def test_coe_is_the_only_protocol(drive: Protocol) -> None:
    def rows(name: str) -> list[str]:
        assert drive.tables[name].closed
        return [row.name for row in drive.tables[name].rows]

    assert rows("mailbox_type") == ["error", "coe"]
    services = ["emergency", "sdo_request", "sdo_response", "sdo_information"]
    assert rows("coe_service") == services


def test_no_code_is_demanded(drive: Protocol) -> None:
    """ANOM-019: a refusal has an error, whatever its AL status code."""
    assert not drive.tables["al_status_code"].closed
    judged = []
    for rule in drive.machines["al"].rules:
        updates = {update.variable: update.value for update in rule.updates}
        if updates.get("error") != Literal(value=True):
            continue
        code = updates["code"]
        parts = [code.then, code.otherwise] if isinstance(code, Conditional) else [code]
        if not all(isinstance(part, AnyValue) for part in parts):
            judged.append(rule.name)
    # rules of a state that the drive does not have
    in_boot = {"bootstrap_mailbox_refused", "boot_skipping_refused"}
    assert {*judged} == in_boot | {"boot_mailbox_found_wrong", "boot_mailbox_taken_away"}


def test_error_numbers(drive: Protocol) -> None:
    found = {row.value: row.wording for row in drive.tables["drive_error"].rows}
    assert list(found) == [*range(0x620, 0x626), *range(0x630, 0x634)]
    for value, wording in found.items():
        assert wording.startswith(f"{value >> 4:02x}-{value & 0xF} ")
    assert "warning" in found[0x633]


def test_the_esc_shows_its_features(drive: Protocol) -> None:
    resets = {name: register.reset for name, register in drive.registers.items()}
    assert resets["esc_fmmus"] == sum(name.startswith("fmmu_") for name in resets) == PDOS
    assert resets["esc_sync_managers"] == 6
    assert resets["esc_memory"] * 1024 + 0x1000 == Model(drive).parameter("memory_size")
    assert drive.registers["esc_sync_managers"].fields[0].shows is None  # ANOM-111
    shows = drive.registers["esc_features"].fields[0].shows
    assert shows is not None
    assert shows.value == Literal(value=True)


# --- objects --------------------------------------------------------------------------------------


def test_sync_channels(drive: Protocol) -> None:
    held = entries(drive)
    for subindex, value in enumerate((4, 1, 2, 3, 4)):
        entry = held[0x1C00, subindex]
        assert (entry.default, entry.constant, entry.access) == (value, True, Access.READ)
        assert entry.type == UInt(8)
    for index in (0x1C10, 0x1C11):
        entry = held[index, 0]
        assert (entry.default, entry.constant, entry.access) == (0, True, Access.READ)
        assert (index, 1) not in held


@pytest.mark.parametrize(("index", "first"), [(0x1C12, 0x1600), (0x1C13, 0x1A00)])
def test_four_pdos_a_direction_none_assigned(drive: Protocol, index: int, first: int) -> None:
    held = entries(drive)
    count = held[index, 0]
    assert (count.low, count.high, count.default, count.type) == (0, PDOS, 0, UInt(8))
    for subindex in range(1, PDOS + 1):
        entry = held[index, subindex]
        assert (entry.default, entry.type) == (first + subindex - 1, UInt(16))
    assert (index, PDOS + 1) not in held
    pdos = {e.index for e in drive.objects if first <= e.index < first + 0x200}
    assert pdos == set(range(first, first + PDOS))


def test_set_up_in_preop_only(drive: Protocol) -> None:
    pdos = {*range(0x1600, 0x1604), *range(0x1A00, 0x1A04), 0x1C12, 0x1C13}
    rows = [entry for entry in drive.objects if entry.index in pdos]
    assert {entry.index for entry in rows} == pdos
    assert {(entry.access, entry.states) for entry in rows} == {(Access.BOTH, ("PREOP",))}


def test_no_object_is_longer_than_four_bytes(drive: Protocol, model: Model) -> None:
    assert model.parameter("longest_transfer") == 4
    for entry in drive.objects:
        assert getattr(entry.type, "width", 99) <= 32, hex(entry.index)
    assert not set(TEXTS) & {entry.index for entry in drive.objects}


def test_containers_take_whatever_fits(drive: Protocol) -> None:
    held = entries(drive)
    for index in CONTAINERS:
        entry = held[index, 0]
        assert entry.access is Access.BOTH
        assert entry.low is not None
        assert entry.high is not None
        assert entry.high - entry.low == 255


# --- description file -----------------------------------------------------------------------------


def number(rows: dict[str, int | str], path: str) -> int:
    value = rows[path]
    assert isinstance(value, int), path
    return value


def test_the_described_pdo_is_what_the_drive_maps(drive: Protocol) -> None:
    held = entries(drive)
    rows = {row.path: row.value for row in drive.esi}
    pdo, channel = number(rows, "Device/RxPdo/Index"), number(rows, "Device/RxPdo/@Sm")
    assert pdo == held[0x1C12, 1].default
    assert held[0x1C00, channel + 1].default == 3  # outputs
    assert held[pdo, 0].default == 2
    for place in (0, 1):
        at = f"Device/RxPdo/Entry[{place}]"
        index, subindex, bits = (
            number(rows, f"{at}/{name}") for name in ("Index", "SubIndex", "BitLen")
        )
        assert held[pdo, place + 1].default == index << 16 | subindex << 8 | bits
        entry = held[index, subindex]
        assert entry.mappable
        assert getattr(entry.type, "width", 0) == bits in {8, 16, 32}
        signed = not isinstance(entry.type, UInt)
        assert rows[f"{at}/DataType"] == ("SINT" if signed else "UINT")


@pytest.mark.parametrize(("place", "name"), [(0, "mode_of_operation"), (1, "control_word")])
def test_commands_at_start_fit_their_objects(drive: Protocol, place: int, name: str) -> None:
    rows = {row.path: row.value for row in drive.esi}
    at = f"Device/Mailbox/CoE/InitCmd[{place}]"
    entry = entries(drive)[number(rows, f"{at}/Index"), number(rows, f"{at}/SubIndex")]
    assert (entry.name, entry.access) == (name, Access.BOTH)
    assert rows[f"{at}/Transition"] == "PS"
    data = bytes.fromhex(str(rows[f"{at}/Data"]))  # ANOM-059: whole bytes
    assert len(data) * 8 == getattr(entry.type, "width", 0)


# --- AL state machine -----------------------------------------------------------------------------


@pytest.mark.parametrize("target", [*STATES, "BOOT"])
@pytest.mark.parametrize("source", STATES)
def test_ways_between_states(model: Model, source: str, target: str) -> None:
    device = VirtualSubDevice(model.protocol)
    # PDOs are assigned on the way to SAFEOP, so OP needs outputs
    outputs = [WriteOutputs()] if source == "SAFEOP" else []
    play(model, device, (*way(model, source), SetUpProcessData(), *outputs, to(model, target)))
    reached, error = shown(model, device)
    if source == target or (source, target) in WAYS:
        assert (reached, error) == (target, False)
    else:
        assert error
        assert reached == source or (source, reached) == ("OP", "SAFEOP")


def test_the_state_is_kept_unasked(model: Model) -> None:
    device = VirtualSubDevice(model.protocol)
    off = WriteRegister("sync_manager_0_activation", {"enabled": 0})
    play(model, device, (*way(model, "OP"), Happen("al.sync_lost"), off))
    assert shown(model, device) == ("OP", False)


def al_state(model: Model, state: State) -> tuple[str, bool]:
    names = {r.value: r.name for r in model.protocol.tables["al_state"].rows}
    value = state.slots[model.slots["al.state"]]
    return next(n for v, n in names.items() if v == value), state.slots[
        model.slots["al.error"]
    ] is True


@pytest.mark.parametrize(
    ("event", "choice", "down"),
    [("watchdog", "watchdog_expiry", "SAFEOP"), ("sync_lost", "sync_failure", "SAFEOP")],
)
def test_an_error_keeps_the_state_or_leads_down(
    model: Model, event: str, choice: str, down: str
) -> None:
    """ANOM-020: both are allowed, the way down shows the error indication."""
    begun = VirtualSubDevice(model.protocol).state
    begun = begun.having(model.slots["al.state"], model.row("al_state", "OP"))
    ends = {}
    for alternative in ("kept", "down"):
        state = begun.having(model.slots[f"choice {choice}"], alternative)
        ends[alternative] = {
            al_state(model, s.state) for s in step(model, state, Event("al", event, {}))
        }
    assert ends == {"kept": {("OP", False)}, "down": {(down, True)}}


def test_wrong_lengths_are_refused_or_errors_of_the_drive(model: Model) -> None:
    """Errors 62-3 and 62-4: what becomes of the AL state is not said."""
    rules = {rule.name: rule for rule in model.protocol.machines["al"].rules}
    assert rules["preop_to_safeop_refused"].target is None
    assert rules["preop_to_safeop_reported"].target == "SAFEOP"
    given = {give.target for give in rules["preop_to_safeop_reported"].gives}
    assert "ds402.length_error" in given


# --- mailbox --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def desk(model: Model) -> Desk:
    return Desk(model)


@pytest.mark.parametrize("kind", [0, 1, 2, 4, 5, 6, 14, 15])
def test_another_protocol_is_told_by_an_emergency(desk: Desk, kind: int) -> None:
    frame, _ = desk.ask("mailbox", type=kind, payload=bytes(7))
    assert frame == "emergency"
    assert desk.read(0x1C00) == ("sdo_upload_expedited", b"\x04")


@pytest.mark.parametrize("service", [0, 1, 3, 4, 5, 6, 7, 9, 15])
def test_an_unknown_service_is_told_by_an_emergency(desk: Desk, service: int) -> None:
    """PDOs over the mailbox among them."""
    frame, _ = desk.ask("coe", service=service, body=bytes(8))
    assert frame == "emergency"
    assert desk.read(0x1C00) == ("sdo_upload_expedited", b"\x04")


@pytest.mark.parametrize("choice", ["protocol_report", "service_report", "command_report"])
def test_the_answer_of_the_standard_is_one_too(drive: Protocol, choice: str) -> None:
    """ANOM-039: either of them is taken."""
    names = {alternative.name for alternative in drive.choices[choice].alternatives}
    assert len(names) == 2
    assert "emergency" in names
    assert choice not in drive.pins


def test_an_emergency_has_eight_bytes_and_no_more(model: Model) -> None:
    fields: dict[str, Value] = {"error_code": 0xFF00, "error_register": 1, "manufacturer": bytes(5)}
    data = model.codec.encode("emergency", fields)
    assert len(data) - model.codec.size("mailbox") - model.codec.size("coe") == 8


@pytest.mark.parametrize("size", [5, 8, 100])
def test_more_than_four_bytes_are_refused(desk: Desk, size: int) -> None:
    fields: dict[str, Value] = {"index": 0x1600, "subindex": 1, "size": size, "value": bytes(size)}
    frame, answer = desk.ask("sdo_download_normal", **fields)
    assert frame == "sdo_abort"
    assert answer["code"] in LENGTH_CODES


def test_four_bytes_come_in_one_segment(desk: Desk) -> None:
    place: dict[str, Value] = {"index": 0x1A01, "subindex": 1}
    value = bytes.fromhex("10004160")
    frame, _ = desk.ask("sdo_download_normal", **place, size=4, value=b"")
    assert frame == "sdo_download_response"
    segment: dict[str, Value] = {"last": True, "toggle": False, "value": value}
    frame, _ = desk.ask("sdo_download_segment", **segment)
    assert frame == "sdo_download_segment_response"
    assert desk.read(0x1A01, 1) == ("sdo_upload_expedited", value)


@pytest.mark.parametrize("brought", [0, 1, 3])
def test_an_upload_has_one_segment(model: Model, brought: int) -> None:
    """Whatever the first response left over comes at once, and is the last."""
    content = bytes.fromhex("01020304")
    slots: dict[str, Value] = {
        "al.state": model.row("al_state", "PREOP"),
        "sdo.state": model.row("sdo_state", "UPLOADING"),
        "sdo.index": 0x1018,
        "sdo.subindex": 1,
        "sdo.size": len(content),
        "sdo.data": content[:brought],
    }
    state = model.initial.keeping((0x1018, 1), content)
    for name, value in slots.items():
        state = state.having(model.slots[name], value)
    wanted: dict[str, Value] = {"flags": 0, "toggle": False, "excess": b""}
    asked = Event("sdo", "upload_segment", wanted | {"number": 0, "reserved_coe": 0})
    (taken,) = step(model, state, asked)
    (output,) = taken.outputs
    sent = dict(output.fields)
    assert (output.frame, sent["last"]) == ("sdo_upload_segment_response", True)
    assert admits(sent["value"], content[brought:])
    assert not admits(sent["value"], content[brought:-1])


@pytest.mark.parametrize("index", TEXTS)
def test_objects_of_texts_are_not_there(desk: Desk, index: int) -> None:
    assert desk.read(index) == ("sdo_abort", 0x06020000)
    assert desk.write(index, 0, b"\1") == 0x06020000


@pytest.mark.parametrize("index", TEXTS)
@pytest.mark.parametrize("event", ["read", "write"])
def test_no_answer_but_the_refusal_is_allowed_there(model: Model, index: int, event: str) -> None:
    """The dictionary is open: another object may exist, these may not."""
    assert not model.protocol.dictionary.closed
    state = model.initial.having(model.slots["al.state"], model.row("al_state", "PREOP"))
    fields: dict[str, Value] = {"index": index, "subindex": 0, "complete": False}
    if event == "write":
        fields |= {"size": 1, "value": b"\1"}
    steps = step(model, state, Event("sdo", event, fields))
    assert {str(rule) for s in steps for rule in s.rules} == {
        f"sdo.{'up' if event == 'read' else 'down'}load_of_text"
    }
    other = step(model, state, Event("sdo", event, {**fields, "index": 0x2000}))
    assert len(other) > 1


@pytest.mark.parametrize("index", CONTAINERS)
def test_containers_keep_their_value(desk: Desk, index: int) -> None:
    for value in (b"\x00", b"\x7f", b"\xff"):
        assert desk.write(index, 0, value) == 0
        assert desk.read(index) == ("sdo_upload_expedited", value)


@pytest.mark.parametrize(("index", "first"), [(0x1C12, 0x1600), (0x1C13, 0x1A00)])
def test_what_the_assignment_takes(desk: Desk, index: int, first: int) -> None:
    for subindex in range(1, PDOS + 1):
        own_pdo = (first + subindex - 1).to_bytes(2, "little")
        assert desk.write(index, subindex, own_pdo) == 0
        assert desk.read(index, subindex) == ("sdo_upload_expedited", own_pdo)
    for strange in (first + PDOS, first ^ 0x0C00, 0x6040):
        assert desk.write(index, 1, strange.to_bytes(2, "little")) != 0
    assert desk.read(index, 1) == ("sdo_upload_expedited", first.to_bytes(2, "little"))
    assert desk.write(index, 0, bytes([PDOS])) == 0
    assert desk.write(index, 0, bytes([PDOS + 1])) != 0
    assert desk.read(index) == ("sdo_upload_expedited", bytes([PDOS]))
    assert desk.write(index, PDOS + 1, b"\0\0") == 0x06090011


def test_the_own_pdo_must_be_taken(model: Model) -> None:
    """ANOM-050: another one of the four may be refused for a reason that only the drive knows."""
    state = model.initial.having(model.slots["al.state"], model.row("al_state", "PREOP"))

    def rules(value: int) -> set[str]:
        fields: dict[str, Value] = {
            "index": 0x1C12,
            "subindex": 2,
            "complete": False,
            "value": value.to_bytes(2, "little"),
            "segmented": False,
        }
        uncounted = state.keeping((0x1C12, 0), b"\0")
        steps = step(model, uncounted, Event("sdo", "commit", fields))
        return {rule.name for s in steps for rule in s.rules}

    assert rules(0x1601) == {"value_taken"}
    assert rules(0x1602) == {"value_taken", "value_refused"}
    assert "value_taken" not in rules(0x1604)
