"""Counts and reports the fates of mutants."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from ecatspec.conformance.render.tables import Sheet
from ecatspec.generators.mutation.mutants import Operator

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.conformance.render.tables import Cell
    from ecatspec.generators.complete.faults import Kills
    from ecatspec.generators.mutation.mutants import Mutant


class Fate(StrEnum):
    """What became of a mutant; the words are those of the report."""

    KILLED = "killed"
    EQUIVALENT = "does the same, as proved"
    TOLERATED = "answers otherwise, as the texts allow"
    UNNOTICED = "answers the same in every case"


@dataclass(frozen=True, slots=True)
class Fated:
    """A mutant and what became of it; the case that showed it and the clauses cited there."""

    mutant: Mutant
    fate: Fate
    case: str = ""
    clauses: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TableKills:
    """The single faults of a finite machine, and how many of them its complete suite kills."""

    name: str
    states: int
    inputs: int
    guarantee: str
    kills: Kills


@dataclass(frozen=True, slots=True)
class Analysis:
    """The mutants of the texts of a device and what became of them, in the order of the texts."""

    device: str
    depth: str
    cases: int
    tables: tuple[TableKills, ...]
    fated: tuple[Fated, ...]

    def count(self, fate: Fate, operator: Operator | None = None) -> int:
        """Count the mutants of one fate, of all operators or of one."""
        return sum(
            each.fate is fate and operator in {None, each.mutant.operator} for each in self.fated
        )

    def score(self, operator: Operator | None = None) -> float:
        """Give the share of killed mutants of those that show something that the texts forbid.

        What answers as the device does in every case counts against it, unless the finite machines
        are the same or the solver proves that it does the same.
        """
        killed = self.count(Fate.KILLED, operator)
        lost = self.count(Fate.UNNOTICED, operator)
        return killed / (killed + lost) if killed + lost else 1.0

    def sheets(self) -> Iterator[Sheet]:
        """Yield the tables of the report."""
        yield Sheet(
            "tables",
            "single faults of the finite machines",
            ("machine", "states", "inputs", "suite", "faults", "equivalent", "killed", "score"),
            tuple(
                (
                    table.name,
                    table.states,
                    table.inputs,
                    table.guarantee,
                    table.kills.faults,
                    table.kills.equivalent,
                    table.kills.killed,
                    _percent(table.kills.score),
                )
                for table in self.tables
            ),
        )
        rows = [(operator.value, self._row(operator)) for operator in Operator]
        rows.append(("all", self._row(None)))
        yield Sheet(
            "mutants",
            f"mutants of the texts, {self.cases} cases of depth {self.depth}",
            ("mistake", "mutants", *(fate.value for fate in Fate), "score"),
            tuple((name, *row) for name, row in rows),
        )

    def _row(self, operator: Operator | None) -> tuple[Cell, ...]:
        counts = [self.count(fate, operator) for fate in Fate]
        return (sum(counts), *counts, _percent(self.score(operator)))

    def survivors(self) -> Iterator[str]:
        """Yield a line for every mutant that no case noticed, and nothing proved equivalent."""
        for each in self.fated:
            if each.fate is Fate.UNNOTICED:
                yield f"{each.mutant.at}: {each.mutant}"

    def to_json(self) -> dict[str, object]:
        """Give the analysis as data."""
        return {
            "device": self.device,
            "depth": self.depth,
            "cases": self.cases,
            "score": round(self.score(), 4),
            "tables": [
                {
                    "machine": table.name,
                    "states": table.states,
                    "inputs": table.inputs,
                    "guarantee": table.guarantee,
                    "faults": table.kills.faults,
                    "equivalent": table.kills.equivalent,
                    "killed": table.kills.killed,
                }
                for table in self.tables
            ],
            "mutants": [
                {
                    "place": each.mutant.place,
                    "mistake": each.mutant.operator.name.lower(),
                    "before": each.mutant.before,
                    "after": each.mutant.after,
                    "at": str(each.mutant.at),
                    "fate": each.fate.name.lower(),
                    "case": each.case,
                    "clauses": list(each.clauses),
                }
                for each in self.fated
            ],
        }


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
