"""Chooses what a drawing of a machine shows: its arrows, and its legend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

from ecatspec.conformance.base.devices import nearest
from ecatspec.spec.language.ir import Binary, Conditional, In, Literal, Name, Unary
from ecatspec.spec.language.pretty_expressions import pretty_expression
from ecatspec.spec.language.references import ChoiceRef, DefinitionRef, Ref, UnresolvedName
from ecatspec.spec.language.scope import Scope, resolve

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from ecatspec.spec.language.ir import Expression, Machine, Protocol, Range, Rule

Truth: TypeAlias = bool | None
"""None: unknown."""

ASIDE: Final = {
    "al": ("BOOT",),
    "ds402": ("FAULT", "FAULT_REACTION_ACTIVE"),
}
"""States that stand beside the main line, in the order in which they are drawn."""

ERRORS: Final = frozenset({"FAULT", "FAULT_REACTION_ACTIVE"})
"""States in which something has gone wrong: another colour."""

NAMES: Final = 5
"""Maximum number of rules named at an arrow; the legend lists the others."""

_EXCEPTIONS: Final = 2
"""Maximum number of names in `every state but ...`."""


@dataclass(frozen=True, slots=True)
class Arrow:
    """All rules that lead from one state to another; `number` where the legend lists them."""

    source: str
    target: str
    rules: tuple[Rule, ...]
    number: int | None = None

    def names(self, first: Collection[str] = ()) -> tuple[str, ...]:
        """Give the lines of the label, with the rules `first` before the others."""
        names = sorted((rule.name for rule in self.rules), key=lambda name: name not in first)
        if self.number is None:
            return tuple(names)
        shown = names[: NAMES - 1]
        return (*shown, f"and {len(names) - len(shown)} more: arrow {self.number}")


@dataclass(frozen=True, slots=True)
class Entry:
    """One paragraph of the legend: words, then names of rules, states or variables."""

    words: str
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Graph:
    """A machine as it is drawn: the main line from top to bottom, states beside it, arrows."""

    device: str
    machine: Machine
    line: tuple[str, ...]
    aside: tuple[str, ...]
    unreached: tuple[str, ...]
    """States to which no arrows lead from the first one."""
    arrows: tuple[Arrow, ...]
    legend: tuple[Entry, ...]
    tips: dict[str, str]
    """What is to be said about each rule and each state."""

    @property
    def title(self) -> str:
        """The heading."""
        return f"{self.device}, machine {self.machine.name}: {self.machine.wording}"

    def tip(self, arrow: Arrow) -> str:
        """Give everything about an arrow, one line for each rule."""
        ends = f"{arrow.source} to {arrow.target}"
        return "\n".join((ends, *(self.tips[rule.name] for rule in arrow.rules)))


def graph_of(protocol: Protocol, name: str) -> Graph:
    """Give what there is to draw.

    Raises:
        UserError: There is no such machine.

    """
    machine = protocol.machines.get(name)
    if machine is None:
        raise nearest("machine", name, sorted(protocol.machines))
    never = tuple(rule for rule in machine.rules if cannot_fire(protocol, machine, rule))
    alive = tuple(rule for rule in machine.rules if rule not in never)
    arrows = tuple(_arrows(machine, alive))
    unreached = tuple(_unreached(machine, arrows))
    aside = tuple(state for state in ASIDE.get(name, ()) if state in machine.states)
    line = tuple(state for state in machine.states if state not in aside)
    rows = {row.name: row for row in protocol.tables[machine.table].rows}
    tips = {rule.name: rule_words(rule) for rule in machine.rules}
    tips |= {s: f"{s} = {rows[s].value}: {rows[s].wording}" for s in machine.states if s in rows}
    return Graph(
        protocol.name,
        machine,
        line or aside,
        aside if line else (),
        unreached,
        arrows,
        tuple(_legend(machine, alive, never, arrows, unreached)),
        tips,
    )


def rule_words(rule: Rule) -> str:
    """Say on what a rule fires, and by which clauses."""
    when = "" if rule.guard is None else f" when {pretty_expression(rule.guard)}"
    return " ".join(f"{rule.name} [{', '.join(rule.clauses)}]: on {rule.input}{when}".split())


def _arrows(machine: Machine, rules: Sequence[Rule]) -> Iterator[Arrow]:
    number = 0
    for source in machine.states:
        for target in machine.states:
            found = tuple(r for r in rules if source in r.sources and r.target == target)
            if found and source != target:
                number += len(found) > NAMES
                yield Arrow(source, target, found, number if len(found) > NAMES else None)


def _unreached(machine: Machine, arrows: Sequence[Arrow]) -> Iterator[str]:
    reached: set[str] = set()
    new = {machine.initial}
    while new:
        reached |= new
        new = {arrow.target for arrow in arrows if arrow.source in reached} - reached
    return (state for state in machine.states if state not in reached)


# --- the legend -----------------------------------------------------------------------------------


def _legend(
    machine: Machine,
    alive: Sequence[Rule],
    never: Sequence[Rule],
    arrows: Sequence[Arrow],
    unreached: tuple[str, ...],
) -> Iterator[Entry]:
    moving = {rule.name for arrow in arrows for rule in arrow.rules}
    staying = [(rule, where) for rule in alive if (where := _stays(rule))]
    parts = [
        f"{len(moving)} on {_count(len(arrows), 'arrow')}",
        f"{len(staying)} that stay in a state",
        *([f"{len(never)} that cannot fire in this device"] if never else ()),
    ]
    gaps = f"Not drawn: {_count(len(machine.gaps), 'gap')}, where the texts say nothing."
    yield Entry(f"{_count(len(machine.rules), 'rule')}: {', '.join(parts)}. {gaps}")
    if machine.variables:
        names = tuple(variable.name for variable in machine.variables)
        yield Entry("Variables beside the state", names)
    for arrow in arrows:
        if arrow.number is not None:
            words = f"Arrow {arrow.number}, {arrow.source} to {arrow.target}"
            yield Entry(words, tuple(rule.name for rule in arrow.rules))
    for acts, words in ((True, "Stay and act"), (False, "Stay without effect")):
        groups: dict[tuple[str, ...], list[str]] = {}
        for rule, where in staying:
            if _acts(rule) is acts:
                groups.setdefault(where, []).append(rule.name)
        for where in sorted(groups, key=lambda states: states_place(machine, states)):
            yield Entry(f"{words} in {states_words(machine, where)}", tuple(groups[where]))
    if unreached:
        yield Entry("Never reached in this device", unreached)
    if never:
        yield Entry(
            "Cannot fire, since the device pins its choices otherwise",
            tuple(rule.name for rule in never),
        )


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _stays(rule: Rule) -> tuple[str, ...]:
    return tuple(source for source in rule.sources if rule.target in {None, source})


def _acts(rule: Rule) -> bool:
    ways = (rule.updates, rule.stores, rule.sends, rule.gives, rule.laters)
    return any(ways) or rule.take is not None or rule.after is not None


def states_place(machine: Machine, states: tuple[str, ...]) -> tuple[int, list[int]]:
    """Give where a group of states comes: the larger first, else in the order of the states."""
    return -len(states), [machine.states.index(state) for state in states]


def states_words(machine: Machine, states: tuple[str, ...]) -> str:
    """Name states in few words."""
    others = [state for state in machine.states if state not in states]
    if not others and len(states) > 1:
        return "every state"
    if len(others) <= _EXCEPTIONS < len(states):
        return f"every state but {' and '.join(others)}"
    return ", ".join(states)


# --- rules that cannot fire -----------------------------------------------------------------------


def cannot_fire(protocol: Protocol, machine: Machine, rule: Rule) -> bool:
    """Tell whether the pins of the device rule out that a rule ever fires."""
    scope = Scope(machine.name, rule.input)
    return rule.guard is not None and _holds(protocol, rule.guard, scope) is False


def _holds(protocol: Protocol, guard: Expression, scope: Scope) -> Truth:
    """Tell what the pins of the device decide of a guard; everything else is unknown."""

    def holds(part: Expression) -> Truth:
        return _holds(protocol, part, scope)

    match guard:
        case Literal(bool(value)):
            return value
        case Name(path):
            ref = _ref(protocol, path, scope)
            if isinstance(ref, DefinitionRef):
                return holds(protocol.definitions[ref.name].value)
            return None
        case Unary("not", operand):
            return _not(holds(operand))
        case Binary("and", left, right):
            return _and(holds(left), holds(right))
        case Binary("or", left, right):
            return _not(_and(_not(holds(left)), _not(holds(right))))
        case Binary("==", Name(path), right):
            return _pinned(protocol, path, (right,), scope)
        case Binary("!=", Name(path), right):
            return _not(_pinned(protocol, path, (right,), scope))
        case In(Name(path), items):
            return _pinned(protocol, path, items, scope)
        case Conditional(condition, then, otherwise):
            decided = holds(condition)
            if decided is not None:
                return holds(then if decided else otherwise)
            ways = (holds(then), holds(otherwise))
            return ways[0] if ways[0] is ways[1] else None
        case _:
            return None


def _not(truth: Truth) -> Truth:
    return None if truth is None else not truth


def _and(one: Truth, other: Truth) -> Truth:
    if one is False or other is False:
        return False
    return None if one is None or other is None else True


def _ref(protocol: Protocol, path: str, scope: Scope) -> Ref | None:
    try:
        return resolve(protocol, path, scope)
    except UnresolvedName:
        return None


def _pinned(
    protocol: Protocol, path: str, items: Sequence[Expression | Range], scope: Scope
) -> Truth:
    """Tell whether a choice goes one of the ways `items`, where the device says how it goes."""
    ref = _ref(protocol, path, scope)
    if not isinstance(ref, ChoiceRef) or ref.name not in protocol.pins:
        return None
    ways = [item.path if isinstance(item, Name) else None for item in items]
    known = {way.name for way in protocol.choices[ref.name].alternatives}
    if not known.issuperset(ways):
        return None
    return protocol.pins[ref.name].alternative in ways
