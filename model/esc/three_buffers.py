"""The buffers of a SyncManager: one for a mailbox, three for process data.

One side writes, the other reads. Both address the first area only; accesses to it go to the buffer
that is theirs. A buffer opens with its first byte and changes hands with its last byte; between
the two it can be accessed in pieces. With three buffers neither side waits: the writer always finds
a free one, the reader opens the newest complete one. With one they take turns: a full buffer cannot
be written, an empty one cannot be read.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

_PROCESS_DATA = 3


@dataclass(frozen=True, slots=True)
class Channel:
    """One SyncManager as set now."""

    start: int
    length: int
    main_writes: bool
    mailbox: bool = False

    @property
    def buffers(self) -> int:
        """Give how many buffers there are."""
        return 1 if self.mailbox else _PROCESS_DATA

    @property
    def end(self) -> int:
        """Give the address behind the area that can be accessed."""
        return self.start + self.length

    @property
    def hidden_end(self) -> int:
        """Give the address behind the last buffer."""
        return self.start + self.buffers * self.length


class Buffers:
    """The buffers of one SyncManager since it was set up."""

    def __init__(self, channel: Channel, *, off: bool) -> None:
        """Start with nothing written; `off` is a SyncManager that the device has deactivated."""
        self.channel = channel
        self.borders = channel.start, channel.end, channel.hidden_end
        """Where the area begins, where what can be accessed ends, and where all of it ends."""
        self.off = off
        self.written = False
        """The event of a write: an image is complete, and the reader has not begun to read."""
        self.taken = False
        """The event of a read: an image was read to its end, and no new one was begun."""
        self.newest: int | None = None
        """The buffer with the newest complete image."""
        self._images = [bytearray(channel.length) for _ in range(channel.buffers)]
        self._writing: int | None = None
        self._reading: int | None = None

    def copy(self) -> Buffers:
        """Give buffers that are as these are now; neither change with the other."""
        other = copy(self)
        other._images = [image.copy() for image in self._images]  # noqa: SLF001
        return other

    @property
    def full(self) -> bool:
        """Tell whether a mailbox holds a message that was not read to its end."""
        return self.channel.mailbox and self.newest is not None

    @property
    def event(self) -> bool:
        """Tell whether the device has not taken notice of what the MainDevice did last."""
        return self.written if self.channel.main_writes else self.taken

    @property
    def write_open(self) -> bool:
        """Tell whether the writer is in the middle of an image."""
        return self._writing is not None

    @property
    def read_open(self) -> bool:
        """Tell whether the reader is in the middle of an image."""
        return self._reading is not None

    def write(self, offset: int, data: bytes) -> bool:
        """Write a piece; False where it is refused: nothing is free, or it begins wrongly."""
        if self.off or self.full:
            return False
        if self._writing is None:
            if offset:
                return False
            used = (self.newest, self._reading)
            self._writing = next(n for n in range(self.channel.buffers) if n not in used)
        self.taken = self.taken and bool(offset)
        self._images[self._writing][offset : offset + len(data)] = data
        if offset + len(data) == self.channel.length:
            self.newest, self._writing = self._writing, None
            self.written = True
        return True

    def read(self, offset: int, length: int) -> bytes | None:
        """Read a piece; None where it is refused: there is nothing, or it begins wrongly."""
        if self.off:
            return None
        if not offset:
            self._reading = self.newest
            self.written = False
        if self._reading is None:
            return None
        data = bytes(self._images[self._reading][offset : offset + length])
        if offset + length == self.channel.length:
            self._reading = None
            self.taken = True
            if self.channel.mailbox:
                self.newest = None
        return data

    def begun(self, offset: int, length: int) -> bytes:
        """Give what a piece of the buffer holds that a write would go to."""
        if self._writing is None:
            return bytes(length)
        return bytes(self._images[self._writing][offset : offset + length]).ljust(length, b"\0")
