"""What a name can stand for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from ecatspec.spec.language.ir import (
    Type,
)


@dataclass(frozen=True, slots=True)
class ParameterOfInput:
    """A parameter of the rule's input; inside a frame, another field of the same frame."""

    name: str


@dataclass(frozen=True, slots=True)
class ReplyField:
    """A field of the frame that the rule sends, as it is sent."""

    name: str


@dataclass(frozen=True, slots=True)
class VariableRef:
    """A variable of a machine."""

    machine: str
    name: str


@dataclass(frozen=True, slots=True)
class StateRef:
    """The state that a machine is in."""

    machine: str


@dataclass(frozen=True, slots=True)
class RegisterFieldRef:
    """What a field of a register holds now."""

    register: str
    field: str


@dataclass(frozen=True, slots=True)
class WordFieldRef:
    """What a field of a word holds now."""

    word: str
    field: str


@dataclass(frozen=True, slots=True)
class ParameterRef:
    """A parameter; `part` is `start` or `length` of an area, else None."""

    name: str
    part: str | None = None


@dataclass(frozen=True, slots=True)
class ChoiceRef:
    """Which way the device goes at a choice; also the kind of such a value."""

    name: str


@dataclass(frozen=True, slots=True)
class AlternativeRef:
    """One way to go at a choice."""

    choice: str
    name: str


@dataclass(frozen=True, slots=True)
class ConditionRef:
    """A truth that only the device knows."""

    name: str


@dataclass(frozen=True, slots=True)
class DefinitionRef:
    """A named expression; it means in this scope what it would mean written out here."""

    name: str


@dataclass(frozen=True, slots=True)
class ConstantRef:
    """The value of a row of a table."""

    value: int
    table: str


Ref: TypeAlias = (
    ParameterOfInput
    | ReplyField
    | VariableRef
    | StateRef
    | RegisterFieldRef
    | WordFieldRef
    | ParameterRef
    | ChoiceRef
    | AlternativeRef
    | ConditionRef
    | DefinitionRef
    | ConstantRef
)


Kind: TypeAlias = Type | ChoiceRef
"""What sort of value: a type of the texts, or the way at a choice."""


class UnresolvedName(LookupError):  # noqa: N818
    """A name that means nothing here, or (with `candidates`) too much."""

    def __init__(self, path: str, candidates: tuple[str, ...] = ()) -> None:
        self.path = path
        self.candidates = candidates
        super().__init__(path)
