"""The ESC around a bare stack: a SubDevice whose stack is under test.

The memory, the mailboxes and the buffers are those of `esc`, the time of the watchdog is that of
the texts.  The stack is polled after what the MainDevice did, and in short steps while time passes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from ecatspec.model.core.compilation import Model
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.register_map import PROCESS_DATA, field_of
from ecatspec.model.esc.esc import Esc
from ecatspec.model.esc.subdevice import register_slots, with_registers

if TYPE_CHECKING:
    from ecatspec.spec.language import ir

POLL = 1000
"""Microseconds between two rounds of a stack's main loop."""
_SECOND = 1_000_000
_OUTPUTS = f"{PROCESS_DATA[0]}_status"


class Stack(Protocol):
    """What runs on the processor of the device."""

    def init(self) -> None:
        """Power on."""

    def poll(self, microseconds: int) -> None:
        """Go once round the main loop; so much time has passed since the last one."""


class BareSubDevice:
    """A SubDevice made of a stack and our ESC, which is another `esc` after each reset."""

    def __init__(self, protocol: ir.Protocol, stack: Stack, poll: int = POLL) -> None:
        """Set up; the stack is not touched before the first reset."""
        self._model = Model(protocol)
        self._stack = stack
        self._poll = poll
        self._slots = register_slots(self._model)
        self._watchdog_on = self._model.definition("watchdog_on")
        self._watchdog_time = self._model.definition("watchdog_time")
        self._power_on()

    def _power_on(self) -> None:
        self.esc = Esc(self._model)
        self._state = self._model.initial
        self._seen = b""
        self._left: int | None = None
        """Microseconds until the watchdog of process data expires; None: it does not run."""
        self._watch()

    def reset(self) -> None:
        """Power cycle."""
        self._power_on()
        self._stack.init()
        self._stack.poll(0)

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice; the stack hears of it where it is told by an event."""
        before = self.esc.al_event()
        result = self.esc.main_read(address, length)
        if self.esc.al_event() != before:
            self._stack.poll(0)
        return result

    def write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice."""
        before = self._newest()
        counter = self.esc.main_write(address, data)
        self._watch(fed=self._newest() != before)
        self._stack.poll(0)
        return counter

    def advance(self, seconds: float) -> None:
        """Let time pass, with a poll at each step of it and when the watchdog expires."""
        left = round(seconds * _SECOND)
        while left:
            step = min(left, self._poll if self._left is None else min(self._poll, self._left))
            left -= step
            if self._left is not None:
                self._left -= step
                if not self._left:
                    self._left = None
                    self.esc.expire_watchdog()
            self._stack.poll(step)

    def _newest(self) -> int:
        """Give the buffer of the newest outputs: each image that is complete has another."""
        raw = self.esc.register(_OUTPUTS)
        return field_of(self._model.protocol, _OUTPUTS, "last_buffer", raw)

    def _watch(self, *, fed: bool = False) -> None:
        """Follow the settings of the watchdog; outputs restart it."""
        registers = self.esc.registers()
        self._state = with_registers(self._state, self._slots, registers, self._seen)
        self._seen = registers
        environment = Environment(self._state.slots, {}, {})
        if not self._watchdog_on(environment):
            self._left = None
            self.esc.show_watchdog(running=True)
        elif fed:
            time = self._watchdog_time(environment)
            self._left = time if isinstance(time, int) and time else None
            self.esc.show_watchdog(running=True)
        elif self._left is None:
            self.esc.show_watchdog(running=False)
