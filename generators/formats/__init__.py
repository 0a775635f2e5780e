"""The table of formats in which test vectors are written.

A format is a file here with `write(head, tests, out)` and a row in FORMATS.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import IO

    from ecatspec.generators.vectors.schema import Head, Test

    Writer = Callable[[Head, Iterable[tuple[str, Test]], IO[bytes]], None]


@dataclass(frozen=True, slots=True)
class Format:
    """A way to write vectors: what it is for, how its files end, and whether they are text."""

    summary: str
    ending: str
    write: Writer
    text: bool = True


def _write(module: str, head: Head, tests: Iterable[tuple[str, Test]], out: IO[bytes]) -> None:
    """Write by a module that is read when it is needed: the help names all formats."""
    importlib.import_module(f"{__name__}.{module}").write(head, tests, out)


FORMATS: Final[Mapping[str, Format]] = MappingProxyType(
    {
        "json": Format("everything, for programs", "json", partial(_write, "json_format")),
        "c": Format(
            "a header with tables and a runner, for firmware tests",
            "h",
            partial(_write, "c_format"),
        ),
        "pcapng": Format(
            "requests and expected answers as frames, for Wireshark",
            "pcapng",
            partial(_write, "pcapng_format"),
            text=False,
        ),
        "markdown": Format(
            "everything in words, for people", "md", partial(_write, "markdown_format")
        ),
        "csv": Format(
            "a row for each expectation, for tables", "csv", partial(_write, "csv_format")
        ),
    }
)
