"""Checks texts before the merge: repetitions, missing citations, statements without effect."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from ecatspec.spec.language.diagnostics import Code, Diagnostic, near
from ecatspec.spec.language.ir import (
    STANDARD,
    Anomaly,
    Choice,
    Clause,
    Close,
    CodeTable,
    Condition,
    Confirm,
    Definition,
    Dictionary,
    EsiEntry,
    Example,
    Extend,
    Fault,
    Frame,
    Level,
    Machine,
    Manual,
    Name,
    ObjectEntry,
    Open,
    Parameter,
    Pin,
    Property,
    Reason,
    Register,
    Remove,
    Replace,
    ReplaceField,
    SetParameter,
    Word,
)
from ecatspec.spec.language.nodes import names_in, nodes_in

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ecatspec.spec.language.ir import Declaration, SourceText, Span

LAYOUT_WORDS: Final = ("reserved", "padding", "data")
"""Names that several frames around each other may use: nobody refers to them."""

_Statement: TypeAlias = (
    Pin
    | Open
    | Confirm
    | Close
    | SetParameter
    | Replace
    | Remove
    | Extend
    | ReplaceField
    | Dictionary
)


def check_texts(texts: Sequence[SourceText]) -> list[Diagnostic]:
    """What is wrong with the texts before they are put together: said twice, cited, not cited."""
    declarations = [declaration for text in texts for declaration in text.declarations]
    clauses = {clause.id: clause for clause in declarations if isinstance(clause, Clause)}
    findings = [*_twice(texts), *_circles(declarations), *_in_vain(texts)]
    findings += _unreasoned(clauses.values())
    findings += _founded(texts)
    for declaration in declarations:
        for name, cited, at in _citations(declaration):
            if not cited and name.startswith(("rule", "gap")):
                findings.append(
                    Diagnostic(
                        Code.ECS105,
                        at,
                        f"{name} cites no clause",
                        "add the clause that it comes from: [AL-03]",
                    )
                )
            findings.extend(
                Diagnostic(
                    Code.ECS104,
                    at,
                    f"no text declares clause {clause}, which {name} cites",
                    f"declare it{near(clause, clauses, ', or cite ')}",
                )
                for clause in cited
                if clause not in clauses
            )
            findings.extend(
                Diagnostic(
                    Code.ECS407,
                    at,
                    f"clause {clause}, which {name} cites, cannot be observed",
                    "cite another clause or give it another level",
                )
                for clause in cited
                if clause in clauses
                and clauses[clause].level is Level.UNOBSERVABLE
                and not isinstance(declaration, Anomaly)
            )
    return findings


def _founded(texts: Iterable[SourceText]) -> Iterator[Diagnostic]:
    """A device text extends the standard, and there is no other."""
    for text in texts:
        if text.extends not in {None, STANDARD}:
            yield Diagnostic(
                Code.ECS106,
                text.at,
                f"there is nothing called `{text.extends}` to extend",
                f"write `extends {STANDARD}`",
            )


def _unreasoned(clauses: Iterable[Clause]) -> Iterator[Diagnostic]:
    """What cannot be observed says why."""
    for clause in clauses:
        if clause.level is Level.UNOBSERVABLE and clause.because is None:
            yield Diagnostic(
                Code.ECS407,
                clause.at,
                f"clause {clause.id} says no reason why it cannot be observed",
                'add `because "..."` at its end',
            )


def unused(texts: Sequence[SourceText]) -> list[Diagnostic]:
    """Clauses that nothing cites and definitions that nothing uses: no error, but a question."""
    declarations = [declaration for text in texts for declaration in text.declarations]
    cited = {c for d in declarations for _, clauses, _ in _citations(d) for c in clauses}
    used = {node.path for d in declarations for node in nodes_in(d) if isinstance(node, Name)}
    return [
        Diagnostic(
            Code.ECS304,
            d.at,
            f"nothing uses {'clause ' + d.id if isinstance(d, Clause) else f'`{d.name}`'}",
            "cite it or take it away",
        )
        for d in declarations
        if (isinstance(d, Clause) and d.id not in cited and d.level is not Level.UNOBSERVABLE)
        or (isinstance(d, Definition) and d.name not in used)
    ]


def _twice(texts: Sequence[SourceText]) -> Iterator[Diagnostic]:
    """Declarations of one kind share one set of names, whatever text they stand in."""
    seen: dict[tuple[str, str], Span] = {}
    for text in texts:
        own = "" if text.extends is None else f"{text.name}: "
        for declaration in text.declarations:
            kind, name = _key(declaration)
            owner = ""
            if isinstance(declaration, (ObjectEntry, CodeTable, Word, *_Statement.__args__)):
                owner = own  # a device text may say these again
            if isinstance(declaration, Extend):
                owner = f"{text.name}: "  # and every text may extend
            key = (kind, owner + name)
            if key in seen:
                yield _again(f"{kind} {name}", declaration.at, seen[key])
            seen.setdefault(key, declaration.at)
            yield from _twice_inside(declaration)


def _again(what: str, at: Span, first: Span, code: Code = Code.ECS102) -> Diagnostic:
    return Diagnostic(code, at, f"{what} stands already at {first}", "take one of them away")


def _key(declaration: Declaration) -> tuple[str, str]:
    match declaration:
        case Clause() | Anomaly():
            key = type(declaration).__name__.lower(), declaration.id
        case Manual():
            key = "manual", declaration.file
        case CodeTable():
            key = "table", declaration.name
        case ObjectEntry():
            key = "object", f"{declaration.index:#06x}:{declaration.subindex}"
        case EsiEntry():
            key = "esi entry", declaration.path
        case Pin():
            key = "pin", declaration.choice
        case Open():
            key = "open choice", declaration.choice
        case Confirm():
            key = (
                "confirmation of",
                ", ".join(f"{kind} {name}" for kind, name in declaration.targets),
            )
        case Close():
            key = "closed", declaration.table
        case SetParameter():
            key = "setting", declaration.name
        case Replace() | Remove():
            key = "change of rule", f"{declaration.machine}.{declaration.rule}"
        case ReplaceField():
            key = "change of field", f"{declaration.frame}.{declaration.name}"
        case Extend():
            key = "extension of machine", declaration.machine
        case Dictionary():
            key = "dictionary", ""
        case (
            Parameter()
            | Register()
            | Word()
            | Frame()
            | Machine()
            | Choice()
            | Condition()
            | Definition()
            | Property()
            | Reason()
            | Example()
            | Fault()
        ):
            key = type(declaration).__name__.lower(), declaration.name
        case _:
            assert_never(declaration)
    return key


def _twice_inside(declaration: Declaration) -> Iterator[Diagnostic]:
    named: list[tuple[str, str, Span]] = []
    match declaration:
        case CodeTable():
            named += [("row", row.name, row.at) for row in declaration.rows]
            named += [("value", f"{row.value:#x}", row.at) for row in declaration.rows]
        case Register() | Word():
            named += [("field", field.name, field.at) for field in declaration.fields]
        case Frame():
            named += [
                ("field", field.name, field.at)
                for field in declaration.fields
                if not field.name.startswith(LAYOUT_WORDS)
            ]
        case Choice():
            named += [("alternative", a.name, a.at) for a in declaration.alternatives]
        case Machine() | Extend():
            named += [("variable", v.name, v.at) for v in declaration.variables]
            named += [("input", item.name, item.at) for item in declaration.inputs]
            if isinstance(declaration, Machine):
                named += [("state", state, declaration.at) for state in declaration.states]
            rows: list[tuple[str, Span]] = [(rule.name, rule.at) for rule in declaration.rules]
            rows += [(gap.name, gap.at) for gap in declaration.gaps]
            first: dict[str, Span] = {}
            for name, at in sorted(rows, key=lambda row: row[1]):
                if name in first:
                    what = f"a rule `{_key(declaration)[1]}.{name}`"
                    yield _again(what, at, first[name], Code.ECS103)
                first.setdefault(name, at)
        case _:
            pass
    seen: dict[tuple[str, str], Span] = {}
    for kind, name, at in named:
        if (kind, name) in seen:
            yield _again(f"{kind} `{name}`", at, seen[kind, name])
        seen.setdefault((kind, name), at)


def _circles(declarations: Iterable[Declaration]) -> Iterator[Diagnostic]:
    """A definition that leads back to itself means nothing."""
    definitions = {d.name: d for d in declarations if isinstance(d, Definition)}
    for definition in definitions.values():
        reached: set[str] = set()
        waiting = [definition.value]
        while waiting:
            for name in names_in(waiting.pop()):
                if name in definitions and name not in reached:
                    reached.add(name)
                    waiting.append(definitions[name].value)
        if definition.name in reached:
            yield Diagnostic(
                Code.ECS101,
                definition.at,
                f"definition `{definition.name}` leads back to itself",
                "write out what it means",
            )


def _in_vain(texts: Sequence[SourceText]) -> Iterator[Diagnostic]:
    """What changes the standard stands in a device text, a fault in a text of faults."""
    for text in texts:
        for declaration in text.declarations:
            kind, name = _key(declaration)
            if isinstance(declaration, Fault) and not (declaration.quirk or declaration.changes):
                yield Diagnostic(
                    Code.ECS402,
                    declaration.at,
                    f"fault {name} is none: it changes nothing",
                    "add a change of a rule or of a field, or a quirk",
                )
            if isinstance(declaration, Fault):
                misplaced, place = not text.faults, "a text that begins with `faults`"
            else:
                statement = isinstance(declaration, _Statement.__args__)
                misplaced = statement and text.extends is None
                misplaced = misplaced and not isinstance(declaration, Dictionary)
                place = "a text that begins with `device`"
                if isinstance(declaration, Extend):
                    misplaced, place = text.faults, "a fault"
            if misplaced:
                yield Diagnostic(
                    Code.ECS402,
                    declaration.at,
                    f"{kind} {name} has no effect in this text",
                    f"write it in {place}",
                )


def _citations(declaration: Declaration) -> Iterator[tuple[str, tuple[str, ...], Span]]:
    """What cites clauses: its name, the clauses, its place."""
    match declaration:
        case Clause() | Manual():
            return
        case CodeTable():
            for row in declaration.rows:
                yield f"row `{row.name}`", row.clauses, row.at
        case Machine() | Extend():
            for rule in declaration.rules:
                yield f"rule `{rule.name}`", rule.clauses, rule.at
            for gap in declaration.gaps:
                yield f"gap `{gap.name}`", gap.clauses, gap.at
        case Register() | Word():
            kind, name = _key(declaration)
            yield f"{kind} `{name}`", declaration.clauses, declaration.at
            for field in declaration.fields:
                yield f"field `{field.name}`", field.clauses, field.at
                if field.shows is not None and (advised := field.shows.advised) is not None:
                    yield f"field `{field.name}`", advised.clauses, field.at
        case Frame():
            yield f"frame {declaration.name}", declaration.clauses, declaration.at
            for part in declaration.fields:
                yield f"field `{part.name}`", part.clauses, part.at
        case Choice():
            yield f"choice {declaration.name}", declaration.clauses, declaration.at
            for way in declaration.alternatives:
                if way.risk is not None:
                    yield f"alternative `{way.name}`", way.risk.clauses, way.at
        case Fault():
            yield f"fault {declaration.name}", declaration.clauses, declaration.at
            for change in declaration.changes:
                yield from _citations(change)
        case _:
            kind, name = _key(declaration)
            yield f"{kind} {name}", declaration.clauses, declaration.at
