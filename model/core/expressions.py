"""Compiles expressions to functions of an environment.

A comparison with an unknown value is unknown, and so may be what `logic` makes of it. Unknown is
`UNKNOWN`; a guard that is unknown may hold or not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias, assert_never

from ecatspec.model.core.values import UNKNOWN, Numbers, Pattern, Unknown, Value, compatible
from ecatspec.spec.language.arithmetic import calculated
from ecatspec.spec.language.functions import EDGES
from ecatspec.spec.language.ir import (
    AnyValue,
    Binary,
    Call,
    Conditional,
    Expression,
    In,
    Literal,
    Name,
    OneOf,
    Range,
    Unary,
)
from ecatspec.spec.language.logic import COMPARED, LOGIC, junction

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

Getter: TypeAlias = "Callable[[Environment], Value]"
Lookup: TypeAlias = "Callable[[Name], Getter]"
Function: TypeAlias = "Callable[[Environment, tuple[Value, ...]], Value]"


class Environment:
    """What an expression sees: the values of one state and the parameters of one input."""

    __slots__ = ("memo", "objects", "parameters", "slots", "undecided")

    def __init__(
        self,
        slots: tuple[Value | None, ...],
        objects: Mapping[tuple[int, int], bytes],
        parameters: Mapping[str, Value],
    ) -> None:
        """Take values, known objects and parameters; `undecided` collects choices met open."""
        self.slots = slots
        self.objects = objects
        self.parameters = parameters
        self.undecided: set[str] = set()
        self.memo: dict[str, tuple[Value, frozenset[str]]] = {}
        """What was found out already, with the choices that were met open on the way."""


def compile_expression(
    expression: Expression, lookup: Lookup, functions: Mapping[str, Function]
) -> Getter:
    """Turn an expression into a function of an environment; names are looked up once, here."""

    def compiled(part: Expression) -> Getter:
        return compile_expression(part, lookup, functions)

    match expression:
        case Literal(value=value):
            return constant(value)
        case Name():
            return lookup(expression)
        case AnyValue(preferred=preferred):
            return (lambda _: UNKNOWN) if preferred is None else _preference(compiled(preferred))
        case Unary(operator="not", operand=operand):
            return _negation(compiled(operand))
        case Unary(operand=operand):
            return _minus(compiled(operand))
        case Binary(operator="and" | "or" as word):
            parts = [compiled(part) for part in _chain(expression, word)]
            return junction(parts, decisive=LOGIC[word], unknown=UNKNOWN)
        case Binary(operator="==", left=left, right=right):
            return _equality(compiled(left), compiled(right))
        case Binary(operator="!=", left=left, right=right):
            return _negation(_equality(compiled(left), compiled(right)))
        case Binary(operator=symbol, left=left, right=right):
            return _arithmetic(symbol, compiled(left), compiled(right))
        case In(operand=operand, items=items):
            return _membership(compiled(operand), [_bounds(item, compiled) for item in items])
        case Conditional(condition=condition, then=then, otherwise=otherwise):
            return _conditional(compiled(condition), compiled(then), compiled(otherwise))
        case Call(function=name, arguments=(Name(path=path) as argument,)) if name in EDGES:
            return _edge(lookup(argument), path.rpartition(".")[2], up=EDGES[name])
        case Call(function=name, arguments=arguments):
            call = _call(functions[name], [compiled(argument) for argument in arguments])
            paths = [argument.path for argument in arguments if isinstance(argument, Name)]
            if len(paths) < len(arguments):
                return call
            return remembered(f"{name}({','.join(paths)})", call)
        case OneOf(items=items, excluded=excluded):
            bounds = [_bounds(item, compiled) for item in items]
            return _one_of(bounds, None if excluded is None else compiled(excluded))
        case _:
            assert_never(expression)


def _bounds(
    item: Expression | Range, compiled: Callable[[Expression], Getter]
) -> tuple[Getter, Getter]:
    if isinstance(item, Range):
        return compiled(item.low), compiled(item.high)
    getter = compiled(item)
    return getter, getter


def _preference(preferred: Getter) -> Getter:
    def preference(environment: Environment) -> Value:
        value = preferred(environment)
        return Unknown(value) if isinstance(value, int) else UNKNOWN

    return preference


def _negation(operand: Getter) -> Getter:
    def negation(environment: Environment) -> Value:
        value = operand(environment)
        return value if isinstance(value, Pattern) else not value

    return negation


def _minus(operand: Getter) -> Getter:
    def minus(environment: Environment) -> Value:
        value = operand(environment)
        return -value if isinstance(value, int) else UNKNOWN

    return minus


def _chain(expression: Expression, word: str) -> list[Expression]:
    match expression:
        case Binary(operator=operator_, left=left, right=right) if operator_ == word:
            return [*_chain(left, word), *_chain(right, word)]
        case _:
            return [expression]


def _equality(left: Getter, right: Getter) -> Getter:
    fixed = getattr(right, "value", UNKNOWN)
    if not isinstance(fixed, Pattern):
        return _equality_with(left, fixed)

    def equality(environment: Environment) -> Value:
        first, second = left(environment), right(environment)
        if isinstance(first, Pattern):
            first, second = second, first
        if isinstance(second, Pattern):
            possible = isinstance(first, Pattern) or second.admits(first)
            return UNKNOWN if possible else False
        return first == second

    return equality


def _equality_with(left: Getter, fixed: Value) -> Getter:
    """Most comparisons are with a constant."""

    def equality(environment: Environment) -> Value:
        value = left(environment)
        if isinstance(value, Pattern):
            return UNKNOWN if value.admits(fixed) else False
        return value == fixed

    return equality


def _arithmetic(sign: str, left: Getter, right: Getter) -> Getter:
    compare = COMPARED.get(sign)

    def arithmetic(environment: Environment) -> Value:
        first, second = left(environment), right(environment)
        if not isinstance(first, int) or not isinstance(second, int):
            return UNKNOWN
        if compare is not None:
            holds: bool = compare(first, second)
            return holds
        number = calculated(sign, first, second)
        return UNKNOWN if number is None else number

    return arithmetic


def _membership(operand: Getter, bounds: list[tuple[Getter, Getter]]) -> Getter:
    fixed = _fixed_ranges(bounds)

    def membership(environment: Environment) -> Value:
        value = operand(environment)
        ranges = _ranges(bounds, environment) if fixed is None else fixed
        if isinstance(ranges, Unknown):
            return UNKNOWN  # of a bound nothing is known
        if isinstance(value, Pattern):
            return UNKNOWN if compatible(value, ranges) else False
        return ranges.admits(value)

    return membership


def _conditional(condition: Getter, then: Getter, otherwise: Getter) -> Getter:
    def conditional(environment: Environment) -> Value:
        value = condition(environment)
        if isinstance(value, Pattern):
            return _either(then(environment), otherwise(environment))
        return then(environment) if value else otherwise(environment)

    return conditional


def _either(first: Value, second: Value) -> Value:
    """Give what a value may be that is one of two."""
    if first == second:
        return first
    ranges = [_as_ranges(value) for value in (first, second)]
    if None in ranges:
        return UNKNOWN
    return Numbers(tuple(pair for known in ranges for pair in known or ()))


def _as_ranges(value: Value) -> tuple[tuple[int, int], ...] | None:
    if isinstance(value, Pattern):
        return value.ranges if isinstance(value, Numbers) and value.excluded is None else None
    return ((value, value),) if type(value) is int else None


def _call(function: Function, arguments: list[Getter]) -> Getter:
    if len(arguments) == 1:
        (only,) = arguments
        return lambda environment: function(environment, (only(environment),))
    if len(arguments) == 2:  # noqa: PLR2004
        first, second = arguments
        return lambda environment: function(environment, (first(environment), second(environment)))
    return lambda environment: function(
        environment, tuple(argument(environment) for argument in arguments)
    )


def before(name: str) -> str:
    """Give the name under which an input has the value that its parameter had before."""
    return f"before {name}"


def _edge(now: Getter, name: str, *, up: bool) -> Getter:
    earlier = before(name)

    def edge(environment: Environment) -> Value:
        value, past = now(environment), environment.parameters.get(earlier, UNKNOWN)
        if value is not up and not isinstance(value, Pattern):
            return False
        if past is up:
            return False
        return UNKNOWN if isinstance(value, Pattern) or isinstance(past, Pattern) else True

    return edge


def _one_of(bounds: list[tuple[Getter, Getter]], excluded: Getter | None) -> Getter:
    fixed = _fixed_ranges(bounds)

    def one_of(environment: Environment) -> Value:
        ranges = _ranges(bounds, environment) if fixed is None else fixed
        if excluded is None or isinstance(ranges, Unknown):
            return ranges
        without = excluded(environment)
        return Numbers(ranges.ranges, without if isinstance(without, int) else None)

    return one_of


def constant(value: Value) -> Getter:
    """Give the function of a value that is the same everywhere."""

    def getter(_: Environment) -> Value:
        return value

    getter.value = value  # type: ignore[attr-defined]
    return getter


def remembered(name: str, getter: Getter) -> Getter:
    """Give the same function, evaluated once in an environment, where the name is unique."""

    def remember(environment: Environment) -> Value:
        known = environment.memo.get(name)
        if known is None:
            outer, environment.undecided = environment.undecided, set()
            value = getter(environment)
            known = environment.memo[name] = (value, frozenset(environment.undecided))
            environment.undecided = outer
        if known[1]:
            environment.undecided |= known[1]
        return known[0]

    return remember


def _fixed_ranges(bounds: list[tuple[Getter, Getter]]) -> Numbers | Unknown | None:
    """Give the ranges where they are the same everywhere."""
    parts = [getattr(getter, "value", None) for pair in bounds for getter in pair]
    if not all(isinstance(part, int) for part in parts):
        return None
    return _ranges(bounds, Environment((), {}, {}))


def _ranges(bounds: list[tuple[Getter, Getter]], environment: Environment) -> Numbers | Unknown:
    ranges = []
    for low, high in bounds:
        bottom, top = low(environment), high(environment)
        if not isinstance(bottom, int) or not isinstance(top, int):
            return UNKNOWN
        ranges.append((bottom, top))
    return Numbers(tuple(ranges))
