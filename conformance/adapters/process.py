"""Tests a device in another process, which speaks the line protocol on stdin and stdout.

The process has a session of its own and ends with its adapter, whatever it does: a device ends
when its stdin ends, or is made to.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import threading
import time
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.adapters.line_protocol import CHUNK, CLOSE, LineAdapter, Lines
from ecatspec.conformance.base.adapter import AdapterError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ecatspec.conformance.adapters.line_protocol import Mark

STDERR_KEPT: Final = 64 << 10
_GRACE: Final = 0.5
"""Seconds a process gets to end by itself before the next, harder, step."""
_HALT: Final = "halt_on_error=1:print_stacktrace=1:print_summary=1:report_error_type=1"
"""What makes an undefined behaviour sanitizer end its program at the first report, with a stack."""


class ProcessAdapter(LineAdapter):
    """A device that runs as `command`; what `env` has is added to the environment."""

    def __init__(
        self,
        command: Sequence[str],
        *,
        hang_timeout: float = 10.0,
        env: Mapping[str, str] | None = None,
    ) -> None:
        if not command:
            message = "the command of the device is empty; give a program and its arguments"
            raise AdapterError(message)
        self._command = tuple(command)
        self._env = os.environ | {
            "UBSAN_OPTIONS": ":".join(filter(None, (_HALT, os.environ.get("UBSAN_OPTIONS")))),
            **(env or {}),
        }
        super().__init__(self._start, hang_timeout=hang_timeout)

    @property
    def pid(self) -> int | None:
        """The process of the device while it lives."""
        return self._link.pid if isinstance(self._link, _Child) else None

    def _start(self) -> _Child:
        try:
            return _Child(self._command, self._env)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            message = f"cannot start {self._command[0]!r}: {reason}; check the command"
            raise AdapterError(message) from None


class _Child:
    """One process: its three pipes, the thread that drains stderr, and its end."""

    def __init__(self, command: Sequence[str], env: Mapping[str, str] | None) -> None:
        # A session of its own: the terminal's interrupt does not reach the device, and one
        # signal reaches all that it started.
        self._process = subprocess.Popen(  # noqa: S603  running it is the purpose
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            env=env,
            start_new_session=True,
        )
        self.pid: Final = self._process.pid
        process = self._process
        if process.stdin is None or process.stdout is None or process.stderr is None:
            raise AssertionError
        self._lines = Lines(process.stdin.fileno(), process.stdout.fileno())
        try:
            self._drain = _Drain(process.stderr.fileno())
        except BaseException:
            self._signal(signal.SIGKILL)
            process.wait()
            raise

    def exchange(self, request: bytes, timeout: float, mark: Mark | None = None) -> bytes:
        """Send one line and return the one line that answers it."""
        return self._lines.exchange(request, timeout, mark)

    def end_of_silence(self) -> str:
        """Say in words how the process ended whose output ended."""
        if not self._gone(_GRACE):
            self.end(politely=False)
            return "it closed its output and stayed; it was killed"
        self.end(politely=False)
        status = self._process.returncode
        if status >= 0:
            return f"exit status {status}"
        try:
            name = signal.Signals(-status).name
        except ValueError:
            return f"killed by signal {-status}"
        return f"killed by {name} ({signal.strsignal(-status)})"

    def last_words(self) -> str:
        """Return the kept end of the error stream."""
        return self._drain.tail().decode("utf-8", errors="replace")

    def end(self, *, politely: bool) -> None:
        """Leave neither process nor descriptor behind: ask, terminate, kill, wait."""
        process = self._process
        try:
            if politely and process.stdin is not None:
                with contextlib.suppress(OSError):
                    os.write(process.stdin.fileno(), CLOSE)
                self._close(process.stdin)
                if not self._gone(_GRACE):
                    self._signal(signal.SIGTERM)
                    self._gone(_GRACE)
        finally:
            # The leader is not reaped yet, so its number still names its group and no other.
            self._signal(signal.SIGKILL)
            process.wait()
            self._drain.stop()
            for pipe in (process.stdin, process.stdout, process.stderr):
                self._close(pipe)

    def _gone(self, seconds: float) -> bool:
        """Wait for the end of the process without reaping it."""
        deadline, pause = time.monotonic() + seconds, 0.0005
        while not os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG):
            if time.monotonic() >= deadline:
                return False
            time.sleep(pause)
            pause = min(2 * pause, 0.02)
        return True

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, number)

    @staticmethod
    def _close(pipe: object) -> None:
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()  # type: ignore[attr-defined]


class _Drain:
    """A thread that empties the error stream, so that no flood can block the device."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._kept = bytearray()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name="device stderr", daemon=True)
        self._thread.start()

    def tail(self) -> bytes:
        return bytes(self._kept[-STDERR_KEPT:])

    def stop(self) -> None:
        """Take what is there and end, even when a stray process holds the stream open."""
        os.write(self._wake_write, b"!")
        self._thread.join()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _run(self) -> None:
        os.set_blocking(self._descriptor, False)
        both = select.poll()
        both.register(self._descriptor, select.POLLIN)
        both.register(self._wake_read, select.POLLIN)
        stopping, left = False, STDERR_KEPT // CHUNK + 16
        while left:
            if not stopping:
                stopping = any(fd == self._wake_read for fd, _ in both.poll())
            try:
                chunk = os.read(self._descriptor, CHUNK)
            except BlockingIOError:
                if stopping:
                    return
                continue
            if not chunk:
                return
            left -= stopping
            self._kept += chunk
            if len(self._kept) > 2 * STDERR_KEPT:
                del self._kept[:-STDERR_KEPT]
