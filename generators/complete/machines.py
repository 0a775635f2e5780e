"""Makes finite machines of a device's texts: AL, drive, SDO server.

The virtual SubDevice is driven with the stimuli that cases are made of, and looked at as a
MainDevice does. Choices that the texts leave open go as it goes, or as given. What the machines do
not tell apart (data, times, counters) is fixed by the stimuli.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import has_process_data, request, way_to
from ecatspec.generators.cases.case import Happen, SendFrame, StopOutputs, WriteOutputs
from ecatspec.generators.cases.play import exchange, play
from ecatspec.generators.cases.process_data import image_size
from ecatspec.generators.cases.transfers import (
    abort,
    download,
    expedited_size,
    initiate,
    sample,
    segment,
    upload,
    upload_segment,
)
from ecatspec.generators.covers.drive_cover import CONTROL, STATUS, commands, is_driven
from ecatspec.generators.covers.mailbox_cover import probe_entry
from ecatspec.generators.covers.sdo_cover import is_written
from ecatspec.generators.covers.transition_cover import symbols
from ecatspec.model.automata.exploration import explore
from ecatspec.model.automata.mealy import minimise
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.object_dictionary import encode_value, size_of, size_varies
from ecatspec.model.core.process_image import INPUTS, taken
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS
from ecatspec.model.core.values import bits_of
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Hashable, Iterable, Mapping

    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.automata.mealy import Mealy
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import ObjectEntry

Alphabet = dict[str, tuple["Stimulus", ...]]
_EVENTS = ("ds402.fault", "ds402.fault_gone", "ds402.mains_off", "ds402.mains_on")
ALL_EVENTS = frozenset(_EVENTS)
"""The local events that the machines of a drive have as inputs."""
REPLY_FIELDS = ("toggle", "last")
"""What of an answer is looked at beside its kind and its abort code."""
AL_SLOTS = ("al.state", "al.error", "al.code", "process_data.state", "process_data.fed")
"""The slots that tell the states of the AL machine apart."""


@dataclass(frozen=True, slots=True)
class Abstraction:
    """A part of a device as a minimal finite machine, and how to give its inputs to a device.

    `prelude` leads from power-on to the initial state; `stimuli` has those of each input by name.
    `merged` has the names of the explored states that each state of the machine stands for.
    """

    name: str
    machine: Mealy
    prelude: tuple[Stimulus, ...]
    stimuli: Mapping[str, tuple[Stimulus, ...]] = field(hash=False)
    merged: tuple[tuple[str, ...], ...]

    def stimuli_of(self, word: Iterable[int]) -> tuple[Stimulus, ...]:
        """Give the stimuli of a word from power-on, the prelude first."""
        names = self.machine.names(word)
        return (*self.prelude, *(s for name in names for s in self.stimuli[name]))


@dataclass(frozen=True, slots=True)
class Setup:
    """What is driven: what leads to the beginning, the inputs, the slots that tell states apart."""

    name: str
    prelude: tuple[Stimulus, ...]
    alphabet: Mapping[str, tuple[Stimulus, ...]] = field(hash=False)
    slots: tuple[str, ...]


class Driven:
    """A virtual SubDevice that takes inputs by name: what `explore` drives.

    Outputs that a MainDevice writes cyclically are written on with every input.
    """

    def __init__(
        self,
        model: Model,
        prelude: tuple[Stimulus, ...],
        alphabet: Mapping[str, tuple[Stimulus, ...]],
        looks: tuple[Callable[[Driven], str], ...],
        slots: Iterable[str],
        choices: Mapping[str, str] | None = None,
        device: VirtualSubDevice | None = None,
    ) -> None:
        """Take what leads to the beginning, the inputs, and what is looked at after each.

        `slots` are the slots of the model, by name, that tell states apart; what is seen, the
        SyncManagers and the outputs that are written do so too. `choices` go as given. `device`
        is driven; without it a new one.
        """
        self.model = model
        self.device = VirtualSubDevice(model.protocol) if device is None else device
        self.prelude = prelude
        self.alphabet = alphabet
        self.looks = looks
        self.slots = {name: self.device.model.slots[name] for name in slots}
        self.choices = dict(choices or {})
        self.words: Mapping[str, int] | None = None
        self.replies: tuple[str, ...] = ()
        self._counter = 0

    def reset(self) -> None:
        """Power on and give the prelude."""
        self.device.reset()
        for name, alternative in self.choices.items():
            slot = self.device.model.slots[f"choice {name}"]
            self.device.state = self.device.state.having(slot, alternative)
        self.words = None
        self.replies = ()
        self._counter = 0
        self.words = play(self.model, self.device, self.prelude)

    def give(self, symbol: str) -> str:
        """Give an input, and give what is seen then."""
        found: list[str] = []
        for stimulus in self.alphabet[symbol]:
            if isinstance(stimulus, SendFrame):
                found += self._exchange(stimulus)
            else:
                self.words = play(self.model, self.device, (stimulus,), self.words)
        self.replies = tuple(found)
        return self._seen()

    def key(self) -> Hashable:
        """Give the slots, what is seen, SyncManagers, process data, and what is written."""
        state = self.device.state
        values = [state.slots[slot] for slot in self.slots.values()]
        managers = [
            self.device.esc.register(name)
            for manager in (*SYNC_MANAGERS, *PROCESS_DATA)
            for name in (manager, f"{manager}_activation")
        ]
        sizes = (image_size(self.model, state, name) for name in PROCESS_DATA)
        written = None if self.words is None else tuple(sorted(self.words.items()))
        self.replies, replies = (), self.replies
        seen = self._seen()
        self.replies = replies
        return (*values, *managers, *sizes, written, seen)

    def name(self) -> str:
        """Give the states of the machines that are told apart, by name."""
        found = []
        for name, slot in self.slots.items():
            machine, _, kind = name.partition(".")
            value = self.device.state.slots[slot]
            if kind == "state" and isinstance(value, int):
                found.append(self.model.state_names(machine).get(value, str(value)))
            elif value is True:
                found.append(kind)
        return " ".join(found)

    def _seen(self) -> str:
        return ", ".join(look(self) for look in self.looks)

    def _exchange(self, stimulus: SendFrame) -> list[str]:
        """Send a message and read all that comes."""
        self._counter = self._counter % self.model.parameter("highest_counter") + 1
        replies = exchange(self.model, self.device, stimulus, self._counter)
        return [_kind(self.model, data) for data in replies]


# --- what a MainDevice sees -----------------------------------------------------------------------


def al_status(driven: Driven) -> str:
    """Give AL Status, and AL Status Code where an error is indicated, by name."""
    protocol = driven.model.protocol
    raw = _register(driven, "al_status")
    fields = {f.name: bits_of(raw, f.low, f.high) for f in protocol.registers["al_status"].fields}
    states = {r.value: r.name for r in protocol.tables["al_state"].rows}
    state = states.get(fields["state"], str(fields["state"]))
    if not fields["error"]:
        return state
    return f"{state} with error {_register(driven, 'al_status_code'):#06x}"


def drive_status(driven: Driven) -> str:
    """Give the bits of the status word that tell the drive state, from the process data."""
    model, device = driven.device.model, driven.device
    word = model.protocol.words[STATUS]
    mask = 0
    for view in model.views[STATUS]:
        mask |= ((1 << view.width) - 1) << view.low
    environment = Environment(device.state.slots, device.state.objects, {})
    layout = model.image.layout(environment, INPUTS) or ()
    part = next((part for part in layout if part.key == word.key), None)
    if part is None:
        return "no status word"
    size = -(-sum(each.bits for each in layout) // 8)
    counter, data = device.read(model.parameter("process_data_in", "start"), size)
    raw = taken(data, part) if counter else None
    return "no inputs" if raw is None else f"status {raw & mask:#06x}"


def replies(driven: Driven) -> str:
    """Give the kinds of the messages that came for the last input."""
    return " and ".join(driven.replies) or "silence"


def _register(driven: Driven, name: str) -> int:
    register = driven.model.protocol.registers[name]
    _, data = driven.device.read(register.address, register.size)
    return int.from_bytes(data, "little")


def _kind(model: Model, data: bytes) -> str:
    message = model.decode(data)
    if message is None:
        return "something else"
    found = [message.frame]
    code = message.fields.get("code")
    if message.frame == "sdo_abort" and isinstance(code, int):
        found.append(f"{code:#010x}")
    for name in REPLY_FIELDS:
        value = message.fields.get(name)
        if isinstance(value, int):
            found.append(f"{name}={int(value)}")
    return " ".join(found)


# --- the machines ---------------------------------------------------------------------------------


def al_machine(
    model: Model,
    choices: Mapping[str, str] | None = None,
    device: VirtualSubDevice | None = None,
    *,
    few: bool = False,
) -> Abstraction:
    """Give the AL state machine from power-on.

    Inputs: mailboxes and process data set up, a mailbox SyncManager disabled, outputs written or
    stopped, every state and some other values requested with and without acknowledge, of a `few`
    inputs one such value. Outputs: AL Status, and AL Status Code where an error is indicated.
    """
    alphabet = dict(symbols(model, few=few))
    if has_process_data(model):
        alphabet["stop_outputs"] = (StopOutputs(),)
    setup = Setup("AL", (), alphabet, AL_SLOTS)
    return _abstraction(model, setup, (al_status,), choices, device)


def drive_machine(
    model: Model,
    choices: Mapping[str, str] | None = None,
    device: VirtualSubDevice | None = None,
    events: Collection[str] = ALL_EVENTS,
) -> Abstraction | None:
    """Give the drive state machine of CiA 402 in OP; None: the device has none in process data.

    Inputs: the control words of the commands, and those of `events` that may happen in the drive.
    Outputs: the bits of the status word that tell the state, and AL Status.
    """
    setup = drive_setup(model, events)
    if setup is None:
        return None
    return _abstraction(model, setup, (drive_status, al_status), choices, device)


def drive_setup(model: Model, events: Collection[str] = ALL_EVENTS) -> Setup | None:
    """Give what the machine of the drive is made of; None: the device has none in process data."""
    if not is_driven(model):
        return None
    return Setup("DS402", way_to(model, "OP"), _drive_alphabet(model, events), _DRIVE)


def al_drive_machine(
    model: Model,
    choices: Mapping[str, str] | None = None,
    device: VirtualSubDevice | None = None,
    events: Collection[str] = ALL_EVENTS,
) -> Abstraction | None:
    """Give AL and drive together, from OP; None: the device is no drive.

    Inputs: requests of SAFEOP and OP, the commands that go on and back, faults. Outputs as for the
    drive alone.
    """
    setup = al_drive_setup(model, events)
    if setup is None:
        return None
    return _abstraction(model, setup, (drive_status, al_status), choices, device)


def al_drive_setup(model: Model, events: Collection[str] = ALL_EVENTS) -> Setup | None:
    """Give what the machine of AL and drive is made of; None: the device is no drive."""
    if not is_driven(model):
        return None
    whole = _drive_alphabet(model, events)
    alphabet = {name: own for name, own in whole.items() if name in _TOGETHER}
    for name in ("SAFEOP", "OP"):
        alphabet[f"request_{name}"] = (request(model.row("al_state", name)),)
    slots = ("al.state", "al.error", "al.code", "process_data.fed", *_DRIVE[1:])
    return Setup("AL x DS402", way_to(model, "OP"), alphabet, slots)


def sdo_machine(model: Model, choices: Mapping[str, str] | None = None) -> Abstraction | None:
    """Give the control part of the SDO server in PREOP; None: there is nothing to read.

    Inputs: uploads and downloads of one entry each, short and long, segments with both toggle bits,
    an abort, an unknown command. Outputs: the kind of the answer, its toggle bit and abort code.
    """
    setup = sdo_setup(model)
    return None if setup is None else _abstraction(model, setup, (replies,), choices, None)


def sdo_setup(model: Model) -> Setup | None:
    """Give what the machine of the SDO server is made of; None: there is nothing to read."""
    alphabet = _sdo_alphabet(model) if model.has_mailbox else {}
    if not alphabet:
        return None
    slots = (
        *("sdo.state", "sdo.index", "sdo.subindex", "sdo.complete", "sdo.expected_toggle"),
        *("sdo.size", "sdo.data", "al.state"),
    )
    return Setup("SDO", way_to(model, "PREOP"), alphabet, slots)


def driven_again(
    model: Model, found: Abstraction, choices: Mapping[str, str] | None = None
) -> Driven:
    """Give the virtual SubDevice that takes the inputs of a machine, to compare them."""
    looks = {
        "AL": (al_status,),
        "DS402": (drive_status, al_status),
        "AL x DS402": (drive_status, al_status),
        "SDO": (replies,),
    }[found.name]
    return Driven(model, found.prelude, found.stimuli, looks, ("al.state",), choices)


_TOGETHER = ("shutdown", "switch_on", "enable_operation", "disable_voltage", "fault_reset", "fault")
_DRIVE = ("al.state", "ds402.state", "ds402.mains", "ds402.cause", "word control_word")


def _abstraction(
    model: Model,
    setup: Setup,
    looks: tuple[Callable[[Driven], str], ...],
    choices: Mapping[str, str] | None,
    device: VirtualSubDevice | None,
) -> Abstraction:
    driven = Driven(model, setup.prelude, setup.alphabet, looks, setup.slots, choices, device)
    found = minimise(explore(driven, tuple(driven.alphabet)))
    return Abstraction(setup.name, found.machine, driven.prelude, driven.alphabet, found.merged)


def _drive_alphabet(model: Model, events: Collection[str]) -> Alphabet:
    alphabet: Alphabet = {
        name: (WriteOutputs({CONTROL: value}),) for name, value in commands(model).items()
    }
    known = {f"ds402.{i.name}" for i in model.protocol.machines["ds402"].inputs}
    for event in _EVENTS:
        if event in known and event in events:
            alphabet[event.partition(".")[2]] = (Happen(event),)
    return alphabet


def _sdo_alphabet(model: Model) -> Alphabet:
    short = probe_entry(model)
    if short is None:
        return {}
    alphabet: Alphabet = {"upload_short": (upload(short.index, short.subindex),)}
    entries = model.protocol.objects
    room = model.parameter("mailbox_in", "length")
    held = (e for e in entries if e.access is not Access.WRITE and not e.read_states)
    long = next((e for e in held if len(_content(e)) > room), None)
    if long is not None:
        alphabet["upload_long"] = (upload(long.index, long.subindex),)
    for toggle in (False, True):
        name = f"upload_segment_{int(toggle)}"
        alphabet[name] = (upload_segment(toggle=toggle),)
    taken_ = (e for e in entries if is_written(e) and not e.states and not size_varies(e))
    in_one = (e for e in taken_ if 2 <= size_of(e) <= expedited_size(model))  # noqa: PLR2004
    put = max(in_one, key=size_of, default=None)
    if put is not None:
        value = sample(put)
        place = (put.index, put.subindex)
        alphabet["download_short"] = (download(*place, value),)
        alphabet["download_begin"] = (initiate(*place, len(value), b""),)
        for toggle in (False, True):
            for last, piece in ((False, value[:1]), (True, value), (True, value[1:])):
                name = f"download_{'last_' if last else ''}{len(piece)}_{int(toggle)}"
                alphabet[name] = (segment(piece, toggle=toggle, last=last),)
    alphabet["abort"] = (abort(0, 0, 0),)
    known = {r.value for r in model.protocol.tables["client_command"].rows}
    odd = next(
        c for c in range(1 << model.protocol.tables["client_command"].width) if c not in known
    )
    rest = bytes(model.parameter("smallest_data_field"))
    alphabet["unknown_command"] = (SendFrame("sdo_request", {"command": odd, "rest": rest}),)
    return alphabet


def _content(entry: ObjectEntry) -> bytes:
    return b"" if entry.default is None else encode_value(entry, entry.default)
