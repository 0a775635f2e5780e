"""Mutants of data: a row, a pin, a parameter or a field with another value.

Where a rule is wrong in what it does, see `mutants`; here the device has something else than the
text declares, and does all by that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from ecatspec.generators.covers.named_cover import named_objects
from ecatspec.generators.mutation.mutants import wrong_checks, wrong_values
from ecatspec.model.analysis.citations import object_name
from ecatspec.spec.language.ir import (
    Access,
    Area,
    Bool,
    Bytes,
    Extend,
    Literal,
    ObjectEntry,
    Pin,
    Remove,
    Replace,
    ReplaceField,
    SInt,
    Text,
    UInt,
)
from ecatspec.spec.language.nodes import names_in
from ecatspec.spec.language.pretty_expressions import pretty_expression, pretty_type

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.spec.language.ir import (
        CodeTable,
        Expression,
        Frame,
        Parameter,
        Protocol,
        Register,
        RegisterField,
        Rule,
        Type,
        Word,
    )

_BYTE: Final = 8
_WIDER: Final = {8: 16, 16: 32, 32: 16, 64: 32}
_OTHER_RIGHT: Final = {
    Access.READ: Access.BOTH,
    Access.BOTH: Access.READ,
    Access.WRITE: Access.BOTH,
}


@dataclass(frozen=True, slots=True)
class DataMutant:
    """A specification with one mistake in its data.

    `place` is the word and the name of what is wrong, as in a text, and `clauses` are those that it
    rests on; no two mutants of a specification are described alike.
    """

    place: str
    mistake: str
    before: str
    after: str
    clauses: tuple[str, ...]
    protocol: Protocol

    def __str__(self) -> str:
        """Give what is wrong and where."""
        return f"{self.place}: {self.mistake}: {self.before} -> {self.after}"


def data_mutants(protocol: Protocol, standard: Protocol, clause: str) -> Iterator[DataMutant]:
    """Yield the mutants of all data that rest on a clause, in the order of the texts.

    `standard` has what a device text takes away or replaces.
    """
    for mutants in (
        _objects,
        _pins,
        _parameters,
        _layouts,
        _frames,
        _tables,
        _closed,
        _conditions,
        _dictionary,
        _there,
    ):
        yield from mutants(protocol, clause)
    yield from _undone(protocol, standard, clause)


# --- the object dictionary ------------------------------------------------------------------------


def _objects(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    words = {word.key: word.clauses for word in protocol.words.values()}
    for number, entry in enumerate(protocol.objects):
        key = entry.index, entry.subindex
        rests = entry.clauses + words.get(key, ())
        if clause not in rests:
            continue
        before, after = protocol.objects[:number], protocol.objects[number + 1 :]
        place = f"object {object_name(key)}"
        for mistake, was, became, wrong in _entries(entry):
            objects = (*before, wrong, *after)
            changed = replace(protocol, objects=objects)
            yield DataMutant(place, mistake, was, became, rests, changed)
        gone = replace(protocol, objects=(*before, *after))
        yield DataMutant(place, "missing", entry.name, "nothing", rests, gone)


_Wrong: TypeAlias = "tuple[str, str, str, ObjectEntry]"


def _entries(entry: ObjectEntry) -> Iterator[_Wrong]:
    """Yield an entry that is wrong in one point."""
    for kind in _types(entry.type):
        yield "another type", pretty_type(entry.type), pretty_type(kind), replace(entry, type=kind)
    right = _OTHER_RIGHT[entry.access]
    yield "another right", entry.access, right, replace(entry, access=right)
    match entry.default:
        case int(number):
            for other in (number ^ 1, 0 if number > 1 else number + 2):
                yield "another default", str(number), str(other), replace(entry, default=other)
        case str(words):
            said = words[:-1] + chr(ord(words[-1]) ^ 1) if words else "x"
            yield "another default", repr(words), repr(said), replace(entry, default=said)
        case _:
            pass
    if entry.low is not None and entry.high is not None:
        was = f"{entry.low} .. {entry.high}"
        for low, high in (
            (entry.low, entry.high + 1),
            (entry.low - 1, entry.high),
            (entry.low, entry.high - 1),
            (entry.low + 1, entry.high),
        ):
            if low <= high:
                wrong = replace(entry, low=low, high=high)
                yield "another range", was, f"{low} .. {high}", wrong
        yield "another range", was, "any", replace(entry, low=None, high=None)
    if entry.states:
        was = ", ".join(entry.states)
        yield "written in other states", was, "all", replace(entry, states=())
    if entry.read_states:
        was = ", ".join(entry.read_states)
        yield "read in other states", was, "all", replace(entry, read_states=())
    if entry.mappable:
        yield "not mappable", "mappable", "not", replace(entry, mappable=False)
    else:
        yield "mappable", "not", "mappable", replace(entry, mappable=True)
    if entry.maps is not None:
        other = entry.maps + _BYTE
        yield "maps more bits", str(entry.maps), str(other), replace(entry, maps=other)


def _types(kind: Type) -> Iterator[Type]:
    match kind:
        case UInt(width):
            yield UInt(_WIDER.get(width, width + _BYTE))
            yield SInt(width)
        case SInt(width):
            yield SInt(_WIDER.get(width, width + _BYTE))
            yield UInt(width)
        case Text(maximum):
            yield Bytes(Literal(maximum))
            yield UInt(4 * _BYTE)
        case Bytes():
            yield Text(4 * _BYTE)
            yield UInt(4 * _BYTE)
        case _:
            yield UInt(4 * _BYTE)


def _dictionary(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    """Yield a closed dictionary with an entry more."""
    rests = protocol.dictionary.clauses
    if clause not in rests or not protocol.dictionary.closed or not protocol.objects:
        return
    taken = {entry.index for entry in protocol.objects}
    last = max(protocol.objects, key=lambda entry: entry.index)
    for entry in (protocol.objects[0], last):
        index = next(number for number in count(entry.index) if number not in taken)
        more = replace(entry, index=index, subindex=0, clauses=())
        changed = replace(protocol, objects=(*protocol.objects, more))
        yield DataMutant("dictionary", "one object more", "none", f"0x{index:04X}", rests, changed)


def _there(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    """Yield a dictionary with an object that a rule of the clause refuses."""
    for index in named_objects(protocol, clause):
        entry = ObjectEntry(index, 0, "there", UInt(_BYTE), Access.READ)
        changed = replace(protocol, objects=(*protocol.objects, entry))
        place = f"object {object_name((index, 0))}"
        yield DataMutant(place, "there", "nothing", "an object", (clause,), changed)


# --- what is chosen -------------------------------------------------------------------------------


def _pins(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    for name, pin in protocol.pins.items():
        if clause not in pin.clauses:
            continue
        for other in protocol.choices[name].alternatives:
            if other.name != pin.alternative:
                pins = protocol.pins | {name: replace(pin, alternative=other.name)}
                yield DataMutant(
                    f"pin {name}",
                    "the other way",
                    pin.alternative,
                    other.name,
                    pin.clauses,
                    replace(protocol, pins=pins),
                )


def _conditions(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    for name, condition in protocol.conditions.items():
        if clause in condition.clauses:
            other = replace(condition, assumed=not condition.assumed)
            yield DataMutant(
                f"condition {name}",
                "the contrary",
                str(condition.assumed).lower(),
                str(other.assumed).lower(),
                condition.clauses,
                replace(protocol, conditions=protocol.conditions | {name: other}),
            )


def _parameters(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    for name, parameter in protocol.parameters.items():
        if clause not in parameter.clauses:
            continue
        was = _said(parameter)
        for value in _other_values(parameter):
            other = replace(parameter, value=value)
            parameters = protocol.parameters | {name: other}
            changed = replace(protocol, parameters=parameters)
            place = f"parameter {name}"
            for choice in _beside(protocol, name):
                for way in protocol.choices[choice].alternatives[1:]:
                    pins = protocol.pins | {choice: Pin(choice, way.name, ())}
                    yield DataMutant(
                        place,
                        f"another value, with {choice} = {way.name}",
                        was,
                        _said(other),
                        parameter.clauses,
                        replace(changed, pins=pins),
                    )
            yield DataMutant(place, "another value", was, _said(other), parameter.clauses, changed)


def _beside(protocol: Protocol, parameter: str) -> list[str]:
    """Give the choices left open that definitions speak of together with a parameter.

    By the first way of such a choice a device may take what is not its own.
    """
    found: dict[str, None] = {}
    for definition in protocol.definitions.values():
        names = set(names_in(definition.value))
        if any(name.partition(".")[0] == parameter for name in names):
            speaking = set(names)
            for other in protocol.definitions.values():
                inside = set(names_in(other.value))
                if definition.name in inside:
                    speaking |= inside
            found |= dict.fromkeys(sorted(speaking & protocol.opened.keys()))
    return list(found)


def _said(parameter: Parameter) -> str:
    return ", ".join(map(pretty_expression, parameter.value))


def _other_values(parameter: Parameter) -> Iterator[tuple[Expression, ...]]:
    match parameter.type, parameter.value:
        case Area(), (Literal(value=start) as one, Literal(value=length) as other):
            yield replace(one, value=start + length), other
            yield one, replace(other, value=length + 2 * _BYTE)
            yield one, replace(other, value=length - 2 * _BYTE)
        case _, (Literal(value=bool(truth)) as one,):
            yield (replace(one, value=not truth),)
        case _, (Literal(value=number) as one,):
            yield (replace(one, value=number + 1),)
            if number:
                yield (replace(one, value=number - 1),)
        case _:
            pass


# --- registers, words, frames ---------------------------------------------------------------------


def _layouts(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    for name, register in protocol.registers.items():
        for place, mistake, was, became, rests, fields in _fields(protocol, register, clause):
            wrong = replace(register, fields=fields)
            changed = replace(protocol, registers=protocol.registers | {name: wrong})
            yield DataMutant(place, mistake, was, became, rests, changed)
        for mistake, was, became, wrong in _registers(register):
            if clause in register.clauses:
                changed = replace(protocol, registers=protocol.registers | {name: wrong})
                place = f"register {name}"
                yield DataMutant(place, mistake, was, became, register.clauses, changed)
    for name, word in protocol.words.items():
        for place, mistake, was, became, rests, fields in _fields(protocol, word, clause):
            words = protocol.words | {name: replace(word, fields=fields)}
            changed = replace(protocol, words=words)
            yield DataMutant(place, mistake, was, became, rests, changed)


def _registers(register: Register) -> Iterator[tuple[str, str, str, Register]]:
    for value in (0, 1):
        if register.reset != value:
            other = replace(register, reset=value)
            yield "another reset value", f"0x{register.reset:X}", f"0x{value:X}", other
    other = replace(register, address=register.address + register.size)
    was, became = f"0x{register.address:04X}", f"0x{other.address:04X}"
    yield "elsewhere", was, became, other
    right = _OTHER_RIGHT.get(register.main)
    if right is not None:
        yield "another right", register.main, right, replace(register, main=right)


def _fields(
    protocol: Protocol, layout: Register | Word, clause: str
) -> Iterator[tuple[str, str, str, str, tuple[str, ...], tuple[RegisterField, ...]]]:
    """Yield the fields of a layout, one of them wrong, after what is wrong and its clauses."""
    for number, bits in enumerate(layout.fields):
        rests = bits.clauses or layout.clauses
        if clause not in rests:
            continue
        before, after = layout.fields[:number], layout.fields[number + 1 :]
        place = f"field {layout.name}.{bits.name}"
        for mistake, was, became, wrong in _bits(protocol, bits, layout.size):
            yield place, mistake, was, became, rests, (*before, wrong, *after)


def _bits(
    protocol: Protocol, bits: RegisterField, size: int
) -> Iterator[tuple[str, str, str, RegisterField]]:
    shows = bits.shows
    if shows is not None:
        changes = [(b, a, value) for b, a, value in wrong_values(protocol, bits.type, shows.value)]
        if isinstance(bits.type, Bool):
            changes += [(b, a, value) for _, b, a, value in wrong_checks(shows.value)]
        seen = set()
        for was, became, value in changes:
            if (was, became) not in seen:
                seen.add((was, became))
                yield "shows", was, became, replace(bits, shows=replace(shows, value=value))
    if bits.high + 1 < size * _BYTE:
        moved = replace(bits, low=bits.low + 1, high=bits.high + 1)
        yield "one bit higher", str(bits.low), str(moved.low), moved
    if bits.low:
        moved = replace(bits, low=bits.low - 1, high=bits.high - 1)
        yield "one bit lower", str(bits.low), str(moved.low), moved


def _frames(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    for frame in protocol.frames.values():
        if clause in frame.clauses:
            yield from frame_mutants(protocol, frame)


def frame_mutants(protocol: Protocol, frame: Frame) -> Iterator[DataMutant]:
    """Yield a specification whose frame has something else in one of its fields."""
    place = f"frame {frame.name}"
    for number, field in enumerate(frame.fields):
        before, after = frame.fields[:number], frame.fields[number + 1 :]
        for said, value in (("value", field.value), ("reply", field.reply)):
            if value is None:
                continue
            for was, became, wrong in wrong_values(protocol, field.type, value):
                other = (
                    replace(field, value=wrong) if said == "value" else replace(field, reply=wrong)
                )
                changed = replace(frame, fields=(*before, other, *after))
                frames = protocol.frames | {frame.name: changed}
                yield DataMutant(
                    place,
                    f"another {said} of {field.name}",
                    was,
                    became,
                    frame.clauses,
                    replace(protocol, frames=frames),
                )


# --- code tables ----------------------------------------------------------------------------------


def _tables(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    """Yield rows with another value; of the states of a machine a clause has to have them all.

    What one state is like no number of it tells.
    """
    states = {machine.table for machine in protocol.machines.values()}
    for table in protocol.tables.values():
        every = all(clause in row.clauses for row in table.rows)
        for number, row in enumerate(table.rows):
            if clause in row.clauses and (every or table.name not in states):
                yield from _row(protocol, table, number, row.clauses)


def _closed(protocol: Protocol, clause: str) -> Iterator[DataMutant]:
    for name, closed in protocol.closed.items():
        if clause in closed.clauses:
            table = protocol.tables[name]
            for number in range(len(table.rows)):
                yield from _row(protocol, table, number, closed.clauses)


def _row(
    protocol: Protocol, table: CodeTable, number: int, clauses: tuple[str, ...]
) -> Iterator[DataMutant]:
    row = table.rows[number]
    taken = {each.value for each in table.rows}
    free = next((n for n in reversed(range(1 << table.width)) if n not in taken), None)
    if free is None:
        return
    rows = (*table.rows[:number], replace(row, value=free), *table.rows[number + 1 :])
    tables = protocol.tables | {table.name: replace(table, rows=rows)}
    yield DataMutant(
        f"row {table.name}.{row.name}",
        "another value",
        f"0x{row.value:X}",
        f"0x{free:X}",
        clauses,
        replace(protocol, tables=tables),
    )


# --- what a device text changes in the standard ---------------------------------------------------


def _undone(protocol: Protocol, standard: Protocol, clause: str) -> Iterator[DataMutant]:
    """Yield the device that does as the standard has it where its text does not."""
    for change in protocol.replaced:
        if isinstance(change, Extend) or clause not in change.clauses:
            continue
        match change:
            case Remove(machine, rule) | Replace(machine, rule):
                old = next((r for r in standard.machines[machine].rules if r.name == rule), None)
                if old is not None:
                    word = "remove" if isinstance(change, Remove) else "replace"
                    changed = _with_rule(protocol, machine, old)
                    place = f"{word} {machine}.{rule}"
                    yield DataMutant(
                        place, "as in the standard", "changed", "not", change.clauses, changed
                    )
            case ReplaceField(frame, name):
                fields = {each.name: each for each in standard.frames[frame].fields}
                own = protocol.frames[frame]
                put = tuple(fields[f.name] if f.name == name else f for f in own.fields)
                frames = protocol.frames | {frame: replace(own, fields=put)}
                yield DataMutant(
                    f"replace {frame}.{name}",
                    "as in the standard",
                    "changed",
                    "not",
                    change.clauses,
                    replace(protocol, frames=frames),
                )
            case _:
                assert_never(change)


def _with_rule(protocol: Protocol, name: str, rule: Rule) -> Protocol:
    machine = protocol.machines[name]
    others = tuple(each for each in machine.rules if each.name != rule.name)
    machines = protocol.machines | {name: replace(machine, rules=(rule, *others))}
    return replace(protocol, machines=machines)
