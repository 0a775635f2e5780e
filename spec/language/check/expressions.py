"""Checks every expression of a text, each in the scope of its place."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ecatspec.spec.language.check.kinds import KindChecker, word_of
from ecatspec.spec.language.diagnostics import Code, near
from ecatspec.spec.language.functions import REPLY
from ecatspec.spec.language.ir import (
    Area,
    Bool,
    Bytes,
    Frame,
    Gap,
    InputKind,
    Machine,
    Named,
    Reason,
    RegisterField,
    Rule,
    SInt,
    Span,
    Time,
    Type,
    UInt,
)
from ecatspec.spec.language.nodes import names_in
from ecatspec.spec.language.references import ChoiceRef
from ecatspec.spec.language.scope import Scope, frame_fields, input_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ecatspec.spec.language.ir import (
        After,
        Expression,
        Give,
        Later,
        Send,
        Update,
    )


_PLACE: Final = re.compile(r"\{[^{}]*\}")
_WORDS: Final = "{words}"
_PLACES: Final = ("{}", "{hex}", _WORDS)
_TOLD: Final = (UInt, SInt, Bool, Named, ChoiceRef)
_REPLY: Final = f"{REPLY}."


class ExpressionChecker(KindChecker):
    """Walks over the expressions of rules, frames, definitions and reasons."""

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
                if found is None or found.kind not in {InputKind.WRITE, InputKind.FRAME}:
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
                what = f"{word_of(kind)} cannot be told by {place}"
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
