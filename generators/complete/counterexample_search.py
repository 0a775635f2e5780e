"""Folds the tree of a suite into machines, in every way possible.

What must be so is settled first: nodes that are certainly different states, targets that can be one
state only. Then one place after the other is tried. A machine with two equivalent states does what
a smaller one does, so it is enough to find those without. The effort is counted in steps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.model.automata.mealy import Mealy

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from ecatspec.generators.complete.trie import Trie

_ONE_BY_ONE = 2
"""Maximum number of states compared one by one; more are first sorted by their next outputs."""
_DEEPEST = 300
"""Branches within branches; deeper ones count as too much effort."""


class ExhaustedError(Exception):
    """The effort is used up."""


class Search:
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
            ExhaustedError: It was not found out within the effort.

        """
        fold = _Fold(self, self.m)
        fold.begin()
        return self._search(fold)

    def _search(self, fold: _Fold, depth: int = 0) -> Mealy | None:
        if depth > _DEEPEST:
            raise ExhaustedError
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
            raise ExhaustedError
        return False


class _Fold:
    """A tree folded in part: states of an implementation, and nodes whose state is not settled.

    A place is the entry of a state and an input. Nodes behind a place whose target is not settled
    wait there, with the states that they can be (`can`, one bit a state).
    """

    def __init__(self, search: Search, m: int) -> None:
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
        self.hindered: dict[int, tuple[int, Hashable]] = {}
        """Places that a twin was sought at in vain: the place that is not known, and what of it."""
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
            raise ExhaustedError
        return True

    def propagate(self) -> bool:
        """Rule out and settle all that cannot be otherwise; give whether anything can be at all."""
        while True:
            self.changed = False
            while self.fresh:
                place, node = self.fresh.pop()
                if place in self.can and not self._look(place, node):
                    return False
            # what goes as in the machine is settled only where it may tell something
            sure = []
            if self.next_place() is not None:
                sure = [p for p in self.can if self._sure(p)] or self._twins()
            for place in sure:
                if place in self.can and not self.assign(place, self.can[place].bit_length() - 1):
                    return False
            if sure:
                continue
            for place in [place for place in self.can if self._doubtful(place)]:
                for node in self.waiting.get(place, ()):
                    if place in self.can and not self._look(place, node):
                        return False
            if not self.fresh and not self.changed:
                return True
            self.hindered.clear()

    def _twins(self) -> list[int]:
        """Give places where a new state would be equivalent to the one that is there: not so then.

        Looked for where one state is left over, and each other one is of another state of the
        machine.
        """
        count = len(self.search.machine.states)
        if self.bad or self.m != count + 1 or not len(self.labels) == len(self.home) == count:
            return []
        found = []
        for place, can in self.can.items():
            if can != self._good(place):
                continue
            before = self.hindered.get(place)
            if before is not None and before[1] == self._known(before[0]):
                continue
            hinders = self._hinders(place, can.bit_length() - 1)
            if hinders is None:
                found.append(place)
            else:
                self.hindered[place] = hinders, self._known(hinders)
        return found

    def _known(self, place: int) -> Hashable:
        """Give what is known of a place, to see later whether it is more."""
        return len(self.waiting.get(place, ())), self.can.get(place), self.next[place]

    def _hinders(self, place: int, twin: int) -> int | None:
        """Give a place not known well enough to call a new state and its twin equivalent.

        None: they are, for each input leads both to one and the same state, or to one of the two.
        """
        child, states = self.search.child, self.search.states
        below: list[list[int]] = [[] for _ in range(self.width)]
        for node in self.waiting[place]:
            for symbol, each in child[node].items():
                below[symbol].append(each)
        everything = (1 << len(self.labels)) - 1
        for symbol, own in enumerate(below):
            if not own:
                return place
            loop = states[own[0]] == self.labels[twin]
            good = self.home[states[own[0]]]
            beside = twin * self.width + symbol
            behind = {place: own}
            if self.next[beside] < 0:
                if self.can.get(beside) != good:
                    return beside
                behind[beside] = list(self.waiting[beside])
            for at, nodes in behind.items():
                if not (loop or self._apart(nodes, below)):
                    return at
            wrong = everything ^ good
            for node in own:
                wrong = self._possible(node, wrong)
            while wrong:
                bit = wrong & -wrong
                wrong ^= bit
                if not any(self._contradicts(node, bit.bit_length() - 1) for node in own):
                    return place
        return None

    def _apart(self, nodes: Sequence[int], below: list[list[int]]) -> bool:
        """Tell whether one of some nodes is certainly not in a state, of which `below` is known."""
        search = self.search
        return any(
            search.answers[each] != search.answers[other] or search.apart(each, other)
            for node in nodes
            for symbol, each in search.child[node].items()
            for other in below[symbol]
        )

    def _possible(self, node: int, states: int) -> int:
        """Give those of some states that answer the next inputs of a node as it does."""
        search = self.search
        for symbol, child in search.child[node].items():
            states &= self.gives[symbol].get(search.answers[child], 0) | ~self.knows[symbol]
        return states

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
        can = self.can[place]
        good = 0 if self.bad else self._good(place)
        if (can & ~good).bit_count() > _ONE_BY_ONE:
            can = self._possible(node, can)
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
                raise ExhaustedError
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
