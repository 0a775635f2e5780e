"""The only place for values of the model: concrete ones, unknown ones, and acceptable sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

ObjectKey: TypeAlias = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Pattern:
    """What a value may be: one of `ranges` (None: anything) but not `excluded`.

    With `lengths` it is a byte string of so many bytes (least, most) that begins like `content`
    (None: anything), with `ranges` too one that is such a number, its lowest byte first; where
    `mask` has a zero bit the content is not known. `into` names where the observed value goes: a
    slot of the state or an object. `preferred` is what the model takes where it has to act itself.
    """

    ranges: tuple[tuple[int, int], ...] | None = None
    excluded: int | None = None
    into: str | ObjectKey | None = None
    lengths: tuple[int, int] | None = None
    content: bytes | None = None
    mask: bytes | None = None
    preferred: int | None = None

    def admits(self, value: Value) -> bool:
        """Tell whether the concrete `value` is acceptable."""
        if self.lengths is not None:
            return isinstance(value, bytes) and self._admits_bytes(value, self.lengths)
        if self.ranges is None:
            return True
        if isinstance(value, bytes | str | Pattern):
            return False
        if value == self.excluded:
            return False
        for low, high in self.ranges:  # noqa: SIM110  it is asked often, and a loop is faster
            if low <= value <= high:
                return True
        return False

    def _admits_bytes(self, value: bytes, lengths: tuple[int, int]) -> bool:
        if not lengths[0] <= len(value) <= lengths[1]:
            return False
        number = int.from_bytes(value, "little") if self.ranges is not None else 0
        if not any(low <= number <= high for low, high in self.ranges or ((0, 0),)):
            return False
        if self.content is None:
            return True
        if self.mask is None:
            return self.content[: len(value)] == value
        # beyond the content nothing is known
        length = min(len(value), len(self.content), len(self.mask))
        seen, wanted, certain = (
            int.from_bytes(each[:length], "little") for each in (value, self.content, self.mask)
        )
        return not (seen ^ wanted) & certain

    def first(self, after: int = -1) -> int:
        """Give the number named first; with `after` the next one above it, or the smallest."""
        if self.ranges is None:
            return 0 if self.preferred is None else self.preferred
        if after < 0 and self.ranges and self.ranges[0][0] != self.excluded:
            return self.ranges[0][0]
        wanted = [n for n in (self._from(after + 1), self._from(0)) if n is not None]
        if not wanted:
            raise ValueError(f"no number is acceptable in {self}")
        return wanted[0]

    def longest(self) -> bytes:
        """Give the longest acceptable byte string."""
        least, most = self.lengths or (0, 0)
        return (self.content or b"")[:most].ljust(least, b"\0")

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

    def piece(self, offset: int, least: int, most: int) -> Pattern:
        """Give what a piece of such a byte string may be, `least` to `most` bytes long.

        Where fewer bytes are left than `least`, those; where `least` is more than `most`, nothing.
        """
        if least > most:
            return Pattern(lengths=(least, most))
        if self.lengths is not None:
            most = min(most, max(0, self.lengths[1] - offset))
        end = offset + most  # what lies behind may be long, and is copied with each piece
        content = None if self.content is None else self.content[offset:end]
        mask = None if self.mask is None else self.mask[offset:end]
        return Pattern(lengths=(min(least, most), most), content=content, mask=mask)


Value: TypeAlias = "int | bool | bytes | str | Pattern"
UNKNOWN = Pattern()


def bits_of(raw: int, low: int, high: int) -> int:
    """Give the bits `low` to `high` of a number, both included."""
    return raw >> low & ((1 << (high - low + 1)) - 1)


def admits(expected: Value, observed: Value) -> bool:
    """Tell whether the concrete `observed` is what `expected` says."""
    if isinstance(expected, Pattern):
        return expected.admits(observed)
    return expected == observed


def is_any(value: Value) -> bool:
    """Tell whether nothing is said of the value."""
    return isinstance(value, Pattern) and value.ranges is None and value.lengths is None


def concrete(value: Value, after: int = -1) -> Value:
    """Give a value that a device may send where `value` is what is acceptable."""
    if not isinstance(value, Pattern):
        return value
    return value.first(after) if value.lengths is None else value.longest()
