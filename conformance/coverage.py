"""The only place for what a run showed of each clause: cases that held by it, and findings."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from ecatspec.conformance.verdict import BLAMING, Outcome
from ecatspec.model.citations import Foundations
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.conformance.verdict import Finding, Result
    from ecatspec.spec.language.ir import Clause, Protocol


class Shown(StrEnum):
    """What a run showed of a clause."""

    FAILED = "failed"
    WARNED = "warned"
    KNOWN = "known"
    """All that was found against it is accepted."""
    HELD = "held"
    UNTESTED = "not tested"
    UNOBSERVABLE = "not observable"


@dataclass(slots=True)
class Covered:
    """One clause: how many cases passed by rules that rest on it, and the findings of it."""

    clause: Clause
    passed: int = 0
    findings: list[tuple[int, Finding]] = field(default_factory=list)
    """Those that broke it, each with its number in the report."""

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
        if self.clause.level is Level.UNOBSERVABLE:
            return Shown.UNOBSERVABLE
        return Shown.UNTESTED


def coverage(result: Result, protocol: Protocol) -> Mapping[str, Covered]:
    """Give all clauses of the texts by id, in the order of the texts."""
    covered = {clause.id: Covered(clause) for clause in protocol.clauses.values()}
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
