"""Writes test vectors as canonical JSON, one test a line."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import IO

    from ecatspec.generators.vectors.schema import Head, Test


def write(head: Head, tests: Iterable[tuple[str, Test]], out: IO[bytes]) -> None:
    """Write a file; keys are in the order of the types, and what is at its default is left out."""
    encode = msgspec.json.Encoder().encode
    fields = msgspec.structs.asdict(head)
    out.write(b"{\n")
    for name, value in fields.items():
        out.write(b" " + encode(name) + b": " + encode(value) + b",\n")
    out.write(b' "testGroups": [')
    for number, (layer, group) in enumerate(groupby(tests, key=lambda each: each[0])):
        out.write(b",\n" if number else b"\n")
        out.write(b'  {"type": ' + encode(layer) + b', "tests": [')
        for place, (_, test) in enumerate(group):
            out.write((b",\n   " if place else b"\n   ") + encode(test))
        out.write(b"\n  ]}")
    out.write(b"\n ]\n}\n")
