"""Explores anything that can be driven, as a finite machine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from ecatspec.model.automata.mealy import Mealy, reachable

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from ecatspec.model.automata.mealy import Word

MOST = 20_000
"""States that are explored at most."""


class Drivable(Protocol):
    """Something that starts anew, takes inputs by name, and shows outputs and its state."""

    def reset(self) -> None:
        """Begin at the beginning."""

    def give(self, symbol: str) -> str:
        """Take an input and give the output."""

    def key(self) -> Hashable:
        """Give what tells its present state from others: the same key, the same future."""

    def name(self) -> str:
        """Give words for the present state; several states may have the same."""


def explore(subject: Drivable, inputs: Sequence[str], most: int = MOST) -> Mealy:
    """Give the machine of all states that inputs lead to, breadth first; not minimised.

    The subject is walked on from where it is as long as there is something new near; what is
    walked again must be as it was. A state has the name that the subject gives it, with a number
    where others have it too.

    Raises:
        ValueError: There are more than `most` states, or the same key had another future.

    """
    walk = _Walk(subject, inputs, most)
    walk.run()
    count = len(inputs)
    found = Mealy(
        _distinct(walk.names),
        tuple(inputs),
        tuple(walk.outputs),
        tuple(walk.steps[place][0] for place in range(len(walk.names) * count)),
        tuple(walk.steps[place][1] for place in range(len(walk.names) * count)),
    )
    return reachable(found)


class _Walk:
    """What was found of a subject; a place is the entry of a state and an input."""

    def __init__(self, subject: Drivable, inputs: Sequence[str], most: int) -> None:
        self.subject = subject
        self.inputs = inputs
        self.most = most
        self.places: dict[Hashable, int] = {}
        self.names: list[str] = []
        self.outputs: dict[str, int] = {}
        self.steps: dict[int, tuple[int, int]] = {}
        self.tried: list[int] = []

    def run(self) -> None:
        count = len(self.inputs)
        self.subject.reset()
        begin = state = self._here()
        while True:
            way = self._nearest(state)
            if way is None:
                self.subject.reset()
                state = begin
                way = self._nearest(state)
                if way is None:
                    return
            for symbol in way:
                state = self._step(state, symbol)
            symbol = self.tried[state]
            assert symbol < count
            self.tried[state] += 1
            state = self._step(state, symbol)

    def _here(self) -> int:
        key = self.subject.key()
        if key not in self.places:
            if len(self.places) == self.most:
                raise ValueError(f"more than {self.most} states")
            self.places[key] = len(self.names)
            self.names.append(self.subject.name())
            self.tried.append(0)
        return self.places[key]

    def _step(self, state: int, symbol: int) -> int:
        output = self.subject.give(self.inputs[symbol])
        found = self._here(), self.outputs.setdefault(output, len(self.outputs))
        if self.steps.setdefault(state * len(self.inputs) + symbol, found) != found:
            name, given = self.names[state], self.inputs[symbol]
            raise ValueError(f"{given} in {name} did not lead where it led before")
        return found[0]

    def _nearest(self, state: int) -> tuple[int, ...] | None:
        """Give the shortest known way to a state with an input that was not tried."""
        count = len(self.inputs)
        came: dict[int, tuple[int, int]] = {state: (-1, -1)}
        work = [state]
        for place in work:
            if self.tried[place] < count:
                way = []
                while came[place][0] >= 0:
                    place, symbol = came[place]  # noqa: PLW2901 - back to the beginning
                    way.append(symbol)
                return tuple(reversed(way))
            for symbol in range(count):
                target = self.steps[place * count + symbol][0]
                if target not in came:
                    came[target] = (place, symbol)
                    work.append(target)
        return None


def disagreement(subject: Drivable, machine: Mealy, word: Word) -> int | None:
    """Give the place in a word where a subject answers otherwise than a machine; None: nowhere."""
    subject.reset()
    for place, (symbol, output) in enumerate(zip(word, machine.run(word), strict=True)):
        if subject.give(machine.inputs[symbol]) != machine.outputs[output]:
            return place
    return None


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    """Give names of which none stands twice: the second and later ones get a number."""
    found: list[str] = []
    counts: dict[str, int] = {}
    taken = set(names)
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        wanted = name
        while counts[name] > 1 and wanted in taken:
            wanted = f"{name} #{counts[name]}"
            if wanted in taken:
                counts[name] += 1
        taken.add(wanted)
        found.append(wanted)
    return tuple(found)
