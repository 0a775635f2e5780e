"""Tests of boundary vectors: they decide, agree with trying, and kill."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, ClassVar

import pytest
from seeds import printed_twice

pytest.importorskip("z3")

from ecatspec.conformance.adapters.model import SnapshotAdapter, described, make
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.bringup import way_to
from ecatspec.generators.cases.case import NO_LIMITS, Probe, SendFrame
from ecatspec.generators.cases.play import play
from ecatspec.generators.covers.boundary_cover import BoundaryCases, boundary_cases, boundary_cover
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.interpreter import step
from ecatspec.model.core.state import Event
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.symbolic import boundary_values
from ecatspec.model.symbolic.boundary_values import Boundaries, Boundary
from ecatspec.model.symbolic.guard_atoms import Side
from ecatspec.spec.language.ir import Binary
from ecatspec.spec.language.load import load_device
from ecatspec.spec.language.nodes import parts_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.spec.language.ir import Expression, Protocol, Range

pytestmark = pytest.mark.xdist_group("boundaries")
"""The solver finds the boundaries once, in one process."""
DEVICE = "reference-drive"
SMALL = ("al", "coe", "mailbox")
OFF_BY_ONE = [
    ("complete_here", "<=", "<"),
    ("odd_segment", "<", "<="),
    ("outputs_wrong", "!=", "<"),
    ("outputs_wrong", "!=", ">"),
    ("inputs_wrong", "!=", "<"),
    ("fresh", "!=", ">"),
]
"""A definition, the comparison of it that a device has wrong, and how."""
FAULTS = [
    "complete_from_two",
    "complete_from_two_written",
    "too_short_unanswered",
    "beyond_unanswered",
    "zero_is_a_duplicate",
    "next_counter_demanded",
    "outputs_too_long_taken",
    "outputs_too_short_taken",
    "inputs_length_unchecked",
    "inputs_mode_unchecked",
]


class Kept(Boundaries):
    """Boundaries that keep what was found, so that the solver finds it once for all tests."""

    made: ClassVar[dict[str, Kept]] = {}

    def found(self) -> Iterator[Boundary]:
        self.made[self.protocol.name] = self
        self.vectors = tuple(super().found())
        return iter(self.vectors)


@cache
def covered(device: str) -> BoundaryCases:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(boundary_values, "Boundaries", Kept)
        return boundary_cases(Model(load_device(device)), () if device == DEVICE else SMALL)


def vectors() -> tuple[tuple[Boundary, ...], Boundaries]:
    covered(DEVICE)
    made = Kept.made[DEVICE]
    return made.vectors, made


# --- vectors --------------------------------------------------------------------------------------


def test_each_side_of_an_edge_is_where_it_says() -> None:
    found, _ = vectors()
    beside = {Side.BELOW: -1, Side.ON: 0, Side.ABOVE: 1}
    assert found
    assert all(each.value - each.edge == beside[each.side] for each in found)
    assert {each.side for each in found} == set(Side)


def test_the_solver_and_trying_agree_where_requests_change_the_rule() -> None:
    model = Model(load_device(DEVICE), assuming=True)
    state = VirtualSubDevice(model.protocol).state
    taken = []
    for requested in range(16):
        parameters = {"requested": requested, "acknowledge": False, "identification": False}
        (done,) = step(model, state, Event("al", "request", parameters))
        taken.append(done.rules[0])
    edges = {
        value
        for value in range(16)
        if any(taken[value] != taken[n] for n in (value - 1, value + 1) if 0 <= n < 16)
    }
    found = {
        each.events[0].parameters["requested"]
        for each in vectors()[0]
        if len(each.events) == 1 and each.events[0].input == "request"
    }
    assert edges
    assert edges <= found


def test_one_side_takes_the_rule_and_the_other_does_not() -> None:
    model = Model(load_device(DEVICE), assuming=True)
    device = VirtualSubDevice(model.protocol)
    play(model, device, way_to(model, "PREOP"))
    preop = device.state
    (below,) = [
        each
        for each in vectors()[0]
        if (str(each.rule), each.side) == ("mailbox.mail_taken", Side.BELOW)
        and "length(payload)" in each.atom
    ]
    plain = {"counter": 1, "channel": 0, "reserved": 0, "address": 0}
    fired = []
    for more in (0, 1):
        parameters = (
            plain | dict(below.events[-1].parameters) | {"payload": bytes(below.value + more)}
        )
        event = Event("mailbox", "mail", parameters, ("mailbox",))
        fired.append({str(done.rules[0]) for done in step(model, preop, event)})
    assert fired == [{"mailbox.mail_too_short"}, {"mailbox.mail_taken"}]


def test_what_lies_in_no_input_is_left_out_with_its_reason() -> None:
    _, made = vectors()
    reasons = made.reasons()
    assert sum(reasons.values()) == len(made.left_out)
    assert reasons["it depends on nothing that the MainDevice sends"]
    assert all(each.reason for each in made.left_out)


# --- cases ----------------------------------------------------------------------------------------


def test_the_cases_are_the_same_again() -> None:
    """Also where sets have another order."""
    program = f"""
from ecatspec.generators.covers.boundary_cover import boundary_cases
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_device

print(*boundary_cases(Model(load_device("{DEVICE}")), ("mailbox",)).cases, sep="\\n")
"""
    given = printed_twice(program)
    assert given[0] == given[1]
    assert given[0].count("Case(") > 30


def test_names_are_unique_and_say_layer_rule_and_side() -> None:
    cases = covered(DEVICE).cases
    assert len({case.name for case in cases}) == len(cases)
    machines = load_device(DEVICE).machines
    for case in cases:
        layer, word, rule, last = case.name.split("/")
        assert (layer, word) == (case.layer, "boundary")
        assert rule.startswith(f"{layer}.")
        assert layer in machines
        assert last.partition("_")[2] in {side.value for side in Side}


def test_a_message_is_followed_by_a_proof_that_the_device_lives() -> None:
    cases = [c for c in covered(DEVICE).cases if c.needs and isinstance(c.stimuli[-2], SendFrame)]
    assert cases
    assert all(isinstance(case.stimuli[-1], Probe) for case in cases)


@pytest.mark.parametrize("device", [DEVICE, "kollmorgen-akd"])
def test_a_sound_device_passes_every_case(device: str) -> None:
    adapter = make(device, {})
    runner = Runner(Model(load_device(device)), adapter, adapter.describe())
    cases = covered(device).cases
    assert len(cases) > 200
    verdicts = [runner.executor.judge(case) for case in cases]
    assert [v for v in verdicts if v.outcome is not Outcome.PASS] == []


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_found(fault: str) -> None:
    adapter = make(DEVICE, {"fault": fault})
    runner = Runner(Model(load_device(DEVICE)), adapter, adapter.describe())
    assert any(runner.executor.judge(case).outcome in BLAMING for case in covered(DEVICE).cases)


@pytest.mark.parametrize(("definition", "old", "new"), OFF_BY_ONE)
def test_a_comparison_that_is_off_by_one_is_found(definition: str, old: str, new: str) -> None:
    wrong = off_by_one(load_device(DEVICE), definition, old, new)
    adapter = SnapshotAdapter(VirtualSubDevice(wrong), described(wrong))
    runner = Runner(Model(load_device(DEVICE)), adapter, adapter.describe())
    assert any(runner.executor.judge(case).outcome in BLAMING for case in covered(DEVICE).cases)


def test_without_the_solver_only_the_call_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [n for n in sys.modules if n.startswith("ecatspec.model.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "z3", None)
    with pytest.raises(ModuleNotFoundError, match=r"install ecatspec\[prove\]"):
        list(boundary_cover(Model(load_device(DEVICE)), NO_LIMITS))


def off_by_one(protocol: Protocol, definition: str, old: str, new: str) -> Protocol:
    """Give the texts in which the first such comparison of a definition is another one."""
    text = protocol.definitions[definition]
    wrong = next(p for p in nodes(text.value) if isinstance(p, Binary) and p.operator == old)
    value = swapped(text.value, wrong, replace(wrong, operator=new))
    definitions = {**protocol.definitions, definition: replace(text, value=value)}
    return replace(protocol, definitions=definitions)


def nodes(expression: Expression | Range) -> list[Expression | Range]:
    inner = [part for each in parts_of(expression) for part in nodes(each)]
    return [expression, *inner]


def swapped(expression: Expression, old: Binary, new: Binary) -> Expression:
    if expression is old:
        return new
    match expression:
        case Binary(left=left, right=right):
            return replace(expression, left=swapped(left, old, new), right=swapped(right, old, new))
        case _:
            return expression
