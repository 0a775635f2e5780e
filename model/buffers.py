"""The only place for the three buffers that a SyncManager keeps for process data.

One side writes, the other reads, neither waits: the writer always finds a free buffer, the reader
opens the newest complete one. Both address the first area only; accesses to it go to the buffer
that is theirs. A buffer opens with its first byte and changes hands with its last byte; between
the two it can be accessed in pieces.
"""

from __future__ import annotations

from dataclasses import dataclass

_BUFFERS = 3


@dataclass(frozen=True, slots=True)
class ProcessChannel:
    """One SyncManager of process data as set now."""

    start: int
    length: int
    main_writes: bool

    @property
    def end(self) -> int:
        """Give the address behind the area that can be accessed."""
        return self.start + self.length

    @property
    def hidden_end(self) -> int:
        """Give the address behind the third buffer."""
        return self.start + _BUFFERS * self.length


class ThreeBuffers:
    """The buffers of one SyncManager since it was set up."""

    def __init__(self, channel: ProcessChannel, *, off: bool) -> None:
        """Start with nothing written; `off` is a SyncManager that the device has deactivated."""
        self.channel = channel
        self.off = off
        self.written = False
        """The writer has completed an image that the reader has not begun to read."""
        self.taken = False
        """The reader has read an image to its end and the writer has not begun a new one."""
        self.newest: int | None = None
        """The buffer with the newest complete image."""
        self._images = [bytearray(channel.length) for _ in range(_BUFFERS)]
        self._writing: int | None = None
        self._reading: int | None = None

    @property
    def write_open(self) -> bool:
        """Tell whether the writer is in the middle of an image."""
        return self._writing is not None

    @property
    def read_open(self) -> bool:
        """Tell whether the reader is in the middle of an image."""
        return self._reading is not None

    @property
    def image(self) -> bytes | None:
        """Give the newest complete image."""
        return None if self.newest is None else bytes(self._images[self.newest])

    def write(self, offset: int, data: bytes) -> bool:
        """Write a piece; False where it is refused, since it does not begin where it must."""
        if self.off:
            return False
        if self._writing is None:
            if offset:
                return False
            used = (self.newest, self._reading)
            self._writing = next(n for n in range(_BUFFERS) if n not in used)
        self.taken = self.taken and bool(offset)
        self._images[self._writing][offset : offset + len(data)] = data
        if offset + len(data) == self.channel.length:
            self.newest, self._writing = self._writing, None
            self.written = True
        return True

    def read(self, offset: int, length: int) -> bytes | None:
        """Read a piece; None where it is refused, since there is nothing or it begins wrongly."""
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
        return data

    def begun(self, offset: int, length: int) -> bytes:
        """Give what a piece of the buffer holds that a write would go to."""
        if self._writing is None:
            return bytes(length)
        return bytes(self._images[self._writing][offset : offset + length]).ljust(length, b"\0")
