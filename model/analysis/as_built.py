"""Specialises a specification to one device as it is built, without free choices.

Choices go as the virtual SubDevice goes, conditions are as assumed. What is decided by that is
taken out: rules that cannot fire, checks that always or never hold, alternatives not taken.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast, get_args

from ecatspec.model.core.compilation import Model
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.values import UNKNOWN
from ecatspec.spec.language.ir import (
    Binary,
    Bool,
    Call,
    Conditional,
    Expression,
    Literal,
    Name,
    Pin,
    Range,
    Unary,
)
from ecatspec.spec.language.kinds import kind_of
from ecatspec.spec.language.logic import LOGIC, joined
from ecatspec.spec.language.nodes import nodes_in, parts_of
from ecatspec.spec.language.references import UnresolvedName
from ecatspec.spec.language.scope import Scope

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.spec.language.ir import Protocol, Rule

_N = TypeVar("_N", bound=Expression | Range)
_EXPRESSIONS: Final = get_args(Expression)
_STATIC: Final = frozenset({"declared", "object_exists", "dictionary_closed", "is_plain_variable"})
"""The functions whose answer never changes where their arguments do not."""


def as_built(protocol: Protocol, choices: Mapping[str, str] | None = None) -> Protocol:
    """Give the texts of the device that goes one way wherever they leave it open.

    `choices` go as given, others as the virtual SubDevice goes. The two behave alike: what is
    stored once a frame was sent tells what the device holds, and the device has that already.
    """
    ways = {name: choice.alternatives[0].name for name, choice in protocol.choices.items()}
    ways |= choices or {}
    pins = {name: Pin(name, way, ()) for name, way in ways.items()} | protocol.pins
    pinned = replace(protocol, pins=pins, opened={})
    fold = _Fold(pinned)
    scopes = _scopes(pinned)
    told = _told(pinned)
    return replace(
        pinned,
        machines={
            name: replace(
                machine,
                rules=tuple(
                    replace(r, stores=()) if f"{name}.{r.input}" in told else r
                    for rule in machine.rules
                    if (r := fold.rule(name, rule)) is not None
                ),
            )
            for name, machine in pinned.machines.items()
        },
        definitions={
            name: replace(
                definition,
                value=fold.expression(definition.value, scopes.get(name, Scope())),
            )
            for name, definition in pinned.definitions.items()
        },
    )


def _scopes(protocol: Protocol) -> dict[str, Scope]:
    """Give for each definition that rules use a place where: its names mean something there."""
    found: dict[str, Scope] = {}
    for machine in protocol.machines.values():
        for rule in machine.rules:
            work: list[object] = [rule]
            while work:
                for node in nodes_in(work.pop()):
                    if not isinstance(node, Name) or node.path in found:
                        continue
                    definition = protocol.definitions.get(node.path)
                    if definition is not None:
                        found[definition.name] = Scope(machine.name, rule.input)
                        work.append(definition.value)
    return found


def _told(protocol: Protocol) -> set[str]:
    """Give the events that come only once a frame was sent."""
    rules = [rule for machine in protocol.machines.values() for rule in machine.rules]
    behind = {give.target for rule in rules if rule.after for give in rule.after.gives}
    at_once = {give.target for rule in rules for give in rule.gives}
    return behind - at_once - {later.target for rule in rules for later in rule.laters}


class _Fold:
    """Finds out what is decided already, and takes it out of expressions."""

    def __init__(self, protocol: Protocol) -> None:
        self.protocol = protocol
        self.model = Model(protocol, assuming=True, closed=True)
        decided = {slot for name, slot in self.model.slots.items() if name.startswith("choice ")}
        self.slots = tuple(
            value if slot in decided else UNKNOWN
            for slot, value in enumerate(self.model.initial.slots)
        )

    def rule(self, machine: str, rule: Rule) -> Rule | None:
        """Give a rule without what is decided; None: it can never fire."""
        scope = Scope(machine, rule.input)
        if rule.guard is None:
            return rule
        guard = self.expression(rule.guard, scope)
        if guard == Literal(value=False):
            return None
        return replace(rule, guard=None if guard == Literal(value=True) else guard)

    def expression(self, value: Expression, scope: Scope) -> Expression:
        """Give an expression without the parts that are decided."""
        if isinstance(value, Literal):
            return value
        truth = self._truth(value, scope)
        if truth is not None:
            return Literal(truth)
        match value:
            case Unary(operator="not", operand=operand):
                return replace(value, operand=self.expression(operand, scope))
            case Binary(operator=operator, left=left, right=right) if operator in LOGIC:
                one, other = self.expression(left, scope), self.expression(right, scope)
                neutral = Literal(not LOGIC[operator])
                if one == neutral:
                    return other
                return one if other == neutral else replace(value, left=one, right=other)
            case Conditional(condition, then, otherwise):
                decided = self._truth(condition, scope)
                if decided is not None:
                    return self.expression(then if decided else otherwise, scope)
                return replace(
                    value,
                    condition=self.expression(condition, scope),
                    then=self.expression(then, scope),
                    otherwise=self.expression(otherwise, scope),
                )
            case _:
                return self._inside(value, scope)

    def _inside(self, value: _N, scope: Scope) -> _N:
        """Give a comparison, a set or a call with the alternatives that are taken in it."""
        changes: dict[str, object] = {}
        for field in fields(value):
            part = getattr(value, field.name)
            if isinstance(part, tuple):
                changes[field.name] = tuple(self._part(item, scope) for item in part)
            elif isinstance(part, _EXPRESSIONS):
                changes[field.name] = self._part(part, scope)
        return cast("_N", replace(cast("Any", value), **changes)) if changes else value

    def _part(self, value: Expression | Range, scope: Scope) -> Expression | Range:
        return (
            self.expression(value, scope)
            if isinstance(value, Conditional)
            else self._inside(value, scope)
        )

    def _truth(self, value: Expression, scope: Scope) -> bool | None:
        """Give the truth that an expression has whatever the device's state and its input.

        A definition may have names that mean something only where it is used, and what a function
        finds may change: nothing is decided there.
        """
        match value:
            case Name(path) if path in self.protocol.definitions:
                return self._truth(self.protocol.definitions[path].value, scope)
            case Unary(operator="not", operand=operand):
                truth = self._truth(operand, scope)
                return None if truth is None else not truth
            case Binary(operator=operator, left=left, right=right) if operator in LOGIC:
                parts = (self._truth(part, scope) for part in (left, right))
                joint = joined(parts, decisive=LOGIC[operator])
                return joint if isinstance(joint, bool) else None
            case Conditional(condition, then, otherwise):
                decided = self._truth(condition, scope)
                truths = {self._truth(part, scope) for part in (then, otherwise)}
                if decided is not None:
                    return self._truth(then if decided else otherwise, scope)
                return truths.pop() if len(truths) == 1 else None
            case _ if self._certain(value) and kind_of(self.protocol, value, scope) == Bool():
                return self._evaluated(value, scope)
            case _:
                return None

    def _certain(self, value: Expression | Range) -> bool:
        """Tell whether no function is in an expression but those that never change."""
        match value:
            case Name(path) if path in self.protocol.definitions:
                return self._certain(self.protocol.definitions[path].value)
            case Call(function, arguments):
                return function in _STATIC and all(isinstance(a, Literal) for a in arguments)
            case _:
                return all(map(self._certain, parts_of(value)))

    def _evaluated(self, value: Expression, scope: Scope) -> bool | None:
        try:
            known = self.model.expression(value, scope, None)
        except UnresolvedName:
            return None
        found = known(Environment(self.slots, {}, {}))
        return found if isinstance(found, bool) else None
