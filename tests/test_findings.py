"""Tests of how many findings a mistake makes: docs/findings.md says it."""

from __future__ import annotations

import os
import re
from functools import cache
from typing import TYPE_CHECKING, Final

import pytest
from c_device import TEXT, build
from causes import (
    ALLOWED,
    C_SLAVE,
    CANOPEN,
    PAGE,
    PLANTED,
    SAMPLE,
    findings_of_fault,
    page,
    told,
)
from fault_suites import apart, ground_of

from ecatspec.conformance.run.runner import run_device
from ecatspec.spec.language.load import load_faults

if TYPE_CHECKING:
    from pathlib import Path

RENEW: Final = bool(os.environ.get("ECATSPEC_RENEW"))
WHOLE: Final = bool(os.environ.get("ECATSPEC_WHOLE"))
"""The whole sample is run, not one in nine, as `make test` does for its time."""
TRIED: Final = SAMPLE if WHOLE else SAMPLE[4::9]
MISTAKES: Final = 19
LINES: Final = 9
"""Lines of canopen that are to blame, in test_runner."""


def several() -> dict[str, int]:
    """Give the faults that the page says have more than one finding."""
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \|", PAGE.read_text("utf-8"), re.MULTILINE)
    return {name: int(number) for name, number in rows}


@cache
def count(name: str) -> int:
    return len(findings_of_fault(name))


@pytest.mark.skipif(not RENEW, reason="it writes docs/findings.md, which takes half an hour")
def test_the_page_is_written(tmp_path: Path) -> None:
    program = build(tmp_path, "library", "FAULT=ALL") / "libslave.so"
    slave = run_device(TEXT, f"lib:{program}", depth="quick").findings()
    canopen = run_device("reference", "canopen", depth="quick").findings()
    planted = {name: count(name) for name in SAMPLE}
    rows = {
        C_SLAVE: (MISTAKES, len(slave)),
        CANOPEN: (LINES, len(canopen)),
        PLANTED: (len(SAMPLE), sum(planted.values())),
    }
    more = {name: number for name, number in planted.items() if number > 1}
    PAGE.write_text(page(rows, more), encoding="utf-8")


def test_a_cause_makes_hardly_more_than_one_finding() -> None:
    rows = dict(told())
    causes, found = rows.pop("**total**")
    assert set(rows) == {C_SLAVE, CANOPEN, PLANTED}
    assert (causes, found) == tuple(map(sum, zip(*rows.values(), strict=True)))
    assert found / causes <= ALLOWED
    assert rows[C_SLAVE][0] == MISTAKES
    assert rows[CANOPEN][0] == LINES
    assert rows[PLANTED] == (len(SAMPLE), len(SAMPLE) + sum(n - 1 for n in several().values()))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=apart(ground_of(load_faults()[name]))) for name in TRIED]
)
def test_a_fault_has_the_findings_that_the_page_says(name: str) -> None:
    assert count(name) == several().get(name, 1)


@pytest.mark.skipif(not WHOLE, reason="ECATSPEC_WHOLE=1: the whole run takes a minute or more")
def test_the_c_slave_has_the_findings_that_the_page_says(tmp_path: Path) -> None:
    program = build(tmp_path, "library", "FAULT=ALL") / "libslave.so"
    assert len(run_device(TEXT, f"lib:{program}", depth="quick").findings()) == told()[C_SLAVE][1]
