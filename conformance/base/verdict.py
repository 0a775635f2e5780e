"""Verdicts, findings that share a cause, and the result of a run."""

from __future__ import annotations

import shlex
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum, StrEnum, auto
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable


class Outcome(StrEnum):
    """How a case ended.

    `error` is trouble of the adapter, `crash` the death of the device; what is `known` would be a
    failure, a warning or a crash, and the user accepts it.
    """

    PASS = "pass"
    FAIL = "fail"
    WARNING = "warning"
    KNOWN = "known"
    INCONCLUSIVE = "inconclusive"
    SKIPPED = "skipped"
    ERROR = "error"
    CRASH = "crash"


BLAMING = frozenset({Outcome.FAIL, Outcome.CRASH})
FOUND = BLAMING | {Outcome.WARNING}
"""How a case ends that tells of a cause to look at."""
CAUSED = FOUND | {Outcome.KNOWN}
"""How a case ends that tells of a cause, known or not."""
MAIN_DEVICE: Final = "MainDevice"
SUB_DEVICE: Final = "SubDevice"
REASON: Final = "reason"
"""Who stands in a trace: the two, and why the device refused."""
UNEXPLAINED: Final = "no state that the texts allow explains the observation"
ADVISED: Final = "the texts allow it, and advise against it"
WAITS: Final = "waits"
LOCAL_EVENT: Final = "has the local event"
"""First words of lines about what does not cross the bus."""


class Conclusion(StrEnum):
    """What a run says of the device as a whole."""

    CONFORMS = "conforms"
    DEVIATES_AS_KNOWN = "deviates as is known"
    """All that would blame it was accepted before."""
    NOT_SHOWN = "not shown"
    """Nothing blames it, but it never was in a state that cases needed."""
    DOES_NOT_CONFORM = "does not conform"


class Way(Enum):
    """Which way something goes in a sequence chart; DEATH: nothing comes any more."""

    TO_DEVICE = auto()
    FROM_DEVICE = auto()
    NONE = auto()
    DEATH = auto()


@dataclass(frozen=True, slots=True)
class TraceLine:
    """One exchange in words: microseconds since the start, who acts, what was done.

    Of a message also its bytes.
    """

    time: int
    who: str
    what: str
    data: bytes = b""

    @property
    def way(self) -> Way:
        """Tell which way this goes."""
        if self.what.startswith((WAITS, LOCAL_EVENT)):
            return Way.NONE
        return {MAIN_DEVICE: Way.TO_DEVICE, SUB_DEVICE: Way.FROM_DEVICE}.get(self.who, Way.NONE)


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
    """What was broken first, then what is involved too."""
    claims: tuple[str, ...] = ()
    trace: tuple[TraceLine, ...] = ()
    at: str = ""
    signature: str = ""
    """Its identity: the same wherever the same is observed and the same demands otherwise."""
    causes: tuple[str, ...] = ()
    """Verdicts that share one of these share a cause; none: those with the same identity do."""
    flag: str = ""
    """What was broken on purpose, a key of `families.NOTES`."""
    rules: tuple[str, ...] = ()
    """The rules that the device surely went by."""
    replay: str = ""
    """The token that holds the case; empty: its name does."""
    differing: tuple[str, ...] = ()
    """The fields of `observed` that are not as expected, or its layout."""
    blamed: tuple[str, ...] = ()
    """The rules by which the device should have gone where it was blamed."""
    depends: tuple[str, ...] = ()
    """The ways (`choice=alternative`) found earlier in the run without which it is no finding."""

    @property
    def broken(self) -> str:
        """The clause that was broken; empty where none is known."""
        return next(iter(self.clauses), "")

    @property
    def involved(self) -> tuple[str, ...]:
        """The clauses that have to do with it too."""
        return self.clauses[1:]

    @property
    def again(self) -> str:
        """What `--replay` takes to run the case again."""
        return self.replay or self.case

    def ways(self) -> tuple[Way, ...]:
        """Tell for each line of the trace which way it goes; a crash ends with the death."""
        found = [line.way for line in self.trace]
        if found and self.outcome is Outcome.CRASH:
            found[-1] = Way.DEATH
        return tuple(found)


@dataclass(frozen=True, slots=True)
class Finding:
    """One cause: the verdict with the shortest trace, and the other cases that show the same."""

    verdict: Verdict
    also: tuple[str, ...] = ()
    kinds: tuple[tuple[Verdict, int], ...] = ()
    """What else was observed of it: the shortest of each identity, and the cases that show it."""


@dataclass(frozen=True, slots=True)
class SetUp:
    """How a run was asked for: enough to ask for it again, and when that was."""

    device: str
    dut: str
    depth: str
    seed: int
    mailbox: str
    began: str
    """Date and time, as ISO 8601 writes them."""
    known: str = ""
    """The file of known deviations."""
    choices: tuple[str, ...] = ()
    """The ways (`choice=alternative`) that were given."""

    def command(self, verdict: Verdict) -> str:
        """Give the command line that runs the case of a verdict again, with the same verdict."""
        words = ["ecatspec", "run", self.device, "--dut", self.dut]
        words += ["--mailbox", self.mailbox] if self.mailbox else []
        words += ["--known", self.known] if self.known else []
        for way in dict.fromkeys((*self.choices, *verdict.depends)):
            words += ["--choice", way]
        return shlex.join((*words, "--replay", verdict.again))


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
    set_up: SetUp | None = None
    """None: it was no run, and no case of it can be run again."""
    unreached: tuple[str, ...] = ()
    """The AL states that cases needed and none reached."""
    planned: int = 0
    """The cases of the whole run, as far as they are known; 0: they are not."""
    rules_beyond: tuple[str, ...] = ()
    """The rules that the device cannot reach by its own text; they are not in the total."""
    clauses_beyond: tuple[str, ...] = ()
    """The clauses that it cannot reach either; they are not in the total."""

    def count(self, outcome: Outcome) -> int:
        """Count the verdicts of one outcome."""
        return sum(verdict.outcome is outcome for verdict in self.verdicts)

    @property
    def conclusion(self) -> Conclusion:
        """Say what was found of the device, so far if the run was interrupted."""
        if any(verdict.outcome in BLAMING for verdict in self.verdicts):
            return Conclusion.DOES_NOT_CONFORM
        if not self.interrupted and self.unreached:
            return Conclusion.NOT_SHOWN
        return Conclusion.DEVIATES_AS_KNOWN if self.count(Outcome.KNOWN) else Conclusion.CONFORMS

    @property
    def conforms(self) -> bool:
        """Tell whether nothing blames the device, and it was wherever cases needed it.

        What is known blames nobody.
        """
        return self.conclusion in {Conclusion.CONFORMS, Conclusion.DEVIATES_AS_KNOWN}

    def unreached_words(self) -> str:
        """Say which AL states were never reached, and why the first case that needed them was not.

        Empty where all were.
        """
        if not self.unreached:
            return ""
        outcome = Outcome.INCONCLUSIVE
        reasons = [v.reason for v in self.verdicts if v.outcome is outcome]
        first = next((reason for reason in reasons if self.unreached[0] in reason), "")
        were = "was" if len(self.unreached) == 1 else "were"
        said = f"{', '.join(self.unreached)} {were} never reached"
        return f"{said} ({first})" if first else said

    def unjudged(self) -> tuple[tuple[Outcome, str, int], ...]:
        """Give why cases say nothing about the device, with their number."""
        groups = Counter(
            (verdict.outcome, verdict.reason or verdict.title)
            for verdict in self.verdicts
            if verdict.outcome in {Outcome.SKIPPED, Outcome.INCONCLUSIVE}
        )
        return tuple((*group, count) for group, count in sorted(groups.items()))

    def findings(self) -> tuple[Finding, ...]:
        """Group what is no pass by cause, most severe first, shortest trace for each."""
        wanted = (
            Outcome.CRASH,
            Outcome.FAIL,
            Outcome.ERROR,
            Outcome.WARNING,
            Outcome.KNOWN,
        )
        same: dict[tuple[Outcome, str], list[Verdict]] = {}
        for verdict in self.verdicts:
            if verdict.outcome in wanted:
                key = (verdict.outcome, verdict.signature or verdict.case)
                same.setdefault(key, []).append(verdict)
        found = map(_finding, _of_one_cause(same.values()))
        return tuple(sorted(found, key=lambda finding: wanted.index(finding.verdict.outcome)))


def _of_one_cause(kinds: Iterable[list[Verdict]]) -> list[list[list[Verdict]]]:
    """Put together the kinds of verdicts that share a cause, each kind with the same identity."""
    groups: list[tuple[set[tuple[Outcome, str]], list[list[Verdict]]]] = []
    for kind in kinds:
        names = {(v.outcome, c) for v in kind for c in v.causes or (v.signature or v.case,)}
        shared = [group for group in groups if group[0] & names]
        groups = [group for group in groups if not group[0] & names]
        names = names.union(*(group[0] for group in shared))
        groups.append((names, [*(each for group in shared for each in group[1]), kind]))
    return [group[1] for group in groups]


def _finding(kinds: list[list[Verdict]]) -> Finding:
    shortest = [min(kind, key=lambda verdict: len(verdict.trace)) for kind in kinds]
    best = min(shortest, key=lambda verdict: len(verdict.trace))
    also = tuple(verdict.case for kind in kinds for verdict in kind if verdict is not best)
    others = ((s, len(kind)) for s, kind in zip(shortest, kinds, strict=True) if s is not best)
    return Finding(best, also, tuple(sorted(others, key=lambda other: -other[1])))
