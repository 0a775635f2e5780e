"""Cases of process data: SyncManagers, the way to OP, watchdog, loss."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ecatspec.generators.cases.assignment import brought_up, first_assigned, set_entry
from ecatspec.generators.cases.bringup import WATCHDOG, has_process_data, request, way_to
from ecatspec.generators.cases.case import (
    Case,
    Happen,
    Probe,
    ReadConfiguration,
    SetUpProcessData,
    Stimulus,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
)
from ecatspec.generators.cases.process_data import holds, image_size, settings
from ecatspec.generators.cases.transfers import upload
from ecatspec.model.core.register_map import PROCESS_DATA
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model

_OUTPUTS, _INPUTS = PROCESS_DATA
_MICROSECONDS = 25
"""Ticks of 40 ns in one microsecond."""
_BYTE = 8
_SOON = 1000
"""Microseconds after the watchdog had to expire in virtual time, which is exact."""


def process_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield the cases of a device whose texts declare process data; else those without."""
    for state in ("PREOP", "SAFEOP", "OP"):
        yield _case(model, f"sync_lost/{state}", (Happen("al.sync_lost"),), state)
    if not has_process_data(model):
        return
    used = _used(model)
    for name, set_up in wrong_process_data(model).items():
        yield _refused(model, name, set_up)
        if name.startswith(("off_", "too_long_")):
            yield _refused(model, name, set_up, later=True)
    yield from _fewer(model)
    yield from _none(model)
    if _OUTPUTS in used:
        yield from _way_to_op(model)
        yield from _watchdog(model)
        yield from _ignored(model)
    yield from _unwatched(model, used)
    for state in ("SAFEOP", "OP"):
        for name in used:
            off = WriteRegister(f"{name}_activation", {"enabled": 0})
            done: tuple[Stimulus, ...] = (off, _to(model, "INIT"), *way_to(model, "OP"))
            yield _case(model, f"disabled_{name}/{state}", done, state)
        if len(used) > 1:
            yield _case(model, f"disabled_both/{state}", (_both_off(model),), state)


def _unwatched(model: Model, used: list[str]) -> Iterator[Case]:
    """Yield SyncManagers that are disabled where no process data run any more."""
    for state in ("SAFEOP", "OP"):
        for below in ("INIT", "PREOP"):
            for name in used:
                off = WriteRegister(f"{name}_activation", {"enabled": 0})
                done = (_to(model, below), off, _to(model, below))
                yield replace(
                    _case(model, f"disabled_{name}/{below}_after_{state}", done, state),
                    about="al.process_data_prepared" if below == "PREOP" else "",
                )


def _ignored(model: Model) -> Iterator[Case]:
    """Yield outputs below OP, before and after there were process data, which act nowhere."""
    for name, word in model.protocol.words.items():
        entry = None if word.key is None else model.dictionary.entries.get(word.key)
        if entry is None or entry.access is Access.WRITE or entry.read_states:
            continue
        if not holds(model, brought_up(model), name):
            continue
        ask = upload(entry.index, entry.subindex)
        tried = (ask, WriteOutputs({name: (1 << 8 * word.size) - 1}), ask)
        before = (*first_assigned(model), SetUpProcessData(), *tried)
        after = (_to(model, "PREOP"), *tried)
        for case in (
            _case(model, f"outputs_in_PREOP/{name}", before, "PREOP"),
            _case(model, f"outputs_in_PREOP_after_OP/{name}", after, "OP"),
        ):
            yield replace(case, about="process_data.outputs_unheard")
        yield _case(model, f"outputs_in_SAFEOP/{name}", tried, "SAFEOP")
        back = (_to(model, "SAFEOP"), *tried)
        yield _case(model, f"outputs_in_SAFEOP_after_OP/{name}", back, "OP")


def _both_off(model: Model) -> WriteRegisters:
    """Disable both SyncManagers by one write, which leaves what lies between as it is."""
    _, inputs = settings(model, brought_up(model), SetUpProcessData())
    off = [WriteRegister(f"{name}_activation", {"enabled": 0}) for name in PROCESS_DATA]
    return WriteRegisters((off[0], inputs.writes[0], off[1]))


def _used(model: Model) -> list[str]:
    """Give the SyncManagers that have process data, as they are assigned on the way up."""
    return [name for name in PROCESS_DATA if image_size(model, brought_up(model), name)]


def wrong_process_data(model: Model) -> dict[str, SetUpProcessData]:
    """Give settings of process data that deviate in one point, or in one for each direction."""
    mailbox = model.row("sync_manager_mode", "mailbox")
    used = _used(model)
    found: dict[str, SetUpProcessData] = {}
    for name in used:
        wrong_way = "main_reads" if name == _OUTPUTS else "main_writes"
        direction = model.row("sync_manager_direction", wrong_way)
        area = {_OUTPUTS: "process_data_out", _INPUTS: "process_data_in"}[name]
        moved = model.parameter(area, "start") + 3 * model.parameter(area, "length")
        wrong = {
            "off": SetUpProcessData({f"{name}_activation": {"enabled": 0}}),
            "too_long": SetUpProcessData(longer={name: 1}),
            "too_short": SetUpProcessData(longer={name: -1}),
            "much_too_long": SetUpProcessData(longer={name: 11}),
            "as_mailbox": SetUpProcessData({name: {"mode": mailbox}}),
            "empty": SetUpProcessData({name: {"length": 0}}),
            "reversed": SetUpProcessData({name: {"direction": direction}}),
            "moved": SetUpProcessData({name: {"start": moved}}),
        }
        found |= {f"{what}_{name}": set_up for what, set_up in wrong.items()}
    if len(used) > 1:
        off = {f"{name}_activation": {"enabled": 0} for name in used}
        found["too_long_both"] = SetUpProcessData(longer=dict.fromkeys(used, 2))
        found["off_both"] = SetUpProcessData(off)
    return found


def _refused(model: Model, name: str, settings: SetUpProcessData, *, later: bool = False) -> Case:
    """Give a way to SAFEOP with wrong settings, then with right ones; `later`: from SAFEOP."""
    wrong: tuple[Stimulus, ...] = (settings, _to(model, "SAFEOP"), *_anew(model))
    if later:
        return _case(model, f"later/{name}", (_to(model, "PREOP"), *_off(), *wrong), "SAFEOP")
    return _case(model, name, (*first_assigned(model), *wrong), "PREOP")


def _off() -> tuple[Stimulus, ...]:
    """Disable both SyncManagers of process data."""
    return tuple(WriteRegister(f"{name}_activation", {"enabled": 0}) for name in PROCESS_DATA)


def _anew(model: Model) -> tuple[Stimulus, ...]:
    """Set up process data as they are to be, and go on to SAFEOP."""
    return (*_off(), SetUpProcessData(), _to(model, "SAFEOP", acknowledge=True))


def _fewer(model: Model) -> Iterator[Case]:
    """Yield settings as they were before an entry less is mapped in one direction."""
    state = brought_up(model)
    objects = state.objects
    for name, index in zip(PROCESS_DATA, model.image.assignments.values(), strict=True):
        pdo = int.from_bytes(objects.get((index, 1), b""), "little")
        numbers = [objects.get(key, b"\0")[0] for key in ((index, 0), (pdo, 0))]
        counts = [model.dictionary.entries.get((number, 0)) for number in (index, pdo)]
        writable = all(c is not None and c.access is Access.BOTH for c in counts)
        if not writable or not model.has_mailbox or not numbers[0] or numbers[1] <= 1:
            continue
        last = int.from_bytes(objects.get((pdo, numbers[1]), b""), "little")
        cleared = (set_entry(model, index, 0, 0), set_entry(model, pdo, 0, 0))
        counted = (set_entry(model, pdo, 0, numbers[1] - 1), set_entry(model, index, 0, numbers[0]))
        fewer = (*first_assigned(model), *cleared, *counted, ReadConfiguration())
        as_before = SetUpProcessData(longer={name: (last & 0xFF) // _BYTE})
        done: tuple[Stimulus, ...] = (*fewer, as_before, _to(model, "SAFEOP"), *_anew(model))
        yield _case(model, f"fewer_{name}", done, "PREOP")


def _none(model: Model) -> Iterator[Case]:
    """Yield nothing assigned in one direction, with settings that fit and as they were before."""
    state = brought_up(model)
    for name, index in zip(PROCESS_DATA, model.image.assignments.values(), strict=True):
        count = model.dictionary.entries.get((index, 0))
        size = image_size(model, state, name)
        if count is None or count.access is not Access.BOTH or not model.has_mailbox or not size:
            continue
        none = (*first_assigned(model), set_entry(model, index, 0, 0), ReadConfiguration())
        fitting = (SetUpProcessData(), _to(model, "SAFEOP"))
        yield _case(model, f"none_{name}", (*none, *fitting), "PREOP")
        as_before = (SetUpProcessData(longer={name: size}), _to(model, "SAFEOP"), *_anew(model))
        yield _case(model, f"none_as_before_{name}", (*none, *as_before), "PREOP")


def _way_to_op(model: Model) -> Iterator[Case]:
    op, ack = _to(model, "OP"), _to(model, "OP", acknowledge=True)
    yield _case(model, "op_without_outputs", (op, WriteOutputs(), ack), "SAFEOP")
    yield _case(model, "op_with_outputs", (WriteOutputs(), op), "SAFEOP")
    stale = (WriteOutputs(), StopOutputs(), Wait(2 * _watchdog_time(model)), op)
    yield _case(model, "op_after_the_watchdog", (*stale, WriteOutputs(), ack), "SAFEOP")
    back = (_to(model, "SAFEOP"), op, _to(model, "PREOP"), _to(model, "SAFEOP"), op)
    yield _case(model, "op_again", back, "OP")


def _watchdog(model: Model) -> Iterator[Case]:
    time = _watchdog_time(model)
    expired = (StopOutputs(), Wait(2 * time))
    safeop, op = _to(model, "SAFEOP", acknowledge=True), _to(model, "OP")
    at_once = _to(model, "OP", acknowledge=True)
    yield _case(model, "watchdog", expired, "OP")
    yield _case(model, "watchdog_not_yet", (StopOutputs(), Wait(time // 2), WriteOutputs()), "OP")
    yield _case(model, "watchdog_and_back", (*expired, WriteOutputs(), safeop, op), "OP")
    yield _case(model, "watchdog_and_op_at_once", (*expired, WriteOutputs(), at_once), "OP")
    yield _case(model, "watchdog_unacknowledged", (*expired, WriteOutputs(), op), "OP")
    yield _case(model, "watchdog_and_init", (*expired, _to(model, "INIT")), "OP")
    yield _case(model, "watchdog_in_safeop", (WriteOutputs(), *expired), "SAFEOP")
    off = WriteRegister("watchdog_process_data", {"time": 0})
    yield _case(model, "watchdog_off", (off, WriteOutputs(), *expired), "OP")
    yield _case(model, "watchdog_never_on", (off, WriteOutputs(), op, *expired), "SAFEOP")
    longer = WriteRegister("watchdog_process_data", {"time": 2 * WATCHDOG})
    shorter = WriteRegister("watchdog_process_data", {"time": WATCHDOG // 4})
    chosen = (
        ("longer_watchdog_still_waits", longer, time * 3 // 2),
        ("longer_watchdog_expires", longer, 3 * time),
        ("shorter_watchdog_expires", shorter, time),
    )
    for what, register, patience in chosen:
        done = (register, WriteOutputs(), StopOutputs(), Wait(patience))
        yield _case(model, what, done, "OP")
    yield from _longest_watchdog(model)
    yield from _power_on_watchdog(model)
    untriggered = SetUpProcessData({_OUTPUTS: {"watchdog_trigger": 0}})
    up = (untriggered, _to(model, "SAFEOP"), WriteOutputs(), op, *expired)
    yield _case(model, "watchdog_not_triggered", (*up, WriteOutputs()), "PREOP")


def _power_on_watchdog(model: Model) -> Iterator[Case]:
    """Yield the watchdog as it is from power-on, which the way up sets to another time."""
    ticks = model.protocol.registers["watchdog_process_data"].reset
    up = (*first_assigned(model), SetUpProcessData(), _to(model, "SAFEOP"), WriteOutputs())
    expired = (StopOutputs(), Wait(2 * _watchdog_time(model, ticks=ticks)))
    yield _case(model, "watchdog_as_at_power_on", (*up, _to(model, "OP"), *expired), "PREOP")


def _longest_watchdog(model: Model) -> Iterator[Case]:
    """Yield a time so long that a wrong unit of it shows, looked at before and right after."""
    divider = model.protocol.registers["watchdog_divider"].reset * 3 // 2
    ticks = (1 << 8 * model.protocol.registers["watchdog_process_data"].size) - 1
    chosen = (
        WriteRegister("watchdog_divider", {"value": divider}),
        WriteRegister("watchdog_process_data", {"time": ticks}),
    )
    time = _watchdog_time(model, divider, ticks)
    early = time * 4 // 5
    stopped = (WriteOutputs(), StopOutputs(), Wait(early), Wait(time - early + _SOON))
    yield _case(model, "longest_watchdog", (*chosen, *stopped), "OP")


def _watchdog_time(model: Model, divider: int | None = None, ticks: int = WATCHDOG) -> int:
    """Give the microseconds of the watchdog, as the way up sets it or otherwise."""
    if divider is None:
        divider = model.protocol.registers["watchdog_divider"].reset
    return (divider + 2) * ticks // _MICROSECONDS


def _to(model: Model, state: str, *, acknowledge: bool = False) -> WriteRegister:
    return request(model.row("al_state", state), acknowledge=acknowledge)


def _case(model: Model, name: str, stimuli: tuple[Stimulus, ...], state: str) -> Case:
    way = way_to(model, state)
    title = f"{name.replace('_', ' ').replace('/', ' in ')}"
    done = (*way, *stimuli, Probe()) if state == "PREOP" else (*way, *stimuli)
    return Case(f"process_data/{name}", title, "process_data", done, state, len(way))
