"""Draws a machine as DOT text, for Graphviz and tools that read its language."""

from __future__ import annotations

import textwrap
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.drawings.graph import ERRORS, graph_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.conformance.drawings.graph import Arrow, Graph
    from ecatspec.spec.language.ir import Protocol

_WIDEST: Final = 110
_LEFT: Final = "\\l"
"""Ends a line of text that begins at the left."""
_FONT: Final = 'fontname="monospace"'


def drawing(protocol: Protocol, machine: str) -> str:
    """Draw a machine as a digraph; what stays in a state is told below it.

    Raises:
        UserError: There is no such machine.

    """
    graph = graph_of(protocol, machine)
    legend = [line for entry in graph.legend for line in _folded(entry.words, entry.names)]
    lines = [
        f'digraph "{_escaped(graph.machine.name)}" {{',
        f'  graph [label="{_lines((graph.title, "", *legend))}", labeljust=l, labelloc=b, {_FONT}]',
        f'  node [shape=box, style="rounded,filled", fillcolor="#ddf4ff", {_FONT}]',
        f"  edge [fontsize=10, {_FONT}]",
        # no state is called so: the name of a state has no blank
        '  "after power-on" [shape=point]',
    ]
    lines += [f"  {_node(graph, state)}" for state in (*graph.line, *graph.aside)]
    lines.append(f'  "after power-on" -> "{_escaped(graph.machine.initial)}"')
    # what keeps the states in their order, whatever the arrows are
    for column in (graph.line, graph.aside):
        lines += [
            f'  "{_escaped(one)}" -> "{_escaped(other)}" [style=invis, weight=100]'
            for one, other in pairwise(column)
        ]
    lines += [f"  {_edge(graph, arrow)}" for arrow in graph.arrows]
    return "\n".join((*lines, "}")) + "\n"


def _node(graph: Graph, state: str) -> str:
    colour = ', fillcolor="#ffebe9", color="#cf222e"' if state in ERRORS else ""
    if state in graph.aside and not colour:
        colour = ', fillcolor="#f6f8fa"'
    if state in graph.unreached:
        colour += ', style="rounded,filled,dashed"'
    tip = _escaped(graph.tips.get(state, state))
    return f'"{_escaped(state)}" [tooltip="{tip}"{colour}]'


def _edge(graph: Graph, arrow: Arrow) -> str:
    ends = f'"{_escaped(arrow.source)}" -> "{_escaped(arrow.target)}"'
    tip = _escaped(graph.tip(arrow))
    words = f'label="{_lines(arrow.names())}", tooltip="{tip}", labeltooltip="{tip}"'
    return f"{ends} [{words}, constraint=false]"


def _folded(words: str, names: tuple[str, ...]) -> list[str]:
    text = words + (f": {', '.join(names)}" if names else "")
    return textwrap.wrap(text, _WIDEST, subsequent_indent="    ")


def _lines(lines: Iterable[str]) -> str:
    return "".join(_escaped(line) + _LEFT for line in lines)


def _escaped(text: str) -> str:
    """Write a text for a quoted string; what HTML knows as an entity would be read as one."""
    words = text.replace("&", "&amp;").replace("\\", "\\\\").replace('"', '\\"')
    shown = (s if " " <= s <= "~" else "\\n" if s == "\n" else f"&#{ord(s)};" for s in words)
    return "".join(shown)
