"""Tests of finite machines as tables, and of what two of them do alike."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ecatspec.model.automata.mealy import (
    Mealy,
    alike,
    differences,
    distinguishing_word,
    equivalent,
    isomorphism,
    minimise,
    reachable,
    read_machine,
    separating_word,
    state_cover,
    write_machine,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ecatspec.model.automata.mealy import Word


def names(count: int) -> tuple[str, ...]:
    return tuple(map(str, range(count)))


def machine_of(draw: random.Random, states: int, inputs: int, outputs: int) -> Mealy:
    size = states * inputs
    return Mealy(
        names(states),
        names(inputs),
        names(outputs),
        tuple(draw.randrange(states) for _ in range(size)),
        tuple(draw.randrange(outputs) for _ in range(size)),
    )


def machines(count: int = 60, most: int = 6) -> Iterator[Mealy]:
    draw = random.Random(7)
    for _ in range(count):
        yield machine_of(draw, draw.randint(1, most), draw.randint(1, 3), draw.randint(1, 3))


def words(inputs: int, length: int) -> Iterator[Word]:
    for size in range(length + 1):
        yield from itertools.product(range(inputs), repeat=size)


def slow_difference(first: Mealy, second: Mealy) -> Word | None:
    """The least of the shortest words, by trying all in that order."""
    longest = len(first.states) + len(second.states)
    found = (w for w in words(len(first.inputs), longest) if first.run(w) != second.run(w))
    return next(found, None)


def renamed(machine: Mealy, order: list[int]) -> Mealy:
    """The same machine with its states in another order."""
    width = len(machine.inputs)
    place = {state: number for number, state in enumerate(order)}
    at = [s * width + x for s in order for x in range(width)]
    return Mealy(
        tuple(machine.states[s] for s in order),
        machine.inputs,
        machine.outputs,
        tuple(place[machine.next[a]] for a in at),
        tuple(machine.out[a] for a in at),
        place[machine.initial],
    )


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("next", (0, 1)),
        ("next", (0, 1, 2, 0)),
        ("next", (0, -1, 0, 0)),
        ("out", (0, 0, 0, 2)),
        ("out", ()),
        ("initial", 2),
        ("states", ("a", "a")),
        ("inputs", ("x", "x")),
        ("inputs", ()),
    ],
)
def test_a_table_out_of_shape_or_range_is_refused(field: str, value: object) -> None:
    good = Mealy(("a", "b"), ("x", "y"), ("0", "1"), (0, 1, 1, 0), (0, 0, 1, 1))
    with pytest.raises(ValueError, match=r"."):
        replace(good, **{field: value})  # type: ignore[arg-type]


def test_text_and_back() -> None:
    for machine in machines():
        assert read_machine(write_machine(machine)) == machine
    moved = replace(next(machines(1)), initial=0)
    assert equivalent(read_machine(write_machine(moved)), moved)


@pytest.mark.parametrize("text", ["1 2\n0 0\n0 0\n", "1 2 1\n0 0\n0\n", "1 2 1"])
def test_a_text_of_another_shape_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        read_machine(text)


def test_an_initial_state_elsewhere_survives_the_text() -> None:
    machine = Mealy(("a", "b"), names(1), names(2), (0, 0), (0, 1), initial=1)
    assert equivalent(read_machine(write_machine(machine)), machine)


def test_covers_are_shortest_and_least() -> None:
    for machine in machines():
        found = state_cover(machine)
        for state, word in enumerate(found):
            every = words(len(machine.inputs), len(machine.states))
            assert word == next((w for w in every if machine.after(w) == state), None)
        part = reachable(machine)
        assert len(part.states) == sum(word is not None for word in found)
        assert equivalent(part, machine)


def test_minimising_keeps_what_a_machine_does_and_says_what_was_merged() -> None:
    for machine in machines():
        found = minimise(machine)
        small = found.machine
        assert equivalent(small, machine)
        for one, other in itertools.combinations(range(len(small.states)), 2):
            assert separating_word(small, one, other) is not None
        covered = state_cover(machine)
        for state, place in enumerate(found.place):
            assert (place is None) == (covered[state] is None)
            if place is not None:
                assert machine.states[state] in found.merged[place]
                assert small.states[place] == found.merged[place][0]


def test_a_long_row_of_states_is_minimal_and_quick() -> None:
    count = 2000
    next_ = tuple(min(state + 1, count - 1) for state in range(count))
    out = tuple(int(state == count - 1) for state in range(count))
    row = Mealy(names(count), ("x",), names(2), next_, out)
    assert len(minimise(row).machine.states) == count
    assert len(minimise(replace(row, out=(0,) * count)).machine.states) == 1


def test_the_shortest_difference_is_found() -> None:
    draw = random.Random(3)
    for machine in machines(40, 4):
        other = machine_of(draw, draw.randint(1, 3), len(machine.inputs), len(machine.outputs))
        for second in (other, machine):
            word = slow_difference(machine, second)
            assert distinguishing_word(machine, second) == word
            assert equivalent(machine, second) == (word is None)


def test_names_tell_what_is_the_same_and_not_numbers() -> None:
    first = Mealy(("a", "b"), ("x", "y"), ("0", "1"), (0, 1, 1, 0), (0, 0, 1, 1))
    second = Mealy(("p", "q"), ("y", "x"), ("1", "0"), (1, 0, 0, 1), (1, 1, 0, 0))
    assert equivalent(first, second)
    assert isomorphism(first, second) == (0, 1)
    other = replace(second, outputs=("1", "zero"))
    found = distinguishing_word(first, other)
    assert found == (0,)
    assert differences(first, other)[0].outputs == ("0", "zero")
    with pytest.raises(ValueError, match="only one of the machines has the inputs x, z"):
        alike(first, replace(second, inputs=("y", "z")))


def test_isomorphism_finds_another_order() -> None:
    draw = random.Random(5)
    for machine in machines():
        part = reachable(machine)
        order = list(range(len(part.states)))
        draw.shuffle(order)
        place = {state: number for number, state in enumerate(order)}
        again = renamed(part, order)
        assert isomorphism(part, again) == tuple(place[s] for s in range(len(order)))
        odd = replace(again, out=tuple((o + 1) % 3 for o in again.out), outputs=names(3))
        assert isomorphism(replace(part, outputs=names(3)), odd) is None


def test_every_transition_that_differs_has_its_own_shortest_word() -> None:
    draw = random.Random(11)
    for machine in machines(40, 4):
        size = len(machine.next)
        if len(machine.outputs) == 1:
            continue
        changed = [draw.randrange(size) for _ in range(2)]
        count = len(machine.outputs)
        out = tuple((o + (at in changed)) % count for at, o in enumerate(machine.out))
        other = replace(machine, out=out)
        found = differences(machine, other)
        width = len(machine.inputs)
        covered = state_cover(machine)
        for difference in found:
            word = difference.word
            assert machine.run(word[:-1]) == other.run(word[:-1])
            assert machine.run(word) != other.run(word)
            assert difference.states[0] == difference.states[1]
        places = {(d.states[0], d.symbol) for d in found}
        assert len(places) == len(found)
        # one that both machines reach is found; the other may lie behind it
        reached = [at for at in changed if covered[at // width] is not None]
        wanted = {(machine.states[at // width], machine.inputs[at % width]) for at in reached}
        assert places <= wanted
        assert bool(places) == bool(wanted)


def test_differences_come_shortest_first(shared: Path) -> None:
    machine = read_machine((shared / "bench" / "esm.txt").read_text("utf-8"))
    out = list(machine.out)
    for at in (3, 100, len(out) - 1):
        out[at] = (out[at] + 1) % len(machine.outputs)
    found = differences(machine, replace(machine, out=tuple(out)))
    lengths = [len(difference.word) for difference in found]
    assert len(found) == 3
    assert lengths == sorted(lengths)


@pytest.mark.parametrize("name", ["esm", "cia402_64", "comp1"])
def test_machines_of_the_benchmark_are_minimal(shared: Path, name: str) -> None:
    machine = read_machine((shared / "bench" / f"{name}.txt").read_text("utf-8"))
    assert minimise(machine).machine == machine
    assert distinguishing_word(machine, machine) is None
