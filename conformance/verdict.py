"""The only place for what a run says: verdicts, findings that share a cause, and the result."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum


class Outcome(StrEnum):
    """How a case ended. `error` is trouble of the adapter, `crash` the death of the device."""

    PASS = "pass"
    FAIL = "fail"
    WARNING = "warning"
    INCONCLUSIVE = "inconclusive"
    SKIPPED = "skipped"
    ERROR = "error"
    CRASH = "crash"


BLAMING = frozenset({Outcome.FAIL, Outcome.CRASH})
REASON = "reason"
"""Who speaks in a trace where it says why the device refused."""


@dataclass(frozen=True, slots=True)
class TraceLine:
    """One exchange in words: microseconds since the start, who acts, what was done."""

    time: int
    who: str
    what: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """What one case (or one place in a capture) showed, with its reason."""

    case: str
    outcome: Outcome
    title: str
    reason: str = ""
    expected: tuple[str, ...] = ()
    observed: str = ""
    clauses: tuple[str, ...] = ()
    claims: tuple[str, ...] = ()
    trace: tuple[TraceLine, ...] = ()
    at: str = ""
    signature: str = ""
    flag: str = ""
    """What was broken on purpose, a key of `families.NOTES`."""
    rules: tuple[str, ...] = ()
    """The rules that the device surely went by."""
    replay: str = ""
    """What `--replay` takes to run the case again; empty: its name."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One cause: the verdict with the shortest trace, and the other cases that show the same."""

    verdict: Verdict
    also: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Result:
    """A whole run or monitored capture."""

    device: str
    subject: str
    verdicts: tuple[Verdict, ...]
    rules_covered: tuple[str, ...]
    rules_total: int
    clauses_covered: tuple[str, ...]
    clauses_total: int
    seconds: float
    choices: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    interrupted: bool = False
    guarantees: tuple[str, ...] = ()
    """What the complete suites are worth for this device, one line for each."""

    def count(self, outcome: Outcome) -> int:
        """Count the verdicts of one outcome."""
        return sum(verdict.outcome is outcome for verdict in self.verdicts)

    @property
    def conforms(self) -> bool:
        """Tell whether nothing blames the device."""
        return not any(verdict.outcome in BLAMING for verdict in self.verdicts)

    def findings(self) -> tuple[Finding, ...]:
        """Group what is no pass by cause, most severe first, shortest trace for each."""
        wanted = (Outcome.CRASH, Outcome.FAIL, Outcome.ERROR, Outcome.WARNING)
        groups: dict[tuple[Outcome, str], list[Verdict]] = {}
        for verdict in self.verdicts:
            if verdict.outcome in wanted:
                key = (verdict.outcome, verdict.signature or verdict.case)
                groups.setdefault(key, []).append(verdict)
        found = []
        for verdicts in groups.values():
            best = min(verdicts, key=lambda verdict: len(verdict.trace))
            also = tuple(verdict.case for verdict in verdicts if verdict is not best)
            found.append(Finding(best, also))
        return tuple(sorted(found, key=lambda finding: wanted.index(finding.verdict.outcome)))
