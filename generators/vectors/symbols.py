"""Words for bytes of test vectors, by the symbol beside them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

from ecatspec.model.core.cache import Cache
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.register_map import field_mask, field_of
from ecatspec.model.core.wording import (
    bytes_words,
    fields_words,
    register_words,
    typed_words,
    value_words,
)
from ecatspec.spec.language.load import device_names, load_device, load_standard

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.generators.vectors.schema import Allowed, Area, Config, Head
    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import Register

_BYTE: Final = 8
_KEPT: Final = 4096
"""Wordings that are kept at most: many tests say the same."""
_MESSAGES: Final = frozenset({"bytes", "nothing"})
"""Symbols beside the names of frames of what lies in a mailbox."""
_ANYTHING: Final = "anything"


def words_of(head: Head) -> Words:
    """Give the words of a file: of the text that it comes from if that is shipped, else ours."""
    name = head.spec.name
    protocol = load_device(name) if name in device_names() else load_standard()
    if protocol.digest != head.spec.sha256:
        protocol = load_standard()
    return Words(Model(protocol), head.config)


@dataclass(slots=True)
class Words:
    """Says what bytes mean; what no text knows is said in hexadecimal."""

    model: Model
    config: Config
    _kept: Cache[tuple[str, bytes, bytes], str] = field(default_factory=partial(Cache, _KEPT))

    def say(self, symbol: str, data: bytes) -> str:
        """Say bytes that are written or were seen; zeros at the end of a message may be missing."""
        whole = self.whole(data) if symbol in self.model.protocol.frames else data
        return self._say(symbol, whole, b"\xff" * len(whole))

    def say_allowed(self, symbol: str, allowed: Allowed) -> str:
        """Say bytes that may be there: what is not said of them may be anything."""
        value = bytes.fromhex(allowed.value)
        mask = bytes.fromhex(allowed.mask)[: len(value)].ljust(len(value), b"\0")
        words = self._say(symbol, value, mask)
        return words if allowed.atLeast is None else f"{words}; at least {allowed.atLeast} bytes"

    def whole(self, data: bytes, mask: bytes | None = None) -> bytes:
        """Give a message with the zeros that were left out, and a length that was left open."""
        area = self.config.mailboxLength
        if mask is not None and not any(_part(mask, area)):
            most = (1 << area.length * _BYTE) - 1
            length = min(max(0, len(data) - self.config.mailboxHead), most)
            said = length.to_bytes(area.length, "little")
            data = data[: area.address] + said + data[area.address + area.length :]
        size = self.config.mailboxHead + _number(_part(data, area))
        return data.ljust(min(size, self.config.mailboxOut.length), b"\0")

    def _is_message(self, symbol: str) -> bool:
        return symbol in self.model.protocol.frames or symbol in _MESSAGES

    def _say(self, symbol: str, data: bytes, mask: bytes) -> str:
        key = symbol, data, mask
        if key not in self._kept:
            self._kept.keep(key, self._words(symbol, data, mask))
        return self._kept[key]

    def _words(self, symbol: str, data: bytes, mask: bytes) -> str:
        protocol = self.model.protocol
        registers = [protocol.registers[n] for n in symbol.split() if n in protocol.registers]
        if registers and len(registers) == len(symbol.split()):
            first = min(register.address for register in registers)
            if max(r.address + r.size for r in registers) == first + len(data):
                return self._registers(registers, first, data, mask)
        elif self._is_message(symbol):
            return self._message(data, mask)
        said = bytes_words(data, mask) if any(mask) else _ANYTHING
        return f"{symbol.replace('_', ' ')} {said}"

    # --- registers --------------------------------------------------------------------------------

    def _registers(
        self, registers: Iterable[Register], first: int, data: bytes, mask: bytes
    ) -> str:
        said = []
        for register in registers:
            start = register.address - first
            raw, sure = (_number(each[start : start + register.size]) for each in (data, mask))
            fields: dict[str, Value] = {}
            for each in register.fields:
                place = field_mask(self.model.protocol, register.name, each.name)
                known = sure & place
                value = field_of(self.model.protocol, register.name, each.name, raw)
                if known == place:
                    fields[each.name] = value
                elif known:
                    words = typed_words(self.model, each.type, value)
                    fields[each.name] = _in_bits(words, known >> each.low)
            if fields:
                said.append(register_words(self.model, register.name, fields))
        return "; ".join(said) or _ANYTHING

    # --- messages ---------------------------------------------------------------------------------

    def _message(self, data: bytes, mask: bytes) -> str:
        whole = self.whole(data, mask) if len(data) >= self.config.mailboxHead else data
        message = self.model.decode(whole)
        if message is None:
            return bytes_words(data, mask)
        fields = self._known(message, mask)
        if not fields:
            return f"{message.frame}: {_ANYTHING}"
        return fields_words(self.model, message.frame, fields)

    def _known(self, message: Message, mask: bytes) -> dict[str, Value]:
        """Give the fields of a message of which something is known."""
        found: dict[str, Value] = {}
        sure, measured = _number(mask), any(_part(mask, self.config.mailboxLength))
        for name, (low, width) in self.model.codec.places(message).items():
            place = (1 << width) - 1
            known, value = sure >> low & place, message.fields[name]
            if not width and not measured:
                continue  # as many bytes as there are
            if known == place:
                found[name] = value
            elif known and isinstance(value, bytes):
                found[name] = bytes_words(value, known.to_bytes(len(value), "little"))
            elif known:
                words = value_words(self.model, message.frame, name, value)
                found[name] = _in_bits(words, known)
        return found


def _in_bits(words: str, known: int) -> str:
    return f"{words} in the bits 0x{known:X}"


def _part(data: bytes, area: Area) -> bytes:
    return data[area.address : area.address + area.length]


def _number(data: bytes) -> int:
    return int.from_bytes(data, "little")
