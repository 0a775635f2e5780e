"""Searches samples of values for one that passes tests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from ecatspec.spec.language.functions import EDGES, EXCLUSIVE, FUNCTIONS, IMPLIES
from ecatspec.spec.language.ir import (
    Binary,
    Call,
    Gap,
    Name,
    Rule,
)
from ecatspec.spec.language.references import (
    ParameterOfInput,
    Ref,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


BUDGET: Final = 20_000
"""How many partial combinations are looked at before a pair of rules is given up."""
Sample: TypeAlias = int | str
Dimension: TypeAlias = Ref | Call | Binary
Row: TypeAlias = Rule | Gap
Test: TypeAlias = "Callable[[Environment], Sample | None]"
_Waiting: TypeAlias = "tuple[Test, tuple[Dimension, ...]]"
"""A test that is not decided, and the dimensions that it asks for."""


class Environment(dict[Dimension, Sample]):
    """Values of dimensions; `missing` are those that were asked for and have none yet."""

    def __init__(self) -> None:
        super().__init__()
        self.missing: dict[Dimension, None] = {}

    def value(self, dimension: Dimension) -> Sample | None:
        """Give the sample of a dimension; None, and a note that it is missing, without one."""
        found = self.get(dimension)
        if found is None:
            self.missing[dimension] = None
        return found


def shared_samples(
    samples: dict[Dimension, set[Sample]], pairs: set[tuple[Dimension, Dimension]]
) -> dict[Dimension, set[Sample]]:
    """Dimensions that are compared with each other get each other's samples."""
    for _ in range(2):
        for one, other in pairs:
            if one in samples and other in samples:
                together = samples[one] | samples[other]
                samples = samples | {one: together, other: together}
    return samples


def search_samples(
    tests: Sequence[Test], samples: dict[Dimension, set[Sample]]
) -> Environment | None:
    """Depth first, along the test that asks for least, with a cut where one is false for sure.

    What is decided stays so, and what is not changes only with a dimension that it asked for.
    """
    environment = Environment()
    budget = BUDGET

    def found(waiting: Sequence[_Waiting], given: Dimension | None) -> bool:
        nonlocal budget
        left: list[_Waiting] = []
        for row in waiting:
            if given is not None and given not in row[1]:
                left.append(row)
                continue
            environment.missing.clear()
            result = row[0](environment)
            if result is None:
                left.append((row[0], tuple(environment.missing)))
            elif not result:
                return False
        if not _possible(environment):
            return False
        if not left:
            return True
        fewest = min((asked for _, asked in left), key=len)
        for value in sorted(samples.get(fewest[0], ()), key=_order) if fewest else ():
            budget -= 1
            if budget <= 0:
                break
            environment[fewest[0]] = value
            if found(left, fewest[0]):
                return True
        if fewest:
            environment.pop(fewest[0], None)
        return False

    return environment if found([(test, ()) for test in tests], None) else None


def _order(value: Sample) -> tuple[bool, int, str]:
    return (isinstance(value, str), value if isinstance(value, int) else 0, str(value))


def _possible(environment: Environment) -> bool:
    """Whether the answers of functions agree with each other, and edges with what they lead to."""
    held = {
        (d.function, d.arguments): bool(value)
        for d, value in environment.items()
        if isinstance(d, Call)
    }
    if not held:
        return True
    for first, second in IMPLIES:
        few = len(FUNCTIONS[second].arguments)
        for (function, arguments), holds in held.items():
            if function == first and holds and held.get((second, arguments[:few])) is False:
                return False
    for (function, arguments), holds in held.items():
        match arguments:
            case (Name(path),) if holds and function in EDGES:
                now = environment.get(ParameterOfInput(path))
                if now is not None and bool(now) is not EDGES[function]:
                    return False
            case _:
                pass
    for group in EXCLUSIVE:
        true = [
            arguments
            for (function, arguments), holds in held.items()
            if function in group and holds
        ]
        if len(true) != len(set(true)):
            return False
    return True
