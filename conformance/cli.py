"""The command line: commands, exit statuses, and the wording of errors.

Status 0: conforms. 1: does not, or was not shown to. 2: the input or the set-up is wrong, nothing
was judged. 130: stopped by Ctrl-C. What is judged goes to stdout, all else to stderr.
"""

from __future__ import annotations

import json
import math
import os
import sys
import traceback
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from io import TextIOWrapper
from typing import IO, TYPE_CHECKING, Any, Final, NoReturn

import click

from ecatspec.conformance.base.version import version
from ecatspec.generators.cases.depths import DEPTHS
from ecatspec.generators.formats import FORMATS
from ecatspec.spec.language.diagnostics import SpecError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ecatspec.conformance.base.verdict import Result
    from ecatspec.conformance.render.tables import Sheet
    from ecatspec.conformance.results.run_file import Basis, Journal
    from ecatspec.conformance.results.run_history import Record
    from ecatspec.conformance.traceability.trace import Trace
    from ecatspec.spec.language.ir import Protocol

    Progress = Callable[[int, int, str], None]

CONFORMS: Final = 0
DOES_NOT_CONFORM: Final = 1
WRONG_INPUT: Final = 2
INTERRUPTED: Final = 130

_MOST_WORKERS: Final = 256
_PIPE_WIDTH: Final = 120
_CLOSED: Final = "there is no standard output; leave it open or redirect it to a file"
"""What is said to a caller who closed it."""
_CHAPTER: Final = "markdown"
"""The form of `show` that is no drawing."""

EXAMPLES: Final = {
    "run": "ecatspec run kollmorgen-akd --dut canopen",
    "compare": "ecatspec compare previous last",
    "monitor": "ecatspec monitor capture.pcapng --device kollmorgen-akd",
    "check": "ecatspec check spec/devices/kollmorgen-akd.ecs",
    "show": "ecatspec show kollmorgen-akd al",
    "trace": "ecatspec trace kollmorgen-akd --missing",
    "prove": "ecatspec prove kollmorgen-akd",
    "mutate": "ecatspec mutate kollmorgen-akd --own",
    "diff": "ecatspec diff kollmorgen-akd kollmorgen-s300",
    "export": "ecatspec export kollmorgen-akd --format c -o vectors.h",
    "replay": "ecatspec replay vectors.json --dut canopen",
    "adapters": "ecatspec adapters --include",
    "vectors": "ecatspec vectors lint vectors.json",
    "schema": "ecatspec schema report",
    "simulate": "ecatspec simulate kollmorgen-akd --iface veth1",
}

_HELP: Final = """Test EtherCAT SubDevices (slaves) against an executable specification.

Exit status: 0 conforms, 1 does not conform or not shown, 2 the input or the set-up is wrong.

\b
Examples:
""" + "\n".join(f"  {example}" for example in EXAMPLES.values())


def _example(command: str) -> str:
    return f"Example: {EXAMPLES[command]}"


def _show_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:  # noqa: FBT001
    if wanted and not context.resilient_parsing:
        _print(f"ecatspec {version()}\n")
        context.exit()


def _seconds(context: click.Context, parameter: click.Parameter, value: float | None) -> float:
    from ecatspec.conformance.adapters import HANG_TIMEOUT

    if value is None:
        return HANG_TIMEOUT
    if not (math.isfinite(value) and value > 0):
        message = f"{value} is no number of seconds above 0"
        raise click.BadParameter(message, context, parameter)
    return value


@click.group(
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    help=_HELP,
)
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_show_version,
    help="Show the version and exit.",
)
@click.pass_context
def cli(context: click.Context) -> int:
    """Every command, and what comes before them all."""
    if context.invoked_subcommand is None:
        _print(context.get_help() + "\n")
        return WRONG_INPUT
    return CONFORMS


_FILES: Final = {
    "html": "Write one page for people, which needs nothing else.",
    "junit": "Write JUnit XML for build servers, one test for each clause.",
    "sarif": "Write SARIF 2.1.0 for code scanning, one result for each finding.",
}
"""Reports that are written to a file, and the help of their options."""


def _reports(command: Callable[..., int]) -> Callable[..., int]:
    """Add the options of all reports to a command."""
    options = (
        click.option("--json", "as_json", is_flag=True, help="Give the report as JSON."),
        *(click.option(f"--{form}", metavar="FILE", help=said) for form, said in _FILES.items()),
        click.option("--github", is_flag=True, help="Give findings as annotations of GitHub too."),
    )
    for option in reversed(options):
        command = option(command)
    return command


_DUT: Final = click.option(
    "--dut", default="model", show_default=True, help="How to reach the device."
)
_SEED: Final = click.option(
    "--seed", type=int, default=0, show_default=True, help="Seed of the random part."
)
_MAILBOX: Final = click.option(
    "--mailbox", default="", metavar="SIZE", help="Bytes of both mailboxes, or OUT:IN."
)
_HANG_TIMEOUT: Final = click.option(
    "--hang-timeout",
    type=float,
    callback=_seconds,
    metavar="SECONDS",
    help="Without an answer for so long the device counts as hung.",
)
"""Options that several commands have."""


@cli.command(epilog=_example("run"))
@click.argument("device")
@_DUT
@_reports
@click.option(
    "--depth",
    type=click.Choice(DEPTHS),
    default="default",
    show_default=True,
    help="quick: one entry of each kind. exhaustive: complete suites for one state more, and all.",
)
@_SEED
@_MAILBOX
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
    type=click.IntRange(1, _MOST_WORKERS),
    default=1,
    show_default=True,
    help="Processes that share the cases, each with a device of its own.",
)
@click.option("--cluster", default="", metavar="ADDRESS", help="Share the cases by a dask cluster.")
@_HANG_TIMEOUT
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
    **reports: Any,  # noqa: ANN401  the options of `_reports`
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
        _refuse("one case is no run that could be kept or resumed; leave out --replay")
    protocol = load(device, mailbox)
    accepted = known_deviations.of(known, protocol.name)
    options = {
        "depth": depth,
        "seed": seed,
        "mailbox": mailbox,
        "only": _layers(only),
        "replay": replay,
        "known": accepted,
        "choices": choices,
        "hang_timeout": hang_timeout,
    }
    if not replay:
        options["keep"] = _keeper(results, resume=resume)
    alone = workers == 1 and not cluster
    if not alone and (replay or (workers > 1 and cluster)):
        _refuse("--workers, --cluster and --replay exclude each other; give one of them")
    with _written(reports) as write, _drafted(write_known) as drafted:
        if alone:
            result = _run(device, dut, options)
        else:
            from ecatspec.conformance.run.campaign import Job, crew

            job = Job(
                device, protocol.digest, dut, mailbox, hang_timeout, choices, accepted.reasons
            )
            with _set_up("run"), crew(job, workers, cluster) as hands:
                result = _run(device, dut, {**options, "crew": hands})
        write((result,), protocol)
        drafted(known_deviations.draft(protocol.name, (result,), accepted))
    return _report((result,), protocol, reports)


@cli.command(epilog=_example("adapters"))
@click.option("--json", "as_json", is_flag=True, help="Give the list as JSON.")
@click.option(
    "--include", is_flag=True, help="Give the folder of the headers for libraries, for a compiler."
)
def adapters(*, as_json: bool, include: bool) -> int:
    """List the ways to reach a device under test, as --dut takes them."""
    from ecatspec.conformance import adapters as reachable
    from ecatspec.conformance.adapters.shared_library import HEADERS
    from ecatspec.conformance.render.tables import Sheet

    every = reachable.adapters()
    if as_json:
        listed = [
            {"name": name, "summary": entry.summary, "example": entry.example}
            for name, entry in every.items()
        ]
        _print_json("ecatspec.adapters", {"include": str(HEADERS), "adapters": listed})
    elif include:
        _print(f"{HEADERS}\n")
    else:
        rows = tuple((name, e.summary, f"--dut {e.example}") for name, e in every.items())
        title = "ways to reach a device under test"
        _print(_table(Sheet("adapters", title, ("adapter", "what it reaches", "example"), rows)))
    return CONFORMS


@cli.command(epilog=_example("compare"))
@click.argument("first", metavar="RUN1")
@click.argument("second", metavar="RUN2")
@click.option("--json", "as_json", is_flag=True, help="Give the comparison as JSON.")
def compare(*, first: str, second: str, as_json: bool) -> int:
    """Tell what became better or worse from RUN1 to RUN2.

    It goes by case, finding, clause and choice. Both are results files (`run --results FILE`), or
    `last` and `previous`: the newest run of this user, and the one before of the same device. A run
    that goes on counts as far as it is. Exit status: 0 nothing is worse, 1 something is.
    """
    from ecatspec.conformance.results import compare as comparing
    from ecatspec.conformance.results import run_file, run_history

    runs = [run_file.read(run_history.named(name)) for name in (first, second)]
    found = comparing.compare(*runs)
    if as_json:
        _print_json("ecatspec.compare", comparing.as_data(found))
    else:
        lines = (comparing.headline(found), *(f"note: {note}" for note in found.notes()))
        _print("".join(f"{line}\n" for line in lines))
        _print("".join(map(_table, comparing.sheets(found))))
    return DOES_NOT_CONFORM if found.worse else CONFORMS


@cli.command(epilog=_example("monitor"))
@click.argument("file")
@click.option("--device", default="standard", show_default=True, help="Name or path of a text.")
@_reports
def monitor(*, file: str, device: str, **reports: Any) -> int:  # noqa: ANN401  as for run
    """Judge FILE, a capture (pcap or pcapng) of real traffic.

    There is one report for each SubDevice.
    """
    from pathlib import Path

    from ecatspec.conformance.base.devices import load
    from ecatspec.conformance.capture.transactions import CaptureError

    protocol = load(device)
    if "\0" in file:
        _refuse(f"{file!a} is no path; give the path of a pcap or pcapng file")
    from ecatspec.conformance.capture.monitor import monitor_file

    try:
        with _written(reports) as write:
            with _progress() as progress:
                results = monitor_file(Path(file), device, progress)
            write(results, protocol)
    except CaptureError as error:
        _refuse(str(error))
    # A capture that breaks off was judged as far as it goes; its note starts with its path.
    for note in dict.fromkeys(note for result in results for note in result.notes):
        if note.startswith(f"{Path(file)}"):
            _warn(f"ecatspec: warning: {note}")
    return _report(results, protocol, reports)


@cli.command(epilog=_example("check"))
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
            _warn(f"ecatspec: {error}")
        else:
            rules = sum(len(machine.rules) for machine in protocol.machines.values())
            checked.append(Checked(file, clauses=len(protocol.clauses), rules=rules))
    _print(CHECKS[form or "text"](checked))
    return CONFORMS if all(each.sound for each in checked) else WRONG_INPUT


@cli.command(epilog=_example("show"))
@click.argument("device")
@click.argument("machine", required=False)
@click.option("--json", "as_json", is_flag=True, help="Give the tables as JSON.")
@click.option(
    "--format",
    "form",
    metavar="svg|mermaid|dot|markdown",
    help="Draw the MACHINE instead of its tables, or give the chapter of DEVICE (markdown).",
)
def show(*, device: str, machine: str | None, as_json: bool, form: str | None) -> int:
    """Show DEVICE as tables, or the rules of one MACHINE.

    DEVICE is a name, or a path to a .ecs file.
    `ecatspec show DEVICE faults` lists the faults that can be planted into its virtual SubDevice.
    """
    from ecatspec.conformance.base.devices import load
    from ecatspec.conformance.describe.text_tables import fault_sheet, machine_sheets, sheets

    if form is not None:
        return _drawn(device, machine, form, as_json=as_json)
    protocol = load(device)
    if machine == "faults":
        tables: tuple[Sheet, ...] = (fault_sheet(),)
    else:
        tables = sheets(protocol) if machine is None else machine_sheets(protocol, machine)
    if as_json:
        data: dict[str, object] = {
            "device": protocol.name,
            "wording": protocol.wording,
            "digest": protocol.digest,
            "tables": [
                {
                    "name": table.name,
                    "title": table.title,
                    "rows": [dict(zip(table.columns, row, strict=True)) for row in table.rows],
                }
                for table in tables
            ],
        }
        _print_json("ecatspec.show", data)
        return CONFORMS
    _print(f"{protocol.name}: {protocol.wording}\n" + "".join(map(_table, tables)))
    return CONFORMS


@cli.command(epilog=_example("trace"))
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
        _print_json("ecatspec.trace", {"devices": data})
    elif form == "csv":
        _print(as_csv((t, row) for t in traces for row in shown[id(t)]))
    elif form == "reqif":
        _print(reqif(traces))
    else:
        sheets = [clause_sheet(t, shown[id(t)]) for t in traces if device or missing]
        _print("".join(map(_table, (*(s for s in sheets if s.rows), total_sheet(traces)))))
    disproved = [line for t in traces for line in t.disproved]
    for line in disproved:
        _warn(f"ecatspec: {line}")
    return DOES_NOT_CONFORM if disproved else CONFORMS


def _measure(device: str, protocol: Protocol, folder: Path) -> None:
    """Look for evidence for each clause of a device, and keep it in a file of the folder."""
    from ecatspec.conformance.traceability.evidence import read, write
    from ecatspec.conformance.traceability.measure import measure
    from ecatspec.conformance.traceability.trace import trace_device
    from ecatspec.model.core.compilation import Model

    known = _known(device, protocol)
    model = Model(protocol)
    traced = trace_device(model, known)
    with _set_up("trace"), _progress() as progress:
        folder.mkdir(parents=True, exist_ok=True)
        found = read(folder, protocol.name)
        keep = partial(write, folder, protocol.name)
        keep(measure(traced, model, known, found, keep, progress))


def _trace(device: str, protocol: Protocol, folder: Path) -> Trace:
    """Trace a device by the last run that is on record, or by one that is made now."""
    from ecatspec.conformance.traceability.evidence import read
    from ecatspec.conformance.traceability.trace import trace_device
    from ecatspec.model.core.compilation import Model

    known = _known(device, protocol)
    with _set_up("trace"):
        return trace_device(Model(protocol), known, read(folder, protocol.name))


def _known(device: str, protocol: Protocol) -> Record:
    """Give the last run of a device that is on record, or one that is made now."""
    from ecatspec.conformance.results import run_history

    known = run_history.load(protocol)
    if known is None:
        said = f"no run of {protocol.name} is on record: its quick suite runs now, on the model"
        _warn(f"ecatspec: {said}")
        options = {"depth": "quick", "keep": _keeper(None)}
        result = _run(device, "model", options)
        known = run_history.record_of(result.subject, result.verdicts)
    return known


def _run(device: str, dut: str, options: Mapping[str, Any]) -> Result:
    from ecatspec.conformance.run.runner import run_device

    with _set_up("run"), _progress() as progress:
        return run_device(device, dut, progress=progress, **options)


def _keeper(path: str | None, *, resume: bool = False) -> Callable[[Basis], Journal | None]:
    """Give what opens the journal of a run: in a file, or among the runs of this user."""
    from pathlib import Path

    from ecatspec.conformance.base.devices import UserError
    from ecatspec.conformance.results import run_file, run_history

    def keep(basis: Basis) -> Journal | None:
        if path is not None:
            return run_file.begin(Path(path), basis, resume=resume)
        try:
            return run_history.begin(basis, resume=resume)
        except (OSError, UserError) as error:
            if resume:
                raise
            why = getattr(error, "strerror", None) or error
            _warn(
                f"ecatspec: warning: no record of the run is kept in {run_history.folder()} ({why})"
            )
            return None

    return keep


def _reqif() -> Callable[[Sequence[Trace]], str]:
    """Give the export, which needs a package that is not always there."""
    from datetime import UTC, datetime

    try:
        from ecatspec.conformance.traceability.requirements import reqif
    except ModuleNotFoundError as error:
        _refuse(f"ReqIF needs the package {error.name}; install ecatspec[reqif]")
    return lambda traces: reqif(traces, datetime.now(UTC))


@cli.command(epilog=_example("prove"))
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
        with _progress() as progress:
            done = list(proofs.prove_all(protocols, progress))
    except ModuleNotFoundError as error:
        if error.name != "z3":
            raise
        _refuse("proofs need the package z3-solver; install ecatspec[prove]")
    for found in done:
        if not as_json:
            lines = "".join(f"{line}\n" for line in proofs.details(found))
            _print(_table(proofs.proof_sheet(found)) + (lines and f"\n{lines}"))
    if as_json:
        _print_json("ecatspec.prove", {"devices": proofs.as_data(done)})
    return DOES_NOT_CONFORM if any(found.refuted for found in done) else CONFORMS


@cli.command(epilog=_example("mutate"))
@click.argument("device")
@click.option("--own", is_flag=True, help="Only rules that the text of DEVICE brings itself.")
@click.option(
    "--only", default="", metavar="WORDS", help="Only mistakes that are described with these words."
)
@click.option(
    "--depth", type=click.Choice(DEPTHS), default="default", show_default=True, help="As for run."
)
@click.option("--workers", type=click.IntRange(1), help="Processes; all processors without it.")
@click.option(
    "--at-least",
    type=click.FloatRange(0, 100),
    default=98.0,
    show_default=True,
    metavar="PERCENT",
    help="A lower score gives exit status 1.",
)
@click.option("--json", "as_json", is_flag=True, help="Give the analysis as JSON.")
def mutate(
    *,
    device: str,
    own: bool,
    only: str,
    depth: str,
    workers: int | None,
    at_least: float,
    as_json: bool,
) -> int:
    """Measure the suite of DEVICE by the mistakes that it finds.

    Every rule of the texts is made wrong in one point after the other, the virtual SubDevice of
    the wrong text is run, and what no case notices is listed. It takes minutes.
    """
    from ecatspec.conformance.mutation.kill_analysis import analyse

    with _progress() as progress:
        found = analyse(
            device,
            own=own,
            only=only,
            depth=depth,
            workers=workers or os.cpu_count() or 1,
            progress=progress,
        )
    if as_json:
        _print_json("ecatspec.mutate", found.to_json())
    else:
        _print("\n".join(_table(sheet) for sheet in found.sheets()))
        _print("".join(f"not noticed: {line}\n" for line in found.survivors()))
    whole = all(table.kills.score == 1 for table in found.tables)
    return CONFORMS if whole and found.score() * 100 >= at_least else DOES_NOT_CONFORM


@cli.command(epilog=_example("diff"))
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
        _refuse("two are compared; give a second one: ecatspec diff A B")
    else:
        text = command.texts(first, second, wanted)
    if form == "json":
        _print_json("ecatspec.diff", text.data)
    else:
        _print(text.words + "".join(map(_table, text.sheets)))
    for failure in text.failures:
        _warn(f"ecatspec: not as stated: {failure}")
    return DOES_NOT_CONFORM if text.differs or text.failures else CONFORMS


@cli.command(epilog=_example("export"))
@click.argument("device")
@click.option(
    "--format",
    "form",
    type=click.Choice(tuple(FORMATS)),
    required=True,
    help="; ".join(f"{name}: {each.summary}" for name, each in FORMATS.items()) + ".",
)
@click.option("-o", "--output", metavar="FILE", help="Write here instead of standard output.")
@click.option(
    "--depth",
    type=click.Choice(DEPTHS),
    default="default",
    show_default=True,
    help="As for run.",
)
@click.option("--only", default="", metavar="LAYER,...", help="Only the tests of these layers.")
@click.option(
    "--choice",
    "choices",
    multiple=True,
    metavar="NAME=WAY",
    help="The device goes this way where its text leaves a choice open, or meets a condition.",
)
@_MAILBOX
@_SEED
def export(
    *,
    device: str,
    form: str,
    output: str | None,
    depth: str,
    only: str,
    choices: tuple[str, ...],
    mailbox: str,
    seed: int,
) -> int:
    """Write the tests of DEVICE as test vectors.

    DEVICE is a name, or a path to a .ecs file.
    Who has no ecatspec can play them: a firmware test in C, another language, a person. The same
    call gives the same bytes.
    """
    from ecatspec.conformance.vectors.export import Wanted
    from ecatspec.conformance.vectors.export import export as write

    wanted = Wanted(device, depth, _layers(only), mailbox, seed, dict(map(_way, choices)))
    with _set_up("export"), _output(output, text=FORMATS[form].text) as out:
        with _progress() as progress:
            made = write(wanted, form, out, progress)
        out.flush()
        said = f"{made.number} tests"
        if made.restless:
            cases = f"{len(made.restless)} cases ({', '.join(made.restless)})"
            said += f"; the virtual SubDevice does not come to rest in {cases}, which have no test"
        if made.cut:
            said += f"; {len(made.cut)} end where more may have happened than can be followed"
        _warn(f"ecatspec: {said}")
    return CONFORMS


def _layers(words: str) -> tuple[str, ...]:
    return tuple(filter(None, words.split(",")))


def _way(choice: str) -> tuple[str, str]:
    name, equals, way = choice.partition("=")
    if not (name and equals and way):
        _refuse(f"--choice {choice!r} names no way; write --choice NAME=WAY")
    return name, way


@cli.command(epilog=_example("replay"))
@click.argument("file")
@_DUT
@_reports
@_HANG_TIMEOUT
def replay(*, file: str, dut: str, hang_timeout: float, **reports: Any) -> int:  # noqa: ANN401
    """Play the test vectors of FILE on a device.

    FILE was made by `export --format json`. The verdicts are those of `run`. The device under test
    is named as there.
    """
    from pathlib import Path

    from ecatspec.conformance.vectors.command import replay as play

    with _written(reports) as write:
        with _set_up("replay"), _progress() as progress:
            result, protocol = play(Path(file), dut, hang_timeout=hang_timeout, progress=progress)
        write((result,), protocol)
    return _report((result,), protocol, reports)


@cli.group(epilog=_example("vectors"))
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

    with _progress() as progress:
        found = check_file(Path(file), progress)
    _print("".join(f"{_plain(line)}\n" for line in found.lines))
    if found.count > len(found.lines):
        _print(f"{found.name}: {found.count - len(found.lines)} more\n")
    return DOES_NOT_CONFORM if found.count else CONFORMS


@cli.command(epilog=_example("schema"))
@click.argument("of", type=click.Choice(("report", "vectors")))
def schema(*, of: str) -> int:
    """Give the JSON Schema of reports, or of test vectors."""
    if of == "report":
        from ecatspec.conformance.reports.json_report import json_schema
    else:
        from ecatspec.generators.vectors.schema import json_schema

    _print(json.dumps(json_schema(), indent=2, sort_keys=True) + "\n")
    return CONFORMS


@cli.command(epilog=_example("simulate"))
@click.argument("device")
@click.option("--iface", required=True, metavar="NAME", help="The network interface to answer on.")
@click.option("--fault", metavar="NAME", help="Plant this fault: ecatspec show DEVICE faults.")
@_MAILBOX
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
        _set_up("simulate"),
        Segment(
            device, iface, fault=fault, mailbox=mailbox, count=count, virtual_time=virtual_time
        ) as segment,
    ):
        said = f"ecatspec: {segment.name} answers on {iface}; Ctrl-C ends it"
        with _progress() as progress:
            segment.serve(progress, lambda: _warn(said))
    return CONFORMS


# --- output ---------------------------------------------------------------------------------------


@contextmanager
def _output(path: str | None, *, text: bool) -> Iterator[IO[bytes]]:
    """Give where to write to: standard output, or a file that is there whole or not at all."""
    from pathlib import Path

    from ecatspec.conformance.base.atomic_write import whole

    if path is None:
        if sys.stdout is None:
            _refuse(_CLOSED)
        if not text and sys.stdout.isatty():
            _refuse("this format is no text for a terminal; write it to a file with -o FILE")
        with _standard_output():
            yield sys.stdout.buffer
        return
    if "\0" in path:
        _refuse(f"{path!a} is no path; give that of a file")
    try:
        with whole(Path(path)) as file:
            yield file
    except OSError as error:
        why = error.strerror or type(error).__name__
        _refuse(f"{path!a} cannot be written ({why}); give another file")


@contextmanager
def _drafted(path: str | None) -> Iterator[Callable[[str], None]]:
    """Give what writes a text to a file, if there is a path to one."""
    if path is None:
        yield lambda _: None
        return
    with _output(path, text=True) as file:

        def write(text: str) -> None:
            file.write(text.encode())

        yield write


@contextmanager
def _set_up(command: str) -> Iterator[None]:
    """Say what is wrong with the set-up of a command."""
    from ecatspec.conformance.base.adapter import AdapterError

    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "z3":
            raise
        _refuse(str(error))
    except AdapterError as error:
        said = str(error)
        hint = f"repair the set-up, see ecatspec {command} --help"
        _refuse(said if ";" in said else f"{said}; {hint}")


@contextmanager
def _written(options: Mapping[str, Any]) -> Iterator[Callable[[Sequence[Result], Protocol], None]]:
    """Give what writes the reports that go to files; a bad place is said before anything runs."""
    from ecatspec.conformance.reports import REPORTS

    if options["github"] and options["as_json"]:
        _refuse("--github and --json both speak on standard output; give one of them")
    with ExitStack() as stack:
        files = {
            form: stack.enter_context(_output(options[form], text=True))
            for form in _FILES
            if options[form] is not None
        }

        def write(results: Sequence[Result], protocol: Protocol) -> None:
            for form, file in files.items():
                file.write(REPORTS[form](results, protocol).encode(errors="backslashreplace"))

        yield write


def _report(results: Sequence[Result], protocol: Protocol, options: Mapping[str, Any]) -> int:
    """Print the results and give the exit status that they deserve."""
    from ecatspec.conformance.base.verdict import Outcome
    from ecatspec.conformance.reports import REPORTS, judged

    said = REPORTS["json" if options["as_json"] else "text"](results, protocol)
    if not options["as_json"] and sys.stdout is not None and sys.stdout.isatty():
        from ecatspec.conformance.render.colours import coloured

        said = coloured(said)
    _print(said)
    if options["github"]:
        _print(REPORTS["github"](results, protocol))
    if any(result.interrupted for result in results):
        return INTERRUPTED
    if not all(result.conforms for result in results):
        return DOES_NOT_CONFORM
    troubles = [v for result in results for v in result.verdicts if v.outcome is Outcome.ERROR]
    if troubles:
        what = f"{len(troubles)} cases could not be judged ({troubles[0].reason})"
        _refuse(f"{what}; see the report, repair the set-up and run again")
    if not any(map(judged, results)):
        _refuse("nothing could be judged; the report says why")
    return CONFORMS


def _drawn(device: str, machine: str | None, form: str, *, as_json: bool) -> int:
    from ecatspec.conformance.base.devices import load, nearest
    from ecatspec.conformance.describe.device_page import chapter
    from ecatspec.conformance.drawings import DRAWINGS

    if form not in DRAWINGS and form != _CHAPTER:
        raise nearest("format", form, (*DRAWINGS, _CHAPTER))
    if as_json:
        _refuse("--format and --json exclude each other; give one of them")
    if form == _CHAPTER:
        if machine is not None:
            _refuse(f"--format {_CHAPTER} is about the whole device; leave {machine!r} out")
        _print(chapter(load(device)))
        return CONFORMS
    if machine is None or machine == "faults":
        what = "" if machine is None else ", which faults are not"
        _refuse(f"--format draws a machine{what}; name one: ecatspec show DEVICE MACHINE")
    _print(DRAWINGS[form](load(device), machine))
    return CONFORMS


def _table(sheet: Sheet) -> str:
    """Give a table as text that fits the terminal."""
    import shutil

    from ecatspec.conformance.render.tables import text_table

    return text_table(sheet, shutil.get_terminal_size((_PIPE_WIDTH, 0)).columns)


def _print_json(schema: str, data: dict[str, object]) -> None:
    data = {"schema": schema, "schema_version": 1, **data}
    _print(json.dumps(data, indent=2, sort_keys=True) + "\n")


def _print(text: str) -> None:
    """Write to stdout; a reader who has seen enough takes nothing from the exit status."""
    if sys.stdout is None:
        _refuse(_CLOSED)
    with _standard_output():
        sys.stdout.write(text)
        sys.stdout.flush()


@contextmanager
def _standard_output() -> Iterator[None]:
    """Say what is wrong with standard output while it is written to."""
    try:
        yield
    except BrokenPipeError:
        _silence()
    except OSError as error:
        _silence()
        _refuse(f"cannot write to standard output ({error.strerror}); redirect it elsewhere")


def _silence() -> None:
    # Python flushes stdout once more at its end: give it a place where that succeeds.
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


def _warn(line: str) -> None:
    """Write one line to stderr, without signs that a terminal would obey."""
    with suppress(BrokenPipeError):
        print(_plain(line), file=sys.stderr, flush=True)


def _plain(line: str) -> str:
    words = " ".join(line.split())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in words)


def _refuse(message: str) -> NoReturn:
    from ecatspec.conformance.base.devices import UserError

    raise UserError(message)


@contextmanager
def _progress() -> Iterator[Progress | None]:
    """Give a bar on a terminal, which goes away at the end, and nothing elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    left, what = TimeRemainingColumn(), TextColumn("{task.description}", markup=False)
    columns = (BarColumn(), MofNCompleteColumn(), left, what)
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)

        def tell(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total or None, description=what)

        yield tell


# --- the entry ------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and give its exit status; every wrong input is one line on stderr."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    given = None if arguments is None else list(arguments)
    try:
        return int(cli.main(given, prog_name="ecatspec", standalone_mode=False) or 0)
    except click.ClickException as error:
        _warn(_usage(error))
    except (click.Abort, KeyboardInterrupt):
        _warn("ecatspec: interrupted")
        return INTERRUPTED
    except SpecError as error:
        for diagnostic in error.diagnostics:
            _warn(str(diagnostic))
    except Exception as error:  # noqa: BLE001  no defect of ours may look like a verdict
        from ecatspec.conformance.base.devices import UserError

        if not isinstance(error, UserError):
            traceback.print_exc()
            name = type(error).__name__
            error = UserError(f"a defect of ecatspec ({name}); report the lines above")
        _warn(f"ecatspec: {error}")
    return WRONG_INPUT


def _usage(error: click.ClickException) -> str:
    what = error.format_message().rstrip().rstrip(".")
    context = error.ctx if isinstance(error, click.UsageError) else None
    command = "ecatspec" if context is None else context.command_path
    return f"ecatspec: {what[:1].lower()}{what[1:]}; see {command} --help"


if __name__ == "__main__":
    sys.exit(main())
