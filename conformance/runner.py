"""The only place for a conformance run: cases one after the other, a verdict for each."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias, assert_never

from hypothesis import HealthCheck, Phase, Verbosity, given, seed, settings

from ecatspec.conformance.adapter import AdapterError, DeviceFault, Unheard
from ecatspec.conformance.adapters import HANG_TIMEOUT, open_adapter
from ecatspec.conformance.coverage import extent_of
from ecatspec.conformance.devices import UserError, load, nearest
from ecatspec.conformance.known import NOTHING
from ecatspec.conformance.marks import headline
from ecatspec.conformance.results import Basis
from ecatspec.conformance.session import Deviation, InconclusiveError, Session
from ecatspec.conformance.shrink import shortest
from ecatspec.conformance.steps import Judged, Knowledge, Learned, Search, Trial
from ecatspec.conformance.verdict import (
    ADVISED,
    BLAMING,
    CAUSED,
    FOUND,
    MAIN_DEVICE,
    REASON,
    SUB_DEVICE,
    UNEXPLAINED,
    Outcome,
    Result,
    SetUp,
    TraceLine,
    Verdict,
)
from ecatspec.generators.assignment import at_power_on, first_assigned, read_configuration
from ecatspec.generators.bringup import has_process_data, way_to
from ecatspec.generators.case import (
    Case,
    Happen,
    Limits,
    Probe,
    SendFrame,
    Stimulus,
    WriteUntilTaken,
)
from ecatspec.generators.finite_cover import complete_suites
from ecatspec.generators.strategies import requests
from ecatspec.generators.suite import all_cases
from ecatspec.generators.token import PREFIX, case_of, check, token_of
from ecatspec.generators.transfers import begins_download
from ecatspec.generators.walks import walk
from ecatspec.model.blame import answering
from ecatspec.model.compiled import Model
from ecatspec.model.interpreter import rests_on, rule_clauses
from ecatspec.model.oracle.oracle import Oracle
from ecatspec.model.state import RuleName
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from ecatspec.conformance.adapter import Adapter, Description
    from ecatspec.conformance.known import Accepted
    from ecatspec.conformance.results import Journal
    from ecatspec.conformance.steps import Crew, Step
    from ecatspec.generators.finite_cover import Complete
    from ecatspec.model.candidates import Mismatch
    from ecatspec.model.values import ObjectKey
    from ecatspec.spec.language.ir import Protocol

Progress: TypeAlias = Callable[[int, int, str], None]

SHAPE = {"mailbox_support": "present", "emulation": "none"}
"""What a run takes for granted where no text pins it: a mailbox, and a controller of its own."""
EXAMPLES = {"quick": 30, "default": 150, "exhaustive": 1000}
"""Runs of random requests, by depth."""
_NOT_SURE = "or an earlier case left something: the device is not power cycled before each"
_LASTING = "it shows again after INIT, whatever earlier cases left: the device is not power cycled"
_DEAF = "the mailbox answers nothing any more"
_MUTE = ("killed", "exit status")
"""How the end of a device is told that says nothing of its cause."""
_STILL = (
    "AL Status never changed, so the device may not run at all: look at that first, "
    "docs/adapters.md has a list"
)
WALKS = {"quick": 0, "default": 10, "exhaustive": 200}
"""Random walks, by depth."""
WALK = 60
"""Stimuli of a walk."""
_SHORTENING = {True: 300, False: 40}
"""So often a case that fails is tried again to make it shorter, in virtual and in real time."""
_ROUNDS = 12
_STEPS = 6


class Runner:
    """Runs cases against one device and keeps what they showed."""

    def __init__(
        self,
        model: Model,
        adapter: Adapter,
        description: Description,
        *,
        accepted: Mapping[str, str] = MappingProxyType({}),
        given: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Take the compiled texts and an open adapter.

        `accepted` has the findings that are known, by their identity, and why; `given` the ways of
        the device that need not be found out.
        """
        self.model = model = model.as_closed if description.closed_dictionary else model
        self.adapter = adapter
        self.description = description
        self.accepted = accepted
        self.session = Session(adapter, model, Oracle(model), overlooks=True, accepted=accepted)
        self.verdicts: list[Verdict] = []
        self.rules: set[RuleName] = set()
        self.given: dict[str, str] = {**shape_of(model.protocol), **given}
        """What is taken for granted of the device."""
        self.choices: dict[str, str] = dict(self.given)
        self.refusals: dict[str, str] = {}
        """Why the device refused a transition, with the first case that showed it."""
        self.session.oracle.raised = description.locals
        self.configured: dict[ObjectKey, bytes] | None = None
        """What was assigned and mapped at power-on, as far as it was read; None: not read yet."""
        self.untold: set[str] = set()
        """Choices that the device met, and nothing told which way it went."""
        self.believed: dict[str, str] = {}
        """The ways at these that a complete suite takes the device to go."""
        self.signatures: set[str] = set()
        """The causes that were found already."""
        self.met: set[str] = set()
        """Choices on which some explanation rested in the step that was taken last."""
        self.journal: Journal | None = None
        """Where each judged step is kept; a resumed run finds there what it need not judge."""
        self.crew: Crew | None = None
        """Who judges the steps; None: this process, with its own device."""
        self.needed: set[str] = set()
        """The AL states that cases needed so far."""
        self.only: frozenset[str] = frozenset()
        """The layers that are tried; none: all."""
        self.moved = False
        """AL Status has changed in some step."""
        self.behind = False
        """The case that was judged last has more new causes than the one that it was given."""
        self.planned = 0
        """The cases of the run, as far as they are known."""

    # --- steps ------------------------------------------------------------------------------------

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
            found: Iterator[Judged] = map(self.take, left)
        else:
            found = self.crew.judge(left, self.knowledge, self.description)
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
        reached = {rule.target for rule in rules if RuleName("al", rule.name) in self.rules}
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
        """Take what a step told as known; that a step taken here is known already is no harm."""
        told = judged.learned
        self.verdicts.append(judged.verdict)
        if judged.verdict.outcome in CAUSED:
            self.signatures.add(judged.verdict.signature)
        self.choices |= told.choices
        self.untold |= set(told.untold)
        for reason in told.refusals:
            self.refusals.setdefault(reason, judged.verdict.case)
        self.rules |= set(map(_rule_of, told.rules))
        if told.disbelieved:
            self.believed = {}
        self.moved |= told.moved

    def wanted(self, layer: str) -> bool:
        """Tell whether a layer is to be tried."""
        return not self.only or layer in self.only

    def knowledge(self) -> Knowledge:
        """Give what verdicts may rest on."""
        return Knowledge(dict(self.choices), dict(self.believed), frozenset(self.signatures))

    def knowing(self, knowledge: Knowledge) -> None:
        """Go on as one who knows just this."""
        self.choices, self.believed = dict(knowledge.choices), dict(knowledge.believed)
        self.signatures = set(knowledge.signatures)
        self.untold, self.refusals, self.rules = set(), {}, set()

    def take(self, step: Step) -> Judged:
        """Judge one step, and tell what it told."""
        before, believed = self.knowledge(), bool(self.believed)
        untold, refusals, rules = set(self.untold), set(self.refusals), self.rules
        self.rules, self.met = set(), set()
        match step:
            case Trial(case, long=False):
                verdict = self._depending(case, self._ruled(case))
            case Trial(case):
                verdict = self._long(case)
            case Search(seed=chosen, examples=examples):
                verdict = self._searched(examples, chosen)
            case _:
                assert_never(step)
        new = {name: way for name, way in self.choices.items() if name not in before.choices}
        learned = Learned(
            new,
            tuple(sorted(self.untold - untold)),
            tuple(reason for reason in self.refusals if reason not in refusals),
            tuple(sorted({*map(str, self.rules), *verdict.rules})),
            believed and not self.believed,
            self.session.moved,
            self.model.protocol.risks(new),
        )
        self.rules |= rules
        return Judged(step.name, verdict, learned, frozenset(self.met))

    def _ruled(self, case: Case) -> Verdict:
        verdict = self.judge(case)
        # where the device was not reached the oracle still knows the case before
        untried = verdict.outcome in {Outcome.SKIPPED, Outcome.ERROR}
        certain = () if untried else self._certain_rules()
        return replace(verdict, flag=case.flag, rules=tuple(sorted(map(str, certain))))

    def _long(self, case: Case) -> Verdict:
        verdict = self._ruled(case)
        if verdict.outcome is not Outcome.PASS:
            verdict = replace(verdict, replay=token_of(case))
        if verdict.outcome in BLAMING and verdict.signature not in self.signatures:
            return self._shortened(case, verdict)
        return self._depending(case, verdict)

    def _shortened(self, case: Case, verdict: Verdict) -> Verdict:
        def fails(tried: Case) -> bool:
            again = self.judge(tried)
            return (again.outcome, again.signature) == (verdict.outcome, verdict.signature)

        tries = _SHORTENING[self.description.virtual_time]
        try:
            short = shortest(case, fails, tries)
        except ValueError:
            return verdict  # it does not fail every time
        found = replace(
            self.judge(short), flag=case.flag, rules=verdict.rules, replay=token_of(short)
        )
        return self._depending(short, found)

    def _depending(self, case: Case, verdict: Verdict) -> Verdict:
        """Say of a new finding without which ways, found in earlier cases, it is none."""
        learned = {n: way for n, way in self.choices.items() if n not in self.given}
        new = verdict.outcome in FOUND and verdict.signature not in self.signatures
        if not new or not learned or verdict.outcome is Outcome.CRASH:
            return verdict

        def shows(ways: Mapping[str, str]) -> bool:
            again = self._aside(case, ways)
            return again.signature == verdict.signature

        if shows({}) or not shows(learned):
            return verdict  # of one that does not show each time nothing more can be said
        needed = dict(learned)
        for name in learned:
            without = {n: way for n, way in needed.items() if n != name}
            if shows(without):
                needed = without
        return replace(verdict, depends=tuple(f"{n}={way}" for n, way in sorted(needed.items())))

    def _aside(self, case: Case, ways: Mapping[str, str], *, cold: bool = True) -> Verdict:
        """Judge a case by these ways and what was given; what it tells is not kept."""
        kept = self.choices, self.believed, self.untold, self.refusals, self.rules, self.met
        behind = self.behind
        self.choices, self.believed = {**self.given, **ways}, {}
        self.untold, self.refusals = set(self.untold), dict(self.refusals)
        self.rules, self.met = set(self.rules), set(self.met)
        try:
            return self._judge(case, cold=cold)
        finally:
            self.choices, self.believed, self.untold, self.refusals, self.rules, self.met = kept
            self.behind = behind

    def complete(self, depth: str, progress: Progress | None) -> list[str]:
        """Run the complete suites of the device as it has shown to go; give what they are worth."""
        promises = []
        ways = dict(self.choices)
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
            unsure = self.untold - self.choices.keys()
            self.believed = {n: way for n, way in suite.assumed.items() if n in unsure}
            doubted = set(self.believed)
            self.run_long(suite.cases(), progress, suite.suite.tests)
            doubted -= self.believed.keys()
            self.believed = {}
            outcomes = Counter(v.outcome for v in self.verdicts[before:])
            promises.append(f"{suite.guarantee()}; {self._worth(outcomes, suite, doubted)}")
        return promises

    def _worth(self, outcomes: Counter[Outcome], suite: Complete, doubted: set[str]) -> str:
        """Say whether a suite keeps what it promises; at some of `doubted` another way was gone."""
        if bad := {o: n for o, n in outcomes.items() if o is not Outcome.PASS}:
            counts = ", ".join(f"{count} {outcome.value}" for outcome, count in bad.items())
            return f"promises nothing: {counts}"
        odd = {name for name, way in suite.assumed.items() if self.choices.get(name, way) != way}
        if odd or doubted:
            ways = ", ".join(sorted(odd or doubted))
            return f"promises nothing: the device goes another way at {ways}"
        return "passed"

    def judge(self, case: Case) -> Verdict:
        """Run one case from power-on; on what is only believed of the device no verdict rests.

        An accident may explain what belief does not allow, so what is not conclusive is no verdict
        either.
        """
        if untried := self._untried(case):
            return untried
        verdict = self._judge(case)
        if verdict.outcome is not Outcome.PASS and self.believed:
            self.believed = {}
            verdict = self._judge(case)
        if self._is_binding(verdict) and self._lasts(case, verdict):
            # the texts demand it, and nothing but the device can be the cause
            return replace(verdict, outcome=Outcome.FAIL, reason=_LASTING)
        return verdict

    def _is_binding(self, verdict: Verdict) -> bool:
        """Tell whether a warning is of a clause that binds every device."""
        clause = self.model.protocol.clauses.get(verdict.broken)
        warns = verdict.outcome is Outcome.WARNING
        return warns and clause is not None and clause.level is Level.MUST

    def _lasts(self, case: Case, verdict: Verdict) -> bool:
        """Tell whether a device without a power cycle goes wrong again after INIT.

        Its objects and its drive may be as earlier cases left them.
        """
        if self.description.power_cycles:
            return False
        learned = {n: way for n, way in self.choices.items() if n not in self.given}
        return self._aside(case, learned, cold=False).signature == verdict.signature

    def _untried(self, case: Case) -> Verdict | None:
        """Give the verdict of a case that the way to the device cannot carry."""
        if case.layer not in self.description.protocols:
            reason = f"{case.layer} is not the device's own: {self.description.name} supplies "
            reason += ", ".join(sorted(self.description.protocols))
            return Verdict(case.name, Outcome.SKIPPED, case.title, reason)
        if case.feature in self.description.without:
            reason = f"{self.description.name} cannot carry it: {case.feature}, see its notes"
            return Verdict(case.name, Outcome.SKIPPED, case.title, reason)
        raised = {s.event for s in case.stimuli if isinstance(s, Happen)}
        if missing := sorted(raised - self.description.locals):
            reason = f"{self.description.name} cannot raise {', '.join(missing)}"
            return Verdict(case.name, Outcome.SKIPPED, case.title, reason)
        return None

    def _judge(self, case: Case, *, cold: bool = True) -> Verdict:
        self.session.forget_trace()
        self.behind = False
        position = -1
        try:
            choices = self.choices | self.believed
            self.session.begin(choices, self.configuration(), cold=cold)
            for position, stimulus in enumerate(case.stimuli):
                if position == case.prelude and case.needs is not None:
                    states = self.session.oracle.known.al_states()
                    if states != {case.needs}:
                        return self._inconclusive(case, states)
                self.session.apply(stimulus)
                if broken := self.session.oracle.known.broken():
                    reason = f"the texts break their own property {', '.join(broken)}"
                    return Verdict(case.name, Outcome.ERROR, case.title, reason)
        except (Deviation, InconclusiveError, DeviceFault, AdapterError) as error:
            on_the_way = position < case.prelude
            verdict = self.explained(replace(case, about="") if on_the_way else case, error)
            return self._new_one(case, verdict)
        finally:
            self.met |= self.session.oracle.known.met()
            if any(self._configures(stimulus) for stimulus in case.stimuli):
                self.configured = None
        if self.session.overlooked:
            return self._new_one(case, Verdict(case.name, Outcome.PASS, case.title))
        oracle = self.session.oracle
        self.rules |= self._certain_rules()
        if not self.believed:
            for reason in self.session.refusals:
                self.refusals.setdefault(reason, case.name)
            self.choices |= oracle.known.choices()
            self.untold |= oracle.known.untold()
        if surprises := oracle.known.surprises():
            reason = f"{' or '.join(surprises)} befell the device while it was tested"
            return Verdict(case.name, Outcome.INCONCLUSIVE, case.title, reason)
        for signature, advice in self.session.advice.items():
            if signature not in self.signatures:
                found = self._against(case, advice.mismatch, advice.trace, advice.time, ADVISED)
                return self._as_accepted(found)
        return Verdict(case.name, Outcome.PASS, case.title)

    def _new_one(self, case: Case, last: Verdict) -> Verdict:
        """Give the first that tells of a new cause: what was overlooked, or how the case ended.

        What is accepted comes after all else.
        """
        found = [
            self._against(case, each.mismatch, each.trace, each.time)
            for each in self.session.overlooked.values()
        ]
        if found and last.outcome in FOUND:
            behind = f"{last.reason}, behind another finding of this case"
            last = replace(last, reason=behind)
        if last.outcome in FOUND or not found:
            found.append(last)
        if last.outcome is Outcome.CRASH:
            return self._as_accepted(last)
        new = [each for each in found if each.signature not in self.signatures]
        other = [each for each in found if each.signature not in self.accepted]
        first = [each for each in new if each.signature not in self.accepted]
        self.behind = len(new) > 1
        return self._as_accepted((*first, *other, *new, *found)[0])

    def _as_accepted(self, verdict: Verdict) -> Verdict:
        """Give the verdict of a finding, as known where it is accepted."""
        if verdict.outcome not in FOUND or verdict.signature not in self.accepted:
            return verdict
        return replace(verdict, outcome=Outcome.KNOWN, reason=self.accepted[verdict.signature])

    def _certain_rules(self) -> frozenset[RuleName]:
        """Give the rules that fired for sure, none that rests on what is only believed."""
        return frozenset(
            rule
            for rule in self.session.oracle.known.certain_rules()
            if self.believed.keys().isdisjoint(rests_on(self.model, rule))
        )

    def configuration(self) -> dict[ObjectKey, bytes]:
        """Give what the device has assigned and mapped at power-on; read it where it may differ.

        A device that deviates meanwhile is left to the cases that show why.
        """
        if not has_process_data(self.model):
            return {}
        if self.configured is None:
            self.configured = {}
            self.session.begin(self.choices)
            with contextlib.suppress(Deviation, InconclusiveError):
                for stimulus in (*way_to(self.model, "PREOP"), *read_configuration(self.model)):
                    self.session.apply(stimulus)
                known = self.session.oracle.known.example().objects
                self.configured = at_power_on(self.model, known)
            self.session.forget_trace()
        return self.configured

    def _configures(self, stimulus: Stimulus) -> bool:
        """Tell whether a request may change what is assigned or mapped."""
        if isinstance(stimulus, WriteUntilTaken):
            return self.model.sets_up(stimulus.index)
        if not isinstance(stimulus, SendFrame) or not begins_download(stimulus):
            return False
        if self.description.power_cycles and stimulus in first_assigned(self.model):
            return False
        index = stimulus.fields["index"]
        return isinstance(index, int) and self.model.sets_up(index)

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

    def _searched(self, examples: int, chosen_seed: int) -> Verdict:
        name = f"random/seed_{chosen_seed}"
        way, known = way_to(self.model, "PREOP"), self.signatures
        failures: list[tuple[Case, Verdict]] = []

        def attempt(sent: list[Stimulus]) -> None:
            stimuli = (*way, *sent, Probe())
            case = Case(name, "random requests", "sdo", stimuli, "PREOP", len(way))
            verdict = self.judge(case)
            if verdict.outcome in BLAMING and verdict.signature not in known:
                if failures and failures[-1][1].signature != verdict.signature:
                    return
                failures.append((case, verdict))
                raise _Found

        search = settings(
            max_examples=examples,
            database=None,
            deadline=None,
            phases=(Phase.generate, Phase.shrink),
            verbosity=Verbosity.quiet,
            suppress_health_check=list(HealthCheck),
            print_blob=False,
            report_multiple_bugs=False,
        )
        wrapped = seed(chosen_seed)(
            search(given(requests(self.model, limits_of(self.description), _STEPS))(attempt))
        )
        try:
            wrapped()
        except _Found:
            case, found = failures[-1]
            return replace(found, replay=token_of(case))
        return Verdict(name, Outcome.PASS, "random requests")

    # --- verdicts ---------------------------------------------------------------------------------

    def explained(
        self, case: Case, error: Deviation | InconclusiveError | DeviceFault | AdapterError
    ) -> Verdict:
        """Give the verdict of a case that ends here, with what the session came to."""
        match error:
            case Deviation():
                session, mismatch = self.session, error.mismatch
                verdict = self._against(case, mismatch, tuple(session.trace), session.time)
                if mismatch.silent and session.is_deaf():
                    # what else it does not answer then is no cause of its own
                    first, rest = verdict.clauses[:1], verdict.clauses[1:]
                    clauses = tuple(dict.fromkeys((*first, *answering(self.model), *rest)))
                    return replace(
                        verdict, reason=_DEAF, signature=_DEAF, clauses=clauses, causes=()
                    )
                return verdict
            case DeviceFault():
                return self._death(case, error)
            case Unheard() | InconclusiveError():
                return Verdict(case.name, Outcome.INCONCLUSIVE, case.title, str(error))
            case AdapterError():
                return Verdict(case.name, Outcome.ERROR, case.title, str(error))
            case _:
                assert_never(error)

    def _against(
        self,
        case: Case,
        mismatch: Mismatch,
        trace: tuple[TraceLine, ...],
        time: int,
        reason: str = UNEXPLAINED,
    ) -> Verdict:
        """Give the verdict of a mismatch at a time in microseconds: a failure, or a warning."""
        clauses = self.model.protocol.clauses
        broken = [clauses[name] for name in mismatch.clauses]
        sure = self.description.power_cycles
        blames = sure and any(clause.level is Level.MUST for clause in broken)
        names = tuple(dict.fromkeys((*mismatch.clauses, *self._looked_for(case))))
        cited = [clauses[name] for name in names]
        return Verdict(
            case.name,
            Outcome.FAIL if blames else Outcome.WARNING,
            headline(mismatch.observed, mismatch.differing, cited[0].wording),
            reason if sure else f"{reason}, {_NOT_SURE}",
            mismatch.expected,
            mismatch.observed,
            names,
            tuple(dict.fromkeys(claim for clause in cited for claim in clause.claims)),
            (
                *trace,
                *(TraceLine(time, REASON, text) for text in mismatch.reasons),
            ),
            f"{time / 1000:.1f} ms",
            mismatch.signature,
            mismatch.causes,
            differing=mismatch.differing,
            blamed=tuple(map(str, mismatch.rules)),
        )

    def _looked_for(self, case: Case) -> tuple[str, ...]:
        """Give the clauses of the rule that a case is about, none where the device lacks it."""
        machine, _, name = case.about.partition(".")
        found = self.model.protocol.machines.get(machine)
        rules = () if found is None else found.rules
        return next((rule.clauses for rule in rules if rule.name == name), ())

    def _death(self, case: Case, death: DeviceFault) -> Verdict:
        trace = tuple(self.session.trace)
        last = _last_stimulus(trace)
        oracle, attempt = self.session.oracle, self.session.attempt
        if attempt is not None:
            oracle.observe(attempt)  # the device died while it served a write
        rules = oracle.known.due_rules()
        inner = [rule for rule in rules if rule.machine != "mailbox"] or rules
        clauses = tuple(dict.fromkeys(c for rule in inner for c in rule_clauses(self.model, rule)))
        kind, said = type(death).__name__, death.cause
        # an error of its own words is the same wherever it comes; a signal says nothing of why
        cause = (kind, *(sorted(clauses) if said.startswith(_MUTE) else ()), said)
        return Verdict(
            case.name,
            Outcome.CRASH,
            said if death.placed else f"{said} at {last.partition(':')[0]}",
            f"last stimulus: {last}",
            ("an answer, and a device that lives",),
            str(death),
            clauses,
            (),
            (*trace, TraceLine(self.session.time, SUB_DEVICE, str(death))),
            f"{self.session.time / 1000:.1f} ms",
            " ".join(cause),
            blamed=tuple(map(str, inner)),
        )

    def _inconclusive(self, case: Case, states: frozenset[str]) -> Verdict:
        reached = " or ".join(sorted(states)) or "no state"
        why = "".join(f"; {text}" for text in self.session.oracle.known.reasons())
        reason = f"needs AL state {case.needs}, the device is in {reached}{why}"
        return Verdict(case.name, Outcome.INCONCLUSIVE, case.title, reason)


def shape_of(protocol: Protocol) -> dict[str, str]:
    """Give what a run takes for granted of a device."""
    return {name: way for name, way in SHAPE.items() if name not in protocol.pins}


def ways_of(protocol: Protocol, choices: Iterable[str]) -> dict[str, str]:
    """Give the ways that a user says a device goes, each as `choice=alternative`.

    Raises:
        UserError: There is no such choice or way, or the text of the device has decided it.

    """
    found: dict[str, str] = {}
    for each in choices:
        name, _, way = each.partition("=")
        choice = protocol.choices.get(name)
        if choice is None:
            raise nearest("choice", name, tuple(protocol.choices))
        ways = tuple(alternative.name for alternative in choice.alternatives)
        if way not in ways:
            raise nearest(f"way of {name}", way, ways)
        pin = protocol.pins.get(name)
        if pin is not None and pin.alternative != way:
            said = f"{protocol.name} says that {name} is {pin.alternative}"
            raise UserError(f"{said}; leave out {each!r}, or change the text")
        found[name] = way
    return found


class _Found(Exception):  # noqa: N818
    """A new cause was found; Hypothesis shrinks it."""


def _last_stimulus(trace: tuple[TraceLine, ...]) -> str:
    return next((line.what for line in reversed(trace) if line.who == MAIN_DEVICE), "power-on")


def _told(steps: Iterable[Step], progress: Progress | None, total: int) -> Iterator[Step]:
    for number, step in enumerate(steps):
        if progress is not None:
            progress(number, total, step.name)
        yield step


def _rule_of(name: str) -> RuleName:
    machine, _, rule = name.partition(".")
    return RuleName(machine, rule)


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
        while replay and runner.behind:
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
    extent = extent_of(runner.model, runner.rules, shape_of(protocol))
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
        runner.choices,
        (
            *runner.description.notes,
            *([_STILL] if blamed and not runner.moved else []),
            *(f"refused: {why} (first in {name})" for why, name in runner.refusals.items()),
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


def limits_of(description: Description) -> Limits:
    """Give what the way to a device cannot carry, as its adapter declares it."""
    return Limits(
        description.limits.get("initiate_data"),
        description.limits.get("segment_data"),
        frozenset(description.without),
    )
