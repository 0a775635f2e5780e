"""Finite machines as tables: equivalence, distinguishing words, minimisation.

A machine is deterministic and complete: every state has one next state and one output for every
input. States, inputs and outputs are numbers 0, 1, ... with names; both tables are flat, the entry
of state `s` and input `x` is at `s * len(inputs) + x`. A word is a tuple of inputs.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

Word: TypeAlias = tuple[int, ...]
"""Inputs by number, in order."""


@dataclass(frozen=True, slots=True)
class Mealy:
    """A machine as two flat tables. `next` and `out` have `len(states) * len(inputs)` entries."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    next: tuple[int, ...]
    out: tuple[int, ...]
    initial: int = 0

    def __post_init__(self) -> None:
        """Check shape and range.

        Raises:
            ValueError: A table has another size than states times inputs, an entry lies out of
                range, or a name stands twice.

        """
        size = len(self.states) * len(self.inputs)
        if not size:
            raise ValueError("a machine has at least one state and one input")
        for name, table, limit in (
            ("next", self.next, len(self.states)),
            ("out", self.out, len(self.outputs)),
        ):
            if len(table) != size:
                raise ValueError(f"{name} has {len(table)} entries, not {size}")
            if min(table) < 0 or max(table) >= limit:
                raise ValueError(f"{name} has an entry out of 0 to {limit - 1}")
        if not 0 <= self.initial < len(self.states):
            raise ValueError(f"there is no state {self.initial} to begin with")
        for kind, names in (("state", self.states), ("input", self.inputs)):
            if len(set(names)) != len(names):
                raise ValueError(f"two {kind}s have one name")

    def step(self, state: int, symbol: int) -> tuple[int, int]:
        """Give the next state and the output."""
        at = state * len(self.inputs) + symbol
        return self.next[at], self.out[at]

    def run(self, word: Iterable[int], start: int | None = None) -> Word:
        """Give the outputs of a word, from the initial state or from `start`."""
        state, width = self.initial if start is None else start, len(self.inputs)
        found = []
        for symbol in word:
            at = state * width + symbol
            found.append(self.out[at])
            state = self.next[at]
        return tuple(found)

    def after(self, word: Iterable[int], start: int | None = None) -> int:
        """Give the state after a word, from the initial state or from `start`."""
        state, width = self.initial if start is None else start, len(self.inputs)
        for symbol in word:
            state = self.next[state * width + symbol]
        return state

    def word(self, names: Iterable[str]) -> Word:
        """Give the word of inputs by name."""
        numbers = {name: number for number, name in enumerate(self.inputs)}
        return tuple(numbers[name] for name in names)

    def names(self, word: Iterable[int]) -> tuple[str, ...]:
        """Give the names of the inputs of a word."""
        return tuple(self.inputs[symbol] for symbol in word)


# --- as text --------------------------------------------------------------------------------------


def read_machine(text: str) -> Mealy:
    """Read a machine: a line `states inputs outputs`, rows of next states, rows of outputs.

    State 0 is the initial one; names are the numbers.

    Raises:
        ValueError: The text has another shape.

    """
    lines = text.split("\n", 1)
    sizes = [int(part) for part in lines[0].split()]
    if len(sizes) != 3 or len(lines) == 1:  # noqa: PLR2004 - states, inputs, outputs
        raise ValueError("the first line is `states inputs outputs`")
    states, inputs, _ = sizes
    numbers = tuple(map(int, lines[1].split()))
    half = states * inputs
    if len(numbers) != 2 * half:
        raise ValueError(f"{len(numbers)} entries, not {2 * half}")
    named = [tuple(map(str, range(size))) for size in sizes]
    return Mealy(named[0], named[1], named[2], numbers[:half], numbers[half:])


def write_machine(machine: Mealy) -> str:
    """Write a machine so that `read_machine` gives its tables; state 0 becomes the initial one."""
    width = len(machine.inputs)
    order = [machine.initial, *(s for s in range(len(machine.states)) if s != machine.initial)]
    place = {state: number for number, state in enumerate(order)}
    lines = [f"{len(order)} {width} {len(machine.outputs)}"]
    for table, given in ((machine.next, place.__getitem__), (machine.out, int)):
        lines += [
            " ".join(str(given(entry)) for entry in table[s * width : (s + 1) * width])
            for s in order
        ]
    return "\n".join(lines) + "\n"


# --- one machine ----------------------------------------------------------------------------------


def state_cover(machine: Mealy) -> tuple[Word | None, ...]:
    """Give the least of the shortest words to each state, None where none leads."""
    width = len(machine.inputs)
    found: list[Word | None] = [None] * len(machine.states)
    found[machine.initial] = ()
    work = deque([machine.initial])
    while work:
        state = work.popleft()
        way = found[state] or ()
        row = machine.next[state * width : (state + 1) * width]
        for symbol, target in enumerate(row):
            if found[target] is None:
                found[target] = (*way, symbol)
                work.append(target)
    return tuple(found)


def reachable(machine: Mealy) -> Mealy:
    """Give the machine of the states that words lead to, in the order of breadth first."""
    width = len(machine.inputs)
    order = [machine.initial]
    place = {machine.initial: 0}
    for state in order:
        for target in machine.next[state * width : (state + 1) * width]:
            if target not in place:
                place[target] = len(order)
                order.append(target)
    if order == list(range(len(machine.states))):
        return machine
    return Mealy(
        tuple(machine.states[state] for state in order),
        machine.inputs,
        machine.outputs,
        tuple(place[t] for s in order for t in machine.next[s * width : (s + 1) * width]),
        tuple(o for s in order for o in machine.out[s * width : (s + 1) * width]),
    )


@dataclass(frozen=True, slots=True)
class Minimal:
    """A machine without equivalent states.

    `place` has the state of `machine` for each state of the machine before, None where no word
    leads to it; `merged` has the names of the states that became one.
    """

    machine: Mealy
    place: tuple[int | None, ...]
    merged: tuple[tuple[str, ...], ...]


def blocks(machine: Mealy) -> list[int]:
    """Give for each state the number of its class of equivalent states.

    Of a block that splits, the largest part keeps its number: a state changes it at most as often
    as the machine can be halved, and only what leads to such a state is looked at again.
    """
    width, count = len(machine.inputs), len(machine.states)
    rows = [machine.out[at : at + width] for at in range(0, count * width, width)]
    numbers: dict[tuple[int, ...], int] = {}
    block = [numbers.setdefault(row, len(numbers)) for row in rows]
    if len(numbers) == count:
        return block
    members: list[set[int]] = [set() for _ in numbers]
    for state, number in enumerate(block):
        members[number].add(state)
    targets: list[Callable[[list[int]], object]]
    targets = [itemgetter(*machine.next[at : at + width]) for at in range(0, count * width, width)]
    before: list[set[int]] | None = None
    touched = {number for number, own in enumerate(members) if len(own) > 1}
    while touched:
        moved: list[tuple[int, set[int]]] = []
        for number in touched:
            parts: dict[object, set[int]] = {}
            for state in members[number]:
                parts.setdefault(targets[state](block), set()).add(state)
            if len(parts) > 1:
                kept = max(parts.values(), key=len)
                moved += [(number, part) for part in parts.values() if part is not kept]
        if not moved:
            return block
        if before is None:
            before = _predecessors(machine)
        touched = set()
        for number, part in moved:
            members[number] -= part
            for state in part:
                block[state] = len(members)
            members.append(part)
        for _, part in moved:
            for state in part:
                touched |= {block[earlier] for earlier in before[state]}
        touched = {number for number in touched if len(members[number]) > 1}
    return block


def _predecessors(machine: Mealy) -> list[set[int]]:
    width = len(machine.inputs)
    found: list[set[int]] = [set() for _ in machine.states]
    for state in range(len(machine.states)):
        for target in set(machine.next[state * width : (state + 1) * width]):
            found[target].add(state)
    return found


def minimise(machine: Mealy) -> Minimal:
    """Give the smallest machine that does the same; a state has the name of its first member."""
    part = reachable(machine)
    block = blocks(part)
    names = {name: state for state, name in enumerate(part.states)}
    first: dict[int, int] = {}
    for state, number in enumerate(block):
        first.setdefault(number, state)
    if len(first) == len(part.states):
        found = part
        place = {state: state for state in range(len(block))}
    else:
        width = len(part.inputs)
        new = {number: place for place, number in enumerate(first)}
        place = {state: new[number] for state, number in enumerate(block)}
        found = Mealy(
            tuple(part.states[state] for state in first.values()),
            part.inputs,
            part.outputs,
            tuple(place[t] for s in first.values() for t in part.next[s * width : (s + 1) * width]),
            tuple(o for s in first.values() for o in part.out[s * width : (s + 1) * width]),
        )
    merged: list[list[str]] = [[] for _ in found.states]
    for state, name in enumerate(part.states):
        merged[place[state]].append(name)
    places = tuple(place[names[name]] if name in names else None for name in machine.states)
    return Minimal(found, places, tuple(map(tuple, merged)))


# --- two machines ---------------------------------------------------------------------------------


def alike(first: Mealy, second: Mealy) -> Mealy:
    """Give the second machine with inputs and outputs in the order of the first.

    Outputs that the first lacks come after its own.

    Raises:
        ValueError: The machines have different inputs.

    """
    if set(first.inputs) != set(second.inputs):
        odd = sorted(set(first.inputs) ^ set(second.inputs))
        raise ValueError(f"only one of the machines has the inputs {', '.join(odd)}")
    if (first.inputs, first.outputs) == (second.inputs, second.outputs):
        return second
    numbers = {name: number for number, name in enumerate(first.outputs)}
    outputs = [numbers.setdefault(name, len(numbers)) for name in second.outputs]
    width = len(second.inputs)
    columns = [second.inputs.index(name) for name in first.inputs]
    at = [row + column for row in range(0, len(second.next), width) for column in columns]
    return Mealy(
        second.states,
        first.inputs,
        tuple(numbers),
        tuple(second.next[place] for place in at),
        tuple(outputs[second.out[place]] for place in at),
        second.initial,
    )


def distinguishing_word(first: Mealy, second: Mealy) -> Word | None:
    """Give the least of the shortest words that two machines answer differently; None: equivalent.

    Words are in the inputs of the first; names of inputs and outputs tell what is the same.
    """
    return _difference(first, first.initial, alike(first, second), second.initial)


def separating_word(machine: Mealy, one: int, other: int) -> Word | None:
    """Give the least of the shortest words that two states answer differently; None: equivalent."""
    return _difference(machine, one, machine, other)


def _difference(first: Mealy, one: int, second: Mealy, other: int) -> Word | None:
    width, out, also = len(first.inputs), first.out, second.out
    ahead, there = first.next, second.next
    begin = (one, other)
    came: dict[tuple[int, int], tuple[int, int]] = {begin: begin}
    work = [begin]
    same: set[int] = set()
    """States of which it is known that the pair with itself was seen."""
    for pair in work:
        one, other = pair
        left, right = one * width, other * width
        up, to = left + width, right + width
        if out[left:up] != also[right:to]:
            last = next(x for x in range(width) if out[left + x] != also[right + x])
            return (*_way(first, second, came, pair), last)
        row, also_row = ahead[left:up], there[right:to]
        if row == also_row:
            # as in two editions of one specification: little of it is new
            fresh = set(row).difference(same)
            targets = [(s, s) for s in dict.fromkeys(row) if s in fresh] if fresh else []
            same |= fresh
        else:
            targets = list(dict.fromkeys(zip(row, also_row, strict=True)))
        for target in targets:
            if target not in came:
                came[target] = pair
                work.append(target)
    return None


def _way(
    first: Mealy, second: Mealy, came: dict[tuple[int, int], tuple[int, int]], pair: tuple[int, int]
) -> Word:
    """Give the word to a pair; each step takes the least input that makes it."""
    width = len(first.inputs)
    found: list[int] = []
    while came[pair] != pair:
        before = came[pair]
        left, right = before[0] * width, before[1] * width
        row = zip(first.next[left : left + width], second.next[right : right + width], strict=True)
        found.append(next(x for x, targets in enumerate(row) if targets == pair))
        pair = before
    return tuple(reversed(found))


def equivalent(first: Mealy, second: Mealy) -> bool:
    """Tell whether two machines give the same outputs for every word (union of classes)."""
    second = alike(first, second)
    width, size = len(first.inputs), len(first.states)
    root = list(range(size + len(second.states)))

    def find(number: int) -> int:
        while root[number] != number:
            root[number] = root[root[number]]
            number = root[number]
        return number

    work = [(first.initial, second.initial)]
    root[size + second.initial] = first.initial
    while work:
        one, other = work.pop()
        left, right = one * width, other * width
        if first.out[left : left + width] != second.out[right : right + width]:
            return False
        for pair in set(
            zip(first.next[left : left + width], second.next[right : right + width], strict=True)
        ):
            a, b = find(pair[0]), find(size + pair[1])
            if a != b:
                root[b] = a
                work.append(pair)
    return True


def isomorphism(first: Mealy, second: Mealy) -> tuple[int, ...] | None:
    """Give the state of the second machine for each of the first; None: there is no such map.

    Both machines must be reachable as a whole; None also where they are not.
    """
    second = alike(first, second)
    width = len(first.inputs)
    if len(first.states) != len(second.states):
        return None
    place: dict[int, int] = {first.initial: second.initial}
    taken = {second.initial}
    work = [first.initial]
    for state in work:
        left, right = state * width, place[state] * width
        if first.out[left : left + width] != second.out[right : right + width]:
            return None
        for one, other in zip(
            first.next[left : left + width], second.next[right : right + width], strict=True
        ):
            known = place.get(one)
            if known is None and other not in taken:
                place[one] = other
                taken.add(other)
                work.append(one)
            elif known != other:
                return None
    if len(place) != len(first.states):
        return None
    return tuple(place[state] for state in range(len(first.states)))


@dataclass(frozen=True, slots=True)
class Difference:
    """One transition that two machines answer differently, and the way to it.

    `word` ends with `symbol`; before it both machines give the same outputs. `states` and
    `outputs` are those of the first and of the second machine, by name.
    """

    word: Word
    symbol: str
    states: tuple[str, str]
    outputs: tuple[str, str]


def differences(first: Mealy, second: Mealy) -> tuple[Difference, ...]:
    """Give all transitions that differ, each pair of states and input once, shortest word first.

    A transition counts where words lead that both machines answer alike before it; of several
    words the least of the shortest is taken. What comes after a different answer is not looked at.
    """
    second = alike(first, second)
    width = len(first.inputs)
    begin = (first.initial, second.initial)
    came: dict[tuple[int, int], tuple[int, int]] = {begin: begin}
    work = [begin]
    found: list[Difference] = []
    for pair in work:
        one, other = pair
        left, right = one * width, other * width
        up, to = left + width, right + width
        given, also = first.out[left:up], second.out[right:to]
        targets = list(zip(first.next[left:up], second.next[right:to], strict=True))
        if given != also:
            way = _way(first, second, came, pair)
            odd = [x for x in range(width) if given[x] != also[x]]
            found += [
                Difference(
                    (*way, x),
                    first.inputs[x],
                    (first.states[one], second.states[other]),
                    (first.outputs[given[x]], second.outputs[also[x]]),
                )
                for x in odd
            ]
            targets = [target for x, target in enumerate(targets) if x not in set(odd)]
        for target in dict.fromkeys(targets):
            if target not in came:
                came[target] = pair
                work.append(target)
    return tuple(found)


def from_rows(
    rows: Sequence[Sequence[tuple[str, str]]],
    inputs: Sequence[str],
    states: Sequence[str],
) -> Mealy:
    """Make a machine of rows, one a state: the name of the next state and of the output each."""
    place = {name: number for number, name in enumerate(states)}
    outputs: dict[str, int] = {}
    out = [outputs.setdefault(output, len(outputs)) for row in rows for _, output in row]
    return Mealy(
        tuple(states),
        tuple(inputs),
        tuple(outputs),
        tuple(place[target] for row in rows for target, _ in row),
        tuple(out),
    )
