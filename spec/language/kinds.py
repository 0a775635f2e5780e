"""The kinds of values: of a reference, of an expression, as it is demanded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.spec.language.ir import (
    AnyValue,
    Area,
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
    SInt,
    Text,
    Time,
    UInt,
    Unary,
)
from ecatspec.spec.language.logic import COMPARED, LOGIC
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
    from ecatspec.spec.language.ir import Expression, Protocol

from ecatspec.spec.language.functions import AREA_PARTS, FUNCTIONS
from ecatspec.spec.language.references import (
    UnresolvedName,
)
from ecatspec.spec.language.scope import frame_fields, parameters_in

_NUMBER: Final = UInt(64)


def kind_of_ref(protocol: Protocol, ref: Ref, scope: Scope) -> Kind | None:
    """The kind of value that a name stands for; a definition of `any` has none."""
    kind: Kind | None
    match ref:
        case ParameterOfInput(name):
            kind = parameters_in(protocol, scope)[name]
        case ReplyField(name):
            kind = frame_fields(protocol, scope.reply or "")[name]
        case VariableRef(machine, name):
            variables = protocol.machines[machine].variables
            kind = next(variable.type for variable in variables if variable.name == name)
        case StateRef(machine):
            kind = Named(protocol.machines[machine].table)
        case RegisterFieldRef(register, field):
            fields = protocol.registers[register].fields
            kind = next(item.type for item in fields if item.name == field)
        case WordFieldRef(word, field):
            fields = protocol.words[word].fields
            kind = next(item.type for item in fields if item.name == field)
        case ParameterRef(name, part):
            kind = protocol.parameters[name].type if part is None else AREA_PARTS[part]
        case ChoiceRef():
            kind = ref
        case AlternativeRef(choice, _):
            kind = ChoiceRef(choice)
        case ConditionRef():
            kind = Bool()
        case DefinitionRef(name):
            value = protocol.definitions[name].value
            kind = expectation(protocol, value, scope) or kind_of(protocol, value, scope)
        case ConstantRef(_, table):
            kind = Named(table)
        case _:
            assert_never(ref)
    return kind


def expectation(protocol: Protocol, expression: Expression, scope: Scope) -> Kind | None:
    """The table or choice that a value belongs to, for resolving what it is compared with."""
    found: Kind | None = None
    match expression:
        case Name(path):
            try:
                found = kind_of_ref(protocol, resolve(protocol, path, scope), scope)
            except UnresolvedName:
                found = None
        case Conditional(_, then, otherwise):
            found = expectation(protocol, then, scope) or expectation(protocol, otherwise, scope)
        case OneOf(items, _):
            parts = [item.low if isinstance(item, Range) else item for item in items]
            kinds = (expectation(protocol, part, scope) for part in parts)
            found = next((kind for kind in kinds if kind is not None), None)
        case Literal() | Unary() | Binary() | In() | Call() | AnyValue():
            found = None
        case _:
            assert_never(expression)
    return found if isinstance(found, Named | ChoiceRef) else None


def kind_of(
    protocol: Protocol, expression: Expression, scope: Scope, expected: Kind | None = None
) -> Kind | None:
    """The kind of value that an expression gives, None where only its surroundings decide.

    Numbers are UInt or SInt; a name that means nothing has no kind.
    """
    found: Kind | None = None
    match expression:
        case Literal(value):
            found = Bool() if isinstance(value, bool) else _NUMBER
        case Name(path):
            try:
                found = kind_of_ref(protocol, resolve(protocol, path, scope, expected), scope)
            except UnresolvedName:
                found = None
        case Unary(operator, _):
            found = Bool() if operator == "not" else _NUMBER
        case Binary(operator, left, _):
            found = Bool() if operator in LOGIC or operator in COMPARED else _NUMBER
            if operator == "+" and kind_of(protocol, left, scope) == Time():
                found = Time()
        case In():
            found = Bool()
        case Conditional(_, then, otherwise):
            found = kind_of(protocol, then, scope, expected)
            found = found or kind_of(protocol, otherwise, scope, expected)
        case Call(function, _):
            found = FUNCTIONS[function].result if function in FUNCTIONS else None
        case OneOf(items, _):
            parts = [item.low if isinstance(item, Range) else item for item in items]
            kinds = (kind_of(protocol, part, scope, expected) for part in parts)
            found = next((kind for kind in kinds if kind is not None), None)
        case AnyValue():
            found = None
        case _:
            assert_never(expression)
    return found


def width_of(protocol: Protocol, kind: Kind) -> int | None:
    """How many bits a value takes, None where that is not fixed."""
    match kind:
        case UInt(width) | SInt(width):
            return width
        case Bool():
            return 1
        case Named(table):
            return protocol.tables[table].width if table in protocol.tables else None
        case Bytes() | Text() | Area() | Time() | ChoiceRef():
            return None
        case _:
            assert_never(kind)


def bounds_of(protocol: Protocol, kind: Kind) -> tuple[int, int] | None:
    """The least and the greatest number of a kind, None for what is no number of fixed width."""
    match kind:
        case SInt(width):
            return -(1 << (width - 1)), (1 << (width - 1)) - 1
        case UInt() | Named():
            width_in_bits = width_of(protocol, kind)
            return None if width_in_bits is None else (0, (1 << width_in_bits) - 1)
        case Bool():
            return 0, 1
        case Bytes() | Text() | Area() | Time() | ChoiceRef():
            return None
        case _:
            assert_never(kind)


def name_hints(protocol: Protocol, expression: Expression, scope: Scope) -> dict[int, Kind]:
    """Give for names in `expression` the kind that the other side of a comparison has."""
    hints: dict[int, Kind] = {}

    def walk(part: Expression | Range, kind: Kind | None) -> None:
        match part:
            case Name():
                if kind is not None:
                    hints[id(part)] = kind
            case Binary(operator="==" | "!=" | "<" | "<=" | ">" | ">=", left=left, right=right):
                walk(left, expectation(protocol, right, scope))
                walk(right, expectation(protocol, left, scope))
            case Binary(left=left, right=right):
                walk(left, kind)
                walk(right, kind)
            case Unary(operand=operand):
                walk(operand, kind)
            case Range(low=low, high=high):
                walk(low, kind)
                walk(high, kind)
            case In(operand=operand, items=items):
                walk(operand, None)
                for item in items:
                    walk(item, expectation(protocol, operand, scope))
            case OneOf(items=items, excluded=excluded):
                for item in items:
                    walk(item, kind)
                if excluded is not None:
                    walk(excluded, kind)
            case Conditional(condition=condition, then=then, otherwise=otherwise):
                walk(condition, None)
                walk(then, kind)
                walk(otherwise, kind)
            case Call(arguments=arguments):
                for argument in arguments:
                    walk(argument, None)
            case AnyValue(preferred=preferred):
                if preferred is not None:
                    walk(preferred, kind)
            case Literal():
                pass
            case _:
                assert_never(part)

    walk(expression, None)
    return hints
