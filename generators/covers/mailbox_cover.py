"""Cases of the mailbox: types, counters, repeats, unread responses."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import WAY_UP, case_in, mailbox_settings, request, way_to
from ecatspec.generators.cases.case import Case, Limits, Repeat, SendFrame, Stimulus
from ecatspec.generators.cases.stimulus import frame_bytes
from ecatspec.generators.cases.transfers import download, upload
from ecatspec.model.core.object_dictionary import size_of, size_varies
from ecatspec.model.core.register_map import BOOTSTRAP
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import ObjectEntry

_ROUND = 9
"""More messages than there are counters."""


def mailbox_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield the cases: unknown types and services, counters, states, replies that are unread."""
    yield from _unknown(model)
    known = probe_entry(model)
    if known is None:
        return
    ask = upload(known.index, known.subindex)
    yield from _counters(model, ask)
    yield from _refusals(model, ask)
    yield from _states(model, ask)
    yield from _unread(model, ask)
    yield from _repeats(model, ask)


def probe_entry(model: Model) -> ObjectEntry | None:
    """Give the first entry that can be read expedited in any state."""
    for entry in model.protocol.objects:
        readable = entry.access is not Access.WRITE and not entry.states
        if readable and not size_varies(entry) and size_of(entry) <= _expedited(model):
            return entry
    return None


def _expedited(model: Model) -> int:
    return model.codec.capacity("sdo_upload_expedited", "value")


def _unknown(model: Model) -> Iterator[Case]:
    body = bytes(model.parameter("smallest_data_field"))
    types = {r.value for r in model.protocol.tables["mailbox_type"].rows if r.name != "error"}
    for kind in range(1 << model.protocol.tables["mailbox_type"].width):
        if kind not in types:
            odd = SendFrame("mailbox", {"type": kind, "payload": body})
            name = f"mailbox/unknown_type/{kind}"
            yield case_in(model, name, "unknown mailbox type", [odd])
    services = model.protocol.tables["coe_service"]
    taken = {row.value for row in services.rows}
    refused = {row.value for row in services.rows if row.name in {"emergency", "sdo_response"}}
    first = model.protocol.objects[0]
    asking = model.decode(frame_bytes(model, upload(first.index, first.subindex), 1))
    assert asking is not None
    for service in range(1 << services.width):
        if service not in taken or service in refused:
            odd = SendFrame("coe", {"service": service, "body": body})
            name = f"coe/unknown_service/{service}"
            yield case_in(model, name, "a CoE service that no device takes", [odd])
            title = "a CoE service that no device takes, twice"
            yield case_in(model, f"coe/unknown_service_twice/{service}", title, [odd, odd])
            asks = SendFrame("coe", {"service": service, "body": asking.fields["body"]})
            title = "a CoE service that no device takes, with an SDO request in it"
            yield case_in(model, f"coe/service_as_request/{service}", title, [asks])


def _counters(model: Model, ask: SendFrame) -> Iterator[Case]:
    twin = replace(ask, same_counter=True)
    yield case_in(model, "mailbox/duplicate", "the same counter twice", [ask, twin])
    yield case_in(
        model, "mailbox/duplicates", "the same counter four times", [ask, twin, twin, twin]
    )
    zero = SendFrame(ask.frame, {**ask.fields, "counter": 0})
    yield case_in(model, "mailbox/counter_zero", "counter 0 twice", [zero, zero])
    yield case_in(model, "mailbox/counters", "counters over nine replies", [ask] * _ROUND)
    highest = model.parameter("highest_counter")
    steps = [*range(highest, 0, -1), 3, 1, 5]
    odd: list[Stimulus] = [SendFrame(ask.frame, {**ask.fields, "counter": n}) for n in steps]
    yield case_in(model, "mailbox/counter_steps", "counters in any order", odd)
    small = (e for e in model.protocol.objects if not size_varies(e))
    small = (e for e in small if size_of(e) <= _expedited(model))
    write = next((e for e in small if e.access is Access.BOTH and not e.states), None)
    if write is not None:
        first = download(write.index, write.subindex, bytes(size_of(write)))
        second = SendFrame(
            first.frame, {**first.fields, "value": b"\1" * size_of(write)}, same_counter=True
        )
        look = upload(write.index, write.subindex)
        down, up = (request(model.row("al_state", name)) for name in ("INIT", "PREOP"))
        other = SendFrame(first.frame, second.fields)
        title = "a request in INIT has no effect"
        yield case_in(model, "mailbox/write_in_INIT", title, [look, down, other, up, look])
        title = "another request with the same counter is dropped"
        yield case_in(model, "mailbox/duplicate_write", title, [look, first, second, look])


def _refusals(model: Model, ask: SendFrame) -> Iterator[Case]:
    """Yield messages that are refused, with the counters around them, and in INIT."""
    types = model.protocol.tables["mailbox_type"]
    unknown = next(n for n in range(1 << types.width) if n not in {r.value for r in types.rows})
    coe, least = model.row("mailbox_type", "coe"), model.parameter("smallest_coe_message")
    odd = {
        "too_short": SendFrame("mailbox", {"type": coe, "payload": bytes(least - 1)}),
        "header_alone": SendFrame("mailbox", {"type": coe, "payload": bytes(least)}),
        "unknown": SendFrame("mailbox", {"type": unknown, "payload": bytes(least)}),
        "unknown_and_empty": SendFrame("mailbox", {"type": unknown, "payload": b""}),
    }
    down, up = (request(model.row("al_state", name)) for name in ("INIT", "PREOP"))
    for name, message in odd.items():
        twin = replace(message, same_counter=True)
        runs: dict[str, tuple[str, list[Stimulus]]] = {
            "twice": ("twice with one counter", [message, twin, ask]),
            "before": (
                "and a request with its counter",
                [message, replace(ask, same_counter=True), ask],
            ),
            "behind": ("with the counter of the request before", [ask, twin, ask]),
            "in_INIT": ("in INIT", [ask, down, message, twin, up, ask]),
        }
        for when, (words, stimuli) in runs.items():
            title = f"a message that is refused ({name.replace('_', ' ')}) {words}"
            case = f"mailbox/refused_{name}/{when}"
            yield case_in(model, case, title, stimuli, feature="malformed")


def _states(model: Model, ask: SendFrame) -> Iterator[Case]:
    for state in WAY_UP[1:]:
        name = f"mailbox/upload_in_{state}"
        yield case_in(model, name, f"upload in {state}", [ask, ask], state=state)
    stimuli = (*mailbox_settings(model), ask)
    yield Case("mailbox/upload_in_INIT", "upload in INIT", "mailbox", stimuli, prelude=2)
    boot = (*mailbox_settings(model, areas=BOOTSTRAP), request(model.row("al_state", "BOOT")))
    yield Case(
        "mailbox/upload_in_BOOT", "upload in BOOT", "mailbox", (*boot, ask), prelude=len(boot)
    )
    init = request(model.row("al_state", "INIT"))
    for state in WAY_UP[1:]:
        name, title = f"mailbox/upload_in_INIT_after_{state}", f"upload in INIT after {state}"
        way = way_to(model, state)
        yield Case(name, title, "mailbox", (*way, ask, init, ask), state, len(way))
    beyond = SendFrame(ask.frame, {**ask.fields, "length": model.parameter("maximal_mailbox")})
    stimuli = (*mailbox_settings(model), beyond)
    title = "a message in INIT that is too long for the mailbox"
    flag = "length_beyond"
    yield Case("mailbox/beyond_in_INIT", title, "mailbox", stimuli, prelude=2, flag=flag)
    down = [request(model.row("al_state", name)) for name in ("INIT", "PREOP")]
    title = "counters start afresh with the mailbox"
    yield case_in(model, "mailbox/restart", title, [ask, *down, ask, ask])
    twin = replace(ask, same_counter=True)
    title = "a counter from before the restart is no duplicate"
    yield case_in(model, "mailbox/restart_same_counter", title, [ask, *down, twin])
    known = [len(way_to(model, state)) for state in ("PREOP", "SAFEOP")]
    up = way_to(model, "OP")
    down = [request(model.row("al_state", name)) for name in ("SAFEOP", "PREOP")]
    steps = [up[known[0] : known[1]], up[known[1] :], *((each,) for each in down)]
    around: list[Stimulus] = [stimulus for way in steps for stimulus in (*way, ask)]
    yield case_in(model, "mailbox/through_the_states", "an upload in each state", around)


def _unread(model: Model, ask: SendFrame) -> Iterator[Case]:
    left = replace(ask, unread=True)
    title = "a request while a reply is unread"
    yield case_in(model, "mailbox/reply_pending", title, [left, ask])
    title = "a duplicate while a reply is unread"
    twin = replace(ask, same_counter=True)
    yield case_in(model, "mailbox/duplicate_pending", title, [left, twin, ask])
    safeop = request(model.row("al_state", "SAFEOP"))
    title = "a reply that is unread over a change of state"
    yield case_in(model, "mailbox/reply_over_safeop", title, [left, safeop, ask])
    down = [request(model.row("al_state", name)) for name in ("INIT", "PREOP")]
    title = "a reply that is unread when the mailbox stops"
    yield case_in(model, "mailbox/reply_over_init", title, [left, *down, ask])


def _repeats(model: Model, ask: SendFrame) -> Iterator[Case]:
    again = Repeat()
    left = replace(ask, unread=True)
    other = _other(model, ask)
    runs: dict[str, tuple[str, list[Stimulus]]] = {
        "repeat_read": ("repeat of a reply that was read", [ask, again, other]),
        "repeat_unread": (
            "repeat while a newer reply is unread",
            [ask, replace(other, unread=True), again, ask],
        ),
        "repeat_queued": (
            "repeat while a reply is unread and a request waits behind it",
            [ask, left, replace(other, unread=True), again, ask],
        ),
        "repeat_nothing": ("repeat before anything was sent", [again, ask]),
        "repeat_first_unread": ("repeat while the first reply is unread", [left, again, other]),
        "repeat_twice": ("repeat twice", [ask, again, again, other]),
        "repeat_thrice": (
            "repeat the last of several replies",
            [ask, other, ask, again, again, again, other],
        ),
        "repeat_after_restart": (
            "the repeat bit is left set when the mailbox starts again",
            [
                ask,
                again,
                *(request(model.row("al_state", n)) for n in ("INIT", "PREOP")),
                ask,
                again,
            ],
        ),
        "repeat_nothing_after_restart": (
            "repeat before anything was sent since the mailbox started again",
            [
                ask,
                *(request(model.row("al_state", n)) for n in ("INIT", "PREOP")),
                again,
                ask,
            ],
        ),
        "repeat_in_INIT": (
            "the repeat bit is toggled in INIT",
            [
                ask,
                request(model.row("al_state", "INIT")),
                again,
                request(model.row("al_state", "PREOP")),
                ask,
                again,
            ],
        ),
        "repeat_in_safeop": (
            "repeat in SAFEOP",
            [ask, request(model.row("al_state", "SAFEOP")), again, other, again],
        ),
    }
    for name, (title, stimuli) in runs.items():
        yield case_in(model, f"mailbox/{name}", title, stimuli, feature="repeat")


def _other(model: Model, ask: SendFrame) -> SendFrame:
    for entry in model.protocol.objects:
        own = (entry.index, entry.subindex) == (ask.fields["index"], ask.fields["subindex"])
        if entry.access is not Access.WRITE and not own:
            return upload(entry.index, entry.subindex)
    return ask
