"""The only place for what texts say of objects: existence, size, access, range and value."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

from ecatspec.model.evaluate import Environment, Function
from ecatspec.model.values import UNKNOWN, Pattern, Value
from ecatspec.spec.language.ir import Access, Bool, ObjectEntry, SInt, Text, UInt

if TYPE_CHECKING:
    from ecatspec.model.values import ObjectKey
    from ecatspec.spec.language.ir import Protocol

AlState: TypeAlias = Callable[[Environment], Value]
_Test: TypeAlias = Callable[[ObjectEntry, Environment, tuple[Value, ...]], Value]


class ObjectDictionary:
    """The declared objects of one protocol and the built-in functions over them."""

    def __init__(self, protocol: Protocol, al_state: AlState) -> None:
        """Index the entries; `al_state` tells the AL state of an environment."""
        self.entries: dict[ObjectKey, ObjectEntry] = {
            (entry.index, entry.subindex): entry for entry in protocol.objects
        }
        self.closed = protocol.dictionary.closed
        self._al_state = al_state
        self._states = {row.name: row.value for row in protocol.tables["al_state"].rows}
        self._highest: dict[int, int] = {}
        for index, subindex in self.entries:
            self._highest[index] = max(self._highest.get(index, 0), subindex)
        self.functions: dict[str, Function] = {
            "declared": lambda _, a: (a[0], a[1]) in self.entries,
            "entry_exists": lambda _, a: (a[0], a[1]) in self.entries,
            "object_exists": lambda _, a: a[0] in self._highest,
            "is_plain_variable": lambda _, a: self._highest.get(_number(a[0])) == 0,
            "count_of": lambda _, a: self._highest.get(_number(a[0]), 0),
            "dictionary_closed": lambda _, __: self.closed,
            "length": lambda _, a: len(a[0]) if isinstance(a[0], bytes) else UNKNOWN,
            "readable": self._of_entry(lambda e, _, __: e.access is not Access.WRITE),
            "writable": self._of_entry(lambda e, _, __: _writable(e)),
            "readable_now": self._of_entry(self._readable_now),
            "writable_now": self._of_entry(self._writable_now),
            "is_constant": self._of_entry(lambda e, _, __: e.constant),
            "range_known": self._of_entry(lambda e, _, __: e.low is not None),
            "size_of": self._of_entry(lambda e, _, __: size_of(e)),
            "value_of": self._of_entry(self._value_of),
            "fitted": self._of_entry(lambda e, _, a: _cut(a[2], size_of(e))),
            "in_range": self._of_entry(lambda e, _, a: _compare(e, a[2]) == 0),
            "too_high": self._of_entry(lambda e, _, a: _compare(e, a[2]) > 0),
            "too_low": self._of_entry(lambda e, _, a: _compare(e, a[2]) < 0),
        }

    def highest(self, index: int) -> int:
        """Give the highest declared subindex of an object."""
        return self._highest[index]

    def close(self) -> None:
        """Take it that exactly the declared objects exist, as a device under test declares."""
        self.closed = True

    def _of_entry(self, test: _Test) -> Function:
        def function(environment: Environment, arguments: tuple[Value, ...]) -> Value:
            index, subindex = arguments[0], arguments[1]
            if isinstance(index, Pattern) or isinstance(subindex, Pattern):
                return UNKNOWN
            entry = self.entries.get((_number(index), _number(subindex)))
            return UNKNOWN if entry is None else test(entry, environment, arguments)

        return function

    def _in_state(self, entry: ObjectEntry, environment: Environment) -> Value:
        if not entry.states:
            return True
        now = self._al_state(environment)
        if isinstance(now, Pattern):
            return UNKNOWN
        return now in {self._states[name] for name in entry.states}

    def _readable_now(self, entry: ObjectEntry, _: Environment, __: tuple[Value, ...]) -> Value:
        return entry.access is not Access.WRITE

    def _writable_now(
        self, entry: ObjectEntry, environment: Environment, _: tuple[Value, ...]
    ) -> Value:
        return _writable(entry) and self._in_state(entry, environment)

    def _value_of(
        self, entry: ObjectEntry, environment: Environment, _: tuple[Value, ...]
    ) -> Value:
        key = (entry.index, entry.subindex)
        if entry.constant and entry.default is not None:
            return encode_value(entry, entry.default)
        if entry.volatile:
            return UNKNOWN
        known = environment.objects.get(key)
        return Pattern(into=key) if known is None else known


def _cut(data: Value, size: int) -> Value:
    return data[:size] if isinstance(data, bytes) else UNKNOWN


def _number(value: Value) -> int:
    return value if isinstance(value, int) else -1


def _writable(entry: ObjectEntry) -> bool:
    return entry.access in {Access.WRITE, Access.BOTH}


def size_of(entry: ObjectEntry) -> int:
    """Give the size of an entry in bytes; for a text its maximum."""
    match entry.type:
        case UInt(width=width) | SInt(width=width):
            return (width + 7) // 8
        case Bool():
            return 1
        case Text(maximum=maximum):
            return maximum
        case _:
            raise TypeError(f"{entry.at}: {entry.type} is no type of an object")


def encode_value(entry: ObjectEntry, value: int | str) -> bytes:
    """Give the bytes of a value of this entry as they travel."""
    if isinstance(value, str):
        return value.encode("latin-1")
    size = size_of(entry)
    return (value & ((1 << (8 * size)) - 1)).to_bytes(size, "little")


def decode_value(entry: ObjectEntry, data: bytes) -> int:
    """Give the number that the bytes of this entry hold."""
    signed = isinstance(entry.type, SInt)
    return int.from_bytes(data[: size_of(entry)], "little", signed=signed)


def _compare(entry: ObjectEntry, data: Value) -> int:
    """Tell whether the bytes are below (-1), within (0) or above (1) the range of the entry."""
    if not isinstance(data, bytes) or entry.low is None or entry.high is None:
        return 0
    number = decode_value(entry, data)
    return -1 if number < entry.low else int(number > entry.high)
