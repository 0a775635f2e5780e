"""Words that tell states apart: splitting tree, state identifiers, W.

The tree splits the set of all states by the shortest word that can, then each part, until the
parts are single states. Identifiers are harmonised: of two states each has a word that begins with
what tells them apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.model.automata.mealy import Mealy, Word


@dataclass(frozen=True, slots=True)
class SplittingTree:
    """How words split the states of a machine; node 0 holds all of them.

    Each list has an entry a node: the node above (-1: none), how deep it lies, the states in it,
    and the word that splits it (empty for a single state). `leaf` has the node of each state alone.
    """

    parents: list[int]
    depths: list[int]
    members: list[list[int]]
    words: list[Word]
    leaf: list[int]

    def common(self, one: int, other: int) -> int:
        """Give the lowest node above two nodes."""
        parents, depths = self.parents, self.depths
        while one != other:
            if depths[one] >= depths[other]:
                one = parents[one]
            else:
                other = parents[other]
        return one

    def below(self, node: int, top: int) -> int:
        """Give the child of `top` that `node` is or lies under."""
        while self.parents[node] != top:
            node = self.parents[node]
        return node

    def splitting(self, states: set[int]) -> Word:
        """Give the shortest known word that some of the states answer differently; () for one."""
        node = -1
        for state in states:
            leaf = self.leaf[state]
            node = leaf if node < 0 else self.common(node, leaf)
        return self.words[node]


def splitting_tree(machine: Mealy) -> SplittingTree:
    """Give the splitting tree of a minimal machine, shortest words first.

    Raises:
        ValueError: Two states of the machine are equivalent.

    """
    count, width = len(machine.states), len(machine.inputs)
    tree = SplittingTree([-1], [0], [list(range(count))], [()], [0] * count)
    values: Sequence[int] = machine.out
    waiting = [0] if count > 1 else []
    length = 1
    while waiting:
        rows = [tuple(values[at : at + width]) for at in range(0, count * width, width)]
        unsplit: list[int] = []
        before = len(tree.parents)
        while waiting:
            node = waiting.pop()
            columns = _columns(machine, rows, tree.members[node])
            if columns is None:
                unsplit.append(node)
            else:
                waiting += _split(tree, node, columns, length)
        if len(tree.parents) == before and length > 1:
            names = ", ".join(machine.states[s] for s in tree.members[unsplit[0]])
            raise ValueError(f"equivalent states: {names}")
        waiting = unsplit
        leaf = tuple(tree.leaf)
        values = [leaf[target] for target in machine.next]
        length += 1
    return tree


def _columns(
    machine: Mealy, rows: list[tuple[int, ...]], states: list[int]
) -> tuple[int, tuple[int, ...]] | None:
    """Give the input that tells most of some states apart, with what it gives; None: no input."""
    own = [rows[state] for state in states]
    if own.count(own[0]) == len(own):
        return None
    width, table = len(machine.inputs), machine.next
    best: tuple[tuple[int, int], int, tuple[int, ...]] | None = None
    for symbol, column in enumerate(zip(*own, strict=True)):
        kinds = len(set(column))
        if kinds > 1:
            targets = [table[state * width + symbol] for state in states]
            kept = len(set(zip(column, targets, strict=True)))
            if best is None or (kept, kinds) > best[0]:
                best = (kept, kinds), symbol, column
    return None if best is None else best[1:]


def _split(
    tree: SplittingTree,
    node: int,
    found: tuple[int, tuple[int, ...]],
    length: int,
) -> list[int]:
    """Split a node by an input, or by an input and the word of a node; give the parts to split."""
    symbol, column = found
    states = tree.members[node]
    if length == 1:
        word: Word = (symbol,)
        part = {value: value for value in column}
    else:
        kinds = iter(dict.fromkeys(column))
        top = next(kinds)
        for kind in kinds:
            top = tree.common(top, kind)
        word = (symbol, *tree.words[top])
        part = {value: tree.below(value, top) for value in set(column)}
    tree.words[node] = word
    groups: dict[int, list[int]] = {}
    for state, value in zip(states, column, strict=True):
        groups.setdefault(part[value], []).append(state)
    again = []
    for group in groups.values():
        child = len(tree.parents)
        tree.parents.append(node)
        tree.depths.append(tree.depths[node] + 1)
        tree.members.append(group)
        tree.words.append(())
        for state in group:
            tree.leaf[state] = child
        if len(group) > 1:
            again.append(child)
    return again


@dataclass(frozen=True, slots=True)
class Identifiers:
    """Words for each state of a machine, none the beginning of another.

    Harmonised: for two states some word of each begins with one and the same word that the states
    answer differently.
    """

    words: tuple[tuple[Word, ...], ...]


def identifiers(machine: Mealy, tree: SplittingTree) -> Identifiers:
    """Give few words for each state, each as long as it still tells states apart.

    All states begin with the same word; where they go on depends on what was answered. A part that
    ends in one and the same state begins again with another word.
    """
    count, width = len(machine.states), len(machine.inputs)
    rows = [machine.out[at : at + width] for at in range(0, count * width, width)]
    found: list[list[Word]] = [[] for _ in range(count)]
    groups = [list(range(count))] if count > 1 else []
    while groups:
        group = groups.pop()
        # states as they were at the beginning of the word, where they are now, the word so far
        work: list[tuple[list[int], list[int], Word]] = [(group, group, ())]
        while work:
            own, now, word = work.pop()
            distinct = set(now)
            if len(distinct) == 1:
                for state in own:
                    found[state].append(word)
                if len(own) > 1:
                    groups.append(own)
                continue
            best = _columns(machine, rows, list(distinct))
            more = tree.splitting(distinct) if best is None else (best[0],)
            parts: dict[Word, tuple[list[int], list[int]]] = {}
            answers = {state: machine.run(more, state) for state in distinct}
            after = {state: machine.after(more, state) for state in distinct}
            for state, place in zip(own, now, strict=True):
                begun, moved = parts.setdefault(answers[place], ([], []))
                begun.append(state)
                moved.append(after[place])
            work += [(begun, moved, (*word, *more)) for begun, moved in parts.values()]
    return Identifiers(tuple(_prefix_free(words) for words in found))


def extended(
    machine: Mealy, words: Sequence[Sequence[Word]], k: int
) -> tuple[tuple[Word, ...], ...]:
    """Give for each state all up to `k` inputs, and after these the words of the state reached.

    Two places after which all of this was seen as in one state of the machine are one state of
    every implementation of at most `k` states more, where no two of its states are equivalent.
    """
    width = len(machine.inputs)
    own = [tuple(each) or ((),) for each in words]
    found = tuple(own)
    for _ in range(k):
        found = tuple(
            _prefix_free(
                [
                    *own[state],
                    *(
                        (symbol, *word)
                        for symbol in range(width)
                        for word in found[machine.next[state * width + symbol]]
                    ),
                ]
            )
            for state in range(len(own))
        )
    return found


def _prefix_free(words: list[Word]) -> tuple[Word, ...]:
    """Give the words that no other one begins with."""
    ordered = sorted(set(words))
    return tuple(
        word
        for place, word in enumerate(ordered)
        if place + 1 == len(ordered) or ordered[place + 1][: len(word)] != word
    )


def characterising_set(tree: SplittingTree) -> tuple[Word, ...]:
    """Give words that together tell all states apart (W)."""
    return _prefix_free([word for word in tree.words if word])


def path_words(tree: SplittingTree) -> tuple[tuple[Word, ...], ...]:
    """Give for each state the words on its way through the tree: harmonised, and in W."""
    found = []
    for leaf in tree.leaf:
        words = []
        node = tree.parents[leaf]
        while node >= 0:
            words.append(tree.words[node])
            node = tree.parents[node]
        found.append(_prefix_free(words))
    return tuple(found)
