"""The only place for SDO requests that assign PDOs and map entries into them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.case import ReadConfiguration
from ecatspec.generators.transfers import download
from ecatspec.model.dictionary import encode_value, size_of
from ecatspec.model.process_image import OUTPUTS
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from ecatspec.generators.case import Stimulus
    from ecatspec.model.compiled import Model
    from ecatspec.model.values import ObjectKey


def pdos_of(model: Model, name: str) -> list[int]:
    """Give the PDOs of an assignment that the texts declare."""
    return sorted(
        {index for index, _ in model.dictionary.entries if index in model.image.pdos[name]}
    )


def is_fixed(model: Model, pdo: int) -> bool:
    """Tell whether nothing can be mapped into a PDO."""
    return model.dictionary.entries[pdo, 0].access is Access.READ


def set_entry(model: Model, index: int, subindex: int, value: int) -> Stimulus:
    """Write a number to an entry."""
    entry = model.dictionary.entries.get((index, subindex))
    if entry is None:
        return download(index, subindex, value.to_bytes(4, "little"))
    return download(index, subindex, encode_value(entry, value))


def assign(model: Model, index: int, pdo: int) -> tuple[Stimulus, ...]:
    """Assign one PDO and read what it maps, without which no settings fit."""
    clear, one = set_entry(model, index, 0, 0), set_entry(model, index, 0, 1)
    return clear, set_entry(model, index, 1, pdo), one, ReadConfiguration()


def entry_of(model: Model, key: ObjectKey) -> int:
    """Give what maps an entry."""
    return mapping(model, key, 8 * size_of(model.dictionary.entries[key]))


def mapping(model: Model, key: ObjectKey, bits: int) -> int:
    """Give what maps so many bits under an index and subindex."""
    fields = {f.name: f.low for f in model.protocol.words["pdo_entry"].fields}
    return bits << fields["bit_length"] | key[1] << fields["subindex"] | key[0] << fields["index"]


def assign_all(model: Model, keys: tuple[ObjectKey, ...]) -> tuple[Stimulus, ...]:
    """Assign outputs that hold these entries; nothing where no PDO is known to do so."""
    index = model.image.assignments[OUTPUTS]
    if (index, 1) not in model.dictionary.entries or is_fixed(model, index):
        return ()
    for pdo in pdos_of(model, OUTPUTS):
        if is_fixed(model, pdo):
            if set(keys) <= _held(model, pdo):
                return assign(model, index, pdo)
        elif len(keys) <= model.dictionary.highest(pdo):
            clear = set_entry(model, index, 0, 0), set_entry(model, pdo, 0, 0)
            held = enumerate((entry_of(model, key) for key in keys), 1)
            entries = tuple(set_entry(model, pdo, place, value) for place, value in held)
            count = set_entry(model, pdo, 0, len(keys))
            return (*clear, *entries, count, *assign(model, index, pdo))
    return ()


def _held(model: Model, pdo: int) -> set[ObjectKey | None]:
    """Give what a PDO is known to hold for good."""
    entries = (e for e in model.dictionary.entries.values() if e.index == pdo and e.subindex)
    known = (e.default for e in entries if e.constant and isinstance(e.default, int))
    return {model.image.target(value)[0] for value in known}
