"""What `and`, `or` and comparisons make of truths and numbers, also where some are not known.

Logic is three-valued (Kleene): `false and unknown` is false, `true and unknown` is unknown. What is
neither true nor false is unknown: a value of the model, a term of a solver, or None.
"""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

_T = TypeVar("_T")
_E = TypeVar("_E")

LOGIC: Final = {"and": False, "or": True}
"""The words that join truths, and the truth that decides for each whatever the others are."""
COMPARED: Final[dict[str, Callable[[Any, Any], Any]]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
"""The signs that compare, and what they make of two known values."""


def joined(values: Iterable[_T], *, decisive: bool) -> bool | list[_T]:
    """Give the truth that `or` (`decisive` is True) or `and` makes; if unknown, what it rests on.

    No value is asked for behind one that decides.
    """
    unknown = []
    for value in values:
        if value is decisive:
            return decisive
        if not isinstance(value, bool):
            unknown.append(value)
    return unknown or not decisive


def junction(
    parts: Sequence[Callable[[_E], _T]], *, decisive: bool, unknown: _T
) -> Callable[[_E], _T | bool]:
    """Give what `joined` tells, as a function of what each part is a function of."""
    otherwise = not decisive

    def joint(environment: _E) -> _T | bool:
        known = True
        for part in parts:
            value = part(environment)
            if value is decisive:
                return decisive
            if value is not otherwise:
                known = False
        return otherwise if known else unknown

    return joint
