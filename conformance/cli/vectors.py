"""`ecatspec vectors`: look after files of test vectors."""

from __future__ import annotations

import click

from ecatspec.conformance.cli.console import plain, print_text, progress_bar
from ecatspec.conformance.cli.exit_status import CONFORMS, DOES_NOT_CONFORM
from ecatspec.conformance.cli.options import example


@click.group(epilog=example("vectors"))
def vectors() -> None:
    """Look after files of test vectors."""


@vectors.command(epilog="Example: ecatspec vectors lint vectors.json")
@click.argument("file")
def lint(*, file: str) -> int:
    """Check FILE: that all its parts fit together, and that `export` would write it so.

    Exit status: 0 nothing is wrong, 1 something is, 2 it cannot be read.
    """
    from pathlib import Path

    from ecatspec.conformance.vectors.lint import lint as check_file

    with progress_bar() as progress:
        found = check_file(Path(file), progress)
    print_text("".join(f"{plain(line)}\n" for line in found.lines))
    if found.count > len(found.lines):
        print_text(f"{found.name}: {found.count - len(found.lines)} more\n")
    return DOES_NOT_CONFORM if found.count else CONFORMS
