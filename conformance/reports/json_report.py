"""Reports a run as stable JSON: the same results give the same bytes.

The types are the format: the report is made with them, and the JSON Schema is made from them.
"""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta, Struct

from ecatspec.conformance.base.verdict import Conclusion, Outcome
from ecatspec.conformance.reports import judged, risks
from ecatspec.spec.language.ir import Level  # noqa: TC001  msgspec reads the annotations

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.conformance.base.verdict import Finding, Result, Verdict
    from ecatspec.spec.language.ir import Protocol

SCHEMA: Final = "ecatspec.report"
VERSION: Final = 1
"""Goes up when a field changes its meaning or goes away; new fields may come without."""

Count = Annotated[int, Meta(ge=0)]
Seconds = Annotated[float, Meta(ge=0)]


class _Part(Struct, frozen=True, forbid_unknown_fields=True):
    """What all parts have in common: nothing is there that is not named here."""


class Specification(_Part, frozen=True):
    """The texts that the device was judged by."""

    name: str
    digest: str


class SetUpPart(_Part, frozen=True):
    """How a run was asked for, and when."""

    device: str
    dut: str
    depth: str
    seed: int
    mailbox: str
    began: str


class Covered(_Part, frozen=True):
    """What was exercised, and the total that the device can reach.

    `beyond` is what it cannot reach by its own text, and is not in the total.
    """

    covered: list[str]
    total: Count
    beyond: list[str]


class ClausePart(_Part, frozen=True, omit_defaults=True):
    """A clause; of one that no text declares only its id is known."""

    id: str
    level: Level | None = None
    wording: str | None = None
    source: str | None = None


class Line(_Part, frozen=True, omit_defaults=True):
    """One line of a trace; `bytes` are those of a message, in hexadecimal."""

    microseconds: int
    who: str
    what: str
    bytes: str = ""


class Brief(_Part, frozen=True):
    """A verdict in short."""

    case: str
    outcome: Outcome
    title: str
    reason: str
    at: str
    flag: str


class KindPart(_Part, frozen=True):
    """Something that was observed of a cause too, and the cases that show it."""

    signature: str
    title: str
    case: str
    clause: str
    """The clause that was broken."""
    cases: Count


class FindingPart(Brief, frozen=True):
    """One cause: the verdict with the shortest trace, and the other cases that show the same."""

    clauses: list[ClausePart]
    """The broken one first, then those that are involved too."""
    claims: list[str]
    expected: list[str]
    observed: str
    differing: list[str]
    """The fields of `observed` that are not as expected, or its layout."""
    blamed: list[str]
    """The rules by which the device should have gone."""
    signature: str
    trace: list[Line]
    also: list[str]
    kinds: list[KindPart]
    """What else was observed of the same cause."""
    depends: list[str]
    """The ways (`choice=alternative`) found earlier in the run without which it is no finding."""
    replay: str
    """What `--replay` takes."""
    command: str | None
    """The whole command line; null where the case cannot be run again."""


class ResultPart(_Part, frozen=True):
    """A run, or one device of a capture."""

    device: str
    subject: str
    conclusion: Conclusion
    conforms: bool
    unreached: list[str]
    """The AL states that cases needed and none reached."""
    judged: bool
    interrupted: bool
    seconds: Seconds
    set_up: SetUpPart | None
    cases: dict[Outcome, Count]
    rules: Covered
    clauses: Covered
    choices: dict[str, str]
    risky: dict[str, str]
    """Why ways in `choices` that were found are risky, by choice."""
    findings: list[FindingPart]
    verdicts: list[Brief]
    notes: list[str]
    guarantees: list[str]


class Report(_Part, frozen=True):
    """The whole report."""

    schema: Literal["ecatspec.report"]
    schema_version: Literal[1]
    specification: Specification
    conforms: bool
    results: list[ResultPart]


def report(results: Sequence[Result], protocol: Protocol) -> str:
    """Give all results as one JSON object; only times differ from run to run."""
    data = Report(
        SCHEMA,
        VERSION,
        Specification(protocol.name, protocol.digest),
        all(result.conforms for result in results),
        [_result(result, protocol) for result in results],
    )
    plain = msgspec.to_builtins(data, str_keys=True)
    return json.dumps(plain, indent=2, sort_keys=True, allow_nan=False) + "\n"


def json_schema() -> dict[str, Any]:
    """Give the JSON Schema of a report, closed: nothing may be there that it does not name."""
    schema = msgspec.json.schema(Report)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _result(result: Result, protocol: Protocol) -> ResultPart:
    counts = Counter(verdict.outcome for verdict in result.verdicts)
    ordered = sorted(result.verdicts, key=lambda v: (v.case, v.outcome.value, v.at, v.title))
    return ResultPart(
        result.device,
        result.subject,
        result.conclusion,
        result.conforms,
        list(result.unreached),
        judged(result),
        result.interrupted,
        round(result.seconds, 3),
        _set_up(result),
        {outcome: counts[outcome] for outcome in Outcome},
        Covered(sorted(result.rules_covered), result.rules_total, sorted(result.rules_beyond)),
        Covered(
            sorted(result.clauses_covered), result.clauses_total, sorted(result.clauses_beyond)
        ),
        dict(result.choices),
        risks(result, protocol),
        [_finding(finding, result, protocol) for finding in result.findings()],
        [Brief(*_brief(verdict)) for verdict in ordered],
        list(result.notes),
        list(result.guarantees),
    )


def _set_up(result: Result) -> SetUpPart | None:
    asked = result.set_up
    if asked is None:
        return None
    return SetUpPart(asked.device, asked.dut, asked.depth, asked.seed, asked.mailbox, asked.began)


def _brief(verdict: Verdict) -> tuple[str, Outcome, str, str, str, str]:
    return (
        verdict.case,
        verdict.outcome,
        verdict.title,
        verdict.reason,
        verdict.at,
        verdict.flag,
    )


def _finding(finding: Finding, result: Result, protocol: Protocol) -> FindingPart:
    verdict = finding.verdict
    return FindingPart(
        *_brief(verdict),
        clauses=[_clause(name, protocol) for name in verdict.clauses],
        claims=list(verdict.claims),
        expected=list(verdict.expected),
        observed=verdict.observed,
        differing=list(verdict.differing),
        blamed=list(verdict.blamed),
        signature=verdict.signature,
        trace=[Line(line.time, line.who, line.what, line.data.hex()) for line in verdict.trace],
        also=sorted(finding.also),
        kinds=[
            KindPart(kind.signature, kind.title, kind.case, kind.broken, count)
            for kind, count in finding.kinds
        ],
        depends=list(verdict.depends),
        replay=verdict.again,
        command=None if result.set_up is None else result.set_up.command(verdict),
    )


def _clause(name: str, protocol: Protocol) -> ClausePart:
    clause = protocol.clauses.get(name)
    if clause is None:
        return ClausePart(name)
    return ClausePart(name, clause.level, clause.wording, clause.source)
