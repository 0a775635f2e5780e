"""Proves a suite complete, or finds a machine that it misses.

An implementation that passes a suite answers its tree of words as the machine does. So the tree
can be folded into the implementation: nodes that lead to one state are one. All ways to fold the
tree into at most m states are tried; what does not fold into the machine itself is a
counterexample. For suites that are too large there is a condition on the tree alone: it proves
completeness, and never refutes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ecatspec.generators.complete.counterexample_search import ExhaustedError, Search
from ecatspec.generators.complete.faults import kills, mutant
from ecatspec.generators.complete.sufficient import sufficient
from ecatspec.generators.complete.suites import Checked
from ecatspec.model.automata.mealy import Mealy, equivalent, minimise

if TYPE_CHECKING:
    from ecatspec.generators.complete.suites import Suite
    from ecatspec.generators.complete.trie import Trie

EFFORT = 20_000_000
"""Steps of comparing and folding that are done where nobody says; half a minute at most."""
_FEW = 20_000_000
"""Single faults up to which they are tried before anything is proved."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """What is known of a suite after it was looked at.

    `checked` is EXACT or SUFFICIENT where it is complete. `counterexample` is a machine of at most
    m states that passes every test and differs. Both absent: nothing was found out within the
    effort.
    """

    checked: Checked
    counterexample: Mealy | None = None


def certify(machine: Mealy, suite: Suite, effort: int = EFFORT) -> Certificate:
    """Find out whether a suite finds every machine of at most `suite.m` states that differs.

    Tries single faults, then all folds, then the sufficient condition; `effort` limits each in
    steps. The suite is taken as it is: what its method promises does not count.
    """
    return certify_tests(machine, suite.trie(), suite.m, effort)


def certify_tests(machine: Mealy, tests: Trie, m: int, effort: int = EFFORT) -> Certificate:
    """Do the same for any tests and any bound `m`.

    Raises:
        ValueError: The machine is not minimal and reachable, or has more than `m` states.

    """
    count = len(machine.states)
    if len(minimise(machine).machine.states) != count:
        raise ValueError("only a machine that is minimal and reachable can be certified")
    if m < count:
        raise ValueError(f"the machine itself has more than {m} states")
    if count * len(machine.next) <= min(_FEW, effort):
        survivors = kills(machine, tests, 1).survivors
        if survivors:
            return Certificate(Checked.NONE, mutant(machine, survivors[0]))
    try:
        found = Search(machine, tests, m, effort).counterexample()
    except ExhaustedError:
        complete = sufficient(machine, tests, m - count)
        return Certificate(Checked.SUFFICIENT if complete else Checked.NONE)
    if found is None:
        return Certificate(Checked.EXACT)
    assert len(found.states) <= m
    assert passes(machine, tests, found)
    assert not equivalent(machine, found)
    return Certificate(Checked.NONE, found)


def passes(machine: Mealy, tests: Trie, implementation: Mealy) -> bool:
    """Tell whether an implementation answers all tests as the machine does."""
    width = len(machine.inputs)
    should, does = tests.states(machine), tests.states(implementation)
    return all(
        machine.out[should[parent] * width + symbol]
        == implementation.out[does[parent] * width + symbol]
        for parent, symbol in zip(tests.parents[1:], tests.symbols[1:], strict=True)
    )
