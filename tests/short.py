"""The short run that tests of results and campaigns share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

from ecatspec.conformance.base.devices import load
from ecatspec.conformance.run import runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.complete.finite_cover import complete_suites
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import pytest

    from ecatspec.conformance.base.verdict import Result
    from ecatspec.generators.cases.case import Case, Limits
    from ecatspec.generators.complete.finite_cover import Complete

SMALL = "reference"
DRIVE = "reference-drive"
FAULT = "model:fault=preop_to_op_taken"
"""What cases and a complete suite of AL notice."""
_MADE: dict[tuple[object, ...], tuple[Few, ...]] = {}
_EACH = 37
_TESTS = 6


@dataclass(frozen=True)
class Few:
    """The first tests of a complete suite."""

    whole: Complete

    @property
    def layer(self) -> str:
        return self.whole.layer

    @property
    def assumed(self) -> Mapping[str, str]:
        return self.whole.assumed

    @property
    def suite(self) -> Few:
        return self

    @property
    def tests(self) -> int:
        return len(list(self.cases()))

    def cases(self) -> Iterator[Case]:
        return iter([case for _, case in zip(range(_TESTS), self.whole.cases(), strict=False)])

    def guarantee(self) -> str:
        return self.whole.guarantee()


@cache
def cases(device: str) -> tuple[Case, ...]:
    """Some of all kinds, so that choices are found out in many places."""
    return tuple(all_cases(Model(load(device)), NO_LIMITS, "quick"))[::_EACH]


def shorten(patch: pytest.MonkeyPatch) -> None:
    """Make runs short: some cases, the first tests of complete suites, few random ones."""

    def suites(
        model: Model,
        limits: Limits,
        events: frozenset[str],
        choices: Mapping[str, str],
        depth: str,
    ) -> Iterator[Few]:
        key = (model.protocol.name, tuple(sorted(choices.items())), depth)
        if key not in _MADE:
            _MADE[key] = tuple(map(Few, complete_suites(model, limits, events, choices, depth)))
        yield from _MADE[key]

    patch.setattr(runner, "all_cases", lambda model, *_: cases(model.protocol.name))
    patch.setattr(runner, "complete_suites", suites)
    patch.setitem(runner.EXAMPLES, "default", 3)
    patch.setitem(runner.WALKS, "default", 3)


def same(first: Result, second: Result) -> None:
    """Assert that two runs say the same."""
    assert first.verdicts == second.verdicts
    assert timeless(first) == timeless(second)


def timeless(result: Result) -> Result:
    """Give what does not depend on when a run was made."""
    assert result.set_up is not None
    return replace(result, seconds=0, set_up=replace(result.set_up, began=""))
