"""A client that follows its transfer: its moves become requests."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

from ecatspec.generators.cases.case import NO_LIMITS, SendFrame, Stimulus
from ecatspec.generators.cases.transfers import (
    initiate,
    initiate_room,
    segment,
    segment_room,
    upload_segment,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model


@dataclass(frozen=True, slots=True)
class Begin:
    """Begin a download of `value`, `first` bytes of it in the first message."""

    key: tuple[int, int]
    value: bytes
    first: int


@dataclass(frozen=True, slots=True)
class Segment:
    """Send the next `count` bytes; `right` tells whether the toggle bit is, `honest` the last."""

    count: int
    right: bool = True
    honest: bool = True


@dataclass(frozen=True, slots=True)
class Ask:
    """Ask for a segment of an upload."""

    right: bool = True


Move: TypeAlias = Stimulus | Begin | Segment | Ask


@dataclass(slots=True)
class Client:
    """What a client knows of its transfer: the next toggle bit, and the bytes still to be sent."""

    model: Model
    limits: Limits = field(default=NO_LIMITS)
    toggle: bool = False
    rest: bytes = b""

    def give(self, move: Move) -> Stimulus:
        """Give the stimulus of a move, and keep in mind what it does to the transfer."""
        match move:
            case Begin(key, value, first):
                first = min(first, initiate_room(self.model, self.limits))
                self.toggle, self.rest = False, value[first:]
                return initiate(*key, len(value), value[:first])
            case Segment(count, right, honest):
                piece = self.rest[: min(count, segment_room(self.model, self.limits))]
                last = (len(piece) == len(self.rest)) is honest
                stimulus = segment(piece, toggle=self.toggle is right, last=last)
                if right:
                    self.toggle, self.rest = not self.toggle, self.rest[len(piece) :]
                return stimulus
            case Ask(right):
                stimulus = upload_segment(toggle=self.toggle is right)
                self.toggle = self.toggle is not right
                return stimulus
            case SendFrame():
                self.toggle = False
                return move
            case _:
                return move


def played(moves: Sequence[Move], limits: Limits, model: Model) -> list[Stimulus]:
    """Give the stimuli of moves as a client makes them that knows where its transfer stands."""
    client = Client(model, limits)
    return [client.give(move) for move in moves]
