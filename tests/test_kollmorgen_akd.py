"""The only place for tests of the text of the Kollmorgen AKD: its evidence and what it declares."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ecatspec.spec.language.ir import Access, Literal, Name, OneOf, Protocol, UInt
from ecatspec.spec.language.load import load_device

TEXT = Path(__file__).resolve().parent.parent / "spec" / "devices" / "kollmorgen-akd.ecs"
CLAUSES, OBJECTS, ANOMALIES = 146, 144, 58


@pytest.fixture(scope="module")
def akd() -> Protocol:
    return load_device("kollmorgen-akd")


def ids_in(path: Path, pattern: str) -> set[str]:
    """All that the pattern's group finds at the beginning of lines."""
    return set(re.findall(pattern, path.read_text(encoding="utf-8"), re.MULTILINE))


def own_clauses(protocol: Protocol) -> set[str]:
    return {name for name in protocol.clauses if name.startswith("AKD-C")}


def test_every_claim_is_a_claim_on_this_drive(akd: Protocol, shared: Path) -> None:
    known = ids_in(shared / "evidence" / "claims.yaml", r"^- id: (AKD-\d{3})$")
    cited = {claim for clause in akd.clauses.values() for claim in clause.claims}
    assert cited
    assert cited <= known


def test_every_clause_of_the_drive_names_a_claim_and_lines(akd: Protocol) -> None:
    for name in own_clauses(akd):
        clause = akd.clauses[name]
        assert clause.claims, name
        assert re.search(r"lines? \d+", clause.source), name


def test_the_cited_lines_are_in_the_manual(akd: Protocol, shared: Path) -> None:
    (manual,) = akd.manuals
    lines = (shared / "manuals" / manual.file).read_text(encoding="utf-8").count("\n")
    for name in own_clauses(akd):
        part = re.sub(r"sections? [\d.-]+", "", akd.clauses[name].source)
        numbers = [int(number) for number in re.findall(r"(?<!ANOM-)\b\d{3,}", part)]
        assert numbers, name
        assert max(numbers) <= lines, name


def test_every_anomaly_is_filed(akd: Protocol, shared: Path) -> None:
    file = shared / "evidence" / "anomalies.md"
    concerned = ids_in(file, r"^\| (ANOM-\d{3}) \| \w \| (?:[^|]*\bAKD\b[^|]*|all) \|")
    assert {anomaly.id for anomaly in akd.anomalies} <= concerned


def test_every_clause_is_used() -> None:
    text = TEXT.read_text(encoding="utf-8")
    declared = set(re.findall(r"^clause (AKD-C\d+)", text, re.MULTILINE))
    statements = re.sub(r"^clause .*$", "", text, flags=re.MULTILINE)
    assert set(re.findall(r"AKD-C\d+", statements)) == declared


def test_golden_counts(akd: Protocol) -> None:
    found = len(own_clauses(akd)), len(akd.objects), len(akd.anomalies)
    assert found == (CLAUSES, OBJECTS, ANOMALIES)


def test_mailbox_areas(akd: Protocol) -> None:
    def area(name: str) -> list[int | bool]:
        return [part.value for part in akd.parameters[name].value if isinstance(part, Literal)]

    assert area("mailbox_out") == [0x1800, 512]
    assert area("mailbox_in") == [0x1C00, 512]


def test_pins(akd: Protocol) -> None:
    assert {name: pin.alternative for name, pin in akd.pins.items()} == {
        "emulation": "none",
        "enabled_in_one": "goes_on",
        "identification_support": "unanswered",
        "mailbox_support": "present",
        "process_data_address": "refuse",
        "refused_in_op": "stay",
        "return_from_quick_stop": "served",
        "upload_form": "expedited",
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


def test_all_claims_on_the_drive_are_carried(akd: Protocol) -> None:
    cited = {claim for clause in akd.clauses.values() for claim in clause.claims}
    assert {f"AKD-{number:03}" for number in range(27, 470)} <= cited


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
    (rule,) = (r for r in akd.machines["al"].rules if r.input == "sync_lost" and "OP" in r.sources)
    assert (rule.target, rule.updates) == (None, ())
    faults = {r.target for r in akd.machines["ds402"].rules if r.name == "fault_125"}
    assert faults == {"FAULT_REACTION_ACTIVE"}


def test_remote_is_always_set_where_the_word_is_valid(akd: Protocol) -> None:
    (remote,) = (field for field in akd.words["status_word"].fields if field.name == "remote")
    assert remote.low == remote.high == 9
    assert remote.shows is not None
    assert remote.shows.value == Literal(True)  # noqa: FBT003
    assert remote.shows.condition == Name("status_valid")
