"""Arithmetic of the language: what an operation gives, and which expressions are constant."""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any, Final

from ecatspec.spec.language.ir import Binary, Literal, Name, Unary
from ecatspec.spec.language.references import (
    ConstantRef,
    DefinitionRef,
    ParameterRef,
    UnresolvedName,
)
from ecatspec.spec.language.scope import Scope, resolve

if TYPE_CHECKING:
    from collections.abc import Callable

    from ecatspec.spec.language.ir import Expression, Protocol

SIGNS: Final[dict[str, Callable[[Any, Any], Any]]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.floordiv,
    "%": operator.mod,
    "&": operator.and_,
    "|": operator.or_,
}
"""The signs that calculate, and what they make of two numbers; see `calculated` for divisions."""
ARITHMETIC: Final = frozenset(SIGNS)
DIVISIONS: Final = frozenset({"/", "%"})


def calculated(sign: str, left: int, right: int) -> int | None:
    """Give the number that a sign makes of two others; None: nothing is known of it.

    That is so where the divisor is zero. Division rounds down, and what remains has the sign of
    the divisor.
    """
    if sign in DIVISIONS and not right:
        return None
    number: int = SIGNS[sign](left, right)
    return number


def constant(protocol: Protocol, expression: Expression, scope: Scope) -> int | None:
    """Give the number that an expression always is; None: it is not, or that is not seen here."""
    match expression:
        case Literal(value=value):
            return int(value)
        case Unary(operator="-", operand=operand):
            number = constant(protocol, operand, scope)
            return None if number is None else -number
        case Binary(operator=sign, left=left, right=right) if sign in ARITHMETIC:
            first = constant(protocol, left, scope)
            second = constant(protocol, right, scope)
            return None if first is None or second is None else calculated(sign, first, second)
        case Name(path=path):
            try:
                ref = resolve(protocol, path, scope)
            except UnresolvedName:
                return None  # another finding
            match ref:
                case ConstantRef(value=value):
                    return value
                case DefinitionRef(name=name):
                    return constant(protocol, protocol.definitions[name].value, scope)
                case ParameterRef(name=name, part=part):
                    values = protocol.parameters[name].value
                    return constant(protocol, values[1 if part == "length" else 0], Scope())
                case _:
                    return None
        case _:
            return None
