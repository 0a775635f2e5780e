"""Cases of local events in each AL state: faults, lost power or clock, restarts.

What happens in a device before it is in operation shows on the way up, or once it is there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import WAY_UP, request, way_to
from ecatspec.generators.cases.case import Case, Happen, Stimulus, WriteOutputs
from ecatspec.generators.cases.play import Reached, at_power_on
from ecatspec.generators.cases.transfers import upload
from ecatspec.generators.covers.drive_cover import CONTROL, STATUS, commands, is_driven

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model

_MOST = 2
"""Maximum number of events in a row, where each changed something."""
_AFTERWARDS = ("disable_voltage", "fault_reset", "disable_voltage", "shutdown", "switch_on")
"""Commands at the end: they show in which state the drive is."""


def event_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield a case for each row of events in each AL state; the way up goes on behind them."""
    for state in WAY_UP:
        way = () if state == WAY_UP[0] else way_to(model, state)
        for events in _rows(model, way):
            names = [event.partition(".")[2] for event in events]
            happened = tuple(Happen(event) for event in events)
            up = (*_look(model, state), *_onwards(model, state))
            title = f"{', then '.join(names).replace('_', ' ')} in {state}, then up"
            name = f"al/events/{state}/{'/'.join(names)}"
            needs = None if state == WAY_UP[0] else state
            yield Case(name, title, "al", (*way, *happened, *up), needs, len(way))


def _rows(model: Model, way: tuple[Stimulus, ...]) -> Iterator[tuple[str, ...]]:
    """Yield each event, and rows of them that lead to something new with each."""
    every = sorted(f"{event.machine}.{event.input}" for event in model.locals)
    start = at_power_on(model).by(model, way)
    seen = {start.device.state.slots}
    rows: list[tuple[tuple[str, ...], Reached]] = [((), start)]
    while rows:
        row, before = rows.pop(0)
        for event in every:
            longer = (*row, event)
            reached = before.by(model, (Happen(event),))
            new = reached.device.state.slots not in seen
            seen.add(reached.device.state.slots)
            if new or not row:
                yield longer
            if new and len(longer) < _MOST:
                rows.append((longer, reached))


def _look(model: Model, state: str) -> Iterator[Stimulus]:
    """Yield an upload of the status word, where the mailbox works and there is one."""
    word = model.protocol.words.get(STATUS)
    if word is not None and word.key in model.dictionary.entries and state != WAY_UP[0]:
        yield upload(*word.key)


def _onwards(model: Model, state: str) -> Iterator[Stimulus]:
    """Yield the rest of the way up, a request that acknowledges, and commands for the drive."""
    up = way_to(model, WAY_UP[-1])
    yield from up[0 if state == WAY_UP[0] else len(way_to(model, state)) :]
    yield from _look(model, WAY_UP[-1])
    op = model.row("al_state", WAY_UP[-1])
    yield request(op, acknowledge=True)
    if is_driven(model):
        known = commands(model)
        for name in _AFTERWARDS:
            yield WriteOutputs({CONTROL: known[name]})
    yield from _look(model, WAY_UP[-1])
