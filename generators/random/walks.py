"""Seeded walks: long random runs over all machines of a device at once.

A walk knows what a MainDevice would know: the state that it believes the device to be in, and
where its own transfer stands. It is mostly sensible, so that it gets deep, and at every step it may
do something else. Each walk does some things often and leaves others out, so that many walks
differ more than one long one would.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from ecatspec.generators.cases.bringup import (
    WATCHDOG,
    WAY_UP,
    mailbox_settings,
    needs_mailbox,
    request,
)
from ecatspec.generators.cases.case import (
    Case,
    Happen,
    Hurry,
    Probe,
    ReadConfiguration,
    ReadRegister,
    Repeat,
    SendFrame,
    SendSegments,
    SetUpProcessData,
    Stimulus,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.cases.client import Ask, Begin, Client, Segment
from ecatspec.generators.cases.transfers import (
    abort,
    download,
    entry_request,
    expedited_size,
    list_request,
    normal_download,
    object_request,
    other_sample,
    pattern,
    sample,
    unsized,
    upload,
)
from ecatspec.generators.covers.complete_access_cover import image, objects
from ecatspec.generators.covers.drive_cover import CONTROL, commands
from ecatspec.generators.covers.sdo_cover import missing_indexes
from ecatspec.generators.covers.transition_cover import wrong_settings
from ecatspec.generators.random.stable_random import Dice
from ecatspec.generators.random.walk_alphabet import ground
from ecatspec.model.core.object_dictionary import encode_value, size_of, size_varies
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS
from ecatspec.spec.language.ir import Bool

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import ObjectEntry

LAYER: Final = "al"
"""A walk goes through the AL states, so it is for devices that have their own."""
_Stimuli: TypeAlias = "Sequence[Stimulus]"

_LONGEST: Final = 200
"""Bytes of a value at most: enough for several segments over a small mailbox."""
_BELOVED: Final = 4
"""Entries that a walk comes back to, so that it reads what it wrote."""
_WAITS: Final = (500, 20_000, 300_000, 2_500_000, 6_000_000)
"""Microseconds: within an answer, between two cycles, and beyond a watchdog and a timeout."""
_LIKINGS: Final = (0, 1, 1, 3)
"""How often a walk does a thing, beside how often walks do it at all."""
_LADDER: Final = ("shutdown", "switch_on", "enable_operation")


def walk(model: Model, limits: Limits, raisable: frozenset[str], seed: int, steps: int) -> Case:
    """Give a random walk of `steps` stimuli from power-on; a longer one begins like a shorter one.

    The same arguments give the same walk, on every version of Python: only numbers of
    `Random.random` are used, which keeps its sequence.

    Args:
        model: what the texts mean.
        limits: what the way to the device cannot carry; the walk does without it.
        raisable: the local events, `machine.input`, that can be raised in the device.
        seed: a number from 0 on.
        steps: stimuli of the walk.

    Raises:
        ValueError: `seed` or `steps` is negative.

    """
    if seed < 0 or steps < 0:
        raise ValueError(f"a walk has a seed and steps from 0 on, not {seed} and {steps}")
    walker = _Walker(model, limits, sorted(raisable), Dice(seed))
    stimuli: list[Stimulus] = []
    while len(stimuli) < steps:
        for stimulus in walker.move():
            walker.believe(stimulus)
            if model.has_mailbox or not needs_mailbox(stimulus):
                stimuli.append(stimulus)
    title = f"random walk of {steps} steps, seed {seed}"
    return Case(f"walk/{seed}_{steps}", title, LAYER, tuple(stimuli[:steps]))


class _Walker:
    """One walk: what it believes of the device, and what it does next."""

    def __init__(self, model: Model, limits: Limits, events: Sequence[str], dice: Dice) -> None:
        self._model = model
        self._limits = limits
        self._events = events
        self._dice = dice
        self._ground = ground(model, limits)
        self._client = Client(model, limits)
        self._state = WAY_UP[0]
        self._refused = False
        self._open = ""
        self._rung = 0
        self._last: SendFrame | None = None
        self._restarts = "mailbox_restart" not in limits.without
        entries = self._ground.entries
        self._beloved = [dice.pick(entries) for _ in range(_BELOVED)] if entries else []
        if self._ground.written:
            self._beloved += [dice.pick(self._ground.written) for _ in range(_BELOVED)]
        self._goal = dice.pick((*WAY_UP[1:], WAY_UP[-1]))
        self._moves = self._chosen()

    def _chosen(self) -> list[tuple[Callable[[], _Stimuli], tuple[int, ...]]]:
        """Give what this walk does, each with its weight in the states of the way up."""
        found: list[tuple[Callable[[], _Stimuli], tuple[int, ...]]] = [(self._climb, _CLIMB)]
        found.append((self._go_on, _GO_ON))
        for name, weights in _WEIGHTS.items():
            liking = self._dice.pick(_LIKINGS)
            move = getattr(self, f"_move_{name}")
            if liking:
                found.append((move, tuple(weight * liking for weight in weights)))
        return found

    def move(self) -> _Stimuli:
        """Give the stimuli of the next thing to do; none where it has no meaning now."""
        if self._dice.one_in(_PATIENCE):
            self._goal = self._dice.pick(WAY_UP[1:])
        level = WAY_UP.index(self._state)
        weights = [row_[level] for _, row_ in self._moves]
        if level >= WAY_UP.index(self._goal):
            weights[0] = 0
        weights[1] *= bool(self._open)
        return self._moves[self._dice.weighed(weights)][0]()

    def believe(self, stimulus: Stimulus) -> None:
        """Follow what a stimulus does, as far as a MainDevice can tell beforehand."""
        match stimulus:
            case WriteRegister("al_control", fields):
                self._request(fields["requested"], acknowledge=bool(fields["acknowledge"]))
            case SendFrame("sdo_upload_request"):
                self._open, self._last = "up", stimulus
            case SendFrame("sdo_download_normal"):
                self._open, self._last = "down", stimulus
            case SendFrame():
                self._last = stimulus
            case _:
                pass

    def _request(self, value: int, *, acknowledge: bool) -> None:
        if self._refused and not acknowledge:
            return
        name = self._ground.states.get(value, "")
        if name in WAY_UP and WAY_UP.index(name) <= WAY_UP.index(self._state) + 1:
            self._refused = False
            if name == WAY_UP[0] or self._state != WAY_UP[-1]:
                self._rung = 0
            if name == WAY_UP[0] or self._state == WAY_UP[0]:
                self._open = ""
            self._state = name
        else:
            self._refused = True

    # --- the AL states ----------------------------------------------------------------------------

    def _climb(self) -> _Stimuli:
        """Go one state up, seldom without what has to come before."""
        name = WAY_UP[WAY_UP.index(self._state) + 1]
        before = () if self._dice.one_in(12) else self._ground.up[name]
        acknowledge = self._refused or self._dice.one_in(6)
        return *before, request(self._value(name), acknowledge=acknowledge)

    def _move_fall(self) -> _Stimuli:
        """Go to a lower state, or ask for the present one again."""
        lower = WAY_UP[: WAY_UP.index(self._state) + 1]
        names = lower if self._restarts else lower[1:]
        if not names:
            return ()
        return (request(self._value(self._dice.pick(names)), acknowledge=self._dice.one_in(3)),)

    def _move_odd_request(self) -> _Stimuli:
        """Ask for any value."""
        if not self._restarts:
            return ()
        value = self._dice.below(1 << self._model.protocol.tables["al_state"].width)
        return (request(value, acknowledge=self._dice.one_in(2)),)

    def _move_acknowledge(self) -> _Stimuli:
        if not self._restarts and self._state == WAY_UP[0]:
            return ()
        return (request(self._value(self._state), acknowledge=True),)

    def _move_set_up_mailbox(self) -> _Stimuli:
        return mailbox_settings(self._model)

    def _move_misset_mailbox(self) -> _Stimuli:
        """Set a mailbox wrongly, or switch one off; a device that used it goes to INIT."""
        if self._state != WAY_UP[0]:
            if not self._restarts:
                return ()
            self._state, self._refused, self._open, self._rung = WAY_UP[0], True, "", 0
        if self._dice.one_in(3):
            name = self._dice.pick(SYNC_MANAGERS)
            return (WriteRegister(f"{name}_activation", {"enabled": 0}),)
        return self._dice.pick(wrong_settings(self._model))[1]

    def _move_set_up_data(self) -> _Stimuli:
        return (SetUpProcessData(),)

    def _move_misset_data(self) -> _Stimuli:
        """Set the process data SyncManagers with one deviation."""
        name = self._dice.pick(PROCESS_DATA)
        tables = {"mode": "sync_manager_mode", "direction": "sync_manager_direction"}
        kind = self._dice.pick(("longer", "enabled", *tables))
        if kind == "longer":
            return (SetUpProcessData(longer={name: self._dice.within(-3, 12)}),)
        if kind == "enabled":
            return (SetUpProcessData({f"{name}_activation": {"enabled": 0}}),)
        value = self._dice.pick(self._model.protocol.tables[tables[kind]].rows).value
        return (SetUpProcessData({name: {kind: value}}),)

    def _value(self, state: str) -> int:
        return self._model.row("al_state", state)

    # --- process data, time, local events ---------------------------------------------------------

    def _move_command(self) -> _Stimuli:
        """Command the drive further up, mostly."""
        if not self._ground.controls:
            return ()
        known = commands(self._model)
        if self._dice.one_in(3):
            self._rung = 0
            return (WriteOutputs({CONTROL: self._dice.pick(self._ground.controls)}),)
        word = known[_LADDER[min(self._rung, len(_LADDER) - 1)]]
        self._rung += 1
        return (WriteOutputs({CONTROL: word}),)

    def _move_outputs(self) -> _Stimuli:
        """Write process data, with any value in one of their words."""
        if not self._ground.words or self._dice.one_in(2):
            return (WriteOutputs(),)
        name, bits = self._dice.pick(self._ground.words)
        return (WriteOutputs({name: self._dice.below(1 << bits)}),)

    def _move_hurry(self) -> _Stimuli:
        """Do not wait for what outputs lead to before something else comes."""
        return (Hurry(), *(self._move_command() or self._move_outputs()))

    def _move_stop_outputs(self) -> _Stimuli:
        return (StopOutputs(),)

    def _move_wait(self) -> _Stimuli:
        return (Wait(self._dice.pick(_WAITS)),)

    def _move_raise_local(self) -> _Stimuli:
        return (Happen(self._dice.pick(self._events)),) if self._events else ()

    def _move_read_register(self) -> _Stimuli:
        return (ReadRegister(self._dice.pick(self._ground.readable)),)

    def _move_set_watchdog(self) -> _Stimuli:
        time = self._dice.pick((0, WATCHDOG // 4, WATCHDOG, 2 * WATCHDOG))
        return (WriteRegister("watchdog_process_data", {"time": time}),)

    # --- SDO --------------------------------------------------------------------------------------

    def _move_upload(self) -> _Stimuli:
        """Ask for an entry, and mostly read on to its end."""
        ask = upload(*self._key(written=False))
        return (ask,) if self._dice.one_in(3) else (ask, SendSegments())

    def _move_download(self) -> _Stimuli:
        """Write an entry in one of the shapes that there are."""
        key = self._key(written=True)
        value = self._bytes(key)
        if len(value) > expedited_size(self._model) or not value or self._dice.one_in(4):
            room = len(value) + 1
            first, piece = self._dice.below(room), 1 + self._dice.below(room)
            whole = self._dice.one_in(2)
            return normal_download(
                self._model, key, value, self._limits, first=None if whole else first, piece=piece
            )
        if self._dice.one_in(6):
            return (unsized(self._model, *key, value),)
        return (download(*key, value),)

    def _move_begin(self) -> _Stimuli:
        """Begin a download of which more is to come."""
        key = self._key(written=True)
        value = self._bytes(key)
        return (self._client.give(Begin(key, value, self._dice.below(len(value) + 1))),)

    def _go_on(self) -> _Stimuli:
        """Go on with the transfer that is open, mostly as it should be."""
        right = not self._dice.one_in(8)
        if self._open == "up":
            return (self._client.give(Ask(right)),)
        if not self._client.rest:
            self._open = ""
        count = 1 + self._dice.below(max(1, len(self._client.rest)))
        return (self._client.give(Segment(count, right, honest=not self._dice.one_in(12))),)

    def _move_abort(self) -> _Stimuli:
        key = self._key(written=False)
        codes = self._model.protocol.tables["sdo_abort_code"].rows
        return (abort(*key, self._dice.pick(codes).value),)

    def _move_complete(self) -> _Stimuli:
        """Read or write a whole object."""
        if "complete_access" in self._limits.without or not self._beloved:
            return ()
        index = self._dice.pick(self._beloved).index
        entries = objects(self._model)[index]
        first = self._dice.below(3)
        bits = any(isinstance(entry.type, Bool) for entry in entries)
        if bits or self._dice.one_in(2):
            return (upload(index, first, complete=True), SendSegments())
        data = image(entries, first)
        if self._dice.one_in(4):
            data = data[: self._dice.below(len(data) + 1)]
        if not data:
            return ()
        return normal_download(self._model, (index, first), data, self._limits, complete=True)

    def _move_information(self) -> _Stimuli:
        """Ask what there is."""
        index, subindex = self._key(written=False)
        lists = self._model.protocol.tables["object_list_type"].rows
        return (
            self._dice.pick(
                (
                    list_request(self._dice.pick(lists).value),
                    object_request(index),
                    entry_request(index, subindex),
                    entry_request(index, subindex, self._dice.below(1 << 8)),
                )
            ),
        )

    def _move_configure(self) -> _Stimuli:
        """Assign or map process data, whole or in part."""
        if not self._ground.configurations:
            return ()
        picked = self._dice.pick(self._ground.configurations)
        stimuli = tuple(s for s in picked if not isinstance(s, Happen) or s.event in self._events)
        if self._dice.one_in(3):
            return stimuli[self._dice.below(len(stimuli)) :]
        return stimuli

    def _move_read_configuration(self) -> _Stimuli:
        return (ReadConfiguration(),)

    # --- the mailbox ------------------------------------------------------------------------------

    def _move_family(self) -> _Stimuli:
        """Send a request at its edge, or with one fault."""
        return self._dice.pick(self._ground.families) if self._ground.families else ()

    def _move_repeat(self) -> _Stimuli:
        return () if "repeat" in self._limits.without else (Repeat(),)

    def _move_again(self) -> _Stimuli:
        """Send the last message once more: with its counter, or with the next."""
        if self._last is None:
            return ()
        same = self._dice.one_in(2)
        return (SendFrame(self._last.frame, self._last.fields, same_counter=same),)

    def _move_leave_unread(self) -> _Stimuli:
        """Ask, and leave the answer in the mailbox for now."""
        ask = upload(*self._key(written=False))
        return (SendFrame(ask.frame, ask.fields, unread=True),)

    def _move_probe(self) -> _Stimuli:
        return (Probe(),)

    # --- values -----------------------------------------------------------------------------------

    def _key(self, *, written: bool) -> tuple[int, int]:
        """Give an entry: mostly one that the walk comes back to, seldom one that is missing."""
        if not self._ground.entries or self._dice.one_in(16):
            return self._dice.pick(missing_indexes(self._model)), self._dice.below(3)
        entries = (written and self._ground.written) or self._ground.entries
        beloved = [entry for entry in self._beloved if not written or entry in entries]
        if self._dice.one_in(4) or not beloved:
            beloved = list(entries)
        entry = self._dice.pick(beloved)
        return entry.index, entry.subindex + int(self._dice.one_in(24))

    def _bytes(self, key: tuple[int, int]) -> bytes:
        """Give a value for an entry: mostly one that it takes, seldom of a wrong length."""
        entry = self._model.dictionary.entries.get(key)
        least = int("empty_download" in self._limits.without)
        value = b"\1" if entry is None else self._value_of(entry)[:_LONGEST]
        if self._dice.one_in(8):
            value = pattern(self._dice.below(_LONGEST) if self._dice.one_in(4) else len(value) + 1)
        return value or bytes(least)

    def _value_of(self, entry: ObjectEntry) -> bytes:
        if self._dice.one_in(3):
            return self._dice.pick((sample(entry), other_sample(entry)))
        size = min(size_of(entry), _LONGEST)
        if size_varies(entry):
            return pattern(self._dice.pick((0, 1, self._dice.within(0, size), size)), size)
        if isinstance(entry.type, Bool):
            return bytes([self._dice.below(3)])
        if entry.low is None or entry.high is None:
            return self._dice.data(size)
        low, high = entry.low, entry.high
        within = self._dice.within(low, high)
        number = self._dice.pick((low, high, within, within, within, low - 1, high + 1))
        return encode_value(entry, number)


_PATIENCE: Final = 20
"""The mean number of moves after which a walk has another goal."""
_CLIMB: Final = (20, 14, 20, 0)
_GO_ON: Final = (0, 25, 25, 25)
_WEIGHTS: Final[Mapping[str, tuple[int, int, int, int]]] = {
    "fall": (1, 2, 2, 2),
    "odd_request": (2, 1, 1, 1),
    "acknowledge": (1, 1, 1, 1),
    "set_up_mailbox": (2, 1, 1, 1),
    "misset_mailbox": (3, 1, 1, 1),
    "set_up_data": (1, 2, 1, 1),
    "misset_data": (1, 3, 1, 1),
    "command": (0, 1, 3, 12),
    "outputs": (1, 1, 3, 4),
    "hurry": (0, 1, 1, 3),
    "stop_outputs": (0, 1, 1, 2),
    "wait": (1, 1, 2, 3),
    "raise_local": (1, 1, 2, 4),
    "read_register": (1, 1, 1, 1),
    "set_watchdog": (1, 1, 1, 1),
    "upload": (1, 6, 4, 4),
    "download": (1, 6, 4, 4),
    "begin": (0, 4, 2, 2),
    "abort": (0, 1, 1, 1),
    "complete": (0, 2, 1, 1),
    "information": (0, 2, 1, 1),
    "configure": (0, 4, 1, 1),
    "read_configuration": (0, 1, 1, 0),
    "family": (1, 3, 2, 2),
    "repeat": (1, 2, 2, 2),
    "again": (1, 2, 1, 1),
    "leave_unread": (0, 1, 1, 1),
    "probe": (1, 1, 1, 1),
}
"""What a walk may do, by the names of the methods, and how often in the states of the way up."""
