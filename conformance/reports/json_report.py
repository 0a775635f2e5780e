"""The only place for a report that machines read: stable JSON, the same for the same results."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.reports import judged
from ecatspec.conformance.verdict import Outcome

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.conformance.verdict import Finding, Result, Verdict
    from ecatspec.spec.language.ir import Protocol

SCHEMA: Final = "ecatspec.report"
VERSION: Final = 1
"""Goes up when a field changes its meaning or goes away; new fields may come without."""


def report(results: Sequence[Result], protocol: Protocol) -> str:
    """Give all results as one JSON object; only `seconds` differs from run to run."""
    data = {
        "schema": SCHEMA,
        "schema_version": VERSION,
        "specification": {"name": protocol.name, "digest": protocol.digest},
        "conforms": all(result.conforms for result in results),
        "results": [_result(result, protocol) for result in results],
    }
    return json.dumps(data, indent=2, sort_keys=True, allow_nan=False) + "\n"


def _result(result: Result, protocol: Protocol) -> dict[str, object]:
    counts = Counter(verdict.outcome for verdict in result.verdicts)
    ordered = sorted(result.verdicts, key=lambda v: (v.case, v.outcome.value, v.at, v.title))
    return {
        "device": result.device,
        "subject": result.subject,
        "conforms": result.conforms,
        "judged": judged(result),
        "interrupted": result.interrupted,
        "seconds": round(result.seconds, 3),
        "cases": {outcome.value: counts[outcome] for outcome in Outcome},
        "rules": {"covered": sorted(result.rules_covered), "total": result.rules_total},
        "clauses": {"covered": sorted(result.clauses_covered), "total": result.clauses_total},
        "choices": dict(result.choices),
        "findings": [_finding(finding, protocol) for finding in result.findings()],
        "verdicts": [_brief(verdict) for verdict in ordered],
        "notes": list(result.notes),
        "guarantees": list(result.guarantees),
    }


def _brief(verdict: Verdict) -> dict[str, object]:
    return {
        "case": verdict.case,
        "outcome": verdict.outcome.value,
        "title": verdict.title,
        "reason": verdict.reason,
        "at": verdict.at,
        "flag": verdict.flag,
    }


def _finding(finding: Finding, protocol: Protocol) -> dict[str, object]:
    verdict = finding.verdict
    return {
        **_brief(verdict),
        "clauses": [_clause(name, protocol) for name in verdict.clauses],
        "claims": list(verdict.claims),
        "expected": list(verdict.expected),
        "observed": verdict.observed,
        "signature": verdict.signature,
        "trace": [
            {"microseconds": line.time, "who": line.who, "what": line.what}
            for line in verdict.trace
        ],
        "also": sorted(finding.also),
        "replay": verdict.replay or verdict.case,
    }


def _clause(name: str, protocol: Protocol) -> dict[str, object]:
    clause = protocol.clauses.get(name)
    if clause is None:
        return {"id": name}
    return {
        "id": name,
        "level": clause.level.value,
        "wording": clause.wording,
        "source": clause.source,
    }
