"""Tests of complete suites: what they find, and what is said of them."""

from __future__ import annotations

import itertools
import random
from functools import cache, partial
from typing import TYPE_CHECKING

import pytest

from ecatspec.generators.complete.certificate import certify, certify_tests, passes
from ecatspec.generators.complete.chain import chain_suite
from ecatspec.generators.complete.characterisation_sets import (
    characterising_set,
    extended,
    identifiers,
    path_words,
    splitting_tree,
)
from ecatspec.generators.complete.counterexample_search import Search
from ecatspec.generators.complete.faults import Fault, faults, kills, mutant
from ecatspec.generators.complete.machines import al_machine, drive_machine
from ecatspec.generators.complete.sufficient import sufficient
from ecatspec.generators.complete.suites import (
    Checked,
    Method,
    Suite,
    hsi_suite,
    state_cover_suite,
    transition_cover_suite,
    w_suite,
    wp_suite,
)
from ecatspec.generators.complete.trie import Trie, trie_of
from ecatspec.model.automata.mealy import Mealy, equivalent, minimise, read_machine, state_cover
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from ecatspec.model.automata.mealy import Word

SUITES: dict[str, Callable[[Mealy], Suite]] = {
    "W": w_suite,
    "Wp": wp_suite,
    "A-HSI": hsi_suite,
    "CHAIN": chain_suite,
}
each_suite = pytest.mark.parametrize("name", sorted(SUITES))
ONE_MORE: dict[str, Callable[[Mealy], Suite]] = {
    "A-HSI": partial(hsi_suite, k=1),
    "CHAIN": partial(chain_suite, k=1),
}
SMALL = 600
"""Transitions of a machine that k = 1 is tried for with every run; see bench/complete.py."""
each_with_one_more = pytest.mark.parametrize("name", sorted(ONE_MORE))


def names(count: int) -> tuple[str, ...]:
    return tuple(map(str, range(count)))


def all_machines(states: int, inputs: int, outputs: int) -> Iterator[Mealy]:
    size = states * inputs
    for next_ in itertools.product(range(states), repeat=size):
        for out in itertools.product(range(outputs), repeat=size):
            yield Mealy(names(states), names(inputs), names(outputs), next_, out)


def is_minimal(machine: Mealy) -> bool:
    return len(minimise(machine).machine.states) == len(machine.states)


@cache
def small() -> tuple[Mealy, ...]:
    """All machines of two states and some of three, two inputs and outputs."""
    return (*all_machines(2, 2, 2), *random.Random(1).sample(list(all_machines(3, 2, 2)), 4000))


def drawn(count: int, states: int, inputs: int = 3, outputs: int = 2) -> Iterator[Mealy]:
    """Minimal machines of about so many states."""
    draw = random.Random(9)
    while count:
        size = states * inputs
        next_ = tuple(draw.randrange(states) for _ in range(size))
        out = tuple(draw.randrange(outputs) for _ in range(size))
        found = minimise(Mealy(names(states), names(inputs), names(outputs), next_, out)).machine
        if len(found.states) > 1:
            count -= 1
            yield found


def passing(machine: Mealy, tests: Trie, most: int) -> Iterator[Mealy | None]:
    """Give all machines of at most so many states that pass; None: one that is not all known.

    They are made while the tests are followed: an answer is as it should be, a target is tried in
    all ways when it is first needed.
    """
    width = len(machine.inputs)
    should = tests.states(machine)
    work: list[tuple[int, tuple[int, ...], dict[int, tuple[int, int]], int]] = [(1, (0,), {}, 1)]
    while work:
        node, at, rows, used = work.pop()
        while node < len(tests):
            parent, symbol = tests.parents[node], tests.symbols[node]
            answer = machine.out[should[parent] * width + symbol]
            place = at[parent] * width + symbol
            if place not in rows:
                for target in range(min(used + 1, most)):
                    more = {**rows, place: (target, answer)}
                    work.append((node + 1, (*at, target), more, max(used, target + 1)))
                break
            if rows[place][1] != answer:
                break
            at = (*at, rows[place][0])
            node += 1
        else:
            if len(rows) < used * width:
                yield None
            else:
                next_, out = zip(*(rows[place] for place in range(used * width)), strict=True)
                yield Mealy(names(used), machine.inputs, machine.outputs, next_, out)


def escapes(machine: Mealy, tests: Trie, most: int) -> bool:
    """Tell by trying all whether a machine of at most so many states passes and differs."""
    return any(o is None or not equivalent(machine, o) for o in passing(machine, tests, most))


@pytest.fixture(scope="module")
def esm(shared: Path) -> Mealy:
    return read_machine((shared / "bench" / "esm.txt").read_text("utf-8"))


@pytest.fixture(scope="module")
def drive(shared: Path) -> Mealy:
    return read_machine((shared / "bench" / "cia402_64.txt").read_text("utf-8"))


# --- words that tell states apart -----------------------------------------------------------------


def common(one: Sequence[int], other: Sequence[int]) -> Word:
    both = zip(one, other, strict=False)
    return tuple(a for a, b in itertools.takewhile(lambda pair: pair[0] == pair[1], both))


def test_words_tell_all_states_apart() -> None:
    for machine in drawn(30, 7):
        tree = splitting_tree(machine)
        everything = characterising_set(tree)
        for family in (identifiers(machine, tree).words, path_words(tree)):
            for one, other in itertools.combinations(range(len(machine.states)), 2):
                assert any(
                    machine.run(word, one) != machine.run(word, other)
                    for a, b in itertools.product(family[one], family[other])
                    if (word := common(a, b))
                )
                assert any(machine.run(w, one) != machine.run(w, other) for w in everything)
        for words in identifiers(machine, tree).words:
            assert all(common(a, b) not in (a, b) for a, b in itertools.combinations(words, 2))


def test_a_machine_with_equivalent_states_is_refused() -> None:
    twins = Mealy(names(2), names(1), names(1), (0, 1), (0, 0))
    with pytest.raises(ValueError, match="equivalent states: 0, 1"):
        splitting_tree(twins)
    lonely = Mealy(names(2), names(1), names(2), (0, 1), (0, 1))
    with pytest.raises(ValueError, match="states that no word leads to: 1"):
        hsi_suite(lonely)


# --- suites as values -----------------------------------------------------------------------------


def by_the_book(machine: Mealy, k: int) -> Trie:
    """Ways, up to k + 1 inputs, and the words of the state: HSI word by word."""
    own = identifiers(machine, splitting_tree(machine)).words
    width = len(machine.inputs)
    ways = [word for word in state_cover(machine) if word is not None]
    middles = [m for size in range(k + 2) for m in itertools.product(range(width), repeat=size)]
    return trie_of(
        way + m + w for way in ways for m in middles for w in own[machine.after(way + m)] or [()]
    )


def test_extended_words_are_inputs_and_the_words_of_the_state_reached() -> None:
    for machine in drawn(5, 4):
        own = identifiers(machine, splitting_tree(machine)).words
        width = len(machine.inputs)
        for k in range(3):
            for state, words in enumerate(extended(machine, own, k)):
                middles = [
                    m for size in range(k + 1) for m in itertools.product(range(width), repeat=size)
                ]
                wanted = trie_of(m + w for m in middles for w in own[machine.after(m, state)])
                assert sorted(words) == sorted(wanted.words())


@pytest.mark.parametrize("k", [0, 1, 2])
def test_a_planned_suite_is_the_suite_of_the_book(k: int) -> None:
    for machine in drawn(10, 5):
        suite = hsi_suite(machine, k)
        words = sorted(suite.words())
        assert words == sorted(by_the_book(machine, k).words())
        assert words == sorted(suite.trie().words())
        assert (suite.tests, suite.symbols) == (len(words), sum(map(len, words)))
        assert (suite.m, suite.k, suite.method) == (len(machine.states) + k, k, Method.HSI)


def test_a_suite_says_what_it_is_worth(esm: Mealy) -> None:
    suite = hsi_suite(esm)
    assert suite.guarantee() == ("A-HSI, m = 10, k = 0: 311 tests, 1220 symbols; checked: none")
    checked = suite.having(certify(esm, suite).checked)
    assert checked.guarantee().endswith("checked: exact")
    assert "promises nothing" in transition_cover_suite(esm).guarantee()
    assert state_cover_suite(esm).tests == 5


def test_sizes(esm: Mealy, drive: Mealy) -> None:
    assert hsi_suite(esm, 1).tests == 9952
    assert hsi_suite(drive).tests == 960
    assert hsi_suite(drive, 1).tests == 61474
    assert hsi_suite(esm, 2).tests == 318464
    chained = chain_suite(esm)
    assert (chained.tests, chained.symbols) == (10, 813)
    chained = chain_suite(drive)
    assert (chained.tests, chained.symbols) == (138, 5727)


def test_one_state_more_is_chained_too(esm: Mealy) -> None:
    chained = chain_suite(esm, k=1)
    assert (chained.m, chained.k, chained.method) == (11, 1, Method.CHAIN)
    assert (chained.tests, chained.symbols) == (1003, 39182)
    assert chain_suite(esm, reset=0, k=1).tests > chained.tests
    for make in (chain_suite, hsi_suite):
        with pytest.raises(ValueError, match="an implementation may have more"):
            make(esm, k=-1)


def test_a_dearer_reset_makes_no_more_tests(esm: Mealy) -> None:
    sizes = [chain_suite(esm, reset).tests for reset in (0, 1, 5, 50)]
    assert sizes == sorted(sizes, reverse=True)


# --- what suites find -----------------------------------------------------------------------------


@each_suite
def test_no_machine_of_as_many_states_escapes(name: str) -> None:
    draw = random.Random(2)
    minimal = [machine for machine in small() if is_minimal(machine)]
    for machine in draw.sample(minimal, 12):
        tests = SUITES[name](machine).trie()
        for other in small():
            if len(other.states) <= len(machine.states) and passes(machine, tests, other):
                assert equivalent(machine, other)


@each_with_one_more
def test_no_machine_of_one_state_more_escapes_k_1(name: str) -> None:
    draw = random.Random(3)
    minimal = [m for m in all_machines(2, 2, 2) if is_minimal(m)]
    for machine in draw.sample(minimal, 8):
        tests = ONE_MORE[name](machine).trie()
        for other in small():
            if passes(machine, tests, other):
                assert equivalent(machine, other)


@pytest.mark.parametrize(("states", "inputs", "k"), [(2, 2, 2), (2, 3, 1), (3, 2, 1), (3, 3, 0)])
def test_nothing_escapes_a_chained_suite_whatever_a_reset_costs(
    states: int, inputs: int, k: int
) -> None:
    for machine in drawn(8, states, inputs):
        for reset in (0, 5, 50):
            tests = chain_suite(machine, reset, k=k).trie()
            assert not escapes(machine, tests, len(machine.states) + k)
            assert sufficient(machine, tests, k)


@each_suite
def test_suites_kill_every_single_fault(name: str, esm: Mealy, drive: Mealy) -> None:
    for machine in (esm, drive):
        found = kills(machine, SUITES[name](machine).trie())
        assert found.score == 1.0
        assert found.killed == found.faults


def test_covers_do_not_kill_every_fault(esm: Mealy, drive: Mealy) -> None:
    scores = [round(kills(m, transition_cover_suite(m).trie()).score, 3) for m in (esm, drive)]
    assert scores == [0.757, 0.343]


def test_faults_are_counted_as_if_each_were_run() -> None:
    draw = random.Random(6)
    for _ in range(25):
        states, inputs, outputs = (draw.randint(1, 3) for _ in range(3))
        size = states * inputs
        machine = Mealy(
            names(states),
            names(inputs),
            names(outputs),
            tuple(draw.randrange(states) for _ in range(size)),
            tuple(draw.randrange(outputs) for _ in range(size)),
        )
        words = [
            tuple(draw.randrange(inputs) for _ in range(draw.randint(0, 6)))
            for _ in range(draw.randint(0, 5))
        ]
        tests = trie_of(words)
        killed, same = set[Fault](), set[Fault]()
        every = set(faults(machine))
        for fault in every:
            other = mutant(machine, fault)
            if not passes(machine, tests, other):
                killed.add(fault)
            elif equivalent(machine, other):
                same.add(fault)
        found = kills(machine, tests, len(every))
        assert (found.faults, found.killed, found.equivalent) == (
            len(every),
            len(killed),
            len(same),
        )
        assert set(found.survivors) == every - killed - same


# --- certificates ---------------------------------------------------------------------------------


@each_suite
def test_complete_suites_are_certified(name: str, esm: Mealy, drive: Mealy) -> None:
    for machine in (esm, drive):
        suite = SUITES[name](machine)
        assert certify(machine, suite).checked is Checked.EXACT
        assert sufficient(machine, suite.trie(), 0)


@each_with_one_more
def test_one_state_more_is_certified(name: str, esm: Mealy) -> None:
    suite = ONE_MORE[name](esm)
    assert certify(esm, suite).checked is Checked.EXACT
    assert sufficient(esm, suite.trie(), 1)
    assert not sufficient(esm, SUITES[name](esm).trie(), 1)
    found = certify_tests(esm, SUITES[name](esm).trie(), 11).counterexample
    assert found is not None
    assert len(found.states) <= 11


@pytest.mark.parametrize("name", device_names())
def test_chained_suites_of_all_devices_are_certified(name: str) -> None:
    model = Model(load_device(name))
    for found in (al_machine(model), drive_machine(model)):
        if found is not None:
            machine = found.machine
            assert certify(machine, chain_suite(machine)).checked is Checked.EXACT
            if len(machine.next) < SMALL:
                suite = chain_suite(machine, k=1)
                assert certify(machine, suite).checked is Checked.EXACT
                assert sufficient(machine, suite.trie(), 1)


def test_too_little_effort_says_nothing_or_less(drive: Mealy) -> None:
    assert certify(drive, chain_suite(drive), 10).checked is Checked.SUFFICIENT
    assert certify_tests(drive, transition_cover_suite(drive).trie(), 15, 10).checked is (
        Checked.NONE
    )


def test_certificates_agree_with_trying_all_machines() -> None:
    draw = random.Random(5)
    minimal = [machine for machine in all_machines(2, 2, 2) if is_minimal(machine)]
    every = list(all_machines(2, 2, 2))
    outcomes = set()
    for machine in draw.sample(minimal, 60):
        words = list(draw.choice(list(SUITES.values()))(machine).words())
        for _ in range(draw.randint(0, 2)):
            if words:
                words.pop(draw.randrange(len(words)))
        tests = trie_of(words)
        escapes = any(
            passes(machine, tests, other) and not equivalent(machine, other) for other in every
        )
        found = certify_tests(machine, tests, 2)
        assert (found.counterexample is not None) == escapes
        assert (found.checked is Checked.EXACT) == (not escapes)
        assert not (escapes and sufficient(machine, tests, 0))
        outcomes.add(escapes)
    assert outcomes == {True, False}


def test_certificates_for_one_state_more_agree_with_trying_all_machines() -> None:
    draw = random.Random(7)
    outcomes = set()
    for machine in (*drawn(70, 3, 2), *drawn(20, 2)):
        most = len(machine.states) + 1
        whole = list(draw.choice(list(ONE_MORE.values()))(machine).words())
        for _ in range(8):
            words = list(whole)
            for _ in range(draw.randint(0, 2)):
                place = draw.randrange(len(words))
                words[place] = words[place][: -draw.randint(1, 2)]
            tests = trie_of(words)
            missed = escapes(machine, tests, most)
            assert (Search(machine, tests, most, 10**7).counterexample() is not None) == missed
            assert not (missed and sufficient(machine, tests, 1))
            outcomes.add(missed)
    assert outcomes == {True, False}


def test_three_states_agree_too() -> None:
    draw = random.Random(8)
    minimal = [machine for machine in small() if is_minimal(machine)]
    for machine in draw.sample(minimal, 25):
        words = list(hsi_suite(machine).words())
        words.pop(draw.randrange(len(words)))
        tests = trie_of(words)
        found = certify_tests(machine, tests, 3)
        if found.counterexample is None:
            assert found.checked is Checked.EXACT
            for other in small():
                assert equivalent(machine, other) or not passes(machine, tests, other)
        else:
            assert len(found.counterexample.states) <= 3
            assert passes(machine, tests, found.counterexample)
            assert not equivalent(machine, found.counterexample)


def test_a_test_taken_out_is_missed(esm: Mealy) -> None:
    draw = random.Random(4)
    for suite in (hsi_suite(esm), w_suite(esm)):
        words = list(suite.words())
        for _ in range(6):
            place = draw.randrange(len(words))
            tests = trie_of(words[:place] + words[place + 1 :])
            found = certify_tests(esm, tests, suite.m).counterexample
            assert found is not None
            assert passes(esm, tests, found)
            assert not equivalent(esm, found)


def test_a_test_taken_out_of_a_chained_suite_is_never_called_complete_wrongly() -> None:
    for machine in drawn(6, 5):
        words = list(chain_suite(machine).words())
        for place in range(len(words)):
            tests = trie_of(words[:place] + words[place + 1 :])
            exact = certify_tests(machine, tests, len(machine.states), 200_000)
            if exact.counterexample is not None:
                assert not sufficient(machine, tests, 0)
            if sufficient(machine, tests, 0):
                assert exact.checked is not Checked.NONE


def test_only_minimal_machines_and_sensible_bounds_are_certified(esm: Mealy) -> None:
    twins = Mealy(names(2), names(1), names(1), (1, 0), (0, 0))
    with pytest.raises(ValueError, match="minimal and reachable"):
        certify_tests(twins, trie_of([(0,)]), 2)
    with pytest.raises(ValueError, match="more than 9 states"):
        certify_tests(esm, hsi_suite(esm).trie(), 9)


def test_a_machine_of_one_state_needs_its_inputs_only() -> None:
    one = Mealy(names(1), names(3), names(2), (0, 0, 0), (0, 1, 0))
    for suite in (hsi_suite(one), chain_suite(one)):
        assert suite.symbols == 3
        assert certify(one, suite).checked is Checked.EXACT
    assert certify(one, hsi_suite(one, 1)).checked is Checked.EXACT
    assert certify_tests(one, hsi_suite(one).trie(), 2).counterexample is not None
