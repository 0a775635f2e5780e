"""The only place for one step: what a device may do with one input, run to completion."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.model.compiled import rows_of
from ecatspec.model.evaluate import Environment
from ecatspec.model.state import Event, Output, RuleName, State, Step
from ecatspec.model.values import UNKNOWN, Pattern, Value, admits

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.codec import Message
    from ecatspec.model.compiled import CompiledRule, Model

DELIVER = "deliver"


def step(model: Model, state: State, event: Event) -> tuple[Step, ...]:
    """Give every way in which the texts let the device react; never empty.

    Rules that may hold or not (unknown values, conditions of the device) give a step each. A
    choice that decides is decided in the step's state and stays so. An input that no rule takes
    is unspecified.
    """
    first = _fire(model, state, event)
    return tuple(done for partial, given in first for done in _complete(model, partial, given))


def _complete(model: Model, partial: Step, given: tuple[Event, ...]) -> list[Step]:
    done = [partial]
    for event in given:
        done = [
            _joined(before, after) for before in done for after in step(model, before.state, event)
        ]
    return done


def _joined(before: Step, after: Step) -> Step:
    return Step(
        after.state,
        before.rules + after.rules,
        before.outputs + after.outputs,
        max(before.within, after.within),
        before.unspecified or after.unspecified,
    )


def _fire(model: Model, state: State, event: Event) -> list[tuple[Step, tuple[Event, ...]]]:
    environment = Environment(state.slots, state.known(), event.parameters)
    current = state.slots[model.slots[f"{event.machine}.state"]]
    enabled: list[CompiledRule] = []
    undecided: set[str] = set()
    for rule in model.rules[event.machine, event.input]:
        if current not in rule.sources:
            continue
        environment.undecided = set()
        holds = True if rule.guard is None else rule.guard(environment)
        if isinstance(holds, Pattern):
            undecided |= environment.undecided
        if holds is not False:
            enabled.append(rule)
    if undecided and len(enabled) > 1:
        return _decide(model, state, event, min(undecided))
    if not enabled:
        return [(Step(_forget(model, state, event.machine), (), (), 0, unspecified=True), ())]
    results: list[tuple[Step, tuple[Event, ...]]] = []
    for rule in enabled:
        results += _apply(model, state, event, rule)
    return results


def _decide(
    model: Model, state: State, event: Event, choice: str
) -> list[tuple[Step, tuple[Event, ...]]]:
    slot = model.slots[f"choice {choice}"]
    results: list[tuple[Step, tuple[Event, ...]]] = []
    for alternative in model.protocol.choices[choice].alternatives:
        results += _fire(model, state.having(slot, alternative.name), event)
    return results


def _apply(
    model: Model, state: State, event: Event, rule: CompiledRule
) -> list[tuple[Step, tuple[Event, ...]]]:
    if rule.gap:
        forgotten = _forget(model, state, event.machine)
        return [(Step(forgotten, (rule.name,), (), 0, unspecified=True), ())]
    environment = Environment(state.slots, state.known(), event.parameters)
    values = [(slot, getter(environment)) for slot, getter in rule.updates]
    stores = [tuple(getter(environment) for getter in store) for store in rule.store]
    outputs = tuple(
        Output(frame, tuple((name, getter(environment)) for name, getter in fields), rule.name)
        for frame, fields in rule.sends
    )
    given = [
        (target, {name: getter(environment) for name, getter in arguments})
        for target, arguments in rule.gives
    ]
    if environment.undecided:
        return _decide(model, state, event, min(environment.undecided))
    within = 0 if rule.within is None else rule.within(environment)
    after = state
    for slot, value in values:
        after = after.having(slot, value)
    if rule.target is not None:
        after = after.having(model.slots[f"{event.machine}.state"], rule.target)
    for index, subindex, content in stores:
        if isinstance(index, int) and isinstance(subindex, int) and isinstance(content, bytes):
            after = after.keeping((index, subindex), content)
    limit = within if isinstance(within, int) else 0
    events = tuple(
        e for target, arguments in given for e in _given(model, event, target, arguments)
    )
    return [(Step(after, (rule.name,), outputs, limit), events)]


def _given(model: Model, event: Event, target: str, arguments: Mapping[str, Value]) -> list[Event]:
    if target != DELIVER:
        machine, _, name = target.partition(".")
        return [Event(machine, name, arguments)]
    return [
        Event(machine.name, source.name, event.parameters, event.trail)
        for machine in model.protocol.machines.values()
        for source in machine.inputs
        if machine.name != event.machine
        and source.kind == "frame"
        and event.trail[-1] in source.origin
    ]


def _forget(model: Model, state: State, machine: str) -> State:
    """Give the state after what no text describes: the machine's variables are unknown."""
    for variable in model.protocol.machines[machine].variables:
        state = state.having(model.slots[f"{machine}.{variable.name}"], UNKNOWN)
    return state


# --- observations ---


def matches(model: Model, state: State, output: Output, message: Message) -> list[State]:
    """Give the states after the MainDevice read `message` where `output` was due; none: refused."""
    if output.frame not in message.trail:
        return []
    environment = Environment(state.slots, state.known(), {})
    expected: dict[str, Value] = model.codec.fixed(output.frame) | dict(output.fields)
    keeps: dict[str, str | None] = {}
    for name, (getter, into) in model.replies[output.frame].items():
        if name not in expected:
            expected[name] = getter(environment)
        keeps[name] = into
    if environment.undecided:
        choice = min(environment.undecided)
        slot = model.slots[f"choice {choice}"]
        return [
            after
            for alternative in model.protocol.choices[choice].alternatives
            for after in matches(model, state.having(slot, alternative.name), output, message)
        ]
    after = state
    for name, value in expected.items():
        observed = message.fields[name]
        if not admits(value, observed):
            return []
        into = keeps.get(name)
        if into is not None:
            after = after.having(model.slots[into], observed)
        if isinstance(value, Pattern) and isinstance(value.into, tuple):
            after = after.keeping(value.into, observed if isinstance(observed, bytes) else b"")
    return [after]


def expected_fields(model: Model, state: State, output: Output) -> dict[str, Value]:
    """Give all that the texts say of a frame that is due: fixed, stated and default fields."""
    environment = Environment(state.slots, state.known(), {})
    expected: dict[str, Value] = dict(model.codec.fixed(output.frame))
    for name, (getter, _) in model.replies[output.frame].items():
        expected[name] = getter(environment)
    return expected | dict(output.fields)


def rule_clauses(model: Model, rule: RuleName) -> tuple[str, ...]:
    """Give the clauses that a rule or gap cites."""
    for row in rows_of(model.protocol.machines[rule.machine]):
        if row.name == rule.name:
            return row.clauses
    return ()
