"""The only place for the data of the model: states, inputs, outputs and steps."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.values import ObjectKey, Value


@dataclass(frozen=True, slots=True)
class State:
    """All that the model knows of a device: one value a slot (None: undecided), known objects.

    The objects are in the order of their keys.
    """

    slots: tuple[Value | None, ...]
    objects: tuple[tuple[ObjectKey, bytes], ...] = ()
    _known: Mapping[ObjectKey, bytes] | None = field(default=None, compare=False, repr=False)
    _hash_of_objects: int | None = field(default=None, compare=False, repr=False)
    _hash: int | None = field(default=None, init=False, compare=False, repr=False)

    def __hash__(self) -> int:
        """Give the hash of slots and objects, worked out once; there may be many objects."""
        value = self._hash
        if value is None:
            if self._hash_of_objects is None:
                object.__setattr__(self, "_hash_of_objects", hash(self.objects))
            value = hash((self.slots, self._hash_of_objects))
            object.__setattr__(self, "_hash", value)
        return value

    def known(self) -> Mapping[ObjectKey, bytes]:
        """Give the objects whose value is known."""
        known = self._known
        if known is None:
            known = dict(self.objects)
            object.__setattr__(self, "_known", known)
        return known

    def keeping(self, key: ObjectKey, value: bytes) -> State:
        """Give the state in which the object `key` has `value`."""
        known = self.known()
        if known.get(key) == value:
            return self
        place = bisect_left(self.objects, (key,))
        rest = self.objects[place + (key in known) :]
        objects = (*self.objects[:place], (key, value), *rest)
        return State(self.slots, objects, {**known, key: value})

    def forgetting(self, key: ObjectKey) -> State:
        """Give the state in which the value of the object `key` is not known."""
        if key not in self.known():
            return self
        return State(self.slots, tuple(pair for pair in self.objects if pair[0] != key))

    def having(self, slot: int, value: Value | None) -> State:
        """Give the state with another value in one slot."""
        if self.slots[slot] == value and type(self.slots[slot]) is type(value):
            return self
        return self.holding((*self.slots[:slot], value, *self.slots[slot + 1 :]))

    def holding(self, slots: tuple[Value | None, ...]) -> State:
        """Give the state with other values in all slots."""
        return State(slots, self.objects, self._known, self._hash_of_objects)


@dataclass(frozen=True, slots=True)
class Event:
    """An input of a machine with its parameters; for a frame, `trail` holds its layouts."""

    machine: str
    input: str
    parameters: Mapping[str, Value]
    trail: tuple[str, ...] = ()
    _hash: int | None = field(default=None, init=False, compare=False, repr=False)

    def __hash__(self) -> int:
        """Give the hash of all, parameters in any order, worked out once."""
        value = self._hash
        if value is None:
            parameters = frozenset(self.parameters.items())
            value = hash((self.machine, self.input, self.trail, parameters))
            object.__setattr__(self, "_hash", value)
        return value


@dataclass(frozen=True, slots=True)
class RuleName:
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


@dataclass(frozen=True, slots=True)
class Alarm:
    """An event that comes by itself, from `after` on and by `within`, in microseconds."""

    event: Event
    after: int
    within: int


@dataclass(frozen=True, slots=True)
class Step:
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
