"""Proves that a mutant is equivalent: the solver finds no difference.

A device with the mistake takes the same rule, or one that does the same, for every input in every
state that can be reached. What the proof does not know (the content of bytes, what objects hold)
may be anything in it, so that it errs on one side only: it misses mutants that are no mistakes.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

from ecatspec.generators.mutation.mutants import DEFINE, SHOWN, definitions_in
from ecatspec.model.analysis.entry_facts import with_guesses
from ecatspec.model.core.compilation import MAILBOX
from ecatspec.model.core.compiled import rows_of
from ecatspec.model.core.interpreter import DELIVER
from ecatspec.model.core.state import RuleName
from ecatspec.model.symbolic.proofs import Prover
from ecatspec.model.symbolic.renewed_solver import ForgetfulSolver
from ecatspec.model.symbolic.smt_encoding import Meaning
from ecatspec.model.symbolic.symbolic_execution import Chains
from ecatspec.model.symbolic.symbolic_state import ANY, Anything, Content, Moment
from ecatspec.model.symbolic.terms import Answer, all_of, any_of, equal, negated
from ecatspec.spec.language import ir
from ecatspec.spec.language.ir import InputKind
from ecatspec.spec.language.nodes import nodes_in
from ecatspec.spec.language.references import UnresolvedName
from ecatspec.spec.language.scope import Scope

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from ecatspec.generators.mutation.mutants import Mutant
    from ecatspec.model.symbolic.symbolic_state import Meant, Meeting, World
    from ecatspec.model.symbolic.terms import Term
    from ecatspec.spec.language.ir import Machine, Protocol, Update

Row: TypeAlias = ir.Rule | ir.Gap
Target = tuple[str, str]
"""A machine and an input of it."""
_INSIDE: Final = frozenset({ir.InputKind.OWN, ir.InputKind.LOCAL, ir.InputKind.EVENT})
"""Inputs that come from within the device only, from rules or by themselves."""
_UNSURE: Final = frozenset({"can_hold", "holds", "pdo_bits"})
"""Functions to which even a device has no answer of its own, for a place in a mapping that is
empty or not there."""
_OUTSIDE: Final = frozenset({ir.InputKind.FRAME, ir.InputKind.LOCAL, ir.InputKind.WRITE})
"""Inputs that come when all that was given before is done."""


class Equivalents:
    """What the solver knows of a device as it is built, to prove mutants to be no mistakes."""

    def __init__(self, built: Protocol, raisable: Collection[str]) -> None:
        """Find out which rules can fire; `raisable` are the local events that can be raised."""
        self._built = built
        self._meaning = Meaning(built, abstract=False, closed=True)
        self._chains = Chains(self._meaning)
        self._solver = ForgetfulSolver(self._meaning.symbols)
        self._world = self._meaning.world()
        self._raisable = frozenset(raisable)
        self._gaps_differ = True
        """Whether it matters what a device does where the texts have a gap."""
        self._rows: dict[Target, tuple[Row, ...]] = {}
        for machine in built.machines.values():
            for source in machine.inputs:
                rows = tuple(row for row in rows_of(machine) if row.input == source.name)
                self._rows[machine.name, source.name] = rows
        self._reached = {m.name: {m.initial} for m in built.machines.values()}
        self._live: dict[tuple[str, str], ir.Rule] = {}
        self._held = self._held_at_first()
        self._known = self._facts()
        self._explore()
        self._delivered_alone = all(
            DELIVER not in (given := [give.target for give in rule.gives]) or len(given) == 1
            for machine in built.machines.values()
            for rule in machine.rules
        )
        self._resting = {m.name: self._rests_in(m) for m in built.machines.values()}
        self._forgetful = {m.name for m in built.machines.values() if self._forgets(m)}
        """Machines of which nobody can tell in which state they rest."""
        self._met, self._further = Prover(with_guesses(built), meaning=self._meaning).met()

    def proved(self, mutant: Mutant) -> bool:
        """Tell whether a mutant is proved to do what the device does."""
        try:
            if mutant.place.startswith(DEFINE):
                return self._same_definition(mutant)
            return self._same_rule(mutant)
        except UnresolvedName:  # it means something only where nobody looks here
            return False

    def left_open(self, mutant: Mutant) -> bool:
        """Tell whether a mutant is proved to do what the device does but where the texts end."""
        self._gaps_differ = False
        try:
            return self.proved(mutant)
        finally:
            self._gaps_differ = True

    # --- what can happen --------------------------------------------------------------------------

    def _explore(self) -> None:
        """Find the rules that can fire and the states that they lead to, from power-on."""
        moments = {target: self._moment(target) for target in self._rows}
        grown = True
        while grown:
            grown = False
            for (machine, name), rows in self._rows.items():
                if not self._comes((machine, name)):
                    continue
                moment = moments[machine, name]
                for row in rows:
                    if isinstance(row, ir.Gap):
                        continue
                    enabled = self._enabled(row, moment)
                    if (machine, row.name) not in self._live:
                        if not self._can(enabled):
                            continue
                        self._live[machine, row.name] = row
                        if row.target is not None:
                            self._reached[machine].add(row.target)
                        grown = True
                    grown |= self._learned(row, enabled, moment)
                    self._known = self._facts()

    def _held_at_first(self) -> dict[str, set[bool]]:
        """Give the truths that variables hold at power-on, of those that nothing but rules sets."""
        model = self._meaning.model
        observed = {into for frame in model.replies.values() for _, into in frame.values()}
        return {
            slot: {bool(model.initial.slots[model.slots[slot]])}
            for machine in self._built.machines.values()
            for variable in machine.variables
            if (slot := f"{machine.name}.{variable.name}") not in observed
            and isinstance(variable.type, ir.Bool)
        }

    def _learned(self, row: ir.Rule, enabled: Term, moment: Moment) -> bool:
        """Take in what truths a rule may set; tell whether there is a new one."""
        machine = moment.scope.machine or ""
        grown = False
        late = () if row.after is None else row.after.updates
        for update in (*row.updates, *late):
            held = self._held.get(slot := _slot(update, machine))
            for truth in () if held is None else {True, False} - held:
                meant: Meant = ANY
                if update not in late:
                    meant = self._meaning.value(update.value, moment, ir.Bool())
                unknown = isinstance(meant, Content | Anything)
                if unknown or self._can(enabled, equal(cast("Term", meant), truth)):
                    self._held[slot].add(truth)
                    grown = True
        return grown

    def _rests_in(self, machine: Machine) -> set[str]:
        """Give the states of a machine in which nothing is left to do that a rule gave.

        A rule that gives its machine an event which is taken in any case is not the last one.
        """
        found = {machine.initial}
        for rule in machine.rules:
            if (machine.name, rule.name) in self._live:
                ends = rule.sources if rule.target is None else (rule.target,)
                found |= {s for s in ends if not self._goes_on(machine.name, rule, s)}
        return found

    def _goes_on(self, machine: str, rule: ir.Rule, state: str) -> bool:
        """Tell whether a rule that leads to a state gives an event that is taken there."""
        for event in _given_at_once(rule):
            owner, _, name = event.partition(".")
            if owner == machine:
                moment = self._moment((owner, name))
                none = [negated(self._enabled(row, moment)) for row in self._rows[owner, name]]
                here = any_of(equal(self._state(owner), n) for n in self._numbers(owner, {state}))
                if not self._can(here, *none):
                    return True
        return False

    def _forgets(self, machine: Machine) -> bool:
        """Tell whether each input that comes to a machine at rest is taken alike in every state.

        Each leads to a state that does not depend on the one before, and nobody asks for that.
        """
        every = set(machine.states)
        if self._asked_for(machine.name):
            return False
        return all(
            isinstance(row, ir.Rule) and every <= set(row.sources) and row.target is not None
            for source in machine.inputs
            if self._comes_at_rest((machine.name, source.name))
            for row in self._rows[machine.name, source.name]
        )

    def _comes_at_rest(self, target: Target) -> bool:
        """Tell whether an input may come but from rules of the machine itself, at once."""
        machine, name = target
        event = ".".join(target)
        source = next(i for i in self._built.machines[machine].inputs if i.name == name)
        if source.kind not in _INSIDE:
            return True
        givers = {giver for (giver, _), rule in self._live.items() if event in _given(rule)}
        later = any(event == late.target for rule in self._live.values() for late in rule.laters)
        return self._comes(target) and (givers != {machine} or later)

    def _comes(self, target: Target) -> bool:
        """Tell whether an input can come, as far as is known."""
        machine, name = target
        source = next(i for i in self._built.machines[machine].inputs if i.name == name)
        if source.kind not in _INSIDE:
            return True
        event = f"{machine}.{name}"
        fetched = self._meaning.model.fetched
        if event in self._raisable or target == (fetched.machine, fetched.input):
            return True
        return any(event in _given(rule) for rule in self._live.values())

    def _facts(self) -> tuple[Term, ...]:
        """Give what is known of all machines: the states that they can be in."""
        return tuple(
            any_of(equal(self._state(name), value) for value in self._numbers(name, reached))
            for name, reached in self._reached.items()
            if reached != set(self._built.machines[name].states)
        ) + tuple(
            equal(cast("Term", self._world.get(slot)), min(held))
            for slot, held in self._held.items()
            if len(held) == 1
        )

    def _before(self, target: Target) -> tuple[Term, ...]:
        """Give what is known when an input comes from outside: what rules gave before is done."""
        machine, name = target
        source = next(i for i in self._built.machines[machine].inputs if i.name == name)
        if source.kind not in _OUTSIDE or not self._delivered_alone:
            return ()
        return tuple(
            any_of(equal(self._state(other), n) for n in self._numbers(other, resting))
            for other, resting in self._resting.items()
        )

    def _state(self, machine: str, world: World | None = None) -> Term:
        state = (world or self._world).get(f"{machine}.state")
        assert not isinstance(state, Content | Anything)
        return state

    def _numbers(self, machine: str, names: Collection[str]) -> list[int]:
        values = self._meaning.model.state_names(machine)
        return [value for value, name in values.items() if name in names]

    # --- questions --------------------------------------------------------------------------------

    def _moment(self, target: Target) -> Moment:
        return Moment(self._world, Scope(*target), ".".join(target), {})

    def _ways(self, target: Target) -> Iterator[list[tuple[Moment, tuple[Term, ...]]]]:
        """Yield the ways in which an input comes, with what is known then: vaguely, then as met."""
        yield [(self._moment(target), self._before(target))]
        if not any(RuleName(target[0], row.name) in self._further for row in self._rows[target]):
            yield [
                (
                    meeting.moment,
                    (*meeting.conditions, *self._before(_root(meeting))),
                )
                for meeting in self._met
                if _target_of(meeting) == target
            ]

    def _enabled(self, row: Row, moment: Moment) -> Term:
        return self._chains.enabled(row, self._machine(moment), moment)

    def _machine(self, moment: Moment) -> Machine:
        return self._built.machines[moment.scope.machine or ""]

    def _can(self, *terms: Term) -> bool:
        """Tell whether all can hold together; what the solver does not find out can."""
        return self._solver.ask((*self._known, *terms)) is not Answer.NO

    def _differ(self, one: Meant, other: Meant) -> Term:
        """Give what holds where two values may differ."""
        if isinstance(one, Content) and isinstance(other, Content):
            return one.name != other.name
        if isinstance(one, Content | Anything) or isinstance(other, Content | Anything):
            return True
        return negated(equal(one, other))

    # --- rules ------------------------------------------------------------------------------------

    def _same_rule(self, mutant: Mutant) -> bool:
        machine, _, name = mutant.place.partition(".")
        if (machine, name) not in self._live and not mutant.checks:
            return True
        (wrong,) = (r for r in mutant.protocol.machines[machine].rules if r.name == name)
        target = machine, wrong.input
        if not self._comes(target):
            return True
        if mutant.checks and self._unsure(wrong):
            return False
        rows = self._rows[target]
        others = tuple(row for row in rows if row.name != name)
        return self._same(target, rows, (wrong, *others))

    def _unsure(self, row: ir.Rule) -> bool:
        """Tell whether a guard may be neither true nor false to the device.

        Of several such rows it takes the first one, and a wrong rule stands before the others.
        """
        names = definitions_in(self._built, row.guard)
        parts = (row.guard, *(self._built.definitions[name].value for name in names))
        calls = (node.function for node in nodes_in(parts) if isinstance(node, ir.Call))
        return not _UNSURE.isdisjoint(calls)

    def _same_definition(self, mutant: Mutant) -> bool:
        name = mutant.place.removeprefix(DEFINE)
        old, new = (p.definitions[name].value for p in (self._built, mutant.protocol))
        if SHOWN in mutant.machines and self._can(
            self._unlike(old, new, Moment(self._world, Scope(), "shown", {}))
        ):
            return False
        for target, rows in self._rows.items():
            if not self._comes(target):
                continue
            wrong = tuple(self._with(row, name, new) for row in rows)
            moment = self._moment(target)
            for row in rows:
                if isinstance(row, ir.Gap) or (target[0], row.name) not in self._live:
                    continue
                rest = replace(row, guard=None)
                if name not in definitions_in(self._built, rest):
                    continue
                # what follows a frame is looked at later, in whatever state there is then
                late = row.after is not None and name in definitions_in(self._built, row.after)
                if late and self._can(self._unlike(old, new, moment)):
                    return False
                if not late and not self._same_in(row, target, old, new):
                    return False
            if any(a is not b for a, b in zip(rows, wrong, strict=True)) and not self._same(
                target, rows, wrong
            ):
                return False
        return True

    def _same_in(self, row: Row, target: Target, old: ir.Expression, new: ir.Expression) -> bool:
        """Tell whether two expressions are alike where a row takes its input."""
        return any(
            not any(
                self._can(*known, self._enabled(row, moment), self._unlike(old, new, moment))
                for moment, known in ways
            )
            for ways in self._ways(target)
        )

    def _unlike(self, old: ir.Expression, new: ir.Expression, moment: Moment) -> Term:
        """Give what holds where two expressions may differ; of the same alternatives in each."""
        if old == new:
            return False
        if isinstance(old, ir.Conditional) and isinstance(new, ir.Conditional):
            one, other = (self._meaning.truth(each.condition, moment) for each in (old, new))
            thens = self._unlike(old.then, new.then, moment)
            elses = self._unlike(old.otherwise, new.otherwise, moment)
            return any_of(
                (
                    negated(equal(one, other)),
                    all_of((one, thens)),
                    all_of((negated(one), elses)),
                )
            )
        return self._differ(*(self._meaning.value(each, moment, None) for each in (old, new)))

    def _with(self, row: Row, name: str, value: ir.Expression) -> Row:
        """Give a row whose guard has another definition; the row itself where it has not."""
        if row.guard is None or name not in definitions_in(self._built, row.guard):
            return row
        return replace(row, guard=_inlined(self._built, row.guard, name, value))

    def _same(self, target: Target, rows: tuple[Row, ...], wrong: tuple[Row, ...]) -> bool:
        """Tell whether the first of the wrong rows that fires does what the right one does."""
        return any(
            all(self._same_at(moment, known, rows, wrong) for moment, known in ways)
            for ways in self._ways(target)
        )

    def _same_at(
        self,
        moment: Moment,
        first: tuple[Term, ...],
        rows: tuple[Row, ...],
        wrong: tuple[Row, ...],
    ) -> bool:
        right = [(row, self._enabled(row, moment)) for row in rows]
        ways: list[tuple[Row | None, Term]] = []
        before: list[Term] = []
        for row in wrong:
            here = self._enabled(row, moment)
            ways.append((row, all_of((here, *before))))
            before.append(negated(here))
        ways.append((None, all_of(before)))
        known = [*right, (None, all_of(negated(here) for _, here in right))]
        return not any(
            self._can(*first, here, there, self._unlike_effects(one, other, moment))
            for one, here in known
            for other, there in ways
            if one is not other
            and not (one in wrong and other in rows)
            and (self._gaps_differ or not isinstance(one, ir.Gap))
        )

    def _unlike_effects(self, one: Row | None, other: Row | None, moment: Moment) -> Term:
        """Give what holds where two rows may do something different."""
        if self._effects(one) != self._effects(other):
            return True
        if None in {one, other} and self._delivered(moment):
            return True
        parts: list[Term] = []
        machine = moment.scope.machine or ""
        goes_on = any(f.startswith(f"{machine}.") for r in (one, other) for f in _next(r))
        asked = goes_on or machine not in self._forgetful
        for source in self._built.machines[machine].states if asked else ():
            ends = _target(one, source), _target(other, source)
            if ends[0] != ends[1] and not self._meet_again(machine, one, ends):
                (value,) = self._numbers(machine, {source})
                parts.append(equal(self._state(machine, moment.world), value))
        changes = [self._changed(row, moment) for row in (one, other)]
        for slot in changes[0].keys() | changes[1].keys():
            if not _alike(one, other, slot):
                was = moment.world.get(slot)
                parts.append(self._differ(*(change.get(slot, was) for change in changes)))
        return any_of(parts)

    def _meet_again(self, machine: str, row: Row | None, states: tuple[str, str]) -> bool:
        """Tell whether what a row gives next leads to one state from both, and nobody asks."""
        given = (
            (*row.gives, *(row.after.gives if row.after else ()))
            if isinstance(row, ir.Rule)
            else ()
        )
        own = [give.target for give in given if give.target.startswith(f"{machine}.")]
        if not own or self._asked_for(machine):
            return False
        rows = self._rows[machine, own[0].partition(".")[2]]
        taking = [row for row in rows if not set(states).isdisjoint(row.sources)]
        if any(
            isinstance(row, ir.Gap) or row.target is None or not set(states) <= set(row.sources)
            for row in taking
        ):
            return False
        moment = self._moment((machine, own[0].partition(".")[2]))
        there = any_of(equal(self._state(machine), n) for n in self._numbers(machine, states))
        return not self._can(there, *(negated(self._enabled(row, moment)) for row in taking))

    def _asked_for(self, machine: str) -> bool:
        """Tell whether any part of the texts asks for the state of a machine."""
        return f"{machine}.state" in self._named

    @cached_property
    def _named(self) -> frozenset[str]:
        """Give all names that the texts speak of."""
        built = self._built
        rows = (row for each in built.machines.values() for row in rows_of(each))
        shown = (*built.registers.values(), *built.words.values(), *built.frames.values())
        parts = (*built.definitions.values(), *shown, *rows)
        return frozenset(node.path for node in nodes_in(parts) if isinstance(node, ir.Name))

    def _effects(self, row: Row | None) -> tuple[object, ...]:
        """Give what a row does beside its target and what it sets; its time limit is none of it."""
        if not isinstance(row, ir.Rule):
            return ((), (), (), None, None, ())
        sends = tuple(
            (send.frame, tuple((name, _chosen(value)) for name, value in send.fields))
            for send in row.sends
        )
        gives = tuple(give for give in row.gives if not self._in_vain(give.target))
        return (row.stores, sends, gives, row.after, row.take, row.laters)

    def _in_vain(self, event: str) -> bool:
        """Tell whether all that an event does is to change a state that makes no difference."""
        machine, _, name = event.partition(".")
        return machine in self._forgetful and all(
            isinstance(row, ir.Rule)
            and (row.after, row.take) == (None, None)
            and not (row.updates or row.stores or row.sends or row.gives or row.laters)
            for row in self._rows[machine, name]
        )

    def _delivered(self, moment: Moment) -> bool:
        """Tell whether an input is a message that the mailbox hands on, which has to be taken."""
        machine = self._machine(moment)
        source = next(i for i in machine.inputs if i.name == moment.scope.input)
        return source.kind == InputKind.FRAME and machine.name != MAILBOX

    def _changed(self, row: Row | None, moment: Moment) -> dict[str, Meant]:
        """Give what a row sets, by slot."""
        changes: dict[str, Meant] = {}
        for update in _updates(row):
            slot = _slot(update, moment.scope.machine or "")
            kind = self._meaning.kinds[slot]
            meant = self._meaning.value(_taken(update.value), moment, kind)
            open_ = isinstance(update.value, ir.AnyValue)
            changes[slot] = ANY if open_ and isinstance(meant, Content) else meant
        return changes


def _target_of(meeting: Meeting) -> Target:
    scope = meeting.moment.scope
    return scope.machine or "", scope.input or ""


def _root(meeting: Meeting) -> Target:
    """Give the input from outside that led to another, or was it."""
    scope = meeting.fired[0][1].scope if meeting.fired else meeting.moment.scope
    return scope.machine or "", scope.input or ""


def _alike(one: Row | None, other: Row | None, slot: str) -> bool:
    """Tell whether two rows set a slot in the same words."""
    names = {slot, slot.rpartition(".")[2]}
    said = [[u.value for u in _updates(row) if u.variable in names] for row in (one, other)]
    return said[0] == said[1]


def _updates(row: Row | None) -> tuple[Update, ...]:
    return row.updates if isinstance(row, ir.Rule) else ()


def _taken(value: ir.Expression) -> ir.Expression:
    """Give what the device takes for a number where the texts leave it open."""
    return value.preferred if isinstance(value, ir.AnyValue) and value.preferred else value


def _slot(update: Update, machine: str) -> str:
    return update.variable if "." in update.variable else f"{machine}.{update.variable}"


def _target(row: Row | None, source: str) -> str:
    if not isinstance(row, ir.Rule) or row.target is None:
        return source
    return row.target


def _chosen(value: ir.Expression) -> ir.Expression:
    """Give what the device sends for a field: of several values that may be the first."""
    match value:
        case ir.OneOf(items=(first, *_), excluded=None):
            return _chosen(first.low if isinstance(first, ir.Range) else first)
        case ir.Conditional(then=then, otherwise=otherwise):
            one, other = _chosen(then), _chosen(otherwise)
            return one if one == other else replace(value, then=one, otherwise=other)
        case _:
            return value


def _next(row: Row | None) -> set[str]:
    return _given_at_once(row) if isinstance(row, ir.Rule) else set()


def _given(rule: ir.Rule) -> set[str]:
    """Give the events that a rule gives, at once or later."""
    return _given_at_once(rule) | {later.target for later in rule.laters}


def _given_at_once(rule: ir.Rule) -> set[str]:
    """Give the events that a rule gives before anything else can come."""
    given = {give.target for give in rule.gives}
    return given if rule.after is None else given | {give.target for give in rule.after.gives}


def _inlined(
    protocol: Protocol, node: ir.Expression, name: str, value: ir.Expression
) -> ir.Expression:
    """Give an expression with other words in the place of a definition, however deep it is."""
    if isinstance(node, ir.Name):
        if node.path == name:
            return value
        inner = protocol.definitions.get(node.path)
        if inner is None or name not in definitions_in(protocol, inner.value):
            return node
        return _inlined(protocol, inner.value, name, value)
    changes: dict[str, Any] = {}
    for field in fields(node):
        part = getattr(node, field.name)
        if isinstance(part, tuple):
            new: Any = tuple(_part(protocol, item, name, value) for item in part)
        else:
            new = _part(protocol, part, name, value)
        if new is not part and new != part:
            changes[field.name] = new
    return replace(cast("Any", node), **changes) if changes else node


def _part(protocol: Protocol, part: object, name: str, value: ir.Expression) -> object:
    if isinstance(part, ir.Range):
        low, high = (_inlined(protocol, end, name, value) for end in (part.low, part.high))
        return replace(part, low=low, high=high)
    if isinstance(part, ir.Expression):
        return _inlined(protocol, part, name, value)
    return part
