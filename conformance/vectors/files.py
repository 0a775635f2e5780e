"""Reads vector files a test at a time, in bounded memory."""

from __future__ import annotations

import codecs
import re
from contextlib import contextmanager
from decimal import Decimal
from typing import TYPE_CHECKING, Final, NoReturn, TypeVar

import ijson
import msgspec

from ecatspec.conformance.base.devices import UserError
from ecatspec.generators.vectors.schema import SCHEMA, SCHEMA_VERSION, Head, Name, Test

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import BinaryIO, Protocol

    class Source(Protocol):
        """What bytes are read from."""

        def read(self, size: int, /) -> bytes:
            """Give at most a number of bytes; none at the end."""
            ...

        def seek(self, offset: int, /) -> object:
            """Go to a place, where that can be."""
            ...


_T = TypeVar("_T")

DEEPEST: Final = 16
"""Objects and lists in each other; files of ours have eleven."""
LONGEST_PART: Final = 1 << 25
"""Bytes of a test, and of the head."""
MOST_VALUES: Final = 1_000_000
"""Values in a test, and in the head."""
LONGEST_TOKEN: Final = 1 << 18
"""Bytes of a string or of blank space."""
MOST_TESTS: Final = 1_000_000
"""Tests of a file: their ids are kept, to find one that is there twice."""
_CHUNK: Final = 1 << 13
_LONGEST_WORDS: Final = 160
_LARGEST: Final = (1 << 63) - 1
_GROUPS: Final = "testGroups"
_HEAD: Final = frozenset(field.encode_name for field in msgspec.structs.fields(Head))
_REMEDY: Final = "docs/vectors.md has the format; correct the file or export it again"
_BROKEN: Final = (ijson.JSONError, ValueError, ArithmeticError, SystemError)
"""What parsers raise: the last for a number with more digits than Python accepts."""
_WHERE: Final = re.compile(r"(?s)(.*?)(?: - at (`key` in )?`\$(.*)`)?")


class WrongError(Exception):
    """One part of a file is wrong, and what follows can still be read: the place, and a remedy."""

    def __init__(self, place: str, what: str, remedy: str = _REMEDY) -> None:
        super().__init__(f"{place}: {what}; {remedy}")
        self.place, self.what, self.remedy = place, what, remedy


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open a file.

    Raises:
        UserError: It cannot be read.

    """
    try:
        with path.open("rb") as stream:
            yield stream
    except OSError as error:
        why = error.strerror or type(error).__name__
    except ValueError as error:  # a zero byte in the path
        why = str(error)
    else:
        return
    raise UserError(f"{path}: cannot be read ({why}); give a file of test vectors")


class Reading:
    """A file that is being read: its head, then its tests one after the other.

    A test that is wrong is told to `complain`; without it the file is refused.
    """

    def __init__(
        self, source: Source, name: str, complain: Callable[[WrongError], None] | None = None
    ) -> None:
        """Read the head.

        Raises:
            UserError: It cannot be read, or is wrong.

        """
        self.place = ""
        """Where the test stands that was given last."""
        self._name = name
        self._source = source
        self._complain = complain or self._refuse
        self._offset = 0
        self._values = 0
        self._begin = 0
        self._ids: set[int] = set()
        self._events = self._parsed()
        self.head: Final = self._read_head()

    def tests(self) -> Iterator[tuple[str, Test]]:
        """Yield the type of the group and the test, once.

        Raises:
            UserError: The file cannot be read, or is wrong.

        """
        group = -1
        for event, _ in self._events:
            group += 1
            place = f"{_GROUPS}[{group}]"
            if event == "end_array":
                break
            if event != "start_map":
                self._fail(place, "is no object")
            yield from self._read_group(place)
        for event, key in self._events:
            if event == "map_key":
                self._fail(_cut(str(key)), f"comes after {_GROUPS}, which must be the last")

    # --- the parts --------------------------------------------------------------------------------

    def _read_head(self) -> Head:
        if next(self._events)[0] != "start_map":
            self._foreign("it is no JSON object")
        self._new_part()
        found: dict[str, object] = {}
        for event, key in self._events:
            if event == "end_map":
                self._foreign(f"it has no {_GROUPS}")
            if not isinstance(key, str) or key not in {*_HEAD, _GROUPS}:
                if "schema" not in found:
                    self._foreign(f"it begins with {_shown(key)}")
                self._version(found)
                self._fail(_cut(str(key)), "is no key of test vectors")
            if key == _GROUPS:
                break
            if key in found:
                self._fail(key, "is there twice")
            found[key] = self._whole(key, 1)
            if key == "schema":
                self._schema(found)
        if not found:
            self._fail(_GROUPS, "comes first; all other keys must come before it")
        self._schema(found)
        self._version(found)
        try:
            head = _converted(found, Head, "")
        except WrongError as wrong:
            self._refuse(wrong)
        if next(self._events)[0] != "start_array":
            self._fail(_GROUPS, "is no list")
        return head

    def _whole(self, place: str, depth: int) -> object:
        try:
            return self._value(place, depth)
        except WrongError as wrong:
            self._refuse(wrong)

    def _named(self, place: str) -> str:
        try:
            return _converted(self._value(place, 3), Name, place)
        except WrongError as wrong:
            self._refuse(wrong)

    def _schema(self, found: dict[str, object]) -> None:
        if found.get("schema") != SCHEMA:
            self._foreign(f"its schema is {_shown(found.get('schema'))}, not {SCHEMA!r}")

    def _version(self, found: dict[str, object]) -> None:
        version = found.get("schema_version")
        if type(version) is not int or version != SCHEMA_VERSION:
            what = f"{_shown(version)} is not understood, only {SCHEMA_VERSION} is"
            remedy = "export the file again with this ecatspec, or use the one that made it"
            self._refuse(WrongError("schema_version", what, remedy))

    def _read_group(self, place: str) -> Iterator[tuple[str, Test]]:
        self._new_part()
        found: dict[str, object] = {}
        for event, key in self._events:
            if event == "end_map":
                break
            if key not in {"type", "tests"}:
                self._fail(f"{place}.{_cut(str(key))}", "is no key of a group")
            if key in found:
                self._fail(f"{place}.{key}", "is there twice")
            if key == "type":
                found["type"] = self._named(f"{place}.type")
            else:
                if "type" not in found:
                    self._fail(f"{place}.tests", "comes before the type, which must be first")
                found["tests"] = True
                for test in self._read_tests(f"{place}.tests"):
                    yield str(found["type"]), test
        if "tests" not in found:
            self._fail(place, "has no tests")

    def _read_tests(self, place: str) -> Iterator[Test]:
        if next(self._events)[0] != "start_array":
            self._fail(place, "is no list")
        number = 0
        for event, value in self._events:
            if event == "end_array":
                return
            self.place = f"{place}[{number}]"
            number += 1
            self._new_part()
            try:
                test = _converted(self._value(self.place, 4, (event, value)), Test, self.place)
            except WrongError as wrong:
                self._complain(wrong)
                continue
            known = hash(test.id)
            if known in self._ids:
                what = f"the id {_shown(test.id)} is there twice"
                self._complain(WrongError(f"{self.place}.id", what))
            self._ids.add(known)
            if len(self._ids) > MOST_TESTS:
                self._fail(self.place, f"there are more than {MOST_TESTS} tests", "split the file")
            yield test

    # --- one value --------------------------------------------------------------------------------

    def _new_part(self) -> None:
        self._values, self._begin = 0, self._offset

    def _value(self, at: str, depth: int, first: tuple[str, object] | None = None) -> object:
        """Give one whole value; `depth` is that of what it lies in."""
        around: list[dict[str, object] | list[object]] = []
        keys: list[str] = []
        wrong: WrongError | None = None
        event, value = first or next(self._events)
        while True:
            self._values += 1
            fault = ""
            done: object
            if event == "map_key":
                keys[-1] = name = str(value)
                fault = "is there twice" if name in around[-1] else _unfit(name)
            elif event in {"end_map", "end_array"}:
                done = around.pop()
                keys.pop()
                if not around:
                    break
            else:
                done = value
                if event == "start_map":
                    done = {}
                elif event == "start_array":
                    done = []
                else:
                    fault = _unfit(value)
                if around:
                    outer = around[-1]
                    if isinstance(outer, dict):
                        outer[keys[-1]] = done
                    else:
                        outer.append(done)
                if isinstance(done, dict | list):
                    around.append(done)
                    keys.append("")
                elif not around:
                    break
            if fault:
                wrong = wrong or WrongError(at + _path(around, keys), fault)
            if self._values > MOST_VALUES or depth + len(around) > DEEPEST:
                self._unbounded(at)
            event, value = next(self._events)
        if fault:
            wrong = WrongError(at, fault)
        if wrong is not None:
            raise wrong
        return done

    def _unbounded(self, place: str) -> NoReturn:
        if self._values > MOST_VALUES:
            self._fail(place, f"there are more than {MOST_VALUES} values in one part", "split it")
        self._fail(place, f"more than {DEEPEST} objects and lists lie in each other")

    # --- the bytes --------------------------------------------------------------------------------

    def _parsed(self) -> Iterator[tuple[str, object]]:
        """Yield what JSON says, a chunk at a time."""
        events = ijson.sendable_list()
        parser = ijson.basic_parse_coro(events)
        text = codecs.getincrementaldecoder("utf-8")()
        silent = 0
        while chunk := self._read():
            self._check_text(text, chunk)
            try:
                parser.send(chunk)
            except _BROKEN:
                # what was told last may be no object at all: it is not looked at
                self._byte(self._offset + self._good(chunk), "this is no JSON that can be read")
            self._offset += len(chunk)
            silent = 0 if events else silent + len(chunk)
            if silent > LONGEST_TOKEN:
                what = f"more than {LONGEST_TOKEN} bytes are one string, one number or blank"
                self._byte(self._offset - silent, what)
            if self._offset - self._begin > LONGEST_PART:
                what = f"more than {LONGEST_PART} bytes are one test, or the head"
                self._byte(self._begin, what, "split it")
            yield from events
            del events[:]
        if not self._offset:
            self._byte(0, "the file is empty")
        self._check_text(text, b"", final=True)
        try:
            parser.close()
        except _BROKEN:
            self._byte(self._offset, "the file ends too early", "copy or export it as a whole")
        yield from events

    def _read(self) -> bytes:
        try:
            return self._source.read(_CHUNK)
        except OSError as error:
            self._byte(self._offset, f"cannot be read ({error.strerror})", "give another file")

    def _check_text(
        self, text: codecs.IncrementalDecoder, chunk: bytes, *, final: bool = False
    ) -> None:
        waiting = len(text.getstate()[0])
        try:
            text.decode(chunk, final)
        except UnicodeDecodeError as error:
            self._byte(self._offset - waiting + error.start, "the file is not UTF-8")

    def _good(self, chunk: bytes) -> int:
        """Give how many bytes of a chunk make sense, by reading all again, where that can be."""
        events = ijson.sendable_list()
        parser = ijson.basic_parse_coro(events)
        left = self._offset
        try:
            self._source.seek(0)
            while left and (part := self._source.read(min(left, _CHUNK))):
                parser.send(part)
                del events[:]
                left -= len(part)
        except OSError:
            return 0
        for good in range(len(chunk)):
            try:
                parser.send(chunk[good : good + 1])
            except _BROKEN:
                return good
            del events[:]
        return len(chunk)

    def _byte(self, offset: int, what: str, remedy: str = _REMEDY) -> NoReturn:
        self._fail(f"byte {offset}", what, remedy)

    def _foreign(self, why: str) -> NoReturn:
        remedy = "give a file that `ecatspec export DEVICE --format json` made"
        raise UserError(f"{self._name}: no test vectors, {why}; {remedy}")

    def _fail(self, place: str, what: str, remedy: str = _REMEDY) -> NoReturn:
        self._refuse(WrongError(place, what, remedy))

    def _refuse(self, wrong: WrongError) -> NoReturn:
        raise UserError(f"{self._name}: {wrong}") from None


def _converted(value: object, kind: type[_T], place: str) -> _T:
    """Give a value as the type that it is to have."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        found = _WHERE.fullmatch(str(error))
        assert found is not None
        what, key, path = found.groups(default="")
        where = f"{place}{path}".removeprefix(".") or "the head"
        raise WrongError(_cut(where), f"{'a key: ' * bool(key)}{_cut(what)}") from None


def _unfit(value: object) -> str:
    """Say why a value can be in no file of test vectors; none: it can."""
    if isinstance(value, Decimal):
        return "is no whole number"
    if isinstance(value, int):
        return "is too large a number" if abs(value) > _LARGEST else ""
    if isinstance(value, str) and not value.isascii():
        try:
            value.encode()
        except UnicodeEncodeError:
            return "holds half a character"
    return ""


def _path(around: list[dict[str, object] | list[object]], keys: list[str]) -> str:
    return "".join(
        f"[{len(outer) - 1}]" if isinstance(outer, list) else f".{_cut(key)}"
        for outer, key in zip(around, keys, strict=True)
        if key or isinstance(outer, list)
    )


def _shown(value: object) -> str:
    simple = isinstance(value, str | int) or value is None
    return _cut(repr(value)) if simple else f"a {type(value).__name__}"


def _cut(text: str) -> str:
    """Shorten what a stranger wrote."""
    return text if len(text) <= _LONGEST_WORDS else f"{text[:_LONGEST_WORDS]}..."
