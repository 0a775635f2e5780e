"""The only place for running cases that begin alike without doing their beginning again."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.adapter import Description
from ecatspec.conformance.adapters.model import VirtualAdapter
from ecatspec.conformance.runner import Runner
from ecatspec.conformance.session import NOTHING, Session
from ecatspec.model.buffers import Buffers, Channel
from ecatspec.model.compiled import Model
from ecatspec.model.esc import Esc
from ecatspec.model.oracle.oracle import Oracle
from ecatspec.model.state import State
from ecatspec.model.subdevice import VirtualSubDevice

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping

    from ecatspec.generators.case import Stimulus
    from ecatspec.model.values import ObjectKey

_OWN: Final = tuple(item.name for item in fields(Session) if item.name not in {"adapter", "model"})
_PATHS = 4
"""So many beginnings are kept: what a device was known to do, and to have, at power-on."""
_LONGEST = 60
"""What comes after so many stimuli is not kept."""


@dataclass
class Seen:
    """What a test sees inside of a device; an attribute of the adapter, it is kept with it."""

    rules: set[str] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class _Kept:
    """What a part of the device was when it was looked at, and the part."""

    part: object
    variables: dict[str, object]


_PARTS: Final = (VirtualAdapter, VirtualSubDevice, Esc, Buffers, Seen)
_STAYS: Final = frozenset(
    {type(None), bool, int, float, str, bytes, tuple, frozenset, State, Channel, Model, Description}
)
"""Most of what is looked at; the other kinds take longer to be told apart."""


def _taken(thing: object) -> object:
    """Give a copy of what changes in a virtual device; all else is what it was."""
    if type(thing) in _STAYS:
        return thing
    if isinstance(thing, _PARTS):
        return _Kept(thing, {name: _taken(value) for name, value in vars(thing).items()})
    match thing:
        case list():
            return [bytearray(each) if isinstance(each, bytearray) else each for each in thing]
        case dict():
            return {key: _taken(value) for key, value in thing.items()}
        case set() | bytearray():
            return thing.copy()
        case Oracle():
            return replace(thing)
        case _:
            return thing


def _given(thing: object) -> object:
    """Put back what `_taken` gave, which stays as it is."""
    if type(thing) in _STAYS:
        return thing
    match thing:
        case _Kept(part, variables):
            vars(part).update({name: _given(value) for name, value in variables.items()})
            return part
        case dict():
            return {key: _given(value) for key, value in thing.items()}
        case _:
            return _taken(thing)


@dataclass(frozen=True, slots=True)
class _Point:
    """Where a session was after a stimulus."""

    stimulus: Stimulus | None
    session: tuple[object, ...]
    device: object


@dataclass(slots=True)
class Resumed(Session):
    """A session with a virtual device that goes on where a case differs from the one before.

    Device and oracle are functions of what was done since power-on, so that what they were after
    the same stimuli is what they would be again.
    """

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
            _given(self._path[self._at].device)
            self._elsewhere = False

    def _point(self, stimulus: Stimulus | None) -> _Point:
        own = tuple(_taken(getattr(self, name)) for name in _OWN)
        return _Point(stimulus, own, _taken(self.adapter))

    def _see(self) -> None:
        """Take what the session was at this point; the device is put there once it is needed."""
        for name, value in zip(_OWN, self._path[self._at].session, strict=True):
            setattr(self, name, _taken(value))
        self._elsewhere = True


def resumed(model: Model, adapter: VirtualAdapter) -> Runner:
    """Give a runner that does not do again what cases have in common at their beginning."""
    runner = Runner(model, adapter, adapter.describe())
    oracle = runner.executor.session.oracle
    runner.executor.session = Resumed(adapter, model, oracle)
    return runner
