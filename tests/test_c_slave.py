"""Tests of examples/c_slave: it conforms, and each planted fault is found."""

from __future__ import annotations

import ctypes
import random
import re
import subprocess
from functools import cache
from typing import TYPE_CHECKING

import pytest
from c_device import SOURCES, TEXT, WHERE, build, library, sanitizes
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.adapters.process import ProcessAdapter
from ecatspec.conformance.base.adapter import AdapterError
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.run.runner import Runner, run_device
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.esc import Esc

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.generators.cases.case import Case

DEPTH = "quick"

COMMANDS = (0x00, 0x01, 0x10, 0x11, 0x21, 0x23, 0x40, 0x60, 0x70, 0x80, 0xFF)
"""Bytes that begin SDO requests."""

EXERCISED = {
    # AL state machine and process data
    "al.held_back",
    "al.init_to_preop_refused",
    "al.mailbox_taken_away",
    "al.preop_to_safeop_refused",
    "al.process_data_taken_away",
    "al.safeop_to_op",
    "al.safeop_to_op_refused",
    "al.watchdog_in_op",
    "process_data.expired_unseen",
    "process_data.outputs_enabled",
    "process_data.outputs_taken",
    # mailbox
    "mailbox.beyond_refused",
    "mailbox.mail_duplicate",
    "mailbox.mail_taken",
    "mailbox.mail_too_short",
    "mailbox.mail_unheard",
    "mailbox.nothing_repeated",
    "mailbox.repeated",
    "mailbox.type_refused",
    # SDO
    "sdo.complete_upload_refused",
    "sdo.download_read_only",
    "sdo.download_too_long",
    "sdo.download_too_short",
    "sdo.download_wrong_state",
    "sdo.unknown_aborted",
    "sdo.upload_expedited",
    "sdo.upload_normal",
    "sdo.upload_no_object",
    "sdo.upload_no_subindex",
    "sdo.upload_write_only",
    "sdo.upload_wrong_state",
    "sdo.value_taken",
    "sdo.value_too_high",
    "sdo.value_too_low",
    # segments
    "sdo.abort_silent",
    "sdo.download_begun",
    "sdo.download_segment_stray",
    "sdo.download_toggle_ends",
    "sdo.segment_beyond",
    "sdo.segment_last",
    "sdo.segment_last_too_early",
    "sdo.segment_taken",
    "sdo.upload_complete",
    "sdo.upload_goes_on",
    "sdo.upload_segment_sent",
    "sdo.upload_toggle_ends",
    "sdo.value_taken_by_segments",
    # CiA 402
    "ds402.disable_operation_5",
    "ds402.disable_voltage_9",
    "ds402.enable_operation_4",
    "ds402.fault_13",
    "ds402.fault_reset_15",
    "ds402.fault_stays",
    "ds402.initialised_1",
    "ds402.mode_taken",
    "ds402.quick_stop_11",
    "ds402.reaction_done_14",
    "ds402.shutdown_2",
    "ds402.shutdown_6",
    "ds402.shutdown_8",
    "ds402.stopped_12",
    "ds402.switch_on_3",
}
"""Rules by which a run has to go for sure, so that its silence means something."""


@pytest.fixture(scope="session")
def slave(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The device; with a compiler that has sanitizers it ends at the first access out of bounds."""
    folder = tmp_path_factory.mktemp("c_slave")
    return build(folder, *(["sanitized"] if sanitizes(folder) else [])) / "slave"


@cache
def model() -> Model:
    return Model(load(TEXT))


@cache
def cases() -> tuple[Case, ...]:
    return tuple(all_cases(model(), NO_LIMITS, DEPTH))


def judged(program: Path, prefix: str) -> Iterator[Verdict]:
    with ProcessAdapter([str(program)]) as adapter:
        runner = Runner(model(), adapter, adapter.describe())
        yield from (runner.executor.judge(case) for case in cases() if case.name.startswith(prefix))


def test_the_device_conforms(slave: Path) -> None:
    result = run_device(TEXT, f"exec:{slave}", depth=DEPTH)
    assert not [(f.verdict.case, f.verdict.observed) for f in result.findings()]
    odd = [v for v in result.verdicts if v.outcome not in {Outcome.PASS, Outcome.SKIPPED}]
    assert not odd
    unable = {v.reason for v in result.verdicts if v.outcome is Outcome.SKIPPED}
    assert all("cannot raise" in reason for reason in unable), unable
    assert not EXERCISED - set(result.rules_covered)


def test_the_program_keeps_the_contract(slave: Path) -> None:
    complaints = check_adapter(
        lambda: ProcessAdapter([str(slave)]),
        spans=((0x0130, 2), (0x0800, 32), (0x1000, 48)),
        write=(0x0120, b"\x02\x00"),
    )
    assert not complaints


@pytest.mark.parametrize(
    "line",
    [
        "",
        "{",
        "[]",
        '{"op":',
        '{"op":"read"}',
        '{"op":"read","address":65535,"length":2}',
        '{"op":"write","address":288,"data":"0"}',
        '{"op":"write","address":288,"data":"zz"}',
        '{"op":"advance","seconds":-1}',
        '{"op":"local","event":"ds402.mains_on"}',
        '{"op":"dance"}',
    ],
)
def test_the_program_refuses_what_is_no_request(slave: Path, line: str) -> None:
    done = subprocess.run(
        [str(slave)], input=f"{line}\n", capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith('{"ok":false,"error":"')
    assert not done.stderr


def test_an_event_that_it_does_not_know_is_no_verdict(slave: Path) -> None:
    with ProcessAdapter([str(slave)]) as adapter, pytest.raises(AdapterError):
        adapter.local("al.sync_lost")


def test_no_access_breaks_it(slave: Path) -> None:
    dice = random.Random(402)
    places = (
        0x0120,
        0x0400,
        0x0420,
        *range(0x0800, 0x0820),
        0x1000,
        0x1080,
        0x1100,
        0x1106,
        0x1400,
    )
    header = bytes.fromhex("0a00000000")
    with ProcessAdapter([str(slave)]) as adapter:
        for attempt in range(3000):
            if attempt % 20 == 0:
                adapter.reset()
                adapter.write(0x0800, bytes.fromhex("00103000260001008010300022000100"))
                adapter.write(0x0120, b"\x02\x00")
            address, length = dice.choice(places), dice.choice((1, 2, 6, 7, 8, 48, 1000))
            match dice.randrange(4):
                case 0:
                    adapter.read(address, length)
                case 1:
                    adapter.write(address, dice.randbytes(length))
                case 2:
                    adapter.read(0x1080, 48)
                case _:
                    request = bytes(
                        (3 | attempt % 8 << 4, 0, 0x20, *dice.choices(COMMANDS), 0, 0x20, 0)
                    )
                    size = bytes((dice.choice((5, 60, 120, 200)), 0, 0, 0))
                    adapter.write(0x1000, (header + request + size + dice.randbytes(32))[:48])


# --- the chip -------------------------------------------------------------------------------------

CHIP = """
#include "chip.c"
const size_t size_of_chip = sizeof(struct esc);
const uint16_t outputs_length = 0, inputs_length = 0;
"""
AREAS = ((0x1000, 6, 0x26), (0x1010, 5, 0x22), (0x1020, 4, 0x64), (0x1040, 3, 0x20))
"""Start, length and control of the SyncManagers."""
STATES, EVENTS = (0x0800, 32), (0x0220, 4)
ACCESSES = st.tuples(
    st.sampled_from(("main_read", "main_write", "pdi_read", "pdi_write")),
    st.sampled_from(AREAS).flatmap(lambda area: st.integers(area[0] - 1, area[0] + 4 * area[1])),
    st.binary(min_size=1, max_size=8),
)
SWITCHES = st.tuples(
    st.sampled_from(("main_write", "pdi_write")),
    st.sampled_from(range(len(AREAS))),
    st.sampled_from((b"\0", b"\1")),
).map(lambda t: (t[0], 0x0800 + 8 * t[1] + (6 if t[0] == "main_write" else 7), t[2]))


class Chip:
    """The chip in C as both sides use it, like `Esc`."""

    def __init__(self, file: Path) -> None:
        self._of = ctypes.CDLL(str(file))
        size = ctypes.c_size_t.in_dll(self._of, "size_of_chip").value
        self._state = ctypes.create_string_buffer(size)
        self._of.chip_reset(self._state)

    def main_read(self, address: int, length: int) -> tuple[int, bytes]:
        data = ctypes.create_string_buffer(length)
        counter = self._of.chip_main_read(self._state, address, data, ctypes.c_size_t(length))
        return counter, data.raw

    def main_write(self, address: int, data: bytes) -> int:
        size = ctypes.c_size_t(len(data))
        counter: int = self._of.chip_main_write(self._state, address, data, size)
        return counter

    def pdi_read(self, address: int, length: int) -> bytes:
        data = ctypes.create_string_buffer(length)
        self._of.esc_read(self._state, address, data, ctypes.c_size_t(length))
        return data.raw

    def pdi_write(self, address: int, data: bytes) -> None:
        self._of.esc_write(self._state, address, data, ctypes.c_size_t(len(data)))

    def al_event(self) -> int:
        events: int = self._of.esc_events(self._state)
        return events


@pytest.fixture(scope="session")
def chip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("chip") / "libchip.so"
    return library(CHIP, file, f"-I{SOURCES}", str(SOURCES / "esc.c"))


def does(one: Chip | Esc, act: str, address: int, data: bytes) -> tuple[int, bytes]:
    """Do something from one side; give what is counted and what is read."""
    match act:
        case "main_read":
            return one.main_read(address, len(data))
        case "main_write":
            return one.main_write(address, data), b""
        case "pdi_read":
            return 0, one.pdi_read(address, len(data))
        case _:
            one.pdi_write(address, data)
            return 0, b""


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(acts=st.lists(st.one_of(ACCESSES, ACCESSES, ACCESSES, SWITCHES), max_size=40))
@example(
    acts=[
        ("main_write", 0x1000, b"abcdef"),
        ("pdi_read", 0x1000, b"."),
        ("pdi_read", 0x1000, b"......"),
    ]
)
@example(
    acts=[
        ("pdi_write", 0x1010, b"abcde"),
        ("pdi_write", 0x1010, b"f"),
        ("main_read", 0x1010, b"....."),
    ]
)
def test_the_chip_in_c_and_the_chip_of_level_b_are_the_same(
    chip: Path, acts: list[tuple[str, int, bytes]]
) -> None:
    both = Chip(chip), Esc(model())
    for one in both:
        for number, (start, length, control) in enumerate(AREAS):
            words = start.to_bytes(2, "little") + length.to_bytes(2, "little")
            one.main_write(0x0800 + 8 * number, words + bytes([control, 0, 1]))
    switched = False
    for act, address, data in acts:
        switched = switched or address < AREAS[0][0] - 1
        (counted, found), (expected, content) = (does(one, act, address, data) for one in both)
        assert counted == expected
        # a buffer that was switched off may begin with any content
        assert found == content or switched
        assert both[0].al_event() == both[1].al_event()
        assert both[0].main_read(*STATES) == both[1].main_read(*STATES)


def test_every_fault_has_its_cases() -> None:
    named = re.findall(r"^ {4}FAULT_(\w+)\b", (SOURCES / "faults.h").read_text(), re.MULTILINE)
    assert named == ["NONE", *WHERE, "ALL"]


BROKEN = {
    "AL_CODE_FORGOTTEN": ("AL-06", "al/request_BOOT"),
    "AL_ERROR_NOT_LATCHED": ("AL-16", "al/set_up/request_BOOT/request_PREOP"),
    "AL_MAILBOX_UNCHECKED": ("AL-04", "al/request_PREOP"),
    "MAILBOX_COUNTER_IGNORED": ("MBX-04", "mailbox/duplicate"),
    "MAILBOX_LENGTH_UNCHECKED": (
        "MBX-17",
        "sdo/malformed/sdo_upload_request/length_one_beyond_area",
    ),
    "MAILBOX_COUNTER_STUCK": ("MBX-06", "sdo/default/2000_00"),
    "REPEAT_UNACKNOWLEDGED": ("MBX-21", "mailbox/repeat_read"),
    "SDO_SIZE_UNCHECKED": ("SDO-13", "sdo/server/idle/download_3_bytes"),
    "SDO_WRONG_ABORT": ("SDO-08", "sdo/no_subindex/upload/1000_01"),
    "SDO_RANGE_ONE_SIDED": ("SDO-15", "mailbox/duplicate_write"),
    "SDO_STATE_UNCHECKED": ("SDO-11", "sdo/upload_in_PREOP/2005_00"),
    "SEGMENT_TOGGLE_UNCHECKED": ("SDO-30", "sdo/boundary/sdo_download_segment/toggle_turned"),
    "SEGMENT_LAST_TOO_EARLY": ("SDO-33", "sdo/boundary/sdo_download_segment/value_empty"),
    "SEGMENT_LAST_FORGOTTEN": ("SDO-39", "sdo/upload/2000_00"),
    "WATCHDOG_IGNORED": ("PD-11", "process_data/watchdog"),
    "OUTPUTS_IN_SAFEOP": ("PD-08", "ds402/commands_in_SAFEOP_after_OP/SWITCH_ON_DISABLED"),
    "PDO_LENGTH_UNCHECKED": ("PD-04", "process_data/too_long_sync_manager_2"),
    "RESET_BY_LEVEL": ("DRV-18", "ds402/reset_held/SWITCH_ON_DISABLED"),
    "QUICK_STOP_IGNORED": ("DRV-14", "ds402/shutdown/enable_operation/quick_stop"),
}
"""The clause that a finding of each mistake names first, and a case, where all are there at once.

A device that never gives an AL status code cannot give a wrong one: AL_UNKNOWN_STATE is not there.
"""


@pytest.mark.xdist_group("faults of c_slave")
def test_all_mistakes_at_once_are_found_each_by_its_clause(tmp_path: Path) -> None:
    program = build(tmp_path, "FAULT=ALL") / "slave"
    names = {name for _, name in BROKEN.values()}
    with ProcessAdapter([str(program)]) as adapter:
        runner = Runner(model(), adapter, adapter.describe())
        runner.run([case for case in cases() if case.name in names], None, len(names))
    found = {verdict.broken for verdict in runner.verdicts if verdict.outcome in BLAMING}
    assert set(BROKEN) == WHERE.keys() - {"AL_UNKNOWN_STATE"}
    assert {clause for clause, _ in BROKEN.values()} <= found
    clause, name = BROKEN["SEGMENT_LAST_FORGOTTEN"]
    alone = run_device(TEXT, f"exec:{program}", depth=DEPTH, replay=name).findings()
    assert {BROKEN["MAILBOX_COUNTER_STUCK"][0], clause} <= {f.verdict.broken for f in alone}


@pytest.mark.xdist_group("faults of c_slave")  # the cases are made once for all of them
@pytest.mark.parametrize("fault", WHERE)
def test_a_fault_is_found(fault: str, tmp_path: Path) -> None:
    program = build(tmp_path, f"FAULT={fault}") / "slave"
    assert any(verdict.outcome in BLAMING for verdict in judged(program, WHERE[fault]))
