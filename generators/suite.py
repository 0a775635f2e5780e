"""The list of generators: the parts of a run, in their order."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from ecatspec.generators.cases.bringup import possible
from ecatspec.generators.covers.boundary_cover import boundary_cover
from ecatspec.generators.covers.complete_access_cover import complete_cover
from ecatspec.generators.covers.configuration_cover import configuration_cover
from ecatspec.generators.covers.default_cover import initial_cover
from ecatspec.generators.covers.drive_cover import drive_cover
from ecatspec.generators.covers.event_cover import event_cover
from ecatspec.generators.covers.example_cover import example_cover
from ecatspec.generators.covers.information_cover import information_cover
from ecatspec.generators.covers.mailbox_cover import mailbox_cover
from ecatspec.generators.covers.malformed_cover import family_cover
from ecatspec.generators.covers.named_cover import named_cover
from ecatspec.generators.covers.process_cover import process_cover
from ecatspec.generators.covers.register_cover import register_cover
from ecatspec.generators.covers.sdo_cover import sdo_cover
from ecatspec.generators.covers.server_cover import server_cover
from ecatspec.generators.covers.transfer_cover import transfer_cover
from ecatspec.generators.covers.transition_cover import transition_cover

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from ecatspec.generators.cases.case import Case, Limits
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import ObjectEntry

GENERATORS: Final[Mapping[str, Callable[[Model, Limits], Iterator[Case]]]] = MappingProxyType(
    {
        "initial": initial_cover,
        "registers": register_cover,
        "transitions": transition_cover,
        "process": process_cover,
        "events": event_cover,
        "configuration": configuration_cover,
        "drive": drive_cover,
        "mailbox": mailbox_cover,
        "examples": example_cover,
        "sdo": sdo_cover,
        "named": named_cover,
        "transfers": transfer_cover,
        "complete": complete_cover,
        "server": server_cover,
        "information": information_cover,
        "families": family_cover,
    }
)


_SHORTENED: Final[Mapping[str, frozenset[str]]] = MappingProxyType(
    {
        "quick": frozenset(GENERATORS),
        "default": frozenset({"transfers", "complete"}),
        "exhaustive": frozenset(),
    }
)
"""By depth: the generators of whose cases that differ in the entry only one of a kind is taken."""


def all_cases(model: Model, limits: Limits, depth: str = "default") -> Iterator[Case]:
    """Yield all fixed cases of a protocol in the order in which they run.

    `quick`: of cases that differ in the entry only, those of one entry of each kind. `default`:
    every entry is read, written and described, in all shapes of a transfer one of each kind.
    `exhaustive`: all of them, and the boundaries of the guards.

    Raises:
        MissingSolverError: The boundaries need the solver.

    """
    kinds = _kinds(model)
    seen: set[tuple[str, object]] = set()
    for name, generate in GENERATORS.items():
        for case in generate(model, limits):
            what, _, key = case.name.rpartition("/")
            kind = kinds.get(key) if name in _SHORTENED[depth] else None
            if kind is not None and (what, kind) in seen:
                continue
            seen.add((what, kind))
            yield from possible(model, case)
    if depth == "exhaustive":
        for case in boundary_cover(model, limits):
            yield from possible(model, case)


def _kinds(model: Model) -> dict[str, object]:
    """Give what tells one entry from another of its kind, by the name that it has in cases."""
    objects: dict[int, list[ObjectEntry]] = {}
    for entry in model.protocol.objects:
        objects.setdefault(entry.index, []).append(entry)
    kinds: dict[str, object] = {}
    for index, entries in objects.items():
        own = {
            e.subindex: (
                *(e.type, e.access, e.states, e.read_states, e.constant),
                *(e.low is None, e.mappable, e.maps is None),
            )
            for e in entries
        }
        kinds |= {f"{index:04X}_{subindex:02X}": kind for subindex, kind in own.items()}
        shape = tuple(dict.fromkeys(own.values())), len(entries) > 1
        kinds[f"{index:04X}"] = shape
        for first in (0, 1, 2):
            kinds[f"{index:04X}_from_{first}"] = (shape, first)
    return kinds
