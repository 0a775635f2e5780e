"""`ecatspec diff`: compare two devices."""

from __future__ import annotations

import click

from ecatspec.conformance.cli.console import print_json, print_text, refuse, table_text, warn
from ecatspec.conformance.cli.exit_status import CONFORMS, DOES_NOT_CONFORM
from ecatspec.conformance.cli.options import example


@click.command(epilog=example("diff"))
@click.argument("first", metavar="A")
@click.argument("second", required=False, metavar="[B]")
@click.option("--section", "sections", multiple=True, metavar="NAME", help="Only this section.")
@click.option("--verify", is_flag=True, help="Replay each witness on both virtual SubDevices.")
@click.option("--export", "vectors", metavar="FILE", help="Write the witnesses as test vectors.")
@click.option("--html", "page", metavar="FILE", help="Write one page with diagrams.")
@click.option("--json", "form", flag_value="json", help="Give the comparison as JSON.")
@click.option("--markdown", "form", flag_value="markdown", help="Give it as Markdown.")
@click.option("--dut", "duts", multiple=True, help="Twice: compare two devices by the suite of A.")
def diff(
    *,
    first: str,
    second: str | None,
    sections: tuple[str, ...],
    verify: bool,
    vectors: str | None,
    page: str | None,
    form: str | None,
    duts: tuple[str, ...],
) -> int:
    """Tell what A and B do differently.

    Each difference comes with its shortest witness.
    A and B are devices, `standard`, texts, or texts of a git revision (FILE@REVISION). With --dut X
    --dut Y both devices get the stimuli of the suite of A, and only differences are told.
    """
    from ecatspec.conformance.diff import command

    wanted = command.Wanted(sections, form, vectors, page, verify=verify)
    if duts:
        text = command.devices(first, second, duts, wanted)
    elif second is None:
        refuse("two are compared; give a second one: ecatspec diff A B")
    else:
        text = command.texts(first, second, wanted)
    if form == "json":
        print_json("ecatspec.diff", text.data)
    else:
        print_text(text.words + "".join(map(table_text, text.sheets)))
    for failure in text.failures:
        warn(f"ecatspec: not as stated: {failure}")
    return DOES_NOT_CONFORM if text.differs or text.failures else CONFORMS
