"""Runs cases that begin alike without doing their beginning again."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.run.session import NOTHING, Session, SessionSnapshot

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping

    from ecatspec.conformance.adapters.model import VirtualAdapter
    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.model.esc.subdevice import Snapshot

_PATHS = 4
"""So many beginnings are kept: what a device was known to do, and to have, at power-on."""
_LONGEST = 60
"""What comes after so many stimuli is not kept."""


@dataclass(frozen=True, slots=True)
class _Point:
    """Where a session was after a stimulus."""

    stimulus: Stimulus | None
    session: SessionSnapshot
    device: Snapshot
    rules: frozenset[str]


@dataclass(slots=True)
class Resumed(Session):
    """A session with a virtual device that goes on where a case differs from the one before.

    Device and oracle are functions of what was done since power-on, so that what they were after
    the same stimuli is what they would be again.
    """

    device: VirtualAdapter = field(kw_only=True)
    rules: set[str] = field(default_factory=set)
    """What a test sees inside of the device, put where the device is."""
    _paths: dict[Hashable, list[_Point]] = field(default_factory=dict)
    _path: list[_Point] = field(default_factory=list)
    _at: int = 0
    _elsewhere: bool = False
    """The device is not where the session is."""
    _inside: bool = False
    """A stimulus is made of others."""

    def begin(
        self,
        choices: dict[str, str],
        objects: Mapping[ObjectKey, bytes] = NOTHING,
        *,
        cold: bool = True,
    ) -> None:
        """Power cycle the device, or take it for what it was then."""
        known = (tuple(sorted(choices.items())), tuple(sorted(objects.items())), cold)
        path = self._paths.pop(known, None)
        if path is None:
            Session.begin(self, choices, objects, cold=cold)
            path = [self._point(None)]
            if len(self._paths) == _PATHS:
                del self._paths[next(iter(self._paths))]
        self._paths[known] = self._path = path
        self._at = 0
        self._see()

    def apply(self, stimulus: Stimulus) -> None:
        """Give one stimulus, or take what it did before."""
        if self._inside:
            Session.apply(self, stimulus)
            return
        after = self._at + 1
        if after < len(self._path) and self._path[after].stimulus == stimulus:
            self._at = after
            self._see()
            return
        self.arrive()
        if self._at < len(self._path):
            del self._path[after:]
        self._inside = True
        try:
            Session.apply(self, stimulus)
        finally:
            self._inside = False
            self._at = after
        if after == len(self._path) < _LONGEST:
            self._path.append(self._point(stimulus))

    def arrive(self) -> None:
        """Put the device where the session is."""
        if self._elsewhere:
            point = self._path[self._at]
            self.device.restore(point.device)
            self.rules.clear()
            self.rules.update(point.rules)
            self._elsewhere = False

    def _point(self, stimulus: Stimulus | None) -> _Point:
        return _Point(stimulus, self.snapshot(), self.device.snapshot(), frozenset(self.rules))

    def _see(self) -> None:
        """Take what the session was at this point; the device is put there once it is needed."""
        self.restore(self._path[self._at].session)
        self._elsewhere = True


def resumed(model: Model, adapter: VirtualAdapter, rules: set[str] | None = None) -> Runner:
    """Give a runner that does not do again what cases have in common at their beginning.

    `rules` is what a test keeps of the device, and goes on from where the device does.
    """
    runner = Runner(model, adapter, adapter.describe())
    oracle = runner.executor.session.oracle
    runner.executor.session = Resumed(
        adapter, runner.model, oracle, device=adapter, rules=set() if rules is None else rules
    )
    return runner
