"""The only place for the memory of an ESC: registers, AL Control lock, SyncManagers, events.

Both sides see it: the MainDevice through `main_read`, `main_write` and `logical` with a working
counter, the device through the hooks `pdi_read`, `pdi_write` and `al_event`. Addresses and bits
come from the texts.

An access may lie across the areas of process data: each piece of it goes where it belongs, and the
working counter counts when at least one piece was carried out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

from ecatspec.model.buffers import ProcessChannel, ThreeBuffers
from ecatspec.model.fmmu import Fmmu, fmmu_registers
from ecatspec.model.once import once
from ecatspec.model.values import bits_of
from ecatspec.spec.language.ir import Access, Bool

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.compiled import Model
    from ecatspec.spec.language.ir import Protocol, Register

SYNC_MANAGERS = ("sync_manager_0", "sync_manager_1")
"""The mailbox SyncManagers, the MainDevice's output first."""
PROCESS_DATA = ("sync_manager_2", "sync_manager_3")
"""The SyncManagers of process data, the MainDevice's output first."""
_ALL = SYNC_MANAGERS + PROCESS_DATA
AREAS = dict(
    zip(_ALL, ("mailbox_out", "mailbox_in", "process_data_out", "process_data_in"), strict=True)
)
"""SyncManager -> the parameter that says where its memory usually lies."""
DIRECTIONS = dict(zip(_ALL, ("main_writes", "main_reads") * 2, strict=True))
"""SyncManager -> the row of `sync_manager_direction` that is right for it."""
_EVENTS = "al_event_request"
_WATCHDOG = "watchdog_status"


def field_of(protocol: Protocol, register: str, field: str, raw: int) -> int:
    """Give one field of a register whose content is `raw`, a truth value where the text says so."""
    bits = next(item for item in protocol.registers[register].fields if item.name == field)
    value = bits_of(raw, bits.low, bits.high)
    return bool(value) if isinstance(bits.type, Bool) else value


def field_mask(protocol: Protocol, register: str, field: str) -> int:
    """Give the bits that a field takes in its register."""
    bits = next(item for item in protocol.registers[register].fields if item.name == field)
    return ((1 << (bits.high - bits.low + 1)) - 1) << bits.low


@dataclass(frozen=True, slots=True)
class Channel:
    """One mailbox SyncManager as set now."""

    name: str
    start: int
    length: int
    main_writes: bool
    full: bool = False
    off: bool = False
    """The device has deactivated it."""

    def overlaps(self, address: int, length: int) -> bool:
        """Tell whether an access touches the area."""
        return address < self.start + self.length and self.start < address + length

    def reaches_end(self, address: int, length: int) -> bool:
        """Tell whether an access covers the last byte of the area, which changes hands with it."""
        return address < self.start + self.length <= address + length


@dataclass(frozen=True, slots=True)
class _Status:
    """The register that tells what became of the buffers of a SyncManager, with masks."""

    name: str
    reset: int
    flags: tuple[tuple[str, int], ...]
    last_buffer: int


@once
def _status_of(model: Model, manager: str) -> _Status:
    name = f"{manager}_status"
    flags = ("written", "taken", "read_open", "write_open")
    return _Status(
        name,
        model.protocol.registers[name].reset,
        tuple((flag, field_mask(model.protocol, name, flag)) for flag in flags),
        field_mask(model.protocol, name, "last_buffer"),
    )


class Esc:
    """ESC memory of one SubDevice, power-on state."""

    def __init__(self, model: Model) -> None:
        """Take addresses, sizes and reset values from the protocol."""
        self._model = model
        self._protocol = protocol = model.protocol
        self.size = model.parameter("memory_size")
        self._memory = bytearray(self.size)
        self._events = 0
        self._al_control_locked = False
        self._channels: dict[str, Channel] = {}
        self._buffers: dict[str, ThreeBuffers] = {}
        self._al_bit = 1 << model.parameter("al_control_event")
        self._change_bit = 1 << model.parameter("sync_manager_change_event")
        self._first_bit = model.parameter("first_sync_manager_event")
        self._watchdog_bit = field_mask(protocol, _EVENTS, "process_data_watchdog")
        self._mailbox_mode = model.row("sync_manager_mode", "mailbox")
        self._buffered_mode = model.row("sync_manager_mode", "buffered")
        self._main_writes = model.row("sync_manager_direction", "main_writes")
        self._writable = [r for r in protocol.registers.values() if r.main is Access.BOTH]
        self._fmmu_registers = fmmu_registers(protocol)
        self._fmmus: tuple[Fmmu, ...] | None = None
        self._both = model.parameter("counter_of_a_read"), model.parameter("counter_of_a_write")
        self._registers_end = max(r.address + r.size for r in protocol.registers.values())
        for register in protocol.registers.values():
            self.set_register(register.name, register.reset)

    # --- registers by name ------------------------------------------------------------------------

    def register(self, name: str) -> int:
        """Give the raw content of a register."""
        at = self._protocol.registers[name]
        return int.from_bytes(self._memory[at.address : at.address + at.size], "little")

    def registers(self) -> bytes:
        """Give the memory that holds all registers."""
        return bytes(self._memory[: self._registers_end])

    def set_register(self, name: str, raw: int) -> None:
        """Set the raw content of a register."""
        at = self._protocol.registers[name]
        self._memory[at.address : at.address + at.size] = raw.to_bytes(at.size, "little")
        if at in self._fmmu_registers:
            self._fmmus = None

    # --- the side of the MainDevice ---------------------------------------------------------------

    def main_read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice: working counter and bytes (zeros where it is refused)."""
        if not self._touches_process_data(address, length):
            return self._read_memory(address, length)
        found = [
            self._read_memory(low, high - low)
            if owner is None
            else self._read_inputs(owner, low, high - low)
            for low, high, owner in self._pieces(address, length)
        ]
        return max(counter for counter, _ in found), b"".join(data for _, data in found)

    def main_write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice: working counter, 0 where the write is refused."""
        if not self._touches_process_data(address, len(data)):
            return self._write_memory(address, data)
        return max(
            self._write_memory(low, data[low - address : high - address])
            if owner is None
            else self._write_outputs(owner, low, data[low - address : high - address])
            for low, high, owner in self._pieces(address, len(data))
        )

    def logical(self, command: str, address: int, data: bytes) -> tuple[int, bytes]:
        """Take a logical datagram (LRD, LWR, LRW) through the FMMUs: what it counts and returns."""
        reads, writes = command in {"LRD", "LRW"}, command in {"LWR", "LRW"}
        result, was_read, was_written = data, False, False
        shares = [(fmmu, fmmu.share(address, len(data))) for fmmu in self._enabled_fmmus()]
        for fmmu, share in shares:
            if share is not None and reads and fmmu.read:
                counter, found = self.main_read(share.address, share.length)
                if counter:
                    result, was_read = share.put(result, found), True
        for fmmu, share in shares:
            if share is not None and writes and fmmu.write:
                before = self._writable_now(share.address, share.length)
                counter = self.main_write(share.address, share.taken(data, before))
                was_written = was_written or bool(counter)
        if not (reads and writes):
            return int(was_read or was_written), result
        read, written = self._both
        return was_read * read + was_written * written, result

    def _enabled_fmmus(self) -> tuple[Fmmu, ...]:
        if self._fmmus is None:
            every = (Fmmu.of(r, self.register(r.name)) for r in self._fmmu_registers)
            self._fmmus = tuple(fmmu for fmmu in every if fmmu.enabled)
        return self._fmmus

    def _writable_now(self, address: int, length: int) -> bytes:
        """Give what lies where a write would go; unmapped bits of a byte stay as they are."""
        return b"".join(
            bytes(self._memory[low:high])
            if owner is None
            else self._buffers[owner].begun(low - self._buffers[owner].channel.start, high - low)
            for low, high, owner in self._pieces(address, length)
        )

    def _touches_process_data(self, address: int, length: int) -> bool:
        return any(
            address < buffers.channel.hidden_end and buffers.channel.start < address + length
            for buffers in self._buffers.values()
        )

    def _pieces(self, address: int, length: int) -> Iterator[tuple[int, int, str | None]]:
        """Cut an access at the borders of areas: start, end, SyncManager of process data."""
        areas = [buffers.channel for buffers in self._buffers.values()]
        edges = {border for area in areas for border in (area.start, area.end, area.hidden_end)}
        edges |= {
            border for c in self._channels.values() for border in (c.start, c.start + c.length)
        }
        within = sorted(edge for edge in edges if address < edge < address + length)
        for low, high in pairwise((address, *within, address + length)):
            yield low, high, self._owner(low)

    def _owner(self, address: int) -> str | None:
        """Give whose area an address is; an area counts before the hidden buffers of another."""
        areas = {name: buffers.channel for name, buffers in self._buffers.items()}
        for name, area in areas.items():
            if area.start <= address < area.end:
                return name
        if any(channel.overlaps(address, 1) for channel in self._channels.values()):
            return None
        hidden = (name for name, a in areas.items() if a.end <= address < a.hidden_end)
        return next(hidden, None)

    def _read_inputs(self, name: str, address: int, length: int) -> tuple[int, bytes]:
        buffers = self._buffers[name]
        offset = address - buffers.channel.start
        if buffers.channel.main_writes or address >= buffers.channel.end:
            return 0, bytes(length)
        data = buffers.read(offset, length)
        if data is not None and not buffers.read_open:
            self._events |= self._event_of(name)
        self._show_buffers(name)
        return (0, bytes(length)) if data is None else (1, data)

    def _write_outputs(self, name: str, address: int, data: bytes) -> int:
        buffers = self._buffers[name]
        if not buffers.channel.main_writes or address >= buffers.channel.end:
            return 0
        done = buffers.write(address - buffers.channel.start, data)
        if done and not buffers.write_open:
            self._events |= self._event_of(name)
        self._show_buffers(name)
        return int(done)

    def _event_of(self, name: str) -> int:
        return 1 << (self._first_bit + _ALL.index(name))

    def _read_memory(self, address: int, length: int) -> tuple[int, bytes]:
        for channel in self._channels.values():
            if channel.overlaps(address, length):
                if channel.main_writes or not channel.full:
                    return 0, bytes(length)
                data = bytes(self._memory[address : address + length])
                if channel.reaches_end(address, length):
                    self._set_full(channel, full=False)
                    self._events |= self._event_of(channel.name)
                return 1, data
        return 1, bytes(self._memory[address : address + length])

    def _write_memory(self, address: int, data: bytes) -> int:
        for channel in self._channels.values():
            if channel.overlaps(address, len(data)):
                if not channel.main_writes or channel.full or channel.off:
                    return 0
                self._memory[address : address + len(data)] = data
                if channel.reaches_end(address, len(data)):
                    self._set_full(channel, full=True)
                    self._events |= self._event_of(channel.name)
                return 1
        touched = [r for r in self._writable if _overlap(r, address, len(data))]
        if not touched:
            if address < self._registers_end:
                return 0
            self._memory[address : address + len(data)] = data
            return 1
        return max(self._write_register(register, address, data) for register in touched)

    def _write_register(self, register: Register, address: int, data: bytes) -> int:
        if register.name == "al_control":
            if self._al_control_locked:
                return 0
            self._al_control_locked = True
            self._events |= self._al_bit
        if register.name in _ALL and self._enabled(register.name):
            return 1
        for offset in range(register.size):
            position = register.address + offset - address
            if 0 <= position < len(data):
                self._memory[register.address + offset] = data[position]
        self._fmmus = None
        if register.name.startswith(_ALL):
            self._arrange()
            self._arrange_process_data()
            self._events |= self._change_bit
        return 1

    def _enabled(self, name: str) -> bool:
        raw = self.register(f"{name}_activation")
        return bool(field_of(self._protocol, f"{name}_activation", "enabled", raw))

    def _deactivated(self, name: str) -> bool:
        control = f"{name}_pdi_control"
        return bool(field_of(self._protocol, control, "deactivated", self.register(control)))

    def _arrange(self) -> None:
        before, self._channels = self._channels, {}
        for name in SYNC_MANAGERS:
            raw = self.register(name)
            mode = field_of(self._protocol, name, "mode", raw)
            length = field_of(self._protocol, name, "length", raw)
            if self._enabled(name) and mode == self._mailbox_mode and length:
                direction = field_of(self._protocol, name, "direction", raw)
                start = field_of(self._protocol, name, "start", raw)
                old = before.get(name)
                off = self._deactivated(name)
                full = bool(old and old.full and old.start == start and not off)
                if off:
                    self._events &= ~self._event_of(name)
                channel = Channel(name, start, length, direction == self._main_writes, full, off)
                self._set_full(channel, full=full)
            else:
                self.set_register(f"{name}_status", 0)

    def _arrange_process_data(self) -> None:
        before, self._buffers = self._buffers, {}
        for name in PROCESS_DATA:
            raw = self.register(name)
            mode = field_of(self._protocol, name, "mode", raw)
            start, length = (field_of(self._protocol, name, f, raw) for f in ("start", "length"))
            # the registers lie below the memory that a SyncManager can cover
            covers = self._enabled(name) and start >= self._registers_end and length > 0
            if covers and mode == self._buffered_mode:
                direction = field_of(self._protocol, name, "direction", raw)
                channel = ProcessChannel(start, length, direction == self._main_writes)
                off = self._deactivated(name)
                old = before.get(name)
                same = old is not None and (old.channel, old.off) == (channel, off)
                self._buffers[name] = old if old and same else ThreeBuffers(channel, off=off)
            if self._buffers.get(name) is not before.get(name):
                self._events &= ~self._event_of(name)
            self._show_buffers(name)

    def _show_buffers(self, name: str) -> None:
        """Let the status register tell what became of the buffers."""
        status = _status_of(self._model, name)
        raw = status.reset
        buffers = self._buffers.get(name)
        if buffers is not None:
            for field, mask in status.flags:
                raw |= mask * getattr(buffers, field)
            if buffers.newest is not None:
                raw = raw & ~status.last_buffer | buffers.newest * (
                    status.last_buffer & -status.last_buffer
                )
        self.set_register(status.name, raw)

    def _set_full(self, channel: Channel, *, full: bool) -> None:
        self._channels[channel.name] = replace(channel, full=full)
        status = f"{channel.name}_status"
        mask = field_mask(self._protocol, status, "full")
        raw = self.register(status)
        self.set_register(status, raw | mask if full else raw & ~mask)

    # --- the side of the device -------------------------------------------------------------------

    def al_event(self) -> int:
        """Give the AL event request: what happened since the device looked."""
        return self._events

    @property
    def al_control_changed(self) -> bool:
        """Tell whether the MainDevice wrote AL Control since the device read it."""
        return bool(self._events & self._al_bit)

    @property
    def settings_changed(self) -> bool:
        """Tell whether SyncManager settings were written since the device read them."""
        return bool(self._events & self._change_bit)

    def pdi_read(self, address: int, length: int) -> bytes:
        """Read as the device: unlocks AL Control, empties a mailbox that was written."""
        for channel in self._channels.values():
            if channel.main_writes and channel.full and channel.reaches_end(address, length):
                self._set_full(channel, full=False)
                self._events &= ~self._event_of(channel.name)
        control = self._protocol.registers["al_control"]
        if _overlap(control, address, length):
            self._al_control_locked = False
            self._events &= ~self._al_bit
        for name in _ALL:
            if _overlap(self._protocol.registers[f"{name}_activation"], address, length):
                self._events &= ~self._change_bit
        if _overlap(self._protocol.registers[_EVENTS], address, length):
            self.set_register(_EVENTS, self._events)
        if _overlap(self._protocol.registers[_WATCHDOG], address, length):
            self._events &= ~self._watchdog_bit
        if not self._touches_process_data(address, length):
            return bytes(self._memory[address : address + length])
        return b"".join(
            bytes(self._memory[low:high])
            if owner is None
            else self._device_read(owner, low, high - low)
            for low, high, owner in self._pieces(address, length)
        )

    def _device_read(self, name: str, address: int, length: int) -> bytes:
        buffers = self._buffers[name]
        if not buffers.channel.main_writes or address >= buffers.channel.end:
            return bytes(length)
        data = buffers.read(address - buffers.channel.start, length)
        if data is None:
            return bytes(length)
        self._events &= ~self._event_of(name)
        self._show_buffers(name)
        return data

    def pdi_write(self, address: int, data: bytes) -> None:
        """Write as the device: fills a mailbox when its last byte is written."""
        for low, high, owner in self._pieces(address, len(data)):
            piece = data[low - address : high - address]
            if owner is None:
                self._memory[low:high] = piece
            else:
                self._device_write(owner, low, piece)
        self._fmmus = None
        for channel in self._channels.values():
            takes = not (channel.main_writes or channel.off)
            if takes and channel.reaches_end(address, len(data)):
                self._set_full(channel, full=True)
                self._events &= ~self._event_of(channel.name)
        if address < self._registers_end and any(
            _overlap(self._protocol.registers[f"{name}_pdi_control"], address, len(data))
            for name in _ALL
        ):
            self._arrange()
            self._arrange_process_data()

    def _device_write(self, name: str, address: int, data: bytes) -> None:
        buffers = self._buffers[name]
        if buffers.channel.main_writes or address >= buffers.channel.end:
            return
        if buffers.write(address - buffers.channel.start, data):
            self._events &= ~self._event_of(name)
        self._show_buffers(name)

    @property
    def outputs_written(self) -> bool:
        """Tell whether the MainDevice wrote outputs since the device took them."""
        return bool(self._events & self._event_of(PROCESS_DATA[0]))

    def outputs(self) -> bytes | None:
        """Take the newest complete outputs, None while none came since the SyncManager is on."""
        channel = self.process_channel(PROCESS_DATA[0])
        if channel is None or not channel.main_writes:
            return None
        if self._buffers[PROCESS_DATA[0]].newest is None:
            return None
        return self._device_read(PROCESS_DATA[0], channel.start, channel.length)

    def set_inputs(self, data: bytes) -> None:
        """Write the inputs, cut or filled with zeros to their length; without effect while off."""
        channel = self.process_channel(PROCESS_DATA[1])
        if channel is not None:
            image = data[: channel.length].ljust(channel.length, b"\0")
            self._device_write(PROCESS_DATA[1], channel.start, image)

    def process_channel(self, name: str) -> ProcessChannel | None:
        """Give a SyncManager of process data as it is now, None while it is off."""
        buffers = self._buffers.get(name)
        return None if buffers is None or buffers.off else buffers.channel

    def deactivate(self, name: str, *, off: bool) -> None:
        """Switch a SyncManager of process data from the side of the device."""
        control = f"{name}_pdi_control"
        mask = field_mask(self._protocol, control, "deactivated")
        raw = self.register(control)
        self.set_register(control, raw | mask if off else raw & ~mask)
        self._arrange_process_data()

    def show_watchdog(self, *, running: bool) -> None:
        """Let the status of the watchdog of process data say whether it runs, or is off."""
        mask = field_mask(self._protocol, _WATCHDOG, "running")
        self.set_register(_WATCHDOG, mask if running else 0)

    def expire_watchdog(self) -> None:
        """Tell the device that the watchdog expired: an event, until it reads the status."""
        self.show_watchdog(running=False)
        self._events |= self._watchdog_bit

    def channel(self, name: str) -> Channel | None:
        """Give a mailbox as it is now, None where it is not set up."""
        return self._channels.get(name)

    def empty(self, name: str) -> None:
        """Take back what was put into a mailbox and not read, by switching its SyncManager."""
        if name in self._channels:
            self._set_full(self._channels[name], full=False)


def _overlap(register: Register, address: int, length: int) -> bool:
    return address < register.address + register.size and register.address < address + length
