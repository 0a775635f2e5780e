"""Values of the model: concrete ones, and what is known of one that is not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Iterable

ObjectKey: TypeAlias = tuple[int, int]
Ranges: TypeAlias = "tuple[tuple[int, int], ...]"


class Pattern:
    """What is known of a value that is not concrete: `Unknown`, `Numbers` or `Octets`."""

    # a plain class: to ask for it takes half as long as to ask for a struct
    __slots__ = ()

    def admits(self, value: Value) -> bool:
        """Tell whether the concrete `value` is acceptable."""
        raise NotImplementedError

    def taken(self, after: int = -1) -> Value:
        """Give what the model takes where it has to act itself; `after` as for `Numbers`."""
        raise NotImplementedError


class Unknown(Pattern, Struct, frozen=True, cache_hash=True):
    """Anything; `preferred` is what the model takes where it has to act itself."""

    preferred: int | None = None

    def admits(self, value: Value) -> bool:  # noqa: ARG002
        """Everything is acceptable."""
        return True

    def taken(self, after: int = -1) -> int:  # noqa: ARG002
        """Give what is preferred, or 0."""
        return 0 if self.preferred is None else self.preferred


class Numbers(Pattern, Struct, frozen=True, cache_hash=True):
    """A number of one of `ranges`, but not `excluded`."""

    ranges: Ranges
    excluded: int | None = None

    def admits(self, value: Value) -> bool:
        """Tell whether `value` is such a number."""
        if isinstance(value, bytes | str | Pattern):
            return False
        return value != self.excluded and _within(value, self.ranges)

    def taken(self, after: int = -1) -> int:
        """Give the number named first; with `after` the next one above it, or the smallest."""
        if after < 0 and self.ranges and self.ranges[0][0] != self.excluded:
            return self.ranges[0][0]
        wanted = [n for n in (self._from(after + 1), self._from(0)) if n is not None]
        if not wanted:
            raise ValueError(f"no number is acceptable in {self}")
        return wanted[0]

    def _from(self, least: int) -> int | None:
        candidates = []
        for low, high in self.ranges:
            number = max(low, least)
            if number == self.excluded:
                number += 1
            if number <= high:
                candidates.append(number)
        return min(candidates, default=None)


class Octets(Pattern, Struct, frozen=True, cache_hash=True):
    """A byte string of `lengths` bytes (least, most) that begins like `content` (None: anything).

    Where `mask` has a zero bit the content is not known. With `ranges` it is one of these numbers,
    its lowest byte first. `into` is the object that has the observed value then.
    """

    lengths: tuple[int, int]
    content: bytes | None = None
    mask: bytes | None = None
    ranges: Ranges | None = None
    into: ObjectKey | None = None

    def admits(self, value: Value) -> bool:
        """Tell whether `value` is such a byte string."""
        if not isinstance(value, bytes) or not self.lengths[0] <= len(value) <= self.lengths[1]:
            return False
        if self.ranges is not None and not _within(int.from_bytes(value, "little"), self.ranges):
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

    def taken(self, after: int = -1) -> bytes:  # noqa: ARG002
        """Give the longest of them."""
        least, most = self.lengths
        return (self.content or b"")[:most].ljust(least, b"\0")

    def piece(self, offset: int, least: int, most: int) -> Octets:
        """Give what a piece of such a byte string may be, `least` to `most` bytes long.

        Where fewer bytes are left than `least`, those; where `least` is more than `most`, nothing.
        """
        if least > most:
            return Octets((least, most))
        most = min(most, max(0, self.lengths[1] - offset))
        end = offset + most  # what lies behind may be long, and is copied with each piece
        content = None if self.content is None else self.content[offset:end]
        mask = None if self.mask is None else self.mask[offset:end]
        return Octets((min(least, most), most), content, mask)


Value: TypeAlias = "int | bool | bytes | str | Unknown | Numbers | Octets"
UNKNOWN: Final = Unknown()
_PATTERNS: Final = frozenset({Unknown, Numbers, Octets})


def _within(number: int, ranges: Ranges) -> bool:
    for low, high in ranges:  # noqa: SIM110  it is asked often, and a loop is faster
        if low <= number <= high:
            return True
    return False


def ranges_of(value: Value) -> Ranges | None:
    """Give the ranges of a number or of a byte string that is one; None: none are stated."""
    return value.ranges if isinstance(value, Numbers | Octets) else None


def compatible(one: Value, other: Value) -> bool:
    """Tell whether some value is acceptable to both, as far as ranges of numbers show it."""
    first, second = ranges_of(one), ranges_of(other)
    if first is None or second is None:
        return True
    return any(low <= top and bottom <= high for low, high in first for bottom, top in second)


def bits_of(raw: int, low: int, high: int) -> int:
    """Give the bits `low` to `high` of a number, both included."""
    return raw >> low & ((1 << (high - low + 1)) - 1)


def admits(expected: Value, observed: Value) -> bool:
    """Tell whether the concrete `observed` is what `expected` says."""
    if isinstance(expected, Pattern):
        return expected.admits(observed)
    return expected == observed


def any_open(values: Iterable[Value | None]) -> bool:
    """Tell whether one of the values is not concrete."""
    return not _PATTERNS.isdisjoint(map(type, values))


def concrete(value: Value, after: int = -1) -> Value:
    """Give a value that a device may send where `value` is what is acceptable."""
    return value.taken(after) if isinstance(value, Pattern) else value
