"""The only place for values of the model: concrete ones, unknown ones, and acceptable sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

ObjectKey: TypeAlias = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Pattern:
    """What a value may be: one of `ranges` (None: anything) but not `excluded`.

    `into` names where the observed value goes: a slot of the state or an object.
    """

    ranges: tuple[tuple[int, int], ...] | None = None
    excluded: int | None = None
    into: str | ObjectKey | None = None

    def admits(self, value: Value) -> bool:
        """Tell whether the concrete `value` is acceptable."""
        if self.ranges is None:
            return True
        if isinstance(value, bytes | str | Pattern):
            return False
        return value != self.excluded and any(low <= value <= high for low, high in self.ranges)

    def first(self, after: int = 0) -> int:
        """Give the smallest acceptable number above `after`, wrapping to the smallest of all."""
        if self.ranges is None:
            return 0
        wanted = [n for n in (self._from(after + 1), self._from(0)) if n is not None]
        if not wanted:
            raise ValueError(f"no number is acceptable in {self}")
        return wanted[0]

    def _from(self, least: int) -> int | None:
        candidates = []
        for low, high in self.ranges or ():
            number = max(low, least)
            if number == self.excluded:
                number += 1
            if number <= high:
                candidates.append(number)
        return min(candidates, default=None)

    def narrowed(self, other: Pattern) -> bool:
        """Tell whether some value is acceptable to both."""
        if self.ranges is None or other.ranges is None:
            return True
        return any(
            low <= top and bottom <= high
            for low, high in self.ranges
            for bottom, top in other.ranges
        )


Value: TypeAlias = "int | bool | bytes | str | Pattern"
UNKNOWN = Pattern()


def admits(expected: Value, observed: Value) -> bool:
    """Tell whether the concrete `observed` is what `expected` says."""
    if isinstance(expected, Pattern):
        return expected.admits(observed)
    return expected == observed
