"""Compiles rules, with what follows from them, and views of registers and words."""

from __future__ import annotations

import typing
from dataclasses import replace
from typing import TYPE_CHECKING

from ecatspec.model.core.compiled import CompiledRule, Holder, Later, Timer, View
from ecatspec.model.core.state import RuleName
from ecatspec.model.core.values import Pattern
from ecatspec.spec.language.functions import REPLY
from ecatspec.spec.language.ir import (
    After,
    Bool,
    Conditional,
    Expression,
    Gap,
    Name,
    Rule,
    Type,
)
from ecatspec.spec.language.nodes import names_in
from ecatspec.spec.language.references import (
    StateRef,
    VariableRef,
)
from ecatspec.spec.language.scope import Scope, frame_fields, resolve

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.core.codec import Codec
    from ecatspec.model.core.expressions import (
        Environment,
        Getter,
    )
    from ecatspec.spec.language.ir import (
        Give,
        Protocol,
        Register,
        Send,
        Update,
        Word,
    )


class Names(typing.Protocol):
    """What names of the texts mean in a compiled model."""

    protocol: Protocol
    slots: dict[str, int]
    codec: Codec

    def expression(self, expression: Expression, scope: Scope, expected: Type | None) -> Getter:
        """Compile an expression of a scope, of which a value of `expected` is wanted."""

    def slot(self, ref: VariableRef | StateRef) -> int:
        """Give the slot of a variable or a state."""

    def state_names(self, machine: str) -> Mapping[int, str]:
        """Give the states of a machine by their numbers."""


def rule_of(names: Names, machine: str, rule: Rule | Gap) -> CompiledRule:
    """Compile a rule or a gap."""
    scope = Scope(machine, rule.input)
    values = {name: value for value, name in names.state_names(machine).items()}
    guard = None if rule.guard is None else names.expression(rule.guard, scope, None)
    sources = frozenset(values[name] for name in rule.sources)
    if isinstance(rule, Gap):
        return CompiledRule(
            RuleName(machine, rule.name), sources, guard, None, (), (), (), (), None, gap=True
        )
    later = scope if not rule.sends else replace(scope, reply=rule.sends[-1].frame)
    sends, late = [], []
    for send in rule.sends:
        bound = _bindings_of(names, send, later)
        sends.append((send.frame, tuple((n, get) for n, get, is_late in bound if not is_late)))
        late += [(n, get) for n, get, is_late in bound if is_late]
    after = None
    if late or rule.after is not None:
        given = rule.after or After((), ())
        after = Later(
            tuple(late),
            _updates_of(names, given.updates, later),
            _gives_of(names, given.gives, later),
        )
    return CompiledRule(
        RuleName(machine, rule.name),
        sources,
        guard,
        None if rule.target is None else values[rule.target],
        _updates_of(names, rule.updates, scope),
        tuple(
            (
                names.expression(store.index, scope, None),
                names.expression(store.subindex, scope, None),
                names.expression(store.value, scope, None),
                store.complete,
            )
            for store in rule.stores
        ),
        tuple(sends),
        _gives_of(names, rule.gives, scope),
        None if rule.within is None else names.expression(rule.within, scope, None),
        gap=False,
        later=after,
        take=None if rule.take is None else names.expression(rule.take, scope, None),
        timers=tuple(
            Timer(
                later.target.partition(".")[0],
                later.target.partition(".")[2],
                tuple((n, names.expression(e, scope, None)) for n, e in later.arguments),
                None if later.after is None else names.expression(later.after, scope, None),
                names.expression(later.within, scope, None),
            )
            for later in rule.laters
        ),
    )


def _updates_of(
    names: Names, updates: tuple[Update, ...], scope: Scope
) -> tuple[tuple[int, Getter], ...]:
    found = []
    for update in updates:
        machine, dot, variable = update.variable.rpartition(".")
        owner = machine if dot else scope.machine or ""
        variables = names.protocol.machines[owner].variables
        kind = next(item.type for item in variables if item.name == variable)
        value = names.expression(update.value, scope, kind)
        found.append((names.slots[f"{owner}.{variable}"], value))
    return tuple(found)


def _gives_of(
    names: Names, gives: tuple[Give, ...], scope: Scope
) -> tuple[tuple[str, tuple[tuple[str, Getter], ...]], ...]:
    return tuple(
        (give.target, tuple((n, names.expression(e, scope, None)) for n, e in give.arguments))
        for give in gives
    )


def _bindings_of(names: Names, send: Send, scope: Scope) -> tuple[tuple[str, Getter, bool], ...]:
    """Give field, value, and whether the value waits for other fields of the frame."""
    types = frame_fields(names.protocol, send.frame)
    return tuple(
        (
            name,
            names.expression(value, scope, types[name]),
            any(path.startswith(f"{REPLY}.") for path in names_in(value)),
        )
        for name, value in send.fields
    )


def views_of(names: Names, register: Register | Word) -> tuple[View, ...]:
    """Compile the fields of a register or a word that the MainDevice reads."""
    views = []
    for field in register.fields:
        if field.shows is None:
            continue
        condition, advised = field.shows.condition, field.shows.advised
        views.append(
            View(
                field.name,
                field.low,
                field.high - field.low + 1,
                isinstance(field.type, Bool),
                field.shows.value,
                names.expression(field.shows.value, Scope(), field.type),
                None if condition is None else names.expression(condition, Scope(), None),
                _holder_of(names, field.shows.value),
                None if advised is None else names.expression(advised.value, Scope(), field.type),
            )
        )
    return tuple(views)


def _holder_of(names: Names, shown: Expression) -> Holder:
    if isinstance(shown, Conditional):
        condition = names.expression(shown.condition, Scope(), None)
        then, otherwise = _holder_of(names, shown.then), _holder_of(names, shown.otherwise)

        def chosen(environment: Environment) -> int | None:
            holds = condition(environment)
            if isinstance(holds, Pattern):
                return None
            return then(environment) if holds else otherwise(environment)

        return chosen
    ref = resolve(names.protocol, shown.path, Scope()) if isinstance(shown, Name) else None
    slot = names.slot(ref) if isinstance(ref, VariableRef | StateRef) else None
    return lambda _: slot


def reply_fields_of(names: Names, frame: str) -> dict[str, tuple[Getter, str | None]]:
    """Give for each field with a `reply` text its value and the slot that keeps it."""
    found = {}
    for name in names.codec.trail(frame):
        for field in names.protocol.frames[name].fields:
            if field.reply is not None:
                getter = names.expression(field.reply, Scope(), field.type)
                found[field.name] = (getter, field.into)
    return found
