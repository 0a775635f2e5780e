"""SDO requests that assign PDOs and map entries into them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.case import ReadConfiguration, SendFrame
from ecatspec.generators.cases.transfers import download
from ecatspec.model.core.memo import once
from ecatspec.model.core.object_dictionary import encode_value, size_of
from ecatspec.model.core.observables import layout
from ecatspec.model.core.process_image import OUTPUTS
from ecatspec.model.esc.subdevice import power_on
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import State
    from ecatspec.model.core.values import ObjectKey


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


def assign(model: Model, index: int, *pdos: int) -> tuple[Stimulus, ...]:
    """Assign PDOs and read what they map, without which no settings fit."""
    clear, count = (set_entry(model, index, 0, number) for number in (0, len(pdos)))
    entries = (set_entry(model, index, place, pdo) for place, pdo in enumerate(pdos, 1))
    return clear, *entries, count, ReadConfiguration()


def entry_of(model: Model, key: ObjectKey) -> int:
    """Give what maps an entry."""
    return mapping(model, key, 8 * size_of(model.dictionary.entries[key]))


def mapping(model: Model, key: ObjectKey, bits: int) -> int:
    """Give the mapping value of a number of bits of an index and subindex."""
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


def assign_apart(
    model: Model, name: str, first: ObjectKey, second: ObjectKey
) -> tuple[Stimulus, ...]:
    """Assign two PDOs of a SyncManager that hold an entry each; nothing where none can."""
    index = model.image.assignments[name]
    if (index, 2) not in model.dictionary.entries or is_fixed(model, index):
        return ()
    pdos = [pdo for pdo in pdos_of(model, name) if not is_fixed(model, pdo)][:2]
    if len(pdos) <= 1:
        return ()
    mapped: list[Stimulus] = [set_entry(model, index, 0, 0)]
    for pdo, key in zip(pdos, (first, second), strict=True):
        mapped += [set_entry(model, pdo, 0, 0), set_entry(model, pdo, 1, entry_of(model, key))]
        mapped.append(set_entry(model, pdo, 0, 1))
    return (*mapped, *assign(model, index, *pdos))


@once
def first_assigned(model: Model) -> tuple[Stimulus, ...]:
    """Assign process data in each direction that has none at power-on, as far as PDOs hold some.

    The entries that are there are counted, the fewest that hold anything; else the first PDO that
    holds anything is assigned.
    """
    state = power_on(model)
    found: list[Stimulus] = []
    if not model.has_mailbox:
        return ()
    for name, index in model.image.assignments.items():
        count = model.dictionary.entries.get((index, 0))
        if layout(model, state, name) or count is None or count.access is Access.READ:
            continue
        kept = model.dictionary.highest(index)
        counted = (n for n in range(1, kept + 1) if _holds(model, _counting(state, index, n), name))
        for number in counted:
            found.append(set_entry(model, index, 0, number))
            break
        else:
            chosen = (pdo for pdo in pdos_of(model, name) if _known(state, pdo))
            found += (s for pdo in (*chosen,)[:1] for s in assign(model, index, pdo))
    return tuple(found)


def read_configuration(model: Model) -> tuple[Stimulus, ...]:
    """Read what is assigned and mapped, of what `first_assigned` assigns too, then as before."""
    assigning = first_assigned(model)
    if not assigning:
        return (ReadConfiguration(),) if model.has_mailbox else ()
    counts = [(index, 0) for index in model.image.assignments.values()]
    written = {key for stimulus in assigning if (key := _written(stimulus)) is not None}
    back = (set_entry(model, *key, 0) for key in counts if key in written)
    return (ReadConfiguration(), *assigning, ReadConfiguration(), *back)


def at_power_on(model: Model, objects: Iterable[tuple[ObjectKey, bytes]]) -> dict[ObjectKey, bytes]:
    """Give what sets up process data, of the objects that are known after `read_configuration`."""
    changed = {_written(s) for s in first_assigned(model)} - {
        (index, 0) for index in model.image.assignments.values()
    }
    return {key: value for key, value in objects if model.sets_up(key[0]) and key not in changed}


def _written(stimulus: Stimulus) -> ObjectKey | None:
    """Give the entry that a download writes."""
    if not isinstance(stimulus, SendFrame):
        return None
    index, subindex = stimulus.fields["index"], stimulus.fields["subindex"]
    assert isinstance(index, int)
    assert isinstance(subindex, int)
    return index, subindex


@once
def brought_up(model: Model) -> State:
    """Give the state of the virtual SubDevice in PREOP with the process data that it gets there."""
    state = power_on(model)
    for stimulus in first_assigned(model):
        key = _written(stimulus)
        if isinstance(stimulus, SendFrame) and key is not None:
            value = stimulus.fields["value"]
            assert isinstance(value, bytes)
            state = state.keeping(key, value)
    return state


def _counting(state: State, index: int, number: int) -> State:
    return state.keeping((index, 0), number.to_bytes(1, "little"))


def _holds(model: Model, state: State, name: str) -> bool:
    return bool(layout(model, state, name))


def _known(state: State, pdo: int) -> bool:
    """Tell whether a PDO counts entries at power-on."""
    return any(state.objects.get((pdo, 0), b""))


def _held(model: Model, pdo: int) -> set[ObjectKey | None]:
    """Give what a PDO is known to hold for good."""
    entries = (e for e in model.dictionary.entries.values() if e.index == pdo and e.subindex)
    known = (e.default for e in entries if e.constant and isinstance(e.default, int))
    return {model.image.target(value)[0] for value in known}
