"""Tests of a device text that limits the SDO service: the suite follows it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapters.model import SnapshotAdapter
from ecatspec.conformance.base.adapter import Description
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import load_file

if TYPE_CHECKING:
    from pathlib import Path

    from ecatspec.spec.language.ir import Protocol

LIMITED = """
device small extends standard "a device with expedited transfers only"
clause SML-01 must "expedited transfers only, and nothing beside" source "this text"
parameter longest_transfer = 4 [SML-01]
pin segmented_download = refused [SML-01]
pin information_support = absent [SML-01]
pin complete_access_support = refused [SML-01]
dictionary closed [SML-01]
objects
  0x2000 : 0 number u32 rw = 5 [SML-01]
  0x2001 : 0 long u64 rw = 5 [SML-01]
  0x2002 : 0 words text(40) rw = "too long for the device" [SML-01]
"""
GENEROUS = LIMITED.replace("parameter longest_transfer = 4 [SML-01]", "")
GENEROUS = "\n".join(line for line in GENEROUS.splitlines() if not line.startswith("pin"))


@pytest.fixture(scope="module")
def texts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Protocol]:
    folder: Path = tmp_path_factory.mktemp("texts")
    found = {}
    for name, text in {"limited": LIMITED, "generous": GENEROUS}.items():
        path = folder / f"{name}.ecs"
        path.write_text(text)
        found[name] = load_file(path)
    return found


def runner(text: Protocol, device: Protocol) -> Runner:
    """Judge by `text` the virtual SubDevice of `device`."""
    model = Model(text)
    description = Description("small", frozenset(text.machines), *(True, True))
    adapter = SnapshotAdapter(VirtualSubDevice(device), description)
    judge = Runner(model, adapter, adapter.describe())
    cases = [
        c for c in all_cases(model, NO_LIMITS, "quick") if c.layer not in {"al", "process_data"}
    ]
    judge.run(cases, None, len(cases))
    return judge


def test_a_limited_device_passes_its_own_text(texts: dict[str, Protocol]) -> None:
    judge = runner(texts["limited"], texts["limited"])
    assert {verdict.outcome for verdict in judge.verdicts} == {Outcome.PASS}
    fired = {rule.name for rule in judge.known.rules}
    assert {"download_beyond_service", "upload_beyond_service", "list_asked_in_vain"} <= fired
    assert {"complete_upload_refused", "complete_download_refused"} <= fired


def test_a_device_that_serves_more_than_its_text_says_is_found(texts: dict[str, Protocol]) -> None:
    judge = runner(texts["limited"], texts["generous"])
    blamed = {c for v in judge.verdicts if v.outcome in BLAMING for c in v.clauses}
    assert {"SDO-52", "SDO-20", "INF-03"} <= blamed
