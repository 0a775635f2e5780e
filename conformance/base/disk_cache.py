"""Keeps on disk, between starts, what takes long to compute."""

from __future__ import annotations

import hashlib
import os
import pickle
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, TypeVar

from platformdirs import user_cache_path

from ecatspec.conformance.base.atomic_write import whole

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

_T = TypeVar("_T")


def folder() -> Path | None:
    """Give where things are kept between starts; None: nowhere.

    They are unpickled, so the folder must be one that nobody else can write to.
    """
    try:
        place = user_cache_path("ecatspec", appauthor=False)
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = place.stat()
    except (OSError, RuntimeError):
        return None
    own = status.st_uid == os.getuid() if hasattr(os, "getuid") else True
    return place if own and not status.st_mode & 0o022 else None


class DiskCache:
    """Keeps answers as files in the folder of caches of this user."""

    def kept(
        self, name: str, source: bytes, make: Callable[[], _T], program: tuple[str, ...]
    ) -> _T:
        """Give what `make` gives, or gave at an earlier start for the same source and program."""
        place = folder()
        if place is None:
            return make()
        file = place / f"{name}.pickle"
        key = hashlib.sha256(digest_of(program) + source).digest()
        # a file may have been cut off, or be of another version: then the answer is made anew
        with suppress(Exception):
            stored, answer = pickle.loads(file.read_bytes())  # noqa: S301  the folder is one's own
            if stored == key:
                found: _T = answer
                return found
        made = make()
        with suppress(OSError), whole(file) as written:
            _Pickler(written, pickle.HIGHEST_PROTOCOL).dump((key, made))
        return made


class _Pickler(pickle.Pickler):
    """Takes a dataclass as the call that makes it: so it comes back in half the time."""

    def reducer_override(self, value: object) -> Any:  # noqa: ANN401  what pickle defines
        if is_dataclass(value) and not isinstance(value, type):
            return type(value), tuple(getattr(value, each.name) for each in fields(value))
        return NotImplemented


@cache
def digest_of(packages: tuple[str, ...]) -> bytes:
    """Give a digest of the source of packages and of those in them."""
    digest = hashlib.sha256()
    waiting = [resources.files(package) for package in packages]
    while waiting:
        for part in sorted(waiting.pop().iterdir(), key=lambda part: part.name):
            if part.name.endswith((".py", ".lark")):
                digest.update(part.name.encode() + b"\0" + part.read_bytes())
            elif part.is_dir() and not part.name.startswith("__"):
                waiting.append(part)
    return digest.digest()
