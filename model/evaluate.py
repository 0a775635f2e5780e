"""The only place for what an expression means: expressions become functions of an environment.

Logic is three-valued (Kleene): a comparison with an unknown value is unknown, `false and unknown`
is false. Unknown is `UNKNOWN`; a guard that is unknown may hold or not.
"""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, TypeAlias, assert_never

from ecatspec.model.values import UNKNOWN, Pattern, Value
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

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

Getter: TypeAlias = "Callable[[Environment], Value]"
Lookup: TypeAlias = "Callable[[Name], Getter]"
Function: TypeAlias = "Callable[[Environment, tuple[Value, ...]], Value]"


class Environment:
    """What an expression sees: the values of one state and the parameters of one input."""

    __slots__ = ("objects", "parameters", "slots", "undecided")

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


_NUMERIC: dict[str, Callable[[int, int], Value]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.floordiv,
    "%": operator.mod,
    "&": operator.and_,
    "|": operator.or_,
}


def compile_expression(
    expression: Expression, lookup: Lookup, functions: Mapping[str, Function]
) -> Getter:
    """Turn an expression into a function of an environment; names are looked up once, here."""

    def compiled(part: Expression) -> Getter:
        return compile_expression(part, lookup, functions)

    match expression:
        case Literal(value=constant):
            return lambda _: constant
        case Name():
            return lookup(expression)
        case AnyValue(preferred=preferred):
            return (lambda _: UNKNOWN) if preferred is None else _preference(compiled(preferred))
        case Unary(operator="not", operand=operand):
            return _negation(compiled(operand))
        case Unary(operand=operand):
            return _minus(compiled(operand))
        case Binary(operator="and", left=left, right=right):
            return _junction(compiled(left), compiled(right), decisive=False)
        case Binary(operator="or", left=left, right=right):
            return _junction(compiled(left), compiled(right), decisive=True)
        case Binary(operator="==", left=left, right=right):
            return _equality(compiled(left), compiled(right))
        case Binary(operator="!=", left=left, right=right):
            return _negation(_equality(compiled(left), compiled(right)))
        case Binary(operator=symbol, left=left, right=right):
            return _arithmetic(_NUMERIC[symbol], compiled(left), compiled(right))
        case In(operand=operand, items=items):
            return _membership(compiled(operand), [_bounds(item, compiled) for item in items])
        case Conditional(condition=condition, then=then, otherwise=otherwise):
            return _conditional(compiled(condition), compiled(then), compiled(otherwise))
        case Call(function=name, arguments=arguments):
            return _call(functions[name], [compiled(argument) for argument in arguments])
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
        return Pattern(preferred=value) if isinstance(value, int) else UNKNOWN

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


def _junction(left: Getter, right: Getter, *, decisive: bool) -> Getter:
    def junction(environment: Environment) -> Value:
        first = left(environment)
        if first is decisive:
            return decisive
        second = right(environment)
        if second is decisive:
            return decisive
        return UNKNOWN if isinstance(first, Pattern) or isinstance(second, Pattern) else second

    return junction


def _equality(left: Getter, right: Getter) -> Getter:
    def equality(environment: Environment) -> Value:
        first, second = left(environment), right(environment)
        if isinstance(first, Pattern):
            first, second = second, first
        if isinstance(second, Pattern):
            possible = isinstance(first, Pattern) or second.admits(first)
            return UNKNOWN if possible else False
        return first == second

    return equality


def _arithmetic(function: Callable[[int, int], Value], left: Getter, right: Getter) -> Getter:
    def arithmetic(environment: Environment) -> Value:
        first, second = left(environment), right(environment)
        if isinstance(first, int) and isinstance(second, int):
            return function(first, second)
        return UNKNOWN

    return arithmetic


def _membership(operand: Getter, bounds: list[tuple[Getter, Getter]]) -> Getter:
    def membership(environment: Environment) -> Value:
        value = operand(environment)
        ranges = _ranges(bounds, environment)
        if isinstance(value, Pattern):
            return UNKNOWN if value.narrowed(ranges) else False
        return ranges.admits(value)

    return membership


def _conditional(condition: Getter, then: Getter, otherwise: Getter) -> Getter:
    def conditional(environment: Environment) -> Value:
        value = condition(environment)
        if isinstance(value, Pattern):
            first, second = then(environment), otherwise(environment)
            return first if first == second else UNKNOWN
        return then(environment) if value else otherwise(environment)

    return conditional


def _call(function: Function, arguments: list[Getter]) -> Getter:
    return lambda environment: function(
        environment, tuple(argument(environment) for argument in arguments)
    )


def _one_of(bounds: list[tuple[Getter, Getter]], excluded: Getter | None) -> Getter:
    def one_of(environment: Environment) -> Value:
        ranges = _ranges(bounds, environment)
        if excluded is None:
            return ranges
        without = excluded(environment)
        return Pattern(ranges.ranges, without if isinstance(without, int) else None)

    return one_of


def _ranges(bounds: list[tuple[Getter, Getter]], environment: Environment) -> Pattern:
    ranges = []
    for low, high in bounds:
        bottom, top = low(environment), high(environment)
        if not isinstance(bottom, int) or not isinstance(top, int):
            return UNKNOWN
        ranges.append((bottom, top))
    return Pattern(tuple(ranges))
