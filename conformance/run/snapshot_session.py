"""A session that does not play again what a case has in common with the one before."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, cast

from ecatspec.conformance.run.device_link import NOTHING, SessionSnapshot
from ecatspec.conformance.run.session import Session

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping

    from ecatspec.conformance.base.adapter import Restorable
    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.values import ObjectKey

_BEGINNINGS: Final = 4
"""Maximum number of beginnings (ways and objects known at power-on) with snapshots."""
_LONGEST: Final = 60
"""Maximum number of stimuli of a case behind which snapshots are taken."""


@dataclass(frozen=True, slots=True)
class _Point:
    """Session and device after a stimulus; None: after power-on."""

    stimulus: Stimulus | None
    session: SessionSnapshot
    device: object


@dataclass(slots=True)
class SnapshotSession(Session):
    """A session with a device that can be set back.

    Device and oracle are functions of what was done since power-on: after the same stimuli they
    are what they were.
    """

    _paths: dict[Hashable, list[_Point]] = field(default_factory=dict)
    """The points of the last case, by what it began with."""
    _path: list[_Point] = field(default_factory=list)
    _at: int = 0
    _elsewhere: bool = False
    """The device is not where the session is."""
    _nested: bool = False
    """A stimulus is made of others."""

    def begin(
        self,
        choices: dict[str, str],
        objects: Mapping[ObjectKey, bytes] = NOTHING,
        *,
        cold: bool = True,
    ) -> None:
        """Power cycle the device, or take it for what it was after an earlier power cycle."""
        known = self._begun_with(choices, objects, cold)
        path = self._paths.pop(known, None)
        if path is None:
            Session.begin(self, choices, objects, cold=cold)
            path = [self._point(None)]
            if len(self._paths) == _BEGINNINGS:
                del self._paths[next(iter(self._paths))]
        self._paths[known] = self._path = path
        self._at = 0
        self._go_to_point()

    def apply(self, stimulus: Stimulus) -> None:
        """Give one stimulus, or take what it led to before."""
        if self._nested:
            Session.apply(self, stimulus)
            return
        after = self._at + 1
        if after < len(self._path) and self._path[after].stimulus == stimulus:
            self._at = after
            self._go_to_point()
            return
        self.arrive()
        if self._at < len(self._path):
            del self._path[after:]
        self._nested = True
        try:
            Session.apply(self, stimulus)
        finally:
            self._nested = False
            self._at = after
        if after == len(self._path) <= _LONGEST:
            self._path.append(self._point(stimulus))

    def arrive(self) -> None:
        """Put the device where the session is."""
        if self._elsewhere:
            self._device.restore(self._path[self._at].device)
            self._elsewhere = False

    @property
    def _device(self) -> Restorable:
        return cast("Restorable", self.adapter)

    def _begun_with(
        self,
        choices: Mapping[str, str],
        objects: Mapping[ObjectKey, bytes],
        cold: bool,  # noqa: FBT001
    ) -> Hashable:
        return tuple(sorted(choices.items())), tuple(sorted(objects.items())), cold

    def _point(self, stimulus: Stimulus | None) -> _Point:
        return _Point(stimulus, self.snapshot(), self._device.snapshot())

    def _go_to_point(self) -> None:
        """Take what the session was at this point; the device is put there once it is needed."""
        self.restore(self._path[self._at].session)
        self._elsewhere = True
