"""Decides which clause an observation broke.

It starts from the explanations that were possible before the observation and takes the nearest:
the device has served its requests, and the fewest fields differ. The source of the demand on these
fields (a layout, an entry of the object dictionary, a rule) gives the clauses: those of a device
before those of the standard, specific ones before general ones. A `may` clause is never broken.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from ecatspec.model.analysis.citations import object_name
from ecatspec.model.core.compiled import paths_in, rows_of
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.interpreter import row_of, rule_clauses
from ecatspec.model.core.memo import once
from ecatspec.spec.language.ir import Binary, Bytes, Level, Name, Unary
from ecatspec.spec.language.nodes import names_in
from ecatspec.spec.language.scope import Scope

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName, State
    from ecatspec.model.core.values import Value
    from ecatspec.model.oracle.explanations import Candidate
    from ecatspec.spec.language.ir import Expression, ObjectEntry

_ANSWERED: Final = "response_timeout"
"""The parameter whose clauses say that there is an answer, and by when."""
_FAR: Final = 100
"""Something else altogether: more than any number of fields."""
_VALUE: Final = "value"
_TELLING: Final = frozenset({_VALUE, "code"})
"""The fields that tell by which rule a device went."""
_WEAKER: Final[Mapping[Level, int]] = MappingProxyType({Level.MUST: 0, Level.SHOULD: 1})
"""How much less a level demands than `must`; all others demand nothing of a device."""
_MUCH: Final = 8
"""Rules: a clause that more of them cite speaks of much."""
_WAYS: Final = (True, False)


@dataclass(frozen=True, slots=True)
class Alternative:
    """One explanation that the observation was not: the rules that led there, and what differs."""

    candidate: Candidate
    rules: tuple[RuleName, ...]
    """Those of one machine, or that led to a reply, the last one last."""
    fields: tuple[str, ...] = ()
    """The fields that are not as expected; none: it is something else altogether."""
    layout: str = ""
    """The frame, register or word that these fields are of."""
    entry: ObjectEntry | None = None
    """The entry that a reply speaks of."""
    asked: tuple[tuple[str, Value], ...] = ()
    """What the last rule was given."""
    resized: bool = False
    """A value has another length than expected."""
    silent: bool = False
    """Nothing was observed where an answer was due."""
    blank: bool = False
    """The fields that differ were left at 0."""
    stuck: bool = False
    """What was observed is what the device showed before the last rule."""
    alien: bool = False
    """What was observed is no answer to this at all, or no value that the field can have."""
    refusing: bool = False
    """A refusal is due, and an answer was observed."""
    sized: bool = False
    """The length of the value follows from what its entry holds, which is known."""


@dataclass(frozen=True, slots=True)
class Blame:
    """What was broken: by whom it is demanded, and the clauses, the broken one first."""

    demand: str
    """What of a kind shares a cause: an entry, a field that has clauses of its own, a clause."""
    rules: tuple[RuleName, ...]
    clauses: tuple[str, ...]
    nearest: tuple[Alternative, ...]
    by_rule: bool
    """It is a rule that demands it, not a layout or an entry."""

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that differ; none: it was something else altogether."""
        return self.nearest[0].fields


def blame(model: Model, alternatives: Iterable[Alternative]) -> Blame | None:
    """Give what was broken; None where nothing was expected."""
    found = sorted(alternatives, key=partial(_distance, model))
    if not found:
        return None
    least = _distance(model, found[0])
    nearest = [each for each in found if _distance(model, each) == least]
    demand, own = _demanded(model, nearest[0])
    clauses = dict.fromkeys(own)
    for group in (nearest, found):
        # what each of them cites first comes before what one of them cites next
        rows = zip_longest(*(_ranked(model, each) for each in group))
        clauses |= dict.fromkeys(clause for row in rows for clause in row if clause)
    ordered = strongest_first(model, clauses)
    rules = tuple(dict.fromkeys(rule for each in nearest for rule in each.rules[-1:]))
    told = demand or next(iter(ordered), nearest[0].layout)
    return Blame(told, rules, ordered, tuple(nearest), by_rule=not demand)


def answering(model: Model) -> tuple[str, ...]:
    """Give the clauses that demand an answer at all."""
    return model.protocol.parameters[_ANSWERED].clauses


def strongest_first(model: Model, clauses: Iterable[str]) -> tuple[str, ...]:
    """Give clauses in their order, `must` before `should`, and last what nobody can break."""
    level = {clause: model.protocol.clauses[clause].level for clause in clauses}
    return tuple(sorted(level, key=lambda clause: _WEAKER.get(level[clause], len(_WEAKER))))


def _distance(model: Model, each: Alternative) -> tuple[int, int, int]:
    """Give what is unserved, how many fields differ, and how many odd ways the device would go."""
    unserved = sum(not pending.timer for pending in each.candidate.inbox)
    return unserved, len(each.fields) or _FAR + each.refusing, _odd(model, each)


def _odd(model: Model, each: Alternative) -> int:
    """Count the conditions that are not as assumed, and the ways that are not the first."""
    protocol, slots = model.protocol, each.candidate.state.slots
    conditions = sum(
        protocol.conditions[name].assumed is not wanted
        for rule in each.rules[-1:]
        for name, wanted in _conditions(model, rule)
    )
    ways = sum(
        slots[model.slots[f"choice {name}"]] not in {None, choice.alternatives[0].name}
        for name, choice in protocol.choices.items()
        if name not in protocol.pins
    )
    return conditions + ways


def _demanded(model: Model, each: Alternative) -> tuple[str, tuple[str, ...]]:
    """Give the name of what demands what differs, and its clauses as far as they are its own."""
    entry = each.entry
    if _VALUE in each.fields and not each.resized and entry is not None and entry.constant:
        return object_name((entry.index, entry.subindex)), entry.clauses
    found = _of_layout(model, each)
    if found is not None:
        return found
    protocol = model.protocol
    if each.alien and each.layout in protocol.frames:
        return each.layout, protocol.frames[each.layout].clauses
    if each.alien and each.layout in protocol.registers:
        return each.layout, protocol.registers[each.layout].clauses
    if each.blank and len(each.fields) == 1:
        return f"{each.layout}.{each.fields[0]} 0", ()
    return "", ()


def _of_layout(model: Model, each: Alternative) -> tuple[str, tuple[str, ...]] | None:
    """Give the field that differs, where its layout has clauses for it that the rule cites too."""
    protocol = model.protocol
    sizes = sizing(model, each.layout, _VALUE) if each.sized else frozenset()
    fields = sorted(
        {_VALUE if name in sizes else name for name in each.fields},
        key=lambda name: (name != _VALUE, name),
    )
    if each.layout in protocol.frames:
        entry = each.entry
        known = entry is not None and (entry.index, entry.subindex) in each.candidate.state.objects
        cited = {
            clause
            for rule in each.rules[-1:]
            for clause in rule_clauses(model, rule)
            if _at_home(model, rule, clause) or _is_own(model, rule) or known
        }
        for name in fields:
            for frame in model.codec.trail(each.layout):
                items = {item.name: item for item in protocol.frames[frame].fields}
                item = items.get(name)
                if item is not None and each.resized:
                    sized = (items[n] for n in items if n in sizing(model, frame, name))
                    item = next((other for other in sized if other.clauses), item)
                if item is None or not item.clauses:
                    continue
                if frame != each.layout or cited.intersection(item.clauses):
                    return f"{frame}.{item.name}", item.clauses
        return None
    holder = protocol.words.get(each.layout) or protocol.registers.get(each.layout)
    for bits in () if holder is None else holder.fields:
        if bits.name in fields and bits.clauses:
            return f"{each.layout}.{bits.name}", bits.clauses
    return None


@once
def sizing(model: Model, layout: str, name: str) -> frozenset[str]:
    """Give the fields of a frame that say how long another field of it is."""
    for frame in model.codec.trail(layout):
        for item in model.protocol.frames[frame].fields:
            if item.name == name and isinstance(item.type, Bytes) and item.type.length is not None:
                return frozenset(names_in(item.type.length))
    return frozenset()


def _ranked(model: Model, each: Alternative) -> tuple[str, ...]:
    """Give the clauses of the rules that led there, the most telling first."""
    told: dict[str, None] = {}
    for rule in reversed(each.rules):
        clauses = rule_clauses(model, rule)
        told |= dict.fromkeys(sorted(clauses, key=partial(_telling, model, each, rule)))
    return tuple(told)


def _telling(model: Model, each: Alternative, rule: RuleName, clause: str) -> tuple[int, ...]:
    """Give how little a clause of a rule tells of what was wrong."""
    asked = each.asked if rule == each.rules[-1] else ()
    decisive, idle = _decisive(model, rule, each.candidate.state, asked, each.stuck)
    filled = each.layout in model.protocol.frames and bool(each.fields)
    if filled and _TELLING.isdisjoint(each.fields):
        # it did not go otherwise: it went, and filled in what is wrong
        decisive, idle = frozenset(), frozenset()
    answers = answering(model) if each.silent else ()
    concerned = () if each.entry is None else each.entry.clauses
    shared = _entries_of(model)[clause] if clause in concerned else 0
    own = bool(model.protocol.clauses[clause].claims)
    return (
        clause not in answers,
        clause not in concerned,
        not own,
        shared,
        clause not in decisive,
        clause in idle,
        not _at_home(model, rule, clause),
        not own and _often(model)[clause] > _MUCH,
    )


@once
def _entries_of(model: Model) -> Counter[str]:
    """Count the entries that cite each clause: one that fewer cite is about them."""
    return Counter(c for entry in model.dictionary.entries.values() for c in set(entry.clauses))


@once
def _often(model: Model) -> Counter[str]:
    """Count the rules that cite each clause."""
    machines = model.protocol.machines.values()
    return Counter(c for machine in machines for row in rows_of(machine) for c in set(row.clauses))


@once
def _decisive(
    model: Model,
    rule: RuleName,
    state: State,
    asked: tuple[tuple[str, Value], ...],
    stuck: bool,  # noqa: FBT001
) -> tuple[frozenset[str], ...]:
    """Give the clauses of the definitions that let a rule fire in a state, and of the others.

    Of definitions that are made up of others it is the innermost that tell. For a device that did
    not go at all those tell that speak of a word that it did not heed.
    """
    told: dict[str, tuple[int, set[bool]]] = {}
    environment = Environment(state.slots, state.objects, dict(asked))
    for name, scope, wanted, depth in _guard_of(model, rule):
        definition = model.protocol.definitions.get(name)
        if definition is None or (stuck and not _speaks_of_word(model, name)):
            continue
        try:
            holds = model.definition(name, scope)(environment)
        except KeyError:
            continue  # it depends on what the rule was given, which is not known any more
        if isinstance(holds, bool):
            for clause in definition.clauses:
                if told.get(clause, (-1,))[0] < depth:
                    told[clause] = depth, set()
                if told[clause][0] == depth:
                    told[clause][1].add(holds is wanted)
    return tuple(frozenset(c for c, (_, ways) in told.items() if way in ways) for way in _WAYS)


@once
def _speaks_of_word(model: Model, name: str) -> bool:
    """Tell whether a definition depends on a word, such as a control word."""
    paths = paths_in(model.protocol, model.protocol.definitions[name].value)
    return any(path.partition(".")[0] in model.protocol.words for path in paths)


def _is_own(model: Model, rule: RuleName) -> bool:
    """Tell whether a device text has a rule, or a part of it."""
    return any(model.protocol.clauses[clause].claims for clause in rule_clauses(model, rule))


def _at_home(model: Model, rule: RuleName, clause: str) -> bool:
    """Tell whether a clause is of the text that has the rule; a device says only which one."""
    row, own = row_of(model, rule), model.protocol.clauses[clause]
    return row is None or own.at.file == row.at.file


@once
def _conditions(model: Model, rule: RuleName) -> tuple[tuple[str, bool], ...]:
    """Give the conditions that the guard of a rule cannot do without, and what it wants of them."""
    row = row_of(model, rule)
    guard = None if row is None else row.guard
    found = () if guard is None else tuple(_needed(model, guard, wanted=True))
    return tuple((name, wanted) for name, wanted in found if name in model.protocol.conditions)


@once
def _guard_of(model: Model, rule: RuleName) -> tuple[tuple[str, Scope, bool, int], ...]:
    """Give what the guard of a rule is made up of, whether it must hold, and how deep it lies.

    A definition comes with those that it is made up of; what the guard names itself counts first.
    """
    row = row_of(model, rule)
    if row is None or row.guard is None:
        return ()
    scope = Scope(rule.machine, row.input)
    found: dict[str, tuple[bool, int]] = {}
    depth = 0
    layer = list(_named(row.guard, wanted=True))
    while layer:
        new = {name: wanted for name, wanted in layer if name not in found}
        found |= {name: (wanted, depth) for name, wanted in new.items()}
        depth += 1
        layer = [
            each
            for name, wanted in new.items()
            if name in model.protocol.definitions
            for each in _named(model.protocol.definitions[name].value, wanted=wanted)
        ]
    return tuple((name, scope, *told) for name, told in found.items())


def _named(part: Expression, *, wanted: bool) -> Iterator[tuple[str, bool]]:
    """Yield the names that a condition is made up of, and whether it wants them to hold."""
    match part:
        case Unary("not", operand):
            yield from _named(operand, wanted=not wanted)
        case Binary("and" | "or", left, right):
            yield from _named(left, wanted=wanted)
            yield from _named(right, wanted=wanted)
        case Name(path=path):
            yield path, wanted
        case _:
            return


def _needed(model: Model, part: Expression, *, wanted: bool) -> Iterator[tuple[str, bool]]:
    """Yield those that must be so, whatever else is, down to the ground."""
    match part:
        case Unary("not", operand):
            yield from _needed(model, operand, wanted=not wanted)
        case Binary("and" | "or" as word, left, right) if (word == "and") is wanted:
            yield from _needed(model, left, wanted=wanted)
            yield from _needed(model, right, wanted=wanted)
        case Name(path=path) if path in model.protocol.definitions:
            yield from _needed(model, model.protocol.definitions[path].value, wanted=wanted)
        case Name(path=path):
            yield path, wanted
        case _:
            return
