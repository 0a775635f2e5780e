"""Pairs captured frames: a request, and the request as it came back."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.esc.wire import Datagram

_PAIRED_SHARE: Final = 0.8
_JUMPS: Final = 0.1
"""A source with a larger share of jumps does not count its frames."""


@dataclass(frozen=True, slots=True)
class Content:
    """What a frame holds; one object for all frames with the same bytes."""

    source: bytes
    marked: bool
    """The source address has the bit of a frame that came back."""
    datagrams: tuple[Datagram, ...]
    good: bool
    """All is well formed."""
    counted: bool
    """Somebody counted up a working counter."""
    signature: tuple[object, ...]
    """What does not change on the way round the segment."""

    @classmethod
    def of(
        cls, datagrams: tuple[Datagram, ...], source: bytes, *, marked: bool, good: bool
    ) -> Content:
        """Work out the rest."""
        counted = any(datagram.working_counter for datagram in datagrams)
        signature = (source, *(datagram.signature() for datagram in datagrams))
        return cls(source, marked, datagrams, good, counted, signature)


@dataclass(frozen=True, slots=True)
class Frame:
    """An EtherCAT frame as it was captured."""

    number: int
    nanoseconds: int
    content: Content

    @property
    def datagrams(self) -> tuple[Datagram, ...]:
        """What it holds."""
        return self.content.datagrams

    def passed(self, request: Frame) -> int | None:
        """Give how many SubDevices the frame passed, None when no datagram shows it."""
        for before, after in zip(request.datagrams, self.datagrams, strict=True):
            if after.command.counts_up:
                return after.adp - before.adp
        return None


class Sequence:
    """The datagram indices of one source: a jump shows that frames are missing.

    A MainDevice that does not count its frames gives no such sign.
    """

    def __init__(self) -> None:
        """Begin before the first frame of a source."""
        self._last: int | None = None
        self._first = 0
        self._steps = self._jumps = 0

    def jumps_to(self, index: int) -> bool:
        """Take in the index of the next request; tell whether requests are missing before it."""
        last, self._last = self._last, index
        if last is None:
            self._first = index
            return False
        again = index <= self._first and index != last  # it wraps, or the MainDevice began anew
        self._steps += 1
        if index == last + 1 or again:
            return False
        self._jumps += 1
        return self._jumps <= self._steps * _JUMPS


# --- requests and returns -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Request:
    serial: int
    frame: Frame
    signature: tuple[object, ...]


class Pending:
    """Requests that have not come back, in the order they were sent."""

    def __init__(self) -> None:
        """Begin without any."""
        self._requests: dict[int, _Request] = {}
        self._by_signature: dict[tuple[object, ...], deque[_Request]] = {}
        self._serial = 0
        self._last: dict[bytes, int] = {}

    def add(self, frame: Frame) -> None:
        """Take in a request."""
        self._serial += 1
        request = _Request(self._serial, frame, frame.content.signature)
        self._requests[request.serial] = request
        self._by_signature.setdefault(request.signature, deque()).append(request)

    def match(self, frame: Frame, size: int | None) -> Frame | None:
        """Take out the request of a returned frame: the first that no other frame has overtaken.

        Frames keep their order on a segment, so a request older than one that came back is most
        likely lost.
        """
        waiting = self._by_signature.get(frame.content.signature)
        if not waiting:
            return None
        source = frame.content.source
        last = self._last.get(source, 0)
        request = waiting[0]
        if len(waiting) > 1:
            request = min(
                waiting,
                key=lambda one: (
                    size is not None and frame.passed(one.frame) not in {size, None},
                    one.serial <= last,
                    one.serial,
                ),
            )
        self._last[source] = max(last, request.serial)
        self._remove(request)
        return request.frame

    def expired(self, before: int | None) -> Iterator[Frame]:
        """Take out the requests sent before a frame number, or all of them."""
        while self._requests:
            request = next(iter(self._requests.values()))
            if before is not None and request.frame.number >= before:
                return
            self._remove(request)
            yield request.frame

    def overtaken(self, source: bytes) -> Iterator[Frame]:
        """Take out the requests older than the last that came back: they are lost."""
        last = self._last.get(source, 0)
        lost = [
            r
            for r in self._requests.values()
            if r.serial < last and r.frame.content.source == source
        ]
        for request in lost:
            self._remove(request)
            yield request.frame

    def _remove(self, request: _Request) -> None:
        del self._requests[request.serial]
        waiting = self._by_signature[request.signature]
        waiting.remove(request)
        if not waiting:
            del self._by_signature[request.signature]


def come_in_pairs(frames: list[Frame]) -> bool:
    """Tell whether requests and returns look alike: no mark, yet they come in pairs.

    That is a MainDevice with a locally administered address, whose frames carry the mark from the
    start, or an emulated segment that does not set it.
    """
    if len({frame.content.marked for frame in frames}) != 1:
        return False
    open_requests: Counter[tuple[object, ...]] = Counter()
    pairs = 0
    for frame in frames:
        signature = frame.content.signature
        if open_requests[signature]:
            open_requests[signature] -= 1
            pairs += 1
        elif not frame.content.counted:
            open_requests[signature] += 1
    return 2 * pairs >= _PAIRED_SHARE * len(frames)
