"""Reports how far a run got in each machine: rules that fired, and why others did not."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.drawings.graph import cannot_fire
from ecatspec.generators.covers.drive_cover import is_drive
from ecatspec.model.core.interpreter import rests_on
from ecatspec.model.core.state import RuleName
from ecatspec.spec.language.ir import Pin

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.conformance.base.verdict import Result, Verdict
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import Machine, Protocol, Rule

_OF_A_MAILBOX: Final = frozenset({"mailbox", "coe", "sdo", "sdo_information", "emergency"})
_OF_A_DRIVE: Final = frozenset({"ds402"})
"""The machines that a device without a mailbox, and one that is no drive, does not have."""
_UNJUDGED: Final = frozenset({Outcome.SKIPPED, Outcome.INCONCLUSIVE})
_DEEPEST: Final = "exhaustive"


class Mark(StrEnum):
    """What a run showed of a rule."""

    EXERCISED = "exercised"
    BLAMED = "blamed"
    UNREACHED = "not exercised"
    IMPOSSIBLE = "cannot fire"


@dataclass(frozen=True, slots=True)
class Reached:
    """A rule, what the run showed of it, and why it was not exercised, as far as that is known."""

    rule: Rule
    mark: Mark
    why: str = ""


def lacking(model: Model) -> dict[str, str]:
    """Give the machines that the device does not have, each with the reason."""
    found: dict[str, str] = {}
    if not model.has_mailbox:
        found |= dict.fromkeys(_OF_A_MAILBOX, "the device has no mailbox")
    if not is_drive(model):
        found |= dict.fromkeys(_OF_A_DRIVE, "the texts declare no control and status word")
    return {name: why for name, why in found.items() if name in model.protocol.machines}


def reached(result: Result, model: Model) -> dict[str, tuple[Reached, ...]]:
    """Give all rules of each machine that the device has, in the order of the texts."""
    seen = _Seen(result, model)
    left_out = lacking(model)
    return {
        name: tuple(map(seen.of(machine), machine.rules))
        for name, machine in model.protocol.machines.items()
        if name not in left_out or seen.blames(machine)
    }


class _Seen:
    """What the verdicts of a run say of machines."""

    def __init__(self, result: Result, model: Model) -> None:
        self._result = result
        self._model = model
        self._covered = frozenset(result.rules_covered)
        blaming = (verdict for verdict in result.verdicts if verdict.outcome in BLAMING)
        self._blamed = {rule for verdict in blaming for rule in verdict.blamed}
        self._cases: dict[str, list[Verdict]] = {}
        for verdict in result.verdicts:
            self._cases.setdefault(verdict.case.partition("/")[0], []).append(verdict)

    def blames(self, machine: Machine) -> bool:
        """Tell whether a rule of a machine is blamed."""
        return any(f"{machine.name}.{rule.name}" in self._blamed for rule in machine.rules)

    def of(self, machine: Machine) -> _Machine:
        """Give what tells of each rule of a machine what was seen of it."""
        rules = [(rule, f"{machine.name}.{rule.name}") for rule in machine.rules]
        targets = {rule.target for rule, name in rules if name in self._covered}
        return _Machine(
            self._result,
            self._model.protocol,
            machine,
            frozenset(r.name for r, name in rules if name in self._covered),
            frozenset(r.name for r, name in rules if name in self._blamed),
            frozenset(state for state in machine.states if state in {machine.initial, *targets}),
            self._untried(machine.name),
            {r.name: rests_on(self._model, RuleName(machine.name, r.name)) for r, _ in rules},
        )

    def _untried(self, machine: str) -> str:
        """Say why no case tried a machine; empty where one did, or where there were no cases."""
        if self._result.set_up is None:
            return ""
        cases = self._cases.get(machine, [])
        if not cases:
            return f"no case of {machine} was run"
        if any(verdict.outcome not in _UNJUDGED for verdict in cases):
            return ""
        reasons = Counter(verdict.reason or verdict.title for verdict in cases)
        return f"every case of {machine} was left unjudged: {reasons.most_common(1)[0][0]}"


@dataclass(frozen=True, slots=True)
class _Machine:
    """What was seen of one machine, and so of each of its rules."""

    result: Result
    protocol: Protocol
    machine: Machine
    covered: frozenset[str]
    blamed: frozenset[str]
    entered: frozenset[str]
    """The states that it was surely in."""
    untried: str
    rests: dict[str, frozenset[str]]
    """The names on which the guards of rules rest."""

    def __call__(self, rule: Rule) -> Reached:
        """Say what was seen of a rule."""
        if rule.name in self.blamed:
            return Reached(rule, Mark.BLAMED)
        if rule.name in self.covered:
            return Reached(rule, Mark.EXERCISED)
        ruled_out = self._ruled_out(rule)
        if ruled_out:
            return Reached(rule, Mark.IMPOSSIBLE, ruled_out)
        return Reached(rule, Mark.UNREACHED, next(self._reasons(rule)))

    def _ruled_out(self, rule: Rule) -> str:
        """Name the ways at choices by which a rule cannot fire; empty where it can."""
        pins = self.protocol.pins
        ways = self.result.choices | {name: pin.alternative for name, pin in pins.items()}
        known = [name for name in sorted(self.rests[rule.name]) if name in ways]
        every = {name: Pin(name, ways[name], ()) for name in known}
        if not cannot_fire(replace(self.protocol, pins=every), self.machine, rule):
            return ""
        alone = [
            name
            for name, pin in every.items()
            if cannot_fire(replace(self.protocol, pins={name: pin}), self.machine, rule)
        ]
        origin = {True: "from the text", False: "found"}
        said = (f"{name} = {ways[name]} ({origin[name in pins]})" for name in alone or known)
        return f"the device goes another way: {', '.join(said)}"

    def _reasons(self, rule: Rule) -> Iterator[str]:
        """Yield why a rule was not exercised, what says most of it first."""
        if self.untried:
            yield self.untried
        if self.entered.isdisjoint(rule.sources):
            yield self._never_in(rule.sources)
        for _, reason, _ in self.result.unjudged():
            # an event that the way to the device cannot raise is named by the cases that need it
            if re.search(rf"\bcannot raise .*\b{re.escape(rule.input)}\b", reason):
                yield reason
        if self.result.interrupted:
            yield "the run was interrupted"
        set_up = self.result.set_up
        if set_up is None:
            yield "nothing that was captured surely went by it"
        elif set_up.depth == _DEEPEST:
            yield "no case surely went by it"
        else:
            yield f"no case of the depth {set_up.depth} surely went by it"

    def _never_in(self, states: tuple[str, ...]) -> str:
        if self.machine.name == "al" and set(states) & set(self.result.unreached):
            return self.result.unreached_words()
        return f"the machine was never surely in {' or '.join(states)}"
