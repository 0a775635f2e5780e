"""Compares two runs: what is better, worse, or different."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.render.tables import Sheet

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.conformance.results.run_file import Basis, FoundWay, Run

_WORST_FIRST: Final = (
    Outcome.CRASH,
    Outcome.FAIL,
    Outcome.ERROR,
    Outcome.WARNING,
    Outcome.KNOWN,
    Outcome.INCONCLUSIVE,
    Outcome.SKIPPED,
    Outcome.PASS,
)
"""What says nothing of the device is worse than a pass: something is no longer known."""
_CAUSES: Final = frozenset({Outcome.CRASH, Outcome.FAIL, Outcome.WARNING})
_SAME: Final = ("device", "digest", "depth", "seed", "mailbox", "only", "version")
"""What two runs should have in common for a comparison to be about their devices."""
_WORDS: Final = {"digest": "texts", "version": "ecatspec"}


@dataclass(frozen=True, slots=True)
class Change:
    """A case that ended otherwise."""

    case: str
    title: str
    before: Outcome
    after: Outcome

    @property
    def worse(self) -> bool:
        """Tell whether it ended worse."""
        return _WORST_FIRST.index(self.after) < _WORST_FIRST.index(self.before)


@dataclass(frozen=True, slots=True)
class Blamed:
    """A cause or a clause, and how many of the common cases showed it before and after."""

    name: str
    clauses: tuple[str, ...]
    before: int
    after: int

    @property
    def worse(self) -> bool:
        """Tell whether it is new."""
        return not self.before

    @property
    def standing(self) -> str:
        """Say what became of it."""
        if self.worse:
            return "new"
        return "gone" if not self.after else f"{self.before} before"


@dataclass(frozen=True, slots=True)
class Turn:
    """A choice at which both runs found a way, and not the same."""

    choice: str
    before: FoundWay
    after: FoundWay

    @property
    def worse(self) -> bool:
        """Tell whether the way is risky and was not."""
        return bool(self.after.risk) and not self.before.risk

    @property
    def standing(self) -> str:
        """Say what that means: most ways are as good as another."""
        if self.worse:
            return "worse"
        return "better" if self.before.risk and not self.after.risk else "other"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two runs side by side. What only one of them tried says nothing of better or worse."""

    first: Run
    second: Run
    common: int
    left_out: tuple[int, int]
    changes: tuple[Change, ...]
    findings: tuple[Blamed, ...]
    clauses: tuple[Blamed, ...]
    choices: tuple[Turn, ...]

    @property
    def worse(self) -> bool:
        """Tell whether anything became worse."""
        changed = any(c.worse for c in self.changes) or any(c.worse for c in self.choices)
        blamed = (*self.findings, *self.clauses)
        return changed or any(each.worse for each in blamed)

    def notes(self) -> tuple[str, ...]:
        """Say what keeps the two from being of the same kind."""
        one, other = self.first.basis, self.second.basis
        notes = [
            f"other {_WORDS.get(name, name)}: {_told(one, name)} and {_told(other, name)}"
            for name in _SAME
            if getattr(one, name) != getattr(other, name)
        ]
        for which, run, alone in zip(
            ("first", "second"), (self.first, self.second), self.left_out, strict=True
        ):
            if not run.finished:
                notes.append(f"the {which} run is not finished: {len(run.verdicts)} cases")
            if alone:
                notes.append(f"only the {which} run has {alone} of its cases")
        return tuple(notes)


def _told(basis: Basis, name: str) -> str:
    value = getattr(basis, name)
    words = ",".join(value) if isinstance(value, tuple) else str(value)
    return (words[:12] if name == "digest" else words) or "none"


def compare(first: Run, second: Run) -> Comparison:
    """Compare a run with a later one, case by case."""
    one, other = _by_case(first), _by_case(second)
    common = [name for name in other if name in one]
    changes = [
        Change(name, other[name].title, one[name].outcome, other[name].outcome)
        for name in common
        if one[name].outcome is not other[name].outcome
    ]
    changes.sort(key=lambda change: (not change.worse, _WORST_FIRST.index(change.after)))
    before, after = ([run[name] for name in common] for run in (one, other))
    return Comparison(
        first,
        second,
        len(common),
        (len(one) - len(common), len(other) - len(common)),
        tuple(changes),
        _findings(before, after),
        _clauses(before, after),
        _turns(first, second),
    )


def _turns(first: Run, second: Run) -> tuple[Turn, ...]:
    """Give the choices that changed, what is worse first. What only one run found says nothing."""
    both = sorted(first.choices.keys() & second.choices.keys())
    turns = [Turn(name, first.choices[name], second.choices[name]) for name in both]
    changed = [turn for turn in turns if turn.before.way != turn.after.way]
    return tuple(sorted(changed, key=lambda turn: not turn.worse))


def _by_case(run: Run) -> dict[str, Verdict]:
    """Give the verdict on each case, the worst where a name stands twice."""
    found: dict[str, Verdict] = {}
    for verdict in run.verdicts:
        known = found.get(verdict.case, verdict)
        worst = min(known, verdict, key=lambda v: _WORST_FIRST.index(v.outcome))
        found[verdict.case] = worst
    return found


def _findings(before: list[Verdict], after: list[Verdict]) -> tuple[Blamed, ...]:
    """Give the causes of either run, named by the verdict with the shortest trace."""
    groups: dict[str, tuple[list[Verdict], list[Verdict]]] = {}
    for which, verdicts in enumerate((before, after)):
        for verdict in verdicts:
            if verdict.outcome in _CAUSES:
                cause = f"{verdict.outcome} {verdict.signature or verdict.case}"
                groups.setdefault(cause, ([], []))[which].append(verdict)
    found = []
    for one, other in groups.values():
        shown = min(other or one, key=lambda verdict: len(verdict.trace))
        words = f"{shown.outcome}: {shown.title}, {shown.observed or shown.reason} ({shown.case})"
        found.append(Blamed(words, shown.clauses, len(one), len(other)))
    return _ordered(found)


def _clauses(before: list[Verdict], after: list[Verdict]) -> tuple[Blamed, ...]:
    counts: dict[str, list[int]] = {}
    for which, verdicts in enumerate((before, after)):
        for verdict in verdicts:
            if verdict.outcome in _CAUSES:
                for clause in verdict.clauses:
                    counts.setdefault(clause, [0, 0])[which] += 1
    return _ordered(Blamed(name, (name,), *counts[name]) for name in sorted(counts))


def _ordered(found: Iterable[Blamed]) -> tuple[Blamed, ...]:
    """Give what is new first, and what is gone last."""
    return tuple(sorted(found, key=lambda each: (not each.worse, not each.after)))


# --- as tables and data ---------------------------------------------------------------------------


def headline(found: Comparison) -> str:
    """Say in one line what became of it."""
    worse = sum(change.worse for change in found.changes)
    counts = f"{worse} cases worse, {len(found.changes) - worse} better"
    new = sum(each.worse for each in found.findings)
    gone = sum(not each.after for each in found.findings)
    counts += f"; {new} findings new, {gone} gone, {len(found.findings) - new - gone} still there"
    counts += f"; {len(found.choices)} choices changed"
    return f"{found.common} cases in common: {counts}"


def sheets(found: Comparison) -> tuple[Sheet, ...]:
    """Give the tables of a comparison that have rows."""
    cases = tuple(
        ("worse" if c.worse else "better", c.case, c.before.value, c.after.value)
        for c in found.changes
    )
    findings = tuple((f.standing, f.after, f.name, f.clauses) for f in found.findings)
    clauses = tuple((c.standing, c.after, c.name) for c in found.clauses)
    choices = tuple(
        (c.standing, c.choice, c.before.way, c.after.way, c.before.cases, c.after.cases, _risk(c))
        for c in found.choices
    )
    columns = ("", "choice", "before", "after", "found in", "found now in", "risk")
    every = (
        Sheet("findings", "findings", ("", "cases", "finding", "clauses"), findings),
        Sheet("clauses", "clauses that were violated", ("", "cases", "clause"), clauses),
        Sheet("cases", "cases that end otherwise", ("", "case", "before", "after"), cases),
        Sheet("choices", "choices of the device that changed", columns, choices),
    )
    return tuple(sheet for sheet in every if sheet.rows)


def _risk(turn: Turn) -> str:
    return turn.after.risk or (f"before: {turn.before.risk}" if turn.before.risk else "")


def as_data(found: Comparison) -> dict[str, object]:
    """Give a comparison as data for JSON."""
    return {
        "worse": found.worse,
        "runs": [
            {
                "device": run.basis.device,
                "digest": run.basis.digest,
                "dut": run.basis.dut,
                "subject": run.basis.description["name"],
                "finished": run.finished,
                "cases": len(run.verdicts),
                "only_here": alone,
            }
            for run, alone in zip((found.first, found.second), found.left_out, strict=True)
        ],
        "common": found.common,
        "notes": list(found.notes()),
        "cases": [
            {"case": c.case, "worse": c.worse, "before": c.before.value, "after": c.after.value}
            for c in found.changes
        ],
        "findings": [_blamed(each) for each in found.findings],
        "clauses": [_blamed(each) for each in found.clauses],
        "choices": [
            {
                "choice": turn.choice,
                "standing": turn.standing,
                "worse": turn.worse,
                "before": asdict(turn.before),
                "after": asdict(turn.after),
            }
            for turn in found.choices
        ],
    }


def _blamed(each: Blamed) -> dict[str, object]:
    return {
        "name": each.name,
        "clauses": list(each.clauses),
        "before": each.before,
        "after": each.after,
        "worse": each.worse,
    }
