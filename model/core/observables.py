"""What one state shows: registers, words, and where mail and process data lie."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.model.core.compiled import paths_in
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.interpreter import fields_with_before
from ecatspec.model.core.memo import once
from ecatspec.model.core.process_image import INPUTS, Mapped, taken
from ecatspec.model.core.register_map import AREAS, SYNC_MANAGERS, field_mask, field_of
from ecatspec.model.core.values import Pattern, Unknown, Value, admits, bits_of
from ecatspec.model.core.wording import register_words

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.compiled import View
    from ecatspec.model.core.state import State
    from ecatspec.spec.language.ir import Register, Word


@once
def enabled(model: Model, state: State, name: str) -> bool | None:
    """Tell whether a SyncManager is switched on; None: not known."""
    raw = state.slots[model.slots[f"register {name}_activation"]]
    if not isinstance(raw, int):
        return None
    return bool(field_of(model.protocol, f"{name}_activation", "enabled", raw))


@once
def usual_mailbox(model: Model) -> dict[str, int]:
    """Give the slots of the mailbox SyncManagers as they are where nobody saw them set."""
    found = {}
    for name in SYNC_MANAGERS:
        fields = {field.name: field.low for field in model.protocol.registers[name].fields}
        settings = mailbox_fields(model, name, AREAS[name])
        found[f"register {name}"] = sum(value << fields[n] for n, value in settings.items())
        activation = f"{name}_activation"
        found[f"register {activation}"] = field_mask(model.protocol, activation, "enabled")
    return found


def mailbox_fields(model: Model, name: str, area: str) -> dict[str, int]:
    """Give the fields of a mailbox SyncManager as a device wants them in an area, by its name."""
    start, length = (model.parameter(area, part) for part in ("start", "length"))
    return {"start": start, "length": length, **control_fields(model, name)}


def control_fields(model: Model, name: str) -> dict[str, int]:
    """Give the fields of the control byte of a SyncManager, as the device's description has it."""
    control = model.parameter(f"{name}_control")
    fields = model.protocol.registers[name].fields
    first = next(field.low for field in fields if field.name == "mode")
    return {
        field.name: bits_of(control, field.low - first, field.high - first)
        for field in fields
        if field.low >= first
    }


def _own_area(model: Model, name: str) -> tuple[int, int]:
    return model.parameter(AREAS[name], "start"), model.parameter(AREAS[name], "length")


@once
def mailbox_area(model: Model, state: State, name: str) -> tuple[int, int] | None:
    """Give start and length of a mailbox; of one that was not seen set, the device's own."""
    raw = state.slots[model.slots[f"register {name}"]]
    if not isinstance(raw, int):
        return _own_area(model, name)
    start = field_of(model.protocol, name, "start", raw)
    length = field_of(model.protocol, name, "length", raw)
    return (start, length) if length else None


@once
def process_area(model: Model, state: State, name: str) -> tuple[int, int] | None:
    """Give start and length of process data that are switched on."""
    if not enabled(model, state, name):
        return None
    raw = state.slots[model.slots[f"register {name}"]]
    if not isinstance(raw, int):
        return None
    start, length = (field_of(model.protocol, name, f, raw) for f in ("start", "length"))
    return (start, length) if length else None


def shown_register(model: Model, register: Register, state: State) -> dict[str, Value]:
    """Give the fields of a register as they read in a state."""
    environment = Environment(state.slots, {}, {})
    return {view.name: view.present(environment) for view in model.views[register.name]}


@once
def definitely(model: Model, state: State, definition: str) -> bool | None:
    """Tell whether a definition of the texts holds of the slots of a state; None: not known."""
    holds = model.definition(definition)(Environment(state.slots, {}, {}))
    return None if isinstance(holds, Pattern) else bool(holds)


@once
def seen(model: Model, name: str, state: State, raw: int) -> tuple[State, ...]:
    """Give the states after `raw` was read in a register, none where the state forbids it."""
    environment = Environment(state.slots, {}, {})
    shown = [(view, view.present(environment)) for view in model.views[name]]
    if environment.undecided:
        choice = min(environment.undecided)
        slot = model.slots[f"choice {choice}"]
        return tuple(
            after
            for alternative in model.protocol.choices[choice].alternatives
            for after in seen(model, name, state.having(slot, alternative.name), raw)
        )
    for view, value in shown:
        observed: int = raw >> view.low & ((1 << view.width) - 1)
        if view.truth:
            observed = bool(observed)
        if not admits(value, observed):
            return ()
        if isinstance(value, Pattern) and view.condition is None:
            holder = view.holder(Environment(state.slots, {}, {}))
            state = state if holder is None else state.having(holder, observed)
    return (state,)


@once
def advised(model: Model, name: str, state: State) -> tuple[tuple[View, Value], ...]:
    """Give the fields of a register that should show something beside what they must."""
    environment = Environment(state.slots, {}, {})
    found = ((view, view.advised) for view in model.views[name])
    return tuple((view, get(environment)) for view, get in found if get is not None)


@once
def layout(model: Model, state: State, name: str) -> tuple[Mapped, ...] | None:
    """Give what the process data of an assignment hold, in order; None: not known."""
    return model.image.layout(Environment(state.slots, state.objects, {}), name)


def fields_in(model: Model, state: State, image: bytes) -> Iterator[tuple[str, dict[str, Value]]]:
    """Yield the words that inputs hold, by name, with the fields that show something."""
    for mapped in layout(model, state, INPUTS) or ():
        word = None if mapped.key is None else model.words.get(mapped.key)
        raw = taken(image, mapped)
        if word is not None and raw is not None:
            now = fields_with_before(word.fields, raw, None)
            yield word.name, {view.name: now[view.name] for view in model.views[word.name]}


@once
def words_in(model: Model, state: State, image: bytes) -> tuple[tuple[str, str], ...]:
    """Give the words that inputs hold, by name and in words."""
    found = fields_in(model, state, image)
    return tuple((name, register_words(model, name, fields)) for name, fields in found)


@once
def odd_words(model: Model, state: State, image: bytes) -> dict[str, Word]:
    """Give the words in the inputs that are not what the state shows."""
    environment = Environment(state.slots, state.objects, {})
    found = {}
    for mapped in layout(model, state, INPUTS) or ():
        shown = None if mapped.key is None else model.dictionary.shown.get(mapped.key)
        raw = taken(image, mapped)
        if shown is None or mapped.key is None or raw is None:
            continue
        word = model.words[mapped.key]
        if not admits(shown(environment), raw.to_bytes(word.size, "little")):
            found[word.name] = word
    return found


@once
def decided(model: Model, state: State, image: bytes) -> tuple[State, ...]:
    """Give the states that one stands for in which machines are not known that words show."""
    states = [state]
    for name, _ in words_in(model, state, image):
        for machine in machines_of(model, name):
            slot = model.slots[f"{machine}.state"]
            if isinstance(state.slots[slot], Pattern):
                values = model.state_names(machine)
                states = [each.having(slot, value) for each in states for value in values]
    return tuple(states)


def shown_fields(model: Model, state: State, name: str) -> dict[str, Value]:
    """Give the fields of a word of which a state says something."""
    environment = Environment(state.slots, state.objects, {})
    shown = {view.name: view.present(environment) for view in model.views[name]}
    return {field: value for field, value in shown.items() if not isinstance(value, Unknown)}


@once
def machines_of(model: Model, name: str) -> frozenset[str]:
    """Give the machines of which a register or a word shows something."""
    paths = (p for view in model.views[name] for p in paths_in(model.protocol, view.expression))
    return frozenset(model.protocol.machines).intersection(p.partition(".")[0] for p in paths)
