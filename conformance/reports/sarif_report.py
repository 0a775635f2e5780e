"""Reports a run as SARIF: one result for each finding, whose rule is the broken clause.

A result lies where the text of the device states the clause, if that is a file of the user; else it
names the case only.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.render.marks import kinds, needs
from ecatspec.conformance.render.sarif import log, place

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.conformance.base.verdict import Finding, Result
    from ecatspec.spec.language.ir import Protocol

_NO_CLAUSE: Final = "run"
"""The rule of what breaks no clause."""
_NOTES: Final = "of the run itself, no clause"


def report(results: Sequence[Result], protocol: Protocol) -> str:
    """Give all findings as SARIF 2.1.0 that ends with a newline."""
    every = [(result, finding) for result in results for finding in result.findings()]
    broken = dict.fromkeys(finding.verdict.broken or _NO_CLAUSE for _, finding in every)
    clauses = protocol.clauses
    rules = {name: clauses[name].wording if name in clauses else _NOTES for name in broken}
    return log(rules, [_found(*each, protocol, list(rules)) for each in every])


def _found(
    result: Result, finding: Finding, protocol: Protocol, rules: list[str]
) -> dict[str, object]:
    verdict = finding.verdict
    rule = verdict.broken or _NO_CLAUSE
    bad = verdict.outcome in BLAMING or verdict.outcome is Outcome.ERROR
    level = "note" if verdict.outcome is Outcome.KNOWN else "error" if bad else "warning"
    said = [verdict.title, *(f"expected: {words}" for words in verdict.expected)]
    said += [f"observed: {verdict.observed}"] if verdict.observed else []
    said += [verdict.reason] if verdict.reason else []
    said += [needs(verdict)] if verdict.depends else []
    said += [f"seen too: {kind}" for kind in kinds(finding)]
    said += [result.set_up.command(verdict)] if result.set_up is not None else []
    return {
        "ruleId": rule,
        "ruleIndex": rules.index(rule),
        "level": level,
        "message": {"text": "\n".join(said)},
        "locations": [_location(verdict.case, rule, protocol)],
        "partialFingerprints": {"ecatspec/identity": verdict.signature or verdict.case},
        "occurrenceCount": 1 + len(finding.also),
    }


def _location(case: str, rule: str, protocol: Protocol) -> dict[str, object]:
    where: dict[str, object] = {"logicalLocations": [{"fullyQualifiedName": case}]}
    clause = protocol.clauses.get(rule)
    if clause is not None and Path(clause.at.file).is_file():
        where |= place(clause.at.file, clause.at.line, clause.at.column)
    return where
