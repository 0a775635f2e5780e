"""Keeps a run in a file: each verdict is on disk as soon as it is given.

A results file is an SQLite database. What was judged is handed to the operating system at once, so
that no death of this process loses it, and forced onto the disk a moment later. Others can read the
file meanwhile, and only one process writes it: SQLite's own locks see to both, and they end with
the process that holds them.
"""

from __future__ import annotations

import sqlite3
import tempfile
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.base.verdict import Verdict
from ecatspec.conformance.base.version import version
from ecatspec.conformance.base.work_items import Judged, Learned

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from types import TracebackType
    from typing import Self

SCHEMA: Final = int.from_bytes(b"ecat")
"""Tells a results file from other databases."""
VERSION: Final = 1
_TABLES: Final = """
CREATE TABLE run (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE rule (number INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE step (
  number INTEGER PRIMARY KEY,
  name TEXT NOT NULL,
  seconds REAL NOT NULL,
  verdict TEXT NOT NULL,
  rules TEXT NOT NULL,
  learned TEXT NOT NULL
);
"""
_BASIS: Final = "basis"
_FINISHED: Final = "finished"
_FORCED: Final = 0.2
"""Seconds after which, at the latest, what is judged is forced onto the disk."""
_PATIENCE: Final = 1.0
"""Seconds to wait for who opens, closes or reads the file at this moment."""
_NO_OPTIONS: Final = {
    "digest": "is of other texts",
    "description": "is of a device that its adapter describes otherwise",
    "known": "has other known deviations",
}
"""What is said of parts of a set-up that nobody would want to read."""


@dataclass(frozen=True, slots=True)
class Basis:
    """All that the verdicts of a run follow from, beside the device itself."""

    device: str
    digest: str
    dut: str
    description: dict[str, Any]
    """What the adapter says of the device."""
    depth: str
    seed: int
    mailbox: str
    only: tuple[str, ...]
    version: str = version()
    choices: tuple[str, ...] = ()
    known: dict[str, str] = field(default_factory=dict)
    """The findings that are accepted, by their identity, and why."""


@dataclass(frozen=True, slots=True)
class FoundWay:
    """Which way a device goes at a choice, the cases that told it, and why that is risky."""

    way: str
    cases: tuple[str, ...]
    risk: str = ""


@dataclass(frozen=True, slots=True)
class Run:
    """A run as its file has it."""

    basis: Basis
    verdicts: tuple[Verdict, ...]
    finished: bool
    choices: Mapping[str, FoundWay] = field(default_factory=dict)


class Journal:
    """The results file of a run that goes on; `seconds` is how long it took until it was opened."""

    def __init__(self, path: Path, base: sqlite3.Connection) -> None:
        """Take a database that nobody else writes."""
        self._path = path
        self._base = base
        self._names: dict[int, str] = dict(base.execute("SELECT number, name FROM rule"))
        self._rules = {name: number for number, name in self._names.items()}
        self._count = 0
        rows = base.execute("SELECT name, verdict, rules, learned FROM step ORDER BY number")
        self._known: Iterator[Judged] = map(self._judged, rows)
        (before,) = base.execute("SELECT max(seconds) FROM step").fetchone()
        self.seconds: Final = float(before or 0)
        self._began = self._forced = time.monotonic()

    def _judged(self, row: tuple[str, str, str, str]) -> Judged:
        verdict = _verdict(self._names, *row[1:3])
        told = msgspec.json.decode(row[3], type=Learned)
        return Judged(row[0], verdict, replace(told, rules=(*told.rules, *verdict.rules)))

    def again(self, name: str) -> Judged | None:
        """Give the step that comes next, if it was judged before; None: from here on nothing was.

        Raises:
            UserError: Another step comes next in the file.

        """
        with _reading(self._path):
            judged = next(self._known, None)
        if judged is None:
            return None
        self._count += 1
        if judged.name != name:
            what = f"{self._path} goes on with {judged.name!r} where this run has {name!r}"
            raise UserError(f"{what}; it is of another suite: begin another run")
        return judged

    def keep(self, judged: Judged) -> None:
        """Add a step.

        Raises:
            UserError: The file cannot be written any more.

        """
        now = time.monotonic()
        force = now - self._forced >= _FORCED
        own = judged.verdict.rules
        learned = replace(
            judged.learned, rules=tuple(r for r in judged.learned.rules if r not in set(own))
        )
        new = [name for name in own if name not in self._rules]
        self._rules |= {name: number for number, name in enumerate(new, len(self._rules))}
        row = (
            self._count,
            judged.name,
            round(self.seconds + now - self._began, 3),
            _text(replace(judged.verdict, rules=())),
            _text([self._rules[name] for name in own]),
            _text(learned),
        )
        with _writing(self._path):
            self._base.execute(f"PRAGMA synchronous = {'FULL' if force else 'NORMAL'}")
            with self._base:
                self._base.execute("BEGIN")
                rules = ((self._rules[name], name) for name in new)
                self._base.executemany("INSERT INTO rule VALUES (?, ?)", rules)
                self._base.execute("INSERT INTO step VALUES (?, ?, ?, ?, ?, ?)", row)
        self._count += 1
        if force:
            self._forced = now

    def finish(self) -> None:
        """Say that nothing is left to judge."""
        with _writing(self._path):
            self._base.execute("PRAGMA synchronous = FULL")
            self._base.execute("INSERT OR REPLACE INTO run VALUES (?, 'true')", (_FINISHED,))

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave one file, without a companion that holds a part of it."""
        _end(self._base)


# --- beginnings -----------------------------------------------------------------------------------


def begin(path: Path, basis: Basis, *, resume: bool = False) -> Journal:
    """Open the journal of a new run, or with `resume` of the one in the file, which goes on.

    A finished run in the file gives way to a new one.

    Raises:
        UserError: The file is none of ours, holds a run that is not finished, or has to be resumed
            and holds a run of another set-up.

    """
    if "\0" in str(path):
        raise UserError(f"{str(path)!a} is no path; give that of a file")
    if not resume:
        with _writing(path):
            _create(path, basis)
    elif not path.exists():
        raise UserError(f"there is no run in {path} to resume; leave out --resume")
    base = _opened(path)
    try:
        with _writing(path):
            _own(base)
    except BaseException:
        base.close()
        raise
    try:
        _refuse_others(path, _basis_of(path, base), basis)
        return Journal(path, base)
    except BaseException:
        _end(base)
        raise


def _own(base: sqlite3.Connection) -> None:
    """Become the only one who writes, until the database is closed or the process ends."""
    base.execute("PRAGMA journal_mode = WAL")
    base.execute(
        "SELECT 1 FROM run"
    ).fetchone()  # from here on what is locked is shared with readers
    _exclude(base)
    # the end of the transaction leaves a lock that others may read beside, and not exclude
    base.execute("PRAGMA locking_mode = NORMAL")
    base.execute("COMMIT")


def _exclude(base: sqlite3.Connection) -> None:
    """Begin what nobody may see: it takes that nobody else has the database open."""
    base.execute("PRAGMA locking_mode = EXCLUSIVE")
    base.execute("BEGIN IMMEDIATE")


def _end(base: sqlite3.Connection) -> None:
    """Close a database that was written, as one file without a companion that holds a part of it.

    Somebody who reads it for long takes the companions away when closing it.
    """
    with suppress(sqlite3.Error):
        _exclude(base)
        base.execute("COMMIT")
        base.execute("PRAGMA journal_mode = DELETE")
    base.close()


def _create(path: Path, basis: Basis) -> None:
    """Put a file without a step in its place, whole or not at all; a finished run gives way."""
    if path.exists() and path.stat().st_size:
        _refuse_unfinished(path)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        new = Path(folder) / path.name
        base = sqlite3.connect(new, isolation_level=None)
        try:
            text = f"PRAGMA application_id = {SCHEMA}; PRAGMA user_version = {VERSION};{_TABLES}"
            base.executescript(f"BEGIN;{text}COMMIT;")
            base.execute("INSERT INTO run VALUES (?, ?)", (_BASIS, _text(basis)))
        finally:
            base.close()
        new.replace(path)


def _refuse_unfinished(path: Path) -> None:
    base = _opened(path, alone=True)
    try:
        _basis_of(path, base)
        finished = _is_finished(base)
    finally:
        base.close()
    if not finished:
        hint = "go on with it by --resume, or remove it"
        raise UserError(f"{path} holds a run that is not finished; {hint}")


def _refuse_others(path: Path, known: Basis, wanted: Basis) -> None:
    for each in fields(Basis):
        there, here = getattr(known, each.name), getattr(wanted, each.name)
        if there != here:
            what = _NO_OPTIONS.get(each.name, f"has {each.name} {there!r}, this one {here!r}")
            raise UserError(f"the run in {path} {what}; resume it as it was, or begin another")


# --- reading --------------------------------------------------------------------------------------


def read(path: Path) -> Run:
    """Give the run of a file as far as it goes; a run may write it meanwhile.

    Raises:
        UserError: It is no results file, or is damaged.

    """
    if not path.is_file():
        raise UserError(f"there is no file {str(path)!a}; give a results file")
    base = _opened(path)
    try:
        with _reading(path):
            base.execute("BEGIN")  # all that follows is of one moment
            basis = _basis_of(path, base)
            names = dict(base.execute("SELECT number, name FROM rule"))
            verdicts = []
            choices: dict[str, FoundWay] = {}
            rows = base.execute("SELECT verdict, rules, learned FROM step ORDER BY number")
            for verdict, rules, learned in rows:
                verdicts.append(_verdict(names, verdict, rules))
                _learn(choices, verdicts[-1].case, msgspec.json.decode(learned, type=Learned))
            return Run(basis, tuple(verdicts), _is_finished(base), choices)
    finally:
        base.close()


def _learn(choices: dict[str, FoundWay], case: str, told: Learned) -> None:
    """Add what a step told; where steps say different things of a choice the last one counts."""
    for name, way in told.choices.items():
        known = choices.get(name)
        cases = known.cases if known is not None and known.way == way else ()
        choices[name] = FoundWay(way, (*cases, case), told.risks.get(name, ""))


def _verdict(names: dict[int, str], verdict: str, rules: str) -> Verdict:
    own = tuple(names[number] for number in msgspec.json.decode(rules, type=list[int]))
    return replace(msgspec.json.decode(verdict, type=Verdict), rules=own)


def _opened(path: Path, *, alone: bool = False) -> sqlite3.Connection:
    """Open a database and see that it is whole and ours; `alone`: and that nobody writes it."""
    with _reading(path):
        name = f"{path.absolute().as_uri()}?mode=rw"  # one that was killed left more to be taken in
        base = sqlite3.connect(name, timeout=_PATIENCE, isolation_level=None, uri=True)
        try:
            if alone:
                base.execute("PRAGMA locking_mode = EXCLUSIVE")
            _check(path, base)
        except BaseException:
            base.close()
            raise
    return base


def _check(path: Path, base: sqlite3.Connection) -> None:
    (schema,) = base.execute("PRAGMA application_id").fetchone()
    (found,) = base.execute("PRAGMA user_version").fetchone()
    if schema != SCHEMA:
        raise UserError(f"{path} is no results file; give one that a run has written")
    if found != VERSION:
        what = f"{path} is a results file of version {found}, this ecatspec reads {VERSION}"
        raise UserError(f"{what}; read it with the ecatspec that wrote it")
    (health,) = base.execute("PRAGMA quick_check(1)").fetchone()
    if health != "ok":
        raise sqlite3.DatabaseError(health)


def _basis_of(path: Path, base: sqlite3.Connection) -> Basis:
    with _reading(path):
        row = base.execute("SELECT value FROM run WHERE name = ?", (_BASIS,)).fetchone()
        if row is None:
            raise UserError(f"{path} holds no run yet; remove it")
        return msgspec.json.decode(row[0], type=Basis)


def _is_finished(base: sqlite3.Connection) -> bool:
    return bool(base.execute("SELECT 1 FROM run WHERE name = ?", (_FINISHED,)).fetchone())


def _text(value: object) -> str:
    return msgspec.json.encode(value).decode()


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Say what is wrong with a file that is read."""
    try:
        yield
    except (sqlite3.Error, msgspec.MsgspecError, KeyError, UnicodeError) as error:
        _refuse_busy(path, error)
        what = f"{path} is no results file, or a damaged one ({error})"
        raise UserError(f"{what}; give one that a run has written") from None


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Say what is wrong with a file that is written."""
    try:
        yield
    except (sqlite3.Error, OSError) as error:
        _refuse_busy(path, error)
        hint = "make room or give another file"
        raise UserError(f"{path} cannot be written ({error}); {hint}") from None


def _refuse_busy(path: Path, error: Exception) -> None:
    code = getattr(error, "sqlite_errorcode", None)
    if code in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
        raise UserError(f"a run is writing {path}; wait for its end") from None
