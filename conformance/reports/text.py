"""The only place for a report that people read: the summary first, then each finding once."""

from __future__ import annotations

import textwrap
from collections import Counter
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.reports import judged
from ecatspec.conformance.verdict import Outcome
from ecatspec.generators.families import NOTES

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ecatspec.conformance.verdict import Finding, Result, TraceLine
    from ecatspec.spec.language.ir import Protocol

WIDTH: Final = 80
_INDENT: Final = "  "
_LABEL: Final = 10
_MICROSECONDS: Final = 1000


def report(results: Sequence[Result], protocol: Protocol) -> str:
    """Give all results as text of 80 columns that ends with a newline."""
    blocks = [line for result in results for line in (*_result(result, protocol), "")]
    return "\n".join(blocks[:-1]) + "\n" if blocks else ""


def _result(result: Result, protocol: Protocol) -> Iterable[str]:
    findings = result.findings()
    yield from _wrapped("", f"{result.device}, tested: {result.subject}")
    yield from _wrapped(_INDENT, _judgement(result, findings))
    yield ""
    yield from _summary(result, protocol)
    for number, finding in enumerate(findings, 1):
        yield ""
        yield from _finding(f"{number}. ", finding, protocol)
    unjudged = list(_unjudged(result))
    if unjudged:
        yield from ("", "not judged", *unjudged)
    if result.notes:
        yield from ("", "notes")
        for note in result.notes:
            yield from _wrapped(_INDENT + "- ", note)


def _judgement(result: Result, findings: Sequence[Finding]) -> str:
    words = "conforms" if result.conforms else "DOES NOT CONFORM"
    if not judged(result):
        words = "NOT JUDGED"
    if findings:
        words += f": {_plural(len(findings), 'finding')}"
    if result.interrupted:
        words += " (interrupted: what was found so far)"
    return words


def _summary(result: Result, protocol: Protocol) -> Iterable[str]:
    counts = ((result.count(outcome), outcome.value) for outcome in Outcome)
    cases = ", ".join(f"{count} {name}" for count, name in counts if count) or "none"
    yield from _labelled("cases", [cases])
    yield from _labelled("rules", [f"{len(result.rules_covered)} of {result.rules_total} covered"])
    clauses = f"{len(result.clauses_covered)} of {result.clauses_total} covered"
    yield from _labelled("clauses", [clauses])
    yield from _labelled("choices", [_choice(*item, protocol) for item in _found(result)])
    yield from _labelled("suites", result.guarantees)
    yield from _labelled("time", [f"{result.seconds:.1f} s"])


def _found(result: Result) -> list[tuple[str, str]]:
    return sorted(result.choices.items())


def _choice(name: str, way: str, protocol: Protocol) -> str:
    origin = "from the text" if name in protocol.pins else "found"
    return f"{name} = {way} ({origin})"


def explained(finding: Finding, protocol: Protocol, command: str) -> str:
    """Give one finding as text; `command` runs the device, and replays the finding."""
    return "\n".join(_finding("", finding, protocol, command))


def _finding(head: str, finding: Finding, protocol: Protocol, command: str = "") -> Iterable[str]:
    verdict = finding.verdict
    yield from _wrapped(head, f"{verdict.outcome.value.upper()}: {verdict.title}")
    for name in verdict.clauses:
        clause = protocol.clauses.get(name)
        words = [name]
        if clause is not None:
            words = [f"{name} {clause.level.value}: {clause.wording}", f"source: {clause.source}"]
        yield from _labelled("clause", words)
    yield from _labelled("claims", [", ".join(verdict.claims)] if verdict.claims else [])
    yield from _labelled("expected", [*_alternatives(verdict.expected)])
    yield from _labelled("observed", [verdict.observed] if verdict.observed else [])
    yield from _labelled("reason", [verdict.reason] if verdict.reason else [])
    flag = f"{verdict.flag}: {NOTES[verdict.flag]}" if verdict.flag else ""
    yield from _labelled("flag", [flag] if flag else [])
    yield from _labelled("at", [verdict.at] if verdict.at else [])
    yield from _labelled("case", [verdict.case])
    # a token is copied, so it stays whole
    again = _plain(verdict.replay or verdict.case)
    again = f"{command} --replay {again}".strip()
    yield f"{_INDENT}{'replay':<{_LABEL}}{again}"
    if verdict.trace:
        yield f"{_INDENT}trace"
        yield from _trace(verdict.trace)
    if finding.also:
        others = _plural(len(finding.also), "other case")
        yield from _labelled("also", [f"{others} {_show(len(finding.also))} the same"])


def _show(count: int) -> str:
    return "shows" if count == 1 else "show"


def _alternatives(expected: Sequence[str]) -> Iterable[str]:
    if len(expected) <= 1:
        yield from expected
        return
    yield "one of"
    yield from (f"- {alternative}" for alternative in expected)


def _trace(trace: Sequence[TraceLine]) -> Iterable[str]:
    times = [f"{line.time / _MICROSECONDS:.3f} ms" for line in trace]
    width = max(map(len, times))
    who = max(len(_plain(line.who)) for line in trace)
    for moment, line in zip(times, trace, strict=True):
        yield from _wrapped(f"    {moment:>{width}}  {_plain(line.who):<{who}}  ", line.what)


def _unjudged(result: Result) -> Iterable[str]:
    groups = Counter(
        (verdict.outcome.value, verdict.reason or verdict.title)
        for verdict in result.verdicts
        if verdict.outcome in {Outcome.SKIPPED, Outcome.INCONCLUSIVE}
    )
    for (outcome, reason), count in sorted(groups.items()):
        yield from _wrapped(_INDENT + "- ", f"{_plural(count, 'case')} {outcome}: {reason}")


def _plural(count: int, word: str) -> str:
    return f"{count} {word}" if count == 1 else f"{count} {word}s"


def _plain(text: str) -> str:
    """Give the text on one line, without signs that a terminal would obey."""
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in words)


def _labelled(label: str, values: Sequence[str]) -> Iterable[str]:
    for position, value in enumerate(values):
        head = "" if position else label
        start = f"{_INDENT}{head:<{_LABEL}}"
        hang = 2 if value.startswith("- ") else 0
        yield from _wrapped(start, value, hang)


def _wrapped(start: str, text: str, hang: int = 0) -> list[str]:
    if len(start) > WIDTH // 2:
        start, text = _INDENT * 2, f"{start} {text}"
    lines = textwrap.wrap(
        _plain(text),
        WIDTH,
        initial_indent=start,
        subsequent_indent=" " * (len(start) + hang),
        break_on_hyphens=False,
    )
    return lines or [start.rstrip()]
