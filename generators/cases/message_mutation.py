"""Mutates requests: the valid message, its edges, and one fault each.

Everything is read off the layouts. A variant is made by changing bits of the valid message, and the
decoder tells what became of it: still this frame, another frame of the texts (then it is no variant
of this one), or none. What the layouts cannot say goes by the words of the texts, listed below.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import TYPE_CHECKING

from ecatspec.generators.cases.case import SendFrame
from ecatspec.model.core.register_map import AREAS, SYNC_MANAGERS
from ecatspec.spec.language.ir import Bool, Bytes, InputKind, Named
from ecatspec.spec.language.kinds import width_of
from ecatspec.spec.language.nodes import names_in

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import CodeTable, FrameField

_RESERVED = ("reserved", "flags")
"""Fields whose names begin so are 0 in a valid request."""
_PADDING = "padding"
"""Bytes whose names begin so are there, and say nothing."""
_EXCESS = "excess"
"""Bytes of this name take what is too much at the end: a valid message has none."""
_COUNTER, _CHANNEL = "counter", "channel"
_SIZE, _UNUSED, _SIZE_INDICATED = "size", "unused", "size_indicated"
_BYTE = 8
_FILLER = b"\xff"
_MANY = 16
"""Of more values than this without a row only the first and the last of each gap are tried."""


class Family(StrEnum):
    """How a variant stands to the texts: as it should be, at an edge, or with one fault."""

    VALID = "valid"
    BOUNDARY = "boundary"
    MALFORMED = "malformed"


_BOUNDARY_NOTES: dict[str, str] = {
    "routing_value": (
        "A field of the headers that selects no service (address, priority, number) is not 0, which"
        " is the sender's freedom; hunts devices that compare whole headers or answer elsewhere."
    ),
    "channel_set": (
        "The channel is not 0: a freedom of the layout, but there is a mailbox error for it, so the"
        " device serves or refuses; hunts devices that fall silent, or put it into the reply."
    ),
    "counter_edge": (
        "The counter is 0 or at an edge; 0 is never a duplicate, another one is if it repeats the"
        " last; hunts devices that demand the next number in turn."
    ),
    "number_edge": (
        "A field of the request has an edge value: 0, 1, the top bit alone, all bits, or a truth"
        " value turned round; hunts signed comparisons, tables read beyond their end and masks."
    ),
    "code_unknown": (
        "A field of a code table has a value that no row names, in a message that is well formed;"
        " hunts devices that index a table with it or do not answer."
    ),
    "size_left_open": (
        "The request does not tell its size, and its unused count is 0; hunts devices that take the"
        " count of a size that was not told."
    ),
    "body_edge": (
        "The bytes at the end are none, one, or exactly as many as the mailbox holds; hunts"
        " comparisons that are off by one and buffers smaller than the mailbox."
    ),
    "segmented_start": (
        "The mailbox is full and the size says that more will follow, which begins a segmented"
        " transfer; hunts devices that copy the size and not what is there."
    ),
    "padding_set": (
        "Bytes that the message itself calls unused are not 0; hunts devices that take them into"
        " the value."
    ),
    "garbage_after": (
        "Bytes follow after the announced length, which nobody may look at; hunts devices that"
        " measure a message by its buffer."
    ),
}
_MALFORMED_NOTES: dict[str, str] = {
    "length_zero": (
        "The header announces no bytes while the message is there; hunts devices that serve what"
        " lies in the buffer, or count down from 0."
    ),
    "length_cut": (
        "The announced length ends before the message does, the rest lies in the buffer; hunts"
        " devices that read fields without asking whether they have arrived."
    ),
    "length_padded": (
        "The announced length is longer than the message, with zeros behind it; hunts devices that"
        " fall silent instead of refusing, or take the padding for data."
    ),
    "length_beyond": (
        "The announced length is longer than what the mailbox can hold; hunts devices that read or"
        " copy beyond the buffer, forget the header in the sum, or wrap round."
    ),
    "service_unknown": (
        "A field that selects the service has a value that no row of its table names; hunts devices"
        " that do not answer, jump through a table, or look at some of the bits only."
    ),
    "constant_changed": (
        "A field that has one value in this layout has another, and the message is no other of the"
        " texts; hunts devices that do not check the field."
    ),
    "reserved_set": (
        "A reserved field or unused flags are not 0, which binds the sender, while most devices"
        " must be lenient; hunts devices that compare the whole byte and fall silent."
    ),
    "count_too_small": (
        "A count inside the message is less than the bytes that follow; hunts devices that copy"
        " all bytes into room for the count."
    ),
    "count_too_large": (
        "A count inside the message is more than the bytes that follow, and the mailbox is not"
        " full, so no segments are to come; hunts devices that copy beyond the message."
    ),
    "unused_contradicts": (
        "Unused bytes are counted where none are told of or fewer are there; hunts devices that"
        " subtract below 0."
    ),
    "size_not_indicated": (
        "The message carries a size, and its command says that it has none; hunts devices that"
        " look at one of the two only."
    ),
}
NOTES: Mapping[str, str] = _BOUNDARY_NOTES | _MALFORMED_NOTES
"""Flag -> what is broken or at its edge, and what defect of a device it hunts."""


@dataclass(frozen=True, slots=True)
class Variant:
    """One message of a family; `flag` is a key of NOTES, and empty for the valid message.

    What counts is the whole mailbox area: who sends the message fills it up with zeros, and cuts a
    message at the end of the area (one with the flag `length_beyond` may encode to more bytes).
    """

    name: str
    family: Family
    flag: str
    stimulus: SendFrame


def request_frames(model: Model) -> tuple[str, ...]:
    """Give the frames that a MainDevice sends, in the order of the machines.

    These are the origins of inputs. A frame that catches what is left over (`coe`, `sdo_request`)
    is none of them: it has no valid message of its own, only the malformed ones of others. Nor is
    one that takes the area as it is (`mailbox_beyond`), without a length that tells its end.
    """
    origins = [
        frame
        for machine in model.protocol.machines.values()
        for item in machine.inputs
        if item.kind == InputKind.FRAME
        for frame in item.origin
    ]
    proper = _proper_frames(model)
    return tuple(f for f in dict.fromkeys(origins) if f in proper and _has_length(model, f))


def family_of(model: Model, frame: str, base: Mapping[str, Value]) -> Iterator[Variant]:
    """Yield the valid message with the fields of `base`, its edges, and its malformed ones.

    Every malformed one breaks one constraint. The order is that of the layouts, and the same in
    every run; names are unique within the frame.

    Args:
        model: what the texts mean.
        frame: a frame inside the mailbox.
        base: fields of one valid message; those left out are their constants, counts or 0.

    Raises:
        ValueError: `base` is no valid message of the frame, or too long for the mailbox.

    """
    return _without_twins(model, _Maker(model, frame, base).variants())


@dataclass(frozen=True, slots=True)
class _Place:
    """A field of one message: the layout it belongs to, its bits, and whether it is a constant."""

    frame: str
    field: FrameField
    start: int
    width: int
    constant: bool
    label: str

    @property
    def name(self) -> str:
        return self.field.name

    @property
    def greatest(self) -> int:
        return (1 << self.width) - 1

    @property
    def reserved(self) -> bool:
        return self.name.startswith(_RESERVED)

    def read(self, data: bytes) -> int:
        return int.from_bytes(data, "little") >> self.start & self.greatest

    def written(self, data: bytes, value: int) -> bytes:
        raw = int.from_bytes(data, "little") & ~(self.greatest << self.start)
        return (raw | value << self.start).to_bytes(len(data), "little")


class _Maker:
    """Makes the variants of one message by changing its bytes."""

    def __init__(self, model: Model, frame: str, base: Mapping[str, Value]) -> None:
        self._model = model
        self._codec = model.codec
        if not _has_length(model, frame):
            raise ValueError(f"`{frame}` lies in no frame with a length")
        self._frame = frame
        self._base = dict(base)
        self._proper = _proper_frames(model)
        self._trail = self._codec.trail(frame)
        self._root = self._trail[0]
        self._header = self._codec.size(self._root)
        self._area = model.parameter(AREAS[SYNC_MANAGERS[0]], "length")
        self._data = self._codec.encode(frame, self._base)
        message = self._codec.decode(self._data, self._root)
        if message is None or message.frame != frame or len(self._data) > self._area:
            raise ValueError(f"the base is no message of `{frame}` that fits into the mailbox")
        fault = self._contradiction(message)
        if fault is not None:
            raise ValueError(f"the base of `{frame}` is not valid. {NOTES[fault]}")
        self._message = message
        self._places = self._placed()
        self._own = {place.name: place for place in self._places if place.frame == frame}
        self._count = next(p for p in self._places if p.frame == self._root and self._counts(p))

    def variants(self) -> Iterator[Variant]:
        yield Variant("valid", Family.VALID, "", SendFrame(self._frame, self._base))
        yield from self._lengths()
        for place in self._places:
            if place.constant:
                yield from self._constants(place)
                continue
            if place.reserved:
                yield from self._reserved(place)
            elif place != self._count and not isinstance(place.field.type, Bytes):
                yield from self._numbers(place)
            if isinstance(place.field.type, Bytes) and place.frame == self._frame:
                yield from self._bodies(place)
        yield from self._garbage()

    # --- the length in the header -----------------------------------------------------------------

    def _lengths(self) -> Iterator[Variant]:
        whole = len(self._data) - self._header
        room = self._area - self._header
        cuts = {p.start // _BYTE - self._header for p in self._places if p.start % _BYTE == 0}
        cuts |= {whole - 1}
        yield from self._announced("zero", "length_zero", 0)
        for cut in sorted(cut for cut in cuts if 0 < cut < whole):
            yield from self._announced(f"cut_at_{cut}", "length_cut", cut)
        longer = {room: "fills_area", whole + 1: "one_longer"}
        for length in sorted(length for length in longer if whole < length <= room):
            yield from self._announced(longer[length], "length_padded", length)
        top = self._count.greatest
        beyond = {"one_beyond_area": room + 1, "without_header": self._area, "maximal": top}
        for word, length in beyond.items():
            if room < length <= top:
                yield from self._announced(word, "length_beyond", length)

    def _announced(self, word: str, flag: str, length: int) -> Iterator[Variant]:
        data = self._count.written(self._landed(self._data), length)
        name = f"{self._count.label}_{word}"
        yield from self._made(name, flag, data, {self._count.name: length})

    def _garbage(self) -> Iterator[Variant]:
        length = len(self._data)
        ends = {self._area: "fills_area", length + 1: "one_byte"}
        for end in sorted(end for end in ends if length < end <= self._area):
            data = self._data.ljust(end, _FILLER)
            yield from self._made(f"garbage_{ends[end]}", "garbage_after", data, {})

    # --- fields -----------------------------------------------------------------------------------

    def _constants(self, place: _Place) -> Iterator[Variant]:
        kind = place.field.type
        if isinstance(kind, Named):
            flag = "service_unknown"
            values = _values_without_row(self._model.protocol.tables[kind.table])
        else:
            now = place.read(self._data)
            flag, values = "constant_changed", [now - 1, now + 1, *_edges(place).values()]
        for value in sorted(set(values)):
            if 0 <= value <= place.greatest:
                yield from self._patched(place, str(value), flag, value)

    def _reserved(self, place: _Place) -> Iterator[Variant]:
        if place.width:
            yield from self._patched(place, "all_ones", "reserved_set", place.greatest)
        if place.width > 1:
            yield from self._patched(place, "one_bit", "reserved_set", 1)

    def _numbers(self, place: _Place) -> Iterator[Variant]:
        kind, now = place.field.type, place.read(self._data)
        edges, flag = _edges(place), "number_edge"
        rows = None
        if isinstance(kind, Named):
            rows = {row.value for row in self._model.protocol.tables[kind.table].rows}
        if isinstance(kind, Bool):
            edges = {"turned": 1 - now}
        elif place.name == _SIZE and place.frame == self._frame:
            near = {"one_less": now - 1, "one_more": now + 1}
            told = {*near.values(), 1}
            edges = near | {w: v for w, v in edges.items() if v not in told}
        if place.frame != self._frame:
            special = {_CHANNEL: "channel_set", _COUNTER: "counter_edge"}
            flag = special.get(place.name, "routing_value")
            wanted = {"turned", "all_ones", "zero" if place.name == _COUNTER else ""}
            edges = {word: value for word, value in edges.items() if word in wanted}
        unused = self._own.get(_UNUSED)
        if place.name == _SIZE_INDICATED and now and unused and _SIZE not in self._own:
            data = unused.written(place.written(self._data, 0), 0)
            changes = {place.name: 0, _UNUSED: 0}
            yield from self._made(f"{place.label}_left_open", "size_left_open", data, changes)
            edges = edges if unused.read(self._data) else {}
        for word, value in edges.items():
            if 0 <= value <= place.greatest:
                known = rows is None or value in rows
                yield from self._patched(place, word, flag if known else "code_unknown", value)

    def _bodies(self, place: _Place) -> Iterator[Variant]:
        if place.name.startswith(_PADDING) and place.width:
            yield from self._patched(place, "all_ones", "padding_set", place.greatest)
        if not self._open(place.field):
            return
        start = place.start // _BYTE
        content = self._data[start : start + place.width // _BYTE]
        content = content or (b"\0" if place.reserved else _FILLER)
        room = self._area - start
        lengths = {0: "empty", room: "fills_area", 1: "one_byte"}
        for length in sorted(length for length in lengths if length <= room):
            filled = (content * length)[:length]
            if length != place.width // _BYTE:
                changes: dict[str, Value] = {place.name: filled}
                changes |= {_SIZE: length} if _SIZE in self._own else {}
                name = f"{place.label}_{lengths[length]}"
                yield from self._rebuilt(name, "body_edge", changes)
        if _SIZE in self._own:
            changes = {place.name: (content * room)[:room], _SIZE: room + 1}
            yield from self._rebuilt(f"{place.label}_goes_on", "segmented_start", changes)

    # --- from bytes to a variant ------------------------------------------------------------------

    def _patched(self, place: _Place, word: str, flag: str, value: int) -> Iterator[Variant]:
        """Change one field; nothing if it had the value already."""
        now = place.read(self._data)
        chosen_by_sender = place.name == _COUNTER and _COUNTER not in self._base
        if value == now and not chosen_by_sender:
            return
        data = place.written(self._data, value)
        otherwise = "count_too_small" if value < now else "count_too_large"
        yield from self._made(f"{place.label}_{word}", flag, data, {place.name: value}, otherwise)

    def _rebuilt(self, name: str, flag: str, changes: dict[str, Value]) -> Iterator[Variant]:
        """Change the bytes at the end, and with them all that the encoder makes of them."""
        made = {place.name for place in self._own.values() if place.field.filled is not None}
        made |= {self._count.name}
        kept = {field: value for field, value in self._base.items() if field not in made}
        data = self._codec.encode(self._frame, kept | changes)
        yield from self._made(name, flag, data, changes)

    def _made(
        self,
        name: str,
        flag: str,
        data: bytes,
        changes: Mapping[str, Value],
        otherwise: str = "count_too_large",
    ) -> Iterator[Variant]:
        """Give the variant, with the flag that its bytes earn; nothing if it is another message.

        An edge that turns out to contradict itself is malformed; a fault of the length that leaves
        a sound message of the frame is no fault, and its like is among the bodies.
        """
        message = self._codec.decode(self._landed(data), self._root)
        same = message is not None and message.frame == self._frame
        fault = None if message is None or not same else self._contradiction(message)
        if message is not None and not same and message.frame in self._proper:
            return
        if flag in _BOUNDARY_NOTES:
            flag = (fault or flag) if same else otherwise
        elif same and fault is None and flag != "reserved_set":
            return
        family = Family.BOUNDARY if flag in _BOUNDARY_NOTES else Family.MALFORMED
        yield Variant(name, family, flag, self._stimulus(data, message, changes))

    def _landed(self, data: bytes) -> bytes:
        """Give what the mailbox holds once the message has been written."""
        return data[: self._area].ljust(self._area, b"\0")

    def _contradiction(self, message: Message) -> str | None:
        """Give the flag of a statement of the message that its other fields do not bear out."""
        layout = self._model.protocol.frames[self._frame].fields
        fields = {item.name: message.fields[item.name] for item in layout}
        last = fields[layout[-1].name] if layout[-1].type == Bytes(None) else None
        present = len(last) if isinstance(last, bytes) else None
        size, unused = fields.get(_SIZE), fields.get(_UNUSED)
        told = fields.get(_SIZE_INDICATED)
        body = message.fields[self._model.protocol.frames[self._root].fields[-1].name]
        whole = self._header + (len(body) if isinstance(body, bytes) else 0)
        full = whole == self._area
        if fields.get(_EXCESS):
            return "length_padded"
        said = {item.name: fields[item.name] for item in layout if self._open(item)}
        if len(self._codec.encode(self._frame, said)) > whole:
            return "length_cut"
        if isinstance(size, int) and present is not None:
            if told is False:
                return "size_not_indicated"
            if unused:
                return "unused_contradicts"
            if size < present:
                return "count_too_small"
            return "count_too_large" if size > present and not full else None
        if isinstance(unused, int) and unused:
            more = told is None and present is not None and unused > present
            return "unused_contradicts" if told is False or more else None
        return None

    def _stimulus(
        self, data: bytes, message: Message | None, changes: Mapping[str, Value]
    ) -> SendFrame:
        """Give the bytes as fields of the frame where the encoder can, else as raw payload."""
        fields = self._base | dict(changes)
        trials = [SendFrame(self._frame, fields)]
        if message is not None and message.frame == self._frame:
            constants = self._codec.fixed(self._frame)
            own = {n: message.fields[n] for n in self._own if n not in constants}
            trials.append(SendFrame(self._frame, fields | own))
        for trial in trials:
            if self._landed(self._codec.encode(trial.frame, trial.fields)) == self._landed(data):
                return trial
        raw: dict[str, Value] = {}
        for place in self._places:
            value = place.read(data)
            if place.frame == self._root and (
                value or place.name in fields or place == self._count
            ):
                raw[place.name] = value
        body = self._model.protocol.frames[self._root].fields[-1].name
        return SendFrame(self._root, raw | {body: data[self._header :]})

    # --- where the fields are ---------------------------------------------------------------------

    def _open(self, field: FrameField) -> bool:
        """Tell whether a field has as many bytes of content as the length of the message allows."""
        if not isinstance(field.type, Bytes) or field.name == _EXCESS or field.filled is not None:
            return False
        length = field.type.length
        own = {item.name for item in self._model.protocol.frames[self._frame].fields}
        return length is None or bool(set(names_in(length)) - own)

    def _placed(self) -> tuple[_Place, ...]:
        """Give the fields of the message from the first bit on, without the bodies of others."""
        frames = self._model.protocol.frames
        names = [item.name for name in self._trail for item in frames[name].fields]
        found: list[_Place] = []
        at = 0
        for depth, name in enumerate(self._trail):
            fields = frames[name].fields if name == self._frame else frames[name].fields[:-1]
            bound = self._bound(depth)
            for item in fields:
                content = self._message.fields[item.name]
                if isinstance(content, bytes):
                    width = len(content) * _BYTE
                else:
                    width = width_of(self._model.protocol, item.type) or 0
                constant = item.value is not None or item.name in bound
                label = item.name if names.count(item.name) == 1 else f"{name}_{item.name}"
                found.append(_Place(name, item, at, width, constant, label))
                at += width
        return tuple(found)

    def _counts(self, place: _Place) -> bool:
        return self._codec.is_derived(place.frame, place.name)

    def _bound(self, depth: int) -> set[str]:
        """Give the fields of a layout that the conditions of the layouts inside it bind."""
        frames = self._model.protocol.frames
        bound: set[str] = set()
        hidden: set[str] = set()
        for name in self._trail[depth + 1 :]:
            bound |= {field for field, _ in frames[name].conditions if field not in hidden}
            hidden |= {item.name for item in frames[name].fields}
        return bound


def _proper_frames(model: Model) -> frozenset[str]:
    """Give the frames that are more than a catch-all for what no other frame of the place is.

    A catch-all has constants that another frame at its place, or inside it, has too, and more.
    """
    codec, frames = model.codec, model.protocol.frames

    def catches(one: str, other: str) -> bool:
        inside = (frames[one].parent or one) in codec.trail(other)
        return inside and codec.fixed(one).items() < codec.fixed(other).items()

    return frozenset(one for one in frames if not any(catches(one, other) for other in frames))


def _without_twins(model: Model, variants: Iterable[Variant]) -> Iterator[Variant]:
    """Leave out what has the bytes of an earlier one; a counter of 0 is not one left open."""
    seen: set[tuple[bytes, bool]] = set()
    for variant in variants:
        stimulus = variant.stimulus
        data = model.codec.encode(stimulus.frame, stimulus.fields)
        key = data, _COUNTER in stimulus.fields
        if key not in seen:
            seen.add(key)
            yield variant


def _has_length(model: Model, frame: str) -> bool:
    """Tell whether the outermost layout around a frame counts its bytes."""
    root = model.codec.trail(frame)[0]
    fields = model.protocol.frames[root].fields
    return any(model.codec.is_derived(root, field.name) for field in fields)


def _edges(place: _Place) -> dict[str, int]:
    edges = {"zero": 0, "one": 1, "top_bit": 1 << (place.width - 1), "all_ones": place.greatest}
    return {word: edges[word] for word in {value: word for word, value in edges.items()}.values()}


def _values_without_row(table: CodeTable) -> list[int]:
    """Give the values of the width that no row names; of many the first and last of each gap."""
    rows = sorted({row.value for row in table.rows})
    bounds = [-1, *rows, 1 << table.width]
    gaps = [(low + 1, high - 1) for low, high in pairwise(bounds) if high - low > 1]
    if sum(last - first + 1 for first, last in gaps) <= _MANY:
        return [value for first, last in gaps for value in range(first, last + 1)]
    return sorted({value for gap in gaps for value in gap})
