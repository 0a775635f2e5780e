"""Tests of comparing two specifications, and two devices."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

from ecatspec.conformance import cli
from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.diff import comparison
from ecatspec.conformance.diff import devices as diff_devices
from ecatspec.conformance.diff.behaviour import Grade, Sides, graded, product
from ecatspec.conformance.diff.comparison import Comparison, compare
from ecatspec.conformance.diff.devices import compare_devices
from ecatspec.conformance.diff.machines import (
    AL,
    DRIVE,
    Explored,
    ObservedDevice,
    Part,
    Seen,
    explored,
    setups,
)
from ecatspec.conformance.diff.page import page
from ecatspec.conformance.diff.report import as_data, headline, markdown, sections_of, sheets
from ecatspec.conformance.diff.subjects import subject
from ecatspec.conformance.diff.verify import vectors, verify
from ecatspec.generators.cases.case_codec import from_data
from ecatspec.generators.complete.machines import Setup
from ecatspec.generators.mutation.mutants import mutants
from ecatspec.generators.suite import all_cases
from ecatspec.model.analysis.as_built import as_built
from ecatspec.model.analysis.fact_diff import Effect, compare_facts, judged
from ecatspec.model.analysis.facts import TITLES, Fact, Kind, Section, facts
from ecatspec.model.automata.mealy import from_rows
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.values import Numbers
from ecatspec.spec.language.load import device_names, load_device, load_standard

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ecatspec.generators.cases.case import Case, Limits

AFAG, BECKHOFF, AKD, S300, DIS2 = (
    "afag-se-power",
    "beckhoff-el6720",
    "kollmorgen-akd",
    "kollmorgen-s300",
    "metronix-dis2",
)
PAIRS = tuple(combinations((AFAG, BECKHOFF, AKD, S300, DIS2), 2))
STANDARD = Model(load_standard())


@cache
def model(name: str) -> Model:
    return Model(load_device(name))


@cache
def compared(first: str, second: str) -> Comparison:
    return compare(load_device(first), load_device(second), workers=2)


def lines(found: Comparison) -> Iterator[str]:
    """Give all that a comparison says, a line each; the first letter tells of which kind it is."""
    for d in found.differences:
        yield f"F {d.section} {d.subject} | {d.values[0]} | {d.values[1]} {d.anomalies}"
    for b in found.behaviours:
        yield f"B {b.subject} | {b.answers[0]} | {b.answers[1]} {b.rules}"
    for s in found.silences:
        yield f"S {s.section} {s.subject} | {s.values[0]} | {s.values[1]}"
    for m in found.misprints:
        yield f"M {m.id} {m.subject} | {m.printed[0]} | {m.printed[1]}"


# --- facts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["standard", *device_names()])
def test_a_text_does_not_differ_from_itself(name: str) -> None:
    found = compare_facts(model(name), model(name), STANDARD)
    assert not found.differences
    assert not found.silences
    assert all(m.printed[0] == m.printed[1] for m in found.misprints)


@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_facts_are_the_same_from_either_side(pair: tuple[str, str]) -> None:
    one, other = (compare_facts(model(a), model(b), STANDARD) for a, b in (pair, pair[::-1]))
    assert {(d.section, d.subject, d.values, d.misprint) for d in one.differences} == {
        (d.section, d.subject, d.values[::-1], d.misprint) for d in other.differences
    }
    assert {(s.subject, s.values) for s in one.silences} == {
        (s.subject, s.values[::-1]) for s in other.silences
    }


def test_every_fact_has_a_section_with_a_title_and_clauses_that_exist() -> None:
    assert set(TITLES) == set(Section)
    for name in device_names():
        own = model(name)
        for fact in facts(own).values():
            assert set(fact.clauses) <= own.protocol.clauses.keys()


def a_fact(kind: Kind, **what: object) -> Fact:
    return replace(Fact(Section.OBJECTS, "x", "v", (), "x", kind), **what)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("one", "other", "effect"),
    [
        (a_fact(Kind.FIXED), a_fact(Kind.FIXED, value="w"), Effect.BREAKS),
        (a_fact(Kind.FIXED), None, Effect.BREAKS),
        (None, a_fact(Kind.FIXED), Effect.HARMLESS),
        (a_fact(Kind.ANSWER), None, Effect.HARMLESS),
        (None, a_fact(Kind.ANSWER), Effect.BREAKS),
        (a_fact(Kind.MORE, amount=64), a_fact(Kind.MORE, amount=72), Effect.HARMLESS),
        (a_fact(Kind.MORE, amount=72), a_fact(Kind.MORE, amount=64), Effect.BREAKS),
        (
            a_fact(Kind.MORE, members=frozenset("ab")),
            a_fact(Kind.MORE, members=frozenset("a")),
            Effect.BREAKS,
        ),
        (a_fact(Kind.LESS, amount=2), a_fact(Kind.LESS, amount=1), Effect.HARMLESS),
        (a_fact(Kind.LESS, amount=1), a_fact(Kind.LESS, amount=2), Effect.MAY),
        (a_fact(Kind.NOTE), None, Effect.MAY),
        (a_fact(Kind.NOTE), a_fact(Kind.NOTE, value="w"), Effect.MAY),
    ],
)
def test_a_difference_is_judged_by_what_it_binds(
    one: Fact | None, other: Fact | None, effect: Effect
) -> None:
    assert judged(one, other) is effect


# --- what devices do ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["reference", "reference-drive"])
def test_a_device_does_what_it_does(name: str) -> None:
    found = compare(load_device(name), load_device(name))
    assert not found.count
    assert all(not tried.differences for tried in found.tried)
    assert "no differences" in headline(found)
    assert "proved equal" in str(list(sheets(found)))


@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_every_witness_is_as_stated_on_both_devices(pair: tuple[str, str]) -> None:
    found = compared(*pair)
    assert found.behaviours
    assert verify(found) == ()


def test_a_wrong_witness_is_noticed() -> None:
    found = compared(AKD, S300)
    swapped = tuple(replace(b, seen=(b.seen[1], b.seen[0])) for b in found.behaviours)
    failures = verify(replace(found, behaviours=swapped))
    hard = [b for b in found.behaviours if not b.freer]
    assert len(failures) >= 2 * len(hard)


def test_a_wrong_rule_gives_the_differences_that_it_causes_and_no_others() -> None:
    sound = as_built(load_device("reference-drive"))
    chosen = [m for m in mutants(sound) if m.place.startswith(("al.", "ds402."))]
    right = ObservedDevice(sound)
    plans = setups(right.model)
    own = {n: explored(right, plans[n], plans[n].alphabet, {}) for n in (AL, DRIVE)}
    shown = 0
    for mutant in chosen[::97]:
        assert not compare_facts(Model(sound), Model(mutant.protocol), STANDARD).differences
        wrong = ObservedDevice(mutant.protocol)
        sides = Sides((right, wrong), ({}, {}))
        name = AL if mutant.place.startswith("al.") else DRIVE
        pair = (own[name], explored(wrong, setups(wrong.model)[name], plans[name].alphabet, {}))
        for behaviour in sides.behaviours(pair, product(*pair), set()):
            shown += 1
            fired = {*behaviour.roots[0], *behaviour.roots[1]}
            assert mutant.place in fired, f"{mutant}: {behaviour.subject}"
            assert fired == {mutant.place}, f"{mutant}: {behaviour.subject}"
    assert shown > 5


def test_answers_from_the_other_side_are_the_same_differences() -> None:
    one, other = compared(AFAG, DIS2), compared(DIS2, AFAG)
    assert {(b.machine, b.inputs, b.answers) for b in one.behaviours} == {
        (b.machine, b.inputs, b.answers[::-1]) for b in other.behaviours
    }


def seen(*values: object) -> Seen:
    return Seen(tuple(Part(str(n), v, "") for n, v in enumerate(values)), ())  # type: ignore[arg-type]


def test_answers_go_together_where_one_is_allowed_on_both_sides() -> None:
    some, few = Numbers(((1, 1), (3, 3))), Numbers(((3, 4),))
    assert graded(seen(1), seen(1)) == (Grade.SAME, ())
    assert graded(seen(1), seen(2)) == (Grade.OTHER, ("0",))
    assert graded(seen(some), seen(3)) == (Grade.FREER, ("0",))
    assert graded(seen(3), seen(some)) == (Grade.FREER, ("0",))
    assert graded(seen(some), seen(2)) == (Grade.OTHER, ("0",))
    assert graded(seen(some), seen(few)) == (Grade.FREER, ("0",))
    assert graded(seen(some, 1), seen(few, 2)) == (Grade.OTHER, ("0", "1"))
    # a part of one side only is not compared, but for a whole answer
    assert graded(seen(1), seen(1, 2)) == (Grade.SAME, ())
    answer = Seen((Part("answer 0", "sdo_abort", ""),), ())
    assert graded(answer, Seen((), ()))[0] is Grade.OTHER


def tiny(*outputs: str) -> Explored:
    """Give a machine of one input that answers these in turn, the last one for ever."""
    last = len(outputs) - 1
    rows = [[(str(min(n + 1, last)), output)] for n, output in enumerate(outputs)]
    machine = from_rows(rows, ("x",), [str(n) for n in range(len(outputs))])
    return Explored(Setup("AL", (), {"x": ()}, ()), machine, {o: seen(int(o)) for o in outputs})


def test_behind_another_answer_nothing_is_looked_at() -> None:
    found = product(tiny("1", "2", "3"), tiny("1", "8", "9"))
    assert [met.word for met in found.met] == [(0, 0)]
    assert found.pairs == 2
    assert not product(tiny("1", "2"), tiny("1", "2", "2")).met


# --- the devices ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wanted",
    [
        # 0x0017 where the AKD says so and the S300 says nothing, and the other way round
        r"B request_PREOP \| INIT, error, code 0x0017 .* \| .* 0x0011 .* or 0x0017",
        r"B .*request_SAFEOP then request_OP \| .* 0x0011 .* or 0x0017 .* \| .* 0x0017 [a-z_]* ",
        r"F anomalies ANOM-017: .*INIT to PREOP and PREOP to .* \| .*SAFEOP and SAFEOP to OP",
        r"F codes al_status_code 0x001A \| \(not there\) \| synchronisation_error",
        r"B .* sync_lost \| OP \| SAFEOP, error, code 0x001A",
        r"F anomalies ANOM-021: bootstrap",
        r"B set_up_mailbox then request_BOOT \| BOOT \| INIT",
        r"F anomalies ANOM-089: control_word \| commands are levels.* \| .*edges",
        r"B shutdown then enable_operation \| OP, drive OPERATION_ENABLED \| OP, drive SWITCHED_ON",
        r"F memory process_data_in length \| 64 bytes \| 72 bytes",
        *(rf"F memory interrupt_enable bit {bit} " for bit in range(2, 6)),
        r"M ANOM-001 al_event_request \| .*0x201.* \| .*0x201",
    ],
)
def test_akd_against_s300(wanted: str) -> None:
    assert any(re.match(wanted, line) for line in lines(compared(AKD, S300))), wanted


def test_the_first_control_words_that_tell_edges_from_levels_are_short() -> None:
    found = [b for b in compared(AKD, S300).behaviours if b.machine == DRIVE]
    words = next(b for b in found if b.inputs == ("shutdown", "enable_operation"))
    assert words.effect is Effect.BREAKS
    assert "AKD-C120" in words.clauses[0]
    assert "S300-C72" in words.clauses[1]


@pytest.mark.parametrize(
    "wanted",
    [
        # an example of the S300, an object that may exist, a choice and a default of the standard
        "S pdos receive PDOs",
        "S objects 0x6060:00",
        "S services bootstrap",
        "S times synchronisation_time",
        "S esi description file",
    ],
)
def test_what_one_manual_does_not_say_is_no_difference(wanted: str) -> None:
    every = list(lines(compared(AKD, S300)))
    assert any(line.startswith(wanted) for line in every)
    assert not any(line.startswith(f"F{wanted[1:]}") for line in every)


def test_an_answer_is_judged_for_a_main_device_that_knows_the_first() -> None:
    found = {b.inputs: b for b in compared(AKD, S300).behaviours}
    assert found["request_BOOT",].effect is Effect.HARMLESS  # refused by one, taken by the other
    entered = found["set_up_mailbox", "request_BOOT"]
    assert entered.effect is Effect.MAY
    assert entered.depends == ("condition reset_shown_as_boot",)
    refused = found["request_PREOP",]
    assert (refused.effect, refused.freer) == (Effect.MAY, True)
    lost = next(b for inputs, b in found.items() if inputs[-1] == "sync_lost")
    assert lost.effect is Effect.BREAKS
    assert not lost.depends


def test_what_rests_on_the_reading_of_a_misprint_is_told_apart() -> None:
    found = {d.subject: d for d in compared(AKD, S300).differences}
    assert found["interrupt_enable bit 3"].misprint
    assert not found["interrupt_enable bit 2"].misprint
    assert not found["process_data_in length"].misprint


@pytest.mark.parametrize(
    "wanted",
    [
        r"F pdos receive PDOs \| 4: .* \| 2: ",
        r"F pdos transmit PDOs \| 4: .* \| 2: ",
        r"F pdos 0x1C12:00 default \| 0 \| 2",
        r"F pdos 0x1C12:00 range \| 0..4 \| 0..2",
        r"F anomalies ANOM-054: .*0x60C4.*0x60C4",
        r"F anomalies ANOM-100: .*distributed clocks.* \| no distributed clocks",
        r"F errors drive_error 0x0620 \| bus_error \| \(not there\)",
        r"F errors drive_error 0x0025 \| \(not there\) \| ethercat_bus",
    ],
)
def test_se_power_against_dis2(wanted: str) -> None:
    assert any(re.match(wanted, line) for line in lines(compared(AFAG, DIS2))), wanted


UNSEEN = "it does not show in the protocol"
INSIDE = "what the device switches inside itself shows in no register and no state"
ALIKE = "both texts say the same of it"
ROWS: dict[str, str | tuple[str, str, str]] = {
    "firmware": UNSEEN,
    "ESC": UNSEEN,
    "EtherCAT hardware": UNSEEN,
    "Interrupt enable 0x0204 (2 B)": (AFAG, DIS2, "S memory register interrupt_enable"),
    "0x0204 bit 2": (AKD, S300, "F memory interrupt_enable bit 2"),
    "0x0204 bit 3": (AKD, S300, "F memory interrupt_enable bit 3"),
    "0x0204 bit 4": (AKD, S300, "F memory interrupt_enable bit 4"),
    "0x0204 bit 5": (AKD, S300, "F memory interrupt_enable bit 5"),
    "0x0220 bit 1": (AKD, S300, "M ANOM-003 al_event_request"),
    "0x0220 bit 2": "both texts confirm the register of the standard: its bits are not judged",
    "0x0220 bits 3, 4, 5": "both texts confirm the register of the standard: as bit 2",
    "SM register blocks": (AKD, DIS2, "F anomalies ANOM-010"),
    "FMMU count": (AFAG, DIS2, "S memory register esc_fmmus"),
    "process input buffer (SM3)": (AKD, S300, "F memory process_data_in length"),
    "event handling model": (AKD, S300, "F anomalies ANOM-014"),
    "EEPROM emulation": (AKD, S300, "F memory interrupt_enable bit 5"),
    "SM length mismatch": (AFAG, AKD, "PREOP, error, code 0x0017"),
    "Safe-Op": INSIDE,
    "Op": INSIDE,
    "Boot": (AFAG, S300, "F services bootstrap"),
    "slave-initiated change": (AFAG, S300, "sync_lost | OP | SAFEOP, error, code 0x001A"),
    "IP (0x02)": INSIDE,
    "PS (0x04)": (AFAG, AKD, "then request_SAFEOP | SAFEOP | PREOP, error"),
    "SP (0x02)": INSIDE,
    "SO (0x08)": (AKD, S300, "al.safeop_to_op_refused"),
    "OS (0x04)": INSIDE,
    "OP (0x02)": INSIDE,
    "SI (0x01)": INSIDE,
    "OI (0x01)": INSIDE,
    "IB (0x03)": (AKD, S300, "request_BOOT | BOOT | INIT"),
    "BI": (AKD, S300, "F al al.restarted"),
    "allowed set": (AFAG, S300, "al.bootstrap_refused"),
    "list closed": (AFAG, AKD, "S codes table al_status_code"),
    "0x0017": (AKD, S300, "F anomalies ANOM-017"),
    "0x001A": (AKD, S300, "F codes al_status_code 0x001A"),
    "protocols": (AFAG, AKD, "F services mailbox_type 0x1"),
    "non-CoE request": ALIKE,
    "CoE types": (AFAG, AKD, "F services coe_service 0x4"),
    "SDO services": "the manual of the AKD says nothing of segments: its text leaves them open",
    "size limit": (AFAG, BECKHOFF, "F anomalies ANOM-041"),
    "0x1008, 0x1009, 0x100A": "the EL6720 has them as examples; both drives lack them",
    "0x1600..": (AFAG, DIS2, "F pdos receive PDOs"),
    "0x1A00..": (AFAG, DIS2, "F pdos transmit PDOs"),
    "0x1C12:00": (AFAG, DIS2, "F pdos 0x1C12:00 default"),
    "0x1C12 subs": (AFAG, DIS2, "F anomalies ANOM-050"),
    "0x1C13:00": (AFAG, DIS2, "F pdos 0x1C13:00 default"),
    "0x1C13 subs": (AFAG, DIS2, "F anomalies ANOM-050"),
    "effect of 0x1C12/0x1C13": (AFAG, DIS2, "M ANOM-051"),
    "0x6089-0x608E": (AFAG, DIS2, "S objects 0x6089:00"),
    "0x60C4": (AFAG, DIS2, "F anomalies ANOM-054"),
    "cyclic objects": (AKD, DIS2, "S objects 0x60C1:01"),
    "count Rx / Tx": (AFAG, DIS2, "F pdos receive PDOs | 4"),
    "fixed RxPDOs": (AKD, DIS2, "0x1701"),
    "fixed TxPDOs": (AKD, DIS2, "0x1B01"),
    "default": (AFAG, DIS2, "F pdos 0x1C12:00 default"),
    "limit": (AKD, S300, "F memory process_data_in length"),
    "mapping source": UNSEEN,
    "PDO via mailbox": (AFAG, AKD, "F services coe_service 0x5"),
    "InitCmd example": (AFAG, AKD, "S esi Device/Mailbox/CoE/InitCmd[0]"),
    "CoE attributes in ESI": "the AKD has a box to be ticked in a tool, and no attribute of a file",
    "distributed clocks": (AFAG, DIS2, "F anomalies ANOM-100"),
    "sync without DC": INSIDE,
    "sync required for Op": (AKD, S300, "S times synchronisation_time"),
    "supervision": (AKD, S300, "sync_lost | OP | SAFEOP, error, code 0x001A"),
    "transmission type SYNC": (AFAG, DIS2, "F anomalies ANOM-100"),
    "cycle time": INSIDE,
    "cycle setting": (AKD, S300, "S objects 0x60C2:01"),
    "sync enable": UNSEEN,
    "trigger type": (AKD, S300, "F anomalies ANOM-089"),
    "CW evaluated in": (S300, DIS2, "S services drive_coupling"),
    "shutdown 2, 6, 8": (AKD, S300, "ds402.row_6"),
    "switch on 3": (AKD, S300, "B shutdown then enable_operation"),
    "enable operation 4": (AKD, S300, "ds402.enable_operation_4"),
    "disable operation 5": "in operation enabled bit 3 is 1, so that leaving it is a falling edge",
    "disable voltage 7, 9, 10, 12": (AKD, S300, "ds402.disable_voltage_7"),
    "quick stop 11": (AKD, S300, "ds402.quick_stop_11_stays"),
    "fault reset 15": "the text of the AKD reads its level as an edge, by ANOM-091",
    "automatic 0, 1, 13, 14": (AKD, S300, "M ANOM-088"),
    "CW bits 11, 12": (AKD, S300, "F ds402 control_word bit 11"),
    "SW bit 4 / 7 / 9 / 10 / 11": (AKD, S300, "S ds402 status_word bit 9"),
    "bus error": (AFAG, DIS2, "F errors drive_error 0x0620"),
    "ESC missing": (AFAG, DIS2, "F errors drive_error 0x0621"),
    "protocol not CoE": (AFAG, DIS2, "F errors drive_error 0x0622"),
    "SM2 / SM3 length": (AFAG, DIS2, "F errors drive_error 0x0623"),
    "sync error": (AKD, S300, "sync_lost | OP | SAFEOP, error, code 0x001A"),
    "bus data error": (AFAG, DIS2, "F errors drive_error 0x0631"),
    "clear fault": "another fault for want of a restart shows on the drive only",
    "watchdog": "one manual has its default, the other a lamp",
    "RUN LED": UNSEEN,
    "ERR LED": UNSEEN,
    "link LED": UNSEEN,
    "ports": UNSEEN,
    "node / alias address": (AFAG, DIS2, "F anomalies ANOM-109"),
    "firmware update": (AFAG, AKD, "F anomalies ANOM-021"),
    "fieldbus selection": UNSEEN,
    "parameter persistence": (AKD, S300, "F ds402 control_word bit 12"),
}
"""Where each row of the evidence that is a true difference is found, or why it cannot be."""


def test_every_true_difference_of_the_evidence_is_found(shared: Path) -> None:
    text = (shared / "evidence" / "device-comparison.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    topics = [re.sub(r"( ANOM-\d+)+$", "", row[0]) for row in rows if "DIFF" in row[-1:][0]]
    topics = [topic for topic in topics if not topic.startswith("A blank cell")]
    assert set(topics) == set(ROWS)
    lost = []
    for topic, where in ROWS.items():
        if isinstance(where, tuple):
            first, second, words = where
            if not any(words in line for line in lines(compared(first, second))):
                lost.append(topic)
    assert not lost


# --- reports, vectors, subjects -------------------------------------------------------------------


def test_a_report_has_all_differences_in_every_form() -> None:
    found = compared(AKD, S300)
    data = json.loads(json.dumps(as_data(found)))
    assert len(data["facts"]) == len(found.differences)
    assert len(data["answers"]) == len(found.behaviours)
    assert all(c["source"] for a in data["answers"] for side in a["clauses"] for c in side)
    words = markdown(found)
    html = page(found)
    for behaviour in found.behaviours:
        assert behaviour.inputs[-1] in words.replace("\\", "")
    assert html.count("<details>") == len(found.behaviours)
    assert html.count('class="ecs"') == 4
    assert 'class="odd"' in html
    assert not re.search(r"https?://(?!www\.w3\.org)|<script|src=|url\(", html)


def test_markup_of_a_text_does_not_become_markup_of_the_page() -> None:
    found = compared(AKD, S300)
    odd = replace(found, names=("<b>", "a & b"))
    assert "<b>" not in page(odd)
    assert "\\<b\\>" in markdown(odd)


def test_vectors_are_the_cases_again() -> None:
    found = compared(AKD, S300)
    data = json.loads(vectors(found))
    assert [d["name"] for d in data["devices"]] == [AKD, S300]
    for test, behaviour in zip(data["tests"], found.behaviours, strict=True):
        for side in (0, 1):
            assert from_data(test["sides"][side]["case"]) == behaviour.cases[side]
            assert test["sides"][side]["expected"]


def test_sections_can_be_chosen() -> None:
    found = compared(AKD, S300).only(sections_of(["codes"]))
    assert {d.subject for d in found.differences} == {"al_status_code 0x001A"}
    assert not found.behaviours
    with pytest.raises(UserError, match="did you mean 'codes'"):
        sections_of(["code"])


def test_a_text_of_a_revision_is_taken_from_git(tmp_path: Path) -> None:
    def git(*words: str) -> None:
        who = ("-c", "user.name=n", "-c", "user.email=e@example.org")
        subprocess.run(["git", *who, *words], cwd=tmp_path, check=True, capture_output=True)

    file = tmp_path / "mine.ecs"
    git("init")
    for number in (2, 3):
        parameter = f"parameter mailbox_out = area(0x1000, {number * 128})"
        clause = 'clause X-1 must "x" source "x"'
        file.write_text(f'device mine extends standard "x"\n{clause}\n{parameter} [X-1]\n')
        git("add", ".")
        git("commit", "-m", "x")
    old, new = subject(f"{file}@HEAD~1"), subject(f"{file}@HEAD")
    assert new.parameters == subject(str(file)).parameters
    found = compare_facts(Model(old), Model(new), STANDARD)
    told = [(d.subject, d.values) for d in found.differences]
    assert told == [("mailbox_out length", ("256 bytes", "384 bytes"))]
    with pytest.raises(UserError, match="git has no"):
        subject(f"{file}@nowhere")
    with pytest.raises(UserError, match="names no revision"):
        subject(f"{file}@--output=x")
    with pytest.raises(UserError, match="git has no"):
        subject(f"{tmp_path}/other.ecs@HEAD")


def test_two_devices_are_told_apart_by_the_same_stimuli(monkeypatch: pytest.MonkeyPatch) -> None:
    def some(own: Model, limits: Limits, depth: str) -> Iterator[Case]:
        every = all_cases(own, limits, depth)
        return (case for case in every if case.name.startswith("sdo/transfer/"))

    monkeypatch.setattr(diff_devices, "all_cases", some)
    assert not compare_devices("reference", ("model", "model")).differences
    found = compare_devices("reference", ("model", "model:fault=toggle_ignored"))
    assert not found.left_out
    assert found.differences
    shortest = found.differences[0]
    assert shortest.answers[0] != shortest.answers[1]
    assert shortest.stimuli
    assert len(found.sheets()[0].rows) == len(found.differences)
    assert shortest.case in found.markdown()


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> object:
    monkeypatch.setattr("ecatspec.conformance.diff.command.compare", fast)

    def run(*words: str) -> tuple[int, str, str]:
        status = cli.main(words)
        told = capsys.readouterr()
        return status, told.out, told.err

    return run


def fast(*arguments: object, **_: object) -> Comparison:
    first, second = (str(getattr(each, "name", each)) for each in arguments[:2])
    return compared(first, second)


def test_the_command_tells_differences_by_its_status(call: object, tmp_path: Path) -> None:
    assert callable(call)
    vectors_file, page_file = tmp_path / "v.json", tmp_path / "p.html"
    status, out, err = call(
        *("diff", AKD, S300, "--verify", "--export", str(vectors_file), "--html", str(page_file))
    )
    assert (status, err) == (1, "")
    assert out.startswith(f"{AKD} against {S300}: ")
    assert "replayed on both: as stated" in out
    assert json.loads(vectors_file.read_text())["tests"]
    assert page_file.read_text().startswith("<!doctype html>")
    status, out, _ = call("diff", AKD, S300, "--json", "--section", "codes")
    assert (status, len(json.loads(out)["facts"])) == (1, 1)
    assert call("diff", AKD, S300, "--section", "esi")[0] == 0
    assert call("diff", AKD, S300, "--markdown")[1].startswith("# ")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([AKD], "two are compared"),
        ([AKD, "kollmorgen-s30"], "did you mean"),
        ([AKD, S300, "--section", "x"], "no section"),
        ([AKD, S300, "--html", "/nowhere/x"], "cannot be written"),
        ([AKD, "--dut", "model"], "two devices"),
        ([AKD, S300, "--dut", "model", "--dut", "model"], "two devices"),
        ([AKD, "--dut", "model", "--dut", "model", "--verify"], "leave it out"),
        ([AKD, "--dut", "model", "--dut", "nothing"], "unknown adapter"),
    ],
)
def test_wrong_input_is_one_line(call: object, words: list[str], said: str) -> None:
    assert callable(call)
    status, out, err = call("diff", *words)
    assert (status, out) == (2, "")
    assert said in err
    assert err.count("\n") == 1


def test_the_help_has_an_example() -> None:
    assert "ecatspec diff" in CliRunner().invoke(cli.cli, ["diff", "--help"]).output


def test_walks_of_an_earlier_start_are_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    walked: list[str] = []

    def counted(device: ObservedDevice, setup: Setup, *more: Any) -> Explored:  # noqa: ANN401  passed on
        walked.append(setup.name)
        return explored(device, setup, *more)

    monkeypatch.setattr(comparison, "explored", counted)
    pair = load_device(AFAG), load_device(BECKHOFF)
    plain = compare(*pair)
    machines = len(walked)
    assert [compare(*pair, keeps=True) for _ in range(2)] == [plain] * 2
    assert len(walked) == 2 * machines
    # an answer is for these texts, these inputs and these choices alone
    compare(replace(pair[0], digest="another"), pair[1], keeps=True)
    assert len(walked) == 2 * machines + machines // 2
