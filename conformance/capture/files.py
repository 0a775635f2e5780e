"""Reads pcap and pcapng files: packets with their times.

Memory stays flat however long a file is.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO, Final, Protocol

import dpkt
import dpkt.pcapng

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

NANOSECONDS: Final = 10**9
"""In a second."""
_LARGEST_BLOCK: Final = 1 << 26
_GZIP: Final = b"\x1f\x8b"


@dataclass(frozen=True, slots=True)
class Packet:
    """A frame as captured, numbered from 1; nanoseconds since the epoch of the file."""

    number: int
    nanoseconds: int
    data: bytes


class BrokenError(Exception):
    """The file ends or stops making sense here; the frames before are good."""

    def __init__(self, what: str, offset: int) -> None:
        super().__init__(what)
        self.what = what
        self.offset = offset


class NoCaptureError(Exception):
    """The file is no capture: what it is, what to do, and where that is seen, if anywhere."""

    def __init__(self, what: str, remedy: str, offset: int | None = 0) -> None:
        super().__init__(what)
        self.what = what
        self.remedy = remedy
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
            raise BrokenError(message, self.offset)
        self.offset += len(data)
        return data


class _Reader(Protocol):
    def __call__(self, stream: _Stream, magic: bytes) -> Iterator[Packet]: ...


def _read_pcap(stream: _Stream, magic: bytes) -> Iterator[Packet]:
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
            raise BrokenError(message, at)
        data = stream.take(captured, f"frame {number + 1}")
        number += 1
        yield Packet(number, seconds * NANOSECONDS + fraction * scale, data if ethernet else b"")


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
        return self.offset + (high << 32 | low) * NANOSECONDS // self.ticks


_PCAPNG_MAGIC: Final = dpkt.pcapng.PCAPNG_BT_SHB.to_bytes(4, "big")
_SIMPLE_PACKET: Final = 3
_BLOCK_OVERHEAD: Final = 12


def _read_pcapng(stream: _Stream, magic: bytes) -> Iterator[Packet]:
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
            raise BrokenError(message, at)
        body += stream.take(length - 8 - len(body), what)
        block = struct.unpack(f"{order}I", kind)[0]
        try:
            if block == dpkt.pcapng.PCAPNG_BT_IDB:
                interfaces.append(_interface(kind + size + body, order))
            elif block in {dpkt.pcapng.PCAPNG_BT_EPB, dpkt.pcapng.PCAPNG_BT_PB, _SIMPLE_PACKET}:
                number += 1
                packet, clock = _packet(block, body[:-4], order, interfaces, clock)
                yield Packet(number, clock, packet)
        except (dpkt.dpkt.Error, struct.error, ValueError, IndexError) as error:
            message = f"{what} makes no sense"
            raise BrokenError(message, at) from error
        kind = stream.take(4, f"the block after frame {number}", end_allowed=True)


def _byte_order(mark: bytes, at: int) -> str:
    for order in "<>":
        if struct.unpack(f"{order}I", mark)[0] == dpkt.pcapng.BYTE_ORDER_MAGIC:
            return order
    message = "a section has no byte order mark"
    raise BrokenError(message, at)


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
    return _Interface(description.linktype == dpkt.pcap.DLT_EN10MB, ticks, offset * NANOSECONDS)


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


def packets(file: BinaryIO) -> Iterator[Packet]:
    """Yield the packets of a file; those of another link than Ethernet are empty.

    Raises:
        NoCaptureError: It is neither pcap nor pcapng.
        BrokenError: It breaks off; what was yielded is good.

    """
    stream = _Stream(file)
    magic = stream.take(4, "the file header", end_allowed=True)
    if not magic:
        raise NoCaptureError("the file is empty", "record the capture again", None)
    reader = _READERS.get(magic)
    if reader is None and magic.startswith(_GZIP):
        raise NoCaptureError("the file is compressed", "unpack it with gunzip first")
    if reader is None:
        raise NoCaptureError("not a capture", "save it as pcap or pcapng")
    yield from reader(stream, magic)
