"""The only place for Hypothesis strategies made from the texts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from hypothesis import strategies as st

from ecatspec.generators.case import Repeat, SendFrame, SendSegments, Stimulus
from ecatspec.generators.sdo_cover import is_written, read_back
from ecatspec.generators.transfers import (
    abort,
    download,
    expedited_size,
    initiate,
    initiate_room,
    segment,
    segment_room,
    unsized,
    upload,
    upload_segment,
)
from ecatspec.model.dictionary import size_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.generators.case import Limits
    from ecatspec.model.compiled import Model
    from ecatspec.spec.language.ir import ObjectEntry

_LONGEST = 200
"""Bytes of a drawn value at most: enough for several segments over a small mailbox."""


@dataclass(frozen=True, slots=True)
class Begin:
    """Begin a download of `value`, `first` bytes of it in the first message."""

    key: tuple[int, int]
    value: bytes
    first: int


@dataclass(frozen=True, slots=True)
class Segment:
    """Send the next `count` bytes; `right` tells whether the toggle bit is, `honest` the last."""

    count: int
    right: bool = True
    honest: bool = True


@dataclass(frozen=True, slots=True)
class Ask:
    """Ask for a segment of an upload."""

    right: bool = True


Move: TypeAlias = Stimulus | Begin | Segment | Ask


def played(moves: Sequence[Move], limits: Limits, model: Model) -> list[Stimulus]:
    """Give the stimuli of moves as a client makes them that knows where its transfer stands."""
    stimuli: list[Stimulus] = []
    toggle, rest = False, b""
    for move in moves:
        match move:
            case Begin(key, value, first):
                first = min(first, initiate_room(model, limits))
                stimuli.append(initiate(*key, len(value), value[:first]))
                toggle, rest = False, value[first:]
            case Segment(count, right, honest):
                piece = rest[: min(count, segment_room(model, limits))]
                last = (len(piece) == len(rest)) is honest
                stimuli.append(segment(piece, toggle=toggle is right, last=last))
                if right:
                    toggle, rest = not toggle, rest[len(piece) :]
            case Ask(right):
                stimuli.append(upload_segment(toggle=toggle is right))
                toggle = toggle is not right
            case SendFrame():
                stimuli.append(move)
                toggle = False
            case _:
                stimuli.append(move)
    return stimuli


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
