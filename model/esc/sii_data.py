"""Reads the EEPROM (SII) of a SubDevice as data, and writes the same bytes again."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from ecatspec.model.esc.sii import WORD, checksum

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import Value

_CONFIGURATION: Final = "sii_configuration"
_INFORMATION: Final = "sii_information"
_HEADER: Final = "sii_category_header"
_STRING: Final = "sii_string"
_PDO: Final = "sii_pdo"
_ENTRY: Final = "sii_pdo_entry"
_FRAMES: Final = MappingProxyType(
    {
        "general": "sii_general",
        "sync_managers": "sii_sync_manager",
        "tx_pdos": _PDO,
        "rx_pdos": _PDO,
        "clocks": "sii_clock",
    }
)
"""The layout of the records of a category."""


class SiiError(Exception):
    """The bytes are no SII; the message says why in one line."""


@dataclass(frozen=True, slots=True)
class Record:
    """One layout of the texts with its fields."""

    frame: str
    fields: Mapping[str, Value]

    def number(self, field: str) -> int:
        """Give a field that is a number."""
        value = self.fields[field]
        if not isinstance(value, int):
            raise TypeError(f"{self.frame}.{field} is no number")
        return value


@dataclass(frozen=True, slots=True)
class Category:
    """One category; behind each record of a PDO come those of its entries.

    `count` is the number of strings. `rest` holds what has no layout: all of a category of a
    vendor, the uses of FMMUs, a filling byte.
    """

    kind: int
    name: str
    records: tuple[Record, ...]
    rest: bytes
    count: int | None = None


@dataclass(frozen=True, slots=True)
class Sii:
    """The whole content: what has fixed places, the categories, and what follows them.

    `ended` tells whether a mark ends the categories; `rest` holds all bytes behind the mark, or
    behind the last whole category where there is no mark.
    """

    configuration: Record
    information: Record
    categories: tuple[Category, ...]
    ended: bool
    rest: bytes

    def strings(self) -> tuple[bytes, ...]:
        """Give the strings; the first has number 1."""
        found: list[bytes] = []
        for category in self.categories:
            for record in category.records:
                text = record.fields.get("text") if record.frame == _STRING else None
                if isinstance(text, bytes):
                    found.append(text)
        return tuple(found)


def read_sii(model: Model, data: bytes) -> Sii:
    """Read an image; `model` is of texts which include those of the link.

    SiiError: the part with fixed places is not whole.
    """
    codec = model.codec
    start, size = codec.size(_CONFIGURATION), _head_size(model)
    if len(data) < size:
        raise SiiError(f"an SII has at least {size} bytes, and here are {len(data)}")
    categories: list[Category] = []
    at, ended = size, False
    header = codec.size(_HEADER)
    mark = model.row("sii_category", "end").to_bytes(WORD, "little")
    while True:
        if data[at : at + WORD] == mark:
            ended, at = True, at + WORD
            break
        if at + header > len(data):
            break
        record = _record(model, _HEADER, data[at : at + header])
        end = at + header + record.number("words") * WORD
        if end > len(data):
            break
        categories.append(_category(model, record.number("kind"), data[at + header : end]))
        at = end
    return Sii(
        _record(model, _CONFIGURATION, data[:start]),
        _record(model, _INFORMATION, data[start:size]),
        tuple(categories),
        ended,
        data[at:],
    )


def write_sii(model: Model, sii: Sii) -> bytes:
    """Give the bytes of an image; checksum and size are those of the data, right or not."""
    parts = [_bytes(model, sii.configuration), _bytes(model, sii.information)]
    for category in sii.categories:
        content = _content(model, category)
        fields: dict[str, Value] = {"kind": category.kind, "words": len(content) // WORD}
        parts += [model.codec.encode(_HEADER, fields), content]
    if sii.ended:
        parts.append(model.row("sii_category", "end").to_bytes(WORD, "little"))
    return b"".join((*parts, sii.rest))


def right_checksum(model: Model, sii: Sii) -> int:
    """Give the checksum that the configuration area should have."""
    return checksum(model, _bytes(model, sii.configuration))


def _head_size(model: Model) -> int:
    return model.codec.size(_CONFIGURATION) + len(model.codec.encode(_INFORMATION, {}))


def _record(model: Model, frame: str, data: bytes) -> Record:
    message = model.codec.decode(data, frame)
    if message is None:
        raise SiiError(f"{len(data)} bytes do not hold {frame}")
    return Record(frame, MappingProxyType(dict(message.fields)))


def _bytes(model: Model, record: Record) -> bytes:
    return model.codec.encode(record.frame, record.fields)


def _content(model: Model, category: Category) -> bytes:
    count = b"" if category.count is None else bytes([category.count])
    return b"".join((count, *(_bytes(model, each) for each in category.records), category.rest))


def _category(model: Model, kind: int, content: bytes) -> Category:
    names = {row.value: row.name for row in model.protocol.tables["sii_category"].rows}
    name = names.get(kind, "")
    if name == "strings" and content:
        records = tuple(_strings(model, content))
        count: int | None = content[0]
    else:
        records = tuple(_records(model, _FRAMES[name], content)) if name in _FRAMES else ()
        count = None
    used = len(_content(model, Category(kind, name, records, b"", count)))
    return Category(kind, name, records, content[used:], count)


def _strings(model: Model, content: bytes) -> Iterator[Record]:
    at = 1
    for _ in range(content[0]):
        message = model.codec.decode(content[at:], _STRING)
        if message is None:
            return
        record = Record(_STRING, MappingProxyType(dict(message.fields)))
        yield record
        at += len(_bytes(model, record))


def _records(model: Model, frame: str, content: bytes) -> Iterator[Record]:
    at, entries = 0, 0
    while at < len(content):
        layout = _ENTRY if entries else frame
        message = model.codec.decode(content[at:], layout)
        if message is None:
            return
        record = Record(layout, MappingProxyType(dict(message.fields)))
        yield record
        at += len(_bytes(model, record))
        entries = record.number("entries") if layout == _PDO else max(0, entries - 1)
