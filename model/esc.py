"""The only place for the memory of an ESC: registers, AL Control lock, mailboxes, events.

Both sides see it: the MainDevice through `main_read` and `main_write` with a working counter, the
device through the hooks `pdi_read`, `pdi_write` and `al_event`. Addresses and bits come
from the texts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ecatspec.spec.language.ir import Access, Bool

if TYPE_CHECKING:
    from ecatspec.model.compiled import Model
    from ecatspec.spec.language.ir import Protocol, Register

SYNC_MANAGERS = ("sync_manager_0", "sync_manager_1")
"""The mailbox SyncManagers, the MainDevice's output first."""


def field_of(protocol: Protocol, register: str, field: str, raw: int) -> int:
    """Give one field of a register whose content is `raw`, a truth value where the text says so."""
    bits = next(item for item in protocol.registers[register].fields if item.name == field)
    value = raw >> bits.low & ((1 << (bits.high - bits.low + 1)) - 1)
    return bool(value) if isinstance(bits.type, Bool) else value


def field_mask(protocol: Protocol, register: str, field: str) -> int:
    """Give the bits that a field takes in its register."""
    bits = next(item for item in protocol.registers[register].fields if item.name == field)
    return ((1 << (bits.high - bits.low + 1)) - 1) << bits.low


@dataclass(slots=True)
class Channel:
    """One mailbox SyncManager as set now."""

    name: str
    start: int
    length: int
    main_writes: bool
    full: bool = False

    def overlaps(self, address: int, length: int) -> bool:
        """Tell whether an access touches the area."""
        return address < self.start + self.length and self.start < address + length

    def reaches_end(self, address: int, length: int) -> bool:
        """Tell whether an access covers the last byte of the area, which changes hands with it."""
        return address < self.start + self.length <= address + length


class Esc:
    """ESC memory of one SubDevice, power-on state."""

    def __init__(self, model: Model) -> None:
        """Take addresses, sizes and reset values from the protocol."""
        self._protocol = protocol = model.protocol
        self.size = model.parameter("memory_size")
        self._memory = bytearray(self.size)
        self._events = 0
        self._al_control_locked = False
        self._channels: list[Channel] = []
        self._al_bit = 1 << model.parameter("al_control_event")
        self._change_bit = 1 << model.parameter("sync_manager_change_event")
        self._first_bit = model.parameter("first_sync_manager_event")
        rows = {row.name: row.value for row in protocol.tables["sync_manager_mode"].rows}
        self._mailbox_mode = rows["mailbox"]
        rows = {row.name: row.value for row in protocol.tables["sync_manager_direction"].rows}
        self._main_writes = rows["main_writes"]
        self._writable = [r for r in protocol.registers.values() if r.main is Access.BOTH]
        self._registers_end = max(r.address + r.size for r in protocol.registers.values())
        for register in protocol.registers.values():
            self.set_register(register.name, register.reset)

    # --- registers by name ------------------------------------------------------------------------

    def register(self, name: str) -> int:
        """Give the raw content of a register."""
        at = self._protocol.registers[name]
        return int.from_bytes(self._memory[at.address : at.address + at.size], "little")

    def set_register(self, name: str, raw: int) -> None:
        """Set the raw content of a register."""
        at = self._protocol.registers[name]
        self._memory[at.address : at.address + at.size] = raw.to_bytes(at.size, "little")

    # --- the side of the MainDevice ---------------------------------------------------------------

    def main_read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice: working counter and bytes (zeros where it is refused)."""
        for channel in self._channels:
            if channel.overlaps(address, length):
                if channel.main_writes or not channel.full:
                    return 0, bytes(length)
                data = bytes(self._memory[address : address + length])
                if channel.reaches_end(address, length):
                    self._set_full(channel, full=False)
                    self._events |= 1 << (self._first_bit + SYNC_MANAGERS.index(channel.name))
                return 1, data
        return 1, bytes(self._memory[address : address + length])

    def main_write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice: working counter, 0 where the write is refused."""
        for channel in self._channels:
            if channel.overlaps(address, len(data)):
                if not channel.main_writes or channel.full:
                    return 0
                self._memory[address : address + len(data)] = data
                if channel.reaches_end(address, len(data)):
                    self._set_full(channel, full=True)
                    self._events |= 1 << (self._first_bit + SYNC_MANAGERS.index(channel.name))
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
        if register.name in SYNC_MANAGERS and self._enabled(register.name):
            return 1
        for offset in range(register.size):
            position = register.address + offset - address
            if 0 <= position < len(data):
                self._memory[register.address + offset] = data[position]
        if register.name.startswith(SYNC_MANAGERS):
            self._arrange()
            self._events |= self._change_bit
        return 1

    def _enabled(self, name: str) -> bool:
        raw = self.register(f"{name}_activation")
        return bool(field_of(self._protocol, f"{name}_activation", "enabled", raw))

    def _arrange(self) -> None:
        before = {channel.name: channel for channel in self._channels}
        self._channels = []
        for name in SYNC_MANAGERS:
            raw = self.register(name)
            mode = field_of(self._protocol, name, "mode", raw)
            length = field_of(self._protocol, name, "length", raw)
            if self._enabled(name) and mode == self._mailbox_mode and length:
                direction = field_of(self._protocol, name, "direction", raw)
                start = field_of(self._protocol, name, "start", raw)
                channel = Channel(name, start, length, direction == self._main_writes)
                old = before.get(name)
                channel.full = bool(old and old.full and old.start == start)
                self._channels.append(channel)
                self._set_full(channel, full=channel.full)
            else:
                self.set_register(f"{name}_status", 0)

    def _set_full(self, channel: Channel, *, full: bool) -> None:
        channel.full = full
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
        for channel in self._channels:
            if channel.main_writes and channel.full and channel.reaches_end(address, length):
                self._set_full(channel, full=False)
        control = self._protocol.registers["al_control"]
        if _overlap(control, address, length):
            self._al_control_locked = False
            self._events &= ~self._al_bit
        for name in SYNC_MANAGERS:
            if _overlap(self._protocol.registers[f"{name}_activation"], address, length):
                self._events &= ~self._change_bit
        return bytes(self._memory[address : address + length])

    def pdi_write(self, address: int, data: bytes) -> None:
        """Write as the device: fills a mailbox when its last byte is written."""
        self._memory[address : address + len(data)] = data
        for channel in self._channels:
            if not channel.main_writes and channel.reaches_end(address, len(data)):
                self._set_full(channel, full=True)

    def channel(self, name: str) -> Channel | None:
        """Give a mailbox as it is now, None where it is not set up."""
        return next((replace(c) for c in self._channels if c.name == name), None)

    def empty(self, name: str) -> None:
        """Take back what was put into a mailbox and not read, by switching its SyncManager."""
        for channel in self._channels:
            if channel.name == name:
                self._set_full(channel, full=False)


def _overlap(register: Register, address: int, length: int) -> bool:
    return address < register.address + register.size and register.address < address + length
