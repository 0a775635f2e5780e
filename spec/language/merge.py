"""Merges texts: extend, pin, set, close, replace, remove."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from ecatspec.spec.language.ir import (
    NOWHERE,
    Anomaly,
    Choice,
    Clause,
    Close,
    CodeTable,
    Condition,
    Definition,
    Dictionary,
    EsiEntry,
    Example,
    Extend,
    Frame,
    Machine,
    Manual,
    ObjectEntry,
    Parameter,
    Property,
    Protocol,
    Reason,
    Register,
    Remove,
    Replace,
    ReplaceField,
    Word,
)
from ecatspec.spec.language.merge_closes import Closes

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ecatspec.spec.language.diagnostics import Diagnostic
    from ecatspec.spec.language.ir import (
        Declaration,
        Fault,
        SourceText,
    )


_CHANGES = (Replace, Remove, Extend, ReplaceField)
_T = TypeVar("_T")
_N = TypeVar(
    "_N",
    CodeTable,
    Parameter,
    Register,
    Word,
    Frame,
    Machine,
    Choice,
    Condition,
    Definition,
    Property,
    Reason,
)


def merge_standard(texts: Sequence[SourceText]) -> tuple[Protocol, list[Diagnostic]]:
    """All declarations of the standard's texts, in the order of the texts, and the findings."""
    protocol = _declared(texts)
    merge = Closes(protocol, _declared(()))
    for text in texts:
        for extension in _of(text.declarations, Extend):
            merge.take(extension)
    return replace(protocol, machines=merge.machines), merge.findings


def _declared(texts: Sequence[SourceText]) -> Protocol:
    """What texts declare, before anything in them changes anything else."""
    declared = [declaration for text in texts for declaration in text.declarations]
    wording = texts[0].wording if len(texts) == 1 else "the standard"
    dictionaries = _of(declared, Dictionary)
    return Protocol(
        name="standard",
        wording=wording,
        manuals=_of(declared, Manual),
        clauses={clause.id: clause for clause in _of(declared, Clause)},
        tables=_named(_of(declared, CodeTable)),
        parameters=_named(_of(declared, Parameter)),
        registers=_named(_of(declared, Register)),
        words=_named(_of(declared, Word)),
        frames=_named(_of(declared, Frame)),
        machines=_named(_of(declared, Machine)),
        choices=_named(_of(declared, Choice)),
        conditions=_named(_of(declared, Condition)),
        definitions=_named(_of(declared, Definition)),
        properties=_named(_of(declared, Property)),
        reasons=_named(_of(declared, Reason)),
        pins={},
        opened={},
        closed={},
        objects=_of(declared, ObjectEntry),
        dictionary=dictionaries[-1] if dictionaries else Dictionary(closed=False, clauses=()),
        esi=_of(declared, EsiEntry),
        anomalies=_of(declared, Anomaly),
        examples=_of(declared, Example),
        replaced=(),
        digest="",
    )


def merge_device(standard: Protocol, text: SourceText) -> tuple[Protocol, list[Diagnostic]]:
    """The standard as one device keeps it, and the findings of 4xx."""
    own = _declared((text,))
    merge = Closes(standard, own)
    for declaration in text.declarations:
        merge.take(declaration)
    for close in own_closes(text):
        merge.close(close)
    if own.manuals:
        merge.unclaimed(own.clauses.values())
        merge.unfounded(text.declarations, standard.clauses | own.clauses)
        merge.unaccounted(own.manuals, own.clauses.values())
    merge.same_objects(standard.objects, own.objects)
    merge.same_words(standard.words, own.words.values())
    changed = tuple(d for d in text.declarations if isinstance(d, _CHANGES))
    protocol = Protocol(
        name=text.name,
        wording=text.wording,
        manuals=standard.manuals + own.manuals,
        clauses=standard.clauses | own.clauses,
        tables=merge.tables,
        parameters=merge.parameters,
        registers=merge.registers,
        words=merge.words,
        frames=merge.frames,
        machines=merge.machines,
        choices=merge.choices,
        conditions=merge.conditions,
        definitions=merge.definitions,
        properties=merge.properties,
        reasons=merge.reasons | own.reasons,
        pins=merge.pins,
        opened=merge.opened,
        closed=merge.closed,
        objects=_objects(standard.objects, own.objects),
        dictionary=own.dictionary if own.dictionary.at != NOWHERE else standard.dictionary,
        esi=standard.esi + own.esi,
        anomalies=standard.anomalies + own.anomalies,
        examples=standard.examples + own.examples,
        replaced=standard.replaced + changed,
        digest="",
    )
    return protocol, merge.findings


def with_fault(protocol: Protocol, fault: Fault) -> tuple[Protocol, list[Diagnostic]]:
    """The protocol as a device with this mistake keeps it, and the findings of 4xx."""
    merge = Closes(protocol, _declared(()))
    for change in fault.changes:
        merge.take(change)
    faulty = replace(protocol, machines=merge.machines, frames=merge.frames, reasons=merge.reasons)
    return faulty, merge.findings


def own_closes(text: SourceText) -> tuple[Close, ...]:
    """The tables that a device text closes."""
    return _of(text.declarations, Close)


def _of(declared: Iterable[Declaration], kind: type[_T]) -> tuple[_T, ...]:
    return tuple(declaration for declaration in declared if isinstance(declaration, kind))


def _named(declared: Iterable[_N]) -> dict[str, _N]:
    return {declaration.name: declaration for declaration in declared}


def _objects(
    standard: tuple[ObjectEntry, ...], own: tuple[ObjectEntry, ...]
) -> tuple[ObjectEntry, ...]:
    merged = {(entry.index, entry.subindex): entry for entry in standard}
    merged |= {(entry.index, entry.subindex): entry for entry in own}
    return tuple(merged.values())
