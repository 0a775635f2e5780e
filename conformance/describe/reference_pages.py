"""Writes the reference pages: the texts of the standard, and the grammar."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.describe.device_page import capital
from ecatspec.conformance.render.tables import Sheet, markdown_table
from ecatspec.spec.language.ir import (
    Choice,
    Clause,
    CodeTable,
    Condition,
    Definition,
    Dictionary,
    Extend,
    Frame,
    Machine,
    ObjectEntry,
    Parameter,
    Property,
    Reason,
    Register,
    Word,
)
from ecatspec.spec.language.pretty import pretty_blocks, pretty_rule

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.spec.language.ir import Declaration, Gap, Protocol, Rule, SourceText

_TITLES: Final = {
    CodeTable: "Code tables",
    Parameter: "Parameters",
    Register: "Registers",
    Word: "Bits of objects",
    Frame: "Layouts",
    Dictionary: "Object dictionary",
    ObjectEntry: "Objects",
    Choice: "Choices",
    Condition: "Conditions that only the device knows",
    Definition: "Definitions",
    Property: "What always holds",
    Reason: "Why rules refuse",
}
"""The sections of declarations that are shown as they are written, in their order."""


def standard_page(text: SourceText, protocol: Protocol) -> str:
    """Give the page of one text of the standard: its clauses, and each rule with those it cites."""
    clauses = [each for each in text.declarations if isinstance(each, Clause)]
    machines = [each for each in text.declarations if isinstance(each, Machine | Extend)]
    rules = sum(len(machine.rules) for machine in machines)
    about = (
        f"The text `spec/standard/{text.name}.ecs`: {len(clauses)} clauses, {rules} rules. Made by"
        f" `make docs`; [the language](../language.md) says how to read it."
    )
    parts = [f"# {capital(text.wording)}", about, "## Clauses", _clause_table(clauses)]
    for kind, title in _TITLES.items():
        members = [each for each in text.declarations if isinstance(each, kind)]
        if members:
            parts += [f"## {title}", _code("\n\n".join(pretty_blocks(members)))]
    for machine in machines:
        parts += _machine(machine, protocol)
    others = {type(each) for each in text.declarations} - {Clause, Machine, Extend, *_TITLES}
    if others:
        raise TypeError(others)
    return "\n\n".join(parts) + "\n"


def _clause_table(clauses: list[Clause]) -> str:
    rows = tuple((each.id, each.level.value, each.wording, each.source) for each in clauses)
    return markdown_table(Sheet("clauses", "", ("clause", "level", "demand", "source"), rows))


def _machine(machine: Machine | Extend, protocol: Protocol) -> Iterator[str]:
    if isinstance(machine, Machine):
        yield f"## Machine {machine.name}: {machine.wording}"
    else:
        yield f"## Added to machine {machine.machine}"
    without: Declaration = replace(machine, rules=(), gaps=())
    yield _code("\n\n".join(pretty_blocks([without])))
    rows: tuple[Rule | Gap, ...] = (*machine.rules, *machine.gaps)
    for row in sorted(rows, key=lambda row: row.at):
        yield f"### {row.name}"
        yield _code(pretty_rule(row))
        if row.clauses:
            yield "\n".join(_cited(protocol.clauses, name) for name in row.clauses)


def _cited(clauses: Mapping[str, Clause], name: str) -> str:
    return f"- **{name}** {clauses[name].level.value}: {clauses[name].wording}"


def _code(text: str) -> str:
    return "\n".join(f"    {line}".rstrip() for line in text.splitlines())


_ABOUT_GRAMMAR: Final = """# Grammar

The productions of the [language](language.md), as the parser has them.
Made by `make docs` from `spec/language/grammar.lark`.

What is in quotes stands in a text as it is. `a | b` is one of both, `[a]` and `a?` may be absent,
`a*` comes any number of times, `a+` at least once. Names in capitals are words; `/.../` is a
regular expression. White space and comments are dropped between words."""

_SECTION: Final = re.compile(r"^// --- (.+?) -+$")
_HEAD: Final = re.compile(r"([?!]?)(\w+)(?:\.\d+)?:")
_ALIAS: Final = re.compile(r"\s+-> \w+")


def grammar_page(grammar: str) -> str:
    """Give the page of the grammar: all productions, without what only the parser needs."""
    sections: list[tuple[str, list[str]]] = [("texts", [])]
    cut = 0
    for line in grammar.splitlines():
        if title := _SECTION.match(line):
            sections.append((title[1], []))
        elif not line.startswith(("//", "%")):
            own = _ALIAS.sub("", line)
            if head := _HEAD.match(own):
                cut = len(head[1])
                own = head[2] + ":" + own[head.end() :]
            else:
                own = own[cut:]
            sections[-1][1].append(own)
    parts = [_ABOUT_GRAMMAR]
    for name, lines in sections:
        parts += [f"## {capital(name)}", _code("\n".join(lines).strip("\n"))]
    return "\n\n".join(parts) + "\n"
