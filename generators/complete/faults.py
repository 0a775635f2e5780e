"""Single faults of a finite machine, and which of them a suite kills.

An output fault gives another output at one transition, a transfer fault leads elsewhere. A suite
kills a fault when some test of it is answered otherwise. Faults are not run one by one: all tests
share their prefixes, and all targets of one transition are tried at once as a set of states, a
number with one bit a state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ecatspec.model.automata.mealy import blocks, equivalent, state_cover

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.complete.trie import Trie
    from ecatspec.model.automata.mealy import Mealy


@dataclass(frozen=True, slots=True)
class Fault:
    """One wrong entry of a table: a target where `transfer`, else an output."""

    state: int
    symbol: int
    wrong: int
    transfer: bool


@dataclass(frozen=True, slots=True)
class Kills:
    """How many single faults there are, of both kinds, and what became of them.

    `equivalent` ones change nothing that a word could show, so nothing can kill them. `survivors`
    names the first of those that a longer suite could kill.
    """

    faults: int
    killed: int
    equivalent: int
    survivors: tuple[Fault, ...]

    @property
    def score(self) -> float:
        """Give the share of the faults that are not equivalent."""
        real = self.faults - self.equivalent
        return 1.0 if not real else self.killed / real


def faults(machine: Mealy) -> Iterator[Fault]:
    """Yield all single faults, transition by transition: outputs, then targets."""
    width = len(machine.inputs)
    for place, (target, output) in enumerate(zip(machine.next, machine.out, strict=True)):
        state, symbol = divmod(place, width)
        for wrong in range(len(machine.outputs)):
            if wrong != output:
                yield Fault(state, symbol, wrong, transfer=False)
        for wrong in range(len(machine.states)):
            if wrong != target:
                yield Fault(state, symbol, wrong, transfer=True)


def mutant(machine: Mealy, fault: Fault) -> Mealy:
    """Give the machine with a fault in it."""
    place = fault.state * len(machine.inputs) + fault.symbol
    table = machine.next if fault.transfer else machine.out
    wrong = (*table[:place], fault.wrong, *table[place + 1 :])
    return replace(machine, next=wrong) if fault.transfer else replace(machine, out=wrong)


def kills(machine: Mealy, tests: Trie, most: int = 10) -> Kills:
    """Count the single faults that a suite kills, and name `most` of those that it should have.

    Exact: the same numbers come out when every mutant is run through every test.
    """
    width, states, outputs = len(machine.inputs), len(machine.states), len(machine.outputs)
    reached = [word is not None for word in state_cover(machine)]
    found = _Kills(machine, tests)
    block = blocks(machine)
    minimal = len(set(block)) == states and all(reached)
    killed = equal = 0
    survivors: list[Fault] = []
    for place in range(states * width):
        state, symbol = divmod(place, width)
        target, output = machine.next[place], machine.out[place]
        if not reached[state]:
            equal += outputs - 1 + states - 1
            continue
        alive = found.alive(place)
        killed += states - 1 - len(alive)
        if found.entries[place]:
            killed += outputs - 1
        else:
            wrong = [o for o in range(outputs) if o != output][: most - len(survivors)]
            survivors += [Fault(state, symbol, o, transfer=False) for o in wrong]
        for other in alive:
            fault = Fault(state, symbol, other, transfer=True)
            # of a minimal machine no transfer fault is equivalent
            if not minimal and (
                block[other] == block[target] or equivalent(machine, mutant(machine, fault))
            ):
                equal += 1
            elif len(survivors) < most:
                survivors.append(fault)
    return Kills(states * width * (states + outputs - 2), killed, equal, tuple(survivors))


class _Kills:
    """A suite prepared for many faults of one machine."""

    __slots__ = ("agree", "children", "entries", "machine", "symbols", "wanted")

    def __init__(self, machine: Mealy, tests: Trie) -> None:
        width = len(machine.inputs)
        self.machine = machine
        self.symbols = tests.symbols
        self.children = tests.children()
        states = tests.states(machine)
        out = machine.out
        places = [
            states[parent] * width + symbol
            for parent, symbol in zip(tests.parents[1:], tests.symbols[1:], strict=True)
        ]
        self.wanted = [-1, *(out[place] for place in places)]
        # where a test makes a transition for the first time: up to there nothing has changed
        self.entries: list[list[int]] = [[] for _ in out]
        used = bytearray(len(out))
        work = list(reversed(self.children[0]))
        while work:
            node = work.pop()
            if node < 0:
                used[~node] = 0
                continue
            place = places[node - 1]
            if not used[place]:
                used[place] = 1
                self.entries[place].append(node)
                work.append(~place)
            work += self.children[node]
        # for an input and an output: the states that give it
        self.agree: list[dict[int, int]] = []
        for symbol in range(width):
            own: dict[int, int] = {}
            for state, output in enumerate(out[symbol::width]):
                own[output] = own.get(output, 0) | 1 << state
            self.agree.append(own)

    def alive(self, place: int) -> list[int]:
        """Give the wrong targets of a transition that no test notices."""
        target = self.machine.next[place]
        width = len(self.machine.inputs)
        left = ((1 << len(self.machine.states)) - 1) ^ (1 << target)
        symbols, children, out = self.symbols, self.children, self.machine.out
        first = {symbols[node] for entry in self.entries[place] for node in children[entry]}
        for symbol in first:
            left &= self.agree[symbol][out[target * width + symbol]]
        found = []
        while left:
            bit = left & -left
            left ^= bit
            wrong = bit.bit_length() - 1
            if not any(self._noticed(place, wrong, entry) for entry in self.entries[place]):
                found.append(wrong)
        return found

    def _noticed(self, place: int, wrong: int, entry: int) -> bool:
        """Tell whether what comes after an entry is answered otherwise from another target."""
        machine, symbols, children, wanted = (
            self.machine,
            self.symbols,
            self.children,
            self.wanted,
        )
        next_, out, width = machine.next, machine.out, len(machine.inputs)
        work = [(node, wrong) for node in children[entry]]
        while work:
            node, state = work.pop()
            at = state * width + symbols[node]
            if out[at] != wanted[node]:
                return True
            after = wrong if at == place else next_[at]
            work += [(child, after) for child in children[node]]
        return False
