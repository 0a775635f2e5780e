"""Compiles a protocol to a model that runs: slots, rules, views."""

from __future__ import annotations

from collections import defaultdict
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final, assert_never

from ecatspec.model.core.cache import Cache
from ecatspec.model.core.codec import Codec
from ecatspec.model.core.compiled import CompiledReason, CompiledRule, rows_of
from ecatspec.model.core.expressions import (
    Environment,
    Getter,
    Lookup,
    compile_expression,
    constant,
    remembered,
)
from ecatspec.model.core.functions import PLAIN
from ecatspec.model.core.object_dictionary import CROWDED, ObjectDictionary
from ecatspec.model.core.process_image import ProcessImage
from ecatspec.model.core.rule_compilation import reply_fields_of, rule_of, views_of
from ecatspec.model.core.state import Event, RuleName, State
from ecatspec.model.core.values import UNKNOWN, Octets, Pattern, Value, bits_of
from ecatspec.spec.language.functions import REPLY
from ecatspec.spec.language.ir import (
    Access,
    Bool,
    Expression,
    Gap,
    InputKind,
    Name,
    Type,
)
from ecatspec.spec.language.kinds import name_hints
from ecatspec.spec.language.nodes import names_in
from ecatspec.spec.language.references import (
    AlternativeRef,
    ChoiceRef,
    ConditionRef,
    ConstantRef,
    DefinitionRef,
    ParameterOfInput,
    ParameterRef,
    Ref,
    RegisterFieldRef,
    ReplyField,
    StateRef,
    VariableRef,
    WordFieldRef,
)
from ecatspec.spec.language.scope import Scope, resolve

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.expressions import Function
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.spec.language.ir import (
        Protocol,
        RegisterField,
        Word,
    )


MAILBOX = "mailbox"
"""The machine that takes all messages, and its outermost layout."""
_DECODED: Final = 512
"""Messages that are kept decoded at most."""
_ANSWERS: Final = 16384
"""Answers of one function that are kept at most."""


_NO_RULE = Scope()


class Model:
    """One protocol, compiled; nobody changes it.

    `assuming`: conditions as assumed, choices first or pinned. `closed`: exactly the declared
    objects exist, as a device under test declares; else what the text says of that.
    """

    def __init__(self, protocol: Protocol, *, assuming: bool = False, closed: bool = False) -> None:
        """Compile every view and layout of the protocol."""
        self.protocol = protocol
        self.assuming = assuming
        self._decoded: Cache[bytes, Message | None] = Cache(_DECODED)
        self.answers: defaultdict[object, Cache[tuple[object, ...], Any]] = defaultdict(
            partial(Cache, _ANSWERS)
        )
        """What functions of the model gave (`once`)."""
        self._parameters: dict[tuple[str, str | None], int] = {}
        self.codec = Codec(protocol)
        self.dictionary = ObjectDictionary(protocol, self._al_state, exact=assuming, closed=closed)
        self.image = ProcessImage(protocol, self.dictionary, self.parameter)
        self._functions = self.functions()
        self._definitions: dict[tuple[str, Scope], Getter] = {}
        names, values = zip(*self._initial(), strict=True)
        self.slots: dict[str, int] = {name: slot for slot, name in enumerate(names)}
        self.initial = State(values)
        self._rules: dict[tuple[str, str], tuple[CompiledRule, ...]] = {}
        self._named: dict[RuleName, CompiledRule] = {}
        rows = [(m.name, row) for m in protocol.machines.values() for row in rows_of(m)]
        self._input_of = {RuleName(machine, row.name): row.input for machine, row in rows}
        mailbox = protocol.machines[MAILBOX]
        self._roots = [o for i in mailbox.inputs if i.kind == InputKind.FRAME for o in i.origin]
        self.own = self._events(InputKind.OWN)
        """What the device may do at any time."""
        self.locals = self._events(InputKind.LOCAL)
        """The local events that may happen in the device."""
        self.outputs = self._events(InputKind.OUTPUTS)
        """The inputs that take process data."""
        self.word_inputs = {
            word: tuple(
                (machine.name, i.name)
                for machine in protocol.machines.values()
                for i in machine.inputs
                if i.kind == InputKind.WORD and word in i.origin
            )
            for word in protocol.words
        }
        self.worded = frozenset(m for pairs in self.word_inputs.values() for m, _ in pairs)
        """The machines that words move."""
        self.displayed = frozenset(
            path.removesuffix(".state")
            for register in protocol.registers.values()
            for field in register.fields
            for path in (() if field.shows is None else names_in(field.shows.value))
            if path.endswith(".state")
        )
        """The machines whose state a register shows."""
        self.open_gaps = frozenset(
            RuleName(machine, row.name)
            for machine, row in rows
            if isinstance(row, Gap) and machine in self.displayed
        )
        """The gaps of these machines: what rests on their state is open too."""
        self.words: dict[ObjectKey, Word] = {
            word.key: word
            for word in protocol.words.values()
            if word.key in self.dictionary.entries
        }
        """The words of objects that the device has."""
        self.settings = tuple(
            key
            for key, word in self.words.items()
            if not self.dictionary.entries[key].volatile
            and all(field.shows is None for field in word.fields)
            and not self.image.configures(key[0])
        )
        """The entries that say how words are to be understood: option codes, a mode."""
        self.fetched = Event(MAILBOX, "fetched", {})
        """The MainDevice has read a message."""
        self._properties = [
            (law.name, self.expression(law.value, Scope(), Bool()))
            for law in protocol.properties.values()
        ]
        self.views = {r.name: views_of(self, r) for r in protocol.registers.values()}
        self.views |= {w.name: views_of(self, w) for w in protocol.words.values()}
        for key, word in self.words.items():
            if self.views[word.name]:
                self.dictionary.shown[key] = self._reads(word)
        self.reasons: dict[RuleName, list[CompiledReason]] = {}
        """Why rules refuse, by rule."""
        for reason in protocol.reasons.values():
            scope = Scope(reason.machine)
            self.reasons.setdefault(RuleName(reason.machine, reason.rule), []).append(
                CompiledReason(
                    reason.wording,
                    self.expression(reason.guard, scope, None),
                    tuple(self.expression(value, scope, None) for value in reason.values),
                )
            )
        self.replies = {name: reply_fields_of(self, name) for name in protocol.frames}

    def _events(self, kind: InputKind) -> tuple[Event, ...]:
        return tuple(
            Event(machine.name, i.name, {})
            for machine in self.protocol.machines.values()
            for i in machine.inputs
            if i.kind == kind
        )

    @cached_property
    def as_closed(self) -> Model:
        """The same texts for a device that has exactly the declared objects."""
        if self.dictionary.closed:
            return self
        return type(self)(self.protocol, assuming=self.assuming, closed=True)

    @cached_property
    def has_mailbox(self) -> bool:
        """Tell whether the device may have a mailbox; else its text says that it has none."""
        support = self.protocol.pins.get("mailbox_support")
        return support is None or support.alternative != "absent"

    def sets_up(self, index: int) -> bool:
        """Tell whether an object has a say in what process data hold."""
        return self.image.configures(index) or any(key[0] == index for key in self.settings)

    def functions(self) -> Mapping[str, Function]:
        """Give the functions that the texts may call."""
        return PLAIN | self.dictionary.functions | self.image.functions

    def signature(self, event: Event) -> tuple[tuple[str, Type], ...]:
        """Give the parameters of an input with their types."""
        inputs = self.protocol.machines[event.machine].inputs
        return next(i.parameters for i in inputs if i.name == event.input)

    # --- names of slots ---------------------------------------------------------------------------

    def _initial(self) -> list[tuple[str, Value | None]]:
        protocol = self.protocol
        found: list[tuple[str, Value | None]] = []
        for machine in protocol.machines.values():
            table = protocol.tables[machine.table]
            values = {row.name: row.value for row in table.rows}
            found.append((f"{machine.name}.state", values[machine.initial]))
            for variable in machine.variables:
                lookup = self._lookup(Scope(machine.name), variable.type)
                value = compile_expression(variable.initial, lookup, PLAIN)
                found.append((f"{machine.name}.{variable.name}", value(Environment((), {}, {}))))
        for choice in protocol.choices.values():
            pin = protocol.pins.get(choice.name)
            decided = pin.alternative if pin else None
            if decided is None and self.assuming:
                decided = choice.alternatives[0].name
            found.append((f"choice {choice.name}", decided))
        found += [
            (f"register {register.name}", register.reset)
            for register in protocol.registers.values()
            if register.main is Access.BOTH
        ]
        found += [(f"word {word}", 0) for word in protocol.words]
        return found

    def slot(self, ref: Ref) -> int:
        """Give the slot that a variable, a state, a choice or a register lies in."""
        match ref:
            case VariableRef(machine=machine, name=name):
                return self.slots[f"{machine}.{name}"]
            case StateRef(machine=machine):
                return self.slots[f"{machine}.state"]
            case ChoiceRef(name=name):
                return self.slots[f"choice {name}"]
            case RegisterFieldRef(register=register):
                return self.slots[f"register {register}"]
            case _:
                raise TypeError(f"{ref} has no slot")

    def rules(self, machine: str, source: str) -> tuple[CompiledRule, ...]:
        """Give the rules and gaps of an input, compiled when they are asked for first."""
        found = self._rules.get((machine, source))
        if found is None:
            rows = rows_of(self.protocol.machines[machine])
            found = tuple(rule_of(self, machine, row) for row in rows if row.input == source)
            self._rules[machine, source] = found
            self._named |= {rule.name: rule for rule in found}
        return found

    def named(self, rule: RuleName) -> CompiledRule:
        """Give a rule by its name."""
        if rule not in self._named:
            self.rules(rule.machine, self._input_of[rule])
        return self._named[rule]

    def decode(self, data: bytes) -> Message | None:
        """Decode what lies in a mailbox by the first outermost layout that fits."""
        # the same message is looked at by the device, the session and the oracle
        if data not in self._decoded:
            messages = (self.codec.decode(data, root) for root in self._roots)
            self._decoded.keep(data, next((each for each in messages if each is not None), None))
        return self._decoded[data]

    def takers(self, sender: str, trail: tuple[str, ...]) -> list[tuple[str, str]]:
        """Give the inputs of other machines that take a frame: those of its innermost layout."""
        for layout in reversed(trail):
            found = [
                (machine.name, source.name)
                for machine in self.protocol.machines.values()
                for source in machine.inputs
                if machine.name != sender
                and source.kind == InputKind.FRAME
                and layout in source.origin
            ]
            if found:
                return found
        return []

    def mail(self, message: Message, *, crowded: bool) -> Event:
        """Give the input that a message is; `crowded`: an earlier one was unanswered."""
        source = next(
            i for i in self.protocol.machines[MAILBOX].inputs if message.trail[0] in i.origin
        )
        parameters = {**message.fields, CROWDED: crowded}
        return Event(MAILBOX, source.name, parameters, message.trail)

    def state_names(self, machine: str) -> dict[int, str]:
        """Give the states of a machine by value."""
        wanted = set(self.protocol.machines[machine].states)
        table = self.protocol.tables[self.protocol.machines[machine].table]
        return {row.value: row.name for row in table.rows if row.name in wanted}

    def definition(self, name: str, scope: Scope = _NO_RULE) -> Getter:
        """Give a definition of the texts as a function, in no rule's scope or in that of one."""
        if (name, scope) not in self._definitions:
            value = self.protocol.definitions[name].value
            self._definitions[name, scope] = self.expression(value, scope, None)
        return self._definitions[name, scope]

    def broken(self, state: State) -> tuple[str, ...]:
        """Give the properties of the texts that do not hold in a state."""
        environment = Environment(state.slots, {}, {})
        return tuple(name for name, law in self._properties if law(environment) is False)

    def parameter(self, name: str, part: str | None = None) -> int:
        """Give the value of a parameter (of an area: `start` or `length`; of a time: us)."""
        if (name, part) not in self._parameters:
            self._parameters[name, part] = self._parameter(name, part)
        return self._parameters[name, part]

    def _parameter(self, name: str, part: str | None) -> int:
        parameter = self.protocol.parameters[name]
        expression = parameter.value[1 if part == "length" else 0]
        value = compile_expression(expression, self._lookup(Scope()), {})(Environment((), {}, {}))
        if not isinstance(value, int):
            raise TypeError(f"{parameter.at}: `{name}` is no number")
        return value

    def row(self, table: str, name: str) -> int:
        """Give the value of a row of a code table."""
        return next(row.value for row in self.protocol.tables[table].rows if row.name == name)

    @cached_property
    def _al_state_slot(self) -> int:
        return self.slots["al.state"]

    def _al_state(self, environment: Environment) -> Value:
        value = environment.slots[self._al_state_slot]
        return UNKNOWN if value is None else value

    # --- compilation ------------------------------------------------------------------------------

    def expression(self, expression: Expression, scope: Scope, expected: Type | None) -> Getter:
        """Compile an expression that stands in `scope` where a value of `expected` is wanted."""
        return compile_expression(
            expression,
            self._lookup(scope, expected, expression),
            self._functions,
        )

    def _lookup(
        self, scope: Scope, expected: Type | None = None, within: Expression | None = None
    ) -> Lookup:
        hints = {} if within is None else name_hints(self.protocol, within, scope)

        def lookup(name: Name) -> Getter:
            hint = hints.get(id(name)) or expected
            return self._getter(resolve(self.protocol, name.path, scope, hint), scope)

        return lookup

    def _getter(self, ref: Ref, scope: Scope) -> Getter:
        match ref:
            case ParameterOfInput(name=key):
                return lambda environment: environment.parameters.get(key, UNKNOWN)
            case ReplyField(name=key):
                path = f"{REPLY}.{key}"
                return lambda environment: environment.parameters.get(path, UNKNOWN)
            case VariableRef() | StateRef():
                slot = self.slot(ref)
                return lambda environment: _present(environment.slots[slot])
            case RegisterFieldRef(register=register, field=field):
                text = self.protocol.registers[register]
                return self._field(self.slots[f"register {register}"], text.fields, field)
            case WordFieldRef(word=word, field=field):
                fields = self.protocol.words[word].fields
                return self._field(self.slots[f"word {word}"], fields, field)
            case ParameterRef(name=name, part=part):
                return constant(self.parameter(name, part))
            case ChoiceRef(name=name):
                return self._choice(name)
            case AlternativeRef(name=name):
                return constant(name)
            case ConditionRef(name=name):
                known: Value = UNKNOWN
                if self.assuming:
                    known = self.protocol.conditions[name].assumed
                return constant(known)
            case ConstantRef(value=value):
                return constant(value)
            case DefinitionRef(name=name):
                return remembered(name, self.definition(name, scope))
            case _:
                assert_never(ref)

    def _choice(self, name: str) -> Getter:
        slot = self.slots[f"choice {name}"]

        def choice(environment: Environment) -> Value:
            value = environment.slots[slot]
            if value is None:
                environment.undecided.add(name)
                return UNKNOWN
            return value

        return choice

    def _field(self, slot: int, fields: tuple[RegisterField, ...], name: str) -> Getter:
        bits = next(item for item in fields if item.name == name)
        truth = isinstance(bits.type, Bool)
        low, mask = bits.low, bits_of(-1, bits.low, bits.high)

        def field(environment: Environment) -> Value:
            value = environment.slots[slot]
            if not isinstance(value, int):
                return UNKNOWN
            content = value >> low & mask
            return bool(content) if truth else content

        return field

    def _reads(self, word: Word) -> Getter:
        """Give what the object of a word reads as: the bits that the texts show."""
        views = self.views[word.name]

        def reads(environment: Environment) -> Value:
            raw = mask = 0
            for view in views:
                value = view.present(environment)
                if not isinstance(value, Pattern | bytes | str):
                    raw |= int(value) << view.low
                    mask |= ((1 << view.width) - 1) << view.low
            content, certain = (n.to_bytes(word.size, "little") for n in (raw, mask))
            if self.assuming:
                return content
            return Octets((word.size, word.size), content, certain)

        return reads


def _present(value: Value | None) -> Value:
    return UNKNOWN if value is None else value
