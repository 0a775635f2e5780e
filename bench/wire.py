"""The only place that measures `ecatspec simulate` on a cable, beside a bare echo loop.

    python bench/wire.py [--json]

It makes a network namespace of its own with two cables: at the far end of one is the virtual
SubDevice, at that of the other a loop that gives each frame back as it is. Both take turns. It
needs Linux, `unshare` and `ip`, and root or the right to make namespaces.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Final

import pysoem
from run import ROUNDS, Figure, Row, in_turns, rate, show

from ecatspec.generators.stimulus import frame_bytes
from ecatspec.generators.transfers import upload
from ecatspec.model.compiled import Model
from ecatspec.model.wire import COMMANDS, Datagram, Wire, filled, wire_format
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Iterator

DEVICE: Final = "kollmorgen-akd"
SIMULATED, ECHOED = ("near", "far"), ("this", "that")
READS: Final = 2000
UPLOADS: Final = 500
INSIDE: Final = "--inside"
CABLES: Final = " && ".join(
    f"ip link add {a} type veth peer name {b} && ip link set {a} up && ip link set {b} up"
    for a, b in (SIMULATED, ECHOED)
)
ECHO: Final = f"""
import socket
end = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x88A4))
end.bind(({ECHOED[1]!r}, 0x88A4))
print("ready", flush=True)
buffer = bytearray(2048)
while True:
    length = end.recv_into(buffer)
    end.send(buffer[:length])
"""
SOURCE: Final = bytes(6)

# On a busy machine a frame may take longer than SOEM waits; in microseconds.
pysoem.settings.timeouts.ret = 100_000
pysoem.settings.timeouts.safe = 200_000
pysoem.settings.timeouts.tx_mailbox = 500_000


class End:
    """The near end of a cable, which sends a frame and waits for it."""

    def __init__(self, name: str, ethertype: int) -> None:
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ethertype))
        self._socket.bind((name, ethertype))
        self._socket.settimeout(5)

    def trip(self, frame: bytes) -> None:
        self._socket.send(frame)
        self._socket.recv(2048)

    def trips(self, frames: list[bytes], count: int) -> None:
        for _ in range(count):
            for frame in frames:
                self.trip(frame)

    def median(self, frame: bytes, count: int) -> float:
        times = []
        for _ in range(count):
            began = time.perf_counter_ns()
            self.trip(frame)
            times.append(time.perf_counter_ns() - began)
        return statistics.median(times) / 1000


@contextmanager
def running(command: list[str]) -> Iterator[None]:
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=subprocess.STDOUT) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield
        finally:
            process.terminate()


def register_read(wire: Wire, address: int) -> Row:
    """Measure a read of AL Status: what the virtual SubDevice adds to the cable."""
    asked = Datagram(COMMANDS["APRD"], 1, 0, address, bytes(6), 0)
    frame = filled(wire.frame(SOURCE, (asked,)))
    ends = [End(name, wire.format.ethertype) for name, _ in (SIMULATED, ECHOED)]
    rounds = [[end.median(frame, READS) for end in ends] for _ in range(ROUNDS + 1)][1:]
    ours, bare = (Figure.of(list(column)) for column in zip(*rounds, strict=True))
    note = f"median of {READS} trips a round; added: {ours.median - bare.median:.1f} us"
    return Row("register read, round trip", "microseconds", ours, bare, "an echo loop", note)


def uploads(wire: Wire, model: Model) -> Row:
    """Measure SDO uploads by pysoem beside the frames of one, sent to the echo loop."""
    main_device = pysoem.Master()
    main_device.open(SIMULATED[0])
    try:
        assert main_device.config_init() == 1
        device = main_device.slaves[0]
        assert device.state_check(pysoem.PREOP_STATE, 1_000_000) == pysoem.PREOP_STATE
        end = End(ECHOED[0], wire.format.ethertype)
        frames = frames_of_an_upload(wire, model)

        def read() -> None:
            for _ in range(UPLOADS):
                device.sdo_read(0x1018, 1)

        ours, bare = in_turns(ROUNDS, read, partial(end.trips, frames, UPLOADS))
    finally:
        main_device.close()
    beside = f"the {len(frames)} frames of one, from Python to an echo loop"
    note = f"{UPLOADS} uploads of 4 bytes a round"
    return Row(
        "SDO uploads by pysoem",
        "per second",
        rate(UPLOADS, ours),
        rate(UPLOADS, bare),
        beside,
        note,
    )


def frames_of_an_upload(wire: Wire, model: Model) -> list[bytes]:
    """Give frames as long as those with which SOEM reads an object."""
    out, back = (model.parameter(area, "length") for area in ("mailbox_out", "mailbox_in"))
    message = frame_bytes(model, upload(0x1018, 1), 1).ljust(out, b"\0")
    status = model.protocol.registers["sync_manager_1_status"].address
    looks = [Datagram(COMMANDS["FPRD"], 1, 0x1001, status, bytes(2), 0)] * 3
    mail = [
        Datagram(COMMANDS["FPWR"], 1, 0x1001, 0x1800, message, 0),
        Datagram(COMMANDS["FPRD"], 1, 0x1001, 0x1C00, bytes(back), 0),
    ]
    return [filled(wire.frame(SOURCE, (datagram,))) for datagram in (*looks, *mail)]


def measure() -> list[Row]:
    model = Model(load_device(DEVICE))
    wire = Wire(wire_format(model))
    simulate = ["-m", "ecatspec.conformance.cli", "simulate", DEVICE, "--iface", SIMULATED[1]]
    with ExitStack() as stack:
        stack.enter_context(running([sys.executable, *simulate]))
        stack.enter_context(running([sys.executable, "-c", ECHO]))
        address = model.protocol.registers["al_status"].address
        return [register_read(wire, address), uploads(wire, model)]


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure simulate beside an echo loop.")
    parser.add_argument("--json", action="store_true", help="give the figures as JSON")
    parser.add_argument(INSIDE, action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if not given.inside:
        rights = ["--map-root-user"] if os.geteuid() else []
        again = [sys.executable, *sys.argv, INSIDE]
        script = ["sh", "-c", f'{CABLES} && exec "$@"', "sh", *again]
        return subprocess.run(["unshare", "--net", *rights, *script], check=False).returncode
    rows = measure()
    if given.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    else:
        show(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
