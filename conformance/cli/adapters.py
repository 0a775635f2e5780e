"""`ecatspec adapters`: list the ways to a device under test."""

from __future__ import annotations

import click

from ecatspec.conformance.cli.console import print_json, print_text, table_text
from ecatspec.conformance.cli.exit_status import CONFORMS
from ecatspec.conformance.cli.options import example


@click.command(epilog=example("adapters"))
@click.option("--json", "as_json", is_flag=True, help="Give the list as JSON.")
@click.option(
    "--include", is_flag=True, help="Give the folder of the headers for libraries, for a compiler."
)
def adapters(*, as_json: bool, include: bool) -> int:
    """List the ways to reach a device under test, as --dut takes them."""
    from ecatspec.conformance import adapters as reachable
    from ecatspec.conformance.adapters.shared_library import HEADERS
    from ecatspec.conformance.render.tables import Sheet

    every = reachable.adapters()
    if as_json:
        listed = [
            {"name": name, "summary": entry.summary, "example": entry.example}
            for name, entry in every.items()
        ]
        print_json("ecatspec.adapters", {"include": str(HEADERS), "adapters": listed})
    elif include:
        print_text(f"{HEADERS}\n")
    else:
        rows = tuple((name, e.summary, f"--dut {e.example}") for name, e in every.items())
        title = "ways to reach a device under test"
        print_text(
            table_text(Sheet("adapters", title, ("adapter", "what it reaches", "example"), rows))
        )
    return CONFORMS
