"""What rules, reasons and views of the texts become."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from ecatspec.model.core.values import UNKNOWN, Value
from ecatspec.spec.language.nodes import names_in

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ecatspec.model.core.expressions import (
        Environment,
        Getter,
    )
    from ecatspec.model.core.state import RuleName
    from ecatspec.spec.language.ir import (
        Expression,
        Gap,
        Machine,
        Protocol,
        Rule,
    )


Holder: TypeAlias = "Callable[[Environment], int | None]"


@dataclass(frozen=True, slots=True)
class CompiledRule:
    """A rule or a gap, ready to run in the order of its paragraphs."""

    name: RuleName
    sources: frozenset[int]
    guard: Getter | None
    target: int | None
    updates: tuple[tuple[int, Getter], ...]
    store: tuple[tuple[Getter, Getter, Getter, bool], ...]
    sends: tuple[tuple[str, tuple[tuple[str, Getter], ...]], ...]
    gives: tuple[tuple[str, tuple[tuple[str, Getter], ...]], ...]
    within: Getter | None
    gap: bool
    later: Later | None = None
    take: Getter | None = None
    timers: tuple[Timer, ...] = ()


@dataclass(frozen=True, slots=True)
class Timer:
    """An event that comes by itself: machine, input, parameters, not before, at the latest."""

    machine: str
    input: str
    arguments: tuple[tuple[str, Getter], ...]
    after: Getter | None
    within: Getter


@dataclass(frozen=True, slots=True)
class Later:
    """What a rule says of its frame once other fields of it are fixed, and what follows then."""

    fields: tuple[tuple[str, Getter], ...]
    updates: tuple[tuple[int, Getter], ...]
    gives: tuple[tuple[str, tuple[tuple[str, Getter], ...]], ...]


@dataclass(frozen=True, slots=True)
class CompiledReason:
    """Why a rule refuses: when it holds, and its words with places for values."""

    wording: str
    guard: Getter
    values: tuple[Getter, ...]


@dataclass(frozen=True, slots=True)
class View:
    """One field of a register or a word as the MainDevice reads it."""

    name: str
    low: int
    width: int
    truth: bool
    expression: Expression
    value: Getter
    condition: Getter | None
    holder: Holder
    """What tells the slot whose value the field is."""
    advised: Getter | None
    """What the field should be beside what it must."""

    def present(self, environment: Environment) -> Value:
        """Give what the field reads as, unknown where nothing is said."""
        if self.condition is not None and self.condition(environment) is not True:
            return UNKNOWN
        return self.value(environment)


def timers_of(protocol: Protocol) -> frozenset[str]:
    """Give the inputs that come when a time is over, as `machine.input`."""
    return frozenset(
        later.target
        for machine in protocol.machines.values()
        for rule in machine.rules
        for later in rule.laters
    )


def rows_of(machine: Machine) -> tuple[Rule | Gap, ...]:
    """Give the rules and the gaps of a machine."""
    return (*machine.rules, *machine.gaps)


def paths_in(protocol: Protocol, expression: Expression) -> Iterator[str]:
    """Yield the names of an expression and of the definitions that it uses."""
    for path in names_in(expression):
        definition = protocol.definitions.get(path)
        if definition is None:
            yield path
        else:
            yield from paths_in(protocol, definition.value)
