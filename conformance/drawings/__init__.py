"""The table of drawings: the forms in which a machine can be drawn.

A drawing is a file here with `drawing(protocol, machine) -> str` and a row in DRAWINGS. Same texts,
same characters: nothing depends on time, chance or the order of a hash.
"""

from __future__ import annotations

import importlib
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ecatspec.spec.language.ir import Protocol

    Drawing = Callable[[Protocol, str], str]


def _make(module: str, protocol: Protocol, machine: str) -> str:
    drawing = cast("Drawing", importlib.import_module(f"{__name__}.{module}").drawing)
    return drawing(protocol, machine)


DRAWINGS: Final[Mapping[str, Drawing]] = MappingProxyType(
    {
        "svg": partial(_make, "svg"),
        "mermaid": partial(_make, "mermaid"),
        "dot": partial(_make, "dot"),
    }
)
