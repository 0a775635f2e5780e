"""Traces each clause to its rules and to the cases that exercise it.

That a run goes by a rule does not say that it would notice a mistake there: evidence says that.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.render.tables import Sheet
from ecatspec.conformance.traceability.case_footprint import Exercise
from ecatspec.conformance.traceability.evidence import fresh
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.analysis.citations import citations
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ecatspec.conformance.results.run_history import Record
    from ecatspec.conformance.traceability.evidence import Evidence
    from ecatspec.model.analysis.citations import Citation
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import Clause, Protocol

_WORST_FIRST: Final = (
    Outcome.CRASH,
    Outcome.FAIL,
    Outcome.ERROR,
    Outcome.WARNING,
    Outcome.KNOWN,
    Outcome.PASS,
    Outcome.INCONCLUSIVE,
    Outcome.SKIPPED,
)
_SHOWN_CASES: Final = 3
_DATA: Final = frozenset(
    {
        "row",
        "object",
        "pin",
        "open",
        "property",
        "parameter",
        "condition",
        "choice",
        "alternative",
        "dictionary",
        "esi",
    }
)
"""The kinds of declarations that nothing goes by: they are only looked up."""
_COLUMNS: Final = (
    "device",
    "clause",
    "level",
    "claims",
    "wording",
    "source",
    "specified",
    "standing",
    "because",
    "violation",
    "cases",
    "first case",
    "last run",
)


class Standing(StrEnum):
    """How a clause stands between text and test."""

    CARRIED = "carried"
    """A violation of it is found by a case, as measured."""
    EXERCISED = "exercised only"
    """Cases go by what rests on it; that they would notice a violation is not measured."""
    ROW_ONLY = "row only"
    """Nothing rests on it but data and choices, and no case is known to notice a violation."""
    FREE = "demands nothing"
    MISSING = "not exercised"
    REASONED = "not exercised, with the reason"
    DATA = "data of the device description"
    UNOBSERVABLE = "not observable through the protocol"


@dataclass(frozen=True, slots=True)
class Traced:
    """One clause; `outcomes` count those of its cases that the last run judged.

    `evidence` is what it was measured by, where that holds for the texts as they are.
    """

    clause: Clause
    places: tuple[Citation, ...]
    cases: tuple[str, ...]
    outcomes: Mapping[Outcome, int]
    standing: Standing
    evidence: Evidence | None = None

    @property
    def disproved(self) -> str:
        """Say why it is not true that nothing can exercise it; empty where nothing tells."""
        if self.clause.because is None or self.evidence is None:
            return ""
        return (
            f"{self.clause.at}: {self.clause.id} has it that nothing exercises it "
            f'("{self.clause.because}"), but {self.evidence.case} finds '
            f"{self.evidence.violation}; mend the text"
        )

    @property
    def verdict(self) -> str:
        """Give the worst outcome of its cases, and how many had which."""
        if not self.cases:
            return ""
        counts = [(o, self.outcomes[o]) for o in _WORST_FIRST if self.outcomes.get(o)]
        return ", ".join(f"{count} {outcome}" for outcome, count in counts) or "not run"


@dataclass(frozen=True, slots=True)
class Trace:
    """All clauses of a device (of the standard, those of the standard), and what they came to."""

    protocol: Protocol
    rows: tuple[Traced, ...]
    subject: str
    going: Mapping[str, tuple[str, ...]]
    """The cases that exercise what rests on a clause, whatever its standing."""

    @property
    def disproved(self) -> tuple[str, ...]:
        """Give the reasons of the texts that evidence disproves."""
        return tuple(filter(None, (row.disproved for row in self.rows)))

    @property
    def claims(self) -> tuple[str, ...]:
        """Give all claims that the manuals count, or where they count none, those carried."""
        counted = [claim for manual in self.protocol.manuals for claim in manual.claims]
        return tuple(counted) or tuple(sorted(self.standing_of_claims()))

    def standing_of_claims(self) -> dict[str, Standing]:
        """Give how each claim stands: as the best of the clauses that carry it."""
        order = list(Standing)
        found: dict[str, Standing] = {}
        for row in self.rows:
            for claim in row.clause.claims:
                known = found.get(claim, row.standing)
                found[claim] = min(known, row.standing, key=order.index)
        return found

    @property
    def missing(self) -> tuple[Traced, ...]:
        """Give what no case exercises, or of what no case is known to notice a violation."""
        wanting = {Standing.MISSING, Standing.ROW_ONLY, Standing.EXERCISED}
        return tuple(row for row in self.rows if row.standing in wanting)


def demands(clause: Clause) -> bool:
    """Tell whether a clause can be violated."""
    return clause.level is not Level.MAY


def trace_device(
    model: Model, record: Record | None, known: Mapping[str, Evidence] = MappingProxyType({})
) -> Trace:
    """Follow each clause of a device's own text to the cases that exercise it.

    `record` is the last run: its cases say which rules the device went by. What cases touch by
    their stimuli (objects, registers) is known without a run. `known` is the evidence by clause.
    """
    protocol = model.protocol
    exercise = Exercise(model)
    by_clause: dict[str, dict[str, None]] = {}
    outcomes: dict[str, Outcome] = {}
    names: set[str] = set()
    for case in all_cases(model, NO_LIMITS):
        names.add(case.name)
        seen = None if record is None else record.cases.get(case.name)
        if seen is not None:
            outcomes[case.name] = seen.outcome
        for clause in exercise.clauses(case, () if seen is None else seen.rules):
            by_clause.setdefault(clause, {})[case.name] = None
    cited: dict[str, list[Citation]] = {}
    for citation in citations(protocol):
        for clause in citation.clauses:
            cited.setdefault(clause, []).append(citation)
    device = bool(protocol.manuals)
    going = {clause: tuple(cases) for clause, cases in by_clause.items()}
    holding = fresh(model, known, names)
    rows = (
        _traced(
            clause,
            tuple(cited.get(clause.id, ())),
            going.get(clause.id, ()),
            outcomes,
            holding.get(clause.id),
        )
        for clause in protocol.clauses.values()
        if clause.claims or not device
    )
    return Trace(protocol, tuple(rows), "" if record is None else record.subject, going)


def _traced(
    clause: Clause,
    places: tuple[Citation, ...],
    cases: tuple[str, ...],
    outcomes: Mapping[str, Outcome],
    evidence: Evidence | None,
) -> Traced:
    if clause.level is Level.UNOBSERVABLE:
        standing = Standing.UNOBSERVABLE
    elif clause.because is not None:
        standing, cases = Standing.REASONED, ()  # what cites it is exercised, it is not
    elif not demands(clause):
        standing = Standing.FREE
    elif evidence is not None:
        standing = Standing.CARRIED
    elif cases:
        data = all(place.kind in _DATA for place in places)
        standing = Standing.ROW_ONLY if data else Standing.EXERCISED
    elif places and all(place.kind == "esi" for place in places):
        standing = Standing.DATA
    else:
        standing = Standing.MISSING
    counts = Counter(outcomes[case] for case in cases if case in outcomes)
    return Traced(clause, places, cases, counts, standing, evidence)


# --- as tables ------------------------------------------------------------------------------------


def clause_sheet(trace: Trace, rows: Iterable[Traced]) -> Sheet:
    """Give one row for each clause."""
    columns = ("clause", "claims", "says", "source", "specified", "standing", "cases", "last run")
    title = f"clauses of {trace.protocol.name}"
    if trace.subject:
        title += f"; last run: {trace.subject}"
    return Sheet(
        "clauses",
        title,
        columns,
        tuple(
            (
                row.clause.id,
                row.clause.claims,
                row.clause.wording,
                row.clause.source,
                _places(row),
                _standing(row),
                shown_cases(row),
                row.verdict,
            )
            for row in rows
        ),
    )


def _places(row: Traced) -> tuple[str, ...]:
    return tuple(f"{place.kind} {place.name}".strip() for place in row.places)


def _standing(row: Traced) -> tuple[str, ...]:
    """Give how a clause stands, and what that rests on."""
    if row.clause.because is not None:
        return (f"{row.standing}: {row.clause.because}",)
    if row.standing is Standing.CARRIED and row.evidence is not None:
        return (f"{row.standing}: {row.evidence.case} finds", row.evidence.violation)
    return (row.standing,)


def shown_cases(row: Traced) -> tuple[str, ...]:
    """Give the first cases of a clause."""
    more = len(row.cases) - _SHOWN_CASES
    return row.cases[:_SHOWN_CASES] + ((f"and {more} more",) if more > 0 else ())


def total_sheet(traces: Iterable[Trace]) -> Sheet:
    """Give one row for each device, and the sum of all."""
    rows: list[tuple[str | int, ...]] = []
    anomalies: list[set[str]] = []
    for trace in traces:
        standing_of = trace.standing_of_claims()
        standings = Counter(standing_of.values())
        carried = sum(claim in standing_of for claim in trace.claims)
        numbers = [standings[standing] for standing in Standing]
        anomalies.append({anomaly.id for anomaly in trace.protocol.anomalies})
        counts = (len(trace.rows), len(trace.claims), carried, *numbers)
        rows.append((trace.protocol.name, *counts, len(anomalies[-1])))
    if len(rows) > 1:
        columns = list(zip(*rows, strict=True))[1:-1]
        sums = (sum(int(number) for number in column) for column in columns)
        rows.append(("all", *sums, len(set.union(*anomalies))))
    header = ("device", "clauses", "claims", "accounted", *Standing, "anomalies")
    title = "claims of the manuals (an anomaly that several have counts once)"
    return Sheet("totals", title, header, tuple(rows))


def device_data(trace: Trace, rows: Iterable[Traced]) -> dict[str, object]:
    """Give a device and these of its clauses as data for JSON."""
    header, *counts = zip(total_sheet((trace,)).columns, total_sheet((trace,)).rows[0], strict=True)
    return {
        header[0]: header[1],
        "digest": trace.protocol.digest,
        "last_run": trace.subject,
        "totals": dict(counts),
        "clauses": [_data(row) for row in rows],
        "claims": {claim: standing.value for claim, standing in trace.standing_of_claims().items()},
        "anomalies": [
            {"id": a.id, "subject": a.subject, "clauses": list(a.clauses), "treatment": a.treatment}
            for a in trace.protocol.anomalies
        ],
    }


def _data(row: Traced) -> dict[str, object]:
    return {
        "id": row.clause.id,
        "level": row.clause.level.value,
        "wording": row.clause.wording,
        "source": row.clause.source,
        "claims": list(row.clause.claims),
        "standing": row.standing.value,
        "because": row.clause.because,
        "evidence": None
        if row.evidence is None
        else {"violation": row.evidence.violation, "case": row.evidence.case},
        "specified": [
            {"kind": p.kind, "name": p.name, "file": p.at.file, "line": p.at.line}
            for p in row.places
        ],
        "cases": list(row.cases),
        "outcomes": {outcome.value: count for outcome, count in sorted(row.outcomes.items())},
    }


def as_csv(rows: Iterable[tuple[Trace, Traced]]) -> str:
    """Give one line for each clause, as spreadsheets read it."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for trace, row in rows:
        clause = row.clause
        told = (
            trace.protocol.name,
            clause.id,
            clause.level.value,
            " ".join(clause.claims),
            clause.wording,
            clause.source,
            "; ".join(_places(row)),
            row.standing.value,
            clause.because or "",
            "" if row.evidence is None else row.evidence.violation,
            len(row.cases),
            row.cases[0] if row.cases else "",
            row.verdict,
        )
        writer.writerow(told)
    return out.getvalue()
