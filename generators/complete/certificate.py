"""The only place where a suite is proved complete, or a machine found that it misses.

An implementation that passes a suite answers its tree of words as the machine does. So the tree
can be folded into the implementation: nodes that lead to one state are one. All ways to fold the
tree into at most m states are tried, those that cannot be otherwise first; what does not fold into
the machine itself is a counterexample. For suites that are too large there is a condition on the
tree alone (Vaandrager and Melse, k-A-completeness): it proves completeness, and never refutes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ecatspec.generators.complete.faults import kills, mutant
from ecatspec.generators.complete.separate import identifiers, path_words, splitting_tree
from ecatspec.generators.complete.suites import Checked
from ecatspec.model.mealy import Mealy, equivalent, minimise

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.generators.complete.suites import Suite
    from ecatspec.generators.complete.trie import Trie
    from ecatspec.model.mealy import Word

EFFORT = 5_000_000
"""Steps of comparing and folding that are done where nobody says; some seconds."""
_FEW = 20_000_000
"""Single faults up to which they are tried before anything is proved."""

_ONE_BY_ONE = 2
"""So many states are looked at each for itself; more are first sorted out by the next outputs."""
_DEEPEST = 300
"""Branches within branches; deeper ones count as too much effort."""


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
        found = _Search(machine, tests, m, effort).counterexample()
    except _ExhaustedError:
        complete = sufficient(machine, tests, m - count)
        return Certificate(Checked.SUFFICIENT if complete else Checked.NONE)
    return Certificate(Checked.EXACT) if found is None else Certificate(Checked.NONE, found)


def passes(machine: Mealy, tests: Trie, implementation: Mealy) -> bool:
    """Tell whether an implementation answers all tests as the machine does."""
    width = len(machine.inputs)
    should, does = tests.states(machine), tests.states(implementation)
    return all(
        machine.out[should[parent] * width + symbol]
        == implementation.out[does[parent] * width + symbol]
        for parent, symbol in zip(tests.parents[1:], tests.symbols[1:], strict=True)
    )


# --- all folds ------------------------------------------------------------------------------------


class _ExhaustedError(Exception):
    """The effort is used up."""


class _Search:
    """The tree of a suite with all that never changes, and the effort that is left."""

    def __init__(self, machine: Mealy, tests: Trie, m: int, effort: int) -> None:
        self.machine = machine
        self.tests = tests
        self.width = width = len(machine.inputs)
        self.m = m
        self.effort = effort
        self.states = tests.states(machine)
        self.symbols = tests.symbols
        self.answers = [-1]
        self.child: list[dict[int, int]] = [{} for _ in tests.parents]
        for node in range(1, len(tests)):
            parent, symbol = tests.parents[node], tests.symbols[node]
            self.child[parent][symbol] = node
            self.answers.append(machine.out[self.states[parent] * width + symbol])

    def counterexample(self) -> Mealy | None:
        """Give a machine that passes and differs; None: there is none.

        Raises:
            _ExhaustedError: It was not found out within the effort.

        """
        fold = _Fold(self, self.m)
        fold.begin()
        found = self._search(fold)
        if found is not None:
            assert len(found.states) <= self.m
            assert passes(self.machine, self.tests, found)
            assert not equivalent(self.machine, found)
        return found

    def _search(self, fold: _Fold, depth: int = 0) -> Mealy | None:
        if depth > _DEEPEST:
            raise _ExhaustedError
        while True:
            if not fold.propagate():
                return None
            if not fold.bad and fold.lacking():
                found = fold.completed()
                if found is not None:
                    return found
            place = fold.next_place()
            if place is None:
                return fold.machine() if fold.bad else None
            ways = fold.ways(place)
            for way in ways[:-1]:
                branch = fold.copy()
                if branch.assign(place, way):
                    found = self._search(branch, depth + 1)
                    if found is not None:
                        return found
            if not ways or not fold.assign(place, ways[-1]):
                return None

    def apart(self, one: int, other: int) -> bool:
        """Tell whether the trees under two nodes answer some word differently."""
        child, answers = self.child, self.answers
        work = [(one, other)]
        while work:
            one, other = work.pop()
            self.effort -= 1
            left, right = child[one], child[other]
            if len(left) > len(right):
                left, right = right, left
            for symbol, node in left.items():
                also = right.get(symbol)
                if also is not None:
                    if answers[node] != answers[also]:
                        return True
                    work.append((node, also))
        if self.effort < 0:
            raise _ExhaustedError
        return False


class _Fold:
    """A tree folded in part: states of an implementation, and nodes whose state is not settled.

    A place is the entry of a state and an input. Nodes behind a place whose target is not settled
    wait there, with the states that they can be (`can`, one bit a state).
    """

    def __init__(self, search: _Search, m: int) -> None:
        self.search = search
        self.m = m
        self.width = search.width
        self.labels: list[int] = []
        """The state of the machine that the first node of each state is in."""
        self.home: dict[int, int] = {}
        """The states with a label, one bit a state."""
        self.next: list[int] = []
        self.out: list[int] = []
        self.gives: list[dict[int, int]] = [{} for _ in range(self.width)]
        self.knows = [0] * self.width
        self.waiting: dict[int, tuple[int, ...]] = {}
        self.can: dict[int, int] = {}
        self.fresh: list[tuple[int, int]] = []
        self.changed = True
        self.bad = False
        """Nodes in different states of the machine are one: this is not the machine."""

    def copy(self) -> _Fold:
        """Give a fold that goes its own way from here."""
        found = _Fold(self.search, self.m)
        found.labels = list(self.labels)
        found.home = dict(self.home)
        found.next = list(self.next)
        found.out = list(self.out)
        found.gives = [dict(own) for own in self.gives]
        found.knows = list(self.knows)
        found.waiting = dict(self.waiting)
        found.can = dict(self.can)
        found.fresh = list(self.fresh)
        found.bad = self.bad
        return found

    def begin(self) -> None:
        """Settle the root, and what is certainly another state than all before it."""
        search = self.search
        basis = [0]
        rows: dict[tuple[int, int, int], int] = {}
        taken = {search.states[0]: 0}
        for node in basis:
            for symbol in sorted(search.child[node]):
                child = search.child[node][symbol]
                state = search.states[child]
                if state not in taken and all(search.apart(child, other) for other in basis):
                    taken[state] = len(basis)
                    basis.append(child)
                    rows[node, symbol, child] = taken[state]
        for node in basis:
            self._state(search.states[node])
        for (node, symbol, child), number in rows.items():
            place = taken[search.states[node]] * self.width + symbol
            self.next[place] = number
            del child
        self._settle([(0, 0)])

    def _state(self, label: int) -> int:
        number = len(self.labels)
        self.labels.append(label)
        self.home[label] = self.home.get(label, 0) | 1 << number
        self.next += [-1] * self.width
        self.out += [-1] * self.width
        for place in self.can:
            self.can[place] |= 1 << number
        return number

    def assign(self, place: int, number: int) -> bool:
        """Settle the target of a place; the number after the last is a new state.

        Give whether that does not contradict itself.
        """
        nodes = self.waiting.pop(place)
        del self.can[place]
        self.changed = True
        if number == len(self.labels):
            self._state(self.search.states[nodes[0]])
            self.fresh += [(at, node) for at, own in self.waiting.items() for node in own]
        self.next[place] = number
        return self._settle([(node, number) for node in nodes])

    def _settle(self, work: list[tuple[int, int]]) -> bool:
        search, width, next_, out = self.search, self.width, self.next, self.out
        child, answers, states = search.child, search.answers, search.states
        while work:
            node, number = work.pop()
            if states[node] != self.labels[number]:
                self.bad = True
            search.effort -= 1
            for symbol, below in child[node].items():
                place = number * width + symbol
                answer = answers[below]
                if out[place] < 0:
                    out[place] = answer
                    own = self.gives[symbol]
                    own[answer] = own.get(answer, 0) | 1 << number
                    self.knows[symbol] |= 1 << number
                elif out[place] != answer:
                    return False
                if next_[place] >= 0:
                    work.append((below, next_[place]))
                    continue
                if place in self.waiting:
                    self.waiting[place] += (below,)
                else:
                    self.waiting[place] = (below,)
                    self.can[place] = (1 << len(self.labels)) - 1
                self.fresh.append((place, below))
        if search.effort < 0:
            raise _ExhaustedError
        return True

    def propagate(self) -> bool:
        """Rule out and settle all that cannot be otherwise; give whether anything can be at all."""
        while True:
            self.changed = False
            while self.fresh:
                place, node = self.fresh.pop()
                if place in self.can and not self._look(place, node):
                    return False
            for place in [place for place in self.can if self._doubtful(place)]:
                for node in self.waiting.get(place, ()):
                    if place in self.can and not self._look(place, node):
                        return False
            if self.fresh or self.changed:
                continue
            # what goes as in the machine is settled only where it may tell something
            sure = [] if self.next_place() is None else [p for p in self.can if self._sure(p)]
            for place in sure:
                if place in self.can and not self.assign(place, self.can[place].bit_length() - 1):
                    return False
            if not sure:
                return True

    def _doubtful(self, place: int) -> bool:
        """Tell whether a place can still lead where it would make a difference."""
        if self.bad:
            return self.can[place].bit_count() > 1
        return bool(self.can[place] & ~self._good(place))

    def _sure(self, place: int) -> bool:
        """Tell whether a place can lead to one state only."""
        return self.can[place].bit_count() == 1 and len(self.labels) == self.m

    def _good(self, place: int) -> int:
        """Give the states that the machine's own fold could have there."""
        return self.home.get(self.search.states[self.waiting[place][0]], 0)

    def _look(self, place: int, node: int) -> bool:
        """Rule out states that a node cannot be in; settle the place where one way is left."""
        search = self.search
        can = self.can[place]
        good = 0 if self.bad else self._good(place)
        if (can & ~good).bit_count() > _ONE_BY_ONE:
            for symbol, child in search.child[node].items():
                can &= self.gives[symbol].get(search.answers[child], 0) | ~self.knows[symbol]
        left = can & ~good
        while left:
            bit = left & -left
            left ^= bit
            if self._contradicts(node, bit.bit_length() - 1):
                can ^= bit
        if can != self.can[place]:
            self.can[place] = can
            self.changed = True
        new = len(self.labels) < self.m
        ways = can.bit_count() + new
        if ways == 0:
            return False
        if ways == 1 and (new or self.bad or not can & good):
            return self.assign(place, len(self.labels) if new else can.bit_length() - 1)
        return True

    def _contradicts(self, node: int, number: int) -> bool:
        """Tell whether a node is certainly not in a state: some word below it says so."""
        search, width = self.search, self.width
        child, answers = search.child, search.answers
        work = [(node, number)]
        while work:
            node, number = work.pop()
            search.effort -= 1
            if search.effort < 0:
                raise _ExhaustedError
            for symbol, below in child[node].items():
                place = number * width + symbol
                answer = self.out[place]
                if answer < 0:
                    continue
                if answer != answers[below]:
                    return True
                if self.next[place] >= 0:
                    work.append((below, self.next[place]))
                elif any(search.apart(below, other) for other in self.waiting[place]):
                    return True
        return False

    # --- where it can go on -----------------------------------------------------------------------

    def next_place(self) -> int | None:
        """Give the place with the fewest ways, where that can lead to a difference; None: done."""
        if self.bad or len(self.labels) < self.m or self.lacking():
            doubtful = list(self.can)
        else:
            doubtful = [place for place in self.can if self._doubtful(place)]
        return min(doubtful, key=lambda place: (self.can[place].bit_count(), place), default=None)

    def ways(self, place: int) -> list[int]:
        """Give the states that a place can lead to: wrong ones, a new one, those of the machine."""
        good = self._good(place)
        can = self.can[place]
        numbers = range(len(self.labels))
        wrong = [n for n in numbers if can & ~good & 1 << n]
        new = [len(self.labels)] if len(self.labels) < self.m else []
        return [*wrong, *new, *(n for n in numbers if can & good & 1 << n)]

    def lacking(self) -> bool:
        """Tell whether there is a place that no test makes known, as far as is settled."""
        return -1 in self.out

    def completed(self) -> Mealy | None:
        """Give a counterexample where all goes as in the machine and some place stays unknown."""
        for last in (False, True):
            fold = self.copy()
            while fold.waiting:
                place = next(iter(fold.waiting))
                good = fold._good(place)  # noqa: SLF001 - a fold of its own
                if not good:
                    break
                number = good.bit_length() - 1 if last else (good & -good).bit_length() - 1
                if not fold.assign(place, number):
                    break
            else:
                if fold.lacking():
                    return fold.machine()
        return None

    def machine(self) -> Mealy:
        """Give the fold, in which all is settled, as a machine; what is not known goes wrong."""
        own = self.search.machine
        width, next_, out = self.width, list(self.next), list(self.out)
        outputs = own.outputs if len(own.outputs) > 1 else (*own.outputs, "something else")
        for place, output in enumerate(out):
            if output < 0:
                number, symbol = divmod(place, width)
                right = own.out[self.labels[number] * width + symbol]
                out[place] = (right + 1) % len(outputs)
                next_[place] = 0
        names = [f"{own.states[label]}#{number}" for number, label in enumerate(self.labels)]
        return Mealy(tuple(names), own.inputs, outputs, tuple(next_), tuple(out))


# --- the sufficient condition ---------------------------------------------------------------------


def sufficient(machine: Mealy, tests: Trie, k: int) -> bool:
    """Tell whether a tree of tests meets a condition for completeness with `k` states more.

    Either of two. All words of up to `k` + 1 inputs are there after nodes that reach each state
    once, and of all these nodes each two in different states of the machine answer some word below
    both differently. Or, for `k` = 0, every transition is seen with the words of its target from
    places that must be in its source, as chained suites are made. The words are those that the
    methods of this package use; other suites may be complete and not meet it.
    """
    tree = splitting_tree(machine)
    families = (identifiers(machine, tree).words, path_words(tree))
    seen = _Seen(machine, tests)
    if len(seen.basis) != len(machine.states):
        return False
    return any(
        _harmonised(machine, words)
        and (seen.identified(words, k) or (k == 0 and seen.converging(words)))
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

    def converging(self, words: Sequence[Sequence[Word]]) -> bool:
        """Tell whether every transition is verified from nodes whose state cannot be another."""
        states, width, next_ = self.states, len(self.machine.inputs), self.machine.next
        if not all(self.has(node, word) for node in self.basis for word in words[states[node]]):
            return False
        missing = [set(words[target]) for target in next_]
        verified = bytearray(len(next_))
        waiting: list[list[int]] = [[] for _ in next_]
        certain = bytearray(len(states))
        work = list(self.basis)
        for node in work:
            certain[node] = 1
        while work:
            node = work.pop()
            for symbol, child in self.child[node].items():
                place = states[node] * width + symbol
                if certain[child]:
                    waiting[place].append(child)
                    missing[place].clear()  # a node of the basis: its state is its own
                elif not verified[place]:
                    waiting[place].append(child)
                    missing[place] -= {word for word in missing[place] if self.has(child, word)}
                if verified[place]:
                    fresh = [] if certain[child] else [child]
                elif not missing[place]:
                    verified[place] = 1
                    fresh = [other for other in waiting[place] if not certain[other]]
                else:
                    fresh = []
                for other in fresh:
                    certain[other] = 1
                    work.append(other)
        return all(verified)


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
