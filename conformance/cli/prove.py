"""`ecatspec prove`: prove a text whole and free of contradictions."""

from __future__ import annotations

import click

from ecatspec.conformance.cli.console import (
    print_json,
    print_text,
    progress_bar,
    refuse,
    table_text,
)
from ecatspec.conformance.cli.exit_status import CONFORMS, DOES_NOT_CONFORM
from ecatspec.conformance.cli.options import example


@click.command(epilog=example("prove"))
@click.argument("device", required=False)
@click.option("--json", "as_json", is_flag=True, help="Give the proofs as JSON.")
def prove(*, device: str | None, as_json: bool) -> int:
    """Prove the text of DEVICE whole, and free of contradictions.

    No two rules for one input, a rule for every input, properties that hold, states that are
    reached. Without DEVICE the standard and all devices.
    """
    from ecatspec.conformance import prove as proofs
    from ecatspec.conformance.base.devices import load
    from ecatspec.spec.language.ir import STANDARD
    from ecatspec.spec.language.load import device_names

    protocols = {name: load(name) for name in ([device] if device else [STANDARD, *device_names()])}
    try:
        with progress_bar() as progress:
            done = list(proofs.prove_all(protocols, progress))
    except ModuleNotFoundError as error:
        if error.name != "z3":
            raise
        refuse("proofs need the package z3-solver; install ecatspec[prove]")
    for found in done:
        if not as_json:
            lines = "".join(f"{line}\n" for line in proofs.details(found))
            print_text(table_text(proofs.proof_sheet(found)) + (lines and f"\n{lines}"))
    if as_json:
        print_json("ecatspec.prove", {"devices": proofs.as_data(done)})
    return DOES_NOT_CONFORM if any(found.refuted for found in done) else CONFORMS
