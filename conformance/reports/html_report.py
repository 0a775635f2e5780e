"""Reports a run as one self-contained page of HTML."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from markupsafe import Markup

from ecatspec.conformance.base.verdict import BLAMING, Conclusion, Outcome, Way
from ecatspec.conformance.base.version import version
from ecatspec.conformance.drawings.graph import rule_words, states_place, states_words
from ecatspec.conformance.drawings.svg import drawing
from ecatspec.conformance.pages import render
from ecatspec.conformance.render.marks import interruption, kinds, needs, parts, plural
from ecatspec.conformance.reports import judged, risks
from ecatspec.conformance.run.coverage import Shown, coverage
from ecatspec.conformance.run.machine_coverage import Mark, lacking, reached
from ecatspec.generators.cases.message_mutation import NOTES
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.wording import bytes_words, value_words

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ecatspec.conformance.base.verdict import Finding, Result, TraceLine, Verdict
    from ecatspec.conformance.run.machine_coverage import Reached
    from ecatspec.spec.language.ir import Protocol

View: TypeAlias = "dict[str, object]"
"""What the template is given of something."""

_MARKS: Final = {
    Mark.EXERCISED: {"kind": "exercised", "sign": "\N{CHECK MARK}"},
    Mark.BLAMED: {"kind": "blamed", "sign": "\N{BALLOT X}"},
    Mark.UNREACHED: {"kind": "unreached", "sign": "\N{WHITE CIRCLE}"},
    Mark.IMPOSSIBLE: {"kind": "impossible", "sign": "\N{EN DASH}"},
}
"""What rules are shown by: a CSS class, and a sign for those who see no colours."""
_SECTIONS: Final = (
    ("overview", "Overview"),
    ("findings", "Findings"),
    ("whole", "Whole run"),
    ("machines", "State machines"),
    ("clauses", "Clauses"),
    ("choices", "Choices"),
    ("limits", "Limits"),
    ("provenance", "Provenance"),
)
_LINES: Final = 400
"""Lines of a sequence at most: its last ones."""
_MICROSECONDS: Final = 1000
_BYTE: Final = 8


def report(results: Sequence[Result], protocol: Protocol) -> str:
    """Give the page of all results."""
    model = Model(protocol)
    return render(
        "report.html",
        title=f"Conformance of {protocol.name}",
        sections=_SECTIONS,
        version=version(),
        runs=[_run(number, result, model) for number, result in enumerate(results, 1)],
    )


def _run(number: int, result: Result, model: Model) -> View:
    protocol = model.protocol
    kind, judgement = _judgement(result)
    run = f"run-{number}"
    known = reached(result, model)
    findings = [
        _finding(f"{run}-finding-{place}", finding, result, model)
        for place, finding in enumerate(result.findings(), 1)
    ]
    return {
        "id": run,
        "device": result.device,
        "subject": result.subject,
        "kind": kind,
        "judgement": judgement,
        "tiles": list(_tiles(result)),
        "guarantees": result.guarantees,
        "unjudged": [f"{plural(n, 'case')} {o}: {why}" for o, why, n in result.unjudged()],
        "notes": result.notes,
        "findings": findings,
        "outcomes": list(dict.fromkeys(finding["outcome"] for finding in findings)),
        "whole": list(_whole(known, result, protocol)),
        "lacking": [f"{name}: {why}" for name, why in lacking(model).items() if name not in known],
        "machines": list(_machines(known, protocol)),
        "kinds": [shown.value for shown in Shown],
        "clauses": list(_clauses(result, protocol)),
        "choices": list(_choices(result, protocol)),
        "provenance": list(_provenance(result, protocol)),
    }


def _judgement(result: Result) -> tuple[str, str]:
    reason = interruption(result)
    late = f" ({reason})" if reason else ""
    if not judged(result):
        return "", f"Not judged{late}"
    words = result.conclusion.value.capitalize()
    match result.conclusion:
        case Conclusion.CONFORMS | Conclusion.DEVIATES_AS_KNOWN:
            return "good", f"{words}{late}"
        case Conclusion.NOT_SHOWN:
            return "bad", f"{words}: {result.unreached_words()}{late}"
        case Conclusion.DOES_NOT_CONFORM:
            return "bad", f"{words}{late}"
        case _:
            assert_never(result.conclusion)


def _tiles(result: Result) -> Iterator[View]:
    for outcome in Outcome:
        if count := result.count(outcome):
            bad = outcome in BLAMING or outcome is Outcome.ERROR
            kind = "bad" if bad else "good" if outcome is Outcome.PASS else ""
            yield {"value": count, "what": f"cases: {outcome.value}", "kind": kind}
    rules = f"{len(result.rules_covered)} of {result.rules_total}"
    yield {"value": rules, "what": "rules covered", "kind": ""}
    clauses = f"{len(result.clauses_covered)} of {result.clauses_total}"
    yield {"value": clauses, "what": "clauses of rules covered", "kind": ""}
    yield {"value": f"{result.seconds:.1f} s", "what": "time", "kind": ""}


# --- findings -------------------------------------------------------------------------------------


def _finding(name: str, finding: Finding, result: Result, model: Model) -> View:
    verdict = finding.verdict
    protocol = model.protocol
    cases = 1 + len(finding.also)
    return {
        "id": name,
        "title": verdict.title,
        "outcome": verdict.outcome.value,
        "cases": plural(cases, "case"),
        "expected": [list(parts(words, verdict.differing)) for words in verdict.expected],
        "observed": list(parts(verdict.observed, verdict.differing)) if verdict.observed else [],
        "reason": verdict.reason,
        "flag": f"{verdict.flag}: {NOTES[verdict.flag]}" if verdict.flag else "",
        "clauses": [_cited(clause, protocol) for clause in verdict.clauses],
        "claims": ", ".join(verdict.claims),
        "case": verdict.case,
        "at": verdict.at,
        "identity": verdict.signature,
        "depends": needs(verdict) if verdict.depends else "",
        "kinds": kinds(finding),
        "also": f"the same in {plural(cases - 1, 'other case')}" if cases > 1 else "",
        "replay": result.set_up and result.set_up.command(verdict),
        "trace": _trace(verdict, model),
        "lines": plural(len(verdict.trace), "line"),
    }


def _cited(name: str, protocol: Protocol) -> View:
    clause = protocol.clauses.get(name)
    if clause is None:
        return {"id": name, "known": False}
    return {
        "id": name,
        "known": True,
        "level": clause.level.value,
        "wording": clause.wording,
        "source": clause.source,
    }


def _trace(verdict: Verdict, model: Model) -> list[View]:
    pairs = list(zip(verdict.trace, verdict.ways(), strict=True))[-_LINES:]
    said = [place for place, (_, way) in enumerate(pairs) if way in {Way.FROM_DEVICE, Way.DEATH}]
    last = said[-1] if said and verdict.outcome in BLAMING else None
    return [
        _line(line, way, verdict.differing if place == last else (), model, last=place == last)
        for place, (line, way) in enumerate(pairs)
    ]


def _line(line: TraceLine, way: Way, differing: Sequence[str], model: Model, *, last: bool) -> View:
    frame, fields = _fields(line.data, differing, model)
    return {
        "time": f"{line.time / _MICROSECONDS:.3f} ms",
        "way": way.name.lower(),
        "who": line.who,
        "what": line.what,
        "last": last,
        "hex": bytes_words(line.data) if line.data else "",
        "frame": frame,
        "fields": fields,
    }


def _fields(data: bytes, differing: Sequence[str], model: Model) -> tuple[str, list[View]]:
    """Give the layout of a message, and each field with its bytes."""
    message = model.decode(data) if data else None
    if message is None:
        return "", []
    places = model.codec.places(message)
    found: list[View] = []
    for name in sorted(model.codec.field_names(message.frame), key=lambda name: places[name]):
        offset, width = places[name]
        first, end = offset // _BYTE, -(-(offset + width) // _BYTE)
        found.append(
            {
                "place": _place(offset, width),
                "hex": bytes_words(data[first:end]) if width else "",
                "name": name,
                "value": value_words(model, message.frame, name, message.fields[name]),
                "differs": name in differing,
            }
        )
    return message.frame, found


def _place(offset: int, width: int) -> str:
    if not width:
        return "none"
    first, last = offset // _BYTE, (offset + width - 1) // _BYTE
    place = str(first) if first == last else f"{first} to {last}"
    if offset % _BYTE or width % _BYTE:
        low, high = offset % _BYTE, offset % _BYTE + width - 1
        return f"{place}, bit {low}" if low == high else f"{place}, bits {low} to {high}"
    return place


# --- what was covered -----------------------------------------------------------------------------


def _whole(
    known: Mapping[str, Sequence[Reached]], result: Result, protocol: Protocol
) -> Iterator[View]:
    for name, rules in known.items():
        machine = protocol.machines[name]
        by_states: dict[tuple[str, ...], list[Reached]] = {}
        for each in rules:
            by_states.setdefault(each.rule.sources, []).append(each)
        order = sorted(by_states, key=lambda states: states_place(machine, states))
        yield {
            "name": name,
            "wording": machine.wording,
            "total": len(rules),
            "counts": [
                {**_MARKS[mark], "mark": mark.value, "count": sum(r.mark is mark for r in rules)}
                for mark in Mark
            ],
            "rows": [
                {
                    "states": states_words(machine, states),
                    "missed": ", ".join(s for s in states if s in _missed(result, name)),
                    "groups": list(_groups(by_states[states])),
                }
                for states in order
            ],
        }


def _missed(result: Result, machine: str) -> tuple[str, ...]:
    return result.unreached if machine == "al" else ()


def _groups(rules: Sequence[Reached]) -> Iterator[View]:
    """Give rules that share their mark and the reason for it."""
    groups: dict[tuple[Mark, str], list[Reached]] = {}
    for each in rules:
        groups.setdefault((each.mark, each.why), []).append(each)
    order = list(Mark)
    for (mark, why), found in sorted(groups.items(), key=lambda item: order.index(item[0][0])):
        shown = [{"name": each.rule.name, "tip": rule_words(each.rule)} for each in found]
        yield {**_MARKS[mark], "mark": mark.value, "why": why, "rules": shown}


def _machines(known: Mapping[str, Sequence[Reached]], protocol: Protocol) -> Iterator[View]:
    for name, rules in known.items():
        if len(protocol.machines[name].states) == 1:
            continue  # its picture would be one box
        marked = {
            r.rule.name: r.mark.value for r in rules if r.mark in {Mark.EXERCISED, Mark.BLAMED}
        }
        gone, failed = (
            sum(mark == wanted for mark in marked.values())
            for wanted in (Mark.EXERCISED, Mark.BLAMED)
        )
        yield {
            "name": name,
            "said": f"{gone} of {plural(len(rules), 'rule')} exercised, {failed} blamed.",
            # the drawing escapes the words of the texts
            "drawing": Markup(drawing(protocol, name, marked, brief=True)),  # noqa: S704
        }


def _clauses(result: Result, protocol: Protocol) -> Iterator[View]:
    for covered in coverage(result, protocol).values():
        clause = covered.clause
        yield {
            "id": clause.id,
            "level": clause.level.value,
            "wording": clause.wording,
            "source": clause.source,
            "shown": covered.shown.value,
            "passed": covered.passed,
            "findings": [number for number, _ in covered.findings],
        }


def _choices(result: Result, protocol: Protocol) -> Iterator[View]:
    why = risks(result, protocol)
    for name, choice in sorted(
        protocol.choices.items(), key=lambda item: (item[0] not in why, item[0])
    ):
        ways = {each.name: each.wording for each in choice.alternatives}
        pin = protocol.pins.get(name)
        way = result.choices.get(name, "")
        origin = "from the text" if pin is not None else "found" if way else "not found out"
        yield {
            "name": name,
            "wording": choice.wording,
            "way": way,
            "means": ways.get(way, ""),
            "origin": origin,
            "risk": why.get(name, ""),
        }


def _provenance(result: Result, protocol: Protocol) -> Iterator[tuple[str, str]]:
    yield "ecatspec", version()
    yield "specification", protocol.name
    yield "digest of the texts", protocol.digest
    yield "device under test", result.subject
    if result.set_up is not None:
        asked = result.set_up
        yield "text asked for", asked.device
        yield "adapter", asked.dut
        yield "depth", asked.depth
        yield "seed", str(asked.seed)
        yield "mailbox", asked.mailbox or "as the text says"
        yield "began", asked.began
    yield "took", f"{result.seconds:.1f} s"
