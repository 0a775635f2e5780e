"""Cases of the AL state machine: every input in every state.

The states are those that the virtual SubDevice reaches; each case is the shortest way to a state
and one input more.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from ecatspec.generators.cases.assignment import first_assigned
from ecatspec.generators.cases.bringup import has_process_data, mailbox_settings, request
from ecatspec.generators.cases.case import (
    Case,
    SetUpProcessData,
    Stimulus,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.cases.play import Reached, at_power_on
from ecatspec.generators.cases.process_data import image_size
from ecatspec.model.core.register_map import AREAS, BOOTSTRAP, PROCESS_DATA, SYNC_MANAGERS
from ecatspec.spec.language.functions import AREA_PARTS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.esc.subdevice import VirtualSubDevice

Symbol = tuple[str, tuple[Stimulus, ...]]


def symbols(model: Model, *, few: bool = False) -> tuple[Symbol, ...]:
    """Give the inputs: requests with and without acknowledge, and settings.

    All states are requested, and three values that are none, or of a `few` inputs one.
    """
    states = {r.value: r.name for r in model.protocol.tables["al_state"].rows}
    width = model.protocol.tables["al_state"].width
    invalid = [value for value in range(1 << width) if value not in states]
    none = invalid[1:2] if few else (invalid[0], invalid[1], invalid[-1])
    tried = states | {value: f"value_{value}" for value in none}
    process_data = has_process_data(model)
    set_up: tuple[Stimulus, ...] = mailbox_settings(model) if model.has_mailbox else ()
    if process_data:
        set_up = (*set_up, SetUpProcessData())
    found: list[Symbol] = [("set_up", set_up)] if set_up else []
    if process_data:
        found.append(("outputs", (WriteOutputs(),)))
        if assigning := first_assigned(model):
            found.append(("assign", (*assigning, SetUpProcessData())))
    for value, name in tried.items():
        found.append((f"request_{name}", (request(value),)))
        found.append((f"acknowledge_{name}", (request(value, acknowledge=True),)))
    if model.has_mailbox:
        found += [
            (f"disable_{name}", (WriteRegister(f"{name}_activation", {"enabled": 0}),))
            for name in SYNC_MANAGERS
        ]
    return tuple(found)


def wrong_settings(model: Model, areas: Mapping[str, str] = AREAS) -> tuple[Symbol, ...]:
    """Give mailbox settings that deviate in one point."""
    smallest = model.parameter("minimal_mailbox")
    buffered = model.row("sync_manager_mode", "buffered")
    found: list[Symbol] = []
    other = dict(zip(SYNC_MANAGERS, reversed(SYNC_MANAGERS), strict=True))
    whole = [[model.parameter(areas[name], p) for p in AREA_PARTS] for name in SYNC_MANAGERS]
    behind = max(start + length for start, length in whole)
    for name, wrong in zip(SYNC_MANAGERS, ("main_reads", "main_writes"), strict=True):
        changes = {
            f"{name}_off": {f"{name}_activation": {"enabled": 0}},
            f"{name}_buffered": {name: {"mode": buffered}},
            f"{name}_reversed": {name: {"direction": model.row("sync_manager_direction", wrong)}},
            f"{name}_empty": {name: {"length": 0}},
            f"{name}_too_short": {name: {"length": smallest - 1}},
            f"{name}_shortest": {name: {"length": smallest}},
            f"{name}_moved": {name: {"start": behind}},
            f"{name}_on_{other[name]}": {
                name: {"start": model.parameter(areas[other[name]], "start")}
            },
        }
        for what, change in changes.items():
            found.append((what, mailbox_settings(model, change, areas)))
    return tuple(found)


def transition_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield a case for every reachable state and every input, shortest way first."""
    alphabet = symbols(model)
    ways: dict[tuple[object, ...], tuple[Symbol, ...]] = {}
    work: deque[tuple[tuple[Symbol, ...], Reached]] = deque([((), at_power_on(model))])
    while work:
        way, before = work.popleft()
        reached = before.by(model, way[-1][1]) if way else before
        key = _key(model, reached.device)
        if key in ways:
            continue
        ways[key] = way
        work.extend(((*way, symbol), reached) for symbol in alphabet)
    for way in ways.values():
        for symbol in alphabet:
            yield _case(way, symbol)
    if not model.has_mailbox:
        return
    preop = request(model.row("al_state", "PREOP"))
    for name, stimuli in wrong_settings(model):
        yield _case(((name, stimuli),), ("request_PREOP", (preop,)))
    yield from _in_boot(model)


def _in_boot(model: Model) -> Iterator[Case]:
    """Yield what a device with BOOT does there, shortest way first; one without refuses it."""
    boot = model.row("al_state", "BOOT")
    enter = ("request_BOOT", (request(boot),))
    up = (("set_up_for_BOOT", mailbox_settings(model, areas=BOOTSTRAP)), enter)
    again = ("acknowledge_BOOT", (request(boot, acknowledge=True),))
    refused = ("request_PREOP", (request(model.row("al_state", "PREOP")),))
    for name, stimuli in wrong_settings(model, BOOTSTRAP):
        yield _case(((f"{name}_for_BOOT", stimuli),), enter)
    for name in SYNC_MANAGERS:
        off = (f"disable_{name}", (WriteRegister(f"{name}_activation", {"enabled": 0}),))
        yield _case(up, off)
        yield _case((*up, off), again)
        yield _case((*up, refused, off), again)


def _case(way: tuple[Symbol, ...], symbol: Symbol) -> Case:
    names = [name for name, _ in (*way, symbol)]
    before = tuple(stimulus for _, stimuli in way for stimulus in stimuli)
    return Case(
        f"al/{'/'.join(names)}",
        f"{symbol[0]} after {', '.join(names[:-1]) or 'power-on'}",
        "al",
        (*before, *symbol[1]),
        prelude=len(before),
    )


def _key(model: Model, device: VirtualSubDevice) -> tuple[object, ...]:
    """Give what tells the states apart that a device is brought to."""
    slots = [device.state.slots[model.slots[name]] for name in ("al.state", "al.error")]
    fed = device.state.slots[model.slots["process_data.fed"]]
    enabled = tuple(device.esc.register(f"{name}_activation") for name in SYNC_MANAGERS)
    sizes = (image_size(model, device.state, name) for name in PROCESS_DATA)
    return (*slots, fed, enabled, *sizes)
