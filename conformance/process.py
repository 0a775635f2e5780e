"""The only place for a device in another process: line-delimited JSON on its stdin and stdout.

One request, one reply, one line each:

    {"op":"describe"}                             {"ok":true,"description":{...}}
    {"op":"reset"}                                {"ok":true}
    {"op":"read","address":304,"length":2}        {"ok":true,"wkc":1,"data":"0100"}
    {"op":"write","address":288,"data":"0200"}    {"ok":true,"wkc":1}
    {"op":"advance","seconds":0.5}                {"ok":true}
    {"op":"local","event":"ds402.fault"}          {"ok":true}
    {"op":"close"}                                {"ok":true}

A reply {"ok":false,"error":"text"} says that the call or the set-up was wrong: AdapterError.
Everything else that is not such a reply is a fault of the device: it ended (DeviceCrash), it
was silent (DeviceHang) or it answered out of the contract (DeviceRubbish).  After a fault the
process is gone, and `reset` starts a new one.  A device ends when its stdin ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import threading
import time
from typing import TYPE_CHECKING, Final, NoReturn, Self

from ecatspec.conformance.adapter import (
    AdapterError,
    Description,
    DeviceCrash,
    DeviceHang,
    DeviceRubbish,
    check_duration,
    check_span,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MAXIMUM_LINE: Final = 1 << 20
STDERR_KEPT: Final = 64 << 10
_CHUNK: Final = 1 << 16
_LOOKS: Final = 200 if (os.cpu_count() or 1) > 1 else 0
"""How often to look for an answer before sleeping; on one processor looking only delays it."""
_GRACE: Final = 0.5
"""Seconds a process gets to end by itself before the next, harder, step."""


class ProcessAdapter:
    """A device that runs as `command` in its own session and speaks the line protocol."""

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
        self._hang_timeout = hang_timeout
        self._env = None if env is None else dict(env)
        self._child: _Child | None = None
        self._obituary = "it was closed"
        self._description: Description | None = None
        self._start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int | None:
        """The process of the device while it lives."""
        return None if self._child is None else self._child.pid

    def reset(self) -> None:
        """Power cycle the device; a dead one gets a new process first."""
        if self._child is None:
            self._start()
        self._exchange('{"op":"reset"}\n')

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Return the working counter and the bytes read."""
        check_span(address, length)
        reply = self._exchange(f'{{"op":"read","address":{address:d},"length":{length:d}}}\n')
        working_counter = self._working_counter(reply)
        text = reply.get("data")
        if not isinstance(text, str):
            self._rubbish(f"the data of a read is not a text: {text!r}")
        try:
            data = bytes.fromhex(text)
        except ValueError:
            self._rubbish(f"the data of a read is not hexadecimal: {text[:40]!r}")
        if len(data) != length and (working_counter or data):
            self._rubbish(f"{len(data)} bytes came for a read of {length}")
        return working_counter, data

    def write(self, address: int, data: bytes) -> int:
        """Return the working counter of the write."""
        check_span(address, len(data))
        return self._working_counter(
            self._exchange(f'{{"op":"write","address":{address:d},"data":"{data.hex()}"}}\n')
        )

    def advance(self, seconds: float) -> None:
        """Let the device run; in real time the answer may take that much longer."""
        check_duration(seconds)
        self._exchange(f'{{"op":"advance","seconds":{float(seconds)!r}}}\n', extra=seconds)

    def local(self, event: str) -> None:
        """Make a local event befall the device."""
        self._exchange(json.dumps({"op": "local", "event": event}) + "\n")

    def describe(self) -> Description:
        """Return the device's description: asked once, kept beyond the device's death."""
        if self._description is None:
            data = self._exchange('{"op":"describe"}\n').get("description")
            if not isinstance(data, dict):
                self._rubbish("the answer to describe has no description")
            try:
                self._description = Description.from_json(data)
            except ValueError as error:
                self._rubbish(str(error))
        return self._description

    def close(self) -> None:
        """End the process and everything in its group; safe to call at any time."""
        child, self._child, self._obituary = self._child, None, "it was closed"
        if child is not None:
            child.end(politely=True)

    def _start(self) -> None:
        try:
            self._child = _Child(self._command, self._env)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            message = f"cannot start {self._command[0]!r}: {reason}; check the command"
            raise AdapterError(message) from None

    def _exchange(self, request: str, *, extra: float = 0.0) -> dict[str, object]:
        child = self._child
        if child is None:
            reason = f"the device is not running ({self._obituary}); reset starts it again"
            raise DeviceCrash(reason)
        try:
            line = child.exchange(request.encode("ascii"), self._hang_timeout + extra)
        except _Ended as ended:
            self._crash(child, ended)
        except _SilentError:
            self._kill(reason := f"no answer within {self._hang_timeout + extra:g} s")
            raise DeviceHang(reason) from None
        except _UnboundError as error:
            self._rubbish(str(error))
        except BaseException:  # the reply is still under way: this process is of no more use
            self._kill("the run was interrupted")
            raise
        try:
            reply = json.loads(line)
        except (ValueError, RecursionError):
            self._rubbish(f"the answer is not JSON: {line[:60]!r}")
        if not isinstance(reply, dict):
            self._rubbish(f"the answer is not an object: {line[:60]!r}")
        accepted = reply.get("ok")
        if accepted is True:
            return reply
        error_text = reply.get("error")
        if accepted is not False or not isinstance(error_text, str):
            self._rubbish(f"the answer says neither yes nor why not: {line[:60]!r}")
        raise AdapterError(error_text)

    def _working_counter(self, reply: dict[str, object]) -> int:
        value = reply.get("wkc")
        if type(value) is not int or value < 0:
            self._rubbish(f"the working counter is not a count: {value!r}")
        return value

    def _kill(self, obituary: str) -> None:
        child, self._child, self._obituary = self._child, None, obituary
        if child is not None:
            child.end(politely=False)

    def _rubbish(self, reason: str) -> NoReturn:
        self._kill(reason)
        raise DeviceRubbish(reason) from None

    def _crash(self, child: _Child, ended: _Ended) -> NoReturn:
        self._child = None
        how = child.end_of_silence()
        tail = child.stderr_tail()
        last = tail.rstrip().rpartition("\n")[2].strip()
        reason = f"the device ended: {how}"
        if ended.unfinished:
            reason += f", {ended.unfinished} bytes into an answer"
        if last:
            reason += f"; it said: {last[-200:]}"
        self._obituary = how
        raise DeviceCrash(reason, tail) from None


class _Ended(Exception):  # noqa: N818  the end of the output, not yet judged
    def __init__(self, unfinished: int) -> None:
        super().__init__()
        self.unfinished = unfinished


class _SilentError(Exception):
    pass


class _UnboundError(Exception):
    pass


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
        self._stdin, self._stdout = process.stdin.fileno(), process.stdout.fileno()
        os.set_blocking(self._stdin, False)  # a device that does not listen must not stop us
        self._answers = select.poll()
        self._answers.register(self._stdout, select.POLLIN)
        try:
            self._drain = _Drain(process.stderr.fileno())
        except BaseException:
            self._signal(signal.SIGKILL)
            process.wait()
            raise

    def exchange(self, request: bytes, timeout: float) -> bytes:
        """Send one line and return the one line that answers it."""
        if self._answers.poll(0):
            # End of file, or output that nobody asked for.
            unasked = os.read(self._stdout, _CHUNK)
            if not unasked:
                raise _Ended(0)
            message = f"output without a request: {unasked[:60]!r}"
            raise _UnboundError(message)
        deadline = time.monotonic() + timeout
        try:
            sent = os.write(self._stdin, request)
            if sent < len(request):
                self._send_rest(request[sent:], deadline)
        except BlockingIOError:
            self._send_rest(request, deadline)
        except BrokenPipeError:
            raise _Ended(0) from None
        return self._receive(deadline)

    def _send_rest(self, rest: bytes, deadline: float) -> None:
        room = select.poll()
        room.register(self._stdin, select.POLLOUT)
        while rest:
            if not room.poll(_milliseconds(deadline)):
                raise _SilentError
            with contextlib.suppress(BlockingIOError):
                rest = rest[os.write(self._stdin, rest) :]

    def _receive(self, deadline: float) -> bytes:
        line = b""
        # A quick device answers before a sleep and a wake-up would be over: look first.
        for _ in range(_LOOKS):
            if self._answers.poll(0):
                break
        while True:
            if not self._answers.poll(_milliseconds(deadline)):
                raise _SilentError
            chunk = os.read(self._stdout, _CHUNK)
            if not chunk:
                raise _Ended(len(line))
            line = line + chunk if line else chunk
            end = chunk.find(b"\n")
            if end >= 0:
                end += len(line) - len(chunk)
                if end + 1 < len(line):
                    message = f"more than one line to one request: {line[end + 1 :][:60]!r}"
                    raise _UnboundError(message)
                line = line[:end]
            if len(line) > MAXIMUM_LINE:
                message = f"a line of more than {MAXIMUM_LINE} bytes"
                raise _UnboundError(message)
            if end >= 0:
                return line

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

    def stderr_tail(self) -> str:
        """Return the kept end of the error stream."""
        return self._drain.tail().decode("utf-8", errors="replace")

    def end(self, *, politely: bool) -> None:
        """Leave neither process nor descriptor behind: ask, terminate, kill, wait."""
        process = self._process
        try:
            if politely:
                with contextlib.suppress(OSError):
                    os.write(self._stdin, b'{"op":"close"}\n')
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
        stopping, left = False, STDERR_KEPT // _CHUNK + 16
        while left:
            if not stopping:
                stopping = any(fd == self._wake_read for fd, _ in both.poll())
            try:
                chunk = os.read(self._descriptor, _CHUNK)
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


def _milliseconds(deadline: float) -> int:
    return max(0, int((deadline - time.monotonic()) * 1000) + 1)
