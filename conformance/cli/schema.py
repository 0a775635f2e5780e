"""`ecatspec schema`: give JSON Schemas."""

from __future__ import annotations

import json

import click

from ecatspec.conformance.cli.console import print_text
from ecatspec.conformance.cli.exit_status import CONFORMS
from ecatspec.conformance.cli.options import example


@click.command(epilog=example("schema"))
@click.argument("of", type=click.Choice(("report", "vectors")))
def schema(*, of: str) -> int:
    """Give the JSON Schema of reports, or of test vectors."""
    if of == "report":
        from ecatspec.conformance.reports.json_report import json_schema
    else:
        from ecatspec.generators.vectors.schema import json_schema

    print_text(json.dumps(json_schema(), indent=2, sort_keys=True) + "\n")
    return CONFORMS
