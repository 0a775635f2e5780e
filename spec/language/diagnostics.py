"""The diagnostics: codes, sentences, and how a finding is printed."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.spec.language.ir import Span


class Code(Enum):
    """All findings: 0 syntax, 1 names, 2 types, 3 meaning, 4 and 5 device texts.

    4 compares a device text with the standard, 5 with itself.
    """

    ECS001 = "a word or sign stands where the language does not expect it"
    ECS002 = "the text ends in the middle of a declaration"
    ECS003 = "the file is not a text in UTF-8"
    ECS004 = "the file holds no declaration at all"

    ECS101 = "a name means nothing here"
    ECS102 = "something is declared twice"
    ECS103 = "two rules of a machine have the same name"
    ECS104 = "a clause is cited that no text declares"
    ECS105 = "a rule, gap or device statement cites no clause"
    ECS106 = "a state, input, frame, register, table or machine does not exist"
    ECS107 = "a bare name stands for rows of several tables"

    ECS201 = "a value or a field does not fit the bits it is given"
    ECS202 = "values of different kinds meet"
    ECS203 = "a function gets the wrong arguments"
    ECS204 = "the fields of a frame do not fit together"
    ECS205 = "an edge is asked of something that has no value before"
    ECS206 = "the wording of a reason and its values do not fit together"
    ECS207 = "a number is divided by zero"

    ECS301 = "two rules of a machine can fire for the same input"
    ECS302 = "a rule can never fire"
    ECS303 = "no rule ever goes to a state"
    ECS304 = "nothing uses a clause or a definition"

    ECS401 = "a device text speaks of something that the standard does not have"
    ECS402 = "a device text changes nothing"
    ECS403 = "a closed table leaves a rule without a code"
    ECS404 = "a clause of a device text names no claim"
    ECS405 = "the values of an object contradict each other"
    ECS406 = "the claims of a manual and the clauses do not fit together"
    ECS407 = "a clause that cannot be observed is cited, or says no reason"

    ECS501 = "an object of a device cites no clause"
    ECS502 = "two objects of a device have the same name"
    ECS503 = "an object has no whole number of bytes"
    ECS504 = "an object counts more entries than it has"
    ECS505 = "an object has another length than the word that describes it"
    ECS506 = "a drive has a control word and no status word"
    ECS507 = "the number of entries of the identity is wrong or missing"
    ECS508 = "an assignment names no PDO of the device and the direction"
    ECS509 = "a mapped object is not declared"
    ECS510 = "a mapped object has another length or direction, or cannot be mapped"
    ECS511 = "two memory areas overlap"
    ECS512 = "a memory area is too small"


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One finding: what is wrong at which place, and what to do about it."""

    code: Code
    at: Span
    message: str
    remedy: str

    def __str__(self) -> str:
        """Give the line that editors and people read."""
        return f"{self.at}: {self.code.name} {self.message}; {self.remedy}"


class SpecError(Exception):
    """A text is wrong: all findings of the phase that found them."""

    def __init__(self, diagnostics: tuple[Diagnostic, ...]) -> None:
        self.diagnostics = diagnostics
        super().__init__("\n".join(str(diagnostic) for diagnostic in diagnostics))


def near(name: str, known: Iterable[str], before: str = "; did you mean ") -> str:
    """What else could be meant by a name, for a remedy."""
    found = difflib.get_close_matches(name, sorted(set(known)), 1, 0.6)
    return f"{before}`{found[0]}`" if found else ""
