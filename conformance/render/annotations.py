"""Writes annotations of GitHub: lines in a log that are shown at a place in a file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from ecatspec.conformance.render.marks import plain

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import TypeAlias

    Kind: TypeAlias = Literal["error", "warning", "notice"]


def annotation(
    kind: Kind, *lines: str, title: str = "", place: Mapping[str, object] | None = None
) -> str:
    """Give an annotation, which is one line here; `place` has `file`, `line` and `col`."""
    told = {**(place or {}), **({"title": title} if title else {})}
    where = ",".join(f"{name}={_property(plain(str(value)))}" for name, value in told.items())
    message = "%0A".join(_data(plain(line)) for line in lines)
    return f"::{kind}{' ' if where else ''}{where}::{message}"


def _data(text: str) -> str:
    return text.replace("%", "%25")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")
