"""The only place for traceability: clause, where it is specified, what exercises it, what it showed."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.devices import Sheet
from ecatspec.conformance.exercise import Touch
from ecatspec.conformance.verdict import Outcome
from ecatspec.generators.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.citations import Foundations, citations
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ecatspec.conformance.record import Record
    from ecatspec.model.citations import Citation
    from ecatspec.model.compiled import Model
    from ecatspec.spec.language.ir import Clause, Protocol

_WORST_FIRST: Final = (
    Outcome.CRASH,
    Outcome.FAIL,
    Outcome.ERROR,
    Outcome.WARNING,
    Outcome.PASS,
    Outcome.INCONCLUSIVE,
    Outcome.SKIPPED,
)
_SHOWN_CASES: Final = 3


class Standing(StrEnum):
    """How a clause stands between text and test."""

    EXERCISED = "exercised"
    MISSING = "not exercised"
    REASONED = "not exercised, with the reason"
    DATA = "data of the device description"
    UNOBSERVABLE = "not observable through the protocol"


@dataclass(frozen=True, slots=True)
class Traced:
    """One clause; `outcomes` count those of its cases that the last run judged."""

    clause: Clause
    places: tuple[Citation, ...]
    cases: tuple[str, ...]
    outcomes: Mapping[Outcome, int]
    standing: Standing

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
        """Give what is specified and not exercised."""
        return tuple(row for row in self.rows if row.standing is Standing.MISSING)


def trace_device(model: Model, record: Record | None) -> Trace:
    """Follow each clause of a device's own text to the cases that exercise it.

    `record` is the last run: its cases say which rules the device went by. What cases touch by
    their stimuli (objects, registers) is known without a run.
    """
    protocol = model.protocol
    foundations = Foundations(protocol)
    touch = Touch(model)
    by_clause: dict[str, dict[str, None]] = {}
    outcomes: dict[str, Outcome] = {}
    for case in all_cases(model, NO_LIMITS):
        seen = None if record is None else record.cases.get(case.name)
        names = touch.of(case)
        if seen is not None:
            outcomes[case.name] = seen.outcome
            names |= seen.rules
        for clause in {c for name in names for c in foundations.of.get(name, ())}:
            by_clause.setdefault(clause, {})[case.name] = None
    cited: dict[str, list[Citation]] = {}
    for citation in citations(protocol):
        for clause in citation.clauses:
            cited.setdefault(clause, []).append(citation)
    device = bool(protocol.manuals)
    rows = (
        _traced(
            clause,
            tuple(cited.get(clause.id, ())),
            tuple(by_clause.get(clause.id, ())),
            outcomes,
        )
        for clause in protocol.clauses.values()
        if clause.claims or not device
    )
    return Trace(protocol, tuple(rows), "" if record is None else record.subject)


def _traced(
    clause: Clause,
    places: tuple[Citation, ...],
    cases: tuple[str, ...],
    outcomes: Mapping[str, Outcome],
) -> Traced:
    if clause.level is Level.UNOBSERVABLE:
        standing = Standing.UNOBSERVABLE
    elif cases:
        standing = Standing.EXERCISED
    elif clause.because is not None:
        standing = Standing.REASONED
    elif places and all(place.kind == "esi" for place in places):
        standing = Standing.DATA
    else:
        standing = Standing.MISSING
    counts = Counter(outcomes[case] for case in cases if case in outcomes)
    return Traced(clause, places, cases, counts, standing)


# --- as tables ------------------------------------------------------------------------------------


def clause_sheet(trace: Trace, rows: Iterable[Traced]) -> Sheet:
    """Give one row for each clause."""
    columns = ("clause", "claims", "says", "source", "specified", "cases", "last run")
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
                _cases(row),
                row.verdict,
            )
            for row in rows
        ),
    )


def _places(row: Traced) -> tuple[str, ...]:
    return tuple(f"{place.kind} {place.name}".strip() for place in row.places)


def _cases(row: Traced) -> tuple[str, ...]:
    if not row.cases:
        why = f": {row.clause.because}" if row.clause.because else ""
        return (f"{row.standing}{why}",)
    more = len(row.cases) - _SHOWN_CASES
    return row.cases[:_SHOWN_CASES] + ((f"and {more} more",) if more > 0 else ())


def total_sheet(traces: Iterable[Trace]) -> Sheet:
    """Give one row for each device, and the sum of all."""
    rows: list[tuple[str, *tuple[int, ...]]] = []
    for trace in traces:
        standings = Counter(trace.standing_of_claims().values())
        carried = sum(claim in trace.standing_of_claims() for claim in trace.claims)
        numbers = [standings[standing] for standing in Standing]
        anomalies = len(trace.protocol.anomalies)
        counts = (len(trace.rows), len(trace.claims), carried, *numbers, anomalies)
        rows.append((trace.protocol.name, *counts))
    if len(rows) > 1:
        rows.append(("all", *(sum(column) for column in zip(*(r[1:] for r in rows), strict=True))))
    columns = ("device", "clauses", "claims", "accounted", *Standing, "anomalies")
    return Sheet("totals", "claims of the manuals", columns, tuple(rows))
