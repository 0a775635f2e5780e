"""A run of the suite as several commands make it: progress, journal, errors of the set-up."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ecatspec.conformance.cli.console import progress_bar, refuse, warn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from ecatspec.conformance.base.verdict import Result
    from ecatspec.conformance.results.run_file import Basis, Journal


@contextmanager
def set_up_errors(command: str) -> Iterator[None]:
    """Say what is wrong with the set-up of a command."""
    from ecatspec.conformance.base.adapter import AdapterError

    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "z3":
            raise
        refuse(str(error))
    except AdapterError as error:
        said = str(error)
        hint = f"repair the set-up, see ecatspec {command} --help"
        refuse(said if ";" in said else f"{said}; {hint}")


def run_with_progress(device: str, dut: str, options: Mapping[str, Any]) -> Result:
    """Run the suite; the options are those of `run_device`."""
    from ecatspec.conformance.run.runner import run_device

    with set_up_errors("run"), progress_bar() as progress:
        return run_device(device, dut, progress=progress, **options)


def journal_opener(path: str | None, *, resume: bool = False) -> Callable[[Basis], Journal | None]:
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
            warn(
                f"ecatspec: warning: no record of the run is kept in {run_history.folder()} ({why})"
            )
            return None

    return keep
