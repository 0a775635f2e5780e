"""The memory of an ESC: registers, AL Control lock, SyncManagers, events.

Both sides see it: the MainDevice through `main_read`, `main_write` and `logical` with a working
counter, the device through the hooks `pdi_read`, `pdi_write` and `al_event`. Addresses and bits
come from the texts.

An access may lie across the areas of SyncManagers: each piece of it goes where it belongs, and the
working counter counts when at least one piece was carried out. An access of no bytes does nothing.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from ecatspec.model.core.memo import once
from ecatspec.model.core.register_map import (
    AL_EVENTS,
    PROCESS_DATA,
    SYNC_MANAGERS,
    WATCHDOG,
    field_mask,
    field_of,
)
from ecatspec.model.esc.fmmu import Fmmu, fmmu_registers
from ecatspec.model.esc.three_buffers import Buffers, Channel
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import Register

_ALL = SYNC_MANAGERS + PROCESS_DATA


@dataclass(frozen=True, slots=True)
class _Status:
    """Where it shows what became of the buffers of a SyncManager: its register, with masks."""

    name: str
    reset: int
    flags: tuple[tuple[str, int], ...]
    last_buffer: int
    """0 where there is one buffer."""
    event: int
    """In AL event request."""


@once
def _status_of(model: Model, manager: str) -> _Status:
    register = model.protocol.registers[f"{manager}_status"]
    masks = {
        bits.name: field_mask(model.protocol, register.name, bits.name) for bits in register.fields
    }
    last_buffer = masks.pop("last_buffer", 0)
    event = 1 << (model.parameter("first_sync_manager_event") + _ALL.index(manager))
    return _Status(register.name, register.reset, tuple(masks.items()), last_buffer, event)


@once
def _reset_memory(model: Model) -> bytes:
    """Give the memory at power-on: the reset values of the registers."""
    memory = bytearray(model.parameter("memory_size"))
    for at in model.protocol.registers.values():
        memory[at.address : at.address + at.size] = at.reset.to_bytes(at.size, "little")
    return bytes(memory)


class Esc:
    """ESC memory of one SubDevice, power-on state."""

    def __init__(self, model: Model) -> None:
        """Take addresses, sizes and reset values from the protocol."""
        self._model = model
        self._protocol = protocol = model.protocol
        self.size = model.parameter("memory_size")
        self._memory = bytearray(_reset_memory(model))
        self._events = 0
        self._al_control_locked = False
        self._buffers: dict[str, Buffers] = {}
        self._al_bit = 1 << model.parameter("al_control_event")
        self._change_bit = 1 << model.parameter("sync_manager_change_event")
        self._watchdog_bit = field_mask(protocol, AL_EVENTS, "process_data_watchdog")
        mailbox, buffered = (model.row("sync_manager_mode", row) for row in ("mailbox", "buffered"))
        self._modes = dict.fromkeys(SYNC_MANAGERS, mailbox) | dict.fromkeys(PROCESS_DATA, buffered)
        self._main_writes = model.row("sync_manager_direction", "main_writes")
        self._writable = tuple(r for r in protocol.registers.values() if r.main is Access.BOTH)
        self._fmmu_registers = MappingProxyType({r.name: r for r in fmmu_registers(protocol)})
        self._fmmus: tuple[Fmmu, ...] | None = None
        self._both = model.parameter("counter_of_a_read"), model.parameter("counter_of_a_write")
        self._registers_end = max(r.address + r.size for r in protocol.registers.values())

    def copy(self) -> Esc:
        """Give a memory that is as this one is now; neither changes with the other."""
        other = copy(self)
        other._memory = self._memory.copy()  # noqa: SLF001
        other._buffers = {name: buffers.copy() for name, buffers in self._buffers.items()}  # noqa: SLF001
        return other

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
        if name in self._fmmu_registers:
            self._fmmus = None

    # --- the side of the MainDevice ---------------------------------------------------------------

    def main_read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice: working counter and bytes (zeros where it is refused).

        An access that ends behind the memory is refused.
        """
        if address + length > self.size:
            return 0, bytes(length)
        if not self._touches_buffers(address, length):
            return 1, bytes(self._memory[address : address + length])
        counter, found = 0, b""
        for low, high, owner in self._pieces(address, length):
            piece: bytes | None = bytes(self._memory[low:high])
            if owner is not None:
                piece = self._read_piece(owner, low, high - low, main=True)
            counter |= piece is not None
            found += bytes(high - low) if piece is None else piece
        return counter, found

    def main_write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice: working counter, 0 where the write is refused.

        An access that ends behind the memory is refused.
        """
        if address + len(data) > self.size:
            return 0
        if not self._touches_buffers(address, len(data)):
            return self._write_memory(address, data)
        counter = 0
        for low, high, owner in self._pieces(address, len(data)):
            piece = data[low - address : high - address]
            if owner is None:
                counter |= self._write_memory(low, piece)
            else:
                counter |= self._write_piece(owner, low, piece, main=True)
        return counter

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
            every = (Fmmu.of(r, self.register(name)) for name, r in self._fmmu_registers.items())
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

    def _touches_buffers(self, address: int, length: int) -> bool:
        end = address + length
        for buffers in self._buffers.values():
            start, _, behind = buffers.borders
            if start < end and address < behind:
                return True
        return False

    def _pieces(self, address: int, length: int) -> Iterator[tuple[int, int, str | None]]:
        """Cut an access at the borders of areas as they are then: start, end, SyncManager."""
        end = address + length
        while address < end:
            borders = (at for buffers in self._buffers.values() for at in buffers.borders)
            high = min((at for at in borders if at > address), default=end)
            yield address, min(high, end), self._owner(address)
            address = high

    def _owner(self, address: int) -> str | None:
        """Give whose area an address is; an area counts before the hidden buffers of another."""
        hidden = None
        for name, buffers in self._buffers.items():
            start, end, hidden_end = buffers.borders
            if start <= address < end:
                return name
            if end <= address < hidden_end:
                hidden = hidden or name
        return hidden

    def _read_piece(self, name: str, address: int, length: int, *, main: bool) -> bytes | None:
        """Read of an area from one side, None where that is refused."""
        buffers = self._buffers[name]
        if buffers.channel.main_writes is main or address >= buffers.channel.end:
            return None
        data = buffers.read(address - buffers.channel.start, length)
        self._show_buffers(name)
        return data

    def _write_piece(self, name: str, address: int, data: bytes, *, main: bool) -> bool:
        """Write to an area from one side, False where that is refused."""
        buffers = self._buffers[name]
        if buffers.channel.main_writes is not main or address >= buffers.channel.end:
            return False
        done = buffers.write(address - buffers.channel.start, data)
        self._show_buffers(name)
        return done

    def _write_memory(self, address: int, data: bytes) -> int:
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
            self._events |= self._change_bit
        return 1

    def _enabled(self, name: str) -> bool:
        raw = self.register(f"{name}_activation")
        return bool(field_of(self._protocol, f"{name}_activation", "enabled", raw))

    def _deactivated(self, name: str) -> bool:
        control = f"{name}_pdi_control"
        return bool(field_of(self._protocol, control, "deactivated", self.register(control)))

    def _arrange(self) -> None:
        """Set the areas up as the registers say; one whose settings stay keeps its buffers."""
        before, self._buffers = self._buffers, {}
        for name, mode in self._modes.items():
            raw = self.register(name)
            start, length = (field_of(self._protocol, name, f, raw) for f in ("start", "length"))
            # the registers lie below the memory that a SyncManager can cover
            covers = self._enabled(name) and start >= self._registers_end and length > 0
            if covers and mode == field_of(self._protocol, name, "mode", raw):
                main_writes = field_of(self._protocol, name, "direction", raw) == self._main_writes
                channel = Channel(start, length, main_writes, mailbox=name in SYNC_MANAGERS)
                off = self._deactivated(name)
                old = before.get(name)
                same = old is not None and (old.channel, old.off) == (channel, off)
                self._buffers[name] = old if old and same else Buffers(channel, off=off)
            self._show_buffers(name)

    def _show_buffers(self, name: str) -> None:
        """Let the status register and the event tell what became of the buffers."""
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
        self._events &= ~status.event
        if buffers is not None and buffers.event:
            self._events |= status.event

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
        """Read as the device: unlocks AL Control, takes events, empties a mailbox to its end.

        What is refused reads as zeros: a processor does not see a working counter.
        """
        if not length:
            return b""
        if address < self._registers_end:
            self._look(address, length)
        if not self._touches_buffers(address, length):
            return bytes(self._memory[address : address + length])
        return b"".join(
            bytes(self._memory[low:high])
            if owner is None
            else self._read_piece(owner, low, high - low, main=False) or bytes(high - low)
            for low, high, owner in self._pieces(address, length)
        )

    def _look(self, address: int, length: int) -> None:
        """Take the events of the registers that the device reads."""
        registers = self._protocol.registers
        if _overlap(registers["al_control"], address, length):
            self._al_control_locked = False
            self._events &= ~self._al_bit
        for name in _ALL:
            if _overlap(registers[f"{name}_activation"], address, length):
                self._events &= ~self._change_bit
        if _overlap(registers[AL_EVENTS], address, length):
            self.set_register(AL_EVENTS, self._events)
        if _overlap(registers[WATCHDOG], address, length):
            self._events &= ~self._watchdog_bit

    def pdi_write(self, address: int, data: bytes) -> None:
        """Write as the device: fills a mailbox with its last byte. What is refused is lost."""
        if not data:
            return
        for low, high, owner in self._pieces(address, len(data)):
            piece = data[low - address : high - address]
            if owner is None:
                self._memory[low:high] = piece
            else:
                self._write_piece(owner, low, piece, main=False)
        self._fmmus = None
        if address < self._registers_end and any(
            _overlap(self._protocol.registers[f"{name}_pdi_control"], address, len(data))
            for name in _ALL
        ):
            self._arrange()

    @property
    def outputs_written(self) -> bool:
        """Tell whether the MainDevice wrote outputs since the device took them."""
        buffers = self._buffers.get(PROCESS_DATA[0])
        return buffers is not None and buffers.event

    def outputs(self) -> bytes | None:
        """Take the newest complete outputs, None while none came since the SyncManager is on."""
        channel = self.process_channel(PROCESS_DATA[0])
        if channel is None or not channel.main_writes:
            return None
        if self._buffers[PROCESS_DATA[0]].newest is None:
            return None
        return self._read_piece(PROCESS_DATA[0], channel.start, channel.length, main=False)

    def set_inputs(self, data: bytes) -> None:
        """Write the inputs, cut or filled with zeros to their length; without effect while off."""
        channel = self.process_channel(PROCESS_DATA[1])
        if channel is not None:
            image = data[: channel.length].ljust(channel.length, b"\0")
            self._write_piece(PROCESS_DATA[1], channel.start, image, main=False)

    def process_channel(self, name: str) -> Channel | None:
        """Give a SyncManager of process data as it is now, None while it is off."""
        buffers = self._buffers.get(name)
        return None if buffers is None or buffers.off else buffers.channel

    def deactivate(self, name: str, *, off: bool) -> None:
        """Switch a SyncManager from the side of the device."""
        control = f"{name}_pdi_control"
        mask = field_mask(self._protocol, control, "deactivated")
        raw = self.register(control)
        self.set_register(control, raw | mask if off else raw & ~mask)
        self._arrange()

    def show_watchdog(self, *, running: bool) -> None:
        """Let the status of the watchdog of process data say whether it runs, or is off."""
        mask = field_mask(self._protocol, WATCHDOG, "running")
        self.set_register(WATCHDOG, mask if running else 0)

    def expire_watchdog(self) -> None:
        """Tell the device that the watchdog expired: an event, until it reads the status."""
        self.show_watchdog(running=False)
        self._events |= self._watchdog_bit

    def mailbox(self, name: str) -> Buffers | None:
        """Give a mailbox as it is now, None where it is not set up."""
        return self._buffers.get(name)

    def empty(self, name: str) -> None:
        """Take back what was put into a mailbox and not read, by switching its SyncManager."""
        self.deactivate(name, off=True)
        self.deactivate(name, off=False)


def _overlap(register: Register, address: int, length: int) -> bool:
    return address < register.address + register.size and register.address < address + length
