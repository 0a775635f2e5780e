"""`ecatspec compare`: what became better or worse from run to run."""

from __future__ import annotations

import click

from ecatspec.conformance.cli.console import print_json, print_text, table_text
from ecatspec.conformance.cli.exit_status import CONFORMS, DOES_NOT_CONFORM
from ecatspec.conformance.cli.options import example


@click.command(epilog=example("compare"))
@click.argument("first", metavar="RUN1")
@click.argument("second", metavar="RUN2")
@click.option("--json", "as_json", is_flag=True, help="Give the comparison as JSON.")
def compare(*, first: str, second: str, as_json: bool) -> int:
    """Tell what became better or worse from RUN1 to RUN2.

    It goes by case, finding, clause and choice. Both are results files (`run --results FILE`), or
    `last` and `previous`: the newest run of this user, and the one before of the same device. A run
    that goes on counts as far as it is. Exit status: 0 nothing is worse, 1 something is.
    """
    from ecatspec.conformance.results import compare as comparing
    from ecatspec.conformance.results import run_file, run_history

    runs = [run_file.read(run_history.named(name)) for name in (first, second)]
    found = comparing.compare(*runs)
    if as_json:
        print_json("ecatspec.compare", comparing.as_data(found))
    else:
        lines = (comparing.headline(found), *(f"note: {note}" for note in found.notes()))
        print_text("".join(f"{line}\n" for line in lines))
        print_text("".join(map(table_text, comparing.sheets(found))))
    return DOES_NOT_CONFORM if found.worse else CONFORMS
