"""Counts the rules and clauses that a run showed, among those that the device can reach."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.model.analysis.citations import Foundations
from ecatspec.model.analysis.unreachable import clauses_beyond, rules_beyond
from ecatspec.model.core.compiled import rows_of
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Mapping
    from collections.abc import Set as AbstractSet

    from ecatspec.conformance.base.verdict import Finding, Result
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName
    from ecatspec.spec.language.ir import Clause, Protocol


class Shown(StrEnum):
    """What a run showed of a clause."""

    FAILED = "failed"
    WARNED = "warned"
    KNOWN = "known"
    """All that was found against it is accepted."""
    HELD = "held"
    UNTESTED = "not tested"
    BEYOND = "not of this device"
    """By its own text the device can reach nothing that rests on it."""
    UNOBSERVABLE = "not observable"


@dataclass(slots=True)
class Covered:
    """One clause: how many cases passed by rules that rest on it, and the findings of it."""

    clause: Clause
    passed: int = 0
    findings: list[tuple[int, Finding]] = field(default_factory=list)
    """Those that broke it, each with its number in the report."""
    beyond: bool = False
    """Nothing that the device can reach rests on it."""

    @property
    def blaming(self) -> tuple[Finding, ...]:
        """Give the findings that blame the device by this clause; one that allows blames nobody."""
        if self.clause.level is not Level.MUST:
            return ()
        return tuple(f for _, f in self.findings if f.verdict.outcome in BLAMING)

    @property
    def shown(self) -> Shown:
        """Give the worst that was seen."""
        if self.blaming:
            return Shown.FAILED
        if self.findings and self.clause.level in {Level.MUST, Level.SHOULD}:
            known = all(f.verdict.outcome is Outcome.KNOWN for _, f in self.findings)
            return Shown.KNOWN if known else Shown.WARNED
        if self.passed:
            return Shown.HELD
        if self.beyond:
            return Shown.BEYOND
        if self.clause.level is Level.UNOBSERVABLE:
            return Shown.UNOBSERVABLE
        return Shown.UNTESTED


@dataclass(frozen=True, slots=True)
class Extent:
    """The rules and gaps that a device went by, and the clauses that they cite.

    The totals are those that it can reach; `beyond` are the others.
    """

    rules_covered: tuple[str, ...]
    rules_total: int
    rules_beyond: tuple[str, ...]
    clauses_covered: tuple[str, ...]
    clauses_total: int
    clauses_beyond: tuple[str, ...]


def extent_of(model: Model, gone: AbstractSet[RuleName], ways: Mapping[str, str]) -> Extent:
    """Give how far a device went that is taken to go these ways beside its pins."""
    protocol = model.protocol
    rows = {f"{m.name}.{row.name}": row for m in protocol.machines.values() for row in rows_of(m)}
    covered = frozenset(map(str, gone))
    # a device that deviates may have come where none of its text comes
    beyond = rules_beyond(model, frozenset(ways.items())) - covered
    cited = {clause for row in rows.values() for clause in row.clauses}
    clauses = clauses_beyond(model, beyond)
    return Extent(
        tuple(sorted(covered)),
        len(rows.keys() - beyond),
        tuple(sorted(beyond)),
        tuple(sorted({clause for name in covered for clause in rows[name].clauses})),
        len(cited - clauses),
        tuple(sorted(clauses)),
    )


def coverage(result: Result, protocol: Protocol) -> Mapping[str, Covered]:
    """Give all clauses of the texts by id, in the order of the texts."""
    beyond = frozenset(result.clauses_beyond)
    covered = {c.id: Covered(c, beyond=c.id in beyond) for c in protocol.clauses.values()}
    foundations = Foundations(protocol).of
    together = Counter(v.rules for v in result.verdicts if v.outcome is Outcome.PASS)
    for rules, count in together.items():
        for clause in {c for rule in rules for c in foundations.get(rule, ())}:
            if clause in covered:
                covered[clause].passed += count
    for number, finding in enumerate(result.findings(), 1):
        if finding.verdict.broken in covered:
            covered[finding.verdict.broken].findings.append((number, finding))
    return covered
