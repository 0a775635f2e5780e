"""Explores two devices side by side, and finds where their answers differ.

The product of their machines is searched breadth first, so that each difference has the shortest
stimuli from power-on. What both texts leave to the device is no difference as long as one answer
is allowed on either side.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING

from ecatspec.conformance.diff.machines import AL, BOTH, DRIVE, SDO, Seen, otherwise, owner
from ecatspec.generators.cases.case import Case, StopOutputs, WriteOutputs
from ecatspec.generators.mutation.mutants import definitions_in
from ecatspec.model.analysis.fact_diff import Effect
from ecatspec.model.analysis.facts import Section
from ecatspec.model.automata.mealy import alike
from ecatspec.model.core.compiled import rows_of
from ecatspec.model.core.interpreter import rule_clauses
from ecatspec.model.core.memo import once
from ecatspec.model.core.values import Pattern, admits, compatible
from ecatspec.spec.language.ir import Name
from ecatspec.spec.language.nodes import nodes_in

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ecatspec.conformance.diff.machines import Explored, ObservedDevice
    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.automata.mealy import Word
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName
    from ecatspec.model.core.values import Value

SECTIONS = {AL: Section.AL, DRIVE: Section.DRIVE, BOTH: Section.DRIVE, SDO: Section.MAILBOX}
_REQUESTS = ("request_", "acknowledge_")


class Grade(IntEnum):
    """How the answers of two devices to one input go together."""

    SAME = 0
    FREER = 1
    """One of them may answer in ways that the other may not, but there is a common one."""
    OTHER = 2
    """There is no answer that both may give."""


def graded(one: Seen, other: Seen) -> tuple[Grade, tuple[str, ...]]:
    """Compare what two devices may show: the worst grade, and the parts that are not the same.

    A part of which only one device says something is not compared, but for whole answers.
    """
    first = {part.name: part.value for part in one.parts}
    second = {part.name: part.value for part in other.parts}
    found: dict[str, Grade] = {}
    for name in dict.fromkeys((*first, *second)):
        if name in first and name in second:
            found[name] = _grade(first[name], second[name])
        elif name.startswith("answer") and name.count(" ") == 1:
            found[name] = Grade.OTHER
    odd = tuple(name for name, grade in found.items() if grade)
    return max(found.values(), default=Grade.SAME), odd


def _grade(one: Value, other: Value) -> Grade:
    if one == other:
        return Grade.SAME
    match one, other:
        case Pattern(), Pattern():
            common = compatible(one, other)
        case Pattern(), _:
            common = admits(one, other)
        case _:
            common = admits(other, one)
    return Grade.FREER if common else Grade.OTHER


# --- the product ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Met:
    """One transition of the product that is not the same; `word` ends with its input."""

    word: Word
    seen: tuple[Seen, Seen]
    grade: Grade
    odd: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Product:
    """What the search of two machines came to: pairs of states that were reached, and all odd ones.

    Behind an answer that is another nothing is looked at.
    """

    pairs: int
    met: tuple[Met, ...]


def product(first: Explored, second: Explored) -> Product:
    """Search the product of two machines with the same inputs, shortest words first."""
    left, right = first.machine, alike(first.machine, second.machine)
    width = len(left.inputs)
    grades: dict[tuple[int, int], tuple[Grade, tuple[str, ...]]] = {}
    begin = (left.initial, right.initial)
    came: dict[tuple[int, int], tuple[tuple[int, int], int]] = {}
    known = {begin}
    work = [begin]
    found: list[Met] = []
    for pair in work:
        one, other = pair[0] * width, pair[1] * width
        for symbol in range(width):
            answers = left.out[one + symbol], right.out[other + symbol]
            if answers not in grades:
                seen = _seen(first, second, answers[0], right.outputs[answers[1]])
                grades[answers] = graded(*seen)
            grade, odd = grades[answers]
            if grade:
                seen = _seen(first, second, answers[0], right.outputs[answers[1]])
                found.append(Met((*_way(came, pair), symbol), seen, grade, odd))
            target = left.next[one + symbol], right.next[other + symbol]
            if grade is not Grade.OTHER and target not in known:
                known.add(target)
                came[target] = (pair, symbol)
                work.append(target)
    return Product(len(known), tuple(found))


def _seen(first: Explored, second: Explored, one: int, other: str) -> tuple[Seen, Seen]:
    return first.seen[first.machine.outputs[one]], second.seen[other]


def _way(
    came: Mapping[tuple[int, int], tuple[tuple[int, int], int]], pair: tuple[int, int]
) -> Word:
    found: list[int] = []
    while pair in came:
        pair, symbol = came[pair]
        found.append(symbol)
    return tuple(reversed(found))


# --- what it is about -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Behaviour:
    """One difference in what two devices do, with its shortest witness; pairs are of both sides.

    `inputs` are those of the witness by name. `rules` fired for its last input, `roots` are those
    on the way to it that the texts have otherwise; `clauses` are cited by either. `transitions`
    says at how many places of the product it shows. `freer`: one side may also answer as the
    other does. `depends` has open choices and conditions by which one of them could answer like
    the other.
    """

    section: Section
    machine: str
    inputs: tuple[str, ...]
    answers: tuple[str, str]
    rules: tuple[tuple[str, ...], tuple[str, ...]]
    roots: tuple[tuple[str, ...], tuple[str, ...]]
    clauses: tuple[tuple[str, ...], tuple[str, ...]]
    effect: Effect
    freer: bool
    depends: tuple[str, ...]
    transitions: int
    seen: tuple[Seen, Seen] = field(repr=False)
    cases: tuple[Case, Case] = field(repr=False)

    @property
    def subject(self) -> str:
        """Give the last input and what comes before it."""
        return " then ".join(self.inputs)


class Sides:
    """Both devices: which of their rules say the same, and what rules depend on."""

    def __init__(
        self, devices: tuple[ObservedDevice, ObservedDevice], choices: tuple[Mapping[str, str], ...]
    ) -> None:
        """Take the devices, and how open choices are made to go on each side."""
        self.devices = devices
        self.models = (devices[0].model, devices[1].model)
        self.choices = choices

    def differs(self, rule: RuleName) -> bool:
        """Tell whether a rule, or what it speaks of, is another in the two texts."""
        one, other = (_text(model, rule) for model in self.models)
        return one != other

    def behaviours(
        self, pair: tuple[Explored, Explored], found: Product, known: set[object]
    ) -> Iterator[Behaviour]:
        """Yield each difference once; `known` are those told already, and it is added to."""
        groups: dict[object, list[Met]] = {}
        for met in found.met:
            if met.grade is Grade.FREER and not any(seen.decided for seen in met.seen):
                continue  # what was left free before still shows
            parts = tuple(
                tuple((p.name, p.value) for p in seen.parts if p.name in met.odd)
                for seen in met.seen
            )
            rules = tuple(self._deciding(met, side) for side in (0, 1))
            groups.setdefault((rules, parts if not any(rules) else met.grade), []).append(met)
        for key, members in groups.items():
            if key not in known:
                known.add(key)
                yield self._behaviour(pair, members)

    def _deciding(self, met: Met, side: int) -> tuple[RuleName, ...]:
        """Give the rules of the last step without those that say the same and fired on both.

        Of them those count of the machines that what is shown belongs to, if there are any.
        """
        own, others = met.seen[side].rules, met.seen[1 - side].rules
        odd = tuple(rule for rule in own if rule not in others or self.differs(rule))
        machines = {owner(name) for name in met.odd}
        return tuple(rule for rule in odd if rule.machine in machines) or odd

    def _behaviour(self, pair: tuple[Explored, Explored], members: list[Met]) -> Behaviour:
        met = members[0]
        last = tuple(self._deciding(met, side) or met.seen[side].rules for side in (0, 1))
        roots = tuple(
            tuple(rule for rule in _fired(explored, pair[0], met) if self.differs(rule))
            for explored in pair
        )
        clauses = tuple(self._clauses(side, (*last[side], *roots[side])) for side in (0, 1))
        name = pair[0].setup.name
        inputs = pair[0].machine.names(met.word)
        effect = _effect(met, asked=name == SDO or inputs[-1].startswith(_REQUESTS))
        depends: tuple[str, ...] = ()
        if met.grade is Grade.OTHER:
            sides = [side for side in (0, 1) if self._could(side, pair[side], inputs, met)]
            depends = tuple(name for side in sides for name in self._depends(side, last[side]))
            if sides and effect is Effect.BREAKS:
                effect = Effect.MAY
        answers = (met.seen[0].words(), met.seen[1].words())
        if answers[0] == answers[1]:
            answers = (_parts(met, 0), _parts(met, 1))
        return Behaviour(
            SECTIONS[name],
            name,
            inputs,
            answers,
            (_names(last[0]), _names(last[1])),
            (_names(roots[0]), _names(roots[1])),
            (clauses[0], clauses[1]),
            effect,
            met.grade is Grade.FREER,
            tuple(dict.fromkeys(depends)),
            len(members),
            met.seen,
            (_case(pair[0], inputs), _case(pair[1], inputs)),
        )

    def _could(self, side: int, own: Explored, inputs: tuple[str, ...], met: Met) -> bool:
        """Tell whether a device could also answer as the other one does, going otherwise."""
        ways = otherwise(self.devices[side], own.setup, self.choices[side], inputs)
        return any(graded(way, met.seen[1 - side])[0] is not Grade.OTHER for way in ways)

    def _clauses(self, side: int, rules: Iterable[RuleName]) -> tuple[str, ...]:
        model = self.models[side]
        return tuple(dict.fromkeys(c for rule in rules for c in rule_clauses(model, rule)))

    def _depends(self, side: int, rules: Iterable[RuleName]) -> Iterator[str]:
        """Yield open choices and conditions that rules of a side ask for."""
        protocol = self.models[side].protocol
        settled = {*protocol.pins, *self.choices[side]}
        for rule in rules:
            text = _text(self.models[side], rule)
            for name in () if text is None else sorted(text.names):
                if name in protocol.conditions:
                    yield f"condition {name}"
                elif name in protocol.choices and name not in settled:
                    yield f"choice {name}"


@dataclass(frozen=True, slots=True)
class _Text:
    """A rule without its clauses, with all definitions that it speaks of, and names in these."""

    rule: object
    definitions: tuple[object, ...]
    names: frozenset[str] = field(compare=False)


@once
def _text(model: Model, name: RuleName) -> _Text | None:
    """Give what a rule says; None: there is no such rule."""
    protocol = model.protocol
    machine = protocol.machines.get(name.machine)
    rows = () if machine is None else rows_of(machine)
    rule = next((row for row in rows if row.name == name.name), None)
    if rule is None:
        return None
    used = sorted(definitions_in(protocol, rule))
    values = tuple(protocol.definitions[name].value for name in used)
    names = (name for node in (rule, *values) for name in _named(node))
    return _Text(replace(rule, clauses=()), tuple(zip(used, values, strict=True)), frozenset(names))


def _named(node: object) -> Iterator[str]:
    yield from (part.path for part in nodes_in(node) if isinstance(part, Name))


def _effect(met: Met, *, asked: bool) -> Effect:
    """Judge a transition; `asked`: its input is a request, which may be refused."""
    one, other = met.seen
    if met.grade is Grade.FREER:
        narrower = all(
            isinstance(value, Pattern) and not isinstance(now, Pattern)
            for value, now in _values(met)
        )
        return Effect.HARMLESS if narrower else Effect.MAY
    if one.refused and not other.refused:
        return Effect.HARMLESS if asked else Effect.MAY
    return Effect.BREAKS


def _values(met: Met) -> Iterator[tuple[Value, Value]]:
    first, second = ({part.name: part.value for part in seen.parts} for seen in met.seen)
    yield from ((first[name], second[name]) for name in met.odd)


def _parts(met: Met, side: int) -> str:
    """Give what is not the same where the words are: bits that no word stands for."""
    values = {part.name: part.value for part in met.seen[side].parts}
    told = (f"{name} {values[name]!r}" for name in met.odd if name in values)
    return f"{met.seen[side].words()}, {', '.join(told)}"


def _names(rules: Iterable[RuleName]) -> tuple[str, ...]:
    return tuple(map(str, rules))


def _fired(explored: Explored, first: Explored, met: Met) -> Iterator[RuleName]:
    """Yield the rules that fire along a word, which is in the inputs of the first machine."""
    machine = explored.machine
    word = machine.word(first.machine.names(met.word))
    for output in machine.run(word):
        yield from explored.seen[machine.outputs[output]].rules


def _case(explored: Explored, inputs: tuple[str, ...]) -> Case:
    setup = explored.setup
    given = (*setup.prelude, *(s for name in inputs for s in setup.alphabet[name]))
    stimuli = tuple(_written_on(given))
    name = f"diff/{setup.name}/{'/'.join(inputs)}"
    title = f"{inputs[-1]} after {', '.join(inputs[:-1]) or 'nothing'}"
    return Case(name, title, "diff", stimuli)


def _written_on(given: Iterable[Stimulus]) -> Iterator[Stimulus]:
    """Yield stimuli with the process data written on before each, as they were when it was found.

    A MainDevice writes them cyclically; how often before a request comes decides what it meets.
    """
    writes = False
    for stimulus in given:
        if isinstance(stimulus, WriteOutputs):
            writes = True
        elif isinstance(stimulus, StopOutputs):
            writes = False
        elif writes:
            yield WriteOutputs()
        yield stimulus
