"""The only place for the cover of mailbox and SDO rules: every entry, refusal and oddity."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.bringup import WAY_UP, mailbox_settings, way_to
from ecatspec.generators.case import Case, Probe, SendFrame, Stimulus
from ecatspec.model.dictionary import encode_value, size_of
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.compiled import Model
    from ecatspec.model.values import Value
    from ecatspec.spec.language.ir import ObjectEntry

EXPEDITED = 4
"""Bytes that an expedited transfer holds: the size of its data field."""
_LAST_INDEX = (1 << 16) - 1
_LAST_SUBINDEX = (1 << 8) - 1


def upload(index: int, subindex: int, *, complete: bool = False) -> SendFrame:
    """Ask for an entry."""
    fields: dict[str, Value] = {"index": index, "subindex": subindex}
    return SendFrame("sdo_upload_request", fields | {"complete_access": int(complete)})


def download(
    index: int, subindex: int, value: bytes, *, sized: bool = True, complete: bool = False
) -> SendFrame:
    """Write an entry, expedited; without `sized` the command does not tell the size."""
    fields: dict[str, Value] = {
        "size_indicated": int(sized),
        "complete_access": int(complete),
        "unused": EXPEDITED - len(value) if sized else 0,
        "index": index,
        "subindex": subindex,
        "value": value if sized else value.ljust(EXPEDITED, b"\0"),
    }
    return SendFrame("sdo_download_expedited", fields)


def sample(entry: ObjectEntry) -> bytes:
    """Give a value that an entry takes: its default, or the lowest of its range."""
    low = 0 if entry.low is None else entry.low
    value = entry.default if isinstance(entry.default, int) else low
    return encode_value(entry, value)


def sdo_cover(model: Model) -> Iterator[Case]:
    """Yield the cases, in the order of the dictionary and of the texts."""
    entries = [e for e in model.protocol.objects if 1 <= size_of(e) <= EXPEDITED]
    for entry in model.protocol.objects:
        yield _case(model, f"upload/{_name(entry)}", "upload", [_upload(entry)])
    for entry in entries:
        yield from _downloads(model, entry)
    yield from _missing(model)
    yield from _complete(model, entries)
    yield from _odd_commands(model)
    yield from _mailbox(model)


def _downloads(model: Model, entry: ObjectEntry) -> Iterator[Case]:
    name, value = _name(entry), sample(entry)
    if entry.access in {Access.READ, Access.NONE}:
        yield _case(
            model, f"write_read_only/{name}", "write to a read-only entry", [_write(entry, value)]
        )
        return
    back = [] if entry.access is Access.WRITE else [_upload(entry)]
    state = entry.states[0] if entry.states else "PREOP"
    yield _case(
        model, f"download/{name}", "write and read back", [_write(entry, value), *back], state
    )
    for size in range(1, EXPEDITED + 1):
        if size != size_of(entry):
            wrong = value[:size].ljust(size, b"\0")
            stimuli = [_write(entry, wrong), *back]
            yield _case(
                model, f"download_{size}_bytes/{name}", f"write {size} bytes", stimuli, state
            )
    unsized = download(entry.index, entry.subindex, value, sized=False)
    yield _case(model, f"download_unsized/{name}", "write without size", [unsized, *back], state)
    for other in WAY_UP[1:]:
        if entry.states and other not in entry.states:
            stimuli = [_write(entry, value), *back]
            yield _case(model, f"download_in_{other}/{name}", f"write in {other}", stimuli, other)
            break
    if entry.low is not None and entry.high is not None:
        bits = 8 * size_of(entry)
        edges = {"lowest": entry.low, "highest": entry.high}
        edges |= {"below": entry.low - 1} if entry.low > 0 else {}
        edges |= {"above": entry.high + 1} if entry.high + 1 < 1 << (bits - 1) else {}
        for word, number in edges.items():
            stimuli = [_write(entry, encode_value(entry, number)), *back]
            yield _case(model, f"range_{word}/{name}", f"write the value {number}", stimuli, state)


def _missing(model: Model) -> Iterator[Case]:
    declared = {entry.index for entry in model.protocol.objects}
    highest = {e.index: model.dictionary.highest(e.index) for e in model.protocol.objects}
    free = next(index for index in range(1, _LAST_INDEX) if index not in declared)
    for index in (0, free, _LAST_INDEX):
        if index not in declared:
            for kind, stimulus in (
                ("upload", upload(index, 0)),
                ("download", download(index, 0, b"\1")),
            ):
                yield _case(
                    model,
                    f"no_object/{kind}/{index:04X}",
                    f"{kind} of a missing object",
                    [stimulus],
                )
    for index, last in highest.items():
        for subindex in (last + 1, _LAST_SUBINDEX):
            name = f"{index:04X}_{subindex:02X}"
            title = "of a missing subindex"
            yield _case(
                model, f"no_subindex/upload/{name}", f"upload {title}", [upload(index, subindex)]
            )
        stimulus = download(index, last + 1, b"\1")
        yield _case(model, f"no_subindex/download/{index:04X}", f"download {title}", [stimulus])


def _complete(model: Model, entries: list[ObjectEntry]) -> Iterator[Case]:
    for entry in entries[:1]:
        stimuli: list[Stimulus] = [upload(entry.index, entry.subindex, complete=True)]
        yield _case(
            model, f"complete_upload/{_name(entry)}", "upload with complete access", stimuli
        )
        stimuli = [download(entry.index, entry.subindex, sample(entry), complete=True)]
        yield _case(
            model, f"complete_download/{_name(entry)}", "download with complete access", stimuli
        )


def _odd_commands(model: Model) -> Iterator[Case]:
    known = {r.value for r in model.protocol.tables["client_command"].rows}
    for command in range(1 << model.protocol.tables["client_command"].width):
        if command not in known:
            odd = SendFrame("sdo_request", {"command": command, "rest": bytes(7)})
            yield _case(model, f"unknown_command/{command}", "unknown command specifier", [odd])
    yield _case(model, "client_abort", "abort without a transfer", [SendFrame("sdo_abort", {})])
    services = {r.value for r in model.protocol.tables["coe_service"].rows}
    for service in range(1 << model.protocol.tables["coe_service"].width):
        if service not in services:
            odd = SendFrame("coe", {"service": service, "body": bytes(8)})
            yield _case(
                model, f"unknown_service/{service}", "unknown CoE service", [odd], layer="mailbox"
            )


def _mailbox(model: Model) -> Iterator[Case]:
    types = {r.value for r in model.protocol.tables["mailbox_type"].rows if r.name != "error"}
    for kind in range(1 << model.protocol.tables["mailbox_type"].width):
        if kind not in types:
            odd = SendFrame("mailbox", {"type": kind, "payload": bytes(8)})
            yield _case(
                model, f"unknown_type/{kind}", "unknown mailbox type", [odd], layer="mailbox"
            )
    known = probe_entry(model)
    if known is None:
        return
    again = upload(known.index, known.subindex)
    twin = SendFrame(again.frame, again.fields, same_counter=True)
    yield _case(model, "duplicate", "the same counter twice", [again, twin], layer="mailbox")
    unsized: list[Stimulus] = [SendFrame(again.frame, {**again.fields, "counter": 0})] * 2
    yield _case(model, "counter_zero", "counter 0 twice", unsized, layer="mailbox")
    yield _case(model, "nine_replies", "counters over nine replies", [again] * 9, layer="mailbox")
    for state in WAY_UP[2:]:
        yield _case(model, f"upload_in_{state}", f"upload in {state}", [again], state)
    stimuli = (*mailbox_settings(model), again)
    yield Case("mailbox/upload_in_INIT", "upload in INIT", "mailbox", stimuli, prelude=2)


def probe_entry(model: Model) -> ObjectEntry | None:
    """Give the first entry that can be read expedited in any state."""
    for entry in model.protocol.objects:
        if (
            entry.access is not Access.WRITE
            and not entry.states
            and 1 <= size_of(entry) <= EXPEDITED
        ):
            return entry
    return None


def _case(
    model: Model,
    name: str,
    title: str,
    stimuli: list[Stimulus],
    state: str = "PREOP",
    layer: str = "sdo",
) -> Case:
    way = way_to(model, state)
    done = (*way, *stimuli, Probe())
    return Case(f"{layer}/{name}", title, layer, done, needs=state, prelude=len(way))


def _upload(entry: ObjectEntry) -> Stimulus:
    return upload(entry.index, entry.subindex)


def _write(entry: ObjectEntry, value: bytes) -> Stimulus:
    return download(entry.index, entry.subindex, value)


def _name(entry: ObjectEntry) -> str:
    return f"{entry.index:04X}_{entry.subindex:02X}"
