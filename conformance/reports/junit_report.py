"""Reports a run as JUnit XML, one test for each clause.

Names of tests are ids of clauses, so they stay the same from run to run. Clauses that the device
cannot reach by its own text have no test. The file stays small
whatever the run: a test names a few of its findings and counts the others.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.base.version import version
from ecatspec.conformance.render.marks import interruption, kinds, needs, plain, plural
from ecatspec.conformance.reports import judged
from ecatspec.conformance.run.coverage import Covered, Shown, coverage
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ecatspec.conformance.base.verdict import Finding, Result
    from ecatspec.spec.language.ir import Protocol

WHOLE: Final = "run"
"""The suite and the test of what belongs to no clause."""
BEYOND: Final = f"clauses {Shown.BEYOND}"
"""The property that says how many clauses have no test."""
_SHOWN: Final = 3
"""Findings that a test tells of at most."""
_LONGEST: Final = 400
"""Letters of one line at most."""
_LINES: Final = 25
"""Lines of the trace of a finding at most: its last ones."""
_SKIPPED: Final = {
    Shown.UNTESTED: "this run shows nothing of it",
    Shown.UNOBSERVABLE: "it cannot be observed through the protocol",
}
_NO_XML: Final = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def report(results: Sequence[Result], protocol: Protocol) -> str:
    """Give all results as JUnit XML that ends with a newline."""
    root = ET.Element("testsuites", {"name": "ecatspec"})
    for number, result in enumerate(results, 1):
        device = result.device if len(results) == 1 else f"{result.device}.{number}"
        _result(root, device, result, protocol)
    for key in ("tests", "failures", "errors", "skipped"):
        root.set(key, str(sum(int(suite.attrib[key]) for suite in root)))
    ET.indent(root, " ")
    text: str = ET.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def _result(root: ET.Element, device: str, result: Result, protocol: Protocol) -> None:
    groups: dict[str, list[Covered]] = {}
    clauses = coverage(result, protocol).values()
    own = [covered for covered in clauses if covered.shown is not Shown.BEYOND]
    for covered in own:
        groups.setdefault(covered.clause.id.partition("-")[0], []).append(covered)
    whole = _suite(root, device, WHOLE, result.seconds)
    _properties(
        whole,
        {
            "ecatspec": version(),
            "specification": protocol.name,
            "digest": protocol.digest,
            "subject": result.subject,
            BEYOND: str(len(clauses) - len(own)),
            **{f"choice {name}": way for name, way in sorted(result.choices.items())},
        },
    )
    _whole(whole, device, result, protocol)
    _count(whole)
    for group, members in sorted(groups.items()):
        suite = _suite(root, device, group)
        for covered in members:
            _clause(suite, f"{device}.{group}", covered, result)
        _count(suite)


def _suite(root: ET.Element, device: str, group: str, seconds: float = 0) -> ET.Element:
    name = _clean(f"{device}.{group}")
    return ET.SubElement(root, "testsuite", {"name": name, "time": f"{seconds:.3f}"})


def _whole(suite: ET.Element, device: str, result: Result, protocol: Protocol) -> None:
    """Add the test of all that belongs to no clause: that anything was judged at all."""
    case = ET.SubElement(
        suite, "testcase", {"classname": _clean(f"{device}.{WHOLE}"), "name": WHOLE, "time": "0"}
    )
    binding = {clause.id for clause in protocol.clauses.values() if clause.level is Level.MUST}
    own = [f for f in result.findings() if f.verdict.broken not in binding]
    blaming = [f for f in own if f.verdict.outcome in BLAMING]
    troubles = [f for f in own if f.verdict.outcome is Outcome.ERROR]
    if blaming:
        _told(case, "failure", blaming, result)
    elif troubles:
        _told(case, "error", troubles, result)
    elif not judged(result):
        ET.SubElement(case, "error", {"message": "nothing could be judged"})
    counts = (f"{result.count(outcome)} {outcome.value}" for outcome in Outcome)
    notes = [*counts, *result.guarantees, *result.notes]
    _output(case, [*notes, *filter(None, [interruption(result)])][:_LINES])


def _clause(suite: ET.Element, classname: str, covered: Covered, result: Result) -> None:
    clause = covered.clause
    attributes = {"classname": _clean(classname), "name": clause.id, "time": "0"}
    case = ET.SubElement(suite, "testcase", attributes)
    told = {"level": clause.level.value, "wording": clause.wording, "source": clause.source}
    if clause.claims:
        told["claims"] = " ".join(clause.claims)
    _properties(case, told)
    match covered.shown:
        case Shown.FAILED:
            _told(case, "failure", covered.blaming, result)
        case Shown.WARNED:
            first = (finding for _, finding in covered.findings[:_SHOWN])
            _output(case, [line for finding in first for line in _lines(finding, result)])
        case Shown.KNOWN:
            reason = covered.findings[0][1].verdict.reason
            ET.SubElement(case, "skipped", {"message": _clean(reason)})
        case Shown.HELD | Shown.BEYOND:
            pass
        case Shown.UNTESTED | Shown.UNOBSERVABLE:
            ET.SubElement(case, "skipped", {"message": _SKIPPED[covered.shown]})
        case _:
            assert_never(covered.shown)


def _told(case: ET.Element, kind: str, findings: Sequence[Finding], result: Result) -> None:
    """Add what went wrong: the first findings in full, of the others their number."""
    first = findings[0].verdict
    about = ET.SubElement(case, kind, {"message": _clean(first.title), "type": first.outcome.value})
    lines = [line for finding in findings[:_SHOWN] for line in (*_lines(finding, result), "")]
    if len(findings) > _SHOWN:
        lines.append(f"and {plural(len(findings) - _SHOWN, 'finding')} more")
    about.text = "\n".join(map(_clean, lines)).rstrip()


def _lines(finding: Finding, result: Result) -> Iterable[str]:
    verdict = finding.verdict
    yield f"{verdict.outcome.value}: {verdict.title}"
    yield from (f"expected: {words}" for words in verdict.expected[:_LINES])
    if verdict.observed:
        yield f"observed: {verdict.observed}"
    if verdict.involved:
        yield f"involved: {', '.join(verdict.involved)}"
    if verdict.differing:
        yield f"differing: {', '.join(verdict.differing)}"
    if verdict.reason:
        yield f"reason: {verdict.reason}"
    if verdict.depends:
        yield f"depends: {needs(verdict)}"
    yield from (f"{line.time} us {line.who} {line.what}" for line in verdict.trace[-_LINES:])
    yield from (f"seen too: {kind}" for kind in kinds(finding)[:_LINES])
    if finding.also:
        yield f"also in {plural(len(finding.also), 'other case')}"
    if result.set_up is not None:
        yield f"replay: {result.set_up.command(verdict)}"
    else:
        yield f"case: {verdict.case}"


def _output(case: ET.Element, lines: Sequence[str]) -> None:
    ET.SubElement(case, "system-out").text = "\n".join(map(_clean, lines))


def _properties(parent: ET.Element, told: dict[str, str]) -> None:
    properties = ET.SubElement(parent, "properties")
    for name, value in told.items():
        ET.SubElement(properties, "property", {"name": _clean(name), "value": _clean(value)})


def _count(suite: ET.Element) -> None:
    cases = suite.findall("testcase")
    suite.set("tests", str(len(cases)))
    for key, kind in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
        suite.set(key, str(sum(case.find(kind) is not None for case in cases)))


def _clean(text: str) -> str:
    """Give a line that XML can hold and that is not too long; what is copied stays whole."""
    line = _NO_XML.sub("\ufffd", plain(text))
    whole = len(line) <= _LONGEST or line.startswith("replay: ")
    return line if whole else f"{line[:_LONGEST]} ..."
