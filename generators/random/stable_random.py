"""Random numbers that are the same in every version of Python."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Sequence

_T = TypeVar("_T")


class Dice:
    """Random numbers from `Random.random` alone, whose sequence every Python keeps."""

    def __init__(self, seed: int) -> None:
        self._random = Random(seed).random  # noqa: S311  nothing here is a secret

    def below(self, bound: int) -> int:
        """Give a number from 0 to `bound` - 1."""
        return int(self._random() * bound)

    def within(self, low: int, high: int) -> int:
        """Give a number from `low` to `high`, both included."""
        return low + self.below(high - low + 1)

    def pick(self, choices: Sequence[_T]) -> _T:
        """Give one of them."""
        return choices[self.below(len(choices))]

    def one_in(self, times: int) -> bool:
        """Tell whether something with a chance of one in `times` happens."""
        return not self.below(times)

    def weighed(self, weights: Sequence[int]) -> int:
        """Give a position, the more often the larger its weight."""
        drawn = self.below(sum(weights))
        for position, weight in enumerate(weights):
            drawn -= weight
            if drawn < 0:
                return position
        raise ValueError("no weight is above 0")

    def data(self, length: int) -> bytes:
        """Give a number of bytes."""
        return bytes(self.below(1 << 8) for _ in range(length))
