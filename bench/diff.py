"""The only place that measures `ecatspec diff`: every two devices that have a manual.

    python bench/diff.py [--json]

The command runs as a process of its own, start-up included; the product search of AL x DS402 is
timed by itself, over tables that are there. A figure is the best of the rounds.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from itertools import combinations
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.diff.behaviour import product
from ecatspec.conformance.diff.machines import BOTH, Watched, explored, setups
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Callable

ROUNDS: Final = 3
COMMAND: Final = (sys.executable, "-P", "-m", "ecatspec.conformance.cli", "diff")
TARGET: Final = {"command": 2.0, "product": 0.02}
"""Seconds that are aimed at."""


def best(call: Callable[[], object]) -> float:
    """Give the seconds of the fastest of all rounds."""
    found = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        call()
        found.append(time.perf_counter() - began)
    return min(found)


def told(first: str, second: str) -> dict[str, object]:
    """Run the command once and give its JSON."""
    done = subprocess.run((*COMMAND, first, second, "--json"), capture_output=True, check=False)
    found: dict[str, object] = json.loads(done.stdout)
    return found


def searched(first: str, second: str) -> float | None:
    """Give the seconds of the product search of AL x DS402; None: one of them is no such drive."""
    devices = [Watched(load_device(name)) for name in (first, second)]
    plans = [setups(device.model).get(BOTH) for device in devices]
    if plans[0] is None or plans[1] is None:
        return None
    inputs = [name for name in plans[0].alphabet if name in plans[1].alphabet]
    one = explored(devices[0], plans[0], inputs, {})
    other = explored(devices[1], plans[1], inputs, {})
    return best(lambda: product(one, other))


def main() -> None:
    """Measure all pairs and print a line for each, or all as JSON."""
    names = [name for name in device_names() if load_device(name).manuals]
    rows = []
    for first, second in combinations(names, 2):
        data: dict[str, object] = {}
        seconds = best(lambda: data.update(told(first, second)))  # noqa: B023  used at once
        facts, answers = data["facts"], data["answers"]
        assert isinstance(facts, list)
        assert isinstance(answers, list)
        search = searched(first, second)
        rows.append((first, second, seconds, search, len(facts), len(answers)))
        if "--json" not in sys.argv:
            shown = "        -" if search is None else f"{search * 1000:7.2f}ms"
            print(
                f"{first:15} {second:15} {seconds:6.2f} s  {shown}  "
                f"{len(facts):3} facts {len(answers):3} answers",
                flush=True,
            )
    if "--json" in sys.argv:
        keys = ("first", "second", "command", "product", "facts", "answers")
        print(
            json.dumps({"target": TARGET, "rows": [dict(zip(keys, r, strict=True)) for r in rows]})
        )


if __name__ == "__main__":
    main()
