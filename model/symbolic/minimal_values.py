"""Makes a solver's values those of a device: true, and the smallest.

A symbol for an answer may have a value that the dictionary never gives. For the arguments of an
example the interpreter knows the answer; as a lemma it goes into the next question.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.model.core.expressions import Environment
from ecatspec.model.symbolic.concretisation import Example
from ecatspec.model.symbolic.symbolic_state import Anything, Content
from ecatspec.model.symbolic.terms import Term, all_of, any_of, compared, equal, negated

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from ecatspec.model.core.state import State
    from ecatspec.model.symbolic.smt_encoding import Meaning
    from ecatspec.model.symbolic.symbolic_state import Meant
    from ecatspec.model.symbolic.terms import Solver, Values

_TRIES: Final = 24
"""Maximum number of times that the solver gets the answers of the dictionary."""

_NEVER: Final = frozenset({"has_value"})
"""What is not put right: one byte string of countless ones after the other would be told."""


class Refined:
    """What was learnt of the answers of one specification, for the objects of one state."""

    def __init__(self, meaning: Meaning, solver: Solver, state: State) -> None:
        """Take the state whose objects answer."""
        self._meaning = meaning
        self._solver = solver
        self._state = state
        self._functions = meaning.model.dictionary.functions | meaning.model.image.functions
        self._lemmas: dict[str, dict[tuple[object, ...], Term]] = {}

    def smallest(
        self,
        formulas: tuple[Term, ...],
        sent: set[str],
        al_state: int | None,
        later: Collection[str],
    ) -> Values | None:
        """Give values of which all answers are true, None where there are none.

        The symbols `sent` are the smallest in the order of their names. `al_state` is that of the
        question. `later` are the stamps of worlds in which objects may have changed: what is asked
        there may have any answer.
        """
        names = self.related(formulas)
        for _ in range(_TRIES):
            known = (all_of((*formulas, *self.lemmas(names))),)
            values = self._solver.example(known)[1]
            if values is None:
                return None
            if self._learn(values, al_state, later):
                continue
            values = self._lowered(known, sorted(sent & values.numbers.keys()), values)
            if not self._learn(values, al_state, later):
                return values
        return None

    def related(self, formulas: Iterable[Term]) -> set[str]:
        """Give the symbols of which formulas speak, and those that are tied to them."""
        found: set[str] = set()
        symbols = self._meaning.symbols
        symbols.facts(frozenset[str]().union(*map(symbols.inside, formulas)), found)
        return found

    def lemmas(self, names: Iterable[str]) -> tuple[Term, ...]:
        """Give what is known of the answers among some symbols."""
        return tuple(
            lemma for name in sorted(names) for lemma in self._lemmas.get(name, {}).values()
        )

    def _learn(self, values: Values, al_state: int | None, later: Collection[str]) -> bool:
        """Tell whether an example has an answer that is wrong, and keep the right one."""
        example = Example(self._meaning, values)
        slots = list(self._state.slots)
        if al_state is not None:
            slots[self._meaning.model.slots["al.state"]] = al_state
        environment = Environment(tuple(slots), self._state.objects, {})
        wrong = False
        for name in sorted(values.numbers):
            function, arguments = self._meaning.answers.asked.get(name, ("", ()))
            if (
                function not in self._functions
                or function in _NEVER
                or any(f" @{stamp}" in name for stamp in later)
            ):
                continue
            given = tuple(example.value(argument, 0) for argument in arguments)
            answer = self._functions[function](environment, given)
            if isinstance(answer, int) and answer != values.numbers[name]:
                wrong = True
                here = all_of(
                    self._is(meant, value) for meant, value in zip(arguments, given, strict=True)
                )
                term = self._meaning.symbols.known[name].term
                lemma = any_of((negated(here), equal(term, answer)))
                self._lemmas.setdefault(name, {})[given] = lemma
        return wrong

    def _lowered(self, formulas: tuple[Term, ...], names: list[str], values: Values) -> Values:
        """Give the values that come first in the order of the names."""
        fixed = list(formulas)
        for name in names:
            # nearly always it is the smallest already, which is asked first, or else 0 is
            low, high = 0, int(values.numbers[name])
            tried = high - 1
            while low < high:
                smaller = self._solver.example((*fixed, self._at_most(name, tried)))[1]
                if smaller is None:
                    low = tried + 1
                else:
                    values = smaller
                    high = int(smaller.numbers[name])
                tried = (low + high) // 2 if low else 0
            fixed.append(self._at_most(name, high))
        return values

    def _at_most(self, name: str, value: int) -> Term:
        return compared("<=", self._meaning.symbols.known[name].term, int(value))

    def _is(self, meant: Meant, value: object) -> Term:
        if isinstance(meant, Anything):
            return True
        if not isinstance(meant, Content):
            assert isinstance(value, int)
            return equal(meant, value)
        assert isinstance(value, bytes)
        parts = [equal(meant.length, len(value))]
        number = self._meaning.symbols.known.get(f"number({meant.name})")
        if number is not None:
            parts.append(equal(number.term, int.from_bytes(value[:8], "little")))
        return all_of(parts)
