"""What holds for every device with a manual: claims, anomalies, a sound run."""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest
import yaml
from fault_suites import DEVICES, GROUNDS, apart, suite

from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.results.run_history import CaseRecord, Record
from ecatspec.conformance.traceability import evidence
from ecatspec.conformance.traceability.trace import Standing, trace_device
from ecatspec.model.analysis.citations import citations
from ecatspec.spec.language.ir import Level
from ecatspec.spec.language.load import load_device, load_faults

if TYPE_CHECKING:
    from pathlib import Path

    from ecatspec.spec.language.ir import Clause, Protocol

PREFIX = {
    "afag-se-power": "AFAG",
    "beckhoff-el6720": "EL6720",
    "kollmorgen-akd": "AKD",
    "kollmorgen-s300": "S300",
    "metronix-dis2": "DIS2",
}
"""How the ids of claims and clauses of a device begin."""
COUNTS = {
    "afag-se-power": (267, 199, 66, 54, 28, 48),
    "beckhoff-el6720": (33, 32, 6, 11, 0, 6),
    "kollmorgen-akd": (469, 156, 22, 138, 65, 63),
    "kollmorgen-s300": (189, 113, 12, 12, 0, 39),
    "metronix-dis2": (220, 154, 44, 35, 34, 43),
}
"""Claims, clauses, those that cannot be observed, own objects, ESI rows, anomalies."""
ALL_CLAIMS, ALL_ANOMALIES = 1178, 118
TESTABLE = {"al-registers", "mailbox-sdo", "process-data"}
REASONED = 57
"""Testable claims that have a reason in place of a case."""
UNSEEN = {"ANOM-094": "no test starts a reference run or saves parameters unasked"}
"""Grave anomalies of which nothing can be seen."""
NOT_FOUND = {
    "afag-se-power": set[str](),
    "beckhoff-el6720": {"EL6720-032"},
    "kollmorgen-akd": {"AKD-119", "AKD-120", "AKD-121"},
    "kollmorgen-s300": set(),
    "metronix-dis2": set(),
}
"""Testable claims of which no case is known to find a violation."""
OWN_FAULTS = 10

each_device = pytest.mark.parametrize("name", DEVICES)


def own(protocol: Protocol) -> list[Clause]:
    prefix = f"{PREFIX[protocol.name]}-C"
    return [clause for clause in protocol.clauses.values() if clause.id.startswith(prefix)]


@pytest.fixture(scope="session")
def claims(shared: Path) -> dict[str, dict[str, Any]]:
    file = shared / "evidence" / "claims.yaml"
    rows = yaml.load(file.read_text(encoding="utf-8"), yaml.CSafeLoader)
    return {row["id"]: row for row in rows}


@pytest.fixture(scope="session")
def anomalies(shared: Path) -> dict[str, tuple[str, str]]:
    """Severity and devices of each anomaly."""
    file = shared / "evidence" / "anomalies.md"
    rows = re.findall(
        r"^\| (ANOM-\d{3}) \| (\w) \| ([^|]*) \|", file.read_text(encoding="utf-8"), re.MULTILINE
    )
    return {name: (severity, devices) for name, severity, devices in rows}


# --- the texts ------------------------------------------------------------------------------------


def test_every_claim_of_the_manuals_is_carried(claims: dict[str, dict[str, Any]]) -> None:
    carried = {c for name in DEVICES for clause in own(load_device(name)) for c in clause.claims}
    assert len(claims) == ALL_CLAIMS
    assert carried == set(claims)


def test_every_anomaly_is_recorded_by_the_devices_that_have_it(
    anomalies: dict[str, tuple[str, str]],
) -> None:
    assert len(anomalies) == ALL_ANOMALIES
    for name in DEVICES:
        word = re.compile(rf"\b{PREFIX[name]}\b")
        concerned = {
            anomaly
            for anomaly, (_, devices) in anomalies.items()
            if word.search(devices) or devices.strip() == "all"
        }
        assert {anomaly.id for anomaly in load_device(name).anomalies} == concerned, name


@each_device
def test_golden_counts(name: str) -> None:
    protocol = load_device(name)
    ids = {clause.id for clause in own(protocol)}
    hidden = [clause for clause in own(protocol) if clause.level is Level.UNOBSERVABLE]
    objects = [entry for entry in protocol.objects if set(entry.clauses) & ids]
    counted = sum(len(manual.claims) for manual in protocol.manuals)
    found = counted, len(ids), len(hidden), len(objects), len(protocol.esi)
    assert (*found, len(protocol.anomalies)) == COUNTS[name]


@each_device
def test_clauses_name_claims_and_lines_of_the_manual(name: str, shared: Path) -> None:
    protocol = load_device(name)
    (manual,) = protocol.manuals
    lines = (shared / "manuals" / manual.file).read_text(encoding="utf-8").count("\n")
    for clause in own(protocol):
        assert clause.claims, clause.id
        part = re.sub(r"sections? [\d.-]+|tables? \d+|ANOM-\d+", "", clause.source)
        numbers = [int(number) for number in re.findall(r"\d+", part)]
        assert numbers, clause.id
        assert max(numbers) <= lines, clause.id


@each_device
def test_a_clause_is_used_or_cannot_be_observed(name: str) -> None:
    protocol = load_device(name)
    used = {clause for citation in citations(protocol) for clause in citation.clauses}
    unused = [c.id for c in own(protocol) if c.id not in used and c.because is None]
    assert unused == []


@each_device
def test_grave_anomalies_cite_what_can_be_seen(
    name: str, anomalies: dict[str, tuple[str, str]]
) -> None:
    protocol = load_device(name)
    for anomaly in protocol.anomalies:
        cited = [protocol.clauses[clause] for clause in anomaly.clauses]
        seen = [c for c in cited if c.level is not Level.UNOBSERVABLE and c.because is None]
        assert seen or anomalies[anomaly.id][0] != "A" or anomaly.id in UNSEEN, anomaly.id


@each_device
def test_a_device_has_faults_of_its_own(name: str) -> None:
    prefix = f"{PREFIX[name]}-C"
    mine = [f for f in load_faults().values() if any(c.startswith(prefix) for c in f.clauses)]
    assert len(mine) >= OWN_FAULTS


# --- runs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=apart(GROUNDS[name.replace("-", "_")])) for name in DEVICES]
)
def test_what_can_be_tested_is_exercised(name: str, claims: dict[str, dict[str, Any]]) -> None:
    made = suite(GROUNDS[name.replace("-", "_")])
    assert not made.blamed
    cases = {case.name: CaseRecord(Outcome.PASS, fired) for case, fired in made.cases}
    known = evidence.read(evidence.shipped(), name)
    trace = trace_device(made.model, Record("the virtual SubDevice", cases), known)
    assert not trace.disproved
    standing = trace.standing_of_claims()
    assert set(standing) == set(trace.claims)
    testable = [claim for claim in standing if claims[claim]["testable_via"] in TESTABLE]
    expected = {Standing.CARRIED, Standing.FREE, Standing.REASONED, Standing.UNOBSERVABLE}
    left = {claim for claim in testable if standing[claim] not in expected}
    assert left == NOT_FOUND[name]


def test_few_testable_claims_have_a_reason_instead(claims: dict[str, dict[str, Any]]) -> None:
    carriers: dict[str, list[Clause]] = {}
    for name in DEVICES:
        for clause in own(load_device(name)):
            for claim in clause.claims:
                carriers.setdefault(claim, []).append(clause)
    testable = [claim for claim, row in claims.items() if row["testable_via"] in TESTABLE]
    reasoned = Counter(all(c.because is not None for c in carriers[claim]) for claim in testable)
    assert reasoned[True] == REASONED
