"""Tests of the text of the Metronix DIS-2: CoE alone, 4 bytes, two PDOs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest
from drive_fixture import STATES, WAYS, Desk, shown, to, way

from ecatspec.conformance.adapters.model import VirtualAdapter, make
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import (
    NO_LIMITS,
    Happen,
    SetUpProcessData,
    StopOutputs,
    Wait,
)
from ecatspec.generators.cases.play import play
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.interpreter import step
from ecatspec.model.core.process_image import OUTPUTS
from ecatspec.model.core.state import Event
from ecatspec.model.core.values import admits
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Access, AnyValue, Conditional, Literal, UInt
from ecatspec.spec.language.load import load_device, load_faults, load_file

if TYPE_CHECKING:
    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import ObjectEntry, Protocol

TEXT = Path(__file__).resolve().parent.parent / "spec" / "devices" / "metronix-dis2.ecs"
LEAST_FAULTS: Final = 10
STRINGS: Final = (0x1008, 0x1009, 0x100A)
VENDOR, PRODUCT, REVISION = 0xE4, 0x264860D2, 0x20000


@pytest.fixture(scope="module")
def drive() -> Protocol:
    return load_device("metronix-dis2")


@pytest.fixture(scope="module")
def model(drive: Protocol) -> Model:
    return Model(drive)


def own_clauses(protocol: Protocol) -> list[str]:
    return [name for name in protocol.clauses if name.startswith("DIS2-C")]


def entries(protocol: Protocol) -> dict[tuple[int, int], ObjectEntry]:
    return {(entry.index, entry.subindex): entry for entry in protocol.objects}


# --- evidence -------------------------------------------------------------------------------------


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
    # ANOM-039, ANOM-040: segments within 4 bytes, the answer to a bad service
    wanted = {"segmented_download", "upload_form", "bad_service", "unknown_command"}
    assert wanted | {"refused_in_op"} <= set(drive.opened)


def test_coe_is_the_only_protocol(drive: Protocol) -> None:
    def rows(name: str) -> list[str]:
        table = drive.tables[name]
        assert table.closed
        return [row.name for row in table.rows]

    assert rows("mailbox_type") == ["error", "coe"]
    services = ["emergency", "sdo_request", "sdo_response", "sdo_information"]
    assert rows("coe_service") == services
    assert not drive.dictionary.closed  # the dictionary is in the manual of CANopen


def test_no_code_is_demanded(drive: Protocol) -> None:
    """ANOM-019: a refusal has an error, whatever its AL status code."""
    assert not drive.tables["al_status_code"].closed
    for rule in drive.machines["al"].rules:
        updates = {update.variable: update.value for update in rule.updates}
        if updates.get("error") == Literal(value=True) and "BOOT" not in rule.sources:
            code = updates["code"]
            parts = [code.then, code.otherwise] if isinstance(code, Conditional) else [code]
            free = all(isinstance(part, AnyValue) for part in parts)
            assert free or rule.name == "bootstrap_mailbox_refused", rule.name


def test_error_numbers(drive: Protocol) -> None:
    assert [row.value for row in drive.tables["drive_error"].rows] == [37, 38, 39, 53]


def test_fewer_pdos_are_a_reason_to_refuse_safeop(drive: Protocol) -> None:
    """ANOM-052: 0 and 1 can be written, what SAFEOP makes of them is left open."""
    reasons = {r.name for r in drive.reasons.values() if r.rule == "preop_to_safeop_held"}
    assert {"outputs_unassigned", "inputs_unassigned"} <= reasons


# --- objects --------------------------------------------------------------------------------------


def test_sync_channels(drive: Protocol) -> None:
    held = entries(drive)
    for subindex, value in enumerate((4, 1, 2, 3, 4)):
        entry = held[0x1C00, subindex]
        assert (entry.default, entry.constant, entry.access) == (value, True, Access.READ)
    for index in (0x1C10, 0x1C11):
        entry = held[index, 0]
        assert (entry.default, entry.constant, entry.access) == (0, True, Access.READ)
        assert (index, 1) not in held


@pytest.mark.parametrize(("index", "first"), [(0x1C12, 0x1600), (0x1C13, 0x1A00)])
def test_two_pdos_a_direction_both_assigned(drive: Protocol, index: int, first: int) -> None:
    held = entries(drive)
    count = held[index, 0]
    assert (count.low, count.high, count.default, count.type) == (0, 2, 2, UInt(8))
    for subindex in (1, 2):
        entry = held[index, subindex]
        assert (entry.low, entry.high) == (first, first + 1)
        assert (entry.default, entry.type) == (first + subindex - 1, UInt(16))
    assert (index, 3) not in held
    pdos = {e.index for e in drive.objects if first <= e.index < first + 0x200}
    assert pdos == {first, first + 1}


def test_set_up_in_preop_only(drive: Protocol) -> None:
    written = {0x1600, 0x1601, 0x1A00, 0x1A01, 0x1C12, 0x1C13}
    states = {e.states for e in drive.objects if e.index in written and e.access is Access.BOTH}
    assert states == {("PREOP",)}


def test_identity_is_that_of_the_description(drive: Protocol) -> None:
    held = entries(drive)
    rows = {row.path: row.value for row in drive.esi}
    values = [held[0x1018, subindex].default for subindex in (1, 2, 3)]
    assert values == [VENDOR, PRODUCT, REVISION]
    assert all(held[0x1018, subindex].constant for subindex in (1, 2, 3))
    paths = ("Vendor/Id", "Device/Type/@ProductCode", "Device/Type/@RevisionNo")
    assert [rows[path] for path in paths] == values


def test_the_described_pdo_is_what_the_drive_maps(drive: Protocol) -> None:
    held = entries(drive)
    rows = {row.path: row.value for row in drive.esi}
    pdo = rows["Device/RxPdo/Index"]
    assert pdo == held[0x1C12, 1].default
    channel = rows["Device/RxPdo/@Sm"]
    assert isinstance(channel, int)
    assert held[0x1C00, channel + 1].default == 3  # outputs
    assert isinstance(pdo, int)
    for number in (0, 1):
        parts = [rows[f"Device/RxPdo/Entry[{number}]/{n}"] for n in ("Index", "SubIndex", "BitLen")]
        index, subindex, bits = (part for part in parts if isinstance(part, int))
        assert held[pdo, number + 1].default == index << 16 | subindex << 8 | bits
        entry = held[index, subindex]
        assert entry.mappable
        signed = "SINT" if bits == 8 else "UINT"
        assert rows[f"Device/RxPdo/Entry[{number}]/DataType"] == signed
    assert held[pdo, 0].default == 2


def test_the_command_at_start_is_one_that_the_drive_takes(drive: Protocol) -> None:
    rows = {row.path: row.value for row in drive.esi}
    at = "Device/Mailbox/CoE/InitCmd[0]"
    entry = entries(drive)[rows[f"{at}/Index"], rows[f"{at}/SubIndex"]]  # type: ignore[index]
    assert entry.access is Access.BOTH
    assert not entry.states
    mode = int(str(rows[f"{at}/Data"]), 16)
    names = {r.value: r.name for r in drive.tables["operation_mode"].rows}
    assert names[mode] == "profile_velocity"
    assert rows[f"{at}/Transition"] == "PS"


# --- AL state machine -----------------------------------------------------------------------------


@pytest.mark.parametrize("target", [*STATES, "BOOT"])
@pytest.mark.parametrize("source", STATES)
def test_ways_between_states(model: Model, source: str, target: str) -> None:
    device = VirtualSubDevice(model.protocol)
    ready = (SetUpProcessData(),) if (source, target) == ("PREOP", "SAFEOP") else ()
    fed = way(model, "OP")[-2:-1] if (source, target) == ("SAFEOP", "OP") else ()
    play(model, device, (*way(model, source), *ready, *fed, to(model, target)))
    reached, error = shown(model, device)
    if source == target or (source, target) in WAYS:
        assert (reached, error) == (target, False)
    else:
        assert error
        assert reached == source or (source, reached) == ("OP", "SAFEOP")


def test_the_drive_keeps_its_state_without_outputs(model: Model) -> None:
    device = VirtualSubDevice(model.protocol)
    play(model, device, (*way(model, "OP"), StopOutputs(), Wait(60_000_000)))
    assert shown(model, device) == ("OP", False)


def test_there_is_no_synchronisation_to_lose(model: Model) -> None:
    device = VirtualSubDevice(model.protocol)
    play(model, device, (*way(model, "OP"), Happen("al.sync_lost")))
    assert shown(model, device) == ("OP", False)
    names = {rule.name for rule in model.protocol.machines["al"].rules}
    assert "sync_lost_in_op" not in names


@pytest.mark.parametrize(("way_gone", "reached"), [("kept", "OP"), ("down", "SAFEOP")])
def test_without_outputs_it_stays_or_goes_down(model: Model, way_gone: str, reached: str) -> None:
    state = VirtualSubDevice(model.protocol).state
    state = state.having(model.slots["al.state"], model.row("al_state", "OP"))
    state = state.having(model.slots["choice watchdog_expiry"], way_gone)
    (taken,) = step(model, state, Event("al", "watchdog", {}))
    assert taken.state.slots[model.slots["al.state"]] == model.row("al_state", reached)


# --- mailbox --------------------------------------------------------------------------------------


@pytest.fixture
def desk(model: Model) -> Desk:
    return Desk(model)


@pytest.mark.parametrize("kind", [0, 1, 2, 4, 5, 6, 14, 15])
def test_another_protocol_is_told_by_an_emergency(desk: Desk, kind: int) -> None:
    answer = desk.ask("mailbox", type=kind, payload=bytes(7))
    assert answer[0] == "emergency"
    assert desk.read(0x1C00)[1] == b"\x04"


@pytest.mark.parametrize("service", [0, 1, 3, 4, 5, 6, 7, 9, 15])
def test_an_unknown_service_is_told_by_an_emergency(desk: Desk, service: int) -> None:
    """PDOs by the mailbox among them."""
    answer = desk.ask("coe", service=service, body=bytes(8))
    assert answer[0] == "emergency"
    assert desk.read(0x1C00)[1] == b"\x04"


@pytest.mark.parametrize("choice", ["protocol_report", "service_report"])
def test_a_mailbox_error_is_an_answer_too(model: Model, choice: str) -> None:
    """ANOM-039: the drive may do as the standard says."""
    names = [alternative.name for alternative in model.protocol.choices[choice].alternatives]
    assert names[0] == "emergency"
    assert choice not in model.protocol.pins


def test_an_emergency_has_no_more_than_eight_bytes(model: Model) -> None:
    fields: dict[str, Value] = {"error_code": 0xFF00, "error_register": 1, "manufacturer": bytes(5)}
    data = model.codec.encode("emergency", fields)
    assert len(data) - model.codec.size("mailbox") - model.codec.size("coe") == 8


@pytest.mark.parametrize("size", [5, 8, 100])
def test_more_than_four_bytes_are_refused(desk: Desk, size: int) -> None:
    value = bytes(min(size, 100))
    fields: dict[str, Value] = {"index": 0x1600, "subindex": 1, "size": size, "value": value}
    answer = desk.ask("sdo_download_normal", **fields)
    assert (answer[0], answer[1]["code"]) == ("sdo_abort", 0x06070012)
    assert desk.read(0x1C00)[1] == b"\x04"


def test_four_bytes_can_come_in_any_form(desk: Desk) -> None:
    place: dict[str, Value] = {"index": 0x1A01, "subindex": 1}
    value = bytes.fromhex("10004160")
    whole = desk.ask("sdo_download_normal", **place, size=4, value=value)
    assert whole is not None
    assert whole[0] == "sdo_download_response"
    read = desk.ask("sdo_upload_request", **place)
    assert read is not None
    assert (read[0], read[1]["value"]) == ("sdo_upload_expedited", value)


def test_no_object_is_longer_than_four_bytes(drive: Protocol, model: Model) -> None:
    assert model.parameter("longest_transfer") == 4
    for entry in drive.objects:
        assert model.dictionary.entries[entry.index, entry.subindex] is entry
        assert getattr(entry.type, "width", 99) <= 32


@pytest.mark.parametrize("index", [*STRINGS, 0x60C4, 0x6089, 0x608E])
def test_objects_that_are_not_there(desk: Desk, index: int) -> None:
    for frame, more in (("sdo_upload_request", {}), ("sdo_download_expedited", {"value": b"\1"})):
        fields: dict[str, Value] = {"index": index, "subindex": 0, **more}
        answer = desk.ask(frame, **fields)
        assert (answer[0], answer[1]["code"]) == ("sdo_abort", 0x06020000)


@pytest.mark.parametrize(
    ("index", "rules"),
    [
        (0x1008, {"missing_upload"}),
        (0x60C4, {"missing_upload"}),
        (0x1009, {"missing_upload"}),
        (0x6089, {"missing_upload", "upload_undeclared"}),
        (0x2000, {"upload_undeclared"}),
    ],
)
def test_what_may_be_there_and_what_may_not(model: Model, index: int, rules: set[str]) -> None:
    """An object of the manual of CANopen may exist, a string may not; ANOM-053 is in between."""
    state = VirtualSubDevice(model.protocol).state
    state = state.having(model.slots["al.state"], model.row("al_state", "PREOP"))
    asked: dict[str, Value] = {"index": index, "subindex": 0, "complete": False}
    fired = {str(taken.rules[0]) for taken in step(model, state, Event("sdo", "read", asked))}
    kinds = {re.sub(r"_(refused|expedited|normal)$", "", name.partition(".")[2]) for name in fired}
    assert kinds == rules


@pytest.mark.parametrize(
    ("subindex", "value", "code"),
    [
        (0, b"\3", {0x06090030, 0x06090031, 0x06070010, 0x06040042}),
        (1, b"\2\x16", {0x06090030, 0x06090031, 0x06040041, 0x06020000}),
        (1, b"\0\x1a", {0x06090030, 0x06090031, 0x06040041, 0x06020000}),
        (2, b"\xff\x15", {0x06090030, 0x06090032, 0x06040041, 0x06020000}),
    ],
)
def test_ranges_of_the_assignment(desk: Desk, subindex: int, value: bytes, code: set[int]) -> None:
    clear: dict[str, Value] = {"index": 0x1C12, "subindex": 0, "value": b"\0"}
    cleared = desk.ask("sdo_download_expedited", **clear)
    assert cleared is not None
    assert cleared[0] == "sdo_download_response"
    place: dict[str, Value] = {"index": 0x1C12, "subindex": subindex, "value": value}
    answer = desk.ask("sdo_download_expedited", **place)
    assert answer[0] == "sdo_abort"
    assert answer[1]["code"] in code


def test_either_pdo_fits_either_place(desk: Desk) -> None:
    """ANOM-050: each entry takes the first or the second."""
    for index, subindex, value in (
        (0x1C12, 0, b"\0"),
        (0x1C12, 1, b"\1\x16"),
        (0x1C12, 2, b"\0\x16"),
        (0x1C12, 0, b"\2"),
    ):
        place: dict[str, Value] = {"index": index, "subindex": subindex, "value": value}
        answer = desk.ask("sdo_download_expedited", **place)
        assert answer[0] == "sdo_download_response", (index, subindex)


def test_the_fixed_address_is_zero_or_that_of_the_esc(model: Model) -> None:
    word = model.protocol.words["fixed_station_address"]
    ways = {"zero": 0, "mirror": 0x1001}
    register = model.slots["register station_address"]
    for name, value in ways.items():
        state = VirtualSubDevice(model.protocol).state.having(register, 0x1001)
        state = state.having(model.slots["al.state"], model.row("al_state", "PREOP"))
        state = state.having(model.slots["choice fixed_address"], name)
        asked: dict[str, Value] = {"index": 0x1100, "subindex": 0, "complete": False}
        outputs = [o for t in step(model, state, Event("sdo", "read", asked)) for o in t.outputs]
        told = [dict(o.fields)["value"] for o in outputs if o.frame == "sdo_upload_expedited"]
        assert told
        assert all(admits(each, value.to_bytes(word.size, "little")) for each in told)
        assert not any(admits(each, b"\2\x10") for each in told)


# --- a drive that goes the other ways -------------------------------------------------------------

OTHER_WAYS: Final = {
    "mailbox_loss": "down",
    "watchdog_expiry": "down",
    "protocol_report": "mailbox_error",
    "service_report": "of_the_standard",
    "segmented_download": "refused",
    "refused_in_op": "stay",
}
"""What the standard wants where the manual says something else or nothing."""
SOME_CASES: Final = (
    "mailbox/unknown_type/",
    "coe/unknown_service/",
    "process_data/watchdog",
    "process_data/disabled",
    "al/set_up/request_PREOP/disable",
)


def test_a_drive_that_does_as_the_standard_says_passes_too(model: Model, tmp_path: Path) -> None:
    text = TEXT.read_text(encoding="utf-8")
    for choice, way_taken in OTHER_WAYS.items():
        text = re.sub(rf"(?m)^open {choice} .*$", "", text)
        text += f"\npin {choice} = {way_taken} [DIS2-C79]\n"
    path = tmp_path / "metronix-other.ecs"
    path.write_text(text.replace("device metronix-dis2", "device metronix-other"), encoding="utf-8")
    description = make("metronix-dis2", {}).describe()
    adapter = VirtualAdapter(VirtualSubDevice(load_file(path)), description)
    judge = Runner(model, adapter, description)
    cases = [c for c in all_cases(model, NO_LIMITS, "quick") if c.name.startswith(SOME_CASES)]
    judge.run(cases, None, len(cases))
    assert {verdict.outcome for verdict in judge.verdicts} == {Outcome.PASS}
    shown_ways = {
        name: judge.known.choices.get(name) for name in ("mailbox_loss", "protocol_report")
    }
    assert shown_ways == {name: OTHER_WAYS[name] for name in shown_ways}


# --- faults ---------------------------------------------------------------------------------------


def test_the_faults_are_of_this_drive(drive: Protocol) -> None:
    faults = [f for f in load_faults().values() if Path(f.at.file).stem == "metronix_dis2"]
    assert len(faults) >= LEAST_FAULTS
    for fault in faults:
        assert set(fault.clauses) <= set(drive.clauses), fault.name
        assert set(fault.clauses) & set(own_clauses(drive)), fault.name


def test_a_mapping_longer_than_declared_is_not_known(model: Model) -> None:
    declared = max(sub for index, sub in entries(model.protocol) if index == 0x1600)
    counted = model.initial.keeping((0x1600, 0), bytes([declared + 1]))
    assigned = counted.keeping((0x1C12, 0), b"\1").keeping((0x1C12, 1), b"\x00\x16")
    environment = Environment(assigned.slots, assigned.objects, {})
    assert model.image.layout(environment, OUTPUTS) is None
