"""`ecatspec simulate`: answer a MainDevice on a network interface."""

from __future__ import annotations

import click

from ecatspec.conformance.cli.console import progress_bar, warn
from ecatspec.conformance.cli.device_run import set_up_errors
from ecatspec.conformance.cli.exit_status import CONFORMS
from ecatspec.conformance.cli.options import MAILBOX, example


@click.command(epilog=example("simulate"))
@click.argument("device")
@click.option("--iface", required=True, metavar="NAME", help="The network interface to answer on.")
@click.option("--fault", metavar="NAME", help="Plant this fault: ecatspec show DEVICE faults.")
@MAILBOX
@click.option(
    "--count",
    type=click.IntRange(1, 64),
    default=1,
    show_default=True,
    help="Number of SubDevices in line.",
)
@click.option(
    "--virtual-time",
    is_flag=True,
    help="Time stands still until it is commanded: for --dut eth:IFACE,time=virtual.",
)
def simulate(
    *,
    device: str,
    iface: str,
    fault: str | None,
    mailbox: str,
    count: int,
    virtual_time: bool,
) -> int:
    """Answer a MainDevice as DEVICE, on a network interface (Linux).

    It needs the right CAP_NET_RAW. SIGHUP is a power cycle; Ctrl-C or SIGTERM ends it, with exit
    status 0.
    """
    from ecatspec.conformance.simulate import Segment

    with (
        set_up_errors("simulate"),
        Segment(
            device, iface, fault=fault, mailbox=mailbox, count=count, virtual_time=virtual_time
        ) as segment,
    ):
        said = f"ecatspec: {segment.name} answers on {iface}; Ctrl-C ends it"
        with progress_bar() as progress:
            segment.serve(progress, lambda: warn(said))
    return CONFORMS
