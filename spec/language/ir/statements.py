"""Statements of a device text, and texts as they were read."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from ecatspec.spec.language.ir.expressions import Expression

from ecatspec.spec.language.ir.declarations import (
    Choice,
    Clause,
    CodeTable,
    Condition,
    Definition,
    Frame,
    Gap,
    Give,
    Input,
    Later,
    Machine,
    Manual,
    ObjectEntry,
    Parameter,
    Property,
    Reason,
    Register,
    Rule,
    Send,
    Update,
    Variable,
    Word,
)
from ecatspec.spec.language.ir.expressions import NOWHERE, Span


@dataclass(frozen=True, slots=True)
class Pin:
    """A device text decides a choice."""

    choice: str
    alternative: str
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Open:
    """A device text leaves a choice open: its manual is silent."""

    choice: str
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Confirm:
    """A manual says the same as the standard: pairs of kind and name, `rule` and `machine.rule`."""

    targets: tuple[tuple[str, str], ...]
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Close:
    """A device text closes a code table: only these values (names or numbers) ever appear."""

    table: str
    values: tuple[Expression, ...]
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class SetParameter:
    """A device text sets a parameter of the standard."""

    name: str
    value: tuple[Expression, ...]
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Replace:
    """A device text changes one rule: paragraphs given replace those of the standard's rule."""

    machine: str
    rule: str
    clauses: tuple[str, ...]
    guard: Expression | None
    target: str | None
    updates: tuple[Update, ...]
    sends: tuple[Send, ...]
    within: Expression | None
    gives: tuple[Give, ...] = ()
    laters: tuple[Later, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Remove:
    """A device text takes a rule of the standard away."""

    machine: str
    rule: str
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Extend:
    """A text adds variables, inputs, rules and gaps to a machine of the standard."""

    machine: str
    variables: tuple[Variable, ...]
    inputs: tuple[Input, ...]
    rules: tuple[Rule, ...]
    gaps: tuple[Gap, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class ReplaceField:
    """A text changes what the device sends in one field of a frame."""

    frame: str
    name: str
    clauses: tuple[str, ...]
    reply: Expression
    into: str | None
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Fault:
    """A mistake that a device can have: changes of the texts, or a quirk outside of them.

    `clauses` are those of which a run must cite one when it finds the fault.
    """

    name: str
    wording: str
    clauses: tuple[str, ...]
    quirk: str | None
    changes: tuple[Replace | Remove | Extend | ReplaceField, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Anomaly:
    """A place where a manual contradicts itself or the standard."""

    id: str
    subject: str
    printed: str
    normative: str
    treatment: str
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Example:
    """A worked example of a manual: the bytes written to the mailbox and the bytes answered."""

    name: str
    request: bytes
    response: bytes
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Dictionary:
    """Whether objects that no text declares may exist (`open`) or not (`closed`)."""

    closed: bool
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class EsiEntry:
    """What a manual says of the ESI file: the path of an element or attribute, and its value."""

    path: str
    value: int | str
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


Declaration: TypeAlias = (
    Clause
    | Manual
    | CodeTable
    | Parameter
    | Register
    | Frame
    | Machine
    | Choice
    | Condition
    | Definition
    | Property
    | ObjectEntry
    | EsiEntry
    | Pin
    | Open
    | Confirm
    | Close
    | SetParameter
    | Replace
    | Remove
    | Anomaly
    | Example
    | Dictionary
    | Extend
    | ReplaceField
    | Fault
    | Word
    | Reason
)


@dataclass(frozen=True, slots=True)
class SourceText:
    """One file as written: `extends` is None for a text of the standard or of planted `faults`.

    `digest` is the SHA-256 of its characters.
    """

    name: str
    wording: str
    extends: str | None
    declarations: tuple[Declaration, ...]
    faults: bool = False
    digest: str = field(default="", compare=False)
    at: Span = field(default=NOWHERE, compare=False)
