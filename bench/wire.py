"""Measures `ecatspec simulate` on a cable, beside a bare echo loop.

It makes a network namespace of its own with two cables: at the far end of one is the virtual
SubDevice, at that of the other a loop that gives each frame back as it is. Both take turns. What is
measured runs in a process inside the namespace, which prints what it found as JSON.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from measure import (
    COMMAND,
    Absent,
    Effort,
    Figure,
    Found,
    Of,
    Part,
    Profile,
    Row,
    Target,
    in_turns,
    profiled_file,
    rate,
)

from ecatspec.generators.cases.stimulus import frame_bytes
from ecatspec.generators.cases.transfers import upload
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.wire import COMMANDS, Datagram, Wire, filled, wire_format
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Iterator

DEVICE: Final = "kollmorgen-akd"
SIMULATED, ECHOED = ("near", "far"), ("this", "that")
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
            process.send_signal(signal.SIGTERM)
            process.wait(20)


# --- inside the namespace -------------------------------------------------------------------------


def register_read(wire: Wire, address: int, rounds: int, count: int) -> tuple[Figure, Figure]:
    """Measure a read of AL Status: what the virtual SubDevice adds to the cable."""
    asked = Datagram(COMMANDS["APRD"], 1, 0, address, bytes(6), 0)
    frame = filled(wire.frame(SOURCE, (asked,)))
    ends = [End(name, wire.format.ethertype) for name, _ in (SIMULATED, ECHOED)]
    found = [[end.median(frame, count) for end in ends] for _ in range(rounds + 1)][1:]
    ours, bare = (Figure.of(list(column)) for column in zip(*found, strict=True))
    return ours, bare


def uploads(wire: Wire, model: Model, rounds: int, count: int) -> tuple[Figure, Figure]:
    """Measure SDO uploads by pysoem beside the frames of one, sent to the echo loop."""
    import pysoem  # noqa: PLC0415  only this process needs it

    # on a busy machine a frame may take longer than SOEM waits; in microseconds
    pysoem.settings.timeouts.ret = 100_000
    pysoem.settings.timeouts.safe = 200_000
    pysoem.settings.timeouts.tx_mailbox = 500_000
    main_device = pysoem.Master()
    main_device.open(SIMULATED[0])
    try:
        assert main_device.config_init() == 1
        device = main_device.slaves[0]
        assert device.state_check(pysoem.PREOP_STATE, 1_000_000) == pysoem.PREOP_STATE
        end = End(ECHOED[0], wire.format.ethertype)
        frames = frames_of_an_upload(wire, model)

        def read() -> None:
            for _ in range(count):
                device.sdo_read(0x1018, 1)

        ours, bare = in_turns(rounds, read, partial(end.trips, frames, count))
    finally:
        main_device.close()
    return rate(count, ours), rate(count, bare)


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


def inside(rounds: int, reads: int, asked: int, profile: str) -> None:
    """Measure on the cables of this namespace, and print the figures; keep a profile if asked."""
    model = Model(load_device(DEVICE))
    wire = Wire(wire_format(model))
    address = model.protocol.registers["al_status"].address
    simulate = ("simulate", DEVICE, "--iface", SIMULATED[1])
    command = [*COMMAND, *simulate]
    if profile:
        command = [*COMMAND[:2], "-m", "cProfile", "-o", profile, "-m", COMMAND[-1], *simulate]
    with ExitStack() as stack:
        stack.enter_context(running(command))
        stack.enter_context(running([sys.executable, "-c", ECHO]))
        figures = [
            *register_read(wire, address, rounds, reads),
            *uploads(wire, model, rounds, asked),
        ]
    print(json.dumps([[one.median, one.low, one.high] for one in figures]))


# --- outside --------------------------------------------------------------------------------------


def within(*asked: str) -> list[Figure]:
    """Lay the cables in a new namespace, and measure there in a process of its own."""
    if not (sys.platform == "linux" and shutil.which("unshare") and shutil.which("ip")):
        raise Absent("namespaces need Linux, unshare and ip")
    rights = ["--map-root-user"] if os.geteuid() else []
    again = [sys.executable, __file__, *asked]
    script = ["sh", "-c", f'{CABLES} && exec "$@"', "sh", *again]
    done = subprocess.run(
        ["unshare", "--net", *rights, *script], capture_output=True, text=True, check=False
    )
    if done.returncode:
        last = done.stderr.strip().splitlines() or ["no word"]
        raise Absent(f"no cable can be laid here: {last[-1]}")
    return [Figure(*each) for each in json.loads(done.stdout)]


def measure(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Measure both on the same cables."""
    read, upload_row = rows
    reads, asked = effort.of(2000, 500, 20), effort.of(500, 100, 5)
    rounds = effort.of(7, 3, 1)
    one, echo, asking, frames = within(str(rounds), str(reads), str(asked), "")
    note = f"median of {reads} trips a round"
    said = f"{asked} uploads of 4 bytes a round; the rival sends the five frames of one from Python"
    return Found((read.found(one, echo, note), upload_row.found(asking, frames, said)))


def profile(effort: Effort) -> Profile:
    """Profile the virtual SubDevice while it answers, mostly uploads."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "profile"
        within("1", "10", str(effort.of(2000, 500, 5)), str(path))
        return profiled_file(path, "cProfile of `simulate`, start-up included")


PARTS: Final = (
    Part(
        (
            Row(
                "cable-read",
                "register read over a cable, round trip",
                "us",
                "an echo loop in Python",
                Target(Of.ADDED, 20.0),
            ),
            Row(
                "cable-upload",
                "SDO uploads by pysoem through `simulate`",
                "a second",
                "the frames of one, to an echo loop",
                Target(Of.FIGURE, 12_000.0, least=True),
                "An upload is five frames: three looks at mailboxes, the request, the answer. "
                "The cable and the frames take much of the time, the interpreter of the texts "
                "the rest: the message is decoded, a rule is chosen, the answer is encoded.",
            ),
        ),
        measure,
        {"cable-upload": profile},
    ),
)


if __name__ == "__main__":
    inside(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
