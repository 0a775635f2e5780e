"""EtherCAT datagrams in a frame: read, written, and passed on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final, TypeAlias

from ecatspec.model.esc.fmmu import fmmu_registers

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import Register

ETHERNET_ADDRESS: Final = 6
"""Bytes of an address of Ethernet; a frame begins with those of receiver and sender."""
EVERYBODY: Final = bytes([0xFF] * ETHERNET_ADDRESS)
_VLAN_TAG: Final = 4
_TYPE: Final = 2
_SHORTEST_FRAME: Final = 60
"""Bytes of a frame without its check sequence; what is shorter is filled up."""
_LONGEST_PAYLOAD: Final = 1500


@dataclass(frozen=True, slots=True)
class Bits:
    """A field of a header: bit offset and width in the little-endian header."""

    offset: int
    width: int
    mask: int = field(init=False)

    def __post_init__(self) -> None:
        """Work the mask out once: it is needed several times for each datagram."""
        object.__setattr__(self, "mask", (1 << self.width) - 1)

    def of(self, header: int) -> int:
        """Give the value of the field in a header read as one little-endian number."""
        return header >> self.offset & self.mask

    def put(self, header: int, value: int) -> int:
        """Give a header with another value of the field."""
        return header & ~(self.mask << self.offset) | (value & self.mask) << self.offset


@dataclass(frozen=True, slots=True)
class WireFormat:
    """Every protocol number of the wire, filled from the texts."""

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
    interrupt: Bits
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

    @property
    def positions(self) -> int:
        """Give how many positions a datagram can name: they are counted round."""
        return 1 << self.adp.width

    @property
    def longest_data(self) -> int:
        """Give the most data that one datagram alone in a frame can have."""
        around = self.ethercat_header_size + self.datagram_header_size + self.working_counter_size
        return _LONGEST_PAYLOAD - around


def wire_format(model: Model) -> WireFormat:
    """Give the layout of frames on the wire as the texts say it."""
    codec = model.codec

    def bits(frame: str, name: str) -> Bits:
        return Bits(*codec.place(frame, name))

    register = model.protocol.registers["station_address"]
    return WireFormat(
        fmmus=fmmu_registers(model.protocol),
        ethertype=model.parameter("ether_type"),
        vlan_ethertype=model.parameter("vlan_type"),
        vlan_tag_size=_VLAN_TAG,
        source_mac_offset=ETHERNET_ADDRESS,
        source_mac_size=ETHERNET_ADDRESS,
        source_mac_returned_bit=model.parameter("returned_source_bit"),
        ethercat_header_size=codec.size("ethercat_header"),
        ethercat_length=bits("ethercat_header", "frame_length"),
        ethercat_type=bits("ethercat_header", "frame_type"),
        ethercat_type_datagrams=model.parameter("datagram_frame_type"),
        datagram_header_size=codec.size("datagram_header"),
        command=bits("datagram_header", "command"),
        index=bits("datagram_header", "number"),
        adp=bits("datagram_header", "position"),
        ado=bits("datagram_header", "offset"),
        length=bits("datagram_header", "size"),
        more=bits("datagram_header", "more"),
        interrupt=bits("datagram_header", "interrupt"),
        working_counter_size=codec.size("datagram_trailer"),
        working_counter_read=model.parameter("counter_of_a_read"),
        working_counter_write=model.parameter("counter_of_a_write"),
        commands={row.name: row.value for row in model.protocol.tables["datagram_command"].rows},
        station_address_register=register.address,
        station_address_size=register.size,
    )


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
    counts_up: bool
    """Each SubDevice that a frame passes adds one to the ADP."""
    others_write: bool
    """What the one addressed has read, all others write."""


COMMANDS: Final = {
    name: Command(
        name,
        addressing,
        reads,
        writes,
        counts_up=addressing in {Addressing.POSITION, Addressing.ALL},
        others_write=name in {"ARMW", "FRMW"},
    )
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
}


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


Visit: TypeAlias = Callable[[Command, int, int, bytes], tuple[int, bytes, int, int]]
"""What a SubDevice makes of a command with ADP, ADO and data as it passes: the ADP and the data
that go on, what it adds to the working counter, and its bits of the interrupt field."""


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a datagram lies in a frame."""

    header: int
    """The header as one number."""
    at: int
    start: int
    stop: int
    command: Command | None


class Wire:
    """Ethernet bytes to datagrams, and back."""

    def __init__(self, wire: WireFormat) -> None:
        """Take the numbers of the protocol."""
        self.format = wire
        self._commands = {
            number: COMMANDS[name] for name, number in wire.commands.items() if name in COMMANDS
        }

    # --- reading ----------------------------------------------------------------------------------

    def begin(self, data: bytes | bytearray) -> int | None:
        """Give where the EtherCAT part of an Ethernet frame begins, None when it has none."""
        wire = self.format
        at = wire.source_mac_offset + wire.source_mac_size
        kind = int.from_bytes(data[at : at + _TYPE], "big")
        if kind == wire.vlan_ethertype:
            at += wire.vlan_tag_size
            kind = int.from_bytes(data[at : at + _TYPE], "big")
        return at + _TYPE if kind == wire.ethertype and len(data) >= at + _TYPE else None

    def payload(self, data: bytes) -> bytes | None:
        """Give the EtherCAT part of an Ethernet frame, None when it has none."""
        at = self.begin(data)
        return None if at is None else data[at:]

    def source(self, data: bytes) -> tuple[bytes, bool]:
        """Give the address of the MainDevice without the returned bit, and the bit."""
        wire = self.format
        start = wire.source_mac_offset
        mac = bytearray(data[start : start + wire.source_mac_size])
        marked = bool(mac[0] & wire.source_mac_returned_bit)
        mac[0] &= ~wire.source_mac_returned_bit
        return bytes(mac), marked

    def datagrams(self, payload: bytes) -> tuple[tuple[Datagram, ...], bool]:
        """Give the good datagrams, and whether all is well formed."""
        wire, good = self.format, True
        found: list[Datagram] = []
        for place in self._places(payload, 0):
            if place is None or place.command is None:
                good = False
                continue
            header, end = place.header, place.stop + wire.working_counter_size
            found.append(
                Datagram(
                    place.command,
                    wire.index.of(header),
                    wire.adp.of(header),
                    wire.ado.of(header),
                    payload[place.start : place.stop],
                    int.from_bytes(payload[place.stop : end], "little"),
                )
            )
        return tuple(found), good

    def _places(self, data: bytes | bytearray, at: int) -> Iterator[_Place | None]:
        """Yield where datagrams lie from `at` on; None: something is not well formed."""
        wire = self.format
        first = at + wire.ethercat_header_size
        if len(data) < first:
            yield None
            return
        header = int.from_bytes(data[at:first], "little")
        if wire.ethercat_type.of(header) != wire.ethercat_type_datagrams:
            return
        end = first + wire.ethercat_length.of(header)
        if end > len(data):
            yield None
            end = len(data)
        at, more = first, True
        while more:
            start = at + wire.datagram_header_size
            header = int.from_bytes(data[at:start], "little")
            stop = start + wire.length.of(header)
            after = stop + wire.working_counter_size
            if start > end or after > end:
                yield None
                return
            yield _Place(header, at, start, stop, self._commands.get(wire.command.of(header)))
            at, more = after, bool(wire.more.of(header))

    # --- writing ----------------------------------------------------------------------------------

    def encode(self, datagrams: Iterable[Datagram]) -> bytes:
        """Give the EtherCAT part of a frame that holds these datagrams."""
        wire, parts = self.format, list(datagrams)
        body = b""
        for left, datagram in enumerate(reversed(parts)):
            header = wire.command.put(0, wire.commands[datagram.command.name])
            header = wire.index.put(header, datagram.index)
            header = wire.adp.put(header, datagram.adp)
            header = wire.ado.put(header, datagram.ado)
            header = wire.length.put(header, len(datagram.data))
            header = wire.more.put(header, int(left > 0))
            counter = datagram.working_counter.to_bytes(wire.working_counter_size, "little")
            begin = header.to_bytes(wire.datagram_header_size, "little")
            body = begin + datagram.data + counter + body
        header = wire.ethercat_length.put(0, len(body))
        header = wire.ethercat_type.put(header, wire.ethercat_type_datagrams)
        return header.to_bytes(wire.ethercat_header_size, "little") + body

    def frame(self, source: bytes, datagrams: Iterable[Datagram]) -> bytes:
        """Give an Ethernet frame to everybody, as short as its datagrams let it be."""
        kind = self.format.ethertype.to_bytes(_TYPE, "big")
        return EVERYBODY + source + kind + self.encode(datagrams)

    def marked(self, source: bytes) -> bytes:
        """Give the address of a sender as it is in a frame that came back."""
        return bytes([source[0] | self.format.source_mac_returned_bit]) + source[1:]

    # --- passing on -------------------------------------------------------------------------------

    def pass_on(self, frame: bytearray, visits: Iterable[Visit]) -> bool:
        """Let SubDevices work on a frame, in their order, as it passes; False: it has no datagrams.

        What is not well formed passes as it is, from there on. The frame is marked as returned.
        """
        begin = self.begin(frame)
        if begin is None:
            return False
        wire = self.format
        places = [place for place in self._places(frame, begin) if place and place.command]
        for visit in visits:
            places = [self._visited(frame, place, visit) for place in places]
        frame[wire.source_mac_offset] |= wire.source_mac_returned_bit
        return True

    def _visited(self, frame: bytearray, place: _Place, visit: Visit) -> _Place:
        wire, command = self.format, place.command
        if command is None:
            return place
        before, start, stop = place.header, place.start, place.stop
        sent = bytes(frame[start:stop])
        adp, data, counted, interrupt = visit(
            command, wire.adp.of(before), wire.ado.of(before), sent
        )
        header = wire.adp.put(before, adp) | wire.interrupt.put(0, interrupt)
        if data is not sent:
            frame[start:stop] = data
        if counted:
            end = stop + wire.working_counter_size
            counter = int.from_bytes(frame[stop:end], "little") + counted
            counter &= (1 << 8 * wire.working_counter_size) - 1
            frame[stop:end] = counter.to_bytes(wire.working_counter_size, "little")
        if header == before:
            return place
        frame[place.at : start] = header.to_bytes(wire.datagram_header_size, "little")
        return _Place(header, place.at, start, stop, command)


def filled(frame: bytes) -> bytes:
    """Give a frame that is long enough for Ethernet."""
    return frame.ljust(_SHORTEST_FRAME, b"\0")
