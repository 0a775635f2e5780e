"""The only place for tests of examples/c_level_b: a first report from a few lines of glue."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest
from c_device import SOURCES, build, sanitizes

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.devices import load
from ecatspec.conformance.kit import check_adapter
from ecatspec.conformance.runner import Runner, run_device
from ecatspec.conformance.verdict import BLAMING, Outcome
from ecatspec.generators.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.compiled import Model

if TYPE_CHECKING:
    from pathlib import Path

EXAMPLE = SOURCES.parent / "c_level_b"
DEVICE = str(EXAMPLE / "thermostat.ecs")
MOST_GLUE = 60
SLIPS = (
    ("> object->high ? TOO_HIGH : TOO_LOW", "> object->high ? TOO_LOW : TOO_HIGH"),
    ("NO_OBJECT : NO_SUBINDEX", "NO_SUBINDEX : NO_OBJECT"),
    ("if (length != object->size)", "if (length > object->size)"),
)
"""What somebody may have written in application.c."""


def thermostat(folder: Path, *arguments: str, sources: Path = EXAMPLE) -> str:
    return f"lib:{build(folder, *arguments, sources=sources)}/libthermostat.so,poll=0.01"


def test_the_glue_is_short() -> None:
    assert len((EXAMPLE / "glue.c").read_text(encoding="utf-8").splitlines()) < MOST_GLUE


def test_the_thermostat_conforms(tmp_path: Path) -> None:
    dut = thermostat(tmp_path, *(["sanitized"] if sanitizes(tmp_path) else []))
    result = run_device(DEVICE, dut, depth="quick")
    odd = [v for v in result.verdicts if v.outcome not in {Outcome.PASS, Outcome.SKIPPED}]
    assert not odd
    assert {"sdo.value_taken", "sdo.value_too_low", "mailbox.repeated"} <= set(result.rules_covered)


def test_the_kit_has_no_complaint(tmp_path: Path) -> None:
    dut = thermostat(tmp_path)
    complaints = check_adapter(
        lambda: open_adapter(dut, DEVICE),
        spans=((0x0130, 2), (0x0800, 32), (0x1000, 48)),
        write=(0x0120, b"\x02\x00"),
    )
    assert complaints == []


@pytest.mark.parametrize(("right", "wrong"), SLIPS)
def test_a_slip_of_the_application_is_found(right: str, wrong: str, tmp_path: Path) -> None:
    sources = tmp_path / "c_level_b"
    shutil.copytree(EXAMPLE, sources)
    (tmp_path / "c_slave").symlink_to(SOURCES)
    application = sources / "application.c"
    text = application.read_text(encoding="utf-8")
    assert right in text
    application.write_text(text.replace(right, wrong), encoding="utf-8")
    adapter = open_adapter(thermostat(tmp_path, sources=sources), DEVICE)
    try:
        runner = Runner(Model(load(DEVICE)), adapter, adapter.describe())
        cases = (c for c in all_cases(runner.model, NO_LIMITS, "quick") if c.layer == "sdo")
        assert any(runner.judge(case).outcome in BLAMING for case in cases)
    finally:
        adapter.close()
