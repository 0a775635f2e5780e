"""Tests of the adapter `eth`: the suite through a cable, and what goes wrong."""

from __future__ import annotations

import json
import sys
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from wire_run import verdicts
from wires import NEAR, cable

from ecatspec.conformance.adapters import eth, open_adapter, parse_options
from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.adapters.model import VirtualAdapter, described, planted
from ecatspec.conformance.base.adapter import AdapterError, DeviceHang, Unheard
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.data_link import LinkedSubDevice, linked
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.esc.wire import COMMANDS, Datagram, Wire, wire_format
from ecatspec.spec.language.load import load_link

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from wire_run import Verdicts
    from wires import Cable

    from ecatspec.conformance.adapters.eth import WireAdapter

DEVICE = "reference-drive"
RUN = str(Path(__file__).with_name("wire_run.py"))
STATION, ALIAS, AL_STATUS, MAIL = 0x0010, 0x0012, 0x0130, 0x1080


@pytest.fixture
def wire() -> Iterator[Cable]:
    with cable() as laid:
        yield laid


def sample(every: int, *words: str) -> list[str]:
    """Give some names of quick cases, evenly over all, those with one of the words."""
    cases = all_cases(Model(load(DEVICE)), NO_LIMITS, "quick")
    names = [case.name for case in cases if not words or any(word in case.name for word in words)]
    return names[::every]


def in_process(names: list[str], fault: str | None) -> Verdicts:
    """Judge as `eth` would, that is: without what it cannot know and cannot do."""
    protocol, quirks = planted(load(DEVICE), fault)
    description = replace(described(protocol), closed_dictionary=False, locals=frozenset())
    device = VirtualSubDevice(protocol, quirks=quirks)
    return verdicts(DEVICE, VirtualAdapter(device, description), names)


def through(wire: Cable, names: list[str], *options: str, dut: str = "") -> Verdicts:
    with wire.simulated(DEVICE, *options) as device:
        spec = f"eth:{NEAR},power=kill -HUP {device.pid}{dut}"
        done = wire.run([sys.executable, RUN, DEVICE, spec, *names], 300)
    assert done.returncode == 0, done.stderr
    found: Verdicts = json.loads(done.stdout)
    return found


def blamed(found: Verdicts) -> Verdicts:
    return {name: row for name, row in found.items() if row[0] != "skipped"}


def test_verdicts_are_those_of_the_process(wire: Cable) -> None:
    names = sample(20)
    found = through(wire, names, "--virtual-time", dut=",time=virtual")
    assert blamed(found) == blamed(in_process(names, None))
    assert len(found) == len(names) > 150
    assert {row[0] for row in found.values()} == {"pass", "skipped"}


@pytest.mark.parametrize(
    ("fault", "words"),
    [("toggle_ignored", ("toggle",)), ("watchdog_ignored", ("watchdog",))],
)
def test_planted_faults_are_found_as_in_the_process(
    wire: Cable, fault: str, words: tuple[str, ...]
) -> None:
    names = sample(3, *words)
    options = ("--virtual-time", "--fault", fault)
    found = through(wire, names, *options, dut=",time=virtual")
    assert blamed(found) == blamed(in_process(names, fault))
    assert "fail" in {row[0] for row in found.values()}


def test_real_time_makes_no_false_alarm(wire: Cable) -> None:
    names = [
        "al/register/al_status",
        "mailbox/unknown_type/6",
        "process_data/watchdog",
        "sdo/upload/1018_00",
    ]
    assert {row[0] for row in through(wire, names).values()} == {"pass"}


# --- a segment without a cable --------------------------------------------------------------------


class Loop:
    """A segment of three in place of a socket; `lost` says what becomes of the next frames."""

    def __init__(self) -> None:
        protocol = linked(load(DEVICE), load_link())
        self.devices = [
            LinkedSubDevice(protocol, follower=number < 2, commanded=True) for number in range(3)
        ]
        self.wire = Wire(wire_format(self.devices[0].device.model))
        self.returns: deque[bytes] = deque()
        self.lost: deque[str] = deque()
        self.sent = 0
        self.timeout = 0.0
        self.closed = False
        self.lossy = False
        """Long frames, that is messages, never come back."""

    def settimeout(self, seconds: float) -> None:
        self.timeout = seconds

    def send(self, frame: bytes) -> None:
        assert len(frame) >= 60
        self.sent += 1
        fate = self.lost.popleft() if self.lost else "after" * (self.lossy and len(frame) > 60)
        if fate != "before":
            passing = bytearray(frame)
            assert self.wire.pass_on(passing, [device.visit for device in self.devices])
            if fate != "after":
                self.returns.append(bytes(passing))

    def recv(self, _: int) -> bytes:
        if not self.returns:
            raise TimeoutError
        return self.returns.popleft()

    def close(self) -> None:
        self.closed = True


def opened(options: str = "") -> WireAdapter:
    return eth.make(DEVICE, {"interface": "loop", **parse_options(options)})


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> Loop:
    made = Loop()
    monkeypatch.setattr(eth, "open_interface", lambda *_: made)
    return made


def test_it_keeps_the_contract(loop: Loop) -> None:
    def make() -> WireAdapter:
        return opened("position=1")

    assert check_adapter(make, spans=((STATION, 2), (AL_STATUS, 6)), write=(STATION, b"\1\0")) == []
    assert loop.closed


@pytest.mark.parametrize("position", range(3))
def test_nobody_else_is_touched(loop: Loop, position: int) -> None:
    before = [device.device.esc.registers() for device in loop.devices]
    adapter = opened(f"position={position}")
    adapter.reset()
    assert adapter.write(STATION, b"\x34\x12") == 1
    assert adapter.read(STATION, 2) == (1, b"\x34\x12")
    after = [device.device.esc.registers() for device in loop.devices]
    assert [one == two for one, two in zip(before, after, strict=True)] == [
        number != position for number in range(3)
    ]


@pytest.mark.usefixtures("loop")
def test_more_than_a_datagram_holds_goes_in_parts() -> None:
    adapter = opened()
    content = bytes(range(256)) * 16
    assert adapter.write(0x2000, content) == 1
    assert adapter.read(0x2000, len(content)) == (1, content)


@pytest.mark.parametrize("fate", ["before", "after"])
def test_a_read_of_registers_that_was_lost_is_sent_again(loop: Loop, fate: str) -> None:
    adapter = opened()
    loop.lost.extend([fate] * 2)
    assert adapter.read(AL_STATUS, 2) == (1, b"\1\0")


@pytest.mark.parametrize(
    "access",
    [
        lambda adapter: adapter.write(STATION, b"\1\0"),
        lambda adapter: adapter.read(MAIL, 48),
    ],
)
def test_what_cannot_be_sent_again_is_not(
    loop: Loop, access: Callable[[WireAdapter], object]
) -> None:
    adapter = opened()
    before = loop.sent
    loop.lost.append("after")
    with pytest.raises(Unheard, match="not known"):
        access(adapter)
    assert loop.sent == before + 1


def test_an_answer_to_an_earlier_frame_is_left_out(loop: Loop) -> None:
    adapter = opened()
    late = Datagram(COMMANDS["APWR"], 200, 3, STATION, b"\1\0", 1)
    loop.returns.extend([b"", loop.wire.frame(bytes(6), (late,))])
    loop.lost.append("after")
    with pytest.raises(Unheard):
        adapter.write(STATION, b"\1\0")
    assert adapter.read(STATION, 2) == (1, b"\1\0")


def test_a_lost_frame_makes_a_case_inconclusive(loop: Loop) -> None:
    adapter = opened("time=virtual")
    model = Model(load(DEVICE))
    runner = Runner(model, adapter, adapter.describe())
    case = next(c for c in all_cases(model, NO_LIMITS) if c.name == "sdo/upload/1018_00")
    assert runner.executor.judge(case).outcome is Outcome.PASS
    loop.lossy = True
    assert runner.executor.judge(case).outcome is Outcome.INCONCLUSIVE


def test_whoever_does_not_answer_any_more_is_gone(loop: Loop) -> None:
    adapter = opened()
    loop.lost.extend(["before"] * 5)
    with pytest.raises(DeviceHang, match="sent 5 times"):
        adapter.read(AL_STATUS, 2)


@pytest.mark.parametrize(
    ("rest", "said"),
    [
        ("", "needs an interface"),
        ("loop,position=x", "no position"),
        ("loop,position=3", "no position 3 among 3"),
        ("loop,time=slow", "real and virtual"),
        ("loop,speed=1", "no option 'speed'"),
    ],
)
def test_what_is_wrong_is_one_line(loop: Loop, rest: str, said: str) -> None:
    with pytest.raises(AdapterError, match=said) as caught:
        open_adapter(f"eth:{rest}", DEVICE)
    assert "\n" not in str(caught.value)
    assert loop.closed == (loop.timeout > 0)


def test_a_segment_without_anybody(loop: Loop) -> None:
    loop.lost.extend(["before"] * 5)
    with pytest.raises(AdapterError, match="connect a SubDevice"):
        opened()
    assert loop.closed


@pytest.mark.usefixtures("loop")
def test_power_is_switched_by_a_command(tmp_path: Path) -> None:
    mark = tmp_path / "switched"
    adapter = opened(f"power=touch {mark}")
    adapter.reset()
    assert mark.exists()
    assert not adapter.describe().notes
    assert opened().describe().notes
    failing = opened("power=echo no relay >&2; exit 3")
    with pytest.raises(AdapterError, match=r"exit status 3 \(no relay\)"):
        failing.reset()


@pytest.mark.usefixtures("loop")
def test_without_power_an_error_is_acknowledged_and_registers_are_reset() -> None:
    adapter = opened()
    adapter.write(0x0120, b"\4\0")
    adapter.write(0x0600, bytes(range(1, 14)))
    assert adapter.read(AL_STATUS, 2) == (1, b"\x11\0")
    adapter.reset()
    assert adapter.read(AL_STATUS, 2) == (1, b"\1\0")
    assert adapter.read(0x0600, 13) == (1, bytes(13))
    assert adapter.read(0x0120, 2) == (1, b"\1\0")
