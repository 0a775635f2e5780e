"""Words for values, registers and messages."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from ecatspec.model.core.values import Numbers, Octets, Pattern, Unknown, Value
from ecatspec.spec.language.ir import Bool, Named, SInt, Type, UInt

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.compilation import Model

_BYTE = 8
"""Numbers up to this many bits are said in decimal."""
_ALL = 0xFF
"""All bits of a byte."""
_MANY = 24
"""Byte strings longer than this are not said in full."""
_FIRST, _LAST = 8, 4
"""Number of bytes that are shown from either end."""
_QUIET = ("address", "channel", "priority", "reserved", "padding", "payload", "body", "number")

_RARELY_SET = ("reserved", "application")
"""Fields of registers with these names are said only where they are not 0."""
_EXCESS = "excess"
"""Bytes of this name are said only where there are some: a valid message has none."""


def typed_words(model: Model, kind: Type, value: Value) -> str:
    """Say a value of a type: hexadecimal as wide as the type, with its name where it has one."""
    match value:
        case Octets((least, most), content, mask, ranges):
            count = f"{least} to {most} bytes" if least < most else f"{most} bytes"
            if ranges is not None:
                parts = [f"{low}" if low == high else f"{low}..{high}" for low, high in ranges]
                return f"{count}: {' or '.join(parts)}"
            if content is None:
                return f"any {count}"
            start = content[:most]
            sure = None if mask is None else mask[: len(start)].ljust(len(start), b"\0")
            words = bytes_words(start, sure)
            return words if least == len(start) else f"{words} of {count}"
        case Unknown():
            return "any"
        case Numbers(ranges, excluded):
            parts = []
            for low, high in ranges:
                first = typed_words(model, kind, low)
                parts.append(first if low == high else f"{first}..{typed_words(model, kind, high)}")
            words = " or ".join(parts)
            return words if excluded is None else f"{words} but not {excluded}"
        case bytes():
            return bytes_words(value)
        case str():
            return value
    match kind:
        case Bool():
            return "yes" if value else "no"
        case Named(table=table):
            text = model.protocol.tables[table]
            digits = (text.width + 3) // 4
            number = f"0x{value:0{digits}X}" if text.width > _BYTE else str(int(value))
            names = [row.name for row in text.rows if row.value == value]
            return f"{number} {names[0]}" if names else number
        case UInt(width=width) if width > _BYTE:
            return f"0x{value:0{(width + 3) // 4}X}"
        case SInt() | UInt():
            return str(int(value))
        case _:
            return str(value)


def bytes_words(value: bytes, mask: bytes | None = None) -> str:
    """Say bytes in hexadecimal, not all where they are many.

    With a mask, `??` has no bit in it, and `40/6F` those of 6F.
    """
    sure = mask or bytes([_ALL]) * len(value)
    said = [
        f"{n:02X}" if known == _ALL else f"{n:02X}/{known:02X}" if known else "??"
        for n, known in zip(value, sure, strict=True)
    ]
    if len(said) <= _MANY:
        return " ".join(said) or "empty"
    return f"{' '.join(said[:_FIRST])} .. {' '.join(said[-_LAST:])} ({len(said)} bytes)"


def value_words(model: Model, frame: str, field: str, value: Value) -> str:
    """Say the value of a field of a frame."""
    for name in reversed(model.codec.trail(frame)):
        for item in model.protocol.frames[name].fields:
            if item.name == field:
                return typed_words(model, item.type, value)
    return str(value)


def register_words(model: Model, name: str, fields: Mapping[str, Value]) -> str:
    """Say what a register or a word holds, field by field, reserved bits only where one is set."""
    holder = model.protocol.registers.get(name) or model.protocol.words[name]
    types = {field.name: field.type for field in holder.fields}
    words = ", ".join(
        f"{n} {typed_words(model, types[n], v)}"
        for n, v in fields.items()
        if v != 0 or n not in _RARELY_SET
    )
    return f"{name}: {words}"


def reason_words(wording: str, values: Sequence[Value]) -> str:
    """Say a reason: `{}` a number, `{hex}` one in hexadecimal, `{words}` numbers of two bytes."""
    left = iter(values)

    def said(match: re.Match[str]) -> str:
        value = next(left)
        if isinstance(value, Pattern):
            return "unknown"
        if isinstance(value, bytes):
            pairs = (value[n : n + 2] for n in range(0, len(value), 2))
            return ", ".join(f"0x{int.from_bytes(pair, 'little'):04X}" for pair in pairs) or "none"
        if match.group(1) == "hex" and isinstance(value, int):
            return f"0x{value:04X}"
        return str(value)

    return re.sub(r"\{(|hex|words)\}", said, wording)


def message_words(model: Model, message: Message) -> str:
    """Say a message: its layout and every field that tells something."""
    return fields_words(model, message.frame, message.fields)


def fields_words(model: Model, frame: str, fields: Mapping[str, Value]) -> str:
    """Say fields of a frame, without those that the layout fixes or that only fill it up."""
    fixed = model.codec.fixed(frame)
    told = [
        f"{name} {value_words(model, frame, name, fields[name])}"
        for name in model.codec.field_names(frame)
        if name in fields
        and name not in fixed
        and not name.startswith(_QUIET)
        and not (name == _EXCESS and fields[name] == b"")
        and not model.codec.is_derived(frame, name)
    ]
    return f"{frame}: {', '.join(told)}" if told else frame
