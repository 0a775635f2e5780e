"""Sets tables of words as text and as Markdown."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import zip_longest
from textwrap import wrap
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterable

Cell: TypeAlias = str | int | tuple[str, ...]

_GAP: Final = "  "
_LEAST: Final = 40
"""Columns of a table at least, however small the terminal is."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """One table; a cell with several parts is shown with commas and is a list in JSON."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def cell_words(cell: Cell) -> str:
    """Give a cell in words."""
    return ", ".join(cell) if isinstance(cell, tuple) else str(cell)


def text_table(sheet: Sheet, width: int) -> str:
    """Give a sheet as a table of text of at most `width` columns, with its title; numbers right."""
    rows = [[cell_words(cell) for cell in row] for row in sheet.rows]
    right = [
        all(isinstance(row[at], int) for row in sheet.rows) for at in range(len(sheet.columns))
    ]
    needed = [max(map(len, column)) for column in zip(sheet.columns, *rows, strict=True)]
    widths = _fitted(needed, max(width, _LEAST) - len(_GAP) * (len(needed) - 1))
    rule = "─" * (sum(widths) + len(_GAP) * (len(widths) - 1))
    lines = [*_set(sheet.columns, widths, right), rule]
    for row in rows:
        lines += _set(row, widths, right)
    return f"\n{sheet.title}\n\n" + "".join(f"{line}\n" for line in lines)


def _fitted(widths: list[int], space: int) -> list[int]:
    """Take from the widest columns until all fit into the space."""
    while sum(widths) > space and max(widths) > 1:
        widest = max(widths)
        count = widths.count(widest)
        next_widest = max((each for each in widths if each < widest), default=1)
        excess = -(-(sum(widths) - space) // count)
        width = max(next_widest, widest - excess, 1)
        widths = [width if each == widest else each for each in widths]
    return widths


def _set(cells: Iterable[str], widths: list[int], right: list[bool]) -> list[str]:
    """Set a row in lines: what is wider than its column goes on below."""
    columns = [
        (cell,) if len(cell) <= width else wrap(cell, width)
        for cell, width in zip(cells, widths, strict=True)
    ]
    return [
        _GAP.join(
            part.rjust(width) if to_right else part.ljust(width)
            for part, width, to_right in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in zip_longest(*columns, fillvalue="")
    ]


def markdown_table(sheet: Sheet) -> str:
    """Give a sheet as a table of Markdown."""
    lines = [_line(sheet.columns), _line("---" for _ in sheet.columns)]
    lines += [_line(map(cell_words, row)) for row in sheet.rows]
    return "\n".join(lines)


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
