"""Resolves names: in a rule, in a register, in a frame, in a parameter.

A bare name is looked up in this order; the first that knows it wins:

1. what the other side of a comparison, an assignment or an acceptable set expects: an alternative
   of that choice (only then), and later a row of that table where several tables have it;
2. a parameter of the rule's input: the fields of the register that was written, of the word that
   was taken (and `cyclic`), of the frame that was delivered and of the frames around it, the
   `image` that was written, or the parameters of the event;
3. a variable of the rule's own machine; `state` is its own state;
4. a parameter (of an area `parameter.start` and `parameter.length`);
5. a choice, a condition, a definition;
6. a row of a code table.

Dotted names are `reply.field` of the frame that the rule sends, `input.parameter` of the rule's own
input, `machine.variable`, `machine.state`, `register.field`, `word.field`, `parameter.start`,
`parameter.length`, `table.row`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Final, TypeAlias, assert_never, cast

from ecatspec.spec.language.ir import (
    AnyValue,
    Area,
    Binary,
    Bool,
    Bytes,
    Call,
    Conditional,
    In,
    Literal,
    Name,
    Named,
    OneOf,
    Range,
    SInt,
    Text,
    Time,
    Type,
    UInt,
    Unary,
)
from ecatspec.spec.language.logic import COMPARED, LOGIC

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterator

    from ecatspec.spec.language.ir import Expression, Input, Protocol

# --- what a name can stand for -------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ParameterOfInput:
    """A parameter of the rule's input; inside a frame, another field of the same frame."""

    name: str


@dataclass(frozen=True, slots=True)
class ReplyField:
    """A field of the frame that the rule sends, as it is sent."""

    name: str


@dataclass(frozen=True, slots=True)
class VariableRef:
    """A variable of a machine."""

    machine: str
    name: str


@dataclass(frozen=True, slots=True)
class StateRef:
    """The state that a machine is in."""

    machine: str


@dataclass(frozen=True, slots=True)
class RegisterFieldRef:
    """What a field of a register holds now."""

    register: str
    field: str


@dataclass(frozen=True, slots=True)
class WordFieldRef:
    """What a field of a word holds now."""

    word: str
    field: str


@dataclass(frozen=True, slots=True)
class ParameterRef:
    """A parameter; `part` is `start` or `length` of an area, else None."""

    name: str
    part: str | None = None


@dataclass(frozen=True, slots=True)
class ChoiceRef:
    """Which way the device goes at a choice; also the kind of such a value."""

    name: str


@dataclass(frozen=True, slots=True)
class AlternativeRef:
    """One way to go at a choice."""

    choice: str
    name: str


@dataclass(frozen=True, slots=True)
class ConditionRef:
    """A truth that only the device knows."""

    name: str


@dataclass(frozen=True, slots=True)
class DefinitionRef:
    """A named expression; it means in this scope what it would mean written out here."""

    name: str


@dataclass(frozen=True, slots=True)
class ConstantRef:
    """The value of a row of a table."""

    value: int
    table: str


Ref: TypeAlias = (
    ParameterOfInput
    | ReplyField
    | VariableRef
    | StateRef
    | RegisterFieldRef
    | WordFieldRef
    | ParameterRef
    | ChoiceRef
    | AlternativeRef
    | ConditionRef
    | DefinitionRef
    | ConstantRef
)

Kind: TypeAlias = Type | ChoiceRef
"""What sort of value: a type of the texts, or the way at a choice."""


class UnresolvedName(LookupError):  # noqa: N818
    """A name that means nothing here, or (with `candidates`) too much."""

    def __init__(self, path: str, candidates: tuple[str, ...] = ()) -> None:
        self.path = path
        self.candidates = candidates
        super().__init__(path)


@dataclass(frozen=True, slots=True)
class Scope:
    """Where a name stands: a rule has machine and input, a layout has its frame.

    `reply` is the frame that the rule sends, where its fields can be spoken of.
    """

    machine: str | None = None
    input: str | None = None
    frame: str | None = None
    reply: str | None = None


# --- built-in functions --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FunctionSignature:
    """Types of arguments and result of a built-in function, and what it tells."""

    arguments: tuple[Type, ...]
    result: Type
    wording: str


_INDEX: Final = UInt(16)
_SUBINDEX: Final = UInt(8)
_ENTRY: Final = (_INDEX, _SUBINDEX)
_DATA: Final = Bytes(None)
_COUNT: Final = UInt(32)

FUNCTIONS: Final[dict[str, FunctionSignature]] = {
    "declared": FunctionSignature(_ENTRY, Bool(), "a text declares the entry"),
    "object_exists": FunctionSignature((_INDEX,), Bool(), "the device has the object"),
    "readable": FunctionSignature(_ENTRY, Bool(), "the entry can be read in some AL state"),
    "writable": FunctionSignature(_ENTRY, Bool(), "the entry can be written in some AL state"),
    "readable_now": FunctionSignature(_ENTRY, Bool(), "the entry can be read in this AL state"),
    "writable_now": FunctionSignature(_ENTRY, Bool(), "the entry can be written in this AL state"),
    "size_of": FunctionSignature(_ENTRY, UInt(32), "bytes that the entry has at most"),
    "size_varies": FunctionSignature(_ENTRY, Bool(), "the entry may hold fewer bytes than that"),
    "size_unsaid": FunctionSignature(
        _ENTRY, Bool(), "no text says whether the size of the string varies"
    ),
    "present_size": FunctionSignature(_ENTRY, UInt(32), "bytes that an upload may announce now"),
    "size_allowed": FunctionSignature(
        (*_ENTRY, _COUNT), Bool(), "a number of bytes can be written"
    ),
    "value_of": FunctionSignature(_ENTRY, _DATA, "the present value as bytes on the wire"),
    "range_known": FunctionSignature(_ENTRY, Bool(), "a text states the range of the entry"),
    "in_range": FunctionSignature((*_ENTRY, _DATA), Bool(), "the range of the entry allows it"),
    "too_high": FunctionSignature((*_ENTRY, _DATA), Bool(), "above the range of the entry"),
    "too_low": FunctionSignature((*_ENTRY, _DATA), Bool(), "below the range of the entry"),
    "is_plain_variable": FunctionSignature((_INDEX,), Bool(), "the object has subindex 0 only"),
    "complete_size": FunctionSignature(_ENTRY, UInt(32), "bytes from this subindex on, padded"),
    "counted_size": FunctionSignature(
        _ENTRY, UInt(32), "bytes from this subindex to that which subindex 0 counts, padded"
    ),
    "complete_value": FunctionSignature(_ENTRY, _DATA, "the object from this subindex on"),
    "complete_in_range": FunctionSignature((*_ENTRY, _DATA), Bool(), "all ranges allow the bytes"),
    "complete_readable": FunctionSignature(_ENTRY, Bool(), "every entry from there can be read"),
    "complete_writable": FunctionSignature(_ENTRY, Bool(), "every entry from there can be written"),
    "object_list": FunctionSignature((UInt(16),), _DATA, "the list of this type as it travels"),
    "object_code_of": FunctionSignature((_INDEX,), UInt(8), "variable, array or record"),
    "highest_subindex": FunctionSignature((_INDEX,), UInt(8), "the highest subindex to be told"),
    "mappable": FunctionSignature(_ENTRY, Bool(), "the entry can travel as process data"),
    "data_type_of": FunctionSignature(_ENTRY, UInt(16), "the number of the entry's type"),
    "bit_length_of": FunctionSignature(_ENTRY, UInt(16), "bits that the entry has"),
    "readable_in": FunctionSignature((*_ENTRY, UInt(4)), Bool(), "can be read in this AL state"),
    "writable_in": FunctionSignature((*_ENTRY, UInt(4)), Bool(), "can be written in this AL state"),
    "in_work": FunctionSignature((), Bool(), "an earlier request was unanswered when this came"),
    "length": FunctionSignature((_DATA,), UInt(32), "how many bytes there are"),
    "join": FunctionSignature((_DATA, _DATA), _DATA, "the second after the first"),
    "cut": FunctionSignature((_DATA, _COUNT), _DATA, "the first bytes, up to a length"),
    "zeros": FunctionSignature((_COUNT,), _DATA, "a number of zero bytes"),
    "word": FunctionSignature((UInt(16),), _DATA, "the number in two bytes"),
    "piece": FunctionSignature(
        (_DATA, _COUNT, _COUNT, _COUNT),
        _DATA,
        "from an offset on, of a least and a greatest length",
    ),
    "numbered": FunctionSignature(
        (_DATA, _COUNT, _COUNT, _COUNT),
        _DATA,
        "bytes that are a number from, to, or that other one",
    ),
    "lesser": FunctionSignature((_COUNT, _COUNT), _COUNT, "the smaller number"),
    "dictionary_closed": FunctionSignature((), Bool(), "only declared objects exist"),
    "number": FunctionSignature((_DATA,), UInt(32), "the bytes as a number, the lowest first"),
    "number_of": FunctionSignature(_ENTRY, SInt(64), "the present value as a number"),
    "is_assignment": FunctionSignature(
        (_INDEX,), Bool(), "the object assigns PDOs to a SyncManager"
    ),
    "is_mapping": FunctionSignature((_INDEX,), Bool(), "the object maps entries into a PDO"),
    "can_hold": FunctionSignature(
        (*_ENTRY, _DATA), Bool(), "the PDO can be assigned there, or the object mapped"
    ),
    "mapped": FunctionSignature(
        (_INDEX, *_ENTRY), Bool(), "a PDO of the assignment holds the entry"
    ),
    "assigned_pdos": FunctionSignature((_INDEX,), _DATA, "the assigned PDOs, two bytes each"),
    "image_size": FunctionSignature(
        (_INDEX,), UInt(32), "bytes of the process data that an assignment object assigns"
    ),
    "pdo_bits": FunctionSignature(
        _ENTRY, UInt(32), "bits of the first entries of a PDO, up to a count"
    ),
    "repeated": FunctionSignature(
        (_INDEX,), Bool(), "the PDOs of the assignment map an entry more than once"
    ),
    "has_value": FunctionSignature((*_ENTRY, _DATA), Bool(), "the entry has this value already"),
    "holds": FunctionSignature(_ENTRY, Bool(), "a number of entries of the object is possible"),
    "bit": FunctionSignature((_COUNT, UInt(8)), Bool(), "this bit of the number is set"),
    "microseconds": FunctionSignature((_COUNT,), Time(), "a number of microseconds"),
    "rises": FunctionSignature((Bool(),), Bool(), "it is true now and was false before"),
    "falls": FunctionSignature((Bool(),), Bool(), "it is false now and was true before"),
}

EDGES: Final = {"rises": True, "falls": False}
"""What a parameter of the input is after the edge; its argument is such a parameter, by name."""

WITH_BEFORE: Final = frozenset({"write", "word"})
"""The kinds of inputs whose parameters had a value before."""

IMPLIES: Final = (
    ("readable_now", "readable"),
    ("writable_now", "writable"),
    ("declared", "object_exists"),
)
"""For the same entry: where the first holds, the second holds (of its first arguments)."""

EXCLUSIVE: Final = (frozenset({"in_range", "too_high", "too_low"}), frozenset(EDGES))
"""With the same arguments: at most one of these holds."""

# --- names ---------------------------------------------------------------------------------------

STATE: Final = "state"
CYCLIC: Final = "cyclic"
IMAGE: Final = "image"
REPLY: Final = "reply"
AREA_PARTS: Final = {"start": UInt(16), "length": UInt(16)}


def resolve(protocol: Protocol, path: str, scope: Scope, expected: Kind | None = None) -> Ref:
    """What the name stands for in this scope; `expected` is the kind that the other side has."""
    if "." in path:
        found = _dotted(protocol, path, scope)
    else:
        found = _bare(protocol, path, scope, expected)
    if found is None:
        raise UnresolvedName(path)
    return found


def _bare(protocol: Protocol, name: str, scope: Scope, expected: Kind | None) -> Ref | None:
    machine = protocol.machines.get(scope.machine or "")
    if isinstance(expected, ChoiceRef) and (choice := protocol.choices.get(expected.name)):
        for alternative in choice.alternatives:
            if alternative.name == name:
                return AlternativeRef(choice.name, name)
    if _is_parameter(protocol, scope, name):
        return ParameterOfInput(name)
    if machine is not None:
        if any(variable.name == name for variable in machine.variables):
            return VariableRef(machine.name, name)
        if name == STATE:
            return StateRef(machine.name)
    if name in protocol.parameters:
        return ParameterRef(name)
    if name in protocol.choices:
        return ChoiceRef(name)
    if name in protocol.conditions:
        return ConditionRef(name)
    if name in protocol.definitions:
        return DefinitionRef(name)
    return _row(protocol, name, expected)


def _row(protocol: Protocol, name: str, expected: Kind | None) -> ConstantRef | None:
    found = [
        ConstantRef(row.value, table.name)
        for table in protocol.tables.values()
        for row in table.rows
        if row.name == name
    ]
    if isinstance(expected, Named):
        for constant in found:
            if constant.table == expected.table:
                return constant
    if len(found) > 1:
        raise UnresolvedName(name, tuple(f"{constant.table}.{name}" for constant in found))
    return found[0] if found else None


def _dotted(protocol: Protocol, path: str, scope: Scope) -> Ref | None:
    owner, _, name = path.partition(".")
    if owner == REPLY and scope.reply is not None and name in frame_fields(protocol, scope.reply):
        return ReplyField(name)
    if owner == scope.input and _is_parameter(protocol, scope, name):
        return ParameterOfInput(name)
    if machine := protocol.machines.get(owner):
        if any(variable.name == name for variable in machine.variables):
            return VariableRef(owner, name)
        if name == STATE:
            return StateRef(owner)
    register = protocol.registers.get(owner)
    if register and any(field.name == name for field in register.fields):
        return RegisterFieldRef(owner, name)
    word = protocol.words.get(owner)
    if word and any(field.name == name for field in word.fields):
        return WordFieldRef(owner, name)
    parameter = protocol.parameters.get(owner)
    if parameter and parameter.type == Area() and name in AREA_PARTS:
        return ParameterRef(owner, name)
    if table := protocol.tables.get(owner):
        for row in table.rows:
            if row.name == name:
                return ConstantRef(row.value, owner)
    return None


def known_names(protocol: Protocol, scope: Scope, expected: Kind | None = None) -> Iterator[str]:
    """All names that mean something in this scope, for telling what else could be meant."""
    if isinstance(expected, ChoiceRef) and expected.name in protocol.choices:
        yield from (way.name for way in protocol.choices[expected.name].alternatives)
    yield from _parameters(protocol, scope)
    if scope.reply is not None:
        yield from (f"{REPLY}.{name}" for name in frame_fields(protocol, scope.reply))
    own = protocol.machines.get(scope.machine or "")
    if own is not None:
        yield STATE
        yield from (variable.name for variable in own.variables)
    for machine in protocol.machines.values():
        yield f"{machine.name}.{STATE}"
        yield from (f"{machine.name}.{variable.name}" for variable in machine.variables)
    for register in protocol.registers.values():
        yield from (f"{register.name}.{field.name}" for field in register.fields)
    for word in protocol.words.values():
        yield from (f"{word.name}.{field.name}" for field in word.fields)
    for parameter in protocol.parameters.values():
        yield parameter.name
        if parameter.type == Area():
            yield from (f"{parameter.name}.{part}" for part in AREA_PARTS)
    yield from protocol.choices
    yield from protocol.conditions
    yield from protocol.definitions
    yield from (row.name for table in protocol.tables.values() for row in table.rows)


def input_of(protocol: Protocol, scope: Scope) -> Input | None:
    """The input that a rule reacts to."""
    machine = protocol.machines.get(scope.machine or "")
    return None if machine is None else machine.input_by_name.get(scope.input or "")


def frame_fields(protocol: Protocol, name: str) -> dict[str, Type]:
    """The fields of a frame and of the frames around it; the inner ones win, outermost first."""
    chain = list(frame_chain(protocol, name))
    return {
        field.name: field.type
        for frame in reversed(chain)
        for field in protocol.frames[frame].fields
    }


def frame_chain(protocol: Protocol, name: str) -> Iterator[str]:
    """A frame and the frames around it, from the inside to the outside."""
    seen: set[str] = set()
    place: str | None = name
    while place is not None and place in protocol.frames and place not in seen:
        seen.add(place)
        yield place
        place = protocol.frames[place].parent


def _parameters(protocol: Protocol, scope: Scope) -> dict[str, Type]:
    if scope.frame is not None:
        return frame_fields(protocol, scope.frame)
    found = input_of(protocol, scope)
    if found is None:
        return {}
    if found.kind in {"event", "local", "own"}:
        return dict(found.parameters)
    if found.kind == "outputs":
        return {IMAGE: Bytes(None)}
    origins = [_origin(protocol, found.kind, origin) for origin in found.origin]
    common = origins[0] if origins else {}
    for other in origins[1:]:
        common = {name: kind for name, kind in common.items() if name in other}
    return common


def _is_parameter(protocol: Protocol, scope: Scope, name: str) -> bool:
    """Tell whether `_parameters` has a name; most names are in no origin, so the first tells it."""
    found = None if scope.frame is not None else input_of(protocol, scope)
    if found is None or found.kind in {"event", "local", "own", "outputs"} or not found.origin:
        return name in _parameters(protocol, scope)
    return all(name in _origin(protocol, found.kind, origin) for origin in found.origin)


def _origin(protocol: Protocol, kind: str, origin: str) -> dict[str, Type]:
    if kind == "frame":
        return frame_fields(protocol, origin)
    if kind == "word":
        word = protocol.words.get(origin)
        fields = () if word is None else word.fields
        return {field.name: field.type for field in fields} | {CYCLIC: Bool()}
    register = protocol.registers.get(origin)
    return {} if register is None else {field.name: field.type for field in register.fields}


# --- what an expression is made of ---------------------------------------------------------------


def nodes_in(node: object) -> Iterator[object]:
    """All parts of a declaration, itself included, wherever they stand in it."""
    rest = [node]
    while rest:
        part = rest.pop()
        if isinstance(part, tuple):
            rest += reversed(part)
            continue
        names = _names_of_fields(cast("Hashable", type(part)))  # mypy 2 doubts it
        if names is not None:
            yield part
            rest += (getattr(part, name) for name in names)


@cache
def _names_of_fields(kind: Hashable) -> tuple[str, ...] | None:
    """The fields of a dataclass, the last first; None: it is none."""
    return tuple(f.name for f in reversed(fields(kind))) if is_dataclass(kind) else None


def names_in(expression: Expression | Range) -> Iterator[str]:
    """All names that an expression mentions, of functions not."""
    match expression:
        case Name(path):
            yield path
        case _:
            for part in parts_of(expression):
                yield from names_in(part)


def parts_of(expression: Expression | Range) -> tuple[Expression | Range, ...]:
    """What an expression is made of."""
    match expression:
        case Literal() | Name():
            return ()
        case AnyValue(preferred):
            return () if preferred is None else (preferred,)
        case Unary():
            return (expression.operand,)
        case Binary():
            return expression.left, expression.right
        case Range():
            return expression.low, expression.high
        case In():
            return (expression.operand, *expression.items)
        case Conditional():
            return expression.condition, expression.then, expression.otherwise
        case Call():
            return expression.arguments
        case OneOf():
            excluded = () if expression.excluded is None else (expression.excluded,)
            return (*expression.items, *excluded)
        case _:
            assert_never(expression)


# --- kinds ---------------------------------------------------------------------------------------


_NUMBER: Final = UInt(64)


def kind_of_ref(protocol: Protocol, ref: Ref, scope: Scope) -> Kind | None:
    """The kind of value that a name stands for; a definition of `any` has none."""
    kind: Kind | None
    match ref:
        case ParameterOfInput(name):
            kind = _parameters(protocol, scope)[name]
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
