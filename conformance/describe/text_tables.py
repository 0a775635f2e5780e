"""Sets a specification in tables of words."""

from __future__ import annotations

from typing import TYPE_CHECKING, assert_never

from ecatspec.conformance.base.devices import nearest
from ecatspec.conformance.render.tables import Cell, Sheet
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.functions import AREA_PARTS
from ecatspec.spec.language.ir import (
    Area,
    Binary,
    Call,
    Conditional,
    Extend,
    In,
    Literal,
    Name,
    OneOf,
    Remove,
    Replace,
    ReplaceField,
    Time,
    Unary,
)
from ecatspec.spec.language.load import load_faults
from ecatspec.spec.language.pretty_expressions import pretty_expression, pretty_type

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ecatspec.model.core.process_image import ProcessImage
    from ecatspec.spec.language.ir import (
        CodeTable,
        Expression,
        Give,
        Later,
        Machine,
        ObjectEntry,
        Parameter,
        Protocol,
        Range,
        Register,
        Rule,
        Word,
    )


_MICROSECONDS = 1_000_000


def sheets(protocol: Protocol) -> tuple[Sheet, ...]:
    """Give everything about a device that a reader looks up, without the rules."""
    tables = (_codes(table) for table in protocol.tables.values())
    every = (
        _manuals(protocol),
        _memory(protocol),
        _parameters(protocol),
        _machines(protocol),
        _choices(protocol),
        _risks(protocol),
        _conditions(protocol),
        _properties(protocol),
        *tables,
        _objects(protocol),
        _esi(protocol),
        _words(protocol),
        _process_data(protocol),
        _changes(protocol),
        _anomalies(protocol),
        _examples(protocol),
    )
    return tuple(sheet for sheet in every if sheet.rows)


def machine_sheets(protocol: Protocol, name: str) -> tuple[Sheet, ...]:
    """Give one machine: states, variables, rules, and the definitions that its guards use."""
    machine = protocol.machines.get(name)
    if machine is None:
        raise nearest("machine", name, sorted(protocol.machines))
    states = {row.name: row for row in protocol.tables[machine.table].rows}
    every = (
        Sheet(
            "states",
            f"machine {name}: {machine.wording}",
            ("state", "value", "meaning", "rules"),
            tuple(
                (
                    state + (" (initial)" if state == machine.initial else ""),
                    states[state].value if state in states else "",
                    states[state].wording if state in states else "",
                    sum(state in rule.sources for rule in machine.rules),
                )
                for state in machine.states
            ),
        ),
        Sheet(
            "variables",
            "variables",
            ("name", "type", "after power-on"),
            tuple(
                (variable.name, pretty_type(variable.type), pretty_expression(variable.initial))
                for variable in machine.variables
            ),
        ),
        Sheet(
            "rules",
            f"rules of {name}",
            ("rule", "from", "input", "guard", "to", "does", "clauses"),
            tuple(_rule(rule) for rule in machine.rules),
        ),
        Sheet(
            "gaps",
            "the texts say nothing about",
            ("gap", "from", "input", "guard", "clauses"),
            tuple(
                (gap.name, gap.sources, gap.input, _guard(gap.guard), gap.clauses)
                for gap in machine.gaps
            ),
        ),
        _definitions(protocol, machine),
    )
    return tuple(sheet for sheet in every if sheet.rows)


def _guard(guard: Expression | None) -> str:
    return "" if guard is None else pretty_expression(guard)


def _bindings(pairs: Sequence[tuple[str, Expression]]) -> str:
    return ", ".join(f"{name} = {pretty_expression(value)}" for name, value in pairs)


def _rule(rule: Rule) -> tuple[Cell, ...]:
    effects = [f"{update.variable} = {pretty_expression(update.value)}" for update in rule.updates]
    for store in rule.stores:
        place = f"{pretty_expression(store.index)} : {pretty_expression(store.subindex)}"
        word = "store complete" if store.complete else "store"
        effects.append(f"{word} {place} = {pretty_expression(store.value)}")
    if rule.take is not None:
        effects.append(f"take {pretty_expression(rule.take)}")
    effects += [f"send {send.frame}({_bindings(send.fields)})" for send in rule.sends]
    effects += [_gift(give) for give in rule.gives]
    effects += [_later(later) for later in rule.laters]
    if rule.within is not None:
        effects.append(f"within {pretty_expression(rule.within)}")
    if rule.after is not None:
        effects += [f"then {u.variable} = {pretty_expression(u.value)}" for u in rule.after.updates]
        effects += [f"then {_gift(give)}" for give in rule.after.gives]
    target = rule.target or "(stays)"
    guard = _guard(rule.guard)
    return rule.name, rule.sources, rule.input, guard, target, tuple(effects), rule.clauses


def _gift(give: Give) -> str:
    if give.target in {"deliver", "resend"}:
        return give.target
    arguments = f"({_bindings(give.arguments)})" if give.arguments else ""
    return f"give {give.target}{arguments}"


def _later(later: Later) -> str:
    arguments = f"({_bindings(later.arguments)})" if later.arguments else ""
    after = "" if later.after is None else f" after {pretty_expression(later.after)}"
    return f"later {later.target}{arguments}{after} within {pretty_expression(later.within)}"


def _names(expression: Expression | Range, protocol: Protocol) -> Iterator[str]:
    """Give the names that an expression speaks of, but not the alternatives of a choice."""
    parts: tuple[Expression | Range, ...] = ()
    match expression:
        case Name(path):
            yield path
        case Binary(_, Name(path), _) if path in protocol.choices:
            yield path
        case Binary(_, left, right):
            parts = (left, right)
        case Unary(_, operand):
            parts = (operand,)
        case In(operand, items):
            parts = (operand, *items)
        case Conditional(condition, then, otherwise):
            parts = (condition, then, otherwise)
        case Call(_, arguments):
            parts = arguments
        case OneOf(items):
            parts = items
        case _:
            pass
    for part in parts:
        yield from _names(part, protocol)


def _definitions(protocol: Protocol, machine: Machine) -> Sheet:
    guards = [*(rule.guard for rule in machine.rules), *(gap.guard for gap in machine.gaps)]
    waiting = [guard for guard in guards if guard is not None]
    used: set[str] = set()
    while waiting:
        named = set(_names(waiting.pop(), protocol))
        new = named.intersection(protocol.definitions) - used
        used |= new
        waiting += [protocol.definitions[name].value for name in sorted(new)]
    return Sheet(
        "definitions",
        "definitions that the guards use",
        ("name", "meaning", "value", "clauses"),
        tuple(
            (name, definition.wording, pretty_expression(definition.value), definition.clauses)
            for name, definition in protocol.definitions.items()
            if name in used
        ),
    )


def _manuals(protocol: Protocol) -> Sheet:
    rows = tuple((manual.file, manual.edition) for manual in protocol.manuals)
    return Sheet("manuals", "manuals", ("file", "edition"), rows)


def _hex(value: int, width: int) -> str:
    return f"0x{value:0{(width + 3) // 4}X}"


def _address(value: int) -> str:
    return _hex(value, 16)


def _bits(register: Register | Word) -> tuple[str, ...]:
    return tuple(
        f"{field.name} {field.low}" + ("" if field.low == field.high else f"..{field.high}")
        for field in register.fields
    )


def _memory(protocol: Protocol) -> Sheet:
    rows: list[tuple[int, tuple[Cell, ...]]] = []
    for register in protocol.registers.values():
        access = (register.main.value, register.device.value)
        span = (_address(register.address), register.size)
        row = (*span, register.name, *access, _bits(register), register.clauses)
        rows.append((register.address, row))
    for parameter in protocol.parameters.values():
        if isinstance(parameter.type, Area):
            start, length = (_number(protocol, part) for part in parameter.value)
            cells = (_address(start), length, parameter.name, "", "", (), parameter.clauses)
            rows.append((start, cells))
    columns = ("address", "bytes", "name", "MainDevice", "device", "bits", "clauses")
    ordered = sorted(rows, key=lambda row: row[0])
    return Sheet("memory", "memory map", columns, tuple(row for _, row in ordered))


def _number(protocol: Protocol, expression: Expression) -> int:
    """Give the number that an area begins with or is long, which may be that of another area."""
    match expression:
        case Literal(value):
            return int(value)
        case Name(path):
            name, _, part = path.partition(".")
            parts = dict(zip(AREA_PARTS, protocol.parameters[name].value, strict=True))
            return _number(protocol, parts[part])
        case _:
            raise TypeError(f"{expression} is no number")


def _value(parameter: Parameter) -> str:
    match parameter.type, parameter.value:
        case Time(), (Literal(value),):
            return f"{value / _MICROSECONDS:g} s"
        case _, parts:
            return ", ".join(map(pretty_expression, parts))


def _parameters(protocol: Protocol) -> Sheet:
    rows = tuple(
        (parameter.name, pretty_type(parameter.type), _value(parameter), parameter.clauses)
        for parameter in protocol.parameters.values()
        if not isinstance(parameter.type, Area)
    )
    return Sheet("parameters", "parameters", ("name", "type", "value", "clauses"), rows)


def _machines(protocol: Protocol) -> Sheet:
    rows = tuple(
        (machine.name, machine.wording, machine.states, machine.initial, len(machine.rules))
        for machine in protocol.machines.values()
    )
    columns = ("machine", "meaning", "states", "initial", "rules")
    return Sheet("machines", "machines", columns, rows)


def _choices(protocol: Protocol) -> Sheet:
    rows = []
    for choice in protocol.choices.values():
        pin = protocol.pins.get(choice.name)
        names = tuple(alternative.name for alternative in choice.alternatives)
        cited = choice.clauses if pin is None else tuple(dict.fromkeys(pin.clauses))
        left = protocol.opened.get(choice.name)
        cited = cited if left is None else left.clauses
        silent = "open" if left is None else "open: the manual is silent"
        way = silent if pin is None else pin.alternative
        rows.append((choice.name, choice.wording, names, way, cited))
    title = "choices (implementation conformance statement)"
    return Sheet("choices", title, ("choice", "meaning", "ways", "pinned", "clauses"), tuple(rows))


def _risks(protocol: Protocol) -> Sheet:
    rows = tuple(
        (choice.name, way.name, way.risk.wording, way.risk.clauses)
        for choice in protocol.choices.values()
        for way in choice.alternatives
        if way.risk is not None
    )
    title = "ways that are allowed and risky"
    return Sheet("risky", title, ("choice", "way", "why", "clauses"), rows)


def _conditions(protocol: Protocol) -> Sheet:
    rows = tuple(
        (condition.name, condition.wording, str(condition.assumed).lower(), condition.clauses)
        for condition in protocol.conditions.values()
    )
    title = "conditions that only the device knows"
    return Sheet("conditions", title, ("condition", "meaning", "assumed", "clauses"), rows)


def _properties(protocol: Protocol) -> Sheet:
    rows = tuple(
        (law.name, law.wording, pretty_expression(law.value), law.clauses)
        for law in protocol.properties.values()
    )
    title = "what holds in every state that the texts allow"
    return Sheet("properties", title, ("property", "meaning", "always", "clauses"), rows)


def fault_sheet() -> Sheet:
    """Give the planted faults: what `--dut model:fault=NAME` does wrong, and where that breaks."""
    rows = tuple((f.name, f.wording, f.clauses) for f in load_faults().values())
    title = "planted faults: ecatspec run DEVICE --dut model:fault=NAME"
    return Sheet("faults", title, ("fault", "what the device does wrong", "clauses"), rows)


def _codes(table: CodeTable) -> Sheet:
    kind = "closed: there are no other values" if table.closed else "open"
    rows = tuple(
        (_hex(row.value, table.width), row.name, row.wording, row.clauses) for row in table.rows
    )
    title = f"code table {table.name} ({kind})"
    return Sheet(f"table {table.name}", title, ("value", "name", "meaning", "clauses"), rows)


def _limits(entry: ObjectEntry) -> str:
    if entry.low is None and entry.high is None:
        return ""
    return f"{'' if entry.low is None else entry.low}..{'' if entry.high is None else entry.high}"


def _objects(protocol: Protocol) -> Sheet:
    rows = tuple(
        (
            f"{_address(entry.index)}:{_hex(entry.subindex, 8)[2:]}",
            entry.name,
            pretty_type(entry.type),
            entry.access.value,
            (*entry.states, *(f"{state} (read)" for state in entry.read_states)),
            _limits(entry),
            "" if entry.default is None else str(entry.default),
            entry.clauses,
        )
        for entry in protocol.objects
    )
    others = "there are no others" if protocol.dictionary.closed else "there may be others"
    columns = ("object", "name", "type", "access", "states", "range", "default", "clauses")
    return Sheet("objects", f"objects ({others})", columns, rows)


def _esi(protocol: Protocol) -> Sheet:
    rows = tuple((entry.path, str(entry.value), entry.clauses) for entry in protocol.esi)
    return Sheet("esi", "device description (ESI)", ("element", "value", "clauses"), rows)


def _words(protocol: Protocol) -> Sheet:
    entries = {(entry.index, entry.subindex) for entry in protocol.objects}
    rows = tuple(
        (
            f"{_address(word.key[0])}:{_hex(word.key[1], 8)[2:]}",
            word.name,
            _bits(word),
            tuple(field.name for field in word.fields if field.shows is not None),
            word.clauses,
        )
        for word in protocol.words.values()
        if word.key in entries and word.key is not None
    )
    columns = ("object", "name", "bits", "judged", "clauses")
    return Sheet("words", "bits of objects", columns, rows)


def _process_data(protocol: Protocol) -> Sheet:
    """Give the PDOs with what they map by default."""
    image = Model(protocol).image
    entries: dict[int, list[ObjectEntry]] = {}
    for entry in protocol.objects:
        if entry.subindex:
            entries.setdefault(entry.index, []).append(entry)
    rows = []
    for name, indices in image.pdos.items():
        for index in indices:
            held = [_held(image, entry) for entry in entries.get(index, ())]
            if held:
                access = {entry.access.value for entry in entries[index]}
                kind = "can be mapped" if "rw" in access else "fixed"
                direction = name.partition("_")[0]
                rows.append((_address(index), direction, kind, tuple(filter(None, held))))
    return Sheet(
        "pdos", "process data objects", ("PDO", "direction", "mapping", "entries"), tuple(rows)
    )


def _held(image: ProcessImage, entry: ObjectEntry) -> str:
    if entry.maps is not None:
        return f"{entry.maps} bits"
    if not isinstance(entry.default, int) or not entry.default:
        return ""
    key, bits = image.target(entry.default)
    place = "gap" if key is None else f"{_address(key[0])}:{_hex(key[1], 8)[2:]}"
    return f"{place} {bits} bits"


def _changes(protocol: Protocol) -> Sheet:
    rows: list[tuple[str, str, tuple[str, ...]]] = []
    for change in protocol.replaced:
        match change:
            case Replace() | Remove():
                word = "removed" if isinstance(change, Remove) else "replaced"
                rows.append((f"{change.machine}.{change.rule}", word, change.clauses))
            case ReplaceField():
                rows.append((f"{change.frame}.{change.name}", "replaced", change.clauses))
            case Extend():
                rows += [(f"{change.machine}.{r.name}", "added", r.clauses) for r in change.rules]
            case _:
                assert_never(change)
    title = "rules and fields of the standard that this device keeps differently"
    return Sheet("changes", title, ("subject", "change", "clauses"), tuple(rows))


def _anomalies(protocol: Protocol) -> Sheet:
    rows = tuple(
        (anomaly.id, anomaly.subject, anomaly.printed, anomaly.normative, anomaly.treatment)
        for anomaly in protocol.anomalies
    )
    columns = ("id", "subject", "printed", "normative", "treatment")
    return Sheet("anomalies", "anomalies of the manual", columns, rows)


def _examples(protocol: Protocol) -> Sheet:
    rows = tuple(
        (example.name, example.request.hex(" "), example.response.hex(" "), example.clauses)
        for example in protocol.examples
    )
    title = "worked examples of the manual"
    return Sheet("examples", title, ("example", "request", "response", "clauses"), rows)
