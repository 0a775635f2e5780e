"""Runs cases one after the other, by workers where there are some, with a journal of verdicts."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias

from ecatspec.conformance.adapters import HANG_TIMEOUT, open_adapter
from ecatspec.conformance.base.devices import UserError, load, nearest
from ecatspec.conformance.base.verdict import BLAMING, Outcome, Result, SetUp
from ecatspec.conformance.base.work_items import Search, Trial
from ecatspec.conformance.results.known_deviations import NOTHING
from ecatspec.conformance.results.run_file import Basis
from ecatspec.conformance.run.case_executor import CaseExecutor, limits_of
from ecatspec.conformance.run.coverage import extent_of
from ecatspec.conformance.run.dut_knowledge import shape_of, ways_of
from ecatspec.generators.cases.case_codec import PREFIX, case_of, check
from ecatspec.generators.complete.finite_cover import complete_suites
from ecatspec.generators.random.walks import walk
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.state import RuleName

if TYPE_CHECKING:
    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.conformance.base.work_items import Crew, Judged, Step
    from ecatspec.conformance.results.known_deviations import Accepted
    from ecatspec.conformance.results.run_file import Journal
    from ecatspec.generators.cases.case import Case, Limits
    from ecatspec.generators.complete.finite_cover import Complete

Progress: TypeAlias = Callable[[int, int, str], None]

EXAMPLES = {"quick": 30, "default": 150, "exhaustive": 1000}
"""Runs of random requests, by depth."""
WALKS = {"quick": 0, "default": 10, "exhaustive": 200}
"""Random walks, by depth."""
WALK = 60
"""Stimuli of a walk."""
_STILL = (
    "AL Status never changed, so the device may not run at all: look at that first, "
    "docs/adapters.md has a list"
)
_ROUNDS = 12
"""Searches with random requests at most."""


class Runner:
    """Schedules the cases of a run and keeps their verdicts."""

    def __init__(
        self,
        model: Model,
        adapter: Adapter,
        description: Description,
        *,
        accepted: Mapping[str, str] = MappingProxyType({}),
        given: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Take what an executor of cases takes, which judges where there is no crew."""
        self.executor = CaseExecutor(model, adapter, description, accepted=accepted, given=given)
        self.model = self.executor.model
        self.description = description
        self.known = self.executor.known
        """What the judged steps have told of the device."""
        self.verdicts: list[Verdict] = []
        self.journal: Journal | None = None
        """Where each judged step is kept; a resumed run finds there what it need not judge."""
        self.crew: Crew | None = None
        """Who judges the steps; None: this process, with its own device."""
        self.needed: set[str] = set()
        """The AL states that cases needed so far."""
        self.only: frozenset[str] = frozenset()
        """The layers that are tried; none: all."""
        self.planned = 0
        """The cases of the run, as far as they are known."""

    def run(self, cases: Iterable[Case], progress: Progress | None, total: int) -> None:
        """Run cases in order; a case of a layer that is not the device's own is skipped."""
        self.planned += total
        self._through(map(Trial, cases), progress, total)

    def run_long(self, cases: Iterable[Case], progress: Progress | None, total: int) -> None:
        """Run cases as `run` does; one that shows a new cause is made as short as it goes."""
        self.planned += total
        self._through((Trial(case, long=True) for case in cases), progress, total)

    def _through(self, steps: Iterable[Step], progress: Progress | None, total: int) -> None:
        """Go through steps in order; what the journal has of them is not judged again."""
        left = self._left(self._noted(_told(steps, progress, total)))
        if self.crew is None:
            found: Iterator[Judged] = map(self.executor.take, left)
        else:
            found = self.crew.judge(left, self.known.snapshot, self.description)
        for judged in found:
            self._apply(judged)
            if self.journal is not None:
                self.journal.keep(judged)

    def _noted(self, steps: Iterable[Step]) -> Iterator[Step]:
        """Note the AL states that cases need."""
        for step in steps:
            if isinstance(step, Trial) and step.case.needs is not None:
                self.needed.add(step.case.needs)
            yield step

    def unreached(self) -> tuple[str, ...]:
        """Give the AL states that cases needed and no rule led to, in the order of their values."""
        rules = self.model.protocol.machines["al"].rules
        reached = {rule.target for rule in rules if RuleName("al", rule.name) in self.known.rules}
        names = self.model.state_names("al").values()
        return tuple(name for name in names if name in self.needed - reached)

    def _left(self, steps: Iterable[Step]) -> Iterator[Step]:
        for step in steps:
            judged = None if self.journal is None else self.journal.again(step.name)
            if judged is None:
                yield step
            else:
                self._apply(judged)

    def _apply(self, judged: Judged) -> None:
        self.verdicts.append(judged.verdict)
        self.known.learn(judged)

    def wanted(self, layer: str) -> bool:
        """Tell whether a layer is to be tried."""
        return not self.only or layer in self.only

    def complete(self, depth: str, progress: Progress | None) -> list[str]:
        """Run the complete suites of the device as it has shown to go; give what they are worth."""
        promises = []
        ways = dict(self.known.choices)
        suites = complete_suites(
            self.model,
            limits_of(self.description),
            self.description.locals,
            {name: way for name, way in ways.items() if name in self.model.protocol.choices},
            depth,
        )
        for suite in suites:
            if suite.layer not in self.description.protocols or not self.wanted(suite.layer):
                continue
            before = len(self.verdicts)
            unsure = self.known.untold - self.known.choices.keys()
            self.known.believed = {n: way for n, way in suite.assumed.items() if n in unsure}
            doubted = set(self.known.believed)
            self.run_long(suite.cases(), progress, suite.suite.tests)
            doubted -= self.known.believed.keys()
            self.known.believed = {}
            outcomes = Counter(v.outcome for v in self.verdicts[before:])
            promises.append(f"{suite.guarantee()}; {self._worth(outcomes, suite, doubted)}")
        return promises

    def _worth(self, outcomes: Counter[Outcome], suite: Complete, doubted: set[str]) -> str:
        """Say whether a suite keeps what it promises; at some of `doubted` another way was gone."""
        if bad := {o: n for o, n in outcomes.items() if o is not Outcome.PASS}:
            counts = ", ".join(f"{count} {outcome.value}" for outcome, count in bad.items())
            return f"promises nothing: {counts}"
        odd = {
            name for name, way in suite.assumed.items() if self.known.choices.get(name, way) != way
        }
        if odd or doubted:
            ways = ", ".join(sorted(odd or doubted))
            return f"promises nothing: the device goes another way at {ways}"
        return "passed"

    def walk(self, seed: int) -> Case:
        """Give a random walk for this device."""
        return walk(self.model, limits_of(self.description), self.description.locals, seed, WALK)

    def explore(self, examples: int, first_seed: int, progress: Progress | None) -> None:
        """Vary requests at random; every new cause is shrunk to its shortest run by replay."""
        carried = "sdo" in self.description.protocols and self.model.has_mailbox
        if not carried or not self.wanted("sdo"):
            return
        for number in range(_ROUNDS):
            self.planned += 1
            self._through((Search(first_seed + number, examples),), progress, _ROUNDS)
            if self.verdicts[-1].outcome not in BLAMING:
                return


def _told(steps: Iterable[Step], progress: Progress | None, total: int) -> Iterator[Step]:
    for number, step in enumerate(steps):
        if progress is not None:
            progress(number, total, step.name)
        yield step


def run_device(
    device: str,
    dut: str,
    *,
    depth: str = "default",
    seed: int = 0,
    mailbox: str = "",
    only: tuple[str, ...] = (),
    hang_timeout: float = HANG_TIMEOUT,
    replay: str = "",
    known: Accepted = NOTHING,
    choices: tuple[str, ...] = (),
    keep: Callable[[Basis], Journal | None] | None = None,
    crew: Crew | None = None,
    progress: Progress | None = None,
) -> Result:
    """Run everything against one device under test; Ctrl-C ends with what was found so far.

    `replay` names one case, or is the token of one: only that is run. `only` names the layers that
    are tried, none: all. `known` are deviations that are accepted, `choices` ways that the device
    is said to go (`choice=alternative`). `keep` opens the journal that each verdict goes
    to, and from which an interrupted run goes on. A `crew` judges the cases elsewhere.

    Raises:
        UserError: There is no such device, layer, case or choice, or the set-up is wrong.

    """
    began = time.monotonic()
    started = datetime.now(UTC).isoformat(timespec="seconds")
    protocol = load(device, mailbox)
    for layer in only:
        if layer not in protocol.machines:
            raise nearest("layer", layer, tuple(protocol.machines))
    given = ways_of(protocol, choices)
    if crew is None:
        adapter = open_adapter(dut, device, mailbox=mailbox, hang_timeout=hang_timeout)
    else:
        adapter = crew.adapter()
    with contextlib.ExitStack() as stack:
        stack.callback(adapter.close)
        description = adapter.describe()
        model = Model(protocol, closed=description.closed_dictionary)
        runner = Runner(model, adapter, description, accepted=known.reasons, given=given)
        runner.crew, runner.only = crew, frozenset(only)
        if keep is not None:
            told = description.to_json()
            basis = Basis(
                protocol.name,
                protocol.digest,
                dut,
                told,
                depth,
                seed,
                mailbox,
                only,
                choices=choices,
                known=dict(known.reasons),
            )
            journal = keep(basis)
            if journal is not None:
                runner.journal = stack.enter_context(journal)
                began -= journal.seconds
        guarantees, interrupted = _run_all(runner, depth, seed, replay, progress)
        set_up = SetUp(device, dut, depth, seed, mailbox, started, known.path, choices)
        result = _result(runner, guarantees, began, set_up, interrupted=interrupted)
        whole = not (interrupted or replay or only)
        notes = known.notes({v.signature for v in runner.verdicts}, whole=whole)
        planned = 0 if replay else result.planned  # one case is not resumed
        result = replace(result, notes=(*result.notes, *notes), planned=planned)
        if runner.journal is not None and not result.interrupted:
            runner.journal.finish()
    return result


def _run_all(
    runner: Runner, depth: str, seed: int, replay: str, progress: Progress | None
) -> tuple[list[str], bool]:
    """Run the whole suite; give what its complete suites are worth, and whether it was stopped."""
    limits = limits_of(runner.description)
    guarantees: list[str] = []
    if replay:
        cases = [_replayed(replay, runner.model, limits)]
    else:
        every = all_cases(runner.model, limits, depth)
        cases = [case for case in every if runner.wanted(case.layer)]
    try:
        runner.run(cases, progress, len(cases))
        while replay and runner.executor.behind:
            # in a run other cases told the causes before it
            runner.run(cases, progress, len(cases))
        if not replay:
            guarantees = runner.complete(depth, progress)
            seeds = range(seed, seed + WALKS[depth])
            walks = [walk for walk in map(runner.walk, seeds) if runner.wanted(walk.layer)]
            runner.run_long(walks, progress, len(walks))
            runner.explore(EXAMPLES[depth], seed, progress)
    except KeyboardInterrupt:
        return guarantees, True
    return guarantees, False


def _result(
    runner: Runner, guarantees: list[str], began: float, set_up: SetUp, *, interrupted: bool
) -> Result:
    protocol = runner.model.protocol
    extent = extent_of(runner.model, runner.known.rules, shape_of(protocol))
    blamed = any(verdict.outcome in BLAMING for verdict in runner.verdicts)
    return Result(
        protocol.name,
        runner.description.name,
        tuple(runner.verdicts),
        extent.rules_covered,
        extent.rules_total,
        extent.clauses_covered,
        extent.clauses_total,
        time.monotonic() - began,
        runner.known.choices,
        (
            *runner.description.notes,
            *([_STILL] if blamed and not runner.known.moved else []),
            *(f"refused: {why} (first in {name})" for why, name in runner.known.refusals.items()),
        ),
        interrupted,
        tuple(guarantees),
        set_up,
        runner.unreached(),
        runner.planned,
        extent.rules_beyond,
        extent.clauses_beyond,
    )


def _replayed(replay: str, model: Model, limits: Limits) -> Case:
    """Give the case that a token holds, or that has this name."""
    if replay.startswith(PREFIX):
        try:
            case = case_of(replay)
            check(case, model)
        except ValueError as error:
            raise UserError(str(error)) from None
        return case
    found = {case.name: case for case in all_cases(model, limits)}
    if replay not in found:
        raise nearest("case", replay, tuple(found))
    return found[replay]
