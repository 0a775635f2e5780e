"""The object dictionary of the texts: existence, size, access, range and value."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Final, TypeAlias

from ecatspec.model.core.expressions import Environment, Function
from ecatspec.model.core.functions import LONGEST
from ecatspec.model.core.values import UNKNOWN, Numbers, Octets, Pattern, Value
from ecatspec.spec.language.ir import Access, Bool, Bytes, Literal, ObjectEntry, SInt, Text, UInt

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.values import ObjectKey
    from ecatspec.spec.language.ir import Protocol

AlState: TypeAlias = Callable[[Environment], Value]
_Test: TypeAlias = Callable[[ObjectEntry, Environment, tuple[Value, ...]], Value]
_BYTE = 8
_HIGHEST = (1 << _BYTE) - 1
"""The highest subindex that can be."""
_OWN_TYPE = "own_type"
"""The row from which on devices number types of their own."""
_ENTRY = "pdo_entry"


class ObjectDictionary:
    """The declared objects of one protocol and the built-in functions over them.

    `exact`: a device asks for its own objects, whose values it knows; else somebody watches it,
    who must accept every form in which the value may come.
    """

    def __init__(
        self, protocol: Protocol, al_state: AlState, *, exact: bool, closed: bool = False
    ) -> None:
        """Index the entries; `al_state` tells the AL state of an environment.

        `closed`: exactly the declared objects exist, even if the text does not say so.
        """
        self.entries: dict[ObjectKey, ObjectEntry] = {
            (entry.index, entry.subindex): entry for entry in protocol.objects
        }
        self.closed: Final = closed or protocol.dictionary.closed
        self._exact = exact
        self._al_state = al_state
        self._states = {row.name: row.value for row in protocol.tables["al_state"].rows}
        self._types = _rows(protocol, "data_type")
        self._last_type = (1 << protocol.tables["data_type"].width) - 1
        self._codes = _rows(protocol, "object_code")
        self._lists = _rows(protocol, "object_list_type")
        layout = () if _ENTRY not in protocol.words else protocol.words[_ENTRY].fields
        counts = (f for f in layout if f.name == "bit_length")
        self._bits = next(((f.low, f.high - f.low + 1) for f in counts), None)
        """Where a mapping entry has its number of bits: the lowest of them, and how many."""
        self.shown: dict[ObjectKey, Callable[[Environment], Value]] = {}
        """What objects read as whose bits the texts show."""
        self._highest: dict[int, int] = {}
        for index, subindex in self.entries:
            self._highest[index] = max(self._highest.get(index, 0), subindex)
        self.functions: dict[str, Function] = {
            "declared": _of_known(lambda _, a: (a[0], a[1]) in self.entries),
            "object_exists": _of_known(lambda _, a: a[0] in self._highest),
            "is_plain_variable": _of_known(lambda _, a: self._highest.get(_number(a[0])) == 0),
            "dictionary_closed": lambda _, __: self.closed,
            "in_work": lambda e, _: e.parameters.get(CROWDED, False),
            "readable": self._of_entry(lambda e, _, __: e.access is not Access.WRITE),
            "writable": self._of_entry(lambda e, _, __: _writable(e)),
            "readable_now": self._of_entry(
                lambda e, env, _: self._readable(e, self._al_state(env))
            ),
            "writable_now": self._of_entry(
                lambda e, env, _: self._writable(e, self._al_state(env))
            ),
            "readable_in": self._of_entry(lambda e, _, a: self._readable(e, a[2])),
            "writable_in": self._of_entry(lambda e, _, a: self._writable(e, a[2])),
            "range_known": self._of_entry(lambda e, _, __: e.low is not None),
            "size_of": self._of_entry(lambda e, _, __: size_of(e)),
            "size_varies": self._of_entry(lambda e, _, __: size_varies(e)),
            "size_unsaid": self._of_entry(lambda e, _, __: size_varies(e) and not e.varying),
            "size_allowed": self._of_entry(lambda e, _, a: _size_allowed(e, a[2])),
            "present_size": self._of_entry(self._present_size),
            "value_of": self._of_entry(self._value_of),
            "has_value": self._of_entry(self._has_value),
            "number_of": self._of_entry(self._number_of),
            "in_range": self._of_entry(lambda e, _, a: _compare(e, a[2]) == 0),
            "too_high": self._of_entry(lambda e, _, a: _compare(e, a[2]) > 0),
            "too_low": self._of_entry(lambda e, _, a: _compare(e, a[2]) < 0),
            "complete_size": _of_known(
                lambda _, a: self._complete_size(_number(a[0]), _number(a[1]))
            ),
            "counted_size": _of_known(self._counted_size),
            "complete_value": _of_known(self._complete_value),
            "complete_in_range": _of_known(lambda _, a: self._complete_in_range(*a)),
            "complete_readable": _of_known(self._complete_readable),
            "complete_writable": _of_known(self._complete_writable),
            "object_list": _of_known(lambda _, a: self._object_list(_number(a[0]))),
            "object_code_of": _of_known(lambda _, a: self._object_code(_number(a[0]))),
            "highest_subindex": _of_known(
                lambda _, a: self._highest_told(self._highest.get(_number(a[0]), 0))
            ),
            "mappable": self._of_entry(
                lambda e, _, __: e.mappable if e.mappable or self._exact else UNKNOWN
            ),
            "data_type_of": self._of_entry(lambda e, _, __: self._data_type(e)),
            "bit_length_of": self._of_entry(lambda e, _, __: self._bit_length(e)),
        }

    def highest(self, index: int) -> int:
        """Give the highest declared subindex of an object."""
        return self._highest[index]

    def _of_entry(self, test: _Test) -> Function:
        def function(environment: Environment, arguments: tuple[Value, ...]) -> Value:
            entry = self.entries.get((_number(arguments[0]), _number(arguments[1])))
            return UNKNOWN if entry is None else test(entry, environment, arguments)

        return _of_known(function)

    def _highest_told(self, value: int) -> Value:
        """What a device tells; one with entries of its own may have a higher one."""
        return value if self._exact or self.closed else Numbers(((value, _HIGHEST),))

    # --- access -----------------------------------------------------------------------------------

    def _in_state(self, states: tuple[str, ...], state: Value) -> Value:
        if not states:
            return True
        if isinstance(state, Pattern):
            return UNKNOWN
        return state in {self._states[name] for name in states}

    def _readable(self, entry: ObjectEntry, state: Value) -> Value:
        return entry.access is not Access.WRITE and self._in_state(entry.read_states, state)

    def _writable(self, entry: ObjectEntry, state: Value) -> Value:
        return _writable(entry) and self._in_state(entry.states, state)

    # --- one entry --------------------------------------------------------------------------------

    def _present_size(
        self, entry: ObjectEntry, environment: Environment, _: tuple[Value, ...]
    ) -> Value:
        most = size_of(entry)
        if not size_varies(entry):
            return most
        known = self._known(entry, environment)
        if self._exact:
            return len(known or b"")
        return Numbers(((len(known or b""), most),))

    def _value_of(
        self, entry: ObjectEntry, environment: Environment, _: tuple[Value, ...]
    ) -> Value:
        shown = self.shown.get((entry.index, entry.subindex))
        if shown is not None:
            return shown(environment)
        known = self._known(entry, environment)
        most = size_of(entry)
        least = 0 if size_varies(entry) else most
        if known is None:
            into = None if entry.volatile else (entry.index, entry.subindex)
            content, mask = self._mapping(entry)
            return Octets((least, most), content, mask, into=into)
        if self._exact or not size_varies(entry):
            return known
        # behind a byte string that was written lie zeros, or what was there before
        return _padded(known, most, open_end=isinstance(entry.type, Bytes) and _writable(entry))

    def _mapping(self, entry: ObjectEntry) -> tuple[bytes | None, bytes | None]:
        """Give the bytes, and which bits of them are sure, of a mapping entry."""
        if entry.maps is None or entry.access is not Access.READ or self._bits is None:
            return None, None
        low, width = self._bits
        size = size_of(entry)
        mask = (1 << width) - 1 << low
        return (entry.maps << low).to_bytes(size, "little"), mask.to_bytes(size, "little")

    def known(self, environment: Environment, key: ObjectKey) -> bytes | None:
        """Give the present value of an entry as bytes; None where it is not known."""
        entry = self.entries.get(key)
        return None if entry is None else self._known(entry, environment)

    def _number_of(
        self, entry: ObjectEntry, environment: Environment, _: tuple[Value, ...]
    ) -> Value:
        known = self._known(entry, environment)
        return UNKNOWN if known is None else decode_value(entry, known)

    def _has_value(
        self, entry: ObjectEntry, environment: Environment, arguments: tuple[Value, ...]
    ) -> Value:
        known = self._known(entry, environment)
        return UNKNOWN if known is None else known == arguments[2]

    def _known(self, entry: ObjectEntry, environment: Environment) -> bytes | None:
        if entry.constant and entry.default is not None:
            return encode_value(entry, entry.default)
        if entry.volatile and not self._exact:
            return None
        return environment.objects.get((entry.index, entry.subindex))

    # --- complete access --------------------------------------------------------------------------

    def _layout(self, index: int, first: int) -> Iterator[tuple[ObjectEntry, int]]:
        """Yield the entries from subindex `first` on and the bytes that each takes."""
        for subindex in range(first, self._highest.get(index, -1) + 1):
            entry = self.entries.get((index, subindex))
            if entry is not None:
                yield entry, 2 * size_of(entry) if subindex == 0 else size_of(entry)

    def _complete_known(self, index: int) -> bool:
        """Tell whether the layout follows from the texts: no gaps, nothing smaller than a byte."""
        entries = [entry for entry, _ in self._layout(index, 0)]
        whole = all(_whole(entry) for entry in entries)
        return whole and (self.closed or self._exact) and self._gapless(index)

    def _gapless(self, index: int) -> bool:
        return all((index, number) in self.entries for number in range(self._highest[index] + 1))

    def _complete_size(self, index: int, first: int) -> Value:
        if not (self._exact or self._complete_known(index)):
            return UNKNOWN
        return sum(size for _, size in self._layout(index, first))

    def _counted_size(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        index, first = _number(arguments[0]), _number(arguments[1])
        counter = self.entries.get((index, 0))
        if counter is None or not (self._exact or self._complete_known(index)):
            return UNKNOWN
        count = self._number_of(counter, environment, ())
        if not isinstance(count, int):
            return UNKNOWN
        return sum(size for entry, size in self._layout(index, first) if entry.subindex <= count)

    def _complete_value(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        index, first = _number(arguments[0]), _number(arguments[1])
        if not (self._exact or self._complete_known(index)):
            return Octets((0, LONGEST))
        content, mask = b"", b""
        for entry, size in self._layout(index, first):
            known = bytes(size) if entry.access is Access.WRITE else None
            if self._readable(entry, self._al_state(environment)) is True:
                value = self._value_of(entry, environment, ())
                known = value if isinstance(value, bytes) else None
            if self._exact:
                known = known or b""
            content += (known or b"").ljust(size, b"\0")
            mask += (b"\0" if known is None else b"\xff") * size
        if self._exact:
            return content
        return Octets((len(content), len(content)), content, mask)

    def _complete_readable(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        return self._complete_right(self._readable, environment, arguments)

    def _complete_writable(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        return self._complete_right(self._writable, environment, arguments)

    def _complete_right(
        self,
        right: Callable[[ObjectEntry, Value], Value],
        environment: Environment,
        arguments: tuple[Value, ...],
    ) -> Value:
        now = self._al_state(environment)
        layout = self._layout(_number(arguments[0]), _number(arguments[1]))
        rights = [right(entry, now) for entry, _ in layout]
        return UNKNOWN if any(isinstance(r, Pattern) for r in rights) else all(rights)

    def split(
        self, environment: Environment, index: int, first: int, data: bytes
    ) -> Iterator[tuple[ObjectKey, bytes]]:
        """Yield what a complete download of `data` writes; entries that cannot be are skipped."""
        offset = 0
        for entry, size in self._layout(index, first):
            part, offset = data[offset : offset + size], offset + size
            now = self._writable(entry, self._al_state(environment))
            if now is True and len(part) == size:
                held = part[: size_of(entry)]
                if size_varies(entry):
                    held = held.rstrip(b"\0")
                yield (entry.index, entry.subindex), held

    def written_from(
        self, index: int, first: int, length: int | None = None
    ) -> Iterator[ObjectKey]:
        """Yield what a complete download from subindex `first` on can write, if only in part.

        `length` is the most that it brings in bytes; None: as much as the object takes.
        """
        bounded = length if self._exact or self._complete_known(index) else None
        offset = 0
        for entry, size in self._layout(index, first):
            if _writable(entry) and not (bounded is not None and offset >= bounded):
                yield entry.index, entry.subindex
            offset += size

    def _complete_in_range(self, index: Value, first: Value, data: Value) -> Value:
        if not isinstance(data, bytes):
            return UNKNOWN
        offset = 0
        for entry, size in self._layout(_number(index), _number(first)):
            part, offset = data[offset : offset + size], offset + size
            if _writable(entry) and len(part) == size and _compare(entry, part):
                return False
        return True

    # --- SDO information --------------------------------------------------------------------------

    def _object_list(self, kind: int) -> Value:
        listed = b"".join(index.to_bytes(2, "little") for index in sorted(self._highest))
        if kind == self._lists["all"]:
            if self._exact or self.closed:
                return listed
        elif self._exact:
            counts = (len(self._highest), 0, 0, 0, 0)
            told = b"".join(count.to_bytes(2, "little") for count in counts)
            return told if kind == self._lists["lengths"] else b""
        return Octets((0, LONGEST))

    def _object_code(self, index: int) -> Value:
        if self._highest.get(index):
            if self._exact:
                return self._codes["record"]
            return Numbers(((self._codes["array"], self._codes["record"]),))
        variable, block = self._codes["variable"], self._codes.get("domain")
        if self._exact:
            return variable
        entry = self.entries.get((index, 0))
        if not self.closed or entry is None:
            return UNKNOWN  # there may be other entries
        if isinstance(entry.type, Bytes) and block is not None:
            return Numbers(((variable, variable), (block, block)))
        return variable

    def _data_type(self, entry: ObjectEntry) -> Value:
        """Give the number of the type; the same bits may have one of several names."""
        known = [self._types[name] for name in type_names(entry) if name in self._types]
        own = self._types.get(_OWN_TYPE)
        if self._exact:
            return known[0] if known else own or 0
        ranges = tuple((number, number) for number in known)
        return Numbers(ranges if own is None else (*ranges, (own, self._last_type)))

    def _bit_length(self, entry: ObjectEntry) -> Value:
        if size_varies(entry) and not self._exact:
            return UNKNOWN
        match entry.type:
            case UInt(width=width) | SInt(width=width):
                return width
            case Bool() if not self._exact:
                return Numbers(((1, 1), (_BYTE, _BYTE)))  # a truth may have a byte of its own
            case Bool():
                return 1
            case _:
                return _BYTE * size_of(entry) % (1 << 16)


CROWDED = "request in work"
"""The parameter of a mailbox input that tells whether an earlier one was unanswered."""


def _rows(protocol: Protocol, table: str) -> dict[str, int]:
    return {row.name: row.value for row in protocol.tables[table].rows}


def _of_known(function: Function) -> Function:
    """Give the same function, whose answer is unknown where it is not known of what object."""

    def ask(environment: Environment, arguments: tuple[Value, ...]) -> Value:
        for place in arguments[:2]:
            if isinstance(place, Pattern):
                return UNKNOWN
        return function(environment, arguments)

    return ask


def _number(value: Value) -> int:
    return value if isinstance(value, int) else -1


def _writable(entry: ObjectEntry) -> bool:
    return entry.access in {Access.WRITE, Access.BOTH}


def size_of(entry: ObjectEntry) -> int:
    """Give the size of an entry in bytes; for a text or byte string its maximum."""
    match entry.type:
        case UInt(width=width) | SInt(width=width):
            return (width + 7) // _BYTE
        case Bool():
            return 1
        case Text(maximum=maximum):
            return maximum
        case Bytes(length=Literal(value=maximum)):
            return maximum
        case _:
            raise TypeError(f"{entry.at}: {entry.type} is no type of an object")


def size_varies(entry: ObjectEntry) -> bool:
    """Tell whether the entry may hold fewer bytes than its maximum."""
    return isinstance(entry.type, Text | Bytes) and not entry.fixed


def type_names(entry: ObjectEntry) -> tuple[str, ...]:
    """Give the rows of the table of data types that an entry may have, the usual one first."""
    match entry.type:
        case Bool():
            return "boolean", "bit1"
        case Text():
            return "visible_string", "unicode_string"
        case Bytes():
            return "octet_string", *_BLOCKS
        case UInt(width=width):
            alike = (f"bit{width}", f"bit_array{width}", _OF_BITS.get(width, ""), f"real{width}")
            return f"unsigned{width}", *alike
        case SInt(width=width):
            return f"integer{width}", f"real{width}"
        case _:
            raise TypeError(f"{entry.at}: {entry.type} is no type of an object")


_OF_BITS = {8: "byte_type", 16: "word_type", 32: "double_word_type"}
"""Types that are bits rather than numbers."""
_BLOCKS = (
    *("unicode_string", "domain_type", "time_of_day", "time_difference"),
    *("array_of_int", "array_of_sint", "array_of_dint", "array_of_udint"),
)
"""Types for which the texts have no other word than bytes."""


def _whole(entry: ObjectEntry) -> bool:
    """Tell whether an entry has whole bytes."""
    kind = entry.type
    return not isinstance(kind, Bool) and not (isinstance(kind, UInt | SInt) and kind.width % _BYTE)


def encode_value(entry: ObjectEntry, value: int | str) -> bytes:
    """Give the bytes of a value of this entry as they travel."""
    if isinstance(value, str):
        return value.encode("latin-1").ljust(size_of(entry) if entry.fixed else 0, b"\0")
    if size_varies(entry):
        return b""
    size = size_of(entry)
    return (value & ((1 << (_BYTE * size)) - 1)).to_bytes(size, "little")


def decode_value(entry: ObjectEntry, data: bytes) -> int:
    """Give the number that the bytes of this entry hold."""
    signed = isinstance(entry.type, SInt)
    return int.from_bytes(data[: size_of(entry)], "little", signed=signed)


@lru_cache(maxsize=4)
def _padded(known: bytes, most: int, *, open_end: bool) -> Octets:
    """Give what is known of a byte string of up to `most` bytes.

    It is asked for each segment of a transfer, and a long value is copied for it.
    """
    mask = (b"\xff" * len(known)).ljust(most, b"\0") if open_end else None
    return Octets((len(known), most), known.ljust(most, b"\0"), mask)


def _size_allowed(entry: ObjectEntry, size: Value) -> Value:
    if isinstance(size, Pattern):
        return UNKNOWN
    return _number(size) <= size_of(entry) if size_varies(entry) else size == size_of(entry)


def _compare(entry: ObjectEntry, data: Value) -> int:
    """Tell whether the bytes are below (-1), within (0) or above (1) the range of the entry."""
    if not isinstance(data, bytes) or entry.low is None or entry.high is None:
        return 0
    number = decode_value(entry, data)
    return -1 if number < entry.low else int(number > entry.high)
