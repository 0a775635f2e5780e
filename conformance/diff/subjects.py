"""Loads what a user wants to compare: specifications, also of git revisions."""

from __future__ import annotations

import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.devices import SUFFIX, UserError, load
from ecatspec.spec.language.diagnostics import SpecError

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import Protocol

_PATIENCE: Final = 30
"""Seconds that git may take."""


def subject(name: str) -> Protocol:
    """Load a device by name, `standard`, a text by its path, or a text of git: `FILE@REVISION`.

    Of a revision only this text is taken; the texts that it builds on are those of the package.

    Raises:
        UserError: There is no such device, file, repository or revision.
        SpecError: The text is wrong.

    """
    path, at, revision = name.rpartition("@")
    if not at or not path.endswith(SUFFIX):
        return load(name)
    text = _text_at(Path(path), revision, name)
    with tempfile.TemporaryDirectory(prefix="ecatspec-") as folder:
        file = Path(folder) / Path(path).name
        file.write_bytes(text)
        try:
            return load(str(file))
        except SpecError as error:
            named = (replace(d, at=replace(d.at, file=name)) for d in error.diagnostics)
            raise SpecError(tuple(named)) from None


def _text_at(path: Path, revision: str, name: str) -> bytes:
    if not revision or revision.startswith("-"):
        raise UserError(f"{name!r} names no revision; write FILE@REVISION, as in FILE@HEAD~1")
    if "\0" in name:
        raise UserError(f"{name!a} is no path; write FILE@REVISION")
    folder = path.parent
    command = ["git", "-C", str(folder), "show", f"{revision}:./{path.name}"]
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=_PATIENCE)  # noqa: S603
    except FileNotFoundError:
        raise UserError(f"{name!r} needs git, which is not installed; give a file") from None
    except subprocess.TimeoutExpired:
        raise UserError(f"git did not answer for {name!r}; give a file") from None
    if done.returncode:
        said = done.stderr.decode("utf-8", "replace").strip().splitlines()
        why = said[-1] if said else f"status {done.returncode}"
        raise UserError(f"git has no {name!r} ({why}); give a file of a repository, and a revision")
    return done.stdout
