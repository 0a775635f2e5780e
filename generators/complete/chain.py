"""Complete suites with few resets: tests that go on as long as they can (CHAIN).

A reset of a real device costs more than an input. So a test does not end after a transition and
the words that identify its target: where it is known which state an implementation must be in, the
next transition is tried from there.

How that is known: the tests begin with the ways to all states and the words of each state, so an
implementation has n states that are certainly different. Two places after which all up to k inputs
and the words of the states reached were seen, as in one state of the machine, are then one state
of an implementation of n + k: else these inputs would lead to more different states than it has. A
transition is *verified* once all that was seen after it, from places that are known to be in its
source, and after known places of its target; then every place behind it is known too, in all tests
that wait for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.complete.characterisation_sets import (
    Identifiers,
    extended,
    identifiers,
    splitting_tree,
)
from ecatspec.generators.complete.suites import Method, Suite, cover_words, suite_of
from ecatspec.generators.complete.trie import branches, trie_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.generators.complete.trie import Branches
    from ecatspec.model.automata.mealy import Mealy, Word

RESET = 5
"""What a reset costs, in inputs, where nobody says."""
_LOOKED_AT = 2
"""Maximum number of tests among which the one with the nearest work goes on."""
_CHOSEN = 20_000
"""Maximum number of transitions of a machine whose order is chosen; more take too long."""


def chain_suite(
    machine: Mealy, reset: int = RESET, known: Identifiers | None = None, k: int = 0
) -> Suite:
    """Give a chained suite for implementations of up to `k` states more than the machine.

    It finds every deterministic machine of at most `len(machine.states) + k` states that differs.
    `reset` is the price of a reset in inputs: a dearer one makes fewer and longer tests. The
    machine must be minimal and reachable as a whole; memory grows with the symbols of the suite,
    and these with `len(machine.inputs) ** k`.

    Raises:
        ValueError: The machine is not minimal, or not reachable, or `k` is less than 0.

    """
    if k < 0:
        raise ValueError("k is the number of states that an implementation may have more")
    own = known or identifiers(machine, splitting_tree(machine))
    tests = _Chain(machine, own, reset, k).run()
    return suite_of(Method.CHAIN, machine, k, trie_of(tests))


class _Chain:
    """Tests that grow.

    A place is a transition, by its entry in the tables of the machine, or after these a state:
    that all its words were seen from known places of it. Both have words to be seen: those of the
    target of the transition, or of the state.
    """

    __slots__ = (
        "at",
        "branches",
        "chosen",
        "count",
        "cover",
        "failed",
        "first",
        "identify",
        "into",
        "known",
        "links",
        "masks",
        "missing",
        "next",
        "open",
        "order",
        "parked",
        "recent",
        "reset",
        "resumed",
        "routes",
        "size",
        "tests",
        "todo",
        "verified",
        "waiting",
        "ways_out",
        "width",
        "words",
    )

    def __init__(self, machine: Mealy, own: Identifiers, reset: int, k: int) -> None:
        self.width = width = len(machine.inputs)
        self.size = size = len(machine.next)
        count = len(machine.states)
        states = range(count)
        self.next = [*machine.next, *states]
        self.reset = reset
        # where there is one state only, nothing tells that a transition leads to it
        self.identify = [words or ((),) for words in own.words]
        self.words = extended(machine, own.words, k)
        self.branches = [branches(words) for words in self.words]
        self.cover = cover_words(machine)
        self.first = 0
        """How many states of the order have no work."""
        self.order = sorted(states, key=lambda s: (len(self.cover[s]), self.cover[s]))
        # of each place: words not seen yet, one bit a word
        self.missing = [(1 << len(self.words[target])) - 1 for target in self.next]
        self.verified = bytearray(size + count)
        self.count = 0
        # of each state: places to work on, the last first; verified transitions as target -> input
        self.todo = [list(range((s + 1) * width - 1, s * width - 1, -1)) for s in states]
        self.into: list[list[int]] = [[] for _ in states]
        """Of each state: the transitions that lead to it."""
        for place in range(size):
            self.into[machine.next[place]].append(place)
        if k:
            # a transition is worth nothing before the words of its target were seen
            self.todo = [[size + s] for s in states]
        else:
            self.verified[size:] = b"\1" * count
        self.chosen = [-1] * count
        self.open = (1 << count) - 1
        self.links: list[dict[int, int]] = [{} for _ in states]
        self.masks = [0] * count
        self.ways_out = [0] * count
        """Of each state: how many of its transitions are verified."""
        # of each test: its inputs, how many of them lead to a known place, the state there
        self.tests: list[list[int]] = []
        self.known: list[int] = []
        self.at: list[int] = []
        self.waiting: dict[int, list[int]] = {}
        """Tests that cannot go on before a transition is verified."""
        self.parked: list[list[int]] = [[] for _ in states]
        """Tests that could go on, by the state that they are in."""
        self.recent: list[int] = []
        self.resumed: list[int] = []
        self.routes: list[tuple[int, list[int]] | None] = [None] * count
        self.failed = [0] * count

    def run(self) -> list[list[int]]:
        """Give all tests."""
        self._begin()
        cover, order, test = self.cover, self.order, -1
        while True:
            while self.first < len(order) and not self._todo(order[self.first]):
                self.first += 1
            if self.first == len(order):
                return self.tests
            nearest = order[self.first]
            limit = self.reset + len(cover[nearest])
            test, found = self._continued(test, limit)
            if found is None:
                test, found = self._parked(limit)
            if found is None:
                test, found = self._test(cover[nearest], nearest), (nearest, [])
            state, way = found
            self.tests[test] += way
            self.known[test] += len(way)
            self.at[test] = state
            place = self._choose(state)
            if place < self.size:
                self.tests[test].append(place % self.width)
            missing = self.missing[place]
            number = (missing & -missing).bit_length() - 1
            self.tests[test] += self.words[self.next[place]][number]
            if not self._goes_on(test):
                test = -1

    def _begin(self) -> None:
        """Make the ways to the states and the words of each: no two states can be one."""
        width = self.width
        for state in self.order:
            if self.cover[state]:
                before = self.order[0]
                for symbol in self.cover[state][:-1]:
                    before = self.next[before * width + symbol]
                self._verify(before * width + self.cover[state][-1])
        for state in self.order:
            for word in self.identify[state]:
                test = self._test(self.cover[state], state)
                self.tests[test] += word
                self._settle(test)

    def _test(self, way: Word, state: int) -> int:
        self.tests.append(list(way))
        self.known.append(len(way))
        self.at.append(state)
        return len(self.tests) - 1

    # --- where a test goes on ---------------------------------------------------------------------

    def _todo(self, state: int) -> list[int]:
        """Give the places of a state to work on, with one that has words to be seen at the end."""
        found, verified, missing = self.todo[state], self.verified, self.missing
        while found and (verified[found[-1]] or not missing[found[-1]]):
            found.pop()
        return found

    def _choose(self, state: int) -> int:
        """Give the place of a state to work on: to its end, then what frees most for its price.

        Once a transition is verified, the tests that wait for it go on, and so do those that look
        at it and then take transitions of its target that are verified.
        """
        todo = self.todo[state]
        if todo[-1] == self.chosen[state] or self.size > _CHOSEN:
            return todo[-1]
        best, at = -1.0, -1
        for number, place in enumerate(todo):
            words = self.missing[place].bit_count()
            if not words or self.verified[place]:
                continue
            if place >= self.size:
                at = number
                break
            freed = len(self.waiting.get(place, ())) + self.ways_out[self.next[place]] + 1
            if freed / words >= best:
                best, at = freed / words, number
        todo[at], todo[-1] = todo[-1], todo[at]
        self.chosen[state] = todo[-1]
        return todo[-1]

    def _continued(self, test: int, limit: int) -> tuple[int, tuple[int, list[int]] | None]:
        """Give the way from where a test is to the next work; park it where that is too far."""
        if test < 0:
            return test, None
        state = self.at[test]
        found = self._route(state, limit)
        if found is None:
            self._park(test)
        return test, found

    def _parked(self, limit: int) -> tuple[int, tuple[int, list[int]] | None]:
        """Give a test that could go on, and its way to the next work."""
        looked: list[int] = []
        best, start = None, -1
        while self.recent and len(looked) < _LOOKED_AT:
            state = self.recent.pop()
            if not self.parked[state] or state in looked:
                continue
            looked.append(state)
            found = self._route(state, limit)
            if found is not None and (best is None or len(found[1]) < len(best[1])):
                best, start = found, state
                if not found[1]:
                    break
        self.recent += reversed(looked)
        return (-1, None) if best is None else (self.parked[start].pop(), best)

    def _route(self, state: int, limit: int) -> tuple[int, list[int]] | None:
        """Give the next state with work and a way over verified transitions, shorter than `limit`.

        What was found is kept while there is work at its end; what was sought in vain is sought
        again when an eighth more is verified.
        """
        if self._todo(state):
            return state, []
        found = self.routes[state]
        if found is None:
            if self.count < self.failed[state]:
                return None
            found = self.routes[state] = self._search(state, limit)
        elif not self._todo(found[0]):
            found = self.routes[state] = self._search(state, limit)
        if found is None:
            self.failed[state] = self.count * 9 // 8 + 1
            return None
        return found if len(found[1]) < limit else None

    def _search(self, state: int, limit: int) -> tuple[int, list[int]] | None:
        """Search breadth first; sets of states are numbers, one bit a state."""
        masks = self.masks
        layers = [[state]]
        seen = 1 << state
        while len(layers) < limit:
            front = 0
            for place in layers[-1]:
                front |= masks[place]
            front &= ~seen
            if not front:
                return None
            hit = front & self.open
            while hit:
                bit = hit & -hit
                target = bit.bit_length() - 1
                if self._todo(target):
                    return target, self._way(layers, target)
                self.open ^= bit
                hit ^= bit
            seen |= front
            layer = []
            while front:
                bit = front & -front
                layer.append(bit.bit_length() - 1)
                front ^= bit
            layers.append(layer)
        return None

    def _way(self, layers: list[list[int]], target: int) -> list[int]:
        way = []
        for layer in reversed(layers):
            before = next(state for state in layer if target in self.links[state])
            way.append(self.links[before][target])
            target = before
        return way[::-1]

    # --- what is known ----------------------------------------------------------------------------

    def _verify(self, place: int) -> None:
        self.verified[place] = 1
        self.count += 1
        if place >= self.size:
            self._worth_while(place - self.size)
            return
        state, target = place // self.width, self.next[place]
        self.ways_out[state] += 1
        self.links[state].setdefault(target, place % self.width)
        self.masks[state] |= 1 << target
        waiting = self.waiting.pop(place, None)
        if waiting:
            self.resumed += waiting

    def _worth_while(self, target: int) -> None:
        """Verify transitions to a state whose words were seen, or have them worked on."""
        for place in self.into[target]:
            if self.verified[place]:
                continue
            if self.missing[place]:
                state = place // self.width
                self.todo[state].append(place)
                self.open |= 1 << state
            else:
                self._verify(place)
        self.first = 0

    def _note(self, place: int, inputs: Sequence[int], at: int) -> None:
        """Note the word of a place that stands in a test there, if one does."""
        branch = self.branches[self.next[place]]
        while not isinstance(branch, int):
            if at == len(inputs) or inputs[at] not in branch:
                return
            branch = branch[inputs[at]]
            at += 1
        self.missing[place] &= ~(1 << branch)

    def _advance(self, test: int) -> int:
        """Follow a test over verified transitions, and note the words after others.

        Give the transition that is not verified and so stops it, -1 at the end of the test.
        """
        inputs, known, state = self.tests[test], self.known[test], self.at[test]
        next_, width, verified, size = self.next, self.width, self.verified, self.size
        missing = self.missing
        end = len(inputs)
        while known < end:
            if not verified[size + state]:
                self._note(size + state, inputs, known)
                if not missing[size + state]:
                    self._verify(size + state)
            place = state * width + inputs[known]
            if not verified[place]:
                if missing[place]:
                    self._note(place, inputs, known + 1)
                if missing[place] or not verified[size + next_[place]]:
                    self.known[test], self.at[test] = known, state
                    return place
                self._verify(place)
            state = next_[place]
            known += 1
        self.known[test], self.at[test] = known, state
        return -1

    def _settle(self, test: int) -> None:
        """Follow a test, and all that can go on after it, to where each stops."""
        self.resumed.append(test)
        while self.resumed:
            each = self.resumed.pop()
            place = self._advance(each)
            if place < 0:
                self._park(each)
            elif self._finish(each, place):
                self.resumed.append(each)
            else:
                self.waiting.setdefault(place, []).append(each)

    def _park(self, test: int) -> None:
        state = self.at[test]
        self.parked[state].append(test)
        self.recent.append(state)

    def _finish(self, test: int, place: int) -> bool:
        """Finish the word of a place that a test ends in, where one is wanted; tell whether so.

        That is cheaper than to come again.
        """
        missing = self.missing[place]
        if not missing:
            return False
        branch = self.branches[self.next[place]]
        for symbol in self.tests[test][self.known[test] + 1 :]:
            if isinstance(branch, int) or symbol not in branch:
                return False
            branch = branch[symbol]
        rest = _wanted(branch, missing)
        if not rest:
            return False
        self.tests[test] += rest
        return True

    def _goes_on(self, test: int) -> bool:
        """Follow a test that grew; tell whether it can go on from a known place."""
        while True:
            place = self._advance(test)
            while self.resumed:
                self._settle(self.resumed.pop())
            if place < 0:
                return True
            if not self.verified[place] and not self._finish(test, place):
                self.waiting.setdefault(place, []).append(test)
                return False


def _wanted(branch: Branches, missing: int) -> list[int]:
    """Give the shortest rest of a word that is missing; none: no word is."""
    layer: list[tuple[Branches, list[int]]] = [(branch, [])]
    while layer:
        below = []
        for each, rest in layer:
            if isinstance(each, int):
                if missing >> each & 1:
                    return rest
            else:
                below += [(part, [*rest, symbol]) for symbol, part in each.items()]
        layer = below
    return []
