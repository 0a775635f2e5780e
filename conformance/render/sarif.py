"""The frame of SARIF 2.1.0: one run of this tool, its rules and results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

from ecatspec.conformance.base.version import version

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_VERSION: Final = "2.1.0"
_SCHEMA: Final = "https://json.schemastore.org/sarif-2.1.0.json"
_ROOT: Final = "%SRCROOT%"
"""What readers of SARIF call the folder of the checkout."""


def log(
    rules: Mapping[str, str],
    results: Sequence[Mapping[str, object]],
    errors: Sequence[str] = (),
) -> str:
    """Give a log of one run: `rules` by id with their words, what was found, what went wrong."""
    driver = {
        "name": "ecatspec",
        "version": version(),
        "rules": [{"id": name, "shortDescription": {"text": said}} for name, said in rules.items()],
    }
    told = [{"level": "error", "message": {"text": error}} for error in errors]
    run = {
        "tool": {"driver": driver},
        "columnKind": "unicodeCodePoints",
        "invocations": [{"executionSuccessful": not told, "toolExecutionNotifications": told}],
        "results": results,
    }
    data = {"$schema": _SCHEMA, "version": _VERSION, "runs": [run]}
    return json.dumps(data, indent=2, sort_keys=True) + "\n"


def place(file: str, line: int, column: int) -> dict[str, object]:
    """Give a place in a file; one that is not absolute lies in the checkout."""
    path = Path(file)
    artifact: dict[str, object] = {"uri": path.as_uri()} if path.is_absolute() else {}
    artifact = artifact or {"uri": quote(path.as_posix()), "uriBaseId": _ROOT}
    region = {"startLine": max(1, line), "startColumn": max(1, column)}
    return {"physicalLocation": {"artifactLocation": artifact, "region": region}}
