"""Loads texts: shipped texts with device texts on top, merged to one Protocol."""

from __future__ import annotations

import difflib
import hashlib
import os
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from ecatspec.spec.language.diagnostics import SpecError
from ecatspec.spec.language.ir import STANDARD, Fault
from ecatspec.spec.language.merge import merge_device, merge_standard, with_fault
from ecatspec.spec.language.store import kept

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.resources.abc import Traversable

    from ecatspec.spec.language.diagnostics import Diagnostic
    from ecatspec.spec.language.ir import Protocol, SourceText


class UnknownDevice(LookupError):  # noqa: N818
    """No text of that name is shipped."""

    def __init__(self, name: str) -> None:
        known = (STANDARD, *device_names())
        near = difflib.get_close_matches(name, known, 1, 0.4)
        hint = f"did you mean `{near[0]}`?" if near else f"there are {', '.join(known)}"
        super().__init__(f"no device text is called `{name}`; {hint}")


def device_names() -> tuple[str, ...]:
    """All devices that texts are shipped for, in alphabetical order."""
    return tuple(sorted(file.name.removesuffix(".ecs") for file in _files("devices")))


def standard_texts() -> tuple[SourceText, ...]:
    """The texts of the standard as they are written, not yet put together."""
    return tuple(_shipped("standard", file.name) for file in _files("standard"))


@cache
def load_standard() -> Protocol:
    """The standard as shipped; its checks are a matter of tests, not of every start."""
    return kept(STANDARD, _shipped_bytes(), lambda: _together(standard_texts(), STANDARD))


@cache
def load_device(name: str) -> Protocol:
    """The standard as the device `name` keeps it; the name `standard` gives the standard itself."""
    if name == STANDARD:
        return load_standard()
    for file in _files("devices"):
        if file.name == f"{name}.ecs":
            source = _shipped_bytes() + _bytes("devices", file.name)
            return kept(f"device-{name}", source, lambda: _device(name))
    raise UnknownDevice(name)


def _device(name: str) -> Protocol:
    return _together((*standard_texts(), _shipped("devices", f"{name}.ecs")), name)


def load_file(path: str | Path) -> Protocol:
    """A text of one's own: a device on the shipped standard, or in the place of a shipped text.

    A text that was found sound is not checked again while it and the shipped ones stay as they are.
    """
    raw = Path(path).read_bytes()
    source = _shipped_bytes() + os.fsencode(path) + b"\0" + raw
    name = hashlib.sha256(os.fsencode(Path(path).name)).hexdigest()[:16]
    return kept(f"own-{name}", source, lambda: _compiled(raw, str(path)))


def _compiled(raw: bytes, file: str) -> Protocol:
    text = _parsed(raw, file)
    shipped = standard_texts()
    if text.extends is not None:
        return compile_texts((*shipped, text), text.name)
    names = [other.name for other in shipped]
    if text.faults or text.name not in names:
        return compile_texts((*shipped, text), STANDARD)
    return compile_texts([text if o.name == text.name else o for o in shipped], STANDARD)


@cache
def load_link() -> Protocol:
    """What a SubDevice has for the way to it, which no suite judges: data link, EEPROM."""
    return _together([_shipped("link", file.name) for file in _files("link")], STANDARD)


@cache
def load_faults() -> dict[str, Fault]:
    """All planted faults that are shipped, by name, in the order of their texts."""
    texts = [_shipped("faults", file.name) for file in _files("faults")]
    faults = [d for text in texts for d in text.declarations if isinstance(d, Fault)]
    return {fault.name: fault for fault in faults}


def plant(protocol: Protocol, fault: Fault) -> Protocol:
    """What a device with this mistake takes for its specification."""
    faulty, findings = with_fault(protocol, fault)
    _raise(findings)
    return faulty


def compile_texts(texts: Sequence[SourceText], name: str | None = None) -> Protocol:
    """One Protocol of all standard texts and the device text `name`, or all that is wrong.

    Without a name the only device text is taken, if there is one.
    """
    # what has been checked is kept, so most starts need no checks
    from ecatspec.spec.language.check import (  # noqa: PLC0415
        check_device,
        check_protocol,
        check_words,
    )
    from ecatspec.spec.language.check.texts import check_texts  # noqa: PLC0415

    chosen = _chosen(texts, name)
    _raise(check_texts(chosen))
    protocol = _together(chosen, name)
    _raise(check_protocol(protocol))
    for device in (text for text in chosen if text.extends is not None):
        _raise(check_device(protocol, device, (t for t in chosen if t.extends is None)))
    for fault in (d for text in chosen for d in text.declarations if isinstance(d, Fault)):
        faulty, findings = with_fault(protocol, fault)
        _raise(findings or check_words(faulty))
    return protocol


def _chosen(texts: Sequence[SourceText], name: str | None) -> list[SourceText]:
    return [text for text in texts if text.extends is None or name in {None, text.name}]


def _together(texts: Sequence[SourceText], name: str | None) -> Protocol:
    chosen = _chosen(texts, name)
    standard = [text for text in chosen if text.extends is None]
    protocol, findings = merge_standard(standard)
    _raise(findings)
    for device in (text for text in chosen if text.extends is not None):
        protocol, findings = merge_device(protocol, device)
        _raise(findings)
    digest = hashlib.sha256("".join(text.digest for text in chosen).encode()).hexdigest()
    return replace(protocol, digest=digest)


def _raise(findings: Sequence[Diagnostic]) -> None:
    if findings:
        raise SpecError(tuple(sorted(findings, key=lambda found: (found.at, found.code.name))))


def _files(folder: str) -> list[Traversable]:
    place = resources.files("ecatspec.spec").joinpath(folder)
    if not place.is_dir():
        return []
    return sorted((f for f in place.iterdir() if f.name.endswith(".ecs")), key=lambda f: f.name)


@cache
def _shipped(folder: str, name: str) -> SourceText:
    raw = _bytes(folder, name)
    return kept(f"{folder}-{name}", raw, lambda: _parsed(raw, f"spec/{folder}/{name}"))


@cache
def _shipped_bytes() -> bytes:
    """Give the texts of the standard as they lie there: what rests on them is kept for these."""
    return b"".join(_bytes("standard", file.name) for file in _files("standard"))


def _bytes(folder: str, name: str) -> bytes:
    return resources.files("ecatspec.spec").joinpath(folder, name).read_bytes()


def _parsed(raw: bytes, file: str) -> SourceText:
    # what has been parsed is kept, so most starts need no parser
    from ecatspec.spec.language.parse import decode, parse_text  # noqa: PLC0415

    return parse_text(decode(raw, file), file)
