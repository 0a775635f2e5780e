"""Tells the content of an EEPROM (SII) in tables."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

from ecatspec.conformance.render.tables import Sheet
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.data_link import linked
from ecatspec.model.esc.sii_data import read_sii, right_checksum
from ecatspec.spec.language.ir import Named
from ecatspec.spec.language.load import load_device, load_link

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.conformance.render.tables import Cell
    from ecatspec.model.core.values import Value
    from ecatspec.model.esc.sii_data import Category, Record, Sii


def sii_sheets(data: bytes) -> tuple[Sheet, ...]:
    """Give an image as tables: its head, its strings, its categories.

    SiiError: the part with fixed places is not whole.
    """
    model = Model(linked(load_device("standard"), load_link()))
    sii = read_sii(model, data)
    head = (*_fields(model, sii.configuration), *_fields(model, sii.information))
    right = right_checksum(model, sii)
    stored = sii.information.number("checksum")
    said = "right" if stored == right else f"wrong: 0x{right:02X} by the bytes"
    checked: tuple[Cell, ...] = ("checksum of the configuration", said)
    texts = tuple((n, _text(text)) for n, text in enumerate(sii.strings(), 1))
    return (
        Sheet(
            "head", "Configuration, identity and mailboxes", ("field", "value"), (*head, checked)
        ),
        Sheet("strings", "Strings", ("number", "text"), texts),
        *(_category(model, at, each) for at, each in enumerate(sii.categories) if _shown(each)),
        Sheet("end", "Behind the categories", ("field", "value"), _end(sii)),
    )


def _shown(category: Category) -> bool:
    return category.name != "strings"


def _end(sii: Sii) -> tuple[tuple[Cell, ...], ...]:
    mark = "there" if sii.ended else "missing"
    return ("end of the categories", mark), ("bytes behind", len(sii.rest))


def _category(model: Model, at: int, category: Category) -> Sheet:
    name = category.name or f"category_{category.kind}"
    rows = tuple(
        chain.from_iterable(
            ((number, *row) for row in _fields(model, record))
            for number, record in enumerate(category.records)
        )
    )
    if category.rest:
        rows += ((len(category.records), "bytes", category.rest.hex(" ")),)
    title = f"Category {category.kind}" + (f": {category.name}" if category.name else "")
    return Sheet(f"{at}_{name}", title, ("record", "field", "value"), rows)


def _fields(model: Model, record: Record) -> Iterator[tuple[str, str]]:
    types = {field.name: field.type for field in model.protocol.frames[record.frame].fields}
    for name, value in record.fields.items():
        kind = types[name]
        if isinstance(kind, Named) and isinstance(value, int):
            rows = model.protocol.tables[kind.table].rows
            named = next((row.name for row in rows if row.value == value), "not in the table")
            yield name, f"{value} ({named})"
        else:
            yield name, _value(value)


def _value(value: Value) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case int():
            return f"0x{value:X}"
        case bytes():
            return value.hex(" ") if any(value) else f"{len(value)} bytes 0"
        case _:
            return str(value)


def _text(text: bytes) -> str:
    words = text.decode("latin-1")
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in words)
