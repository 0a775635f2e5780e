"""Proves layouts by trial: frames at their boundaries, and areas of the memory."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final

from ecatspec.model.core.register_map import BOOTSTRAP
from ecatspec.model.core.wording import typed_words
from ecatspec.model.symbolic.obligations import Finding, Obligation, Status
from ecatspec.spec.language.ir import Area, Bool, Bytes, Literal
from ecatspec.spec.language.kinds import bounds_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import FrameField, Type

MOST: Final = 300
"""Maximum number of combinations of a frame that are tried; the number is reported."""
_LENGTHS: Final = (0, 1, 4, 7, 8)
_PADDING: Final = "padding"


# --- frames ---------------------------------------------------------------------------------------


def round_trip(model: Model, obligation: Obligation) -> Finding:
    """Encode and decode a frame with all its fields at their boundaries, by the real codec."""
    frame = obligation.name
    at = model.protocol.frames[frame].at
    names, choices = _boundaries(model, frame)
    tried = fitting = 0
    for values in itertools.islice(_combined(choices), MOST):
        tried += 1
        given = dict(zip(names, values, strict=True))
        raw = model.codec.encode(frame, given)
        message = model.codec.decode(raw, model.codec.trail(frame)[0])
        if message is None or message.frame != frame:
            continue
        fitting += 1
        wrong = {name: value for name, value in given.items() if message.fields[name] != value}
        if wrong and not _refit(model, frame, wrong):
            lines = [f"{name} = {_said(model, frame, name, given[name])}" for name in given]
            lines += [
                f"{name} comes back as {_said(model, frame, name, message.fields[name])}"
                for name in wrong
            ]
            return Finding(obligation, Status.REFUTED, (*lines, f"bytes {raw.hex(' ')}"), (at,))
    if not fitting:
        line = f"none of {tried} messages is decoded as `{frame}`"
        return Finding(obligation, Status.REFUTED, (line, *_clash(model, frame)), (at,))
    line = f"{fitting} of {tried} combinations of boundary values are this frame"
    return Finding(obligation, Status.BOUNDED, (line,), depth=tried)


def _refit(model: Model, frame: str, wrong: dict[str, Value]) -> bool:
    """Tell whether only byte strings differ, whose length other fields fix."""
    types = {
        field.name: field.type
        for layout in model.codec.trail(frame)
        for field in model.protocol.frames[layout].fields
    }
    return all(isinstance(types[name], Bytes) for name in wrong)


def _clash(model: Model, frame: str) -> Iterator[str]:
    """Say which constants of a frame and of those around it contradict each other."""
    said: dict[str, tuple[Value, str]] = {}
    for layout in model.codec.trail(frame):
        fixed = model.codec.fixed(layout)
        for name, value in fixed.items():
            if name in said and said[name][0] != value:
                first, outer = said[name]
                yield f"{name} is {first!r} in `{outer}` and {value!r} in `{layout}`"
            said[name] = (value, layout)


def _combined(choices: list[tuple[Value, ...]]) -> Iterator[tuple[Value, ...]]:
    """Yield the first values, each field at each of its boundaries by itself, then all together."""
    first = tuple(values[0] for values in choices)
    yield first
    for place, values in enumerate(choices):
        for value in values[1:]:
            yield (*first[:place], value, *first[place + 1 :])
    yield from itertools.product(*choices)


def _boundaries(model: Model, frame: str) -> tuple[list[str], list[tuple[Value, ...]]]:
    codec = model.codec
    names: list[str] = []
    choices: list[tuple[Value, ...]] = []
    for layout in codec.trail(frame):
        fields = model.protocol.frames[layout].fields
        for field in fields:
            body = field is fields[-1] and layout != frame
            left = body or field.filled is not None or codec.is_derived(frame, field.name)
            if not left and field.name not in codec.fixed(frame) and field.name != _PADDING:
                names.append(field.name)
                choices.append(_values(model, field))
    return names, choices


def _values(model: Model, field: FrameField) -> tuple[Value, ...]:
    match field.type:
        case Bool():
            return False, True
        case Bytes(length=Literal(value=size)):
            return (bytes(range(1, size + 1)),)
        case Bytes():
            return tuple(bytes(range(1, length + 1)) for length in _LENGTHS)
        case kind:
            low, high = bounds_of(model.protocol, kind) or (0, 1)
            return tuple(dict.fromkeys((0, low, high, 1)))


def _said(model: Model, frame: str, name: str, value: Value) -> str:
    for layout in reversed(model.codec.trail(frame)):
        for field in model.protocol.frames[layout].fields:
            if field.name == name:
                kind: Type = field.type
                return typed_words(model, kind, value)
    return str(value)


# --- memory ---------------------------------------------------------------------------------------


def memory(model: Model, obligation: Obligation) -> Finding:
    """Compare the areas that parameters name with each other and with the memory."""
    protocol = model.protocol
    size = model.parameter("memory_size")
    areas = {
        name: (model.parameter(name, "start"), model.parameter(name, "length"))
        for name, parameter in protocol.parameters.items()
        if isinstance(parameter.type, Area)
    }
    lines: list[str] = []
    places = []
    for name, (start, length) in areas.items():
        if start + length > size:
            lines.append(f"{_area(name, start, length)} ends beyond the memory of {size} bytes")
            places.append(protocol.parameters[name].at)
    for one, other in itertools.combinations(areas, 2):
        if (one in BOOTSTRAP.values()) != (other in BOOTSTRAP.values()):
            continue  # they are not there at the same time
        (first, much), (second, more) = areas[one], areas[other]
        if first < second + more and second < first + much:
            lines.append(f"{_area(one, first, much)} and {_area(other, second, more)} overlap")
            places += [protocol.parameters[one].at, protocol.parameters[other].at]
    if lines:
        return Finding(obligation, Status.REFUTED, tuple(lines), tuple(places))
    return Finding(obligation, Status.PROVED, tuple(_noted(model)))


def _noted(model: Model) -> Iterator[str]:
    """Say what an anomaly tells of areas."""
    for anomaly in model.protocol.anomalies:
        parameter = model.protocol.parameters.get(anomaly.subject)
        if parameter is not None and isinstance(parameter.type, Area):
            yield f"{anomaly.id} {anomaly.subject}: {anomaly.normative}; {anomaly.treatment}"


def _area(name: str, start: int, length: int) -> str:
    return f"{name} (0x{start:04X} to 0x{start + length - 1:04X})"
