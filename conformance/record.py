"""The only place for the record of the last run of a device: what each case showed, on disk."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from platformdirs import user_state_path

from ecatspec.conformance.files import write_whole
from ecatspec.conformance.verdict import Outcome

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from ecatspec.conformance.verdict import Result
    from ecatspec.spec.language.ir import Protocol

SCHEMA: Final = "ecatspec.record"
VERSION: Final = 1


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
    """Give the folder in which records lie, of this user."""
    return user_state_path("ecatspec") / "runs"


def record_of(result: Result) -> Record:
    """Give what is kept of a result."""
    cases = {v.case: CaseRecord(v.outcome, frozenset(v.rules)) for v in result.verdicts}
    return Record(result.subject, cases)


def save(protocol: Protocol, record: Record) -> None:
    """Keep the record of a device in place of the one before.

    Raises:
        OSError: The file cannot be written.

    """
    names = sorted({rule for case in record.cases.values() for rule in case.rules})
    numbers = {name: number for number, name in enumerate(names)}
    data = {
        "schema": SCHEMA,
        "schema_version": VERSION,
        "device": protocol.name,
        "digest": protocol.digest,
        "subject": record.subject,
        "rules": names,
        "cases": {
            name: [case.outcome.value, sorted(numbers[rule] for rule in case.rules)]
            for name, case in record.cases.items()
        },
    }
    folder().mkdir(mode=0o700, parents=True, exist_ok=True)
    write_whole(_file(protocol), json.dumps(data, separators=(",", ":")) + "\n")


def load(protocol: Protocol) -> Record | None:
    """Give the record of the last run by exactly these texts, None where there is none."""
    try:
        data = json.loads(_file(protocol).read_text(encoding="utf-8"))
        known = data["schema"], data["schema_version"], data["digest"]
        if known != (SCHEMA, VERSION, protocol.digest):
            return None
        names: list[str] = data["rules"]
        cases = {
            name: CaseRecord(Outcome(outcome), frozenset(names[number] for number in rules))
            for name, (outcome, rules) in data["cases"].items()
        }
        return Record(str(data["subject"]), cases)
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        return None


def _file(protocol: Protocol) -> Path:
    return folder() / f"{protocol.name}.json"
