"""Encodes process data as the MainDevice writes them: settings and images."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.case import WriteRegister, WriteRegisters
from ecatspec.model.core.observables import control_fields, layout
from ecatspec.model.core.process_image import INPUTS, OUTPUTS, placed
from ecatspec.model.core.register_map import AREAS, PROCESS_DATA

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.generators.cases.case import SetUpProcessData
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import State

_BYTE = 8
_ASSIGNMENTS = dict(zip(PROCESS_DATA, (OUTPUTS, INPUTS), strict=True))


def image_size(model: Model, state: State, sync_manager: str) -> int | None:
    """Give the bytes that the objects of a state assign to a SyncManager; None: not known."""
    mapped = layout(model, state, _ASSIGNMENTS[sync_manager])
    return None if mapped is None else -(-sum(part.bits for part in mapped) // _BYTE)


def settings(model: Model, state: State, wanted: SetUpProcessData) -> tuple[WriteRegisters, ...]:
    """Give the writes that set both process data SyncManagers, for what a state assigns.

    One without process data, or of which nothing is known, is switched off.
    """
    writes = []
    for name in PROCESS_DATA:
        size = image_size(model, state, name) or 0
        fields = {
            "start": model.parameter(AREAS[name], "start"),
            "length": max(0, size + wanted.longer.get(name, 0)),
            **control_fields(model, name),
        }
        activation = f"{name}_activation"
        enabled = wanted.changes.get(activation, {"enabled": int(fields["length"] > 0)})
        writes.append(
            WriteRegisters(
                (
                    WriteRegister(name, fields | dict(wanted.changes.get(name, {}))),
                    WriteRegister(activation, enabled),
                )
            )
        )
    return tuple(writes)


def image(model: Model, state: State, words: Mapping[str, int]) -> bytes | None:
    """Give the outputs that hold these words; None where their layout is not known, or none."""
    mapped = layout(model, state, OUTPUTS)
    if not mapped:
        return None
    keys = {model.protocol.words[name].key: value for name, value in words.items()}
    content = 0
    for part in mapped:
        if part.key in keys:
            content = placed(content, part, keys[part.key])
    return content.to_bytes(-(-sum(part.bits for part in mapped) // _BYTE), "little")


def holds(model: Model, state: State, word: str) -> bool:
    """Tell whether the outputs hold a word."""
    mapped = layout(model, state, OUTPUTS) or ()
    return any(part.key == model.protocol.words[word].key for part in mapped)
