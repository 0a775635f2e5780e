"""The only place for one step: what a device may do with one input, run to completion."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.model.compiled import rows_of
from ecatspec.model.evaluate import Environment
from ecatspec.model.state import Event, Output, RuleName, State, Step
from ecatspec.model.values import UNKNOWN, Pattern, Value, admits
from ecatspec.spec.language.scope import REPLY

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.codec import Message
    from ecatspec.model.compiled import CompiledRule, Model
    from ecatspec.model.evaluate import Getter

DELIVER, RESEND = "deliver", "resend"


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
        after.resend or before.resend,
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
    stores = [
        (index(environment), subindex(environment), content(environment), complete)
        for index, subindex, content, complete in rule.store
    ]
    sends = [
        (frame, tuple((name, getter(environment)) for name, getter in fields))
        for frame, fields in rule.sends
    ]
    given = _arguments(rule.gives, environment)
    within = 0 if rule.within is None else rule.within(environment)
    if environment.undecided:
        return _decide(model, state, event, min(environment.undecided))
    after = _updated(state, values)
    if rule.target is not None:
        after = after.having(model.slots[f"{event.machine}.state"], rule.target)
    for index, subindex, content, complete in stores:
        after = _stored(model, environment, after, (index, subindex), content, complete=complete)
    limit = within if isinstance(within, int) else 0
    kept = None if rule.later is None else tuple(sorted(event.parameters.items()))
    outputs = tuple(Output(frame, fields, rule.name, kept, limit) for frame, fields in sends)
    resend = rule.name if any(target == RESEND for target, _ in given) else None
    events = tuple(
        e for target, arguments in given for e in _given(model, event, target, arguments)
    )
    return [(Step(after, (rule.name,), outputs, limit, resend=resend), events)]


def _arguments(
    gives: tuple[tuple[str, tuple[tuple[str, Getter], ...]], ...], environment: Environment
) -> list[tuple[str, dict[str, Value]]]:
    return [
        (target, {name: getter(environment) for name, getter in arguments})
        for target, arguments in gives
    ]


def _updated(state: State, values: list[tuple[int, Value]]) -> State:
    for slot, value in values:
        state = state.having(slot, value)
    return state


def _stored(
    model: Model,
    environment: Environment,
    state: State,
    place: tuple[Value, Value],
    content: Value,
    *,
    complete: bool,
) -> State:
    """Give the state after a write; what is written but not known makes the object unknown."""
    index, subindex = place
    if not isinstance(index, int) or not isinstance(subindex, int):
        return state
    if not complete:
        key = (index, subindex)
        return state.keeping(key, content) if isinstance(content, bytes) else state.forgetting(key)
    if isinstance(content, bytes):
        for key, part in model.dictionary.split(environment, index, subindex, content):
            state = state.keeping(key, part)
        return state
    for key in model.dictionary.entries:
        if key[0] == index:
            state = state.forgetting(key)
    return state


def _given(model: Model, event: Event, target: str, arguments: Mapping[str, Value]) -> list[Event]:
    if target == RESEND:
        return []
    if target != DELIVER:
        machine, _, name = target.partition(".")
        return [Event(machine, name, arguments)]
    return [
        Event(machine, source, event.parameters, event.trail)
        for machine, source in model.takers(event.machine, event.trail)
    ]


def _forget(model: Model, state: State, machine: str) -> State:
    """Give the state after what no text describes: the machine's variables are unknown."""
    for variable in model.protocol.machines[machine].variables:
        state = state.having(model.slots[f"{machine}.{variable.name}"], UNKNOWN)
    return state


# --- observations ---


def matches(model: Model, state: State, output: Output, message: Message) -> list[Step]:
    """Give what may follow when the MainDevice read `message` where `output` was due.

    Nothing: the output does not allow the message.
    """
    if output.again is not None:
        before = model.decode(output.again)
        same = not output.again or (before is not None and before.fields == message.fields)
        return [Step(state, (), (), 0)] if same else []
    if output.frame not in message.trail:
        return []
    environment = Environment(state.slots, state.known(), {})
    expected: dict[str, Value] = model.codec.fixed(output.frame) | dict(output.fields)
    keeps: dict[str, str | None] = {}
    for name, (getter, into) in model.replies[output.frame].items():
        if name not in expected:
            expected[name] = getter(environment)
        keeps[name] = into
    late = later_fields(model, state, output, message.fields)
    environment.undecided |= late[1]
    if environment.undecided:
        choice = min(environment.undecided)
        slot = model.slots[f"choice {choice}"]
        return [
            after
            for alternative in model.protocol.choices[choice].alternatives
            for after in matches(model, state.having(slot, alternative.name), output, message)
        ]
    after = state
    for name, value in (expected | late[0]).items():
        observed = message.fields[name]
        if not admits(value, observed):
            return []
        into = keeps.get(name)
        if into is not None:
            after = after.having(model.slots[into], observed)
        if isinstance(value, Pattern) and isinstance(value.into, tuple):
            after = after.keeping(value.into, observed if isinstance(observed, bytes) else b"")
    return afterwards(model, after, output, message.fields)


def differing(model: Model, state: State, output: Output, message: Message) -> tuple[str, ...]:
    """Give the fields of a message that are not what is due, where it is the frame that is due."""
    if output.again is not None or output.frame not in message.trail:
        return ()
    expected = expected_fields(model, state, output)
    expected |= later_fields(model, state, output, message.fields)[0]
    return tuple(n for n, value in expected.items() if not admits(value, message.fields[n]))


def later_fields(
    model: Model, state: State, output: Output, fields: Mapping[str, Value]
) -> tuple[dict[str, Value], set[str]]:
    """Give what a rule says of fields that depend on others of its frame, and open choices."""
    rule = model.named(output.rule)
    if output.given is None or rule.later is None:
        return {}, set()
    environment = _sent(state, output, fields)
    later = {name: getter(environment) for name, getter in rule.later.fields}
    return later, environment.undecided


def afterwards(
    model: Model, state: State, output: Output, fields: Mapping[str, Value]
) -> list[Step]:
    """Give what may follow once the fields of an output are fixed: updates, then events."""
    rule = model.named(output.rule)
    if output.given is None or rule.later is None:
        return [Step(state, (), (), 0)]
    environment = _sent(state, output, fields)
    values = [(slot, getter(environment)) for slot, getter in rule.later.updates]
    given = _arguments(rule.later.gives, environment)
    source = Event(output.rule.machine, "", {})
    events = tuple(
        e for target, arguments in given for e in _given(model, source, target, arguments)
    )
    return _complete(model, Step(_updated(state, values), (), (), 0), events)


def _sent(state: State, output: Output, fields: Mapping[str, Value]) -> Environment:
    reply = {f"{REPLY}.{name}": value for name, value in fields.items()}
    return Environment(state.slots, state.known(), dict(output.given or ()) | reply)


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
