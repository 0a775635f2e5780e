"""Colours the report for people, on a terminal that wants colours."""

from __future__ import annotations

import io
from typing import Final

from rich.console import Console
from rich.text import Text

from ecatspec.conformance.reports.text import MARKS

_STYLES: Final = (
    (r"(?m)^\d+\. (CRASH|FAIL|ERROR): .*$", "bold red"),
    (r"(?m)^\d+\. WARNING: .*$", "bold yellow"),
    (r"(?m)^  (DOES NOT CONFORM|NOT SHOWN|NOT JUDGED).*$", "bold red"),
    (r"(?m)^  conforms.*$", "bold green"),
    (r"(?m)^(findings|not judged|notes)$", "bold"),
    (r"(?m)^  [a-z]{2,9}(?= {2,})", "cyan"),
    (r"\|(-+>|<-+| +)[|X]", "dim"),
    (rf"(?<= ){MARKS[0]}[^{MARKS[1]}]+{MARKS[1]}", "bold red"),
)
"""What is found in the text, and its style."""


def coloured(text: str) -> str:
    """Give the report with colours, as far as the terminal and NO_COLOR allow."""
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, legacy_windows=False)
    styled = Text(text, end="")
    for pattern, style in _STYLES:
        styled.highlight_regex(pattern, style)
    console.print(styled, soft_wrap=True, end="")
    return out.getvalue()
