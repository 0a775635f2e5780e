"""Cases of PDO assignment and mapping: order, counts, capacity."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.assignment import (
    assign,
    entry_of,
    is_fixed,
    mapping,
    pdos_of,
    set_entry,
)
from ecatspec.generators.cases.bringup import has_process_data, mailbox_settings, request, way_to
from ecatspec.generators.cases.case import (
    Case,
    Happen,
    Probe,
    ReadConfiguration,
    SetUpProcessData,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.cases.transfers import normal_download, upload
from ecatspec.generators.covers.drive_cover import STATUS
from ecatspec.model.core.object_dictionary import size_of
from ecatspec.model.core.process_image import INPUTS, OUTPUTS
from ecatspec.model.core.register_map import PROCESS_DATA
from ecatspec.spec.language.ir import Access, Call, In, Literal, Name
from ecatspec.spec.language.nodes import nodes_in, parts_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Limits, Stimulus
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import ObjectKey


_LONG = 5_000_000


def configuration_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield the cases of a device whose texts declare what assigns its process data."""
    if not has_process_data(model):
        return
    yield _case(model, "read", (ReadConfiguration(),))
    for name in (OUTPUTS, INPUTS):
        index = model.image.assignments[name]
        if (index, 0) in model.dictionary.entries:
            yield from _assignments(model, name, index)
    for name in (OUTPUTS, INPUTS):
        free = 0
        for pdo in pdos_of(model, name):
            fixed = is_fixed(model, pdo)
            yield from _fixed(model, pdo) if fixed else _mappings(model, name, pdo, every=not free)
            free += not fixed


# --- assignment -----------------------------------------------------------------------------------


def _assignments(model: Model, name: str, index: int) -> Iterator[Case]:
    own, other = pdos_of(model, name), pdos_of(model, INPUTS if name == OUTPUTS else OUTPUTS)
    key = f"{index:04X}"
    for pdo in own:
        way = (*assign(model, index, pdo), *_up(model))
        yield _case(model, f"assign/{key}_{pdo:04X}", way)
    if not own:
        return
    yield from _in_operation(model, name, own[0])
    clear, one = set_entry(model, index, 0, 0), set_entry(model, index, 0, 1)
    first = set_entry(model, index, 1, own[0])
    yield _case(model, f"cleared/{key}", (clear, _ask(index, 0), *_up(model)))
    yield _case(model, f"entry_while_counted/{key}", (one, set_entry(model, index, 1, own[-1])))
    yield _case(model, f"same_entry_while_counted/{key}", (clear, first, one, first))
    yield _case(model, f"emptied/{key}", (clear, set_entry(model, index, 1, 0), _ask(index, 1)))
    yield _case(model, f"all_counted/{key}", _all_counted(model, index))
    most = model.dictionary.highest(index)
    last = set_entry(model, index, most, own[0]), _ask(index, most)
    yield _case(model, f"last_entry_while_counted/{key}", (clear, first, one, *last))
    size = size_of(model.dictionary.entries[index, most])
    parts = normal_download(model, (index, most), own[0].to_bytes(size, "little"), first=0)
    yield _case(
        model,
        f"last_entry_in_segments_while_counted/{key}",
        (clear, _ask(index, most), first, one, *parts, _ask(index, most)),
    )
    for count in (most + 1, 0xFF):
        counted = set_entry(model, index, 0, count)
        yield _case(model, f"count_{count}/{key}", (clear, first, counted))
    strange = {"undeclared": _nowhere(model), **_free(model, name)}
    if other:
        strange["other_direction"] = other[0]
    near = range(model.image.pdos[name][0] - 1, model.image.pdos[name][-1] + 2)
    tried_before = {0, *own, *strange.values()}
    edges = (near[0], *_compared(model), near[-1])
    fits = (n for n in edges if n in near and n not in tried_before)
    strange |= {f"number_{number:X}": number for number in fits}
    for what, pdo in strange.items():
        tried = (clear, set_entry(model, index, 1, pdo), one, _ask(index, 0), _ask(index, 1))
        yield _case(model, f"{what}/{key}", tried)
    for state in ("SAFEOP", "OP"):
        yield _case(model, f"changed_in_{state}/{key}", (clear, _ask(index, 0)), state)
        yield _case(model, f"entry_changed_in_{state}/{key}", (first, _ask(index, 1)), state)
    to_init = request(model.row("al_state", "INIT"))
    preop = request(model.row("al_state", "PREOP"))
    again = (to_init, *mailbox_settings(model), preop, ReadConfiguration())
    yield _case(model, f"survives_init/{key}", (*assign(model, index, own[-1]), *again))
    safeop = request(model.row("al_state", "SAFEOP"))
    late = (SetUpProcessData(), *assign(model, index, own[-1]), safeop)
    yield _case(model, f"settings_before/{key}", late)


def _in_operation(model: Model, name: str, pdo: int) -> Iterator[Case]:
    """Yield what can happen to process data that the MainDevice assigned."""
    index = model.image.assignments[name]
    manager = PROCESS_DATA[(OUTPUTS, INPUTS).index(name)]
    safeop = request(model.row("al_state", "SAFEOP"))
    key = f"{index:04X}_{pdo:04X}"
    assigned = assign(model, index, pdo)
    up = (*assigned, *_up(model))
    off = WriteRegister(f"{manager}_activation", {"enabled": 0})
    yield _case(model, f"disabled/{key}", (*up, off))
    yield _case(model, f"disabled_in_SAFEOP/{key}", (*assigned, SetUpProcessData(), safeop, off))
    wrong = SetUpProcessData(longer={manager: 1})
    yield _case(model, f"misfit/{key}", (*assigned, wrong, safeop, *_look(model)))
    yield _case(model, f"watchdog/{key}", (*up, StopOutputs(), Wait(_LONG), *_look(model)))
    yield _case(model, f"sync_lost/{key}", (*up, Happen("al.sync_lost"), *_look(model)))


def _look(model: Model) -> Iterator[Stimulus]:
    """Yield an upload of the drive's status word, where there is one."""
    word = model.protocol.words.get(STATUS)
    if word is not None and word.key in model.dictionary.entries:
        yield upload(*word.key)


def _compared(model: Model) -> list[int]:
    """Give the numbers on both sides of those that definitions compare a written value with."""
    found: dict[int, None] = {}
    written = Call("number", (Name("value"),))
    for definition in model.protocol.definitions.values():
        for node in nodes_in(definition.value):
            if isinstance(node, In) and node.operand == written:
                ends = (end for item in node.items for end in (parts_of(item) or (item,)))
                for end in ends:
                    if isinstance(end, Literal):
                        number = int(end.value)
                        found |= dict.fromkeys((number - 1, number, number + 1))
    return [number for number in found if number >= 0]


def _up(model: Model) -> tuple[Stimulus, ...]:
    """Give the way from PREOP to OP with the process data that are assigned by then."""
    safeop, op = (request(model.row("al_state", name)) for name in ("SAFEOP", "OP"))
    return SetUpProcessData(), safeop, WriteOutputs(), op


# --- mapping --------------------------------------------------------------------------------------


def _fixed(model: Model, pdo: int) -> Iterator[Case]:
    yield _case(model, f"fixed/{pdo:04X}", (set_entry(model, pdo, 0, 0), _ask(pdo, 0)))


def _mappings(model: Model, name: str, pdo: int, *, every: bool) -> Iterator[Case]:
    """Yield the cases of one PDO that can be mapped, with `every` object or the first alone."""
    key = f"{pdo:04X}"
    index = model.image.assignments[name]
    most = model.dictionary.highest(pdo)
    free = (set_entry(model, index, 0, 0), set_entry(model, pdo, 0, 0))
    good = [entry_of(model, held) for held in _mappable(model, name)]
    for number, value in enumerate(good if every else good[:1]):
        way = (*free, set_entry(model, pdo, 1, value), set_entry(model, pdo, 0, 1))
        done = (*way, set_entry(model, index, 1, pdo), set_entry(model, index, 0, 1), *_up(model))
        yield _case(model, f"map_{number}/{key}", done)
    if not good:
        return
    first = set_entry(model, pdo, 1, good[0])
    one = set_entry(model, pdo, 0, 1)
    yield _case(model, f"map_while_counted/{key}", (*free, first, one, set_entry(model, pdo, 1, 0)))
    yield _case(
        model, f"map_count_{most + 1}/{key}", (*free, first, set_entry(model, pdo, 0, most + 1))
    )
    for what, value in _unmappable(model, name, good[0]).items():
        tried = (*free, set_entry(model, pdo, 1, value), one, _ask(pdo, 0), _ask(pdo, 1))
        yield _case(model, f"map_{what}/{key}", tried)
    emptied = (*free, set_entry(model, pdo, 1, 0), _ask(pdo, 1))
    yield _case(model, f"map_emptied/{key}", emptied)
    yield _case(model, f"map_all_counted/{key}", _all_counted(model, pdo))
    for what, held in _around_capacity(model, good, most).items():
        filled = [set_entry(model, pdo, n, value) for n, value in enumerate(held, 1)]
        counted = set_entry(model, pdo, 0, len(held))
        yield _case(model, f"map_{what}/{key}", (*free, *filled, counted, _ask(pdo, 0)))
    for state in ("SAFEOP", "OP"):
        late = (set_entry(model, pdo, 0, 0), _ask(pdo, 0))
        yield _case(model, f"mapped_in_{state}/{key}", late, state)


def _unmappable(model: Model, name: str, good: int) -> dict[str, int]:
    """Give mapping entries that no device can hold."""
    found = {
        "nothing": mapping(model, (_nowhere(model), 0), 16),
        "more_bits": good + 8,
    }
    wrong = Access.READ if name == OUTPUTS else Access.WRITE
    for key, entry in model.dictionary.entries.items():
        if entry.access is wrong and entry.mappable:
            found["wrong_way"] = entry_of(model, key)
            break
    for key, entry in model.dictionary.entries.items():
        if not entry.mappable and not model.image.configures(key[0]):
            found["unmappable"] = entry_of(model, key)
            break
    return found


def _around_capacity(model: Model, good: list[int], most: int) -> dict[str, tuple[int, ...]]:
    """Give entries that a PDO could count: as many bits as it holds, and the least that are more.

    Nothing of what entries cannot make up, each of them mapped once at most.
    """
    room = 8 * model.parameter("pdo_capacity")
    made: dict[int, tuple[int, ...]] = {0: ()}
    for value in good:
        for bits, chosen in tuple(made.items()):
            longer = bits + model.image.target(value)[1]
            known = made.get(longer)
            has_room = bits <= room and len(chosen) < most
            if has_room and (known is None or len(chosen) + 1 < len(known)):
                made[longer] = (*chosen, value)
    sums = {"as_much_as_it_holds": room, "too_much": min((n for n in made if n > room), default=0)}
    return {what: made[bits] for what, bits in sums.items() if made.get(bits)}


def _all_counted(model: Model, index: int) -> tuple[Stimulus, ...]:
    """Read every place of an object and count them all, whatever they hold."""
    places = range(1, model.dictionary.highest(index) + 1)
    read = (_ask(index, place) for place in places)
    return (*read, set_entry(model, index, 0, len(places)), _ask(index, 0))


# --- helpers --------------------------------------------------------------------------------------


def _free(model: Model, name: str) -> dict[str, int]:
    """Give an index of PDOs of this direction under which no text declares one, if there is."""
    taken = set(pdos_of(model, name))
    free = [index for index in model.image.pdos[name] if index not in taken]
    return {"free": free[-1]} if free else {}


def _nowhere(model: Model) -> int:
    """Give the highest index under which no text declares an object."""
    indices = {index for index, _ in model.dictionary.entries}
    return next(index for index in reversed(range(1 << 16)) if index not in indices)


def _mappable(model: Model, name: str) -> list[ObjectKey]:
    wrong = Access.READ if name == OUTPUTS else Access.WRITE
    entries = model.dictionary.entries.values()
    return [(e.index, e.subindex) for e in entries if e.mappable and e.access is not wrong]


def _ask(index: int, subindex: int) -> Stimulus:
    return upload(index, subindex)


def _case(model: Model, name: str, stimuli: tuple[Stimulus, ...], state: str = "PREOP") -> Case:
    way = way_to(model, state)
    title = f"process data objects: {name.replace('_', ' ').replace('/', ', ')}"
    return Case(
        f"sdo/configuration/{name}", title, "sdo", (*way, *stimuli, Probe()), state, len(way)
    )
