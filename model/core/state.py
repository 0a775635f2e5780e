"""The data of the model: states, inputs, outputs and steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeVar

from msgspec import Struct, structs

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.core.values import ObjectKey, Value

_K = TypeVar("_K")
_V = TypeVar("_V")


class Fixed(dict[_K, _V]):
    """A mapping that nobody changes, with its hash worked out once; there may be many objects."""

    __slots__ = ("_hash",)
    _hash: int

    def __hash__(self) -> int:  # type: ignore[override]  # a plain dict has none
        """Give the hash of what it holds, in any order."""
        try:
            return self._hash
        except AttributeError:
            self._hash = hash(frozenset(self.items()))
            return self._hash


NOTHING: Final[Fixed[ObjectKey, bytes]] = Fixed()
"""No object has a value that is known."""


class State(Struct, frozen=True, cache_hash=True):
    """All that the model knows of a device: one value a slot (None: undecided), known objects.

    The objects are in the order of their keys.
    """

    slots: tuple[Value | None, ...]
    objects: Fixed[ObjectKey, bytes] = NOTHING

    def keeping(self, key: ObjectKey, value: bytes) -> State:
        """Give the state in which the object `key` has `value`."""
        before = self.objects.get(key)
        if before == value:
            return self
        objects = Fixed({**self.objects, key: value})
        return State(self.slots, objects if before is not None else Fixed(sorted(objects.items())))

    def forgetting(self, key: ObjectKey) -> State:
        """Give the state in which the value of the object `key` is not known."""
        if key not in self.objects:
            return self
        return State(self.slots, Fixed({k: v for k, v in self.objects.items() if k != key}))

    def having(self, slot: int, value: Value | None) -> State:
        """Give the state with another value in one slot."""
        if self.slots[slot] == value and type(self.slots[slot]) is type(value):
            return self
        return self.holding((*self.slots[:slot], value, *self.slots[slot + 1 :]))

    def holding(self, slots: tuple[Value | None, ...]) -> State:
        """Give the state with other values in all slots."""
        return State(slots, self.objects)


class Event(Struct, frozen=True, cache_hash=True):
    """An input of a machine with its parameters; for a frame, `trail` holds its layouts."""

    machine: str
    input: str
    parameters: Mapping[str, Value]
    trail: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Keep the parameters as they are now."""
        if type(self.parameters) is not Fixed:
            structs.force_setattr(self, "parameters", Fixed(self.parameters))


class RuleName(Struct, frozen=True, cache_hash=True):
    """Which rule or gap; cited by verdicts and counted by coverage."""

    machine: str
    name: str

    def __str__(self) -> str:
        """Give the dotted name."""
        return f"{self.machine}.{self.name}"


@dataclass(frozen=True, slots=True)
class Output:
    """A frame that the device owes; `fields` are what the rule says of it, others are default.

    `given` are the parameters of the rule's input where the rule goes on once the frame is fixed.
    `within`: how long the device may take once nothing is before it. `again` holds the bytes
    of a message that is repeated; empty where they were not seen.
    """

    frame: str
    fields: tuple[tuple[str, Value], ...]
    rule: RuleName
    given: tuple[tuple[str, Value], ...] | None = None
    within: int = 0
    again: bytes | None = None
    chain: tuple[RuleName, ...] = ()
    """The rules that led to it, from the input of the device on."""
    asked: tuple[tuple[str, Value], ...] = field(default=(), compare=False)
    """The parameters of the rule's input."""


class Alarm(Struct, frozen=True, cache_hash=True):
    """An event that comes by itself, from `after` on and by `within`, in microseconds."""

    event: Event
    after: int
    within: int


class Step(Struct, frozen=True, cache_hash=True):
    """One way in which the texts let a device react to one input.

    `within` is the time it may take in microseconds; `unspecified` tells that a gap was met.
    """

    state: State
    rules: tuple[RuleName, ...]
    outputs: tuple[Output, ...]
    within: int
    unspecified: bool = False
    resend: RuleName | None = None
    """The rule that puts the message read last back before all that is unread."""
    alarms: tuple[Alarm, ...] = ()
