"""Whole reports, word by word: of a foreign server and of five planted faults.

What changes with every text or release (times, versions, digests, totals) is replaced. Where a
change is meant, write the files anew and read what `git diff` says of them:

    ECATSPEC_RENEW=1 python -m pytest tests/test_golden.py
"""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Final

import pytest

from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import Outcome, Result
from ecatspec.conformance.reports import REPORTS, junit_report
from ecatspec.conformance.run.runner import run_device

GOLDEN: Final = Path(__file__).resolve().parent / "golden"
RENEW: Final = bool(os.environ.get("ECATSPEC_RENEW"))
SUBJECTS: Final = {
    "canopen": (
        "reference",
        "canopen",
        (
            "sdo/unknown_command/7",
            "sdo/transfer/stray_segment",
            "sdo/no_subindex/upload/1000_01",
            "al/request_OP",
        ),
    ),
    "counter_echoed": ("reference", "model:fault=counter_echoed", ("mailbox/counter_zero",)),
    "missing_object_code_wrong": (
        "reference",
        "model:fault=missing_object_code_wrong",
        ("sdo/no_object/upload/0000",),
    ),
    "value_not_stored": (
        "reference",
        "model:fault=value_not_stored",
        ("sdo/download/2000_00",),
    ),
    "quick_stop_ignored": (
        "reference-drive",
        "model:fault=quick_stop_ignored",
        ("ds402/shutdown/enable_operation/quick_stop",),
    ),
    "outputs_address_unchecked": (
        "reference-drive",
        "model:fault=outputs_address_unchecked",
        ("process_data/moved_sync_manager_2",),
    ),
}
"""Device, device under test, and the cases that show what is to be read."""
FORMS: Final = {"text": "txt", "json": "json", "junit": "xml"}


@cache
def result(subject: str) -> Result:
    """What a run of these cases alone says, without what differs from day to day."""
    device, dut, cases = SUBJECTS[subject]
    results = [run_device(device, dut, replay=case) for case in cases]
    first = results[0]
    assert first.set_up is not None
    return replace(
        first,
        subject=re.sub(r"canopen [0-9.]+", "canopen 0.0", first.subject),
        verdicts=tuple(verdict for each in results for verdict in each.verdicts),
        rules_total=100,
        clauses_total=50,
        rules_beyond=(),
        clauses_beyond=(),
        seconds=1.0,
        set_up=replace(first.set_up, began="2026-01-02T03:04:05+00:00"),
    )


def said(subject: str, form: str) -> str:
    found = result(subject)
    protocol = replace(load(found.device), digest="0" * 64)
    text = REPORTS[form]((found,), protocol)
    return failures(text) if form == "junit" else text


def failures(text: str) -> str:
    """Only the tests that failed: the others change with the clauses of the texts."""
    root = ET.fromstring(text)
    for suite in root.findall("testsuite"):
        for case in suite.findall("testcase"):
            if case.get("name") != "run" and case.find("failure") is None:
                suite.remove(case)
        if suite.find("testcase") is None:
            root.remove(suite)
    for counted in (root, *root):
        for key in ("tests", "skipped"):
            del counted.attrib[key]
    ET.indent(root, " ")
    return ET.tostring(root, encoding="unicode") + "\n"


@pytest.mark.parametrize("form", sorted(FORMS))
@pytest.mark.parametrize("subject", sorted(SUBJECTS))
def test_a_report_is_what_it_was(subject: str, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(junit_report, "version", lambda: "0.0")
    file = GOLDEN / f"{subject}.{FORMS[form]}"
    found = said(subject, form)
    if RENEW:
        file.parent.mkdir(exist_ok=True)
        file.write_text(found, encoding="utf-8")
    assert found == file.read_text("utf-8"), "is it meant? the head of this file says how to renew"


@pytest.mark.parametrize("subject", sorted(SUBJECTS))
def test_a_finding_has_all_that_a_reader_needs(subject: str) -> None:
    found = result(subject)
    assert not found.conforms
    for finding in found.findings():
        verdict = finding.verdict
        assert verdict.outcome in {Outcome.FAIL, Outcome.CRASH}
        assert verdict.title
        assert verdict.clauses
        assert verdict.expected
        assert verdict.observed
        assert verdict.trace
        assert verdict.blamed
        assert verdict.differing or verdict.outcome is Outcome.CRASH or subject == "canopen"


def test_no_file_is_left_over() -> None:
    wanted = {f"{subject}.{form}" for subject in SUBJECTS for form in FORMS.values()}
    assert {file.name for file in GOLDEN.iterdir()} == wanted
