"""Reports findings as annotations of GitHub, one line each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.render.annotations import annotation
from ecatspec.conformance.render.marks import kinds, needs, plural

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.conformance.base.verdict import Finding, Result
    from ecatspec.conformance.render.annotations import Kind
    from ecatspec.spec.language.ir import Protocol

_MOST: Final = 50
"""Annotations at most; GitHub shows ten of a kind for each step, and fifty for each job."""


def report(results: Sequence[Result], protocol: Protocol) -> str:
    """Give one line for each finding, or nothing."""
    del protocol
    every = [(result, finding) for result in results for finding in result.findings()]
    lines = [_line(*each) for each in every[:_MOST]]
    if len(every) > _MOST:
        more = plural(len(every) - _MOST, "finding")
        lines.append(annotation("notice", f"{more} more, see the report"))
    return "".join(f"{line}\n" for line in lines)


def _line(result: Result, finding: Finding) -> str:
    verdict = finding.verdict
    bad = verdict.outcome in BLAMING or verdict.outcome is Outcome.ERROR
    said = [f"{result.device}, tested: {result.subject}"]
    if verdict.broken:
        said.append(f"broken: {verdict.broken}")
    if verdict.involved:
        said.append(f"involved: {', '.join(verdict.involved)}")
    said += [f"expected: {words}" for words in verdict.expected[:3]]
    if verdict.observed:
        said.append(f"observed: {verdict.observed}")
    said += [f"seen too: {kind}" for kind in kinds(finding)[:3]]
    if verdict.depends:
        said.append(needs(verdict))
    if result.set_up is not None:
        said.append(result.set_up.command(verdict))
    title = f"{verdict.outcome.value}: {verdict.title}"
    kind: Kind = "error" if bad else "warning"
    if verdict.outcome is Outcome.KNOWN:
        kind = "notice"
    return annotation(kind, *said, title=title)
