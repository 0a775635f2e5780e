"""The only place for finding out whether texts make sense: names, kinds of values, meaning."""

from __future__ import annotations

import difflib
from collections import Counter
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from ecatspec.spec.language.diagnostics import Code, Diagnostic
from ecatspec.spec.language.ir import (
    Access,
    Anomaly,
    AnyValue,
    Area,
    Binary,
    Bool,
    Bytes,
    Call,
    Choice,
    Clause,
    Close,
    CodeTable,
    Condition,
    Conditional,
    Definition,
    Dictionary,
    Example,
    Extend,
    Fault,
    Frame,
    Gap,
    In,
    Literal,
    Machine,
    Manual,
    Name,
    Named,
    ObjectEntry,
    OneOf,
    Parameter,
    Pin,
    Property,
    Range,
    Register,
    Remove,
    Replace,
    ReplaceField,
    Rule,
    SetParameter,
    SInt,
    Span,
    Text,
    Time,
    Type,
    UInt,
    Unary,
)
from ecatspec.spec.language.overlap import meaning
from ecatspec.spec.language.parse import TIME_DIGITS
from ecatspec.spec.language.scope import (
    COMPARISONS,
    FUNCTIONS,
    REPLY,
    ChoiceRef,
    ConstantRef,
    DefinitionRef,
    Kind,
    Scope,
    UnresolvedName,
    VariableRef,
    bounds_of,
    expectation,
    frame_chain,
    frame_fields,
    input_of,
    kind_of,
    kind_of_ref,
    known_names,
    names_in,
    resolve,
    width_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from ecatspec.spec.language.ir import (
        After,
        Declaration,
        Expression,
        Give,
        Protocol,
        Send,
        SourceText,
        Update,
    )

_LAYOUT_WORDS: Final = ("reserved", "padding", "data")
"""Names that several frames around each other may use: nobody refers to them."""

_Statement: TypeAlias = (
    Pin | Close | SetParameter | Replace | Remove | Extend | ReplaceField | Dictionary
)
_BITS: Final = 8
_REPLY: Final = f"{REPLY}."


def check_texts(texts: Sequence[SourceText]) -> list[Diagnostic]:
    """What is wrong with the texts before they are put together: said twice, cited, not cited."""
    declarations = [declaration for text in texts for declaration in text.declarations]
    declared = {clause.id for clause in declarations if isinstance(clause, Clause)}
    findings = [*_twice(texts), *_circles(declarations), *_in_vain(texts)]
    for declaration in declarations:
        for name, clauses, at in _citations(declaration):
            if not clauses and name.startswith(("rule", "gap")):
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
                    f"declare it{_near(clause, declared, ', or cite ')}",
                )
                for clause in clauses
                if clause not in declared
            )
    return findings


def check_protocol(protocol: Protocol) -> list[Diagnostic]:
    """What is wrong with texts put together: the findings of the first phase that has any."""
    if found := check_words(protocol):
        return found
    checker = _Checker(protocol)
    checker.objects()
    return [*checker.of_phase("4"), *meaning(protocol)]


def check_words(protocol: Protocol) -> list[Diagnostic]:
    """What is wrong with names and kinds of values; a planted fault may mean what it likes."""
    checker = _Checker(protocol)
    checker.structure()
    checker.expressions()
    return checker.of_phase("1") or checker.of_phase("2")


def _near(name: str, known: Iterable[str], before: str = "; did you mean ") -> str:
    near = difflib.get_close_matches(name, sorted(set(known)), 1, 0.6)
    return f"{before}`{near[0]}`" if near else ""


def unused(texts: Sequence[SourceText]) -> list[Diagnostic]:
    """Clauses that nothing cites and definitions that nothing uses: no error, but a question."""
    declarations = [declaration for text in texts for declaration in text.declarations]
    cited = {c for d in declarations for _, clauses, _ in _citations(d) for c in clauses}
    used = {name for d in declarations for name in _names_used(d)}
    return [
        Diagnostic(
            Code.ECS304,
            d.at,
            f"nothing uses {'clause ' + d.id if isinstance(d, Clause) else f'`{d.name}`'}",
            "cite it or take it away",
        )
        for d in declarations
        if (isinstance(d, Clause) and d.id not in cited)
        or (isinstance(d, Definition) and d.name not in used)
    ]


def _names_used(node: object) -> Iterator[str]:
    """All names in the expressions of a declaration, wherever they stand in it."""
    if isinstance(node, Name):
        yield node.path
    elif isinstance(node, tuple):
        for part in node:
            yield from _names_used(part)
    elif is_dataclass(node):
        for field in fields(node):
            yield from _names_used(getattr(node, field.name))


# --- before the merge ----------------------------------------------------------------------------


def _twice(texts: Sequence[SourceText]) -> Iterator[Diagnostic]:
    """Declarations of one kind share one set of names, whatever text they stand in."""
    seen: dict[tuple[str, str], Span] = {}
    for text in texts:
        owner = "" if text.extends is None else f"{text.name}: "
        for declaration in text.declarations:
            kind, name = _key(declaration)
            local = isinstance(
                declaration, (ObjectEntry, CodeTable, *_Statement.__args__)
            )  # a device text may say these again
            key = (kind, owner + name if local else name)
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
        case Pin():
            key = "pin", declaration.choice
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
            | Frame()
            | Machine()
            | Choice()
            | Condition()
            | Definition()
            | Property()
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
        case Register():
            named += [("field", field.name, field.at) for field in declaration.fields]
        case Frame():
            named += [
                ("field", field.name, field.at)
                for field in declaration.fields
                if not field.name.startswith(_LAYOUT_WORDS)
            ]
        case Choice():
            named += [("alternative", a.name, declaration.at) for a in declaration.alternatives]
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
        case Register():
            yield f"register `{declaration.name}`", declaration.clauses, declaration.at
            for field in declaration.fields:
                yield f"field `{field.name}`", field.clauses, field.at
        case Fault():
            yield f"fault {declaration.name}", declaration.clauses, declaration.at
            for change in declaration.changes:
                yield from _citations(change)
        case _:
            kind, name = _key(declaration)
            yield f"{kind} {name}", declaration.clauses, declaration.at


# --- after the merge -----------------------------------------------------------------------------


class _Checker:
    """Walks over a whole Protocol and notes what is wrong."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._found: dict[Diagnostic, None] = {}

    def of_phase(self, phase: str) -> list[Diagnostic]:
        """The findings whose code begins with this digit."""
        return [d for d in self._found if d.code.name[len("ECS")] == phase]

    def _note(self, code: Code, at: Span, message: str, remedy: str) -> None:
        self._found[Diagnostic(code, at, message, remedy)] = None

    def _missing(self, kind: str, name: str, known: Iterable[str], at: Span) -> None:
        names = sorted(set(known))
        remedy = f"declare it{_near(name, names, ', or write ')}"
        self._note(Code.ECS106, at, f"there is no {kind} `{name}`", remedy)

    # --- structure: what must exist, what must fit ---

    def structure(self) -> None:
        """Check everything that is no expression."""
        for table in self._protocol.tables.values():
            self._table(table)
        for parameter in self._protocol.parameters.values():
            self._type(parameter.type, parameter.at)
        for register in self._protocol.registers.values():
            self._register(register)
        for frame in self._protocol.frames.values():
            self._frame(frame)
        for machine in self._protocol.machines.values():
            self._machine(machine)

    def _table(self, table: CodeTable) -> None:
        for row in table.rows:
            if row.value >> table.width:
                self._note(
                    Code.ECS201,
                    row.at,
                    f"{row.value:#x} does not fit the {table.width} bits of `{table.name}`",
                    "make the table wider or the value smaller",
                )

    def _type(self, kind: Type, at: Span) -> None:
        if isinstance(kind, Named) and kind.table not in self._protocol.tables:
            self._missing("table", kind.table, self._protocol.tables, at)
        if isinstance(kind, UInt | SInt) and not kind.width:
            self._note(Code.ECS201, at, "a number of no bits", "give it at least one bit")

    def _register(self, register: Register) -> None:
        bits = register.size * _BITS
        if register.reset >> bits:
            self._note(
                Code.ECS201,
                register.at,
                f"the reset value does not fit the {bits} bits of `{register.name}`",
                "make it smaller",
            )
        taken: dict[int, str] = {}
        for field in register.fields:
            self._type(field.type, field.at)
            span = range(field.low, field.high + 1)
            if field.high >= bits or not span:
                self._note(
                    Code.ECS201,
                    field.at,
                    f"bits {field.low}..{field.high} are not in the {bits} bits of"
                    f" `{register.name}`",
                    f"stay between 0 and {bits - 1}, low bit first",
                )
            others = sorted({taken[bit] for bit in span if bit in taken})
            if others:
                self._note(
                    Code.ECS201,
                    field.at,
                    f"`{field.name}` takes bits of `{others[0]}`",
                    "move one of them",
                )
            taken |= dict.fromkeys(span, field.name)
            width = width_of(self._protocol, field.type)
            if width is not None and span and width != len(span):
                self._note(
                    Code.ECS201,
                    field.at,
                    f"`{field.name}` has {len(span)} bits and a type of {width}",
                    "make them equal",
                )

    def _frame(self, frame: Frame) -> None:
        parent = None if frame.parent is None else self._protocol.frames.get(frame.parent)
        if frame.parent is not None and parent is None:
            self._missing("frame", frame.parent, self._protocol.frames, frame.at)
        chain = list(frame_chain(self._protocol, frame.name))
        if parent is not None and self._protocol.frames[chain[-1]].parent is not None:
            self._note(Code.ECS204, frame.at, f"`{frame.name}` lies in itself", "break the circle")
            return
        if parent is not None and not (parent.fields and isinstance(parent.fields[-1].type, Bytes)):
            self._note(
                Code.ECS204,
                frame.at,
                f"`{parent.name}` has no bytes at its end that `{frame.name}` could lie in",
                "give it a last field of type bytes",
            )
        outer = {
            field.name: name for name in chain[1:] for field in self._protocol.frames[name].fields
        }
        for field in frame.fields:
            if field.name in outer and not field.name.startswith(_LAYOUT_WORDS):
                self._note(
                    Code.ECS204,
                    field.at,
                    f"`{field.name}` is a field of `{outer[field.name]}` around it already",
                    "give it another name",
                )
        self._layout(frame)
        fields = {} if parent is None else frame_fields(self._protocol, parent.name)
        for name, _ in frame.conditions:
            if parent is not None and name not in fields:
                self._missing(f"field of `{parent.name}`", name, fields, frame.at)

    def _layout(self, frame: Frame) -> None:
        bits: int | None = 0
        for position, field in enumerate(frame.fields):
            self._type(field.type, field.at)
            width = width_of(self._protocol, field.type)
            if isinstance(field.type, Bytes):
                if field.type.length is None and position + 1 < len(frame.fields):
                    self._note(
                        Code.ECS204,
                        field.at,
                        f"`{field.name}` takes all bytes, and `{frame.fields[-1].name}` follows",
                        "say how many bytes it has: bytes(n)",
                    )
                if bits is not None and bits % _BITS:
                    self._note(
                        Code.ECS204,
                        field.at,
                        f"`{field.name}` begins at bit {bits}, in the middle of a byte",
                        "add a reserved field before it",
                    )
                bits = 0
            elif width is None:
                if not isinstance(field.type, Named):
                    self._note(
                        Code.ECS204,
                        field.at,
                        f"`{field.name}` has no place in a frame with this type",
                        "take a number, bool, a table or bytes",
                    )
                bits = None
            elif bits is not None:
                bits += width
        if bits is not None and bits % _BITS:
            self._note(
                Code.ECS204,
                frame.at,
                f"the fields of `{frame.name}` end in the middle of a byte",
                "add a reserved field",
            )

    def _machine(self, machine: Machine) -> None:
        table = self._protocol.tables.get(machine.table)
        if table is None:
            self._missing("table", machine.table, self._protocol.tables, machine.at)
        else:
            rows = [row.name for row in table.rows]
            for state in machine.states:
                if state not in rows:
                    self._missing(f"row of table `{table.name}`", state, rows, machine.at)
        self._states(machine, (machine.initial,), machine.at)
        for variable in machine.variables:
            self._type(variable.type, variable.at)
        for item in machine.inputs:
            known = list(self._protocol.registers)
            if item.kind == "frame":
                known = list(self._protocol.frames)
            for origin in item.origin:
                if origin not in known:
                    kind = "frame" if item.kind == "frame" else "register"
                    self._missing(kind, origin, known, item.at)
            for _, kind_of_parameter in item.parameters:
                self._type(kind_of_parameter, item.at)
        rules_and_gaps: tuple[Rule | Gap, ...] = (*machine.rules, *machine.gaps)
        for row in rules_and_gaps:
            self._states(machine, row.sources, row.at)
            inputs = [item.name for item in machine.inputs]
            if row.input not in inputs:
                self._missing("input", row.input, inputs, row.at)
        for rule in machine.rules:
            if rule.target is not None:
                self._states(machine, (rule.target,), rule.at)

    def _states(self, machine: Machine, states: Iterable[str], at: Span) -> None:
        for state in states:
            if state not in machine.states:
                self._missing(f"state of `{machine.name}`", state, machine.states, at)

    # --- expressions: where they stand and what is expected there ---

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
            for field in register.fields:
                if field.shows is not None:
                    self._demand(field.shows.value, nowhere, field.type)
                    if field.shows.condition is not None:
                        self._demand(field.shows.condition, nowhere, Bool())
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

    def _variable(self, path: str, scope: Scope, at: Span) -> Kind | None:
        """The kind of the variable that is to be set."""
        own = self._protocol.machines.get(scope.machine or "")
        if own is not None:
            for variable in own.variables:
                if variable.name == path:
                    return variable.type
        try:
            ref = resolve(self._protocol, path, Scope()) if "." in path else None
        except UnresolvedName:
            ref = None
        if isinstance(ref, VariableRef):
            return kind_of_ref(self._protocol, ref, Scope())
        known = [] if own is None else [variable.name for variable in own.variables]
        self._note(
            Code.ECS101,
            at,
            f"`{path}` is no variable that can be set",
            f"declare it as a variable{_near(path, known, ', or write ')}",
        )
        return None

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
        for send in rule.sends:
            self._send(send, scope)
        self._gives(rule.gives, scope)
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
                if (found := input_of(self._protocol, scope)) is None or found.kind in {
                    "event",
                    "local",
                }:
                    self._note(
                        Code.ECS202,
                        give.at,
                        "there is no frame that could be delivered",
                        "deliver in rules on a write or a frame",
                    )
                continue
            name, _, event = give.target.partition(".")
            other = self._protocol.machines.get(name)
            inputs = {} if other is None else {i.name: i for i in other.inputs if i.kind == "event"}
            if event not in inputs:
                self._missing("event", give.target, (f"{name}.{i}" for i in inputs), give.at)
                continue
            self._bindings(
                give.arguments, dict(inputs[event].parameters), scope, give.target, give.at
            )
            for parameter, _ in inputs[event].parameters:
                if parameter not in dict(give.arguments):
                    what = f"`{give.target}` gets no `{parameter}`"
                    self._note(Code.ECS203, give.at, what, f"write {parameter} = ...")

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
                    f"name one of its own{_near(name, types)}",
                )
            self._demand(value, scope, types.get(name))

    # --- kinds of values ---

    def _demand(self, value: Expression, scope: Scope, expected: Kind | None) -> None:
        """The expression must give a value of this kind, whatever the kind if None."""
        self._compatible(self._walk(value, scope, expected), expected, value.at)

    def _compatible(self, found: Kind | None, expected: Kind | None, at: Span) -> bool:
        if found is None or expected is None or _agree(found, expected):
            return True
        self._note(
            Code.ECS202,
            at,
            f"{_word(found)} stands where {_word(expected)} is needed",
            "compare and set values of one kind",
        )
        return False

    def _walk(self, value: Expression, scope: Scope, expected: Kind | None) -> Kind | None:
        """The kind of a value; everything inside it is checked."""
        found: Kind | None = None
        match value:
            case Literal():
                found = self._literal(value, value.value, expected)
            case Name():
                found = self._name(value, scope, expected)
            case Unary("-", Literal() as literal):
                found = self._literal(literal, -literal.value, expected)
            case Unary(operator, operand):
                found = Bool() if operator == "not" else _NUMBER
                self._demand(operand, scope, found)
            case Binary(operator, left, right) if operator in COMPARISONS:
                self._compare(operator, left, right, scope)
                found = Bool()
            case Binary(operator, left, right):
                found = Bool() if operator in {"and", "or"} else _NUMBER
                self._demand(left, scope, found)
                self._demand(right, scope, found)
            case In(operand, items):
                kind = self._walk(operand, scope, None)
                self._items(items, scope, kind)
                found = Bool()
            case Conditional(condition, then, otherwise):
                self._demand(condition, scope, Bool())
                found = self._walk(then, scope, expected)
                other = self._walk(otherwise, scope, expected)
                self._compatible(other, found, otherwise.at)
                found = found or other
            case Call():
                found = self._call(value, scope)
            case OneOf(items, excluded):
                self._items(items, scope, expected)
                if excluded is not None:
                    self._demand(excluded, scope, expected)
            case AnyValue(preferred):
                if preferred is not None:
                    self._demand(preferred, scope, expected)
            case _:
                assert_never(value)
        return found

    def _literal(self, literal: Literal, value: int, expected: Kind | None) -> Kind | None:
        if isinstance(literal.value, bool):
            return Bool()
        if literal.digits == TIME_DIGITS:
            return Time()
        self._fits(value, expected, literal.at)
        return _NUMBER

    def _fits(self, value: int, expected: Kind | None, at: Span) -> None:
        if expected is None or expected == _NUMBER or isinstance(expected, Bool):
            return
        bounds = bounds_of(self._protocol, expected)
        if bounds is not None and not bounds[0] <= value <= bounds[1]:
            self._note(
                Code.ECS201,
                at,
                f"{value} does not fit {_word(expected)} ({bounds[0]}..{bounds[1]})",
                "take a value that fits or a wider type",
            )
        elif (
            isinstance(expected, Named)
            and (table := self._protocol.tables.get(expected.table)) is not None
            and table.closed
            and value not in {row.value for row in table.rows}
        ):
            self._note(
                Code.ECS201,
                at,
                f"the closed table `{table.name}` has no value {value:#x}",
                "take one of its rows",
            )

    def _name(self, name: Name, scope: Scope, expected: Kind | None) -> Kind | None:
        try:
            ref = resolve(self._protocol, name.path, scope, expected)
        except UnresolvedName as error:
            self._unresolved(name, error, scope, expected)
            return None
        if isinstance(ref, DefinitionRef):
            return self._walk(self._protocol.definitions[ref.name].value, scope, expected)
        if isinstance(ref, ConstantRef) and not isinstance(expected, Named):
            self._fits(ref.value, expected, name.at)
        return kind_of_ref(self._protocol, ref, scope)

    def _unresolved(
        self, name: Name, error: UnresolvedName, scope: Scope, expected: Kind | None
    ) -> None:
        if error.candidates:
            rows = " or ".join(f"`{candidate}`" for candidate in error.candidates)
            what = f"`{name.path}` is a row of several tables"
            self._note(Code.ECS107, name.at, what, f"write {rows}")
            return
        if isinstance(expected, Named) and expected.table not in self._protocol.tables:
            return  # that the table is missing is the finding
        known = known_names(self._protocol, scope, expected)
        where = f" in rules on `{scope.input}`" if scope.input is not None else ""
        self._note(
            Code.ECS101,
            name.at,
            f"`{name.path}` means nothing{where}",
            f"declare it{_near(name.path, known, ', or write ')}",
        )

    def _compare(self, operator: str, left: Expression, right: Expression, scope: Scope) -> None:
        protocol = self._protocol
        of_left = expectation(protocol, right, scope) or kind_of(protocol, right, scope)
        of_right = expectation(protocol, left, scope) or kind_of(protocol, left, scope)
        if isinstance(right, Name) and of_left is None:
            of_left = kind_of(protocol, right, scope, of_right)
        if isinstance(left, Name) and of_right is None:
            of_right = kind_of(protocol, left, scope, of_left)
        kind = self._walk(left, scope, of_left)
        other = self._walk(right, scope, of_right)
        if self._compatible(other, kind, right.at) and operator not in {"==", "!="}:
            for side in (kind, other):
                if side is not None and not isinstance(side, UInt | SInt | Named | Time):
                    what = f"{_word(side)} has no order"
                    self._note(Code.ECS202, left.at, what, "compare with == or !=")
                    break

    def _items(
        self, items: Iterable[Expression | Range], scope: Scope, expected: Kind | None
    ) -> None:
        for item in items:
            if not isinstance(item, Range):
                self._demand(item, scope, expected)
                continue
            self._demand(item.low, scope, expected)
            self._demand(item.high, scope, expected)
            match item:
                case Range(Literal(low), Literal(high)) if low > high:
                    what = f"there is no number from {low} to {high}"
                    self._note(Code.ECS201, item.at, what, "write the smaller one first")
                case _:
                    pass

    def _call(self, call: Call, scope: Scope) -> Kind | None:
        signature = FUNCTIONS.get(call.function)
        if signature is None:
            self._note(
                Code.ECS101,
                call.at,
                f"there is no function `{call.function}`",
                f"take one of scope.FUNCTIONS{_near(call.function, FUNCTIONS)}",
            )
            return None
        wanted = ", ".join(_word(kind) for kind in signature.arguments)
        remedy = f"write {call.function}({wanted})"
        if len(call.arguments) != len(signature.arguments):
            what = f"`{call.function}` gets {len(call.arguments)} arguments"
            self._note(Code.ECS203, call.at, what, remedy)
        for argument, kind in zip(call.arguments, signature.arguments, strict=False):
            found = self._walk(argument, scope, kind)
            if found is not None and not _agree(found, kind):
                what = f"`{call.function}` gets {_word(found)} for {_word(kind)}"
                self._note(Code.ECS203, argument.at, what, remedy)
        return signature.result

    # --- objects ---

    def objects(self) -> None:
        """The range, the default and the type of an object must agree, and its states exist."""
        rows = {row.name for table in self._protocol.tables.values() for row in table.rows}
        for entry in self._protocol.objects:
            what = f"object {entry.index:#06x}:{entry.subindex} `{entry.name}`"
            for state in (*entry.states, *entry.read_states):
                if state not in rows:
                    self._missing("state", state, rows, entry.at)
            problem = self._problem(entry)
            if problem is not None:
                self._note(Code.ECS405, entry.at, f"{what}: {problem}", "correct the row")

    def _problem(self, entry: ObjectEntry) -> str | None:
        numbers = [n for n in (entry.low, entry.high, entry.default) if isinstance(n, int)]
        if isinstance(entry.type, Text | Bytes):
            most = entry.type.maximum if isinstance(entry.type, Text) else entry.type.length
            if isinstance(most, Literal):
                most = most.value
            if not isinstance(most, int) or isinstance(most, bool):
                return "the length of bytes is no number"
            if numbers:
                return "a text has no number"
            if len(str(entry.default or "").encode()) > most:
                return f"the default is longer than {most} bytes"
            return None
        bounds = bounds_of(self._protocol, entry.type)
        if isinstance(entry.default, str) or bounds is None:
            return "a number has no text"
        if any(not bounds[0] <= number <= bounds[1] for number in numbers):
            return f"a value is not in {bounds[0]}..{bounds[1]}, the numbers of its type"
        low = bounds[0] if entry.low is None else entry.low
        high = bounds[1] if entry.high is None else entry.high
        if low > high:
            return f"the range {low}..{high} is empty"
        if isinstance(entry.default, int) and not low <= entry.default <= high:
            return f"the default {entry.default} is not in the range {low}..{high}"
        if entry.index >> 16 or entry.subindex >> 8:
            return "index or subindex is too great"
        if entry.access is Access.NONE:
            return "nobody can read or write it"
        return None


_NUMBER: Final = UInt(64)


def _agree(one: Kind, other: Kind) -> bool:
    """Whether values of two kinds may meet: tables with themselves and with plain numbers."""
    match one, other:
        case (Named(), Named()) | (ChoiceRef(), ChoiceRef()):
            return one == other
        case (UInt() | SInt() | Named(), UInt() | SInt() | Named()):
            return True
        case (Bytes() | Text(), Bytes() | Text()):
            return True
        case _:
            return type(one) is type(other)


def _word(kind: Kind) -> str:
    match kind:
        case UInt(width):
            return "a number" if kind == _NUMBER else f"u{width}"
        case SInt(width):
            return f"i{width}"
        case Bool():
            return "bool"
        case Named(table):
            return f"a value of `{table}`"
        case Bytes():
            return "bytes"
        case Text():
            return "a text"
        case Area():
            return "an area"
        case Time():
            return "a time"
        case ChoiceRef(name):
            return f"a way at `{name}`"
        case _:
            assert_never(kind)
