"""Tests of the planted faults: each is sound as a text, and a run finds it."""

from __future__ import annotations

import os
from collections import Counter, deque
from functools import cache
from typing import TYPE_CHECKING, Final

import pytest
from fault_suites import DEPTH, GROUNDS, LIKELY, REFERENCE, Ground, apart, ground_of, suite

from ecatspec.conformance.adapters.in_process import Guarded
from ecatspec.conformance.adapters.model import VirtualAdapter, described, make
from ecatspec.conformance.base.devices import going
from ecatspec.conformance.base.verdict import BLAMING, FOUND
from ecatspec.conformance.run.dut_knowledge import SHAPE
from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.vectors.export import Export, Wanted
from ecatspec.conformance.vectors.replay import Player
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.state import RuleName
from ecatspec.model.esc.subdevice import Quirk, VirtualSubDevice
from ecatspec.spec.language.ir import Fault
from ecatspec.spec.language.load import load_device, load_faults, plant
from ecatspec.spec.language.parse import parse_text

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.generators.cases.case import Case
    from ecatspec.generators.vectors.schema import Head

FAULTS = load_faults()
ORDER: Final = {name: number for number, name in enumerate(sorted(FAULTS))}
WHOLE: Final = bool(os.environ.get("ECATSPEC_WHOLE"))
"""Vectors of all faults are tried, not of each second one, as `make test` does for its time."""
COUNTED: Final = {"judged_with_count": "true"}
KNOWN: Final[Mapping[str, Mapping[str, str]]] = {
    "any_number_assigned": COUNTED,
    "missing_object_mapped": COUNTED,
    "missing_pdo_assigned": COUNTED,
    "other_direction_assigned": COUNTED,
    "read_only_mapped": COUNTED,
    "unmappable_mapped": COUNTED,
    "wrong_bits_mapped": COUNTED,
    "long_text_cut": {"size_judged_late": "true"},
}
"""What is known of devices that go another way first, which is allowed: their vectors say so too,
or they end there."""
BEYOND: Final = frozenset(
    {
        "assignment_while_counted",
        "code_kept",
        "code_kept_after_success",
        "code_kept_on_the_way",
        "default_lost",
        "every_value_refused",
        "fragments_not_counted",
        "inputs_in_preop",
        "missing_object_error_wrong",
        "upload_size_of_object",
    }
)
"""Faults that a run finds and vectors do not: they go an allowed way first, which nobody can know
before, and the test ends; or what they do would be right a moment later, as vectors wait for it; or
it only should be otherwise, of which vectors say nothing."""
LATER: Final = frozenset(
    {
        "complete_shows_write_only",
        "lost_clock_faults_idle_drive",
        "mailed_pdo_confirmed",
        "op_refused_as_request",
        "position_pdo_of_8_bytes",
        "process_data_watched_on",
        "upload_size_of_first_part",
    }
)
"""Faults whose clause is not among the first three of the first finding."""
SECOND: Final = frozenset(
    {
        "command_in_safeop",
        "complete_part_too_far",
        "connection_fault_missing",
        "emergency_with_more_data",
        "enabled_word_disables",
        "entry_access_of_any_state",
        "first_bytes_lost",
        "initiate_refused",
        "list_without_type",
        "mode_restarts",
        "op_left_unasked",
        "other_protocol_confirmed",
        "other_protocol_reported_twice",
        "pdo_by_mail_confirmed",
        "pdo_by_mail_taken",
        "refused_value_stored",
        "repeat_bits_differ_at_start",
        "return_to_switched_on",
        "row_5_for_row_11",
        "safeop_keeps_error",
        "segment_not_padded",
        "segments_not_stored",
        "service_erred_twice",
        "short_writes",
        "size_not_indicated",
        "subindex_ignored",
        "upper_bits_compared",
        "value_not_stored",
    }
)
"""Those of the others whose clause comes second or third."""
NEAR = 20
"""So many cases around the one that finds a fault in a run are tried as vectors."""
LEFT_OPEN = """
faults left_open "what a device may do where the texts leave it open: no mistake"

fault init_in_an_error "SyncManagers that were taken away count in an error too" [AL-20]
  replace rule al.mailbox_taken_away [AL-20]
    when   mailbox_wrong and mailbox_support == present
  replace rule al.process_data_taken_away [PD-14]
    when   outputs_wrong or inputs_wrong
"""


def test_there_are_faults_of_every_service() -> None:
    assert len(FAULTS) >= 230
    texts = {fault.at.file for fault in FAULTS.values()}
    for fault in FAULTS.values():
        clauses = load_device(ground_of(fault).device).clauses
        assert set(fault.clauses) <= set(clauses), fault.name
        assert any(clauses[name].level in {"must", "should"} for name in fault.clauses), fault.name
    assert len(texts) > 1


def test_of_most_faults_the_first_clauses_name_the_own() -> None:
    assert FAULTS.keys() >= LATER | SECOND
    assert LATER.isdisjoint(SECOND)
    assert len(LATER) <= len(FAULTS) // 50
    assert len(LATER | SECOND) <= len(FAULTS) // 10


def test_no_two_faults_are_one() -> None:
    grounds = {name: ground_of(fault).device for name, fault in FAULTS.items()}
    wordings = Counter((grounds[name], fault.wording) for name, fault in FAULTS.items())
    assert not [wording for wording, times in wordings.items() if times > 1]
    changes = [(grounds[name], f.quirk, f.changes) for name, f in FAULTS.items()]
    assert all(quirk or changed for _, quirk, changed in changes)
    assert all(changes.count(change) == 1 for change in changes)


def test_every_quirk_is_planted() -> None:
    assert {fault.quirk for fault in FAULTS.values()} == {None, *(quirk.value for quirk in Quirk)}


@pytest.mark.parametrize(
    "ground",
    [
        pytest.param(ground, id=name, marks=apart(ground))
        for name, ground in {"reference": REFERENCE, **GROUNDS}.items()
    ],
)
def test_the_sound_device_is_not_blamed(ground: Ground) -> None:
    made = suite(ground)
    assert made.cases
    assert not made.blamed


@pytest.mark.xdist_group("together")
def test_what_belongs_together_runs_in_one_process(request: pytest.FixtureRequest) -> None:
    # or the suite of each device is made in all of them
    if not getattr(request.config.option, "loadgroup", False):
        pytest.skip("the tests were not called with -n and --dist loadgroup")
    assert request.node.nodeid.endswith("@together")


def test_what_the_texts_leave_open_is_no_mistake() -> None:
    (other,) = (d for d in parse_text(LEFT_OPEN, "open").declarations if isinstance(d, Fault))
    sound = load_device("reference-drive")
    protocol = plant(sound, other)
    adapter = VirtualAdapter(VirtualSubDevice(protocol), described(protocol))
    runner = Runner(Model(sound), adapter, adapter.describe())
    cases = [c for c in all_cases(runner.model, NO_LIMITS, "default") if c.layer == "al"]
    assert sum(runner.executor.judge(case).outcome in BLAMING for case in cases) == 0
    assert RuleName("al", "mailbox_moved") in runner.known.rules


@cache
def exported(ground: Ground, known: tuple[tuple[str, str], ...]) -> tuple[Export, Head]:
    """Give what records the vectors of a ground for the ways that its virtual SubDevice goes."""
    protocol = load_device(ground.device)
    ways = {name: pin.alternative for name, pin in going(protocol, SHAPE).pins.items()}
    wanted = Wanted(ground.device, DEPTH, mailbox=ground.mailbox, choices=ways | dict(known))
    made = Export(wanted)
    made.configure()
    return made, made.head()


def blamed_by_vectors(ground: Ground, name: str, case: Case) -> bool:
    """Tell whether the case blames the device with a fault as a test vector too."""
    made, head = exported(ground, tuple(KNOWN.get(name, {}).items()))
    test = made.record(case)
    assert test is not None
    options = {"fault": name} | ({"mailbox": ground.mailbox} if ground.mailbox else {})
    adapter = Guarded(make(ground.device, options))
    player = Player(head, adapter, adapter.describe(), lambda symbol, _: symbol, configured=True)
    return player.judge(test).outcome in BLAMING


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=apart(ground_of(fault))) for name, fault in FAULTS.items()],
)
def test_a_run_and_its_vectors_find_the_fault(name: str) -> None:
    fault = FAULTS[name]
    made = suite(ground_of(fault))
    runner = made.runner({"fault": name})
    other: set[tuple[str, ...]] = set()
    near: deque[Case] = deque(maxlen=NEAR)
    found = 0
    cases = made.ordered(fault)
    assert cases[0].name.startswith(LIKELY.get(name, "")), "take it from the list"
    first = True
    for case in cases:
        verdict = runner.executor.judge(case)
        near.appendleft(case)
        if verdict.outcome in FOUND and first:
            first = False
            leads, *others = (clause in fault.clauses for clause in verdict.clauses[:3])
            assert (not leads and any(others)) == (name in SECOND), verdict.clauses
            assert (not leads and not any(others)) == (name in LATER), verdict.clauses
        if verdict.outcome in FOUND and not set(verdict.clauses) & set(fault.clauses):
            other.add(verdict.clauses)
        elif verdict.outcome in FOUND or found:
            found += 1
            if name in BEYOND:
                assert not blamed_by_vectors(made.ground, name, case), "take it from the list"
                return
            if not WHOLE and ORDER[name] % 2:
                return
            if any(blamed_by_vectors(made.ground, name, c) for c in near):
                return
            near.clear()
            assert found < NEAR, "a run finds the fault, and vectors of the same choices do not"
    pytest.fail(f"blamed for {sorted(other) or 'nothing'}, not for {fault.clauses}")
