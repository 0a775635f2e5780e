"""Guesses what holds in a state of a machine since a rule led there.

A rule that keeps what came in its variables asked something of it before. That may hold as long as
the machine stays in a state behind it: a proof takes out the guesses that fail.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import reduce
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

from ecatspec.spec.language.ir import Binary, Expression, Literal, Name, Property, Range, Unary
from ecatspec.spec.language.references import (
    DefinitionRef,
    ParameterOfInput,
    Ref,
    StateRef,
    UnresolvedName,
    VariableRef,
)
from ecatspec.spec.language.scope import Scope, resolve

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.spec.language.ir import Machine, Protocol, Rule

_N = TypeVar("_N", bound=Expression | Range)
_AND: Final = "and"


def with_guesses(protocol: Protocol) -> Protocol:
    """Give the texts with what may hold in the states of their machines as further properties."""
    guesses = {
        guess.value: guess
        for machine in protocol.machines.values()
        for rule in machine.rules
        for guess in _guesses(protocol, machine, rule)
    }
    named = {guess.name: guess for guess in guesses.values()}
    return replace(protocol, properties=named | protocol.properties)


def _guesses(protocol: Protocol, machine: Machine, rule: Rule) -> Iterator[Property]:
    scope = Scope(machine.name, rule.input)
    own = {_slot(machine, update.variable): update.value for update in rule.updates}
    kept = {
        value.path: slot
        for slot, value in own.items()
        if isinstance(value, Name) and isinstance(_ref(protocol, value, scope), ParameterOfInput)
    }
    if rule.guard is None or not kept:
        return
    told = _told_apart(machine)
    marks = [
        Binary("==", Name(slot), value)
        for slot, value in own.items()
        if slot in told and isinstance(value, Literal)
    ]
    words = _Words(protocol, scope, kept, frozenset(own))
    for number, part in enumerate(_row(words.inlined(rule.guard))):
        try:
            said = words.said(part)
        except _Unsayable:
            continue
        for state in machine.states:
            if state != machine.initial:
                here = Binary("==", Name(f"{machine.name}.state"), Name(state))
                there = reduce(lambda one, other: Binary(_AND, one, other), marks, here)
                name = f"{machine.name}.{rule.name} {number} in {state}"
                value = Binary("or", Unary("not", there), said)
                yield Property(name, name, value, rule.clauses, rule.at)


def _told_apart(machine: Machine) -> set[str]:
    """Give the variables by which rules tell what they kept: not all set the same value."""
    values: dict[str, set[object]] = {}
    for rule in machine.rules:
        for update in rule.updates:
            if isinstance(update.value, Literal):
                values.setdefault(_slot(machine, update.variable), set()).add(update.value.value)
    return {slot for slot, found in values.items() if len(found) > 1}


def _slot(machine: Machine, variable: str) -> str:
    return variable if "." in variable else f"{machine.name}.{variable}"


def _row(value: Expression) -> Iterator[Expression]:
    """Yield the parts of `a and b and c`."""
    match value:
        case Binary(operator="and", left=left, right=right):
            yield from _row(left)
            yield from _row(right)
        case _:
            yield value


def _ref(protocol: Protocol, name: Name, scope: Scope) -> Ref | None:
    try:
        return resolve(protocol, name.path, scope)
    except UnresolvedName:  # a name of a table, or of an alternative: the same everywhere
        return None


class _Unsayable(Exception):  # noqa: N818
    """It speaks of something that is not kept."""


class _Words:
    """Puts what a rule asked of its input into words of what it kept of that."""

    def __init__(
        self, protocol: Protocol, scope: Scope, kept: Mapping[str, str], changed: frozenset[str]
    ) -> None:
        self._protocol = protocol
        self._scope = scope
        self._kept = kept
        self._changed = changed

    def inlined(self, node: _N) -> _N:
        """Give an expression without definitions."""
        if isinstance(node, Name):
            match _ref(self._protocol, node, self._scope):
                case DefinitionRef(name):
                    return cast("_N", self.inlined(self._protocol.definitions[name].value))
                case _:
                    return node
        return self._changed_in(node, self.inlined)

    def said(self, node: _N) -> _N:
        """Give an expression of what was kept.

        Raises:
            _Unsayable: It speaks of something else that came, or that the rule changes.

        """
        if not isinstance(node, Name):
            return self._changed_in(node, self.said)
        match _ref(self._protocol, node, self._scope):
            case ParameterOfInput(name) if name in self._kept:
                return cast("_N", Name(self._kept[name]))
            case VariableRef(machine, name) if f"{machine}.{name}" not in self._changed:
                return cast("_N", Name(f"{machine}.{name}"))
            case ParameterOfInput() | VariableRef() | StateRef():
                raise _Unsayable
            case _:
                return node

    def _changed_in(self, node: _N, change: Any) -> _N:  # noqa: ANN401
        changes: dict[str, object] = {}
        for field in fields(node):
            part = getattr(node, field.name)
            if isinstance(part, tuple):
                changes[field.name] = tuple(
                    change(item) if isinstance(item, Expression | Range) else item for item in part
                )
            elif isinstance(part, Expression | Range):
                changes[field.name] = change(part)
        return cast("_N", replace(cast("Any", node), **changes)) if changes else node
