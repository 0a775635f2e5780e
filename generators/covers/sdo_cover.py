"""Cases of single SDO requests: every entry, every refusal, oddities."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import WAY_UP, case_in
from ecatspec.generators.cases.case import Case, Limits, SendFrame, Stimulus, WriteUntilTaken
from ecatspec.generators.cases.transfers import (
    abort,
    download,
    expedited_size,
    normal_download,
    other_sample,
    read,
    unsized,
    upload,
    write,
)
from ecatspec.model.core.memo import once
from ecatspec.model.core.object_dictionary import encode_value, size_of, size_varies
from ecatspec.spec.language.ir import Access, Binary, In, Literal, Name, SInt
from ecatspec.spec.language.nodes import nodes_in, parts_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import ObjectEntry

_TOGETHER = 8
"""Entries that are written in one case; the last of one is the first of the next."""
_LAST_INDEX = (1 << 16) - 1
_LAST_SUBINDEX = (1 << 8) - 1


def sdo_cover(model: Model, limits: Limits) -> Iterator[Case]:
    """Yield the cases, in the order of the dictionary and of the texts."""
    for entry in model.protocol.objects:
        stimuli = read(entry.index, entry.subindex)
        state = entry.read_states[0] if entry.read_states else "PREOP"
        yield case_in(model, f"sdo/upload/{entry_name(entry)}", "upload", stimuli, state=state)
        for other in WAY_UP[1:]:
            if entry.read_states and other not in entry.read_states:
                name = f"sdo/upload_in_{other}/{entry_name(entry)}"
                yield case_in(model, name, f"upload in {other}", stimuli, state=other)
    for entry in model.protocol.objects:
        yield from _downloads(model, limits, entry)
    yield from _together(model, limits)
    yield from _missing(model)
    yield from _odd_commands(model)


def entry_name(entry: ObjectEntry) -> str:
    """Give index and subindex in the form that names of cases have."""
    return f"{entry.index:04X}_{entry.subindex:02X}"


def is_written(entry: ObjectEntry) -> bool:
    """Tell whether a client can write the entry in some state."""
    return entry.access in {Access.WRITE, Access.BOTH}


def read_back(model: Model, entry: ObjectEntry) -> list[Stimulus]:
    """Read an entry and its neighbours in the dictionary: a write must not reach them."""
    places = _lasting(model)
    place = entry.index, entry.subindex
    first, end = bisect_left(places, place), bisect_right(places, place)
    looks = (*places[first:end], *places[end : end + 1], *places[max(first - 1, 0) : first])
    return [stimulus for look in looks for stimulus in read(*look)]


@once
def _lasting(model: Model) -> tuple[tuple[int, int], ...]:
    """Give the places of what can be read and changes by writes alone, in order."""
    lasting = (e for e in model.protocol.objects if e.access is not Access.WRITE)
    return tuple(sorted((e.index, e.subindex) for e in lasting if not e.volatile))


def writing(model: Model, entry: ObjectEntry, requests: Sequence[Stimulus]) -> list[Stimulus]:
    """Give the requests of a write between two looks at the entry and its neighbours."""
    around = read_back(model, entry)
    return [*around, *requests, *around]


def searched(entry: ObjectEntry) -> bool:
    """Tell whether no text says which values an entry takes, and it is expected to take some."""
    return entry.access is Access.BOTH and entry.low is None and not entry.guarded


def state_of(entry: ObjectEntry) -> str:
    """Give the first AL state in which an entry can be written."""
    return entry.states[0] if entry.states else "PREOP"


def _downloads(model: Model, limits: Limits, entry: ObjectEntry) -> Iterator[Case]:
    name, value, state = entry_name(entry), other_sample(entry), state_of(entry)
    expedited = expedited_size(model)
    if not is_written(entry):
        small = (value or b"\1")[:expedited]
        stimuli = writing(model, entry, [download(entry.index, entry.subindex, small)])
        title = "write to a read-only entry"
        yield case_in(model, f"sdo/write_read_only/{name}", title, stimuli)
        return
    stimuli = writing(model, entry, write(model, entry, value, limits))
    title = "write, read back, and look at the neighbours"
    yield case_in(model, f"sdo/download/{name}", title, stimuli, state=state)
    for size in range(1, expedited + 1):
        if size != size_of(entry) and not (size_varies(entry) and size < size_of(entry)):
            wrong = value[:size].ljust(size, b"\0")
            stimuli = writing(model, entry, [download(entry.index, entry.subindex, wrong)])
            case = f"sdo/download_{size}_bytes/{name}"
            yield case_in(model, case, f"write {size} bytes", stimuli, state=state)
    if size_of(entry) <= expedited and not size_varies(entry):
        request = unsized(model, entry.index, entry.subindex, value)
        stimuli = writing(model, entry, [request])
        case = f"sdo/download_unsized/{name}"
        yield case_in(model, case, "write without size", stimuli, state=state)
    for other in WAY_UP[1:]:
        if entry.states and other not in entry.states:
            stimuli = writing(model, entry, write(model, entry, value, limits))
            case = f"sdo/download_in_{other}/{name}"
            yield case_in(model, case, f"write in {other}", stimuli, state=other)
            break
    if searched(entry):
        title = "write values until one is taken"
        until = [WriteUntilTaken(entry.index, entry.subindex)]
        yield case_in(model, f"sdo/takes/{name}", title, until, state=state)
    yield from _ranges(model, limits, entry)


def _together(model: Model, limits: Limits) -> Iterator[Case]:
    """Yield entries that are written one after the other, and then read: each keeps its own."""
    kept = [e for e in model.protocol.objects if e.access is Access.BOTH and _keeps(model, e)]
    for place in range(0, len(kept) - 1, _TOGETHER - 1):
        group = kept[place : place + _TOGETHER]
        stimuli = [s for entry in group for s in write(model, entry, other_sample(entry), limits)]
        looks = (look for entry in group for look in read(entry.index, entry.subindex))
        title = f"{len(group)} entries written, then read"
        name = f"sdo/together/{entry_name(group[0])}"
        yield case_in(model, name, title, (*stimuli, *looks))


def _keeps(model: Model, entry: ObjectEntry) -> bool:
    """Tell whether an entry holds what was written to it in PREOP, and nothing hangs on it."""
    everywhere = all(
        not states or "PREOP" in states for states in (entry.states, entry.read_states)
    )
    return everywhere and not entry.volatile and not model.sets_up(entry.index)


def _ranges(model: Model, limits: Limits, entry: ObjectEntry) -> Iterator[Case]:
    if entry.low is None or entry.high is None:
        return
    bits = 8 * size_of(entry)
    signed = isinstance(entry.type, SInt)
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    edges = {"lowest": entry.low, "highest": entry.high}
    edges |= {"below": entry.low - 1, "least": least} if entry.low > least else {}
    edges |= {"above": entry.high + 1, "most": most} if entry.high < most else {}
    for word, number in edges.items():
        value = encode_value(entry, number)
        stimuli = writing(model, entry, write(model, entry, value, limits))
        case = f"sdo/range_{word}/{entry_name(entry)}"
        yield case_in(model, case, f"write the value {number}", stimuli, state=state_of(entry))
        if not entry.low <= number <= entry.high:
            key = entry.index, entry.subindex
            parts = normal_download(model, key, value, limits, first=0)
            case = f"sdo/range_{word}_in_segments/{entry_name(entry)}"
            title = f"write the value {number} in segments"
            stimuli = writing(model, entry, parts)
            yield case_in(model, case, title, stimuli, state=state_of(entry))


def missing_indexes(model: Model) -> list[int]:
    """Give indexes at the edges and in between that no text declares."""
    declared = {entry.index for entry in model.protocol.objects}
    free = next(index for index in range(1, _LAST_INDEX) if index not in declared)
    return [index for index in (0, free, _LAST_INDEX) if index not in declared]


def named_indexes(model: Model) -> list[int]:
    """Give the indexes that definitions name and no text declares; of a range its ends."""
    declared = {entry.index for entry in model.protocol.objects}
    named: dict[int, None] = {}
    for definition in model.protocol.definitions.values():
        for node in nodes_in(definition.value):
            if isinstance(node, In) and node.operand == Name("index"):
                ends = (end for item in node.items for end in (parts_of(item) or (item,)))
                named |= {int(end.value): None for end in ends if isinstance(end, Literal)}
    return [index for index in named if index not in declared]


def compared_indexes(model: Model) -> list[int]:
    """Give the indexes on both sides of each number that rules compare an index with."""
    edges: dict[int, None] = {}
    for machine in model.protocol.machines.values():
        for rule in machine.rules:
            for node in nodes_in(rule.guard):
                match node:
                    case Binary("<" | "<=" | ">" | ">=", Name("index"), Literal(edge)):
                        edges |= {int(edge) - 1: None, int(edge): None, int(edge) + 1: None}
    return [index for index in edges if 0 <= index <= _LAST_INDEX]


def missing_subindexes(model: Model) -> dict[int, list[int]]:
    """Give for each declared object subindexes that it does not have: gaps, the next, the last."""
    found: dict[int, list[int]] = {}
    for index in dict.fromkeys(entry.index for entry in model.protocol.objects):
        last = model.dictionary.highest(index)
        gaps = [n for n in range(last) if (index, n) not in model.dictionary.entries]
        beyond = (n for n in (last + 1, _LAST_SUBINDEX) if n <= _LAST_SUBINDEX)
        found[index] = [*gaps[:1], *beyond]
    return found


def _missing(model: Model) -> Iterator[Case]:
    named = named_indexes(model)
    for index in dict.fromkeys((*missing_indexes(model), *named)):
        # what texts say of an object that the device may have holds for its first entry
        asked = [upload(index, subindex) for subindex in ((0, 1) if index in named else (0,))]
        for kind, stimuli in (("upload", asked), ("download", [download(index, 0, b"\1")])):
            name = f"sdo/no_object/{kind}/{index:04X}"
            yield case_in(model, name, f"{kind} of a missing object", stimuli)
    for index, subindexes in missing_subindexes(model).items():
        for subindex in subindexes:
            name = f"{index:04X}_{subindex:02X}"
            title = "of a missing subindex"
            asked = [upload(index, subindex)]
            yield case_in(model, f"sdo/no_subindex/upload/{name}", f"upload {title}", asked)
        asked = [download(index, subindexes[0], b"\1")]
        name = f"sdo/no_subindex/download/{index:04X}"
        yield case_in(model, name, f"download {title}", asked)


def _odd_commands(model: Model) -> Iterator[Case]:
    table = model.protocol.tables["client_command"]
    known = {row.value for row in table.rows}
    rest = bytes(model.parameter("smallest_data_field"))
    for command in range(1 << table.width):
        if command not in known:
            odd = SendFrame("sdo_request", {"command": command, "rest": rest})
            name, feature = f"sdo/unknown_command/{command}", f"unknown_command_{command}"
            yield case_in(model, name, "unknown command specifier", [odd], feature=feature)
    yield case_in(model, "sdo/client_abort", "abort without a transfer", [abort(0, 0, 0)])
