"""A solver that begins anew after a number of questions.

A solver keeps what it was told of every symbol that was ever spoken of, and has to satisfy all of
it with each answer. To tell a new one again what matters takes less time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.model.symbolic.terms import Solver

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.model.symbolic.terms import Answer, Symbols, Term, Values

_QUESTIONS: Final = 25
"""Number of questions that one solver answers; of 25, 100 and 400 this was the fastest."""


class ForgetfulSolver(Solver):
    """A solver that answers as others do, from a fresh one now and then."""

    def __init__(self, symbols: Symbols) -> None:
        """Take the symbols."""
        super().__init__(symbols)
        self._fresh = Solver(symbols)

    def _ask(self, formulas: Iterable[Term], *, wanted: bool) -> tuple[Answer, Values | None]:
        self.questions += 1
        if self._fresh.questions >= _QUESTIONS:
            self._fresh = Solver(self._symbols)
        return self._fresh._ask(formulas, wanted=wanted)  # noqa: SLF001  of its own class
