"""Measures whether a run notices that a clause is violated.

For each clause devices that violate it are tried, in the cases that have to do with what is wrong.
What the sound device was asked in a case, and what it answered, is kept: a device that answers the
same to all of it is not judged there.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import chain, islice, zip_longest
from typing import TYPE_CHECKING, Final, TypeAlias, TypeVar

from ecatspec.conformance.base.adapter import AdapterError, DeviceFault
from ecatspec.conformance.base.verdict import FOUND, Outcome
from ecatspec.conformance.mutation.kill_analysis import PATIENCE, Heard, OverdueError, overdue
from ecatspec.conformance.run.dut_knowledge import shape_of
from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.traceability.case_footprint import Touch
from ecatspec.conformance.traceability.evidence import Evidence, Violations, digest_of
from ecatspec.conformance.traceability.trace import demands
from ecatspec.generators.cases.case import NO_LIMITS, SendFrame
from ecatspec.generators.suite import all_cases
from ecatspec.model.analysis.citations import object_name
from ecatspec.model.esc.subdevice import Quirk

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.conformance.results.run_history import Record
    from ecatspec.conformance.run.runner import Progress
    from ecatspec.conformance.traceability.evidence import Violation
    from ecatspec.conformance.traceability.trace import Trace
    from ecatspec.generators.cases.case import Case
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import Protocol

_T = TypeVar("_T")
_ROUNDS: Final = ((24, 10), (80, 40))
"""Violations of a clause, and cases for each, that a first and a second round try at most."""
_WAYS: Final = 12
"""Cases, the shortest first, that try to bring a device to an AL state."""
_CITED: Final = 6
"""Further violations that are tried for one whose finding cites the clause."""


_Log: TypeAlias = tuple[tuple[str, tuple[object, ...], object], ...]


@dataclass(frozen=True, slots=True)
class _Tried:
    """A device that violates a clause, as it is listened to."""

    heard: Heard
    runner: Runner


class Measurement:
    """The suite of a device, and which of it has to do with what."""

    def __init__(self, model: Model) -> None:
        """Make all cases, and the sound device."""
        self.model = model = model.as_closed  # what is measured are devices made of texts
        self.violations = Violations(model)
        self._sound = self._device(model.protocol, frozenset())
        self._cases = {case.name: case for case in all_cases(model, NO_LIMITS)}
        touch = Touch(model)
        self._touched = {
            name: touch.of(case).union(_asked(case)) for name, case in self._cases.items()
        }
        self._about: dict[str, list[str]] = {}
        self._shown: dict[str, _Log | None] = {}
        """What the sound device was asked in cases, and answered; None: it is blamed there."""

    def knowing(self, record: Record) -> None:
        """Take from a run which rules its cases went by."""
        for name, case in record.cases.items():
            if name in self._touched:
                self._touched[name] |= case.rules
        self._about = {}
        for name, touched in self._touched.items():
            for each in touched:
                self._about.setdefault(each, []).append(name)

    def again(self, clause: str, known: Evidence) -> Evidence | None:
        """Tell whether evidence holds still; None: it does not."""
        if known.digest != digest_of(self.model.protocol, clause):
            return None
        if known.case not in self._cases:
            return None
        for violation in self.violations.of(clause):
            if violation.name == known.violation:
                return self._found(clause, violation, [known.case])
        return None

    def search(self, clause: str, cases: Iterable[str], *, alone: bool) -> Evidence | None:
        """Look for a violation of a clause that a case finds; `cases` exercise the clause.

        `alone`: only by what nothing else rests on.
        """
        every = [v for v in self.violations.of(clause) if v.alone or not alone]
        ordered = list(_in_turn(every, lambda v: (not v.alone, _place(v.name))))
        fallback = tuple(cases)
        for devices, often in _ROUNDS:
            best: Evidence | None = None
            left = devices
            for violation in ordered:
                if not left:
                    break
                left -= 1
                found = self._found(clause, violation, self._likely(violation, fallback, often))
                if found is None:
                    continue
                if found.cited:
                    return found
                if best is None:
                    best, left = found, min(left, _CITED)
            if best is not None:
                return best
        return None

    def _likely(self, violation: Violation, fallback: tuple[str, ...], number: int) -> list[str]:
        """Give cases that have to do with what is wrong: the rarest and shortest, of all kinds."""
        about = [name for name in violation.about if name in self._about]
        weights: defaultdict[str, float] = defaultdict(float)
        for name in about:
            for case in self._about[name]:
                weights[case] += 1 / len(self._about[name])
        names = list(weights) or [name for name in fallback if name in self._cases]
        names.sort(key=lambda name: (-weights[name], len(self._cases[name].stimuli)))
        return list(islice(_in_turn(names, lambda name: name.rpartition("/")[0]), number))

    def _found(self, clause: str, violation: Violation, cases: Iterable[str]) -> Evidence | None:
        quirk = None if violation.fault is None else violation.fault.quirk
        try:
            with overdue(PATIENCE):
                device = self._device(
                    violation.protocol, frozenset({Quirk(quirk)} if quirk else ())
                )
        except (Exception, OverdueError):  # noqa: BLE001  what does not come up violates nothing
            return None
        digest = digest_of(self.model.protocol, clause)
        best: Evidence | None = None
        stuck: str | None = None
        for name in cases:
            verdict = self._judged(device, name)
            if verdict is None:
                continue
            if verdict.outcome is Outcome.INCONCLUSIVE:
                stuck = stuck or name
            if verdict.outcome not in FOUND:
                continue
            found = Evidence(digest, violation.name, name, clause in verdict.clauses)
            if found.cited:
                return found
            best = best or found
        if best is None and stuck is not None and self._never_there(device, stuck):
            return Evidence(digest, violation.name, stuck, cited=False)
        return best

    def _never_there(self, device: _Tried, name: str) -> bool:
        """Tell whether a device never comes where a case needs it: no run says that it conforms."""
        state = self._cases[name].needs
        needing = [case for case in self._cases.values() if case.needs == state]
        needing.sort(key=lambda case: len(case.stimuli))
        runner = device.runner
        runner.needed = set() if state is None else {state}
        for case in needing[:_WAYS]:
            runner.known.choices = shape_of(self.model.protocol)
            try:
                with overdue(PATIENCE):
                    runner.executor.judge(case)
            except (DeviceFault, AdapterError, OverdueError):
                return False
        return state in runner.unreached()

    def _judged(self, device: _Tried, name: str) -> Verdict | None:
        """Judge a device in a case; None where it does as the sound device does."""
        log = self._log(name)
        if log is None or not device.heard.differs(log):
            return None
        device.runner.known.choices = shape_of(self.model.protocol)
        device.runner.known.signatures = set()
        try:
            with overdue(PATIENCE):
                return device.runner.executor.judge(self._cases[name])
        except (DeviceFault, AdapterError, OverdueError):
            return None

    def _log(self, name: str) -> _Log | None:
        if name not in self._shown:
            self._sound.runner.known.choices = shape_of(self.model.protocol)
            verdict = self._sound.runner.executor.judge(self._cases[name])
            sound = verdict.outcome not in FOUND
            self._shown[name] = tuple(self._sound.heard.log) if sound else None
        return self._shown[name]

    def _device(self, protocol: Protocol, quirks: frozenset[Quirk]) -> _Tried:
        heard = Heard(protocol, quirks)
        return _Tried(heard, Runner(self.model, heard, heard.describe()))


def _asked(case: Case) -> Iterator[str]:
    """Give the objects that a case asks for, whether a text declares them or not."""
    for stimulus in case.stimuli:
        if isinstance(stimulus, SendFrame):
            index, subindex = (stimulus.fields.get(name) for name in ("index", "subindex"))
            if isinstance(index, int) and isinstance(subindex, int):
                yield object_name((index, subindex))


def _place(name: str) -> str:
    return name.partition(": ")[0]


def _in_turn(items: Iterable[_T], kind: Callable[[_T], object]) -> Iterator[_T]:
    """Yield the first of each kind, then the second of each."""
    groups: dict[object, list[_T]] = {}
    for item in items:
        groups.setdefault(kind(item), []).append(item)
    missing = object()
    rows = zip_longest(*groups.values(), fillvalue=missing)
    return (item for item in chain.from_iterable(rows) if item is not missing)  # type: ignore[misc]


def measure(
    trace: Trace,
    model: Model,
    record: Record,
    known: Mapping[str, Evidence],
    keep: Callable[[Mapping[str, Evidence]], None],
    progress: Progress | None = None,
) -> dict[str, Evidence]:
    """Look for evidence for each clause of a trace that demands something; keep it as it is found.

    What is known already is tried first, and looked for anew where it holds no more.
    """
    work = Measurement(model)
    work.knowing(record)
    found = dict(known)
    rows = [row for row in trace.rows if demands(row.clause)]
    for name in known.keys() - {row.clause.id for row in rows}:
        del found[name]
    for number, row in enumerate(rows):
        clause = row.clause
        if progress is not None:
            progress(number, len(rows), clause.id)
        own = known.get(clause.id)
        evidence = None if own is None else work.again(clause.id, own)
        if evidence is None:
            cases = trace.going.get(clause.id, ())
            alone = clause.because is not None
            evidence = work.search(clause.id, cases, alone=alone)
        if evidence is None:
            found.pop(clause.id, None)
        else:
            found[clause.id] = evidence
        if evidence != own:
            keep(found)
    return found
