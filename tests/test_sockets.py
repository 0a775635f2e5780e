"""Tests of devices behind sockets: they answer, die, and come back or do not."""

from __future__ import annotations

import shlex
import socket
import sys
import textwrap
import threading
import time
from typing import TYPE_CHECKING

import pytest
from inetd import Served
from processes import descriptors
from test_process import HEAD, LOOP, on_read

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.adapters.line_protocol import MAXIMUM_LINE
from ecatspec.conformance.base.adapter import (
    AdapterError,
    DeviceCrash,
    DeviceFault,
    DeviceHang,
    DeviceRubbish,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from ecatspec.conformance.base.adapter import Adapter

    Serve = Callable[[str], Served]


@pytest.fixture(params=["tcp", "unix"])
def serve(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Serve]:
    """Serve a device from source at a socket of each kind."""
    served: list[Served] = []

    def start(source: str) -> Served:
        script = tmp_path / "device.py"
        script.write_text(textwrap.dedent(source))
        path = str(tmp_path / "socket") if request.param == "unix" else ""
        served.append(Served([sys.executable, "-I", "-S", str(script)], path))
        return served[-1]

    yield start
    for each in served:
        each.__exit__()


def test_a_good_device_passes_the_kit(serve: Serve) -> None:
    served = serve(HEAD + LOOP)
    complaints = check_adapter(
        lambda: open_adapter(served.dut, "standard"), spans=[(0, 4096)], write=(0x120, b"\x02\0")
    )
    assert complaints == []


def test_a_reset_keeps_the_connection(serve: Serve) -> None:
    served = serve(HEAD + LOOP)
    adapter = open_adapter(served.dut, "standard")
    adapter.write(0x1000, b"x")
    adapter.reset()
    assert adapter.read(0x1000, 1) == (1, b"\0")
    assert len(served.processes) == 1
    adapter.close()
    assert served.processes[0].wait(5) == 0


@pytest.mark.parametrize(
    ("body", "fault", "words"),
    [
        ("os._exit(3)", DeviceCrash, "the device ended: the connection was lost"),
        ("os.kill(os.getpid(), 11)", DeviceCrash, "the connection was lost"),
        ("os.write(1, b'{\"ok\":tr'); os._exit(0)", DeviceCrash, "lost, 8 bytes into an answer"),
        ("while True: pass", DeviceHang, "no answer within 1 s"),
        ("while True: os.write(1, b'x' * 65536)", DeviceRubbish, f"more than {MAXIMUM_LINE} bytes"),
        ("print('hello', flush=True)", DeviceRubbish, "not JSON"),
        ("reply(wkc=1, data='000000')", DeviceRubbish, "3 bytes came for a read of 2"),
        ("reply(wkc=-1, data='0000')", DeviceRubbish, "the working counter is not a count"),
    ],
)
def test_what_a_device_does_wrong_is_its_fault_and_it_is_reached_again(
    body: str, fault: type[DeviceFault], words: str, serve: Serve
) -> None:
    served = serve(on_read(body))
    adapter = open_adapter(served.dut, "standard", hang_timeout=1)
    with pytest.raises(fault, match=words):
        adapter.read(0, 2)
    with pytest.raises(DeviceCrash, match="the device is not running"):
        adapter.read(0, 2)
    adapter.reset()
    assert adapter.write(0, b"\0") == 1
    assert len(served.processes) == 2
    adapter.close()


def write_without_end(adapter: Adapter) -> None:
    while True:
        adapter.write(0, bytes(65536))


def test_a_device_that_never_listens_to_a_long_request_is_a_hang(serve: Serve) -> None:
    served = serve(
        "import json, sys, time\n"
        + HEAD
        + "serve(json.loads(sys.stdin.readline()))\nwhile True: time.sleep(1)\n"
    )
    adapter = open_adapter(served.dut, "standard", hang_timeout=1)
    with pytest.raises(DeviceHang):
        write_without_end(adapter)
    adapter.close()


def test_many_lost_connections_leave_no_descriptor_behind(serve: Serve) -> None:
    served = serve(on_read("os._exit(1)"))
    adapter = open_adapter(served.dut, "standard")
    before = -1
    for number in range(30):
        adapter.reset()
        with pytest.raises(DeviceFault):
            adapter.read(0, 1)
        if number == 0:
            before = descriptors()
    assert descriptors() == before
    adapter.close()


@pytest.mark.parametrize(
    ("dut", "words"),
    [
        ("tcp:", "'' is no place in a network; give HOST:PORT"),
        ("tcp:localhost", "'localhost' is no place in a network"),
        ("tcp:localhost:0", "is no place in a network"),
        ("tcp:localhost:70000", "is no place in a network"),
        ("tcp:localhost:http", "is no place in a network"),
        ("tcp::5000", "is no place in a network"),
        ("tcp:[::1]:1", r"no device at 'tcp:\[::1\]:1': .*; start the device first"),
        ("unix:", "a Unix socket is a file"),
        ("unix:/nowhere/at/all", "no device at .*: No such file or directory; start the device"),
        ("unix:" + "x" * 200, "no device at .*too long"),
        ("unix:a\0b", "no device at 'unix:a.x00b': "),
    ],
)
def test_where_no_device_is_is_one_line(dut: str, words: str) -> None:
    with pytest.raises(AdapterError, match=words) as caught:
        open_adapter(dut, "standard")
    assert "\n" not in str(caught.value)


def test_a_closed_port_is_one_line() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        with pytest.raises(AdapterError, match="Connection refused; start the device first"):
            open_adapter(f"tcp:127.0.0.1:{port}", "standard")


def test_what_listens_and_says_nothing_does_not_come_up() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(AdapterError, match=r"does not come up: no answer within 0.2 s"):
            open_adapter(f"tcp:127.0.0.1:{port}", "standard", hang_timeout=0.2)


def test_a_device_that_comes_back_late_is_waited_for_once(tmp_path: Path) -> None:
    path = str(tmp_path / "socket")
    script = tmp_path / "device.py"
    script.write_text(on_read("os._exit(1)"))
    command = [sys.executable, "-I", "-S", str(script)]
    with Served(command, path) as served:
        adapter = open_adapter(served.dut, "standard", hang_timeout=3)
        with pytest.raises(DeviceCrash):
            adapter.read(0, 1)
    (tmp_path / "socket").unlink()
    again: list[Served] = []
    later = threading.Timer(0.5, lambda: again.append(Served(command, path)))
    later.start()
    adapter.reset()
    later.join()
    with pytest.raises(DeviceCrash):
        adapter.read(0, 1)
    again[0].__exit__()
    for least in (3.0, 0.0):
        began = time.monotonic()
        with pytest.raises(AdapterError, match="start the device first"):
            adapter.reset()
        assert least <= time.monotonic() - began < least + 2
    adapter.close()


def test_the_lines_are_those_of_a_program(tmp_path: Path) -> None:
    script = tmp_path / "device.py"
    script.write_text(HEAD + LOOP)
    command = [sys.executable, "-I", "-S", str(script)]
    by_exec = open_adapter(f"exec:{shlex.join(command)}", "standard")
    with Served(command) as served:
        by_socket = open_adapter(served.dut, "standard")
        assert by_socket.describe() == by_exec.describe()
        by_socket.close()
    by_exec.close()
