"""Options that several commands have, and the examples of the help."""

from __future__ import annotations

import math
from typing import Final

import click

from ecatspec.conformance.cli.console import refuse

EXAMPLES: Final = {
    "run": "ecatspec run kollmorgen-akd --dut canopen",
    "compare": "ecatspec compare previous last",
    "monitor": "ecatspec monitor capture.pcapng --device kollmorgen-akd",
    "check": "ecatspec check spec/devices/kollmorgen-akd.ecs",
    "show": "ecatspec show kollmorgen-akd al",
    "trace": "ecatspec trace kollmorgen-akd --missing",
    "prove": "ecatspec prove kollmorgen-akd",
    "mutate": "ecatspec mutate kollmorgen-akd --own",
    "diff": "ecatspec diff kollmorgen-akd kollmorgen-s300",
    "export": "ecatspec export kollmorgen-akd --format c -o vectors.h",
    "replay": "ecatspec replay vectors.json --dut canopen",
    "adapters": "ecatspec adapters --include",
    "vectors": "ecatspec vectors lint vectors.json",
    "schema": "ecatspec schema report",
    "simulate": "ecatspec simulate kollmorgen-akd --iface veth1",
}

MOST_WORKERS: Final = 256


def example(command: str) -> str:
    """Give the last line of the help of a command."""
    return f"Example: {EXAMPLES[command]}"


def _seconds(context: click.Context, parameter: click.Parameter, value: float | None) -> float:
    from ecatspec.conformance.adapters import HANG_TIMEOUT

    if value is None:
        return HANG_TIMEOUT
    if not (math.isfinite(value) and value > 0):
        message = f"{value} is no number of seconds above 0"
        raise click.BadParameter(message, context, parameter)
    return value


DUT: Final = click.option(
    "--dut", default="model", show_default=True, help="How to reach the device."
)


SEED: Final = click.option(
    "--seed", type=int, default=0, show_default=True, help="Seed of the random part."
)


MAILBOX: Final = click.option(
    "--mailbox", default="", metavar="SIZE", help="Bytes of both mailboxes, or OUT:IN."
)


HANG_TIMEOUT: Final = click.option(
    "--hang-timeout",
    type=float,
    callback=_seconds,
    metavar="SECONDS",
    help="Without an answer for so long the device counts as hung.",
)


def layers(words: str) -> tuple[str, ...]:
    """Give the layers that --only names."""
    return tuple(filter(None, words.split(",")))


def way_of_choice(choice: str) -> tuple[str, str]:
    """Give the name and the way of a --choice."""
    name, equals, way = choice.partition("=")
    if not (name and equals and way):
        refuse(f"--choice {choice!r} names no way; write --choice NAME=WAY")
    return name, way
