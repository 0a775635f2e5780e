"""A condition on tests from which completeness follows.

Nothing is tried here: the condition is read off the tree of the tests (apartness of all nodes near
the basis, after Vaandrager and Melse, k-A-completeness; or nodes that must be one state, as in the
methods SPY and S). It proves completeness, and never refutes it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.complete.characterisation_sets import (
    extended,
    identifiers,
    path_words,
    splitting_tree,
)
from ecatspec.generators.complete.trie import branches

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.generators.complete.trie import Trie
    from ecatspec.model.automata.mealy import Mealy, Word


def sufficient(machine: Mealy, tests: Trie, k: int) -> bool:
    """Tell whether a tree of tests meets a condition for completeness with `k` states more.

    Either of two. All words of up to `k` + 1 inputs are there after nodes that reach each state
    once, and of all these nodes each two in different states of the machine answer some word below
    both differently. Or every transition is seen with up to `k` inputs and the words of the states
    reached, from places that must be in its source, as chained suites are made. The words are those
    that the methods of this package use; other suites may be complete and not meet it.
    """
    tree = splitting_tree(machine)
    families = (identifiers(machine, tree).words, path_words(tree))
    seen = _Seen(machine, tests)
    if len(seen.basis) != len(machine.states):
        return False
    return any(
        _harmonised(machine, words) and (seen.identified(words, k) or seen.converging(words, k))
        for words in families
    )


class _Seen:
    """A tree of tests with a node for each state that it reaches: no words, no claims."""

    def __init__(self, machine: Mealy, tests: Trie) -> None:
        self.machine = machine
        self.states = states = tests.states(machine)
        self.child: list[dict[int, int]] = [{} for _ in tests.parents]
        for node in range(1, len(tests)):
            self.child[tests.parents[node]][tests.symbols[node]] = node
        self.basis, taken = [0], {states[0]}
        for node in self.basis:
            for _, child in sorted(self.child[node].items()):
                if states[child] not in taken:
                    taken.add(states[child])
                    self.basis.append(child)

    def has(self, node: int, word: Word) -> bool:
        """Tell whether a word is in the tree from a node on."""
        found: int | None = node
        for symbol in word:
            found = self.child[found].get(symbol) if found is not None else None
        return found is not None

    def identified(self, words: Sequence[Sequence[Word]], k: int) -> bool:
        """Tell whether all nodes near the basis have the words of their states."""
        width = len(self.machine.inputs)
        nodes, level, known = list(self.basis), self.basis, set(self.basis)
        for _ in range(k + 1):
            if any(len(self.child[node]) != width for node in level):
                return False
            level = [c for node in level for c in self.child[node].values() if c not in known]
            nodes += level
        return all(self.has(node, word) for node in nodes for word in words[self.states[node]])

    def converging(self, words: Sequence[Sequence[Word]], k: int) -> bool:
        """Tell whether every transition is verified from nodes whose state cannot be another.

        Each fact is taken from the tests and from facts before it; the order is the only thing
        that is found out here. Nodes are one state where all that `extended` gives was seen after
        them, or after nodes that are one with them.
        """
        if not all(self.has(node, w) for node in self.basis for w in words[self.states[node]]):
            return False
        known = _Known(self, extended(self.machine, words, k))
        known.follow(self.basis)
        return all(known.verified)


class _Known:
    """What is known of nodes while transitions are verified one after the other.

    A place is a transition, or after all of these a state: that all its words were seen after
    nodes that are certainly in it.
    """

    def __init__(self, seen: _Seen, words: Sequence[Sequence[Word]]) -> None:
        machine = seen.machine
        states = range(len(machine.states))
        self.seen = seen
        self.width = len(machine.inputs)
        self.size = len(machine.next)
        self.targets = [*machine.next, *states]
        self.branches = [branches(each) for each in words]
        self.missing = [(1 << len(words[target])) - 1 for target in self.targets]
        self.verified = bytearray(len(self.targets))
        self.into: list[list[int]] = [[] for _ in states]
        for place, target in enumerate(machine.next):
            self.into[target].append(place)
        self.certain = bytearray(len(seen.states))
        self.waiting: list[list[int]] = [[] for _ in machine.next]
        """Nodes behind a transition that is not verified."""
        self.work: list[int] = []

    def follow(self, basis: list[int]) -> None:
        """Begin with one node for each state; go on as far as anything follows."""
        for node in basis:
            self._settle(node)
        while self.work:
            node = self.work.pop()
            state = self.seen.states[node]
            self._look(self.size + state, node)
            for symbol, child in self.seen.child[node].items():
                place = state * self.width + symbol
                if self.verified[place]:
                    self._settle(child)
                    continue
                self.waiting[place].append(child)
                if self.certain[child]:
                    self._verify(place)  # a node of the basis: its state is its own
                else:
                    self._look(place, child)

    def _look(self, place: int, node: int) -> None:
        """Note the words below a node that stands for a place."""
        if self.verified[place]:
            return
        work = [(node, self.branches[self.targets[place]])]
        while work:
            node, branch = work.pop()
            if isinstance(branch, int):
                self.missing[place] &= ~(1 << branch)
                continue
            child = self.seen.child[node]
            work += [(child[symbol], part) for symbol, part in branch.items() if symbol in child]
        if not self.missing[place]:
            self._complete(place)

    def _complete(self, place: int) -> None:
        """Take up what follows from all words of a place having been seen."""
        if place < self.size:
            if self.verified[self.size + self.targets[place]]:
                self._verify(place)
            return
        self.verified[place] = 1
        for each in self.into[place - self.size]:
            if not self.missing[each] and not self.verified[each]:
                self._verify(each)

    def _verify(self, place: int) -> None:
        self.verified[place] = 1
        for node in self.waiting[place]:
            self._settle(node)

    def _settle(self, node: int) -> None:
        if not self.certain[node]:
            self.certain[node] = 1
            self.work.append(node)


def _harmonised(machine: Mealy, words: Sequence[Sequence[Word]]) -> bool:
    """Tell whether each two states have words with a common beginning that tells them apart."""
    count = len(machine.states)
    apart = [0] * count
    # all states that have some beginning of a word, each with where it leads
    work = [[(state, state, word) for state in range(count) for word in words[state]]]
    while work:
        by_symbol: dict[int, list[tuple[int, int, Word]]] = {}
        for state, now, word in work.pop():
            if word:
                by_symbol.setdefault(word[0], []).append((state, now, word[1:]))
        for symbol, own in by_symbol.items():
            parts: dict[int, list[tuple[int, int, Word]]] = {}
            everybody = 0
            for state, now, rest in own:
                after, answer = machine.step(now, symbol)
                parts.setdefault(answer, []).append((state, after, rest))
                everybody |= 1 << state
            for part in parts.values():
                members = 0
                for state, _, _ in part:
                    members |= 1 << state
                for state, _, _ in part:
                    apart[state] |= everybody & ~members
            work += parts.values()
    return all(apart[state] | 1 << state == (1 << count) - 1 for state in range(count))
