"""Prints IR as a text that parses to the same IR.

Comments are no part of the IR: this is for showing a specification, not for rewriting files.
"""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from ecatspec.spec.language.ir import (
    Alternative,
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
    In,
    Input,
    Later,
    Literal,
    Machine,
    Manual,
    Name,
    Named,
    ObjectEntry,
    OneOf,
    Open,
    Parameter,
    Pin,
    Property,
    Range,
    Reason,
    Register,
    Remove,
    Replace,
    ReplaceField,
    Rule,
    Send,
    SetParameter,
    SInt,
    SourceText,
    Text,
    Time,
    Type,
    UInt,
    Unary,
    Word,
)
from ecatspec.spec.language.parse import MICROSECONDS, TIME_DIGITS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ecatspec.spec.language.ir import Declaration, Expression, FrameField, RegisterField, Update

_Line: TypeAlias = (
    Clause
    | Manual
    | Parameter
    | SetParameter
    | ObjectEntry
    | EsiEntry
    | Dictionary
    | Pin
    | Open
    | Confirm
    | Close
    | Remove
)
"""Declarations of one line, which stand under each other without an empty line."""

_WIDTH: Final = 100
_DECIMAL: Final = 16
"""Tables whose values are all below are written in decimal."""

# How tightly an operator binds; what binds looser than its place asks for gets parentheses.
_LOOSEST: Final = 0
_OR: Final = 1
_AND: Final = 2
_NOT: Final = 3
_COMPARISON: Final = 4
_SUM: Final = 5
_PRODUCT: Final = 6
_PREFIX: Final = 7
_ATOM: Final = 8
_BINDING: Final = (
    {"or": _OR, "and": _AND} | dict.fromkeys("+-|&", _SUM) | dict.fromkeys("*/%", _PRODUCT)
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
        if issubclass(kind, _Line):
            blocks.append("\n".join(_lines(members)))
        else:
            blocks.extend("\n".join(_block(member)) for member in members)
    return blocks


def pretty_rule(row: Rule | Gap) -> str:
    """One rule or gap of a machine."""
    return "\n".join(_rule(row))


# --- expressions ---------------------------------------------------------------------------------


def pretty_expression(expression: Expression | Range, place: int = _LOOSEST) -> str:
    """An expression with no more parentheses than its place asks for."""
    words, binding = _expression(expression)
    return words if binding >= place else f"({words})"


def _expression(expression: Expression | Range) -> tuple[str, int]:
    binding = _ATOM
    match expression:
        case Literal(value, digits):
            words = _literal(value, digits)
        case Name(path):
            words = path
        case Unary("not", operand):
            words, binding = f"not {pretty_expression(operand, _NOT)}", _NOT
        case Unary(_, operand):
            words, binding = f"-{pretty_expression(operand, _PREFIX)}", _PREFIX
        case Binary(operator, left, right):
            binding = _BINDING.get(operator, _COMPARISON)
            before = binding + (binding == _COMPARISON)
            one, other = pretty_expression(left, before), pretty_expression(right, binding + 1)
            words = f"{one} {operator} {other}"
        case In(operand, items):
            words, binding = f"{pretty_expression(operand, _SUM)} in {_set(items)}", _COMPARISON
        case Conditional(condition, then, otherwise):
            parts = (pretty_expression(part) for part in (condition, then, otherwise))
            words, binding = "if {} then {} else {}".format(*parts), _LOOSEST
        case Call(function, arguments):
            words = f"{function}({', '.join(map(pretty_expression, arguments))})"
        case OneOf(items, excluded):
            words = f"one of {_set(items)}"
            if excluded is not None:
                words += f" except {pretty_expression(excluded, _PREFIX)}"
        case AnyValue(preferred):
            words = "any"
            if preferred is not None:
                words += f" preferably {pretty_expression(preferred, _PREFIX)}"
        case Range(low, high):
            words = f"{pretty_expression(low)}..{pretty_expression(high)}"
        case _:
            assert_never(expression)
    return words, binding


def _literal(value: int, digits: int) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"0x{value:0{digits}X}" if digits > 0 else str(value)


def _set(items: Iterable[Expression | Range]) -> str:
    words = ", ".join(map(pretty_expression, items))
    return f"{{ {words} }}" if words else "{ }"


def _chain(expression: Expression, operator: str) -> list[Expression]:
    match expression:
        case Binary(own, left, right) if own == operator:
            return [*_chain(left, operator), right]
        case _:
            return [expression]


def _paragraph(word: str, expression: Expression) -> list[str]:
    """A guard; one that is too long for a line is broken at its outermost `and` or `or`."""
    return _broken(f"  {word:<6} ", "         ", expression)


def _broken(start: str, indent: str, expression: Expression) -> list[str]:
    line = start + pretty_expression(expression)
    if len(line) <= _WIDTH or not isinstance(expression, Binary):
        return [line]
    operator = expression.operator
    if operator not in {"and", "or"}:
        return [line]
    first, *rest = _chain(expression, operator)
    binding = _BINDING[operator]
    lines = [start + pretty_expression(first, binding)]
    return lines + [f"{indent}{operator} {pretty_expression(e, binding + 1)}" for e in rest]


# --- small parts ---------------------------------------------------------------------------------


def pretty_type(kind: Type) -> str:
    """A type as it is written after a colon."""
    match kind:
        case UInt(width):
            return f"u{width}"
        case SInt(width):
            return f"i{width}"
        case Bool():
            return "bool"
        case Named(table):
            return table
        case Bytes(length):
            return "bytes" if length is None else f"bytes({pretty_expression(length)})"
        case Text(maximum):
            return f"text({maximum})"
        case Area():
            return "area"
        case Time():
            return "time"
        case _:
            assert_never(kind)


def _ids(clauses: Sequence[str]) -> str:
    return f"[{', '.join(clauses)}]" if clauses else ""


def _parameter_value(value: tuple[Expression, ...], kind: Type | None) -> str:
    match value:
        case (Literal(number, digits),) if digits == TIME_DIGITS or isinstance(kind, Time):
            if not isinstance(number, bool):
                unit = next(u for u in ("s", "ms", "us") if number % MICROSECONDS[u] == 0)
                return f"{number // MICROSECONDS[unit]} {unit}"
        case (start, length):
            return f"area({pretty_expression(start)}, {pretty_expression(length)})"
        case _:
            pass
    return pretty_expression(value[0])


def _columns(rows: Sequence[Sequence[str]], indent: str = "") -> list[str]:
    """Rows of a table, each column as wide as its widest cell."""
    if not rows:
        return []
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = (
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True) if width)
        for row in rows
    )
    return [f"{indent}{line}".rstrip() for line in lines]


def _hex(value: int, digits: int) -> str:
    return f"0x{value:0{digits}X}"


# --- declarations of one line --------------------------------------------------------------------


def _lines(members: Sequence[Declaration]) -> list[str]:
    rows = [_cells(member) for member in members]
    if isinstance(members[0], ObjectEntry):
        return ["objects", *_columns(rows, "  ")]
    if isinstance(members[0], EsiEntry):
        return ["esi", *_columns(rows, "  ")]
    if isinstance(members[0], Clause):
        return ["  ".join(filter(None, row)) for row in _padded(rows)]
    return _columns(rows)


def _padded(rows: Sequence[Sequence[str]]) -> Iterable[Sequence[str]]:
    """Clauses: ids and levels in columns, the long sentences not."""
    first, second = (max(len(row[column]) for row in rows) for column in (0, 1))
    return [(f"{row[0]:<{first}} {row[1]:<{second}} {' '.join(row[2:]).rstrip()}",) for row in rows]


def _cells(member: Declaration) -> tuple[str, ...]:
    match member:
        case Clause(name, level, wording, source, claims, because):
            cited = f"claims {_ids(claims)}" if claims else ""
            why = "" if because is None else f'because "{because}"'
            return f"clause {name}", level.value, f'"{wording}"', f'source "{source}"', cited, why
        case Manual(file, edition, claims):
            row = f"claims {claims[0]} .. {claims[-1]}" if claims else ""
            return f'manual "{file}"', f'"{edition}"', row
        case Parameter(name, kind, value, clauses):
            word = f": {pretty_type(kind)}"
            return f"parameter {name}", word, f"= {_parameter_value(value, kind)}", _ids(clauses)
        case SetParameter(name, value, clauses):
            return f"parameter {name}", f"= {_parameter_value(value, None)}", _ids(clauses)
        case ObjectEntry():
            return _object_cells(member)
        case EsiEntry(path, value, clauses):
            shown = f'"{value}"' if isinstance(value, str) else str(value)
            return f'"{path}"', f"= {shown}", _ids(clauses)
        case Dictionary(closed, clauses):
            return f"dictionary {'closed' if closed else 'open'}", _ids(clauses)
        case Pin(choice, alternative, clauses):
            return f"pin {choice}", f"= {alternative}", _ids(clauses)
        case Open(choice, clauses):
            return f"open {choice}", _ids(clauses)
        case Confirm(targets, clauses):
            named = ", ".join(f"{kind} {name}" for kind, name in targets)
            return f"confirm {named}", _ids(clauses)
        case Close(table, values, clauses):
            return f"closed {table} {_set(values)}", _ids(clauses)
        case Remove(machine, rule, clauses):
            return f"remove rule {machine}.{rule}", _ids(clauses)
        case _:
            raise TypeError(member)


_MARKS = ("constant", "volatile", "mappable", "fixed", "varying", "stored", "guarded")


def _object_cells(entry: ObjectEntry) -> tuple[str, ...]:
    marks = [word for word in _MARKS if getattr(entry, word)]
    default = entry.default
    if default is not None:
        default = f'= "{default}"' if isinstance(default, str) else f"= {default}"
    return (
        f"{_hex(entry.index, 4)} : {entry.subindex}",
        entry.name,
        pretty_type(entry.type),
        entry.access.value,
        " ".join(marks),
        f"in {{ {', '.join(entry.states)} }}" if entry.states else "",
        f"readable in {{ {', '.join(entry.read_states)} }}" if entry.read_states else "",
        "" if entry.low is None else f"range {entry.low} .. {entry.high}",
        default or "",
        "" if entry.maps is None else f"maps {entry.maps}",
        _ids(entry.clauses),
    )


# --- declarations of several lines ---------------------------------------------------------------


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
            return [f'choice {name} "{wording}" {_ids(clauses)}', *_columns(ways, "  ")]
        case Condition(name, wording, assumed, clauses):
            word = "true" if assumed else "false"
            return [f'condition {name} "{wording}" assumed {word} {_ids(clauses)}']
        case Definition(name, wording, value, clauses):
            lines = _broken("    ", "    ", value)
            return [f'define {name} "{wording}" =', *lines[:-1], f"{lines[-1]}  {_ids(clauses)}"]
        case Property(name, wording, value, clauses):
            lines = _broken("    ", "    ", value)
            return [
                f'property {name} "{wording}" always',
                *lines[:-1],
                f"{lines[-1]}  {_ids(clauses)}",
            ]
        case Replace() | Extend() | ReplaceField():
            return _change(member)
        case Fault(name, wording, clauses, quirk, changes):
            lines = [f'fault {name} "{wording}" {_ids(clauses)}']
            lines += [] if quirk is None else [f"  quirk {quirk}"]
            for change in changes:
                lines += [f"  {line}".rstrip() for line in _change(change)]
            return lines
        case Anomaly(name, subject, printed, normative, treatment, clauses):
            return [
                f"anomaly {name} {subject}",
                f'  printed   "{printed}"',
                f'  normative "{normative}"',
                f'  treatment "{treatment}"  {_ids(clauses)}'.rstrip(),
            ]
        case Example(name, request, response, clauses):
            return [
                f"example {name} {_ids(clauses)}",
                f'  request  hex"{request.hex(" ").upper()}"',
                f'  response hex"{response.hex(" ").upper()}"',
            ]
        case _:
            raise TypeError(member)


def _change(member: Replace | Remove | Extend | ReplaceField) -> list[str]:
    match member:
        case Replace():
            lines = [f"replace rule {member.machine}.{member.rule} {_ids(member.clauses)}"]
            return lines + _paragraphs(member)
        case Remove():
            return ["  ".join(_cells(member)).rstrip()]
        case Extend():
            return [f"extend {member.machine}", *_machine_parts(member)]
        case ReplaceField(frame, name, clauses, reply, into):
            words = f"replace field {frame}.{name} {_ids(clauses)} reply {pretty_expression(reply)}"
            return [words if into is None else f"{words} into {into}"]
        case _:
            assert_never(member)


def _table(table: CodeTable) -> list[str]:
    decimal = all(row.value < _DECIMAL for row in table.rows)
    digits = (table.width + 3) // 4
    rows = [
        (
            str(row.value) if decimal else _hex(row.value, digits),
            row.name,
            f'"{row.wording}"',
            _ids(row.clauses),
        )
        for row in table.rows
    ]
    word = "closed" if table.closed else "open"
    return [f"table {table.name} u{table.width} {word}", *_columns(rows, "  ")]


def _risk(way: Alternative) -> str:
    return "" if way.risk is None else f'risky "{way.risk.wording}" {_ids(way.risk.clauses)}'


def _register(register: Register) -> list[str]:
    head = (
        f"register {register.name} at {_hex(register.address, 4)} size {register.size}"
        f" main {register.main} device {register.device} reset {register.reset}"
        f" {_ids(register.clauses)}"
    )
    return [head.rstrip(), *_columns([_register_field(f) for f in register.fields], "  ")]


def _word(word: Word) -> list[str]:
    head = f"word {word.name}"
    if word.key is not None:
        head += f" in {_hex(word.key[0], 4)} : {word.key[1]}"
    head += f" size {word.size} {_ids(word.clauses)}"
    return [head.rstrip(), *_columns([_register_field(f) for f in word.fields], "  ")]


def _reason(reason: Reason) -> list[str]:
    head = f'reason {reason.name} of {reason.machine}.{reason.rule} "{reason.wording}"'
    if reason.values:
        head += f" ({', '.join(map(pretty_expression, reason.values))})"
    lines = _paragraph("when", reason.guard)
    return [head, *lines[:-1], f"{lines[-1]}  {_ids(reason.clauses)}"]


def _register_field(field: RegisterField) -> tuple[str, ...]:
    shows = ""
    if field.shows is not None:
        shows = f"shows {pretty_expression(field.shows.value)}"
        if field.shows.condition is not None:
            shows += f" when {pretty_expression(field.shows.condition)}"
        if (advised := field.shows.advised) is not None:
            shows += f" should {pretty_expression(advised.value)} {_ids(advised.clauses)}"
    bits = f"bits {field.low}" + ("" if field.low == field.high else f"..{field.high}")
    return bits, field.name, f": {pretty_type(field.type)}", shows, _ids(field.clauses)


def _frame(frame: Frame) -> list[str]:
    head = f"frame {frame.name}"
    if frame.parent is not None:
        head += f" in {frame.parent} when {_bindings(frame.conditions)}"
    rows = [_frame_field(field) for field in frame.fields]
    return [f"{head} {_ids(frame.clauses)}".rstrip(), *_columns(rows, "  ")]


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
        words.append(_ids(field.clauses))
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
    lines = _columns(variables, "  ")
    lines += _columns([_input(item) for item in machine.inputs], "  ")
    rows: tuple[Rule | Gap, ...] = (*machine.rules, *machine.gaps)
    for row in sorted(rows, key=lambda row: row.at):
        lines += ["", *(f"  {line}".rstrip() for line in _rule(row))]
    return lines


def _input(item: Input) -> tuple[str, str]:
    if item.kind in {"event", "local", "own"}:
        word = "" if item.kind == "event" else f"{item.kind} "
        parameters = ", ".join(f"{name}: {pretty_type(kind)}" for name, kind in item.parameters)
        return f"input    {item.name}", f"{word}({parameters})"
    return f"input    {item.name}", f"from {item.kind} {', '.join(item.origin)}".rstrip()


def _rule(row: Rule | Gap) -> list[str]:
    word = "rule" if isinstance(row, Rule) else "gap"
    lines = [
        f"{word} {row.name} {_ids(row.clauses)}".rstrip(),
        f"  from   {', '.join(row.sources)} on {row.input}",
    ]
    if isinstance(row, Rule):
        return lines + _paragraphs(row)
    return lines + ([] if row.guard is None else _paragraph("when", row.guard))


def _paragraphs(row: Rule | Replace) -> list[str]:
    """The paragraphs that a rule and its replacement have, in their fixed order."""
    lines: list[str] = []
    if row.guard is not None:
        lines += _paragraph("when", row.guard)
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
    return [line] if len(line) <= _WIDTH else ["  set    " + ",\n           ".join(words)]


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
