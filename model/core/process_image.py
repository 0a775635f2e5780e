"""The layout of process data: PDO assignment, PDO mapping, and words inside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ecatspec.model.core.object_dictionary import size_of
from ecatspec.model.core.values import UNKNOWN, ObjectKey, Pattern, Value, bits_of
from ecatspec.spec.language.ir import Access, Bool, SInt, UInt

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ecatspec.model.core.expressions import Environment, Function
    from ecatspec.model.core.object_dictionary import ObjectDictionary
    from ecatspec.spec.language.ir import ObjectEntry, Protocol

OUTPUTS, INPUTS = "output_assignment", "input_assignment"
"""The words that count the assigned PDOs."""
_ENTRY = "pdo_entry"
_BYTE = 8
_HIGHEST = (1 << _BYTE) - 1
"""The highest subindex that can be."""


@dataclass(frozen=True, slots=True)
class Mapped:
    """Bits of the process data; `key` is the entry that they hold, None where it is not known."""

    key: ObjectKey | None
    offset: int
    bits: int


class ProcessImage:
    """The layout of the process data as the objects say it, and the functions over it."""

    def __init__(
        self,
        protocol: Protocol,
        dictionary: ObjectDictionary,
        parameter: Callable[[str], int],
    ) -> None:
        """Take the assignment words and the parameters that say which indices are PDOs."""
        self._dictionary = dictionary
        count = parameter("pdos_a_direction")
        firsts = {OUTPUTS: parameter("first_rx_pdo"), INPUTS: parameter("first_tx_pdo")}
        self.pdos = {name: range(first, first + count) for name, first in firsts.items()}
        """The indices that PDOs of an assignment have."""
        keys = {name: protocol.words[name].key for name in (OUTPUTS, INPUTS)}
        self.assignments = {name: key[0] for name, key in keys.items() if key is not None}
        self._fields = {f.name: (f.low, f.high) for f in protocol.words[_ENTRY].fields}
        self._states_mappable = any(entry.mappable for entry in protocol.objects)
        self.functions: dict[str, Function] = {
            "image_size": self._image_size,
            "assigned_pdos": self._assigned_pdos,
            "mapped": self._holds_entry,
            "is_assignment": lambda _, a: a[0] in self.assignments.values(),
            "is_mapping": lambda _, a: self._direction(a[0]) is not None,
            "can_hold": lambda _, a: self._can_hold(a[0], a[1], a[2]),
            "holds": self._all_hold,
            "repeated": self._repeated,
            "pdo_bits": self._pdo_bits,
        }

    def configures(self, index: int) -> bool:
        """Tell whether an object assigns PDOs or maps entries."""
        return index in self.assignments.values() or self._direction(index) is not None

    # --- layout -----------------------------------------------------------------------------------

    def layout(self, environment: Environment, name: str) -> tuple[Mapped, ...] | None:
        """Give what the process data of an assignment hold, in order; None: not known."""
        pdos = self._assigned(environment, self.assignments[name])
        if pdos is None:
            return None
        found: list[Mapped] = []
        offset = 0
        for pdo in pdos:
            for key, bits in self._mapping(environment, pdo):
                if bits is None:
                    return None
                found.append(Mapped(key, offset, bits))
                offset += bits
        return tuple(found)

    def _counted(self, environment: Environment, index: int) -> int | None:
        """Give how many entries an object of this kind counts; None: not known."""
        if (index, 0) not in self._dictionary.entries:
            return 0 if self._dictionary.closed else None
        known = self._dictionary.known(environment, (index, 0))
        return None if known is None else known[0]

    def _numbers(self, environment: Environment, index: int) -> Iterator[tuple[int, int | None]]:
        """Yield the counted subindices with their value, None where it is not known."""
        count = self._counted(environment, index)
        for subindex in range(1, (count or 0) + 1):
            known = self._dictionary.known(environment, (index, subindex))
            yield subindex, None if known is None else int.from_bytes(known, "little")

    def _assigned(self, environment: Environment, index: int) -> list[int] | None:
        if self._counted(environment, index) is None:
            return None
        values = [value for _, value in self._numbers(environment, index)]
        known = [value for value in values if value is not None]
        return known if len(known) == len(values) else None

    def _mapping(
        self, environment: Environment, pdo: int
    ) -> Iterator[tuple[ObjectKey | None, int | None]]:
        """Yield entry and bits of what a PDO maps; bits None: not known."""
        if pdo == 0:
            return
        if self._counted(environment, pdo) is None:
            yield None, None
        for subindex, value in self._numbers(environment, pdo):
            if value is not None:
                yield self.target(value)
            else:
                entry = self._dictionary.entries.get((pdo, subindex))  # the device may have more
                yield None, None if entry is None else entry.maps

    def target(self, value: int) -> tuple[ObjectKey | None, int]:
        """Give the entry that a mapping entry names (None: a gap), and its bits."""
        part = {name: bits_of(value, *place) for name, place in self._fields.items()}
        key = (part["index"], part["subindex"]) if part["index"] else None
        return key, part["bit_length"]

    # --- functions of the texts -------------------------------------------------------------------

    def _name(self, index: Value) -> str:
        return next(name for name, number in self.assignments.items() if number == index)

    def _image_size(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        layout = self.layout(environment, self._name(arguments[0]))
        if layout is None:
            return UNKNOWN
        return -(-sum(mapped.bits for mapped in layout) // _BYTE)

    def _assigned_pdos(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        pdos = self._assigned(environment, self.assignments[self._name(arguments[0])])
        return UNKNOWN if pdos is None else b"".join(pdo.to_bytes(2, "little") for pdo in pdos)

    def _holds_entry(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        layout = self.layout(environment, self._name(arguments[0]))
        if layout is None:
            return UNKNOWN
        if any(mapped.key == arguments[1:] for mapped in layout):
            return True
        return UNKNOWN if any(mapped.key is None for mapped in layout) else False

    def _repeated(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        layout = self.layout(environment, self._name(arguments[0]))
        if layout is None:
            return UNKNOWN
        keys = [mapped.key for mapped in layout if mapped.key is not None]
        return len(keys) != len(set(keys))

    def _direction(self, pdo: Value) -> str | None:
        """Give the assignment that PDOs of this index belong to; None for another object."""
        return next((name for name, indices in self.pdos.items() if pdo in indices), None)

    def _can_hold(self, index: Value, subindex: Value, value: Value) -> Value:
        if not isinstance(value, bytes) or not isinstance(index, int):
            return UNKNOWN
        if subindex == 0 or not self.configures(index):
            return False
        number = int.from_bytes(value, "little")
        direction = self._direction(index)
        if number == 0:
            return False
        if direction is not None:
            return self._can_map(direction, number)
        if self._direction(number) != self._name(index):
            return False
        return self._exists((number, 0))

    def _can_map(self, direction: str, number: int) -> Value:
        key, bits = self.target(number)
        if key is None:
            return True  # a gap
        entry = self._dictionary.entries.get(key)
        if entry is None:
            return self._exists(key)
        wrong_way = Access.READ if direction == OUTPUTS else Access.WRITE
        if bits != _bits(entry) or entry.access is wrong_way:
            return False
        if entry.mappable:
            return True
        return False if self._states_mappable and self._dictionary.closed else UNKNOWN

    def _exists(self, key: ObjectKey) -> Value:
        if key in self._dictionary.entries:
            return True
        return False if self._dictionary.closed else UNKNOWN

    def _all_hold(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        index, count = arguments
        if not isinstance(index, int) or not isinstance(count, int):
            return UNKNOWN
        if not self.configures(index):
            return count == 0
        unknown = count > _HIGHEST
        for subindex in range(1, min(count, _HIGHEST) + 1):
            held = self._dictionary.known(environment, (index, subindex))
            if not held or not any(held):
                unknown = True  # nothing in its place, as some devices allow
                continue
            possible = self._can_hold(index, subindex, held)
            if possible is False:
                return False
            unknown = unknown or isinstance(possible, Pattern)
        return UNKNOWN if unknown else True

    def _pdo_bits(self, environment: Environment, arguments: tuple[Value, ...]) -> Value:
        index, count = arguments
        if not isinstance(index, int) or not isinstance(count, int):
            return UNKNOWN
        if self._direction(index) is None:
            return 0
        total = 0
        for subindex in range(1, count + 1):
            held = self._dictionary.known(environment, (index, subindex))
            if held is None:
                return UNKNOWN
            total += self.target(int.from_bytes(held, "little"))[1]
        return total


def _bits(entry: ObjectEntry) -> int:
    if isinstance(entry.type, Bool):
        return 1
    if isinstance(entry.type, UInt | SInt):
        return entry.type.width
    return _BYTE * size_of(entry)


def taken(image: bytes, mapped: Mapped) -> int | None:
    """Give the bits of the process data that an entry has; None where they end before."""
    if mapped.offset + mapped.bits > _BYTE * len(image):
        return None
    return int.from_bytes(image, "little") >> mapped.offset & ((1 << mapped.bits) - 1)


def placed(image: int, mapped: Mapped, value: int) -> int:
    """Give the process data, as one number, with the value of an entry in its place."""
    mask = (1 << mapped.bits) - 1
    return image & ~(mask << mapped.offset) | (value & mask) << mapped.offset
