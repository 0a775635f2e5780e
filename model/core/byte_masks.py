"""The bytes that may be read in a state, and a mask of those that count.

A form is bytes with a mask. The forms of a state are proposals: whoever uses them asks the oracle
what becomes of each. Where the texts allow a few values there is a form for each of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Final, TypeVar

from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.interpreter import expected_fields, later_fields
from ecatspec.model.core.memo import once
from ecatspec.model.core.observables import layout
from ecatspec.model.core.process_image import INPUTS
from ecatspec.model.core.values import Numbers, Octets, Pattern, Unknown, Value, concrete, ranges_of
from ecatspec.spec.language.ir import Bytes, Literal

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import Output, State
    from ecatspec.spec.language.ir import Register

_K = TypeVar("_K")
_FEW: Final = 32
"""Maximum number of blocks of values of a field that get a form each."""
_MOST: Final = 64
"""Forms of one message at most; beyond that fields are free."""
_BYTE: Final = 8
_ALL: Final = -1
"""All bits of a number."""
_SOME: Final = 16
"""Bytes of a content that is long enough for no layout to treat it specially."""
_ENDS: Final = (b"\0", b"\xff")
_ANY_BYTES: Final = Octets((0, 1 << 16))
"""A string of bytes of which nothing is said."""


@dataclass(frozen=True, slots=True)
class Form:
    """Bytes as a number, lowest first; `free` are the bits of each part that may be anything.

    With `least` a message may be so short; as far as it goes it is like this.
    """

    size: int
    value: int
    free: tuple[int, ...] = ()
    least: int | None = None

    @property
    def open_bits(self) -> int:
        """The bits that may be anything."""
        found = 0
        for mask in self.free:
            found |= mask
        return found

    def within(self, size: int) -> Form | None:
        """Give what of it fits into a number of bytes; None where a message has to be longer."""
        if self.size <= size:
            return self
        if self.least is None or self.least > size:
            return None
        reach = (1 << size * _BYTE) - 1
        free = tuple(mask & reach for mask in self.free if mask & reach)
        return Form(size, self.value & reach, free, self.least)

    def having(self, data: bytes) -> Form:
        """Give the form with the free bits of `data`, as far as it reaches."""
        raw = int.from_bytes(data[: self.size], "little")
        free = self.open_bits
        return Form(self.size, self.value & ~free | raw & free, self.free)


def message_forms(
    model: Model, state: State, output: Output, observed: Mapping[str, Value], unseen: str
) -> Iterator[Form]:
    """Yield what a message may be that is due; free fields are as `observed`, where they may be.

    The field `unseen` is not looked at: it has one value.
    """
    fields = expected_fields(model, state, output)
    fields |= {
        name: Octets((length, length))
        for name, length in _lengths(model, output.frame).items()
        if name in fields and isinstance(fields[name], Unknown)
    }
    fields[unseen] = _chosen(fields[unseen], observed.get(unseen))
    undecided = _undecided(model, state, output, unseen)
    for some in _combined(fields):
        if undecided:
            break
        chosen = {name: _chosen(value, observed.get(name)) for name, value in some.items()}
        late, undecided = later_fields(model, state, output, chosen)
        for more in () if undecided else _combined(late):
            whole = some | more
            full = {name: _chosen(value, observed.get(name)) for name, value in whole.items()}
            yield from _forms(model, output.frame, whole, full)
            if any(map(ranges_of, some.values())):
                # of what follows from a number that may be another one only that it is there
                loose = {name: _ANY_BYTES if _is_bytes(late[name]) else late[name] for name in late}
                yield from _forms(model, output.frame, some | loose, full)
    if undecided:
        choice = min(undecided)
        slot = model.slots[f"choice {choice}"]
        for way in model.protocol.choices[choice].alternatives:
            there = state.having(slot, way.name)
            yield from message_forms(model, there, output, observed, unseen)


@once
def _lengths(model: Model, frame: str) -> dict[str, int]:
    """Give the byte strings of a layout that have one length, in bytes."""
    return {
        field.name: field.type.length.value
        for name in model.codec.trail(frame)
        for field in model.protocol.frames[name].fields
        if isinstance(field.type, Bytes) and isinstance(field.type.length, Literal)
    }


def _undecided(model: Model, state: State, output: Output, unseen: str) -> set[str]:
    """Give the choices on which fields rest of which the rule says nothing."""
    environment = Environment(state.slots, state.objects, {})
    said = {*model.codec.fixed(output.frame), *dict(output.fields), unseen}
    for name, (getter, _) in model.replies[output.frame].items():
        if name not in said:
            getter(environment)
    return environment.undecided


def _combined(fields: Mapping[_K, Value]) -> Iterator[dict[_K, Value]]:
    """Yield the fields with one value where there are few, all combinations of them."""
    few = {name: found for name, value in fields.items() if (found := _few(value)) is not None}
    count = 1
    for name in list(few):
        count *= len(few[name])
        if count > _MOST:
            del few[name]
    for values in product(*few.values()):
        yield {**fields, **dict(zip(few, values, strict=True))}


def _few(value: Value) -> list[Value] | None:
    """Give the numbers as blocks in which the lowest bits may be anything, if they are few."""
    ranges = ranges_of(value)
    if ranges is None:
        return None
    excluded = value.excluded if isinstance(value, Numbers) else None
    found: list[Value] = []
    for span in ranges:
        for low, high in _around(span, excluded):
            for block in _blocks(low, high):
                if len(found) == _FEW:
                    return None
                first, last = block
                found.append(first if first == last else Numbers((block,)))
    return found


def _around(span: tuple[int, int], excluded: int | None) -> tuple[tuple[int, int], ...]:
    low, high = span
    if excluded is None or not low <= excluded <= high:
        return (span,)
    return (low, excluded - 1), (excluded + 1, high)


def _blocks(low: int, high: int) -> Iterator[tuple[int, int]]:
    """Yield the numbers as blocks of 2^n that begin at a multiple of 2^n."""
    while low <= high:
        size = low & -low or 1 << high.bit_length()
        while low + size - 1 > high:
            size >>= 1
        yield low, low + size - 1
        low += size


def _loose(value: Value) -> int:
    """Give the bits of a number that may be anything: those of a block, or all."""
    ranges = ranges_of(value)
    if ranges is None or len(ranges) > 1:
        return _ALL
    (block,) = ranges
    return block[0] ^ block[1] if [block] == [*_blocks(*block)] else _ALL


def _is_bytes(value: Value) -> bool:
    return isinstance(value, bytes | Octets)


def _chosen(value: Value, observed: Value | None) -> Value:
    if isinstance(value, Pattern) and observed is not None and value.admits(observed):
        return observed
    return concrete(value)


def _forms(
    model: Model, frame: str, fields: Mapping[str, Value], chosen: Mapping[str, Value]
) -> Iterator[Form]:
    fields = {name: _of_bytes(model, frame, name, value) for name, value in fields.items()}
    chosen = {
        name: b"" if value is _ANY_BYTES and not isinstance(chosen[name], bytes) else chosen[name]
        for name, value in fields.items()
    }
    data = model.codec.encode(frame, chosen)
    raw = int.from_bytes(data, "little")
    free = [
        mask
        for name, value in fields.items()
        if isinstance(value, Pattern) and (mask := _unsaid(model, frame, chosen, name, value))
    ]
    yield Form(len(data), raw, tuple(free))
    for name, value in fields.items():
        if isinstance(value, Octets) and len(set(value.lengths)) > 1:
            start = model.codec.start(frame, name)
            if start is None:
                continue  # what is open before it says it
            lengths = (
                model.codec.bits(frame, counted) or 0
                for counted in model.codec.field_names(frame)
                if model.codec.is_derived(frame, counted)
            )
            longest = {**chosen, name: b"" if value is _ANY_BYTES else value.taken()}
            most = model.codec.encode(frame, longest)
            unsaid = _unsaid(model, frame, longest, name, value)
            # what the encoder makes of the content is another for another length
            some = [_changed(model, frame, chosen, name, (b"", each * _SOME)) for each in _ENDS]
            # where there is little content there may be padding in its place
            shortest = len(model.codec.encode(frame, {**chosen, name: b""}))
            made = (some[0] | some[1]) & (1 << max(start, shortest) * _BYTE) - 1
            if value is _ANY_BYTES:
                made |= -1 << start * _BYTE
            reach = (1 << len(most) * _BYTE) - 1
            masks = tuple(m for mask in (*free, *lengths, unsaid, made) if (m := mask & reach))
            least = max(1, start + value.lengths[0])
            yield Form(len(most), int.from_bytes(most, "little"), masks, min(least, len(most)))


def _of_bytes(model: Model, frame: str, name: str, value: Value) -> Value:
    """Give what is said of a field; of a string of which nothing is said that it is one."""
    return _ANY_BYTES if isinstance(value, Unknown) and model.codec.is_bytes(frame, name) else value


def _unsaid(model: Model, frame: str, chosen: Mapping[str, Value], name: str, value: Value) -> int:
    """Give the bits of a field that may be anything, as far as it is as long as chosen."""
    content = chosen[name]
    if not isinstance(content, bytes):
        loose = _loose(value)
        bits = model.codec.bits(frame, name) if loose == _ALL else None
        return bits or _changed(model, frame, chosen, name, (0, loose))
    known = bytes(len(content))
    if isinstance(value, Octets) and value.content is not None:
        mask = value.mask or b"\xff" * len(value.content)
        known = mask[: len(content)].ljust(len(content), b"\0")
    flipped = bytes(byte ^ ~sure & 0xFF for byte, sure in zip(content, known, strict=True))
    return _changed(model, frame, chosen, name, (content, flipped))


def _changed(
    model: Model,
    frame: str,
    chosen: Mapping[str, Value],
    name: str,
    values: tuple[Value, Value],
) -> int:
    """Give the bits of a frame that differ between two values of a field."""
    one, other = (model.codec.encode(frame, {**chosen, name: value}) for value in values)
    return int.from_bytes(one, "little") ^ int.from_bytes(other, "little")


def register_forms(model: Model, state: State, registers: Iterable[Register]) -> Iterator[Form]:
    """Yield what neighbouring registers may hold, from the first to the last."""
    every = list(registers)
    start = every[0].address
    end = max(register.address + register.size for register in every)
    environment = Environment(state.slots, {}, {})
    fields: dict[tuple[int, int], Value] = {}
    for register in every:
        for view in model.views[register.name]:
            low = (register.address - start) * _BYTE + view.low
            fields[low, view.width] = view.present(environment)
    if environment.undecided:
        choice = min(environment.undecided)
        slot = model.slots[f"choice {choice}"]
        for way in model.protocol.choices[choice].alternatives:
            yield from register_forms(model, state.having(slot, way.name), every)
        return
    whole = (1 << (end - start) * _BYTE) - 1
    for some in _combined(fields):
        value = known = 0
        free = []
        for (low, width), part in some.items():
            mask = (1 << width) - 1 << low
            known |= mask
            number = concrete(part)
            if isinstance(part, Pattern):
                free.append(_loose(part) << low & mask)
            if isinstance(number, int):
                value |= number << low & mask
        unsaid = whole & ~known
        bits = (1 << bit for bit in range(unsaid.bit_length()) if unsaid >> bit & 1)
        yield Form(end - start, value, (*free, *bits))


def input_form(model: Model, state: State, data: bytes) -> Form:
    """Give what the inputs may be in a state: its words, all else as in `data`."""
    environment = Environment(state.slots, state.objects, {})
    value = int.from_bytes(data, "little")
    free = whole = (1 << len(data) * _BYTE) - 1
    for mapped in layout(model, state, INPUTS) or ():
        shown = None if mapped.key is None else model.dictionary.shown.get(mapped.key)
        if shown is None or mapped.offset + mapped.bits > len(data) * _BYTE:
            continue
        said = shown(environment)
        if isinstance(said, Octets):
            content = said.content or b""
            mask = int.from_bytes(said.mask or b"\xff" * len(content), "little")
        else:
            content = said if isinstance(said, bytes) else b""
            mask = (1 << len(content) * _BYTE) - 1
        mask &= (1 << mapped.bits) - 1
        value &= ~(mask << mapped.offset)
        value |= (int.from_bytes(content, "little") & mask) << mapped.offset
        free &= ~(mask << mapped.offset)
    return Form(len(data), value & whole, (free,) if free else ())
