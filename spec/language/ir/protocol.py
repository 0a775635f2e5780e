"""A protocol: texts put together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.spec.language.ir.declarations import (
        Choice,
        Clause,
        CodeTable,
        Condition,
        Definition,
        Frame,
        Machine,
        Manual,
        ObjectEntry,
        Parameter,
        Property,
        Reason,
        Register,
        Word,
    )
    from ecatspec.spec.language.ir.statements import (
        Anomaly,
        Close,
        Dictionary,
        EsiEntry,
        Example,
        Extend,
        Open,
        Pin,
        Remove,
        Replace,
        ReplaceField,
    )


STANDARD = "standard"
"""The name of the Protocol that belongs to no device."""


@dataclass(frozen=True, slots=True)
class Protocol:
    """All texts of the standard, or of one device on top of them, checked and merged.

    Order is the order of the texts. `replaced` keeps what a device text changed or took away.
    """

    name: str
    wording: str
    manuals: tuple[Manual, ...]
    clauses: dict[str, Clause]
    tables: dict[str, CodeTable]
    parameters: dict[str, Parameter]
    registers: dict[str, Register]
    words: dict[str, Word]
    frames: dict[str, Frame]
    machines: dict[str, Machine]
    choices: dict[str, Choice]
    conditions: dict[str, Condition]
    definitions: dict[str, Definition]
    properties: dict[str, Property]
    reasons: dict[str, Reason]
    pins: dict[str, Pin]
    opened: dict[str, Open]
    closed: dict[str, Close]
    objects: tuple[ObjectEntry, ...]
    dictionary: Dictionary
    esi: tuple[EsiEntry, ...]
    anomalies: tuple[Anomaly, ...]
    examples: tuple[Example, ...]
    replaced: tuple[Replace | Remove | Extend | ReplaceField, ...]
    digest: str

    def risks(self, ways: Mapping[str, str]) -> dict[str, str]:
        """Give why ways are risky, by choice; those that are not are left out."""
        return {
            choice.name: way.risk.wording
            for choice in self.choices.values()
            for way in choice.alternatives
            if way.risk is not None and ways.get(choice.name) == way.name
        }
