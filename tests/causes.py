"""How findings are counted against causes: docs/findings.md, and who fills it.

ECATSPEC_RENEW=1 python -m pytest tests/test_findings.py
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fault_suites import ground_of, suite

from ecatspec.conformance.base.verdict import CAUSED, Result
from ecatspec.spec.language.load import load_faults

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.conformance.base.verdict import Finding

PAGE: Final = Path(__file__).parents[1] / "docs" / "findings.md"
EVERY: Final = 12
"""One of this number of planted faults is measured: a run for each takes hours."""
SAMPLE: Final = sorted(load_faults())[3::EVERY]
ALLOWED: Final = 1.3
"""Findings for each cause at most, in total."""
C_SLAVE: Final = "examples/c_slave, `make FAULT=ALL`"
CANOPEN: Final = "the SDO server of the package `canopen`"
PLANTED: Final = f"planted faults, one in {EVERY}, each alone"


def findings_of_fault(name: str) -> tuple[Finding, ...]:
    """Give the findings of a run against a virtual SubDevice with one fault."""
    fault = load_faults()[name]
    made = suite(ground_of(fault))
    runner = made.runner({"fault": name})
    verdicts = []
    for case in made.ordered(fault):
        verdicts.append(runner.executor.judge(case))
        if verdicts[-1].outcome in CAUSED:
            runner.known.signatures.add(verdicts[-1].signature)
    return Result("", "", tuple(verdicts), (), 0, (), 0, 0.0).findings()


def told() -> Mapping[str, tuple[int, int]]:
    """Give causes and findings of each row of the page."""
    rows = re.findall(r"^\| (.+?) \| (\d+) \| (\d+) \|", PAGE.read_text("utf-8"), re.MULTILINE)
    return {name: (int(causes), int(found)) for name, causes, found in rows}


def page(rows: Mapping[str, tuple[int, int]], several: Mapping[str, int]) -> str:
    """Give the page with other tables: the rows, and planted faults with more than one finding."""
    causes, found = (sum(column) for column in zip(*rows.values(), strict=True))
    total = [f"| **total** | {causes} | {found} | {found / causes:.2f} |"]
    counts = [f"| {name} | {one} | {n} | {n / one:.2f} |" for name, (one, n) in rows.items()]
    faults = [f"| `{name}` | {n} | {load_faults()[name].wording} |" for name, n in several.items()]
    text = PAGE.read_text(encoding="utf-8")
    for head, lines in (("device", [*counts, *total]), ("fault", faults)):
        table = re.compile(rf"^(\| {head} .*\n\|[-|]+\n)(?:\|.*\n)*", re.MULTILINE)
        place = table.search(text)
        assert place is not None
        text = text.replace(place[0], place[1] + "".join(f"{line}\n" for line in lines))
    return text
