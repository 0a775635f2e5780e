"""Test that our own device gets the same verdicts as a library in C."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from c_device import library

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.base.verdict import BLAMING, Outcome, Verdict
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_device

DEVICE = "reference"
SHIM = Path(__file__).with_name("virtual_shim.c")
EACH = 16
"""Of the quick suite each sixteenth case is played, and those around the fault."""
FAULTS = {"": "", "toggle_ignored": "sdo/transfer/wrong_", "refused_without_error": "al/set_up/"}


def verdicts(dut: str, prefix: str) -> list[Verdict]:
    model = Model(load_device(DEVICE))
    adapter = open_adapter(dut, DEVICE)
    try:
        runner = Runner(model, adapter, adapter.describe())
        cases = list(all_cases(model, NO_LIMITS, "quick"))
        near = [case for case in cases if prefix and case.name.startswith(prefix)]
        return [runner.executor.judge(case) for case in (*cases[::EACH], *near[:20])]
    finally:
        adapter.close()


def shim(folder: Path, fault: str) -> str:
    """Compile the library around a process that hosts the virtual SubDevice."""
    adapter = open_adapter("model", DEVICE)
    locals_ = " ".join(sorted(adapter.describe().locals))
    adapter.close()
    set_up = json.dumps({"device": DEVICE, "options": {"fault": fault} if fault else {}})
    host = [sys.executable, "-P", "-m", "ecatspec.conformance.adapters.host", "model", set_up]
    head = f"#define COMMAND {', '.join(map(json.dumps, host))}\n"
    head += f"#define LOCALS {json.dumps(locals_)}\n"
    source = head + SHIM.read_text(encoding="utf-8")
    return f"lib:{library(source, folder / 'virtual.so', standard='c11')}"


@pytest.mark.parametrize("fault", FAULTS)
def test_the_virtual_subdevice_behind_c_gets_the_same_verdicts(fault: str, tmp_path: Path) -> None:
    found = verdicts(f"model:fault={fault}" if fault else "model", FAULTS[fault])
    assert any(verdict.outcome in BLAMING for verdict in found) is bool(fault)
    assert sum(verdict.outcome is Outcome.PASS for verdict in found) > 100
    assert verdicts(shim(tmp_path, fault), FAULTS[fault]) == found
