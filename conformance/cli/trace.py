"""`ecatspec trace`: follow clauses to cases and the last run."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import click

from ecatspec.conformance.cli.console import (
    print_json,
    print_text,
    progress_bar,
    refuse,
    table_text,
    warn,
)
from ecatspec.conformance.cli.device_run import journal_opener, run_with_progress, set_up_errors
from ecatspec.conformance.cli.exit_status import CONFORMS, DOES_NOT_CONFORM
from ecatspec.conformance.cli.options import example

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ecatspec.conformance.results.run_history import Record
    from ecatspec.conformance.traceability.trace import Trace
    from ecatspec.spec.language.ir import Protocol


@click.command(epilog=example("trace"))
@click.argument("device", required=False)
@click.option("--missing", is_flag=True, help="Only what no violation is found of.")
@click.option("--measure", is_flag=True, help="Look for violations that cases find, and keep them.")
@click.option(
    "--evidence", metavar="FOLDER", help="Where they are kept, instead of the shipped ones."
)
@click.option("--json", "form", flag_value="json", help="Give the trace as JSON.")
@click.option("--csv", "form", flag_value="csv", help="Give the clauses as CSV.")
@click.option("--reqif", "form", flag_value="reqif", help="Give the clauses as ReqIF.")
def trace(
    *, device: str | None, missing: bool, measure: bool, evidence: str | None, form: str | None
) -> int:
    """Follow the clauses of DEVICE to their cases and the last run.

    Without DEVICE the totals of all devices that have a manual. A device of which no run is on
    record is run once as the virtual SubDevice of its text. A clause is carried if a violation of
    it is known that a case finds; --measure looks for one for each, tries those that are known
    first, and can be interrupted and called again.

    The exit status is 1 where such a case disproves what a text gives as the reason that nothing
    exercises a clause.
    """
    from pathlib import Path

    from ecatspec.conformance.base.devices import load
    from ecatspec.conformance.traceability.evidence import shipped
    from ecatspec.conformance.traceability.trace import (
        as_csv,
        clause_sheet,
        device_data,
        total_sheet,
    )
    from ecatspec.spec.language.load import device_names

    if form == "reqif":
        reqif = _reqif()
    loaded = [(name, load(name)) for name in ([device] if device else device_names())]
    folder = shipped() if evidence is None else Path(evidence)
    wanted = [(name, p) for name, p in loaded if device or p.manuals]
    if measure:
        for name, protocol in wanted:
            _measure(name, protocol, folder)
    traces = [_trace(name, p, folder) for name, p in wanted]
    shown = {id(t): t.missing if missing else t.rows for t in traces}
    if form == "json":
        data = [device_data(t, shown[id(t)]) for t in traces]
        print_json("ecatspec.trace", {"devices": data})
    elif form == "csv":
        print_text(as_csv((t, row) for t in traces for row in shown[id(t)]))
    elif form == "reqif":
        print_text(reqif(traces))
    else:
        sheets = [clause_sheet(t, shown[id(t)]) for t in traces if device or missing]
        print_text("".join(map(table_text, (*(s for s in sheets if s.rows), total_sheet(traces)))))
    disproved = [line for t in traces for line in t.disproved]
    for line in disproved:
        warn(f"ecatspec: {line}")
    return DOES_NOT_CONFORM if disproved else CONFORMS


def _measure(device: str, protocol: Protocol, folder: Path) -> None:
    """Look for evidence for each clause of a device, and keep it in a file of the folder."""
    from ecatspec.conformance.traceability.evidence import read, write
    from ecatspec.conformance.traceability.measure import measure
    from ecatspec.conformance.traceability.trace import trace_device
    from ecatspec.model.core.compilation import Model

    known = known_run(device, protocol)
    model = Model(protocol)
    traced = trace_device(model, known)
    with set_up_errors("trace"), progress_bar() as progress:
        folder.mkdir(parents=True, exist_ok=True)
        found = read(folder, protocol.name)
        keep = partial(write, folder, protocol.name)
        keep(measure(traced, model, known, found, keep, progress))


def _trace(device: str, protocol: Protocol, folder: Path) -> Trace:
    """Trace a device by the last run that is on record, or by one that is made now."""
    from ecatspec.conformance.traceability.evidence import read
    from ecatspec.conformance.traceability.trace import trace_device
    from ecatspec.model.core.compilation import Model

    known = known_run(device, protocol)
    with set_up_errors("trace"):
        return trace_device(Model(protocol), known, read(folder, protocol.name))


def known_run(device: str, protocol: Protocol) -> Record:
    """Give the last run of a device that is on record, or one that is made now."""
    from ecatspec.conformance.results import run_history

    known = run_history.load(protocol)
    if known is None:
        said = f"no run of {protocol.name} is on record: its quick suite runs now, on the model"
        warn(f"ecatspec: {said}")
        options = {"depth": "quick", "keep": journal_opener(None)}
        result = run_with_progress(device, "model", options)
        known = run_history.record_of(result.subject, result.verdicts)
    return known


def _reqif() -> Callable[[Sequence[Trace]], str]:
    """Give the export, which needs a package that is not always there."""
    from datetime import UTC, datetime

    try:
        from ecatspec.conformance.traceability.requirements import reqif
    except ModuleNotFoundError as error:
        refuse(f"ReqIF needs the package {error.name}; install ecatspec[reqif]")
    return lambda traces: reqif(traces, datetime.now(UTC))
