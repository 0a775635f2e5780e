"""The data of symbolic runs: values, worlds, moments, chains of rules."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ecatspec.model.core.state import RuleName
    from ecatspec.model.symbolic.terms import Term
    from ecatspec.spec.language.ir import Gap, Rule
    from ecatspec.spec.language.references import Kind
    from ecatspec.spec.language.scope import Scope


@dataclass(frozen=True, slots=True)
class Content:
    """A byte string: its length, and a name in the place of its bytes."""

    length: Term
    name: str


class Anything(str):
    """`any`: whatever it meets decides what sort of value it is."""

    __slots__ = ()


ANY: Final = Anything("any")
Meant: TypeAlias = "Term | Content | Anything"


class Maker(Protocol):
    """What makes symbols of a type."""

    def of_kind(self, name: str, label: str, kind: Kind | None, *, abstract: bool = False) -> Meant:
        """Make a symbol within the bounds of a type."""
        ...


@dataclass(slots=True)
class World:
    """What machines, registers and words hold at one time: symbols, made when first asked for.

    `changed` goes before `base`; what is in neither is made by `of_base` and put into it. `stamp`
    tells apart the times between which objects may have changed.
    """

    make: Callable[[str, str], Meant]
    """Makes the symbol of a slot, by the name of the symbol and of the slot."""
    prefix: str
    base: dict[str, Meant]
    changed: Mapping[str, Meant] = field(default_factory=dict)
    stamp: str = ""

    def get(self, slot: str) -> Meant:
        """Give what a slot holds."""
        if slot in self.changed:
            return self.changed[slot]
        if slot not in self.base:
            self.base[slot] = self.make(f"{self.prefix}{slot}", slot)
        return self.base[slot]

    def having(self, changes: Mapping[str, Meant], stamp: str | None = None) -> World:
        """Give the world with other values in some slots."""
        later = self.stamp if stamp is None else stamp
        return World(self.make, self.prefix, self.base, {**self.changed, **changes}, later)


@dataclass(slots=True)
class Moment:
    """One input of one machine in a world: what the expressions of its rules speak of."""

    world: World
    scope: Scope
    key: str
    parameters: dict[str, Meant]
    memo: dict[tuple[str, str | None], Meant] = field(default_factory=dict)


Fired: TypeAlias = "tuple[tuple[RuleName, Moment], ...]"
"""Rules that fired, with what their expressions speak of."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """An input that comes to a machine, with the parameters that are known and what holds."""

    machine: str
    input: str
    parameters: Mapping[str, Meant]
    conditions: tuple[Term, ...] = ()
    key: str = ""
    """What tells its symbols from those of inputs before it in a trace."""


@dataclass(frozen=True, slots=True)
class Chain:
    """One way through the rules.

    `fired` are the rules with what their expressions speak of; `gap` tells that the texts are
    silent from there on.
    """

    world: World
    conditions: tuple[Term, ...]
    fired: Fired = ()
    gap: bool = False
    between: tuple[tuple[World, tuple[Term, ...]], ...] = ()
    """Worlds on the way in which something else can be seen or happen, and what holds there."""
    replies: tuple[Moment, ...] = ()
    """What the frames hold that were sent on the way, where something follows from that."""


@dataclass(frozen=True, slots=True)
class Meeting:
    """An input at a machine: what has to hold for it to come, and for each row to take it."""

    moment: Moment
    conditions: tuple[Term, ...]
    rows: tuple[tuple[Rule | Gap, Term], ...]
    fired: Fired
