"""Makes states and inputs of the interpreter from values that a solver found.

An example of the solver may rest on an answer that the object dictionary never gives. The
interpreter is asked what its rules say there: where it disagrees or does not know, nothing is
refuted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from ecatspec.model.core.compilation import Model
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.object_dictionary import encode_value
from ecatspec.model.core.state import Event, State
from ecatspec.model.core.values import Pattern, Value
from ecatspec.model.core.wording import typed_words
from ecatspec.model.symbolic.symbolic_state import Anything, Content
from ecatspec.model.symbolic.terms import settled
from ecatspec.spec.language.ir import Word

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.model.core.values import ObjectKey
    from ecatspec.model.symbolic.smt_encoding import Meaning
    from ecatspec.model.symbolic.symbolic_state import Meant, Moment, World
    from ecatspec.model.symbolic.terms import Term, Values
    from ecatspec.spec.language.ir import Register, RegisterField

_LONGEST: Final = 1 << 17
"""A longer byte string is not made for an example."""


@dataclass(frozen=True, slots=True)
class Example:
    """Values that a solver found, as the interpreter takes them."""

    meaning: Meaning
    values: Values

    # --- values -----------------------------------------------------------------------------------

    def value(self, meant: Meant, default: Value) -> Value:
        """Give the concrete value, or the default where the example says nothing of it."""
        if isinstance(meant, Anything):
            return default
        if isinstance(meant, Content):
            return self._bytes(meant)
        found = self._settled(meant)
        return default if found is None else found

    def _settled(self, term: Term) -> int | bool | None:
        return settled(term, self.values.numbers, self.meaning.symbols)

    def _bytes(self, content: Content) -> bytes:
        length = self._settled(content.length)
        size = 0 if length is None else max(0, min(length, _LONGEST))
        number = self.values.of(f"number({content.name})")
        if number is None:
            return bytes(size)
        data = int(number).to_bytes(8, "little")
        return data[:size].ljust(size, b"\0")

    # --- the state --------------------------------------------------------------------------------

    def state(self, world: World, *, open_choices: bool = False) -> State:
        """Give the state that a world is; choices that it does not speak of are open or first."""
        model = self.meaning.model
        protocol = self.meaning.protocol
        slots: list[Value | None] = list(model.initial.slots)
        for name, slot in model.slots.items():
            known = slots[slot]
            if name in self.meaning.kinds:
                default = 0 if known is None or isinstance(known, Pattern) else known
                slots[slot] = self._of_slot(world, name, default)
        for choice, text in protocol.choices.items():
            slot = model.slots[f"choice {choice}"]
            way = self.values.of(f"choice {choice}")
            if way is not None:
                slots[slot] = text.alternatives[way].name
            elif slots[slot] is None and not open_choices:
                slots[slot] = text.alternatives[0].name
        holders: list[Register | Word] = [*protocol.registers.values(), *protocol.words.values()]
        for holder in holders:
            name = f"{'word' if isinstance(holder, Word) else 'register'} {holder.name}"
            place = model.slots.get(name)
            if place is not None:
                slots[place] = self._bits(world, name, holder.fields, slots[place])
        state = State(tuple(slots))
        for key, content in self.objects().items():
            state = state.keeping(key, content)
        return state

    def _of_slot(self, world: World, name: str, default: Value) -> Value:
        return self.value(world.get(name), default)

    def _bits(
        self, world: World, name: str, fields: tuple[RegisterField, ...], known: Value | None
    ) -> int:
        raw = known if isinstance(known, int) else 0
        for bits in fields:
            mask = ((1 << (bits.high - bits.low + 1)) - 1) << bits.low
            now = (raw & mask) >> bits.low
            value = self.value(world.get(f"{name}.{bits.name}"), now)
            if isinstance(value, int):
                raw = raw & ~mask | (int(value) << bits.low) & mask
        return raw

    def objects(self) -> dict[ObjectKey, bytes]:
        """Give the objects of whose numbers the example speaks."""
        found: dict[ObjectKey, bytes] = {}
        for name, number in self.values.numbers.items():
            function, arguments = self.meaning.answers.asked.get(name, ("", ()))
            if function != "number_of":
                continue
            index, subindex = (self.value(argument, 0) for argument in arguments)
            if isinstance(index, int) and isinstance(subindex, int):
                entry = self.meaning.model.dictionary.entries.get((index, subindex))
                if entry is not None:
                    found[index, subindex] = encode_value(entry, int(number))
        return found

    def event(self, moment: Moment) -> Event:
        """Give the input of a moment with its parameters."""
        machine, name = moment.scope.machine or "", moment.scope.input or ""
        return Event(machine, name, self.parameters(moment))

    def parameters(self, moment: Moment) -> dict[str, Value]:
        """Give the parameters of an input; what the example does not speak of is zero."""
        return {
            name: self.value(meant, b"" if isinstance(meant, Content) else 0)
            for name, meant in moment.parameters.items()
        }

    # --- what the interpreter says ----------------------------------------------------------------

    def guards(self, moment: Moment) -> dict[str, bool | None]:
        """Give for every rule and gap whether the interpreter lets it take the input."""
        model = self._decided(moment)
        state, event = self.state(moment.world), self.event(moment)
        environment = Environment(state.slots, state.objects, event.parameters)
        current = state.slots[model.slots[f"{event.machine}.state"]]
        found: dict[str, bool | None] = {}
        for rule in model.rules(event.machine, event.input):
            holds: Value = True if rule.guard is None else rule.guard(environment)
            if current not in rule.sources:
                holds = False
            found[rule.name.name] = None if isinstance(holds, Pattern) else bool(holds)
        return found

    def _decided(self, moment: Moment) -> Model:
        """Give the model in which conditions are as the example has them."""
        protocol = self.meaning.protocol
        found = {}
        for name, condition in protocol.conditions.items():
            value = self.values.of(f"condition {name} @{moment.key}")
            found[name] = condition if value is None else replace(condition, assumed=bool(value))
        return Model(replace(protocol, conditions=found), assuming=True)

    # --- words ------------------------------------------------------------------------------------

    def words(self, about: Iterable[str]) -> tuple[str, ...]:
        """Say the values of some symbols in the words of the texts."""
        lines: dict[str, str] = {}
        for name in sorted(about):
            value = self.values.of(name)
            symbol = self.values.known[name]
            if value is None:
                continue
            label = symbol.label
            lines[f"{label} = {self._said(name, value)}"] = label
        return tuple(sorted(lines, key=lambda line: (lines[line].count("("), line)))

    def _said(self, name: str, value: int | bool) -> str:  # noqa: FBT001
        symbol = self.values.known[name]
        choice = self.meaning.protocol.choices.get(symbol.label)
        if choice is not None and name.startswith("choice "):
            return choice.alternatives[value].name
        if symbol.kind is None:
            return str(value)
        return typed_words(self.meaning.model, symbol.kind, value)

    def abstract(self, about: Iterable[str]) -> tuple[str, ...]:
        """Give the labels of symbols that stand for answers of functions."""
        symbols = self.values.known
        return tuple(sorted({symbols[name].label for name in about if symbols[name].abstract}))
