"""Complete test suites without chaining: covers, W, Wp and HSI.

A suite is planned, not written out: ways into the machine, and under each the words that belong to
the state it leads to. So a suite of millions of tests can be counted and given word by word.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from ecatspec.generators.complete.characterisation_sets import (
    Identifiers,
    characterising_set,
    identifiers,
    path_words,
    splitting_tree,
)
from ecatspec.generators.complete.trie import Builder, Trie, graft, trie_of
from ecatspec.model.automata.mealy import state_cover

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ecatspec.model.automata.mealy import Mealy, Word


class Checked(StrEnum):
    """How it was made sure that a suite is complete."""

    EXACT = "exact"
    """No machine of at most m states passes and differs: all ways to fold the suite were tried."""
    SUFFICIENT = "sufficient"
    """The suite meets a condition that completeness follows from."""
    NONE = "none"
    """Not at all: the method promises it, nobody looked."""


class Method(StrEnum):
    """How a suite was made."""

    STATE_COVER = "state cover"
    TRANSITION_COVER = "transition cover"
    W = "W"
    WP = "Wp"
    HSI = "A-HSI"
    CHAIN = "CHAIN"


PROMISING: Final = frozenset({Method.W, Method.WP, Method.HSI, Method.CHAIN})
"""The methods whose suites find every machine of at most m states that differs."""


@dataclass(frozen=True, slots=True)
class Suite:
    """Tests, each a word from the initial state, and what they are worth.

    A deterministic implementation of at most `m` states that passes is equivalent to the machine,
    as far as `method` promises it and `checked` says that somebody looked. `k` is how many states
    that is more than the machine has. `tests` and `symbols` count; a test that another one begins
    with is in it and not counted.

    `core` is a tree of words; under its node `places[i]` hangs the tree `blocks[kinds[i]]`.
    """

    method: Method
    m: int
    k: int
    tests: int
    symbols: int
    core: Trie
    blocks: tuple[Trie, ...] = ()
    places: tuple[int, ...] = ()
    kinds: tuple[int, ...] = ()
    checked: Checked = Checked.NONE

    def words(self) -> Iterator[Word]:
        """Yield the tests one after the other; only the plan is in memory."""
        hangs = dict(zip(self.places, self.kinds, strict=True))
        tails: dict[int, tuple[Word, ...]] = {}
        for node in self.core.leaves():
            way = self.core.word(node)
            kind = hangs.get(node)
            if kind is None:
                yield way
                continue
            if kind not in tails:
                tails[kind] = tuple(self.blocks[kind].words())
            for tail in tails[kind]:
                yield way + tail

    def trie(self) -> Trie:
        """Give all tests as one tree, in memory as a whole."""
        if not self.places:
            return self.core
        parents, symbols = list(self.core.parents), list(self.core.symbols)
        own: dict[int, list[int]] = {}
        for place, kind in zip(self.places, self.kinds, strict=True):
            own.setdefault(kind, []).append(place)
        for kind, places in own.items():
            graft(parents, symbols, places, self.blocks[kind])
        return Trie(parents, symbols)

    def having(self, checked: Checked) -> Suite:
        """Give the same suite, checked in this way."""
        return replace(self, checked=checked)

    def guarantee(self) -> str:
        """Say in one line what the suite is worth."""
        size = f"{self.tests} tests, {self.symbols} symbols"
        if self.method not in PROMISING:
            return f"{self.method}: {size}; promises nothing"
        return f"{self.method}, m = {self.m}, k = {self.k}: {size}; checked: {self.checked}"


def suite_of(method: Method, machine: Mealy, k: int, trie: Trie) -> Suite:
    """Make a suite of words that are there as a tree."""
    tests, symbols = trie.size()
    return Suite(method, len(machine.states) + k, k, tests, symbols, trie)


def cover_words(machine: Mealy) -> list[Word]:
    """Give a shortest word to each state.

    Raises:
        ValueError: No word leads to some state.

    """
    words = state_cover(machine)
    lost = [name for name, word in zip(machine.states, words, strict=True) if word is None]
    if lost:
        raise ValueError(f"states that no word leads to: {', '.join(lost)}")
    return [word for word in words if word is not None]


def state_cover_suite(machine: Mealy) -> Suite:
    """Give tests that reach every state; they promise nothing."""
    trie = trie_of(cover_words(machine))
    return suite_of(Method.STATE_COVER, machine, 0, trie)


def transition_cover_suite(machine: Mealy) -> Suite:
    """Give tests that make every transition; they find every wrong output and nothing else."""
    nothing = ((),) * len(machine.states)
    return _suite(Method.TRANSITION_COVER, machine, 0, nothing, nothing)


def w_suite(machine: Mealy, k: int = 0) -> Suite:
    """Give the suite of the W method: every word of W after every transition."""
    words = characterising_set(splitting_tree(machine))
    everywhere = (words,) * len(machine.states)
    return _suite(Method.W, machine, k, everywhere, everywhere)


def wp_suite(machine: Mealy, k: int = 0) -> Suite:
    """Give the suite of the Wp method: W after the ways, words of the state after what comes last.

    The words of a state are those words of W that tell it from others in the splitting tree.
    """
    tree = splitting_tree(machine)
    everywhere = (characterising_set(tree),) * len(machine.states)
    return _suite(Method.WP, machine, k, everywhere, path_words(tree))


def hsi_suite(machine: Mealy, k: int = 0, known: Identifiers | None = None) -> Suite:
    """Give the suite of the HSI method with adaptive identifiers (A-HSI).

    It finds every deterministic machine of at most `len(machine.states) + k` states that differs.
    The machine must be minimal and reachable as a whole. Memory grows with
    `len(machine.inputs) ** k`, not with the number of tests.

    Raises:
        ValueError: The machine is not minimal, or not reachable.

    """
    own = known or identifiers(machine, splitting_tree(machine))
    return _suite(Method.HSI, machine, k, own.words, own.words)


def _suite(
    method: Method,
    machine: Mealy,
    k: int,
    inner: Sequence[Sequence[Word]],
    last: Sequence[Sequence[Word]],
) -> Suite:
    """Give all transitions after all ways, `k` inputs more, `last` there and `inner` before."""
    if k < 0:
        raise ValueError("k is the number of states that an implementation may have more")
    width, table = len(machine.inputs), machine.next
    cover = cover_words(machine)
    order = sorted(range(len(cover)), key=lambda state: (len(cover[state]), cover[state]))
    node = {order[0]: 0}
    parents, symbols, states = [-1], [-1], [order[0]]
    for state in order:
        parents.extend([node[state]] * width)
        first = len(symbols)
        symbols.extend(range(width))
        for symbol, target in enumerate(table[state * width : (state + 1) * width]):
            states.append(target)
            if target not in node and cover[target] == (*cover[state], symbol):
                node[target] = first + symbol
    base = {node[state]: 1 + place * width for place, state in enumerate(order)}
    blocks = [_block(machine, k, state, inner, last) for state in range(len(cover))]
    # words of the ways themselves: what is left of them where the tree of transitions ends
    left: dict[int, list[Word]] = {}
    for state in order:
        for word in inner[state]:
            at, place = node[state], 0
            while place < len(word) and at in base:
                at = base[at] + word[place]
                place += 1
            if at not in base and place < len(word):
                left.setdefault(at, []).append(word[place:])
    places, kinds = [], []
    for at in range(len(parents)):
        if at in base:
            continue
        kind = states[at]
        if at in left:
            kind = len(blocks)
            blocks.append(_more(blocks[states[at]], left[at], width))
        if len(blocks[kind]) > 1:
            places.append(at)
            kinds.append(kind)
    core = Trie(parents, symbols)
    depths = core.depths()
    sizes = [block.size() for block in blocks]
    hung = set(places)
    alone = [leaf for leaf in core.leaves() if leaf not in hung]
    tests = len(alone) + sum(sizes[kind][0] for kind in kinds)
    total = sum(depths[leaf] for leaf in alone) + sum(
        depths[at] * sizes[kind][0] + sizes[kind][1] for at, kind in zip(places, kinds, strict=True)
    )
    return Suite(
        method,
        len(machine.states) + k,
        k,
        tests,
        total,
        core,
        tuple(blocks),
        tuple(places),
        tuple(kinds),
    )


def _block(
    machine: Mealy,
    k: int,
    state: int,
    inner: Sequence[Sequence[Word]],
    last: Sequence[Sequence[Word]],
) -> Trie:
    """Give what comes after a transition into a state: `k` inputs more and the words there."""
    width = len(machine.inputs)
    builder = Builder(width)
    ends = [(0, state)]
    for level in range(k + 1):
        words = last if level == k else inner
        for node, at in ends:
            for word in words[at]:
                builder.add(word, node)
        if level < k:
            ends = [
                (builder.add((symbol,), node), machine.next[at * width + symbol])
                for node, at in ends
                for symbol in range(width)
            ]
    return builder.trie()


def _more(block: Trie, words: Sequence[Word], width: int) -> Trie:
    """Give a tree with further words in it."""
    builder = Builder(width)
    for node in range(1, len(block)):
        parent, symbol = block.parents[node], block.symbols[node]
        builder.child[parent * width + symbol] = node
        builder.parents.append(parent)
        builder.symbols.append(symbol)
    for word in words:
        builder.add(word)
    return builder.trie()
