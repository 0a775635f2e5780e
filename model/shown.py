"""The only place for what one state shows: registers, words, where mail and process data lie."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.model.esc import SYNC_MANAGERS, field_of
from ecatspec.model.evaluate import Environment
from ecatspec.model.interpreter import fields_with_before
from ecatspec.model.process_image import INPUTS, taken
from ecatspec.model.values import Pattern, Value, admits, is_any
from ecatspec.model.words import register_words
from ecatspec.spec.language.ir import Conditional, Expression, Name
from ecatspec.spec.language.scope import Scope, StateRef, VariableRef, names_in, resolve

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.compiled import Model, View
    from ecatspec.model.state import State
    from ecatspec.spec.language.ir import Register, Word


def enabled(model: Model, state: State, name: str) -> bool | None:
    """Tell whether a SyncManager is switched on; None: not known."""
    raw = state.slots[model.slots[f"register {name}_activation"]]
    if not isinstance(raw, int):
        return None
    return bool(field_of(model.protocol, f"{name}_activation", "enabled", raw))


def mailbox_area(model: Model, state: State, name: str) -> tuple[int, int] | None:
    """Give start and length of a mailbox; of one that was not seen set, the device's own."""
    raw = state.slots[model.slots[f"register {name}"]]
    if not isinstance(raw, int):
        parameter = "mailbox_out" if name == SYNC_MANAGERS[0] else "mailbox_in"
        return model.parameter(parameter, "start"), model.parameter(parameter, "length")
    start = field_of(model.protocol, name, "start", raw)
    length = field_of(model.protocol, name, "length", raw)
    return (start, length) if length else None


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


def seen(model: Model, register: Register, state: State, raw: int) -> list[State]:
    """Give the states after `raw` was read, none where the state does not allow it."""
    environment = Environment(state.slots, {}, {})
    views = model.views[register.name]
    shown = [(view, view.present(environment)) for view in views]
    if environment.undecided:
        choice = min(environment.undecided)
        slot = model.slots[f"choice {choice}"]
        return [
            after
            for alternative in model.protocol.choices[choice].alternatives
            for after in seen(model, register, state.having(slot, alternative.name), raw)
        ]
    for view, value in shown:
        observed: int = raw >> view.low & ((1 << view.width) - 1)
        if view.truth:
            observed = bool(observed)
        if not admits(value, observed):
            return []
        if isinstance(value, Pattern) and view.condition is None:
            state = _narrowed(model, view, state, observed)
    return [state]


def _narrowed(model: Model, view: View, state: State, observed: int) -> State:
    """Give the state in which the variable that the field shows has the value observed."""
    expression: Expression = view.expression
    environment = Environment(state.slots, {}, {})
    while isinstance(expression, Conditional):
        holds = model.expression(expression.condition, Scope(), None)(environment)
        if isinstance(holds, Pattern):
            return state
        expression = expression.then if holds else expression.otherwise
    if not isinstance(expression, Name):
        return state
    ref = resolve(model.protocol, expression.path, Scope())
    if isinstance(ref, VariableRef | StateRef):
        return state.having(model.slot(ref), observed)
    return state


def words_in(model: Model, state: State, image: bytes) -> Iterator[tuple[str, str]]:
    """Yield the words that inputs hold, by name and in words."""
    environment = Environment(state.slots, state.known(), {})
    for mapped in model.image.layout(environment, INPUTS) or ():
        word = None if mapped.key is None else model.words.get(mapped.key)
        raw = taken(image, mapped)
        if word is not None and raw is not None:
            now = fields_with_before(word.fields, raw, None)
            shown = {view.name: now[view.name] for view in model.views[word.name]}
            yield word.name, register_words(model, word.name, shown)


def odd_words(model: Model, state: State, image: bytes) -> dict[str, Word]:
    """Give the words in the inputs that are not what the state shows."""
    environment = Environment(state.slots, state.known(), {})
    found = {}
    for mapped in model.image.layout(environment, INPUTS) or ():
        shown = None if mapped.key is None else model.dictionary.shown.get(mapped.key)
        raw = taken(image, mapped)
        if shown is None or mapped.key is None or raw is None:
            continue
        word = model.words[mapped.key]
        if not admits(shown(environment), raw.to_bytes(word.size, "little")):
            found[word.name] = word
    return found


def decided(model: Model, state: State, image: bytes) -> list[State]:
    """Give the states that one stands for in which machines are not known that words show."""
    states = [state]
    for name, _ in words_in(model, state, image):
        for machine in machines_of(model, name):
            slot = model.slots[f"{machine}.state"]
            if isinstance(state.slots[slot], Pattern):
                values = model.state_names(machine)
                states = [each.having(slot, value) for each in states for value in values]
    return states


def shown_fields(model: Model, state: State, name: str) -> dict[str, Value]:
    """Give the fields of a word of which a state says something."""
    environment = Environment(state.slots, state.known(), {})
    shown = {view.name: view.present(environment) for view in model.views[name]}
    return {field: value for field, value in shown.items() if not is_any(value)}


def machines_of(model: Model, name: str) -> set[str]:
    """Give the machines of which a register or a word shows something."""
    paths = (p for view in model.views[name] for p in _names(model, view.expression))
    return {path.partition(".")[0] for path in paths} & set(model.protocol.machines)


def _names(model: Model, expression: Expression) -> Iterator[str]:
    """Give the names of an expression and of the definitions that it uses."""
    for path in names_in(expression):
        definition = model.protocol.definitions.get(path)
        if definition is None:
            yield path
        else:
            yield from _names(model, definition.value)
