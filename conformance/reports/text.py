"""Reports a run for people: the summary first, then each finding once."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.verdict import MAIN_DEVICE, SUB_DEVICE, Conclusion, Outcome, Way
from ecatspec.conformance.render.marks import interruption, kinds, needs, parts, plain, plural
from ecatspec.conformance.reports import judged, risks
from ecatspec.generators.cases.message_mutation import NOTES
from ecatspec.model.core.wording import bytes_words

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ecatspec.conformance.base.verdict import Finding, Result, Verdict
    from ecatspec.spec.language.ir import Protocol

WIDTH: Final = 80
MARKS: Final = (">", "<")
"""What stands around a field that differs."""
_INDENT: Final = "  "
_LABEL: Final = 10
_MICROSECONDS: Final = 1000
_LIVES: Final = (MAIN_DEVICE, SUB_DEVICE)
_APART: Final = 12
"""Columns from the line of the MainDevice to that of the SubDevice."""
_ARROWS: Final = {
    Way.TO_DEVICE: f"|{'-' * (_APART - 2)}>|",
    Way.FROM_DEVICE: f"|<{'-' * (_APART - 2)}|",
    Way.NONE: f"|{' ' * (_APART - 1)}|",
    Way.DEATH: f"|{' ' * (_APART - 1)}X",
}


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
    if findings:
        yield ""
        yield "findings"
    for number, finding in enumerate(findings, 1):
        yield from _line(number, finding)
    for number, finding in enumerate(findings, 1):
        yield ""
        again = result.set_up.command(finding.verdict) if result.set_up is not None else ""
        yield from _finding(f"{number}. ", finding, protocol, again)
    unjudged = result.unjudged()
    if unjudged:
        yield from ("", "not judged")
        for outcome, reason, count in unjudged:
            yield from _wrapped(_INDENT + "- ", f"{plural(count, 'case')} {outcome}: {reason}")
    if result.notes:
        yield from ("", "notes")
        for note in result.notes:
            yield from _wrapped(_INDENT + "- ", note)


def _judgement(result: Result, findings: Sequence[Finding]) -> str:
    words = {
        Conclusion.CONFORMS: "conforms",
        Conclusion.DEVIATES_AS_KNOWN: "deviates as is known, and conforms otherwise",
        Conclusion.NOT_SHOWN: f"NOT SHOWN: {result.unreached_words()}",
        Conclusion.DOES_NOT_CONFORM: "DOES NOT CONFORM",
    }[result.conclusion]
    if not judged(result):
        words = "NOT JUDGED"
    if findings:
        words += f": {plural(len(findings), 'finding')}"
    late = interruption(result)
    return f"{words} ({late})" if late else words


def _summary(result: Result, protocol: Protocol) -> Iterable[str]:
    counts = ((result.count(outcome), outcome.value) for outcome in Outcome)
    cases = ", ".join(f"{count} {name}" for count, name in counts if count) or "none"
    yield from _labelled("cases", [cases])
    rules = _extent(result.rules_covered, result.rules_total, result.rules_beyond)
    yield from _labelled("rules", [rules])
    clauses = _extent(result.clauses_covered, result.clauses_total, result.clauses_beyond)
    yield from _labelled("clauses", [clauses])
    yield from _labelled("choices", [*_choices(result, protocol)])
    yield from _labelled("suites", result.guarantees)
    yield from _labelled("time", [f"{result.seconds:.1f} s"])


def _extent(covered: Sequence[str], total: int, beyond: Sequence[str]) -> str:
    if not beyond:
        return f"{len(covered)} of {total} covered"
    more = f"{len(beyond)} more {'is' if len(beyond) == 1 else 'are'} not its own"
    return f"{len(covered)} of {total} that the device can reach ({more})"


def _choices(result: Result, protocol: Protocol) -> Iterable[str]:
    """Give the ways of the device, those first that were found and are risky."""
    why = risks(result, protocol)
    for name, way in sorted(result.choices.items(), key=lambda item: (item[0] not in why, item)):
        origin = "from the text" if name in protocol.pins else "found"
        risk = f" RISKY: {why[name]}" if name in why else ""
        yield f"{name} = {way} ({origin}){risk}"


def explained(finding: Finding, protocol: Protocol, command: str) -> str:
    """Give one finding as text; `command` runs the device, and replays the finding."""
    again = f"{command} --replay {finding.verdict.again}"
    return "\n".join(_finding("", finding, protocol, again))


def _line(number: int, finding: Finding) -> Iterable[str]:
    """Give one line of the list at the top: what, the broken clause, in how many cases."""
    verdict = finding.verdict
    cited = f" [{verdict.broken}]" if verdict.broken else ""
    cases = plural(1 + len(finding.also), "case")
    said = f"{verdict.outcome.value}: {verdict.title}{cited}, {cases}"
    yield from _wrapped(f"{_INDENT}{number:>2}  ", said)


def _finding(head: str, finding: Finding, protocol: Protocol, again: str) -> Iterable[str]:
    verdict = finding.verdict
    yield from _wrapped(head, f"{verdict.outcome.value.upper()}: {verdict.title}")
    for name in verdict.clauses[:1]:
        clause = protocol.clauses.get(name)
        words = [name]
        if clause is not None:
            words = [f"{name} {clause.level.value}: {clause.wording}", f"source: {clause.source}"]
        yield from _labelled("broken", words)
    yield from _labelled("involved", [", ".join(verdict.involved)] if verdict.involved else [])
    yield from _labelled("claims", [", ".join(verdict.claims)] if verdict.claims else [])
    expected = [_marked(words, verdict.differing) for words in verdict.expected]
    yield from _labelled("expected", [*_alternatives(expected)])
    observed = _marked(verdict.observed, verdict.differing)
    yield from _labelled("observed", [observed] if observed else [])
    yield from _labelled("reason", [verdict.reason] if verdict.reason else [])
    flag = f"{verdict.flag}: {NOTES[verdict.flag]}" if verdict.flag else ""
    yield from _labelled("flag", [flag] if flag else [])
    yield from _labelled("depends", [needs(verdict)] if verdict.depends else [])
    yield from _labelled("at", [verdict.at] if verdict.at else [])
    yield from _labelled("case", [verdict.case])
    yield from _labelled("identity", [verdict.signature] if verdict.signature else [])
    if verdict.trace:
        yield from _chart(verdict)
    yield from _labelled("seen too", [f"- {kind}" for kind in kinds(finding)])
    if finding.also:
        others = plural(len(finding.also), "other case")
        yield from _labelled("also", [f"{others} {_show(len(finding.also))} the same"])
    if again:
        # it is copied, so it stays whole
        yield f"{_INDENT}{'replay':<{_LABEL}}{plain(again)}".rstrip()


def _show(count: int) -> str:
    return "shows" if count == 1 else "show"


def _marked(words: str, differing: Sequence[str]) -> str:
    first, last = MARKS
    return "".join(
        f"{first}{part}{last}" if differs else part for part, differs in parts(words, differing)
    )


def _alternatives(expected: Sequence[str]) -> Iterable[str]:
    if len(expected) <= 1:
        yield from expected
        return
    yield "one of"
    yield from (f"- {alternative}" for alternative in expected)


def _chart(verdict: Verdict) -> Iterable[str]:
    """Draw who does what as a sequence chart, the time to its left and the words to its right."""
    times = [f"{line.time / _MICROSECONDS:.3f} ms" for line in verdict.trace]
    width = max(*map(len, times), len(_LIVES[0]) // 2)
    life = len(_INDENT * 2) + width + 2
    heads = "".join(f"{name:^{2 * (_APART // 2)}}" for name in _LIVES)
    yield f"{_INDENT}{'trace':<{life - _APART // 2 - len(_INDENT)}}{heads}".rstrip()
    for moment, line, way in zip(times, verdict.trace, verdict.ways(), strict=True):
        start = f"{_INDENT * 2}{moment:>{width}}  {_ARROWS[way]}  "
        yield from _in_chart(start, line.what)
        if line.data:
            yield from _in_chart(f"{' ' * life}{_ARROWS[Way.NONE]}  ", bytes_words(line.data))


def _in_chart(start: str, words: str) -> Iterable[str]:
    bars = f"{' ' * (len(start) - _APART - 3)}{_ARROWS[Way.NONE]}  "
    yield from _wrapped(start, words, after=bars)


def _labelled(label: str, values: Sequence[str]) -> Iterable[str]:
    for position, value in enumerate(values):
        head = "" if position else label
        start = f"{_INDENT}{head:<{_LABEL}}"
        hang = "  " if value.startswith("- ") else ""
        yield from _wrapped(start, value, after=" " * len(start) + hang)


def _wrapped(start: str, text: str, *, after: str | None = None) -> list[str]:
    lines = textwrap.wrap(
        plain(text),
        WIDTH,
        initial_indent=start,
        subsequent_indent=" " * len(start) if after is None else after,
        break_on_hyphens=False,
    )
    return lines or [start.rstrip()]
