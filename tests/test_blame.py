"""Tests of the clause that a finding names first, and of hidden causes."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Final

import pytest

from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.adapter import AdapterError, DeviceCrash, DeviceHang
from ecatspec.conformance.base.verdict import Outcome, Result, Verdict
from ecatspec.conformance.render.marks import headline
from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.run.session import Session
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.oracle.blame import strongest_first
from ecatspec.spec.language.load import load_device, load_faults, plant

if TYPE_CHECKING:
    from ecatspec.generators.cases.case import Case

DEVICE: Final = "reference"
WIDE: Final = "counter_stuck"
"""Every message after the first is wrong."""
NARROW: Final = ("command_code_wrong", "state_code_wrong", "missing_subindex_code_wrong")
SEEN_IN: Final = (
    "mailbox/counters",
    "sdo/upload/1018_01",
    "sdo/unknown_command/5",
    "sdo/unknown_command/6",
    "sdo/download_in_SAFEOP/2040_00",
    "sdo/no_subindex/upload/1018_05",
    "sdo/no_subindex/download/1018",
)


@cache
def sound() -> Model:
    return Model(load_device(DEVICE))


@cache
def cases() -> dict[str, Case]:
    return {case.name: case for case in all_cases(sound(), NO_LIMITS, "quick")}


def findings(*faults: str, names: tuple[str, ...] = SEEN_IN) -> list[Verdict]:
    """Give what a run of these cases finds of a device with these faults."""
    protocol = load_device(DEVICE)
    for name in faults:
        protocol = plant(protocol, load_faults()[name])
    adapter = VirtualAdapter(VirtualSubDevice(protocol), described(protocol))
    runner = Runner(sound(), adapter, adapter.describe())
    runner.run((cases()[name] for name in names), None, len(names))
    result = Result(DEVICE, "", tuple(runner.verdicts), (), 0, (), 0, 0)
    return [finding.verdict for finding in result.findings()]


def test_a_wide_mistake_hides_no_narrow_ones() -> None:
    broken = {fault: load_faults()[fault].clauses for fault in (WIDE, *NARROW)}
    found = findings(WIDE, *NARROW)
    for fault, clauses in broken.items():
        assert sum(verdict.broken in clauses for verdict in found) == 1, fault
    assert len(found) == len(broken)


def test_what_is_behind_says_so() -> None:
    alone = findings("malformed_unanswered", names=("sdo/malformed/sdo_abort/length_cut_at_2",))
    assert not any("behind" in verdict.reason for verdict in alone)


def test_one_mistake_in_many_cases_is_one_finding() -> None:
    (found,) = findings(WIDE)
    assert found.broken == "MBX-06"
    assert found.differing == ("counter",)


def test_a_dead_mailbox_is_one_finding() -> None:
    names = ("sdo/client_abort", "sdo/upload/1018_01", "sdo/no_subindex/upload/1018_05")
    aborting = tuple(name for name in cases() if "abort" in name and name.startswith("sdo/"))
    (found,) = findings("abort_kills", names=(*names, *aborting[:12]))
    assert found.outcome is Outcome.FAIL
    assert found.reason == "the mailbox answers nothing any more"


@pytest.mark.parametrize("failure", [DeviceCrash, DeviceHang, AdapterError])
def test_a_device_that_dies_of_the_probe_is_blamed_for_the_silence(
    failure: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(*_: object) -> int:
        raise failure("gone")

    look = Session.is_deaf

    def asked(session: Session) -> bool:
        with monkeypatch.context() as patch:
            patch.setattr(VirtualAdapter, "write", dies)
            return look(session)

    monkeypatch.setattr(Session, "is_deaf", asked)
    (found,) = findings("command_unanswered", names=("sdo/unknown_command/5",))
    assert (found.outcome, found.broken) == (Outcome.FAIL, "SDO-17")


def test_a_clause_that_only_allows_comes_last() -> None:
    clauses = ("AL-07", "PD-31", "ESC-02", "SDO-05")
    assert strongest_first(Model(load_device("reference-drive")), clauses) == (
        *("ESC-02", "PD-31"),
        *("AL-07", "SDO-05"),
    )


@pytest.mark.parametrize(
    ("fault", "clause", "names"),
    [
        ("command_unanswered", "SDO-17", ("sdo/unknown_command/5",)),
        ("state_code_wrong", "SDO-11", ("sdo/download_in_SAFEOP/2040_00",)),
        ("counter_stuck", "MBX-06", ("mailbox/counters",)),
    ],
)
def test_the_broken_clause_comes_first(fault: str, clause: str, names: tuple[str, ...]) -> None:
    (found,) = findings(fault, names=names)
    assert found.broken == clause
    assert clause not in found.involved


def test_what_only_allows_is_never_broken() -> None:
    for verdict in findings(WIDE, *NARROW):
        assert sound().protocol.clauses[verdict.broken].level in {"must", "should"}


def test_a_headline_says_what_differs_and_what_is_demanded() -> None:
    observed = "al_status: state 4 SAFEOP, error no"
    assert headline(observed, ("state",), "it is refused") == "state 4 SAFEOP, but it is refused"
    silent = headline("mailbox empty: no reply", (), "each is answered")
    assert silent == "mailbox empty: no reply, but each is answered"
