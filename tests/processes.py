"""Looking at the processes and descriptors that a test may leave behind."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path


def living_group(leader: int) -> list[str]:
    """Processes of the group that still run; a killed orphan may wait for init as a zombie."""
    living = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, group = stat.read_text().rpartition(")")[2].split()[:3]
            if int(group) == leader and state not in "ZX":
                living.append(str(stat))
    return living


def gone(leader: int) -> bool:
    """Whether the group dies soon: all of it got a signal, only the leader was waited for."""
    deadline = time.monotonic() + 10
    while living_group(leader) and time.monotonic() < deadline:
        time.sleep(0.01)
    return not living_group(leader)


def descriptors() -> int:
    """How many descriptors this process holds."""
    return len(list(Path("/proc/self/fd").iterdir()))


def memory() -> int:
    """How many bytes this process has in memory."""
    line = next(
        line
        for line in Path("/proc/self/status").read_text().splitlines()
        if line.startswith("VmRSS:")
    )
    return int(line.split()[1]) * 1024
