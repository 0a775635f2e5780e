"""A cache of limited size, which forgets its oldest entry for a new one."""

from __future__ import annotations

from collections import OrderedDict
from typing import TypeVar

_K = TypeVar("_K")
_V = TypeVar("_V")


class Cache(OrderedDict[_K, _V]):
    """Values by key, in the order in which they were kept."""

    __slots__ = ("_limit",)

    def __init__(self, limit: int) -> None:
        """Begin empty; `limit` is the highest number of entries."""
        super().__init__()
        self._limit = limit

    def keep(self, key: _K, value: _V) -> None:
        """Add an entry that is not there yet; the oldest goes where there are too many."""
        if len(self) >= self._limit:
            self.popitem(last=False)
        self[key] = value
