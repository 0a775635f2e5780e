"""The virtual SubDevice: the texts at work on the memory of an ESC.

Where the texts leave a choice it goes the first way or the pinned one; where they accept a set it
takes the first value; conditions of the device are as the texts assume.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, TypeAlias

from ecatspec.model.core.compilation import MAILBOX, Model
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.interpreter import (
    afterwards,
    expected_fields,
    fields_with_before,
    later_fields,
    step,
)
from ecatspec.model.core.memo import once
from ecatspec.model.core.object_dictionary import encode_value
from ecatspec.model.core.observables import definitely, layout
from ecatspec.model.core.process_image import INPUTS, placed
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS
from ecatspec.model.core.state import Event, Output, State, Step
from ecatspec.model.core.values import Pattern, Value, any_open, concrete
from ecatspec.model.esc.esc import Esc
from ecatspec.spec.language.functions import IMAGE
from ecatspec.spec.language.ir import Access, InputKind

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.model.core.codec import Message
    from ecatspec.spec.language.ir import Protocol

SdoServer: TypeAlias = Callable[[bytes], list[bytes]]
MAIN_OUT, MAIN_IN = SYNC_MANAGERS
_SECOND = 1_000_000
_BYTE = 8
_MOST = 4
"""Number of protocols that are kept compiled."""
_MODELS: dict[int, Model] = {}


class Quirk(StrEnum):
    """A mistake in how a device handles its mailbox memory, which no text can describe."""

    OVERWRITES = "overwrites"
    """A request is served while the answer before is unread, and its answer put in the place of
    that one, which the device takes back by switching the SyncManager."""
    SHORT_WRITES = "short_writes"
    """The last byte of the area is not written, so that the mailbox never becomes full."""
    LOSES_UNREAD = "loses_unread"
    """A repeated message is put over the one that was not read yet."""
    KEEPS_CODE = "keeps_code"
    """AL Status Code is written with an error only, and not taken back with it."""
    OPEN_REGISTERS = "open_registers"
    """The MainDevice can write registers that only the device may write."""


Observer: TypeAlias = "Callable[[State, Event, Step], None]"
"""What is told of each step, before it is made: the state, the input, what the rules make of it."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All that a virtual SubDevice is at one time."""

    esc: Esc
    """A copy that nobody else has."""
    state: State
    shown: State | None
    taken: bytes
    queue: tuple[bytes, ...]
    unread: bytes | None
    last: bytes | None
    clock: int
    alarms: tuple[tuple[tuple[str, str], tuple[int, Event]], ...]


class VirtualSubDevice:
    """A SubDevice made of a protocol; `sdo_server` may serve SDO requests in its place."""

    def __init__(
        self,
        protocol: Protocol,
        sdo_server: SdoServer | None = None,
        quirks: frozenset[Quirk] = frozenset(),
    ) -> None:
        """Compile the protocol and power on; `quirks` are mistakes of the layer below the texts."""
        self.quirks = quirks
        self.observer: Observer | None = None
        self.model = _compiled(protocol)
        self._sdo_server = sdo_server
        codec = self.model.codec
        self._request_service = codec.fixed("sdo_request")["service"]
        self._response_service = codec.fixed("sdo_response")["service"]
        self._power_on = power_on(self.model)
        self._register_slots = register_slots(self.model)
        self.reset()

    def reset(self) -> None:
        """Power cycle."""
        self.esc = Esc(self.model)
        self._shown: State | None = None
        self._taken = b""
        """The registers when the device looked at them last."""
        self.state = self._power_on
        self._queue: list[bytes] = []
        self._unread: bytes | None = None
        self._last: bytes | None = None
        self._clock = 0
        self._alarms: dict[tuple[str, str], tuple[int, Event]] = {}
        self._show()

    def snapshot(self) -> Snapshot:
        """Give what the device is now; what serves its SDO requests in its place is no part."""
        return Snapshot(
            self.esc.copy(),
            self.state,
            self._shown,
            self._taken,
            tuple(self._queue),
            self._unread,
            self._last,
            self._clock,
            tuple(self._alarms.items()),
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Be as a device of these texts was then; a snapshot may be restored again."""
        self.esc = snapshot.esc.copy()
        self.state = snapshot.state
        self._shown = snapshot.shown
        self._taken = snapshot.taken
        self._queue = list(snapshot.queue)
        self._unread = snapshot.unread
        self._last = snapshot.last
        self._clock = snapshot.clock
        self._alarms = dict(snapshot.alarms)

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice."""
        outbox = self.esc.mailbox(MAIN_IN)
        waits = outbox is not None and outbox.full
        result = self.esc.main_read(address, length)
        if outbox is not None and waits and not outbox.full:
            self._last, self._unread = self._unread, None
            self._run(self.model.fetched)
            self.poll()
        return result

    def write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice."""
        counter = self.esc.main_write(address, data)
        if Quirk.OPEN_REGISTERS in self.quirks:
            self._overwrite(address, data)
        self.poll()
        return counter

    def _overwrite(self, address: int, data: bytes) -> None:
        for register in self.model.protocol.registers.values():
            place = register.address - address
            if register.main is Access.READ and 0 <= place <= len(data) - register.size:
                raw = int.from_bytes(data[place : place + register.size], "little")
                self.esc.set_register(register.name, raw)

    def advance(self, seconds: float) -> None:
        """Let time pass: what comes by itself comes as early as it may, all else at once."""
        until = self._clock + round(seconds * _SECOND)
        while self._alarms:
            key, (due, event) = min(self._alarms.items(), key=lambda item: item[1][0])
            if due > until:
                break
            del self._alarms[key]
            self._clock = max(self._clock, due)
            self._run(event)
            self.poll()
        self._clock = until
        self.poll()

    def logical(self, command: str, address: int, data: bytes) -> tuple[int, bytes]:
        """Answer a logical command (LRD, LWR, LRW) as a MainDevice with FMMUs gives it."""
        result = self.esc.logical(command, address, data)
        self.poll()
        return result

    def awaits(self, machine: str, event: str) -> bool:
        """Tell whether something will happen by itself, after some time."""
        return (machine, event) in self._alarms

    def happen(self, machine: str, event: str, parameters: Mapping[str, Value]) -> None:
        """Let something happen inside the device that a machine has as local input."""
        self._run(Event(machine, event, parameters))
        self.poll()

    # --- the device's side ------------------------------------------------------------------------

    def poll(self) -> None:
        """Do what a device's main loop does: look at the events and serve them."""
        if self.esc.settings_changed:
            self._take_settings()
        if self.esc.al_control_changed:
            self._take_request()
        if self.esc.outputs_written:
            self._take_outputs()
        self._serve_mailbox()
        self._show()

    def _registers(self) -> None:
        registers, before = self.esc.registers(), self._taken
        if registers == before:
            return
        self._taken = registers
        was_alive = self._alive()
        self.state = with_registers(self.state, self._register_slots, registers, before)
        self._drop_mail(was_alive)

    def _drop_mail(self, was_alive: bool) -> None:  # noqa: FBT001
        if self._alive() != was_alive:
            self._queue, self._unread, self._last = [], None, None

    def _take_settings(self) -> None:
        managers = (*SYNC_MANAGERS, *PROCESS_DATA)
        for name in managers:
            at = self.model.protocol.registers[f"{name}_activation"]
            self.esc.pdi_read(at.address, at.size)
        self._registers()
        for machine in self.model.protocol.machines.values():
            for source in machine.inputs:
                if source.kind == InputKind.WRITE and any(
                    o.startswith(managers) for o in source.origin
                ):
                    self._run(Event(machine.name, source.name, {}))

    def _take_request(self) -> None:
        at = self.model.protocol.registers["al_control"]
        raw = int.from_bytes(self.esc.pdi_read(at.address, at.size), "little")
        past = self.state.slots[self.model.slots[f"register {at.name}"]]
        self._registers()
        self._run(Event("al", "request", fields_with_before(at.fields, raw, past)))

    def _take_outputs(self) -> None:
        image = self.esc.outputs()
        if image is not None:
            self._registers()
            for source in self.model.outputs:
                self._run(Event(source.machine, source.input, {IMAGE: image}))

    def _serve_mailbox(self) -> None:
        outbox = self.esc.mailbox(MAIN_IN)
        if outbox is None:
            self._unread = None
            return
        free = not outbox.full or Quirk.OVERWRITES in self.quirks
        inbox = self.esc.mailbox(MAIN_OUT)
        if inbox is not None and inbox.full and not self._queue and free:
            self._registers()
            area = inbox.channel
            message = self.model.decode(self.esc.pdi_read(area.start, area.length))
            if message is not None:
                self._run(self.model.mail(message, crowded=False), message)
        if self._queue and free:
            if Quirk.OVERWRITES in self.quirks:
                self.esc.empty(MAIN_IN)
            area = outbox.channel
            self._unread = self._queue.pop(0)
            reply = self._unread[: area.length]
            if Quirk.SHORT_WRITES in self.quirks:
                self.esc.pdi_write(area.start, reply[: area.length - 1])
            else:
                self.esc.pdi_write(area.start, reply.ljust(area.length, b"\0"))

    def react(self, event: Event) -> Step:
        """Give what the rules make of an input in the present state."""
        return step(self.model, self.state, event)[0]

    def _run(self, event: Event, message: Message | None = None) -> None:
        taken = self.react(event)
        if self.observer is not None:
            self.observer(self.state, event, taken)
        if taken.unspecified and message is not None and not _delivered(taken):
            return
        was_alive = self._alive()
        self._settle(taken.state)
        for alarm in taken.alarms:
            due = self._clock + alarm.after
            self._alarms[alarm.event.machine, alarm.event.input] = (due, alarm.event)
        self._drop_mail(was_alive)
        if taken.resend is not None and self._last is not None:
            waiting = [] if self._unread is None else [self._unread]
            if Quirk.LOSES_UNREAD in self.quirks:
                waiting = []
            self._queue = [self._last, *waiting, *self._queue]
            self.esc.empty(MAIN_IN)
        if self._sdo_server and message and self._is_sdo(message) and _delivered(taken):
            self._queue += self._served(self._sdo_server, message)
        else:
            self._send(taken.outputs)

    def _send(self, outputs: tuple[Output, ...]) -> None:
        for output in outputs:
            fields = self._formed(output)
            self._queue.append(self.model.codec.encode(output.frame, fields))
            following = afterwards(self.model, self.state, output, fields)[0]
            self._settle(following.state)
            self._send(following.outputs)

    def _settle(self, state: State) -> None:
        if any_open(state.slots):
            state = state.holding(tuple(None if v is None else concrete(v) for v in state.slots))
        if state != self.state:
            self.state = state

    def _alive(self) -> bool:
        return definitely(self.model, self.state, "mailbox_alive") is True

    def _is_sdo(self, message: Message) -> bool:
        return message.fields.get("service") == self._request_service

    def _served(self, server: SdoServer, message: Message) -> list[bytes]:
        codec = self.model.codec
        body = message.fields.get("body")
        replies = []
        for answer in server(body if isinstance(body, bytes) else b""):
            trial = codec.encode("coe", {"service": self._request_service, "body": answer})
            decoded = codec.decode(trial, MAILBOX)
            aborts = decoded is not None and decoded.frame == "sdo_abort"
            service = self._request_service if aborts else self._response_service
            defaults = self._defaults("coe")
            replies.append(codec.encode("coe", {**defaults, "service": service, "body": answer}))
        return replies

    def _formed(self, output: Output) -> dict[str, Value]:
        """Choose the fields of a frame, those that depend on others last."""
        fields = self._concrete(expected_fields(self.model, self.state, output), output.frame)
        for name in later_fields(self.model, self.state, output, fields)[0]:
            fields[name] = concrete(later_fields(self.model, self.state, output, fields)[0][name])
        return fields

    def _defaults(self, frame: str) -> dict[str, Value]:
        environment = Environment(self.state.slots, {}, {})
        fields = {name: get(environment) for name, (get, _) in self.model.replies[frame].items()}
        return self._concrete(fields, frame)

    def _concrete(self, fields: dict[str, Value], frame: str) -> dict[str, Value]:
        chosen: dict[str, Value] = {}
        for name, value in fields.items():
            into = self.model.replies[frame].get(name, (None, None))[1]
            after = self.state.slots[self.model.slots[into]] if into else 0
            taken = concrete(value, after) if into and isinstance(after, int) else concrete(value)
            chosen[name] = taken
            if into:
                self.state = self.state.having(self.model.slots[into], taken)
        return chosen

    def _show(self) -> None:
        """Write the inputs and what the registers show, AL Status Code before AL Status."""
        if self.state is self._shown:
            return
        self._shown = self.state
        registers, inputs = _presented(self.model, self.state)
        if inputs is not None:
            self.esc.set_inputs(inputs)
        for register, raw in registers:
            if raw or register != "al_status_code" or Quirk.KEEPS_CODE not in self.quirks:
                self.esc.set_register(register, raw)


@once
def power_on(model: Model) -> State:
    """Give the state in which a virtual SubDevice of these texts begins."""
    if not model.assuming:
        return VirtualSubDevice(model.protocol).state
    state = model.initial
    for entry in model.protocol.objects:
        default = entry.maps or 0 if entry.default is None else entry.default
        state = state.keeping((entry.index, entry.subindex), encode_value(entry, default))
    return state


@once
def _presented(model: Model, state: State) -> tuple[tuple[tuple[str, int], ...], bytes | None]:
    """Give what the registers show and the inputs, None where they have no content."""
    environment = Environment(state.slots, state.objects, {})
    registers = [r for r in model.protocol.registers.values() if model.views[r.name]]
    shown = []
    # AL Status Code lies above AL Status and is written first
    for register in sorted(registers, key=lambda register: -register.address):
        raw = 0
        for view in model.views[register.name]:
            value = view.present(environment)
            number = 0 if isinstance(value, Pattern) or not isinstance(value, int) else value
            raw |= int(number) << view.low
        shown.append((register.name, raw))
    return tuple(shown), _inputs(model, state, environment)


def _inputs(model: Model, state: State, environment: Environment) -> bytes | None:
    mapped = layout(model, state, INPUTS)
    if not mapped or not model.definition("inputs_valid")(environment):
        return None
    image = 0
    for part in mapped:
        if part.key is not None:
            shown = model.dictionary.shown.get(part.key)
            value = shown(environment) if shown else environment.objects.get(part.key)
            if isinstance(value, bytes):
                image = placed(image, part, int.from_bytes(value, "little"))
    return image.to_bytes(-(-sum(part.bits for part in mapped) // _BYTE), "little")


def register_slots(model: Model) -> tuple[tuple[int, int, int], ...]:
    """Give the registers that a state knows: slot, first address, address behind the last."""
    return tuple(
        (slot, at.address, at.address + at.size)
        for name, at in model.protocol.registers.items()
        if (slot := model.slots.get(f"register {name}")) is not None
    )


def with_registers(
    state: State, slots: tuple[tuple[int, int, int], ...], registers: bytes, before: bytes
) -> State:
    """Give the state after the memory of the registers was `before` and is `registers`."""
    for slot, low, high in slots:
        if (raw := registers[low:high]) != before[low:high]:
            state = state.having(slot, int.from_bytes(raw, "little"))
    return state


def _compiled(protocol: Protocol) -> Model:
    """Give what devices of a protocol go by, the same for all: they only ask it.

    It is the same object that is meant: to compare protocols takes as long as to compile one.
    """
    model = _MODELS.pop(id(protocol), None)
    if model is None:
        model = Model(protocol, assuming=True, closed=True)
        if len(_MODELS) == _MOST:
            del _MODELS[next(iter(_MODELS))]
    _MODELS[id(protocol)] = model  # which keeps the protocol, so that no other has its number
    return model


def _delivered(taken: Step) -> bool:
    """Tell whether the mailbox took the message and handed it on."""
    return any(rule.machine == MAILBOX for rule in taken.rules) and len(taken.rules) > 1
