"""Encodes expressions of the texts for a solver.

What the interpreter does not know is a symbol here: a condition, `any`, an answer of the object
dictionary, the content of bytes. What is proved holds for every value of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.model.core.compilation import Model
from ecatspec.model.core.expressions import before
from ecatspec.model.core.object_dictionary import CROWDED
from ecatspec.model.symbolic.dictionary_symbols import Answers
from ecatspec.model.symbolic.symbolic_state import ANY, Anything, Content, Meant, Moment, World
from ecatspec.model.symbolic.terms import (
    Symbols,
    Term,
    all_of,
    any_of,
    compared,
    counted,
    either,
    equal,
    is_truth,
    lesser,
    negated,
    within,
)
from ecatspec.spec.language.functions import EDGES, FUNCTIONS, REPLY
from ecatspec.spec.language.ir import (
    STANDARD,
    Access,
    AnyValue,
    Binary,
    Bool,
    Bytes,
    Call,
    Conditional,
    Expression,
    In,
    Literal,
    Name,
    Named,
    OneOf,
    Range,
    Unary,
)
from ecatspec.spec.language.kinds import bounds_of, kind_of_ref, name_hints
from ecatspec.spec.language.pretty_expressions import pretty_expression
from ecatspec.spec.language.references import (
    AlternativeRef,
    ChoiceRef,
    ConditionRef,
    ConstantRef,
    DefinitionRef,
    Kind,
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
    from ecatspec.spec.language.ir import Protocol, Type

LONGEST: Final = 1 << 32


class Meaning:
    """The terms of one specification.

    `abstract`: which objects there are is not known, as in the standard, which has none of its own.
    `closed`: exactly the declared objects exist, even if the text does not say so.
    """

    def __init__(
        self, protocol: Protocol, *, abstract: bool | None = None, closed: bool = False
    ) -> None:
        """Compile the interpreter's side, which answers what needs no solver."""
        self.protocol = protocol
        self.model = Model(protocol, closed=closed)
        self.symbols = Symbols()
        self.abstract = protocol.name == STANDARD if abstract is None else abstract
        self.kinds = _kinds(protocol)
        self._places: dict[int, tuple[Expression, int]] = {}
        self._hints: dict[tuple[int, Scope], tuple[Expression, dict[int, Kind]]] = {}
        self.answers = Answers(self.model, self.symbols, abstract=self.abstract)

    # --- symbols ----------------------------------------------------------------------------------

    def world(self, prefix: str = "") -> World:
        """Give a world of which nothing is known."""
        return World(self.symbol, prefix, {}, stamp=prefix)

    def power_on(self) -> World:
        """Give the world after power-on; registers hold what was written to them before."""
        world = self.world()
        for name, slot in self.model.slots.items():
            value = self.model.initial.slots[slot]
            if name in self.kinds and isinstance(value, int):
                world.base[name] = value
            elif isinstance(value, bytes):
                world.base[name] = Content(len(value), f"{value!r}")
        for word in self.protocol.words.values():
            for bits in word.fields:
                value = 0
                world.base[f"word {word.name}.{bits.name}"] = (
                    False if isinstance(bits.type, Bool) else value
                )
        return world

    def symbol(self, name: str, slot: str) -> Meant:
        """Make the symbol of a slot, within its type."""
        label = slot.removeprefix("register ").removeprefix("word ")
        made = self.of_kind(name, label, self.kinds[slot])
        machine, _, what = slot.partition(".")
        if what == "state" and machine in self.protocol.machines and not isinstance(made, Content):
            values = self.model.state_names(machine)
            self.symbols.fact(made, any_of(equal(made, value) for value in values))
        return made

    def of_kind(self, name: str, label: str, kind: Kind | None, *, abstract: bool = False) -> Meant:
        """Make a symbol within the bounds of a type."""
        match kind:
            case None:
                return ANY
            case Bool():
                return self.symbols.truth(name, label, kind, abstract=abstract)
            case Bytes():
                length = self.symbols.number(
                    f"{name}.length", f"length({label})", None, (0, LONGEST), abstract=abstract
                )
                return Content(length, name)
            case ChoiceRef(name=choice):
                ways = len(self.protocol.choices[choice].alternatives)
                return self.symbols.number(name, label, None, (0, ways - 1), abstract=abstract)
            case _:
                bounds = bounds_of(self.protocol, kind) or (0, None)
                return self.symbols.number(name, label, kind, bounds, abstract=abstract)

    def _place(self, part: Expression, at: Moment) -> str:
        """Give a name for what one part of an expression is at one moment."""
        number = self._places.setdefault(id(part), (part, len(self._places)))[1]
        return f"part {number} @{at.key}"

    def _free(self, part: Expression, at: Moment) -> Term:
        """Give the truth of a part that may hold or not."""
        return self.symbols.truth(self._place(part, at), "any", Bool())

    def typed(self, value: Meant, label: str, kind: Kind | None, key: str) -> Term | Content:
        """Give a value where one of a type is wanted: `any` becomes a symbol of it."""
        found = value
        if isinstance(value, Anything):
            found = self.of_kind(f"{label} of {key}", label, kind or Bool())
        assert not isinstance(found, Anything)
        return found

    def choice(self, name: str) -> Term:
        """Give the way at a choice, by the number of the alternative."""
        pin = self.protocol.pins.get(name)
        if pin is not None:
            return self.alternative(name, pin.alternative)
        ways = len(self.protocol.choices[name].alternatives)
        return self.symbols.number(f"choice {name}", name, None, (0, ways - 1))

    def alternative(self, choice: str, name: str) -> int:
        """Give the number of an alternative."""
        names = [way.name for way in self.protocol.choices[choice].alternatives]
        return names.index(name)

    # --- expressions ------------------------------------------------------------------------------

    def truth(self, expression: Expression | None, moment: Moment) -> Term:
        """Give the truth of a guard; no guard always holds."""
        if expression is None:
            return True
        return self._truth(self.value(expression, moment, None), expression, moment)

    def value(self, expression: Expression, moment: Moment, expected: Kind | None) -> Meant:
        """Give the meaning of an expression where a value of `expected` is wanted."""
        key = (id(expression), moment.scope)
        if key not in self._hints:
            hints = name_hints(self.protocol, expression, moment.scope)
            self._hints[key] = (expression, hints)
        return self._value(expression, moment, self._hints[key][1], expected)

    def _truth(self, value: Meant, part: Expression, at: Moment) -> Term:
        if isinstance(value, Content | Anything):
            return self._free(part, at)
        return value if is_truth(value) else negated(equal(value, 0))

    def _value(
        self, part: Expression, at: Moment, hints: dict[int, Kind], expected: Kind | None
    ) -> Meant:
        def inner(operand: Expression) -> Meant:
            return self._value(operand, at, hints, expected)

        match part:
            case Literal(value=value):
                return value
            case Name(path=path):
                hint = hints.get(id(part)) or expected
                return self._of_ref(resolve(self.protocol, path, at.scope, hint), at)
            case AnyValue():
                return ANY
            case Unary(operator="not", operand=operand):
                return negated(self._truth(inner(operand), operand, at))
            case Unary(operand=operand):
                return self._counted("-", 0, inner(operand))
            case Binary(operator="and", left=left, right=right):
                first = self._truth(inner(left), left, at)
                return all_of(
                    (first, True if first is False else self._truth(inner(right), right, at))
                )
            case Binary(operator="or", left=left, right=right):
                first = self._truth(inner(left), left, at)
                return any_of(
                    (first, False if first is True else self._truth(inner(right), right, at))
                )
            case Binary(operator="==", left=left, right=right):
                return self._equal(inner(left), inner(right), part, at)
            case Binary(operator="!=", left=left, right=right):
                return negated(self._equal(inner(left), inner(right), part, at))
            case Binary(operator="<" | "<=" | ">" | ">=" as sign, left=left, right=right):
                one, other = inner(left), inner(right)
                if isinstance(one, Content | Anything) or isinstance(other, Content | Anything):
                    return self._free(part, at)
                return compared(sign, one, other)
            case Binary(operator=sign, left=left, right=right):
                return self._counted(sign, inner(left), inner(right))
            case In(operand=operand, items=items):
                ranges = self._ranges(items, at, hints, expected)
                return self._member(inner(operand), ranges, part, at)
            case Conditional(condition=condition, then=then, otherwise=otherwise):
                asked = self._truth(inner(condition), condition, at)
                if isinstance(asked, bool):
                    return inner(then if asked else otherwise)
                ways = inner(then), inner(otherwise)
                return self._either(asked, *ways, expected, self._place(part, at))
            case Call():
                return self._call(part, at, hints)
            case OneOf(items=items, excluded=excluded):
                made = self.typed(ANY, "one of", expected, self._place(part, at))
                if isinstance(made, Content):
                    return made
                ranges = self._ranges(items, at, hints, expected)
                parts = [self._member(made, ranges, part, at)]
                if excluded is not None:
                    parts.append(negated(self._equal(made, inner(excluded), part, at)))
                self.symbols.fact(made, all_of(parts))
                return made
            case _:
                assert_never(part)

    def _of_ref(self, ref: Ref, at: Moment) -> Meant:
        match ref:
            case ParameterOfInput(name=name):
                return self.parameter(at, name)
            case ReplyField(name=name):
                return self.parameter(at, f"{REPLY}.{name}", ref)
            case VariableRef(machine=machine, name=name):
                return at.world.get(f"{machine}.{name}")
            case StateRef(machine=machine):
                return at.world.get(f"{machine}.state")
            case RegisterFieldRef(register=register, field=name):
                return at.world.get(f"register {register}.{name}")
            case WordFieldRef(word=word, field=name):
                return at.world.get(f"word {word}.{name}")
            case ParameterRef(name=name, part=part):
                return self.model.parameter(name, part)
            case ChoiceRef(name=name):
                return self.choice(name)
            case AlternativeRef(choice=choice, name=name):
                return self.alternative(choice, name)
            case ConditionRef(name=name):
                return self.symbols.truth(f"condition {name} @{at.key}", name, Bool())
            case ConstantRef(value=value):
                return value
            case DefinitionRef(name=name):
                key = (name, at.scope.reply)
                if key not in at.memo:
                    at.memo[key] = self.value(self.protocol.definitions[name].value, at, None)
                return at.memo[key]
            case _:
                assert_never(ref)

    def parameter(self, at: Moment, name: str, ref: Ref | None = None) -> Meant:
        """Give a parameter of the input, or a field of the reply."""
        if name not in at.parameters:
            kind = kind_of_ref(self.protocol, ref or ParameterOfInput(name), at.scope)
            at.parameters[name] = self.of_kind(f"{name} @{at.key}", name, kind)
        return at.parameters[name]

    def _equal(self, one: Meant, other: Meant, part: Expression, at: Moment) -> Term:
        if isinstance(one, Anything) or isinstance(other, Anything):
            return self._free(part, at)
        if isinstance(one, Content) or isinstance(other, Content):
            if not isinstance(one, Content) or not isinstance(other, Content):
                return self._free(part, at)
            if one.name == other.name:
                return True
            same = self.answers.truth("==", (one.name, other.name), f"{one.name} == {other.name}")
            self.symbols.fact(same, any_of((negated(same), equal(one.length, other.length))))
            return same
        return equal(one, other)

    def _counted(self, sign: str, one: Meant, other: Meant) -> Meant:
        if isinstance(one, Content | Anything) or isinstance(other, Content | Anything):
            return ANY
        found = counted(sign, one, other)
        return ANY if found is None else found

    def _ranges(
        self,
        items: tuple[Expression | Range, ...],
        at: Moment,
        hints: dict[int, Kind],
        expected: Kind | None,
    ) -> list[tuple[Meant, Meant]]:
        found = []
        for item in items:
            ends = (item.low, item.high) if isinstance(item, Range) else (item, item)
            low = self._value(ends[0], at, hints, expected)
            high = low if ends[0] is ends[1] else self._value(ends[1], at, hints, expected)
            found.append((low, high))
        return found

    def _member(
        self, value: Meant, ranges: list[tuple[Meant, Meant]], part: Expression, at: Moment
    ) -> Term:
        if isinstance(value, Content | Anything):
            return self._free(part, at)
        parts = []
        for low, high in ranges:
            if isinstance(low, Content | Anything) or isinstance(high, Content | Anything):
                parts.append(self._free(part, at))
            else:
                parts.append(within(value, low, high))
        return any_of(parts)

    def _either(
        self, asked: Term, one: Meant, other: Meant, expected: Kind | None, place: str
    ) -> Meant:
        if isinstance(one, Content) and isinstance(other, Content):
            name = f"({one.name} or {other.name})"
            return Content(either(asked, one.length, other.length), name)
        if isinstance(one, Content | Anything) or isinstance(other, Content | Anything):
            known = other if isinstance(one, Anything) else one
            if isinstance(known, Content | Anything):
                return ANY
            kind = expected or (Bool() if is_truth(known) else None)
            free = self.of_kind(place, "any", kind) if kind else self._whole_number(place)
            assert not isinstance(free, Content | Anything)
            return either(asked, free, known) if known is other else either(asked, known, free)
        return either(asked, one, other)

    def _whole_number(self, place: str) -> Term:
        return self.symbols.number(place, "any", None, (None, None))

    # --- functions --------------------------------------------------------------------------------

    def _call(self, part: Call, at: Moment, hints: dict[int, Kind]) -> Meant:
        name = part.function
        match name, part.arguments:
            case _, (Name(path=path) as argument,) if name in EDGES:
                now = self._truth(self._value(argument, at, hints, None), argument, at)
                short = path.rpartition(".")[2]
                past = at.parameters.get(before(short))
                if past is None:
                    past = self.of_kind(f"{before(short)} @{at.key}", before(short), Bool())
                    at.parameters[before(short)] = past
                up = EDGES[name]
                was = self._truth(past, part, at)
                return all_of((now, negated(was)) if up else (negated(now), was))
        if name == "in_work":
            if CROWDED not in at.parameters:
                crowded = self.of_kind(f"{CROWDED} @{at.key}", CROWDED, Bool())
                at.parameters[CROWDED] = crowded
            return at.parameters[CROWDED]
        values = tuple(self._value(argument, at, hints, None) for argument in part.arguments)
        if any(isinstance(value, Anything) for value in values):
            if FUNCTIONS[name].result != Bytes(None) or name == "piece":
                return ANY if name != "piece" else self._piece(values[3], self._place(part, at))
            return self.of_kind(self._place(part, at), name, Bytes(None))
        label = pretty_expression(part)
        plain = self._plain(name, values, self._place(part, at))
        if plain is not None:
            return plain
        return self.answers.ask(self, name, values, at.world, label)

    def _plain(self, name: str, values: tuple[Meant, ...], place: str) -> Meant | None:
        """Give a function of bytes and numbers; None for one of the dictionary."""
        match name, values:
            case "length", (Content(length=length),):
                return length
            case "join", (Content() as one, Content() as other):
                total = self._counted("+", one.length, other.length)
                assert not isinstance(total, Content | Anything)
                return Content(total, f"join({one.name}, {other.name})")
            case "zeros", (count,) if not isinstance(count, Content | Anything):
                return Content(self._at_least(count), f"zeros({place})")
            case "cut", (Content() as data, count) if not isinstance(count, Content | Anything):
                cut = self.of_kind(place, "cut", Bytes(None))
                assert isinstance(cut, Content)
                exact = equal(cut.length, lesser(count, data.length))
                self.symbols.fact(cut.length, any_of((compared("<", count, 0), exact)))
                self.symbols.fact(cut.length, compared("<=", cut.length, data.length))
                return cut
            case "piece", (_, _, _, most):
                return self._piece(most, place)
            case "numbered", (data, _, _, _):
                return data
            case "word", _:
                return Content(2, place)
            case "lesser", (one, other):
                if isinstance(one, Content | Anything) or isinstance(other, Content | Anything):
                    return None
                return lesser(one, other)
            case "microseconds", (value,):
                return value
            case "bit", (int(number), int(bit)):
                return bool(number >> bit & 1)
            case "bit", (value, int(bit)) if not isinstance(value, Content | Anything):
                halves = counted("/", value, 1 << bit)
                assert halves is not None
                last = counted("%", halves, 2)
                return None if last is None else equal(last, 1)
            case _:
                return None

    def _at_least(self, count: Term) -> Term:
        return max(0, count) if isinstance(count, int) else either(count >= 0, count, 0)

    def _piece(self, most: Meant, place: str) -> Content:
        """Give a piece of bytes, up to a length."""
        piece = self.of_kind(place, "piece", Bytes(None))
        assert isinstance(piece, Content)
        if not isinstance(most, Content | Anything):
            self.symbols.fact(piece.length, compared("<=", piece.length, self._at_least(most)))
        return piece


def _kinds(protocol: Protocol) -> dict[str, Type]:
    """Give the type of every slot: states, variables, fields of registers and words."""
    kinds: dict[str, Type] = {}
    for machine in protocol.machines.values():
        kinds[f"{machine.name}.state"] = Named(machine.table)
        for variable in machine.variables:
            kinds[f"{machine.name}.{variable.name}"] = variable.type
    for register in protocol.registers.values():
        kinds |= {f"register {register.name}.{bits.name}": bits.type for bits in register.fields}
    for word in protocol.words.values():
        kinds |= {f"word {word.name}.{bits.name}": bits.type for bits in word.fields}
    return kinds


def is_written(protocol: Protocol, register: str) -> bool:
    """Tell whether the MainDevice can write a register, so that the model keeps its value."""
    return protocol.registers[register].main is Access.BOTH
