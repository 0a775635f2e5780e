"""Cases on both sides of each comparison that the texts make.

The solver finds the values (`model.boundaries`); here they become what a MainDevice does.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ecatspec.generators.cases.assignment import brought_up
from ecatspec.generators.cases.bringup import (
    WAY_UP,
    has_process_data,
    mailbox_settings,
    way_to,
)
from ecatspec.generators.cases.case import (
    Case,
    Happen,
    Probe,
    SendFrame,
    SetUpProcessData,
    Stimulus,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.cases.process_data import holds, image_size
from ecatspec.generators.cases.transfers import download
from ecatspec.model.core.object_dictionary import encode_value
from ecatspec.model.core.register_map import PROCESS_DATA
from ecatspec.spec.language.functions import CYCLIC

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import Event
    from ecatspec.model.core.values import Value
    from ecatspec.model.symbolic.boundary_values import Boundary
    from ecatspec.spec.language.ir import Input

_CONTROL: Final = "al_control"
_BEYOND: Final = "mailbox_beyond"
_MANY: Final = 2
"""From this number of SyncManager registers on, an input is not one write of the MainDevice."""
_WORDS: Final = {"below": "below", "on": "exactly", "above": "above"}


@dataclass(frozen=True, slots=True)
class BoundaryCases:
    """The cases of boundaries, and how many comparisons or vectors gave none, by the reason."""

    cases: tuple[Case, ...]
    left_out: Counter[str]


class _Unplayable(Exception):  # noqa: N818
    """No MainDevice can do this; the text says why."""


def boundary_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield a case for every boundary vector that a MainDevice can bring about.

    Raises:
        ModuleNotFoundError: The solver is not installed.

    """
    yield from boundary_cases(model).cases


def boundary_cases(model: Model, machines: Collection[str] = ()) -> BoundaryCases:
    """Give the cases of a protocol, or of the rules of some machines, and what was left out.

    Raises:
        ModuleNotFoundError: The solver is not installed.

    """
    try:
        from ecatspec.model.symbolic.boundary_values import Boundaries  # noqa: PLC0415  an optional package
    except ModuleNotFoundError as error:
        if error.name != "z3":
            raise
        message = "cases of boundaries need the package z3-solver; install ecatspec[prove]"
        raise ModuleNotFoundError(message, name="z3") from None
    boundaries = Boundaries(model.protocol, machines)
    player = _Player(model)
    cases: list[Case] = []
    known: set[str] = set()
    left_out: Counter[str] = Counter()
    for boundary in boundaries.found():
        try:
            case = player.case(boundary)
        except _Unplayable as why:
            left_out[str(why)] += 1
            continue
        same = repr(case.stimuli)
        if same in known:
            left_out["another rule has the same stimuli"] += 1
            continue
        known.add(same)
        cases.append(case)
    return BoundaryCases(tuple(cases), boundaries.reasons() + left_out)


class _Player:
    """Turns the inputs of machines into stimuli, on the way up that all cases go."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._brought_up = brought_up(model)
        names = {r.value: r.name for r in model.protocol.tables["al_state"].rows}
        self._states = names

    def case(self, boundary: Boundary) -> Case:
        """Give the case of one vector."""
        stimuli: list[Stimulus] = list(mailbox_settings(self._model, boundary.written))
        asked: list[str] = []
        for event in boundary.events:
            before = len(stimuli)
            stimuli += self._played(boundary, event, asked, stimuli)
            if self._input(event).origin == (_CONTROL,):
                value = event.parameters.get("requested", 0)
                asked.append(self._states.get(int(value), "") if isinstance(value, int) else "")
        before = max(before, 0)
        last = self._input(boundary.events[-1])
        beneath = asked if last.origin != (_CONTROL,) else asked[:-1]
        needs = None
        if beneath and tuple(beneath) == WAY_UP[1 : len(beneath) + 1]:
            needs = beneath[-1]
        if needs is not None and mailbox_settings(
            self._model, boundary.written
        ) != mailbox_settings(self._model):
            raise _Unplayable("no device needs to come so far with such mailboxes")
        if needs is not None and last.kind == "frame":
            stimuli.append(Probe())
        rule = boundary.rule
        name = f"{rule.machine}/boundary/{rule}/{boundary.number}_{boundary.side}"
        title = f"{boundary.atom}: {boundary.value}, {_WORDS[boundary.side]} {boundary.edge}"
        return Case(name, title, rule.machine, tuple(stimuli), needs, before)

    def _input(self, event: Event) -> Input:
        inputs = self._model.protocol.machines[event.machine].inputs
        return next(source for source in inputs if source.name == event.input)

    def _played(
        self, boundary: Boundary, event: Event, asked: list[str], before: list[Stimulus]
    ) -> Iterator[Stimulus]:
        source = self._input(event)
        match source.kind:
            case "frame":
                yield self._message(event)
            case "write" if len(source.origin) >= _MANY:
                raise _Unplayable("a SyncManager that is enabled cannot be set anew")
            case "write":
                (register,) = source.origin
                if register == _CONTROL:
                    yield from self._prepared(boundary, asked)
                    yield WriteRegister(register, _numbers(event.parameters))
                else:
                    yield WriteRegister(register, {"enabled": 1} | _numbers(event.parameters))
            case "word":
                yield self._word(source.origin[0], event)
            case "outputs":
                if not has_process_data(self._model):
                    raise _Unplayable("the device has no process data")
                yield WriteOutputs()
            case "local":
                yield Happen(f"{event.machine}.{event.input}")
            case "own":
                return
            case _:
                if event != self._model.fetched:
                    raise _Unplayable("it comes with time")
                if not any(isinstance(stimulus, SendFrame) for stimulus in before):
                    yield Probe()

    def _prepared(self, boundary: Boundary, asked: list[str]) -> Iterator[Stimulus]:
        """Yield what comes on the way up between two requests."""
        latest = asked[-1] if asked else ""
        if latest not in WAY_UP[1:-1]:
            return
        after = WAY_UP[WAY_UP.index(latest) + 1]
        usual = way_to(self._model, after)[len(way_to(self._model, latest)) : -1]
        changed = self._changed(boundary)
        for stimulus in usual:
            yield stimulus if not isinstance(stimulus, SetUpProcessData) else changed
        if not usual and changed != SetUpProcessData():
            yield changed

    def _changed(self, boundary: Boundary) -> SetUpProcessData:
        """Give the settings of the process data as they deviate from what is assigned."""
        changes: dict[str, dict[str, int]] = {}
        longer: dict[str, int] = {}
        for name in PROCESS_DATA:
            fields = dict(boundary.written.get(name, {}))
            if "length" in fields:
                size = image_size(self._model, self._brought_up, name) or 0
                longer[name] = fields.pop("length") - size
            activation = f"{name}_activation"
            if fields:
                changes[name] = fields
            if activation in boundary.written:
                changes[activation] = dict(boundary.written[activation])
        return SetUpProcessData(changes, longer)

    def _message(self, event: Event) -> SendFrame:
        fields = dict(event.parameters)
        if event.trail == (_BEYOND,):
            fields.setdefault("beyond_length", self._model.parameter("mailbox_out", "length"))
        return SendFrame(event.trail[-1], fields)

    def _word(self, name: str, event: Event) -> Stimulus:
        word = self._model.protocol.words[name]
        raw = 0
        for bits in word.fields:
            raw |= int(_numbers(event.parameters).get(bits.name, 0)) << bits.low
        if event.parameters.get(CYCLIC, False) and holds(self._model, self._brought_up, name):
            return WriteOutputs({name: raw})
        entry = None if word.key is None else self._model.dictionary.entries.get(word.key)
        if word.key is None or entry is None:
            raise _Unplayable("the device has no such object")
        return download(*word.key, encode_value(entry, raw))


def _numbers(parameters: Mapping[str, Value]) -> dict[str, int]:
    return {name: int(value) for name, value in parameters.items() if isinstance(value, int)}
