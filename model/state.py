"""The only place for the data of the model: states, inputs, outputs and steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.values import ObjectKey, Value


@dataclass(frozen=True, slots=True)
class State:
    """All that the model knows of a device: one value a slot (None: undecided), known objects."""

    slots: tuple[Value | None, ...]
    objects: tuple[tuple[ObjectKey, bytes], ...] = ()

    def known(self) -> dict[ObjectKey, bytes]:
        """Give the objects whose value is known."""
        return dict(self.objects)

    def keeping(self, key: ObjectKey, value: bytes) -> State:
        """Give the state in which the object `key` has `value`."""
        objects = self.known()
        objects[key] = value
        return State(self.slots, tuple(sorted(objects.items())))

    def forgetting(self, key: ObjectKey) -> State:
        """Give the state in which the value of the object `key` is not known."""
        return State(self.slots, tuple(pair for pair in self.objects if pair[0] != key))

    def having(self, slot: int, value: Value | None) -> State:
        """Give the state with another value in one slot."""
        if self.slots[slot] == value and type(self.slots[slot]) is type(value):
            return self
        return State((*self.slots[:slot], value, *self.slots[slot + 1 :]), self.objects)


@dataclass(frozen=True, slots=True)
class Event:
    """An input of a machine with its parameters; for a frame, `trail` holds its layouts."""

    machine: str
    input: str
    parameters: Mapping[str, Value] = field(hash=False)
    trail: tuple[str, ...] = ()


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
