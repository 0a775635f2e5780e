"""Reports of judged devices: options, files, standard output, exit status."""

from __future__ import annotations

import sys
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Final

import click

from ecatspec.conformance.cli.console import output_file, print_text, refuse
from ecatspec.conformance.cli.exit_status import CONFORMS, DOES_NOT_CONFORM, INTERRUPTED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ecatspec.conformance.base.verdict import Result
    from ecatspec.spec.language.ir import Protocol


REPORT_FILES: Final = {
    "html": "Write one page for people, which needs nothing else.",
    "junit": "Write JUnit XML for build servers, one test for each clause.",
    "sarif": "Write SARIF 2.1.0 for code scanning, one result for each finding.",
}


def report_options(command: Callable[..., int]) -> Callable[..., int]:
    """Add the options of all reports to a command."""
    options = (
        click.option("--json", "as_json", is_flag=True, help="Give the report as JSON."),
        *(
            click.option(f"--{form}", metavar="FILE", help=said)
            for form, said in REPORT_FILES.items()
        ),
        click.option("--github", is_flag=True, help="Give findings as annotations of GitHub too."),
    )
    for option in reversed(options):
        command = option(command)
    return command


@contextmanager
def report_files(
    options: Mapping[str, Any],
) -> Iterator[Callable[[Sequence[Result], Protocol], None]]:
    """Give what writes the reports that go to files; a bad place is said before anything runs."""
    from ecatspec.conformance.reports import REPORTS

    if options["github"] and options["as_json"]:
        refuse("--github and --json both speak on standard output; give one of them")
    with ExitStack() as stack:
        files = {
            form: stack.enter_context(output_file(options[form], text=True))
            for form in REPORT_FILES
            if options[form] is not None
        }

        def write(results: Sequence[Result], protocol: Protocol) -> None:
            for form, file in files.items():
                file.write(REPORTS[form](results, protocol).encode(errors="backslashreplace"))

        yield write


def print_report(results: Sequence[Result], protocol: Protocol, options: Mapping[str, Any]) -> int:
    """Print the results and give the exit status that they deserve."""
    from ecatspec.conformance.base.verdict import Outcome
    from ecatspec.conformance.reports import REPORTS, judged

    said = REPORTS["json" if options["as_json"] else "text"](results, protocol)
    if not options["as_json"] and sys.stdout is not None and sys.stdout.isatty():
        from ecatspec.conformance.cli.colours import coloured

        said = coloured(said)
    print_text(said)
    if options["github"]:
        print_text(REPORTS["github"](results, protocol))
    if any(result.interrupted for result in results):
        return INTERRUPTED
    if not all(result.conforms for result in results):
        return DOES_NOT_CONFORM
    troubles = [v for result in results for v in result.verdicts if v.outcome is Outcome.ERROR]
    if troubles:
        what = f"{len(troubles)} cases could not be judged ({troubles[0].reason})"
        refuse(f"{what}; see the report, repair the set-up and run again")
    if not any(map(judged, results)):
        refuse("nothing could be judged; the report says why")
    return CONFORMS
