"""Explores what the texts allow a device to show, as finite machines.

They are walked with the stimuli of the complete suites, but an output is a set: all that a
MainDevice may see after an input, not only what the virtual SubDevice happens to take. With it
stands which rules led there, so that a difference can cite them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

from ecatspec.generators.cases.bringup import WATCHDOG, has_process_data, mailbox_settings, request
from ecatspec.generators.cases.case import (
    Happen,
    SetUpProcessData,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.complete.machines import (
    AL_SLOTS,
    REPLY_FIELDS,
    Driven,
    Setup,
    al_drive_setup,
    drive_setup,
    sdo_setup,
)
from ecatspec.generators.covers.drive_cover import STATUS
from ecatspec.model.automata.mealy import Mealy, minimise
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.interpreter import expected_fields, step
from ecatspec.model.core.observables import layout, shown_fields, shown_register
from ecatspec.model.core.process_image import INPUTS
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS
from ecatspec.model.core.values import Pattern, Unknown, Value, any_open
from ecatspec.model.core.wording import typed_words, value_words
from ecatspec.model.esc.subdevice import Snapshot, VirtualSubDevice

if TYPE_CHECKING:
    from collections.abc import Collection, Hashable, Mapping, Sequence

    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.state import Event, Output, RuleName, State, Step
    from ecatspec.spec.language.ir import Protocol

AL, DRIVE, BOTH, SDO = "AL", "DS402", "AL x DS402", "SDO"
MACHINES = (AL, DRIVE, BOTH, SDO)
"""What is compared by trying it out, in this order."""
_CODE = "code"
_ABORT = "abort"
_EXPIRED = 3_000_000
"""Microseconds after which the watchdog that was set up has expired."""


@dataclass(frozen=True, slots=True)
class Part:
    """One thing that a MainDevice sees: what it may be, and this in words."""

    name: str
    value: Value
    words: str


@dataclass(frozen=True, slots=True)
class Seen:
    """What a MainDevice may see after an input, and the rules that fired for it.

    `decided`: with this input something was left to the device, and not with one before.
    """

    parts: tuple[Part, ...]
    rules: tuple[RuleName, ...]
    decided: bool = False

    @property
    def refused(self) -> bool:
        """Tell whether it shows that the input was refused: an error, or an abort."""
        return any(
            (part.name == "error" and part.value is True) or _ABORT in str(part.value)
            for part in self.parts
        )

    def words(self) -> str:
        """Give all parts in words."""
        return ", ".join(part.words for part in self.parts if part.words) or "nothing"


@dataclass(frozen=True, slots=True)
class Explored:
    """A machine of one device; `seen` has what its outputs stand for, by their names."""

    setup: Setup
    machine: Mealy
    seen: Mapping[str, Seen] = field(hash=False)


_Place: TypeAlias = "tuple[Snapshot, Mapping[int, Value], bool, Mapping[str, int] | None, int]"
"""Where a device is: what it is itself, what it was free to choose, whether something was left free
lately, the words that are written cyclically, the mailbox counter."""


class ObservedDevice:
    """A virtual SubDevice of which is kept which rules fired and what it was free to choose."""

    def __init__(self, protocol: Protocol) -> None:
        """Power on with nothing kept."""
        self.device = VirtualSubDevice(protocol)
        self.device.observer = self._observe
        self.model = self.device.model
        self.free: dict[int, Value] = {}
        self.taken: list[Step] = []
        self.decided = False
        """Whether something was left free since this was last set to False."""
        self.settled: set[str] | None = None
        """The choices that it may not go otherwise at any more; None: nobody asks."""
        self.others: list[Step] = []
        """What else the texts would have let it do."""
        self.unbound = Model(protocol)

    def forget(self) -> None:
        """Keep nothing of what was."""
        self.free, self.taken = {}, []

    def _observe(self, _state: State, event: Event, taken: Step) -> None:
        """Keep a step, and of each slot what else it may hold."""
        for rule in taken.rules:
            for slot, _ in self.model.named(rule).updates:
                self.free.pop(slot, None)
        if any_open(taken.state.slots):
            found = {n: v for n, v in enumerate(taken.state.slots) if isinstance(v, Pattern)}
            self.free |= found
            self.decided = True
        if taken.rules:
            self.taken.append(taken)
        if self.settled is not None:
            self._look_aside(event, taken, self.settled)

    def _look_aside(self, event: Event, taken: Step, settled: set[str]) -> None:
        """Keep what else the texts would let the device do, and which choices have shown."""
        model = self.unbound
        state = self.allowed()
        unsettled = [n for n in model.protocol.choices if n not in settled]
        for name in unsettled:
            state = state.having(model.slots[f"choice {name}"], None)
        every = step(model, state, event)
        same = [other for other in every if other.rules == taken.rules]
        for name in unsettled:
            slot = model.slots[f"choice {name}"]
            if same and all(other.state.slots[slot] is not None for other in same):
                settled.add(name)
        self.others += (other for other in every if other.rules != taken.rules)

    def allowed(self) -> State:
        """Give the present state with all that the texts leave free in it."""
        state = self.device.state
        for slot, pattern in self.free.items():
            state = state.having(slot, pattern)
        return state


class _Walked(Driven):
    """What is explored: a driven device whose outputs are sets."""

    def __init__(self, observed: ObservedDevice, setup: Setup, choices: Mapping[str, str]) -> None:
        device = observed.device
        super().__init__(
            device.model, setup.prelude, setup.alphabet, (), setup.slots, choices, device
        )
        self.observed = observed
        self.setup = setup
        self.seen: dict[str, Seen] = {}

    def reset(self) -> None:
        """Power on, keep nothing of what was, and give the prelude."""
        self.observed.forget()
        super().reset()

    def give(self, symbol: str) -> str:
        """Give an input, and the name of what may be seen then."""
        observed = self.observed
        observed.taken, observed.decided = [], False
        super().give(symbol)
        rules = tuple(dict.fromkeys(rule for taken in observed.taken for rule in taken.rules))
        outputs = [(taken.state, out) for taken in observed.taken for out in taken.outputs]
        found = Seen(tuple(self._parts(observed.allowed(), outputs)), rules, observed.decided)
        name = f"{found.words()} [{', '.join(map(str, rules))}]{' *' * found.decided}"
        return self._named(name, found)

    def keep(self) -> _Place:
        """Give where the device is now, to go on from there later."""
        observed = self.observed
        free = observed.free.copy()
        return self.device.snapshot(), free, observed.decided, self.words, self._counter

    def go_on(self, place: _Place) -> None:
        """Go on from a place that was kept."""
        snapshot, free, self.observed.decided, self.words, self._counter = place
        self.device.restore(snapshot)
        self.observed.free = dict(free)

    def _named(self, name: str, found: Seen) -> str:
        """Give a name that stands for nothing else."""
        while self.seen.setdefault(name, found) != found:
            name += "'"
        return name

    def key(self) -> Hashable:
        """Give what tells the present state from others."""
        device = self.device
        state = self.observed.allowed()
        managers = tuple(
            device.esc.register(name)
            for manager in (*SYNC_MANAGERS, *PROCESS_DATA)
            for name in (manager, f"{manager}_activation")
        )
        written = None if self.words is None else tuple(sorted(self.words.items()))
        slots = tuple(state.slots[slot] for slot in self.slots.values())
        return slots, managers, written

    def otherwise(self, word: Sequence[str]) -> list[Seen]:
        """Give what else the texts let the device show after the last input of a word."""
        for symbol in word:
            self.observed.others = []
            self.give(symbol)
        found = []
        for other in self.observed.others:
            outputs = [(other.state, out) for out in other.outputs]
            found.append(Seen(tuple(self._parts(other.state, outputs)), other.rules))
        return found

    def _parts(self, state: State, outputs: Sequence[tuple[State, Output]]) -> list[Part]:
        model = self.model
        if self.setup.name == SDO:
            return self._replies(outputs)
        found = []
        for name in ("al_status", "al_status_code"):
            register = model.protocol.registers[name]
            types = {bits.name: bits.type for bits in register.fields}
            for key, value in shown_register(model, register, state).items():
                if not isinstance(value, Unknown):
                    words = typed_words(model, types[key], value)
                    found.append(Part(key, value, _al_words(key, value, words)))
        if self.setup.name != AL:
            found += self._status(state)
        return found

    def _status(self, state: State) -> list[Part]:
        model = self.model
        word = model.protocol.words[STATUS]
        mapped = layout(model, self.device.state, INPUTS) or ()
        shown = shown_fields(model, state, STATUS)
        if not any(part.key == word.key for part in mapped) or not shown:
            return [Part("status word", 0, "no status word")]
        slot = model.slots["ds402.state"]
        drive = state.slots[slot]
        names = model.state_names("ds402")
        said = f"drive {names.get(drive, '?') if isinstance(drive, int) else 'in some state'}"
        bits = [Part(f"status bit {name}", value, "") for name, value in shown.items()]
        return [Part("status word", 1, said), *bits]

    def _replies(self, outputs: Sequence[tuple[State, Output]]) -> list[Part]:
        found = []
        for number, (state, output) in enumerate(outputs):
            fields = expected_fields(self.model, state, output)
            found.append(Part(f"answer {number}", output.frame, output.frame.replace("_", " ")))
            for name in (_CODE, *REPLY_FIELDS):
                value = fields.get(name)
                if value is not None and not isinstance(value, Unknown):
                    words = f"{name} {value_words(self.model, output.frame, name, value)}"
                    found.append(Part(f"answer {number} {name}", value, words))
        return found or [Part("answer 0", "silence", "silence")]


def owner(part: str) -> str:
    """Give the machine that a part of what is seen belongs to."""
    if part.startswith("answer"):
        return "sdo"
    return "ds402" if part.startswith("status ") else "al"


def _al_words(name: str, value: Value, words: str) -> str:
    if name == "state":
        return words.partition(" ")[2] or f"state {words}"
    if name == "error":
        return "error" if value is True else ""
    return f"code {words}" if name == _CODE else ""


# --- the machines ---------------------------------------------------------------------------------


def setups(model: Model) -> dict[str, Setup]:
    """Give what the machines of a device are made of, by name; without those that it has not."""
    found = (_al_setup(model), drive_setup(model), al_drive_setup(model), sdo_setup(model))
    return {setup.name: setup for setup in found if setup is not None}


def _al_setup(model: Model) -> Setup:
    """Give AL from power-on: mailbox and process data set up each by itself, and taken away."""
    states = {r.value: r.name for r in model.protocol.tables["al_state"].rows}
    invalid = next(value for value in range(max(states) + 2) if value not in states)
    alphabet: dict[str, tuple[Stimulus, ...]] = {"set_up_mailbox": mailbox_settings(model)}
    first = f"disable_{SYNC_MANAGERS[0]}"
    alphabet[first] = (_disabled(SYNC_MANAGERS[0]),)
    if has_process_data(model):
        quiet = WriteRegister("watchdog_process_data", {"time": WATCHDOG})
        alphabet["set_up_process_data"] = (quiet, SetUpProcessData())
        alphabet["outputs"] = (WriteOutputs(),)
        alphabet["outputs_end"] = (StopOutputs(), Wait(_EXPIRED))
        # outputs that are not taken any more are missed in the end
        second = f"disable_{PROCESS_DATA[0]}"
        alphabet[second] = (_disabled(PROCESS_DATA[0]), Wait(_EXPIRED))
    for value, name in {**states, invalid: f"value_{invalid}"}.items():
        alphabet[f"request_{name}"] = (request(value),)
        alphabet[f"acknowledge_{name}"] = (request(value, acknowledge=True),)
    for local in model.locals:
        if local.machine == "al":
            alphabet[local.input] = (Happen(f"al.{local.input}"),)
    return Setup(AL, (), alphabet, AL_SLOTS)


def _disabled(name: str) -> WriteRegister:
    return WriteRegister(f"{name}_activation", {"enabled": 0})


def explored(
    device: ObservedDevice, setup: Setup, inputs: Collection[str], choices: Mapping[str, str]
) -> Explored:
    """Give the machine of a device over some of the inputs of a setup, minimal.

    What the device is in each state is kept, so that no way has to be walked twice.
    """
    alphabet = {name: own for name, own in setup.alphabet.items() if name in inputs}
    small = Setup(setup.name, setup.prelude, alphabet, setup.slots)
    walked = _Walked(device, small, choices)
    walked.reset()
    begin = walked.keep()
    places: dict[Hashable, int] = {walked.key(): 0}
    names = [walked.name()]
    kept = [begin]
    targets: list[int] = []
    outputs: dict[str, int] = {}
    out: list[int] = []
    for place in kept:
        for symbol in alphabet:
            walked.go_on(place)
            output = walked.give(symbol)
            out.append(outputs.setdefault(output, len(outputs)))
            key = walked.key()
            if key not in places:
                places[key] = len(names)
                names.append(f"{walked.name()} #{len(names)}")
                kept.append(walked.keep())
            targets.append(places[key])
    machine = Mealy(tuple(names), tuple(alphabet), tuple(outputs), tuple(targets), tuple(out))
    return Explored(small, minimise(machine).machine, walked.seen)


def otherwise(
    device: ObservedDevice, setup: Setup, choices: Mapping[str, str], word: Sequence[str]
) -> list[Seen]:
    """Give all that the texts let a device show after the last input of a word.

    Choices that neither `choices` nor what was seen before settle, and conditions, go any way then.
    """
    walked = _Walked(device, setup, choices)
    device.settled = {*choices, *device.model.protocol.pins}
    try:
        walked.reset()
        return walked.otherwise(word)
    finally:
        device.settled = None
