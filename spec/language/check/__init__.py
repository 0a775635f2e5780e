"""Checks that texts make sense: names, kinds of values, meaning."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.spec.language.check.expressions import ExpressionChecker
from ecatspec.spec.language.check.structure import StructureChecker
from ecatspec.spec.language.overlap import meaning

if TYPE_CHECKING:
    from ecatspec.spec.language.diagnostics import Diagnostic
    from ecatspec.spec.language.ir import Protocol


def check_protocol(protocol: Protocol) -> list[Diagnostic]:
    """What is wrong with texts put together: the findings of the first phase that has any."""
    if found := check_words(protocol):
        return found
    checker = StructureChecker(protocol)
    checker.objects()
    return [*checker.of_phase("4"), *meaning(protocol)]


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
