"""Exports the suite of a device as a head and a stream of test vectors."""

from __future__ import annotations

import tempfile
from collections import deque
from dataclasses import dataclass, field
from itertools import chain, groupby, islice
from typing import TYPE_CHECKING, Final

import msgspec

from ecatspec.conformance.adapters.model import SnapshotAdapter, described
from ecatspec.conformance.base.devices import (
    TRUTHS,
    UserError,
    assuming,
    going,
    load,
    nearest,
    pinned,
)
from ecatspec.conformance.base.version import version
from ecatspec.conformance.run.device_link import Deviation, InconclusiveError
from ecatspec.conformance.run.dut_knowledge import SHAPE, shape_of
from ecatspec.conformance.run.runner import WALK, WALKS
from ecatspec.conformance.run.worker_pools import Died, process_pool
from ecatspec.conformance.vectors.expectations import COUNTER, LENGTH
from ecatspec.conformance.vectors.record import Recorder, RestlessError
from ecatspec.generators.cases.assignment import at_power_on, read_configuration
from ecatspec.generators.cases.bringup import has_process_data, way_to
from ecatspec.generators.cases.case import (
    NO_LIMITS,
    Case,
    Happen,
    ReadConfiguration,
    Repeat,
    SetUpProcessData,
    WriteOutputs,
)
from ecatspec.generators.cases.message_mutation import NOTES
from ecatspec.generators.cases.play import play
from ecatspec.generators.complete.finite_cover import complete_suites
from ecatspec.generators.formats import FORMATS
from ecatspec.generators.random.walks import walk
from ecatspec.generators.suite import all_cases
from ecatspec.generators.vectors.schema import (
    CONFIGURATION,
    SCHEMA,
    SCHEMA_VERSION,
    Allowed,
    Area,
    Clause,
    Config,
    Generator,
    Guarantee,
    Head,
    Note,
    Read,
    Spec,
    Test,
)
from ecatspec.model.core.byte_masks import message_forms
from ecatspec.model.core.compilation import MAILBOX, Model
from ecatspec.model.core.compiled import rows_of
from ecatspec.model.core.interpreter import step
from ecatspec.model.core.register_map import AREAS, SYNC_MANAGERS, field_mask
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from typing import IO

    from ecatspec.conformance.run.runner import Progress
    from ecatspec.conformance.run.worker_pools import Answer
    from ecatspec.generators.complete.finite_cover import Complete
    from ecatspec.generators.vectors.schema import Step
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.spec.language.ir import Protocol

_BYTE: Final = 8
_ALONE: Final = 200
"""Number of cases that are recorded before workers are started."""
_SHARD: Final = 16
"""Cases that a worker gets at once: neighbours begin alike."""
_AHEAD: Final = 2
"""Shards under way for each worker: one is recorded, one waits."""
OTHER_WAYS: Final = "other_ways"
_OTHER_WAYS: Final = (
    "Somewhere the texts allow more than one way, and the test goes on with one of them only; a"
    " device that goes another is not tried further."
)
_HEADER: Final = """\
Each test begins with a power cycle. A step: do `in`, let `us` of the device's time pass (writing
`cycle` while it does), then look for all that `expect` says, in order.
Bytes are right when they equal a `value` wherever its `mask` has a bit. `passes`: go on. `ends`:
the device went another way that is allowed; the test ends, and counts as passed.
Nothing happens in the device that no step raises: where power or synchronisation may fail on the
bench, a failure has to be looked at with that in mind.
docs/vectors.md of ecatspec says it all, glossary first.
"""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a user asks for."""

    device: str
    depth: str = "default"
    only: tuple[str, ...] = ()
    mailbox: str = ""
    seed: int = 0
    choices: Mapping[str, str] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True)
class Recorded:
    """What became of a case."""

    test: Test | None
    """None: the virtual SubDevice does not come to rest in it."""
    cut: bool
    """The test ends early, because a device may do too much from there on."""


@dataclass(frozen=True, slots=True)
class _Planned:
    """A case, its number among those that progress counts with it, and the suite it is of."""

    case: Case
    number: int
    total: int
    suite: Complete | None = None


@dataclass(slots=True)
class Export:
    """The suite of one device; tests are made when asked for."""

    wanted: Wanted
    progress: Progress | None = None
    workers: int = 1
    """Processes that record; the tests are the same for any number."""
    guarantees: list[Guarantee] = field(default_factory=list)
    number: int = 0
    flags: set[str] = field(default_factory=set)
    cut: list[str] = field(default_factory=list)
    """Cases cut short in the vectors, because a device may do too much from there on."""
    restless: list[str] = field(default_factory=list)
    """Cases without a test: the virtual SubDevice does not come to rest in them."""
    protocol: Protocol = field(init=False)
    _model: Model = field(init=False)
    _recorder: Recorder = field(init=False)
    _ways: dict[str, str] = field(default_factory=dict)
    _truths: dict[str, str] = field(default_factory=dict)
    """The conditions that the device is known to meet, or not."""
    _locals: frozenset[str] = frozenset()
    _objects: dict[ObjectKey, bytes] = field(default_factory=dict)
    _cited: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Read the texts."""
        protocol = load(self.wanted.device, self.wanted.mailbox)
        known = _ways_at(protocol)
        for name, way in self.wanted.choices.items():
            if name not in known:
                raise nearest("choice", name, tuple(known))
            if way not in known[name]:
                raise nearest(f"way at {name}", way, known[name])
            if name in protocol.pins and protocol.pins[name].alternative != way:
                text = protocol.pins[name].alternative
                raise UserError(f"the text pins {name} = {text}; leave out --choice {name}={way}")
        layers = {*protocol.machines, CONFIGURATION}
        for name in self.wanted.only:
            if name not in layers:
                raise nearest("layer", name, tuple(protocol.machines))
        given = self.wanted.choices
        self.protocol = pinned(protocol, {n: w for n, w in given.items() if n in protocol.choices})
        self._model = Model(self.protocol, closed=True)
        self._truths = {n: way for n, way in given.items() if n in protocol.conditions}
        device = assuming(going(self.protocol, SHAPE), self._truths)
        description = described(device)
        oracle = Oracle(self._model)
        oracle.raised = description.locals
        adapter = SnapshotAdapter(VirtualSubDevice(device), description)
        self._ways = {name: pin.alternative for name, pin in device.pins.items()}
        self._locals = description.locals
        self._recorder = Recorder(adapter, self._model, oracle)

    # --- tests ------------------------------------------------------------------------------------

    def tests(self) -> Iterator[tuple[str, Test]]:
        """Yield the layer and the test, one after the other.

        Raises:
            MissingSolverError: The boundaries of `exhaustive` need the solver.

        """
        for suite, found in groupby(self._played(), key=lambda played: played[0].suite):
            first, whole = None, True
            for planned, recorded in found:
                first = first or planned.case.name.rpartition("/")[0]
                whole = whole and recorded.test is not None and not recorded.cut
                test = self._take(planned.case, recorded)
                if test is not None:
                    yield planned.case.layer, test
            if suite is not None and first is not None and whole:
                made = suite.suite
                self.guarantees.append(
                    Guarantee(f"{first}/*", made.method.value, made.m, made.k, made.checked.value)
                )

    def _planned(self) -> Iterator[_Planned]:
        """Yield the cases in the order of the file."""
        fixed = self._fixed()
        for number, case in enumerate(fixed):
            yield _Planned(case, number, len(fixed))
        for suite in complete_suites(
            self._model, NO_LIMITS, self._locals, self._ways, self.wanted.depth
        ):
            if not self.wanted.only or suite.layer in self.wanted.only:
                for number, case in enumerate(suite.cases()):
                    yield _Planned(case, number, suite.suite.tests, suite)
        walks = WALKS[self.wanted.depth]
        for number in range(walks):
            seed = self.wanted.seed + number
            case = walk(self._model, NO_LIMITS, self._locals, seed, WALK)
            if not self.wanted.only or case.layer in self.wanted.only:
                yield _Planned(case, number, walks)

    def _played(self) -> Iterator[tuple[_Planned, Recorded]]:
        """Record the cases, here or by workers once there are enough of them."""
        planned = self._planned()
        for each in islice(planned, None if self.workers == 1 else _ALONE):
            self._tell(each.number, each.total, each.case.name)
            yield each, self.play(each.case)
        if (following := next(planned, None)) is None:
            return
        test_of = msgspec.json.Decoder(Test | None).decode
        with process_pool(self.workers, _release) as pool:
            left = chain([following], planned)
            shards = iter(lambda: list(islice(left, _SHARD)), [])
            waiting: deque[tuple[list[_Planned], Answer]] = deque()
            while True:
                for shard in islice(shards, self.workers * _AHEAD - len(waiting)):
                    cases = [each.case for each in shard]
                    waiting.append((shard, pool.submit(_recorded, self.wanted, cases)))
                if not waiting:
                    return
                shard, answer = waiting.popleft()
                try:
                    found = [Recorded(test_of(made), cut) for made, cut in answer.result()]
                except Died:
                    found = [self.play(each.case) for each in shard]
                self._tell(shard[-1].number, shard[-1].total, shard[-1].case.name)
                yield from zip(shard, found, strict=True)

    def _fixed(self) -> list[Case]:
        """Give the cases that do not depend on the device; the configuration first."""
        every = list(all_cases(self._model, NO_LIMITS, self.wanted.depth))
        only = self.wanted.only
        chosen = [case for case in every if not only or case.layer in only]
        return [*self._configuration(), *chosen]

    def _configuration(self) -> Iterator[Case]:
        if has_process_data(self._model):
            way = (*way_to(self._model, "PREOP"), *read_configuration(self._model))
            title = "what is assigned and mapped after power-on"
            yield Case(CONFIGURATION, title, CONFIGURATION, way)

    def configure(self) -> None:
        """Take for granted what a device has assigned and mapped, as the first test shows it."""
        for case in self._configuration():
            self.play(case)

    def record(self, case: Case) -> Test | None:
        """Give the test that a case becomes; None: the virtual SubDevice comes to no rest in it."""
        return self._take(case, self.play(case))

    def _take(self, case: Case, recorded: Recorded) -> Test | None:
        """Number a test, and note what became of its case."""
        if recorded.cut:
            self.cut.append(case.name)
        if recorded.test is None:
            self.restless.append(case.name)
            return None
        self.number += 1
        self.flags |= set(recorded.test.flags)
        return msgspec.structs.replace(recorded.test, tcId=self.number)

    def play(self, case: Case) -> Recorded:
        """Record a case as a test without a number."""
        requires = bool(self._objects) and _rests_on_configuration(case)
        repeats = any(isinstance(stimulus, Repeat) for stimulus in case.stimuli)
        self._recorder.acknowledges = repeats or case.layer == MAILBOX
        try:
            self._recorder.begin(shape_of(self.protocol), self._objects if requires else {})
            for stimulus in case.stimuli:
                self._recorder.apply(stimulus)
                if self._recorder.oracle.lost:
                    break  # what would follow says nothing
        except (Deviation, InconclusiveError, RestlessError):
            return Recorded(None, cut=False)
        if case.name == CONFIGURATION:
            known = self._recorder.oracle.known.example().objects
            self._objects = at_power_on(self._model, known.items())
        steps = self._recorder.steps
        flags = [case.flag] if case.flag else []
        if ends := any(step.can_end for step in steps):
            flags.append(OTHER_WAYS)
        rules = dict.fromkeys(rule for step in steps for rule in step.covers)
        clauses = {c for rule in rules for c in self._rules().get(rule, [])}
        test = Test(
            tcId=1,  # until it has its place
            id=case.name,
            comment=case.title,
            steps=steps,
            result="acceptable" if ends else "valid",
            flags=flags,
            needs=sorted({s.event for s in case.stimuli if isinstance(s, Happen)}),
            requires=requires,
            clauses=sorted(clauses or self._clauses_of_reads(steps)),
        )
        return Recorded(test, cut=self._recorder.oracle.lost)

    def _clauses_of_reads(self, steps: Iterable[Step]) -> set[str]:
        """Give the clauses of the registers that are read: of what no rule has led to."""
        read = {
            name
            for step in steps
            for e in step.expect
            if isinstance(e, Read)
            for name in e.symbol.split()
        }
        registers = self.protocol.registers
        return {c for name in read & registers.keys() for c in registers[name].clauses}

    def _tell(self, number: int, total: int, what: str) -> None:
        if self.progress is not None:
            self.progress(number, total, what)

    # --- the head ---------------------------------------------------------------------------------

    def head(self) -> Head:
        """Give the head of the file; it counts the tests that were given so far."""
        protocol = self.protocol
        rules = dict(self._rules())
        rules |= {each.name: sorted(each.clauses) for each in protocol.registers.values()}
        cited = {clause for clauses in rules.values() for clause in clauses}
        pins = {name: pin.alternative for name, pin in protocol.pins.items()}
        notes = {name: note for name, note in NOTES.items() if name in self.flags}
        if OTHER_WAYS in self.flags:
            notes[OTHER_WAYS] = _OTHER_WAYS
        return Head(
            schema=SCHEMA,
            schema_version=SCHEMA_VERSION,
            generator=Generator(
                name="ecatspec",
                version=version(),
                depth=self.wanted.depth,
                mailbox=self.wanted.mailbox,
                seed=self.wanted.seed,
                only=sorted(self.wanted.only),
            ),
            spec=Spec(protocol.name, protocol.wording, protocol.digest),
            numberOfTests=self.number,
            header=_HEADER.splitlines(),
            notes={name: Note(name.replace("_", " "), notes[name]) for name in sorted(notes)},
            guarantee=self.guarantees,
            choices=dict(sorted(pins.items())),
            open={n: w for n, w in sorted((self._ways | self._truths).items()) if n not in pins},
            config=self._config(),
            rules=rules,
            clauses={
                name: Clause(each.level, each.wording, each.source)
                for name, each in sorted(protocol.clauses.items())
                if name in cited
            },
        )

    def _rules(self) -> dict[str, list[str]]:
        if not self._cited:
            self._cited = {
                f"{machine.name}.{row.name}": sorted(row.clauses)
                for machine in self.protocol.machines.values()
                for row in rows_of(machine)
            }
        return self._cited

    def _config(self) -> Config:
        out, back = (self._area(AREAS[name]) for name in SYNC_MANAGERS)
        status = f"{SYNC_MANAGERS[1]}_status"
        register = self.protocol.registers[status]
        mask = field_mask(self.protocol, status, "full").to_bytes(register.size, "little")
        counter, counter_mask = self._place(COUNTER)
        return Config(
            mailboxOut=out,
            mailboxIn=back,
            mailboxFull=Area(register.address, register.size),
            mailboxFullMask=mask.hex(),
            mailboxHead=self._model.codec.size(MAILBOX),
            mailboxLength=self._place(LENGTH)[0],
            mailboxCounter=counter,
            mailboxCounterMask=counter_mask,
            requestUs=self._model.parameter("request_timeout"),
            passOver=self._unasked(),
        )

    def _place(self, name: str) -> tuple[Area, str]:
        """Give the bytes of a field in the mailbox header, and the mask of its bits in them."""
        low, width = self._model.codec.place(MAILBOX, name)
        first, last = low // _BYTE, (low + width - 1) // _BYTE
        mask = (1 << width) - 1 << low - first * _BYTE
        size = last - first + 1
        return Area(first, size), mask.to_bytes(size, "little").hex()

    def _area(self, name: str) -> Area:
        return Area(self._model.parameter(name, "start"), self._model.parameter(name, "length"))

    def _unasked(self) -> list[Allowed]:
        """Give the messages that a device may send by itself at any time."""
        found: dict[tuple[str, str], Allowed] = {}
        device = VirtualSubDevice(self._model.protocol)
        play(self._model, device, way_to(self._model, "PREOP"))
        for event in self._model.own:
            for taken in step(self._model, device.state, event):
                for output in taken.outputs[:1]:
                    for form in message_forms(self._model, taken.state, output, {}, COUNTER):
                        allowed = self._recorder.allowed(form)
                        found[allowed.value, allowed.mask] = allowed
        return list(found.values())


def _ways_at(protocol: Protocol) -> dict[str, tuple[str, ...]]:
    """Give what may be pinned: choices, and conditions that a device is known to meet or not."""
    choices = protocol.choices.values()
    ways = {choice.name: tuple(each.name for each in choice.alternatives) for choice in choices}
    return ways | dict.fromkeys(protocol.conditions, tuple(TRUTHS))


def _rests_on_configuration(case: Case) -> bool:
    """Tell whether a case shows something else where other process data are assigned."""
    kinds = (SetUpProcessData, WriteOutputs, ReadConfiguration)
    return case.layer != "sdo" or any(isinstance(stimulus, kinds) for stimulus in case.stimuli)


class _Desk:
    """The export of this worker process."""

    export: Export | None = None


def _recorded(wanted: Wanted, cases: Sequence[Case]) -> list[tuple[bytes, bool]]:
    """Record cases in a worker: tests as JSON, which has what is default as such."""
    if _Desk.export is None or _Desk.export.wanted != wanted:
        _Desk.export = Export(wanted)
        _Desk.export.configure()
    played = map(_Desk.export.play, cases)
    return [(msgspec.json.encode(recorded.test), recorded.cut) for recorded in played]


def _release() -> None:
    """Let go of nothing: the device of a worker ends with it."""


def export(
    wanted: Wanted,
    form: str,
    out: IO[bytes],
    progress: Progress | None = None,
    *,
    workers: int = 1,
) -> Export:
    """Write the vectors of a device in a format; give what was written.

    Tests lie in a temporary file until the head is known, so that memory does not grow with them.

    Raises:
        UserError: There is no such device, choice or layer.
        MissingSolverError: The boundaries of `exhaustive` need the solver.
        OSError: The file cannot be written.

    """
    made = Export(wanted, progress, workers)
    with tempfile.TemporaryFile() as kept:
        for layer, test in made.tests():
            kept.write(msgspec.json.encode((layer, test)) + b"\n")
        kept.seek(0)
        decoder = msgspec.json.Decoder(tuple[str, Test])
        FORMATS[form].write(made.head(), map(decoder.decode, kept), out)
    return made
