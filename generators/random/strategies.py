"""Hypothesis strategies made from the texts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hypothesis import strategies as st

from ecatspec.generators.cases.bringup import WAY_UP, mailbox_settings, request, way_to
from ecatspec.generators.cases.case import (
    NO_LIMITS,
    Happen,
    Hurry,
    Probe,
    ReadRegister,
    Repeat,
    SendFrame,
    SendSegments,
    SetUpProcessData,
    Stimulus,
    StopOutputs,
    Wait,
    WriteOutputs,
)
from ecatspec.generators.cases.client import Ask, Begin, Move, Segment, played
from ecatspec.generators.cases.message_mutation import Family, family_of, request_frames
from ecatspec.generators.cases.transfers import (
    abort,
    download,
    entry_request,
    expedited_size,
    list_request,
    object_request,
    unsized,
    upload,
)
from ecatspec.generators.covers.sdo_cover import is_written, read_back
from ecatspec.model.core.object_dictionary import encode_value, size_of
from ecatspec.spec.language.ir import Access, Bool, Bytes, Literal, Named, SInt, Text, UInt
from ecatspec.spec.language.kinds import width_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import FrameField, ObjectEntry

_LONGEST = 200
"""Bytes of a drawn value at most: enough for several segments over a small mailbox."""
_BY_DEFAULT = ("reserved", "flags", "padding", "unused", "excess")
"""Fields whose names begin so say nothing in a valid message, or follow from the others."""
_WAITS = (500, 50_000, 600_000, 3_000_000)
"""Microseconds: within an answer, between cycles, around and beyond a watchdog."""


# --- values and messages --------------------------------------------------------------------------


def values_of(entry: ObjectEntry) -> st.SearchStrategy[bytes]:
    """Draw values that an entry takes, as the bytes that travel: in its range, of its size."""
    size = min(size_of(entry), _LONGEST)
    match entry.type:
        case Text():
            signs = st.characters(min_codepoint=ord(" "), max_codepoint=ord("~"))
            return st.text(signs, max_size=size).map(lambda text: text.encode("ascii"))
        case Bytes():
            return st.binary(max_size=size)
        case Bool():
            return st.sampled_from([b"\0", b"\1"])
        case UInt(width) | SInt(width):
            signed = isinstance(entry.type, SInt)
            low = -(1 << width - 1) if signed else 0
            high = (1 << width - signed) - 1
            low, high = (
                bound if stated is None else stated
                for bound, stated in ((low, entry.low), (high, entry.high))
            )
            return st.integers(low, high).map(lambda number: encode_value(entry, number))
        case _:
            raise TypeError(f"{entry.at}: {entry.type} is no type of an object")


def objects(model: Model) -> st.SearchStrategy[tuple[ObjectEntry, bytes]]:
    """Draw declared entries, each with a value that it takes."""

    def valued(entry: ObjectEntry) -> st.SearchStrategy[tuple[ObjectEntry, bytes]]:
        return st.tuples(st.just(entry), values_of(entry))

    return st.sampled_from(model.protocol.objects).flatmap(valued)


def frames(model: Model, names: Iterable[str] | None = None) -> st.SearchStrategy[SendFrame]:
    """Draw messages with valid fields: of the frames named, or of all that a MainDevice sends.

    Every field of the frame itself is drawn that is no constant, no count and not reserved; the
    encoder makes the others. All of them decode to the frame again and fit into the mailbox.
    """
    chosen = request_frames(model) if names is None else tuple(names)
    return st.sampled_from(chosen).flatmap(lambda name: _frame(model, name))


def malformed(model: Model) -> st.SearchStrategy[SendFrame]:
    """Draw requests with one fault each: a length, a constant, a count or a reserved field."""

    def broken(valid: SendFrame) -> st.SearchStrategy[SendFrame]:
        variants = family_of(model, valid.frame, valid.fields)
        return st.sampled_from([v.stimulus for v in variants if v.family is Family.MALFORMED])

    return frames(model).flatmap(broken)


def is_chosen(model: Model, frame: str, field: FrameField) -> bool:
    """Tell whether the sender of a frame chooses a field: no constant, no count, not reserved."""
    made = field.name in model.codec.fixed(frame) or model.codec.is_derived(frame, field.name)
    return not made and field.filled is None and not field.name.startswith(_BY_DEFAULT)


def _frame(model: Model, name: str) -> st.SearchStrategy[SendFrame]:
    codec = model.codec
    area = model.parameter("mailbox_out", "length")
    drawn: dict[str, st.SearchStrategy[Value]] = {}
    for field in model.protocol.frames[name].fields:
        if is_chosen(model, name, field):
            drawn[field.name] = _field(model, name, field)

    def sound(fields: dict[str, Value]) -> bool:
        data = codec.encode(name, fields)
        message = codec.decode(data, codec.trail(name)[0])
        same = message is not None and message.frame == name
        return same and len(data) <= area

    return st.fixed_dictionaries(drawn).filter(sound).map(lambda fields: SendFrame(name, fields))


def _field(model: Model, frame: str, field: FrameField) -> st.SearchStrategy[Value]:
    match field.type:
        case Bytes(length=Literal(value=length)):
            return st.binary(min_size=length, max_size=length)
        case Bytes(length=length):
            outside = model.codec.encode(frame, {field.name: b""})
            room = max(0, model.parameter("mailbox_out", "length") - len(outside))
            if length is not None:
                room = min(room, max(1, model.codec.capacity(frame, field.name)))
            return st.binary(min_size=int(length is not None), max_size=min(room, _LONGEST))
        case Named(table):
            return st.sampled_from([row.value for row in model.protocol.tables[table].rows])
        case SInt(width):
            return st.integers(-(1 << width - 1), (1 << width - 1) - 1)
        case kind:
            return st.integers(0, (1 << (width_of(model.protocol, kind) or 0)) - 1)


# --- stimuli --------------------------------------------------------------------------------------


def stimuli(
    model: Model, limits: Limits = NO_LIMITS, raisable: Iterable[str] = ()
) -> st.SearchStrategy[Stimulus]:
    """Draw anything that a MainDevice can do, or that happens in the device: one stimulus.

    `limits` says what the way to the device cannot carry, `raisable` which local events
    (`machine.input`) can be raised in it.
    """
    protocol = model.protocol
    states = st.integers(0, (1 << protocol.tables["al_state"].width) - 1)
    known = st.sampled_from([row.value for row in protocol.tables["al_state"].rows])
    readable = [r.name for r in protocol.registers.values() if r.main is not Access.WRITE]
    words = [w for key, w in model.words.items() if model.dictionary.entries[key].mappable]
    found: list[st.SearchStrategy[Stimulus]] = [
        st.tuples(known | states, st.booleans()).map(lambda d: request(d[0], acknowledge=d[1])),
        st.sampled_from([*mailbox_settings(model), SetUpProcessData()]),
        st.sampled_from([ReadRegister(name) for name in readable]),
        st.sampled_from([WriteOutputs(), StopOutputs(), Probe(), SendSegments(), Hurry()]),
        st.sampled_from([Wait(time) for time in _WAITS]),
        uploads(model, limits),
        downloads(model),
        information(model),
    ]
    events = sorted(raisable)
    if events:
        found.append(st.sampled_from([Happen(event) for event in events]))
    if words:
        found.append(
            st.sampled_from(words).flatmap(
                lambda word: st.integers(0, (1 << 8 * word.size) - 1).map(
                    lambda value: WriteOutputs({word.name: value})
                )
            )
        )
    if "malformed" not in limits.without:
        found.append(malformed(model))
    if "repeat" not in limits.without:
        found.append(st.just(Repeat()))
    return st.one_of(found)


def traces(
    model: Model, limits: Limits = NO_LIMITS, steps: int = 10, raisable: Iterable[str] = ()
) -> st.SearchStrategy[list[Stimulus]]:
    """Draw runs from power-on: the way to some AL state, and up to `steps` stimuli more."""
    ways = st.sampled_from([way_to(model, state) for state in WAY_UP])
    made = st.lists(moves(model, limits) | stimuli(model, limits, raisable), max_size=steps)
    return st.tuples(ways, made).map(lambda drawn: [*drawn[0], *played(drawn[1], limits, model)])


def information(model: Model) -> st.SearchStrategy[SendFrame]:
    """Draw requests of SDO information."""
    lists = [row.value for row in model.protocol.tables["object_list_type"].rows]
    asked = st.tuples(keys(model), st.integers(0, (1 << 8) - 1))
    return st.one_of(
        st.sampled_from(lists).map(list_request),
        keys(model).map(lambda key: object_request(key[0])),
        asked.map(lambda drawn: entry_request(*drawn[0], drawn[1])),
    )


# --- SDO ------------------------------------------------------------------------------------------


def keys(model: Model) -> st.SearchStrategy[tuple[int, int]]:
    """Draw declared entries, near misses of them, and anything."""
    declared = [(entry.index, entry.subindex) for entry in model.protocol.objects]
    near = [(index, subindex + 1) for index, subindex in declared]
    anything = st.tuples(st.integers(0, (1 << 16) - 1), st.integers(0, (1 << 8) - 1))
    return st.one_of(st.sampled_from(declared), st.sampled_from(near), anything)


def uploads(model: Model, limits: Limits) -> st.SearchStrategy[SendFrame]:
    """Draw upload requests, with complete access where it gets through."""
    complete = st.booleans() if "complete_access" not in limits.without else st.just(value=False)
    return st.tuples(keys(model), complete).map(lambda drawn: upload(*drawn[0], complete=drawn[1]))


def downloads(model: Model) -> st.SearchStrategy[SendFrame]:
    """Draw expedited downloads, with and without size."""
    values = st.binary(min_size=1, max_size=expedited_size(model))
    return st.tuples(keys(model), values, st.booleans()).map(
        lambda drawn: (
            download(*drawn[0], drawn[1]) if drawn[2] else unsized(model, *drawn[0], drawn[1])
        )
    )


def begins(model: Model, limits: Limits) -> st.SearchStrategy[Begin]:
    """Draw normal downloads: of the entry's own size, or of any."""

    def sized(entry_size: int) -> st.SearchStrategy[bytes]:
        own = min(entry_size, _LONGEST)
        least = int("empty_download" in limits.without)
        own = max(own, least)
        some = st.binary(min_size=least, max_size=_LONGEST)
        return st.one_of(st.binary(min_size=own, max_size=own), some)

    def begin(key: tuple[int, int]) -> st.SearchStrategy[Begin]:
        entry = model.dictionary.entries.get(key)
        values = sized(size_of(entry) if entry is not None else 1)
        return st.builds(Begin, st.just(key), values, st.integers(0, _LONGEST))

    return keys(model).flatmap(begin)


def commands(model: Model) -> st.SearchStrategy[SendFrame]:
    """Draw SDO requests with any command specifier and any content."""
    width = model.protocol.tables["client_command"].width
    least = model.parameter("smallest_data_field")
    drawn = st.tuples(st.integers(0, (1 << width) - 1), st.binary(min_size=least, max_size=least))
    return drawn.map(lambda pair: SendFrame("sdo_request", {"command": pair[0], "rest": pair[1]}))


def moves(model: Model, limits: Limits) -> st.SearchStrategy[Move]:
    """Draw what a client may do next, sensible or not."""
    truth = st.booleans()
    found: list[st.SearchStrategy[Move]] = [
        uploads(model, limits),
        downloads(model),
        begins(model, limits),
        st.builds(
            Segment,
            st.integers(0, _LONGEST),
            truth | st.just(value=True),
            truth | st.just(value=True),
        ),
        st.builds(Segment, st.integers(1, _LONGEST)),
        st.builds(Ask, truth | st.just(value=True)),
        st.just(SendSegments()),
        keys(model).map(lambda key: abort(*key, 0)),
    ]
    if "malformed" not in limits.without:
        found.append(commands(model))
    if "repeat" not in limits.without:
        found.append(st.just(Repeat()))
    return st.one_of(found)


def requests(model: Model, limits: Limits, steps: int) -> st.SearchStrategy[list[Stimulus]]:
    """Draw runs of 1 to `steps` moves between two looks at what they write, and beside it."""

    def looked(made: list[Move]) -> list[Stimulus]:
        around = [s for entry in _written(model, made) for s in read_back(model, entry)]
        return [*around, *played(made, limits, model), *around]

    return st.lists(moves(model, limits), min_size=1, max_size=steps).map(looked)


def _written(model: Model, made: list[Move]) -> list[ObjectEntry]:
    """Give the entries that moves write."""
    touched: dict[tuple[int, int], None] = {}
    for move in made:
        match move:
            case Begin(key=key):
                touched[key] = None
            case SendFrame(fields={"index": int(index), "subindex": int(subindex), "value": _}):
                touched[index, subindex] = None
            case _:
                pass
    entries = model.dictionary.entries
    return [entries[key] for key in touched if key in entries and is_written(entries[key])]
