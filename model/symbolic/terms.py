"""Solver terms. It is the only module that imports z3.

Numbers are integers within the bounds of their types: the interpreter never wraps, nor do the
terms. What is the same everywhere stays a Python value, so that pins and parameters fold away.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, TypeAlias

import z3

from ecatspec.spec.language.arithmetic import SIGNS, calculated
from ecatspec.spec.language.logic import COMPARED, joined

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from ecatspec.spec.language.ir import Type

Term: TypeAlias = "bool | int | z3.ExprRef"
"""A truth or a number: known, or a term of the solver."""

EFFORT: Final = 4_000_000
"""Steps of the solver for one question; the same on every machine, other than seconds."""

_COUNTED: Final = frozenset({"+", "-", "*"})
"""The signs that make of two terms what they make of two numbers."""


class Answer(Enum):
    """What the solver says to a question."""

    NO = "no values make it true"
    YES = "some values make it true"
    UNKNOWN = "the effort was not enough"


z3.z3.Z3_DEBUG = False  # it compares the sorts of all parts of each new term: a third of the time

_ANSWERS: Final = {"unsat": Answer.NO, "sat": Answer.YES, "unknown": Answer.UNKNOWN}


@dataclass(frozen=True, slots=True)
class Symbol:
    """What a term has instead of a value that is not known; `label` is its name for people.

    `abstract`: it stands for something that the terms do not describe, an answer of a function.
    """

    name: str
    label: str
    kind: Type | None
    term: Term
    abstract: bool


class Symbols:
    """All symbols of one specification, with what is known of each."""

    def __init__(self) -> None:
        """Begin with none."""
        self.known: dict[str, Symbol] = {}
        self._facts: dict[str, list[tuple[Term, list[str]]]] = {}
        self._inside: dict[int, tuple[Term, frozenset[str]]] = {}

    def truth(self, name: str, label: str, kind: Type | None, *, abstract: bool = False) -> Term:
        """Give the symbol of a truth value, made where there is none of that name."""
        if name not in self.known:
            self.known[name] = Symbol(name, label, kind, z3.Bool(name), abstract)
        return self.known[name].term

    def number(
        self,
        name: str,
        label: str,
        kind: Type | None,
        bounds: tuple[int | None, int | None],
        *,
        abstract: bool = False,
    ) -> Term:
        """Give the symbol of a number between bounds, made where there is none of that name."""
        if name not in self.known:
            term = z3.Int(name)
            self.known[name] = Symbol(name, label, kind, term, abstract)
            low, high = bounds
            if low is not None:
                self.fact(term, term >= low)
            if high is not None:
                self.fact(term, term <= high)
        return self.known[name].term

    def fact(self, symbol: Term, holds: Term) -> None:
        """Say what holds of a symbol wherever it is spoken of."""
        if not isinstance(symbol, int):
            # the solver's examples depend on the order
            fact = holds, sorted(self.inside(holds))
            self._facts.setdefault(symbol.decl().name(), []).append(fact)

    def inside(self, term: Term) -> frozenset[str]:
        """Give the names of the symbols in a term."""
        if isinstance(term, int):
            return frozenset()
        found = self._inside.get(term.get_id())
        if found is not None:
            return found[1]
        if term.num_args():
            names = frozenset[str]().union(*map(self.inside, term.children()))
        elif z3.is_const(term) and term.decl().kind() == z3.Z3_OP_UNINTERPRETED:
            names = frozenset((term.decl().name(),))
        else:
            names = frozenset()
        # the term is kept: the solver would give its number to another one
        self._inside[term.get_id()] = (term, names)
        return names

    def facts(self, names: Iterable[str], told: set[str]) -> list[Term]:
        """Give what is known of symbols, and of those that this speaks of; `told` grows."""
        found: list[Term] = []
        work = sorted(names)  # the solver's examples depend on the order
        while work:
            name = work.pop()
            if name not in told:
                told.add(name)
                for holds, others in self._facts.get(name, ()):
                    found.append(holds)
                    work += others
        return found


@dataclass(frozen=True, slots=True)
class Values:
    """Values of symbols that make a question true: of those that it speaks of."""

    known: Mapping[str, Symbol]
    numbers: Mapping[str, int | bool]

    def of(self, name: str) -> int | bool | None:
        """Give the value of a symbol, None where the question did not speak of it."""
        return self.numbers.get(name)


class Solver:
    """One solver that keeps what it learnt of the symbols from question to question."""

    def __init__(self, symbols: Symbols) -> None:
        """Take the symbols; what is known of them is told when they are first spoken of."""
        self._symbols = symbols
        self._solver = z3.SimpleSolver()
        self._solver.set("rlimit", EFFORT)
        self._solver.set("random_seed", 0)
        self._told: set[str] = set()
        self.questions = 0

    def ask(self, formulas: Iterable[Term]) -> Answer:
        """Tell whether all formulas can hold together."""
        return self._ask(formulas, wanted=False)[0]

    def example(self, formulas: Iterable[Term]) -> tuple[Answer, Values | None]:
        """Tell whether all formulas can hold together, and with which values."""
        return self._ask(formulas, wanted=True)

    def _ask(self, formulas: Iterable[Term], *, wanted: bool) -> tuple[Answer, Values | None]:
        parts = [part for part in formulas if part is not True]
        if any(part is False for part in parts):
            return Answer.NO, None
        self.questions += 1
        names = frozenset[str]().union(*map(self._symbols.inside, parts))
        for holds in self._symbols.facts(names - self._told, self._told):
            if holds is not True:
                self._solver.add(holds)
        self._solver.push()
        try:
            self._solver.add(*parts)
            answer = _ANSWERS[str(self._solver.check())]
            if not wanted or answer is not Answer.YES:
                return answer, None
            related: set[str] = set()
            self._symbols.facts(names, related)
            return answer, self._values(related)
        finally:
            self._solver.pop()

    def _values(self, names: Iterable[str]) -> Values:
        model = self._solver.model()
        numbers: dict[str, int | bool] = {}
        for name in sorted(names):
            value = model.eval(self._symbols.known[name].term, model_completion=True)
            numbers[name] = value.as_long() if z3.is_int_value(value) else z3.is_true(value)
        return Values(self._symbols.known, numbers)


# --- terms ----------------------------------------------------------------------------------------


def is_truth(term: Term) -> bool:
    """Tell whether a term is a truth value."""
    return isinstance(term, bool) or (not isinstance(term, int) and z3.is_bool(term))


def negated(term: Term) -> Term:
    """Give the opposite."""
    return not term if isinstance(term, bool) else z3.Not(term)


def all_of(terms: Iterable[Term]) -> Term:
    """Give what holds where all hold."""
    return _joined(terms, z3.And, decisive=False)


def any_of(terms: Iterable[Term]) -> Term:
    """Give what holds where one holds at least."""
    return _joined(terms, z3.Or, decisive=True)


def _joined(terms: Iterable[Term], join: Callable[..., Term], *, decisive: bool) -> Term:
    found = joined(terms, decisive=decisive)
    if isinstance(found, bool):
        return found
    return join(*found) if len(found) > 1 else found[0]


def two_of(terms: Iterable[Term]) -> Term:
    """Give what holds where two hold at least."""
    parts = list(terms)
    known = sum(part is True for part in parts)
    open_ = [part for part in parts if not isinstance(part, bool)]
    if known >= 2:  # noqa: PLR2004  it says so
        return True
    if known:
        return any_of(open_)
    return z3.AtLeast(*open_, 2) if len(open_) > 1 else False


def either(condition: Term, then: Term, otherwise: Term) -> Term:
    """Give one term where the condition holds, the other where it does not."""
    if isinstance(condition, bool):
        return then if condition else otherwise
    if is_literal(then) and is_literal(otherwise) and then == otherwise:
        return then
    first, second = _alike(then, otherwise)
    if is_truth(first):
        return any_of(
            (all_of((condition, first)), all_of((negated(condition), second))),
        )
    return z3.If(condition, first, second)


def equal(first: Term, second: Term) -> Term:
    """Give what holds where two terms have the same value."""
    if is_literal(first) and is_literal(second):
        return first == second
    first, second = _alike(first, second)
    if isinstance(first, bool):
        return second if first else negated(second)
    if isinstance(second, bool):
        return first if second else negated(first)
    return first == second


def compared(sign: str, first: Term, second: Term) -> Term:
    """Give what holds where `<`, `<=`, `>` or `>=` does."""
    found: Term = COMPARED[sign](_number(first), _number(second))
    return found


def within(term: Term, low: Term, high: Term) -> Term:
    """Give what holds where a number is between two others, both included."""
    if is_literal(low) and is_literal(high) and low == high:
        return equal(term, low)
    return all_of((compared(">=", term, low), compared("<=", term, high)))


def counted(sign: str, first: Term, second: Term) -> Term | None:
    """Give a number calculated of two; None where the solver's rules are not the interpreter's."""
    first, second = _number(first), _number(second)
    if isinstance(first, int) and isinstance(second, int):
        return calculated(sign, first, second)
    if sign in _COUNTED:
        made: Term = SIGNS[sign](first, second)
        return made
    if sign in "&|" or not isinstance(second, int) or second <= 0:
        return None
    return first / second if sign == "/" else first % second


def lesser(first: Term, second: Term) -> Term:
    """Give the smaller number."""
    return either(compared("<=", first, second), first, second)


def is_literal(term: Term) -> bool:
    """Tell whether a term is the same everywhere."""
    return isinstance(term, int)


def key_of(term: Term) -> object:
    """Give what tells terms apart that are written differently."""
    return term if isinstance(term, int) else ("term", term.get_id())


def _number(term: Term) -> Term:
    if isinstance(term, bool):
        return int(term)
    return z3.If(term, 1, 0) if is_truth(term) else term


def _alike(first: Term, second: Term) -> tuple[Term, Term]:
    if is_truth(first) == is_truth(second):
        return first, second
    return _number(first), _number(second)


def settled(term: Term, numbers: Mapping[str, int | bool], symbols: Symbols) -> int | bool | None:
    """Give the value of a term with values in the place of its symbols, None where it has none."""
    if isinstance(term, int):
        return term
    names = symbols.inside(term)
    if term.num_args() == 0:
        return next((numbers.get(name) for name in names), None)
    if not any(name in numbers for name in names):
        return None
    pairs = []
    for name in names:
        if name in numbers:
            value = numbers[name]
            new = z3.BoolVal(value) if isinstance(value, bool) else z3.IntVal(value)
            pairs.append((symbols.known[name].term, new))
    result = z3.simplify(z3.substitute(term, *pairs))
    if z3.is_true(result) or z3.is_false(result):
        return bool(z3.is_true(result))
    return int(result.as_long()) if z3.is_int_value(result) else None


def with_value(term: Term, name: str, value: int, symbols: Symbols) -> Term:
    """Give a term with a value in the place of one symbol."""
    if name not in symbols.inside(term):
        return term
    return z3.substitute(term, (symbols.known[name].term, z3.IntVal(value)))
