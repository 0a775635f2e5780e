"""Divides the datagrams of a capture into transactions of each SubDevice.

A MainDevice sends a frame and the same frame comes back; a capture holds both. This module pairs
the two and yields what the pair did: one read or write of ESC memory, with its working counter. A
logical datagram becomes the accesses that the FMMUs make of it, as far as the capture shows how
they are set.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, islice
from typing import TYPE_CHECKING, BinaryIO, Final

from ecatspec.conformance.capture.files import NANOSECONDS, BrokenError, NoCaptureError, packets
from ecatspec.conformance.capture.frames import Content, Frame, Pending, Sequence, come_in_pairs
from ecatspec.conformance.capture.segment import Mappings, Segment, Transaction
from ecatspec.model.esc.wire import Addressing, Command, Datagram, Wire

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ecatspec.conformance.capture.files import Packet
    from ecatspec.model.esc.fmmu import Share
    from ecatspec.model.esc.wire import WireFormat

LOST_AFTER: Final = 1000
"""A request is given up when it is this many frames old."""
_WINDOW: Final = 256
_REMEMBERED: Final = 4096


class CaptureError(Exception):
    """A capture that cannot be used: one line with what is wrong, where, and what to do."""

    def __init__(self, what: str, where: str, remedy: str) -> None:
        super().__init__(f"{where}: {what}; {remedy}")
        self.what = what
        self.where = where
        self.remedy = remedy


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


class Capture:
    """A capture file, ready to be read.

    Iterate to get the transactions; each iteration reads the file from the start. `statistics`,
    `segment`, `gaps` and `truncated` tell about the latest iteration, `truncated` when it has
    ended. `gaps` holds the numbers of the frames before which others are missing.
    """

    def __init__(self, path: Path, wire: WireFormat) -> None:
        """Remember what to read; nothing is opened before the iteration.

        Args:
            path: A pcap or pcapng file.
            wire: The numbers of the protocol.

        """
        self._path = path
        self._wire = wire
        self._decoder = Wire(wire)
        # a MainDevice that polls sends the same bytes again and again
        self._content = lru_cache(_REMEMBERED)(self._decoded)
        self._reset()

    def _reset(self) -> None:
        self.segment = Segment(self._wire)
        self._mappings = Mappings(self._wire, self.segment)
        self.truncated: str | None = None
        self._count: Counter[str] = Counter()
        self._pending = Pending()
        self._sequences: dict[bytes, Sequence] = {}
        self.gaps: list[int] = []
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

    def _packets(self, file: BinaryIO) -> Iterator[Packet]:
        try:
            yield from packets(file)
        except NoCaptureError as wrong:
            raise self._error(wrong.what, wrong.remedy, wrong.offset) from wrong
        except BrokenError as broken:
            where = f"{self._path}, offset {broken.offset}"
            frames = self._count["frames"]
            remedy = f"the {frames} frames before it were used, record again for the rest"
            self.truncated = f"{where}: {broken.what}; {remedy}"
            if not frames:
                remedy = "record or copy the capture again"
                raise self._error(broken.what, remedy, broken.offset) from broken

    def _frames(self, file: BinaryIO) -> Iterator[Frame]:
        """Yield the EtherCAT frames that hold datagrams."""
        for packet in self._packets(file):
            if not self._count["frames"]:
                self._start = packet.nanoseconds
            self._count["frames"] += 1
            content = self._content(packet.data)
            if content is None:
                continue
            self._count["ethercat_frames"] += 1
            self._count["datagrams"] += len(content.datagrams)
            self._count["malformed"] += not content.good
            if content.datagrams:
                yield Frame(packet.number, packet.nanoseconds, content)
        if not self._count["ethercat_frames"]:
            frames = self._count["frames"]
            what = f"no EtherCAT frame among {frames} frames, or the link is not Ethernet"
            if self.truncated:
                what += ", and then the file breaks off"
            raise self._error(what, "record on the network interface of the MainDevice")

    def _decoded(self, data: bytes) -> Content | None:
        """Give what a frame holds, None: it is none of EtherCAT."""
        payload = self._decoder.payload(data)
        if payload is None:
            return None
        datagrams, good = self._decoder.datagrams(payload)
        source, marked = self._decoder.source(data)
        return Content.of(datagrams, source, marked=marked, good=good)

    def _transactions(self, frames: Iterator[Frame]) -> Iterator[Transaction]:
        head = list(islice(frames, _WINDOW))
        paired = come_in_pairs(head)
        for frame in chain(head, frames):
            for lost in self._pending.expired(frame.number - LOST_AFTER):
                yield from self._lost(lost)
            request: Frame | None = None
            back = frame.content.marked or frame.content.counted
            if back or paired:
                request = self._pending.match(frame, self.segment.size)
            if request is not None or (back and not paired):
                self._count["returns"] += 1
                if request is not None:
                    for lost in self._pending.overtaken(request.content.source):
                        yield from self._lost(lost)
                yield from self._returned(frame, request)
            else:
                source = frame.content.source
                sequence = self._sequences.setdefault(source, Sequence())
                if sequence.jumps_to(frame.datagrams[0].index):
                    self._gap(frame)
                self._count["requests"] += 1
                self._pending.add(frame)
        for lost in self._pending.expired(None):
            yield from self._lost(lost)

    def _returned(self, frame: Frame, request: Frame | None) -> Iterator[Transaction]:
        self._measure(frame, request)
        if request is None:
            self._count["unmatched_returns"] += 1
            if self._count["requests"]:
                self._gap(frame)
        befores = frame.datagrams if request is None else request.datagrams
        for before, after in zip(befores, frame.datagrams, strict=True):
            adp: int | None = before.adp
            if request is None and after.command.addressing is Addressing.POSITION:
                size = self.segment.size
                adp = None if size is None else after.adp - size
            if adp is None:
                self._count["unplaced"] += 1
                continue
            if after.command.addressing is Addressing.LOGICAL:
                accesses = self._logical(frame, request, before, after)
            else:
                accesses = self._halves(frame, request, before, after, adp)
            for transaction in accesses:
                self.segment.observe(transaction)
                self._mappings.observe(transaction)
                yield transaction

    def _gap(self, frame: Frame) -> None:
        """Note that frames are missing before this one."""
        self.gaps.append(frame.number)

    def _measure(self, frame: Frame, request: Frame | None) -> None:
        """Learn the number of SubDevices: each adds one to the ADP, and a broadcast starts at 0."""
        if request is not None:
            size = frame.passed(request)
            if size is not None:
                self.segment.size = size % self._wire.positions
        elif self.segment.size is None:
            for datagram in frame.datagrams:
                if datagram.command.addressing is Addressing.ALL:
                    self.segment.size = datagram.adp

    def _halves(
        self, frame: Frame, request: Frame | None, before: Datagram, after: Datagram, adp: int
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
            single = both and command.addressing is not Addressing.ALL
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
        self, frame: Frame, request: Frame | None, before: Datagram, after: Datagram
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

    def _shares(self, datagram: Datagram) -> list[tuple[bool, int, Share]]:
        """Give the parts of a logical datagram: whether it is written, by whom, which bits."""
        command = datagram.command
        address = datagram.ado << self._wire.adp.width | datagram.adp
        found = self._mappings.shares(address, len(datagram.data))
        return [
            *((False, d, share) for d, fmmu, share in found if command.reads and fmmu.read),
            *((True, d, share) for d, fmmu, share in found if command.writes and fmmu.write),
        ]

    def _carried_out(
        self, shares: list[tuple[bool, int, Share]], datagram: Datagram
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

    def _lost(self, request: Frame) -> Iterator[Transaction]:
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

    def _sent(self, datagram: Datagram) -> Iterator[tuple[int | None, bool, int, bytes]]:
        """Yield the accesses that a request asks for: SubDevice, write, address, data."""
        command = datagram.command
        if command.addressing is Addressing.LOGICAL:
            for write, device, share in self._shares(datagram):
                if share.whole_bytes:
                    yield device, write, share.address, share.taken(datagram.data, b"")
            return
        for write in (False, True):
            if command.writes if write else command.reads:
                addressed = self._device(command, datagram.adp)
                yield addressed, write, datagram.ado, datagram.data

    def _device(self, command: Command, adp: int) -> int | None:
        match command.addressing:
            case Addressing.POSITION:
                return -adp % self._wire.positions
            case Addressing.STATION:
                return self.segment.at_station(adp)
            case _:
                return None

    def _seconds(self, frame: Frame) -> float:
        return (frame.nanoseconds - self._start) / NANOSECONDS
