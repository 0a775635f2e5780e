"""Finds which mistakes in a device its suite notices, and which it does not.

The device under test is the virtual SubDevice of mutated texts, judged by the texts as they are.
What the sound device was asked in each case, and what it answered, is kept: a mutant that answers
the same to all of it would get the same verdict, so it is not judged there.
"""

from __future__ import annotations

import multiprocessing
import signal
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, ParamSpec, TypeAlias, TypeVar

from ecatspec.conformance.adapters.in_process import Guarded
from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.adapter import DeviceFault, DeviceHang
from ecatspec.conformance.base.devices import UserError, load
from ecatspec.conformance.base.verdict import BLAMING
from ecatspec.conformance.mutation.fates import Analysis, Fate, Fated, TableKills
from ecatspec.conformance.run.case_executor import CaseExecutor
from ecatspec.conformance.run.dut_knowledge import shape_of
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.complete.faults import kills
from ecatspec.generators.complete.finite_cover import complete_suites
from ecatspec.generators.complete.machines import al_drive_machine, al_machine, drive_machine
from ecatspec.generators.mutation.mutants import DEFINE, SHOWN, definitions_in, mutants
from ecatspec.generators.suite import all_cases
from ecatspec.model.analysis.as_built import as_built
from ecatspec.model.automata.mealy import equivalent
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.compiled import rows_of
from ecatspec.model.core.interpreter import step
from ecatspec.model.core.state import RuleName
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import load_standard

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
    from types import FrameType

    from ecatspec.conformance.base.adapter import Description
    from ecatspec.conformance.run.runner import Progress
    from ecatspec.generators.cases.case import Case
    from ecatspec.generators.complete.finite_cover import Complete
    from ecatspec.generators.complete.machines import Abstraction
    from ecatspec.generators.mutation.equivalents import Equivalents
    from ecatspec.generators.mutation.mutants import Mutant
    from ecatspec.model.core.state import Event, State, Step
    from ecatspec.model.esc.subdevice import Quirk
    from ecatspec.spec.language.ir import Protocol, Rule

_T = TypeVar("_T")
_P = ParamSpec("_P")
PATIENCE: Final = 20.0
"""Seconds for one case; a mutant that takes longer hangs."""
_EXPLORING: Final = 300.0
"""Seconds for its finite machines."""


_EXPLORED: Final = frozenset({"al", "process_data", "ds402"})
"""The machines that the finite machines show as a whole."""


# --- a device that is listened to -----------------------------------------------------------------

_Exchange: TypeAlias = tuple[str, tuple[object, ...], object]
"""What was asked, with its arguments, and the answer."""


class OverdueError(BaseException):
    """A mutant did not come to an end; nothing but what stops it may catch this."""


@dataclass(frozen=True, slots=True)
class _Taken:
    """A step; the same input in the same state gives the same object."""

    state: State
    event: Event
    step: Step


class _Steps(dict[int, _Taken]):
    """The steps of a device, by what tells them apart; an observer of it."""

    def __call__(self, state: State, event: Event, step: Step) -> None:
        self[id(step)] = _Taken(state, event, step)


class Heard:
    """An adapter that keeps what was exchanged since power-on."""

    def __init__(self, protocol: Protocol, quirks: frozenset[Quirk] = frozenset()) -> None:
        """Make the device; `quirks` are mistakes of the layer below the texts."""
        self.device = VirtualSubDevice(protocol, quirks=quirks)
        self.steps = self.device.observer = _Steps()
        self.adapter = Guarded(VirtualAdapter(self.device, described(protocol)))
        self.log: list[_Exchange] = []

    def reset(self) -> None:
        """Power cycle, and forget what was exchanged."""
        self.log = []
        self.steps = self.device.observer = _Steps()
        self.adapter.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice."""
        return self._exchange(self.adapter.read, address, length)

    def write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice."""
        return self._exchange(self.adapter.write, address, data)

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        self._exchange(self.adapter.advance, seconds)

    def local(self, event: str) -> None:
        """Raise a local event in the device."""
        self._exchange(self.adapter.local, event)

    def close(self) -> None:
        """Release the device."""
        self.adapter.close()

    def describe(self) -> Description:
        """Give what the device is."""
        return self.adapter.describe()

    def differs(self, log: Iterable[_Exchange]) -> bool:
        """Tell whether it answers otherwise than another did who was asked the same."""
        try:
            with overdue(PATIENCE):
                self.reset()
                return any(
                    getattr(self.adapter, asked)(*arguments) != answer
                    for asked, arguments, answer in log
                )
        except (DeviceFault, OverdueError):
            return True

    def _exchange(self, ask: Callable[_P, _T], *arguments: _P.args, **words: _P.kwargs) -> _T:
        try:
            answer = ask(*arguments, **words)
        except OverdueError:
            raise DeviceHang("no answer in time") from None
        self.log.append((ask.__name__, arguments, answer))
        return answer


# --- the suite and the sound device ---------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Shown:
    """A case and what the sound device showed in it; `choices` are the ways that it went there."""

    case: Case
    log: tuple[_Exchange, ...]
    steps: frozenset[int]
    choices: dict[str, str]


class _Ground:
    """The texts of a device, the suite, and what the sound device shows in each case of it."""

    def __init__(
        self, device: str, depth: str, progress: Progress | None, mailbox: str = ""
    ) -> None:
        protocol = load(device, mailbox)
        self.built = as_built(protocol)
        self.heard = Heard(self.built)
        self.model = Model(protocol, closed=self.heard.describe().closed_dictionary)
        explorer = VirtualSubDevice(self.built)
        self.explored = explorer.observer = _Steps()
        self.machines = _machines(explorer.model, explorer)
        self.explored_rules = {r for taken in self.explored.values() for r in taken.step.rules}
        self.explored_states = _states(explorer.model, self.explored.values())
        self.steps: dict[int, _Taken] = {}
        executor = CaseExecutor(self.model, self.heard, self.heard.describe())
        executor.configuration()
        self.asked = tuple(self.heard.log)
        cases = list(all_cases(self.model, NO_LIMITS, depth))
        local = self.heard.describe().locals
        tables: list[TableKills] = []
        for found in complete_suites(self.model, NO_LIMITS, local, {}, depth):
            cases += found.cases()
            tables.append(_table(found))
        self.tables = tuple(tables)
        self.shown: list[_Shown] = []
        for number, case in enumerate(cases):
            if progress is not None:
                progress(number, len(cases), f"{device}: {case.name}")
            executor.known.choices = shape_of(executor.model.protocol)
            if executor.judge(case).outcome in BLAMING:
                raise UserError(f"{device} is blamed without a mistake in {case.name}: repair it")
            steps = self.heard.steps
            self.steps |= steps
            log = tuple(self.heard.log)
            self.shown.append(_Shown(case, log, frozenset(steps), executor.known.choices))
        self.configured = executor.configured
        self.equivalents = _equivalents(self.built, local)
        self.groups = _groups(self.built)
        self.behind = _behind(self.built)
        self.built_rules = {
            f"{machine.name}.{rule.name}": rule
            for machine in self.built.machines.values()
            for rule in machine.rules
        }
        self.speaking: dict[str, set[str]] = {}
        for place, rule in self.built_rules.items():
            for name in definitions_in(self.built, rule):
                self.speaking.setdefault(f"{DEFINE}{name}", set()).add(place)

    def fate(self, mutant: Mutant) -> Fated:
        """Find out what becomes of a mutant."""
        try:
            with overdue(PATIENCE):
                heard = Heard(mutant.protocol)
        except (Exception, OverdueError):  # noqa: BLE001  it does not even come up
            return Fated(mutant, Fate.KILLED, "power-on")
        if self.equivalents is not None and self.equivalents.proved(mutant):
            return Fated(mutant, Fate.EQUIVALENT)
        executor = CaseExecutor(self.model, heard, heard.describe())
        if not heard.differs(self.asked):
            executor.configured = self.configured
        touched = sorted(self._touched(mutant, heard.device), key=lambda shown: len(shown.log))
        differing: list[_Shown] = []
        for shown in touched:
            if heard.differs(shown.log):
                executor.known.choices = shape_of(executor.model.protocol)
                if (found := self._judged(mutant, executor, shown)) is not None:
                    return found
                differing.append(shown)
        # the ways that it went in other cases it must go in these too
        others = (shown.choices for shown in self.shown if shown not in differing)
        shape = shape_of(self.model.protocol)
        ways = shape | dict(way for choices in others for way in choices.items())
        for shown in differing:
            executor.known.choices = dict(ways)
            if (found := self._judged(mutant, executor, shown)) is not None:
                return found
        if differing:
            return Fated(mutant, Fate.TOLERATED, differing[0].case.name)
        if self._equal(mutant, heard.device):
            return Fated(mutant, Fate.EQUIVALENT)
        if self.equivalents is not None and self.equivalents.left_open(mutant):
            return Fated(mutant, Fate.TOLERATED)
        return Fated(mutant, Fate.UNNOTICED)

    def _judged(self, mutant: Mutant, executor: CaseExecutor, shown: _Shown) -> Fated | None:
        try:
            with overdue(PATIENCE):
                verdict = executor.judge(shown.case)
        except OverdueError:
            return Fated(mutant, Fate.KILLED, shown.case.name)
        if verdict.outcome not in BLAMING:
            return None
        return Fated(mutant, Fate.KILLED, shown.case.name, verdict.clauses)

    def _touched(self, mutant: Mutant, device: VirtualSubDevice) -> list[_Shown]:
        """Give the cases in which some step of the mutant is another than that of the device."""
        if mutant.place not in self.groups and SHOWN in mutant.machines:
            return self.shown
        other = {key for key, taken in self.steps.items() if self._other(mutant, device, taken)}
        return [shown for shown in self.shown if not other.isdisjoint(shown.steps)]

    def _other(self, mutant: Mutant, device: VirtualSubDevice, taken: _Taken) -> bool:
        """Tell whether the mutant steps otherwise, in what follows a step too."""
        fired = taken.step.rules
        if self._follows(mutant, fired):
            return True
        if mutant.place in self.groups:
            own = RuleName(*mutant.place.split("."))
            if own not in fired and not (
                mutant.checks
                and (taken.step.unspecified or not self.groups[mutant.place].isdisjoint(fired))
            ):
                return False
            if mutant.follows and own in fired:
                return True
        try:
            with overdue(PATIENCE):
                return step(device.model, taken.state, taken.event)[0] != taken.step
        except (Exception, OverdueError):  # noqa: BLE001  a mutant may fail in any way
            return True

    def _follows(self, mutant: Mutant, fired: Collection[RuleName]) -> bool:
        """Tell whether what is wrong may show once a frame is fixed, which no step has."""
        if mutant.place in self.groups:
            own = {RuleName(*mutant.place.split("."))}
            late: Collection[RuleName] = self.groups[mutant.place] if mutant.checks else own
        else:
            late = {RuleName(*place.split(".")) for place in self.speaking.get(mutant.place, ())}
            if any(rule in late and rule in self.behind for rule in fired):
                return True
        return any(not self.behind[rule].isdisjoint(late) for rule in fired if rule in self.behind)

    def _equal(self, mutant: Mutant, device: VirtualSubDevice) -> bool:
        """Tell whether the finite machines of the mutant are those of the device.

        They have what the AL state machine, the process data and the drive can show, whenever it
        comes: they do not tell whether an alarm is set to another time. Where no step of their
        exploration is another, they are the same and need not be explored.
        """
        if not mutant.machines <= _EXPLORED or not self._explored(mutant):
            return False
        others = [each for each in self.explored.values() if self._other(mutant, device, each)]
        if not others:
            return True
        try:
            with overdue(_EXPLORING):
                if any(_retimed(device, taken) for taken in others):
                    return False
                found = _machines(device.model, device)
        except (Exception, OverdueError):  # noqa: BLE001  a mutant may fail in any way
            return False
        return all(
            equivalent(one.machine, other.machine)
            for one, other in zip(self.machines, found, strict=True)
        )

    def _explored(self, mutant: Mutant) -> bool:
        """Tell whether the exploration came to what is wrong, or showed that nothing can."""
        if mutant.place in self.groups:
            return self._came_to(mutant.place, by_input=mutant.checks)
        return any(self._came_to(rule, by_input=False) for rule in self.speaking[mutant.place])

    def _came_to(self, place: str, *, by_input: bool) -> bool:
        rule = RuleName(*place.split("."))
        if rule in self.explored_rules or (
            by_input and not self.explored_rules.isdisjoint(self.groups[place])
        ):
            return True
        sources = self.built_rules[place].sources
        return not any((rule.machine, state) in self.explored_states for state in sources)


def _equivalents(built: Protocol, raisable: Collection[str]) -> Equivalents | None:
    """Give what proves mutants to be no mistakes; None where the solver is not installed."""
    try:
        from ecatspec.generators.mutation.equivalents import Equivalents
    except ModuleNotFoundError as error:
        if error.name != "z3":
            raise
        return None
    return Equivalents(built, raisable)


def _table(found: Complete) -> TableKills:
    machine = found.found.machine
    return TableKills(
        found.found.name,
        len(machine.states),
        len(machine.inputs),
        found.suite.guarantee(),
        kills(machine, found.suite.trie()),
    )


def _groups(protocol: Protocol) -> dict[str, frozenset[RuleName]]:
    """Give for each rule those that take the same input in some state of it, itself included."""
    return {
        f"{machine.name}.{rule.name}": frozenset(
            RuleName(machine.name, other.name)
            for other in rows_of(machine)
            if other.input == rule.input and not set(other.sources).isdisjoint(rule.sources)
        )
        for machine in protocol.machines.values()
        for rule in machine.rules
    }


def _behind(protocol: Protocol) -> dict[RuleName, frozenset[RuleName]]:
    """Give for each rule whose frame is followed by something the rules that may fire then."""
    takers: dict[str, list[tuple[RuleName, Rule]]] = {}
    every: dict[RuleName, Rule] = {}
    for machine in protocol.machines.values():
        for rule in machine.rules:
            name = RuleName(machine.name, rule.name)
            every[name] = rule
            takers.setdefault(f"{machine.name}.{rule.input}", []).append((name, rule))
    found: dict[RuleName, frozenset[RuleName]] = {}
    for name, rule in every.items():
        if rule.after is None:
            continue
        reached: set[RuleName] = set()
        given = [give.target for give in rule.after.gives]
        while given:
            for other, row in takers.get(given.pop(), ()):
                if other not in reached:
                    reached.add(other)
                    given += (give.target for give in row.gives)
                    given += () if row.after is None else (g.target for g in row.after.gives)
        found[name] = frozenset(reached)
    return found


def _states(model: Model, every: Iterable[_Taken]) -> set[tuple[str, str]]:
    """Give the states of machines, by name, in which inputs came or to which they led."""
    states = {state for taken in every for state in (taken.state, taken.step.state)}
    found: set[tuple[str, str]] = set()
    for machine in model.protocol.machines:
        names = model.state_names(machine)
        slot = model.slots[f"{machine}.state"]
        values = {state.slots[slot] for state in states}
        found |= {(machine, name) for value, name in names.items() if value in values}
    return found


def _machines(model: Model, device: VirtualSubDevice) -> list[Abstraction]:
    every = (al_machine, drive_machine, al_drive_machine)
    found = (make(model, device=device) for make in every)
    return [machine for machine in found if machine is not None]


def _retimed(device: VirtualSubDevice, taken: _Taken) -> bool:
    """Tell whether a device sets an alarm to another time than is set in a step."""
    mine = step(device.model, taken.state, taken.event)[0].alarms
    times = {(alarm.event, alarm.after, alarm.within) for alarm in taken.step.alarms}
    events = {event for event, *_ in times}
    return any(a.event in events and (a.event, a.after, a.within) not in times for a in mine)


@contextmanager
def overdue(patience: float) -> Iterator[None]:
    """Stop what a mutant does after a while; where there are no such signals it may hang."""

    def stop(_: int, __: FrameType | None) -> None:
        raise OverdueError

    old = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, patience, patience)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)


# --- all of them ----------------------------------------------------------------------------------

_AT_WORK: list[tuple[_Ground, Sequence[Mutant]]] = []
"""What the workers look at; they are copies of this process and need not be told."""


def analyse(
    device: str,
    *,
    own: bool = False,
    only: str = "",
    depth: str = "default",
    mailbox: str = "",
    workers: int = 1,
    progress: Progress | None = None,
) -> Analysis:
    """Find out what becomes of the mutants of a device's texts.

    `own`: only those of rules and definitions that the text of the device brings itself.
    `only`: those whose description holds these words.
    `mailbox` gives the areas another length: in a small one transfers take several messages.

    Raises:
        UserError: There is no such device or mutant, or the device is blamed as it is.

    """
    built = as_built(load(device, mailbox))
    standard = set(_files(load_standard())) if own else set()
    every = [m for m in mutants(built) if m.at.file not in standard and only in str(m)]
    if only and not every:
        raise UserError(f"no mutant of {device} has {only!r} in its description; leave out --only")
    ground = _Ground(device, depth, progress, mailbox)
    fated: dict[int, Fated] = {}
    _AT_WORK.append((ground, every))
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), _begin)
    try:
        work = {pool.submit(_fate, number): number for number in range(len(every))}
        for done in as_completed(work):
            number = work[done]
            fate, case, clauses = done.result()
            fated[number] = Fated(every[number], fate, case, clauses)
            if progress is not None:
                progress(len(fated), len(every), f"{device}: {every[number].place}")
    finally:
        pool.shutdown(cancel_futures=True)
        _AT_WORK.pop()
    ordered = tuple(fated[number] for number in range(len(every)))
    return Analysis(device, depth, len(ground.shown), ground.tables, ordered)


def _files(protocol: Protocol) -> Iterator[str]:
    """Yield the files of the rules and definitions of a specification."""
    for machine in protocol.machines.values():
        yield from (rule.at.file for rule in machine.rules)
    yield from (definition.at.file for definition in protocol.definitions.values())


def _begin() -> None:
    """Leave Ctrl-C to the process that waits."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _fate(number: int) -> tuple[Fate, str, tuple[str, ...]]:
    ground, every = _AT_WORK[-1]
    found = ground.fate(every[number])
    return found.fate, found.case, found.clauses
