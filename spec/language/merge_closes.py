"""Closed tables: what is left of rules once values are gone."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ecatspec.spec.language.diagnostics import Code
from ecatspec.spec.language.ir import (
    Close,
    CodeTable,
    Conditional,
    Literal,
    Machine,
    Name,
    Named,
    OneOf,
    Range,
    Rule,
)
from ecatspec.spec.language.merge_changes import Changes, constant_in, joined, listed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.spec.language.ir import (
        Expression,
        Type,
    )


class Closes(Changes):
    """The changes of a device text with the tables that it closes."""

    def close(self, close: Close) -> None:
        """Close a table: other values vanish from the table and from what rules may set or send."""
        table = self.tables.get(close.table)
        if table is None:
            self._find(
                Code.ECS401,
                close.at,
                f"there is no table `{close.table}`",
                f"close one of {listed(self.tables, close.table)}",
            )
            return
        names = {row.name: row.value for row in table.rows}
        kept: dict[int, None] = {}
        for item in close.values:
            value = constant_in(item, names, table.name)
            if value is None or value not in names.values():
                self._find(
                    Code.ECS401,
                    item.at,
                    f"table `{table.name}` has no row for this value",
                    f"add a row in a `table {table.name}` of the device text",
                )
            else:
                kept[value] = None
        rows = tuple(row for row in table.rows if row.value in kept)
        if table.closed and len(rows) == len(table.rows):
            self._find(
                Code.ECS402,
                close.at,
                f"table `{table.name}` is closed with these values already",
                "take the line away",
            )
        self.closed[close.table] = close
        self.tables[close.table] = replace(table, closed=True, rows=rows)
        narrow = _Narrow(table, tuple(kept))
        for machine in self.machines.values():
            rules = tuple(self._narrowed(machine, rule, narrow, close) for rule in machine.rules)
            self.machines[machine.name] = replace(machine, rules=rules)

    def _narrowed(self, machine: Machine, rule: Rule, narrow: _Narrow, close: Close) -> Rule:
        variables: dict[str, Type] = {
            f"{other.name}.{variable.name}": variable.type
            for other in self.machines.values()
            for variable in other.variables
        }
        variables |= {variable.name: variable.type for variable in machine.variables}
        narrow.lost.clear()
        updates = tuple(
            replace(update, value=narrow.value(variables.get(update.variable), update.value))
            for update in rule.updates
        )
        sends = tuple(
            replace(send, fields=narrow.fields(self._field_types(send.frame), send.fields))
            for send in rule.sends
        )
        gives = tuple(
            replace(give, arguments=narrow.fields(self._event_types(give.target), give.arguments))
            for give in rule.gives
        )
        laters = tuple(
            replace(
                later, arguments=narrow.fields(self._event_types(later.target), later.arguments)
            )
            for later in rule.laters
        )
        for value in narrow.lost:
            self._find(
                Code.ECS403,
                close.at,
                f"rule `{machine.name}.{rule.name}` ({rule.at}) is left without a code of"
                f" `{close.table}`: it has {narrow.wording(value)}",
                "replace or remove the rule, or keep its code",
            )
        new = replace(rule, updates=updates, sends=sends, gives=gives, laters=laters)
        if new == rule:
            return rule
        return replace(new, clauses=joined(rule.clauses, close.clauses))

    def _field_types(self, name: str) -> dict[str, Type]:
        types: dict[str, Type] = {}
        place: str | None = name
        seen: set[str] = set()
        while place is not None and place in self.frames and place not in seen:
            seen.add(place)
            frame = self.frames[place]
            types = {field.name: field.type for field in frame.fields} | types
            place = frame.parent
        return types

    def _event_types(self, target: str) -> dict[str, Type]:
        name, _, event = target.partition(".")
        machine = self.machines.get(name)
        inputs = () if machine is None else machine.inputs
        return {p: t for i in inputs if i.name == event for p, t in i.parameters}


class _Narrow:
    """Takes values that a closed table no longer has out of expressions."""

    def __init__(self, table: CodeTable, kept: tuple[int, ...]) -> None:
        self._table = table
        self._names = {row.name: row.value for row in table.rows}
        self._kept = kept
        self.lost: list[Expression] = []

    def fields(
        self, types: Mapping[str, Type], given: tuple[tuple[str, Expression], ...]
    ) -> tuple[tuple[str, Expression], ...]:
        return tuple((name, self.value(types.get(name), value)) for name, value in given)

    def value(self, kind: Type | None, value: Expression) -> Expression:
        """The value with what is left of it; what has nothing left is noted in `lost`."""
        if kind != Named(self._table.name):
            return value
        match value:
            case Conditional():
                return replace(
                    value,
                    then=self.value(kind, value.then),
                    otherwise=self.value(kind, value.otherwise),
                )
            case OneOf():
                items = tuple(item for old in value.items for item in self._item(old))
                barred = None if value.excluded is None else self._constant(value.excluded)
                left = {self._constant(item) for item in items} - {None, barred}
                if not left and not any(self._constant(item) is None for item in items):
                    self.lost.append(value)
                    return value
                vanished = barred is not None and barred not in self._kept
                return replace(value, items=items, excluded=None if vanished else value.excluded)
            case Literal() | Name():
                number = self._constant(value)
                if number is not None and number not in self._kept:
                    self.lost.append(value)
                return value
            case _:
                return value

    def wording(self, value: Expression) -> str:
        """The codes that a rule had, for the finding."""
        items = value.items if isinstance(value, OneOf) else (value,)
        words = [
            f"{i.low.value:#06x}..{i.high.value:#06x}"
            if isinstance(i, Range) and isinstance(i.low, Literal) and isinstance(i.high, Literal)
            else f"`{i.path}`"
            if isinstance(i, Name)
            else f"{i.value:#06x}"
            if isinstance(i, Literal)
            else "..."
            for i in items
        ]
        return ", ".join(words)

    def _constant(self, value: Expression | Range) -> int | None:
        return (
            None if isinstance(value, Range) else constant_in(value, self._names, self._table.name)
        )

    def _item(self, item: Expression | Range) -> tuple[Expression | Range, ...]:
        if isinstance(item, Range):
            low, high = self._constant(item.low), self._constant(item.high)
            if low is None or high is None:
                return (item,)
            digits = (self._table.width + 3) // 4
            inside = (value for value in self._kept if low <= value <= high)
            return tuple(Literal(value, digits, item.at) for value in inside)
        number = self._constant(item)
        return () if number is not None and number not in self._kept else (item,)
