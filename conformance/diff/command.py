"""Runs the command `diff` between its options and its output."""

from __future__ import annotations

import gc
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ecatspec.conformance.base.atomic_write import write_whole
from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.diff.comparison import compare, processors
from ecatspec.conformance.diff.report import as_data, headline, markdown, sections_of, sheets
from ecatspec.conformance.diff.subjects import subject

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.conformance.render.tables import Sheet

_MARKDOWN = "markdown"
_TWO = 2


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a user asks for: sections (none: all), the form, files to write."""

    sections: tuple[str, ...] = ()
    form: str | None = None
    vectors: str | None = None
    page: str | None = None
    verify: bool = False


@dataclass(frozen=True, slots=True)
class Told:
    """What is printed; `differs` decides the exit status."""

    words: str
    sheets: tuple[Sheet, ...] = ()
    data: dict[str, object] = field(default_factory=dict)
    failures: tuple[str, ...] = ()
    differs: bool = False


def texts(first: str, second: str, wanted: Wanted) -> Told:
    """Compare two specifications.

    Raises:
        UserError: There is no such specification or section, or a file cannot be written.
        SpecError: A text is wrong.

    """
    sections = sections_of(wanted.sections)
    with _uncollected():
        pair = (subject(first), subject(second))
        names, workers = _names(first, second), min(_TWO, processors())
        whole = compare(*pair, names, workers, keeps=True)
    found = whole.only(sections)
    failures: tuple[str, ...] = ()
    if wanted.verify or wanted.vectors:
        from ecatspec.conformance.diff.verify import vectors, verify

        failures = verify(found) if wanted.verify else ()
        if wanted.vectors:
            _write(wanted.vectors, vectors(found))
    if wanted.page:
        from ecatspec.conformance.diff.page import page

        _write(wanted.page, page(found))
    if wanted.form == _MARKDOWN:
        return Told(markdown(found), failures=failures, differs=bool(found.count))
    lines = [headline(found)]
    if wanted.verify and not failures:
        lines.append(f"Each of {len(found.behaviours)} witnesses was replayed on both: as stated.")
    data = as_data(found)
    if wanted.verify:
        data |= {"failures": list(failures)}
    words = "".join(f"{line}\n" for line in lines)
    return Told(words, tuple(sheets(found)), data, failures, bool(found.count))


@contextmanager
def _uncollected() -> Iterator[None]:
    """Let garbage lie: there are many objects, nearly all stay, and looking at them takes long."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _names(first: str, second: str) -> tuple[str, str]:
    """Give short names that are not the same."""
    short = (Path(first).name, Path(second).name)
    return short if short[0] != short[1] else (f"{first} (A)", f"{second} (B)")


def _write(path: str, text: str) -> None:
    try:
        write_whole(Path(path), text)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or type(error).__name__
        raise UserError(f"{path!a} cannot be written ({why}); give another file") from None


def devices(first: str, second: str | None, duts: tuple[str, ...], wanted: Wanted) -> Told:
    """Compare two implementations by the suite of one text.

    Raises:
        UserError: There are not two of them, or one cannot be reached.

    """
    if second is not None or len(duts) != _TWO:
        message = "two devices are compared by one text: ecatspec diff A --dut X --dut Y"
        raise UserError(message)
    unused: Mapping[str, object] = {
        "--section": wanted.sections,
        "--export": wanted.vectors,
        "--html": wanted.page,
        "--verify": wanted.verify,
    }
    for option, given in unused.items():
        if given:
            raise UserError(f"{option} is about texts; leave it out with --dut")
    from ecatspec.conformance.diff.devices import compare_devices

    found = compare_devices(first, (duts[0], duts[1]))
    words = found.headline() + "\n"
    if wanted.form == _MARKDOWN:
        return Told(found.markdown(), differs=bool(found.differences))
    return Told(words, found.sheets(), found.as_data(), differs=bool(found.differences))
