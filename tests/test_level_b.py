"""Tests of examples/c_level_b: a first report from a few lines of glue."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest
from c_device import SOURCES, build, sanitizes

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.run.runner import Runner, run_device
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model

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
OTHER_WAYS = (
    (
        "slave.c",
        "    slave->events = esc_events(slave->esc);\n",
        """
    static int up;
    uint8_t link[2], eeprom[2];
    if (!up) {    /* the PDI works, its watchdog is fine, a link at port 0, the EEPROM is loaded */
        esc_read(slave->esc, 0x0110, link, sizeof link);
        esc_read(slave->esc, 0x0502, eeprom, sizeof eeprom);
        up = (link[0] & 0x13) == 0x13 && (link[1] & 0x02) && !(eeprom[1] & 0xB8);
        return;
    }
    slave->events = esc_events(slave->esc);
    esc_read(slave->esc, 0x1C00, NULL, 0);
    esc_write(slave->esc, 0xFFFF, NULL, 0);
""",
    ),
    (
        "esc.c",
        """    uint8_t status;
    esc_read(slave->esc, manager(MAIL_IN, AT_STATUS), &status, 1);
    return !(status & FULL);
""",
        """    uint8_t status, nothing = 0;
    esc_read(slave->esc, manager(MAIL_IN, AT_STATUS), &status, 1);
    if (!(status & 0x02) || !(esc_events(slave->esc) & EVENT_MANAGER_0 << MAIL_IN)) {
        return 0;
    }
    esc_write(slave->esc, MAILBOX_IN_START, &nothing, 1);    /* the event has been seen */
    return 1;
""",
    ),
    (
        "esc.c",
        "    esc_write(slave->esc, MAILBOX_IN_START, message, MAILBOX_IN_LENGTH);\n",
        """    uint8_t nothing = 0;
    esc_write(slave->esc, MAILBOX_IN_START, message, MAILBOX_IN_LENGTH);
    esc_write(slave->esc, MAILBOX_IN_START, &nothing, 1);    /* too late: it is full */
""",
    ),
    (
        "mailbox.c",
        """    if (mailbox->unread && esc_mail_read(slave)) {
        mailbox->unread = 0;
""",
        """    if (esc_mail_read(slave)) {
        if (!mailbox->unread) {    /* nothing was written, so nothing can have been read */
            abort();
        }
        mailbox->unread = 0;
""",
    ),
    ("mailbox.c", "#include <string.h>\n", "#include <stdlib.h>\n#include <string.h>\n"),
)
"""A stack that goes by what a chip shows: it waits until the chip is up, learns from the event of a
read that it may repeat a reply, acknowledges the event by the first byte of the mailbox, and relies
on it that a full mailbox takes nothing."""


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


def test_a_stack_that_goes_by_the_events_of_a_chip_conforms(tmp_path: Path) -> None:
    for folder in (EXAMPLE, SOURCES):
        shutil.copytree(folder, tmp_path / folder.name)
    for file, one, other in OTHER_WAYS:
        written_otherwise(tmp_path / "c_slave" / file, one, other)
    dut = thermostat(tmp_path, sources=tmp_path / "c_level_b")
    result = run_device(DEVICE, dut, depth="quick", only=("al", "mailbox", "sdo"))
    odd = [v for v in result.verdicts if v.outcome not in {Outcome.PASS, Outcome.SKIPPED}]
    assert not odd
    assert {"sdo.value_taken", "mailbox.repeated"} <= set(result.rules_covered)


def written_otherwise(file: Path, one: str, other: str) -> None:
    text = file.read_text(encoding="utf-8")
    assert one in text
    file.write_text(text.replace(one, other), encoding="utf-8")


@pytest.mark.parametrize(("right", "wrong"), SLIPS)
def test_a_slip_of_the_application_is_found(right: str, wrong: str, tmp_path: Path) -> None:
    sources = tmp_path / "c_level_b"
    shutil.copytree(EXAMPLE, sources)
    (tmp_path / "c_slave").symlink_to(SOURCES)
    written_otherwise(sources / "application.c", right, wrong)
    adapter = open_adapter(thermostat(tmp_path, sources=sources), DEVICE)
    try:
        runner = Runner(Model(load(DEVICE)), adapter, adapter.describe())
        cases = (c for c in all_cases(runner.model, NO_LIMITS, "quick") if c.layer == "sdo")
        assert any(runner.executor.judge(case).outcome in BLAMING for case in cases)
    finally:
        adapter.close()
