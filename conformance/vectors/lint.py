"""Checks a vector file beyond its schema: whether its parts agree with each other.

A file that cannot be read is refused by the reader; all else is listed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Final, assert_never, cast

from ecatspec.conformance.vectors.files import Reading, opened
from ecatspec.generators.formats.json_format import write
from ecatspec.generators.vectors.schema import CONFIGURATION, Full, Local, Mail, Read, Send, Write
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_standard

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator
    from pathlib import Path
    from typing import IO, BinaryIO

    from ecatspec.conformance.run.runner import Progress
    from ecatspec.conformance.vectors.files import WrongError
    from ecatspec.generators.vectors.schema import Allowed, Area, Expected, Head, Input, Step, Test

MOST_SHOWN: Final = 100
_SHOWN: Final = 40
_KEPT: Final = 4096
_BYTES: Final = "bytes"
"""The symbol of a message that no layout describes."""
_AGAIN: Final = "export the file again"


@dataclass(slots=True)
class Findings:
    """What is wrong with a file: the first lines of it, and how many there would be."""

    name: str
    lines: list[str] = field(default_factory=list)
    count: int = 0

    def add(self, place: str, what: str, remedy: str) -> None:
        """Take one more."""
        self.count += 1
        if self.count <= MOST_SHOWN:
            self.lines.append(f"{self.name}: {place}: {what}; {remedy}")


def lint(path: Path, progress: Progress | None = None) -> Findings:
    """Check a file, a test at a time.

    Raises:
        UserError: It cannot be read.

    """
    found = Findings(str(path))
    with opened(path) as stream:
        text = _Text(stream, found)
        linter = _Linter(text, found, progress)
        write(linter.reading.head, linter.tests(), cast("IO[bytes]", text))
        text.end()
    return found


class _Text:
    """The file as it is read, and as it would be written: the first line that differs is told."""

    def __init__(self, stream: BinaryIO, found: Findings) -> None:
        self._stream, self._found = stream, found
        self._read = bytearray()
        self._line = 1
        self.compared = True

    def read(self, size: int, /) -> bytes:
        data = self._stream.read(size)
        if self.compared:
            self._read += data
        return data

    def seek(self, offset: int, /) -> object:
        return self._stream.seek(offset)

    def write(self, data: bytes, /) -> int:
        if self.compared:
            there = bytes(self._read[: len(data)])
            if there != data:
                pairs = zip(there, data, strict=False)
                same = next((n for n, (a, b) in enumerate(pairs) if a != b), len(there))
                self._line += data.count(b"\n", 0, same)
                self._differs(bytes(self._read[same : same + _SHOWN]), data[same : same + _SHOWN])
            else:
                self._line += data.count(b"\n")
                del self._read[: len(data)]
        return len(data)

    def end(self) -> None:
        """Nothing more is written."""
        if self.compared and self._read:
            self._differs(bytes(self._read[:_SHOWN]), b"")

    def _differs(self, there: bytes, written: bytes) -> None:
        self.give_up()
        seen, wanted = (part.decode(errors="replace") for part in (there, written))
        what = f"{seen!r} stands where `export` writes {wanted!r}"
        self._found.add(f"line {self._line}", what, "keep its order, spaces and defaults")

    def give_up(self) -> None:
        """Compare no further."""
        self.compared = False
        self._read.clear()


class _Linter:
    """What is known of a file so far."""

    def __init__(self, text: _Text, found: Findings, progress: Progress | None) -> None:
        self._text, self._found, self._progress = text, found, progress
        self.reading = Reading(text, found.name, self._complain)
        self._head: Head = self.reading.head
        self._model = Model(load_standard())
        self._flags: set[str] = set()
        self._first = ""
        self._number = 0
        self._frame = lru_cache(_KEPT)(self._decoded)

    def tests(self) -> Iterator[tuple[str, Test]]:
        """Yield every test once it is checked; at last check what they are together."""
        self._add(_head(self._head, self._memory))
        for layer, test in self.reading.tests():
            self._number += 1
            self._first = self._first or test.id
            self._flags |= set(test.flags)
            if self._progress is not None:
                self._progress(self._number, self._head.numberOfTests, test.id)
            self._add(self._test(self.reading.place, test))
            yield layer, test
        stated = self._head.numberOfTests
        if self._number != stated:
            self._found.add("numberOfTests", f"{stated} are stated, {self._number} there", _AGAIN)
        for flag in sorted(self._head.notes.keys() - self._flags):
            self._found.add(f"notes.{flag}", "no test has this flag", "leave the note out")

    def _complain(self, wrong: WrongError) -> None:
        """Take a test that is wrong; what it would be written like is not known."""
        self._found.add(wrong.place, wrong.what, wrong.remedy)
        self._text.give_up()
        self._number += 1

    def _add(self, findings: Iterable[tuple[str, str, str]]) -> None:
        for place, what, remedy in findings:
            self._found.add(place, what, remedy)

    @cached_property
    def _memory(self) -> int:
        return self._model.parameter("memory_size")

    # --- a test -----------------------------------------------------------------------------------

    def _test(self, place: str, test: Test) -> Iterator[tuple[str, str, str]]:
        if test.tcId != self._number:
            yield f"{place}.tcId", f"{test.tcId} is not the place {self._number}", _AGAIN
        yield from _unknown(f"{place}.flags", test.flags, self._head.notes, "note")
        yield from _unknown(f"{place}.clauses", test.clauses, self._head.clauses, "clause")
        if test.requires and self._first != CONFIGURATION:
            what = f"rests on test 1, which is not `{CONFIGURATION}`"
            yield f"{place}.requires", what, _AGAIN
        events = sorted({s.given.event for s in test.steps if isinstance(s.given, Local)})
        if events != test.needs:
            what = f"the steps raise {', '.join(events) or 'nothing'}"
            yield f"{place}.needs", what, "name these events in order"
        ends = any(step.can_end for step in test.steps)
        if ends != (test.result == "acceptable"):
            what = f"{test.result}, and {'a' if ends else 'no'} step can end the test"
            yield f"{place}.result", what, "`acceptable` is a test that can end early"
        for number, step in enumerate(test.steps):
            yield from self._step(f"{place}.steps[{number}]", step)

    def _step(self, place: str, step: Step) -> Iterator[tuple[str, str, str]]:
        yield from _unknown(f"{place}.covers", step.covers, self._head.rules, "rule")
        if step.given is not None:
            yield from self._input(f"{place}.in", step.given)
        if step.cycle is not None:
            size = len(step.cycle.data) // 2
            yield from _inside(f"{place}.cycle", step.cycle.address, size, self._memory)
            if not step.us:
                yield f"{place}.cycle", "is written while no time passes", "leave it out"
        if step.early and not step.us:
            yield f"{place}.early", "nothing is waited for", "leave it out"
        for number, expected in enumerate(step.expect):
            yield from self._expected(f"{place}.expect[{number}]", expected)

    def _input(self, place: str, given: Input) -> Iterator[tuple[str, str, str]]:
        match given:
            case Write(address, data):
                yield from _inside(place, address, len(data) // 2, self._memory)
            case Send(address, data, symbol):
                area = self._head.config.mailboxOut
                if address != area.address:
                    what = f"{address} is not that of the mailbox, {area.address}"
                    yield f"{place}.address", what, "write there"
                if len(data) // 2 > area.length:
                    what = f"{len(data) // 2} bytes do not fit into the mailbox of {area.length}"
                    yield f"{place}.data", what, "send less"
                elif symbol not in {_BYTES, frame := self._frame(data, area.length)}:
                    yield f"{place}.symbol", *_another(symbol, frame)
            case Local():
                pass
            case _:
                assert_never(given)

    def _expected(self, place: str, expected: Expected) -> Iterator[tuple[str, str, str]]:
        match expected:
            case Read(address, length):
                yield from _inside(place, address, length, self._memory)
                for number, allowed in enumerate(expected.anyOf):
                    there = f"{place}.anyOf[{number}]"
                    yield from _bytes(there, allowed)
                    if len(allowed.value) // 2 != length:
                        what = f"{len(allowed.value) // 2} bytes, and {length} are read"
                        yield f"{there}.value", what, "give as many"
            case Mail():
                yield from self._mail(place, expected)
            case Full():
                pass
            case _:
                assert_never(expected)

    def _mail(self, place: str, expected: Mail) -> Iterator[tuple[str, str, str]]:
        area = self._head.config.mailboxIn
        frames = {
            self._frame(allowed.value, area.length)
            for allowed in expected.anyOf
            if allowed.effect == "passes"
        }
        for number, allowed in enumerate(expected.anyOf):
            yield from _message(f"{place}.anyOf[{number}]", allowed, area)
        # what a mask leaves open is 0 in a value, so that not each can be decoded
        named = frames - {_BYTES}
        if named and expected.symbol not in {*named, _BYTES, "nothing"}:
            yield f"{place}.symbol", *_another(expected.symbol, " or ".join(sorted(named)))

    def _decoded(self, data: str, size: int) -> str:
        message = self._model.decode(bytes.fromhex(data).ljust(size, b"\0"))
        return _BYTES if message is None else message.frame


def _head(head: Head, memory: int) -> Iterator[tuple[str, str, str]]:
    config = head.config
    for name in ("mailboxOut", "mailboxIn", "mailboxFull"):
        area: Area = getattr(config, name)
        yield from _inside(f"config.{name}", area.address, area.length, memory)
    for name in ("mailboxLength", "mailboxCounter"):
        area = getattr(config, name)
        yield from _inside(f"config.{name}", area.address, area.length, config.mailboxHead)
    for name in ("mailboxFull", "mailboxCounter"):
        area, mask = getattr(config, name), getattr(config, f"{name}Mask")
        if len(mask) // 2 != area.length or not mask.strip("0"):
            what = f"{mask!r} is no mask of {area.length} bytes"
            yield f"config.{name}Mask", what, "set a bit in as many bytes"
    for number, allowed in enumerate(config.passOver):
        yield from _message(f"config.passOver[{number}]", allowed, config.mailboxIn)
    for name, clauses in head.rules.items():
        yield from _unknown(f"rules.{name}", clauses, head.clauses, "clause")


def _message(place: str, allowed: Allowed, area: Area) -> Iterator[tuple[str, str, str]]:
    yield from _bytes(place, allowed)
    if len(allowed.value) // 2 > area.length:
        what = f"{len(allowed.value) // 2} bytes do not fit into the mailbox of {area.length}"
        yield f"{place}.value", what, "expect less"


def _bytes(place: str, allowed: Allowed) -> Iterator[tuple[str, str, str]]:
    value, mask = bytes.fromhex(allowed.value), bytes.fromhex(allowed.mask)
    if len(value) != len(mask):
        what = f"{len(mask)} bytes, and the value has {len(value)}"
        yield f"{place}.mask", what, "give as many"
    elif int.from_bytes(value) & ~int.from_bytes(mask):
        yield f"{place}.value", "has bits that the mask leaves open", "set them to 0"
    if allowed.atLeast is not None and allowed.atLeast > len(value):
        what = f"{allowed.atLeast} bytes at least, and the value has {len(value)}"
        yield f"{place}.atLeast", what, "give no more"


def _inside(place: str, address: int, size: int, room: int) -> Iterator[tuple[str, str, str]]:
    if not size:
        yield place, "there are no bytes", "give one at least"
    if address + size > room:
        what = f"{size} bytes at {address} go beyond {room}"
        yield place, what, "stay inside"


def _unknown(
    place: str, names: Iterable[str], known: Collection[str], what: str
) -> Iterator[tuple[str, str, str]]:
    for number, name in enumerate(names):
        if name not in known:
            yield f"{place}[{number}]", f"there is no {what} {name!r}", "define it in the head"


def _another(symbol: str, frame: str) -> tuple[str, str]:
    return f"{symbol}, and the bytes are {frame}", "name the layout of the bytes"
