"""`ecatspec mutate`: measure a suite by the mistakes that it finds."""

from __future__ import annotations

import os

import click

from ecatspec.conformance.cli.console import print_json, print_text, progress_bar, table_text
from ecatspec.conformance.cli.exit_status import CONFORMS, DOES_NOT_CONFORM
from ecatspec.conformance.cli.options import example
from ecatspec.generators.cases.depths import DEPTHS


@click.command(epilog=example("mutate"))
@click.argument("device")
@click.option("--own", is_flag=True, help="Only rules that the text of DEVICE brings itself.")
@click.option(
    "--only", default="", metavar="WORDS", help="Only mistakes that are described with these words."
)
@click.option(
    "--depth", type=click.Choice(DEPTHS), default="default", show_default=True, help="As for run."
)
@click.option("--workers", type=click.IntRange(1), help="Processes; all processors without it.")
@click.option(
    "--at-least",
    type=click.FloatRange(0, 100),
    default=98.0,
    show_default=True,
    metavar="PERCENT",
    help="A lower score gives exit status 1.",
)
@click.option("--json", "as_json", is_flag=True, help="Give the analysis as JSON.")
def mutate(
    *,
    device: str,
    own: bool,
    only: str,
    depth: str,
    workers: int | None,
    at_least: float,
    as_json: bool,
) -> int:
    """Measure the suite of DEVICE by the mistakes that it finds.

    Every rule of the texts is made wrong in one point after the other, the virtual SubDevice of
    the wrong text is run, and what no case notices is listed. It takes minutes.
    """
    from ecatspec.conformance.mutation.kill_analysis import analyse

    with progress_bar() as progress:
        found = analyse(
            device,
            own=own,
            only=only,
            depth=depth,
            workers=workers or os.cpu_count() or 1,
            progress=progress,
        )
    if as_json:
        print_json("ecatspec.mutate", found.to_json())
    else:
        print_text("\n".join(table_text(sheet) for sheet in found.sheets()))
        print_text("".join(f"not noticed: {line}\n" for line in found.survivors()))
    whole = all(table.kills.score == 1 for table in found.tables)
    return CONFORMS if whole and found.score() * 100 >= at_least else DOES_NOT_CONFORM
