"""Writes the diagnostics of texts as text, GitHub annotations and SARIF."""

from __future__ import annotations

import json
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.render.annotations import annotation
from ecatspec.conformance.render.sarif import log, place
from ecatspec.spec.language.diagnostics import Code

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ecatspec.spec.language.diagnostics import Diagnostic

    Form = Callable[[Sequence["Checked"]], str]


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
    results = [
        {
            "ruleId": diagnostic.code.name,
            "ruleIndex": codes.index(diagnostic.code),
            "level": "error",
            "message": {"text": f"{diagnostic.message}; {diagnostic.remedy}"},
            "locations": [place(diagnostic.at.file, diagnostic.at.line, diagnostic.at.column)],
        }
        for checked in files
        for diagnostic in checked.diagnostics
    ]
    errors = [checked.error for checked in files if checked.error]
    return log({code.name: code.value for code in codes}, results, errors)


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
