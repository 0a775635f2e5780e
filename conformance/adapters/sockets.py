"""Tests a device at the other end of a socket, which speaks the line protocol.

The device is not ours: nothing starts it, and what is lost is the connection.  `reset` after a
fault connects again; a device that starts anew gets as long for that as for an answer, once.
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.adapters.line_protocol import (
    CLOSE,
    Ended,
    LineAdapter,
    Lines,
    SilentError,
    UnboundError,
)
from ecatspec.conformance.base.adapter import AdapterError

if TYPE_CHECKING:
    from collections.abc import Callable

    from ecatspec.conformance.adapters.line_protocol import Mark

_PAUSE: Final = 0.02
"""Seconds between two attempts to connect."""
_GRACE: Final = 0.5
"""Seconds for the answer to the last request."""
_PORTS: Final = range(1, 1 << 16)


class SocketAdapter(LineAdapter):
    """A device that listens where `connect` connects to; `place` is how a user named it."""

    def __init__(
        self, connect: Callable[[float], socket.socket], place: str, *, hang_timeout: float = 10.0
    ) -> None:
        self._connect = connect
        self._place = place
        self._patience = 0.0
        super().__init__(self._open, hang_timeout=hang_timeout)

    def _open(self) -> _Connection:
        until = time.monotonic() + self._patience
        self._patience = 0.0
        while True:
            try:
                found = _Connection(self._connect(self._hang_timeout))
            except (OSError, ValueError) as error:
                if time.monotonic() < until:
                    time.sleep(_PAUSE)
                    continue
                reason = getattr(error, "strerror", None) or error
                message = f"no device at {self._place!r}: {reason}; start the device first"
                raise AdapterError(message) from None
            self._patience = self._hang_timeout
            return found


def at_port(place: str, *, hang_timeout: float) -> SocketAdapter:
    """Open `HOST:PORT`; a host with colons stands in brackets."""
    host, _, port = place.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port.isascii() and port.isdigit()) or int(port) not in _PORTS:
        message = f"{place!r} is no place in a network; give HOST:PORT, e.g. localhost:5000"
        raise AdapterError(message)

    def connect(timeout: float) -> socket.socket:
        connection = socket.create_connection((host, int(port)), timeout)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    return SocketAdapter(connect, f"tcp:{place}", hang_timeout=hang_timeout)


def at_path(place: str, *, hang_timeout: float) -> SocketAdapter:
    """Open the Unix socket that is the file `place`."""
    if not place:
        message = "a Unix socket is a file; give its path, e.g. unix:/tmp/slave.sock"
        raise AdapterError(message)

    def connect(timeout: float) -> socket.socket:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.settimeout(timeout)
            connection.connect(place)
        except BaseException:
            connection.close()
            raise
        return connection

    return SocketAdapter(connect, f"unix:{place}", hang_timeout=hang_timeout)


class _Connection:
    """One connection."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._lines = Lines(connection.fileno(), connection.fileno())

    def exchange(self, request: bytes, timeout: float, mark: Mark | None = None) -> bytes:
        """Send one line and return the one line that answers it."""
        return self._lines.exchange(request, timeout, mark)

    def end_of_silence(self) -> str:
        """Close: why the other end did so is not to be seen from here."""
        self.end(politely=False)
        return "the connection was lost"

    def last_words(self) -> str:
        """Nothing: an error stream does not come over a socket."""
        return ""

    def end(self, *, politely: bool) -> None:
        """Close the connection; politely: say so first."""
        if politely:
            with contextlib.suppress(Ended, SilentError, UnboundError):
                self.exchange(CLOSE, _GRACE)
        self._socket.close()
