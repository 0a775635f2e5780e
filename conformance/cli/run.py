"""`ecatspec run`: test an implementation."""

from __future__ import annotations

from typing import Any

import click

from ecatspec.conformance.cli.console import draft_file, refuse
from ecatspec.conformance.cli.device_run import journal_opener, run_with_progress, set_up_errors
from ecatspec.conformance.cli.options import (
    DUT,
    HANG_TIMEOUT,
    MAILBOX,
    MOST_WORKERS,
    SEED,
    example,
    layers,
)
from ecatspec.conformance.cli.report_output import print_report, report_files, report_options
from ecatspec.generators.cases.depths import DEPTHS


@click.command(epilog=example("run"))
@click.argument("device")
@DUT
@report_options
@click.option(
    "--depth",
    type=click.Choice(DEPTHS),
    default="default",
    show_default=True,
    help="quick: one entry of each kind. exhaustive: complete suites for one state more, and all.",
)
@SEED
@MAILBOX
@click.option("--only", default="", metavar="LAYER,...", help="Only the cases of these layers.")
@click.option("--replay", default="", metavar="CASE", help="Run only this case: a name or a token.")
@click.option(
    "--known", default="", metavar="FILE", help="Go on past the deviations that FILE accepts."
)
@click.option("--write-known", metavar="FILE", help="Draft such a file from what is found.")
@click.option(
    "--choice",
    "choices",
    multiple=True,
    metavar="NAME=WAY",
    help="The device goes this way: nothing needs to show it. May be given again.",
)
@click.option("--results", metavar="FILE", help="Keep the run here, not in the user's folder.")
@click.option(
    "--resume", is_flag=True, help="Go on with the run that is in FILE, or with the last."
)
@click.option(
    "--workers",
    type=click.IntRange(1, MOST_WORKERS),
    default=1,
    show_default=True,
    help="Processes that share the cases, each with a device of its own.",
)
@click.option("--cluster", default="", metavar="ADDRESS", help="Share the cases by a dask cluster.")
@HANG_TIMEOUT
def run(
    *,
    device: str,
    dut: str,
    depth: str,
    seed: int,
    mailbox: str,
    only: str,
    replay: str,
    known: str,
    write_known: str | None,
    choices: tuple[str, ...],
    results: str | None,
    resume: bool,
    workers: int,
    cluster: str,
    hang_timeout: float,
    **reports: Any,  # noqa: ANN401  the options of `report_options`
) -> int:
    """Test an implementation against the text of DEVICE.

    DEVICE is a name, or a path to a .ecs file.

    The device under test is the virtual SubDevice of the text (--dut model), a shared library
    (--dut lib:PATH), a program (--dut "exec:COMMAND ARGUMENTS"), or what else `ecatspec adapters`
    lists.
    """
    from ecatspec.conformance.base.devices import load
    from ecatspec.conformance.results import known_deviations

    if replay and (results is not None or resume):
        refuse("one case is no run that could be kept or resumed; leave out --replay")
    protocol = load(device, mailbox)
    accepted = known_deviations.of(known, protocol.name)
    options = {
        "depth": depth,
        "seed": seed,
        "mailbox": mailbox,
        "only": layers(only),
        "replay": replay,
        "known": accepted,
        "choices": choices,
        "hang_timeout": hang_timeout,
    }
    if not replay:
        options["keep"] = journal_opener(results, resume=resume)
    alone = workers == 1 and not cluster
    if not alone and (replay or (workers > 1 and cluster)):
        refuse("--workers, --cluster and --replay exclude each other; give one of them")
    with report_files(reports) as write, draft_file(write_known) as drafted:
        if alone:
            result = run_with_progress(device, dut, options)
        else:
            from ecatspec.conformance.run.campaign import Job, crew

            job = Job(
                device, protocol.digest, dut, mailbox, hang_timeout, choices, accepted.reasons
            )
            with set_up_errors("run"), crew(job, workers, cluster) as hands:
                result = run_with_progress(device, dut, {**options, "crew": hands})
        write((result,), protocol)
        drafted(known_deviations.draft(protocol.name, (result,), accepted))
    return print_report((result,), protocol, reports)
