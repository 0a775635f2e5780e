"""Encodes messages of the texts as bytes, and decodes bytes as messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ecatspec.model.core.expressions import Environment, Getter, Lookup, compile_expression
from ecatspec.model.core.functions import PLAIN
from ecatspec.model.core.values import UNKNOWN, Pattern, Value
from ecatspec.spec.language.ir import Bool, Bytes, Frame, FrameField, Name, SInt
from ecatspec.spec.language.kinds import width_of
from ecatspec.spec.language.references import ConstantRef, ParameterOfInput
from ecatspec.spec.language.scope import Scope, frame_fields, resolve

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.spec.language.ir import Expression, Protocol, Type


@dataclass(frozen=True, slots=True)
class Message:
    """A decoded frame: the innermost layout that fits, and the fields of it and all around it.

    `trail` holds the layouts from the outermost to `frame`.
    """

    frame: str
    trail: tuple[str, ...]
    fields: Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class _Part:
    name: str
    width: int | None = None
    signed: bool = False
    truth: bool = False
    length: Getter | None = None
    constant: Value | None = None
    counts: str | None = None
    filled: Getter | None = None


class Codec:
    """Encoder and decoder of all frames of one protocol."""

    def __init__(self, protocol: Protocol) -> None:
        """Prepare the layouts; expressions in frames see earlier fields and table rows."""
        self._protocol = protocol
        self._parts = {name: self._layout(frame) for name, frame in protocol.frames.items()}
        self._conditions = {
            name: self._conditions_of(frame) for name, frame in protocol.frames.items()
        }
        self._children: dict[str | None, list[str]] = {}
        for name, frame in protocol.frames.items():
            self._children.setdefault(frame.parent, []).append(name)
        for children in self._children.values():
            children.sort(key=self._weight, reverse=True)
        self._trails = {name: self._trail(name) for name in protocol.frames}
        self._bits: dict[tuple[str, str], int | None] = {}
        self._fixed = {name: self._constants(name) for name in protocol.frames}

    def trail(self, frame: str) -> tuple[str, ...]:
        """Give the layouts around `frame` from the outermost to itself."""
        return self._trails[frame]

    def field_names(self, frame: str) -> tuple[str, ...]:
        """Give the fields of the frame and of all around it, outermost first, without bodies."""
        trail = self.trail(frame)
        names: list[str] = []
        for name in trail:
            parts = self._parts[name]
            names += [part.name for part in (parts if name == frame else parts[:-1])]
        return tuple(names)

    def is_derived(self, frame: str, field: str) -> bool:
        """Tell whether the encoder computes the field: a length of what follows."""
        return any(part.counts == field for name in self.trail(frame) for part in self._parts[name])

    def is_bytes(self, frame: str, field: str) -> bool:
        """Tell whether the field is a string of bytes."""
        parts = (part for name in self.trail(frame) for part in self._parts[name])
        return any(part.name == field and part.width is None for part in parts)

    def fixed(self, frame: str) -> Mapping[str, Value]:
        """Give the fields that have constants: own ones and those that place the frame."""
        return self._fixed[frame]

    def place(self, frame: str, field: str) -> tuple[int, int]:
        """Give bit offset and width of a field in its own layout, which has fixed widths only."""
        offset = 0
        for part in self._parts[frame]:
            if part.width is None:
                break
            if part.name == field:
                return offset, part.width
            offset += part.width
        raise KeyError(f"{frame}.{field}")

    def bits(self, frame: str, field: str) -> int | None:
        """Give the bits of a number in the whole message; None: they lie behind something open."""
        if (frame, field) not in self._bits:
            self._bits[frame, field] = self._bits_of(frame, field)
        return self._bits[frame, field]

    def _bits_of(self, frame: str, field: str) -> int | None:
        found = self._find(frame, field)
        if found is None or found[1].width is None:
            return None
        return (1 << found[1].width) - 1 << found[0]

    def start(self, frame: str, field: str) -> int | None:
        """Give the byte of the message where a field begins; None: behind something open."""
        found = self._find(frame, field)
        return None if found is None else found[0] // 8

    def _find(self, frame: str, field: str) -> tuple[int, _Part] | None:
        """Give the bit where a field of the message begins, as far as all before it is fixed."""
        offset = 0
        for name in self.trail(frame):
            for part in self._parts[name]:
                if part.name == field:
                    return offset, part
                if part.width is None and part is not self._parts[name][-1]:
                    return None
                offset += part.width or 0
        return None

    def places(self, message: Message) -> Mapping[str, tuple[int, int]]:
        """Give bit offset and width of every field of a decoded message, bodies among them."""
        found: dict[str, tuple[int, int]] = {}
        offset = width = 0
        for name in message.trail:
            for part in self._parts[name]:
                value = message.fields[part.name]
                length = len(value) * 8 if isinstance(value, bytes) else 0
                width = length if part.width is None else part.width
                found[part.name] = offset, width
                offset += width
            if name != message.frame:
                offset -= width  # the layout inside begins where the body does
        return found

    def length(self, message: Message) -> int:
        """Give the bytes of a decoded message; what followed in its area is not counted."""
        return max(offset + width for offset, width in self.places(message).values()) // 8

    def size(self, frame: str) -> int:
        """Give the bytes of a layout of fixed widths."""
        return sum(part.width or 0 for part in self._parts[frame]) // 8

    def capacity(self, frame: str, field: str) -> int:
        """Give the most bytes of a counted field: those it has when nothing else takes them."""
        part = next(part for part in self._parts[frame] if part.name == field)
        nothing = dict.fromkeys(self.field_names(frame), 0)
        length = None if part.length is None else part.length(Environment((), {}, nothing))
        if not isinstance(length, int):
            raise TypeError(f"{frame}.{field} has no fixed capacity")
        return length

    # --- bytes to message -------------------------------------------------------------------------

    def decode(self, data: bytes, root: str) -> Message | None:
        """Decode `data`, which starts with the layout `root`; None when not even that fits.

        Bytes after the outermost layout's counted body are never looked at.
        """
        fields = self._read(root, data, {}, exact=False)
        if fields is None:
            return None
        trail = [root]
        while True:
            inner = self._inner(trail[-1], fields)
            if inner is None:
                return Message(trail[-1], tuple(trail), fields)
            trail.append(inner[0])
            fields = inner[1]

    def _inner(self, frame: str, fields: dict[str, Value]) -> tuple[str, dict[str, Value]] | None:
        body = fields.get(self._parts[frame][-1].name) if self._parts[frame] else None
        if not isinstance(body, bytes):
            return None
        for child in self._children.get(frame, ()):
            for name, value in self._conditions[child].items():
                if fields.get(name) != value:
                    break
            else:
                inner = self._read(child, body, fields, exact=True)
                if inner is not None:
                    return child, inner
        return None

    def _read(
        self, frame: str, data: bytes, outer: Mapping[str, Value], *, exact: bool
    ) -> dict[str, Value] | None:
        fields = dict(outer)
        bits = int.from_bytes(data, "little")
        total = len(data) * 8
        offset = 0
        for part in self._parts[frame]:
            if part.width is None:
                length = total // 8 - offset // 8
                if part.length is not None:
                    wanted = part.length(Environment((), {}, fields))
                    if not isinstance(wanted, int) or wanted < 0 or wanted > length:
                        return None
                    length = wanted
                start = offset // 8
                fields[part.name] = data[start : start + length]
                offset += length * 8
                continue
            if offset + part.width > total:
                return None
            value: Value = bits >> offset & ((1 << part.width) - 1)
            if part.signed and isinstance(value, int) and value >> (part.width - 1):
                value -= 1 << part.width
            if part.constant is not None and value != part.constant:
                return None
            fields[part.name] = bool(value) if part.truth else value
            offset += part.width
        return fields if not exact or offset == total else None

    # --- message to bytes -------------------------------------------------------------------------

    def encode(self, frame: str, fields: Mapping[str, Value]) -> bytes:
        """Encode; a field not given is its constant, a count of what follows, or 0."""
        values: dict[str, Value] = {**self.fixed(frame), **fields}
        body: bytes | None = None
        for name in reversed(self.trail(frame)):
            body = self._write(name, values, body)
        return body or b""

    def _write(self, frame: str, values: dict[str, Value], body: bytes | None) -> bytes:
        parts = self._parts[frame]
        values = dict(values)
        if body is not None:
            values[parts[-1].name] = body
        for part in parts:
            # a byte field of which nothing is said is left out, so that it gets its own length
            if part.width is None and not isinstance(values.get(part.name, b""), bytes):
                del values[part.name]
        for part in parts:
            if part.filled is not None and part.name not in values:
                filled = part.filled(Environment((), {}, values))
                if not isinstance(filled, Pattern):
                    values[part.name] = filled
        for part in parts:
            if part.counts is not None and part.counts not in values:
                content = values.get(part.name, b"")
                if isinstance(content, bytes):
                    values[part.counts] = len(content)
        bits = 0
        offset = 0
        for part in parts:
            value = values.get(part.name, 0)
            if part.width is None:
                wanted = 0 if part.length is None else part.length(Environment((), {}, values))
                missing = bytes(max(0, wanted) if isinstance(wanted, int) else 0)
                content = value if isinstance(value, bytes) else missing
                bits |= int.from_bytes(content, "little") << offset
                offset += len(content) * 8
            else:
                number = value if isinstance(value, int) else 0
                bits |= (number & ((1 << part.width) - 1)) << offset
                offset += part.width
        return bits.to_bytes((offset + 7) // 8, "little")

    # --- preparation ------------------------------------------------------------------------------

    def _trail(self, frame: str) -> tuple[str, ...]:
        parent = self._protocol.frames[frame].parent
        return (*self._trail(parent), frame) if parent else (frame,)

    def _constants(self, frame: str) -> Mapping[str, Value]:
        constants: dict[str, Value] = {}
        for name in self.trail(frame):
            constants |= self._conditions[name]
            constants |= {p.name: p.constant for p in self._parts[name] if p.constant is not None}
        return constants

    def _layout(self, frame: Frame) -> tuple[_Part, ...]:
        return tuple(self._part(frame, field) for field in frame.fields)

    def _part(self, frame: Frame, field: FrameField) -> _Part:
        constant = None if field.value is None else self._constant(frame, field.value, field.type)
        filled = None if field.filled is None else self._getter(frame, field.filled, field.type)
        if isinstance(field.type, Bytes):
            expression = field.type.length
            if expression is None:
                return _Part(field.name, constant=constant, filled=filled)
            own = {item.name for item in frame.fields}
            counts = (
                expression.path if isinstance(expression, Name) and expression.path in own else None
            )
            getter = self._getter(frame, expression, None)
            return _Part(field.name, length=getter, constant=constant, counts=counts, filled=filled)
        width = width_of(self._protocol, field.type)
        signed = isinstance(field.type, SInt)
        truth = isinstance(field.type, Bool)
        return _Part(
            field.name, width, signed=signed, truth=truth, constant=constant, filled=filled
        )

    def _lookup(self, frame: Frame, expected: Type | None = None) -> Lookup:
        def lookup(name: Name) -> Getter:
            ref = resolve(self._protocol, name.path, Scope(frame=frame.name), expected)
            match ref:
                case ConstantRef(value=constant):
                    return lambda _: constant
                case ParameterOfInput(name=key):
                    return lambda environment: environment.parameters.get(key, UNKNOWN)
                case _:
                    raise TypeError(f"{name.at}: a layout cannot use `{name.path}`")

        return lookup

    def _constant(self, frame: Frame, expression: Expression, expected: Type) -> Value:
        return self._getter(frame, expression, expected)(Environment((), {}, {}))

    def _getter(self, frame: Frame, expression: Expression, expected: Type | None) -> Getter:
        return compile_expression(expression, self._lookup(frame, expected), PLAIN)

    def _conditions_of(self, frame: Frame) -> dict[str, Value]:
        types = frame_fields(self._protocol, frame.parent) if frame.parent else {}
        return {
            field: self._constant(frame, value, types[field]) for field, value in frame.conditions
        }

    def _weight(self, frame: str) -> tuple[int, int]:
        parts = self._parts[frame]
        constants = sum(part.constant is not None for part in parts) + len(self._conditions[frame])
        return constants, -len(parts)
