"""Tests of `ecatspec simulate`: real MainDevices at the other end of a cable."""

from __future__ import annotations

import json
import signal
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from wires import COMMAND, NEAR, cable

from ecatspec.conformance import cli
from ecatspec.conformance.cli import exit_status
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Iterator

    from wires import Cable

SOEM = str(Path(__file__).with_name("soem_client.py"))
PREOP, SAFEOP, OP, INIT = 2, 4, 8, 1
ABSENT = 0x06020000

# What is written to each device in PREOP, and what a MainDevice then finds.
ASSIGNED = (("1c12", "0", "01"), ("1c13", "0", "01"))
DEVICES: dict[str, tuple[tuple[tuple[str, str, str], ...], list[int]]] = {
    "afag-se-power": ((*ASSIGNED, ("6060", "0", "01")), [3, 2]),
    "beckhoff-el6720": (ASSIGNED, [2, 2]),
    "kollmorgen-akd": ((("60c2", "1", "02"),), [6, 6]),
    "kollmorgen-s300": ((("6040", "0", "0600"),), [6, 6]),
    "metronix-dis2": ((("6060", "0", "03"),), [3, 3]),
}


@pytest.fixture
def wire() -> Iterator[Cable]:
    with cable() as laid:
        yield laid


def soem(wire: Cable, *words: str) -> dict[str, Any]:
    pytest.importorskip("pysoem", reason="no pysoem for this Python")
    done = wire.run([sys.executable, SOEM, NEAR, *words])
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("device", DEVICES)
def test_a_main_device_brings_it_to_op_and_reads_and_writes_objects(
    wire: Cable, device: str
) -> None:
    written, sizes = DEVICES[device]
    with wire.simulated(device):
        found = soem(wire, *(word for row in written for word in row))
    assert found["count"] == 1
    assert (found["preop"], found["safeop"], found["op"], found["init"]) == (
        PREOP,
        SAFEOP,
        OP,
        INIT,
    )
    assert found["code"] == 0
    assert found["after"] == [data for _, _, data in written]
    assert found["abort"] == ABSENT
    assert found["identity"][0] == found["vendor"]
    assert found["sizes"] == sizes
    assert found["counter"] == found["expected"] == 3
    # where the device does not say what its SyncManagers are for, the EEPROM does
    says = any(entry.index == 0x1C00 for entry in load_device(device).objects)
    assert found.get("missing") == (None if says else [0x1C00])


def test_the_name_is_that_of_the_object(wire: Cable) -> None:
    with wire.simulated("beckhoff-el6720"):
        assert soem(wire)["name"] == "EL6720"


def test_ctrl_c_ends_it(wire: Cable) -> None:
    with wire.simulated("reference", ended_by=signal.SIGINT):
        pass


def test_several_stand_one_behind_the_other(wire: Cable) -> None:
    with wire.simulated("reference-drive", "--count", "3"):
        found = soem(wire)
    assert (found["count"], found["preop"]) == (3, PREOP)


def test_a_power_cycle_by_signal(wire: Cable) -> None:
    with wire.simulated("reference-drive") as device:
        dut = f"eth:{NEAR},power=kill -HUP {device.pid}"
        done = wire.run([sys.executable, "-c", POWER, dut])
    assert (done.stdout, done.stderr) == ("1 3412 1 0000\n", "")


POWER = """
import sys
from ecatspec.conformance.adapters import open_adapter
adapter = open_adapter(sys.argv[1], "reference-drive")
counter = adapter.write(0x0010, bytes([0x34, 0x12]))
before = adapter.read(0x0010, 2)[1].hex()
adapter.reset()
print(counter, before, adapter.read(0x0010, 2)[0], adapter.read(0x0010, 2)[1].hex())
"""


# --- what is wrong --------------------------------------------------------------------------------


def said(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(["simulate", *words]) == exit_status.WRONG_INPUT
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1, printed.err
    return printed.err


def test_an_interface_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    line = said(capsys, "reference", "--iface", "nosuch0")
    assert "there is no interface 'nosuch0'; there are" in line


def test_rights_that_are_missing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(socket, "socket", refuse)
    assert "CAP_NET_RAW" in said(capsys, "reference", "--iface", "lo")


def test_a_fault_that_nobody_knows(capsys: pytest.CaptureFixture[str]) -> None:
    line = said(capsys, "reference", "--iface", "lo", "--fault", "toggle_ignord")
    assert "did you mean 'toggle_ignored'" in line


def test_no_such_device(capsys: pytest.CaptureFixture[str]) -> None:
    assert "no device text" in said(capsys, "refrence", "--iface", "lo")


def test_an_interface_that_is_down(wire: Cable) -> None:
    wire.run(["ip", "link", "set", NEAR, "down"])
    done = wire.run([*COMMAND, "simulate", "reference", "--iface", NEAR])
    assert done.returncode == exit_status.WRONG_INPUT
    assert f"'{NEAR}' does not work (Network is down); set it up" in done.stderr
    done = wire.run([*COMMAND, "run", "reference", "--dut", f"eth:{NEAR}"])
    assert done.returncode == exit_status.WRONG_INPUT
    assert f"'{NEAR}' does not work (Network is down); set it up" in done.stderr


def test_nobody_at_the_other_end(wire: Cable) -> None:
    done = wire.run([*COMMAND, "run", "reference", "--dut", f"eth:{NEAR}"])
    assert done.returncode == exit_status.WRONG_INPUT
    assert "no frame comes back" in done.stderr
