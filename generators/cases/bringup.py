"""Stimuli that set up the mailboxes and lead to an AL state."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ecatspec.generators.cases.assignment import first_assigned
from ecatspec.generators.cases.case import (
    Case,
    Probe,
    ReadConfiguration,
    ReadInitial,
    Repeat,
    SendFrame,
    SendSegments,
    SetUpProcessData,
    Stimulus,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
    WriteUntilTaken,
)
from ecatspec.model.core.observables import mailbox_fields
from ecatspec.model.core.register_map import AREAS, SYNC_MANAGERS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ecatspec.model.core.compilation import Model

WATCHDOG = 20_000
"""Ticks of the process data watchdog: a test over a slow line must keep it quiet."""
_BEFORE: Mapping[str, tuple[Stimulus, ...]] = {
    "SAFEOP": (WriteRegister("watchdog_process_data", {"time": WATCHDOG}), SetUpProcessData()),
    "OP": (WriteOutputs(),),
}
_MAILBOX = (
    SendFrame,
    SendSegments,
    Repeat,
    ReadConfiguration,
    ReadInitial,
    WriteUntilTaken,
    Probe,
)
WAY_UP = ("INIT", "PREOP", "SAFEOP", "OP")


def mailbox_settings(
    model: Model,
    changes: Mapping[str, Mapping[str, int]] | None = None,
    areas: Mapping[str, str] = AREAS,
) -> tuple[Stimulus, ...]:
    """Set both mailbox SyncManagers as the texts say; `changes` deviates field by field.

    `areas` are the parameters that say where they lie: those of BOOT are others.
    """
    changes = changes or {}
    stimuli: list[Stimulus] = []
    for name in SYNC_MANAGERS:
        activation = f"{name}_activation"
        usual = mailbox_fields(model, name, areas[name])
        stimuli.append(
            WriteRegisters(
                (
                    WriteRegister(name, usual | dict(changes.get(name, {}))),
                    WriteRegister(activation, changes.get(activation, {"enabled": 1})),
                )
            )
        )
    return tuple(stimuli)


def request(value: int, *, acknowledge: bool = False) -> WriteRegister:
    """Request an AL state."""
    return WriteRegister("al_control", {"requested": value, "acknowledge": int(acknowledge)})


def way_to(model: Model, state: str) -> tuple[Stimulus, ...]:
    """Give the stimuli from power-on to an AL state on the way up."""
    stimuli: list[Stimulus] = list(mailbox_settings(model)) if model.has_mailbox else []
    for name in WAY_UP[1 : WAY_UP.index(state) + 1]:
        if has_process_data(model):
            stimuli += first_assigned(model) if name == "SAFEOP" else ()
            stimuli += _BEFORE.get(name, ())
        stimuli.append(request(model.row("al_state", name)))
    return tuple(stimuli)


def possible(model: Model, case: Case) -> Iterator[Case]:
    """Yield the case; of a device without a mailbox only one that can do without, and so it does.

    No proof of life is asked for there.
    """
    if model.has_mailbox:
        yield case
        return
    before = sum(not isinstance(each, Probe) for each in case.stimuli[: case.prelude])
    stimuli = tuple(each for each in case.stimuli if not isinstance(each, Probe))
    if stimuli and not any(map(needs_mailbox, stimuli)):
        yield replace(case, stimuli=stimuli, prelude=before)


def needs_mailbox(stimulus: Stimulus) -> bool:
    """Tell whether a stimulus goes by way of the mailbox."""
    return isinstance(stimulus, _MAILBOX)


def has_process_data(model: Model) -> bool:
    """Tell whether the texts declare what is assigned to the process data."""
    assignments = model.image.assignments.values()
    return any((index, 0) in model.dictionary.entries for index in assignments)


def case_in(
    model: Model,
    name: str,
    title: str,
    stimuli: Iterable[Stimulus],
    *,
    state: str = "PREOP",
    flag: str = "",
    feature: str = "",
) -> Case:
    """Give a case in an AL state, with a proof at its end that the device lives."""
    way = way_to(model, state)
    layer = name.partition("/")[0]
    done = (*way, *stimuli, Probe())
    return Case(name, title, layer, done, state, len(way), flag, feature)
