"""Tells the SubDevices of a captured segment apart, and follows their FMMUs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

from ecatspec.model.esc.fmmu import Fmmu

if TYPE_CHECKING:
    from ecatspec.model.esc.fmmu import Share
    from ecatspec.model.esc.wire import WireFormat
    from ecatspec.spec.language.ir import Register


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


class Segment:
    """Who is who: resolves positions and station addresses to identities of SubDevices.

    The identity is the position (0 = first) when it is known, otherwise a number above all
    positions. It stays the same when the station address is written later. When a read of the
    station address shows that two identities were one SubDevice all along, `canonical` gives the
    one that goes on.
    """

    def __init__(self, wire: WireFormat) -> None:
        self._wire = wire
        self._modulus = wire.positions
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

    def has_answered(self, device: int) -> bool:
        """Tell whether there is such a SubDevice: it answered at least once."""
        return device in self._answered

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


class Mappings:
    """What the capture has shown of the FMMUs of each SubDevice."""

    def __init__(self, wire: WireFormat, segment: Segment) -> None:
        """Begin with nothing known."""
        self._registers = wire.fmmus
        self._segment = segment
        spans = (range(register.address, _end(register)) for register in wire.fmmus)
        self._addresses = frozenset(chain.from_iterable(spans))
        self._span = min(self._addresses, default=0), max(self._addresses, default=-1)
        self._everywhere: dict[int, int] = {}
        self._bytes: dict[int, dict[int, int]] = {}
        self._fmmus: dict[int, tuple[Fmmu, ...]] | None = None

    def observe(self, transaction: Transaction) -> None:
        """Learn from an access to the registers; a write that got lost makes them unknown."""
        first, last = self._span
        if transaction.address > last or transaction.address + len(transaction.data) <= first:
            return
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
