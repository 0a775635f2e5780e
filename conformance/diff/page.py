"""Writes a comparison as one self-contained page of HTML."""

from __future__ import annotations

import textwrap
from html import escape
from typing import TYPE_CHECKING, Final

from markupsafe import Markup

from ecatspec.conformance.diff.report import headline, sheets
from ecatspec.conformance.drawings.svg import drawing
from ecatspec.conformance.pages import render
from ecatspec.conformance.render.tables import cell_words

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.conformance.diff.behaviour import Behaviour
    from ecatspec.conformance.diff.comparison import Comparison
    from ecatspec.conformance.render.tables import Sheet

MARK: Final = "odd"
"""The CSS class of rules that decide about a difference."""
_STYLE: Final = Markup("""\
.both{display:grid;grid-template-columns:1fr 1fr;gap:1rem}
.both>*{overflow:auto;border:1px solid var(--line)}
.chart{max-width:900px;width:100%;height:auto}
.chart line{stroke:currentColor}
.chart text{fill:currentColor;font-size:13px}
.chart .odd{stroke:var(--bad);stroke-width:2}
details{margin:.4rem 0}
@media (max-width:60rem){.both{grid-template-columns:1fr}}
""")
_WIDTH: Final = 900
_LIVES: Final = (130, 450, 770)
"""Where the lines of the first device, the MainDevice and the second device stand."""
_ROW: Final = 34
_LINE: Final = 17
_LETTERS: Final = 34
"""Letters of an answer in one line."""
_MACHINES: Final = ("al", "ds402")


def page(found: Comparison) -> str:
    """Give the page: both diagrams side by side, all tables, and each witness as a chart."""
    title = f"{found.names[0]} against {found.names[1]}"
    body = [f"<h1>{escape(title)}</h1>", f"<p>{escape(headline(found))}</p>"]
    body += [_diagrams(found, machine) for machine in _MACHINES]
    body.append("<h2>Witnesses</h2>")
    body += [_witness(found, number, each) for number, each in enumerate(found.behaviours, 1)]
    body += [_table(sheet) for sheet in sheets(found)]
    # every word in it is escaped where it is put in
    return render("page.html", title=title, style=_STYLE, body=Markup("\n".join(body)))  # noqa: S704


def _diagrams(found: Comparison, machine: str) -> str:
    drawn = []
    for side, protocol in enumerate(found.protocols):
        if machine in protocol.machines:
            marked = dict.fromkeys(_odd_rules(found, machine, side), MARK)
            drawn.append(f'<div tabindex="0">{drawing(protocol, machine, marked)}</div>')
    heading = escape(f"The machine {machine}: rules that decide about differences are marked")
    return f'<h2>{heading}</h2>\n<div class="both">{"".join(drawn)}</div>'


def _odd_rules(found: Comparison, machine: str, side: int) -> Iterator[str]:
    for behaviour in found.behaviours:
        for rule in behaviour.rules[side]:
            owner, _, name = rule.partition(".")
            if owner == machine:
                yield name


def _table(sheet: Sheet) -> str:
    head = "".join(f'<th scope="col">{escape(column)}</th>' for column in sheet.columns)
    rows = "\n".join(
        f"<tr>{''.join(f'<td>{escape(cell_words(cell))}</td>' for cell in row)}</tr>"
        for row in sheet.rows
    )
    table = f"<table><thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody></table>"
    return f'<h2>{escape(sheet.title)}</h2>\n<div class="scroll" tabindex="0">{table}</div>'


def _witness(found: Comparison, number: int, behaviour: Behaviour) -> str:
    title = escape(f"{number}. {behaviour.machine}: {behaviour.subject} ({behaviour.effect.value})")
    cited = "".join(
        f"<li>{escape(f'{name}: {clause}, {protocol.clauses[clause].source}')}</li>"
        for name, protocol, clauses in zip(
            found.names, found.protocols, behaviour.clauses, strict=True
        )
        for clause in clauses
        if protocol.clauses[clause].claims
    )
    chart = _chart(found.names, behaviour)
    return f"<details><summary>{title}</summary>{chart}<ul>{cited}</ul></details>"


def _chart(names: tuple[str, str], behaviour: Behaviour) -> str:
    """Draw a witness: each input goes to both devices, and what they answer to the last one."""
    left, middle, right = _LIVES
    parts: list[str] = []
    y = 24
    for x, name in zip(_LIVES, (names[0], "MainDevice", names[1]), strict=True):
        parts.append(_text(x, y, name, "middle"))
    top = y = y + 10
    for given in behaviour.inputs:
        y += _ROW
        parts.append(_text(middle, y - 5, given.replace("_", " "), "middle"))
        parts += [_arrow(middle, left, y), _arrow(middle, right, y)]
    y += _ROW
    parts += [_arrow(left, middle, y, MARK), _arrow(right, middle, y, MARK)]
    bottom = y
    for x, answer in ((left, behaviour.answers[0]), (right, behaviour.answers[1])):
        lines = textwrap.wrap(answer, _LETTERS) or [""]
        for row, line in enumerate(lines, 1):
            parts.append(_text(x, y + row * _LINE, line, "middle"))
        bottom = max(bottom, y + (len(lines) + 1) * _LINE)
    lives = [f'<line x1="{x}" y1="{top}" x2="{x}" y2="{y + 4}"/>' for x in _LIVES]
    drawn = "".join((*lives, *parts))
    kind = 'class="chart" role="img" aria-label="sequence"'
    return f'<svg {kind} viewBox="0 0 {_WIDTH} {bottom}">{drawn}</svg>'


def _text(x: int, y: int, words: str, anchor: str) -> str:
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}">{escape(words)}</text>'


def _arrow(start: int, end: int, y: int, mark: str = "") -> str:
    back = 8 if end < start else -8
    kind = f' class="{mark}"' if mark else ""
    lines = ((start, y, end, y), (end, y, end + back, y - 4), (end, y, end + back, y + 4))
    return "".join(
        f'<line{kind} x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}"/>' for x1, y1, x2, y2 in lines
    )
