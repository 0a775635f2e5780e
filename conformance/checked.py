"""The only place for the forms in which the diagnostics of texts are told."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

from ecatspec.conformance.annotations import annotation
from ecatspec.conformance.version import version
from ecatspec.spec.language.diagnostics import Code

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ecatspec.spec.language.diagnostics import Diagnostic

    Form = Callable[[Sequence["Checked"]], str]

_SARIF: Final = "2.1.0"
_SCHEMA: Final = "https://json.schemastore.org/sarif-2.1.0.json"
_ROOT: Final = "%SRCROOT%"
"""What readers of SARIF call the folder of the checkout."""


@dataclass(frozen=True, slots=True)
class Checked:
    """One file: what is wrong with it, why it could not be read at all, or what it holds."""

    file: str
    diagnostics: tuple[Diagnostic, ...] = ()
    error: str = ""
    clauses: int = 0
    rules: int = 0

    @property
    def sound(self) -> bool:
        """Tell whether nothing is wrong."""
        return not (self.diagnostics or self.error)


def _text(files: Sequence[Checked]) -> str:
    lines: list[str] = []
    for checked in files:
        lines += map(str, checked.diagnostics)
        if checked.sound:
            lines.append(f"{checked.file}: ok, {checked.clauses} clauses, {checked.rules} rules")
    return "".join(f"{line}\n" for line in lines)


def _json(files: Sequence[Checked]) -> str:
    entries = [_entry(checked) for checked in files]
    return _dumped({"schema": "ecatspec.check", "schema_version": 1, "files": entries})


def _entry(checked: Checked) -> dict[str, object]:
    entry: dict[str, object] = {
        "file": checked.file,
        "ok": checked.sound,
        "diagnostics": [
            {
                "code": diagnostic.code.name,
                "file": diagnostic.at.file,
                "line": diagnostic.at.line,
                "column": diagnostic.at.column,
                "message": diagnostic.message,
                "remedy": diagnostic.remedy,
            }
            for diagnostic in checked.diagnostics
        ],
    }
    if checked.error:
        entry["error"] = checked.error
    if checked.sound:
        entry |= {"clauses": checked.clauses, "rules": checked.rules}
    return entry


def _sarif(files: Sequence[Checked]) -> str:
    codes = list(Code)
    driver = {
        "name": "ecatspec",
        "version": version(),
        "rules": [{"id": c.name, "shortDescription": {"text": c.value}} for c in codes],
    }
    results = [
        {
            "ruleId": diagnostic.code.name,
            "ruleIndex": codes.index(diagnostic.code),
            "level": "error",
            "message": {"text": f"{diagnostic.message}; {diagnostic.remedy}"},
            "locations": [
                {
                    "physicalLocation": {
                        "artifactLocation": _location(diagnostic.at.file),
                        "region": {
                            "startLine": max(1, diagnostic.at.line),
                            "startColumn": max(1, diagnostic.at.column),
                        },
                    }
                }
            ],
        }
        for checked in files
        for diagnostic in checked.diagnostics
    ]
    errors = [
        {"level": "error", "message": {"text": checked.error}} for checked in files if checked.error
    ]
    run = {
        "tool": {"driver": driver},
        "columnKind": "unicodeCodePoints",
        "invocations": [
            {"executionSuccessful": not errors, "toolExecutionNotifications": errors},
        ],
        "results": results,
    }
    return _dumped({"$schema": _SCHEMA, "version": _SARIF, "runs": [run]})


def _location(file: str) -> dict[str, object]:
    path = Path(file)
    if path.is_absolute():
        return {"uri": path.as_uri()}
    return {"uri": quote(path.as_posix()), "uriBaseId": _ROOT}


def _github(files: Sequence[Checked]) -> str:
    lines = []
    for checked in files:
        lines += [
            annotation(
                "error",
                f"{diagnostic.message}; {diagnostic.remedy}",
                title=diagnostic.code.name,
                place={
                    "file": diagnostic.at.file,
                    "line": diagnostic.at.line,
                    "col": diagnostic.at.column,
                },
            )
            for diagnostic in checked.diagnostics
        ]
        if checked.error:
            lines.append(annotation("error", checked.error))
    return "".join(f"{line}\n" for line in lines)


def _dumped(data: dict[str, object]) -> str:
    return json.dumps(data, indent=2, sort_keys=True) + "\n"


CHECKS: Final[Mapping[str, Form]] = MappingProxyType(
    {"text": _text, "json": _json, "sarif": _sarif, "github": _github}
)
