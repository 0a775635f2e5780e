"""Measures random steps beside those of a Hypothesis state machine.

Three pairs: steps that a device takes and the oracle judges, the making of the steps alone, and
steps over the flat tables of a finite machine. The rival's rules have the same inputs: each is one
kind of stimulus, and draws one of those that the walks have.
"""

from __future__ import annotations

import time
from functools import partial
from random import Random
from typing import TYPE_CHECKING, Any, Final

from hypothesis import HealthCheck, Phase, Verbosity, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    rule,
    run_state_machine_as_test,
)
from measure import Effort, Figure, Found, Of, Part, Profile, Row, Target, number, profiled

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.run.runner import WALK, Runner
from ecatspec.generators.complete.machines import al_drive_machine
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ecatspec.generators.cases.case import Case, Stimulus
    from ecatspec.model.automata.mealy import Mealy

DEVICE: Final = "reference-drive"


def runner_of(device: str) -> Runner:
    """Give a runner for the virtual SubDevice of a text, as `ecatspec run` has it."""
    adapter = make(device, {})
    return Runner(Model(load_device(device)), adapter, adapter.describe())


def walked(runner: Runner, walks: Sequence[Case]) -> None:
    """Judge walks as a run does."""
    for case in walks:
        verdict = runner.executor.judge(case)
        assert not verdict.reason, verdict.reason


def state_machine(
    begin: Callable[[], object], do: Callable[[Any], object], inputs: dict[str, list[Any]]
) -> type[RuleBasedStateMachine]:
    """Give a state machine with a rule for each kind of input."""

    def power_on(_: RuleBasedStateMachine) -> None:
        begin()

    def step(_: RuleBasedStateMachine, given: object) -> None:
        do(given)

    body: dict[str, object] = {"power_on": initialize()(power_on)}
    for kind, every in inputs.items():
        body[kind] = rule(given=st.sampled_from(every))(step)
    return type("Rival", (RuleBasedStateMachine,), body)


def explored(machine: type[RuleBasedStateMachine], runs: int) -> None:
    """Run a state machine a number of times, with as many steps as a walk has."""
    chosen = settings(
        max_examples=runs,
        stateful_step_count=WALK,
        derandomize=True,
        database=None,
        deadline=None,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
        verbosity=Verbosity.quiet,
    )
    run_state_machine_as_test(machine, settings=chosen)


class Counted:
    """Counts the steps of the rival, and the time that their bodies take."""

    def __init__(self, do: Callable[[Any], object]) -> None:
        self._do = do
        self.steps = 0
        self.inside = 0.0

    def __call__(self, given: object) -> None:
        began = time.perf_counter()
        self._do(given)
        self.inside += time.perf_counter() - began
        self.steps += 1


def rates(
    rounds: int, steps: int, ours: Callable[[], object], rival: Callable[[], object], own: Counted
) -> tuple[Figure, Figure, float]:
    """Give steps a second of both, in turns, and the share of the rival's time in its bodies."""
    mine, theirs, inside, whole = [], [], 0.0, 0.0
    for _ in range(rounds):
        began = time.perf_counter()
        ours()
        mine.append(steps / (time.perf_counter() - began))
        own.steps, own.inside = 0, 0.0
        began = time.perf_counter()
        rival()
        took = time.perf_counter() - began
        theirs.append(own.steps / took)
        inside, whole = inside + own.inside, whole + took
    return Figure.of(mine), Figure.of(theirs), inside / whole


def kinds(walks: Sequence[Case]) -> dict[str, list[Stimulus]]:
    """Sort the stimuli of walks by what they are."""
    found: dict[str, list[Stimulus]] = {}
    for case in walks:
        for stimulus in case.stimuli:
            found.setdefault(type(stimulus).__name__, []).append(stimulus)
    return found


def measure(rows: tuple[Row, ...], effort: Effort) -> Found:
    judged, made, tables = rows
    rounds, count = effort.of(5, 2, 1), effort.of(40, 20, 2)
    runner = runner_of(DEVICE)
    walks = [runner.walk(seed) for seed in range(count)]
    walked(runner, walks[:2])
    session, objects = runner.executor.session, runner.executor.configuration()
    steps, inputs = count * WALK, kinds(walks)

    own = Counted(session.apply)
    rival = state_machine(partial(session.begin, runner.known.choices, objects), own, inputs)
    ours, theirs, inside = rates(
        rounds, steps, partial(walked, runner, walks), partial(explored, rival, count), own
    )
    note = f"{count} walks of {WALK} steps a round on {DEVICE}; the rival has a rule for each kind "
    note += "of input and calls the same checked session, but its inputs come in any order, so it "
    note += f"seldom gets as far up; {inside:.0%} of its time is in the session"
    found = [judged.found(ours, theirs, note)]

    own = Counted(lambda _: None)
    rival = state_machine(lambda: None, own, inputs)
    ours, theirs, _ = rates(
        rounds,
        steps,
        lambda: [runner.walk(seed) for seed in range(count)],
        partial(explored, rival, count),
        own,
    )
    note = (
        "the same without a device: how fast steps are made. A walk knows where it is and weighs "
    )
    note += "what comes next; the rival draws"
    found.append(made.found(ours, theirs, note))

    both = al_drive_machine(runner.model)
    assert both is not None
    machine, length = both.machine, effort.of(500_000, 200_000, 1000)
    place = [machine.initial]
    own = Counted(partial(_one, machine, place))
    symbols = {"symbol": list(range(len(machine.inputs)))}
    rival = state_machine(partial(_initial, machine, place), own, symbols)
    ours, theirs, _ = rates(
        rounds, length, partial(_steps, machine, length), partial(explored, rival, count), own
    )
    note = f"AL x DS402 of {DEVICE}: {len(machine.states)} states, {len(machine.inputs)} inputs; "
    note += f"a step is drawn, its output and next state are looked up; {number(length)} a round"
    found.append(tables.found(ours, theirs, note))
    return Found(tuple(found))


def _initial(machine: Mealy, place: list[int]) -> None:
    place[0] = machine.initial


def _one(machine: Mealy, place: list[int], symbol: int) -> None:
    at = place[0] * len(machine.inputs) + symbol
    assert machine.outputs[machine.out[at]] is not None
    place[0] = machine.next[at]


def _steps(machine: Mealy, length: int) -> None:
    draw = Random(1)
    width, out, next_ = len(machine.inputs), machine.out, machine.next
    state, seen = machine.initial, 0
    for symbol in draw.choices(range(width), k=length):
        at = state * width + symbol
        seen |= out[at]
        state = next_[at]


def profile(effort: Effort) -> Profile:
    runner = runner_of(DEVICE)
    walks = [runner.walk(seed) for seed in range(effort.of(20, 10, 1))]
    return profiled(partial(walked, runner, walks))


PARTS: Final = (
    Part(
        (
            Row(
                "walk",
                "seeded walk over AL x DS402 and SDO, judged by the full oracle",
                "steps a second",
                "Hypothesis RuleBasedStateMachine, same inputs, same checked session",
                Target(Of.RATIO, 100.0, least=True),
                "Both wait for the same device and the same oracle, which take most of the time: "
                "what Hypothesis adds to a step is less than they need. Where no device is asked "
                "the ratio is that of the two rows below.",
            ),
            Row(
                "walk-inputs",
                "making the steps of a walk, without a device",
                "steps a second",
                "the same state machine with rules that do nothing",
            ),
            Row(
                "walk-tables",
                "seeded walk over the tables of AL x DS402",
                "steps a second",
                "Hypothesis RuleBasedStateMachine over the same tables",
                Target(Of.RATIO, 300.0, least=True),
            ),
        ),
        measure,
        {"walk": profile},
    ),
)
