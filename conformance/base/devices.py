"""Loads the specification that a user named."""

from __future__ import annotations

import difflib
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.disk_cache import DiskCache
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.ir import (
    Literal,
    Pin,
)
from ecatspec.spec.language.load import UnknownDevice, load_device, load_file
from ecatspec.spec.language.store import keep_in

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ecatspec.spec.language.ir import (
        Protocol,
    )

SUFFIX = ".ecs"
TRUTHS: Final[Mapping[str, bool]] = MappingProxyType({"false": False, "true": True})
"""How users say that a device meets a condition, or does not."""
_MAILBOXES = 2
_ALIGNMENT = 16
_MANY = 20
"""From this number of names on, they are not listed in one line."""
"""A mailbox that has to make room begins at a multiple of this number of bytes."""


class UserError(Exception):
    """Input or set-up is wrong: one line with what is wrong and what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


keep_in(DiskCache())


def load(name_or_path: str, mailbox: str = "") -> Protocol:
    """Load a shipped device text by name or a text file by its path, which ends in `.ecs`.

    `mailbox` gives the areas another length: `SIZE`, or `OUT:IN` in bytes.

    Raises:
        UserError: There is no such device or file, or the mailbox cannot be so long.
        SpecError: The text is wrong.

    """
    protocol = _load(name_or_path)
    return _resized(protocol, mailbox) if mailbox else protocol


def _resized(protocol: Protocol, mailbox: str) -> Protocol:
    model = Model(protocol)
    low, high = (model.parameter(f"{word}_mailbox") for word in ("minimal", "maximal"))
    words = mailbox.split(":")
    sizes = [int(word) for word in words if word.isascii() and word.isdigit()]
    if not 1 <= len(words) == len(sizes) <= _MAILBOXES or not all(low <= n <= high for n in sizes):
        message = f"{mailbox!r} is no mailbox size; give SIZE or OUT:IN in bytes, {low} to {high}"
        raise UserError(message)
    out, back = (protocol.parameters[name] for name in ("mailbox_out", "mailbox_in"))
    first, second = (model.parameter(part.name, "start") for part in (out, back))
    if first < second:
        second = max(second, -(-(first + sizes[0]) // _ALIGNMENT) * _ALIGNMENT)
    else:
        first = max(first, -(-(second + sizes[-1]) // _ALIGNMENT) * _ALIGNMENT)
    if max(first + sizes[0], second + sizes[-1]) > model.parameter("memory_size"):
        raise UserError(f"mailboxes of {mailbox} do not fit into the memory; give smaller sizes")
    areas = {
        part.name: replace(part, value=(Literal(start, 4), Literal(size)))
        for part, start, size in ((out, first, sizes[0]), (back, second, sizes[-1]))
    }
    return replace(protocol, parameters=protocol.parameters | areas)


def _load(name_or_path: str) -> Protocol:
    if not name_or_path.endswith(SUFFIX):
        return _shipped(name_or_path)
    try:
        return load_file(name_or_path)
    except OSError as error:
        why = error.strerror or type(error).__name__
        message = f"{name_or_path}: the file cannot be read ({why}); give the path of a text"
    except ValueError as error:
        message = f"{name_or_path!a} is no path ({error}); give the path of a text"
    except RecursionError:
        message = f"{name_or_path}: an expression is nested too deeply; split it by definitions"
    raise UserError(message)


def pinned(protocol: Protocol, ways: Mapping[str, str]) -> Protocol:
    """Give the device that goes these ways at choices, where its text leaves them open."""
    pins = {name: Pin(name, way, ()) for name, way in ways.items()}
    return replace(protocol, pins=pins | protocol.pins)


def going(protocol: Protocol, ways: Mapping[str, str]) -> Protocol:
    """Give the device that goes one way at every choice: as its text or `ways` say, or the first.

    That is how the virtual SubDevice goes, so that its session need not follow any other.
    """
    firsts = {name: choice.alternatives[0].name for name, choice in protocol.choices.items()}
    return pinned(protocol, firsts | dict(ways))


def assuming(protocol: Protocol, truths: Mapping[str, str]) -> Protocol:
    """Give the device that meets conditions, or does not, as `truths` say."""
    conditions = protocol.conditions
    other = {n: replace(conditions[n], assumed=TRUTHS[truth]) for n, truth in truths.items()}
    return replace(protocol, conditions=dict(conditions) | other)


def nearest(what: str, name: str, known: Sequence[str]) -> UserError:
    """Make the error for a name that does not exist."""
    near = difflib.get_close_matches(name, known, 1, 0.4)
    if near:
        hint = f"did you mean {near[0]!r}?"
    elif len(known) > _MANY:
        hint = f"there are {len(known)}, for instance {known[0]!r}"
    else:
        hint = f"there are {', '.join(known)}"
    return UserError(f"no {what} is called {name!r}; {hint}")


def _shipped(name: str) -> Protocol:
    try:
        return load_device(name)
    except UnknownDevice as error:
        message = str(error)
    if len(Path(name).parts) > 1 or Path(name).exists():
        message = f"{name!r} is no device; give a name, or the path of a text that ends in {SUFFIX}"
    raise UserError(message)
