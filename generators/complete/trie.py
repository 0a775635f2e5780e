"""Sets of words that share their prefixes: two flat lists, one entry for each node."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import repeat
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ecatspec.model.automata.mealy import Mealy, Word

Branches: TypeAlias = "dict[int, Branches] | int"
"""Words as dictionaries by input, one in the other; at the end of each word its number."""


@dataclass(frozen=True, slots=True)
class Trie:
    """Words as a tree. Node 0 is the root; a node comes after its parent.

    `parents` and `symbols` have one entry a node, those of the root are -1. The words are those
    of the leaves: a word that another one begins with is in it and not told.
    """

    parents: Sequence[int]
    symbols: Sequence[int]

    def __len__(self) -> int:
        """Give the number of nodes, the root included."""
        return len(self.parents)

    def depths(self) -> list[int]:
        """Give the length of the word to each node."""
        found = [0] * len(self.parents)
        for node in range(1, len(found)):
            found[node] = found[self.parents[node]] + 1
        return found

    def leaves(self) -> list[int]:
        """Give the nodes without children, in the order of their numbers; the root is none."""
        leaf = bytearray(b"\1") * len(self.parents)
        for parent in self.parents[1:]:
            leaf[parent] = 0
        leaf[0] = 0
        return [node for node, alone in enumerate(leaf) if alone]

    def size(self) -> tuple[int, int]:
        """Give the number of words and of their symbols."""
        depths = self.depths()
        leaves = self.leaves()
        return len(leaves), sum(depths[leaf] for leaf in leaves)

    def word(self, node: int) -> Word:
        """Give the word to a node."""
        found = []
        while node:
            found.append(self.symbols[node])
            node = self.parents[node]
        return tuple(reversed(found))

    def words(self) -> Iterator[Word]:
        """Yield the words of the leaves."""
        return map(self.word, self.leaves())

    def children(self) -> list[list[int]]:
        """Give the children of each node, in the order of their numbers."""
        found: list[list[int]] = [[] for _ in self.parents]
        for node in range(1, len(self.parents)):
            found[self.parents[node]].append(node)
        return found

    def states(self, machine: Mealy, start: int | None = None) -> list[int]:
        """Give the state of a machine at each node."""
        width, table = len(machine.inputs), machine.next
        found = [machine.initial if start is None else start] * len(self.parents)
        for node in range(1, len(found)):
            found[node] = table[found[self.parents[node]] * width + self.symbols[node]]
        return found


class Builder:
    """A tree of words that grows; `width` is the number of inputs."""

    __slots__ = ("child", "parents", "symbols", "width")

    def __init__(self, width: int) -> None:
        """Begin with the empty word."""
        self.width = width
        self.child: dict[int, int] = {}
        """Node * width + input -> node."""
        self.parents = [-1]
        self.symbols = [-1]

    def add(self, word: Iterable[int], node: int = 0) -> int:
        """Add a word from a node on, and give the node where it ends."""
        child, width = self.child, self.width
        for symbol in word:
            key = node * width + symbol
            found = child.get(key)
            if found is None:
                found = child[key] = len(self.parents)
                self.parents.append(node)
                self.symbols.append(symbol)
            node = found
        return node

    def trie(self) -> Trie:
        """Give the tree as it is now."""
        return Trie(self.parents, self.symbols)


def trie_of(words: Iterable[Sequence[int]]) -> Trie:
    """Give the tree of words: in their order, so that each shares its beginning with the last."""
    parents, symbols = [-1], [-1]
    last: Sequence[int] = ()
    path = [0]  # the nodes of the last word
    for word in sorted(map(tuple, words)):
        shared, most = 0, min(len(last), len(word))
        while shared < most and last[shared] == word[shared]:
            shared += 1
        if shared < len(word):
            first = len(parents)
            end = first + len(word) - shared
            parents.append(path[shared])
            parents.extend(range(first, end - 1))
            symbols.extend(word[shared:])
            path[shared + 1 :] = range(first, end)
            last = word
    return Trie(parents, symbols)


def branches(words: Sequence[Word]) -> Branches:
    """Give words, none the beginning of another, with their numbers in this order."""
    if len(words) == 1 and not words[0]:
        return 0
    root: dict[int, Branches] = {}
    for number, word in enumerate(words):
        branch = root
        for symbol in word[:-1]:
            below = branch.setdefault(symbol, {})
            assert not isinstance(below, int), "a word begins with another one"
            branch = below
        branch[word[-1]] = number
    return root


def graft(parents: list[int], symbols: list[int], places: Sequence[int], block: Trie) -> None:
    """Hang one copy of a tree under each of some nodes; copies lie side by side, node by node."""
    count = len(places)
    base = len(parents) - count  # node n of the block is at base + n * count
    for node in range(1, len(block.parents)):
        parent = block.parents[node]
        if parent:
            first = base + parent * count
            parents.extend(range(first, first + count))
        else:
            parents.extend(places)
        symbols.extend(repeat(block.symbols[node], count))
