"""The FMMUs: bits of the logical memory mapped to bits of a SubDevice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ecatspec.model.core.values import bits_of

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import Protocol, Register

_BITS = 8


def fmmu_registers(protocol: Protocol) -> tuple[Register, ...]:
    """Give the registers of the FMMUs that the texts have."""
    found = (r for r in protocol.registers.values() if r.name.startswith("fmmu_"))
    return tuple(sorted(found, key=lambda register: register.address))


@dataclass(frozen=True, slots=True)
class Share:
    """What one FMMU maps of one logical access, in bits: from where in the data, to where."""

    at: int
    """First bit in the data of the datagram."""
    physical: int
    """First bit in the memory of the SubDevice."""
    count: int

    @property
    def whole_bytes(self) -> bool:
        """Tell whether only whole bytes are mapped."""
        return not (self.at % _BITS or self.physical % _BITS or self.count % _BITS)

    @property
    def address(self) -> int:
        """Give the first byte in the memory of the SubDevice."""
        return self.physical // _BITS

    @property
    def length(self) -> int:
        """Give how many bytes of its memory the bits lie in."""
        return (self.physical % _BITS + self.count + _BITS - 1) // _BITS

    def taken(self, data: bytes, memory: bytes) -> bytes:
        """Give `memory`, as many bytes as `length`, with the mapped bits of a datagram in it."""
        if self.whole_bytes:
            return data[self.at // _BITS :][: self.length]
        return _moved(data, self.at, memory, self.physical % _BITS, self.count)

    def put(self, data: bytes, memory: bytes) -> bytes:
        """Give the data of a datagram with the mapped bits of `memory` in it."""
        if self.whole_bytes:
            start = self.at // _BITS
            return data[:start] + memory + data[start + self.length :]
        return _moved(memory, self.physical % _BITS, data, self.at, self.count)


def _moved(source: bytes, from_bit: int, target: bytes, to_bit: int, count: int) -> bytes:
    mask = (1 << count) - 1
    bits = int.from_bytes(source, "little") >> from_bit & mask
    rest = int.from_bytes(target, "little") & ~(mask << to_bit)
    return (rest | bits << to_bit).to_bytes(len(target), "little")


@dataclass(frozen=True, slots=True)
class Fmmu:
    """One FMMU as set now; the names are those of the fields of its register."""

    logical_start: int
    length: int
    first_bit: int
    last_bit: int
    start: int
    start_bit: int
    read: bool
    write: bool
    enabled: bool

    @classmethod
    def of(cls, register: Register, raw: int) -> Fmmu:
        """Decode the content of a register."""

        def number(name: str) -> int:
            bits = next(field for field in register.fields if field.name == name)
            return bits_of(raw, bits.low, bits.high)

        return cls(
            number("logical_start"),
            number("length"),
            number("first_bit"),
            number("last_bit"),
            number("start"),
            number("start_bit"),
            bool(number("read")),
            bool(number("write")),
            bool(number("enabled")),
        )

    @property
    def whole_bytes(self) -> bool:
        """Tell whether only whole bytes are mapped, which is what process data need."""
        return not self.first_bit and self.last_bit == _BITS - 1 and not self.start_bit

    def share(self, address: int, length: int) -> Share | None:
        """Give what is mapped of a logical access, None where nothing is."""
        if not (self.enabled and self.length):
            return None
        first = self.logical_start * _BITS + self.first_bit
        after = (self.logical_start + self.length - 1) * _BITS + self.last_bit + 1
        low, high = max(first, address * _BITS), min(after, (address + length) * _BITS)
        if low >= high:
            return None
        physical = self.start * _BITS + self.start_bit + low - first
        return Share(low - address * _BITS, physical, high - low)
