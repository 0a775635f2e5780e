"""Draws a machine as Mermaid text, for Markdown pages."""

from __future__ import annotations

import json
import textwrap
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.drawings.graph import ERRORS, graph_of

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import Protocol

_BREAK: Final = "<br/>"
_LISTED: Final = "The lists are comments in the text of this drawing."
_NOTE: Final = 25
_WIDEST: Final = 100
_SPECIAL: Final = frozenset('"#;:<>&%{}[]()\\|`')


def drawing(protocol: Protocol, machine: str) -> str:
    """Draw a machine as stateDiagram-v2: a note counts what is not drawn, comments list it.

    Raises:
        UserError: There is no such machine.

    """
    graph = graph_of(protocol, machine)
    states = (*graph.line, *graph.aside)
    # The name of a state may be a word of Mermaid, in capitals too.
    known = {state: f"s{place}" for place, state in enumerate(states)}
    lines = ["---", f"title: {json.dumps(graph.title)}", "---", "stateDiagram-v2"]
    lines += [f'  state "{_escaped(state)}" as {known[state]}' for state in states]
    lines.append(f"  [*] --> {known[graph.machine.initial]}")
    lines += [
        f"  {known[arrow.source]} --> {known[arrow.target]} : "
        + _BREAK.join(map(_escaped, arrow.names()))
        for arrow in graph.arrows
    ]
    # A note with all lists would tear the drawing apart, and Mermaid decodes no number in a note.
    lines.append(f"  note right of {known[graph.line[-1]]}")
    summary = f"{graph.legend[0].words} {_LISTED if graph.legend[1:] else ''}"
    lines += [f"    {line}" for line in textwrap.wrap(summary, _NOTE)]
    lines.append("  end note")
    for entry in graph.legend[1:]:
        words = f"{entry.words}: {', '.join(entry.names)}"
        lines += textwrap.wrap(words, _WIDEST, initial_indent="  %% ", subsequent_indent="  %%   ")
    errors = ",".join(known[state] for state in graph.aside if state in ERRORS)
    if errors:
        lines += ["  classDef error stroke:#cf222e,stroke-width:2px", f"  class {errors} error"]
    return "\n".join(lines) + "\n"


def _escaped(text: str) -> str:
    """Write what means something to Mermaid, and what is not ASCII, by its number."""
    return "".join(
        f"#{ord(sign)};" if sign in _SPECIAL or not " " <= sign <= "~" else sign for sign in text
    )
