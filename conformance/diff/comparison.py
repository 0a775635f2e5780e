"""Compares two specifications as a whole: their facts and their behaviour."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.diff.behaviour import Sides, product
from ecatspec.conformance.diff.machines import MACHINES, Explored, ObservedDevice, explored, setups
from ecatspec.model.analysis.fact_diff import compare_facts
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_standard
from ecatspec.spec.language.store import kept

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from ecatspec.conformance.diff.behaviour import Behaviour
    from ecatspec.model.analysis.fact_diff import Difference, Misprint, Silence
    from ecatspec.model.analysis.facts import Section
    from ecatspec.spec.language.ir import Protocol


@dataclass(frozen=True, slots=True)
class Tried:
    """One machine of both sides that was searched as a whole.

    `states` are those of the two minimal machines over `inputs`, `pairs` those of the product that
    were reached; `odd` inputs are known to one side only, and were left out.
    """

    machine: str
    states: tuple[int, int]
    inputs: tuple[str, ...]
    pairs: int
    differences: int
    odd: tuple[tuple[str, ...], tuple[str, ...]]


@dataclass(frozen=True, slots=True)
class Comparison:
    """All that two specifications differ in; the first of each pair is of the first one.

    `choices` are open ones that were made to go as the other side decides. `untried` says what was
    not compared by trying it out.
    """

    names: tuple[str, str]
    protocols: tuple[Protocol, Protocol]
    differences: tuple[Difference, ...]
    behaviours: tuple[Behaviour, ...]
    tried: tuple[Tried, ...]
    untried: tuple[str, ...]
    choices: tuple[dict[str, str], dict[str, str]]
    silences: tuple[Silence, ...]
    misprints: tuple[Misprint, ...]

    @property
    def count(self) -> int:
        """Give the number of differences of either kind."""
        return len(self.differences) + len(self.behaviours)

    def only(self, sections: Collection[Section]) -> Comparison:
        """Give what it has about some sections; what was tried stays as it is."""
        return replace(
            self,
            differences=tuple(d for d in self.differences if d.section in sections),
            behaviours=tuple(b for b in self.behaviours if b.section in sections),
            silences=tuple(s for s in self.silences if s.section in sections),
        )


_UNTRIED = (
    "mailbox errors, emergencies and SDO information (rules that no machine of these has)",
    "process data that arrive late or never, and all time limits but as numbers",
    "what one object holds but not another: only one entry of each kind is transferred",
)
"""What no product is searched for."""


def compare(
    first: Protocol,
    second: Protocol,
    names: tuple[str, str] | None = None,
    workers: int = 1,
    *,
    keeps: bool = False,
) -> Comparison:
    """Compare two specifications; with two `workers` each device is walked in a process.

    `keeps`: both are as they were loaded, so that what an earlier start found is found again.
    """
    devices = (ObservedDevice(first), ObservedDevice(second))
    models = (devices[0].model, devices[1].model)
    choices = (_settled(first, second), _settled(second, first))
    facts = compare_facts(models[0], models[1], Model(load_standard()))
    plans = tuple(map(setups, models))
    shared = {
        name: tuple(x for x in plans[0][name].alphabet if x in plans[1][name].alphabet)
        for name in MACHINES
        if name in plans[0] and name in plans[1]
    }
    one, other = (
        _Walk(device, shared, own, keeps) for device, own in zip(devices, choices, strict=True)
    )
    walks = _walked(one, other, workers)
    sides = Sides(devices, choices)
    known: set[object] = set()
    behaviours: list[Behaviour] = []
    tried: list[Tried] = []
    for name, inputs in shared.items():
        pair = (walks[0][name], walks[1][name])
        found = product(*pair)
        own = tuple(sides.behaviours(pair, found, known))
        behaviours += own
        alphabets = [set(plan[name].alphabet) for plan in plans]
        odd = (
            tuple(sorted(alphabets[0] - alphabets[1])),
            tuple(sorted(alphabets[1] - alphabets[0])),
        )
        states = (len(pair[0].machine.states), len(pair[1].machine.states))
        tried.append(Tried(name, states, inputs, found.pairs, len(found.met), odd))
    untried = [_missing(name, plans, models) for name in MACHINES if name not in shared]
    return Comparison(
        names or (first.name, second.name),
        (first, second),
        facts.differences,
        tuple(behaviours),
        tuple(tried),
        (*untried, *_UNTRIED),
        choices,
        facts.silences,
        facts.misprints,
    )


def _settled(one: Protocol, other: Protocol) -> dict[str, str]:
    """Give how the open choices of one side go: as the other side decides, where it does."""
    found = {}
    for name, choice in one.choices.items():
        pin = other.pins.get(name)
        ways = {each.name for each in choice.alternatives}
        if name not in one.pins and pin is not None and pin.alternative in ways:
            found[name] = pin.alternative
    return found


def _missing(name: str, plans: tuple[Mapping[str, object], ...], models: tuple[Model, ...]) -> str:
    lack = [m.protocol.name for m, plan in zip(models, plans, strict=True) if name not in plan]
    return f"{name}: {' and '.join(lack)} cannot be driven there (no such objects or process data)"


# --- walks ----------------------------------------------------------------------------------------

_PROGRAM: Final = (
    "ecatspec.spec.language",
    "ecatspec.model",
    "ecatspec.generators",
    "ecatspec.conformance.diff",
)
"""The packages that decide what a walk finds."""


@dataclass(frozen=True, slots=True)
class _Walk:
    """One side: its device, the inputs of each machine that both have, how its choices go."""

    device: ObservedDevice
    inputs: Mapping[str, tuple[str, ...]]
    choices: Mapping[str, str]
    keeps: bool

    def found(self) -> dict[str, Explored]:
        """Give the machines, from an earlier start where it may be."""
        if not self.keeps:
            return self._walked()
        protocol = self.device.model.protocol
        asked = repr((sorted(self.inputs.items()), sorted(self.choices.items()))).encode()
        name = hashlib.sha256(protocol.name.encode() + asked).hexdigest()[:16]
        source = protocol.digest.encode() + asked
        return kept(f"walk-{name}", source, self._walked, _PROGRAM)

    def _walked(self) -> dict[str, Explored]:
        plans = setups(self.device.model)
        return {
            name: explored(self.device, plans[name], inputs, self.choices)
            for name, inputs in self.inputs.items()
        }


_AT_WORK: list[_Walk] = []
"""What the other process walks; it is a copy of this one and need not be told."""


def _walked(
    one: _Walk, other: _Walk, workers: int
) -> tuple[dict[str, Explored], dict[str, Explored]]:
    if workers == 1 or "fork" not in multiprocessing.get_all_start_methods():
        return one.found(), other.found()
    _AT_WORK.append(other)
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("fork"), _begin)
    try:
        found = pool.submit(_other)
        return one.found(), found.result()
    finally:
        pool.shutdown(cancel_futures=True)
        _AT_WORK.pop()


def _begin() -> None:
    """Leave Ctrl-C to the process that waits."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _other() -> dict[str, Explored]:
    return _AT_WORK[-1].found()


def processors() -> int:
    """Give how many processors there are."""
    return os.cpu_count() or 1
