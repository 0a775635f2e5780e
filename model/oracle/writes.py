"""What a write of the MainDevice makes of each explanation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from ecatspec.model.core.compilation import MAILBOX
from ecatspec.model.core.interpreter import fields_with_before, forgotten, step
from ecatspec.model.core.memo import once
from ecatspec.model.core.observables import enabled, mailbox_area, process_area
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS
from ecatspec.model.core.state import Event
from ecatspec.model.core.values import UNKNOWN
from ecatspec.model.oracle.cyclic_outputs import fed, widened
from ecatspec.model.oracle.expansion import is_alive, is_idle
from ecatspec.model.oracle.explanations import Loose, Pending
from ecatspec.model.oracle.havoc import is_open
from ecatspec.model.oracle.judged import Judged
from ecatspec.model.oracle.knowledge import demanded
from ecatspec.spec.language.ir import Access, InputKind

if TYPE_CHECKING:
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName, State
    from ecatspec.model.core.values import Value
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Candidate, Exchange
    from ecatspec.spec.language.ir import Register

MAIN_OUT, MAIN_IN = SYNC_MANAGERS
DATA_OUT, DATA_IN = PROCESS_DATA
_MANAGERS = (*SYNC_MANAGERS, *PROCESS_DATA)


# --- registers ------------------------------------------------------------------------------------


def write_registers(
    model: Model, before: Explanations, touched: tuple[Register, ...], exchange: Exchange
) -> Explanations:
    """Give the explanations in which the device is to look at registers that were written."""
    inputs = [
        (machine.name, source)
        for machine in model.protocol.machines.values()
        for source in machine.inputs
        if source.kind == InputKind.WRITE and any(r.name in source.origin for r in touched)
    ]
    glances = _glances(model, *exchange.span())
    after: Explanations = {}
    for candidate, history in before.items():
        state = candidate.state
        parameters: dict[str, Value] = {}
        for register in touched:
            slot = model.slots[f"register {register.name}"]
            raw = _merged(register, state.slots[slot], exchange)
            if register.name in _MANAGERS and enabled(model, candidate.state, register.name):
                raw = state.slots[slot] or 0
            parameters |= fields_with_before(register.fields, raw, state.slots[slot])
            state = state.having(slot, raw)
        changed = candidate.having(state)
        if is_alive(model, state) != is_alive(model, candidate.state):
            # a mailbox that went, or came back, without a start: nothing is known of it
            lost = forgotten(model, state, MAILBOX)
            changed = structs.replace(changed, state=lost, outbox=(), loose=Loose.ALL, last=None)
        looks = tuple(Event(machine, source.name, parameters) for machine, source in inputs)
        for events in _orders(looks, glances):
            found = [changed]
            for event in events:
                found = _looking(model, found, event, exchange.time, spare=event in glances)
            after |= dict.fromkeys(found, history)
    return after


def hold_registers(model: Model, before: Explanations, exchange: Exchange) -> Explanations:
    """Give the explanations in which registers hold what was written and were not read since."""
    for register in written_registers(model, *exchange.span()):
        slot = model.slots[f"register {register.name}"]
        before = {
            c.having(c.state.having(slot, _merged(register, c.state.slots[slot], exchange))): h
            for c, h in before.items()
        }
    return before


@once
def written_registers(model: Model, address: int, length: int) -> tuple[Register, ...]:
    """Give the registers that a write of the MainDevice touches."""
    return tuple(
        register
        for register in model.protocol.registers.values()
        if register.main is Access.BOTH
        and register.address < address + length
        and address < register.address + register.size
    )


def having(model: Model, candidate: Candidate, event: Event, time: int) -> Candidate:
    """Give the explanation in which the device has one input more."""
    pending = _pending(model, candidate.state, event, time)
    return candidate if pending is None else candidate.expecting((*candidate.inbox, pending))


def _pending(model: Model, state: State, event: Event, time: int) -> Pending | None:
    """Give the input with its deadline; None when it changes nothing and has no deadline."""
    steps = step(model, state, event)
    within = max(taken.within for taken in steps)
    if any(is_open(model, taken) for taken in steps):
        within = max(within, model.parameter("settle_time"))
    idle = not within and is_idle(model, state, event)
    return None if idle else Pending(event, time + within, within, time)


def _looking(
    model: Model, found: list[Candidate], event: Event, time: int, *, spare: bool
) -> list[Candidate]:
    """Give the explanations in which the device looks there; it may `spare` itself the look."""
    looking = [
        each
        if spare and any(pending.event == event for pending in each.inbox)
        else having(model, each, event, time)
        for each in found
    ]
    return list(dict.fromkeys((*looking, *found))) if spare else looking


def _merged(register: Register, before: Value | None, exchange: Exchange) -> Value:
    """Give what a register holds after a write of some of its bytes."""
    covered = range(
        max(register.address, exchange.address),
        min(register.address + register.size, exchange.address + len(exchange.data)),
    )
    if not isinstance(before, int):
        if len(covered) < register.size and register.name.startswith(SYNC_MANAGERS):
            return UNKNOWN
        before = 0
    raw = bytearray(before.to_bytes(register.size, "little"))
    for address in covered:
        raw[address - register.address] = exchange.data[address - exchange.address]
    return int.from_bytes(raw, "little")


@once
def _glances(model: Model, address: int, length: int) -> tuple[Event, ...]:
    """Give looks at SyncManagers that a write does not touch: one event is there for all."""
    touched = {register.name for register in written_registers(model, address, length)}
    if not any(name.startswith(_MANAGERS) for name in touched):
        return ()
    return tuple(
        Event(machine.name, source.name, {})
        for machine in model.protocol.machines.values()
        for source in machine.inputs
        if source.kind == InputKind.WRITE
        and any(name.startswith(_MANAGERS) for name in source.origin)
        and touched.isdisjoint(source.origin)
    )


def _orders(looks: tuple[Event, ...], glances: tuple[Event, ...]) -> tuple[tuple[Event, ...], ...]:
    """Give the orders in which a device may look at what was written, and at what was not."""
    return ((*looks, *glances), (*glances, *looks)) if glances else (looks,)


# --- process data and mailbox ---------------------------------------------------------------------


def write_outputs(
    model: Model, before: Explanations, exchange: Exchange, outputs: tuple[Event, ...]
) -> Judged:
    """Give the explanations in which the device takes process data, or may leave them."""
    after: list[tuple[Candidate, tuple[RuleName, ...]]] = []
    refused: Explanations = {}
    for candidate, history in before.items():
        if process_area(model, candidate.state, DATA_OUT) != exchange.span():
            after.append((candidate, history))
        elif exchange.working_counter:
            after.append((fed(model, candidate, outputs, exchange.time), history))
        elif demanded(model, candidate, "outputs_demanded"):
            refused[candidate] = history
        else:
            after.append((candidate, history))
    return Judged(widened(after), refused)


def write_mailbox(
    model: Model, before: Explanations, exchange: Exchange, *, recent: bool
) -> Judged:
    """Give the explanations in which a device has a message, or may refuse it.

    It may while it is busy, and just after (`recent`) something else was written.
    """
    after: Explanations = {}
    refused: Explanations = {}
    concerned = False
    for candidate, history in before.items():
        area = mailbox_area(model, candidate.state, MAIN_OUT)
        if area is None or not covers_end(area, exchange):
            after[candidate] = history
            continue
        concerned = True
        if not exchange.working_counter:
            busy = recent or candidate.inbox or candidate.outbox or candidate.loose
            allowed = busy or not is_alive(model, candidate.state)
            (after if allowed else refused)[candidate] = history
            continue
        message = model.decode(exchange.data)
        if message is None:
            after[structs.replace(candidate, loose=Loose.ALL)] = history
            continue
        waiting = any(pending.event.trail for pending in candidate.inbox)
        event = model.mail(message, crowded=bool(candidate.outbox or waiting))
        after[having(model, candidate, event, exchange.time)] = history
    return Judged(after, refused, concerned)


def covers_end(area: tuple[int, int], exchange: Exchange) -> bool:
    """Tell whether an access reaches the last byte of an area, which is what counts."""
    end = area[0] + area[1]
    return exchange.address < end <= exchange.address + len(exchange.data)
