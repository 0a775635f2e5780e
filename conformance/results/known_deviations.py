"""Reads and writes files of known deviations: what is accepted, why, and until when.

A file is TOML: the `device`, and a table `known` for each finding, by the identity that reports
give it. Its reason is the user's, and so is the date after which it counts no more.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
import tomli_w

from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.base.verdict import CAUSED

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from ecatspec.conformance.base.verdict import Result

_HEAD: Final = (
    "# Deviations of {device} that are accepted: give the reason of each, and perhaps a last day,\n"
    "# as in until = 2030-12-31\n"
)
_UNEXPLAINED: Final = "drafted from a run on {day}; nobody has given a reason yet"


class Known(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A finding that is accepted."""

    finding: str
    """Its identity, as reports give it."""
    reason: str
    until: date | None = None
    """The last day on which it is accepted; None: it has no end."""
    clause: str = ""
    """The clause that it breaks, for the reader of the file."""
    title: str = ""
    """What it is, for the reader of the file."""


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    device: str
    known: tuple[Known, ...] = ()


@dataclass(frozen=True, slots=True)
class Accepted:
    """What is known of a device, and the file that says so."""

    path: str = ""
    known: tuple[Known, ...] = ()
    ended: tuple[Known, ...] = ()
    """Those whose last day is over: they count no more."""
    reasons: Mapping[str, str] = field(default_factory=dict)
    """Why each finding is accepted, by its identity."""

    def notes(self, found: Collection[str], *, whole: bool) -> Iterable[str]:
        """Say what is over, and after a `whole` run what no longer occurs.

        `found` has the identities of what occurred.
        """
        for each in self.ended:
            yield f"no longer accepted since {each.until}: {each.finding} ({each.reason})"
        for each in self.known if whole else ():
            if each.finding not in found:
                hint = f"take it out of {self.path}"
                yield f"known, and did not occur: {each.finding} ({each.reason}); {hint}"


NOTHING: Final = Accepted()


def of(path: str, device: str) -> Accepted:
    """Give what the file at a path accepts of a device today; without a path nothing.

    Raises:
        UserError: The file cannot be read, is not of this kind, or of another device.

    """
    if "\0" in path:
        raise UserError(f"{path!a} is no path; give that of a file of known deviations")
    return read(Path(path), device, datetime.now(UTC).date()) if path else NOTHING


def read(path: Path, device: str, today: date) -> Accepted:
    """Give what a file accepts of a device on a day.

    Raises:
        UserError: The file cannot be read, is not of this kind, or of another device.

    """
    hint = "see docs/reports.md, or draft one: ecatspec run DEVICE --write-known FILE"
    try:
        file = msgspec.toml.decode(path.read_bytes(), type=_File)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise UserError(f"{path} is no file of known deviations ({why}); {hint}") from None
    if file.device != device:
        raise UserError(f"{path} is about {file.device}, not {device}; give the file of {device}")
    for each, times in Counter(known.finding for known in file.known).items():
        if times > 1:
            raise UserError(f"{path} has {each!r} {times} times; leave one of them")
    if empty := next((known for known in file.known if not known.reason.strip()), None):
        raise UserError(f"{path} gives no reason for {empty.finding!r}; say why it is accepted")
    over = tuple(k for k in file.known if k.until is not None and k.until < today)
    going = tuple(k for k in file.known if k not in over)
    return Accepted(str(path), going, over, {k.finding: _words(k) for k in going})


def _words(known: Known) -> str:
    end = "" if known.until is None else f" (until {known.until})"
    return f"known: {known.reason}{end}"


def draft(device: str, results: Iterable[Result], accepted: Accepted) -> str:
    """Give the file that accepts what was found; what was known and occurs keeps its reason."""
    before = {known.finding: known for known in (*accepted.known, *accepted.ended)}
    day = datetime.now(UTC).date()
    found: dict[str, Known] = {}
    for result in results:
        for finding in result.findings():
            if finding.verdict.outcome not in CAUSED:
                continue
            for verdict in (finding.verdict, *(kind for kind, _ in finding.kinds)):
                new = Known(
                    verdict.signature,
                    _UNEXPLAINED.format(day=day),
                    clause=verdict.broken,
                    title=verdict.title,
                )
                found[verdict.signature] = before.get(verdict.signature, new)
    data = msgspec.to_builtins(_File(device, tuple(found.values())), builtin_types=(date,))
    return _HEAD.format(device=device) + tomli_w.dumps(data)
