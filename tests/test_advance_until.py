"""Tests that a run which goes through its waits at once sees nothing else."""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import replace
from functools import cache
from random import Random
from typing import TYPE_CHECKING, Final, cast

import pytest
from c_device import SOURCES, TEXT, build

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.adapters.model import VirtualAdapter, described, planted
from ecatspec.conformance.base.adapter import Description, DeviceCrash, step_until
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.run.session import Session
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from ecatspec.conformance.base.adapter import Adapter, Reading, Span
    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.generators.cases.case import Case
    from ecatspec.model.oracle.explanations import Exchange

EACH: Final = 41
"""Of the cases of a quick run one in this number is played, by every device and in both ways."""
ALIVE = "    length = answer(slave, request, reply + HEADER);\n"
DEAD = {
    "mute": (ALIVE, f"{ALIVE}    length = 0;\n"),
    "full": ("!mailbox->unread && esc_take_mail", "0 && esc_take_mail"),
}
"""How the mailbox of the C slave dies: it takes requests and answers none, or takes none."""


class Way:
    """An adapter whose device is asked for its waits at once, or one by one; what it was asked."""

    def __init__(self, adapter: Adapter, *, at_once: bool) -> None:
        self._adapter, self._at_once = adapter, at_once
        self.asked: Counter[str] = Counter()

    def describe(self) -> Description:
        return replace(self._adapter.describe(), batch=True, advance_until=self._at_once)

    def __getattr__(self, name: str) -> object:
        found = getattr(self._adapter, name)
        self.asked[name] += 1
        return found


class Fickle(VirtualAdapter):
    """A virtual SubDevice that now and then is silent, shows something else or dies.

    By a seed and by what it was asked until then: asked otherwise, it does otherwise.
    """

    def __init__(self, seed: int, fault: str | None = None) -> None:
        protocol, quirks = planted(load(TEXT), fault)
        super().__init__(VirtualSubDevice(protocol, quirks=quirks), described(protocol))
        self.seed, self.random = seed, Random(seed)
        self.calls: list[tuple[object, ...]] = []

    def does(self, part: float) -> bool:
        return self.random.random() < part * self.seed / 2

    def reset(self) -> None:
        self.calls.append(("reset",))
        super().reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        self.calls.append(("read", address, length))
        counter, data = super().read(address, length)
        if self.does(0.002):
            raise DeviceCrash("it died of a read")
        if self.does(0.002):
            return 0, bytes(length)
        if self.does(0.002):
            return counter, bytes([data[0] ^ 1 << self.random.randrange(8), *data[1:]])
        return counter, data

    def write(self, address: int, data: bytes) -> int:
        self.calls.append(("write", address, data))
        if self.does(0.02):
            return 0
        return 1 if self.does(0.02) else super().write(address, data)

    def advance(self, seconds: float) -> None:
        self.calls.append(("advance", seconds))
        if self.does(0.02):
            raise DeviceCrash("it died while time passed")
        super().advance(seconds)


class Shy(Fickle):
    """A virtual SubDevice whose mailbox says that it is full, and is read the second time only."""

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        again = self.calls[-8:].count(("read", address, length))
        if address == model().parameter("mailbox_in", "start") and not again:
            self.calls.append(("read", address, length))
            return 0, bytes(length)
        return super().read(address, length)


@cache
def model() -> Model:
    return Model(load(TEXT))


@cache
def cases() -> tuple[Case, ...]:
    return tuple(all_cases(model(), NO_LIMITS, "quick"))[::EACH]


def judged(
    adapter: Adapter, patch: pytest.MonkeyPatch, *, at_once: bool
) -> tuple[list[Verdict], list[Exchange], Counter[str]]:
    """Judge the cases; give the verdicts, what the oracle observed, and which calls were made."""
    exchanges: list[Exchange] = []
    observe = Session._observe  # noqa: SLF001

    def observed(session: Session, exchange: Exchange) -> None:
        exchanges.append(exchange)
        observe(session, exchange)

    way = Way(adapter, at_once=at_once)
    runner = Runner(model(), cast("Adapter", way), way.describe())
    with patch.context() as patched:
        patched.setattr(Session, "_observe", observed)
        verdicts = [runner.executor.judge(case) for case in cases()]
    adapter.close()
    return verdicts, exchanges, way.asked


@pytest.mark.parametrize("fault", [None, "abort_kills", "silent_in_op"])
@pytest.mark.parametrize("seed", range(4))
def test_a_virtual_device_is_asked_the_same(
    seed: int, fault: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    same(Fickle(seed, fault), Fickle(seed, fault), monkeypatch)


def test_a_mailbox_that_is_full_and_not_read_is_looked_at_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    same(Shy(0), Shy(0), monkeypatch)


def same(one_by_one: Fickle, at_once: Fickle, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = judged(one_by_one, monkeypatch, at_once=False)
    found = judged(at_once, monkeypatch, at_once=True)
    assert found[:2] == expected[:2]
    assert at_once.calls == one_by_one.calls
    outcomes = {verdict.outcome for verdict in found[0]}
    assert (Outcome.CRASH in outcomes) == (at_once.seed > 0)


def patched_slave(folder: Path, file: str, old: str, new: str) -> str:
    """Build the C slave with a change of its sources; give the folder of the libraries."""
    sources = folder / "sources"
    shutil.copytree(SOURCES, sources)
    text = (sources / file).read_text()
    assert old in text
    (sources / file).write_text(text.replace(old, new))
    return str(build(folder, "library", "CFLAGS=-Wno-error", sources=sources))


@pytest.mark.parametrize("name", ["libslave.so", "libstack.so"])
@pytest.mark.parametrize("death", sorted(DEAD))
def test_a_dead_mailbox_costs_one_round_trip(
    death: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dut = f"lib:{patched_slave(tmp_path, 'mailbox.c', *DEAD[death])}/{name}"
    expected = judged(open_adapter(dut, TEXT), monkeypatch, at_once=False)
    found = judged(open_adapter(dut, TEXT), monkeypatch, at_once=True)
    assert found[:2] == expected[:2]
    blamed = sum(verdict.outcome in BLAMING for verdict in found[0])
    assert blamed > 10
    asked, before = found[2], expected[2]
    assert before["advance_until"] == 0
    saved = before["advance"] - asked["advance"]
    assert before["reads"] - asked["reads"] == saved
    # two waits or three until the answer is missed, and a look behind each
    assert asked["advance_until"] < 0.35 * 2 * saved


def test_where_time_kills_a_library_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dies = "static int times;\n    if (++times % 50 == 0) { __builtin_trap(); }\n    "
    begins = "chip_advance(&device->esc, step);"
    folder = patched_slave(tmp_path, "device.c", begins, dies + begins)
    dut = f"lib:{folder}/libslave.so"
    expected = judged(open_adapter(dut, TEXT), monkeypatch, at_once=False)
    found = judged(open_adapter(dut, TEXT), monkeypatch, at_once=True)
    assert found[2]["advance_until"]
    assert found[:2] == expected[:2]
    assert any(verdict.outcome is Outcome.CRASH for verdict in found[0])


# --- the kit --------------------------------------------------------------------------------------


class Offering(Fickle):
    """A device that offers to go through its waits at once, in a way of its own."""

    own: Callable[..., tuple[int, list[Reading]]] = staticmethod(step_until)

    def describe(self) -> Description:
        return replace(super().describe(), advance_until=True)

    def advance_until(
        self, steps: Sequence[float], seen: Mapping[Span, Reading], mark: Callable[[], None]
    ) -> tuple[int, list[Reading]]:
        return type(self).own(self, steps, seen, mark)


def never_stops(
    device: Adapter, steps: Sequence[float], seen: Mapping[Span, Reading], mark: Callable[[], None]
) -> tuple[int, list[Reading]]:
    for seconds in steps:
        device.advance(seconds)
        mark()
        mark()
    return len(steps), [device.read(*span) for span in seen]


def marks_nothing(
    device: Adapter, steps: Sequence[float], seen: Mapping[Span, Reading], _: Callable[[], None]
) -> tuple[int, list[Reading]]:
    return step_until(device, steps, seen, lambda: None)


def gives_what_was_seen(
    device: Adapter, steps: Sequence[float], seen: Mapping[Span, Reading], mark: Callable[[], None]
) -> tuple[int, list[Reading]]:
    return step_until(device, steps, seen, mark)[0], list(seen.values())


def takes_no_step(
    device: Adapter, steps: Sequence[float], seen: Mapping[Span, Reading], mark: Callable[[], None]
) -> tuple[int, list[Reading]]:
    return step_until(device, steps, seen, mark) if steps else (0, list(seen.values()))


@pytest.mark.parametrize(
    ("own", "complaints"),
    [
        (step_until, []),
        (
            never_stops,
            [
                "steps and marks are (3, 6) at once and (1, 1) one by one",
                "steps and marks are (3, 6) at once and (1, 1) one by one",
                "advance_until takes no step at all",
            ],
        ),
        (
            marks_nothing,
            [
                "steps and marks are (3, 0) at once and (3, 6) one by one",
                "steps and marks are (1, 0) at once and (1, 1) one by one",
                "steps and marks are (1, 0) at once and (1, 1) one by one",
            ],
        ),
        (
            gives_what_was_seen,
            ["the last look gives something else at once than one by one"] * 2,
        ),
        (takes_no_step, ["advance_until takes no step at all"]),
    ],
)
def test_the_kit_looks_at_waits(
    own: Callable[..., tuple[int, list[Reading]]],
    complaints: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Offering, "own", staticmethod(own))
    found = check_adapter(lambda: Offering(0), spans=[(0x120, 2)], write=(0x120, b"\x02\x00"))
    assert found == [f"advance_until: {complaint}" for complaint in complaints]


def test_the_kit_misses_a_method_that_is_described() -> None:
    class Lacking(Fickle):
        def describe(self) -> Description:
            return replace(super().describe(), advance_until=True)

    found = check_adapter(lambda: Lacking(0), spans=[(0x120, 2)], write=(0x120, b"\x02\x00"))
    assert found == [
        "advance_until: the description has advance_until, and the adapter no such method"
    ]
