"""Cases of complete access: layouts, sizes, rights, refusals."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import WAY_UP, case_in
from ecatspec.generators.cases.transfers import (
    initiate,
    normal_download,
    other_sample,
    pattern,
    read,
    segment,
    upload,
    write,
)
from ecatspec.generators.covers.sdo_cover import is_written, missing_indexes, state_of
from ecatspec.generators.covers.transfer_cover import long_entry
from ecatspec.model.core.object_dictionary import encode_value, size_of
from ecatspec.spec.language.ir import Access, Bool, SInt

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Case, Limits, SendFrame, Stimulus
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import ObjectEntry

_FEW = 3
"""Messages of a transfer that a device may refuse: the rest would be stray segments."""
FEATURE = "complete_access"


def complete_cover(model: Model, limits: Limits) -> Iterator[Case]:
    """Yield the cases: every object up and down, then what must be refused."""
    for index, entries in objects(model).items():
        for first in (0, 1):
            name = f"{index:04X}_from_{first}"
            stimuli = read(index, first, complete=True)
            yield _case(model, f"complete_upload/{name}", f"upload all from {first}", stimuli)
        beyond = upload(index, 2, complete=True)
        title = "complete upload from subindex 2"
        yield _case(model, f"complete_upload/{index:04X}_from_2", title, [beyond])
        yield from _hidden(model, limits, index, entries)
        if any(is_written(entry) for entry in entries):
            yield from _downloads(model, limits, index, entries)
    yield from _mixed(model, limits)
    for index in missing_indexes(model):
        ask = upload(index, 0, complete=True)
        title = "complete upload of a missing object"
        yield _case(model, f"complete_no_object/upload/{index:04X}", title, [ask])
        put = initiate(index, 0, 2, b"\1\0", complete=True)
        title = "complete download of a missing object"
        yield _case(model, f"complete_no_object/download/{index:04X}", title, [put])


def _hidden(model: Model, limits: Limits, index: int, entries: list[ObjectEntry]) -> Iterator[Case]:
    """Yield uploads of an object after writes to those of its entries that cannot be read."""
    hidden = [e for e in entries if e.access is Access.WRITE and not e.states]
    writes = [s for e in hidden for s in write(model, e, other_sample(e), limits)]
    for first in (0, 1) if len(entries) > 1 and hidden else ():
        name = f"complete_upload_hidden/{index:04X}_from_{first}"
        stimuli = [*writes, *read(index, first, complete=True)]
        title = f"upload all from {first}, after writes to what cannot be read"
        yield _case(model, name, title, stimuli)


def _mixed(model: Model, limits: Limits) -> Iterator[Case]:
    """Yield transfers of a whole object and of one entry behind each other, both in segments."""
    whole = {i: own for i, own in objects(model).items() if len(own) > 1 and _writable(own)}
    long = long_entry(model)
    found = max(whole, key=lambda i: len(image(whole[i], 0)), default=None)
    if long is None or found is None:
        return
    key = long.index, long.subindex
    all_of_it, one = read(found, 0, complete=True), read(*key)
    put = normal_download(model, (found, 0), image(whole[found], 0), limits, first=0, complete=True)
    part = normal_download(model, key, pattern(size_of(long), 1), limits, first=0)
    least = min(whole, key=lambda i: len(image(whole[i], 0)))
    longer = image(whole[least], 0) + b"\1"
    refused = normal_download(model, (least, 0), longer, limits, complete=True)
    stray = segment(b"\1", toggle=False, last=True)
    parts = [r for n in (0, 1) for r in (*read(found, n, complete=True), *read(found, n))]
    behind = "of an object and of an entry behind each other"
    runs: dict[str, tuple[str, list[Stimulus]]] = {
        "upload": (f"upload {behind}", [*part, *all_of_it, *one, *all_of_it]),
        "download": (f"download {behind}", [*put, *part, *one, *put, *all_of_it]),
        "parts": ("uploads of an object, and of the entry that it begins with", parts),
        "refused": ("a segment after an object that was refused", [*refused, stray]),
    }
    for word, (title, stimuli) in runs.items():
        yield _case(model, f"complete_and_single/{word}", title, stimuli)


def _writable(entries: list[ObjectEntry]) -> bool:
    """Tell whether an object can be written where it is tried, and has no single bits."""
    written = [entry for entry in entries if is_written(entry)]
    here = all("PREOP" in entry.states or not entry.states for entry in written)
    return bool(written) and here and not any(isinstance(e.type, Bool) for e in entries)


def objects(model: Model) -> dict[int, list[ObjectEntry]]:
    """Give the declared entries of each object."""
    found: dict[int, list[ObjectEntry]] = {}
    for entry in sorted(model.protocol.objects, key=lambda e: (e.index, e.subindex)):
        found.setdefault(entry.index, []).append(entry)
    return found


def image(entries: list[ObjectEntry], first: int) -> bytes:
    """Give the bytes of a complete download with other values than there were."""
    data = b""
    for entry in entries:
        if entry.subindex >= first:
            size = 2 * size_of(entry) if entry.subindex == 0 else size_of(entry)
            value = other_sample(entry) if is_written(entry) else b""
            data += value.ljust(size, b"\0")
    return data


def _half(entries: list[ObjectEntry], first: int) -> bytes:
    """Give the bytes of about half of the entries, whole ones; nothing where there is one only."""
    taken = [entry for entry in entries if entry.subindex >= first]
    return image(taken[: len(taken) // 2], first)


def out_of_range(entries: list[ObjectEntry], first: int) -> bytes | None:
    """Give an image in which one entry has a value that is too high, where that can be."""
    data, found = b"", False
    for entry in entries:
        if entry.subindex >= first:
            size = 2 * size_of(entry) if entry.subindex == 0 else size_of(entry)
            value = other_sample(entry) if is_written(entry) else b""
            if is_written(entry) and entry.high is not None and not found:
                value, found = encode_value(entry, entry.high + 1), True
            data += value.ljust(size, b"\0")
    return data if found else None


def _alone(entries: list[ObjectEntry], first: int) -> dict[str, bytes]:
    """Give images of one entry of several, beside its range."""
    found: dict[str, bytes] = {}
    for entry in entries if len(entries) > 1 else ():
        if entry.subindex == first and is_written(entry) and entry.low is not None:
            assert entry.high is not None
            bits = 8 * size_of(entry)
            least = -(1 << bits - 1) if isinstance(entry.type, SInt) else 0
            for word, number in (("below", entry.low - 1), ("above", entry.high + 1)):
                if least <= number < least + (1 << bits):
                    value = encode_value(entry, number)
                    found[word] = value.ljust(len(value) * (2 if first == 0 else 1), b"\0")
    return found


def _downloads(
    model: Model, limits: Limits, index: int, entries: list[ObjectEntry]
) -> Iterator[Case]:
    states = {state_of(entry) for entry in entries if is_written(entry)}
    state = states.pop() if len(states) == 1 else "PREOP"
    back = [
        stimulus
        for entry in entries
        if entry.access is not Access.WRITE
        for stimulus in read(index, entry.subindex)
    ]
    bits = any(isinstance(entry.type, Bool) for entry in entries)
    for first in (0, 1):
        data = image(entries, first)
        if not data or bits:
            continue
        shapes: dict[str, list[SendFrame]] = {
            "whole": normal_download(model, (index, first), data, limits, complete=True),
            "size_only": normal_download(
                model, (index, first), data, limits, first=0, complete=True
            ),
            "shorter": normal_download(model, (index, first), data[:-1], limits, complete=True),
            "longer": normal_download(model, (index, first), data + b"\1", limits, complete=True),
        }
        part = _half(entries, first)
        if part:
            begun = normal_download(model, (index, first), part, limits, complete=True)
            shapes["half"] = begun
        if len(entries) == 1:
            shapes = {"whole": shapes["whole"][:_FEW]}
        odd = out_of_range(entries, first)
        if odd is not None:
            requests = normal_download(model, (index, first), odd, limits, complete=True)
            shapes["out_of_range"] = requests
        for word, requests in shapes.items():
            name = f"complete_download_{word}/{index:04X}_from_{first}"
            stimuli: list[Stimulus] = [*back, *requests, *back]
            title = f"download all from {first}, {word.replace('_', ' ')}"
            yield _case(model, name, title, stimuli, state)
        for word, value in _alone(entries, first).items():
            put = initiate(index, first, len(value), value, complete=True)
            name = f"complete_download_of_one_{word}/{index:04X}_from_{first}"
            title = f"download no more than the first entry from {first}, {word}"
            yield _case(model, name, title, [*back, put, *back], state)
        for other in WAY_UP[1:]:
            if any(is_written(e) and e.states and other not in e.states for e in entries):
                stimuli = [*shapes["whole"], *back]
                name = f"complete_download_in_{other}/{index:04X}_from_{first}"
                yield _case(model, name, f"download all from {first}", stimuli, other)
                break
    put = initiate(index, 2, 2, b"\1\0", complete=True)
    title = "complete download from subindex 2"
    yield _case(model, f"complete_download_from_2/{index:04X}", title, [*back, put, *back], state)


def _case(
    model: Model, name: str, title: str, stimuli: list[Stimulus], state: str = "PREOP"
) -> Case:
    return case_in(model, f"sdo/{name}", title, stimuli, state=state, feature=FEATURE)
