"""Finds what cites which clause, and what a rule, object or register rests on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ecatspec.model.core.compiled import rows_of
from ecatspec.spec.language.ir import (
    Call,
    InputKind,
    Name,
    Named,
    OneOf,
    Remove,
    ReplaceField,
    Rule,
)
from ecatspec.spec.language.nodes import names_in, nodes_in

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ecatspec.model.core.values import ObjectKey
    from ecatspec.spec.language.ir import Gap, Input, Machine, Protocol, Register, Span, Word

_OF_THE_DICTIONARY = frozenset({"declared", "object_exists", "dictionary_closed", "object_list"})
"""Functions whose answer depends on whether other objects may exist."""


@dataclass(frozen=True, slots=True)
class Citation:
    """A declaration that rests on clauses; `kind` is its word in the language."""

    kind: str
    name: str
    clauses: tuple[str, ...]
    at: Span


def citations(protocol: Protocol) -> Iterator[Citation]:
    """Yield all declarations that cite clauses, those that a device text took away too."""
    for machine in protocol.machines.values():
        for rule in machine.rules:
            yield Citation("rule", f"{machine.name}.{rule.name}", rule.clauses, rule.at)
        for gap in machine.gaps:
            yield Citation("gap", f"{machine.name}.{gap.name}", gap.clauses, gap.at)
    for layout in _layouts(protocol):
        kind = type(layout).__name__.lower()
        yield Citation(kind, layout.name, layout.clauses, layout.at)
        for bits in layout.fields:
            yield Citation("field", f"{layout.name}.{bits.name}", bits.clauses, bits.at)
    for frame in protocol.frames.values():
        for part in frame.fields:
            yield Citation("field", f"{frame.name}.{part.name}", part.clauses, part.at)
    for table in protocol.tables.values():
        for row in table.rows:
            yield Citation("row", f"{table.name}.{row.name}", row.clauses, row.at)
    for choice in protocol.choices.values():
        for way in choice.alternatives:
            if way.risk is not None:
                yield Citation("alternative", f"{choice.name}.{way.name}", way.risk.clauses, way.at)
    for kind, declared in (
        ("parameter", protocol.parameters),
        ("frame", protocol.frames),
        ("choice", protocol.choices),
        ("pin", protocol.pins),
        ("open", protocol.opened),
        ("condition", protocol.conditions),
        ("define", protocol.definitions),
        ("property", protocol.properties),
        ("reason", protocol.reasons),
        ("closed", protocol.closed),
    ):
        for name, item in declared.items():
            yield Citation(kind, name, item.clauses, item.at)
    for entry in protocol.objects:
        name = object_name((entry.index, entry.subindex))
        yield Citation("object", name, entry.clauses, entry.at)
    for esi in protocol.esi:
        yield Citation("esi", esi.path, esi.clauses, esi.at)
    for example in protocol.examples:
        yield Citation("example", example.name, example.clauses, example.at)
    yield Citation("dictionary", "", protocol.dictionary.clauses, protocol.dictionary.at)
    for change in protocol.replaced:
        match change:
            case Remove():
                yield Citation(
                    "remove", f"{change.machine}.{change.rule}", change.clauses, change.at
                )
            case ReplaceField():
                yield Citation(
                    "replace", f"{change.frame}.{change.name}", change.clauses, change.at
                )
            case _:
                pass


def object_name(key: ObjectKey) -> str:
    """Give an entry of the object dictionary as it is named in reports."""
    return f"0x{key[0]:04X}:{key[1]:02X}"


class Foundations:
    """The clauses on which everything rests that a test can touch, by the name it has in reports.

    A rule rests on its own clauses and on those of all that it mentions: definitions and what
    they mention, parameters, choices with how the device goes there, rows that it gives a
    variable or a state, registers and frames of its input and of its answer.
    """

    def __init__(self, protocol: Protocol) -> None:
        """Look through all rules of the protocol."""
        self._protocol = protocol
        self._named = self._by_name()
        self._remembered: dict[tuple[str, str], frozenset[str]] = {}
        """By kind and name what frames and definitions rest on, which many rules mention."""
        self._fields = {
            replaced.frame: replaced.clauses
            for replaced in protocol.replaced
            if isinstance(replaced, ReplaceField)
        }
        self.of: dict[str, frozenset[str]] = {}
        for machine in protocol.machines.values():
            for rule in rows_of(machine):
                found = frozenset(self._of_rule(machine, rule))
                self.of[f"{machine.name}.{rule.name}"] = found
        for register in protocol.registers.values():
            self.of[f"register {register.name}"] = frozenset(self._of_layout(register))
        words = {word.key: word for word in protocol.words.values()}
        for entry in protocol.objects:
            key = entry.index, entry.subindex
            bits = self._of_layout(words[key]) if key in words else ()
            self.of[object_name(key)] = frozenset((*entry.clauses, *bits))
        for example in protocol.examples:
            self.of[f"example {example.name}"] = frozenset(example.clauses)

    def _by_name(self) -> dict[str, tuple[str, ...]]:
        """Give the clauses of what an expression can name, but definitions."""
        protocol = self._protocol
        rows = [(table.name, row) for table in protocol.tables.values() for row in table.rows]
        named = {row.name: row.clauses for _, row in rows}
        named |= {f"{table}.{row.name}": row.clauses for table, row in rows}
        named |= {name: condition.clauses for name, condition in protocol.conditions.items()}
        for name, parameter in protocol.parameters.items():
            named |= dict.fromkeys((name, f"{name}.start", f"{name}.length"), parameter.clauses)
        for name, choice in protocol.choices.items():
            ways = (protocol.pins.get(name), protocol.opened.get(name))
            named[name] = choice.clauses + tuple(
                c for w in ways if w is not None for c in w.clauses
            )
        for layout in _layouts(protocol):
            for bits in layout.fields:
                named[f"{layout.name}.{bits.name}"] = layout.clauses + bits.clauses
        return named

    def _of_rule(self, machine: Machine, rule: Rule | Gap) -> Iterator[str]:
        yield from rule.clauses
        source = next(item for item in machine.inputs if item.name == rule.input)
        yield from self._of_input(source)
        yield from self._of_nodes(nodes_in(rule))
        sources = rule.sources if len(rule.sources) == 1 else ()
        target = rule.target if isinstance(rule, Rule) else None
        for state in filter(None, (*sources, target)):
            yield from self._named[f"{machine.table}.{state}"]
        for reason in self._protocol.reasons.values():
            if (reason.machine, reason.rule) == (machine.name, rule.name):
                yield from reason.clauses
        for law in self._protocol.properties.values():
            if any(path.startswith(f"{machine.name}.") for path in names_in(law.value)):
                yield from law.clauses
        if isinstance(rule, Rule):
            yield from self._of_effects(machine, rule)

    def _of_effects(self, machine: Machine, rule: Rule) -> Iterator[str]:
        shown = {f"{machine.name}.{update.variable}" for update in rule.updates}
        if rule.target is not None:
            shown.add(f"{machine.name}.state")
        for layout in _layouts(self._protocol):
            views = [bits.shows for bits in layout.fields if bits.shows is not None]
            if any(shown.intersection(names_in(view.value)) for view in views):
                yield from self._of_layout(layout)
        types = {variable.name: variable.type for variable in machine.variables}
        for update in rule.updates:
            kind = types.get(update.variable)
            if isinstance(kind, Named) and kind.table in self._protocol.closed:
                yield from self._protocol.closed[kind.table].clauses
        for send in rule.sends:
            yield from self._of_frame(send.frame)

    def _of_input(self, source: Input) -> Iterator[str]:
        for name in source.origin:
            if source.kind == InputKind.FRAME:
                yield from self._of_frame(name)
            for layout in _layouts(self._protocol):
                if layout.name == name:
                    yield from self._of_layout(layout)

    def _of_layout(self, layout: Register | Word) -> Iterator[str]:
        yield from layout.clauses
        for bits in layout.fields:
            yield from bits.clauses
            if bits.shows is not None and bits.shows.advised is not None:
                yield from bits.shows.advised.clauses
        yield from self._of_nodes(nodes_in(layout))

    def _of_frame(self, name: str) -> frozenset[str]:
        key = "frame", name
        if key not in self._remembered:
            self._remembered[key] = frozenset(self._of_trail(name))
        return self._remembered[key]

    def _of_trail(self, name: str) -> Iterator[str]:
        place: str | None = name
        while place is not None:
            frame = self._protocol.frames[place]
            yield from frame.clauses
            yield from (clause for item in frame.fields for clause in item.clauses)
            yield from self._fields.get(place, ())
            yield from self._of_nodes(nodes_in(frame))
            place = frame.parent

    def _of_nodes(self, nodes: Iterable[object]) -> Iterator[str]:
        """Give the clauses of what is mentioned; of acceptable sets none of the rows counts."""
        undecided = set()
        for node in nodes:
            if isinstance(node, OneOf):
                undecided |= {name for item in node.items for name in names_in(item)}
            if isinstance(node, Call) and node.function in _OF_THE_DICTIONARY:
                yield from self._protocol.dictionary.clauses
            if not isinstance(node, Name) or node.path in undecided:
                continue
            if node.path in self._protocol.definitions:
                yield from self._of_definition(node.path)
            else:
                yield from self._named.get(node.path, ())

    def _of_definition(self, name: str) -> frozenset[str]:
        key = "define", name
        if key not in self._remembered:
            definition = self._protocol.definitions[name]
            within = self._of_nodes(nodes_in(definition.value))
            self._remembered[key] = frozenset((*definition.clauses, *within))
        return self._remembered[key]


def _layouts(protocol: Protocol) -> tuple[Register | Word, ...]:
    registers: tuple[Register | Word, ...] = tuple(protocol.registers.values())
    return registers + tuple(protocol.words.values())
