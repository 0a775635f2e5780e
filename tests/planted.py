"""Devices that violate a claim, as the files in tests/claims say it by hand.

A violation is an edit of the text of a device, or where that has no such place, of the standard:
lines with `-` are what is there and lines with `+` after them what stands there instead; where no
`+` follows, each line that holds such a part goes. `case` names a case that finds it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ecatspec.spec.language.merge import merge_device, merge_standard
from ecatspec.spec.language.parse import parse_text

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.spec.language.ir import Protocol

CLAIMS: Final = Path(__file__).with_name("claims")
_HEAD: Final = re.compile(r'^violation (\S+) "([^"]*)"(?: case (\S+))?$')


@dataclass(frozen=True, slots=True)
class Violation:
    """A claim of a manual, what a device does instead, and a case that finds it."""

    device: str
    claim: str
    wording: str
    case: str
    edits: tuple[tuple[str, str | None], ...]

    def protocol(self) -> Protocol:
        """Give the texts of the device that violates the claim."""
        sources = _texts(self.device)
        texts = dict(sources)
        for old, new in self.edits:
            name = _holding(texts, old, self.claim)
            texts[name] = _edited(texts[name], old, new)
        # not checked: what is wrong here is meant to be
        own, *parsed = (_parsed(text, name) for name, text in texts.items())
        standard, wrong = merge_standard(parsed)
        protocol, more = merge_device(standard, own)
        assert not wrong + more, (self.claim, wrong, more)
        return replace(protocol, digest=self.claim)


def violations() -> Iterator[Violation]:
    """Yield all violations of all files."""
    for file in sorted(CLAIMS.glob("*.txt")):
        blocks = re.split(r"\n(?=violation )", file.read_text(encoding="utf-8"))
        for head, _, body in (block.strip("\n").partition("\n") for block in blocks):
            found = _HEAD.match(head)
            assert found is not None, head
            claim, wording, case = found.groups()
            yield Violation(file.stem, claim, wording, case or "", tuple(_edits(body)))


def _edits(body: str) -> Iterator[tuple[str, str | None]]:
    groups = re.findall(r"((?:^-.*\n?)+)((?:^\+.*\n?)*)", body, re.MULTILINE)
    for old, new in groups:
        if new:
            yield _plain(old), _plain(new)
        else:
            yield from ((line, None) for line in _plain(old).split("\n"))


def _plain(lines: str) -> str:
    return "\n".join(line[2:] for line in lines.rstrip("\n").split("\n"))


@cache
def _texts(device: str) -> dict[str, str]:
    """Give the texts, that of the device first."""
    folder = files("ecatspec.spec")
    found = {device: (folder / "devices" / f"{device}.ecs").read_text(encoding="utf-8")}
    for text in sorted((folder / "standard").iterdir(), key=lambda text: text.name):
        if text.name.endswith(".ecs"):
            found[text.name] = text.read_text(encoding="utf-8")
    return found


_parsed = cache(parse_text)


def _holding(texts: dict[str, str], part: str, claim: str) -> str:
    """Give the first text that holds a part; it must be clear which place is meant."""
    name = next((name for name, text in texts.items() if part in text), None)
    assert name is not None, f"{claim}: no text has {part!r}"
    assert texts[name].count(part) == 1, f"{claim}: {name} has {part!r} more than once"
    return name


def _edited(text: str, old: str, new: str | None) -> str:
    if new is not None:
        return text.replace(old, new)
    return "\n".join(line for line in text.split("\n") if old not in line)
