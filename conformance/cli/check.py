"""`ecatspec check`: check texts."""

from __future__ import annotations

import click

from ecatspec.conformance.cli.console import print_text, warn
from ecatspec.conformance.cli.exit_status import CONFORMS, WRONG_INPUT
from ecatspec.conformance.cli.options import example
from ecatspec.spec.language.diagnostics import SpecError


@click.command(epilog=example("check"))
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--json", "form", flag_value="json", help="Give the diagnostics as JSON.")
@click.option("--sarif", "form", flag_value="sarif", help="Give them as SARIF 2.1.0.")
@click.option("--github", "form", flag_value="github", help="Give them as annotations of GitHub.")
def check(*, files: tuple[str, ...], form: str | None) -> int:
    """Check texts, and say what is wrong with them.

    A line for each fault: file:line:column: ECSnnn what is wrong; what to do.
    """
    from ecatspec.conformance.base.devices import UserError, load
    from ecatspec.conformance.render.diagnostic_formats import CHECKS, Checked

    checked = []
    for file in files:
        try:
            protocol = load(file)
        except SpecError as error:
            checked.append(Checked(file, error.diagnostics))
        except UserError as error:
            checked.append(Checked(file, error=str(error)))
            warn(f"ecatspec: {error}")
        else:
            rules = sum(len(machine.rules) for machine in protocol.machines.values())
            checked.append(Checked(file, clauses=len(protocol.clauses), rules=rules))
    print_text(CHECKS[form or "text"](checked))
    return CONFORMS if all(each.sound for each in checked) else WRONG_INPUT
