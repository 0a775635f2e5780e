"""Compares the facts of two protocols, and judges the differences.

A fact that one side does not state is no difference: it is listed apart, as not comparable.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from ecatspec.model.analysis.facts import Fact, Kind, Section, facts

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ecatspec.model.analysis.facts import Key
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import Anomaly, Protocol

_REAL = "true difference"
"""So begins the treatment of an anomaly that is none: devices differ as printed."""
_GAP = ("gap", "left", "known by omission")
"""So begins the treatment of something that a manual does not say."""

_NUMBER = re.compile(r"0x[0-9A-Fa-f]+|[0-9]+")
_NUMBERED = re.compile(r" (?:bit )?(0x[0-9A-Fa-f]+|[0-9]+)(?:[. ]|$)")
"""The number of a bit, or of a row of a table, in a subject."""


class Effect(StrEnum):
    """What a difference does to a MainDevice written for the first device that meets the second."""

    BREAKS = "breaks"
    """The second gives what the first never gives, or refuses what the first takes."""
    MAY = "may break"
    """It depends on what the MainDevice builds on."""
    HARMLESS = "does not break"


@dataclass(frozen=True, slots=True)
class Difference:
    """One fact that is another on the two sides; values and clauses are those of both.

    `anomalies` are those that the clauses have to do with. `misprint`: what stands there comes
    from how a misprint was read, so that the devices themselves may be alike.
    """

    section: Section
    subject: str
    values: tuple[str, str]
    clauses: tuple[tuple[str, ...], tuple[str, ...]]
    effect: Effect
    anomalies: tuple[str, ...] = ()
    misprint: bool = False


@dataclass(frozen=True, slots=True)
class Silence:
    """What cannot be compared, as a text of one side leaves it open."""

    section: Section
    subject: str
    values: tuple[str, str]


@dataclass(frozen=True, slots=True)
class Misprint:
    """An anomaly of the manuals that the devices do not differ by: as printed on both sides.

    `printed` is empty where that manual does not have it.
    """

    id: str
    subject: str
    printed: tuple[str, str]
    read_as: str

    @property
    def shared(self) -> bool:
        """Tell whether both manuals have it."""
        return all(self.printed)


@dataclass(frozen=True, slots=True)
class Compared:
    """What the facts of two protocols have come to."""

    differences: tuple[Difference, ...]
    silences: tuple[Silence, ...]
    misprints: tuple[Misprint, ...]


SILENT = "(not stated)"
NONE = "(not there)"


def compare_facts(first: Model, second: Model, standard: Model) -> Compared:
    """Compare all facts of two protocols; the standard tells what their texts say themselves."""
    differences, silences = _Table(first, second, standard).run()
    protocols = (first.protocol, second.protocol)
    told, misprints = _anomalies(*protocols)
    return Compared((*differences, *told), (*silences, *_open(*protocols)), misprints)


class _Table:
    """The facts of both sides, and of the standard."""

    def __init__(self, first: Model, second: Model, standard: Model) -> None:
        self.protocols = (first.protocol, second.protocol)
        self.facts = (facts(first), facts(second))
        self.standard = facts(standard)

    def run(self) -> tuple[list[Difference], list[Silence]]:
        differences: list[Difference] = []
        silences: list[Silence] = []
        first, second = self.facts
        for key in dict.fromkeys((*first, *second)):
            if key[0] is Section.SERVICES and not self._both_or_table(key):
                continue  # a choice: see `_open`
            found = self._compare(first.get(key), second.get(key))
            if isinstance(found, Difference):
                differences.append(found)
            elif found is not None:
                silences.append(found)
        return differences, silences

    def _both_or_table(self, key: Key) -> bool:
        present = [own[key] for own in self.facts if key in own]
        return len(present) == len(self.facts) or bool(present[0].within or present[0].whole)

    def _compare(self, one: Fact | None, other: Fact | None) -> Difference | Silence | None:
        if one is None or other is None:
            return self._missing(one, other)
        if one.value == other.value:
            return None
        if not (self._states(0, one) and self._states(1, other)):
            values = tuple(
                fact.words if self._states(side, fact) else SILENT
                for side, fact in enumerate((one, other))
            )
            return Silence(one.section, one.subject, (values[0], values[1]))
        values = (one.words, other.words)
        return self._difference((one, other), values, (one.clauses, other.clauses))

    def _missing(self, one: Fact | None, other: Fact | None) -> Difference | Silence | None:
        side = 0 if one is None else 1
        fact = other if one is None else one
        assert fact is not None
        around = self._around(side, fact)
        if fact.within and around is None:
            return None  # what contains it is missing too, which is told once
        if not self._states(1 - side, fact):
            return None
        if around is None or not self._is_whole(around):
            values = (SILENT, fact.words) if side == 0 else (fact.words, SILENT)
            return Silence(fact.section, fact.subject, values)
        values = (NONE, fact.words) if side == 0 else (fact.words, NONE)
        clauses = (around.clauses, fact.clauses) if side == 0 else (fact.clauses, around.clauses)
        return self._difference((one, other), values, clauses)

    def _around(self, side: int, fact: Fact) -> Fact | None:
        own = self.facts[side]
        return own.get((fact.section, fact.within)) or own.get((Section.OBJECTS, fact.within))

    def _is_whole(self, fact: Fact) -> bool:
        return fact.whole or (fact.own_list and fact.key not in self.standard)

    def _states(self, side: int, fact: Fact) -> bool:
        """Tell whether the text of a side says this itself, and not as one possibility of many."""
        protocol = self.protocols[side]
        if not protocol.manuals:
            return True
        if fact.example:
            return False
        if any(protocol.clauses[clause].claims for clause in fact.clauses):
            return True
        usual = self.standard.get(fact.key)
        return usual is None or usual.value != fact.value

    def _difference(
        self,
        pair: tuple[Fact | None, Fact | None],
        values: tuple[str, str],
        clauses: tuple[tuple[str, ...], tuple[str, ...]],
    ) -> Difference:
        fact = pair[0] or pair[1]
        assert fact is not None
        cited = [
            anomaly
            for protocol, own in zip(self.protocols, clauses, strict=True)
            for anomaly in protocol.anomalies
            if set(anomaly.clauses) & set(own)
        ]
        names = {each.name for each in pair if each is not None}
        about = [a for a in cited if a.subject in names and _names(a, fact.subject)]
        return Difference(
            fact.section,
            fact.subject,
            values,
            clauses,
            judged(*pair),
            tuple(dict.fromkeys(anomaly.id for anomaly in about)),
            misprint=bool(about) and all(map(_is_misprint, about)),
        )


def judged(one: Fact | None, other: Fact | None) -> Effect:
    """Tell what a fact that is another does to a MainDevice that knows the first device."""
    match one, other:
        case Fact(), Fact():
            return _changed(one, other)
        case Fact(kind=kind), None:
            bad = kind in {Kind.FIXED, Kind.MORE}
        case None, Fact(kind=kind):
            bad = kind is Kind.ANSWER
        case _:
            raise ValueError("there is no fact on either side")
    if kind is Kind.NOTE:
        return Effect.MAY
    return Effect.BREAKS if bad else Effect.HARMLESS


def _changed(one: Fact, other: Fact) -> Effect:
    match other.kind:
        case Kind.MORE:
            good = one.members <= other.members and one.amount <= other.amount
            return Effect.HARMLESS if good else Effect.BREAKS
        case Kind.LESS:
            return Effect.HARMLESS if other.amount <= one.amount else Effect.MAY
        case Kind.NOTE:
            return Effect.MAY
        case _:
            return Effect.BREAKS


# --- what is left open ----------------------------------------------------------------------------


def _open(first: Protocol, second: Protocol) -> Iterator[Silence]:
    """Yield choices that one side decides and the other leaves open, and gaps of one side."""
    for name, choice in (first.choices | second.choices).items():
        ways = [_way(protocol, name) for protocol in (first, second)]
        if ways.count("open") == 1:
            subject = f"{name} ({choice.wording})"
            yield Silence(Section.SERVICES, subject, (ways[0], ways[1]))
    gaps = [
        {f"{m.name}.{gap.name}" for m in p.machines.values() for gap in m.gaps}
        for p in (first, second)
    ]
    for name in sorted(gaps[0] ^ gaps[1]):
        values = ("nothing is specified", "by rules")
        values = values if name in gaps[0] else (values[1], values[0])
        yield Silence(_section_of(name), name, values)


def _way(protocol: Protocol, choice: str) -> str:
    if choice not in protocol.choices:
        return NONE
    pin = protocol.pins.get(choice)
    return "open" if pin is None else pin.alternative


def _section_of(name: str) -> Section:
    known = {"al": Section.AL, "ds402": Section.DRIVE}
    return known.get(name.partition(".")[0], Section.MAILBOX)


# --- anomalies ------------------------------------------------------------------------------------


def _names(anomaly: Anomaly, subject: str) -> bool:
    """Tell whether an anomaly speaks of this bit or row, where the subject is one."""
    number = _NUMBERED.search(subject)
    if number is None:
        return True
    said = _NUMBER.findall(f"{anomaly.printed} {anomaly.normative}")
    return int(number[1], 0) in {int(each, 16 if "x" in each else 10) for each in said}


def _is_misprint(anomaly: Anomaly) -> bool:
    return not anomaly.treatment.startswith((_REAL, *_GAP))


def _anomalies(
    first: Protocol, second: Protocol
) -> tuple[tuple[Difference, ...], tuple[Misprint, ...]]:
    """Give what both manuals say otherwise and truly mean, and what is misprinted only."""
    sides: tuple[Mapping[str, Anomaly], ...] = tuple(
        {anomaly.id: anomaly for anomaly in protocol.anomalies} for protocol in (first, second)
    )
    differences: list[Difference] = []
    misprints: list[Misprint] = []
    for name in dict.fromkeys((*sides[0], *sides[1])):
        pair = [side.get(name) for side in sides]
        known = [anomaly for anomaly in pair if anomaly is not None]
        printed = tuple("" if anomaly is None else anomaly.printed for anomaly in pair)
        real = any(anomaly.treatment.startswith(_REAL) for anomaly in known)
        if real and all(printed) and printed[0] != printed[1]:
            one, other = known
            differences.append(
                Difference(
                    Section.ANOMALIES,
                    f"{name}: {' / '.join(sorted({one.subject, other.subject}))}",
                    (one.printed, other.printed),
                    (one.clauses, other.clauses),
                    Effect.MAY,
                    (name,),
                )
            )
        elif not real and any(map(_is_misprint, known)):
            misprints.append(_misprint(name, known, (printed[0], printed[1])))
    return tuple(differences), tuple(misprints)


def _misprint(name: str, known: Iterable[Anomaly], printed: tuple[str, str]) -> Misprint:
    first = next(iter(known))
    return Misprint(name, first.subject, printed, first.normative)
