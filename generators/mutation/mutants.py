"""Mutants of the texts: one rule or definition that is wrong in one point.

A wrong rule stands before the others of its machine, so that a check that became too weak takes
what another rule should have: the order of checks is wrong then.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import partial, reduce
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar, cast, get_args

from ecatspec.spec.language.ir import (
    AnyValue,
    Binary,
    Bool,
    Conditional,
    Expression,
    In,
    Literal,
    Name,
    Named,
    OneOf,
    Range,
    Rule,
    SInt,
    Time,
    UInt,
    Unary,
)
from ecatspec.spec.language.kinds import kind_of
from ecatspec.spec.language.logic import LOGIC
from ecatspec.spec.language.nodes import nodes_in, parts_of
from ecatspec.spec.language.pretty_expressions import pretty_expression
from ecatspec.spec.language.scope import Scope, frame_fields

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from ecatspec.spec.language.ir import (
        Give,
        Later,
        Machine,
        Protocol,
        Span,
        Type,
        Update,
    )

_T = TypeVar("_T")
_N = TypeVar("_N", bound=Expression | Range)
_NUMBERS: Final = (UInt(64), SInt(64), Time())
_EXPRESSIONS: Final = get_args(Expression)
_EDGES: Final = {"<": "<=", "<=": "<", ">": ">=", ">=": ">"}


class Operator(StrEnum):
    """What is wrong; the words are those of the report."""

    NEGATED = "guard negated"
    UNCHECKED = "check left out or too early"
    NARROWED = "value left out of a set"
    OFF_BY_ONE = "off by one"
    WRONG_VALUE = "wrong code or value"
    WRONG_TARGET = "wrong target"
    UPDATE_DROPPED = "update dropped"
    OUTPUT_DROPPED = "output dropped"


@dataclass(frozen=True, slots=True)
class Mutant:
    """A specification with one mistake.

    `place` is `machine.rule`, or `define NAME`. `before` is what the text says and `after` what
    the mutant makes of it; no two mutants of a specification are described alike.
    """

    place: str
    operator: Operator
    before: str
    after: str
    at: Span
    machines: frozenset[str]
    """The machines that go wrong by it; `SHOWN`: what registers, words and frames show does."""
    follows: bool
    """Whether it is wrong in what follows once a frame is fixed."""
    protocol: Protocol

    @property
    def checks(self) -> bool:
        """Whether other inputs take the rule than before, so that it matters where it did not."""
        return self.operator in _CHECKS

    def __str__(self) -> str:
        """Give what is wrong and where."""
        return f"{self.place}: {self.operator}: {self.before} -> {self.after}"


_CHECKS: Final = frozenset(
    {Operator.NEGATED, Operator.UNCHECKED, Operator.NARROWED, Operator.OFF_BY_ONE}
)
DEFINE: Final = "define "
SHOWN: Final = "shown"
_ASKED: Final = ("inputs_valid", "mailbox_alive")
"""The definitions that the virtual SubDevice asks for itself."""
_NOTHING: Final = "nothing"


def mutants(protocol: Protocol) -> Iterator[Mutant]:
    """Yield the mutants of a specification, in the order of its machines, then its definitions."""
    for machine in protocol.machines.values():
        for rule in machine.rules:
            for operator, before, after, wrong in _numbered(_of_rule(protocol, machine, rule)):
                others = tuple(r for r in machine.rules if r is not rule)
                changed = replace(machine, rules=(wrong, *others))
                machines = protocol.machines | {machine.name: changed}
                yield Mutant(
                    f"{machine.name}.{rule.name}",
                    operator,
                    before,
                    after,
                    rule.at,
                    frozenset({machine.name, *_told(rule, wrong)}),
                    (rule.sends, rule.after) != (wrong.sends, wrong.after),
                    replace(protocol, machines=machines),
                )
    for name, speakers in sorted(_speakers(protocol).items()):
        definition = protocol.definitions[name]
        number = kind_of(protocol, definition.value, Scope()) in _NUMBERS
        changes = wrong_checks(definition.value, negated=not number)
        for operator, before, after, value in _numbered(changes):
            definitions = protocol.definitions | {name: replace(definition, value=value)}
            yield Mutant(
                f"{DEFINE}{name}",
                operator,
                before,
                after,
                definition.at,
                frozenset(speakers),
                follows=False,
                protocol=replace(protocol, definitions=definitions),
            )


def _numbered(
    changes: Iterable[tuple[Operator, str, str, _T]],
) -> Iterator[tuple[Operator, str, str, _T]]:
    """Yield the changes; of those in the same words each says which one it is."""
    every = list(changes)
    alike = Counter(each[:3] for each in every)
    seen: Counter[tuple[Operator, str, str]] = Counter()
    for operator, before, after, wrong in every:
        words = operator, before, after
        seen[words] += 1
        which = f" (number {seen[words]} of {alike[words]})" if alike[words] > 1 else ""
        yield operator, f"{before}{which}", after, wrong


def _told(rule: Rule, wrong: Rule) -> Iterator[str]:
    """Yield the machines that are told less or something else by a wrong rule, or by its frame."""
    if rule.sends != wrong.sends:
        yield SHOWN
    told: tuple[Give | Later, ...] = (*rule.gives, *rule.laters)
    left: tuple[Give | Later, ...] = (*wrong.gives, *wrong.laters)
    yield from (given.target.partition(".")[0] for given in told if given not in left)


def _speakers(protocol: Protocol) -> dict[str, set[str]]:
    """Give the definitions that decide about what a device does, with the machines they do it in.

    In `SHOWN` there are those that registers, words and frames speak of.
    """
    shown = (*protocol.registers.values(), *protocol.words.values(), *protocol.frames.values())
    asked = tuple(protocol.definitions[name] for name in _ASKED)
    speakers = {SHOWN: (*shown, *asked, *map(Name, _ASKED))}
    speakers |= {machine.name: machine.rules for machine in protocol.machines.values()}
    found: dict[str, set[str]] = {}
    for speaker, node in speakers.items():
        for name in definitions_in(protocol, node):
            found.setdefault(name, set()).add(speaker)
    return found


def definitions_in(protocol: Protocol, node: object) -> set[str]:
    """Give the definitions that a part of the texts speaks of, and those that these speak of."""
    found: set[str] = set()
    work = [node]
    while work:
        for part in nodes_in(work.pop()):
            path = part.path if isinstance(part, Name) else ""
            if path in protocol.definitions and path not in found:
                found.add(path)
                work.append(protocol.definitions[path].value)
    return found


_Change: TypeAlias = tuple[Operator, str, str, Rule]


def _of_rule(protocol: Protocol, machine: Machine, rule: Rule) -> Iterator[_Change]:
    if rule.guard is not None:
        for operator, before, after, guard in wrong_checks(rule.guard):
            yield operator, before, after, replace(rule, guard=guard)
    yield from _targets(machine, rule)
    for number, update in enumerate(rule.updates):
        if isinstance(update.value, AnyValue):
            continue  # what it was before is any value too
        dropped = replace(rule, updates=_without(rule.updates, number))
        yield Operator.UPDATE_DROPPED, _said(update), _NOTHING, dropped
    for number, update in enumerate(rule.after.updates if rule.after else ()):
        assert rule.after is not None
        later = replace(rule.after, updates=_without(rule.after.updates, number))
        dropped = replace(rule, after=later)
        yield Operator.UPDATE_DROPPED, f"after {_said(update)}", _NOTHING, dropped
    yield from (
        (Operator.OUTPUT_DROPPED, said, _NOTHING, dropped) for said, dropped in _silent(rule)
    )
    yield from _values(protocol, machine, rule)


def _silent(rule: Rule) -> Iterator[tuple[str, Rule]]:
    """Yield the rule without one of its outputs."""
    for number, store in enumerate(rule.stores):
        said = f"store {pretty_expression(store.value)}"
        yield said, replace(rule, stores=_without(rule.stores, number))
    for number, send in enumerate(rule.sends):
        yield f"send {send.frame}", replace(rule, sends=_without(rule.sends, number))
    for number, give in enumerate(rule.gives):
        yield f"give {give.target}", replace(rule, gives=_without(rule.gives, number))
    for number, later in enumerate(rule.laters):
        yield f"later {later.target}", replace(rule, laters=_without(rule.laters, number))


def _said(update: Update) -> str:
    return f"{update.variable} = {pretty_expression(update.value)}"


def _without(rows: tuple[_T, ...], number: int) -> tuple[_T, ...]:
    return (*rows[:number], *rows[number + 1 :])


def _with(rows: tuple[_T, ...], number: int, row: _T) -> tuple[_T, ...]:
    return (*rows[:number], row, *rows[number + 1 :])


# --- guards ---------------------------------------------------------------------------------------


def wrong_checks(
    guard: Expression, *, negated: bool = True
) -> Iterator[tuple[Operator, str, str, Expression]]:
    """Yield guards that are wrong in one point; `negated`: also the contrary."""
    said = pretty_expression(guard)
    if negated:
        yield Operator.NEGATED, said, f"not ({said})", Unary("not", guard)
    for operator, change in (
        (Operator.UNCHECKED, _one_less),
        (Operator.NARROWED, _fewer),
        (Operator.OFF_BY_ONE, _beside),
    ):
        for part, other, whole in _changed(guard, change):
            shown = pretty_expression(part), pretty_expression(other)
            yield operator, *shown, whole


def _changed(
    node: _N, change: Callable[[object], Iterator[Expression]], above: str = ""
) -> Iterator[tuple[Expression, Expression, _N]]:
    """Yield an expression with one part changed, after that part as it was and as it is.

    `above` is the operator whose row the expression continues: a row is changed as a whole.
    """
    operator = node.operator if isinstance(node, Binary) and node.operator in LOGIC else ""
    if not isinstance(node, Range) and (not operator or operator != above):
        for other in change(node):
            yield node, other, cast("_N", other)
    for field in fields(node):
        value = getattr(node, field.name)
        on = operator if field.name == "left" else ""
        if isinstance(value, tuple):
            for number, item in enumerate(value):
                for part, other, whole in _changed(item, change):
                    wrong = {field.name: _with(value, number, whole)}
                    yield part, other, cast("_N", replace(cast("Any", node), **wrong))
        elif isinstance(value, _EXPRESSIONS):
            for part, other, whole in _changed(value, change, on):
                wrong = {field.name: whole}
                yield part, other, cast("_N", replace(cast("Any", node), **wrong))


def _one_less(node: object) -> Iterator[Expression]:
    """Yield a row of `and` or of `or` without one of its parts."""
    if isinstance(node, Binary) and node.operator in LOGIC:
        parts = list(_row(node.operator, node))
        for number in range(len(parts)):
            left = (*parts[:number], *parts[number + 1 :])
            yield reduce(partial(Binary, node.operator), left)


def _row(operator: str, value: Expression) -> Iterator[Expression]:
    """Yield the parts of `a and b and c`, the first one first."""
    match value:
        case Binary(own, left, right) if own == operator:
            yield from _row(operator, left)
            yield right
        case _:
            yield value


def _fewer(node: object) -> Iterator[Expression]:
    if isinstance(node, In) and len(node.items) > 1:
        for number in range(len(node.items)):
            yield replace(node, items=(*node.items[:number], *node.items[number + 1 :]))


def _beside(node: object) -> Iterator[Expression]:
    match node:
        case Binary(operator, left, right) if operator in _EDGES:
            if not isinstance(left, Literal) and not isinstance(right, Literal):
                yield replace(node, operator=_EDGES[operator])
        case Literal(value) if not isinstance(value, bool):
            yield replace(node, value=value + 1)
            if value:
                yield replace(node, value=value - 1)
        case _:
            return


# --- targets and values ---------------------------------------------------------------------------


def _targets(machine: Machine, rule: Rule) -> Iterator[_Change]:
    """Yield the rule staying where it is, and going to the next state that is no right one."""
    said = rule.target or "stays"
    if rule.target is not None and rule.sources != (rule.target,):
        yield Operator.WRONG_TARGET, said, "stays", replace(rule, target=None)
    right = {rule.target} if rule.target is not None else set(rule.sources)
    first = machine.states.index(rule.target or rule.sources[-1])
    wheel = (*machine.states[first + 1 :], *machine.states[:first])
    other = next((state for state in wheel if state not in right), None)
    if other is not None:
        yield Operator.WRONG_TARGET, said, other, replace(rule, target=other)


def _values(protocol: Protocol, machine: Machine, rule: Rule) -> Iterator[_Change]:
    """Yield the rule with another value in an update, a frame that it sends, or an event."""
    variables = {f"{machine.name}.{v.name}": v.type for v in machine.variables}
    variables |= {v.name: v.type for v in machine.variables}

    def updates(rows: tuple[Update, ...]) -> Iterator[tuple[str, str, tuple[Update, ...]]]:
        for number, row in enumerate(rows):
            kind = variables.get(row.variable)
            for before, after, value in wrong_values(protocol, kind, row.value):
                wrong = replace(row, value=value)
                changed = _with(rows, number, wrong)
                yield f"{row.variable} = {before}", after, changed

    for before, after, changed in updates(rule.updates):
        yield Operator.WRONG_VALUE, before, after, replace(rule, updates=changed)
    if rule.after is not None:
        for before, after, changed in updates(rule.after.updates):
            wrong_after = replace(rule.after, updates=changed)
            yield Operator.WRONG_VALUE, before, after, replace(rule, after=wrong_after)
    for number, send in enumerate(rule.sends):
        types = frame_fields(protocol, send.frame)
        for before, after, named in _wrong_named(protocol, types, send.fields):
            wrong_send = replace(send, fields=named)
            sends = _with(rule.sends, number, wrong_send)
            said = f"{send.frame} {before}"
            yield Operator.WRONG_VALUE, said, after, replace(rule, sends=sends)
    for number, give in enumerate(rule.gives):
        types = _parameters(protocol, give.target)
        for before, after, named in _wrong_named(protocol, types, give.arguments):
            wrong_give = replace(give, arguments=named)
            gives = _with(rule.gives, number, wrong_give)
            said = f"{give.target} {before}"
            yield Operator.WRONG_VALUE, said, after, replace(rule, gives=gives)


def _parameters(protocol: Protocol, target: str) -> dict[str, Type]:
    name, _, event = target.partition(".")
    machine = protocol.machines.get(name)
    inputs = () if machine is None else machine.inputs
    return {name: kind for i in inputs if i.name == event for name, kind in i.parameters}


_NamedValues: TypeAlias = tuple[tuple[str, Expression], ...]


def _wrong_named(
    protocol: Protocol, types: dict[str, Type], named: _NamedValues
) -> Iterator[tuple[str, str, _NamedValues]]:
    for number, (name, value) in enumerate(named):
        for before, after, wrong in wrong_values(protocol, types.get(name), value):
            changed = _with(named, number, (name, wrong))
            yield f"{name} = {before}", after, changed


def wrong_values(
    protocol: Protocol, kind: Type | None, value: Expression
) -> Iterator[tuple[str, str, Expression]]:
    """Yield wrong values for one that is not left open."""
    match value:
        case Conditional(condition, then, otherwise):
            for before, after, wrong in wrong_values(protocol, kind, then):
                yield before, after, Conditional(condition, wrong, otherwise)
            for before, after, wrong in wrong_values(protocol, kind, otherwise):
                yield before, after, Conditional(condition, then, wrong)
            return
        case AnyValue():
            return
    wrong_one = _another(protocol, kind, value)
    if wrong_one is not None:
        yield pretty_expression(value), pretty_expression(wrong_one), wrong_one


def _another(protocol: Protocol, kind: Type | None, value: Expression) -> Expression | None:
    """Give a value that is none of those that an expression stands for."""
    match kind, value:
        case Bool(), Literal(value=bool(truth)):
            return Literal(not truth)
        case Bool(), _:
            return Unary("not", value)
        case Named(table), _:
            rows = protocol.tables[table].rows
            taken = set(_numbers({row.name: row.value for row in rows}, value))
            row = next((row for row in rows if row.value not in taken), None)
            return None if row is None else Name(f"{table}.{row.name}")
        case UInt() | SInt(), Literal(value=number):
            return replace(value, value=number + 1) if number == 0 else replace(value, value=0)
        case UInt() | SInt(), _ if not isinstance(value, OneOf):
            return Conditional(Binary("==", value, Literal(0)), Literal(1), Literal(0))
    return None


def _numbers(rows: dict[str, int], value: Expression | Range) -> Iterator[int]:
    """Yield the numbers that an expression speaks of."""
    match value:
        case Literal(value=number):
            yield int(number)
        case Range(Literal(value=low), Literal(value=high)):
            yield from range(int(low), int(high) + 1)
        case Name(path):
            if (last := path.rpartition(".")[2]) in rows:
                yield rows[last]
        case _:
            for part in parts_of(value):
                yield from _numbers(rows, part)
