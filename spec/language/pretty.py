"""Prints IR as a text that parses to the same IR.

Comments are no part of the IR: this is for showing a specification, not for rewriting files.
"""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, assert_never

from ecatspec.spec.language.ir import (
    Alternative,
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
    Gap,
    Give,
    Input,
    InputKind,
    Later,
    Machine,
    Manual,
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
    Rule,
    Send,
    SetParameter,
    SourceText,
    Word,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ecatspec.spec.language.ir import Declaration, Expression, FrameField, RegisterField, Update

from ecatspec.spec.language.pretty_expressions import (
    DECIMAL,
    WIDTH,
    Line,
    broken_text,
    hex_text,
    ids_text,
    in_columns,
    paragraph_of,
    pretty_expression,
    pretty_type,
    set_text,
    value_of_parameter,
)


def pretty(text: SourceText) -> str:
    """The text as it could have been written, tables in columns, paragraphs in fixed order."""
    head = f'{"faults" if text.faults else "standard"} {text.name} "{text.wording}"'
    if text.extends is not None:
        head = f'device {text.name} extends {text.extends} "{text.wording}"'
    return "\n\n".join((head, *pretty_blocks(text.declarations))) + "\n"


def pretty_blocks(declarations: Iterable[Declaration]) -> list[str]:
    """Declarations as they are written; those of one line under each other."""
    blocks = []
    for kind, group in groupby(declarations, type):
        members = list(group)
        if issubclass(kind, Line):
            blocks.append("\n".join(_lines(members)))
        else:
            blocks.extend("\n".join(_block(member)) for member in members)
    return blocks


def pretty_rule(row: Rule | Gap) -> str:
    """One rule or gap of a machine."""
    return "\n".join(_rule(row))


def _lines(members: Sequence[Declaration]) -> list[str]:
    rows = [_cells(member) for member in members]
    if isinstance(members[0], ObjectEntry):
        return ["objects", *in_columns(rows, "  ")]
    if isinstance(members[0], EsiEntry):
        return ["esi", *in_columns(rows, "  ")]
    if isinstance(members[0], Clause):
        return ["  ".join(filter(None, row)) for row in _padded(rows)]
    return in_columns(rows)


def _padded(rows: Sequence[Sequence[str]]) -> Iterable[Sequence[str]]:
    """Clauses: ids and levels in columns, the long sentences not."""
    first, second = (max(len(row[column]) for row in rows) for column in (0, 1))
    return [(f"{row[0]:<{first}} {row[1]:<{second}} {' '.join(row[2:]).rstrip()}",) for row in rows]


def _cells(member: Declaration) -> tuple[str, ...]:
    match member:
        case Clause(name, level, wording, source, claims, because):
            cited = f"claims {ids_text(claims)}" if claims else ""
            why = "" if because is None else f'because "{because}"'
            return f"clause {name}", level.value, f'"{wording}"', f'source "{source}"', cited, why
        case Manual(file, edition, claims):
            row = f"claims {claims[0]} .. {claims[-1]}" if claims else ""
            return f'manual "{file}"', f'"{edition}"', row
        case Parameter(name, kind, value, clauses):
            word = f": {pretty_type(kind)}"
            return (
                f"parameter {name}",
                word,
                f"= {value_of_parameter(value, kind)}",
                ids_text(clauses),
            )
        case SetParameter(name, value, clauses):
            return f"parameter {name}", f"= {value_of_parameter(value, None)}", ids_text(clauses)
        case ObjectEntry():
            return _object_cells(member)
        case EsiEntry(path, value, clauses):
            shown = f'"{value}"' if isinstance(value, str) else str(value)
            return f'"{path}"', f"= {shown}", ids_text(clauses)
        case Dictionary(closed, clauses):
            return f"dictionary {'closed' if closed else 'open'}", ids_text(clauses)
        case Pin(choice, alternative, clauses):
            return f"pin {choice}", f"= {alternative}", ids_text(clauses)
        case Open(choice, clauses):
            return f"open {choice}", ids_text(clauses)
        case Confirm(targets, clauses):
            named = ", ".join(f"{kind} {name}" for kind, name in targets)
            return f"confirm {named}", ids_text(clauses)
        case Close(table, values, clauses):
            return f"closed {table} {set_text(values)}", ids_text(clauses)
        case Remove(machine, rule, clauses):
            return f"remove rule {machine}.{rule}", ids_text(clauses)
        case _:
            raise TypeError(member)


_MARKS = ("constant", "volatile", "mappable", "fixed", "varying", "stored", "guarded")


def _object_cells(entry: ObjectEntry) -> tuple[str, ...]:
    marks = [word for word in _MARKS if getattr(entry, word)]
    default = entry.default
    if default is not None:
        default = f'= "{default}"' if isinstance(default, str) else f"= {default}"
    return (
        f"{hex_text(entry.index, 4)} : {entry.subindex}",
        entry.name,
        pretty_type(entry.type),
        entry.access.value,
        " ".join(marks),
        f"in {{ {', '.join(entry.states)} }}" if entry.states else "",
        f"readable in {{ {', '.join(entry.read_states)} }}" if entry.read_states else "",
        "" if entry.low is None else f"range {entry.low} .. {entry.high}",
        default or "",
        "" if entry.maps is None else f"maps {entry.maps}",
        ids_text(entry.clauses),
    )


def _block(member: Declaration) -> list[str]:
    match member:
        case CodeTable():
            return _table(member)
        case Register():
            return _register(member)
        case Word():
            return _word(member)
        case Reason():
            return _reason(member)
        case Frame():
            return _frame(member)
        case Machine():
            return _machine(member)
        case Choice(name, wording, alternatives, clauses):
            ways = [(f"| {way.name}", f'"{way.wording}"', _risk(way)) for way in alternatives]
            return [f'choice {name} "{wording}" {ids_text(clauses)}', *in_columns(ways, "  ")]
        case Condition(name, wording, assumed, clauses):
            word = "true" if assumed else "false"
            return [f'condition {name} "{wording}" assumed {word} {ids_text(clauses)}']
        case Definition(name, wording, value, clauses):
            lines = broken_text("    ", "    ", value)
            return [
                f'define {name} "{wording}" =',
                *lines[:-1],
                f"{lines[-1]}  {ids_text(clauses)}",
            ]
        case Property(name, wording, value, clauses):
            lines = broken_text("    ", "    ", value)
            return [
                f'property {name} "{wording}" always',
                *lines[:-1],
                f"{lines[-1]}  {ids_text(clauses)}",
            ]
        case Replace() | Extend() | ReplaceField():
            return _change(member)
        case Fault(name, wording, clauses, quirk, changes):
            lines = [f'fault {name} "{wording}" {ids_text(clauses)}']
            lines += [] if quirk is None else [f"  quirk {quirk}"]
            for change in changes:
                lines += [f"  {line}".rstrip() for line in _change(change)]
            return lines
        case Anomaly(name, subject, printed, normative, treatment, clauses):
            return [
                f"anomaly {name} {subject}",
                f'  printed   "{printed}"',
                f'  normative "{normative}"',
                f'  treatment "{treatment}"  {ids_text(clauses)}'.rstrip(),
            ]
        case Example(name, request, response, clauses):
            return [
                f"example {name} {ids_text(clauses)}",
                f'  request  hex"{request.hex(" ").upper()}"',
                f'  response hex"{response.hex(" ").upper()}"',
            ]
        case _:
            raise TypeError(member)


def _change(member: Replace | Remove | Extend | ReplaceField) -> list[str]:
    match member:
        case Replace():
            lines = [f"replace rule {member.machine}.{member.rule} {ids_text(member.clauses)}"]
            return lines + _paragraphs(member)
        case Remove():
            return ["  ".join(_cells(member)).rstrip()]
        case Extend():
            return [f"extend {member.machine}", *_machine_parts(member)]
        case ReplaceField(frame, name, clauses, reply, into):
            words = (
                f"replace field {frame}.{name} {ids_text(clauses)} reply {pretty_expression(reply)}"
            )
            return [words if into is None else f"{words} into {into}"]
        case _:
            assert_never(member)


def _table(table: CodeTable) -> list[str]:
    decimal = all(row.value < DECIMAL for row in table.rows)
    digits = (table.width + 3) // 4
    rows = [
        (
            str(row.value) if decimal else hex_text(row.value, digits),
            row.name,
            f'"{row.wording}"',
            ids_text(row.clauses),
        )
        for row in table.rows
    ]
    word = "closed" if table.closed else "open"
    return [f"table {table.name} u{table.width} {word}", *in_columns(rows, "  ")]


def _risk(way: Alternative) -> str:
    return "" if way.risk is None else f'risky "{way.risk.wording}" {ids_text(way.risk.clauses)}'


def _register(register: Register) -> list[str]:
    head = (
        f"register {register.name} at {hex_text(register.address, 4)} size {register.size}"
        f" main {register.main} device {register.device} reset {register.reset}"
        f" {ids_text(register.clauses)}"
    )
    return [head.rstrip(), *in_columns([_register_field(f) for f in register.fields], "  ")]


def _word(word: Word) -> list[str]:
    head = f"word {word.name}"
    if word.key is not None:
        head += f" in {hex_text(word.key[0], 4)} : {word.key[1]}"
    head += f" size {word.size} {ids_text(word.clauses)}"
    return [head.rstrip(), *in_columns([_register_field(f) for f in word.fields], "  ")]


def _reason(reason: Reason) -> list[str]:
    head = f'reason {reason.name} of {reason.machine}.{reason.rule} "{reason.wording}"'
    if reason.values:
        head += f" ({', '.join(map(pretty_expression, reason.values))})"
    lines = paragraph_of("when", reason.guard)
    return [head, *lines[:-1], f"{lines[-1]}  {ids_text(reason.clauses)}"]


def _register_field(field: RegisterField) -> tuple[str, ...]:
    shows = ""
    if field.shows is not None:
        shows = f"shows {pretty_expression(field.shows.value)}"
        if field.shows.condition is not None:
            shows += f" when {pretty_expression(field.shows.condition)}"
        if (advised := field.shows.advised) is not None:
            shows += f" should {pretty_expression(advised.value)} {ids_text(advised.clauses)}"
    bits = f"bits {field.low}" + ("" if field.low == field.high else f"..{field.high}")
    return bits, field.name, f": {pretty_type(field.type)}", shows, ids_text(field.clauses)


def _frame(frame: Frame) -> list[str]:
    head = f"frame {frame.name}"
    if frame.parent is not None:
        head += f" in {frame.parent} when {_bindings(frame.conditions)}"
    rows = [_frame_field(field) for field in frame.fields]
    return [f"{head} {ids_text(frame.clauses)}".rstrip(), *in_columns(rows, "  ")]


def _frame_field(field: FrameField) -> tuple[str, str]:
    words = [f": {pretty_type(field.type)}"]
    if field.value is not None:
        words.append(f"= {pretty_expression(field.value)}")
    if field.filled is not None:
        words.append(f"filled {pretty_expression(field.filled)}")
    if field.reply is not None:
        words.append(f"reply {pretty_expression(field.reply)}")
    if field.into is not None:
        words.append(f"into {field.into}")
    if field.clauses:
        words.append(ids_text(field.clauses))
    return field.name, " ".join(words)


def _bindings(bindings: Iterable[tuple[str, Expression]]) -> str:
    return ", ".join(f"{name} = {pretty_expression(value)}" for name, value in bindings)


def _machine(machine: Machine) -> list[str]:
    states = ", ".join(machine.states)
    return [
        f'machine {machine.name} "{machine.wording}"',
        f"  states   {machine.table} {{ {states} }} initial {machine.initial}",
        *_machine_parts(machine),
    ]


def _machine_parts(machine: Machine | Extend) -> list[str]:
    variables = [
        (f"variable {v.name}", f": {pretty_type(v.type)}", f"= {pretty_expression(v.initial)}")
        for v in machine.variables
    ]
    lines = in_columns(variables, "  ")
    lines += in_columns([_input(item) for item in machine.inputs], "  ")
    rows: tuple[Rule | Gap, ...] = (*machine.rules, *machine.gaps)
    for row in sorted(rows, key=lambda row: row.at):
        lines += ["", *(f"  {line}".rstrip() for line in _rule(row))]
    return lines


def _input(item: Input) -> tuple[str, str]:
    if item.kind in {InputKind.EVENT, InputKind.LOCAL, InputKind.OWN}:
        word = "" if item.kind == InputKind.EVENT else f"{item.kind} "
        parameters = ", ".join(f"{name}: {pretty_type(kind)}" for name, kind in item.parameters)
        return f"input    {item.name}", f"{word}({parameters})"
    return f"input    {item.name}", f"from {item.kind} {', '.join(item.origin)}".rstrip()


def _rule(row: Rule | Gap) -> list[str]:
    word = "rule" if isinstance(row, Rule) else "gap"
    lines = [
        f"{word} {row.name} {ids_text(row.clauses)}".rstrip(),
        f"  from   {', '.join(row.sources)} on {row.input}",
    ]
    if isinstance(row, Rule):
        return lines + _paragraphs(row)
    return lines + ([] if row.guard is None else paragraph_of("when", row.guard))


def _paragraphs(row: Rule | Replace) -> list[str]:
    """The paragraphs that a rule and its replacement have, in their fixed order."""
    lines: list[str] = []
    if row.guard is not None:
        lines += paragraph_of("when", row.guard)
    if row.target is not None:
        lines.append(f"  goto   {row.target}")
    if row.updates:
        lines += _updates(row.updates)
    if isinstance(row, Rule):
        for store in row.stores:
            parts = (pretty_expression(p) for p in (store.index, store.subindex, store.value))
            word = "store complete" if store.complete else "store "
            lines.append(f"  {word} {{}} : {{}} = {{}}".format(*parts))
        if row.take is not None:
            lines.append(f"  take   {pretty_expression(row.take)}")
    lines += [_send(send) for send in row.sends]
    lines += [_give(give) for give in row.gives]
    lines += [_later(later) for later in row.laters]
    if row.within is not None:
        lines.append(f"  within {pretty_expression(row.within)}")
    if isinstance(row, Rule) and row.after is not None:
        lines.append("  after")
        lines += [f"  {line}" for line in _updates(row.after.updates)] if row.after.updates else []
        lines += [f"  {_give(give)}" for give in row.after.gives]
    return lines


def _updates(updates: Iterable[Update]) -> list[str]:
    words = [f"{update.variable} = {pretty_expression(update.value)}" for update in updates]
    line = f"  set    {', '.join(words)}"
    return [line] if len(line) <= WIDTH else ["  set    " + ",\n           ".join(words)]


def _send(send: Send) -> str:
    return f"  send   {send.frame}({_bindings(send.fields)})"


def _give(give: Give) -> str:
    if give.target in {"deliver", "resend"}:
        return f"  {give.target}"
    return f"  give   {_event(give)}"


def _later(later: Later) -> str:
    after = "" if later.after is None else f" after {pretty_expression(later.after)}"
    return f"  later  {_event(later)}{after} within {pretty_expression(later.within)}"


def _event(event: Give | Later) -> str:
    return event.target + (f"({_bindings(event.arguments)})" if event.arguments else "")
