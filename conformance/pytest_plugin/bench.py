"""Keeps the device that a pytest process has open, and the parts of its suite."""

from __future__ import annotations

import shlex
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.adapters import HANG_TIMEOUT, open_adapter
from ecatspec.conformance.base.devices import UserError, going, load, nearest
from ecatspec.conformance.base.verdict import Result
from ecatspec.conformance.reports.text import explained
from ecatspec.conformance.results import known_deviations
from ecatspec.conformance.run.case_executor import limits_of
from ecatspec.conformance.run.dut_knowledge import SHAPE
from ecatspec.conformance.run.runner import EXAMPLES, WALKS, Runner
from ecatspec.conformance.traceability.case_footprint import Exercise
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.conformance.base.verdict import Finding, Verdict
    from ecatspec.generators.cases.case import Case

RANDOM: Final = "random"
COMPLETE: Final = "complete"
"""Where the parts are collected that make their cases while they run."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a user asks for, by the words of `ecatspec run`."""

    device: str
    dut: str = "model"
    depth: str = "default"
    only: str = ""
    mailbox: str = ""
    seed: int = 0
    known: str = ""
    hang_timeout: float = HANG_TIMEOUT

    @property
    def command(self) -> str:
        """Give the command that runs the device; what to replay follows it."""
        words = ["ecatspec", "run", self.device, "--dut", self.dut]
        if self.mailbox:
            words += ["--mailbox", self.mailbox]
        if self.known:
            words += ["--known", self.known]
        if self.hang_timeout != HANG_TIMEOUT:
            words += ["--hang-timeout", f"{self.hang_timeout:g}"]
        return shlex.join(words)


@dataclass(frozen=True, slots=True)
class Part:
    """One test: a case, or what makes cases while it runs. `run` tells the runner what to do."""

    name: str
    group: str
    layers: tuple[str, ...]
    run: Callable[[Runner], object]
    case: Case | None = None


@dataclass(slots=True)
class Bench:
    """A device, the texts that judge it, and what it has shown so far."""

    wanted: Wanted
    model: Model = field(init=False)
    adapter: Adapter = field(init=False)
    description: Description = field(init=False)
    runner: Runner = field(init=False)
    exercise: Exercise = field(init=False)
    _only: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Reach the device.

        Raises:
            UserError: There is no such device or layer, or no such file of known deviations.
            SpecError: The text is wrong.
            AdapterError: The device is not reached.

        """
        wanted = self.wanted
        protocol = load(wanted.device, wanted.mailbox)
        self._only = frozenset(filter(None, wanted.only.split(",")))
        for name in sorted(self._only - protocol.machines.keys()):
            raise nearest("layer", name, tuple(protocol.machines))
        if wanted.depth == "exhaustive" and find_spec("z3") is None:
            raise UserError("exhaustive needs the package z3-solver; install ecatspec[prove]")
        accepted = known_deviations.of(wanted.known, protocol.name).reasons
        self.adapter = open_adapter(
            wanted.dut, wanted.device, mailbox=wanted.mailbox, hang_timeout=wanted.hang_timeout
        )
        self.description = self.adapter.describe()
        self.model = Model(protocol, closed=self.description.closed_dictionary)
        self.exercise = Exercise(self.model)
        self.runner = Runner(self.model, self.adapter, self._described(), accepted=accepted)

    def _described(self) -> Description:
        """Give the description for the runner: other layers than those wanted are not judged."""
        if not self._only:
            return self.description
        protocols = self.description.protocols
        return replace(self.description, protocols=protocols & self._only)

    def close(self) -> None:
        """Release the device."""
        self.adapter.close()

    @contextmanager
    def powered(self) -> Iterator[Adapter]:
        """Power cycle the device for somebody who may leave it otherwise than it was."""
        self.adapter.reset()
        yield self.adapter
        self.runner.executor.configured = None

    # --- the suite --------------------------------------------------------------------------------

    def parts(self) -> Iterator[Part]:
        """Yield the tests of the suite, those of `ecatspec run` in its order."""
        wanted, limits = self.wanted, limits_of(self.description)
        for case in all_cases(self.model, limits, wanted.depth):
            if self._takes(case.layer):
                run = partial(_run, case=case)
                yield Part(case.name, case.layer, (case.layer,), run, case)
        if wanted.depth != "quick":
            layers = tuple(name for name in self.model.protocol.machines if self._takes(name))
            run = partial(_complete, depth=wanted.depth)
            yield Part(f"{COMPLETE}/{wanted.depth}", COMPLETE, layers, run)
        for number in range(WALKS[wanted.depth]):
            case = self.runner.walk(wanted.seed + number)
            if self._takes(case.layer):
                yield Part(case.name, RANDOM, (case.layer,), partial(_run_long, case=case))
        if self._takes("sdo"):
            run = partial(_explore, examples=EXAMPLES[wanted.depth], seed=wanted.seed)
            yield Part(f"{RANDOM}/seed_{wanted.seed}", RANDOM, ("sdo",), run)

    def _takes(self, layer: str) -> bool:
        return not self._only or layer in self._only

    def verdicts(self, part: Part) -> tuple[Verdict, ...]:
        """Run one test; give the verdicts that it came to."""
        before = len(self.runner.verdicts)
        part.run(self.runner)
        return tuple(self.runner.verdicts[before:])

    # --- words ------------------------------------------------------------------------------------

    def findings(self, verdicts: Iterable[Verdict]) -> tuple[Finding, ...]:
        """Group what is no pass by cause, most severe first."""
        device, subject = self.model.protocol.name, self.description.name
        return Result(device, subject, tuple(verdicts), (), 0, (), 0, 0.0).findings()

    def explained(self, finding: Finding) -> str:
        """Say what is wrong, where that stands, how it came about, and how to see it again."""
        return explained(finding, self.model.protocol, self.wanted.command)

    def clauses(self, cases: Iterable[Case]) -> Mapping[str, list[str]]:
        """Give the clauses that cases exercise, as the virtual SubDevice of the text shows it."""
        wanted = self.wanted
        adapter = open_adapter("model", wanted.device, mailbox=wanted.mailbox)
        runner = Runner(self.model, adapter, adapter.describe())
        # where it is not known which way a device goes, no rule after that is sure
        sure = going(self.model.protocol, SHAPE).pins
        runner.known.choices |= {name: pin.alternative for name, pin in sure.items()}
        found = {}
        for case in cases:
            runner.run((case,), None, 0)
            found[case.name] = sorted(self.exercise.clauses(case, runner.verdicts[-1].rules))
        return found


def _run(runner: Runner, case: Case) -> None:
    runner.run((case,), None, 0)


def _run_long(runner: Runner, case: Case) -> None:
    runner.run_long((case,), None, 0)


def _complete(runner: Runner, depth: str) -> None:
    runner.complete(depth, None)


def _explore(runner: Runner, examples: int, seed: int) -> None:
    runner.explore(examples, seed, None)
