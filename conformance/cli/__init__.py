"""The command line: commands, exit statuses, and the wording of errors.

Status 0: conforms. 1: does not, or was not shown to. 2: the input or the set-up is wrong, nothing
was judged. 130: stopped by Ctrl-C. What is judged goes to stdout, all else to stderr. The module
of a command is loaded when the command or its help is asked for.
"""

from __future__ import annotations

import sys
import traceback
from importlib import import_module
from io import TextIOWrapper
from typing import TYPE_CHECKING, Final

import click

from ecatspec.conformance.base.version import version
from ecatspec.conformance.cli.console import print_text, warn
from ecatspec.conformance.cli.exit_status import CONFORMS, INTERRUPTED, WRONG_INPUT
from ecatspec.conformance.cli.options import EXAMPLES
from ecatspec.spec.language.diagnostics import SpecError

if TYPE_CHECKING:
    from collections.abc import Sequence


_HELP: Final = """Test EtherCAT SubDevices (slaves) against an executable specification.

Exit status: 0 conforms, 1 does not conform or not shown, 2 the input or the set-up is wrong.

\b
Examples:
""" + "\n".join(f"  {each}" for each in EXAMPLES.values())


def _show_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:  # noqa: FBT001
    if wanted and not context.resilient_parsing:
        print_text(f"ecatspec {version()}\n")
        context.exit()


class _Commands(click.Group):
    """Commands each in the module of its name, which is loaded when it is asked for."""

    def list_commands(self, _: click.Context) -> list[str]:
        return sorted(EXAMPLES)

    def get_command(self, _: click.Context, name: str) -> click.Command | None:
        if name not in EXAMPLES:
            return None
        module = import_module(f"{__name__}.{name}")
        command: click.Command = getattr(module, name)
        return command


@click.group(
    cls=_Commands,
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
        print_text(context.get_help() + "\n")
        return WRONG_INPUT
    return CONFORMS


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and give its exit status; every wrong input is one line on stderr."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    given = None if arguments is None else list(arguments)
    try:
        return int(cli.main(given, prog_name="ecatspec", standalone_mode=False) or 0)
    except click.ClickException as error:
        warn(_usage(error))
    except (click.Abort, KeyboardInterrupt):
        warn("ecatspec: interrupted")
        return INTERRUPTED
    except SpecError as error:
        for diagnostic in error.diagnostics:
            warn(str(diagnostic))
    except Exception as error:  # noqa: BLE001  no defect of ours may look like a verdict
        from ecatspec.conformance.base.devices import UserError

        if not isinstance(error, UserError):
            traceback.print_exc()
            name = type(error).__name__
            error = UserError(f"a defect of ecatspec ({name}); report the lines above")
        warn(f"ecatspec: {error}")
    return WRONG_INPUT


def _usage(error: click.ClickException) -> str:
    what = error.format_message().rstrip().rstrip(".")
    context = error.ctx if isinstance(error, click.UsageError) else None
    command = "ecatspec" if context is None else context.command_path
    return f"ecatspec: {what[:1].lower()}{what[1:]}; see {command} --help"
