"""What must be proved of a specification, and how a proof can end."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from ecatspec.model.core.compiled import rows_of
from ecatspec.spec.language.ir import NOWHERE, STANDARD, Extend, Remove, Replace, Span
from ecatspec.spec.language.load import load_standard

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.spec.language.ir import Machine, Protocol


class Kind(StrEnum):
    """What is asked; the words are those of the report."""

    DETERMINISM = "determinism"
    COMPLETENESS = "completeness"
    LIVE = "rules that can fire"
    RULE_REACHED = "rules reached"
    STATE_REACHED = "states reached"
    PROPERTY = "properties"
    TOLD_APART = "states told apart"
    CHOICE = "choices with effect"
    ROUND_TRIP = "frames round trip"
    MEMORY = "memory areas"


WORDING = {
    Kind.DETERMINISM: "no two rules or gaps take the same input in the same state",
    Kind.COMPLETENESS: "some rule or gap takes every input in every state",
    Kind.LIVE: "some state and input let the rule fire",
    Kind.RULE_REACHED: "inputs lead from power-on to the rule",
    Kind.STATE_REACHED: "inputs lead from power-on to the state",
    Kind.PROPERTY: "holds after power-on, and every rule keeps it",
    Kind.TOLD_APART: "no two states look the same in what registers and words show",
    Kind.CHOICE: "the alternative decides about something",
    Kind.ROUND_TRIP: "what is encoded is decoded as the same frame with the same fields",
    Kind.MEMORY: "areas do not overlap and lie in the memory",
}


class Status(StrEnum):
    """How a proof ended. Unknown is never taken for proved."""

    PROVED = "proved"
    REFUTED = "refuted"
    BOUNDED = "bounded"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Obligation:
    """One thing to be proved; `group` is a machine or the like, `name` what in it."""

    kind: Kind
    group: str
    name: str
    at: Span = NOWHERE

    def __str__(self) -> str:
        """Give what is proved of what."""
        subject = f"{self.group}.{self.name}" if self.group else self.name
        return f"{self.kind} of {subject}"


@dataclass(frozen=True, slots=True)
class Finding:
    """How an obligation ended.

    `lines` are the counterexample, the way to what was reached, or why nothing is known; `places`
    are those of the rules involved. `depth`: the number of inputs, or of cases, that were tried.
    """

    obligation: Obligation
    status: Status
    lines: tuple[str, ...] = ()
    places: tuple[Span, ...] = ()
    depth: int | None = None


def own_rules(protocol: Protocol) -> dict[str, set[str]]:
    """Give the rules and gaps that a device text added or replaced, by machine."""
    found: dict[str, set[str]] = {}
    for change in protocol.replaced:
        match change:
            case Replace():
                found.setdefault(change.machine, set()).add(change.rule)
            case Extend():
                names = {rule.name for rule in change.rules} | {gap.name for gap in change.gaps}
                found.setdefault(change.machine, set()).update(names)
            case Remove():
                found.get(change.machine, set()).discard(change.rule)
            case _:
                pass
    return found


def demanded(protocol: Protocol, machine: Machine, name: str) -> bool:
    """Tell whether a rule has to be of use: a device text may silence what the standard has."""
    if protocol.name == STANDARD:
        return True
    return name in own_rules(protocol).get(machine.name, set())


def obligations(protocol: Protocol) -> Iterator[Obligation]:
    """Yield everything that must be proved, in the order of the texts."""
    standard = protocol.name == STANDARD
    for machine in protocol.machines.values():
        for source in machine.inputs:
            yield Obligation(Kind.DETERMINISM, machine.name, source.name, source.at)
            yield Obligation(Kind.COMPLETENESS, machine.name, source.name, source.at)
    for law in protocol.properties.values():
        yield Obligation(Kind.PROPERTY, "", law.name, law.at)
    for machine in protocol.machines.values():
        for row in rows_of(machine):
            if demanded(protocol, machine, row.name):
                yield Obligation(Kind.LIVE, machine.name, row.name, row.at)
                yield Obligation(Kind.RULE_REACHED, machine.name, row.name, row.at)
        if standard:
            for state in machine.states:
                yield Obligation(Kind.STATE_REACHED, machine.name, state, machine.at)
        yield Obligation(Kind.TOLD_APART, machine.name, "states", machine.at)
    common = set() if standard else set(load_standard().choices)
    for choice in protocol.choices.values():
        if choice.name not in common and choice.name not in protocol.pins:
            for way in choice.alternatives:
                yield Obligation(Kind.CHOICE, choice.name, way.name, choice.at)
    parents = {frame.parent for frame in protocol.frames.values()}
    for frame in protocol.frames.values():
        if frame.name not in parents:
            yield Obligation(Kind.ROUND_TRIP, "", frame.name, frame.at)
    yield Obligation(Kind.MEMORY, "", "areas")
