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

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ecatspec.spec.language.ir import (
    Area,
    Bool,
    Bytes,
    InputKind,
    Named,
    Type,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.spec.language.ir import Input, Protocol

from ecatspec.spec.language.functions import AREA_PARTS, CYCLIC, IMAGE, REPLY, STATE
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
    UnresolvedName,
    VariableRef,
    WordFieldRef,
)


@dataclass(frozen=True, slots=True)
class Scope:
    """Where a name stands: a rule has machine and input, a layout has its frame.

    `reply` is the frame that the rule sends, where its fields can be spoken of.
    """

    machine: str | None = None
    input: str | None = None
    frame: str | None = None
    reply: str | None = None


_WITHOUT_ORIGIN: Final = frozenset(
    {InputKind.EVENT, InputKind.LOCAL, InputKind.OWN, InputKind.OUTPUTS}
)


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
    yield from parameters_in(protocol, scope)
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


def parameters_in(protocol: Protocol, scope: Scope) -> dict[str, Type]:
    """Give the names of parameters in a scope, each with its type."""
    if scope.frame is not None:
        return frame_fields(protocol, scope.frame)
    found = input_of(protocol, scope)
    if found is None:
        return {}
    if found.kind in {InputKind.EVENT, InputKind.LOCAL, InputKind.OWN}:
        return dict(found.parameters)
    if found.kind == InputKind.OUTPUTS:
        return {IMAGE: Bytes(None)}
    origins = [_origin(protocol, found.kind, origin) for origin in found.origin]
    common = origins[0] if origins else {}
    for other in origins[1:]:
        common = {name: kind for name, kind in common.items() if name in other}
    return common


def _is_parameter(protocol: Protocol, scope: Scope, name: str) -> bool:
    """Whether `parameters_in` has a name; most names are in no origin, so the first tells it."""
    found = None if scope.frame is not None else input_of(protocol, scope)
    if found is None or found.kind in _WITHOUT_ORIGIN or not found.origin:
        return name in parameters_in(protocol, scope)
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
