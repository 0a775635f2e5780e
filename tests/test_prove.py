"""Tests of proofs: planted contradictions are refuted, in readable words."""

from __future__ import annotations

import json
import multiprocessing
from functools import cache
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("z3")

from ecatspec.conformance import cli
from ecatspec.conformance import prove as report
from ecatspec.conformance.cli import exit_status
from ecatspec.conformance.prove import details, proof_sheet, prove
from ecatspec.model.symbolic.obligations import WORDING, Finding, Kind, Status, obligations
from ecatspec.model.symbolic.proofs import Prover
from ecatspec.spec.language.load import load_device
from ecatspec.spec.language.merge import merge_standard
from ecatspec.spec.language.parse import parse_text

if TYPE_CHECKING:
    from ecatspec.conformance.prove import Proofs
    from ecatspec.spec.language.ir import Protocol

SMALL = """
standard small "as little as a model needs"

clause S-01 must "a clause for everything" source "nowhere"

table al_state u4 open
  1 INIT  "Init"
  2 PREOP "Pre-Operational"
  8 OP    "Operational"

table data_type u16 open
  5 unsigned8  "u8"
  6 unsigned16 "u16"

table object_code u8 open
  7 variable "variable"
  8 array    "array"
  9 record   "record"

table object_list_type u16 open
  0 lengths "how many"
  1 all     "all"

table mailbox_state u1 closed
  0 SERVING "serving"

parameter memory_size      : u32  = 0x2000             [S-01]
parameter first_rx_pdo     : u16  = 0x1600             [S-01]
parameter first_tx_pdo     : u16  = 0x1A00             [S-01]
parameter pdos_a_direction : u16  = 0x200              [S-01]
parameter mailbox_out      : area = area(0x1000, 128)  [S-01]

register al_control at 0x0120 size 2 main rw device ro reset 1 [S-01]
  bits 0..3 requested   : al_state
  bits 4    acknowledge : bool

register al_status at 0x0130 size 2 main ro device rw reset 1 [S-01]
  bits 0..3 state : al_state shows al.state

word output_assignment in 0x1C12 : 0 size 1 [S-01]
  bits 0..7 count : u8

word input_assignment in 0x1C13 : 0 size 1 [S-01]
  bits 0..7 count : u8

word pdo_entry size 4 [S-01]
  bits 0..7   bit_length : u8
  bits 8..15  subindex   : u8
  bits 16..31 index      : u16

frame mailbox [S-01]
  length  : u16
  kind    : u8
  payload : bytes(length)

machine mailbox "mailbox"
  states mailbox_state { SERVING } initial SERVING
  input  mail from frame mailbox

  rule mail_taken [S-01]
    from SERVING on mail

dictionary closed [S-01]
"""

AL = """
machine al "EtherCAT State Machine"
  states   al_state { INIT, PREOP, OP } initial INIT
  variable error : bool = false
  input    request from write al_control

  rule kept [S-01]
    from INIT, PREOP, OP on request
    when requested == state or error and not acknowledge

  rule up [S-01]
    from INIT on request
    when requested == PREOP and (not error or acknowledge)
    goto PREOP
    set  error = false

  rule on [S-01]
    from PREOP on request
    when requested == OP and (not error or acknowledge)
    goto OP
    set  error = false

  rule down [S-01]
    from PREOP, OP on request
    when requested == INIT and (not error or acknowledge)
    goto INIT
    set  error = false

  rule refused [S-01]
    from INIT, PREOP, OP on request
    when requested != state and (not error or acknowledge)
         and not (state == INIT and requested == PREOP or state == PREOP and requested == OP
                  or state != INIT and requested == INIT)
    set  error = true
"""

TOY = """
table toy_state u2 closed
  0 IDLE "idle"
  1 BUSY "busy"
  2 DONE "done"

machine toy "what contradictions are planted in"
  states   toy_state { IDLE, BUSY } initial IDLE
  variable count : u8 = 0
  input    poke local ()

  rule begin [S-01]
    from IDLE on poke
    goto BUSY

  rule finish [S-01]
    from BUSY on poke
    goto IDLE
"""

OVERLAP = AL.replace("when requested == PREOP and", "when requested in { PREOP, INIT } and")
GAP = AL.replace("or state != INIT and requested == INIT)", "or requested == 3)")
DEAD = (
    AL
    + "\n  rule never [S-01]\n    from OP on request\n    when requested == OP and not known_state"
)
DEAD += '\n\ndefine known_state "a state" = requested in { 1..15 }  [S-01]\n'
UNREACHED = (
    AL
    + TOY.replace("{ IDLE, BUSY }", "{ IDLE, BUSY, DONE }")
    + ("\n  rule rest [S-01]\n    from DONE on poke\n")
)
LATER = TOY.replace("goto BUSY", "goto BUSY\n    set  count = if count < 200 then count + 1 else 0")
BROKEN = (
    AL
    + TOY
    + (
        'property never_busy "the toy is never busy in PREOP" always\n'
        "  toy.state != BUSY or al.state != PREOP  [S-01]\n"
    )
)
BROKEN_LATER = (
    AL + LATER + ('property few "the toy begins at most twice" always toy.count < 2  [S-01]\n')
)
BOUNDED = (
    AL + LATER + ('property many "more than any search tries" always toy.count < 150  [S-01]\n')
)
SAME_WORD = (
    AL
    + TOY
    + (
        "word toy_word in 0x2000 : 0 size 1 [S-01]\n"
        "  bits 0 moving : bool shows toy.state == BUSY and al.state == OP\n"
    )
)
SAME_WORD = SAME_WORD.replace("toy.state == BUSY and al.state == OP", "toy.state in { IDLE, BUSY }")
FRAME = AL + (
    "frame inner in mailbox when kind = 3 [S-01]\n  command : u8\n  body : bytes\n"
    "frame odd in inner when command = 1, kind = 4 [S-01]\n  value : u8\n"
)
CHOICE = AL + ('choice useless "nothing depends on it" [S-01]\n  | one "this"\n  | other "that"\n')
AREAS = AL + "parameter mailbox_in : area = area(0x1040, 128) [S-01]\n"
BEYOND = AL + "parameter mailbox_in : area = area(0x1FF0, 128) [S-01]\n"
CHAINED = (
    AL.replace(
        "    goto OP\n    set  error = false\n",
        "    goto OP\n    set  error = false\n    give toy.poked(times = 9)\n",
    )
    + TOY.replace(
        "  input    poke local ()", "  input    poke local ()\n  input    poked(times: u8)"
    )
    + "\n  rule poked_little [S-01]\n    from IDLE, BUSY on poked\n    when times < 9\n"
)
LEFT_OUT = (
    AL
    + TOY.replace("goto BUSY", "goto BUSY\n    set  count = any")
    + ('property small "the count is small" always toy.count <= 200  [S-01]\n')
)

PLANTED = [
    (
        "overlapping guards",
        OVERLAP,
        Kind.DETERMINISM,
        "request",
        ["`kept` and `up` both fire in INIT"],
    ),
    ("a gap", GAP, Kind.COMPLETENESS, "request", ["no rule and no gap of `al`"]),
    ("a dead rule", DEAD, Kind.LIVE, "never", ["no state and no values make its guard true"]),
    ("an unreachable state", UNREACHED, Kind.STATE_REACHED, "DONE", ["leads to DONE from IDLE"]),
    ("a rule out of reach", UNREACHED, Kind.RULE_REACHED, "rest", ["leads to DONE"]),
    ("a broken property", BROKEN, Kind.PROPERTY, "never_busy", ["toy.state = 1 BUSY", "al.up"]),
    ("broken after several steps", BROKEN_LATER, Kind.PROPERTY, "few", ["toy.count = 2"]),
    ("broken by what is not said", LEFT_OUT, Kind.PROPERTY, "small", ["toy.begin"]),
    ("the same word", SAME_WORD, Kind.TOLD_APART, "states", ["IDLE and BUSY look the same"]),
    ("a frame against itself", FRAME, Kind.ROUND_TRIP, "odd", ["none of", "kind is 3"]),
    ("a choice without effect", CHOICE, Kind.CHOICE, "one", ["useless is one"]),
    ("overlapping areas", AREAS, Kind.MEMORY, "areas", ["mailbox_out (0x1000 to 0x107F)"]),
    ("an area beyond the memory", BEYOND, Kind.MEMORY, "areas", ["ends beyond the memory"]),
    (
        "an event that no rule takes",
        CHAINED,
        Kind.COMPLETENESS,
        "poked",
        ["after al.on", "times = 9"],
    ),
]


@cache
def texts(extra: str) -> Protocol:
    sources = [
        parse_text(SMALL, "small.ecs"),
        parse_text('standard extra "x"\n' + extra, "extra.ecs"),
    ]
    return merge_standard(sources)[0]


@cache
def findings(extra: str) -> tuple[Finding, ...]:
    return tuple(Prover(texts(extra)).findings())


def of(extra: str, kind: Kind, name: str) -> Finding:
    """The last one of that name: `toy` comes after the machines that all texts have."""
    return [f for f in findings(extra) if (f.obligation.kind, f.obligation.name) == (kind, name)][
        -1
    ]


@pytest.mark.parametrize(
    ("extra", "kind", "name", "words"),
    [row[1:] for row in PLANTED],
    ids=[row[0] for row in PLANTED],
)
def test_a_planted_contradiction_is_refuted(
    extra: str, kind: Kind, name: str, words: list[str]
) -> None:
    found = of(extra, kind, name)
    said = "\n".join(found.lines)
    if name == "small":
        # the interpreter does not know the count, so that it cannot say that it is too large
        assert found.status is Status.UNKNOWN, said
    else:
        assert found.status is Status.REFUTED, said
        assert all(at.file in {"small.ecs", "extra.ecs"} and at.line for at in found.places)
        assert found.places
    for word in words:
        assert word in said


def test_a_text_without_contradiction_has_nothing_refuted() -> None:
    found = findings(AL + TOY)
    assert [f for f in found if f.status is Status.REFUTED] == []
    assert of(AL + TOY, Kind.RULE_REACHED, "on").depth == 2
    assert of(AL + TOY, Kind.STATE_REACHED, "OP").status is Status.PROVED


def test_what_neither_induction_nor_the_search_decides_is_bounded() -> None:
    found = of(BOUNDED, Kind.PROPERTY, "many")
    assert found.status is Status.BOUNDED
    assert found.depth


def test_a_property_of_several_machines_is_proved_by_induction() -> None:
    extra = AL + TOY + 'property some "a state" always toy.state in { IDLE, BUSY } [S-01]\n'
    assert of(extra, Kind.PROPERTY, "some").status is Status.PROVED


def test_every_kind_of_obligation_says_what_it_asks() -> None:
    assert set(WORDING) == set(Kind)
    assert len({str(o) for o in obligations(texts(AL + TOY))}) == len(
        list(obligations(texts(AL + TOY)))
    )


# --- the shipped texts ----------------------------------------------------------------------------


@cache
def proved(device: str) -> Proofs:
    return prove(device, load_device(device))


@pytest.mark.parametrize("device", ["beckhoff-el6720", "reference-drive"])
def test_a_shipped_text_has_no_contradiction(device: str) -> None:
    refuted = {
        (t.finding.obligation.kind, t.finding.obligation.group, t.finding.obligation.name)
        for t in proved(device).timed
        if t.finding.status is Status.REFUTED
    }
    assert refuted == set()
    kinds = {t.finding.obligation.kind for t in proved(device).timed}
    assert {Kind.DETERMINISM, Kind.COMPLETENESS, Kind.PROPERTY, Kind.MEMORY} <= kinds
    laws = [t.finding for t in proved(device).timed if t.finding.obligation.kind is Kind.PROPERTY]
    assert {law.status for law in laws} == {Status.PROVED}


def test_the_standard_is_tried_with_objects_of_every_kind() -> None:
    samples = report.sample_objects()
    assert 10 < len(samples) < 120
    assert len({(entry.index, entry.subindex) for entry in samples}) == len(samples)


def test_the_report_has_a_line_for_every_machine_and_tells_what_is_refuted() -> None:
    found = report.Proofs("toy", tuple(report.Timed(f, 0.0) for f in findings(BROKEN)))
    sheet = proof_sheet(found)
    assert sum(row[3] for row in sheet.rows if isinstance(row[3], int)) == 1
    lines = list(details(found))
    assert "toy: refuted: properties of never_busy" in lines
    assert any(line.strip().startswith("at extra.ecs:") for line in lines)
    assert found.refuted
    assert not report.Proofs("toy", ()).refuted


# --- several at once ------------------------------------------------------------------------------


def several() -> dict[str, Protocol]:
    return {"one": texts(AL + TOY), "two": texts(BROKEN), "three": texts(AL)}


def ends(proofs: Proofs) -> list[tuple[str, Status]]:
    return [(str(t.finding.obligation), t.finding.status) for t in proofs.timed]


def test_several_at_once_are_proved_as_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(report, "_processors", lambda: 2)
    told: list[tuple[int, int, str]] = []
    found = list(report.prove_all(several(), lambda *what: told.append(what)))
    assert [proofs.device for proofs in found] == ["one", "two", "three"]
    alone = [prove(name, protocol) for name, protocol in several().items()]
    assert list(map(ends, found)) == list(map(ends, alone))
    assert [proofs.refuted for proofs in found] == [False, True, False]
    assert {total for _, total, _ in told} == {3}
    assert {what.partition(":")[0] for _, _, what in told} == {"one", "two", "three"}


def test_whoever_stops_ends_the_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "_processors", lambda: 2)
    before = set(multiprocessing.active_children())
    proofs = report.prove_all(several())
    next(proofs)
    assert set(multiprocessing.active_children()) - before
    proofs.close()  # type: ignore[attr-defined]
    assert not set(multiprocessing.active_children()) - before


def test_one_specification_needs_no_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "prove", lambda name, *_: report.Proofs(name, ()))
    assert [p.device for p in report.prove_all({"one": texts(AL)})] == ["one"]


def test_without_the_solver_no_worker_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "_processors", lambda: 2)
    monkeypatch.setattr(report, "find_spec", lambda _: None)
    with pytest.raises(ModuleNotFoundError) as refused:
        next(report.prove_all(several()))
    assert refused.value.name == "z3"


# --- the command ----------------------------------------------------------------------------------


def test_the_command_gives_status_and_data(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for extra, status in ((AL + TOY, exit_status.CONFORMS), (AREAS, exit_status.DOES_NOT_CONFORM)):
        timed = tuple(report.Timed(f, 0.25) for f in findings(extra))
        monkeypatch.setattr(
            report, "prove", lambda name, *_, timed=timed: report.Proofs(name, timed)
        )
        assert cli.main(["prove", "reference", "--json"]) == status
        data = json.loads(capsys.readouterr().out)
        assert data["schema"] == "ecatspec.prove"
        (device,) = data["devices"]
        assert {row["status"] for row in device["obligations"]} <= {s.value for s in Status}
        assert cli.main(["prove", "reference"]) == status
        assert ("refuted: memory areas" in capsys.readouterr().out) is (
            status != exit_status.CONFORMS
        )


def test_without_the_solver_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(*_: object) -> None:
        raise ModuleNotFoundError(name="z3")

    monkeypatch.setattr(report, "prove", missing)
    assert cli.main(["prove", "reference"]) == exit_status.WRONG_INPUT
    said = capsys.readouterr().err
    assert said == "ecatspec: proofs need the package z3-solver; install ecatspec[prove]\n"


def test_a_device_that_does_not_exist_is_wrong_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["prove", "nothing"]) == exit_status.WRONG_INPUT
    assert "nothing" in capsys.readouterr().err
