"""Checks that texts make sense: names, kinds of values, meaning."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.spec.language.arithmetic import DIVISIONS, constant
from ecatspec.spec.language.check_texts import LAYOUT_WORDS
from ecatspec.spec.language.diagnostics import Code, Diagnostic, near
from ecatspec.spec.language.ir import (
    Access,
    AnyValue,
    Area,
    Binary,
    Bool,
    Bytes,
    Call,
    CodeTable,
    Conditional,
    Frame,
    Gap,
    In,
    Literal,
    Machine,
    Name,
    Named,
    ObjectEntry,
    OneOf,
    Range,
    Reason,
    Register,
    RegisterField,
    Rule,
    SInt,
    Span,
    Text,
    Time,
    Type,
    UInt,
    Unary,
    Word,
)
from ecatspec.spec.language.logic import COMPARED
from ecatspec.spec.language.overlap import meaning
from ecatspec.spec.language.parse import TIME_DIGITS
from ecatspec.spec.language.scope import (
    CYCLIC,
    EDGES,
    FUNCTIONS,
    REPLY,
    WITH_BEFORE,
    ChoiceRef,
    ConstantRef,
    DefinitionRef,
    Kind,
    ParameterOfInput,
    Scope,
    UnresolvedName,
    VariableRef,
    bounds_of,
    expectation,
    frame_chain,
    frame_fields,
    input_of,
    kind_of,
    kind_of_ref,
    known_names,
    names_in,
    resolve,
    width_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ecatspec.spec.language.ir import (
        After,
        Expression,
        Give,
        Input,
        Later,
        Protocol,
        Send,
        Update,
    )

_BITS: Final = 8
_PLACE: Final = re.compile(r"\{[^{}]*\}")
_WORDS: Final = "{words}"
_PLACES: Final = ("{}", "{hex}", _WORDS)
_TOLD: Final = (UInt, SInt, Bool, Named, ChoiceRef)
_REPLY: Final = f"{REPLY}."


def check_protocol(protocol: Protocol) -> list[Diagnostic]:
    """What is wrong with texts put together: the findings of the first phase that has any."""
    if found := check_words(protocol):
        return found
    checker = _Checker(protocol)
    checker.objects()
    return [*checker.of_phase("4"), *meaning(protocol)]


def check_words(protocol: Protocol) -> list[Diagnostic]:
    """What is wrong with names and kinds of values; a planted fault may mean what it likes."""
    checker = _Checker(protocol)
    checker.structure()
    checker.expressions()
    return checker.of_phase("1") or checker.of_phase("2")


# --- after the merge -----------------------------------------------------------------------------


class _Checker:
    """Walks over a whole Protocol and notes what is wrong."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._found: dict[Diagnostic, None] = {}
        self._kinds: dict[tuple[str, Scope, Kind | None], Kind | None] = {}
        """Definitions that were walked: what is wrong inside is noted once for a scope."""

    def of_phase(self, phase: str) -> list[Diagnostic]:
        """The findings whose code begins with this digit."""
        return [d for d in self._found if d.code.name[len("ECS")] == phase]

    def _note(self, code: Code, at: Span, message: str, remedy: str) -> None:
        self._found[Diagnostic(code, at, message, remedy)] = None

    def _missing(self, kind: str, name: str, known: Iterable[str], at: Span) -> None:
        names = sorted(set(known))
        remedy = f"declare it{near(name, names, ', or write ')}"
        self._note(Code.ECS106, at, f"there is no {kind} `{name}`", remedy)

    # --- structure: what must exist, what must fit ---

    def structure(self) -> None:
        """Check everything that is no expression."""
        for table in self._protocol.tables.values():
            self._table(table)
        for parameter in self._protocol.parameters.values():
            self._type(parameter.type, parameter.at)
        for register in self._protocol.registers.values():
            self._register(register)
        self._words()
        for frame in self._protocol.frames.values():
            self._frame(frame)
        for machine in self._protocol.machines.values():
            self._machine(machine)
        for reason in self._protocol.reasons.values():
            self._reason_of(reason)

    def _table(self, table: CodeTable) -> None:
        for row in table.rows:
            if row.value >> table.width:
                self._note(
                    Code.ECS201,
                    row.at,
                    f"{row.value:#x} does not fit the {table.width} bits of `{table.name}`",
                    "make the table wider or the value smaller",
                )

    def _type(self, kind: Type, at: Span) -> None:
        if isinstance(kind, Named) and kind.table not in self._protocol.tables:
            self._missing("table", kind.table, self._protocol.tables, at)
        if isinstance(kind, UInt | SInt) and not kind.width:
            self._note(Code.ECS201, at, "a number of no bits", "give it at least one bit")

    def _register(self, register: Register) -> None:
        bits = register.size * _BITS
        if register.reset >> bits:
            self._note(
                Code.ECS201,
                register.at,
                f"the reset value does not fit the {bits} bits of `{register.name}`",
                "make it smaller",
            )
        self._bits(register.name, bits, register.fields)

    def _words(self) -> None:
        objects: dict[tuple[int, int], Word] = {}
        for word in self._protocol.words.values():
            self._bits(word.name, word.size * _BITS, word.fields)
            for field in word.fields:
                if field.name == CYCLIC:
                    what = f"`{CYCLIC}` is a parameter of each input from a word"
                    self._note(Code.ECS102, field.at, what, "give the field another name")
            if word.key is None:
                continue
            index, subindex = word.key
            what = f"object {index:#06x}:{subindex}"
            if index >> 16 or subindex >> 8:
                self._note(Code.ECS201, word.at, f"there is no {what}", "make it smaller")
            if word.key in objects:
                first = objects[word.key]
                self._note(
                    Code.ECS102,
                    word.at,
                    f"{what} has the word `{first.name}` already at {first.at}",
                    "take one of them away",
                )
            objects.setdefault(word.key, word)

    def _bits(self, owner: str, bits: int, fields: Iterable[RegisterField]) -> None:
        taken: dict[int, str] = {}
        for field in fields:
            self._type(field.type, field.at)
            span = range(field.low, field.high + 1)
            if field.high >= bits or not span:
                self._note(
                    Code.ECS201,
                    field.at,
                    f"bits {field.low}..{field.high} are not in the {bits} bits of `{owner}`",
                    f"stay between 0 and {bits - 1}, low bit first",
                )
            others = sorted({taken[bit] for bit in span if bit in taken})
            if others:
                self._note(
                    Code.ECS201,
                    field.at,
                    f"`{field.name}` takes bits of `{others[0]}`",
                    "move one of them",
                )
            taken |= dict.fromkeys(span, field.name)
            width = width_of(self._protocol, field.type)
            if width is not None and span and width != len(span):
                self._note(
                    Code.ECS201,
                    field.at,
                    f"`{field.name}` has {len(span)} bits and a type of {width}",
                    "make them equal",
                )

    def _frame(self, frame: Frame) -> None:
        parent = None if frame.parent is None else self._protocol.frames.get(frame.parent)
        if frame.parent is not None and parent is None:
            self._missing("frame", frame.parent, self._protocol.frames, frame.at)
        chain = list(frame_chain(self._protocol, frame.name))
        if parent is not None and self._protocol.frames[chain[-1]].parent is not None:
            self._note(Code.ECS204, frame.at, f"`{frame.name}` lies in itself", "break the circle")
            return
        if parent is not None and not (parent.fields and isinstance(parent.fields[-1].type, Bytes)):
            self._note(
                Code.ECS204,
                frame.at,
                f"`{parent.name}` has no bytes at its end that `{frame.name}` could lie in",
                "give it a last field of type bytes",
            )
        outer = {
            field.name: name for name in chain[1:] for field in self._protocol.frames[name].fields
        }
        for field in frame.fields:
            if field.name in outer and not field.name.startswith(LAYOUT_WORDS):
                self._note(
                    Code.ECS204,
                    field.at,
                    f"`{field.name}` is a field of `{outer[field.name]}` around it already",
                    "give it another name",
                )
        self._layout(frame)
        fields = {} if parent is None else frame_fields(self._protocol, parent.name)
        for name, _ in frame.conditions:
            if parent is not None and name not in fields:
                self._missing(f"field of `{parent.name}`", name, fields, frame.at)

    def _layout(self, frame: Frame) -> None:
        bits: int | None = 0
        for position, field in enumerate(frame.fields):
            self._type(field.type, field.at)
            width = width_of(self._protocol, field.type)
            if isinstance(field.type, Bytes):
                if field.type.length is None and position + 1 < len(frame.fields):
                    self._note(
                        Code.ECS204,
                        field.at,
                        f"`{field.name}` takes all bytes, and `{frame.fields[-1].name}` follows",
                        "say how many bytes it has: bytes(n)",
                    )
                if bits is not None and bits % _BITS:
                    self._note(
                        Code.ECS204,
                        field.at,
                        f"`{field.name}` begins at bit {bits}, in the middle of a byte",
                        "add a reserved field before it",
                    )
                bits = 0
            elif width is None:
                if not isinstance(field.type, Named):
                    self._note(
                        Code.ECS204,
                        field.at,
                        f"`{field.name}` has no place in a frame with this type",
                        "take a number, bool, a table or bytes",
                    )
                bits = None
            elif bits is not None:
                bits += width
        if bits is not None and bits % _BITS:
            self._note(
                Code.ECS204,
                frame.at,
                f"the fields of `{frame.name}` end in the middle of a byte",
                "add a reserved field",
            )

    def _machine(self, machine: Machine) -> None:
        table = self._protocol.tables.get(machine.table)
        if table is None:
            self._missing("table", machine.table, self._protocol.tables, machine.at)
        else:
            rows = [row.name for row in table.rows]
            for state in machine.states:
                if state not in rows:
                    self._missing(f"row of table `{table.name}`", state, rows, machine.at)
        self._states(machine, (machine.initial,), machine.at)
        for variable in machine.variables:
            self._type(variable.type, variable.at)
        for item in machine.inputs:
            self._input(item)
        rules_and_gaps: tuple[Rule | Gap, ...] = (*machine.rules, *machine.gaps)
        for row in rules_and_gaps:
            self._states(machine, row.sources, row.at)
            if row.input not in machine.input_by_name:
                self._missing("input", row.input, machine.input_by_name, row.at)
        for rule in machine.rules:
            if rule.target is not None:
                self._states(machine, (rule.target,), rule.at)

    def _input(self, item: Input) -> None:
        what, known = "register", list(self._protocol.registers)
        if item.kind == "frame":
            what, known = "frame", list(self._protocol.frames)
        elif item.kind == "word":
            what, known = "word", list(self._protocol.words)
        for origin in item.origin:
            if origin not in known:
                self._missing(what, origin, known, item.at)
            elif item.kind == "word" and self._protocol.words[origin].key is None:
                what = f"word `{origin}` has no object that could take a value"
                self._note(Code.ECS106, item.at, what, f"write word {origin} in INDEX : SUBINDEX")
        for _, kind in item.parameters:
            self._type(kind, item.at)

    def _reason_of(self, reason: Reason) -> None:
        machine = self._protocol.machines.get(reason.machine)
        if machine is None:
            self._missing("machine", reason.machine, self._protocol.machines, reason.at)
            return
        rules = [rule.name for rule in machine.rules]
        if reason.rule not in rules:
            self._missing(f"rule of `{machine.name}`", reason.rule, rules, reason.at)

    def _states(self, machine: Machine, states: Iterable[str], at: Span) -> None:
        for state in states:
            if state not in machine.states:
                self._missing(f"state of `{machine.name}`", state, machine.states, at)

    # --- expressions: where they stand and what is expected there ---

    def expressions(self) -> None:
        """Check every expression of the Protocol."""
        nowhere = Scope()
        for parameter in self._protocol.parameters.values():
            area = isinstance(parameter.type, Area)
            if len(parameter.value) != 1 + area:
                self._note(
                    Code.ECS202,
                    parameter.at,
                    f"parameter `{parameter.name}` gets a value of another kind",
                    "write area(start, length)" if area else "write one value",
                )
                continue
            for value in parameter.value:
                self._demand(value, nowhere, UInt(16) if area else parameter.type)
        for register in self._protocol.registers.values():
            self._shows(register.fields)
        for word in self._protocol.words.values():
            self._shows(word.fields)
        for law in self._protocol.properties.values():
            self._demand(law.value, nowhere, Bool())
        for frame in self._protocol.frames.values():
            self._frame_expressions(frame)
        for machine in self._protocol.machines.values():
            for variable in machine.variables:
                self._demand(variable.initial, nowhere, variable.type)
            for rule in machine.rules:
                self._rule(machine, rule)
            for gap in machine.gaps:
                self._guard(machine, gap)
        for reason in self._protocol.reasons.values():
            self._reason(reason)

    def _shows(self, fields: Iterable[RegisterField]) -> None:
        for field in fields:
            if field.shows is not None:
                self._demand(field.shows.value, Scope(), field.type)
                if field.shows.condition is not None:
                    self._demand(field.shows.condition, Scope(), Bool())
                if field.shows.advised is not None:
                    self._demand(field.shows.advised.value, Scope(), field.type)

    def _frame_expressions(self, frame: Frame) -> None:
        inside = Scope(frame=frame.name)
        if frame.parent is not None:
            types = frame_fields(self._protocol, frame.parent)
            for name, value in frame.conditions:
                if name in types:
                    self._demand(value, Scope(), types[name])
        for field in frame.fields:
            if isinstance(field.type, Bytes) and field.type.length is not None:
                self._demand(field.type.length, inside, UInt(16))
            for given in (field.value, field.filled):
                if given is not None:
                    self._demand(given, inside, field.type)
            if field.filled is not None and (
                field.value is not None or field.name in names_in(field.filled)
            ):
                self._note(
                    Code.ECS204,
                    field.at,
                    f"`{field.name}` is never filled: it has a constant, or needs itself",
                    "fill a field from others of its frame",
                )
            if field.reply is not None:
                self._demand(field.reply, inside, field.type)
            if field.into is not None:
                self._variable(field.into, Scope(), field.at)

    def _variable(self, path: str, scope: Scope, at: Span) -> Kind | None:
        """The kind of the variable that is to be set."""
        own = self._protocol.machines.get(scope.machine or "")
        if own is not None:
            for variable in own.variables:
                if variable.name == path:
                    return variable.type
        try:
            ref = resolve(self._protocol, path, Scope()) if "." in path else None
        except UnresolvedName:
            ref = None
        if isinstance(ref, VariableRef):
            return kind_of_ref(self._protocol, ref, Scope())
        known = [] if own is None else [variable.name for variable in own.variables]
        self._note(
            Code.ECS101,
            at,
            f"`{path}` is no variable that can be set",
            f"declare it as a variable{near(path, known, ', or write ')}",
        )
        return None

    def _guard(self, machine: Machine, row: Rule | Gap) -> Scope:
        scope = Scope(machine.name, row.input)
        if row.guard is not None:
            self._demand(row.guard, scope, Bool())
        return scope

    def _rule(self, machine: Machine, rule: Rule) -> None:
        scope = self._guard(machine, rule)
        owner = f"rule `{machine.name}.{rule.name}`"
        self._updates(rule.updates, scope, owner)
        for store in rule.stores:
            self._demand(store.index, scope, UInt(16))
            self._demand(store.subindex, scope, UInt(8))
            self._demand(store.value, scope, Bytes(None))
        if rule.take is not None:
            self._demand(rule.take, scope, Bytes(None))
        for send in rule.sends:
            self._send(send, scope)
        self._gives(rule.gives, scope)
        for later in rule.laters:
            self._event(later, {"event", "local", "own"}, scope)
            if later.after is not None:
                self._demand(later.after, scope, Time())
            self._demand(later.within, scope, Time())
        if rule.within is not None:
            self._demand(rule.within, scope, Time())
        if rule.after is not None:
            self._after(rule, rule.after, scope, owner)

    def _after(self, rule: Rule, after: After, scope: Scope, owner: str) -> None:
        if not rule.sends:
            what = f"{owner} sends no frame that anything could come after"
            self._note(Code.ECS106, after.at, what, "send one, or set and give before `within`")
            return
        for give in after.gives:
            if give.target in {"deliver", "resend"}:
                what = f"`{give.target}` comes too late: the frame of {owner} is sent"
                self._note(Code.ECS202, give.at, what, "write it before `within`")
        later = replace(scope, reply=rule.sends[-1].frame)
        self._updates(after.updates, later, owner)
        self._gives(after.gives, later)

    def _updates(self, updates: Sequence[Update], scope: Scope, owner: str) -> None:
        for update in updates:
            self._demand(update.value, scope, self._variable(update.variable, scope, update.at))
        for again, times in Counter(update.variable for update in updates).items():
            if times > 1:
                what = f"{owner} sets `{again}` twice"
                self._note(Code.ECS102, updates[0].at, what, "take one of them away")

    def _gives(self, gives: Iterable[Give], scope: Scope) -> None:
        for give in gives:
            if give.target == "resend":
                continue
            if give.target == "deliver":
                found = input_of(self._protocol, scope)
                if found is None or found.kind not in {"write", "frame"}:
                    self._note(
                        Code.ECS202,
                        give.at,
                        "there is no frame that could be delivered",
                        "deliver in rules on a write or a frame",
                    )
                continue
            self._event(give, {"event"}, scope)

    def _event(self, event: Give | Later, kinds: set[str], scope: Scope) -> None:
        """The target is an input of one of these kinds and gets all its parameters."""
        machine, _, name = event.target.partition(".")
        other = self._protocol.machines.get(machine)
        inputs = {} if other is None else {i.name: i for i in other.inputs if i.kind in kinds}
        if name not in inputs:
            self._missing("event", event.target, (f"{machine}.{i}" for i in inputs), event.at)
            return
        parameters = dict(inputs[name].parameters)
        self._bindings(event.arguments, parameters, scope, event.target, event.at)
        for parameter in parameters:
            if parameter not in dict(event.arguments):
                what = f"`{event.target}` gets no `{parameter}`"
                self._note(Code.ECS203, event.at, what, f"write {parameter} = ...")

    def _reason(self, reason: Reason) -> None:
        """A reason is told after the rule has fired: the parameters of the input are gone."""
        scope = Scope(reason.machine)
        self._demand(reason.guard, scope, Bool())
        places = _PLACE.findall(reason.wording)
        for place in places:
            if place not in _PLACES:
                what = f"{place} in reason `{reason.name}` stands for nothing"
                self._note(Code.ECS206, reason.at, what, f"write {' or '.join(_PLACES)}")
        if len(places) != len(reason.values):
            self._note(
                Code.ECS206,
                reason.at,
                f"reason `{reason.name}` has {len(places)} places for {len(reason.values)} values",
                "give a value for each place of the wording",
            )
        for place, value in zip(places, reason.values, strict=False):
            expected = Bytes(None) if place == _WORDS else None
            kind = self._walk(value, scope, expected)
            fits = isinstance(kind, Bytes) if place == _WORDS else isinstance(kind, _TOLD)
            if kind is not None and not fits:
                what = f"{_word(kind)} cannot be told by {place}"
                remedy = f"write {_WORDS} for bytes, and {{}} or {{hex}} for all else"
                self._note(Code.ECS206, value.at, what, remedy)

    def _send(self, send: Send, scope: Scope) -> None:
        if send.frame not in self._protocol.frames:
            self._missing("frame", send.frame, self._protocol.frames, send.at)
            return
        types = frame_fields(self._protocol, send.frame)
        self._bindings(send.fields, types, replace(scope, reply=send.frame), send.frame, send.at)
        needed = {
            name: {path.removeprefix(_REPLY) for path in names_in(value) if path.startswith(_REPLY)}
            for name, value in send.fields
        }
        for name, value in send.fields:
            reached: set[str] = set()
            waiting = [name]
            while waiting:
                fresh = needed.get(waiting.pop(), set()) - reached
                reached |= fresh
                waiting += fresh
            if name in reached:
                what = f"`{name}` of the reply leads back to itself"
                self._note(Code.ECS101, value.at, what, "say it by other fields")

    def _bindings(
        self,
        given: Iterable[tuple[str, Expression]],
        types: Mapping[str, Type],
        scope: Scope,
        owner: str,
        at: Span,
    ) -> None:
        for name, value in given:
            if name not in types:
                self._note(
                    Code.ECS101,
                    at,
                    f"`{owner}` has no `{name}`",
                    f"name one of its own{near(name, types)}",
                )
            self._demand(value, scope, types.get(name))

    # --- kinds of values ---

    def _demand(self, value: Expression, scope: Scope, expected: Kind | None) -> None:
        """The expression must give a value of this kind, whatever the kind if None."""
        self._compatible(self._walk(value, scope, expected), expected, value.at)

    def _compatible(self, found: Kind | None, expected: Kind | None, at: Span) -> bool:
        if found is None or expected is None or _agree(found, expected):
            return True
        self._note(
            Code.ECS202,
            at,
            f"{_word(found)} stands where {_word(expected)} is needed",
            "compare and set values of one kind",
        )
        return False

    def _walk(self, value: Expression, scope: Scope, expected: Kind | None) -> Kind | None:
        """The kind of a value; everything inside it is checked."""
        found: Kind | None = None
        match value:
            case Literal():
                found = self._literal(value, value.value, expected)
            case Name():
                found = self._name(value, scope, expected)
            case Unary("-", Literal() as literal):
                found = self._literal(literal, -literal.value, expected)
            case Unary(operator, operand):
                found = Bool() if operator == "not" else _NUMBER
                self._demand(operand, scope, found)
            case Binary(operator, left, right) if operator in COMPARED:
                self._compare(operator, left, right, scope)
                found = Bool()
            case Binary(operator, left, right):
                found = Bool() if operator in {"and", "or"} else _NUMBER
                if operator == "+" and kind_of(self._protocol, left, scope) == Time():
                    found = Time()
                self._demand(left, scope, found)
                self._demand(right, scope, found)
                if operator in DIVISIONS and constant(self._protocol, right, scope) == 0:
                    what = "a number is divided by zero: nothing is known of the result"
                    self._note(Code.ECS207, right.at, what, "divide by another number")
            case In(operand, items):
                kind = self._walk(operand, scope, None)
                self._items(items, scope, kind)
                found = Bool()
            case Conditional(condition, then, otherwise):
                self._demand(condition, scope, Bool())
                found = self._walk(then, scope, expected)
                other = self._walk(otherwise, scope, expected)
                self._compatible(other, found, otherwise.at)
                found = found or other
            case Call():
                found = self._call(value, scope)
            case OneOf(items, excluded):
                self._items(items, scope, expected)
                if excluded is not None:
                    self._demand(excluded, scope, expected)
            case AnyValue(preferred):
                if preferred is not None:
                    self._demand(preferred, scope, expected)
            case _:
                assert_never(value)
        return found

    def _literal(self, literal: Literal, value: int, expected: Kind | None) -> Kind | None:
        if isinstance(literal.value, bool):
            return Bool()
        if literal.digits == TIME_DIGITS:
            return Time()
        self._fits(value, expected, literal.at)
        return _NUMBER

    def _fits(self, value: int, expected: Kind | None, at: Span) -> None:
        if expected is None or expected == _NUMBER or isinstance(expected, Bool):
            return
        bounds = bounds_of(self._protocol, expected)
        if bounds is not None and not bounds[0] <= value <= bounds[1]:
            self._note(
                Code.ECS201,
                at,
                f"{value} does not fit {_word(expected)} ({bounds[0]}..{bounds[1]})",
                "take a value that fits or a wider type",
            )
        elif (
            isinstance(expected, Named)
            and (table := self._protocol.tables.get(expected.table)) is not None
            and table.closed
            and value not in {row.value for row in table.rows}
            and not self._closed_elsewhere(table, at)
        ):
            self._note(
                Code.ECS201,
                at,
                f"the closed table `{table.name}` has no value {value:#x}",
                "take one of its rows",
            )

    def _closed_elsewhere(self, table: CodeTable, at: Span) -> bool:
        """Tell whether another text closed the table: the standard may still ask for its values."""
        closing = self._protocol.closed.get(table.name)
        return closing is not None and closing.at.file != at.file

    def _name(self, name: Name, scope: Scope, expected: Kind | None) -> Kind | None:
        try:
            ref = resolve(self._protocol, name.path, scope, expected)
        except UnresolvedName as error:
            self._unresolved(name, error, scope, expected)
            return None
        if isinstance(ref, DefinitionRef):
            key = (ref.name, scope, expected)
            if key not in self._kinds:
                value = self._protocol.definitions[ref.name].value
                self._kinds[key] = self._walk(value, scope, expected)
            return self._kinds[key]
        if isinstance(ref, ConstantRef) and not isinstance(expected, Named):
            self._fits(ref.value, expected, name.at)
        return kind_of_ref(self._protocol, ref, scope)

    def _unresolved(
        self, name: Name, error: UnresolvedName, scope: Scope, expected: Kind | None
    ) -> None:
        if error.candidates:
            rows = " or ".join(f"`{candidate}`" for candidate in error.candidates)
            what = f"`{name.path}` is a row of several tables"
            self._note(Code.ECS107, name.at, what, f"write {rows}")
            return
        if isinstance(expected, Named) and expected.table not in self._protocol.tables:
            return  # that the table is missing is the finding
        known = known_names(self._protocol, scope, expected)
        where = f" in rules on `{scope.input}`" if scope.input is not None else ""
        self._note(
            Code.ECS101,
            name.at,
            f"`{name.path}` means nothing{where}",
            f"declare it{near(name.path, known, ', or write ')}",
        )

    def _compare(self, operator: str, left: Expression, right: Expression, scope: Scope) -> None:
        protocol = self._protocol
        of_left = expectation(protocol, right, scope) or kind_of(protocol, right, scope)
        of_right = expectation(protocol, left, scope) or kind_of(protocol, left, scope)
        if isinstance(right, Name) and of_left is None:
            of_left = kind_of(protocol, right, scope, of_right)
        if isinstance(left, Name) and of_right is None:
            of_right = kind_of(protocol, left, scope, of_left)
        kind = self._walk(left, scope, of_left)
        other = self._walk(right, scope, of_right)
        if self._compatible(other, kind, right.at) and operator not in {"==", "!="}:
            for side in (kind, other):
                if side is not None and not isinstance(side, UInt | SInt | Named | Time):
                    what = f"{_word(side)} has no order"
                    self._note(Code.ECS202, left.at, what, "compare with == or !=")
                    break

    def _items(
        self, items: Iterable[Expression | Range], scope: Scope, expected: Kind | None
    ) -> None:
        for item in items:
            if not isinstance(item, Range):
                self._demand(item, scope, expected)
                continue
            self._demand(item.low, scope, expected)
            self._demand(item.high, scope, expected)
            match item:
                case Range(Literal(low), Literal(high)) if low > high:
                    what = f"there is no number from {low} to {high}"
                    self._note(Code.ECS201, item.at, what, "write the smaller one first")
                case _:
                    pass

    def _call(self, call: Call, scope: Scope) -> Kind | None:
        signature = FUNCTIONS.get(call.function)
        if signature is None:
            self._note(
                Code.ECS101,
                call.at,
                f"there is no function `{call.function}`",
                f"take one of scope.FUNCTIONS{near(call.function, FUNCTIONS)}",
            )
            return None
        wanted = ", ".join(_word(kind) for kind in signature.arguments)
        remedy = f"write {call.function}({wanted})"
        if len(call.arguments) != len(signature.arguments):
            what = f"`{call.function}` gets {len(call.arguments)} arguments"
            self._note(Code.ECS203, call.at, what, remedy)
        fits = len(call.arguments) == len(signature.arguments)
        for argument, kind in zip(call.arguments, signature.arguments, strict=False):
            found = self._walk(argument, scope, kind)
            if found is not None and not _agree(found, kind):
                fits = False
                what = f"`{call.function}` gets {_word(found)} for {_word(kind)}"
                self._note(Code.ECS203, argument.at, what, remedy)
        if call.function in EDGES and fits:
            self._edge(call, scope)
        return signature.result

    def _edge(self, call: Call, scope: Scope) -> None:
        """Only what was written has a value before: a truth among the parameters of the input."""
        source = input_of(self._protocol, scope)
        remedy = f"write {call.function}(PARAMETER) with a bool of a register or word, by its name"
        if source is None or source.kind not in WITH_BEFORE:
            what = f"`{call.function}` where no register or word was written"
            self._note(Code.ECS205, call.at, what, remedy)
            return
        match call.arguments:
            case (Name(path),) if path != CYCLIC:
                try:
                    ref = resolve(self._protocol, path, scope)
                except UnresolvedName:
                    return  # that the name means nothing is the finding
                if ref == ParameterOfInput(path):
                    return
            case _:
                pass
        what = f"`{call.function}` of what is no field of `{', '.join(source.origin)}`"
        self._note(Code.ECS205, call.at, what, remedy)

    # --- objects ---

    def objects(self) -> None:
        """The range, the default and the type of an object must agree, and its states exist."""
        rows = {row.name for table in self._protocol.tables.values() for row in table.rows}
        for entry in self._protocol.objects:
            what = f"object {entry.index:#06x}:{entry.subindex} `{entry.name}`"
            for state in (*entry.states, *entry.read_states):
                if state not in rows:
                    self._missing("state", state, rows, entry.at)
            problem = self._problem(entry)
            if problem is not None:
                self._note(Code.ECS405, entry.at, f"{what}: {problem}", "correct the row")

    def _problem(self, entry: ObjectEntry) -> str | None:
        numbers = [n for n in (entry.low, entry.high, entry.default) if isinstance(n, int)]
        if isinstance(entry.type, Text | Bytes):
            most = entry.type.maximum if isinstance(entry.type, Text) else entry.type.length
            if isinstance(most, Literal):
                most = most.value
            if not isinstance(most, int) or isinstance(most, bool):
                return "the length of bytes is no number"
            if numbers:
                return "a text has no number"
            if len(str(entry.default or "").encode()) > most:
                return f"the default is longer than {most} bytes"
            return None
        bounds = bounds_of(self._protocol, entry.type)
        if isinstance(entry.default, str) or bounds is None:
            return "a number has no text"
        if any(not bounds[0] <= number <= bounds[1] for number in numbers):
            return f"a value is not in {bounds[0]}..{bounds[1]}, the numbers of its type"
        low = bounds[0] if entry.low is None else entry.low
        high = bounds[1] if entry.high is None else entry.high
        if low > high:
            return f"the range {low}..{high} is empty"
        if isinstance(entry.default, int) and not low <= entry.default <= high:
            return f"the default {entry.default} is not in the range {low}..{high}"
        if entry.index >> 16 or entry.subindex >> 8:
            return "index or subindex is too great"
        if entry.access is Access.NONE:
            return "nobody can read or write it"
        return None


_NUMBER: Final = UInt(64)


def _agree(one: Kind, other: Kind) -> bool:
    """Whether values of two kinds may meet: tables with themselves and with plain numbers."""
    match one, other:
        case (Named(), Named()) | (ChoiceRef(), ChoiceRef()):
            return one == other
        case (UInt() | SInt() | Named(), UInt() | SInt() | Named()):
            return True
        case (Bytes() | Text(), Bytes() | Text()):
            return True
        case _:
            return type(one) is type(other)


def _word(kind: Kind) -> str:
    match kind:
        case UInt(width):
            return "a number" if kind == _NUMBER else f"u{width}"
        case SInt(width):
            return f"i{width}"
        case Bool():
            return "bool"
        case Named(table):
            return f"a value of `{table}`"
        case Bytes():
            return "bytes"
        case Text():
            return "a text"
        case Area():
            return "an area"
        case Time():
            return "a time"
        case ChoiceRef(name):
            return f"a way at `{name}`"
        case _:
            assert_never(kind)
