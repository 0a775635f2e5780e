"""SDO and SDO information requests as stimuli, and whole transfers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.case import NO_LIMITS, SendFrame, SendSegments, Stimulus
from ecatspec.model.core.object_dictionary import encode_value, size_of, size_varies
from ecatspec.spec.language.ir import Bool

if TYPE_CHECKING:
    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import ObjectEntry


def upload(index: int, subindex: int, *, complete: bool = False) -> SendFrame:
    """Ask for an entry."""
    fields: dict[str, Value] = {"index": index, "subindex": subindex}
    return SendFrame("sdo_upload_request", fields | {"complete_access": int(complete)})


def upload_segment(*, toggle: bool) -> SendFrame:
    """Ask for the next segment of an upload."""
    return SendFrame("sdo_upload_segment", {"toggle": int(toggle)})


def download(
    index: int, subindex: int, value: bytes, *, sized: bool = True, complete: bool = False
) -> SendFrame:
    """Write an entry, expedited; without `sized` the command does not tell the size."""
    fields: dict[str, Value] = {
        "size_indicated": int(sized),
        "complete_access": int(complete),
        "index": index,
        "subindex": subindex,
        "value": value,
    }
    return SendFrame("sdo_download_expedited", fields)


def begins_download(frame: SendFrame) -> bool:
    """Tell whether a request says which entry is written."""
    return frame.frame.startswith("sdo_download") and "index" in frame.fields


def unsized(model: Model, index: int, subindex: int, value: bytes) -> SendFrame:
    """Write an entry by an expedited request that does not tell the size."""
    filled = value.ljust(expedited_size(model), b"\0")
    return download(index, subindex, filled, sized=False)


def initiate(
    index: int, subindex: int, size: int, value: bytes, *, complete: bool = False
) -> SendFrame:
    """Begin a normal download of `size` bytes with the first of them."""
    fields: dict[str, Value] = {
        "complete_access": int(complete),
        "index": index,
        "subindex": subindex,
        "size": size,
        "value": value,
    }
    return SendFrame("sdo_download_normal", fields)


def segment(value: bytes, *, toggle: bool, last: bool) -> SendFrame:
    """Send a segment of a download."""
    fields: dict[str, Value] = {"toggle": int(toggle), "last": int(last), "value": value}
    return SendFrame("sdo_download_segment", fields)


def abort(index: int, subindex: int, code: int) -> SendFrame:
    """Abort as the client."""
    return SendFrame("sdo_abort", {"index": index, "subindex": subindex, "code": code})


def expedited_size(model: Model) -> int:
    """Give the bytes that an expedited request carries."""
    return model.codec.capacity("sdo_download_expedited", "value")


def initiate_room(model: Model, limits: Limits = NO_LIMITS) -> int:
    """Give the most bytes that the first message of a download carries."""
    room = model.parameter("mailbox_out", "length") - model.parameter("initiate_overhead")
    return room if limits.initiate_data is None else min(room, limits.initiate_data)


def segment_room(model: Model, limits: Limits = NO_LIMITS) -> int:
    """Give the most bytes that a segment of a download carries."""
    room = model.parameter("mailbox_out", "length") - model.parameter("segment_overhead")
    return room if limits.segment_data is None else min(room, limits.segment_data)


def segments(value: bytes, piece: int) -> list[SendFrame]:
    """Give the segments that bring `value` in pieces; at least one, which is the last."""
    starts = range(0, max(1, len(value)), piece)
    return [
        segment(value[at : at + piece], toggle=number % 2 == 1, last=at + piece >= len(value))
        for number, at in enumerate(starts)
    ]


def normal_download(
    model: Model,
    key: tuple[int, int],
    value: bytes,
    limits: Limits = NO_LIMITS,
    *,
    first: int | None = None,
    piece: int | None = None,
    complete: bool = False,
) -> list[SendFrame]:
    """Write by a normal request with up to `first` bytes, then segments of `piece` bytes."""
    room = initiate_room(model, limits)
    begin = value[: room if first is None else min(first, room)]
    requests = [initiate(*key, len(value), begin, complete=complete)]
    rest = value[len(begin) :]
    if rest:
        most = segment_room(model, limits)
        requests += segments(rest, most if piece is None else min(piece, most))
    return requests


def write(
    model: Model, entry: ObjectEntry, value: bytes, limits: Limits = NO_LIMITS
) -> list[Stimulus]:
    """Write an entry as a MainDevice does: expedited where the value fits, else normal."""
    if 1 <= len(value) <= expedited_size(model):
        return [download(entry.index, entry.subindex, value)]
    return list(normal_download(model, (entry.index, entry.subindex), value, limits))


def read(index: int, subindex: int, *, complete: bool = False) -> list[Stimulus]:
    """Read an entry to its end, however many segments that takes."""
    return [upload(index, subindex, complete=complete), SendSegments()]


def pattern(length: int, salt: int = 0) -> bytes:
    """Give bytes without a zero in which no piece looks like its neighbours."""
    return bytes((at * 7 + at // 251 + salt) % 255 + 1 for at in range(length))


def sample(entry: ObjectEntry) -> bytes:
    """Give a value that an entry takes: its default, or the lowest of its range."""
    low = 0 if entry.low is None else entry.low
    value = low if entry.default is None else entry.default
    return encode_value(entry, value)


def other_sample(entry: ObjectEntry) -> bytes:
    """Give another value that an entry takes, as long as it can be told from the first."""
    if size_varies(entry):
        return pattern(min(size_of(entry), len(sample(entry)) + 3), entry.subindex)
    if entry.low is not None and entry.high is not None:
        numbers = (entry.high, entry.low)
        return next(
            (encode_value(entry, n) for n in numbers if encode_value(entry, n) != sample(entry)),
            sample(entry),
        )
    if isinstance(entry.type, Bool):
        return bytes([1 - sample(entry)[0]])
    return bytes(byte ^ 0x55 for byte in sample(entry))


def several_values(entry: ObjectEntry) -> tuple[bytes, ...]:
    """Give values of an entry of which a device that can be written takes one: far apart."""
    found = [sample(entry), other_sample(entry)]
    if size_varies(entry):
        found += [pattern(length) for length in (1, size_of(entry))]
    else:
        bits = _BYTE * size_of(entry)
        numbers = [*range(_SMALL), *(1 << bit for bit in range(bits)), (1 << bits) - 1]
        numbers += [(1 << bits - 1) - 1, *(10**digits for digits in range(bits // 3))]
        found += [encode_value(entry, number) for number in numbers if number < 1 << bits]
    return tuple(dict.fromkeys(found))


_BYTE = 8
_SMALL = 11
"""Modes and the like have numbers below."""


def list_request(kind: int) -> SendFrame:
    """Ask for a list of objects."""
    return SendFrame("information_list_request", {"list_type": kind})


def object_request(index: int) -> SendFrame:
    """Ask what an object is."""
    return SendFrame("information_object_request", {"index": index})


def entry_request(index: int, subindex: int, value_info: int = 0) -> SendFrame:
    """Ask what an entry is."""
    fields: dict[str, Value] = {"index": index, "subindex": subindex, "value_info": value_info}
    return SendFrame("information_entry_request", fields)
