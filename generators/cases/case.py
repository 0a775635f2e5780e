"""The shape of a test case: stimuli in order, and their purpose."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.core.values import Value


@dataclass(frozen=True, slots=True)
class WriteRegister:
    """The MainDevice writes a register; fields that are not named are 0."""

    register: str
    fields: Mapping[str, int] = field(hash=False)


@dataclass(frozen=True, slots=True)
class WriteRegisters:
    """The MainDevice writes neighbouring registers at once, in the order of their addresses."""

    writes: tuple[WriteRegister, ...]


@dataclass(frozen=True, slots=True)
class ReadRegister:
    """The MainDevice reads a register."""

    register: str


@dataclass(frozen=True, slots=True)
class SendFrame:
    """The MainDevice writes a message into its mailbox.

    Without `counter` the next one of 1 to 7 is taken; `same_counter` repeats the last. With
    `unread` the answer stays in the mailbox.
    """

    frame: str
    fields: Mapping[str, Value] = field(hash=False)
    same_counter: bool = False
    unread: bool = False


@dataclass(frozen=True, slots=True)
class SendSegments:
    """The MainDevice asks for segments until the upload is over; nothing where none is open."""


@dataclass(frozen=True, slots=True)
class Repeat:
    """The MainDevice toggles the repeat bit of the mailbox that it reads."""


@dataclass(frozen=True, slots=True)
class Probe:
    """A request that every device answers: shows that the mailbox is alive."""


@dataclass(frozen=True, slots=True)
class ReadInitial:
    """The MainDevice reads an entry to which nobody wrote since power-on."""

    index: int
    subindex: int


@dataclass(frozen=True, slots=True)
class WriteUntilTaken:
    """The MainDevice writes an entry until it takes a value: what it holds first, then others."""

    index: int
    subindex: int


@dataclass(frozen=True, slots=True)
class ReadConfiguration:
    """The MainDevice reads by SDO what is assigned to the process data and mapped into it."""


@dataclass(frozen=True, slots=True)
class SetUpProcessData:
    """The MainDevice sets the process data SyncManagers to what is assigned and mapped.

    `changes` deviates field by field of a register, `longer` by bytes of a SyncManager.
    """

    changes: Mapping[str, Mapping[str, int]] = field(default_factory=dict, hash=False)
    longer: Mapping[str, int] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True)
class WriteOutputs:
    """The MainDevice writes process data and goes on cyclically.

    `words` are values of words by name; others keep what was written last, all else is 0.
    """

    words: Mapping[str, int] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True)
class StopOutputs:
    """The MainDevice writes no process data any more."""


@dataclass(frozen=True, slots=True)
class Wait:
    """Time passes; while process data are written cyclically they are."""

    microseconds: int


@dataclass(frozen=True, slots=True)
class Hurry:
    """What follows this is not waited for: the device is looked at once, then the next comes."""


@dataclass(frozen=True, slots=True)
class Happen:
    """A local event (`machine.input`) happens in the device; the adapter raises it."""

    event: str


Stimulus: TypeAlias = (
    WriteRegister
    | WriteRegisters
    | ReadRegister
    | SendFrame
    | SendSegments
    | Repeat
    | Probe
    | ReadInitial
    | WriteUntilTaken
    | ReadConfiguration
    | SetUpProcessData
    | WriteOutputs
    | StopOutputs
    | Wait
    | Hurry
    | Happen
)


@dataclass(frozen=True, slots=True)
class Limits:
    """What the way to a device cannot carry, so that no test may ask for it.

    `initiate_data` and `segment_data` are the most bytes of a download that one message carries
    (None: what the mailbox holds), `without` names features that do not get through.
    """

    initiate_data: int | None = None
    segment_data: int | None = None
    without: frozenset[str] = frozenset()


NO_LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class Case:
    """One test from power-on. `layer` is the machine that it exercises.

    `needs` is the AL state that the stimuli before `prelude` must have reached for the case to
    mean something. `flag` names what is broken in it, a key of `families.NOTES`; `feature` what
    the way to the device must be able to carry. `about` is the rule that it looks for, as
    `machine.rule`: a finding behind the prelude cites its clauses too, also where the rule itself
    changes nothing that a MainDevice sees.
    """

    name: str
    title: str
    layer: str
    stimuli: tuple[Stimulus, ...]
    needs: str | None = None
    prelude: int = 0
    flag: str = ""
    feature: str = ""
    about: str = ""
