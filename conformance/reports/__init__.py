"""The table of reports: the forms in which results can be read.

A report is a file here with `report(results, protocol) -> str` and a row in REPORTS.
"""

from __future__ import annotations

import importlib
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, cast

from ecatspec.conformance.base.verdict import CAUSED, Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ecatspec.conformance.base.verdict import Result
    from ecatspec.spec.language.ir import Protocol

    Report = Callable[[Sequence[Result], Protocol], str]


_JUDGED: Final = CAUSED | {Outcome.PASS}


def judged(result: Result) -> bool:
    """Tell whether a result says anything about the device; one that does not is no success."""
    return any(verdict.outcome in _JUDGED for verdict in result.verdicts)


def risks(result: Result, protocol: Protocol) -> dict[str, str]:
    """Give why ways that were found are risky, by choice; a way that the text states is known."""
    found = {name: way for name, way in result.choices.items() if name not in protocol.pins}
    return protocol.risks(found)


def _make(module: str, results: Sequence[Result], protocol: Protocol) -> str:
    report = cast("Report", importlib.import_module(f"{__name__}.{module}").report)
    return report(results, protocol)


REPORTS: Final[Mapping[str, Report]] = MappingProxyType(
    {
        "text": partial(_make, "text"),
        "json": partial(_make, "json_report"),
        "junit": partial(_make, "junit_report"),
        "html": partial(_make, "html_report"),
        "github": partial(_make, "github_report"),
        "sarif": partial(_make, "sarif_report"),
    }
)
