"""`ecatspec monitor`: judge a capture."""

from __future__ import annotations

from typing import Any

import click

from ecatspec.conformance.cli.console import progress_bar, refuse, warn
from ecatspec.conformance.cli.options import example
from ecatspec.conformance.cli.report_output import print_report, report_files, report_options


@click.command(epilog=example("monitor"))
@click.argument("file")
@click.option("--device", default="standard", show_default=True, help="Name or path of a text.")
@report_options
def monitor(*, file: str, device: str, **reports: Any) -> int:  # noqa: ANN401  as for run
    """Judge FILE, a capture (pcap or pcapng) of real traffic.

    There is one report for each SubDevice.
    """
    from pathlib import Path

    from ecatspec.conformance.base.devices import load
    from ecatspec.conformance.capture.transactions import CaptureError

    protocol = load(device)
    if "\0" in file:
        refuse(f"{file!a} is no path; give the path of a pcap or pcapng file")
    from ecatspec.conformance.capture.monitor import monitor_file

    try:
        with report_files(reports) as write:
            with progress_bar() as progress:
                results = monitor_file(Path(file), device, progress)
            write(results, protocol)
    except CaptureError as error:
        refuse(str(error))
    # A capture that breaks off was judged as far as it goes; its note starts with its path.
    for note in dict.fromkeys(note for result in results for note in result.notes):
        if note.startswith(f"{Path(file)}"):
            warn(f"ecatspec: warning: {note}")
    return print_report(results, protocol, reports)
