"""The only place for the table of formats: how test vectors are written.

A format is a file here with `write(head, tests, out)` and a row in FORMATS.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from ecatspec.generators.formats import (
    c_format,
    csv_format,
    json_format,
    markdown_format,
    pcapng_format,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import IO

    from ecatspec.generators.vectors import Head, Test

    Writer = Callable[[Head, Iterable[tuple[str, Test]], IO[bytes]], None]


@dataclass(frozen=True, slots=True)
class Format:
    """A way to write vectors: what it is for, how its files end, and whether they are text."""

    summary: str
    ending: str
    write: Writer
    text: bool = True


FORMATS: Final[Mapping[str, Format]] = MappingProxyType(
    {
        "json": Format("everything, for programs", "json", json_format.write),
        "c": Format("a header with tables and a runner, for firmware tests", "h", c_format.write),
        "pcapng": Format(
            "requests and expected answers as frames, for Wireshark",
            "pcapng",
            pcapng_format.write,
            text=False,
        ),
        "markdown": Format("everything in words, for people", "md", markdown_format.write),
        "csv": Format("a row for each expectation, for tables", "csv", csv_format.write),
    }
)
