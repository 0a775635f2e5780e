"""Cases of the objects and values that rules name by number."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from ecatspec.generators.cases.assignment import set_entry
from ecatspec.generators.cases.bringup import case_in
from ecatspec.generators.cases.transfers import download, upload
from ecatspec.spec.language.ir import Binary, Call, In, Literal, Name, Range, SInt, UInt
from ecatspec.spec.language.nodes import nodes_in

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Case, Limits, Stimulus
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import Definition, Protocol, Rule

_INDEX: Final = "index"
_Named: TypeAlias = tuple[int, int, int]
"""An entry and a value: index, subindex, number."""


def named_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield a read and a write of each object that is named and not declared, and values by name.

    A device text may say that such an object is not there, or that an entry takes a value.
    """
    for index in named_objects(model.protocol):
        key = f"{index:04X}_00"
        what = f"0x{index:04X}, which the texts name and do not declare"
        yield case_in(model, f"sdo/named/{key}", f"upload of {what}", [upload(index, 0)])
        sent = [download(index, 0, bytes(1))]
        yield case_in(model, f"sdo/named_written/{key}", f"download to {what}", sent)
    entries = {(entry.index, entry.subindex): entry for entry in model.protocol.objects}
    named = _named_values(model.protocol)
    for each in named:
        index, subindex, value = each
        entry = entries.get((index, subindex))
        if entry is None or not isinstance(entry.type, UInt | SInt):
            continue
        if isinstance(entry.type, SInt) and value >> entry.type.width - 1:
            value -= 1 << entry.type.width
        name = f"sdo/named_value/{index:04X}_{subindex:02X}/{value}"
        title = f"{entry.name} written with {value}, which the texts name"
        before = _before(model, named, each)
        done = [*before, set_entry(model, index, subindex, value), upload(index, subindex)]
        yield case_in(model, name, title, done)


def _before(model: Model, named: list[_Named], value: _Named) -> Iterator[Stimulus]:
    """Yield what makes room for a value: entries change while their number is 0 and count then."""
    index, subindex, number = value
    if not model.sets_up(index) or not (subindex or number):
        return
    for cleared in dict.fromkeys((*model.image.assignments.values(), index)):
        yield set_entry(model, cleared, 0, 0)
    if not subindex:
        for each in named:
            if each[0] == index and 0 < each[1] <= number:
                yield set_entry(model, *each)


def _named_values(protocol: Protocol) -> list[_Named]:
    """Give the values that definitions name for an entry: index, subindex and value."""
    found: dict[_Named, None] = {}
    for definition in protocol.definitions.values():
        for node in nodes_in(definition.value):
            if not isinstance(node, Binary) or node.operator != "and":
                continue
            subindex: int | None = None
            indices: list[int] = []
            values: list[int] = []
            for part in nodes_in(node):
                match part:
                    case Binary("==", Name(path="subindex"), Literal(value=number)):
                        subindex = int(number)
                    case Binary("==", Name(path=path), Literal() as one) if path == _INDEX:
                        indices += _ends(one)
                    case In(operand=Name(path=path), items=items) if path == _INDEX:
                        indices += [end for item in items for end in _ends(item)]
                    case Binary("==", Call("number", (Name(path="value"),)), Literal() as one):
                        values += _ends(one)
                    case In(operand=Call("number", (Name(path="value"),)), items=items):
                        values += [end for item in items for end in _ends(item)]
                    case _:
                        pass
            if subindex is not None:
                found |= dict.fromkeys(
                    (index, subindex, value) for index in indices for value in values
                )
    return list(found)


def named_objects(protocol: Protocol, clause: str = "") -> list[int]:
    """Give the indices that rules compare with, of objects that no text declares.

    With a clause those of rules and definitions that rest on it.
    """
    declared = {entry.index for entry in protocol.objects}
    parts: list[Rule | Definition] = list(protocol.definitions.values())
    for machine in protocol.machines.values():
        parts += machine.rules
    found: set[int] = set()
    for part in (each for each in parts if not clause or clause in each.clauses):
        for node in nodes_in(part):
            match node:
                case In(operand=Name(path=path), items=items) if path == _INDEX:
                    found |= {number for item in items for number in _ends(item)}
                case Binary("==", Name(path=path), Literal(value=number)) if path == _INDEX:
                    found.add(int(number))
                case _:
                    pass
    return sorted(found - declared)


def _ends(item: object) -> Iterator[int]:
    """Yield a number, or the ends of a row of numbers and what lies between them in the middle."""
    match item:
        case Literal(value=number):
            yield int(number)
        case Range(Literal(value=low), Literal(value=high)):
            yield from {int(low), (int(low) + int(high)) // 2, int(high)}
        case _:
            pass
