"""Declarations of a text: what the protocol is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ecatspec.spec.language.ir.expressions import Expression

from ecatspec.spec.language.ir.expressions import NOWHERE, Access, Level, Span, Type


@dataclass(frozen=True, slots=True)
class Clause:
    """One demand: id, level, wording (own words), source (document and section) and claims.

    `because` says why no case exercises it.
    """

    id: str
    level: Level
    wording: str
    source: str
    claims: tuple[str, ...] = ()
    because: str | None = None
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Manual:
    """The document that a device text is made from; `claims` are all it states, in its order."""

    file: str
    edition: str
    claims: tuple[str, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class CodeRow:
    """One row of a code table."""

    value: int
    name: str
    wording: str
    clauses: tuple[str, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class CodeTable:
    """Named values of `width` bits; a closed table has no others."""

    name: str
    width: int
    closed: bool
    rows: tuple[CodeRow, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Parameter:
    """A value that a device text may set with `parameter NAME = ...`.

    `value` holds one expression; for an Area two (start, length). A Time is written as
    `3 s`, `200 ms` and kept as a Literal of microseconds.
    """

    name: str
    type: Type
    value: tuple[Expression, ...]
    clauses: tuple[str, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Advised:
    """What a register field should read as beside what it must, by clauses of their own."""

    value: Expression
    clauses: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Shows:
    """What a register field reads as: `value` while `condition` holds, unspecified otherwise."""

    value: Expression
    condition: Expression | None = None
    advised: Advised | None = None


@dataclass(frozen=True, slots=True)
class RegisterField:
    """Bits `low` to `high` of a register, both included."""

    name: str
    low: int
    high: int
    type: Type
    shows: Shows | None = None
    clauses: tuple[str, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Register:
    """`size` bytes at `address`; `main` and `device` are the access rights of the two sides."""

    name: str
    address: int
    size: int
    main: Access
    device: Access
    reset: int
    fields: tuple[RegisterField, ...]
    clauses: tuple[str, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Word:
    """Bits of an object (`key`: index and subindex), or, without one, of values of this layout.

    Where a field `shows` an expression, the object reads so.
    """

    name: str
    key: tuple[int, int] | None
    size: int
    fields: tuple[RegisterField, ...]
    clauses: tuple[str, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class FrameField:
    """One field of a frame, least significant bit first.

    `value` is a constant (the decoder demands it, the encoder writes it), `reply` is what the
    device sends when a rule does not say otherwise, `into` the variable that keeps what was seen.
    `filled` is what the encoder writes where the field is not given.
    """

    name: str
    type: Type
    value: Expression | None = None
    filled: Expression | None = None
    reply: Expression | None = None
    into: str | None = None
    clauses: tuple[str, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Frame:
    """A layout. A frame `in` another lies in the parent's last field when `conditions` hold."""

    name: str
    parent: str | None
    conditions: tuple[tuple[str, Expression], ...]
    fields: tuple[FrameField, ...]
    clauses: tuple[str, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable of a machine with its value after power-on."""

    name: str
    type: Type
    initial: Expression
    at: Span = field(default=NOWHERE, compare=False)


class InputKind(StrEnum):
    """Where an input comes from."""

    WRITE = "write"
    """The MainDevice wrote one of the registers `origin`; parameters are its fields."""
    FRAME = "frame"
    """A frame was delivered, and no layout inside `origin` has an input of its own."""
    EVENT = "event"
    """Another machine gives it, with `parameters`."""
    WORD = "word"
    """The device took a value for the object of the word `origin`; parameters are its fields and
    `cyclic` (by process data, not by SDO)."""
    OUTPUTS = "outputs"
    """The MainDevice wrote process data; the parameter is `image`."""
    LOCAL = "local"
    """It happens in the device, unseen by the MainDevice until a rule shows it."""
    OWN = "own"
    """The device does it when it likes."""


@dataclass(frozen=True, slots=True)
class Input:
    """What a machine reacts to."""

    name: str
    kind: InputKind
    origin: tuple[str, ...]
    parameters: tuple[tuple[str, Type], ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Risk:
    """Why a way that is allowed is discouraged, or what a MainDevice risks with it."""

    wording: str
    clauses: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Alternative:
    """One way to go at a choice."""

    name: str
    wording: str
    risk: Risk | None = None
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Choice:
    """A named freedom of the standard; unpinned, a device goes one way and stays with it."""

    name: str
    wording: str
    alternatives: tuple[Alternative, ...]
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Condition:
    """A truth that only the device knows (it may change at any time); `assumed` by the model."""

    name: str
    wording: str
    assumed: bool
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Definition:
    """A named expression; it means what it would mean written out at its place of use."""

    name: str
    wording: str
    value: Expression
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Property:
    """What holds in every state that the texts allow."""

    name: str
    wording: str
    value: Expression
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Update:
    """`set variable = value`."""

    variable: str
    value: Expression
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Send:
    """A frame that the device sends; fields that are not named follow the frame's own text."""

    frame: str
    fields: tuple[tuple[str, Expression], ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Give:
    """An event for another machine (`machine.input`).

    `deliver`: the frame itself goes on; `resend`: the message that the MainDevice read last is put
    back before what is not read yet.
    """

    target: str
    arguments: tuple[tuple[str, Expression], ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Later:
    """An event that comes by itself: not before `after`, at the latest `within`, if not renewed.

    A new one for the same target takes the place of one that is still to come.
    """

    target: str
    arguments: tuple[tuple[str, Expression], ...]
    after: Expression | None
    within: Expression
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Store:
    """`store index : subindex = value`: an object takes a new value.

    `store complete`: all entries from `subindex` on take theirs, laid out as in complete access.
    """

    index: Expression
    subindex: Expression
    value: Expression
    complete: bool = False
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class After:
    """What happens once the frame sent is fixed; `reply.FIELD` is what it holds."""

    updates: tuple[Update, ...]
    gives: tuple[Give, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of a machine, paragraphs in fixed order."""

    name: str
    clauses: tuple[str, ...]
    sources: tuple[str, ...]
    input: str
    guard: Expression | None
    target: str | None
    updates: tuple[Update, ...]
    stores: tuple[Store, ...]
    sends: tuple[Send, ...]
    gives: tuple[Give, ...]
    within: Expression | None
    after: After | None = None
    take: Expression | None = None
    laters: tuple[Later, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a rule refuses, in words: `{}`, `{hex}` and `{words}` stand for the values in order.

    It is told where `guard` holds when the rule `machine.rule` has fired.
    """

    name: str
    machine: str
    rule: str
    wording: str
    values: tuple[Expression, ...]
    guard: Expression
    clauses: tuple[str, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Gap:
    """A declared silence: for this input the texts say nothing (any behaviour is allowed)."""

    name: str
    clauses: tuple[str, ...]
    sources: tuple[str, ...]
    input: str
    guard: Expression | None
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True)  # without slots: there would be no place for `input_by_name`
class Machine:
    """An extended finite state machine; `states` are rows of the table `table`."""

    name: str
    wording: str
    table: str
    states: tuple[str, ...]
    initial: str
    variables: tuple[Variable, ...]
    inputs: tuple[Input, ...]
    rules: tuple[Rule, ...]
    gaps: tuple[Gap, ...]
    at: Span = field(default=NOWHERE, compare=False)

    @cached_property
    def input_by_name(self) -> dict[str, Input]:
        """The inputs by their names."""
        return {item.name: item for item in self.inputs}


@dataclass(frozen=True, slots=True)
class ObjectEntry:
    """One entry of the object dictionary.

    `states` are the AL states in which it can be written, `read_states` those in which it can be
    read; empty for all. `maps`: the number of bits of a mapping entry of an unknown object.
    A string is `fixed`, or of `varying` size up to that of its type; neither: no text says it.
    `stored`: it keeps over power-off what was written, so its default need not be there; `guarded`:
    it takes only values that no text knows, a signature or a password.
    """

    index: int
    subindex: int
    name: str
    type: Type
    access: Access
    constant: bool = False
    volatile: bool = False
    states: tuple[str, ...] = ()
    read_states: tuple[str, ...] = ()
    low: int | None = None
    high: int | None = None
    default: int | str | None = None
    mappable: bool = False
    fixed: bool = False
    varying: bool = False
    stored: bool = False
    guarded: bool = False
    maps: int | None = None
    clauses: tuple[str, ...] = ()
    at: Span = field(default=NOWHERE, compare=False)
