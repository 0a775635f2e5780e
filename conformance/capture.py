"""The only place that reads capture files: pcap or pcapng in, transactions per SubDevice out.

A MainDevice sends a frame and the same frame comes back; a capture holds both. This module pairs
the two and yields what the pair did: one read or write of ESC memory, with its working counter. A
logical datagram becomes the accesses that the FMMUs make of it, as far as the capture shows how
they are set. The numbers of the protocol come in as a `WireFormat`; only the numbers of the two
file formats stand here. Memory stays flat however long the capture is.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum
from itertools import chain, islice
from typing import TYPE_CHECKING, BinaryIO, Final, Protocol

import dpkt
import dpkt.pcapng

from ecatspec.model.fmmu import Fmmu

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from ecatspec.model.fmmu import Share
    from ecatspec.spec.language.ir import Register

LOST_AFTER: Final = 1000
"""A request is given up when it is this many frames old."""
_WINDOW: Final = 256
_PAIRED_SHARE: Final = 0.8
_LARGEST_BLOCK: Final = 1 << 26
_NANOSECONDS: Final = 10**9
_GZIP: Final = b"\x1f\x8b"


class CaptureError(Exception):
    """A capture that cannot be used: one line with what is wrong, where, and what to do."""

    def __init__(self, what: str, where: str, remedy: str) -> None:
        super().__init__(f"{where}: {what}; {remedy}")
        self.what = what
        self.where = where
        self.remedy = remedy


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


class _Addressing(Enum):
    NONE = "none"
    POSITION = "position"
    STATION = "station"
    ALL = "all"
    LOGICAL = "logical"


@dataclass(frozen=True, slots=True)
class _Command:
    name: str
    addressing: _Addressing
    reads: bool
    writes: bool

    @property
    def counts_up(self) -> bool:
        """Whether each SubDevice that a frame passes adds one to the ADP."""
        return self.addressing in {_Addressing.POSITION, _Addressing.ALL}


# ARMW and FRMW: a read for the SubDevice addressed; what the others write is not followed.
_COMMANDS: Final = tuple(
    _Command(name, addressing, reads, writes)
    for name, addressing, reads, writes in (
        ("NOP", _Addressing.NONE, False, False),
        ("APRD", _Addressing.POSITION, True, False),
        ("APWR", _Addressing.POSITION, False, True),
        ("APRW", _Addressing.POSITION, True, True),
        ("FPRD", _Addressing.STATION, True, False),
        ("FPWR", _Addressing.STATION, False, True),
        ("FPRW", _Addressing.STATION, True, True),
        ("BRD", _Addressing.ALL, True, False),
        ("BWR", _Addressing.ALL, False, True),
        ("BRW", _Addressing.ALL, True, True),
        ("LRD", _Addressing.LOGICAL, True, False),
        ("LWR", _Addressing.LOGICAL, False, True),
        ("LRW", _Addressing.LOGICAL, True, True),
        ("ARMW", _Addressing.POSITION, True, False),
        ("FRMW", _Addressing.STATION, True, False),
    )
)


# --- what comes out -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Transaction:
    """One read or one write of the memory of one SubDevice, or of all.

    A command that reads and writes gives two, the read first. An unconfirmed access is yielded
    when a later request came back, or when its own is given up, so later than its time.
    """

    frame: int
    """Number of the returned frame, from 1 as in Wireshark; of the request if not confirmed."""
    time: float
    """Seconds since the first frame of the capture, of the frame above."""
    sent: float
    """Time of the request; `time` when the request is not in the capture."""
    device: int | None
    """Identity of the SubDevice, see `Segment`; None is all of them (broadcast)."""
    write: bool
    address: int
    data: bytes
    working_counter: int
    """As returned; of a command that reads and writes, the sum of both halves.

    All SubDevices share that of a logical datagram: here it is 1 for what was carried out.
    """
    confirmed: bool
    """False for an access of which nobody knows whether it took effect.

    Its return was not captured, or the working counter of a logical datagram does not say whose
    part of it was carried out.
    """
    command: str
    """Name of the command of the datagram."""
    done: bool
    """Whether the working counter says it was carried out (broadcast: by at least one)."""


@dataclass(frozen=True, slots=True)
class Statistics:
    """What was seen so far in a capture."""

    frames: int = 0
    ethercat_frames: int = 0
    requests: int = 0
    returns: int = 0
    datagrams: int = 0
    malformed: int = 0
    """Frames with a length beyond the frame or an unknown command; the good datagrams count."""
    lost_requests: int = 0
    """Request frames without a return."""
    unmatched_returns: int = 0
    """Returned frames without a request."""
    unplaced: int = 0
    """Returned datagrams without a known position, because the request was not captured."""


class Segment:
    """Who is who: resolves positions and station addresses to identities of SubDevices.

    The identity is the position (0 = first) when it is known, otherwise a number above all
    positions. It stays the same when the station address is written later. When a read of the
    station address shows that two identities were one SubDevice all along, `canonical` gives the
    one that goes on.
    """

    def __init__(self, wire: WireFormat) -> None:
        self._wire = wire
        self._modulus = 1 << wire.adp.width
        self._by_station: dict[int, int] = {}
        self._station: dict[int, int] = {}
        self._merged: dict[int, int] = {}
        self._answered: set[int] = set()
        self._fresh = self._modulus
        self.size: int | None = None
        """Number of SubDevices that a frame passes, once a return has shown it."""

    @property
    def devices(self) -> tuple[int, ...]:
        """Identities of the SubDevices that answered at least once."""
        return tuple(sorted({self.canonical(device) for device in self._answered}))

    def at_station(self, station: int) -> int:
        """Give the identity behind a station address, a fresh one for a new address."""
        device = self._by_station.get(station)
        if device is None:
            device = self._fresh
            self._fresh += 1
            self._by_station[station] = device
            self._station[device] = station
        return device

    def canonical(self, device: int) -> int:
        """Give the identity that goes on for a SubDevice that was taken for two."""
        while device in self._merged:
            device = self._merged[device]
        return device

    def name(self, device: int | None) -> str:
        """Give the station address as text, or the position before there is one."""
        if device is None:
            return "all"
        device = self.canonical(device)
        station = self._station.get(device)
        return f"position {device}" if station is None else f"0x{station:04X}"

    def observe(self, transaction: Transaction) -> None:
        """Learn from a confirmed access: who answered, and who has which station address."""
        if not (transaction.confirmed and transaction.done):
            return
        device = transaction.device
        if device is not None:
            self._answered.add(device)
        start = self._wire.station_address_register - transaction.address
        value = transaction.data[max(start, 0) : max(start + self._wire.station_address_size, 0)]
        if start < 0 or len(value) < self._wire.station_address_size:
            return
        station = int.from_bytes(value, "little")
        if device is not None:
            self._learn(device, station, write=transaction.write)
        elif transaction.write:
            self._by_station.clear()
            self._station.clear()

    def _learn(self, device: int, station: int, *, write: bool) -> None:
        if self._station.get(device) == station and self._by_station.get(station) == device:
            return
        other = self._by_station.pop(station, None)
        if other is not None and other != device:
            self._station.pop(other, None)
            if not write and other >= self._modulus > device:
                self._merged[other] = device
        old = self._station.pop(device, None)
        if old is not None and self._by_station.get(old) == device:
            del self._by_station[old]
        if station:
            self._by_station[station] = device
            self._station[device] = station


class _Mappings:
    """What the capture has shown of the FMMUs of each SubDevice."""

    def __init__(self, wire: WireFormat, segment: Segment) -> None:
        self._registers = wire.fmmus
        self._segment = segment
        spans = (range(register.address, _end(register)) for register in wire.fmmus)
        self._addresses = frozenset(chain.from_iterable(spans))
        self._everywhere: dict[int, int] = {}
        self._bytes: dict[int, dict[int, int]] = {}
        self._fmmus: dict[int, tuple[Fmmu, ...]] | None = None

    def observe(self, transaction: Transaction) -> None:
        """Learn from an access to the registers; a write that got lost makes them unknown."""
        device, write = transaction.device, transaction.write
        data = {
            address: value
            for address, value in enumerate(transaction.data, transaction.address)
            if address in self._addresses
        }
        if not data or (device is None and not write):
            return
        if transaction.confirmed and transaction.done:
            for known in self._known(device):
                known.update(data)
        elif write and not transaction.confirmed:
            for known in self._known(device):
                for address in data:
                    known.pop(address, None)
        self._fmmus = None

    def _known(self, device: int | None) -> list[dict[int, int]]:
        """Give the bytes known of one SubDevice; of all, also of those that are still to come."""
        if device is None:
            return [self._everywhere, *self._bytes.values()]
        device = self._segment.canonical(device)
        return [self._bytes.setdefault(device, dict(self._everywhere))]

    def shares(self, address: int, length: int) -> list[tuple[int, Fmmu, Share]]:
        """Give what the FMMUs make of a logical access: SubDevice, FMMU, bits."""
        fmmus = self._fmmus
        if fmmus is None or any(self._segment.canonical(device) != device for device in fmmus):
            fmmus = self._fmmus = self._decoded()
        return [
            (device, fmmu, share)
            for device in sorted(fmmus)
            for fmmu in fmmus[device]
            if (share := fmmu.share(address, length)) is not None
        ]

    def _decoded(self) -> dict[int, tuple[Fmmu, ...]]:
        for device in [d for d in self._bytes if self._segment.canonical(d) != d]:
            known = self._bytes.pop(device)
            known.update(self._bytes.get(self._segment.canonical(device), {}))
            self._bytes[self._segment.canonical(device)] = known
        return {
            device: tuple(
                Fmmu.of(register, int.from_bytes(bytes(known[at] for at in span), "little"))
                for register in self._registers
                if known.keys() >= set(span := range(register.address, _end(register)))
            )
            for device, known in self._bytes.items()
        }


def _end(register: Register) -> int:
    return register.address + register.size


# --- the two file formats -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Packet:
    number: int
    nanoseconds: int
    data: bytes


class _BrokenError(Exception):
    """The file ends or stops making sense here; the frames before are good."""

    def __init__(self, what: str, offset: int) -> None:
        super().__init__(what)
        self.what = what
        self.offset = offset


class _Stream:
    """Exact reads that know their offset."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.offset = 0

    def take(self, size: int, what: str, *, end_allowed: bool = False) -> bytes:
        data = self._file.read(size)
        if len(data) < size and not (end_allowed and not data):
            message = f"the file ends in the middle of {what}"
            raise _BrokenError(message, self.offset)
        self.offset += len(data)
        return data


class _Reader(Protocol):
    def __call__(self, stream: _Stream, magic: bytes) -> Iterator[_Packet]: ...


def _read_pcap(stream: _Stream, magic: bytes) -> Iterator[_Packet]:
    """Yield the packets of a pcap file; an empty packet when the link is not Ethernet."""
    order = _PCAP_ORDER[magic]
    scale = _PCAP_SCALE[int.from_bytes(magic, "big" if order == ">" else "little")]
    start = struct.Struct(f"{order}HHiIII")
    link = start.unpack(stream.take(start.size, "the file header"))[-1] % (1 << 16)
    ethernet = link == dpkt.pcap.DLT_EN10MB
    header = struct.Struct(f"{order}IIII")
    number = 0
    while True:
        at = stream.offset
        head = stream.take(header.size, f"the header of frame {number + 1}", end_allowed=True)
        if not head:
            return
        seconds, fraction, captured, _ = header.unpack(head)
        if captured > _LARGEST_BLOCK:
            message = f"frame {number + 1} claims {captured} bytes"
            raise _BrokenError(message, at)
        data = stream.take(captured, f"frame {number + 1}")
        number += 1
        yield _Packet(number, seconds * _NANOSECONDS + fraction * scale, data if ethernet else b"")


_PCAP_SCALE: Final = {dpkt.pcap.TCPDUMP_MAGIC: 1000, dpkt.pcap.TCPDUMP_MAGIC_NANO: 1}
_PCAP_ORDER: Final = {
    magic.to_bytes(4, "big" if order == ">" else "little"): order
    for magic in _PCAP_SCALE
    for order in (">", "<")
}


@dataclass(frozen=True, slots=True)
class _Interface:
    ethernet: bool
    ticks: int
    """Ticks of the clock in one second."""
    offset: int

    def nanoseconds(self, high: int, low: int) -> int:
        return self.offset + (high << 32 | low) * _NANOSECONDS // self.ticks


_PCAPNG_MAGIC: Final = dpkt.pcapng.PCAPNG_BT_SHB.to_bytes(4, "big")
_SIMPLE_PACKET: Final = 3
_BLOCK_OVERHEAD: Final = 12


def _read_pcapng(stream: _Stream, magic: bytes) -> Iterator[_Packet]:
    """Yield the packets of a pcapng file with any number of sections and interfaces."""
    order = "<"
    interfaces: list[_Interface] = []
    number, clock, kind = 0, 0, magic
    while kind:
        at = stream.offset - len(kind)
        what = f"the block after frame {number}"
        size = stream.take(4, what)
        body = b""
        if kind == _PCAPNG_MAGIC:
            body = stream.take(4, what)
            order = _byte_order(body, at)
            interfaces = []
        length = struct.unpack(f"{order}I", size)[0]
        if not _BLOCK_OVERHEAD + len(body) <= length <= _LARGEST_BLOCK:
            message = f"{what} claims {length} bytes"
            raise _BrokenError(message, at)
        body += stream.take(length - 8 - len(body), what)
        block = struct.unpack(f"{order}I", kind)[0]
        try:
            if block == dpkt.pcapng.PCAPNG_BT_IDB:
                interfaces.append(_interface(kind + size + body, order))
            elif block in {dpkt.pcapng.PCAPNG_BT_EPB, dpkt.pcapng.PCAPNG_BT_PB, _SIMPLE_PACKET}:
                number += 1
                packet, clock = _packet(block, body[:-4], order, interfaces, clock)
                yield _Packet(number, clock, packet)
        except (dpkt.dpkt.Error, struct.error, ValueError, IndexError) as error:
            message = f"{what} makes no sense"
            raise _BrokenError(message, at) from error
        kind = stream.take(4, f"the block after frame {number}", end_allowed=True)


def _byte_order(mark: bytes, at: int) -> str:
    for order in "<>":
        if struct.unpack(f"{order}I", mark)[0] == dpkt.pcapng.BYTE_ORDER_MAGIC:
            return order
    message = "a section has no byte order mark"
    raise _BrokenError(message, at)


def _interface(block: bytes, order: str) -> _Interface:
    little = order == "<"
    name = "InterfaceDescriptionBlockLE" if little else "InterfaceDescriptionBlock"
    description = getattr(dpkt.pcapng, name)(block)
    ticks, offset = 10**6, 0
    for option in description.opts:
        if option.code == dpkt.pcapng.PCAPNG_OPT_IF_TSRESOL:
            power = option.data[0]
            ticks = 2 ** (power & 0x7F) if power & 0x80 else 10**power
        elif option.code == dpkt.pcapng.PCAPNG_OPT_IF_TSOFFSET:
            offset = int.from_bytes(option.data, "little" if little else "big", signed=True)
    return _Interface(description.linktype == dpkt.pcap.DLT_EN10MB, ticks, offset * _NANOSECONDS)


def _packet(
    block: int, body: bytes, order: str, interfaces: list[_Interface], clock: int
) -> tuple[bytes, int]:
    """Give the bytes and the time of a packet block; a simple packet has no time of its own."""
    if block == _SIMPLE_PACKET:
        (original,) = struct.unpack_from(f"{order}I", body)
        interface, data, captured = interfaces[0], body[4:], min(original, len(body) - 4)
    else:
        layout = f"{order}IIII" if block == dpkt.pcapng.PCAPNG_BT_EPB else f"{order}HxxIII"
        which, high, low, captured = struct.unpack_from(layout, body)
        interface, data = interfaces[which], body[20:]
        clock = interface.nanoseconds(high, low)
    if captured > len(data):
        message = "a packet is longer than its block"
        raise ValueError(message)
    return data[:captured] if interface.ethernet else b"", clock


_READERS: Final[Mapping[bytes, _Reader]] = {
    **dict.fromkeys(_PCAP_ORDER, _read_pcap),
    _PCAPNG_MAGIC: _read_pcapng,
}


# --- frames and datagrams -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Datagram:
    command: _Command
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
class _Frame:
    number: int
    nanoseconds: int
    source: bytes
    marked: bool
    datagrams: tuple[_Datagram, ...]

    @property
    def counted(self) -> bool:
        return any(datagram.working_counter for datagram in self.datagrams)

    def signature(self) -> tuple[object, ...]:
        return (self.source, *(datagram.signature() for datagram in self.datagrams))

    def passed(self, request: _Frame) -> int | None:
        """Give how many SubDevices the frame passed, None when no datagram shows it."""
        for before, after in zip(request.datagrams, self.datagrams, strict=True):
            if after.command.counts_up:
                return after.adp - before.adp
        return None


class _Decoder:
    """Ethernet bytes to datagrams."""

    def __init__(self, wire: WireFormat) -> None:
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

    def datagrams(self, payload: bytes) -> tuple[tuple[_Datagram, ...], bool]:
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
        found: list[_Datagram] = []
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
                    _Datagram(
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
    frame: _Frame
    signature: tuple[object, ...]


class _Pending:
    """Requests that have not come back, in the order they were sent."""

    def __init__(self) -> None:
        self._requests: dict[int, _Request] = {}
        self._by_signature: dict[tuple[object, ...], deque[_Request]] = {}
        self._serial = 0
        self._last: dict[bytes, int] = {}

    def add(self, frame: _Frame) -> None:
        self._serial += 1
        request = _Request(self._serial, frame, frame.signature())
        self._requests[request.serial] = request
        self._by_signature.setdefault(request.signature, deque()).append(request)

    def match(self, frame: _Frame, size: int | None) -> _Frame | None:
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

    def expired(self, before: int | None) -> Iterator[_Frame]:
        """Take out the requests sent before a frame number, or all of them."""
        while self._requests:
            request = next(iter(self._requests.values()))
            if before is not None and request.frame.number >= before:
                return
            self._remove(request)
            yield request.frame

    def overtaken(self, source: bytes) -> Iterator[_Frame]:
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


class Capture:
    """A capture file, ready to be read.

    Iterate to get the transactions; each iteration reads the file from the start. `statistics`,
    `segment` and `truncated` tell about the latest iteration, `truncated` when it has ended.
    """

    def __init__(self, path: Path, wire: WireFormat) -> None:
        """Remember what to read; nothing is opened before the iteration.

        Args:
            path: A pcap or pcapng file.
            wire: The numbers of the protocol.

        """
        self._path = path
        self._wire = wire
        self._decoder = _Decoder(wire)
        self._reset()

    def _reset(self) -> None:
        self.segment = Segment(self._wire)
        self._mappings = _Mappings(self._wire, self.segment)
        self.truncated: str | None = None
        self._count: Counter[str] = Counter()
        self._pending = _Pending()
        self._start = 0

    @property
    def statistics(self) -> Statistics:
        """What was seen so far."""
        return Statistics(**self._count)

    def __iter__(self) -> Iterator[Transaction]:
        """Yield the transactions in the order of the returned frames.

        Raises:
            CaptureError: There is no such file, it is no capture, or it holds no EtherCAT frame. A
                capture that breaks off yields all its complete frames first and then sets
                `truncated`.

        """
        self._reset()
        try:
            with self._path.open("rb") as file:
                yield from self._transactions(self._frames(file))
        except OSError as error:
            what = f"the file cannot be read ({error.strerror or error})"
            raise self._error(what, "give the path of a pcap or pcapng file") from error

    def _error(self, what: str, remedy: str, offset: int | None = None) -> CaptureError:
        at = "" if offset is None else f", offset {offset}"
        return CaptureError(what, f"{self._path}{at}", remedy)

    def _packets(self, file: BinaryIO) -> Iterator[_Packet]:
        stream = _Stream(file)
        try:
            magic = stream.take(4, "the file header", end_allowed=True)
            if not magic:
                raise self._error("the file is empty", "record the capture again")
            reader = _READERS.get(magic)
            if reader is None and magic.startswith(_GZIP):
                raise self._error("the file is compressed", "unpack it with gunzip first", 0)
            if reader is None:
                raise self._error("not a capture", "save it as pcap or pcapng", 0)
            yield from reader(stream, magic)
        except _BrokenError as broken:
            where = f"{self._path}, offset {broken.offset}"
            frames = self._count["frames"]
            remedy = f"the {frames} frames before it were used, record again for the rest"
            self.truncated = f"{where}: {broken.what}; {remedy}"
            if not frames:
                remedy = "record or copy the capture again"
                raise self._error(broken.what, remedy, broken.offset) from broken

    def _frames(self, file: BinaryIO) -> Iterator[_Frame]:
        """Yield the EtherCAT frames that hold datagrams."""
        for packet in self._packets(file):
            if not self._count["frames"]:
                self._start = packet.nanoseconds
            self._count["frames"] += 1
            payload = self._decoder.payload(packet.data)
            if payload is None:
                continue
            datagrams, good = self._decoder.datagrams(payload)
            self._count["ethercat_frames"] += 1
            self._count["datagrams"] += len(datagrams)
            self._count["malformed"] += not good
            if datagrams:
                source, marked = self._decoder.source(packet.data)
                yield _Frame(packet.number, packet.nanoseconds, source, marked, datagrams)
        if not self._count["ethercat_frames"]:
            frames = self._count["frames"]
            what = f"no EtherCAT frame among {frames} frames, or the link is not Ethernet"
            if self.truncated:
                what += ", and then the file breaks off"
            raise self._error(what, "record on the network interface of the MainDevice")

    def _transactions(self, frames: Iterator[_Frame]) -> Iterator[Transaction]:
        head = list(islice(frames, _WINDOW))
        paired = _come_in_pairs(head)
        for frame in chain(head, frames):
            for lost in self._pending.expired(frame.number - LOST_AFTER):
                yield from self._lost(lost)
            request: _Frame | None = None
            if frame.marked or frame.counted or paired:
                request = self._pending.match(frame, self.segment.size)
            if request is not None or (not paired and (frame.marked or frame.counted)):
                self._count["returns"] += 1
                if request is not None:
                    for lost in self._pending.overtaken(request.source):
                        yield from self._lost(lost)
                yield from self._returned(frame, request)
            else:
                self._count["requests"] += 1
                self._pending.add(frame)
        for lost in self._pending.expired(None):
            yield from self._lost(lost)

    def _returned(self, frame: _Frame, request: _Frame | None) -> Iterator[Transaction]:
        self._measure(frame, request)
        if request is None:
            self._count["unmatched_returns"] += 1
        befores = frame.datagrams if request is None else request.datagrams
        for before, after in zip(befores, frame.datagrams, strict=True):
            adp: int | None = before.adp
            if request is None and after.command.addressing is _Addressing.POSITION:
                size = self.segment.size
                adp = None if size is None else after.adp - size
            if adp is None:
                self._count["unplaced"] += 1
                continue
            if after.command.addressing is _Addressing.LOGICAL:
                accesses = self._logical(frame, request, before, after)
            else:
                accesses = self._halves(frame, request, before, after, adp)
            for transaction in accesses:
                self.segment.observe(transaction)
                self._mappings.observe(transaction)
                yield transaction

    def _measure(self, frame: _Frame, request: _Frame | None) -> None:
        """Learn the number of SubDevices: each adds one to the ADP, and a broadcast starts at 0."""
        if request is not None:
            size = frame.passed(request)
            if size is not None:
                self.segment.size = size % (1 << self._wire.adp.width)
        elif self.segment.size is None:
            for datagram in frame.datagrams:
                if datagram.command.addressing is _Addressing.ALL:
                    self.segment.size = datagram.adp

    def _halves(
        self, frame: _Frame, request: _Frame | None, before: _Datagram, after: _Datagram, adp: int
    ) -> Iterator[Transaction]:
        """Yield the read and the write of a returned datagram."""
        command = after.command
        both = command.reads and command.writes
        counter = after.working_counter
        wanted = {False: self._wire.working_counter_read, True: self._wire.working_counter_write}
        for write in (False, True):
            if not (command.writes if write else command.reads):
                continue
            if both and request is None and write:
                continue  # the data written went by before the capture started
            single = both and command.addressing is not _Addressing.ALL
            yield Transaction(
                frame=frame.number,
                time=self._seconds(frame),
                sent=self._seconds(request or frame),
                device=self._device(command, adp),
                write=write,
                address=after.ado,
                data=before.data if write else after.data,
                working_counter=counter,
                confirmed=True,
                command=command.name,
                done=bool(counter & wanted[write]) if single else counter > 0,
            )

    def _logical(
        self, frame: _Frame, request: _Frame | None, before: _Datagram, after: _Datagram
    ) -> Iterator[Transaction]:
        """Yield what the FMMUs make of a returned logical datagram, the reads first."""
        both = after.command.reads and after.command.writes
        shares = self._shares(after)
        done = self._carried_out(shares, after)
        for write, device, share in shares:
            if not share.whole_bytes or (both and request is None and write):
                continue  # a bit shows a mailbox state; the data written went by before the start
            outcome = done.get(write)
            yield Transaction(
                frame=frame.number,
                time=self._seconds(frame),
                sent=self._seconds(request or frame),
                device=device,
                write=write,
                address=share.address,
                data=share.taken(before.data if write else after.data, b""),
                working_counter=after.working_counter if outcome is None else int(outcome),
                confirmed=outcome is not None,
                command=after.command.name,
                done=bool(outcome),
            )

    def _shares(self, datagram: _Datagram) -> list[tuple[bool, int, Share]]:
        """Give the parts of a logical datagram: whether it is written, by whom, which bits."""
        command = datagram.command
        address = datagram.ado << self._wire.adp.width | datagram.adp
        found = self._mappings.shares(address, len(datagram.data))
        return [
            *((False, d, share) for d, fmmu, share in found if command.reads and fmmu.read),
            *((True, d, share) for d, fmmu, share in found if command.writes and fmmu.write),
        ]

    def _carried_out(
        self, shares: list[tuple[bool, int, Share]], datagram: _Datagram
    ) -> dict[bool, bool]:
        """Tell for reads and for writes whether all or none took place; left out is not known."""
        weights = {False: 1, True: 1}
        if datagram.command.reads and datagram.command.writes:
            read, written = self._wire.working_counter_read, self._wire.working_counter_write
            weights = {False: read, True: written}
        concerned = {(write, device) for write, device, _ in shares}
        expected = sum(weights[write] for write, _ in concerned)
        counter = datagram.working_counter
        if counter in {0, expected}:
            return {False: counter > 0, True: counter > 0}
        alone = len({device for _, device in concerned}) == 1
        if alone and counter < expected:
            return {write: bool(counter & weight) for write, weight in weights.items()}
        return {}

    def _lost(self, request: _Frame) -> Iterator[Transaction]:
        """Yield the accesses of a lost request; a read may have emptied a mailbox."""
        self._count["lost_requests"] += 1
        for datagram in request.datagrams:
            for device, write, address, data in self._sent(datagram):
                transaction = Transaction(
                    frame=request.number,
                    time=self._seconds(request),
                    sent=self._seconds(request),
                    device=device,
                    write=write,
                    address=address,
                    data=data,
                    working_counter=datagram.working_counter,
                    confirmed=False,
                    command=datagram.command.name,
                    done=False,
                )
                self._mappings.observe(transaction)
                yield transaction

    def _sent(self, datagram: _Datagram) -> Iterator[tuple[int | None, bool, int, bytes]]:
        """Yield the accesses that a request asks for: SubDevice, write, address, data."""
        command = datagram.command
        if command.addressing is _Addressing.LOGICAL:
            for write, device, share in self._shares(datagram):
                if share.whole_bytes:
                    yield device, write, share.address, share.taken(datagram.data, b"")
            return
        for write in (False, True):
            if command.writes if write else command.reads:
                addressed = self._device(command, datagram.adp)
                yield addressed, write, datagram.ado, datagram.data

    def _device(self, command: _Command, adp: int) -> int | None:
        match command.addressing:
            case _Addressing.POSITION:
                return -adp % (1 << self._wire.adp.width)
            case _Addressing.STATION:
                return self.segment.at_station(adp)
            case _:
                return None

    def _seconds(self, frame: _Frame) -> float:
        return (frame.nanoseconds - self._start) / _NANOSECONDS


def _come_in_pairs(frames: list[_Frame]) -> bool:
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
