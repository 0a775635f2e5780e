"""What each explanation had instead of an observation: the rules that led there, what differs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ecatspec.model.core.compiled import timers_of
from ecatspec.model.core.interpreter import differing, expected_fields, row_of
from ecatspec.model.core.memo import once
from ecatspec.model.core.object_dictionary import size_varies
from ecatspec.model.core.observables import machines_of, shown_fields, shown_register
from ecatspec.model.core.values import Octets, Unknown, admits
from ecatspec.model.oracle.blame import Alternative, sizing
from ecatspec.spec.language.ir import Named, Rule
from ecatspec.spec.language.nodes import names_in

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping
    from collections.abc import Set as AbstractSet

    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import Output, RuleName, State
    from ecatspec.model.core.values import Value
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Candidate
    from ecatspec.spec.language.ir import Expression, ObjectEntry, Register

_VALUE: Final = "value"
_REFUSING: Final = frozenset({"code", "detail"})
"""Fields of frames that refuse what was asked."""


# --- registers and process data -------------------------------------------------------------------


def of_register(
    model: Model,
    before: Explanations,
    register: Register,
    observed: Mapping[str, Value],
    since: int,
) -> list[Alternative]:
    """Give what a register should have held instead, from each explanation.

    `since`: rules that each explanation had gone by when it was read last and right.
    """
    views = model.views[register.name]
    machines = machines_of(model, register.name)
    blank = {view.name for view in views if not view.truth and not observed[view.name]}
    # there is no other state of the machine, while a device may have codes of its own
    alien = {
        view.name
        for view in views
        if shows_state(view.expression)
        for bits in register.fields
        if bits.name == view.name and isinstance(bits.type, Named)
        if observed[view.name]
        not in {row.value for row in model.protocol.tables[bits.type.table].rows}
    }

    def shown(state: State) -> Mapping[str, Value]:
        return shown_register(model, register, state)

    found = []
    for candidate, history in before.items():
        odd = not_admitted(shown(candidate.state), observed)
        rules, stuck = _led(model, candidate, history, since, machines, shown, observed)
        found.append(
            Alternative(
                candidate,
                rules,
                odd,
                register.name,
                blank=blank.issuperset(odd),
                stuck=stuck,
                alien=not alien.isdisjoint(odd),
            )
        )
    return found


def of_word(
    model: Model, before: Explanations, word: str, observed: Mapping[str, Value], since: int
) -> Iterator[Alternative]:
    """Yield what a word in the inputs should have held instead, where an explanation says so."""
    machines = machines_of(model, word)

    def shown(state: State) -> Mapping[str, Value]:
        return shown_fields(model, state, word)

    for candidate, history in before.items():
        odd = not_admitted(shown(candidate.state), observed)
        if odd:
            rules, stuck = _led(model, candidate, history, since, machines, shown, observed)
            yield Alternative(candidate, rules, odd, word, stuck=stuck)


def of_machines(candidates: Explanations, machines: AbstractSet[str]) -> tuple[Alternative, ...]:
    """Give the explanations that the observation was not, by the last rule of these machines."""
    return tuple(
        Alternative(candidate, last_rules({candidate: history}, machines))
        for candidate, history in candidates.items()
    )


def last_rules(candidates: Explanations, machines: Collection[str]) -> tuple[RuleName, ...]:
    """Give the last rule of these machines in each history."""
    own = ([r for r in history if r.machine in machines] for history in candidates.values())
    return tuple(dict.fromkeys(history[-1] for history in own if history))


def not_admitted(expected: Mapping[str, Value], observed: Mapping[str, Value]) -> tuple[str, ...]:
    """Give the fields that are not as expected."""
    return tuple(name for name, value in expected.items() if not admits(value, observed[name]))


def shows_state(shown: Expression) -> bool:
    """Tell whether a view shows the state of a machine."""
    return any(path.endswith(".state") for path in names_in(shown))


def _led(
    model: Model,
    candidate: Candidate,
    history: tuple[RuleName, ...],
    since: int,
    machines: AbstractSet[str],
    shown: Callable[[State], Mapping[str, Value]],
    observed: Mapping[str, Value],
) -> tuple[tuple[RuleName, ...], bool]:
    """Give the rule that the device did not go by, if it shows the state before; else the last.

    And whether it shows that state. Rules before `since` led to what was read right. Where these
    machines did nothing after it, it is what became of the outputs.
    """
    recent = history[since:]
    odd = not_admitted(shown(candidate.state), observed)
    later_asked = False
    for rule in reversed(recent):
        row = row_of(model, rule)
        if rule.machine not in machines or not isinstance(row, Rule):
            continue
        asked = _is_asked(model, rule)
        if row.target is None or (later_asked and not asked):
            # what it was asked after it had gone by itself says more
            later_asked = later_asked or asked
            continue
        slot = model.slots[f"{rule.machine}.state"]
        names = {name: value for value, name in model.state_names(rule.machine).items()}
        for source in row.sources:
            before = shown(candidate.state.having(slot, names[source]))
            demanded = any(name in before and not isinstance(before[name], Unknown) for name in odd)
            if source != row.target and demanded and not not_admitted(before, observed):
                return (rule,), True
    own = [rule for rule in history if rule.machine in machines]
    if machines.isdisjoint(rule.machine for rule in recent):
        own = [rule for rule in recent if _takes_outputs(model, rule)] or own
    return tuple(own[-1:]), False


@once
def _takes_outputs(model: Model, rule: RuleName) -> bool:
    """Tell whether a rule says what becomes of outputs."""
    row = row_of(model, rule)
    return row is not None and any(
        (event.machine, event.input) == (rule.machine, row.input) for event in model.outputs
    )


@once
def _is_asked(model: Model, rule: RuleName) -> bool:
    """Tell whether the MainDevice had it done, or the device did it by itself."""
    row = row_of(model, rule)
    alone = {(event.machine, event.input) for event in (*model.own, *model.locals)}
    return (
        row is not None
        and f"{rule.machine}.{row.input}" not in timers_of(model.protocol)
        and (rule.machine, row.input) not in alone
    )


# --- replies --------------------------------------------------------------------------------------


def of_reply(model: Model, candidate: Candidate, output: Output) -> Alternative:
    """Give the explanation that a reply is due, with the entry that it speaks of."""
    fields = dict(output.fields)
    index, subindex = fields.get("index"), fields.get("subindex")
    entry = None
    if isinstance(index, int) and isinstance(subindex, int):
        entry = model.dictionary.entries.get((index, subindex))
    rules = tuple(dict.fromkeys((*output.chain, output.rule)))
    return Alternative(candidate, rules, layout=output.frame, entry=entry, asked=output.asked)


def of_message(model: Model, candidate: Candidate, output: Output, message: Message) -> Alternative:
    """Give the explanation that a reply is due, with what is otherwise in the one that came."""
    each = of_reply(model, candidate, output)
    fields = differing(model, candidate.state, output, message)
    resized = _VALUE in fields and not _fits(model, candidate.state, output, message)
    sized = _holds_any_size(candidate.state, each.entry)
    if sized and _VALUE in fields:
        sizes = sizing(model, output.frame, _VALUE)
        fields = tuple(name for name in fields if name not in sizes)
    return replace(
        each,
        fields=fields,
        resized=resized and not sized,
        sized=sized,
        alien=_is_alien(model, output, message),
        refusing=refuses(model, output.frame) and not refuses(model, message.frame),
    )


def refuses(model: Model, frame: str) -> bool:
    """Tell whether a frame refuses what was asked."""
    return not _REFUSING.isdisjoint(field.name for field in model.protocol.frames[frame].fields)


def _holds_any_size(state: State, entry: ObjectEntry | None) -> bool:
    """Tell whether it is known what an entry holds, and that may be of any size."""
    known = entry is not None and (entry.index, entry.subindex) in state.objects
    return known and entry is not None and size_varies(entry)


def _fits(model: Model, state: State, output: Output, message: Message) -> bool:
    """Tell whether the value of a message is as long as it is to be."""
    expected = expected_fields(model, state, output).get(_VALUE)
    held = message.fields.get(_VALUE)
    if not isinstance(held, bytes):
        return True
    if isinstance(expected, bytes):
        return len(held) == len(expected)
    lengths = expected.lengths if isinstance(expected, Octets) else None
    return lengths is None or lengths[0] <= len(held) <= lengths[1]


def _is_alien(model: Model, output: Output, message: Message) -> bool:
    """Tell whether a message is of the service of a response, and none to that request at all."""
    return (
        message.trail[:-1] == model.codec.trail(output.frame)[:-1]
        and not refuses(model, output.frame)
        and message.frame not in _answers(model, output.rule)
    )


@once
def _answers(model: Model, rule: RuleName) -> frozenset[str]:
    """Give the frames that any rule for the same input, and any refusal, sends."""
    row = row_of(model, rule)
    rules = () if row is None else model.rules(rule.machine, row.input)
    refusing = (name for name in model.protocol.frames if refuses(model, name))
    return frozenset((*(frame for each in rules for frame, _ in each.sends), *refusing))
