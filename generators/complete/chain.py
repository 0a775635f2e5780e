"""The only place for complete suites with few resets: tests that go on as long as they can (CHAIN).

A reset of a real device costs more than an input. So a test does not end after a transition and
the words that identify its target: where it is known which state an implementation must be in, the
next transition is tried from there.

How that is known: the tests begin with the ways to all states and the words of each state, so an
implementation of no more states has exactly these. A transition is *verified* once every word of
its target has been seen after it, from places that are known to be in its source; then every place
behind it is known too, in all tests that wait for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.complete.separate import Identifiers, identifiers, splitting_tree
from ecatspec.generators.complete.suites import Method, Suite, cover_words, suite_of
from ecatspec.generators.complete.trie import trie_of

if TYPE_CHECKING:
    from ecatspec.model.mealy import Mealy, Word

RESET = 5
"""What a reset costs, in inputs, where nobody says."""
_LOOKED_AT = 2
"""So many tests that could go on are looked at; the one with the nearest work goes on."""


def chain_suite(machine: Mealy, reset: int = RESET, known: Identifiers | None = None) -> Suite:
    """Give a chained suite for implementations of as many states as the machine (k = 0).

    It finds every deterministic machine of at most `len(machine.states)` states that differs.
    `reset` is the price of a reset in inputs: a dearer one makes fewer and longer tests. The
    machine must be minimal and reachable as a whole; memory grows with the symbols of the suite.

    Raises:
        ValueError: The machine is not minimal, or not reachable.

    """
    own = known or identifiers(machine, splitting_tree(machine))
    tests = _Chain(machine, own, reset).run()
    trie = trie_of(tests)
    return suite_of(Method.CHAIN, machine, 0, trie)


class _Chain:
    """Tests that grow. A transition is the place of its entry in the tables of the machine."""

    __slots__ = (
        "at",
        "count",
        "cover",
        "failed",
        "known",
        "left",
        "links",
        "masks",
        "next",
        "open",
        "order",
        "parked",
        "recent",
        "reset",
        "resumed",
        "routes",
        "seen",
        "tests",
        "todo",
        "verified",
        "waiting",
        "width",
        "words",
    )

    def __init__(self, machine: Mealy, own: Identifiers, reset: int) -> None:
        self.width = width = len(machine.inputs)
        count = len(machine.states)
        self.next = machine.next
        self.reset = reset
        # where there is one state only, nothing tells that a transition leads to it
        self.words = [[list(word) for word in words] or [[]] for words in own.words]
        self.cover = cover_words(machine)
        self.order = sorted(range(count), key=lambda s: (len(self.cover[s]), self.cover[s]))
        # of each transition: words of its target not seen yet, those seen as bits, all seen
        self.left = [len(self.words[target]) for target in machine.next]
        self.seen = [0] * len(machine.next)
        self.verified = bytearray(len(machine.next))
        self.count = 0
        # of each state: transitions to verify, the last first; verified ones as target -> input
        self.todo = [list(range((s + 1) * width - 1, s * width - 1, -1)) for s in range(count)]
        self.open = (1 << count) - 1
        self.links: list[dict[int, int]] = [{} for _ in range(count)]
        self.masks = [0] * count
        # of each test: its inputs, how many of them lead to a known place, the state there
        self.tests: list[list[int]] = []
        self.known: list[int] = []
        self.at: list[int] = []
        self.waiting: dict[int, list[int]] = {}
        """Tests that cannot go on before a transition is verified."""
        self.parked: list[list[int]] = [[] for _ in range(count)]
        """Tests that could go on, by the state that they are in."""
        self.recent: list[int] = []
        self.resumed: list[int] = []
        self.routes: list[tuple[int, list[int]] | None] = [None] * count
        self.failed = [0] * count

    def run(self) -> list[list[int]]:
        """Give all tests."""
        self._begin()
        cover, todo = self.cover, self._todo
        first, test = 0, -1
        while True:
            while first < len(self.order) and not todo(self.order[first]):
                first += 1
            if first == len(self.order):
                return self.tests
            limit = self.reset + len(cover[self.order[first]])
            test, found = self._continued(test, limit)
            if found is None:
                test, found = self._parked(limit)
            if found is None:
                state = self.order[first]
                test, found = self._test(cover[state], state), (state, [])
            state, way = found
            self.tests[test] += way
            self.known[test] += len(way)
            self.at[test] = state
            place = self.todo[state][-1]
            symbol, seen = place % self.width, self.seen[place]
            words = self.words[self.next[place]]
            self.tests[test].append(symbol)
            self.tests[test] += next(w for n, w in enumerate(words) if not seen >> n & 1)
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
            for word in self.words[state]:
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
        """Give the transitions of a state to verify, with one that is not verified at the end."""
        found, verified = self.todo[state], self.verified
        while found and verified[found[-1]]:
            found.pop()
        return found

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
        state, target = place // self.width, self.next[place]
        self.verified[place] = 1
        self.count += 1
        self.links[state].setdefault(target, place % self.width)
        self.masks[state] |= 1 << target
        waiting = self.waiting.pop(place, None)
        if waiting:
            self.resumed += waiting

    def _advance(self, test: int) -> int:
        """Follow a test over verified transitions, and note the words after others.

        Give the transition that is not verified and so stops it, -1 at the end of the test.
        """
        inputs, known, state = self.tests[test], self.known[test], self.at[test]
        next_, width, verified = self.next, self.width, self.verified
        end = len(inputs)
        while known < end:
            place = state * width + inputs[known]
            if not verified[place]:
                seen = self.seen[place]
                for number, word in enumerate(self.words[next_[place]]):
                    after = known + 1
                    if not seen >> number & 1 and inputs[after : after + len(word)] == word:
                        seen |= 1 << number
                        self.left[place] -= 1
                self.seen[place] = seen
                if self.left[place]:
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
            else:
                self.waiting.setdefault(place, []).append(each)

    def _park(self, test: int) -> None:
        state = self.at[test]
        self.parked[state].append(test)
        self.recent.append(state)

    def _goes_on(self, test: int) -> bool:
        """Follow a test that grew; tell whether it can go on from a known place.

        Where it stops after the beginning of a word that is wanted there, the word is finished:
        that is cheaper than to come again.
        """
        while True:
            place = self._advance(test)
            while self.resumed:
                self._settle(self.resumed.pop())
            if place < 0:
                return True
            if self.verified[place]:
                continue
            rest = self.tests[test][self.known[test] + 1 :]
            seen = self.seen[place]
            for number, word in enumerate(self.words[self.next[place]]):
                if not seen >> number & 1 and word[: len(rest)] == rest:
                    self.tests[test] += word[len(rest) :]
                    break
            else:
                self.waiting.setdefault(place, []).append(test)
                return False
