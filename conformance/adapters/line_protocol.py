"""Speaks the line protocol as the side of the run: line-delimited JSON over any link.

One request, one reply, one line each:

    {"op":"describe"}                             {"ok":true,"description":{...}}
    {"op":"reset"}                                {"ok":true}
    {"op":"read","address":304,"length":2}        {"ok":true,"wkc":1,"data":"0100"}
    {"op":"write","address":288,"data":"0200"}    {"ok":true,"wkc":1}
    {"op":"advance","seconds":0.5}                {"ok":true}
    {"op":"local","event":"ds402.fault"}          {"ok":true}
    {"op":"close"}                                {"ok":true}
    {"op":"batch","calls":[...]}                  {"ok":true,"results":[...]}
    {"op":"advance_until","steps":[0.0005,0.2],"seen":[...]}
                                                  {"ok":true,"passed":2,"results":[...]}

The last two are asked only of a device whose description has `batch` or `advance_until`. Of a
batch each call is a request, each result its reply. `advance_until` advances by one step after the
other and reads after each what was `seen` (address, length, wkc, data), until a read gives
something else: `passed` are the steps until then, the results the replies to the last reads. The
device writes a space as soon as a step has passed, another when the reads behind it gave what was
seen, and its answer behind these.

A reply {"ok":false,"error":"text"} says that the call or the set-up was wrong: AdapterError.
Everything else that is not such a reply is a fault of the device: it ended (DeviceCrash), it
was silent (DeviceHang) or it answered out of the contract (DeviceRubbish).  After a fault the
link is gone, and `reset` opens a new one.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import time
from typing import TYPE_CHECKING, Final, NoReturn, Protocol, Self

from ecatspec.conformance.adapters.crash_stack import crash, own_words
from ecatspec.conformance.base.adapter import (
    AdapterError,
    Description,
    DeviceCrash,
    DeviceHang,
    DeviceRubbish,
    check_duration,
    check_span,
    check_steps,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ecatspec.conformance.base.adapter import Reading, Span

    Mark = Callable[[], float]
    """Called at each sign of life; returns the limit (s) for the next one."""

MAXIMUM_LINE: Final = 1 << 20
CHUNK: Final = 1 << 16
CLOSE: Final = b'{"op":"close"}\n'
_LOOKS: Final = 200 if (os.cpu_count() or 1) > 1 else 0
"""How often to look for an answer before sleeping; on one processor looking only delays it."""
_REPORTS: Final = (
    re.compile(r"^.*: runtime error: .*$", re.MULTILINE),
    re.compile(r"^SUMMARY: (\w+Sanitizer: .*)$", re.MULTILINE),
)
"""What sanitizers say, the most telling line first."""


class Ended(Exception):  # noqa: N818  the end of the output, not yet judged
    """The device closed its side, `unfinished` bytes into an answer."""

    def __init__(self, unfinished: int) -> None:
        super().__init__()
        self.unfinished = unfinished


class SilentError(Exception):
    """Nothing came in time."""


class UnboundError(Exception):
    """What came is not one line to one request."""


class Link(Protocol):
    """One life of a way to a device."""

    def exchange(self, request: bytes, timeout: float, mark: Mark | None = None) -> bytes:
        """Send one line and return the one that answers it: Ended, SilentError, UnboundError.

        With `mark` each space before the answer is a sign of life: `mark` is called for it.
        """

    def end_of_silence(self) -> str:
        """Say in words how the device ended whose output ended, and leave nothing behind."""

    def last_words(self) -> str:
        """Return the end of what the device said on its error stream."""

    def end(self, *, politely: bool) -> None:
        """Leave nothing behind; politely: tell the device first."""


class LineAdapter:
    """A device behind links that `open_link` opens: one after the other, each after a fault."""

    def __init__(self, open_link: Callable[[], Link], *, hang_timeout: float = 10.0) -> None:
        self._open_link = open_link
        self._hang_timeout = hang_timeout
        self._obituary = "it was closed"
        self._description: Description | None = None
        self._link: Link | None = open_link()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reset(self) -> None:
        """Power cycle the device; a dead one gets a new link first."""
        if self._link is None:
            self._link = self._open_link()
        self._exchange('{"op":"reset"}\n')

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Return the working counter and the bytes read."""
        check_span(address, length)
        return self._read_in(self._exchange(f"{_read_request(address, length)}\n"), length)

    def reads(self, spans: Sequence[Span]) -> list[Reading]:
        """Read several spans one after the other, by one line."""
        for span in spans:
            check_span(*span)
        calls = ",".join(_read_request(*span) for span in spans)
        return self._read_in_all(self._exchange(f'{{"op":"batch","calls":[{calls}]}}\n'), spans)

    def advance_until(
        self, steps: Sequence[float], seen: Mapping[Span, Reading], mark: Callable[[], None]
    ) -> tuple[int, list[Reading]]:
        """Advance in steps until a look gives other than was seen, by one line."""
        check_steps(steps)
        for span in seen:
            check_span(*span)
        shown = ",".join(
            f'{{"address":{address:d},"length":{length:d},"wkc":{wkc:d},"data":"{data.hex()}"}}'
            for (address, length), (wkc, data) in seen.items()
        )
        took = [each for seconds in steps for each in (seconds, 0.0)]
        marks = 0

        def marked() -> float:
            nonlocal marks
            marks += 1
            if marks > len(took):
                raise UnboundError(f"more than {len(took)} spaces came for {len(steps)} steps")
            mark()
            return (*took, 0.0)[marks]

        request = f'{{"op":"advance_until","steps":{json.dumps(list(steps))},"seen":[{shown}]}}\n'
        reply = self._exchange(request, extra=took[0], mark=marked)
        found = self._read_in_all(reply, tuple(seen))
        passed = reply.get("passed")
        if type(passed) is not int or not 0 < passed <= len(steps):
            self._rubbish(f"the steps that passed are no number from 1 to {len(steps)}: {passed!r}")
        same = found == list(seen.values())
        if same and passed < len(steps):
            self._rubbish(f"it stopped after {passed} of {len(steps)} steps, and nothing is new")
        if marks != 2 * passed - (not same):
            self._rubbish(f"{marks} spaces came before the answer, for {2 * passed - (not same)}")
        return passed, found

    def _read_in_all(self, reply: dict[str, object], spans: Sequence[Span]) -> list[Reading]:
        results = reply.get("results")
        if not isinstance(results, list) or len(results) != len(spans):
            self._rubbish(f"the results of {len(spans)} calls are no list of as many")
        return [
            self._read_in(self._accepted(result), length)
            for result, (_, length) in zip(results, spans, strict=True)
        ]

    def _read_in(self, reply: dict[str, object], length: int) -> Reading:
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
        """Raise a local event in the device."""
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
        """End the link and what it started; safe to call at any time."""
        link, self._link, self._obituary = self._link, None, "it was closed"
        if link is not None:
            link.end(politely=True)

    def _exchange(
        self, request: str, *, extra: float = 0.0, mark: Mark | None = None
    ) -> dict[str, object]:
        """Give the answer to a request; `extra` seconds it may take more, and `mark` gives others.

        They are the limits for what follows the space that `mark` was called for.
        """
        timeout = self._hang_timeout + extra

        def marked() -> float:
            nonlocal timeout
            assert mark is not None
            timeout = self._hang_timeout + mark()
            return timeout

        link = self._link
        if link is None:
            reason = f"the device is not running ({self._obituary}); reset starts it again"
            raise DeviceCrash(reason)
        try:
            line = link.exchange(request.encode("ascii"), timeout, mark and marked)
        except Ended as ended:
            self._crash(link, ended)
        except SilentError:
            self._kill(reason := f"no answer within {timeout:g} s")
            raise DeviceHang(reason) from None
        except UnboundError as error:
            self._rubbish(str(error))
        except BaseException:  # the reply is still under way: this link is of no more use
            self._kill("the run was interrupted")
            raise
        try:
            reply = json.loads(line)
        except (ValueError, RecursionError):
            self._rubbish(f"the answer is not JSON: {line[:60]!r}")
        return self._accepted(reply)

    def _accepted(self, reply: object) -> dict[str, object]:
        """Give a reply that says yes."""
        if not isinstance(reply, dict):
            self._rubbish(f"the answer is not an object: {_shown(reply)}")
        accepted = reply.get("ok")
        if accepted is True:
            return reply
        error_text = reply.get("error")
        if accepted is not False or not isinstance(error_text, str):
            self._rubbish(f"the answer says neither yes nor why not: {_shown(reply)}")
        raise AdapterError(error_text)

    def _working_counter(self, reply: dict[str, object]) -> int:
        value = reply.get("wkc")
        if type(value) is not int or value < 0:
            self._rubbish(f"the working counter is not a count: {value!r}")
        return value

    def _kill(self, obituary: str) -> None:
        link, self._link, self._obituary = self._link, None, obituary
        if link is not None:
            link.end(politely=False)

    def _rubbish(self, reason: str) -> NoReturn:
        self._kill(reason)
        raise DeviceRubbish(reason) from None

    def _crash(self, link: Link, ended: Ended) -> NoReturn:
        self._link = None
        how = link.end_of_silence()
        tail = link.last_words()
        died = crash(tail)
        last = _telling(own_words(tail))
        reason = f"the device ended: {how}"
        if ended.unfinished:
            reason += f", {ended.unfinished} bytes into an answer"
        if last:
            reason += f"; it said: {last[-200:]}"
        self._obituary = how
        if died is None:
            raise DeviceCrash(reason, tail) from None
        if died.stack:
            reason += f"; stack: {', '.join(map(str, died.stack))}"
        raise DeviceCrash(reason, tail, cause=died.cause, placed=bool(died.stack)) from None


class Lines:
    """Lines over two descriptors, that may be one; a device that does not listen cannot stop us."""

    def __init__(self, requests: int, replies: int) -> None:
        os.set_blocking(requests, False)
        self._requests, self._replies = requests, replies
        self._answers = select.poll()
        self._answers.register(replies, select.POLLIN)

    def exchange(self, request: bytes, timeout: float, mark: Mark | None = None) -> bytes:
        """Send one line and return the one line that answers it.

        With `mark` each space before the answer is a sign of life: `mark` is called for it.
        """
        if self._answers.poll(0):
            # End of file, or output that nobody asked for.
            unasked = self._read()
            if not unasked:
                raise Ended(0)
            message = f"output without a request: {unasked[:60]!r}"
            raise UnboundError(message)
        deadline = time.monotonic() + timeout
        try:
            self._send(request, deadline)
        except (BrokenPipeError, ConnectionResetError):
            raise Ended(0) from None
        return self._receive(deadline, mark)

    def _read(self) -> bytes:
        try:
            return os.read(self._replies, CHUNK)
        except ConnectionResetError:
            return b""

    def _send(self, rest: bytes, deadline: float) -> None:
        while True:
            with contextlib.suppress(BlockingIOError):
                rest = rest[os.write(self._requests, rest) :]
            if not rest:
                return
            room = select.poll()
            room.register(self._requests, select.POLLOUT)
            if not room.poll(_milliseconds(deadline)):
                raise SilentError

    def _receive(self, deadline: float, mark: Mark | None) -> bytes:
        line = b""
        # A quick device answers before a sleep and a wake-up would be over: look first.
        for _ in range(_LOOKS):
            if self._answers.poll(0):
                break
        while True:
            if not self._answers.poll(_milliseconds(deadline)):
                raise SilentError
            chunk = self._read()
            if not chunk:
                raise Ended(len(line))
            if mark is not None and not line:
                chunk, spaces = chunk.lstrip(b" "), len(chunk)
                for _ in range(spaces - len(chunk)):
                    deadline = time.monotonic() + mark()
            line = line + chunk if line else chunk
            end = chunk.find(b"\n")
            if end >= 0:
                end += len(line) - len(chunk)
                if end + 1 < len(line):
                    message = f"more than one line to one request: {line[end + 1 :][:60]!r}"
                    raise UnboundError(message)
                line = line[:end]
            if len(line) > MAXIMUM_LINE:
                message = f"a line of more than {MAXIMUM_LINE} bytes"
                raise UnboundError(message)
            if end >= 0:
                return line


def _milliseconds(deadline: float) -> int:
    return max(0, int((deadline - time.monotonic()) * 1000) + 1)


def _read_request(address: int, length: int) -> str:
    return f'{{"op":"read","address":{address:d},"length":{length:d}}}'


def _shown(reply: object) -> str:
    return json.dumps(reply)[:60]


def _telling(tail: str) -> str:
    """Give the line of the last words that tells most: the report of a sanitizer, or the last."""
    for report in _REPORTS:
        if found := report.search(tail):
            return found[found.re.groups].strip()
    return tail.rstrip().rpartition("\n")[2].strip()
