"""The data link of an ESC: addressing, datagrams, events of the MainDevice.

Commands find their SubDevice by position, station address, alias, or logical address; working
counters are counted as the commands want it. Registers of the link work as their text says:
EEPROM interface, counters, events of the MainDevice. Time is told by who brings the datagrams.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS, field_mask, field_of
from ecatspec.model.esc.sii import WORD, checksum, sii_image
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.esc.wire import Addressing, WireFormat, wire_format

if TYPE_CHECKING:
    from collections.abc import Callable

    from ecatspec.model.esc.subdevice import Quirk
    from ecatspec.model.esc.wire import Command
    from ecatspec.spec.language.ir import Protocol, Register

_MICROSECONDS: Final = 1_000_000
_CLEARED: Final = "_counter"
"""In the name of a register that any write clears."""
_EXPIRED: Final = "watchdog_process_data_counter"
_WATCHDOG: Final = ("process_data", "expired")
"""The machine and its input that is the end of the watchdog's time."""
_WATCHDOG_SETTINGS: Final = (PROCESS_DATA[0], "watchdog_process_data")
_BYTE_MASK: Final = 0xFF
_EEPROM: Final = "eeprom_"
_MANAGERS: Final = (*SYNC_MANAGERS, *PROCESS_DATA)


def linked(protocol: Protocol, link: Protocol) -> Protocol:
    """Give the texts of a device with those of the link beneath; where they meet, the device's."""
    taken = list(protocol.registers.values())
    beneath = {
        name: register
        for name, register in link.registers.items()
        if not any(_meet(register, other) for other in taken)
    }
    return replace(
        protocol,
        registers=protocol.registers | beneath,
        frames=protocol.frames | link.frames,
        tables=link.tables | protocol.tables,
        parameters=link.parameters | protocol.parameters,
    )


def _meet(one: Register, other: Register) -> bool:
    return one.address < other.address + other.size and other.address < one.address + one.size


def _touches(span: range, address: int, end: int) -> bool:
    return address < span.stop and span.start < end


class LinkedSubDevice:
    """A virtual SubDevice as it stands on a segment; its texts include those of the link."""

    def __init__(
        self,
        protocol: Protocol,
        quirks: frozenset[Quirk] = frozenset(),
        *,
        follower: bool = False,
        commanded: bool = False,
    ) -> None:
        """Power on; `follower`: another SubDevice is connected behind this one.

        `commanded`: time passes where the MainDevice writes how much.
        """
        self.device = VirtualSubDevice(protocol, quirks=quirks)
        self._model = model = self.device.model
        self._registers = protocol.registers
        self._wire: WireFormat = wire_format(model)
        self._follower, self._commanded = follower, commanded
        self._positions = self._wire.positions
        self._both = self._wire.working_counter_read, self._wire.working_counter_write
        self._memory_start = model.parameter("process_memory")
        self._eeprom_time = model.parameter("eeprom_time")
        self._eeprom = bytearray(sii_image(model))
        self._counters = [r for name, r in self._registers.items() if _CLEARED in name]
        self._eeprom_span = self._span(_EEPROM)
        self._al_status_span = self._of("al_status")
        raised = ("al_status", *_MANAGERS)
        self._raised = sum(self._mask("main_event_request", name) for name in raised)
        """The events that can be."""
        self._hooks: tuple[tuple[range, Callable[[], None]], ...] = (
            (self._of("main_event_request"), self._show_events),
            (self._eeprom_span, self._show_eeprom),
            (self._of("watchdog_status"), self._show_watchdog),
        )
        self.now = 0
        """Microseconds that have passed."""
        self.reset()

    def reset(self) -> None:
        """Power cycle: the EEPROM keeps what was written to it."""
        self.device.reset()
        self._busy_until = 0
        self._al_status = self._content("al_status")
        self._load()
        if self._follower:
            ports = self._content("dl_status") & ~self._mask("dl_status", "loop_port_1")
            state = self._model.row("loop_state", "open")
            ports |= self._placed("dl_status", "loop_port_1", state)
            self._put("dl_status", ports | self._mask("dl_status", "link_port_1"))

    @property
    def al_state(self) -> str:
        """Give the AL state in words."""
        names = self._model.state_names("al")
        return names[self._field("al_status", "state")]

    # --- datagrams --------------------------------------------------------------------------------

    def visit(
        self, command: Command, adp: int, ado: int, data: bytes
    ) -> tuple[int, bytes, int, int]:
        """Work on a datagram that passes: the ADP that goes on, data, counter, interrupt."""
        here = adp == 0
        after = (adp + 1) % self._positions if command.counts_up else adp
        counted = 0
        match command.addressing:
            case Addressing.POSITION:
                data, counted = self._physical(command, ado, data, addressed=here)
            case Addressing.STATION:
                data, counted = self._physical(command, ado, data, addressed=self._is_called(adp))
            case Addressing.ALL:
                data, counted = self._broadcast(command, ado, data)
            case Addressing.LOGICAL:
                address = ado << self._wire.adp.width | adp
                counted, data = self.device.logical(command.name, address, data)
            case Addressing.NONE:
                pass
        return after, data, counted, self._interrupt()

    def _is_called(self, address: int) -> bool:
        if address == self._content("station_address"):
            return True
        counts = field_of(
            self._model.protocol, "dl_control", "alias_counts", self._content("dl_control")
        )
        return bool(counts) and address == self._content("station_alias")

    def _physical(
        self, command: Command, address: int, data: bytes, *, addressed: bool
    ) -> tuple[bytes, int]:
        if not addressed:
            return data, self.write(address, data) if command.others_write and data else 0
        if not data:
            return data, 0
        found, counted = data, 0
        if command.reads:
            read, content = self.read(address, len(data))
            if read:
                found, counted = content, self._both[0]
        if command.writes and self.write(address, data):
            counted += self._both[1] if command.reads else 1
        return found, counted

    def _broadcast(self, command: Command, address: int, data: bytes) -> tuple[bytes, int]:
        found, counted = self._physical(command, address, data, addressed=True)
        if command.reads and counted % self._both[1]:
            both = zip(data, found, strict=True)
            found = bytes(before | here for before, here in both)
        return found, counted

    # --- memory -----------------------------------------------------------------------------------

    def advance(self, microseconds: int) -> None:
        """Let the time of the device reach a number of microseconds; it never goes back."""
        if microseconds > self.now:
            before = self.device.awaits(*_WATCHDOG)
            self.device.advance((microseconds - self.now) / _MICROSECONDS)
            self.now = microseconds
            if before and not self.device.awaits(*_WATCHDOG) and self._watchdog_on():
                counter = self._content(_EXPIRED)
                self._put(_EXPIRED, min(counter + 1, _BYTE_MASK))

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice."""
        if address < self._memory_start:
            end = address + length
            for span, show in self._hooks:
                if _touches(span, address, end):
                    show()
            if _touches(self._al_status_span, address, end):
                self._al_status = self._content("al_status")
        return self.device.read(address, length)

    def write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice."""
        if address >= self._memory_start:
            return self.device.write(address, data)
        end = address + len(data)
        eeprom = _touches(self._eeprom_span, address, end)
        if eeprom and self._is_busy():
            return 0
        counter = self.device.write(address, data)
        if eeprom and counter:
            self._serve_eeprom(address, end)
        if self._commanded and counter and _touches(self._of("simulated_time"), address, end):
            self.advance(self.now + self._content("simulated_time"))
        for register in self._counters:
            if _touches(self._of(register.name), address, end):
                self._put(register.name, 0)
        return counter

    # --- events of the MainDevice -----------------------------------------------------------------

    def _interrupt(self) -> int:
        mask = self._content("main_event_mask")
        return mask & self._events() if mask & self._raised else 0

    def _events(self) -> int:
        events = 0
        if self._content("al_status") != self._al_status:
            events |= self._mask("main_event_request", "al_status")
        for name in _MANAGERS:
            flag = "full" if name in SYNC_MANAGERS else "written"
            if self._field(f"{name}_status", flag):
                events |= self._mask("main_event_request", name)
        return events

    def _show_events(self) -> None:
        self._put("main_event_request", self._events())

    # --- watchdog ---------------------------------------------------------------------------------

    def _watchdog_on(self) -> bool:
        state = self.device.state
        for name in _WATCHDOG_SETTINGS:  # the device may not have looked at them yet
            state = state.having(self._model.slots[f"register {name}"], self._content(name))
        environment = Environment(state.slots, {}, {})
        return self._model.definition("watchdog_on")(environment) is True

    def _show_watchdog(self) -> None:
        running = not self._watchdog_on() or self.device.awaits(*_WATCHDOG)
        self._put("watchdog_status", running * self._mask("watchdog_status", "running"))

    # --- EEPROM -----------------------------------------------------------------------------------

    def _load(self) -> None:
        """Take from the EEPROM what the controller takes at power-on."""
        codec = self._model.codec
        size = codec.size("sii_configuration")
        content = bytes(self._eeprom[:size])
        self._eeprom_good = checksum(self._model, content) == self._eeprom[size]
        raw = self._content("eeprom_control")
        raw &= ~self._mask("eeprom_control", "checksum_error")
        if self._eeprom_good:
            start, width = codec.place("sii_configuration", "alias")
            number = int.from_bytes(content, "little") >> start & ((1 << width) - 1)
            self._put("station_alias", number)
        else:
            raw |= self._mask("eeprom_control", "checksum_error")
        self._put("eeprom_control", raw)

    def _is_busy(self) -> bool:
        return self.now < self._busy_until

    def _show_eeprom(self) -> None:
        raw = self._content("eeprom_control")
        busy = self._mask("eeprom_control", "busy")
        if bool(raw & busy) != self._is_busy():
            raw = raw & ~busy & ~self._mask("eeprom_control", "command")
            self._put("eeprom_control", raw | busy * self._is_busy())

    def _serve_eeprom(self, address: int, end: int) -> None:
        """Carry out what a write to the interface wants."""
        raw = self._content("eeprom_control")
        if self._field("eeprom_configuration", "taken_back"):
            self._put("eeprom_device_state", 0)
        if not _touches(self._of("eeprom_control"), address, end):
            return
        told = self._reset("eeprom_control")
        if not self._eeprom_good:  # remains until the EEPROM is loaded again, whatever is written
            told |= self._mask("eeprom_control", "checksum_error")
        command, problem = self._field("eeprom_control", "command"), 0
        names = {row.value: row.name for row in self._model.protocol.tables["eeprom_command"].rows}
        place = self._content("eeprom_address") * WORD
        data = self._registers["eeprom_data"]
        if self._field("eeprom_configuration", "for_device"):
            problem = self._mask("eeprom_control", "command_error") * bool(command)
            command = 0
        match names.get(command):
            case "idle" | None:
                if command:
                    problem = self._mask("eeprom_control", "command_error")
                self._put("eeprom_control", told | problem)
                return
            case "read":
                found = bytes(self._eeprom[place : place + data.size])
                self._put(data.name, int.from_bytes(found.ljust(data.size, b"\xff"), "little"))
            case "write":
                if not raw & self._mask("eeprom_control", "write_enabled"):
                    problem = self._mask("eeprom_control", "write_error")
                elif place + WORD <= len(self._eeprom):
                    content = self._content(data.name).to_bytes(data.size, "little")
                    self._eeprom[place : place + WORD] = content[:WORD]
            case "reload":
                self._load()
                told = self._content("eeprom_control") & ~self._mask("eeprom_control", "command")
        self._busy_until = self.now + self._eeprom_time
        self._put("eeprom_control", told | problem | self._mask("eeprom_control", "busy"))

    # --- registers by name ------------------------------------------------------------------------

    def _content(self, name: str) -> int:
        return self.device.esc.register(name)

    def _put(self, name: str, raw: int) -> None:
        self.device.esc.set_register(name, raw)

    def _field(self, name: str, field: str) -> int:
        return field_of(self._model.protocol, name, field, self._content(name))

    def _mask(self, name: str, field: str) -> int:
        return field_mask(self._model.protocol, name, field)

    def _placed(self, name: str, field: str, value: int) -> int:
        mask = self._mask(name, field)
        return value * (mask & -mask)

    def _reset(self, name: str) -> int:
        return self._registers[name].reset

    def _of(self, name: str) -> range:
        register = self._registers[name]
        return range(register.address, register.address + register.size)

    def _span(self, prefix: str) -> range:
        spans = [self._of(name) for name in self._registers if name.startswith(prefix)]
        return range(min(s.start for s in spans), max(s.stop for s in spans))
