"""Measures long SDO transfers: ours checked, the rival's between its own ends.

The rival is the package canopen: its client writes and reads an object of its own server over a bus
that is a call from one to the other. Ours is a session with the virtual SubDevice, and the oracle
judges every exchange. A segment over EtherCAT is as long as the mailbox, on CAN it has seven bytes;
neither end can do otherwise.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import canopen
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes
from exchanges import CHOICES
from measure import Effort, Found, Of, Part, Profile, Row, Target, in_turns, profiled, rate

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.run.session import Session
from ecatspec.generators.cases.bringup import way_to
from ecatspec.generators.cases.transfers import normal_download, pattern, read
from ecatspec.model.core.compilation import Model
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.generators.cases.case import Stimulus

KEY: Final = (0x2000, 0)
NODE: Final = 1
MAILBOX: Final = 1486
"""The longest mailbox that a frame carries."""
TEXT: Final = """device long extends standard "a device with one long object"

clause LON-01 must "the object is as long as the benchmark wants" source "this text"

dictionary closed [LON-01]

objects
  0x{index:04X} : {subindex} long bytes({size}) rw [LON-01]
"""


class Bus(canopen.Network):
    """A bus with two ends: what one sends the other has got when the call returns."""

    other: Bus

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:  # noqa: ANN401, ARG002, FBT001, FBT002  as the package declares it
        self.other.notify(can_id, bytearray(data), 0.0)


def ends(size: int) -> Any:  # noqa: ANN401  the package has no types
    """Give the rival's client, on a bus with its own server."""
    objects = ObjectDictionary()
    variable: Any = ODVariable("long", *KEY)
    variable.data_type, variable.access_type = datatypes.DOMAIN, "rw"
    variable.default = bytes(size)
    objects.add_object(variable)
    client, server = Bus(), Bus()
    client.other, server.other = server, client
    server.create_node(NODE, objects)
    remote = client.add_node(NODE, objects)
    remote.sdo.RESPONSE_TIMEOUT = 5
    return remote.sdo


class Checked:
    """Our session at PREOP, with a device that has the object."""

    def __init__(self, size: int) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "long.ecs"
            index, subindex = KEY
            path.write_text(TEXT.format(index=index, subindex=subindex, size=size), "utf-8")
            self.model = Model(load(str(path), str(MAILBOX)), closed=True)
            self._adapter = make(str(path), {"mailbox": str(MAILBOX)})
        self.session = Session(self._adapter, self.model, Oracle(self.model))
        self.session.begin(CHOICES)
        self.give(way_to(self.model, "PREOP"))

    def give(self, stimuli: Sequence[Stimulus]) -> None:
        """Give stimuli; nothing is said of them, as no one reads it."""
        for stimulus in stimuli:
            self.session.apply(stimulus)
        self.session.forget_trace()


def measure(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Write an object to its end, then read it."""
    download, upload = rows
    size = effort.of(1_000_000, 100_000, 10_000)
    value = pattern(size)
    checked, sdo = Checked(size), ends(size)
    writing = normal_download(checked.model, KEY, value)
    rounds = effort.of(3, 2, 1)
    found = []
    works = (
        (download, partial(checked.give, writing), partial(sdo.download, *KEY, value)),
        (upload, partial(checked.give, read(*KEY)), partial(sdo.upload, *KEY)),
    )
    for row, ours, rival in works:
        before = checked.session.exchanges
        mine, theirs = in_turns(rounds, ours, rival, warm=False)
        count = (checked.session.exchanges - before) // rounds
        note = (
            f"{size:,} bytes, mailboxes of {MAILBOX} bytes, {count:,} exchanges judged; the rival "
        )
        note += "sends seven bytes a frame and judges nothing"
        found.append(row.found(rate(size, mine), rate(size, theirs), note))
    assert bytes(sdo.upload(*KEY)) == value
    return Found(tuple(found))


def profile(*, upload: bool, effort: Effort) -> Profile:
    size = effort.of(1_000_000, 100_000, 10_000)
    checked = Checked(size)
    writing = normal_download(checked.model, KEY, pattern(size))
    if not upload:
        return profiled(partial(checked.give, writing))
    checked.give(writing)  # what was never written has no bytes to read
    return profiled(partial(checked.give, read(*KEY)))


_WHY: Final = (
    "Each segment is a request and an answer through mailboxes, and each exchange of it is judged."
)
_BESIDE: Final = "canopen, its client against its own server"

PARTS: Final = (
    Part(
        (
            Row(
                "transfer-download",
                "segmented download through the checked path",
                "bytes a second",
                _BESIDE,
                Target(Of.RATIO, 5.0, least=True),
                _WHY,
            ),
            Row(
                "transfer-upload",
                "segmented upload through the checked path",
                "bytes a second",
                _BESIDE,
                Target(Of.RATIO, 5.0, least=True),
                _WHY,
            ),
        ),
        measure,
        {
            "transfer-download": lambda effort: profile(upload=False, effort=effort),
            "transfer-upload": lambda effort: profile(upload=True, effort=effort),
        },
    ),
)
