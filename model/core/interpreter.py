"""One step: what a device may do with one input, run to completion."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.model.core.compiled import paths_in, rows_of
from ecatspec.model.core.expressions import Environment, before
from ecatspec.model.core.memo import once
from ecatspec.model.core.process_image import OUTPUTS, taken
from ecatspec.model.core.state import Alarm, Event, Output, RuleName, State, Step
from ecatspec.model.core.values import UNKNOWN, Octets, Pattern, Value, admits, bits_of
from ecatspec.spec.language.functions import CYCLIC, REPLY
from ecatspec.spec.language.ir import Bool

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.compiled import CompiledRule, Timer
    from ecatspec.model.core.expressions import Getter
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.spec.language.ir import Gap, RegisterField, Rule

DELIVER, RESEND = "deliver", "resend"
_BYTE = 8
_AGES = 1 << 40
"""Microseconds in which anything would have happened."""


@once
def step(model: Model, state: State, event: Event) -> tuple[Step, ...]:
    """Give every way in which the texts let the device react; never empty.

    Rules that may hold or not (unknown values, conditions of the device) give a step each. A
    choice that decides is decided in the step's state and stays so. An input that no rule takes
    is unspecified.
    """
    first = _fire(model, state, event)
    return tuple(done for partial, given in first for done in _complete(model, partial, given))


@once
def by_any_rule(model: Model, state: State, event: Event) -> tuple[Step, ...]:
    """Give what a device may do with an input if it minds the guard of no rule; perhaps nothing."""
    current = state.slots[model.slots[f"{event.machine}.state"]]
    rules = [r for r in model.rules(event.machine, event.input) if current in r.sources]
    first = [each for rule in rules if not rule.gap for each in _apply(model, state, event, rule)]
    return tuple(done for partial, given in first for done in _complete(model, partial, given))


def _complete(model: Model, partial: Step, given: tuple[Event, ...]) -> list[Step]:
    done = [partial]
    for event in given:
        done = [_joined(first, then) for first in done for then in step(model, first.state, event)]
    return done


def _joined(first: Step, then: Step) -> Step:
    return Step(
        then.state,
        first.rules + then.rules,
        first.outputs + then.outputs,
        max(first.within, then.within),
        first.unspecified or then.unspecified,
        then.resend or first.resend,
        first.alarms + then.alarms,
    )


def _fire(model: Model, state: State, event: Event) -> list[tuple[Step, tuple[Event, ...]]]:
    environment = Environment(state.slots, state.objects, event.parameters)
    current = state.slots[model.slots[f"{event.machine}.state"]]
    if isinstance(current, Pattern):
        # whatever it does, its state is no better known than before
        return [(Step(forgotten(model, state, event.machine), (), (), 0), ())]
    enabled: list[CompiledRule] = []
    undecided: set[str] = set()
    for rule in model.rules(event.machine, event.input):
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
        return [(Step(forgotten(model, state, event.machine), (), (), 0, unspecified=True), ())]
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
        after = forgotten(model, state, event.machine)
        return [(Step(after, (rule.name,), (), 0, unspecified=True), ())]
    environment = Environment(state.slots, state.objects, event.parameters)
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
    image = None if rule.take is None else rule.take(environment)
    alarms = tuple(_alarm(timer, environment) for timer in rule.timers)
    if environment.undecided:
        return _decide(model, state, event, min(environment.undecided))
    after = _updated(state, values)
    if rule.target is not None:
        after = after.having(model.slots[f"{event.machine}.state"], rule.target)
    words: list[Event] = []
    for index, subindex, content, complete in stores:
        place = (index, subindex)
        after, came = _stored(model, environment, after, place, content, complete=complete)
        words += came
    if image is not None:
        after, came = _spread(model, environment, after, image)
        words += came
    limit = within if isinstance(within, int) else 0
    kept = None if rule.later is None else tuple(sorted(event.parameters.items()))
    asked = tuple(event.parameters.items())
    outputs = tuple(
        Output(frame, fields, rule.name, kept, limit, asked=asked) for frame, fields in sends
    )
    resend = rule.name if any(target == RESEND for target, _ in given) else None
    events = tuple(
        e for target, arguments in given for e in _given(model, event, target, arguments)
    )
    done = Step(after, (rule.name,), outputs, limit, resend=resend, alarms=alarms)
    return [(done, (*words, *events))]


def _alarm(timer: Timer, environment: Environment) -> Alarm:
    arguments = {name: getter(environment) for name, getter in timer.arguments}
    after = 0 if timer.after is None else timer.after(environment)
    within = timer.within(environment)
    # what is not known may come at once, and late
    return Alarm(
        Event(timer.machine, timer.input, arguments),
        after if isinstance(after, int) else 0,
        within if isinstance(within, int) else _AGES,
    )


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
) -> tuple[State, list[Event]]:
    """Give the state after a write and the events of words that were written.

    What is written but not known makes the object unknown.
    """
    index, subindex = place
    if not isinstance(index, int) or not isinstance(subindex, int):
        return state, []
    if model.assuming and isinstance(content, Pattern):
        return state, []  # where anything may be stored a device keeps what it has
    if not complete:
        parts: list[tuple[ObjectKey, Value]] = [((index, subindex), content)]
    elif isinstance(content, bytes):
        parts = list(model.dictionary.split(environment, index, subindex, content))
    else:
        lengths = content.lengths if isinstance(content, Octets) else None
        most = None if lengths is None else lengths[1]
        parts = [(key, UNKNOWN) for key in model.dictionary.written_from(index, subindex, most)]
    events: list[Event] = []
    for key, part in parts:
        state = state.keeping(key, part) if isinstance(part, bytes) else state.forgetting(key)
        raw = int.from_bytes(part, "little") if isinstance(part, bytes) else UNKNOWN
        state, came = _worded(model, state, key, raw, cyclic=False)
        events += came
    return state, events


def _spread(
    model: Model, environment: Environment, state: State, image: Value
) -> tuple[State, list[Event]]:
    """Give the state and the events of words after process data were taken."""
    layout = model.image.layout(environment, OUTPUTS)
    found: list[tuple[ObjectKey, Value]] = []
    if layout is None or not isinstance(image, bytes):
        # which words there are is not known
        found = [(key, UNKNOWN) for key, word in model.words.items() if not model.views[word.name]]
    else:
        for mapped in layout:
            raw = taken(image, mapped)
            if mapped.key in model.dictionary.entries and raw is not None:
                found.append((mapped.key, raw))
                size = -(-mapped.bits // _BYTE)
                # when it takes effect only the device knows
                state = (
                    state.keeping(mapped.key, raw.to_bytes(size, "little"))
                    if model.assuming
                    else state.forgetting(mapped.key)
                )
    events: list[Event] = []
    for key, value in found:
        state, came = _worded(model, state, key, value, cyclic=True)
        events += came
    return state, events


def _worded(
    model: Model, state: State, key: ObjectKey, raw: Value, *, cyclic: bool
) -> tuple[State, list[Event]]:
    """Give the state after an object took a value, and the events if it is a word."""
    word = model.words.get(key)
    if word is None:
        return state, []
    slot = model.slots[f"word {word.name}"]
    parameters = fields_with_before(word.fields, raw, state.slots[slot])
    parameters[CYCLIC] = cyclic
    events = [Event(machine, name, parameters) for machine, name in model.word_inputs[word.name]]
    return state.having(slot, raw), events


def fields_with_before(
    fields: Iterable[RegisterField], raw: Value, past: Value | None
) -> dict[str, Value]:
    """Give the fields of a register or word as parameters, and what they were before."""
    found: dict[str, Value] = {}
    for bits in fields:
        found[bits.name] = _part(bits, raw)
        found[before(bits.name)] = _part(bits, past)
    return found


def _part(bits: RegisterField, raw: Value | None) -> Value:
    if not isinstance(raw, int):
        return UNKNOWN
    value = bits_of(raw, bits.low, bits.high)
    return bool(value) if isinstance(bits.type, Bool) else value


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


def forgotten(model: Model, state: State, machine: str) -> State:
    """Give the state after what no text describes: the machine's variables are unknown.

    What words move may be in another state too: the words will show it. A device stays as it is.
    """
    if model.assuming:
        return state
    if machine in model.worded:
        state = state.having(model.slots[f"{machine}.state"], UNKNOWN)
    for variable in model.protocol.machines[machine].variables:
        state = state.having(model.slots[f"{machine}.{variable.name}"], UNKNOWN)
    return state


# --- observations ---


def matches(model: Model, state: State, output: Output, message: Message) -> list[Step]:
    """Give what may follow when the MainDevice read `message` where `output` was due.

    Nothing: the output does not allow the message.
    """
    if output.again is not None:
        first = model.decode(output.again)
        same = not output.again or (first is not None and first.fields == message.fields)
        return [Step(state, (), (), 0)] if same else []
    if output.frame not in message.trail:
        return []
    environment = Environment(state.slots, state.objects, {})
    expected: dict[str, Value] = {**model.codec.fixed(output.frame), **dict(output.fields)}
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
        if isinstance(value, Octets) and value.into is not None:
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
    return Environment(state.slots, state.objects, dict(output.given or ()) | reply)


def expected_fields(model: Model, state: State, output: Output) -> dict[str, Value]:
    """Give all that the texts say of a frame that is due: fixed, stated and default fields."""
    environment = Environment(state.slots, state.objects, {})
    expected: dict[str, Value] = dict(model.codec.fixed(output.frame))
    for name, (getter, _) in model.replies[output.frame].items():
        expected[name] = getter(environment)
    return expected | dict(output.fields)


def rule_clauses(model: Model, rule: RuleName) -> tuple[str, ...]:
    """Give the clauses that a rule or gap cites."""
    row = row_of(model, rule)
    return () if row is None else row.clauses


@once
def rests_on(model: Model, rule: RuleName) -> frozenset[str]:
    """Give the names on which it depends whether a rule or gap holds."""
    row = row_of(model, rule)
    guard = None if row is None else row.guard
    return frozenset(() if guard is None else paths_in(model.protocol, guard))


@once
def row_of(model: Model, rule: RuleName) -> Rule | Gap | None:
    """Give a rule or gap by its name."""
    rows = rows_of(model.protocol.machines[rule.machine])
    return next((row for row in rows if row.name == rule.name), None)
