"""Finds what a device can never reach, by what its own text fixes.

All that may change is taken as unknown: registers, variables, objects that are no constants,
conditions, open choices. Left are the pins, the entries that the device has, and the words that it
lacks. A rule whose guard is false then in every state that was reached, or whose input nothing
gives, cannot be reached either; what is called so no run goes by, and no solver is asked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.model.analysis.citations import Foundations, citations
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.compiled import paths_in, rows_of
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.interpreter import DELIVER, RESEND
from ecatspec.model.core.memo import once
from ecatspec.model.core.object_dictionary import CROWDED
from ecatspec.model.core.process_image import OUTPUTS
from ecatspec.model.core.state import RuleName
from ecatspec.model.core.values import UNKNOWN, Numbers, Pattern, Unknown
from ecatspec.spec.language.ir import InputKind
from ecatspec.spec.language.nodes import names_in

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.model.core.compiled import CompiledRule
    from ecatspec.model.core.expressions import Function
    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import Gap, Input, Machine, Protocol, Rule

_UNDECLARED: Final = Unknown()
"""An index that no text declares, or a subindex that none declares of its object."""
_ENTRY: Final = ("index", "subindex")
"""How the parameters of inputs are named that say which entry is meant."""
_RANGE: Final = frozenset({"in_range", "too_high", "too_low"})
_OF_RULES: Final = frozenset(
    {
        *("rule", "gap", "define", "reason", "property", "frame", "field", "row"),
        *("choice", "condition", "parameter", "register", "word"),
    }
)
"""Kinds of declarations that `Foundations` finds with all that rests on them."""

_Place = tuple[str, str]
_Parameters = dict[str, "Value"]


@once
def rules_beyond(model: Model, ways: frozenset[tuple[str, str]]) -> frozenset[str]:
    """Give the rules and gaps that a device of these texts cannot reach, by their dotted name.

    `ways` are those at choices that are taken for granted beside the pins.
    """
    protocol = model.protocol
    reached = _Reach(protocol, dict(ways), closed=model.dictionary.closed).rules()
    names = (f"{m.name}.{row.name}" for m in protocol.machines.values() for row in rows_of(m))
    return frozenset(names) - reached


@once
def clauses_beyond(model: Model, rules: frozenset[str]) -> frozenset[str]:
    """Give the clauses on which these rules rest, and nothing else that a device can show."""
    foundations = Foundations(model.protocol).of
    theirs = {clause for rule in rules for clause in foundations[rule]}
    others = {c for name, found in foundations.items() if name not in rules for c in found}
    cited = citations(model.protocol)
    said = {c for each in cited if each.kind not in _OF_RULES for c in each.clauses}
    return frozenset(theirs - others - said)


class _Vague(Model):
    """A model whose functions know nothing of what is not known."""

    def functions(self) -> Mapping[str, Function]:
        found = super().functions()
        return {name: self._vague(name, function) for name, function in found.items()}

    def _vague(self, name: str, function: Function) -> Function:
        def vague(environment: Environment, arguments: tuple[Value, ...]) -> Value:
            if name in {"declared", "object_exists"} and any(a is _UNDECLARED for a in arguments):
                return False
            unknown = [isinstance(argument, Pattern) for argument in arguments]
            if not any(unknown):
                return function(environment, arguments)
            if name in _RANGE and not any(unknown[:2]):
                known = self.dictionary.functions["range_known"](environment, arguments)
                return UNKNOWN if known is not False else name == "in_range"
            return UNKNOWN

        return vague


class _Reach:
    """The states, inputs and rules that were reached so far."""

    def __init__(self, protocol: Protocol, ways: Mapping[str, str], *, closed: bool) -> None:
        self._model = model = _Vague(protocol, closed=closed)
        self._states = {
            machine.name: {model.row(machine.table, machine.initial)}
            for machine in protocol.machines.values()
        }
        self._given: dict[_Place, _Parameters] = {}
        """The parameters of the inputs that something gives, as far as all who give agree."""
        self._reached: set[RuleName] = set()
        self._slots = list(self._unknown(ways))
        for machine in protocol.machines.values():
            for source in machine.inputs:
                if self._comes(machine, source):
                    self._took((machine.name, source.name), {})
        self._entries = tuple(self._places())
        self._fruitless: dict[RuleName, bool] = {}

    def rules(self) -> frozenset[str]:
        """Give the rules and gaps that are reached."""
        changed = True
        while changed:
            changed = False
            for machine in self._model.protocol.machines.values():
                for row in rows_of(machine):
                    changed |= self._tried(machine, row)
        return frozenset(map(str, self._reached))

    # --- at power-on ------------------------------------------------------------------------------

    def _unknown(self, ways: Mapping[str, str]) -> Iterator[Value | None]:
        """Yield what the slots hold for good, and of all others that it is not known."""
        model = self._model
        words = {f"word {word.name}" for word in model.words.values()}
        for name, value in zip(model.slots, model.initial.slots, strict=True):
            kind, _, rest = name.partition(" ")
            if kind == "choice":
                yield ways.get(rest) if value is None else value
            else:
                yield value if kind == "word" and name not in words else UNKNOWN

    def _comes(self, machine: Machine, source: Input) -> bool:
        """Tell whether an input comes from outside of the machines, or by itself."""
        model = self._model
        match source.kind:
            case "event":
                event = model.fetched
                return (machine.name, source.name) == (event.machine, event.input)
            case "frame":
                return machine.name == model.fetched.machine
            case "word":
                return any(word.name in source.origin for word in model.words.values())
            case "outputs":
                return model.image.layout(Environment((), {}, {}), OUTPUTS) != ()
            case "own":
                return self._is_there(machine)
            case _:
                return True

    def _is_there(self, machine: Machine) -> bool:
        """Tell whether the device has one of the words that move a machine or show it, if any."""
        model = self._model
        its = {name for i in machine.inputs if i.kind == InputKind.WORD for name in i.origin}
        for word in model.protocol.words.values():
            shows = (field.shows.value for field in word.fields if field.shows is not None)
            if any(
                path.startswith(f"{machine.name}.") for each in shows for path in names_in(each)
            ):
                its.add(word.name)
        return not its or any(word.name in its for word in model.words.values())

    def _places(self) -> Iterator[_Parameters]:
        """Yield all entries, each object with a subindex that it lacks, and no object."""
        entries = self._model.dictionary.entries
        for key in entries:
            yield dict(zip(_ENTRY, key, strict=True))
        for index in dict.fromkeys((index for index, _ in entries)):
            yield dict(zip(_ENTRY, (index, _UNDECLARED), strict=True))
        yield dict.fromkeys(_ENTRY, _UNDECLARED)

    # --- one rule ---------------------------------------------------------------------------------

    def _tried(self, machine: Machine, row: Rule | Gap) -> bool:
        """Take a rule as fired where it may; tell whether that led to anything new."""
        parameters = self._given.get((machine.name, row.input))
        if parameters is None or self._never(machine, row):
            return False
        rule = self._model.named(RuleName(machine.name, row.name))
        changed = False
        for state in sorted(rule.sources & self._states[machine.name]):
            slots = self._present(machine.name, state)
            if self._holds(row, rule, slots, parameters):
                changed |= rule.name not in self._reached
                self._reached.add(rule.name)
                changed |= self._led(machine, row, rule, Environment(slots, {}, parameters))
        return changed

    def _present(self, machine: str, state: int) -> tuple[Value | None, ...]:
        """Give the slots with a machine in one state, and the others in any that was reached."""
        slots = list(self._slots)
        for name, reached in self._states.items():
            values = {state} if name == machine else reached
            among = Numbers(tuple((value, value) for value in sorted(values)))
            one = min(values) if len(values) == 1 else among
            slots[self._model.slots[f"{name}.state"]] = one
        return tuple(slots)

    def _holds(
        self,
        row: Rule | Gap,
        rule: CompiledRule,
        slots: tuple[Value | None, ...],
        parameters: _Parameters,
    ) -> bool:
        """Tell whether the guard of a rule may hold, for one of the entries if it asks for one."""
        guard = rule.guard
        if guard is None:
            return True
        if guard(Environment(slots, {}, parameters)) is False:
            return False
        if rule.name in self._reached or not self._asks(row):
            return True
        known = {name: value for name, value in parameters.items() if value != UNKNOWN}
        return any(
            guard(Environment(slots, {}, parameters | place | known)) is not False
            for place in self._entries
        )

    def _asks(self, row: Rule | Gap) -> bool:
        """Tell whether a guard asks for an entry."""
        if row.guard is None:
            return False
        return not set(_ENTRY).isdisjoint(paths_in(self._model.protocol, row.guard))

    def _never(self, machine: Machine, row: Rule | Gap) -> bool:
        """Tell whether no entry lets the guard of a rule hold, whatever else may be."""
        rule = RuleName(machine.name, row.name)
        if rule not in self._fruitless:
            guard = self._model.named(rule).guard
            slots = tuple(self._slots)
            self._fruitless[rule] = (
                guard is not None
                and self._asks(row)
                and all(
                    guard(Environment(slots, {}, {CROWDED: UNKNOWN, **place})) is False
                    for place in self._entries
                )
            )
        return self._fruitless[rule]

    def _led(
        self, machine: Machine, row: Rule | Gap, rule: CompiledRule, environment: Environment
    ) -> bool:
        """Take what follows from a rule as reached; tell whether anything of it is new."""
        states = self._states[machine.name]
        before = len(states)
        if rule.target is not None:
            states.add(rule.target)
        if rule.gap and machine.name in self._model.worded:
            states.update(self._model.state_names(machine.name))
        given = [*rule.gives, *(() if rule.later is None else rule.later.gives)]
        given += [(f"{t.machine}.{t.input}", t.arguments) for t in rule.timers]
        changed = len(states) > before
        for target, arguments in given:
            if target == DELIVER:
                changed |= self._delivered(machine, row)
            elif target != RESEND:
                owner, _, name = target.partition(".")
                values = {name: getter(environment) for name, getter in arguments}
                changed |= self._took((owner, name), values)
        return changed

    def _delivered(self, machine: Machine, row: Rule | Gap) -> bool:
        """Take the inputs of other machines as reached whose frames lie in that of a rule."""
        source = next(i for i in machine.inputs if i.name == row.input)
        trail = self._model.codec.trail
        changed = False
        for other in self._model.protocol.machines.values():
            for each in other.inputs if other is not machine else ():
                within = (not set(source.origin).isdisjoint(trail(o)) for o in each.origin)
                if each.kind == "frame" and any(within):
                    changed |= self._took((other.name, each.name), {})
        return changed

    def _took(self, place: _Place, values: _Parameters) -> bool:
        """Take an input as given with these parameters; tell whether that is new."""
        before = self._given.get(place)
        after: _Parameters = dict.fromkeys((CROWDED, *values, *(before or ())), UNKNOWN)
        for name, value in values.items():
            if not isinstance(value, Pattern) and (before is None or before.get(name) == value):
                after[name] = value
        self._given[place] = after
        return after != before
