"""`ecatspec export`: write test vectors."""

from __future__ import annotations

import os

import click

from ecatspec.conformance.cli.console import output_file, progress_bar, warn
from ecatspec.conformance.cli.device_run import set_up_errors
from ecatspec.conformance.cli.exit_status import CONFORMS
from ecatspec.conformance.cli.options import (
    MAILBOX,
    MOST_WORKERS,
    SEED,
    example,
    layers,
    way_of_choice,
)
from ecatspec.generators.cases.depths import DEPTHS
from ecatspec.generators.formats import FORMATS


@click.command(epilog=example("export"))
@click.argument("device")
@click.option(
    "--format",
    "form",
    type=click.Choice(tuple(FORMATS)),
    required=True,
    help="; ".join(f"{name}: {each.summary}" for name, each in FORMATS.items()) + ".",
)
@click.option("-o", "--output", metavar="FILE", help="Write here instead of standard output.")
@click.option(
    "--depth",
    type=click.Choice(DEPTHS),
    default="default",
    show_default=True,
    help="As for run.",
)
@click.option("--only", default="", metavar="LAYER,...", help="Only the tests of these layers.")
@click.option(
    "--choice",
    "choices",
    multiple=True,
    metavar="NAME=WAY",
    help="The device goes this way where its text leaves a choice open, or meets a condition.",
)
@click.option(
    "--workers", type=click.IntRange(1, MOST_WORKERS), help="Processes; all processors without it."
)
@MAILBOX
@SEED
def export(
    *,
    device: str,
    form: str,
    output: str | None,
    depth: str,
    only: str,
    choices: tuple[str, ...],
    workers: int | None,
    mailbox: str,
    seed: int,
) -> int:
    """Write the tests of DEVICE as test vectors.

    DEVICE is a name, or a path to a .ecs file.
    Who has no ecatspec can play them: a firmware test in C, another language, a person. The same
    call gives the same bytes.
    """
    from ecatspec.conformance.vectors.export import Wanted
    from ecatspec.conformance.vectors.export import export as write

    wanted = Wanted(device, depth, layers(only), mailbox, seed, dict(map(way_of_choice, choices)))
    with set_up_errors("export"), output_file(output, text=FORMATS[form].text) as out:
        with progress_bar() as progress:
            made = write(wanted, form, out, progress, workers=workers or os.cpu_count() or 1)
        out.flush()
        said = f"{made.number} tests"
        if made.restless:
            cases = f"{len(made.restless)} cases ({', '.join(made.restless)})"
            said += f"; the virtual SubDevice does not come to rest in {cases}, which have no test"
        if made.cut:
            said += f"; {len(made.cut)} end where more may have happened than can be followed"
        warn(f"ecatspec: {said}")
    return CONFORMS
