"""What commands write: standard output, files, warnings, progress."""

from __future__ import annotations

import json
import os
import sys
from contextlib import contextmanager, suppress
from typing import IO, TYPE_CHECKING, Final, NoReturn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ecatspec.conformance.render.tables import Sheet

    Progress = Callable[[int, int, str], None]


_PIPE_WIDTH: Final = 120


_CLOSED: Final = "there is no standard output; leave it open or redirect it to a file"


@contextmanager
def output_file(path: str | None, *, text: bool) -> Iterator[IO[bytes]]:
    """Give where to write to: standard output, or a file that is there whole or not at all."""
    from pathlib import Path

    from ecatspec.conformance.base.atomic_write import whole

    if path is None:
        if sys.stdout is None:
            refuse(_CLOSED)
        if not text and sys.stdout.isatty():
            refuse("this format is no text for a terminal; write it to a file with -o FILE")
        with standard_output():
            yield sys.stdout.buffer
        return
    if "\0" in path:
        refuse(f"{path!a} is no path; give that of a file")
    try:
        with whole(Path(path)) as file:
            yield file
    except OSError as error:
        why = error.strerror or type(error).__name__
        refuse(f"{path!a} cannot be written ({why}); give another file")


@contextmanager
def draft_file(path: str | None) -> Iterator[Callable[[str], None]]:
    """Give what writes a text to a file, if there is a path to one."""
    if path is None:
        yield lambda _: None
        return
    with output_file(path, text=True) as file:

        def write(text: str) -> None:
            file.write(text.encode())

        yield write


def table_text(sheet: Sheet) -> str:
    """Give a table as text that fits the terminal."""
    import shutil

    from ecatspec.conformance.render.tables import text_table

    return text_table(sheet, shutil.get_terminal_size((_PIPE_WIDTH, 0)).columns)


def print_json(schema: str, data: dict[str, object]) -> None:
    """Print data as JSON with the name and the version of its schema."""
    data = {"schema": schema, "schema_version": 1, **data}
    print_text(json.dumps(data, indent=2, sort_keys=True) + "\n")


def print_text(text: str) -> None:
    """Write to stdout; a reader who has seen enough takes nothing from the exit status."""
    if sys.stdout is None:
        refuse(_CLOSED)
    with standard_output():
        sys.stdout.write(text)
        sys.stdout.flush()


@contextmanager
def standard_output() -> Iterator[None]:
    """Say what is wrong with standard output while it is written to."""
    try:
        yield
    except BrokenPipeError:
        _silence()
    except OSError as error:
        _silence()
        refuse(f"cannot write to standard output ({error.strerror}); redirect it elsewhere")


def _silence() -> None:
    # Python flushes stdout once more at its end: give it a place where that succeeds.
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


def warn(line: str) -> None:
    """Write one line to stderr, without signs that a terminal would obey."""
    with suppress(BrokenPipeError):
        print(plain(line), file=sys.stderr, flush=True)


def plain(line: str) -> str:
    """Give a line without signs that a terminal would obey."""
    words = " ".join(line.split())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in words)


def refuse(message: str) -> NoReturn:
    """End the command by status 2 and a line that says what to do."""
    from ecatspec.conformance.base.devices import UserError

    raise UserError(message)


@contextmanager
def progress_bar() -> Iterator[Progress | None]:
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

        def advance(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total or None, description=what)

        yield advance
