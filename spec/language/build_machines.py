"""Builds machines, their rules and what changes them from the trees of the grammar."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from lark import Token, v_args

from ecatspec.spec.language import ir
from ecatspec.spec.language.build_expressions import ExpressionBuilder
from ecatspec.spec.language.diagnostics import Code
from ecatspec.spec.language.syntax_errors import refuse

if TYPE_CHECKING:
    from lark.tree import Meta

    from ecatspec.spec.language.build_expressions import Binding

Clauses: TypeAlias = "tuple[str, ...] | None"
"""The clauses of a declaration; None where the brackets are absent."""
Rows: TypeAlias = "tuple[ir.Rule | ir.Gap, ...]"


def two_parts(path: str, at: ir.Span, shape: str = "machine.rule") -> tuple[str, str]:
    """Give both names of a path, or refuse it as not of this shape."""
    owner, dot, name = path.partition(".")
    if not dot or "." in name:
        what = shape.partition(".")[2]
        refuse(Code.ECS001, at, f"`{path}` names no {what}", f"write `{shape}`")
    return owner, name


def _divided(rows: Rows) -> tuple[tuple[ir.Rule, ...], tuple[ir.Gap, ...]]:
    """The rules of a machine, and its gaps."""
    rules = tuple(row for row in rows if isinstance(row, ir.Rule))
    return rules, tuple(row for row in rows if isinstance(row, ir.Gap))


@v_args(inline=True, meta=True)
class MachineBuilder(ExpressionBuilder):
    """The rules of the grammar for machines."""

    def machine(
        self,
        meta: Meta,
        name: Token,
        wording: str,
        table: Token,
        states: tuple[str, ...],
        initial: Token,
        variables: tuple[ir.Variable, ...],
        inputs: tuple[ir.Input, ...],
        rows: Rows,
    ) -> ir.Machine:
        rules, gaps = _divided(rows)
        return ir.Machine(
            str(name),
            wording,
            str(table),
            states,
            str(initial),
            variables,
            inputs,
            rules,
            gaps,
            self._at(meta),
        )

    def extend(
        self,
        meta: Meta,
        name: Token,
        variables: tuple[ir.Variable, ...],
        inputs: tuple[ir.Input, ...],
        rows: Rows,
    ) -> ir.Extend:
        return ir.Extend(str(name), variables, inputs, *_divided(rows), self._at(meta))

    def variables(self, _: Meta, *variables: ir.Variable) -> tuple[ir.Variable, ...]:
        return variables

    def variable(
        self, meta: Meta, name: Token, kind: ir.Type, initial: ir.Expression
    ) -> ir.Variable:
        return ir.Variable(str(name), kind, initial, self._at(meta))

    def inputs(self, _: Meta, *inputs: ir.Input) -> tuple[ir.Input, ...]:
        return inputs

    def rows(self, _: Meta, *rows: ir.Rule | ir.Gap) -> Rows:
        return rows

    def origin_input(self, meta: Meta, name: Token, kind: Token, *origin: Token) -> ir.Input:
        frames = tuple(map(str, origin))
        return ir.Input(str(name), ir.InputKind(kind), frames, (), self._at(meta))

    def word_input(self, meta: Meta, name: Token, word: Token) -> ir.Input:
        return ir.Input(str(name), ir.InputKind.WORD, (str(word),), (), self._at(meta))

    def outputs_input(self, meta: Meta, name: Token) -> ir.Input:
        return ir.Input(str(name), ir.InputKind.OUTPUTS, (), (), self._at(meta))

    def event_input(
        self, meta: Meta, name: Token, *parameters: tuple[str, ir.Type] | None
    ) -> ir.Input:
        return self._signed_input(meta, name, ir.InputKind.EVENT, parameters)

    def local_input(
        self, meta: Meta, name: Token, *parameters: tuple[str, ir.Type] | None
    ) -> ir.Input:
        return self._signed_input(meta, name, ir.InputKind.LOCAL, parameters)

    def own_input(
        self, meta: Meta, name: Token, *parameters: tuple[str, ir.Type] | None
    ) -> ir.Input:
        return self._signed_input(meta, name, ir.InputKind.OWN, parameters)

    def _signed_input(
        self,
        meta: Meta,
        name: Token,
        kind: ir.InputKind,
        parameters: tuple[tuple[str, ir.Type] | None, ...],
    ) -> ir.Input:
        given = tuple(parameter for parameter in parameters if parameter is not None)
        return ir.Input(str(name), kind, (), given, self._at(meta))

    def signature_item(self, _: Meta, name: Token, kind: ir.Type) -> tuple[str, ir.Type]:
        return str(name), kind

    def from_part(self, _: Meta, *words: Token) -> tuple[tuple[str, ...], str]:
        *sources, event = map(str, words)
        return tuple(sources), event

    def rule(
        self,
        meta: Meta,
        name: Token,
        clauses: Clauses,
        origin: tuple[tuple[str, ...], str],
        guard: ir.Expression | None,
        target: Token | None,
        updates: tuple[ir.Update, ...] | None,
        stores: tuple[ir.Store, ...],
        take: ir.Expression | None,
        sends: tuple[ir.Send, ...],
        gives: tuple[ir.Give, ...],
        laters: tuple[ir.Later, ...],
        within: ir.Expression | None,
        after: ir.After | None,
    ) -> ir.Rule:
        return ir.Rule(
            str(name),
            clauses or (),
            *origin,
            guard,
            None if target is None else str(target),
            updates or (),
            stores,
            sends,
            gives,
            within,
            after,
            take,
            laters,
            self._at(meta),
        )

    def gap(
        self,
        meta: Meta,
        name: Token,
        clauses: Clauses,
        origin: tuple[tuple[str, ...], str],
        guard: ir.Expression | None,
    ) -> ir.Gap:
        return ir.Gap(str(name), clauses or (), *origin, guard, self._at(meta))

    def updates(self, _: Meta, *updates: ir.Update) -> tuple[ir.Update, ...]:
        return updates

    def update(self, meta: Meta, variable: str, value: ir.Expression) -> ir.Update:
        return ir.Update(variable, value, self._at(meta))

    def stores(self, _: Meta, *stores: ir.Store) -> tuple[ir.Store, ...]:
        return stores

    def store(
        self, meta: Meta, index: ir.Expression, subindex: ir.Expression, value: ir.Expression
    ) -> ir.Store:
        return ir.Store(index, subindex, value, at=self._at(meta))

    def complete_store(
        self, meta: Meta, index: ir.Expression, subindex: ir.Expression, value: ir.Expression
    ) -> ir.Store:
        return ir.Store(index, subindex, value, complete=True, at=self._at(meta))

    def sends(self, _: Meta, *sends: ir.Send) -> tuple[ir.Send, ...]:
        return sends

    def send(self, meta: Meta, frame: Token, *fields: Binding | None) -> ir.Send:
        given = tuple(field for field in fields if field is not None)
        return ir.Send(str(frame), given, self._at(meta))

    def gives(self, _: Meta, *gives: ir.Give) -> tuple[ir.Give, ...]:
        return gives

    def give(self, meta: Meta, target: str, *arguments: Binding | None) -> ir.Give:
        given = tuple(argument for argument in arguments if argument is not None)
        return ir.Give(target, given, self._at(meta))

    def deliver(self, meta: Meta) -> ir.Give:
        return ir.Give("deliver", (), self._at(meta))

    def resend(self, meta: Meta) -> ir.Give:
        return ir.Give("resend", (), self._at(meta))

    def laters(self, _: Meta, *laters: ir.Later) -> tuple[ir.Later, ...]:
        return laters

    def later(
        self,
        meta: Meta,
        target: str,
        arguments: tuple[Binding, ...] | None,
        after: ir.Expression | None,
        within: ir.Expression,
    ) -> ir.Later:
        return ir.Later(target, arguments or (), after, within, self._at(meta))

    def arguments(self, _: Meta, *arguments: Binding) -> tuple[Binding, ...]:
        return arguments

    def after(
        self, meta: Meta, updates: tuple[ir.Update, ...] | None, gives: tuple[ir.Give, ...]
    ) -> ir.After:
        return ir.After(updates or (), gives, self._at(meta))

    def replace(
        self,
        meta: Meta,
        path: str,
        clauses: tuple[str, ...],
        guard: ir.Expression | None,
        target: Token | None,
        updates: tuple[ir.Update, ...] | None,
        sends: tuple[ir.Send, ...],
        gives: tuple[ir.Give, ...],
        laters: tuple[ir.Later, ...],
        within: ir.Expression | None,
    ) -> ir.Replace:
        at = self._at(meta)
        return ir.Replace(
            *two_parts(path, at),
            clauses,
            guard,
            None if target is None else str(target),
            updates or (),
            sends,
            within,
            gives,
            laters,
            at,
        )

    def replace_field(
        self,
        meta: Meta,
        path: str,
        clauses: tuple[str, ...],
        reply: ir.Expression,
        into: str | None,
    ) -> ir.ReplaceField:
        at = self._at(meta)
        return ir.ReplaceField(*two_parts(path, at, "frame.field"), clauses, reply, into, at)

    def fault(
        self,
        meta: Meta,
        name: Token,
        wording: str,
        clauses: tuple[str, ...],
        quirk: Token | None,
        *changes: ir.Replace | ir.Remove | ir.Extend | ir.ReplaceField,
    ) -> ir.Fault:
        named = None if quirk is None else str(quirk)
        return ir.Fault(str(name), wording, clauses, named, changes, self._at(meta))

    def remove(self, meta: Meta, path: str, clauses: tuple[str, ...]) -> ir.Remove:
        at = self._at(meta)
        return ir.Remove(*two_parts(path, at), clauses, at)
