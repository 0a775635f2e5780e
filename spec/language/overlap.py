"""Checks the rules of a machine together: overlaps, dead rules and dead states.

Everything that a guard reads is a dimension with a few sample values: both truths, all ways at a
choice, the numbers that it is compared with and their neighbours. Two guards overlap if some
combination of samples makes both true. That is a search, not a proof: what it finds is real, what
it misses a solver finds.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from ecatspec.spec.language.diagnostics import Code, Diagnostic
from ecatspec.spec.language.ir import (
    STANDARD,
    Binary,
    Call,
    Extend,
    Gap,
    Remove,
    Replace,
    Unary,
)
from ecatspec.spec.language.references import (
    AlternativeRef,
    ChoiceRef,
    ConditionRef,
    ConstantRef,
    DefinitionRef,
    ParameterOfInput,
    ParameterRef,
    RegisterFieldRef,
    ReplyField,
    StateRef,
    VariableRef,
    WordFieldRef,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ecatspec.spec.language.ir import Expression, Machine, Protocol, Span

from ecatspec.spec.language.overlap_guards import Guard
from ecatspec.spec.language.overlap_search import (
    Dimension,
    Environment,
    Row,
    Sample,
    search_samples,
    shared_samples,
)

_INPUT: Final = "input"
_SOURCES: Final = "from"
_Limited: TypeAlias = Dimension | str
Limits: TypeAlias = Mapping[_Limited, AbstractSet[Sample]]
"""What a row needs: the values, all told, that some dimensions may have, its states, its input."""


def meaning(protocol: Protocol) -> list[Diagnostic]:
    """The findings of 3xx."""
    findings: list[Diagnostic] = []
    for machine in protocol.machines.values():
        findings.extend(_overlaps(protocol, machine))
        findings.extend(_dead_rules(protocol, machine))
        findings.extend(_unreachable(protocol, machine))
    return findings


def _changed(protocol: Protocol, machine: Machine) -> dict[str, Span]:
    """The rules of a machine that a device text changed, and where it did."""
    changed: dict[str, Span] = {}
    for change in protocol.replaced:
        match change:
            case Replace() | Remove() if change.machine == machine.name:
                changed[change.rule] = change.at
            case Extend() if change.machine == machine.name:
                changed |= {rule.name: rule.at for rule in change.rules}
                changed |= {gap.name: gap.at for gap in change.gaps}
            case _:
                pass
    return changed


def _overlaps(protocol: Protocol, machine: Machine) -> Iterator[Diagnostic]:
    changed = _changed(protocol, machine)
    rows: tuple[Row, ...] = (*machine.rules, *machine.gaps)
    guards = [Guard(protocol, machine, row, pinned=True) for row in rows]
    limits = [
        {_INPUT: {row.input}, _SOURCES: set(row.sources), **guard.limits}
        for row, guard in zip(rows, guards, strict=True)
    ]
    for place, another in sorted(pairs_that_may_meet(limits)):
        one, other = rows[place], rows[another]
        if isinstance(one, Gap):
            continue
        example = _both(guards[place], guards[another])
        if example is not None:
            common = [source for source in one.sources if source in other.sources]
            first, second = (one, other) if one.at <= other.at else (other, one)
            kind = "gap" if isinstance(second, Gap) else "rule"
            yield Diagnostic(
                Code.ECS301,
                changed.get(first.name) or changed.get(second.name) or second.at,
                f"{kind} `{machine.name}.{second.name}` and `{first.name}` both fire in"
                f" {common[0]} on `{one.input}`{_wording(example)}",
                "make their guards exclude each other",
            )


def _dead_rules(protocol: Protocol, machine: Machine) -> Iterator[Diagnostic]:
    """Rules that never fire; in a device text only what it replaces, since it may silence rules."""
    replaced = _changed(protocol, machine)
    rows: tuple[Row, ...] = (*machine.rules, *machine.gaps)
    for rule in rows:
        if protocol.name != STANDARD and rule.name not in replaced:
            continue
        guard = Guard(protocol, machine, rule, pinned=False)
        if not guard.calculates and guard.never():
            yield Diagnostic(
                Code.ECS302,
                _changed(protocol, machine).get(rule.name, rule.at),
                f"`{machine.name}.{rule.name}` can never fire",
                "correct its guard or take it away",
            )


def _unreachable(protocol: Protocol, machine: Machine) -> Iterator[Diagnostic]:
    if _changed(protocol, machine):
        return
    reached = {machine.initial}
    while True:
        more = {
            rule.target
            for rule in machine.rules
            if rule.target is not None and reached.intersection(rule.sources)
        }
        if more <= reached:
            break
        reached |= more
    for state in machine.states:
        if state not in reached:
            yield Diagnostic(
                Code.ECS303,
                machine.at,
                f"no rule leads `{machine.name}` from {machine.initial} to {state}",
                "add a rule that goes there, or take the state away",
            )


def pairs_that_may_meet(limits: Sequence[Limits]) -> set[tuple[int, int]]:
    """Give all pairs of rows, by their places, that no limit keeps apart.

    Rows are put together by the values of what divides them best, so that most pairs that are
    kept apart are never looked at.
    """
    found: set[tuple[int, int]] = set()
    waiting: list[tuple[list[int], frozenset[_Limited]]] = [([*range(len(limits))], frozenset())]
    while waiting:
        rows, used = waiting.pop()
        divider = _divider(rows, limits, used)
        if divider is None:
            found.update(p for p in itertools.combinations(rows, 2) if _may_meet(limits, *p))
            continue
        free = [row for row in rows if divider not in limits[row]]
        limited = [row for row in rows if divider in limits[row]]
        crossed = ((min(p), max(p)) for p in itertools.product(free, limited))
        found.update(p for p in crossed if _may_meet(limits, *p))
        with_value: dict[Sample, list[int]] = {}
        for row in limited:
            for value in limits[row][divider]:
                with_value.setdefault(value, []).append(row)
        used |= {divider}
        waiting += [(part, used) for part in (free, *with_value.values()) if len(part) > 1]
    return found


def _may_meet(limits: Sequence[Limits], one: int, other: int) -> bool:
    mine, others = limits[one], limits[other]
    return not any(key in others and values.isdisjoint(others[key]) for key, values in mine.items())


def _divider(
    rows: Sequence[int], limits: Sequence[Limits], used: frozenset[_Limited]
) -> _Limited | None:
    """Give what leaves the fewest pairs to look at; None: nothing leaves fewer than all."""
    limited: Counter[_Limited] = Counter()
    with_value: Counter[tuple[_Limited, Sample]] = Counter()
    for row in rows:
        for key, values in limits[row].items():
            if key not in used:
                limited[key] += 1
                with_value.update((key, value) for value in values)
    count = len(rows)
    # a row without the limit meets all others
    left = {key: math.comb(count, 2) - math.comb(many, 2) for key, many in limited.items()}
    for (key, _), many in with_value.items():
        left[key] += math.comb(many, 2)
    best = min(left, key=lambda key: left[key], default=None)
    return None if best is None or left[best] >= math.comb(count, 2) else best


def _both(one: Guard, other: Guard) -> Environment | None:
    """Sample values that make both guards true."""
    for mine, claims in ((one.claims, other.claims), (other.claims, one.claims)):
        if any(_refuted(value, claims, holds=holds) for value, holds in mine):
            return None
    samples = {
        d: one.samples.get(d, set()) | other.samples.get(d, set())
        for d in {**one.samples, **other.samples}
    }
    samples = shared_samples(samples, one.pairs | other.pairs)
    return search_samples([*one.tests, *other.tests], samples)


def _refuted(value: Expression, claims: set[tuple[Expression, bool]], *, holds: bool) -> bool:
    """Whether an expression cannot hold (or fail to) where all is as claimed."""
    if (value, not holds) in claims:
        return True
    match value:
        case Binary("and" | "or" as word, left, right):
            both = (_refuted(part, claims, holds=holds) for part in (left, right))
            return any(both) if holds is (word == "and") else all(both)
        case Unary("not", operand):
            return _refuted(operand, claims, holds=not holds)
        case _:
            return False


def _wording(example: Environment) -> str:
    words = [f"{_name(dimension)} = {value}" for dimension, value in example.items()]
    return f", for instance with {', '.join(words)}" if words else ""


def _name(dimension: Dimension) -> str:
    match dimension:
        case VariableRef(machine, name):
            return f"{machine}.{name}"
        case StateRef(machine):
            return f"{machine}.state"
        case RegisterFieldRef(register, field):
            return f"{register}.{field}"
        case WordFieldRef(word, field):
            return f"{word}.{field}"
        case Call(function, _):
            return f"{function}(...)"
        case Binary(operator, _, _):
            return f"... {operator} ..."
        case AlternativeRef(_, name) | ConditionRef(name) | ChoiceRef(name) | DefinitionRef(name):
            return name
        case ParameterOfInput(name) | ReplyField(name):
            return name
        case ParameterRef(name, part):
            return name if part is None else f"{name}.{part}"
        case ConstantRef(value, table):
            return f"{table} {value}"
        case _:
            assert_never(dimension)
