"""The shape of test vectors: what a file of them holds, and what it means.

The types are the format: files are read and checked with them, and the JSON Schema is made from
them. docs/vectors.md explains it to people who have nothing but a file.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, TypeAlias

import msgspec
from msgspec import Meta, Struct, field

from ecatspec.spec.language.ir import Level  # noqa: TC001  msgspec reads the annotations

SCHEMA: Final = "ecatspec.vectors"
SCHEMA_VERSION: Final = 1
CONFIGURATION: Final = "configuration"
"""The layer and the id of the test that shows what others take for granted."""

_SPACE: Final = 1 << 16
_LONGEST_HEX: Final = 2 * _SPACE
_LONGEST_WAIT: Final = 3_600_000_000
_LONGEST_TEXT: Final = 2000

Address: TypeAlias = Annotated[
    int, Meta(ge=0, lt=_SPACE, description="where something lies in the memory of the ESC")
]
Length: TypeAlias = Annotated[int, Meta(ge=1, le=_SPACE, description="bytes")]
Hex: TypeAlias = Annotated[
    str,
    Meta(
        pattern="^([0-9a-f]{2})*$",
        max_length=_LONGEST_HEX,
        description="bytes in the order of their addresses, two digits each",
    ),
]
Microseconds: TypeAlias = Annotated[
    int, Meta(ge=0, le=_LONGEST_WAIT, description="time of the device")
]
Text: TypeAlias = Annotated[str, Meta(max_length=_LONGEST_TEXT)]
Name: TypeAlias = Annotated[str, Meta(min_length=1, max_length=200)]
Count: TypeAlias = Annotated[int, Meta(ge=0)]
Effect: TypeAlias = Literal["passes", "ends"]
"""What an observation that is allowed means: the test goes on, or it ends as acceptable."""


class _Part(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What all parts of a file have in common: closed, and what is at its default is left out."""


# --- what is done ---------------------------------------------------------------------------------


class Write(_Part, frozen=True, tag_field="do", tag="write"):
    """Write once. `counter` is the working counter; another one is `otherwise`, or a failure."""

    address: Address
    data: Hex
    symbol: Name
    counter: Literal[0, 1] = 1
    otherwise: Effect | None = None


class Send(_Part, frozen=True, tag_field="do", tag="send"):
    """Write a message into the mailbox; while it is refused again, for the request time at most."""

    address: Address
    data: Hex
    symbol: Name


class Local(_Part, frozen=True, tag_field="do", tag="local"):
    """Raise a local event in the device."""

    event: Name


Input: TypeAlias = Write | Send | Local


class Cycle(_Part, frozen=True):
    """Process data that are written every `us` while time passes in a step."""

    address: Address
    data: Hex
    us: Annotated[int, Meta(ge=1, le=_LONGEST_WAIT)]


# --- what is expected -----------------------------------------------------------------------------


class Allowed(_Part, frozen=True):
    """Bytes that may be there: equal to `value` wherever `mask` has a bit.

    With `atLeast` a message may be shorter, but not shorter than that.
    """

    value: Hex
    mask: Hex
    effect: Effect = "passes"
    atLeast: Length | None = None  # noqa: N815

    def admits(self, data: bytes) -> bool:
        """Tell whether the bytes are these; what follows them is not compared."""
        value, mask = bytes.fromhex(self.value), bytes.fromhex(self.mask)
        if self.atLeast is not None:
            value = value[: max(len(data), self.atLeast)]
        pairs = zip(data, value, mask, strict=False)
        return len(data) >= len(value) and all(
            not (seen ^ wanted) & sure for seen, wanted, sure in pairs
        )


class Read(_Part, frozen=True, tag_field="kind", tag="read"):
    """Memory that is read. Bytes that are none of `anyOf` are `otherwise`."""

    address: Address
    length: Length
    symbol: Name
    anyOf: list[Allowed]  # noqa: N815  the usual name in JSON
    refused: Effect | None = None
    otherwise: Effect | None = None


class Mail(_Part, frozen=True, tag_field="kind", tag="mail"):
    """A message that is read from the mailbox, or none. `none`: there may be none."""

    anyOf: list[Allowed]  # noqa: N815
    symbol: Name = "nothing"
    none: Effect | None = None
    otherwise: Effect | None = None
    counter: Literal["new", "same", "any"] = "any"


class Full(_Part, frozen=True, tag_field="kind", tag="full"):
    """Whether a message waits, which is not read."""

    full: bool
    otherwise: Effect | None = None


Expected: TypeAlias = Read | Mail | Full


class Step(_Part, frozen=True):
    """One thing that the MainDevice does, and what it must see `us` later."""

    given: Annotated[Input | None, Meta(description="without it: only look")] = field(
        name="in", default=None
    )
    us: Microseconds = 0
    early: bool = False
    cycle: Cycle | None = None
    expect: list[Expected] = []
    state: dict[Name, Name] = {}
    covers: list[Name] = []

    @property
    def can_end(self) -> bool:
        """Whether a test may end here, since the device may go another way."""
        parts: list[Input | Expected | Allowed | None] = [self.given, *self.expect]
        parts += [allowed for each in self.expect for allowed in getattr(each, "anyOf", ())]
        ways = ("refused", "otherwise", "none", "effect")
        return any(getattr(part, way, None) == "ends" for part in parts for way in ways)


# --- the file -------------------------------------------------------------------------------------


class Test(_Part, frozen=True):
    """A sequence of steps from power-on."""

    tcId: Annotated[int, Meta(ge=1)]  # noqa: N815
    id: Name
    comment: Text
    steps: list[Step]
    result: Literal["valid", "acceptable"] = "valid"
    flags: list[Name] = []
    needs: list[Name] = []
    """Local events that the bench must be able to raise."""
    requires: bool = False
    """Whether test 1, which shows the configuration that is taken for granted, must have passed."""
    clauses: list[Name] = []


class TestGroup(_Part, frozen=True):
    """Tests of one layer that follow each other."""

    type: Name
    tests: list[Test]


class Note(_Part, frozen=True):
    """What a flag hunts."""

    bugType: Text  # noqa: N815
    description: Text


class Generator(_Part, frozen=True):
    """What made the file."""

    name: Name
    version: Name
    depth: Name
    mailbox: Text = ""
    seed: int = 0
    only: list[Name] = []


class Spec(_Part, frozen=True):
    """The texts that the tests come from."""

    name: Name
    title: Text
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


class Area(_Part, frozen=True):
    """A piece of memory."""

    address: Address
    length: Length


class Config(_Part, frozen=True):
    """Where the mailbox is, how a message that waits is seen, and what may come unasked.

    A message is `mailboxHead` bytes and as many more as `mailboxLength` in it says; places in it
    count from its beginning.
    """

    mailboxOut: Area  # noqa: N815
    mailboxIn: Area  # noqa: N815
    mailboxFull: Area  # noqa: N815
    mailboxFullMask: Hex  # noqa: N815
    mailboxHead: Length  # noqa: N815
    mailboxLength: Area  # noqa: N815
    mailboxCounter: Area  # noqa: N815
    mailboxCounterMask: Hex  # noqa: N815
    requestUs: Microseconds  # noqa: N815
    passOver: list[Allowed] = []  # noqa: N815


class Guarantee(_Part, frozen=True):
    """What a complete suite among the tests promises."""

    tests: Text
    method: Name
    m: Count
    k: Count
    checked: Name


class Clause(_Part, frozen=True):
    """A statement of the standard or of a manual."""

    level: Level
    says: Text
    source: Text


class Head(_Part, frozen=True):
    """All of a file but the tests, in the order of the file."""

    schema: Literal["ecatspec.vectors"]
    schema_version: Literal[1]
    generator: Generator
    spec: Spec
    numberOfTests: Count  # noqa: N815
    header: list[Text]
    notes: dict[Name, Note]
    guarantee: list[Guarantee]
    choices: dict[Name, Name]
    open: dict[Name, Name]
    config: Config
    rules: dict[Name, list[Name]]
    clauses: dict[Name, Clause]


class Vectors(Head, frozen=True):
    """A whole file; large ones are read and written test by test instead."""

    testGroups: list[TestGroup]  # noqa: N815


def json_schema() -> dict[str, Any]:
    """Give the JSON Schema of a file, closed: nothing may be there that it does not name."""
    schema = msgspec.json.schema(Vectors)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
