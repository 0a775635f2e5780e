"""Tests a SubDevice on a network interface.

What is sent, and why it is safe:

- All accesses are position addressed (APRD, APWR), so no other SubDevice of the segment is touched.
  At the start one broadcast read counts who is there.
- A frame that does not come back is sent again only where that cannot be noticed: when it reads
  registers. Reading a buffer may have emptied it, and a write may have been taken; then nobody can
  tell, and the case is inconclusive. The repeat bit of the mailbox is left to the cases that test
  it: to use it here would be an exchange that the verdict does not know of.
- Who gives no answer to a read of registers, sent several times, is gone: a fault of the device.
"""

from __future__ import annotations

import subprocess
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.adapters import refuse_options
from ecatspec.conformance.adapters.raw_socket import LARGEST_FRAME, failed, open_interface
from ecatspec.conformance.base.adapter import (
    AdapterError,
    Description,
    DeviceHang,
    Unheard,
    check_duration,
    check_span,
)
from ecatspec.conformance.base.devices import load
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS, field_mask
from ecatspec.model.esc.data_link import linked
from ecatspec.model.esc.wire import COMMANDS, Datagram, Wire, filled, wire_format
from ecatspec.spec.language.ir import Access
from ecatspec.spec.language.load import load_link

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.spec.language.ir import Protocol, Register

_SOURCE: Final = bytes([0x00, 0x01, 0x05, 0x0E, 0x0C, 0x0A])
"""The Ethernet address that frames come from: any without the bit of frames that came back."""
_RETURN: Final = 0.2
"""Seconds after which a frame counts as lost."""
_TRIES: Final = 5
_POWER_UP: Final = 30.0
"""Seconds that a device may take until it answers again, and for the command that switches it."""
_LOOK: Final = 0.002
"""Seconds between two looks at AL Status."""
_NUMBERS: Final = 256
"""Datagrams are numbered below this."""
_TIMES: Final = ("real", "virtual")
"""Virtual is that of `ecatspec simulate --virtual-time`."""
_MICROSECONDS: Final = 1_000_000
_REMEMBERED: Final = (
    "without power=COMMAND a reset is INIT and registers as after power-on; objects that were "
    "written keep their values, a drive its state: cases may fail for what an earlier one left"
)


def make(device: str, options: Mapping[str, str]) -> WireAdapter:
    """Return the SubDevice at a position of the segment behind an interface."""
    interface = options.get("interface")
    if not interface:
        raise AdapterError("the adapter 'eth' needs an interface; write eth:IFACE[,position=N]")
    refuse_options("eth", options, known=("interface", "position", "power", "time"))
    kind = options.get("time", "real")
    if kind not in _TIMES:
        raise AdapterError(f"{kind!a} is no kind of time; there are {' and '.join(_TIMES)}")
    number = options.get("position", "0")
    if not (number.isascii() and number.isdigit()):
        raise AdapterError(f"{number!a} is no position; 0 is the SubDevice next to the MainDevice")
    return WireAdapter(
        load(device), interface, int(number), options.get("power", ""), virtual=kind == _TIMES[1]
    )


class WireAdapter:
    """The contract over frames to one position of a segment."""

    def __init__(
        self, protocol: Protocol, interface: str, position: int, power: str, *, virtual: bool
    ) -> None:
        self._protocol, self._power, self._virtual = protocol, power, virtual
        self._interface, self._position = interface, position
        self._model = model = Model(linked(protocol, load_link()))
        self._wire = wire = Wire(wire_format(model))
        self._adp = -position % wire.format.positions
        self._number = 0
        self._memory = model.parameter("process_memory")
        self._largest = wire.format.longest_data
        self._socket = open_interface(interface, wire.format.ethertype)
        try:
            self._socket.settimeout(_RETURN)
            self._find()
        except BaseException:
            self._socket.close()
            raise

    def describe(self) -> Description:
        """Describe what the text says; of the device itself nothing is known."""
        return Description(
            name=f"SubDevice at position {self._position} of {self._interface}",
            protocols=frozenset(self._protocol.machines),
            virtual_time=self._virtual,
            closed_dictionary=False,
            notes=() if self._power else (_REMEMBERED,),
            power_cycles=bool(self._power),
        )

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read from the position, in as many datagrams as it takes."""
        check_span(address, length)
        found, counter = b"", 0
        for start in range(address, address + length, self._largest):
            size = min(self._largest, address + length - start)
            again = start + size <= self._memory
            part = self._exchange("APRD", self._adp, start, bytes(size), again=again)
            found, counter = found + part.data, max(counter, part.working_counter)
        return counter, found

    def write(self, address: int, data: bytes) -> int:
        """Write to the position, in as many datagrams as it takes."""
        check_span(address, len(data))
        counter = 0
        for start in range(0, len(data), self._largest):
            part = data[start : start + self._largest]
            done = self._exchange("APWR", self._adp, address + start, part, again=False)
            counter = max(counter, done.working_counter)
        return counter

    def advance(self, seconds: float) -> None:
        """Wait: the time of the device is that of the clock, or passes as it is told."""
        check_duration(seconds)
        if not self._virtual:
            time.sleep(seconds)
            return
        register = self._model.protocol.registers["simulated_time"]
        left, most = round(seconds * _MICROSECONDS), (1 << 8 * register.size) - 1
        while left > 0:
            self._set(register, min(left, most))
            left -= most

    def close(self) -> None:
        """Let go of the interface."""
        self._socket.close()

    # --- frames -----------------------------------------------------------------------------------

    def _find(self) -> None:
        """Count who is there, and refuse a position where nobody is."""
        status = self._protocol.registers["al_status"]
        try:
            there = self._exchange("BRD", 0, status.address, bytes(status.size), again=True)
        except DeviceHang:
            message = f"no frame comes back on {self._interface!r}; connect a SubDevice"
            raise AdapterError(message) from None
        number = there.working_counter
        if self._position >= number:
            message = f"there is no position {self._position} among {number} SubDevices"
            raise AdapterError(f"{message} on {self._interface!r}; they are counted from 0")

    def _exchange(self, name: str, adp: int, ado: int, data: bytes, *, again: bool) -> Datagram:
        """Send a datagram and give what came back; `again`: it may be sent more than once."""
        for _ in range(_TRIES if again else 1):
            self._number = (self._number + 1) % _NUMBERS
            sent = Datagram(COMMANDS[name], self._number, adp, ado, data, 0)
            try:
                self._socket.send(filled(self._wire.frame(_SOURCE, (sent,))))
                found = self._returned(sent)
            except OSError as error:
                failed(self._interface, error)
            if found is not None:
                return found
        if again:
            raise DeviceHang(f"no frame comes back on {self._interface!r}, sent {_TRIES} times")
        message = f"a frame was lost on {self._interface!r}: what it did to the device is not known"
        raise Unheard(f"{message}; check the cable, and run the case again")

    def _returned(self, sent: Datagram) -> Datagram | None:
        deadline = time.monotonic() + _RETURN
        while time.monotonic() < deadline:
            try:
                frame = self._socket.recv(LARGEST_FRAME)
            except TimeoutError:
                return None
            payload = self._wire.payload(frame)
            found = () if payload is None else self._wire.datagrams(payload)[0]
            if len(found) == 1 and found[0].signature() == sent.signature():
                return found[0]
        return None

    # --- reset ------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Switch the power off and on, or do what comes nearest without a switch for it."""
        if self._power:
            self._switch()
            self._await_init(_POWER_UP)
            return
        for _ in range(_TRIES):
            with suppress(Unheard):
                self._quieten()
                return
        raise DeviceHang(f"frames are lost on {self._interface!r} again and again")

    def _switch(self) -> None:
        command = self._power
        try:
            done = subprocess.run(  # noqa: S602  a command of the user is the purpose
                command,
                shell=True,
                check=False,
                capture_output=True,
                timeout=_POWER_UP,
                stdin=subprocess.DEVNULL,
            )
        except subprocess.TimeoutExpired:
            message = f"the command {command!r} did not end in {_POWER_UP:g} s"
            raise AdapterError(f"{message}; give one that switches and returns") from None
        if done.returncode:
            last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
            message = f"the command {command!r} failed with exit status {done.returncode} ({last})"
            raise AdapterError(f"{message}; give one that switches the power")

    def _quieten(self) -> None:
        """Bring the device to INIT without an error, its registers to what they are at first."""
        control = self._protocol.registers["al_control"]
        mask = field_mask(self._protocol, control.name, "acknowledge")
        self._set(control, control.reset | mask)
        limit = self._model.parameter("back_timeout") / _MICROSECONDS
        self._await_init(limit)
        managers = (*SYNC_MANAGERS, *PROCESS_DATA)
        first = [f"{name}_activation" for name in managers]  # only then can the rest be written
        own = {r.name: r for r in self._protocol.registers.values() if r.main is Access.BOTH}
        for name in (*first, *(name for name in own if name not in first)):
            self._set(own[name], own[name].reset)
        self._await_init(limit)

    def _set(self, register: Register, raw: int) -> None:
        self.write(register.address, raw.to_bytes(register.size, "little"))

    def _await_init(self, seconds: float) -> None:
        """Wait until the device shows what it shows after power-on."""
        status = self._protocol.registers["al_status"]
        deadline = time.monotonic() + seconds
        while True:
            with suppress(DeviceHang):
                counter, data = self.read(status.address, status.size)
                if counter and int.from_bytes(data, "little") == status.reset:
                    return
            if time.monotonic() > deadline:
                raise DeviceHang(f"the device does not come to INIT in {seconds:g} s")
            time.sleep(_LOOK)
