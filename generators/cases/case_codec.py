"""Writes a case as data for JSON or as one printable word, and reads it back.

The data leave out what has its default. Bytes are `{"hex": "00ff"}`, truths are 0 and 1, so that
equal cases have equal data.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import zlib
from typing import TYPE_CHECKING, Final, NoReturn, TypeAlias, assert_never

from ecatspec.generators.cases.case import (
    Case,
    Happen,
    Hurry,
    Probe,
    ReadConfiguration,
    ReadInitial,
    ReadRegister,
    Repeat,
    SendFrame,
    SendSegments,
    SetUpProcessData,
    Stimulus,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
    WriteUntilTaken,
)
from ecatspec.model.core.register_map import PROCESS_DATA

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import Value

Data: TypeAlias = "int | str | list[Data] | dict[str, Data]"

PREFIX: Final = "case."
_WORD: Final = re.compile(r"case\.([A-Za-z0-9_-]+)\Z")
_MOST_BYTES: Final = 1 << 20
"""Bytes of a case as JSON at most: a hostile token must not fill the memory."""
_MOST_STIMULI: Final = 10_000
_LONGEST_TEXT: Final = 400
_LEAST: Final = -(1 << 63)
_GREATEST: Final = (1 << 64) - 1
_FARTHEST: Final = (1 << 15) - 1
"""Bytes that a SyncManager may be longer or shorter than its process data at most."""
_HEX: Final = re.compile(r"([0-9a-f]{2})*")
_LONGEST_WAIT: Final = 3_600_000_000
"""Microseconds of one wait at most: an hour."""
_SHOWN: Final = 40
_LAST_INDEX: Final = (1 << 16) - 1
_LAST_SUBINDEX: Final = (1 << 8) - 1


# --- tokens ---------------------------------------------------------------------------------------


def token_of(case: Case) -> str:
    """Give a case as one word that needs no quotes in a shell; equal cases have the same.

    Raises:
        ValueError: A field of a frame is no number and no bytes.

    """
    text = json.dumps(to_data(case), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    packed = base64.urlsafe_b64encode(zlib.compress(text.encode("ascii"), 9))
    return PREFIX + packed.decode("ascii").rstrip("=")


def case_of(token: str) -> Case:
    """Give the case of a token.

    Raises:
        ValueError: It is none; the message is one line.

    """
    found = _WORD.match(token)
    if found is None:
        raise ValueError(f"{_short(token)} is no token of a case; copy it whole: case.LETTERS")
    word = found[1]
    unpacking = zlib.decompressobj()
    try:
        packed = base64.urlsafe_b64decode(word + "=" * (-len(word) % 4))
        text = unpacking.decompress(packed, _MOST_BYTES)
    except (binascii.Error, zlib.error):
        raise ValueError(f"{_short(token)} is damaged; copy the whole token") from None
    if unpacking.unconsumed_tail:
        raise ValueError(f"{_short(token)} has more than {_MOST_BYTES} bytes of a case")
    if not unpacking.eof or unpacking.unused_data:
        raise ValueError(f"{_short(token)} is damaged; copy the whole token")
    try:
        data = json.loads(text, object_pairs_hook=_distinct)
    except (ValueError, RecursionError):
        raise ValueError(f"{_short(token)} holds no JSON of a case") from None
    return from_data(data)


def _short(token: str) -> str:
    return repr(token if len(token) <= _SHOWN else f"{token[:_SHOWN]}...")


def _distinct(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key stands twice")
    return found


# --- a case as data -------------------------------------------------------------------------------


def to_data(case: Case) -> dict[str, Data]:
    """Give a case as data for JSON.

    Raises:
        ValueError: A field of a frame is no number and no bytes.

    """
    data: dict[str, Data] = {"name": case.name, "title": case.title, "layer": case.layer}
    data["stimuli"] = [_data_of(stimulus) for stimulus in case.stimuli]
    given: dict[str, Data] = {"prelude": case.prelude, "flag": case.flag, "feature": case.feature}
    given["about"] = case.about
    data |= {key: value for key, value in given.items() if value}
    return data if case.needs is None else data | {"needs": case.needs}


def _data_of(stimulus: Stimulus) -> dict[str, Data]:
    match stimulus:
        case WriteRegister(register, fields):
            data: dict[str, Data] = {"do": "write_register", "register": register}
            return data | {"fields": _numbers_of(fields)}
        case WriteRegisters(writes):
            rows: list[Data] = [
                {"register": write.register, "fields": _numbers_of(write.fields)}
                for write in writes
            ]
            return {"do": "write_registers", "writes": rows}
        case ReadRegister(register):
            return {"do": "read_register", "register": register}
        case SendFrame(frame, fields, same_counter, unread):
            data = {"do": "send_frame", "frame": frame}
            data |= {"fields": {name: _value_of(name, value) for name, value in fields.items()}}
            flags: dict[str, Data] = {"same_counter": int(same_counter), "unread": int(unread)}
            return data | {name: value for name, value in flags.items() if value}
        case SendSegments():
            return {"do": "send_segments"}
        case Repeat():
            return {"do": "repeat"}
        case Probe():
            return {"do": "probe"}
        case ReadInitial(index, subindex):
            return {"do": "read_initial", "index": index, "subindex": subindex}
        case WriteUntilTaken(index, subindex):
            return {"do": "write_until_taken", "index": index, "subindex": subindex}
        case ReadConfiguration():
            return {"do": "read_configuration"}
        case SetUpProcessData(changes, longer):
            data = {"do": "set_up_process_data"}
            if changes:
                data |= {"changes": {name: _numbers_of(own) for name, own in changes.items()}}
            return data | ({"longer": _numbers_of(longer)} if longer else {})
        case WriteOutputs(words):
            return {"do": "write_outputs", "words": _numbers_of(words)}
        case StopOutputs():
            return {"do": "stop_outputs"}
        case Wait(microseconds):
            return {"do": "wait", "microseconds": microseconds}
        case Hurry():
            return {"do": "hurry"}
        case Happen(event):
            return {"do": "happen", "event": event}
        case _:
            assert_never(stimulus)


def _numbers_of(numbers: Mapping[str, int]) -> Data:
    return {name: int(value) for name, value in numbers.items()}


def _value_of(name: str, value: Value) -> Data:
    if isinstance(value, bytes):
        return {"hex": value.hex()}
    if isinstance(value, int):
        return int(value)
    raise ValueError(f"the field {name!r} is {value!r}; a token carries numbers and bytes")


# --- data as a case -------------------------------------------------------------------------------


def from_data(data: object) -> Case:
    """Give the case that `to_data` made data of.

    What the data name may be missing in the texts that the case is run with: see `check`.

    Raises:
        ValueError: They are no data of a case; the message is one line and names the place.

    """
    given = _Given("the case", data)
    stimuli = tuple(_stimulus(each) for each in given.rows("stimuli"))
    case = Case(
        given.text("name"),
        given.text("title"),
        given.text("layer"),
        stimuli,
        given.text("needs") if given.has("needs") else None,
        given.number("prelude", 0, len(stimuli), default=0),
        given.text("flag", default=""),
        given.text("feature", default=""),
        given.text("about", default=""),
    )
    given.nothing_else()
    return case


def _stimulus(given: _Given) -> Stimulus:
    kind = given.text("do")
    made: Stimulus
    match kind:
        case "write_register":
            made = WriteRegister(given.text("register"), given.numbers("fields"))
        case "write_registers":
            made = WriteRegisters(tuple(_register_write(each) for each in given.rows("writes")))
            if not made.writes:
                given.wrong("writes", "is empty")
        case "read_register":
            made = ReadRegister(given.text("register"))
        case "send_frame":
            made = SendFrame(
                given.text("frame"),
                given.values("fields"),
                same_counter=bool(given.number("same_counter", 0, 1, default=0)),
                unread=bool(given.number("unread", 0, 1, default=0)),
            )
        case "send_segments":
            made = SendSegments()
        case "repeat":
            made = Repeat()
        case "probe":
            made = Probe()
        case "read_initial":
            made = ReadInitial(*_entry_of(given))
        case "write_until_taken":
            made = WriteUntilTaken(*_entry_of(given))
        case "read_configuration":
            made = ReadConfiguration()
        case "set_up_process_data":
            changes = given.part("changes")
            found = {name: changes.numbers(name) for name in changes.names()}
            longer = given.numbers("longer", -_FARTHEST, _FARTHEST, default={})
            made = SetUpProcessData(found, longer)
        case "write_outputs":
            made = WriteOutputs(given.numbers("words"))
        case "stop_outputs":
            made = StopOutputs()
        case "wait":
            made = Wait(given.number("microseconds", 0, _LONGEST_WAIT))
        case "hurry":
            made = Hurry()
        case "happen":
            made = Happen(given.text("event"))
        case _:
            given.wrong("do", f"is no stimulus: {_short(kind)}")
    given.nothing_else()
    return made


def _entry_of(given: _Given) -> tuple[int, int]:
    return given.number("index", 0, _LAST_INDEX), given.number("subindex", 0, _LAST_SUBINDEX)


def _register_write(given: _Given) -> WriteRegister:
    made = WriteRegister(given.text("register"), given.numbers("fields"))
    given.nothing_else()
    return made


class _Given:
    """An object of the data; what has been taken from it must be all that there is."""

    def __init__(self, place: str, data: object) -> None:
        if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
            raise ValueError(f"{place} is no object with names: {_short(repr(data))}")
        self._place = place
        self._data: dict[str, object] = dict(data)
        self._left = dict.fromkeys(self._data)

    def wrong(self, key: str, reason: str) -> NoReturn:
        raise ValueError(f"{self._place}: {_short(key)} {reason}")

    def nothing_else(self) -> None:
        for key in self._left:
            self.wrong(key, "is not known here")

    def has(self, key: str) -> bool:
        return key in self._data

    def names(self) -> list[str]:
        return list(self._data)

    def text(self, key: str, *, default: str | None = None) -> str:
        text = self._take(key, default)
        if not isinstance(text, str) or len(text) > _LONGEST_TEXT or not text.isprintable():
            self.wrong(key, f"is no printable text of at most {_LONGEST_TEXT} signs")
        return text

    def number(self, key: str, low: int, high: int, *, default: int | None = None) -> int:
        number = self._take(key, default)
        if type(number) is not int or not low <= number <= high:
            self.wrong(key, f"is no whole number from {low} to {high}")
        return number

    def rows(self, key: str) -> list[_Given]:
        rows = self._take(key, None)
        if not isinstance(rows, list) or len(rows) > _MOST_STIMULI:
            self.wrong(key, f"is no list of at most {_MOST_STIMULI} rows")
        return [_Given(f"{key}[{number}]", row) for number, row in enumerate(rows)]

    def part(self, key: str) -> _Given:
        return _Given(f"{self._place}: {key}", self._take(key, {}))

    def numbers(
        self,
        key: str,
        low: int = _LEAST,
        high: int = _GREATEST,
        *,
        default: dict[str, int] | None = None,
    ) -> dict[str, int]:
        part = _Given(f"{self._place}: {_short(key)}", self._take(key, default))
        return {name: part.number(name, low, high) for name in part.names()}

    def values(self, key: str) -> dict[str, Value]:
        part = _Given(f"{self._place}: {key}", self._take(key, None))
        return {name: part.value(name) for name in part.names()}

    def value(self, key: str) -> Value:
        if not isinstance(self._data[key], dict):
            return self.number(key, _LEAST, _GREATEST)
        part = self.part(key)
        digits = part._data.get("hex")  # noqa: SLF001  an object of the same class
        if part.names() != ["hex"] or not isinstance(digits, str) or not _HEX.fullmatch(digits):
            self.wrong(key, 'is no number and no {"hex": "00ff"}')
        return bytes.fromhex(digits)

    def _take(self, key: str, default: object) -> object:
        self._left.pop(key, None)
        if key in self._data:
            return self._data[key]
        if default is None:
            self.wrong(key, "is missing")
        return default


# --- a case and the texts -------------------------------------------------------------------------


def check(case: Case, model: Model) -> None:
    """Demand that the texts have what a case names: registers, frames, fields, words, events.

    Raises:
        ValueError: Something is missing, or a register has no room for it; the message is one line.

    """
    for number, stimulus in enumerate(case.stimuli):
        for missing in _missing(stimulus, model):
            raise ValueError(f"stimulus {number}: {model.protocol.name} has no {missing}")


def _missing(stimulus: Stimulus, model: Model) -> Iterator[str]:
    protocol = model.protocol
    match stimulus:
        case WriteRegister(register, fields):
            yield from _absent("register", (register,), protocol.registers)
            widths = {f.name: f.high - f.low + 1 for f in protocol.registers[register].fields}
            yield from _absent(f"field of {register}", fields, widths)
            for name, value in fields.items():
                if not 0 <= value < 1 << widths[name]:
                    yield f"room for {value} in {register}.{name}"
        case WriteRegisters(writes):
            for write in writes:
                yield from _missing(write, model)
        case ReadRegister(register):
            yield from _absent("register", (register,), protocol.registers)
        case SendFrame(frame, fields):
            yield from _absent("frame", (frame,), protocol.frames)
            trail = (protocol.frames[name] for name in model.codec.trail(frame))
            known = {field.name for layout in trail for field in layout.fields}
            yield from _absent(f"field of {frame}", fields, known)
        case SetUpProcessData(changes, longer):
            for register, fields in changes.items():
                yield from _missing(WriteRegister(register, fields), model)
            yield from _absent("process data SyncManager", longer, PROCESS_DATA)
        case WriteOutputs(words):
            yield from _absent("word", words, protocol.words)
        case Happen(event):
            known = {f"{local.machine}.{local.input}" for local in model.locals}
            yield from _absent("local event", (event,), known)
        case ReadInitial(index, subindex) | WriteUntilTaken(index, subindex):
            if (index, subindex) not in model.dictionary.entries:
                yield f"entry 0x{index:04X}:{subindex:02X}"
        case SendSegments() | Repeat() | Probe() | ReadConfiguration():
            pass
        case StopOutputs() | Wait() | Hurry():
            pass
        case _:
            assert_never(stimulus)


def _absent(what: str, names: Iterable[str], known: Collection[str]) -> Iterator[str]:
    yield from (f"{what} {_short(name)}" for name in names if name not in known)
