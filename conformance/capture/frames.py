"""The only place for EtherCAT frames on a wire: datagrams, and which request came back.

The numbers of the protocol come in as a `WireFormat`.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.spec.language.ir import Register

_PAIRED_SHARE: Final = 0.8

# --- the wire, as the specification states it -----------------------------------------------------


@dataclass(frozen=True, slots=True)
class Bits:
    """A field of a header: bit offset and width in the little-endian header."""

    offset: int
    width: int

    def of(self, header: int) -> int:
        """Give the value of the field in a header read as one little-endian number."""
        return header >> self.offset & ((1 << self.width) - 1)


@dataclass(frozen=True, slots=True)
class WireFormat:
    """Every protocol number this module needs, filled from the texts."""

    ethertype: int
    vlan_ethertype: int
    vlan_tag_size: int
    source_mac_offset: int
    source_mac_size: int
    source_mac_returned_bit: int
    ethercat_header_size: int
    ethercat_length: Bits
    ethercat_type: Bits
    ethercat_type_datagrams: int
    datagram_header_size: int
    command: Bits
    index: Bits
    adp: Bits
    ado: Bits
    length: Bits
    more: Bits
    working_counter_size: int
    working_counter_read: int
    """What a read adds to the working counter of a command that reads and writes."""
    working_counter_write: int
    """What a write adds to the working counter of a command that reads and writes."""
    commands: Mapping[str, int]
    """Name as in the table of commands (NOP, APRD ...) to number."""
    station_address_register: int
    station_address_size: int
    fmmus: tuple[Register, ...] = ()
    """Registers of the FMMUs; without them logical datagrams are left out."""


class Addressing(Enum):
    """How a command says which SubDevice it means."""

    NONE = "none"
    POSITION = "position"
    STATION = "station"
    ALL = "all"
    LOGICAL = "logical"


@dataclass(frozen=True, slots=True)
class Command:
    """What a command does with the memory of those that it addresses."""

    name: str
    addressing: Addressing
    reads: bool
    writes: bool

    @property
    def counts_up(self) -> bool:
        """Whether each SubDevice that a frame passes adds one to the ADP."""
        return self.addressing in {Addressing.POSITION, Addressing.ALL}


# ARMW and FRMW: a read for the SubDevice addressed; what the others write is not followed.
_COMMANDS: Final = tuple(
    Command(name, addressing, reads, writes)
    for name, addressing, reads, writes in (
        ("NOP", Addressing.NONE, False, False),
        ("APRD", Addressing.POSITION, True, False),
        ("APWR", Addressing.POSITION, False, True),
        ("APRW", Addressing.POSITION, True, True),
        ("FPRD", Addressing.STATION, True, False),
        ("FPWR", Addressing.STATION, False, True),
        ("FPRW", Addressing.STATION, True, True),
        ("BRD", Addressing.ALL, True, False),
        ("BWR", Addressing.ALL, False, True),
        ("BRW", Addressing.ALL, True, True),
        ("LRD", Addressing.LOGICAL, True, False),
        ("LWR", Addressing.LOGICAL, False, True),
        ("LRW", Addressing.LOGICAL, True, True),
        ("ARMW", Addressing.POSITION, True, False),
        ("FRMW", Addressing.STATION, True, False),
    )
)


# --- frames and datagrams -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Datagram:
    """One datagram of a frame, as sent or as returned."""

    command: Command
    index: int
    adp: int
    ado: int
    data: bytes
    working_counter: int

    def signature(self) -> tuple[object, ...]:
        """Give what does not change on the way round the segment."""
        pure_write = self.command.writes and not self.command.reads
        return (
            self.command.name,
            self.index,
            self.ado,
            None if self.command.counts_up else self.adp,
            self.data if pure_write else len(self.data),
        )


@dataclass(frozen=True, slots=True)
class Frame:
    """An EtherCAT frame; `marked`: the source address has the bit of a frame that came back."""

    number: int
    nanoseconds: int
    source: bytes
    marked: bool
    datagrams: tuple[Datagram, ...]

    @property
    def counted(self) -> bool:
        """Whether somebody counted up a working counter."""
        return any(datagram.working_counter for datagram in self.datagrams)

    def signature(self) -> tuple[object, ...]:
        """Give what does not change on the way round the segment."""
        return (self.source, *(datagram.signature() for datagram in self.datagrams))

    def passed(self, request: Frame) -> int | None:
        """Give how many SubDevices the frame passed, None when no datagram shows it."""
        for before, after in zip(request.datagrams, self.datagrams, strict=True):
            if after.command.counts_up:
                return after.adp - before.adp
        return None


class Decoder:
    """Ethernet bytes to datagrams."""

    def __init__(self, wire: WireFormat) -> None:
        """Take the numbers of the protocol."""
        self._wire = wire
        commands = {command.name: command for command in _COMMANDS}
        self._commands = {
            number: commands[name] for name, number in wire.commands.items() if name in commands
        }

    def payload(self, data: bytes) -> bytes | None:
        """Give the EtherCAT part of an Ethernet frame, None when it has none."""
        wire = self._wire
        at = wire.source_mac_offset + wire.source_mac_size
        kind = int.from_bytes(data[at : at + 2], "big")
        if kind == wire.vlan_ethertype:
            at += wire.vlan_tag_size
            kind = int.from_bytes(data[at : at + 2], "big")
        return data[at + 2 :] if kind == wire.ethertype and len(data) >= at + 2 else None

    def source(self, data: bytes) -> tuple[bytes, bool]:
        """Give the address of the MainDevice without the returned bit, and the bit."""
        wire = self._wire
        start = wire.source_mac_offset
        mac = bytearray(data[start : start + wire.source_mac_size])
        marked = bool(mac[0] & wire.source_mac_returned_bit)
        mac[0] &= ~wire.source_mac_returned_bit
        return bytes(mac), marked

    def datagrams(self, payload: bytes) -> tuple[tuple[Datagram, ...], bool]:
        """Give the good datagrams, and whether all is well formed."""
        wire = self._wire
        at = wire.ethercat_header_size
        if len(payload) < at:
            return (), False
        header = int.from_bytes(payload[:at], "little")
        if wire.ethercat_type.of(header) != wire.ethercat_type_datagrams:
            return (), True
        end = at + wire.ethercat_length.of(header)
        good, end = end <= len(payload), min(end, len(payload))
        found: list[Datagram] = []
        more = True
        while more:
            start = at + wire.datagram_header_size
            if start > end:
                return tuple(found), False
            header = int.from_bytes(payload[at:start], "little")
            stop = start + wire.length.of(header)
            at = stop + wire.working_counter_size
            if at > end:
                return tuple(found), False
            command = self._commands.get(wire.command.of(header))
            if command is None:
                good = False
            else:
                found.append(
                    Datagram(
                        command,
                        wire.index.of(header),
                        wire.adp.of(header),
                        wire.ado.of(header),
                        payload[start:stop],
                        int.from_bytes(payload[stop:at], "little"),
                    )
                )
            more = bool(wire.more.of(header))
        return tuple(found), good


# --- requests and returns -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Request:
    serial: int
    frame: Frame
    signature: tuple[object, ...]


class Pending:
    """Requests that have not come back, in the order they were sent."""

    def __init__(self) -> None:
        """Begin without any."""
        self._requests: dict[int, _Request] = {}
        self._by_signature: dict[tuple[object, ...], deque[_Request]] = {}
        self._serial = 0
        self._last: dict[bytes, int] = {}

    def add(self, frame: Frame) -> None:
        """Take in a request."""
        self._serial += 1
        request = _Request(self._serial, frame, frame.signature())
        self._requests[request.serial] = request
        self._by_signature.setdefault(request.signature, deque()).append(request)

    def match(self, frame: Frame, size: int | None) -> Frame | None:
        """Take out the request of a returned frame: the first that no other frame has overtaken.

        Frames keep their order on a segment, so a request older than one that came back is most
        likely lost.
        """
        waiting = self._by_signature.get(frame.signature())
        if not waiting:
            return None
        last = self._last.get(frame.source, 0)
        request = min(
            waiting,
            key=lambda one: (
                size is not None and frame.passed(one.frame) not in {size, None},
                one.serial <= last,
                one.serial,
            ),
        )
        self._last[frame.source] = max(last, request.serial)
        self._remove(request)
        return request.frame

    def expired(self, before: int | None) -> Iterator[Frame]:
        """Take out the requests sent before a frame number, or all of them."""
        while self._requests:
            request = next(iter(self._requests.values()))
            if before is not None and request.frame.number >= before:
                return
            self._remove(request)
            yield request.frame

    def overtaken(self, source: bytes) -> Iterator[Frame]:
        """Take out the requests older than the last that came back: they are lost."""
        last = self._last.get(source, 0)
        lost = [r for r in self._requests.values() if r.serial < last and r.frame.source == source]
        for request in lost:
            self._remove(request)
            yield request.frame

    def _remove(self, request: _Request) -> None:
        del self._requests[request.serial]
        waiting = self._by_signature[request.signature]
        waiting.remove(request)
        if not waiting:
            del self._by_signature[request.signature]


def come_in_pairs(frames: list[Frame]) -> bool:
    """Tell whether requests and returns look alike: no mark, yet they come in pairs.

    That is a MainDevice with a locally administered address, whose frames carry the mark from the
    start, or an emulated segment that does not set it.
    """
    if len({frame.marked for frame in frames}) != 1:
        return False
    open_requests: Counter[tuple[object, ...]] = Counter()
    pairs = 0
    for frame in frames:
        signature = frame.signature()
        if open_requests[signature]:
            open_requests[signature] -= 1
            pairs += 1
        elif not frame.counted:
            open_requests[signature] += 1
    return 2 * pairs >= _PAIRED_SHARE * len(frames)
