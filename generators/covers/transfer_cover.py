"""Cases of normal and segmented transfers: sizes, toggles, interruptions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import WAY_UP, case_in, request
from ecatspec.generators.cases.case import (
    Case,
    Limits,
    Repeat,
    SendFrame,
    SendSegments,
    Stimulus,
    WriteUntilTaken,
)
from ecatspec.generators.cases.transfers import (
    abort,
    download,
    expedited_size,
    initiate,
    initiate_room,
    normal_download,
    other_sample,
    pattern,
    read,
    sample,
    segment,
    segment_room,
    segments,
    upload,
    upload_segment,
)
from ecatspec.generators.covers.sdo_cover import (
    entry_name,
    is_written,
    missing_indexes,
    searched,
    state_of,
    writing,
)
from ecatspec.model.core.object_dictionary import size_of, size_varies
from ecatspec.spec.language.ir import Access, Bool

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import ObjectEntry


def transfer_cover(model: Model, limits: Limits) -> Iterator[Case]:
    """Yield the cases: sizes of every writable entry, then all that can go wrong in the middle."""
    for entry in model.protocol.objects:
        if is_written(entry):
            yield from _elsewhere(model, entry)
            yield from _sizes(model, limits, entry)
        else:
            value = pattern(min(size_of(entry), _SOME))
            for word, first in (("normal", None), ("segmented", 0)):
                requests = normal_download(model, _key(entry), value, limits, first=first)
                name = f"sdo/{word}_read_only/{entry_name(entry)}"
                title = f"{word} write to a read-only entry"
                yield case_in(model, name, title, writing(model, entry, requests))
    for index in missing_indexes(model):
        stimuli = normal_download(model, (index, 0), pattern(8), limits)
        name = f"sdo/normal_no_object/{index:04X}"
        yield case_in(model, name, "normal write to a missing object", stimuli)
    least = model.parameter("smallest_data_field")
    strays: dict[str, tuple[str, Stimulus]] = {
        "stray_segment": (
            "segment without a transfer",
            segment(pattern(least), toggle=False, last=True),
        ),
        "stray_first_segment": (
            "segment without a transfer, more to come",
            segment(pattern(least), toggle=False, last=False),
        ),
        "stray_upload_segment": (
            "segment request without a transfer",
            upload_segment(toggle=False),
        ),
    }
    for name, (title, stray) in strays.items():
        yield case_in(model, f"sdo/transfer/{name}", title, [stray])
    target = transfer_target(model)
    if target is not None:
        yield from _interruptions(model, limits, target)
    long = long_entry(model)
    if long is not None:
        yield from _uploads(model, limits, long)


def transfer_target(model: Model) -> ObjectEntry | None:
    """Give the entry that transfers are tried on: writable always, readable, as long as can be."""
    found = [
        e
        for e in model.protocol.objects
        if e.access is Access.BOTH
        and not e.states
        and e.low is None
        and not isinstance(e.type, Bool)
    ]
    return max(found, key=lambda e: (size_varies(e), min(size_of(e), _ENOUGH)), default=None)


_SOME = 64
_SOME = 64
_ENOUGH = 2000
"""Bytes that take several segments over any mailbox."""


def _key(entry: ObjectEntry) -> tuple[int, int]:
    return entry.index, entry.subindex


def long_entry(model: Model) -> ObjectEntry | None:
    """Give an entry whose upload takes segments, written first where that is needed."""
    return next(_long_entries(model), None)


def _long_entries(model: Model) -> Iterator[ObjectEntry]:
    room = model.parameter("mailbox_in", "length") - model.parameter("initiate_overhead")
    for entry in model.protocol.objects:
        if entry.access is Access.BOTH and not entry.states and room < size_of(entry) <= _ENOUGH:
            yield entry


def _elsewhere(model: Model, entry: ObjectEntry) -> Iterator[Case]:
    """Yield the search for a value that is taken, in the other AL states that allow a write."""
    for state in WAY_UP[1:] if searched(entry) else ():
        if state != state_of(entry) and (not entry.states or state in entry.states):
            name = f"sdo/takes_in_{state}/{entry_name(entry)}"
            until = [WriteUntilTaken(entry.index, entry.subindex)]
            yield case_in(
                model, name, f"write values until one is taken in {state}", until, state=state
            )


# --- sizes ----------------------------------------------------------------------------------------


def _sizes(model: Model, limits: Limits, entry: ObjectEntry) -> Iterator[Case]:
    name, state = entry_name(entry), state_of(entry)
    value = other_sample(entry)
    for word, requests in _forms(model, limits, entry, value).items():
        stimuli = writing(model, entry, requests)
        title = f"write {len(value)} bytes, {word.replace('_', ' ')}"
        yield case_in(model, f"sdo/{word}/{name}", title, stimuli, state=state)
    if not size_varies(entry):
        for size in (size_of(entry) - 1, size_of(entry) + 1, size_of(entry) + _FAR):
            if size > 0:
                wrong = pattern(size)
                for word, first in (("normal", None), ("segmented", 0)):
                    requests = normal_download(model, _key(entry), wrong, limits, first=first)
                    stimuli = writing(model, entry, requests)
                    case = f"sdo/{word}_{size}_bytes/{name}"
                    yield case_in(model, case, f"write {size} bytes, {word}", stimuli, state=state)
        return
    for size in _lengths(model, limits, size_of(entry)):
        requests = normal_download(model, _key(entry), pattern(size), limits)
        if size > size_of(entry):
            requests = requests[:_FEW]
        stimuli = writing(model, entry, requests)
        case = f"sdo/length_{size}/{name}"
        feature = "" if size else "empty_download"
        yield case_in(model, case, f"write {size} bytes", stimuli, state=state, feature=feature)


_FEW = 4
"""Messages after which a device must have refused what is too long."""
_MOST_SEGMENTS = 1000
_FAR = 40
"""The number of bytes that is more than a rounding of the size."""


def _forms(
    model: Model, limits: Limits, entry: ObjectEntry, value: bytes
) -> dict[str, list[SendFrame]]:
    """Give the ways in which a client may bring the same value."""
    key = _key(entry)
    forms = {"normal": normal_download(model, key, value, limits)}
    if value:
        forms["size_only"] = normal_download(model, key, value, limits, first=0)
        forms["single_bytes"] = normal_download(
            model, key, value[:_ENOUGH], limits, first=0, piece=1
        )
        begun = initiate(*key, len(value), b"")
        least = model.parameter("smallest_data_field")
        full = segments(value, max(least, segment_room(model, limits)))
        open_end = [segment_with(s, last=False) for s in full]
        toggle = len(full) % 2 == 1
        forms["empty_last_segment"] = [begun, *open_end, segment(b"", toggle=toggle, last=True)]
    if len(value) > 1:
        forms["first_byte_ahead"] = normal_download(model, key, value, limits, first=1)
    return forms


def segment_with(stimulus: SendFrame, **changes: int) -> SendFrame:
    """Give a segment with other flags."""
    return SendFrame(stimulus.frame, {**stimulus.fields, **changes})


def _lengths(model: Model, limits: Limits, most: int) -> list[int]:
    """Give the lengths at which the shape of a transfer changes, and those at the object's end."""
    first, more = initiate_room(model, limits), segment_room(model, limits)
    back = model.parameter("mailbox_in", "length")
    answered = back - model.parameter("initiate_overhead")
    further = back - model.parameter("segment_overhead")
    least, expedited = model.parameter("smallest_data_field"), expedited_size(model)
    edges = {0, 1, expedited, expedited + 1, first, first + 1, first + least, first + least + 1}
    edges |= {first + more, first + more + 1, answered, answered + 1, answered + further}
    edges |= {answered + further + 1, most, most + 1}
    if most <= _ENOUGH:
        edges |= {most - 1, most + _FAR}
    longest = first + _MOST_SEGMENTS * more
    return sorted(edge for edge in edges if 0 <= edge <= min(most + _FAR, longest))


# --- what can happen in the middle of a download --------------------------------------------------


def _interruptions(model: Model, limits: Limits, target: ObjectEntry) -> Iterator[Case]:
    key = _key(target)
    whole, room = size_of(target), segment_room(model, limits)
    piece = min(room, max(1, whole // 3))
    # an object of fixed size takes nothing shorter: the last segment brings the rest
    fits = not size_varies(target) and whole - 2 * piece <= room
    size = whole if fits else min(3 * piece, whole)
    value = pattern(size)
    begin = initiate(*key, size, b"")
    pieces = (value[:piece], value[piece : 2 * piece], value[2 * piece :])
    one, two, three = (
        segment(each, toggle=number % 2 == 1, last=number == len(pieces) - 1)
        for number, each in enumerate(pieces)
    )
    first = segment_with(one, last=0)
    second = segment_with(two, last=0)
    probe = next(
        e
        for e in model.protocol.objects
        if e.access is not Access.WRITE and not e.states and _key(e) != key
    )
    elsewhere = upload(probe.index, probe.subindex)
    longer = segment(pattern(segment_room(model, limits)), toggle=True, last=True)
    rest = bytes(model.parameter("smallest_data_field"))
    odd = {
        row_value: SendFrame("sdo_request", {"command": row_value, "rest": rest})
        for row_value in _unknown_commands(model)
    }
    flip = segment_with(first, toggle=1)
    runs: dict[str, tuple[str, list[Stimulus]]] = {
        "wrong_first_toggle": ("first toggle bit is 1", [begin, flip]),
        "wrong_first_toggle_last": (
            "first toggle bit of the only segment is 1",
            [
                initiate(*key, min(7, size), b""),
                segment(value[: min(7, size)], toggle=True, last=True),
            ],
        ),
        "malformed_in_transfer": (
            "segments after a malformed one in the middle of a download",
            [begin, first, _cut_short(model, second), second, three],
        ),
        "wrong_second_toggle": (
            "toggle bit does not alternate",
            [begin, first, segment_with(second, toggle=0)],
        ),
        "segment_again": ("the same segment twice", [begin, first, first]),
        "toggle_then_right": (
            "the right toggle bit after a wrong one",
            [begin, flip, first, second, three],
        ),
        "toggle_then_new": (
            "a new transfer after a wrong toggle bit",
            [begin, flip, *normal_download(model, key, value, limits)],
        ),
        "beyond_at_last": (
            "last segment beyond the announced size",
            [initiate(*key, piece, b""), segment_with(first, last=0), longer],
        ),
        "beyond_in_one": (
            "one segment beyond the announced size",
            [initiate(*key, 1, b""), segment_with(longer, toggle=0)],
        ),
        "beyond_and_wrong_toggle": (
            "a segment beyond the announced size whose toggle bit is wrong",
            [initiate(*key, 1, b""), longer],
        ),
        "too_early_and_wrong_toggle": (
            "last segment before the announced size, with a wrong toggle bit",
            [begin, segment_with(one, last=1, toggle=1)],
        ),
        "beyond_in_the_middle": (
            "more than announced before the last segment",
            [initiate(*key, piece, b""), first, second, three],
        ),
        "too_early": (
            "last segment before the announced size",
            [begin, segment_with(first, last=1)],
        ),
        "too_early_empty": (
            "empty last segment before the announced size",
            [begin, first, segment(b"", toggle=True, last=True)],
        ),
        "empty_segment": (
            "an empty segment in the middle",
            [
                begin,
                first,
                segment(b"", toggle=True, last=False),
                segment_with(second, toggle=0),
                segment_with(three, toggle=1),
            ],
        ),
        "after_the_end": (
            "a segment after the last one",
            [
                begin,
                first,
                second,
                three,
                segment_with(three, toggle=1),
            ],
        ),
        "new_upload": ("an upload in the middle of a download", [begin, first, elsewhere, second]),
        "new_download": (
            "another download in the middle of a download",
            [begin, first, *normal_download(model, key, pattern(size, 3), limits)],
        ),
        "new_begin": ("the same download begun again", [begin, first, begin, first, second, three]),
        "wrong_direction": (
            "segment request in the middle of a download",
            [begin, first, upload_segment(toggle=True)],
        ),
        "wrong_direction_first": (
            "segment request right after the begin of a download",
            [begin, upload_segment(toggle=False)],
        ),
        "client_abort": (
            "abort in the middle of a download",
            [begin, first, abort(*key, 0), second],
        ),
        "client_abort_first": (
            "abort right after the begin of a download",
            [begin, abort(*key, 0), first],
        ),
        "unfinished": ("a download that is not finished", [begin, first]),
        "over_init": (
            "a download over a restart of the mailbox",
            [begin, first, *_restart(model), second],
        ),
        "shorter_after": (
            "a shorter value after a longer one",
            [
                *normal_download(model, key, value, limits),
                *normal_download(model, key, pattern(max(1, size // 2), 5), limits),
            ],
        ),
        "rest_of_before": (
            "a short value right after an unfinished long one",
            [begin, first, *normal_download(model, key, pattern(min(5, size), 9), limits, first=0)],
        ),
        "duplicate_segment": (
            "a segment with the counter of the one before",
            [
                begin,
                first,
                SendFrame(second.frame, second.fields, same_counter=True),
                second,
                three,
            ],
        ),
        "repeat_in_transfer": (
            "a repeat in the middle of a download",
            [begin, first, Repeat(), second, three],
        ),
    }
    for command, request_ in odd.items():
        runs[f"unknown_command_{command}"] = (
            "unknown command in the middle of a download",
            [begin, first, request_, *normal_download(model, key, pattern(size, 1), limits)],
        )
    for name, (title, stimuli) in runs.items():
        feature = _feature(name)
        looked = writing(model, target, stimuli)
        yield case_in(model, f"sdo/transfer/{name}", title, looked, feature=feature)


def _cut_short(model: Model, stimulus: SendFrame) -> SendFrame:
    """Give a segment whose message ends after its command byte."""
    header = model.codec.size("coe") + 1
    return SendFrame(stimulus.frame, {**stimulus.fields, "length": header})


def _unknown_commands(model: Model) -> list[int]:
    table = model.protocol.tables["client_command"]
    known = {r.value for r in table.rows}
    return [value for value in range(1 << table.width) if value not in known]


def _restart(model: Model) -> list[Stimulus]:
    return [request(model.row("al_state", name)) for name in ("INIT", "PREOP")]


# --- what can happen in the middle of an upload ---------------------------------------------------


def _uploads(model: Model, limits: Limits, entry: ObjectEntry) -> Iterator[Case]:
    key = _key(entry)
    ask = upload(*key)
    fill = normal_download(model, key, pattern(size_of(entry), 4), limits)
    get, turned = upload_segment(toggle=False), upload_segment(toggle=True)
    other = segment(sample(entry)[:7] or b"\1", toggle=False, last=True)
    probe = next(e for e in model.protocol.objects if e.access is not Access.WRITE and not e.states)
    runs: dict[str, tuple[str, list[Stimulus]]] = {
        "upload_whole": ("upload in segments", [ask, SendSegments()]),
        "upload_wrong_first_toggle": ("first toggle bit of an upload is 1", [ask, turned]),
        "upload_malformed": (
            "segment requests after a malformed one in the middle of an upload",
            [ask, get, _cut_short(model, turned), turned],
        ),
        "upload_wrong_second_toggle": (
            "toggle bit of an upload does not alternate",
            [ask, get, get],
        ),
        "upload_toggle_then_right": ("the right toggle bit after a wrong one", [ask, turned, get]),
        "upload_toggle_then_new": (
            "a new upload after a wrong toggle bit",
            [ask, turned, ask, SendSegments()],
        ),
        "upload_after_the_end": (
            "a segment request after the last segment",
            [ask, SendSegments(), get, turned],
        ),
        "upload_begun_again": ("the same upload begun again", [ask, get, ask, SendSegments()]),
        "upload_other": (
            "another upload in the middle",
            [ask, get, upload(probe.index, probe.subindex), turned],
        ),
        "upload_then_download": (
            "a download in the middle of an upload",
            [ask, get, *fill, turned],
        ),
        "upload_wrong_direction": (
            "a download segment in the middle of an upload",
            [ask, get, other],
        ),
        "upload_client_abort": (
            "abort in the middle of an upload",
            [ask, get, abort(*key, 0), turned],
        ),
        "upload_over_init": (
            "an upload over a restart of the mailbox",
            [ask, get, *_restart(model), turned],
        ),
        "upload_repeat": ("a repeat in the middle of an upload", [ask, get, Repeat(), turned]),
        "upload_expedited_write": (
            "a small write in the middle of an upload",
            [ask, download(*key, b"\1"), get],
        ),
    }
    beside = next((e for e in _long_entries(model) if e.subindex != entry.subindex), None)
    if beside is not None:
        begun = _key(beside)
        filled = normal_download(model, begun, pattern(size_of(beside), 5), limits)
        runs["upload_wrong_toggle_elsewhere"] = (
            "the abort of an upload names it, and not the one before",
            [*filled, ask, SendSegments(), upload(*begun), turned],
        )
    for name, (title, stimuli) in runs.items():
        feature = _feature(name)
        looked = [*fill, *read(*key), *stimuli]
        yield case_in(model, f"sdo/transfer/{name}", title, looked, feature=feature)


def _feature(name: str) -> str:
    """Give what the way to a device must carry for a run of this name."""
    if "repeat" in name:
        return "repeat"
    if name.startswith("unknown_command"):
        return name
    if "malformed" in name:
        return "malformed"
    return "mailbox_restart" if name.endswith("over_init") else ""
