"""Places, types and expressions."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeAlias


@dataclass(frozen=True, slots=True, order=True)
class Span:
    """A place in a text; lines and columns count from 1."""

    file: str
    line: int
    column: int

    def __str__(self) -> str:
        """Give the place in the form that editors jump to."""
        return f"{self.file}:{self.line}:{self.column}"


NOWHERE = Span("<built in>", 0, 0)


class Level(StrEnum):
    """How strongly a clause demands: a breach of must fails, of should warns, may never blames.

    What is `unobservable` does not show in the protocol: nothing is judged by it.
    """

    MUST = "must"
    SHOULD = "should"
    MAY = "may"
    UNOBSERVABLE = "unobservable"


class Access(StrEnum):
    """Access right of one side to a register, or of the MainDevice to an object."""

    NONE = "none"
    READ = "ro"
    WRITE = "wo"
    BOTH = "rw"


@dataclass(frozen=True, slots=True)
class UInt:
    """Unsigned integer of `width` bits."""

    width: int


@dataclass(frozen=True, slots=True)
class SInt:
    """Signed integer of `width` bits, two's complement on the wire."""

    width: int


@dataclass(frozen=True, slots=True)
class Bool:
    """A truth value, one bit on the wire."""


@dataclass(frozen=True, slots=True)
class Named:
    """A value of the code table `table`, with that table's width."""

    table: str


@dataclass(frozen=True, slots=True)
class Bytes:
    """A byte string; `length` is an expression over earlier fields, None for all that is left."""

    length: Expression | None


@dataclass(frozen=True, slots=True)
class Text:
    """A visible string of at most `maximum` bytes (objects only)."""

    maximum: int


@dataclass(frozen=True, slots=True)
class Area:
    """A memory area: start address and length in bytes (parameters only)."""


@dataclass(frozen=True, slots=True)
class Time:
    """A duration in seconds (parameters only)."""


Type: TypeAlias = UInt | SInt | Bool | Named | Bytes | Text | Area | Time


@dataclass(frozen=True, slots=True)
class Literal:
    """A number or a truth value.

    `digits` keeps how it was written: 0 decimal, n > 0 hex with n digits, -1 with a unit of time.
    """

    value: int | bool
    digits: int = field(default=0, compare=False)
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Name:
    """A dotted name; what it means depends on where it stands, see `scope`."""

    path: str
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Unary:
    """`not x` or `-x`."""

    operator: str
    operand: Expression
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Binary:
    """Two operands: or and == != < <= > >= + - * / % & |."""

    operator: str
    left: Expression
    right: Expression
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Range:
    """The numbers from `low` to `high`, both included."""

    low: Expression
    high: Expression
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class In:
    """`x in { a, b, 1..7 }`."""

    operand: Expression
    items: tuple[Expression | Range, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Conditional:
    """`if c then a else b`."""

    condition: Expression
    then: Expression
    otherwise: Expression
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class Call:
    """A built-in function of the object dictionary or of byte strings, see `scope.FUNCTIONS`."""

    function: str
    arguments: tuple[Expression, ...]
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class OneOf:
    """An acceptable set: `one of { a, b, 1..7 } except x`."""

    items: tuple[Expression | Range, ...]
    excluded: Expression | None = None
    at: Span = field(default=NOWHERE, compare=False)


@dataclass(frozen=True, slots=True)
class AnyValue:
    """`any`: the texts do not specify the value; it is never compared.

    `any preferably x`: where the model itself has to act, it takes x.
    """

    preferred: Expression | None = None
    at: Span = field(default=NOWHERE, compare=False)


Expression: TypeAlias = Literal | Name | Unary | Binary | In | Conditional | Call | OneOf | AnyValue
