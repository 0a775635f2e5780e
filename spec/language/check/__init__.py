"""Checks that texts make sense: names, kinds of values, meaning."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.spec.language.check.areas import AreaChecker
from ecatspec.spec.language.check.dictionary import DictionaryChecker
from ecatspec.spec.language.check.expressions import ExpressionChecker
from ecatspec.spec.language.check.structure import StructureChecker
from ecatspec.spec.language.ir import ObjectEntry
from ecatspec.spec.language.overlap import meaning

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.spec.language.diagnostics import Diagnostic
    from ecatspec.spec.language.ir import Protocol, SourceText


_IDENTITY: Final = "identity_entries"
"""The object of the standard that counts the entries of the identity."""


def check_protocol(protocol: Protocol) -> list[Diagnostic]:
    """What is wrong with texts put together: the findings of the first phase that has any."""
    if found := check_words(protocol):
        return found
    checker = StructureChecker(protocol)
    checker.objects()
    return [*checker.of_phase("1"), *checker.of_phase("4"), *meaning(protocol)]


def check_device(
    protocol: Protocol, text: SourceText, standard: Iterable[SourceText]
) -> list[Diagnostic]:
    """What contradicts itself in a device text: objects, PDOs, areas."""
    declared = [declaration for each in standard for declaration in each.declarations]
    identity = [d.index for d in declared if isinstance(d, ObjectEntry) and d.name == _IDENTITY]
    own = {
        (entry.index, entry.subindex)
        for entry in text.declarations
        if isinstance(entry, ObjectEntry)
    }
    dictionary = DictionaryChecker(protocol, frozenset(own), next(iter(identity), None))
    dictionary.dictionary()
    areas = AreaChecker(protocol, text.at.file, dictionary.image_bits)
    areas.areas()
    return [*dictionary.of_phase("5"), *areas.of_phase("5")]


def check_words(protocol: Protocol) -> list[Diagnostic]:
    """What is wrong with names and kinds of values; a planted fault may mean what it likes."""
    structure, expressions = StructureChecker(protocol), ExpressionChecker(protocol)
    structure.structure()
    expressions.expressions()
    for phase in "12":
        found = dict.fromkeys((*structure.of_phase(phase), *expressions.of_phase(phase)))
        if found:
            return list(found)
    return []
