"""Runs a device in the process of the run: an exception of the device is its crash.

For devices that are ours: nothing keeps one from hanging, or from doing harm.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ParamSpec, TypeVar

from ecatspec.conformance.base.adapter import AdapterError, DeviceCrash, raise_local

if TYPE_CHECKING:
    from collections.abc import Callable

    from ecatspec.conformance.base.adapter import Adapter, Description, Restorable

_T = TypeVar("_T")
_P = ParamSpec("_P")


class Guarded:
    """An adapter whose exceptions are crashes of its device."""

    def __init__(self, adapter: Adapter) -> None:
        self._adapter = adapter

    def reset(self) -> None:
        """Power cycle."""
        self._adapter.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Give what the device answers."""
        return _answered(self._adapter.read, address, length)

    def write(self, address: int, data: bytes) -> int:
        """Give the working counter of a write."""
        return _answered(self._adapter.write, address, data)

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        _answered(self._adapter.advance, seconds)

    def local(self, event: str) -> None:
        """Raise a local event in the device."""
        _answered(raise_local, self._adapter, event)

    def close(self) -> None:
        """Release everything."""
        self._adapter.close()

    def describe(self) -> Description:
        """What was given."""
        return self._adapter.describe()


class GuardedSnapshots(Guarded):
    """The same of an adapter that can take snapshots of its device."""

    def __init__(self, adapter: Restorable) -> None:
        super().__init__(adapter)
        self._snapshots = adapter

    def snapshot(self) -> object:
        """Give what the device is now."""
        return self._snapshots.snapshot()

    def restore(self, snapshot: object) -> None:
        """Let the device be as it was then."""
        self._snapshots.restore(snapshot)


def _answered(ask: Callable[_P, _T], *arguments: _P.args, **words: _P.kwargs) -> _T:
    try:
        return ask(*arguments, **words)
    except AdapterError:
        raise
    except Exception as error:
        raise DeviceCrash(f"{type(error).__name__}: {error}") from error
