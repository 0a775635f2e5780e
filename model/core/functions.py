"""The functions of byte strings and numbers that texts may call."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from ecatspec.model.core.values import UNKNOWN, Octets, Pattern, Value

if TYPE_CHECKING:
    from ecatspec.model.core.expressions import Function

LONGEST = 1 << 32
"""More bytes than any object has."""


def _join(first: Value, second: Value) -> Value:
    if isinstance(first, bytes) and isinstance(second, bytes):
        return first + second
    if not isinstance(first, bytes) or not isinstance(second, Octets):
        return UNKNOWN
    least, most = (len(first) + length for length in second.lengths)
    if second.content is None:
        # what follows is not known: any bytes, as many as there may be at all
        return Octets((least, most), first, b"\xff" * len(first))
    mask = None if second.mask is None else b"\xff" * len(first) + second.mask
    return Octets((least, most), first + second.content, mask)


def _piece(data: Value, offset: Value, least: Value, most: Value) -> Value:
    if not isinstance(offset, int) or not isinstance(least, int):
        return Octets((0, LONGEST))
    high = max(0, most) if isinstance(most, int) else LONGEST
    match data:
        case bytes():
            return Octets((len(data), len(data)), data).piece(offset, least, high)
        case Octets():
            return data.piece(offset, least, high)
        case Pattern():
            return Octets((least, high))
        case _:
            return UNKNOWN


def _cut(data: Value, count: Value) -> Value:
    if isinstance(data, bytes) and isinstance(count, int):
        return data[:count]
    return UNKNOWN


def _lesser(one: Value, other: Value) -> Value:
    if isinstance(one, int) and isinstance(other, int):
        return min(one, other)
    return UNKNOWN


def _zeros(count: Value) -> Value:
    return bytes(max(0, count)) if isinstance(count, int) else UNKNOWN


def _bit(number: Value, place: Value) -> Value:
    if isinstance(number, int) and isinstance(place, int):
        return place >= 0 and bool(number >> place & 1)
    return UNKNOWN


def _numbered(data: Value, least: Value, most: Value, other: Value) -> Value:
    if not isinstance(data, Pattern):
        return data  # what is known is that
    if not isinstance(least, int) or not isinstance(most, int) or not isinstance(other, int):
        return data
    more = () if least <= other <= most else ((other, other),)
    octets = data if isinstance(data, Octets) else Octets((0, LONGEST))
    return structs.replace(octets, ranges=((least, most), *more))


PLAIN: dict[str, Function] = {
    "length": lambda _, a: len(a[0]) if isinstance(a[0], bytes) else UNKNOWN,
    "join": lambda _, a: _join(a[0], a[1]),
    "cut": lambda _, a: _cut(a[0], a[1]),
    "zeros": lambda _, a: _zeros(a[0]),
    "word": lambda _, a: a[0].to_bytes(2, "little") if isinstance(a[0], int) else UNKNOWN,
    "piece": lambda _, a: _piece(*a),
    "number": lambda _, a: int.from_bytes(a[0], "little") if isinstance(a[0], bytes) else UNKNOWN,
    "bit": lambda _, a: _bit(a[0], a[1]),
    "microseconds": lambda _, a: a[0],
    "numbered": lambda _, a: _numbered(*a),
    "lesser": lambda _, a: _lesser(a[0], a[1]),
}
"""The functions of byte strings and numbers, which need no object dictionary."""
