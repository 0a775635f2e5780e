"""The alphabet that seeded walks of a device draw from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import WAY_UP, request, way_to
from ecatspec.generators.covers.configuration_cover import configuration_cover
from ecatspec.generators.covers.drive_cover import CONTROL, commands
from ecatspec.generators.covers.malformed_cover import family_cover
from ecatspec.generators.covers.sdo_cover import is_written
from ecatspec.model.core.memo import once
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.generators.cases.case import Limits, Stimulus
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import ObjectEntry


@dataclass(frozen=True, slots=True)
class Ground:
    """What walks of a device draw from."""

    states: Mapping[int, str]
    up: Mapping[str, tuple[Stimulus, ...]]
    """What comes before the request of each state on the way up."""
    readable: tuple[str, ...]
    entries: tuple[ObjectEntry, ...]
    written: tuple[ObjectEntry, ...]
    controls: tuple[int, ...]
    words: tuple[tuple[str, int], ...]
    """Words that process data may bring, and their bits."""
    configurations: tuple[tuple[Stimulus, ...], ...]
    families: tuple[tuple[Stimulus, ...], ...]


@once
def ground(model: Model, limits: Limits) -> Ground:
    """Give what walks of a device draw from, without what the way to it cannot carry."""
    protocol = model.protocol
    ways = [way_to(model, state) for state in WAY_UP]
    up = {
        state: way[len(before) : -1]
        for state, before, way in zip(WAY_UP[1:], [(), *ways[1:]], ways[1:], strict=False)
    }
    drives = CONTROL in {word.name for word in model.words.values()}
    mapped = [w for key, w in model.words.items() if model.dictionary.entries[key].mappable]
    to_init = request(model.row("al_state", WAY_UP[0]))
    cases = [c for c in family_cover(model, limits) if c.feature not in limits.without]
    return Ground(
        states={r.value: r.name for r in protocol.tables["al_state"].rows},
        up=up,
        readable=tuple(
            r.name for r in protocol.registers.values() if r.main in {Access.READ, Access.BOTH}
        ),
        entries=tuple(protocol.objects),
        written=tuple(entry for entry in protocol.objects if is_written(entry)),
        controls=tuple(commands(model).values()) if drives else (),
        words=tuple((word.name, 8 * word.size) for word in mapped),
        configurations=tuple(
            case.stimuli[case.prelude : -1]
            for case in configuration_cover(model, limits)
            # in a walk a transfer may be open
            if "mailbox_restart" not in limits.without or to_init not in case.stimuli
        ),
        families=tuple(case.stimuli[case.prelude : -1] for case in cases),
    )
