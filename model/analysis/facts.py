"""Divides a protocol into single facts that can be compared with another's.

A fact has a place (section and subject), what stands there in words, and the clauses it rests on.
What devices do, their rules, is no fact: it is compared by trying it out.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, TypeAlias

from ecatspec.model.analysis.citations import object_name
from ecatspec.model.core.observables import machines_of
from ecatspec.model.core.process_image import OUTPUTS
from ecatspec.spec.language.ir import Access, Area, InputKind, Level, Literal, Register, Time, Word
from ecatspec.spec.language.pretty_expressions import pretty_expression, pretty_type

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import CodeTable, ObjectEntry, Parameter, Protocol

_SECOND = 1_000_000


class Section(StrEnum):
    """What a difference is about; the values are the names that a user gives."""

    MEMORY = "memory"
    PARAMETERS = "parameters"
    SERVICES = "services"
    TIMES = "times"
    AL = "al"
    CODES = "codes"
    MAILBOX = "mailbox"
    OBJECTS = "objects"
    PDOS = "pdos"
    DRIVE = "ds402"
    ERRORS = "errors"
    ESI = "esi"
    ANOMALIES = "anomalies"


TITLES: dict[Section, str] = {
    Section.MEMORY: "memory map and registers",
    Section.PARAMETERS: "parameters",
    Section.SERVICES: "services and limits",
    Section.TIMES: "time limits",
    Section.AL: "AL state machine",
    Section.CODES: "AL status codes",
    Section.MAILBOX: "mailbox and SDO",
    Section.OBJECTS: "objects",
    Section.PDOS: "PDOs",
    Section.DRIVE: "DS402",
    Section.ERRORS: "errors",
    Section.ESI: "device description (ESI)",
    Section.ANOMALIES: "what the manuals themselves say of their anomalies",
}


class Kind(StrEnum):
    """How a fact binds a MainDevice, which decides whether another value breaks it."""

    FIXED = "fixed"
    """It is built on: another value breaks."""
    ANSWER = "answer"
    """The device may give it: more of them break, fewer do not."""
    MORE = "more"
    """The more (`amount` or `members`) the device takes, the better."""
    LESS = "less"
    """The longer it takes, the worse."""
    NOTE = "note"
    """It may matter or not."""


Key: TypeAlias = tuple[Section, str]


@dataclass(frozen=True, slots=True)
class Fact:
    """One fact. `name` is the declaration that it is of, as anomalies name it.

    `within` is the subject of the fact that contains it; `whole`: what is not stated inside of
    this one does not exist; `own_list`: so it is where the standard does not have this one.
    `example`: the text gives it as one possibility. `note` is told and not compared.
    """

    section: Section
    subject: str
    value: str
    clauses: tuple[str, ...]
    name: str
    kind: Kind = Kind.FIXED
    within: str = ""
    whole: bool = False
    own_list: bool = False
    amount: int = 0
    members: frozenset[str] = frozenset()
    example: bool = False
    note: str = ""

    @property
    def words(self) -> str:
        """Give value and note."""
        return f"{self.value} ({self.note})" if self.note else self.value

    @property
    def key(self) -> Key:
        """Give the place at which facts of two protocols are compared."""
        return self.section, self.subject


_TABLES = {
    "al_status_code": Section.CODES,
    "al_state": Section.AL,
    "sdo_abort_code": Section.MAILBOX,
    "drive_error": Section.ERRORS,
    "emergency_code": Section.ERRORS,
    "operation_mode": Section.DRIVE,
    "quick_stop_option": Section.DRIVE,
    "connection_option": Section.DRIVE,
}
"""Tables that are about something in particular; other tables are services and limits."""
_DRIVE = "ds402"
_FILE = "description file"


def facts(model: Model) -> dict[Key, Fact]:
    """Give all facts of a protocol by their places."""
    protocol = model.protocol
    found: dict[Key, Fact] = {}
    for each in (_memory, _parameters, _choices, _tables, _inputs, _replies, _esi):
        found |= {fact.key: fact for fact in each(protocol)}
    for of_model in (_words, _pdos, _objects):
        found |= {fact.key: fact for fact in of_model(model)}
    return found


def _joined(*parts: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(clause for part in parts for clause in part))


def _hex(value: int, width: int = 16) -> str:
    return f"0x{value:0{(width + 3) // 4}X}"


# --- registers, parameters, choices ---------------------------------------------------------------


def _memory(protocol: Protocol) -> Iterator[Fact]:
    for register in protocol.registers.values():
        place = f"{_hex(register.address)}, {register.size} bytes"
        rights = f"MainDevice {register.main}, device {register.device}"
        value = f"{place}, {rights}, {_hex(register.reset, register.size * 8)} after power-on"
        subject = f"register {register.name}"
        yield Fact(
            Section.MEMORY, subject, value, register.clauses, register.name, Kind.FIXED, whole=True
        )
        yield from _bits(register, Section.MEMORY, subject)


def _bits(layout: Register | Word, section: Section, within: str) -> Iterator[Fact]:
    for bits in layout.fields:
        place = f"{bits.low}" if bits.low == bits.high else f"{bits.low}..{bits.high}"
        subject = f"{layout.name} bit {place}"
        base = (_joined(layout.clauses, bits.clauses), layout.name)
        value = f"{bits.name} ({pretty_type(bits.type)})"
        yield Fact(section, subject, value, *base, within=within)
        if bits.shows is not None and isinstance(bits.shows.value, Literal):
            shown = pretty_expression(bits.shows.value)
            yield Fact(section, f"{subject} is always", shown, *base, Kind.ANSWER, subject)


def _words(model: Model) -> Iterator[Fact]:
    protocol = model.protocol
    for word in protocol.words.values():
        origins = {o for source in protocol.machines[_DRIVE].inputs for o in source.origin}
        drive = word.name in origins or _DRIVE in machines_of(model, word.name)
        section = Section.DRIVE if drive else Section.OBJECTS
        place = "" if word.key is None else f"{object_name(word.key)}, "
        subject = f"word {word.name}"
        value = f"{place}{word.size} bytes"
        yield Fact(section, subject, value, word.clauses, word.name, whole=True)
        yield from _bits(word, section, subject)


def _parameters(protocol: Protocol) -> Iterator[Fact]:
    for parameter in protocol.parameters.values():
        match parameter.type, parameter.value:
            case Area(), (Literal(start), Literal(length)):
                name = parameter.name
                clauses = parameter.clauses
                subject = f"{name} start"
                yield Fact(Section.MEMORY, subject, _hex(start), clauses, name)
                yield Fact(
                    *(Section.MEMORY, f"{name} length", f"{length} bytes", clauses, name),
                    Kind.MORE,
                    amount=int(length),
                )
            case Time(), (Literal(value),):
                yield Fact(
                    *(Section.TIMES, parameter.name, f"{value / _SECOND:g} s"),
                    *(parameter.clauses, parameter.name, Kind.LESS),
                    amount=int(value),
                )
            case _:
                yield _parameter(parameter)


def _parameter(parameter: Parameter) -> Fact:
    value = ", ".join(map(pretty_expression, parameter.value))
    section = Section.PARAMETERS
    return Fact(section, parameter.name, value, parameter.clauses, parameter.name, Kind.NOTE)


def _choices(protocol: Protocol) -> Iterator[Fact]:
    """Yield the choices that are decided; one that is open states nothing."""
    for choice in protocol.choices.values():
        pin = protocol.pins.get(choice.name)
        if pin is not None:
            wording = next(a.wording for a in choice.alternatives if a.name == pin.alternative)
            value = f"{pin.alternative}: {wording}"
            subject = f"{choice.name} ({choice.wording})"
            yield Fact(Section.SERVICES, subject, value, pin.clauses, choice.name)


# --- code tables, events, frames, ESI -------------------------------------------------------------


def _tables(protocol: Protocol) -> Iterator[Fact]:
    """Yield the codes that travel; the states of a machine do so only where AL Status has them."""
    states = {m.table for m in protocol.machines.values()} - _TABLES.keys()
    for table in protocol.tables.values():
        if table.name in states:
            continue
        yield from _rows(protocol, table, _TABLES.get(table.name, Section.SERVICES))


def _rows(protocol: Protocol, table: CodeTable, section: Section) -> Iterator[Fact]:
    closed = protocol.closed.get(table.name)
    clauses = () if closed is None else closed.clauses
    subject = f"table {table.name}"
    whole = table.closed or closed is not None
    value = "no other values" if whole else "other values are possible"
    yield Fact(
        *(section, subject, value, clauses, table.name, Kind.NOTE),
        whole=whole,
        own_list=True,
    )
    for row in table.rows:
        number = _hex(row.value, table.width)
        base = (row.clauses, table.name)
        yield Fact(section, f"{table.name} {number}", row.name, *base, Kind.ANSWER, subject)


def _inputs(protocol: Protocol) -> Iterator[Fact]:
    """Yield the local events of a device: only one that has it shows what comes of it."""
    sections = {"al": Section.AL, _DRIVE: Section.DRIVE}
    for machine in protocol.machines.values():
        section = sections.get(machine.name, Section.MAILBOX)
        within = f"machine {machine.name}"
        yield Fact(section, within, machine.wording, (), machine.name, Kind.NOTE, whole=True)
        for source in machine.inputs:
            if source.kind in {InputKind.LOCAL, InputKind.OWN}:
                rules = [r for r in machine.rules if r.input == source.name]
                clauses = _joined(*(rule.clauses for rule in rules))
                word = (
                    "happens to the device"
                    if source.kind == InputKind.LOCAL
                    else "the device does it"
                )
                subject = f"{machine.name}.{source.name}"
                yield Fact(section, subject, word, clauses, machine.name, Kind.ANSWER, within)


def _replies(protocol: Protocol) -> Iterator[Fact]:
    for frame in protocol.frames.values():
        for item in frame.fields:
            if item.reply is not None:
                subject = f"{frame.name}.{item.name} in answers"
                value = pretty_expression(item.reply)
                yield Fact(Section.MAILBOX, subject, value, frame.clauses, frame.name)


def _esi(protocol: Protocol) -> Iterator[Fact]:
    if protocol.esi:
        yield Fact(Section.ESI, _FILE, "is printed", (), _FILE, Kind.NOTE)
    for entry in protocol.esi:
        value = f"{entry.value:#x}" if isinstance(entry.value, int) else entry.value
        yield Fact(Section.ESI, entry.path, value, entry.clauses, entry.path, Kind.NOTE, _FILE)


# --- objects and PDOs -----------------------------------------------------------------------------

DICTIONARY = "object dictionary"
PDO_LIST = "list of PDOs"
"""What contains the objects that map into PDOs: which there are is one fact for each direction."""


def _objects(model: Model) -> Iterator[Fact]:
    protocol = model.protocol
    closed = protocol.dictionary.closed
    value = "there are no other objects" if closed else "there may be other objects"
    clauses = protocol.dictionary.clauses
    yield Fact(Section.OBJECTS, DICTIONARY, value, clauses, "dictionary", Kind.NOTE, whole=closed)
    for entry in protocol.objects:
        section = Section.PDOS if model.image.configures(entry.index) else Section.OBJECTS
        yield from _entry(model, entry, section)


def _entry(model: Model, entry: ObjectEntry, section: Section) -> Iterator[Fact]:
    subject = object_name((entry.index, entry.subindex))
    base = (entry.clauses, entry.name)
    mapping = section is Section.PDOS and entry.index not in model.image.assignments.values()
    within = PDO_LIST if mapping else DICTIONARY
    yield Fact(section, subject, "exists", *base, Kind.MORE, within, note=entry.name)
    yield Fact(section, f"{subject} type", pretty_type(entry.type), *base, within=subject)
    rights = {Access.READ: "r", Access.WRITE: "w", Access.BOTH: "rw"}.get(entry.access, "")
    states = tuple(row.name for row in model.protocol.tables["al_state"].rows)
    for what, letter, given in (("read", "r", entry.read_states), ("written", "w", entry.states)):
        members = frozenset(given or states) if letter in rights else frozenset()
        words = (", ".join(given) or "in every state") if members else "never"
        yield Fact(
            *(section, f"{subject} can be {what}", words, *base, Kind.MORE, subject),
            members=members,
        )
    if entry.low is not None or entry.high is not None:
        value = f"{'' if entry.low is None else entry.low}..{entry.high or ''}"
        width = (entry.high or 0) - (entry.low or 0)
        yield Fact(*(section, f"{subject} range", value, *base, Kind.MORE, subject), amount=width)
    if entry.default is not None or entry.maps is not None:
        value = _default(model, entry)
        yield Fact(
            *(section, f"{subject} default", value, *base, Kind.NOTE, subject),
            example=entry.maps is not None,
        )
    if entry.mappable:
        yield Fact(section, f"{subject} mapping", "can be mapped", *base, Kind.MORE, subject)
    if entry.stored:
        yield Fact(section, f"{subject} storage", "kept over power-off", *base, Kind.NOTE, subject)
    if entry.guarded:
        value = "values that only the device knows"
        yield Fact(section, f"{subject} takes", value, *base, Kind.NOTE, subject)


def _default(model: Model, entry: ObjectEntry) -> str:
    if entry.maps is not None:
        return f"{entry.maps} bits of an object that is not named"
    if not isinstance(entry.default, int):
        return str(entry.default)
    count_or_pdo = not entry.subindex or entry.index in model.image.assignments.values()
    if model.image.configures(entry.index) and not count_or_pdo and entry.default:
        key, bits = model.image.target(entry.default)
        return f"{'a gap' if key is None else object_name(key)}, {bits} bits"
    return str(entry.default) if not entry.subindex else f"{entry.default:#x}"


def _pdos(model: Model) -> Iterator[Fact]:
    """Yield which PDOs there are, the default assignment, and what each holds by default."""
    entries = {(e.index, e.subindex): e for e in model.protocol.objects}
    for name, indices in model.image.pdos.items():
        direction = "receive" if name == OUTPUTS else "transmit"
        known = [index for index in indices if (index, 0) in entries]
        if not known:
            continue
        counts = [entries[index, 0] for index in known]
        clauses = _joined(*(entry.clauses for entry in counts))
        levels = {model.protocol.clauses[c].level for c in clauses}
        listed = ", ".join(map(_hex, known))
        yield Fact(
            *(Section.PDOS, f"{direction} PDOs", f"{len(known)}: {listed}", clauses, name),
            Kind.MORE,
            members=frozenset(map(_hex, known)),
            example=levels == {Level.MAY},
        )
        for entry in counts:
            size = _size(model, entries, entry)
            if size is not None:
                subject = f"PDO {_hex(entry.index)} size"
                yield Fact(
                    *(Section.PDOS, subject, size, entry.clauses, entry.name, Kind.NOTE),
                    within=f"{object_name((entry.index, 0))}",
                )


def _size(
    model: Model, entries: dict[tuple[int, int], ObjectEntry], count: ObjectEntry
) -> str | None:
    """Give what a PDO has by default, in bytes; None: not known."""
    if not isinstance(count.default, int):
        return None
    bits = 0
    for subindex in range(1, count.default + 1):
        entry = entries.get((count.index, subindex))
        if entry is None:
            return None
        if entry.maps is not None:
            bits += entry.maps
        elif isinstance(entry.default, int):
            bits += model.image.target(entry.default)[1]
        else:
            return None
    return f"{-(-bits // 8)} bytes"
