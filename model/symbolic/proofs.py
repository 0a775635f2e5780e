"""Judges obligations: by induction, by search, and by trial.

One walk over all inputs and what they lead to serves determinism, completeness, properties and
rules that can fire. It begins in any state in which the properties hold, so that what it proves
holds in every state that can be reached.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

from ecatspec.model.core.compiled import rows_of
from ecatspec.model.core.state import RuleName
from ecatspec.model.core.wording import typed_words
from ecatspec.model.symbolic.concretisation import Example
from ecatspec.model.symbolic.effects import has_effect, told_apart
from ecatspec.model.symbolic.layouts import memory, round_trip
from ecatspec.model.symbolic.obligations import Finding, Kind, Obligation, Status, obligations
from ecatspec.model.symbolic.renewed_solver import ForgetfulSolver
from ecatspec.model.symbolic.search import DEPTH, Search
from ecatspec.model.symbolic.smt_encoding import Meaning
from ecatspec.model.symbolic.symbolic_execution import Chains
from ecatspec.model.symbolic.symbolic_state import Moment
from ecatspec.model.symbolic.terms import (
    Answer,
    Solver,
    Term,
    all_of,
    any_of,
    key_of,
    negated,
    two_of,
)
from ecatspec.spec.language.scope import Scope

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.state import State
    from ecatspec.model.symbolic.search import Trace, Way
    from ecatspec.model.symbolic.symbolic_state import Meeting, World
    from ecatspec.spec.language.ir import Gap, ObjectEntry, Protocol, Rule, Span

PROPERTY_DEPTH: Final = 4
"""Number of inputs that are tried where induction does not prove a property."""

_Place = tuple[Kind, str, str]


@dataclass(slots=True)
class _Walk:
    """What one walk found, under the properties that it took for true."""

    broken: set[str] = field(default_factory=set)
    unsure: set[str] = field(default_factory=set)
    fired: set[RuleName] = field(default_factory=set)
    findings: dict[_Place, Finding] = field(default_factory=dict)
    met: list[Meeting] = field(default_factory=list)
    cut: frozenset[RuleName] = frozenset()


class Prover:
    """The proofs of one specification.

    `samples` are objects with which the standard is tried, which has none of its own. With
    `meaning` its symbols are those of a question that comes later.
    """

    def __init__(
        self,
        protocol: Protocol,
        samples: tuple[ObjectEntry, ...] = (),
        meaning: Meaning | None = None,
    ) -> None:
        """Take the texts."""
        self.protocol = protocol
        self.meaning = Meaning(protocol) if meaning is None else meaning
        self._samples = samples
        self._solver = ForgetfulSolver(self.meaning.symbols)

    def findings(self) -> Iterator[Finding]:
        """Yield how every obligation ends, in the order of the obligations."""
        for obligation in obligations(self.protocol):
            found = self._judged(obligation)
            if found is not None:
                yield found

    def met(self) -> tuple[tuple[Meeting, ...], frozenset[RuleName]]:
        """Give all inputs with what is known when they come, from states that can be reached.

        The rules beside them take their inputs in further ways, which the walk did not go.
        """
        return tuple(self._walk.met), self._walk.cut

    def unproved(self) -> set[str]:
        """Give the properties that induction does not prove."""
        return self._walk.broken | self._walk.unsure

    def _judged(self, obligation: Obligation) -> Finding | None:
        name = RuleName(obligation.group, obligation.name)
        match obligation.kind:
            case Kind.DETERMINISM | Kind.COMPLETENESS:
                place = (obligation.kind, obligation.group, obligation.name)
                found = self._walk.findings.get(place)
                proved = Finding(obligation, Status.PROVED)
                return proved if found is None else replace(found, obligation=obligation)
            case Kind.PROPERTY:
                return self._property(obligation)
            case Kind.LIVE:
                return self._live(obligation, name)
            case Kind.RULE_REACHED:
                if name in self._walk.fired:
                    sources = self._row(name).sources
                    if not set(sources) & self._led_to(obligation.group):
                        return self._nowhere(obligation, " or ".join(sources))
                    return _of_trace(obligation, self._traces[0].get(name))
                if self._never(name, self.meaning):
                    return None
                line = "its guard can hold, but not where its input comes and the properties hold"
                return Finding(obligation, Status.REFUTED, (line,), (obligation.at,))
            case Kind.STATE_REACHED:
                return self._state(obligation)
            case Kind.TOLD_APART:
                return told_apart(self.meaning, self._solver, obligation)
            case Kind.CHOICE:
                return has_effect(self.meaning, self._solver, obligation)
            case Kind.ROUND_TRIP:
                return round_trip(self.meaning.model, obligation)
            case Kind.MEMORY:
                return memory(self.meaning.model, obligation)

    # --- the walk ---------------------------------------------------------------------------------

    @cached_property
    def _walk(self) -> _Walk:
        """Walk until the properties that are taken for true are those that are kept."""
        taken = set(self.protocol.properties)
        broken: set[str] = set()
        unsure: set[str] = set()
        while True:
            walk = self._walked(taken)
            broken |= walk.broken
            unsure |= walk.unsure
            if not walk.broken | walk.unsure:
                walk.broken, walk.unsure = broken, unsure
                return walk
            taken -= walk.broken | walk.unsure

    def _walked(self, taken: set[str]) -> _Walk:
        walk = _Walk()
        world = self.meaning.world()
        names = sorted(taken)
        before = {name: key_of(self.law(name, world)) for name in names}
        spoken = {name: self._spoken(name) for name in names}

        def laws(of: World) -> tuple[Term, ...]:
            return tuple(self.law(name, of) for name in names)

        def settle(of: World) -> tuple[World, tuple[Term, ...]]:
            moved = {
                slot: self.meaning.symbol(f"{slot} moved {of.stamp}", slot)
                for slot in sorted(chains.moved_by_words)
            }
            after = of.having(moved)
            return after, laws(after)

        def check(at: World, conditions: tuple[Term, ...]) -> None:
            changed = {
                name: after
                for name in names
                if name not in walk.broken
                and (at.stamp != world.stamp or not spoken[name].isdisjoint(at.changed))
                and key_of(after := self.law(name, at)) != before[name]
            }
            together = any_of(map(negated, changed.values()))
            if self._solver.ask((*conditions, together)) is Answer.NO:
                return
            for name, after in changed.items():
                answer = self._solver.ask((*conditions, negated(after)))
                if answer is Answer.YES:
                    walk.broken.add(name)
                elif answer is Answer.UNKNOWN:
                    walk.unsure.add(name)

        chains = Chains(
            self.meaning,
            lambda conditions: self._solver.ask(conditions) is not Answer.NO,
            meet=lambda meeting: self._met(walk, meeting),
            settle=settle,
        )
        start = self.meaning.power_on()
        for name in names:
            if self._solver.ask((negated(self.law(name, start)),)) is not Answer.NO:
                walk.broken.add(name)
        given = laws(world)
        for at in (*self._unasked(world), *self._sent(world)):
            check(at, given)
        for machine, source in chains.roots():
            came, arrival = chains.arrive(world, machine, source, anew=False)
            for chain in chains.run(came, arrival, given):
                walk.fired |= {name for name, _ in chain.fired}
                for at, conditions in chain.between:
                    check(at, conditions)
                if not chain.gap:
                    check(chain.world, chain.conditions)
        walk.cut = frozenset(chains.cut)
        return walk

    def law(self, name: str, world: World) -> Term:
        """Give a property in a world."""
        moment = Moment(world, Scope(), f"property {name}", {})
        return self.meaning.truth(self.protocol.properties[name].value, moment)

    def _spoken(self, name: str) -> set[str]:
        """Give the slots that a property asks for."""
        asked = self.meaning.world()
        self.law(name, asked)
        return set(asked.base)

    def _unasked(self, world: World) -> Iterator[World]:
        """Yield the worlds after registers were written that no machine looks at."""
        changes = {
            slot: self.meaning.of_kind(f"{slot} anew", slot, kind)
            for slot, kind in self.meaning.kinds.items()
            if slot.startswith(("register ", "word "))
        }
        yield world.having(changes)

    def _sent(self, world: World) -> Iterator[World]:
        """Yield the worlds after a frame was sent of which a variable keeps a field."""
        moment = Moment(world, Scope(), "sent", {})
        for frame in self.protocol.frames.values():
            for item in frame.fields:
                if item.into is not None and item.reply is not None:
                    kind = self.meaning.kinds[item.into]
                    value = self.meaning.value(item.reply, moment, kind)
                    yield world.having(
                        {item.into: self.meaning.typed(value, item.name, kind, "sent")}
                    )

    # --- determinism and completeness -------------------------------------------------------------

    def _met(self, walk: _Walk, meeting: Meeting) -> None:
        scope = meeting.moment.scope
        machine, source = scope.machine or "", scope.input or ""
        walk.met.append(meeting)
        here = [term for _, term in meeting.rows]
        for kind, wrong in (
            (Kind.DETERMINISM, two_of(here)),
            (Kind.COMPLETENESS, all_of(map(negated, here))),
        ):
            place = (kind, machine, source)
            known = walk.findings.get(place)
            if known is not None and known.status is Status.REFUTED:
                continue
            formulas = (*meeting.conditions, wrong)
            answer = self._solver.ask(formulas)
            if answer is Answer.UNKNOWN:
                walk.findings.setdefault(place, _unknown(place, "the solver gave up"))
            elif answer is Answer.YES:
                walk.findings[place] = self._contradiction(place, meeting, formulas)

    def _contradiction(
        self, place: _Place, meeting: Meeting, formulas: tuple[Term, ...]
    ) -> Finding:
        kind, machine, source = place
        values = self._solver.example(formulas)[1]
        if values is None:
            return _unknown(place, "the solver gave up")
        example = Example(self.meaning, values)
        says = example.guards(meeting.moment)
        taken = [row for row, _ in meeting.rows if says[row.name]]
        unsure = [row for row, _ in meeting.rows if says[row.name] is None]
        state = example.value(meeting.moment.world.get(f"{machine}.state"), 0)
        where = self.meaning.model.state_names(machine).get(int(state), "?")  # type: ignore[arg-type]
        core = frozenset[str]().union(
            *(self.meaning.symbols.inside(term) for _, term in meeting.rows)
        )
        led = tuple(f"after {name}" for name, _ in meeting.fired)
        lines = (*led, *self._given(meeting.moment), *example.words(core))
        if kind is Kind.DETERMINISM:
            if len(taken) > 1:
                names = " and ".join(f"`{row.name}`" for row in taken)
                first = f"{names} both fire in {where} on `{source}`"
                return _refuted(place, (first, *lines), _places(taken))
        elif not taken and not unsure:
            first = f"no rule and no gap of `{machine}` takes `{source}` in {where}"
            sources = [row for row, _ in meeting.rows if where in row.sources]
            at = _places(sources) or (self.protocol.machines[machine].at,)
            return _refuted(place, (first, *lines), at)
        why = "the interpreter does not confirm it: it rests on "
        return _unknown(
            place, why + (", ".join(example.abstract(core)) or "what is not known"), *lines
        )

    def _given(self, moment: Moment) -> tuple[str, ...]:
        """Say the parameters that the rule fixed which gave the event."""
        inputs = self.protocol.machines[moment.scope.machine or ""].inputs
        source = next(i for i in inputs if i.name == moment.scope.input)
        model = self.meaning.model
        return tuple(
            f"{name} = {typed_words(model, kind, value)}"
            for name, kind in source.parameters
            if isinstance(value := moment.parameters.get(name), int)
        )

    # --- properties -------------------------------------------------------------------------------

    def _property(self, obligation: Obligation) -> Finding:
        name = obligation.name
        if name not in self.unproved():
            return Finding(obligation, Status.PROVED, ("by induction over all rules",))
        slots = self.meaning.symbols.inside(self.law(name, self.meaning.world()))
        search = Search(Meaning(self.protocol, abstract=False))
        wrong_in = search.meaning

        def wrong(world: World) -> Term:
            moment = Moment(world, Scope(), f"property {name}", {})
            return negated(wrong_in.truth(self.protocol.properties[name].value, moment))

        way, depth = search.find(wrong, slots & set(self.meaning.kinds), PROPERTY_DEPTH)
        if way is None:
            said = f"no trace of up to {depth} inputs breaks it; induction does not prove it"
            return Finding(obligation, Status.BOUNDED, (said,), depth=depth)
        trace = search.trace(way)
        if trace is None or not any(name in wrong_in.model.broken(s) for s in trace.states):
            lines = () if trace is None else trace.lines
            return Finding(
                obligation, Status.UNKNOWN, ("the interpreter does not confirm the trace", *lines)
            )
        last = trace.states[-1]
        held = tuple(
            f"{slot} = {_held(wrong_in, slot, last)}"
            for slot in sorted(slots & set(wrong_in.kinds))
        )
        places = (obligation.at, *self._rules_of(way))
        lines = ("after power-on", *trace.lines, *held) if way.steps else ("after power-on", *held)
        return Finding(obligation, Status.REFUTED, lines, places, depth=trace.length)

    def _rules_of(self, way: Way) -> tuple[Span, ...]:
        return tuple(self._row(name).at for _, chain in way.steps for name, _ in chain.fired)

    def _row(self, name: RuleName) -> Rule | Gap:
        rows = rows_of(self.protocol.machines[name.machine])
        return next(row for row in rows if row.name == name.name)

    # --- what is reached --------------------------------------------------------------------------

    def _live(self, obligation: Obligation, name: RuleName) -> Finding | None:
        """Prove that a guard can hold; what only a pin of the text silences is not asked for."""
        if name in self._walk.fired or not self._never(name, self.meaning):
            return Finding(obligation, Status.PROVED)
        unpinned = Meaning(replace(self.protocol, pins={}))
        if self.protocol.pins and not self._never(name, unpinned):
            return None
        line = "no state and no values make its guard true"
        return Finding(obligation, Status.REFUTED, (line,), (obligation.at,))

    def _never(self, name: RuleName, meaning: Meaning) -> bool:
        machine = self.protocol.machines[name.machine]
        row = self._row(name)
        moment = Moment(meaning.world(), Scope(machine.name, row.input), "dead", {})
        here = Chains(meaning).enabled(row, machine, moment)
        return Solver(meaning.symbols).ask((here,)) is Answer.NO

    @cached_property
    def _traces(self) -> tuple[dict[RuleName, Trace], dict[tuple[str, str], Trace]]:
        """Search from power-on; the standard with sample objects, in both kinds of dictionary."""
        wanted = {
            RuleName(o.group, o.name)
            for o in obligations(self.protocol)
            if o.kind is Kind.RULE_REACHED
        } & self._walk.fired
        protocol = self.protocol
        if self._samples:
            protocol = replace(protocol, objects=self._samples)
        rules: dict[RuleName, Trace] = {}
        states: dict[tuple[str, str], Trace] = {}
        for closed in (protocol.dictionary.closed, True):
            missing = wanted - {name for name, trace in rules.items() if trace.states}
            if not missing:
                break
            dictionary = replace(protocol.dictionary, closed=closed)
            search = Search(Meaning(replace(protocol, dictionary=dictionary), abstract=False))
            found = search.cover(missing)
            for name in missing & set(found):
                trace = search.trace(found[name], name)
                if trace is not None:
                    rules[name] = trace
            for key, way in search.states(found).items():
                if key not in states and (trace := search.trace(way)) is not None:
                    states[key] = trace
            if not self._samples:
                break
        return rules, states

    def _state(self, obligation: Obligation) -> Finding:
        if obligation.name not in self._led_to(obligation.group):
            return self._nowhere(obligation, obligation.name)
        return _of_trace(obligation, self._traces[1].get((obligation.group, obligation.name)))

    def _nowhere(self, obligation: Obligation, state: str) -> Finding:
        initial = self.protocol.machines[obligation.group].initial
        line = f"no rule that can fire leads to {state} from {initial}"
        return Finding(obligation, Status.REFUTED, (line,), (obligation.at,))

    def _led_to(self, machine: str) -> set[str]:
        """Give the states that rules which can fire lead to, one after another."""
        reached = {self.protocol.machines[machine].initial}
        rules = [
            rule
            for rule in self.protocol.machines[machine].rules
            if RuleName(machine, rule.name) in self._walk.fired
        ]
        while True:
            more = {r.target for r in rules if r.target and reached.intersection(r.sources)}
            if more <= reached:
                return reached
            reached |= more


def _of_trace(obligation: Obligation, trace: Trace | None) -> Finding:
    if trace is None:
        line = f"no way was found with up to {DEPTH} inputs"
        return Finding(obligation, Status.UNKNOWN, (line,), depth=DEPTH)
    if not trace.states:
        lines = ("the interpreter does not confirm this way", *trace.lines)
        return Finding(obligation, Status.UNKNOWN, lines, depth=trace.length)
    return Finding(obligation, Status.PROVED, trace.lines, depth=trace.length)


def _held(meaning: Meaning, slot: str, state: State) -> str:
    place = meaning.model.slots.get(slot)
    value = None if place is None else state.slots[place]
    return "?" if value is None else typed_words(meaning.model, meaning.kinds[slot], value)


def _places(rows: list[Rule | Gap]) -> tuple[Span, ...]:
    return tuple(row.at for row in rows)


def _refuted(place: _Place, lines: tuple[str, ...], places: tuple[Span, ...]) -> Finding:
    return Finding(Obligation(*place), Status.REFUTED, lines, places)


def _unknown(place: _Place, *lines: str) -> Finding:
    return Finding(Obligation(*place), Status.UNKNOWN, lines)
