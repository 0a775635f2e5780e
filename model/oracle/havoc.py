"""The states of a device of which little is known."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

from ecatspec.model.core.memo import once
from ecatspec.model.core.observables import usual_mailbox
from ecatspec.model.core.values import UNKNOWN

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import State, Step
    from ecatspec.model.core.values import Value


def any_states(model: Model, choices: Mapping[str, str], kept: State | None) -> tuple[State, ...]:
    """Give all states of a device that goes certain ways; `kept` has its registers and words."""
    base = model.initial
    for name, alternative in choices.items():
        base = base.having(model.slots[f"choice {name}"], alternative)
    for name, slot in model.slots.items():
        if name.startswith(("register ", "word ")):
            usual = usual_mailbox(model).get(name, UNKNOWN)
            base = base.having(slot, kept.slots[slot] if kept else usual)
    return _states(model, base, {machine: model.state_names(machine) for machine in _told(model)})


@once
def warm(model: Model) -> State:
    """Give the state of a device that came back to INIT: its objects may hold what was written."""
    state = model.initial
    for name, slot in model.slots.items():
        owner, _, variable = name.partition(".")
        if name.startswith("word ") or (variable and owner in model.worded):
            state = state.having(slot, UNKNOWN)
    return state


@once
def unset(model: Model) -> State:
    """Give a state with unknown registers and words."""
    state = model.initial
    for name, slot in model.slots.items():
        if name.startswith(("register ", "word ")):
            state = state.having(slot, UNKNOWN)
    return state


def is_open(model: Model, taken: Step) -> bool:
    """Tell whether the texts leave open what the AL does: with it goes all that rests on it."""
    return taken.unspecified and not model.open_gaps.isdisjoint(taken.rules)


@once
def after_open(model: Model, state: State) -> tuple[State, ...]:
    """Give where a device may be that changed its AL state as it liked.

    What rests on the AL went on or began anew.
    """
    possible: dict[str, Iterable[Value]] = {}
    for machine in _told(model):
        slot = model.slots[f"{machine}.state"]
        now, first = state.slots[slot] or 0, model.initial.slots[slot] or 0
        shown = machine in model.displayed
        possible[machine] = model.state_names(machine) if shown else dict.fromkeys((now, first))
    return _states(model, state, possible)


def _told(model: Model) -> list[str]:
    """Give the machines whose state is followed; of others it takes a look at their words."""
    return [machine for machine in model.protocol.machines if machine not in model.worded]


def _states(
    model: Model, base: State, possible: Mapping[str, Iterable[Value]]
) -> tuple[State, ...]:
    """Give the states with the choices, registers and words of `base`; `possible` of machines."""
    for name, slot in model.slots.items():
        if not name.startswith(("choice ", "register ", "word ")):
            base = base.having(slot, UNKNOWN)
    found = []
    for values in product(*possible.values()):
        state = base
        for machine, value in zip(possible, values, strict=True):
            state = state.having(model.slots[f"{machine}.state"], value)
        if not model.broken(state):
            found.append(state)
    return tuple(found)
