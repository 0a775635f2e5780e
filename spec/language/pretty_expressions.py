"""Writes expressions and types as they are written in a text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from ecatspec.spec.language.build_expressions import MICROSECONDS, TIME_DIGITS
from ecatspec.spec.language.ir import (
    AnyValue,
    Area,
    Binary,
    Bool,
    Bytes,
    Call,
    Clause,
    Close,
    Conditional,
    Confirm,
    Dictionary,
    EsiEntry,
    In,
    Literal,
    Manual,
    Name,
    Named,
    ObjectEntry,
    OneOf,
    Open,
    Parameter,
    Pin,
    Range,
    Remove,
    SetParameter,
    SInt,
    Text,
    Time,
    Type,
    UInt,
    Unary,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ecatspec.spec.language.ir import Expression


Line: TypeAlias = (
    Clause
    | Manual
    | Parameter
    | SetParameter
    | ObjectEntry
    | EsiEntry
    | Dictionary
    | Pin
    | Open
    | Confirm
    | Close
    | Remove
)
"""Declarations of one line, which stand under each other without an empty line."""
WIDTH: Final = 100
DECIMAL: Final = 16
"""Tables whose values are all below are written in decimal."""


# How tightly an operator binds; what binds looser than its place asks for gets parentheses.
_LOOSEST: Final = 0
_OR: Final = 1
_AND: Final = 2
_NOT: Final = 3
_COMPARISON: Final = 4
_SUM: Final = 5
_PRODUCT: Final = 6
_PREFIX: Final = 7
_ATOM: Final = 8
_BINDING: Final = (
    {"or": _OR, "and": _AND} | dict.fromkeys("+-|&", _SUM) | dict.fromkeys("*/%", _PRODUCT)
)


def pretty_expression(expression: Expression | Range, place: int = _LOOSEST) -> str:
    """An expression with no more parentheses than its place asks for."""
    words, binding = _expression(expression)
    return words if binding >= place else f"({words})"


def _expression(expression: Expression | Range) -> tuple[str, int]:
    binding = _ATOM
    match expression:
        case Literal(value, digits):
            words = _literal(value, digits)
        case Name(path):
            words = path
        case Unary("not", operand):
            words, binding = f"not {pretty_expression(operand, _NOT)}", _NOT
        case Unary(_, operand):
            words, binding = f"-{pretty_expression(operand, _PREFIX)}", _PREFIX
        case Binary(operator, left, right):
            binding = _BINDING.get(operator, _COMPARISON)
            before = binding + (binding == _COMPARISON)
            one, other = pretty_expression(left, before), pretty_expression(right, binding + 1)
            words = f"{one} {operator} {other}"
        case In(operand, items):
            words, binding = f"{pretty_expression(operand, _SUM)} in {set_text(items)}", _COMPARISON
        case Conditional(condition, then, otherwise):
            parts = (pretty_expression(part) for part in (condition, then, otherwise))
            words, binding = "if {} then {} else {}".format(*parts), _LOOSEST
        case Call(function, arguments):
            words = f"{function}({', '.join(map(pretty_expression, arguments))})"
        case OneOf(items, excluded):
            words = f"one of {set_text(items)}"
            if excluded is not None:
                words += f" except {pretty_expression(excluded, _PREFIX)}"
        case AnyValue(preferred):
            words = "any"
            if preferred is not None:
                words += f" preferably {pretty_expression(preferred, _PREFIX)}"
        case Range(low, high):
            words = f"{pretty_expression(low)}..{pretty_expression(high)}"
        case _:
            assert_never(expression)
    return words, binding


def _literal(value: int, digits: int) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"0x{value:0{digits}X}" if digits > 0 else str(value)


def set_text(items: Iterable[Expression | Range]) -> str:
    """Give a set as it is written."""
    words = ", ".join(map(pretty_expression, items))
    return f"{{ {words} }}" if words else "{ }"


def _chain(expression: Expression, operator: str) -> list[Expression]:
    match expression:
        case Binary(own, left, right) if own == operator:
            return [*_chain(left, operator), right]
        case _:
            return [expression]


def paragraph_of(word: str, expression: Expression) -> list[str]:
    """A guard; one that is too long for a line is broken at its outermost `and` or `or`."""
    return broken_text(f"  {word:<6} ", "         ", expression)


def broken_text(start: str, indent: str, expression: Expression) -> list[str]:
    """Give an expression on as many lines as it needs, the first behind `start`."""
    line = start + pretty_expression(expression)
    if len(line) <= WIDTH or not isinstance(expression, Binary):
        return [line]
    operator = expression.operator
    if operator not in {"and", "or"}:
        return [line]
    first, *rest = _chain(expression, operator)
    binding = _BINDING[operator]
    lines = [start + pretty_expression(first, binding)]
    return lines + [f"{indent}{operator} {pretty_expression(e, binding + 1)}" for e in rest]


def pretty_type(kind: Type) -> str:
    """A type as it is written after a colon."""
    match kind:
        case UInt(width):
            return f"u{width}"
        case SInt(width):
            return f"i{width}"
        case Bool():
            return "bool"
        case Named(table):
            return table
        case Bytes(length):
            return "bytes" if length is None else f"bytes({pretty_expression(length)})"
        case Text(maximum):
            return f"text({maximum})"
        case Area():
            return "area"
        case Time():
            return "time"
        case _:
            assert_never(kind)


def ids_text(clauses: Sequence[str]) -> str:
    """Give the clauses of a declaration in brackets; nothing without any."""
    return f"[{', '.join(clauses)}]" if clauses else ""


def value_of_parameter(value: tuple[Expression, ...], kind: Type | None) -> str:
    """Give the value of a parameter as it is written."""
    match value:
        case (Literal(number, digits),) if digits == TIME_DIGITS or isinstance(kind, Time):
            if not isinstance(number, bool):
                unit = next(u for u in ("s", "ms", "us") if number % MICROSECONDS[u] == 0)
                return f"{number // MICROSECONDS[unit]} {unit}"
        case (start, length):
            return f"area({pretty_expression(start)}, {pretty_expression(length)})"
        case _:
            pass
    return pretty_expression(value[0])


def in_columns(rows: Sequence[Sequence[str]], indent: str = "") -> list[str]:
    """Rows of a table, each column as wide as its widest cell."""
    if not rows:
        return []
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = (
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True) if width)
        for row in rows
    )
    return [f"{indent}{line}".rstrip() for line in lines]


def hex_text(value: int, digits: int) -> str:
    """Give a number in hexadecimal, with that number of digits at least."""
    return f"0x{value:0{digits}X}"
