"""Gives two implementations the same stimuli and finds where their answers differ."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.base.adapter import AdapterError
from ecatspec.conformance.base.devices import UserError, load
from ecatspec.conformance.base.verdict import Outcome, TraceLine
from ecatspec.conformance.render.tables import Sheet
from ecatspec.conformance.run.case_executor import CaseExecutor, limits_of
from ecatspec.generators.cases.case import Limits
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.generators.cases.case import Case

_COUNTER: Final = re.compile(r",? ?\bcounter \d+")
"""Devices count their messages as they like."""
_SAYS: Final = "MainDevice"
_NOTHING: Final = "nothing"
_DEPTH: Final = "quick"


@dataclass(frozen=True, slots=True)
class Parting:
    """One way in which two devices answer otherwise; `case` is the shortest that shows it.

    `stimuli` are those up to there in words, `cases` counts how many cases show it.
    """

    case: str
    stimuli: tuple[str, ...]
    answers: tuple[str, str]
    cases: int


@dataclass(frozen=True, slots=True)
class Parted:
    """What two devices do otherwise; `alike` cases showed nothing, `left_out` were for one only."""

    names: tuple[str, str]
    device: str
    alike: int
    left_out: int
    differences: tuple[Parting, ...]

    def headline(self) -> str:
        """Give one line."""
        first, second = self.names
        count = len(self.differences)
        told = f"{count or 'no'} difference{'' if count == 1 else 's'}"
        left = f"; {self.left_out} cases only one of them can run" if self.left_out else ""
        return f"{first} against {second} by the quick suite of {self.device}: {told}{left}."

    def sheets(self) -> tuple[Sheet, ...]:
        """Give a table of all differences."""
        rows = tuple(
            (p.case, p.stimuli[-1] if p.stimuli else "power on", *p.answers, p.cases)
            for p in self.differences
        )
        columns = ("shortest case", "last stimulus", *self.names, "cases")
        title = "answers that are not the same, times and counters left out"
        return (Sheet("devices", title, columns, rows),) if rows else ()

    def as_data(self) -> dict[str, object]:
        """Give all for JSON."""
        return {
            "devices": list(self.names),
            "text": self.device,
            "cases_alike": self.alike,
            "cases_left_out": self.left_out,
            "answers": [
                {
                    "case": p.case,
                    "stimuli": list(p.stimuli),
                    "answers": list(p.answers),
                    "cases": p.cases,
                }
                for p in self.differences
            ],
        }

    def markdown(self) -> str:
        """Give the differences as a list, each with its stimuli."""
        parts = [f"# {self.names[0]} against {self.names[1]}", self.headline()]
        for p in self.differences:
            steps = "\n".join(f"1. {stimulus}" for stimulus in p.stimuli)
            answers = "\n".join(
                f"- {name}: {answer}" for name, answer in zip(self.names, p.answers, strict=True)
            )
            parts.append(f"## {p.case}\n\n{steps}\n\n{answers}")
        return "\n\n".join(parts) + "\n"


def compare_devices(device: str, duts: tuple[str, str]) -> Parted:
    """Run the quick suite of a text on two devices and compare what they show.

    Raises:
        UserError: There is no such text, or a device cannot be reached.

    """
    protocol = load(device)
    adapters: list[Adapter] = []
    try:
        adapters.extend(open_adapter(dut, device) for dut in duts)
        names = (f"{duts[0]} (X)", f"{duts[1]} (Y)") if duts[0] == duts[1] else duts
        executors = [CaseExecutor(Model(protocol), a, a.describe()) for a in adapters]
        limits = _common([limits_of(adapter.describe()) for adapter in adapters])
        cases = all_cases(Model(protocol), limits, _DEPTH)
        return _compared(names, protocol.name, (executors[0], executors[1]), cases)
    except AdapterError as error:
        raise UserError(str(error)) from None
    finally:
        for adapter in adapters:
            adapter.close()


def _common(both: list[Limits]) -> Limits:
    """Give the limits that cases for both devices keep to."""
    initiate = [one.initiate_data for one in both if one.initiate_data is not None]
    segment = [one.segment_data for one in both if one.segment_data is not None]
    without = frozenset().union(*(one.without for one in both))
    return Limits(min(initiate, default=None), min(segment, default=None), without)


def _compared(
    names: tuple[str, str],
    device: str,
    executors: tuple[CaseExecutor, CaseExecutor],
    cases: Iterable[Case],
) -> Parted:
    found: dict[tuple[str, str, str], Parting] = {}
    alike = left_out = 0
    for case in cases:
        verdicts = [executor.judge(case) for executor in executors]
        if any(verdict.outcome in {Outcome.SKIPPED, Outcome.ERROR} for verdict in verdicts):
            left_out += 1
            continue
        parting = _parting(case.name, *(tuple(executor.session.trace) for executor in executors))
        if parting is None:
            alike += 1
            continue
        key = (parting.stimuli[-1] if parting.stimuli else "", *parting.answers)
        known = found.get(key)
        count = 1 if known is None else known.cases + 1
        shorter = known is None or len(parting.stimuli) < len(known.stimuli)
        best = parting if shorter or known is None else known
        found[key] = Parting(best.case, best.stimuli, best.answers, count)
    ordered = sorted(found.values(), key=lambda p: (len(p.stimuli), p.case))
    return Parted(names, device, alike, left_out, tuple(ordered))


def _parting(
    case: str, first: tuple[TraceLine, ...], second: tuple[TraceLine, ...]
) -> Parting | None:
    """Give the first place where two traces part; None: they are the same."""
    said: list[str] = []
    for one, other in zip_longest(_turns(first), _turns(second)):
        stimulus = (one or other or ("", ""))[0]
        if stimulus:
            said.append(stimulus)
        answers = tuple(_NOTHING if turn is None else turn[1] for turn in (one, other))
        if answers[0] != answers[1]:
            return Parting(case, tuple(said), (answers[0], answers[1]), 1)
        if one is not None and other is not None and one[0] != other[0]:
            return None  # what they answered before led the MainDevice on otherwise
    return None


def _turns(trace: tuple[TraceLine, ...]) -> Iterator[tuple[str, str]]:
    """Yield each stimulus with all that is answered to it, the first for what power-on shows."""
    stimulus, answers = "", list[str]()
    for line in trace:
        what = _COUNTER.sub("", line.what)
        if line.who == _SAYS:
            yield stimulus, "; ".join(answers) or _NOTHING
            stimulus, answers = what, []
        elif line.who == "SubDevice":
            answers.append(what)
    yield stimulus, "; ".join(answers) or _NOTHING
