"""Cases of CiA 402: every command and event in every drive state, and modes.

The states are those that the virtual SubDevice reaches with process data in OP; each case is the
shortest way to a state, then a control word that keeps it, and one input more: what counts may be
the level of a bit or its edge.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from ecatspec.generators.cases.assignment import assign_all, assign_apart, brought_up
from ecatspec.generators.cases.bringup import has_process_data, request, way_to
from ecatspec.generators.cases.case import (
    Case,
    Happen,
    Hurry,
    Probe,
    SetUpProcessData,
    Stimulus,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.cases.play import Reached, at_power_on
from ecatspec.generators.cases.process_data import holds
from ecatspec.generators.cases.transfers import download, upload
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.memo import once
from ecatspec.model.core.object_dictionary import encode_value
from ecatspec.model.core.register_map import PROCESS_DATA
from ecatspec.model.esc.subdevice import power_on

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model

Symbol = tuple[str, Stimulus]
Way = tuple[Symbol, ...]

CONTROL, STATUS = "control_word", "status_word"
CHOSEN = "chosen_mode"
_LONG = 5_000_000
_EVENTS = ("fault", "fault_gone", "mains_off", "mains_on")
_CODES = {"shutdown_code": "shutdown", "disable_code": "switch_on", "halt_code": "halt"}
"""Words that hold option codes, and the command that each speaks of."""
_ENABLED = "OPERATION_ENABLED"
_FAULT = "FAULT"
_UP = ("shutdown", "switch_on", "enable_operation")
"""The commands that lead up."""


def is_drive(model: Model) -> bool:
    """Tell whether the device has the words of a drive."""
    return {CONTROL, STATUS} <= {word.name for word in model.words.values()}


@once
def is_driven(model: Model) -> bool:
    """Tell whether process data command the drive, as they are assigned on the way up."""
    ready = is_drive(model) and has_process_data(model)
    return ready and holds(model, brought_up(model), CONTROL)


def drive_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield the cases of a device whose texts declare a control word."""
    if not is_drive(model):
        return
    yield from _by_sdo(model)
    yield from _modes(model)
    if not is_driven(model):
        return
    reached = _Reached(model)
    ways = _ways(model, reached)
    for way in ways.values():
        for symbol in _symbols(model):
            yield _case(model, (*way, symbol))
    shortest = _shortest(model, ways)
    for way in shortest.values():
        for kept in _keeping(model, reached, way):
            for symbol in _words(model):
                yield _case(model, (*way, kept, symbol))
        for symbol in _others(model):
            yield _case(model, (*way, symbol))
    yield from _up_again(model, reached, shortest)
    yield from _leaving(model, shortest)
    yield from _options(model, shortest)
    yield from _mapped_modes(model)
    yield from _second_pdo(model)
    yield from _reads(model, shortest)
    yield from _resets(model, shortest)
    yield from _early(model)
    yield from _unwatched(model)
    yield from _hurried(model, shortest)


def commands(model: Model) -> dict[str, int]:
    """Give the control words of the commands, as the fields of the word make them up."""
    fields = {field.name: field.low for field in model.protocol.words[CONTROL].fields}

    def word(*names: str) -> int:
        return sum(1 << fields[name] for name in names)

    ready = ("enable_voltage", "quick_stop")
    on = ("switch_on", *ready)
    return {
        "disable_voltage": 0,
        "quick_stop": word("enable_voltage"),
        "shutdown": word(*ready),
        "shutdown_with_enable": word(*ready, "enable_operation"),
        "switch_on": word(*on),
        "enable_operation": word(*on, "enable_operation"),
        "halt": word(*on, "enable_operation", "halt"),
        "quick_stop_enabled": word("switch_on", "enable_voltage", "enable_operation"),
        "fault_reset": word("fault_reset"),
        "fault_reset_enabled": word("fault_reset", *on, "enable_operation"),
    }


def _words(model: Model) -> Iterator[Symbol]:
    for name, value in commands(model).items():
        yield name, WriteOutputs({CONTROL: value})


def _others(model: Model) -> Iterator[Symbol]:
    """Yield what the bits of the commands make up beside these: several change at once."""
    known = commands(model)
    bits = 0
    for name in _UP:
        bits |= known[name]
    for value in range(bits + 1):
        if value & ~bits == 0 and value not in known.values():
            yield f"word_{value:04X}", WriteOutputs({CONTROL: value})
    halted = known["halt"] & ~known["enable_operation"]
    for word, more in (("halted", halted), ("with_fault_reset", known["fault_reset"])):
        for name, value in known.items():
            if value | more not in known.values():
                yield f"{name}_{word}", WriteOutputs({CONTROL: value | more})


def _symbols(model: Model) -> Iterator[Symbol]:
    yield from _words(model)
    for event in _EVENTS:
        yield event, Happen(f"ds402.{event}")


class _Reached:
    """Where ways of commands lead from OP; a way goes on from where all but its last leads."""

    def __init__(self, model: Model) -> None:
        self._model = model
        start = at_power_on(model).by(model, way_to(model, "OP"))
        self._found: dict[tuple[str, ...], Reached] = {(): start}

    def state(self, way: Way) -> tuple[object, ...]:
        """Give the state of the drive, its power and the cause of its fault."""
        device = self._reached(way).device
        slots = ("ds402.state", "ds402.mains", "ds402.cause")
        return tuple(device.state.slots[self._model.slots[name]] for name in slots)

    def _reached(self, way: Way) -> Reached:
        names = tuple(name for name, _ in way)
        if names not in self._found:
            self._found[names] = self._reached(way[:-1]).by(self._model, (way[-1][1],))
        return self._found[names]


def _ways(model: Model, reached: _Reached) -> dict[tuple[object, ...], Way]:
    """Give the shortest way to each state of the drive, its power and the cause of its fault."""
    ways: dict[tuple[object, ...], Way] = {}
    work: deque[Way] = deque([()])
    while work:
        way = work.popleft()
        key = reached.state(way)
        if key not in ways:
            ways[key] = way
            work.extend((*way, symbol) for symbol in _symbols(model))
    return ways


def _keeping(model: Model, reached: _Reached, way: Way) -> list[Symbol]:
    """Give the control words that leave the drive in its state."""
    state = reached.state(way)
    return [symbol for symbol in _words(model) if reached.state((*way, symbol)) == state]


def _shortest(model: Model, ways: dict[tuple[object, ...], Way]) -> dict[str, Way]:
    """Give the shortest way to each drive state, by its name."""
    names = model.state_names("ds402")
    found: dict[str, Way] = {}
    for key, way in ways.items():
        if isinstance(key[0], int):
            found.setdefault(names[key[0]], way)
    return found


def _case(model: Model, way: Way) -> Case:
    names = [name for name, _ in way]
    before = (*way_to(model, "OP"), *(stimulus for _, stimulus in way[:-1]))
    title = f"{names[-1].replace('_', ' ')} after {', '.join(names[:-1]) or 'OP'}"
    stimuli = (*before, way[-1][1])
    return Case(f"ds402/{'/'.join(names)}", title, "ds402", stimuli, "OP", len(way_to(model, "OP")))


def _in(model: Model, name: str, stimuli: tuple[Stimulus, ...], state: str = "OP") -> Case:
    way = way_to(model, state)
    title = f"drive: {name.replace('_', ' ').replace('/', ', ')}"
    return Case(f"ds402/{name}", title, "ds402", (*way, *stimuli), state, len(way))


# --- beside the state machine ---------------------------------------------------------------------


def _by_sdo(model: Model) -> Iterator[Case]:
    """Yield control words by SDO, each followed by a look at the status word."""
    control, status = (model.protocol.words[name].key for name in (CONTROL, STATUS))
    if control is None or status is None:
        return
    known = commands(model)
    for state in ("PREOP", "SAFEOP", "OP"):
        for count in range(1, len(_UP) + 1):
            stimuli: list[Stimulus] = []
            for name in _UP[:count]:
                stimuli += [_set(model, control, known[name]), upload(*status)]
            yield _in(model, f"by_sdo/{state}/{_UP[count - 1]}", tuple(stimuli), state)
        yield _in(model, f"by_sdo/{state}/status", (upload(*status), Probe()), state)


def _reads(model: Model, ways: dict[str, Way]) -> Iterator[Case]:
    """Yield the status word by SDO in each drive state."""
    status = model.protocol.words[STATUS].key
    if status is not None:
        for name, way in ways.items():
            yield _in(model, f"status_by_sdo/{name}", (*_of(way), upload(*status)))


def _up_again(model: Model, reached: _Reached, ways: dict[str, Way]) -> Iterator[Case]:
    """Yield the way up after each transition: a state is the same however it was reached."""
    known = commands(model)
    up = tuple(WriteOutputs({CONTROL: known[name]}) for name in _UP)
    for name, way in ways.items():
        before = reached.state(way)
        for symbol in _symbols(model):
            if reached.state((*way, symbol)) != before:
                yield _in(model, f"up_after/{name}/{symbol[0]}", (*_of((*way, symbol)), *up))


def _leaving(model: Model, ways: dict[str, Way]) -> Iterator[Case]:
    """Yield what takes OP away in each drive state, and the way back."""
    again = tuple(WriteOutputs({CONTROL: value}) for value in (0, 0))
    known = commands(model)
    commanded = tuple(WriteOutputs({CONTROL: known[name]}) for name in _UP)
    op = request(model.row("al_state", "OP"))
    safeop = request(model.row("al_state", "SAFEOP"), acknowledge=True)
    options: list[int | None] = [*_values(model, "connection_code")] or [None]
    for name, way in ways.items():
        for target in ("SAFEOP", "PREOP", "INIT"):
            down = request(model.row("al_state", target))
            yield _in(model, f"leaving_by_{target}/{name}", (*_of(way), down))
        # first what shows of a drive that is switched off
        every = (commanded[0], *(stimulus for _, stimulus in _words(model)))
        for target in ("SAFEOP", "PREOP"):
            down = request(model.row("al_state", target))
            looks = tuple(_look(model)) if target == "PREOP" else ()
            done = (*_of(way), down, *looks, *every, *looks)
            yield _in(model, f"commands_in_{target}_after_OP/{name}", done)
        down = request(model.row("al_state", "SAFEOP"))
        yield _in(model, f"back_in_op/{name}", (*_of(way), down, op, *again, *commanded))
        up = _from_preop(model, "OP")
        preop = request(model.row("al_state", "PREOP"))
        yield _in(model, f"up_again/{name}", (*_of(way), preop, *up, *again))
        if name == _FAULT:
            gone = Happen("ds402.fault_gone")
            yield _in(model, "up_again/fault_gone", (*_of(way), gone, preop, *up, *again))
        yield _in(model, f"watchdog/{name}", (*_of(way), StopOutputs(), Wait(_LONG)))
        yield _in(model, f"sync_lost/{name}", (*_of(way), Happen("al.sync_lost")))
        off = WriteRegister(f"{PROCESS_DATA[0]}_activation", {"enabled": 0})
        back = (SetUpProcessData(), request(model.row("al_state", "SAFEOP"), acknowledge=True))
        yield _in(model, f"disabled/{name}", (*_of(way), off, *back, op, *again))
    for option in options:
        chosen = () if option is None else (_option(model, "connection_code", option),)
        lost = (*_of(ways.get(_ENABLED, ())), StopOutputs(), Wait(_LONG), WriteOutputs())
        done = (*chosen, *lost, safeop, op, *again)
        yield _in(model, f"connection_lost/{'default' if option is None else option}", done)


def _look(model: Model) -> Iterator[Stimulus]:
    """Yield an upload of the status word."""
    status = model.protocol.words[STATUS].key
    if status is not None:
        yield upload(*status)


def _resets(model: Model, ways: dict[str, Way]) -> Iterator[Case]:
    """Yield fault resets that are held while the cause goes, or while the fault comes."""
    reset = WriteOutputs({CONTROL: commands(model)["fault_reset"]})
    held = (Happen("ds402.fault"), reset, Happen("ds402.fault_gone"), Wait(_LONG), reset)
    before = (reset, Happen("ds402.fault"), Happen("ds402.fault_gone"), Wait(_LONG), reset)
    reset_once = (Happen("ds402.fault"), Happen("ds402.fault_gone"), Wait(_LONG), reset)
    zero = WriteOutputs({CONTROL: 0})
    for name in (_ENABLED, "SWITCH_ON_DISABLED"):
        if name in ways:
            yield _in(model, f"reset_held/{name}", (*_of(ways[name]), *held, zero, reset))
            yield _in(model, f"reset_before/{name}", (*_of(ways[name]), *before, zero, reset))
            twice = (*reset_once, zero, *reset_once, zero)
            yield _in(model, f"reset_twice/{name}", (*_of(ways[name]), *twice))


def _early(model: Model) -> Iterator[Case]:
    """Yield control words before OP, by process data and by SDO, and then OP."""
    control, status = (model.protocol.words[name].key for name in (CONTROL, STATUS))
    op = request(model.row("al_state", "OP"))
    known = commands(model)
    after = tuple(WriteOutputs({CONTROL: known[name]}) for name in ("disable_voltage", *_UP))
    for name, value in known.items():
        early: tuple[Stimulus, ...] = (WriteOutputs({CONTROL: value}), op, *after)
        yield _in(model, f"early/{name}", early, "SAFEOP")
    if control is not None and status is not None:
        first = _set(model, control, known["shutdown"])
        up = _from_preop(model, "SAFEOP")
        yield _in(model, "early/by_sdo", (first, *up, upload(*status)), "PREOP")


def _hurried(model: Model, ways: dict[str, Way]) -> Iterator[Case]:
    """Yield commands while the drive stops, and a fault while it tests itself."""
    known = commands(model)
    for name in ("enable_operation", "disable_voltage"):
        if _ENABLED in ways:
            stopping = (*_of(ways[_ENABLED]), Hurry(), WriteOutputs({CONTROL: known["quick_stop"]}))
            done = (*stopping, WriteOutputs({CONTROL: known[name]}))
            yield _in(model, f"while_stopping/{name}", done)
    op = request(model.row("al_state", "OP"))
    tested = (WriteOutputs(), Hurry(), op, Happen("ds402.fault"))
    yield _in(model, "while_testing/fault", tested, "SAFEOP")


def _unwatched(model: Model) -> Iterator[Case]:
    """Yield outputs that stop while the watchdog is off: they still count, and so do new ones."""
    off = WriteRegister("watchdog_process_data", {"time": 0})
    known = commands(model)
    shutdown, nothing = (WriteOutputs({CONTROL: known[n]}) for n in ("shutdown", "disable_voltage"))
    safeop, op = (request(model.row("al_state", name)) for name in ("SAFEOP", "OP"))
    stopped = (off, shutdown, StopOutputs(), Wait(_LONG))
    yield _in(model, "unwatched/SAFEOP", (*stopped, op, nothing), "SAFEOP")
    yield _in(model, "unwatched/OP", (*stopped, nothing))
    for option in _values(model, "connection_code")[:1]:
        chosen = _option(model, "connection_code", option)
        yield _in(model, "unwatched/again", (chosen, *stopped, safeop, op, nothing))


def _options(model: Model, ways: dict[str, Way]) -> Iterator[Case]:
    """Yield a quick stop, halt and disabling with every option code that the texts allow."""
    known = commands(model)
    enabled = ways.get(_ENABLED)
    if enabled is None:
        return
    after = ("enable_operation", "shutdown", "switch_on", "disable_voltage", "quick_stop")
    codes = _values(model, "quick_stop_code")
    for option in codes:
        chosen = (_option(model, "quick_stop_code", option), *_of(enabled))
        stopped = (*chosen, WriteOutputs({CONTROL: known["quick_stop"]}), Wait(_LONG))
        for name in after:
            done = (*stopped, WriteOutputs({CONTROL: known[name]}))
            yield _in(model, f"quick_stop_code_{option}/{name}", done)
        if option in {codes[0], codes[-1]}:
            done = (*stopped, Happen("ds402.stopped"))
            yield _in(model, f"quick_stop_code_{option}/stopped", done)
    for code, name in _CODES.items():
        for option in _values(model, code):
            first = (_option(model, code, option), *_of(enabled))
            done = (*first, WriteOutputs({CONTROL: known[name]}), Wait(_LONG))
            yield _in(model, f"{code}_{option}/{name}", done)
    for option in _values(model, "fault_code"):
        first = (_option(model, "fault_code", option), *_of(enabled))
        yield _in(model, f"fault_code_{option}/fault", (*first, Happen("ds402.fault")))


def _modes(model: Model) -> Iterator[Case]:
    """Yield every mode of the profile, one that it reserves, and ones of the manufacturer."""
    chosen, active = (model.protocol.words[name].key for name in (CHOSEN, "active_mode"))
    if chosen is None or active is None:
        return
    if not {chosen, active} <= model.dictionary.entries.keys():
        return
    rows = [r.value for r in model.protocol.tables["operation_mode"].rows]
    first_ones = (*rows[:1], *_offered(model)[0][:1])
    ask = upload(*active)
    up = _from_preop(model, "SAFEOP")
    for mode in (*rows, 5, 11, 127, -1):
        chosen_by_sdo = _set(model, chosen, mode)
        # a drive may show its mode from SAFEOP on
        yield _in(model, f"mode_{mode}/PREOP", (chosen_by_sdo, ask, *up, ask), "PREOP")
        if not is_driven(model):
            continue
        done = (chosen_by_sdo, ask)
        yield _in(model, f"mode_{mode}/OP", done)
        for first in first_ones:
            again = (_set(model, chosen, first), ask, *done)
            yield _in(model, f"mode_{mode}_after_{first}/OP", again)


def _mapped_modes(model: Model) -> Iterator[Case]:
    """Yield modes that process data bring, and modes by SDO beside them."""
    control, chosen, active = (
        model.protocol.words[name].key for name in (CONTROL, CHOSEN, "active_mode")
    )
    if control is None or chosen is None or active is None:
        return
    if not {control, chosen, active} <= model.dictionary.entries.keys():
        return
    mapped = assign_all(model, (control, chosen))
    good, bad = _offered(model)
    if not mapped or len(good) <= 1:
        return
    ask = upload(*active)
    by_sdo = _set(model, chosen, good[0]), ask
    brought = WriteOutputs({CHOSEN: good[1]}), ask
    safeop, up = (_from_preop(model, state) for state in ("SAFEOP", "OP"))
    done: dict[str, tuple[Stimulus, ...]] = {
        "PREOP": by_sdo,
        "SAFEOP": (*safeop, *by_sdo, *brought, request(model.row("al_state", "OP")), ask),
        "OP": (*up, *brought),
        "by_sdo": (*up, *brought, *by_sdo),
    }
    if bad:
        done["not_offered"] = (*up, *brought, WriteOutputs({CHOSEN: bad[0]}), ask)
        done["not_offered_by_sdo"] = (*up, *brought, _set(model, chosen, bad[0]), ask)
    for name, stimuli in done.items():
        yield _in(model, f"mode_mapped/{name}", (*mapped, *stimuli), "PREOP")


def _second_pdo(model: Model) -> Iterator[Case]:
    """Yield the words of a drive in the second of two PDOs: the image holds both."""
    pairs = ((CHOSEN, CONTROL), ("active_mode", STATUS))
    known = commands(model)
    up = tuple(WriteOutputs({CONTROL: known[name]}) for name in ("disable_voltage", "shutdown"))
    preop = request(model.row("al_state", "PREOP"))
    for direction, names in zip(model.image.assignments, pairs, strict=True):
        first, second = (model.protocol.words[name].key for name in names)
        if (
            first is None
            or second is None
            or not {first, second} <= model.dictionary.entries.keys()
        ):
            continue
        mapped = assign_apart(model, direction, first, second)
        if mapped:
            # the first time the drive shows that it has what it needs to be ready
            again = (preop, *mapped, *_from_preop(model, "OP"), *up)
            yield _in(model, f"second_pdo/{names[1]}", (*up, *again, *_look(model)))


@once
def _offered(model: Model) -> tuple[list[int], list[int]]:
    """Give the modes that the drive has, the certain ones first, and those that it has not."""
    state = power_on(model)
    offered = model.definition("mode_offered")
    found: dict[bool | None, list[int]] = {True: [], None: [], False: []}
    for row in model.protocol.tables["operation_mode"].rows[1:]:
        slots = state.having(model.slots[f"word {CHOSEN}"], row.value).slots
        value = offered(Environment(slots, state.objects, {}))
        found[value if isinstance(value, bool) else None].append(row.value)
    return found[True] + found[None], found[False]


# --- helpers --------------------------------------------------------------------------------------


def _from_preop(model: Model, state: str) -> tuple[Stimulus, ...]:
    return way_to(model, state)[len(way_to(model, "PREOP")) :]


def _of(way: Way) -> tuple[Stimulus, ...]:
    return tuple(stimulus for _, stimulus in way)


def _set(model: Model, key: tuple[int, int], value: int) -> Stimulus:
    return download(*key, encode_value(model.dictionary.entries[key], value))


def _option(model: Model, word: str, value: int) -> Stimulus:
    key = model.protocol.words[word].key
    return _set(model, key or (0, 0), value)


def _values(model: Model, word: str) -> list[int]:
    """Give the values that the range of an option code allows; none where there is no range."""
    key = model.protocol.words[word].key
    entry = None if key is None else model.dictionary.entries.get(key)
    if entry is None or entry.low is None or entry.high is None:
        return []
    return [value for value in range(entry.low, entry.high + 1) if value >= 0]
