"""Marks the fields that differ, and cleans words of a device before they are printed."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ecatspec.conformance.base.verdict import Finding, Result, Verdict


def plain(text: str) -> str:
    """Give the text on one line, without signs that a terminal would obey."""
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in words)


def plural(count: int, word: str) -> str:
    """Say how many there are."""
    return f"{count} {word}" if count == 1 else f"{count} {word}s"


def interruption(result: Result) -> str:
    """Say how far an interrupted run came, and how to go on; empty: it came to its end."""
    if not result.interrupted:
        return ""
    done = len(result.verdicts)
    if not result.planned:
        return f"interrupted after {plural(done, 'case')}"
    return f"interrupted after {done} of {plural(result.planned, 'case')}; --resume goes on"


def needs(verdict: Verdict) -> str:
    """Say on which ways of the device a finding depends."""
    return f"it is a finding because the device goes this way: {', '.join(verdict.depends)}"


def kinds(finding: Finding) -> list[str]:
    """Say what else was observed of a finding, and where."""
    return [
        f"{verdict.title} [{verdict.broken}]: {verdict.case}, {plural(count, 'case')}"
        for verdict, count in finding.kinds
    ]


def headline(observed: str, differing: Sequence[str], wording: str) -> str:
    """Say what was observed in the fewest words, and the demand that it breaks."""
    odd = [part.lstrip(":;, ") for part, differs in parts(observed, differing) if differs]
    said = ", ".join(odd) or observed.partition(": counter")[0]
    return f"{said}, but {wording}"


def parts(words: str, differing: Sequence[str]) -> Iterator[tuple[str, bool]]:
    """Yield what was expected or observed in parts; True where a part names what differs.

    The words are those of `model.words`: `layout: field value, field value; layout: ...`.
    """
    if not differing:
        yield words, False
        return
    names = "|".join(map(re.escape, differing))
    found = re.compile(rf"(?:^|(?<=[:;,] ))(?:{names})(?: [^,;:]+)?(?=[,;:]|$)")
    end = 0
    for match in found.finditer(words):
        if match.start() > end:
            yield words[end : match.start()], False
        yield match.group(), True
        end = match.end()
    if end < len(words):
        yield words[end:], False
