"""What serves a program at a socket: one process for each connection."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import threading
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Sequence


class Served:
    """A program behind a socket: the connection is its stdin and stdout, as inetd does it."""

    def __init__(self, command: Sequence[str], path: str = "") -> None:
        """Listen at a Unix socket `path`, or at a port of its own."""
        self._command = list(command)
        self._listener = socket.socket(socket.AF_UNIX if path else socket.AF_INET)
        self._listener.bind(path or ("127.0.0.1", 0))
        self._listener.listen()
        self.dut = f"unix:{path}" if path else f"tcp:127.0.0.1:{self._listener.getsockname()[1]}"
        self.processes: list[subprocess.Popen[bytes]] = []
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()
        for process in self.processes:
            process.kill()
            process.wait()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection:
                self.processes.append(
                    subprocess.Popen(
                        self._command, stdin=connection.fileno(), stdout=connection.fileno()
                    )
                )
