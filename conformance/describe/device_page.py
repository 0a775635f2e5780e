"""Writes the page of a device: its text in Markdown."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.conformance.describe.text_tables import sheets
from ecatspec.conformance.render.tables import Sheet, markdown_table
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.spec.language.ir import Protocol

_APART = frozenset({"manuals", "choices", "anomalies", "machines", "pdos"})
"""Sheets with a section of their own, or of which every row is the device's."""


def chapter(protocol: Protocol) -> str:
    """Give the chapter: what the device does, where its manual is wrong, what stays open."""
    own = {clause.id for clause in protocol.clauses.values() if clause.claims}
    tables = {sheet.name: sheet for sheet in sheets(protocol)}
    parts = [f"# {protocol.wording}", _about(protocol)]
    parts.append("## What it says")
    for sheet in tables.values():
        kept = sheet if sheet.name == "pdos" else _own_rows(sheet, own)
        if kept.rows and (sheet.name not in _APART or sheet.name == "pdos"):
            parts += [f"### {capital(sheet.title)}", markdown_table(kept)]
    parts += ["## Where the manual is wrong", *_section(tables.get("anomalies"))]
    parts += ["## What was chosen, and what stays open", _chosen(protocol)]
    parts += ["## What the protocol does not show", _unobservable(protocol)]
    return "\n\n".join(parts) + "\n"


def _about(protocol: Protocol) -> str:
    clauses = [clause for clause in protocol.clauses.values() if clause.claims]
    claims = {claim for clause in clauses for claim in clause.claims}
    lines = [f"- Manual: {manual.edition}." for manual in protocol.manuals]
    lines.append(
        f"- The text has {len(clauses)} clauses for {len(claims)} statements of the manual,"
        f" {len(protocol.objects)} entries of the object dictionary"
        f" and {len(protocol.anomalies)} places where the manual is wrong or silent."
    )
    lines.append(f"- `ecatspec show {protocol.name}` has all of it, the standard included.")
    return "\n".join(lines)


def _own_rows(sheet: Sheet, own: set[str]) -> Sheet:
    """Keep the rows that rest on a clause of the device."""
    if "clauses" not in sheet.columns:
        return sheet
    at = sheet.columns.index("clauses")
    rows = tuple(row for row in sheet.rows if own.intersection(_several(row[at])))
    return Sheet(sheet.name, sheet.title, sheet.columns, rows)


def _several(cell: object) -> tuple[str, ...]:
    return cell if isinstance(cell, tuple) else (str(cell),)


def _section(sheet: Sheet | None) -> Iterator[str]:
    yield "Nothing is recorded." if sheet is None else markdown_table(sheet)


def _chosen(protocol: Protocol) -> str:
    rows = []
    for choice in protocol.choices.values():
        pin, left = protocol.pins.get(choice.name), protocol.opened.get(choice.name)
        cited = pin or left
        if cited is not None:
            way = "open: the manual is silent" if pin is None else pin.alternative
            words = "; ".join(protocol.clauses[name].wording for name in cited.clauses)
            rows.append((choice.wording, way, words, cited.clauses))
    columns = ("point", "the device", "because the manual says", "clauses")
    return markdown_table(Sheet("chosen", "", columns, tuple(rows)))


def _unobservable(protocol: Protocol) -> str:
    rows = tuple(
        (clause.wording, clause.because or "", clause.source, (clause.id,))
        for clause in protocol.clauses.values()
        if clause.level is Level.UNOBSERVABLE
    )
    return markdown_table(
        Sheet("unobservable", "", ("statement", "why", "source", "clauses"), rows)
    )


def capital(words: str) -> str:
    """Begin with a capital, as titles do."""
    return words[:1].upper() + words[1:]
