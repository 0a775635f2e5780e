"""Test that the way to a device changes no verdict."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, cast

import pytest
from c_device import TEXT, WHERE, build
from inetd import Served

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.generators.cases.case import Case

WAYS = ("lib", "tcp", "unix")
"""Each beside a program on stdin and stdout; of these `lib` is asked for several reads at once."""
PREFIXES = ("al/set_up/", "mailbox/", "sdo/transfer/", "process_data/", "ds402/up_again/")
EACH = 3
"""Of the cases that begin so each third is played: every way plays them all again."""
FAULTS = ("AL_CODE_FORGOTTEN", "SEGMENT_TOGGLE_UNCHECKED", "WATCHDOG_IGNORED", "RESET_BY_LEVEL")


class Listening:
    """An adapter that remembers what it was asked."""

    def __init__(self, adapter: Adapter, *, batch: bool) -> None:
        self._adapter, self._batch = adapter, batch
        self.asked: list[str] = []

    def describe(self) -> Description:
        return replace(self._adapter.describe(), batch=self._batch)

    def __getattr__(self, name: str) -> object:
        self.asked.append(name)
        return getattr(self._adapter, name)

    def close(self) -> None:
        self._adapter.close()


@cache
def model() -> Model:
    return Model(load(TEXT))


@cache
def cases() -> tuple[Case, ...]:
    return tuple(all_cases(model(), NO_LIMITS, "quick"))


def verdicts(dut: str, chosen: Iterable[Case]) -> Iterator[Verdict]:
    """Judge cases as far as they are asked for."""
    adapter = open_adapter(dut, TEXT)
    try:
        runner = Runner(model(), adapter, adapter.describe())
        yield from map(runner.executor.judge, chosen)
    finally:
        adapter.close()


def sample() -> list[Case]:
    return [case for case in cases() if case.name.startswith(PREFIXES)][::EACH]


def until_blamed(dut: str, fault: str) -> list[Verdict]:
    """Judge the cases around a fault up to the first that blames the device for something."""
    found = []
    for verdict in verdicts(dut, (c for c in cases() if c.name.startswith(WHERE[fault]))):
        found.append(verdict)
        if verdict.outcome in BLAMING:
            return found
    pytest.fail(f"{fault} is not found over {dut}")


def reached(way: str, folder: Path) -> Iterator[str]:
    """Name the device of a folder for `--dut`, by this way; serve it meanwhile if need be."""
    if way == "lib":
        yield f"lib:{folder}/libslave.so"
        return
    with Served([str(folder / "slave")], f"{folder}/socket" if way == "unix" else "") as served:
        yield served.dut


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("c_slave"), "all", "library")


@pytest.fixture(scope="module")
def by_exec(folder: Path) -> list[Verdict]:
    return list(verdicts(f"exec:{folder}/slave", sample()))


@pytest.mark.xdist_group("same verdicts")
@pytest.mark.parametrize("way", WAYS)
def test_every_way_gives_the_same_verdicts(way: str, folder: Path, by_exec: list[Verdict]) -> None:
    assert len(by_exec) > 60
    assert not [verdict for verdict in by_exec if verdict.outcome in BLAMING]
    for dut in reached(way, folder):
        assert list(verdicts(dut, sample())) == by_exec


@pytest.mark.xdist_group("same verdicts")
@pytest.mark.parametrize("fault", FAULTS)
def test_every_way_finds_the_same_in_a_device_with_a_fault(fault: str, tmp_path: Path) -> None:
    folder = build(tmp_path, "all", "library", f"FAULT={fault}")
    found = until_blamed(f"exec:{folder}/slave", fault)
    for way in WAYS:
        for dut in reached(way, folder):
            assert until_blamed(dut, fault) == found, way


def test_a_look_is_one_exchange_where_the_device_takes_several_reads(folder: Path) -> None:
    asked: dict[bool, list[str]] = {}
    for batch in (True, False):
        adapter = Listening(open_adapter(f"lib:{folder}/libslave.so", TEXT), batch=batch)
        runner = Runner(model(), cast("Adapter", adapter), adapter.describe())
        for case in cases()[:40]:
            assert runner.executor.judge(case).outcome not in BLAMING
        adapter.close()
        asked[batch] = adapter.asked
    assert "reads" not in asked[False]
    assert asked[True].count("reads") * 2 <= asked[False].count("read")
    assert len(asked[True]) < 0.7 * len(asked[False])


def outcomes(found: Iterable[Verdict]) -> list[tuple[str, Outcome]]:
    return [(verdict.case, verdict.outcome) for verdict in found]


@pytest.mark.xdist_group("same verdicts")
def test_the_stack_above_our_esc_gives_them_too(folder: Path, by_exec: list[Verdict]) -> None:
    """Level B; what its traces say may differ, since it is polled every millisecond."""
    assert outcomes(verdicts(f"lib:{folder}/libstack.so", sample())) == outcomes(by_exec)


@pytest.mark.xdist_group("same verdicts")
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_the_stack_is_found_above_our_esc(fault: str, tmp_path: Path) -> None:
    folder = build(tmp_path, "library", f"FAULT={fault}")
    assert until_blamed(f"lib:{folder}/libstack.so", fault)
