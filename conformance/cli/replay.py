"""`ecatspec replay`: play test vectors on a device."""

from __future__ import annotations

from typing import Any

import click

from ecatspec.conformance.cli.console import progress_bar
from ecatspec.conformance.cli.device_run import set_up_errors
from ecatspec.conformance.cli.options import DUT, HANG_TIMEOUT, example
from ecatspec.conformance.cli.report_output import print_report, report_files, report_options


@click.command(epilog=example("replay"))
@click.argument("file")
@DUT
@report_options
@HANG_TIMEOUT
def replay(*, file: str, dut: str, hang_timeout: float, **reports: Any) -> int:  # noqa: ANN401
    """Play the test vectors of FILE on a device.

    FILE was made by `export --format json`. The verdicts are those of `run`. The device under test
    is named as there.
    """
    from pathlib import Path

    from ecatspec.conformance.vectors.command import replay as play

    with report_files(reports) as write:
        with set_up_errors("replay"), progress_bar() as progress:
            result, protocol = play(Path(file), dut, hang_timeout=hang_timeout, progress=progress)
        write((result,), protocol)
    return print_report((result,), protocol, reports)
