"""Writes docs/mutants.md: what the suite of each device kills.

`make mutants` runs it. It runs the commands that it prints, one after the other, which takes long.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ecatspec.conformance.base.atomic_write import write_whole
from ecatspec.conformance.mutation.fates import Fate
from ecatspec.generators.mutation.mutants import Operator
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Mapping

PAGE: Final = Path(__file__).resolve().parent / "mutants.md"
WHOLE: Final = "reference-drive"
"""The device whose rules are all tried, those of the standard too."""
_INTRODUCTION: Final = """\
# What the suites kill

Each rule and each definition of the texts is made wrong in one point; the virtual SubDevice of the
wrong text runs the suite of the device, as [methods.md](methods.md) says. Of the imaginary
reference drive all rules are tried, those of the standard too; of the other devices those that
their own texts bring. The score is killed / (killed + unnoticed). Made by `make mutants`.
"""


def devices() -> tuple[str, ...]:
    """Give the devices that are measured: all rules of the first, their own of the others."""
    return (WHOLE, *(name for name in device_names() if load_device(name).manuals))


def command(device: str) -> tuple[str, ...]:
    """Give the arguments of `ecatspec` that measure a device."""
    return ("mutate", device) if device == WHOLE else ("mutate", device, "--own")


def measured(device: str) -> dict[str, Any]:
    """Measure a device, and give the analysis as `ecatspec mutate --json` gives it.

    Raises:
        RuntimeError: The command came to no result.

    """
    arguments = (sys.executable, "-m", "ecatspec.conformance.cli", *command(device), "--json")
    done = subprocess.run(arguments, stdout=subprocess.PIPE, check=False)  # noqa: S603
    if not done.stdout:
        raise RuntimeError(f"{' '.join(arguments)} gave nothing and ended with {done.returncode}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def page(analyses: Mapping[str, Mapping[str, Any]], minutes: Mapping[str, int]) -> str:
    """Give the page: a table for each device, what survived, the command and how long it took."""
    lines = [_INTRODUCTION]
    for device, found in analyses.items():
        shown = " ".join(("ecatspec", *command(device)))
        took = minutes.get(device)
        lines += [f"## {device}", "", *_table(found), ""]
        lines.append(
            f"`{shown}`: {found['cases']} cases of depth {found['depth']}"
            + ("." if took is None else f", {took} minutes.")
        )
        lines += ["", *_survivors(found), ""]
    missing = [device for device in devices() if device not in analyses]
    if missing:
        lines.append(f"Not measured: {', '.join(missing)}.")
    return "\n".join(lines).rstrip() + "\n"


def _table(found: Mapping[str, Any]) -> list[str]:
    heads = ["mistake", "mutants", *(fate.name.lower() for fate in Fate), "score"]
    lines = [f"| {' | '.join(heads)} |", "| --- |" + " ---: |" * (len(heads) - 1)]
    counts = Counter((each["mistake"], each["fate"]) for each in found["mutants"])
    every = [operator.name.lower() for operator in Operator]
    for operator in (*Operator, None):
        names = every if operator is None else [operator.name.lower()]
        row = [sum(counts[name, fate.name.lower()] for name in names) for fate in Fate]
        killed, lost = row[[*Fate].index(Fate.KILLED)], row[[*Fate].index(Fate.UNNOTICED)]
        score = f"{100 * killed / (killed + lost):.1f} %" if killed + lost else ""
        name = "all" if operator is None else operator.value
        lines.append(f"| {name} | {sum(row)} | {' | '.join(map(str, row))} | {score} |")
    return lines


def _survivors(found: Mapping[str, Any]) -> list[str]:
    """Tell what nothing noticed, by the rule or the definition that is wrong."""
    places: dict[str, list[str]] = {}
    for each in found["mutants"]:
        if each["fate"] == Fate.UNNOTICED.name.lower():
            said = f"{Operator[each['mistake'].upper()]}: {each['before']} -> {each['after']}"
            places.setdefault(each["place"], []).append(said)
    if not places:
        return ["Nothing is unnoticed."]
    lines = ["Unnoticed:", ""]
    for place, mistakes in places.items():
        lines.append(f"- {place}")
        lines += [f"  - `{mistake}`" for mistake in mistakes]
    return lines


def main() -> None:
    """Measure all devices and write the page."""
    analyses: dict[str, dict[str, Any]] = {}
    minutes: dict[str, int] = {}
    for device in devices():
        begun = time.monotonic()
        analyses[device] = measured(device)
        minutes[device] = max(1, round((time.monotonic() - begun) / 60))
    write_whole(PAGE, page(analyses, minutes))


if __name__ == "__main__":
    main()
