"""Judges one case: set up, play, judge, and again where a verdict depends on it or may be short."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, assert_never

from hypothesis import HealthCheck, Phase, Verbosity, given, seed, settings

from ecatspec.conformance.base.adapter import AdapterError, DeviceFault, Restorable, Unheard
from ecatspec.conformance.base.verdict import (
    ADVISED,
    BLAMING,
    FOUND,
    MAIN_DEVICE,
    REASON,
    SUB_DEVICE,
    UNEXPLAINED,
    Outcome,
    TraceLine,
    Verdict,
)
from ecatspec.conformance.base.work_items import Judged, Search, Trial
from ecatspec.conformance.render.marks import headline
from ecatspec.conformance.run.device_link import Deviation, InconclusiveError
from ecatspec.conformance.run.dut_knowledge import DutKnowledge, shape_of
from ecatspec.conformance.run.session import Session
from ecatspec.conformance.run.shrink import shortest
from ecatspec.conformance.run.snapshot_session import SnapshotSession
from ecatspec.generators.cases.assignment import at_power_on, first_assigned, read_configuration
from ecatspec.generators.cases.bringup import has_process_data, way_to
from ecatspec.generators.cases.case import (
    Case,
    Happen,
    Limits,
    Probe,
    SendFrame,
    Stimulus,
    WriteUntilTaken,
)
from ecatspec.generators.cases.case_codec import token_of
from ecatspec.generators.cases.transfers import begins_download
from ecatspec.generators.random.strategies import requests
from ecatspec.model.core.interpreter import rests_on, rule_clauses
from ecatspec.model.oracle.blame import answering
from ecatspec.model.oracle.oracle import Oracle
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.conformance.base.work_items import Step
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.model.oracle.explanations import Mismatch

_NOT_SURE = "or an earlier case left something: the device is not power cycled before each"
_LASTING = "it shows again after INIT, whatever earlier cases left: the device is not power cycled"
_DEAF = "the mailbox answers nothing any more"
_MUTE = ("killed", "exit status")
"""How the end of a device is told that says nothing of its cause."""
_SHORTENING = {True: 300, False: 40}
"""Times that a case that fails is tried again at most to make it shorter, in virtual and in real
time."""
_STEPS = 6
"""Random requests of a case at most."""


class CaseExecutor:
    """Executes cases against one device, each from power-on, and gives their verdicts."""

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
        kind = SnapshotSession if isinstance(adapter, Restorable) else Session
        self.session = kind(adapter, model, Oracle(model), overlooks=True, accepted=accepted)
        self.session.oracle.raised = description.locals
        self.known = DutKnowledge({**shape_of(model.protocol), **given})
        self.configured: dict[ObjectKey, bytes] | None = None
        """What was assigned and mapped at power-on, as far as it was read; None: not read yet."""
        self.behind = False
        """The case that was judged last has more new causes than the one that it was given."""

    # --- steps ------------------------------------------------------------------------------------

    def take(self, step: Step) -> Judged:
        """Judge one step, and tell what it told."""
        before = self.known.begin_step()
        match step:
            case Trial(case, long=False):
                verdict = self._depending(case, self._ruled(case))
            case Trial(case):
                verdict = self._long(case)
            case Search(seed=chosen, examples=examples):
                verdict = self._searched(examples, chosen)
            case _:
                assert_never(step)
        protocol = self.model.protocol
        learned = self.known.end_step(before, verdict, protocol, moved=self.session.moved)
        return Judged(step.name, verdict, learned, frozenset(self.known.met))

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
        if verdict.outcome in BLAMING and self.known.is_new(verdict):
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
        learned = self.known.learned
        new = verdict.outcome in FOUND and self.known.is_new(verdict)
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
        kept = self.known, self.behind
        self.known = self.known.fork(ways)
        try:
            return self._judge(case, cold=cold)
        finally:
            self.known, self.behind = kept

    def _searched(self, examples: int, chosen_seed: int) -> Verdict:
        name = f"random/seed_{chosen_seed}"
        way, known = way_to(self.model, "PREOP"), self.known.signatures
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

    # --- one case ---------------------------------------------------------------------------------

    def judge(self, case: Case) -> Verdict:
        """Run one case from power-on; on what is only believed of the device no verdict rests.

        An accident may explain what belief does not allow, so what is not conclusive is no verdict
        either.
        """
        if untried := self._untried(case):
            return untried
        verdict = self._judge(case)
        if verdict.outcome is not Outcome.PASS and self.known.believed:
            self.known.believed = {}
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
        learned = self.known.learned
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
            choices = self.known.choices | self.known.believed
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
            self.known.met |= self.session.oracle.known.met()
            if any(self._configures(stimulus) for stimulus in case.stimuli):
                self.configured = None
        if self.session.overlooked:
            return self._new_one(case, Verdict(case.name, Outcome.PASS, case.title))
        oracle = self.session.oracle
        self.known.rules |= self._certain_rules()
        if not self.known.believed:
            for reason in self.session.refusals:
                self.known.refusals.setdefault(reason, case.name)
            self.known.choices |= oracle.known.choices()
            self.known.untold |= oracle.known.untold()
        if surprises := oracle.known.surprises():
            reason = f"{' or '.join(surprises)} happened in the device while it was tested"
            return Verdict(case.name, Outcome.INCONCLUSIVE, case.title, reason)
        for signature, advice in self.session.advice.items():
            if signature not in self.known.signatures:
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
        new = [each for each in found if self.known.is_new(each)]
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
            if self.known.believed.keys().isdisjoint(rests_on(self.model, rule))
        )

    def configuration(self) -> dict[ObjectKey, bytes]:
        """Give what the device has assigned and mapped at power-on; read it where it may differ.

        A device that deviates meanwhile is left to the cases that show why.
        """
        if not has_process_data(self.model):
            return {}
        if self.configured is None:
            self.configured = {}
            self.session.begin(self.known.choices)
            with contextlib.suppress(Deviation, InconclusiveError):
                for stimulus in (*way_to(self.model, "PREOP"), *read_configuration(self.model)):
                    self.session.apply(stimulus)
                known = self.session.oracle.known.example().objects.items()
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


class _Found(Exception):  # noqa: N818
    """A new cause was found; Hypothesis shrinks it."""


def _last_stimulus(trace: tuple[TraceLine, ...]) -> str:
    return next((line.what for line in reversed(trace) if line.who == MAIN_DEVICE), "power-on")


def limits_of(description: Description) -> Limits:
    """Give what the way to a device cannot carry, as its adapter declares it."""
    return Limits(
        description.limits.get("initiate_data"),
        description.limits.get("segment_data"),
        frozenset(description.without),
    )
