"""Guards as tests over samples of what they speak of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.spec.language.arithmetic import calculated
from ecatspec.spec.language.functions import FUNCTIONS
from ecatspec.spec.language.ir import (
    AnyValue,
    Binary,
    Bool,
    Call,
    Conditional,
    In,
    Literal,
    Name,
    Named,
    OneOf,
    Range,
    Time,
    Unary,
)
from ecatspec.spec.language.kinds import bounds_of, expectation, kind_of, kind_of_ref
from ecatspec.spec.language.logic import COMPARED, junction
from ecatspec.spec.language.references import (
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
    StateRef,
    VariableRef,
    WordFieldRef,
)
from ecatspec.spec.language.scope import Scope, resolve

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ecatspec.spec.language.ir import Expression, Machine, Protocol

from ecatspec.spec.language.overlap_search import (
    BUDGET,
    Dimension,
    Environment,
    Row,
    Sample,
    Test,
    search_samples,
    shared_samples,
)


@dataclass(frozen=True, slots=True)
class _Operand:
    """A part of a guard: how it is evaluated, which dimension it is, its constant value.

    `limit`: it is false unless a dimension has one of these values.
    """

    test: Test
    dimension: Dimension | None = None
    constant: Sample | None = None
    limit: tuple[Dimension, frozenset[Sample]] | None = None


_UNKNOWN: Final = _Operand(lambda _: None)


class Guard:
    """A guard made ready for the search: three-valued tests and the samples of dimensions."""

    def __init__(self, protocol: Protocol, machine: Machine, row: Row, *, pinned: bool) -> None:
        self._protocol = protocol
        self._scope = Scope(machine.name, row.input)
        self._pinned = pinned
        self.samples: dict[Dimension, set[Sample]] = {}
        self.pairs: set[tuple[Dimension, Dimension]] = set()
        self._constants: set[int] = set()
        self._numeric: set[Dimension] = set()
        self.calculates = False
        self.claims: set[tuple[Expression, bool]] = set()
        self.tests: list[Test] = []
        self.limits: dict[Dimension, frozenset[Sample]] = {}
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
        return search_samples(self.tests, shared_samples(self.samples, self.pairs)) is None

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

    def _fixed(self, value: Sample) -> _Operand:
        if isinstance(value, int):
            self._constants.add(value)
        return _Operand(_constantly(value=value), None, value)

    def _conditional(
        self, condition: Expression, then: Expression, otherwise: Expression, expected: Kind | None
    ) -> _Operand:
        asked = self._build(condition, Bool()).test
        yes, no = self._build(then, expected).test, self._build(otherwise, expected).test

        def test(environment: Environment) -> Sample | None:
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

    def _dimension(self, dimension: Dimension, kind: Kind | None) -> _Operand:
        if dimension not in self.samples:
            self.samples[dimension] = self._first_samples(dimension, kind)
            if not isinstance(kind, Bool | ChoiceRef):
                self._numeric.add(dimension)
        if isinstance(kind, Bool):
            return _Operand(lambda e: _truth(e.value(dimension)), dimension)
        return _Operand(lambda e: e.value(dimension), dimension)

    def _first_samples(self, dimension: Dimension, kind: Kind | None) -> set[Sample]:
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

    def _near(self, dimension: Dimension, constants: set[int]) -> None:
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
        tests: list[Test] = []
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
) -> tuple[Dimension, frozenset[Sample]] | None:
    """Give what a subject that equals one of these values is limited to, if all are constant."""
    constants = frozenset(v.constant for v in values if v.constant is not None)
    if subject.dimension is None or any(v.constant is None for v in values):
        return None
    return subject.dimension, constants


def _constantly(*, value: Sample) -> Test:
    return lambda _: value


def _truth(value: Sample | None) -> bool | None:
    return None if value is None else bool(value)


def _compared(operator: str, one: Test, other: Test) -> Test:
    def test(environment: Environment) -> Sample | None:
        left, right = one(environment), other(environment)
        if left is None or right is None:
            return None
        if operator not in {"==", "!="} and (isinstance(left, str) or isinstance(right, str)):
            return None
        found: bool = COMPARED[operator](left, right)
        return found

    return test


def _numbers(operator: str, one: Test, other: Test) -> Test:
    def test(environment: Environment) -> Sample | None:
        left, right = one(environment), other(environment)
        if isinstance(left, int) and isinstance(right, int):
            return calculated(operator, left, right)
        return None

    return test
