"""What an expression is made of: nodes and names."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, assert_never, cast

from ecatspec.spec.language.ir import (
    AnyValue,
    Binary,
    Call,
    Conditional,
    In,
    Literal,
    Name,
    OneOf,
    Range,
    Unary,
)

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterator

    from ecatspec.spec.language.ir import Expression


def nodes_in(node: object) -> Iterator[object]:
    """All parts of a declaration, itself included, wherever they stand in it."""
    rest = [node]
    while rest:
        part = rest.pop()
        if isinstance(part, tuple):
            rest += reversed(part)
            continue
        names = _names_of_fields(cast("Hashable", type(part)))  # mypy 2 doubts it
        if names is not None:
            yield part
            rest += (getattr(part, name) for name in names)


@cache
def _names_of_fields(kind: Hashable) -> tuple[str, ...] | None:
    """The fields of a dataclass, the last first; None: it is none."""
    return tuple(f.name for f in reversed(fields(kind))) if is_dataclass(kind) else None


def names_in(expression: Expression | Range) -> Iterator[str]:
    """All names that an expression mentions, of functions not."""
    match expression:
        case Name(path):
            yield path
        case _:
            for part in parts_of(expression):
                yield from names_in(part)


def parts_of(expression: Expression | Range) -> tuple[Expression | Range, ...]:
    """What an expression is made of."""
    match expression:
        case Literal() | Name():
            return ()
        case AnyValue(preferred):
            return () if preferred is None else (preferred,)
        case Unary():
            return (expression.operand,)
        case Binary():
            return expression.left, expression.right
        case Range():
            return expression.low, expression.high
        case In():
            return (expression.operand, *expression.items)
        case Conditional():
            return expression.condition, expression.then, expression.otherwise
        case Call():
            return expression.arguments
        case OneOf():
            excluded = () if expression.excluded is None else (expression.excluded,)
            return (*expression.items, *excluded)
        case _:
            assert_never(expression)
