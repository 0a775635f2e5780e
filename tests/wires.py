"""Cables of tests: a network namespace with two ends, and what runs at them.

A namespace lives as long as the process that holds it, so nothing is left behind.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

NEAR: Final = "near"
"""The end for a MainDevice."""
FAR: Final = "far"
"""The end for SubDevices."""
COMMAND: Final = [sys.executable, "-P", "-m", "ecatspec.conformance.cli"]
_CABLE: Final = (
    f"ip link add {NEAR} type veth peer name {FAR} && ip link set {NEAR} up && "
    f"ip link set {FAR} up && echo ready && exec cat"
)


class Cable:
    """A namespace with a pair of interfaces."""

    def __init__(self, holder: subprocess.Popen[str]) -> None:
        self._inside = ["nsenter", "--target", str(holder.pid), "--net"]
        if os.geteuid():
            self._inside += ["--user", "--preserve-credentials"]

    def within(self, command: list[str]) -> list[str]:
        """Give a command that runs where the cable is."""
        return [*self._inside, *command]

    def run(self, command: list[str], seconds: float = 120) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            self.within(command), capture_output=True, text=True, check=False, timeout=seconds
        )

    @contextmanager
    def simulated(
        self, device: str, *options: str, ended_by: signal.Signals = signal.SIGTERM
    ) -> Iterator[subprocess.Popen[str]]:
        """Have a virtual SubDevice at the far end, which ends with status 0."""
        command = [*COMMAND, "simulate", device, "--iface", FAR, *options]
        with subprocess.Popen(self.within(command), stderr=subprocess.PIPE, text=True) as running:
            assert running.stderr is not None
            try:
                first = running.stderr.readline()
                assert "answers on" in first, first + running.stderr.read()
                yield running
                running.send_signal(ended_by)
                said = running.stderr.read()
                assert (running.wait(20), said) == (0, "")
            finally:
                running.kill()


@contextmanager
def cable() -> Iterator[Cable]:
    """Lay a cable, or skip the test where that is not allowed."""
    if not shutil.which("unshare") or not shutil.which("ip"):
        pytest.skip("no network namespaces here: unshare or ip is missing")
    rights = ["--map-root-user"] if os.geteuid() else []
    command = ["unshare", "--net", *rights, "sh", "-c", _CABLE]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as holder:
        assert holder.stdin is not None
        assert holder.stdout is not None
        assert holder.stderr is not None
        if holder.stdout.readline() != "ready\n":
            pytest.skip(f"no network namespaces here: {holder.stderr.read().strip()}")
        try:
            yield Cable(holder)
        finally:
            holder.stdin.close()
            holder.wait(20)
