"""Cases of the SDO server's states: every kind of request in each state.

What a request leaves behind shows by the segments that come after it: they belong to a transfer
that is open, or to none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import WAY_UP, case_in
from ecatspec.generators.cases.case import SendFrame
from ecatspec.generators.cases.transfers import (
    abort,
    download,
    expedited_size,
    initiate,
    normal_download,
    other_sample,
    pattern,
    sample,
    segment,
    upload,
    upload_segment,
)
from ecatspec.generators.covers.complete_access_cover import FEATURE, image, objects, out_of_range
from ecatspec.generators.covers.mailbox_cover import probe_entry
from ecatspec.generators.covers.sdo_cover import is_written, missing_indexes, missing_subindexes
from ecatspec.generators.covers.transfer_cover import long_entry, transfer_target
from ecatspec.model.core.object_dictionary import encode_value, size_of, size_varies
from ecatspec.spec.language.ir import Access, Bool, SInt

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ecatspec.generators.cases.case import Case, Limits
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import ObjectEntry

Key = tuple[int, int]
_MALFORMED = "malformed"
_STATE = WAY_UP[1]
"""The AL state in which the server is tried: the first in which it works."""


@dataclass(frozen=True, slots=True)
class Request:
    """Messages of a client, what the way to the device must carry for them, and the AL state."""

    name: str
    messages: Sequence[SendFrame]
    feature: str = ""
    state: str = _STATE


def server_cover(model: Model, limits: Limits) -> Iterator[Case]:
    """Yield a case for every state of the server and every kind of request."""
    known = probe_entry(model)
    if known is None:
        return
    every = tuple(requests(model, limits, known))
    for state, way in _states(model, limits, known).items():
        goes_on, begins = (segment(b"\1", toggle=toggle, last=False) for toggle in (True, False))
        asks = upload_segment(toggle=False)
        looks = (goes_on, begins, asks, begins) if state != "uploading" else (asks, begins, goes_on)
        for request in every:
            title = f"{request.name.replace('_', ' ')}, and segments behind it, {state}"
            yield case_in(
                model,
                f"sdo/server/{state}/{request.name}",
                title,
                [*way, *request.messages, *looks],
                state=request.state,
                feature=request.feature or _carried(request),
            )


def _carried(request: Request) -> str:
    """Give what the way to the device must carry for it, beside mail."""
    begins = (m.fields.get("value") for m in request.messages if m.frame == "sdo_download_normal")
    return "data_in_initiate" if any(begins) else ""


def _states(model: Model, limits: Limits, known: ObjectEntry) -> dict[str, list[SendFrame]]:
    """Give what leads to the states of the server in which a transfer is open, or none."""
    ask = upload(known.index, known.subindex)
    found: dict[str, list[SendFrame]] = {"idle": [ask]}
    target = transfer_target(model)
    if target is not None:
        value = pattern(size_of(target)) if size_varies(target) else other_sample(target)
        begun = initiate(*_key(target), len(value), b"")
        found["downloading"] = [begun, segment(value[:1], toggle=False, last=False)]
    long, get = long_entry(model), upload_segment(toggle=False)
    room = model.parameter("mailbox_in", "length") - model.parameter("initiate_overhead")
    records = (i for i, own in objects(model).items() if len(own) > 1 and len(image(own, 0)) > room)
    record = next(records, None)
    if long is not None:
        fill = normal_download(model, _key(long), pattern(size_of(long), 4), limits)
        found["uploading"] = [*fill, upload(*_key(long)), get]
    elif record is not None and FEATURE not in limits.without:
        found["uploading"] = [upload(record, 0, complete=True), get]
    return found


def requests(model: Model, limits: Limits, known: ObjectEntry) -> Iterator[Request]:
    """Yield requests of every kind that a client can make: served, refused, malformed."""
    ask, get = upload(known.index, known.subindex), upload_segment(toggle=False)
    short = segment(b"\1", toggle=False, last=False)
    yield Request("upload", [ask])
    yield Request("abort", [abort(0, 0, 0)])
    malformed = {
        "upload_with_excess": _with(ask, excess=b"\1"),
        "upload_with_reserved_bits": _with(ask, reserved_bits=1),
        "upload_with_reserved_data": _with(ask, reserved_data=1),
        "segment_request_with_excess": _with(get, excess=b"\1"),
        "segment_request_with_flags": _with(get, flags=1),
        "next_segment_request_with_flags": _with(upload_segment(toggle=True), flags=1),
        "segment_too_short": _with(short, length=model.codec.size("coe") + 1),
        "abort_too_short": _with(abort(0, 0, 0), length=model.codec.size("coe") + 1),
    }
    for name, message in malformed.items():
        yield Request(name, [message], _MALFORMED)
    table = model.protocol.tables["client_command"]
    rest = bytes(model.parameter("smallest_data_field"))
    for command in {*range(1 << table.width)} - {row.value for row in table.rows}:
        odd = SendFrame("sdo_request", {"command": command, "rest": rest})
        yield Request(f"unknown_command_{command}", [odd], f"unknown_command_{command}")
    for key, word in _missing(model).items():
        yield Request(f"upload_{word}", [upload(*key)])
        yield Request(f"download_{word}", [download(*key, b"\1")])
        yield Request(f"download_{word}_begun", [initiate(*key, 2, b"")])
        for place in (0, 1, 2):
            at = f"{word}_from_{place}"
            yield Request(f"complete_upload_{at}", [upload(key[0], place, complete=True)], FEATURE)
            put = initiate(key[0], place, 2, b"\1\0", complete=True)
            yield Request(f"complete_download_{at}", [put], FEATURE)
    yield from _by_right(model)
    yield from _of_values(model, limits)
    yield from _out_of_range(model, limits)
    yield from _complete(model, limits)


def _by_right(model: Model) -> Iterator[Request]:
    """Yield requests for the first entry that lacks a right, always or in some AL state."""
    entries = model.protocol.objects
    for entry in [e for e in entries if e.access is Access.WRITE][:1]:
        yield Request("upload_write_only", [upload(*_key(entry))])
    for entry in [e for e in entries if e.read_states][:1]:
        for state in _without(entry.read_states):
            yield Request("upload_in_wrong_state", [upload(*_key(entry))], state=state)
    read_only = [(e, _STATE) for e in entries if not is_written(e)]
    at_times = [(e, s) for e in entries if is_written(e) for s in _without(e.states)]
    for what, found in (("read_only", read_only[:1]), ("in_wrong_state", at_times[:1])):
        for entry, state in found:
            value = other_sample(entry) or b"\1"
            begun = initiate(*_key(entry), len(value), b"")
            if len(value) <= expedited_size(model):
                # a part of it would have a second fault, and either may be told
                yield Request(f"download_{what}", [download(*_key(entry), value)], state=state)
            yield Request(f"download_{what}_begun", [begun], state=state)
    for what, found in (("read_only", _sized(read_only)), ("in_wrong_state", _sized(at_times))):
        for entry, state in found:
            short = [download(*_key(entry), other_sample(entry)[:-1][: expedited_size(model)])]
            yield Request(f"download_{what}_too_short", short, state=state)


def _sized(found: Sequence[tuple[ObjectEntry, str]]) -> list[tuple[ObjectEntry, str]]:
    """Give the first entry to which a value can be too short."""
    return [(e, s) for e, s in found if size_of(e) > 1 and not size_varies(e)][:1]


def _without(states: Sequence[str]) -> list[str]:
    """Give the first AL state that is none of these; nothing where all are meant."""
    return [state for state in WAY_UP[1:] if states and state not in states][:1]


def _of_values(model: Model, limits: Limits) -> Iterator[Request]:
    """Yield writes to an entry that takes any value of its size: of that size and of others."""
    free = [e for e in model.protocol.objects if _freely(e) and e.low is None]
    sized = [e for e in free if not size_varies(e) and not isinstance(e.type, Bool)]
    fixed = min(sized, key=lambda e: _less_fit(model, e), default=None)
    if fixed is None:
        return
    key, value = _key(fixed), sample(fixed)
    yield Request("download", [download(*key, value)])
    yield Request("download_normal", normal_download(model, key, value, limits))
    yield Request("download_in_segments", normal_download(model, key, value, limits, first=0))
    begun = initiate(*key, len(value), b"")
    yield Request("download_begun", [begun])
    for size in (len(value) - 1, len(value) + 1):
        if size > 0:
            wrong = normal_download(model, key, pattern(size), limits)
            yield Request(f"download_{size}_bytes", wrong)
            yield Request(f"download_{size}_bytes_begun", [initiate(*key, size, b"")])
    segments = {
        "turned": segment(value[:1], toggle=True, last=False),
        "too_long": segment(value + b"\1", toggle=False, last=False),
        "too_early": segment(value[:-1], toggle=False, last=True),
    }
    for name, message in segments.items():
        yield Request(f"download_segment_{name}", [begun, message])
    most = model.parameter("longest_transfer")
    yield Request("download_of_the_most", [initiate(*key, most, value)])
    yield Request("download_beyond_service", [initiate(*key, most + 1, value)])
    whole = initiate(*key, len(value), value)
    malformed = {
        "without_size": _with(whole, size_indicated=0),
        "with_unused_bytes": _with(whole, unused=1),
        "beyond_service_with_unused_bytes": _with(initiate(*key, most + 1, value), unused=1),
        "of_more_than_told": _with(whole, size=len(value) - 1),
        "with_excess": _with(download(*key, value), excess=b"\1"),
    }
    for name, message in malformed.items():
        yield Request(f"download_{name}", [message], _MALFORMED)


def _less_fit(model: Model, entry: ObjectEntry) -> tuple[bool, bool]:
    """Give what makes an entry less fit: that it configures process data, or is long."""
    return model.image.configures(entry.index), size_of(entry) > expedited_size(model)


def _out_of_range(model: Model, limits: Limits) -> Iterator[Request]:
    """Yield values beside the range: of process data objects, which have rules of their own."""
    bounded = [e for e in model.protocol.objects if _freely(e) and e.high is not None]
    configuring = [e for e in bounded if model.image.configures(e.index)]
    others = [e for e in bounded if e not in configuring]
    for what, entries in (("count", configuring), ("value", others)):
        for entry in entries[:1]:
            assert entry.low is not None
            assert entry.high is not None
            bits = 8 * size_of(entry)
            numbers = {"below": entry.low - 1, "above": entry.high + 1}
            least = -(1 << bits - 1) if isinstance(entry.type, SInt) else 0
            for side, number in numbers.items():
                if least <= number < least + (1 << bits):
                    key, value = _key(entry), encode_value(entry, number)
                    name = f"download_{what}_{side}"
                    yield Request(name, normal_download(model, key, value, limits))
                    parts = normal_download(model, key, value, limits, first=0)
                    yield Request(f"{name}_in_segments", parts)


def _complete(model: Model, limits: Limits) -> Iterator[Request]:
    """Yield complete access to the first variable, and to the first object that is written."""
    whole = objects(model)
    variables = (i for i, own in whole.items() if len(own) == 1)
    records = (i for i, own in whole.items() if len(own) > 1 and any(map(_freely, own)))
    kinds = {"variable": next(variables, None), "object": next(records, None)}
    for name, index in kinds.items():
        for place in (0, 1, 2) if index is not None else ():
            assert index is not None
            at, key = f"from_{place}", (index, place)
            yield Request(f"complete_upload_{name}_{at}", [upload(*key, complete=True)], FEATURE)
            data = image(whole[index], min(place, 1)) or b"\1"
            shapes = {
                "": normal_download(model, key, data, limits, complete=True),
                "_begun": [initiate(*key, len(data), b"", complete=True)],
            }
            if place == 0:
                in_parts = normal_download(model, key, data, limits, first=0, complete=True)
                more = data + b"\1"
                shapes |= {
                    "_in_segments": in_parts,
                    "_longer": normal_download(model, key, more, limits, complete=True),
                    "_longer_begun": [initiate(*key, len(more), b"", complete=True)],
                    "_shorter_begun": [initiate(*key, max(1, len(data) - 1), b"", complete=True)],
                }
            odd = out_of_range(whole[index], min(place, 1))
            if odd is not None:
                wrong = normal_download(model, key, odd, limits, complete=True)
                shapes["_out_of_range"] = wrong
            for word, messages in shapes.items():
                yield Request(f"complete_download_{name}{word}_{at}", messages, FEATURE)
            part = [initiate(*key, len(data), b"")]
            yield Request(f"download_of_the_size_of_{name}_{at}", part)
            for entry in (e for e in whole[index] if e.subindex == place):
                begun = [initiate(*key, size_of(entry), b"", complete=True)]
                yield Request(f"complete_download_{name}_of_one_entry_{at}", begun, FEATURE)


def _freely(entry: ObjectEntry) -> bool:
    """Tell whether an entry can be written where the server is tried."""
    return is_written(entry) and (not entry.states or _STATE in entry.states)


def _missing(model: Model) -> dict[Key, str]:
    """Give what does not exist: an object, and a subindex of an object."""
    found: dict[Key, str] = {(index, 0): "no_object" for index in missing_indexes(model)[1:2]}
    for index, subindexes in missing_subindexes(model).items():
        if subindexes:
            found[index, subindexes[0]] = "no_subindex"
            break
    return found


def _with(message: SendFrame, **changes: int | bytes) -> SendFrame:
    """Give a message with other fields."""
    return replace(message, fields={**message.fields, **changes})


def _key(entry: ObjectEntry) -> Key:
    return entry.index, entry.subindex
