"""What judging an exchange yields, as data; `diagnosis` puts a contradiction into words."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from ecatspec.model.core.codec import Message
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.spec.language.ir import Register, Word


@dataclass(frozen=True, slots=True)
class Judged:
    """What an exchange leaves: explanations that allow it, and those that do not."""

    after: Explanations
    refused: Explanations = field(default_factory=dict)
    concerned: bool = True
    """Some explanation has there what the exchange is about."""


@dataclass(frozen=True, slots=True)
class RegisterRead:
    """A register held `raw`, which it cannot hold in any explanation."""

    before: Explanations
    register: Register
    raw: int


@dataclass(frozen=True, slots=True)
class InputsRead:
    """Inputs held words that they cannot hold."""

    before: Explanations
    words: dict[str, Word]


@dataclass(frozen=True, slots=True)
class ProcessDataRefused:
    """Process data that the texts demand could not be read, or written."""

    before: Explanations
    write: bool


@dataclass(frozen=True, slots=True)
class MailboxFound:
    """The mailbox was full where nothing is due, or empty where a reply is."""

    before: Explanations
    full: bool


@dataclass(frozen=True, slots=True)
class MessageRead:
    """The mailbox held a message that is not due; None: nothing that is one."""

    before: Explanations
    message: Message | None


@dataclass(frozen=True, slots=True)
class MailRefused:
    """The mailbox did not take a request."""

    before: Explanations


Contradiction: TypeAlias = (
    RegisterRead | InputsRead | ProcessDataRefused | MailboxFound | MessageRead | MailRefused
)
"""What no explanation allows; `before` are those that it contradicts."""
