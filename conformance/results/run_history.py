"""Keeps the newest runs of each device in the user's folder."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from platformdirs import user_state_path

from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.results import run_file

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ecatspec.conformance.base.verdict import Outcome, Verdict
    from ecatspec.conformance.results.run_file import Basis, Journal, Run
    from ecatspec.spec.language.ir import Protocol

_KEPT: Final = 10
"""Number of runs of each device that are kept."""
_SUFFIX: Final = ".sqlite"
LAST: Final = "last"
PREVIOUS: Final = "previous"


@dataclass(frozen=True, slots=True)
class CaseRecord:
    """How a case ended, and the rules that the device surely went by in it."""

    outcome: Outcome
    rules: frozenset[str]


@dataclass(frozen=True, slots=True)
class Record:
    """A run: the device under test and all cases by name."""

    subject: str
    cases: Mapping[str, CaseRecord]


def folder() -> Path:
    """Give the folder in which runs lie, of this user."""
    return user_state_path("ecatspec") / "runs"


def files(device: str) -> list[Path]:
    """Give the files of the runs of a device, the newest first."""
    return sorted((folder() / device).glob(f"*{_SUFFIX}"), reverse=True)


def begin(basis: Basis, *, resume: bool = False) -> Journal:
    """Open the journal of a new run of a device, or with `resume` that of its last one.

    Raises:
        OSError: The folder cannot be made.
        UserError: There is no run to resume, or one of another set-up, or no file can be written.

    """
    known = files(basis.device)
    if resume:
        if not known:
            raise UserError(f"there is no run of {basis.device} to resume; leave out --resume")
        return run_file.begin(known[0], basis, resume=True)
    home = folder() / basis.device
    home.mkdir(mode=0o700, parents=True, exist_ok=True)
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H%M%S.%f")
    journal = run_file.begin(home / f"{now}{_SUFFIX}", basis)
    for old in known[_KEPT - 1 :]:
        with suppress(OSError):
            old.unlink()
    return journal


def record_of(subject: str, verdicts: Iterable[Verdict]) -> Record:
    """Give what a run says of its cases."""
    return Record(subject, {v.case: CaseRecord(v.outcome, frozenset(v.rules)) for v in verdicts})


def load(protocol: Protocol) -> Record | None:
    """Give the record of the last run by exactly these texts, None where there is none.

    One that is not finished, be it that it goes on at this moment, counts where no other is there.
    """
    found: Run | None = None
    for path in files(protocol.name):
        with suppress(UserError):
            run = run_file.read(path)
            # one of some layers says nothing about what a run exercises
            if run.basis.digest == protocol.digest and not run.basis.only:
                found = run if run.finished else found or run
                if run.finished:
                    break
    if found is None:
        return None
    return record_of(str(found.basis.description["name"]), found.verdicts)


def named(name: str) -> Path:
    """Give the file of a run: a path, the `last` of this user, or the `previous` of its device.

    Raises:
        UserError: There is no such run.

    """
    if name not in {LAST, PREVIOUS}:
        return Path(name)
    every = sorted(folder().glob(f"*/*{_SUFFIX}"), key=lambda path: path.name)
    if not every:
        raise UserError(f"no run is kept in {folder()}; run a device, or give a file")
    if name == LAST:
        return every[-1]
    own = files(every[-1].parent.name)
    if len(own) == 1:
        device = every[-1].parent.name
        raise UserError(f"only one run of {device} is kept; run it again, or give a file")
    return own[1]
