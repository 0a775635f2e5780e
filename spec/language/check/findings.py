"""What a check notes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.spec.language.diagnostics import Code, Diagnostic, near

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.spec.language.ir import (
        Protocol,
        Span,
    )


class Findings:
    """What is wrong with a whole Protocol."""

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
        remedy = f"declare it{near(name, names, ', or write ')}"
        self._note(Code.ECS106, at, f"there is no {kind} `{name}`", remedy)
