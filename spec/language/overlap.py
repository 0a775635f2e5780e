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
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from ecatspec.spec.language.arithmetic import calculated
from ecatspec.spec.language.diagnostics import Code, Diagnostic
from ecatspec.spec.language.ir import (
    STANDARD,
    AnyValue,
    Binary,
    Bool,
    Call,
    Conditional,
    Extend,
    Gap,
    In,
    Literal,
    Name,
    Named,
    OneOf,
    Range,
    Remove,
    Replace,
    Rule,
    Time,
    Unary,
)
from ecatspec.spec.language.logic import COMPARED, junction
from ecatspec.spec.language.scope import (
    EDGES,
    EXCLUSIVE,
    FUNCTIONS,
    IMPLIES,
    AlternativeRef,
    ChoiceRef,
    ConditionRef,
    ConstantRef,
    DefinitionRef,
    Kind,
    ParameterOfInput,
    ParameterRef,
    Ref,
    RegisterFieldRef,
    ReplyField,
    Scope,
    StateRef,
    VariableRef,
    WordFieldRef,
    bounds_of,
    expectation,
    kind_of,
    kind_of_ref,
    resolve,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ecatspec.spec.language.ir import Expression, Machine, Protocol, Span

BUDGET: Final = 20_000
"""How many partial combinations are looked at before a pair of rules is given up."""

_INPUT: Final = "input"
_SOURCES: Final = "from"

_Value: TypeAlias = int | str
_Dimension: TypeAlias = Ref | Call | Binary
_Row: TypeAlias = Rule | Gap
_Test: TypeAlias = "Callable[[_Environment], _Value | None]"
_Limited: TypeAlias = _Dimension | str
Limits: TypeAlias = Mapping[_Limited, AbstractSet[_Value]]
"""What a row needs: the values, all told, that some dimensions may have, its states, its input."""
_Waiting: TypeAlias = "tuple[_Test, tuple[_Dimension, ...]]"
"""A test that is not decided, and the dimensions that it asks for."""


class _Environment(dict[_Dimension, _Value]):
    """Values of dimensions; `missing` are those that were asked for and have none yet."""

    def __init__(self) -> None:
        super().__init__()
        self.missing: dict[_Dimension, None] = {}

    def value(self, dimension: _Dimension) -> _Value | None:
        found = self.get(dimension)
        if found is None:
            self.missing[dimension] = None
        return found


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
    rows: tuple[_Row, ...] = (*machine.rules, *machine.gaps)
    guards = [_Guard(protocol, machine, row, pinned=True) for row in rows]
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
    rows: tuple[_Row, ...] = (*machine.rules, *machine.gaps)
    for rule in rows:
        if protocol.name != STANDARD and rule.name not in replaced:
            continue
        guard = _Guard(protocol, machine, rule, pinned=False)
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


# --- which rows may meet --------------------------------------------------------------------------


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
        with_value: dict[_Value, list[int]] = {}
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
    with_value: Counter[tuple[_Limited, _Value]] = Counter()
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


# --- search --------------------------------------------------------------------------------------


def _both(one: _Guard, other: _Guard) -> _Environment | None:
    """Sample values that make both guards true."""
    for mine, claims in ((one.claims, other.claims), (other.claims, one.claims)):
        if any(_refuted(value, claims, holds=holds) for value, holds in mine):
            return None
    samples = {
        d: one.samples.get(d, set()) | other.samples.get(d, set())
        for d in {**one.samples, **other.samples}
    }
    samples = _shared(samples, one.pairs | other.pairs)
    return _search([*one.tests, *other.tests], samples)


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


def _shared(
    samples: dict[_Dimension, set[_Value]], pairs: set[tuple[_Dimension, _Dimension]]
) -> dict[_Dimension, set[_Value]]:
    """Dimensions that are compared with each other get each other's samples."""
    for _ in range(2):
        for one, other in pairs:
            if one in samples and other in samples:
                together = samples[one] | samples[other]
                samples = samples | {one: together, other: together}
    return samples


def _search(tests: Sequence[_Test], samples: dict[_Dimension, set[_Value]]) -> _Environment | None:
    """Depth first, along the test that asks for least, with a cut where one is false for sure.

    What is decided stays so, and what is not changes only with a dimension that it asked for.
    """
    environment = _Environment()
    budget = BUDGET

    def found(waiting: Sequence[_Waiting], given: _Dimension | None) -> bool:
        nonlocal budget
        left: list[_Waiting] = []
        for row in waiting:
            if given is not None and given not in row[1]:
                left.append(row)
                continue
            environment.missing.clear()
            result = row[0](environment)
            if result is None:
                left.append((row[0], tuple(environment.missing)))
            elif not result:
                return False
        if not _possible(environment):
            return False
        if not left:
            return True
        fewest = min((asked for _, asked in left), key=len)
        for value in sorted(samples.get(fewest[0], ()), key=_order) if fewest else ():
            budget -= 1
            if budget <= 0:
                break
            environment[fewest[0]] = value
            if found(left, fewest[0]):
                return True
        if fewest:
            environment.pop(fewest[0], None)
        return False

    return environment if found([(test, ()) for test in tests], None) else None


def _order(value: _Value) -> tuple[bool, int, str]:
    return (isinstance(value, str), value if isinstance(value, int) else 0, str(value))


def _possible(environment: _Environment) -> bool:
    """Whether the answers of functions agree with each other, and edges with what they lead to."""
    held = {
        (d.function, d.arguments): bool(value)
        for d, value in environment.items()
        if isinstance(d, Call)
    }
    if not held:
        return True
    for first, second in IMPLIES:
        few = len(FUNCTIONS[second].arguments)
        for (function, arguments), holds in held.items():
            if function == first and holds and held.get((second, arguments[:few])) is False:
                return False
    for (function, arguments), holds in held.items():
        match arguments:
            case (Name(path),) if holds and function in EDGES:
                now = environment.get(ParameterOfInput(path))
                if now is not None and bool(now) is not EDGES[function]:
                    return False
            case _:
                pass
    for group in EXCLUSIVE:
        true = [
            arguments
            for (function, arguments), holds in held.items()
            if function in group and holds
        ]
        if len(true) != len(set(true)):
            return False
    return True


def _wording(example: _Environment) -> str:
    words = [f"{_name(dimension)} = {value}" for dimension, value in example.items()]
    return f", for instance with {', '.join(words)}" if words else ""


def _name(dimension: _Dimension) -> str:
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


# --- guards --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Operand:
    """A part of a guard: how it is evaluated, which dimension it is, its constant value.

    `limit`: it is false unless a dimension has one of these values.
    """

    test: _Test
    dimension: _Dimension | None = None
    constant: _Value | None = None
    limit: tuple[_Dimension, frozenset[_Value]] | None = None


_UNKNOWN: Final = _Operand(lambda _: None)


class _Guard:
    """A guard made ready for the search: three-valued tests and the samples of dimensions."""

    def __init__(self, protocol: Protocol, machine: Machine, row: _Row, *, pinned: bool) -> None:
        self._protocol = protocol
        self._scope = Scope(machine.name, row.input)
        self._pinned = pinned
        self.samples: dict[_Dimension, set[_Value]] = {}
        self.pairs: set[tuple[_Dimension, _Dimension]] = set()
        self._constants: set[int] = set()
        self._numeric: set[_Dimension] = set()
        self.calculates = False
        self.claims: set[tuple[Expression, bool]] = set()
        self.tests: list[_Test] = []
        self.limits: dict[_Dimension, frozenset[_Value]] = {}
        if row.guard is not None:
            parts = self._conjuncts(row.guard, negated=False)
            built = [self._build(part, Bool()) for part in parts]
            self.tests = [operand.test for operand in built]
            for dimension, values in (o.limit for o in built if o.limit is not None):
                self.limits[dimension] = values & self.limits.get(dimension, values)
        if self.calculates:
            for dimension in self._numeric:
                self._near(dimension, self._constants)

    def never(self) -> bool:
        """No combination of samples makes the guard true, and all of them were looked at."""
        total = 1
        for values in self.samples.values():
            total *= len(values)
        if total > BUDGET:
            return False
        return _search(self.tests, _shared(self.samples, self.pairs)) is None

    # --- expressions ---

    def _conjuncts(self, value: Expression, *, negated: bool) -> Iterator[Expression]:
        """What must all hold for the expression to hold, or (negated) for it not to hold."""
        self.claims.add((value, not negated))
        match value:
            case Binary("and", left, right) if not negated:
                parts = [(left, False), (right, False)]
            case Binary("or", left, right) if negated:
                parts = [(left, True), (right, True)]
            case Unary("not", operand):
                parts = [(operand, not negated)]
            case Name(path):
                ref = resolve(self._protocol, path, self._scope, Bool())
                parts = []
                if isinstance(ref, DefinitionRef):
                    parts = [(self._protocol.definitions[ref.name].value, negated)]
            case _:
                parts = []
        for part, turned in parts:
            yield from self._conjuncts(part, negated=turned)
        if not parts:
            yield Unary("not", value) if negated else value

    def _build(self, value: Expression, expected: Kind | None) -> _Operand:
        match value:
            case Literal():
                return self._fixed(int(value.value))
            case Name(path):
                return self._of_ref(resolve(self._protocol, path, self._scope, expected), expected)
            case Unary("not", operand):
                test = self._build(operand, Bool()).test
                return _Operand(lambda e: None if (x := test(e)) is None else not x)
            case Unary(_, operand):
                inner = self._build(operand, None)
                if isinstance(inner.constant, int):
                    return self._fixed(-inner.constant)
                test = inner.test
                return _Operand(lambda e: -x if isinstance(x := test(e), int) else None)
            case Binary("and", left, right):
                first, second = self._build(left, Bool()), self._build(right, Bool())
                return _Operand(junction((first.test, second.test), decisive=False, unknown=None))
            case Binary("or", left, right):
                first, second = self._build(left, Bool()), self._build(right, Bool())
                return _Operand(junction((first.test, second.test), decisive=True, unknown=None))
            case Binary(operator, left, right) if operator in COMPARED:
                return self._comparison(value)
            case Binary(operator, left, right):
                self.calculates = True
                one, other = self._build(left, None), self._build(right, None)
                if isinstance(one.constant, int) and isinstance(other.constant, int):
                    result = calculated(operator, one.constant, other.constant)
                    return _UNKNOWN if result is None else self._fixed(result)
                return _Operand(_numbers(operator, one.test, other.test))
            case In(operand, items):
                return self._membership(operand, items)
            case Conditional(condition, then, otherwise):
                return self._conditional(condition, then, otherwise, expected)
            case Call():
                return self._dimension(value, FUNCTIONS[value.function].result)
            case OneOf() | AnyValue():
                return _UNKNOWN
            case _:
                assert_never(value)

    def _fixed(self, value: _Value) -> _Operand:
        if isinstance(value, int):
            self._constants.add(value)
        return _Operand(_constantly(value=value), None, value)

    def _conditional(
        self, condition: Expression, then: Expression, otherwise: Expression, expected: Kind | None
    ) -> _Operand:
        asked = self._build(condition, Bool()).test
        yes, no = self._build(then, expected).test, self._build(otherwise, expected).test

        def test(environment: _Environment) -> _Value | None:
            answer = asked(environment)
            if answer is None:
                return None
            return yes(environment) if answer else no(environment)

        return _Operand(test)

    def _of_ref(self, ref: Ref, expected: Kind | None) -> _Operand:
        match ref:
            case ConstantRef(value, _):
                return self._fixed(value)
            case AlternativeRef(_, name):
                return self._fixed(name)
            case DefinitionRef(name):
                return self._build(self._protocol.definitions[name].value, expected)
            case ParameterRef(name, part):
                values = self._protocol.parameters[name].value
                return self._build(values[1 if part == "length" else 0], None)
            case (
                ParameterOfInput() | ReplyField() | VariableRef() | StateRef() | RegisterFieldRef()
            ):
                return self._dimension(ref, kind_of_ref(self._protocol, ref, self._scope))
            case WordFieldRef() | ChoiceRef() | ConditionRef():
                return self._dimension(ref, kind_of_ref(self._protocol, ref, self._scope))
            case _:
                assert_never(ref)

    def _dimension(self, dimension: _Dimension, kind: Kind | None) -> _Operand:
        if dimension not in self.samples:
            self.samples[dimension] = self._first_samples(dimension, kind)
            if not isinstance(kind, Bool | ChoiceRef):
                self._numeric.add(dimension)
        if isinstance(kind, Bool):
            return _Operand(lambda e: _truth(e.value(dimension)), dimension)
        return _Operand(lambda e: e.value(dimension), dimension)

    def _first_samples(self, dimension: _Dimension, kind: Kind | None) -> set[_Value]:
        match kind:
            case ChoiceRef(name):
                if self._pinned and name in self._protocol.pins:
                    return {self._protocol.pins[name].alternative}
                return {way.name for way in self._protocol.choices[name].alternatives}
            case Named(table) if isinstance(dimension, StateRef):
                rows = self._protocol.tables[table].rows
                states = self._protocol.machines[dimension.machine].states
                return {row.value for row in rows if row.name in states}
            case _:
                bounds = None if kind is None else bounds_of(self._protocol, kind)
                return set() if bounds is None else set(bounds)

    def _near(self, dimension: _Dimension, constants: set[int]) -> None:
        """Numbers next to what a dimension is compared with, as far as its type has them."""
        if isinstance(dimension, StateRef) or not self.samples[dimension]:
            return
        numbers = [n for n in self.samples[dimension] if isinstance(n, int)]
        if not numbers:
            return
        low, high = min(numbers), max(numbers)
        near = {n + step for n in constants for step in (-1, 0, 1)}
        self.samples[dimension] |= {n for n in near if low <= n <= high}

    def _related(self, one: _Operand, other: _Operand) -> None:
        if one.dimension is not None and other.dimension is not None:
            self.pairs.add((one.dimension, other.dimension))
        for side, against in ((one, other), (other, one)):
            if side.dimension is not None and isinstance(against.constant, int):
                self._near(side.dimension, {against.constant})

    def _comparison(self, value: Binary) -> _Operand:
        if kind_of(self._protocol, value.left, self._scope) == Time():
            return self._dimension(value, Bool())
        of_right = expectation(self._protocol, value.left, self._scope)
        of_left = expectation(self._protocol, value.right, self._scope)
        left, right = self._build(value.left, of_left), self._build(value.right, of_right)
        if self._opaque(left) or self._opaque(right):
            for side in (left, right):
                if side.dimension is not None:
                    self.samples.pop(side.dimension, None)
            return self._dimension(value, Bool())
        self._related(left, right)
        limit = None
        if value.operator == "==":
            limit = _limit(left, [right]) or _limit(right, [left])
        return _Operand(_compared(value.operator, left.test, right.test), limit=limit)

    def _opaque(self, operand: _Operand) -> bool:
        """A dimension without samples: bytes. What is compared with it is a truth of its own."""
        return operand.dimension is not None and not self.samples.get(operand.dimension)

    def _membership(self, operand: Expression, items: tuple[Expression | Range, ...]) -> _Operand:
        expected = expectation(self._protocol, operand, self._scope)
        subject = self._build(operand, expected)
        tests: list[_Test] = []
        singles: list[_Operand] = []
        for item in items:
            if isinstance(item, Range):
                low, high = self._build(item.low, expected), self._build(item.high, expected)
                self._related(subject, low)
                self._related(subject, high)
                tests.append(
                    junction(
                        (
                            _compared(">=", subject.test, low.test),
                            _compared("<=", subject.test, high.test),
                        ),
                        decisive=False,
                        unknown=None,
                    )
                )
            else:
                single = self._build(item, expected)
                singles.append(single)
                self._related(subject, single)
                tests.append(_compared("==", subject.test, single.test))
        test = junction(tests, decisive=True, unknown=None)
        limit = _limit(subject, singles) if len(singles) == len(items) else None
        return _Operand(test, limit=limit)


def _limit(
    subject: _Operand, values: Sequence[_Operand]
) -> tuple[_Dimension, frozenset[_Value]] | None:
    """Give what a subject that equals one of these values is limited to, if all are constant."""
    constants = frozenset(v.constant for v in values if v.constant is not None)
    if subject.dimension is None or any(v.constant is None for v in values):
        return None
    return subject.dimension, constants


def _constantly(*, value: _Value) -> _Test:
    return lambda _: value


def _truth(value: _Value | None) -> bool | None:
    return None if value is None else bool(value)


def _compared(operator: str, one: _Test, other: _Test) -> _Test:
    def test(environment: _Environment) -> _Value | None:
        left, right = one(environment), other(environment)
        if left is None or right is None:
            return None
        if operator not in {"==", "!="} and (isinstance(left, str) or isinstance(right, str)):
            return None
        found: bool = COMPARED[operator](left, right)
        return found

    return test


def _numbers(operator: str, one: _Test, other: _Test) -> _Test:
    def test(environment: _Environment) -> _Value | None:
        left, right = one(environment), other(environment)
        if isinstance(left, int) and isinstance(right, int):
            return calculated(operator, left, right)
        return None

    return test
