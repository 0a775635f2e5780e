"""Searches from power-on for the rules and states that can be reached, and how.

Worlds hold symbols, so that one trace stands for all inputs of its kind. The search goes breadth
first and keeps a world where a rule fired for the first time or a pair of machines came to states
in which they were not yet. What it finds the interpreter has to repeat.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ecatspec.model.core.compiled import rows_of
from ecatspec.model.core.interpreter import DELIVER, afterwards, expected_fields, later_fields, step
from ecatspec.model.core.state import Event, RuleName
from ecatspec.model.core.values import concrete
from ecatspec.model.core.wording import typed_words
from ecatspec.model.symbolic.concretisation import Example
from ecatspec.model.symbolic.renewed_solver import ForgetfulSolver
from ecatspec.model.symbolic.symbolic_execution import Chains
from ecatspec.model.symbolic.symbolic_state import Chain, Content, Fired
from ecatspec.model.symbolic.terms import Answer, key_of
from ecatspec.spec.language.functions import REPLY
from ecatspec.spec.language.ir import Bool, InputKind, Literal, Rule

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from collections.abc import Set as AbstractSet

    from ecatspec.model.core.state import State
    from ecatspec.model.core.values import Value
    from ecatspec.model.symbolic.smt_encoding import Meaning
    from ecatspec.model.symbolic.symbolic_state import Meant, Moment, World
    from ecatspec.model.symbolic.terms import Term, Values
    from ecatspec.spec.language.ir import Gap

DEPTH: Final = 12
"""Maximum number of inputs of a trace."""
_NODES: Final = 600
_PATIENCE: Final = 30
"""Maximum number of worlds examined in a row without a rule that fires for the first time."""
_TRIES: Final = 5
"""Maximum number of tries of a rule in the same states of all machines, from different worlds."""


@dataclass(frozen=True, slots=True)
class Way:
    """A trace: for every input the world that it came to, and the chain of rules that took it."""

    world: World
    conditions: tuple[Term, ...]
    steps: tuple[tuple[World, Chain], ...] = ()


@dataclass(frozen=True, slots=True)
class Trace:
    """A trace with values: what was found, and where the interpreter ends."""

    lines: tuple[str, ...]
    length: int
    states: tuple[State, ...]
    """Where the interpreter ends that goes the same way; empty where it does not."""


class Search:
    """The search of one specification."""

    def __init__(self, meaning: Meaning) -> None:
        """Begin at power-on."""
        self.meaning = meaning
        self._solver = ForgetfulSolver(meaning.symbols)
        self._start = meaning.power_on()
        self._machines = tuple(meaning.protocol.machines)
        self._missing: set[RuleName] = set()
        self._relevant: frozenset[str] = frozenset()
        self._tried: dict[tuple[object, ...], int] = {}
        self._seen: set[frozenset[tuple[str, str]]] = set()
        self._truths: frozenset[str] = frozenset()
        self._words: dict[tuple[str, str], tuple[str, ...]] = {}
        self._chains = Chains(meaning, self._possible, wanted=self._wanted)

    def _possible(self, conditions: tuple[Term, ...]) -> bool:
        return self._solver.ask(conditions) is Answer.YES

    # --- rules and states -------------------------------------------------------------------------

    def cover(self, rules: AbstractSet[RuleName]) -> dict[RuleName, Way]:
        """Give for every rule that is reached the way to it, as short as any that was tried."""
        found: dict[RuleName, Way] = {}
        for machine in self.meaning.protocol.machines:
            self._missing = {rule for rule in rules if rule.machine == machine} - set(found)
            self._relevant = self._related(machine)
            self._truths = frozenset(
                f"{machine}.{variable.name}"
                for variable in self.meaning.protocol.machines[machine].variables
                if isinstance(variable.type, Bool)
            )
            self._words = {
                (machine, source.name): tuple(self._written_fields(source.origin))
                for source in self.meaning.protocol.machines[machine].inputs
                if source.kind == InputKind.WORD
            }
            self._seen.clear()
            self._tried.clear()
            found |= self._covered()
        return found

    def _written_fields(self, words: tuple[str, ...]) -> Iterator[str]:
        """Yield one field of each word, which tells whether the word was written."""
        for word in words:
            yield f"word {word}.{self.meaning.protocol.words[word].fields[0].name}"

    def _covered(self) -> dict[RuleName, Way]:
        found: dict[RuleName, Way] = {}
        self._novel(self._start)
        work = deque([Way(self._start, ())])
        nodes = 1
        idle = 0
        while work and self._missing and idle < _PATIENCE:
            way = work.popleft()
            idle += 1
            for after in self._onward(way):
                chain = after.steps[-1][1]
                fired = {name for name, _ in chain.fired}
                for name in fired - set(found):
                    found[name] = after
                new = fired & self._missing
                self._missing -= new
                idle = 0 if new else idle
                novel = self._novel(chain.world)
                fresh = novel or (new and self._changed(way.world, chain.world))
                if fresh and len(after.steps) < DEPTH and nodes < _NODES and not chain.gap:
                    work.append(after)
                    nodes += 1
        return found

    def _related(self, machine: str) -> frozenset[str]:
        """Give the machines on which it depends: those that its guards read or that give to it."""
        found: set[str] = set()
        work = [machine]
        while work:
            name = work.pop()
            if name not in found:
                found.add(name)
                work += self._chains.neighbours(name)
        return frozenset(found)

    def states(self, found: dict[RuleName, Way]) -> dict[tuple[str, str], Way]:
        """Give for every state of a machine the shortest of some ways that goes through it."""
        reached: dict[tuple[str, str], Way] = {
            (machine.name, machine.initial): Way(self._start, ())
            for machine in self.meaning.protocol.machines.values()
        }
        for way in sorted(found.values(), key=lambda way: len(way.steps)):
            for number, (_, chain) in enumerate(way.steps):
                for name, _ in chain.fired:
                    rule = _row(self.meaning, name)
                    if isinstance(rule, Rule) and rule.target is not None:
                        part = Way(chain.world, chain.conditions, way.steps[: number + 1])
                        reached.setdefault((name.machine, rule.target), part)
        return reached

    def _onward(self, way: Way) -> Iterator[Way]:
        key = f"{len(way.steps) + 1}"
        for machine, name in self._chains.roots():
            if not self._missing & self._chains.beneath(machine, name) and not self._moves(
                machine, name, way.world
            ):
                continue
            world, arrival = self._chains.arrive(way.world, machine, name, anew=True, key=key)
            for chain in self._chains.run(world, arrival, way.conditions):
                yield Way(chain.world, chain.conditions, (*way.steps, (world, chain)))

    def _changed(self, before: World, after: World) -> bool:
        """Tell whether a machine has another state or another variable."""
        return any(
            _identity(value) != _identity(before.get(slot))
            for slot, value in after.changed.items()
            if not slot.startswith(("register ", "word "))
        )

    def _wanted(self, machine: str, row: Rule | Gap, world: World, fired: Fired) -> bool:
        if any(self._worthy(name, moment.world) for name, moment in fired):
            return True  # what was begun is brought to its end
        if self._bystander(machine, row, fired):
            return True
        wanted = self._missing & {RuleName(machine, row.name), *self._chains.led_to(machine, row)}
        if wanted:
            place = tuple(self._places(world).items())
            tried = self._tried.setdefault((machine, row.name, place), 0)
            self._tried[machine, row.name, place] += 1
            if tried < _TRIES * len(wanted):
                return True
        return isinstance(row, Rule) and self._leads_on(machine, row, world)

    def _bystander(self, machine: str, row: Rule | Gap, fired: Fired) -> bool:
        """Tell whether an event only has to be over before another one comes that is wanted."""
        rows = [(name.machine, _row(self.meaning, name)) for name, _ in fired]
        return (
            not self._missing & self._chains.beneath(machine, row.input)
            and not any(
                give.target == DELIVER for _, r in rows if isinstance(r, Rule) for give in r.gives
            )
            and any(self._missing & self._chains.led_to(owner, r) for owner, r in rows)
        )

    def _worthy(self, name: RuleName, world: World) -> bool:
        row = _row(self.meaning, name)
        return name in self._missing or (
            isinstance(row, Rule) and self._leads_on(name.machine, row, world)
        )

    def _moves(self, machine: str, name: str, world: World) -> bool:
        rules = self.meaning.protocol.machines[machine].rules
        return any(rule.input == name and self._leads_on(machine, rule, world) for rule in rules)

    def _leads_on(self, machine: str, rule: Rule, world: World) -> bool:
        """Tell whether the rule brings about a pair of places that was not seen together."""
        after: dict[str, str] = {}
        if rule.target is not None and machine in self._relevant:
            names = {name: value for value, name in self.meaning.model.state_names(machine).items()}
            after[machine] = str(names[rule.target])
        for update in rule.updates:
            slot = update.variable if "." in update.variable else f"{machine}.{update.variable}"
            if slot in self._truths and isinstance(update.value, Literal):
                after[slot] = str(update.value.value)
        for word in self._words.get((machine, rule.input), ()):
            after[word] = str(True)
        if not after:
            return False
        places = self._places(world) | after
        return any(
            _pair((one, value), (other, places[other])) not in self._seen
            for one, value in after.items()
            for other in places
        )

    def _places(self, world: World) -> dict[str, str]:
        """Give where the machines are that matter, and the truths of the one that is searched."""
        found = {machine: self._control(world, machine) for machine in sorted(self._relevant)}
        for slot in self._truths:
            value = world.get(slot)
            if isinstance(value, bool):
                found[slot] = str(value)
        for words in self._words.values():
            for word in words:
                found[word] = str(not isinstance(world.get(word), int))
        return found

    def _control(self, world: World, machine: str) -> str:
        state = world.get(f"{machine}.state")
        return str(_identity(state))

    def _novel(self, world: World) -> bool:
        places = self._places(world)
        pairs = {_pair(one, other) for one in places.items() for other in places.items()}
        new = pairs - self._seen
        self._seen |= new
        return bool(new)

    # --- a world that must not be -----------------------------------------------------------------

    def find(
        self, wrong: Callable[[World], Term], slots: frozenset[str], depth: int
    ) -> tuple[Way | None, int]:
        """Give a way to a world in which something is wrong, and how deep was looked for one.

        `slots` are what the wrong thing speaks of.
        """
        chains = Chains(
            self.meaning, self._possible, wanted=lambda m, row, *_: self._concerns(m, row, slots)
        )
        seen: set[object] = set()
        work = deque([Way(self._start, ())])
        if self._possible((wrong(self._start),)):
            return work[0], 0
        nodes = 1
        while work:
            way = work.popleft()
            if len(way.steps) >= depth or nodes > _NODES:
                return None, len(way.steps)
            for machine, name in chains.roots():
                key = f"{len(way.steps) + 1}"
                world, arrival = chains.arrive(way.world, machine, name, anew=True, key=key)
                for chain in chains.run(world, arrival, way.conditions):
                    if chain.gap:
                        continue
                    after = Way(chain.world, chain.conditions, (*way.steps, (world, chain)))
                    if self._possible((*chain.conditions, wrong(chain.world))):
                        wrong_here = (*chain.conditions, wrong(chain.world))
                        return Way(chain.world, wrong_here, after.steps), len(after.steps)
                    place = self._key(chain.world, slots)
                    if place not in seen:
                        seen.add(place)
                        work.append(after)
                        nodes += 1
        return None, depth

    def _concerns(self, machine: str, row: Rule | Gap, slots: frozenset[str]) -> bool:
        if not isinstance(row, Rule):
            return False
        own = {u.variable if "." in u.variable else f"{machine}.{u.variable}" for u in row.updates}
        if row.target is not None:
            own.add(f"{machine}.state")
        machines = {slot.partition(".")[0] for slot in slots} | {"al"}
        beneath = {name.machine for name in self._chains.led_to(machine, row)}
        return bool({slot.partition(".")[0] for slot in own} & machines or beneath & machines)

    def _key(self, world: World, slots: frozenset[str]) -> object:
        places = tuple((machine, self._control(world, machine)) for machine in self._machines)
        return places, tuple((slot, _identity(world.get(slot))) for slot in sorted(slots))

    # --- traces -----------------------------------------------------------------------------------

    def trace(self, way: Way, last: RuleName | None = None) -> Trace | None:
        """Give a way with values, and let the interpreter go it; None without values."""
        answer, values = self._solver.example(way.conditions)
        if answer is not Answer.YES or values is None:
            return None
        example = Example(self.meaning, values)
        lines = tuple(self._line(example, chain, last) for _, chain in way.steps)
        return Trace(lines, len(way.steps), self._repeat(example, way))

    def _line(self, example: Example, chain: Chain, last: RuleName | None) -> str:
        rule, moment = chain.fired[0]
        names = [name for name, _ in chain.fired]
        if last in names:
            names = names[: names.index(last) + 1]
        fired = ", ".join(map(str, names))
        parameters = _parameters(self.meaning, example, moment, values=example.values)
        return f"{rule.machine}.{moment.scope.input}({parameters}): {fired}"

    def _repeat(self, example: Example, way: Way) -> tuple[State, ...]:
        model = self.meaning.model
        state = example.state(self._start, open_choices=True)
        states = [state]
        for world, chain in way.steps:
            written = example.state(world)
            event = self._event(example, chain)
            states = [self._written(known, written, model.slots) for known in states]
            states = [
                after for known in states for after in self._followed(example, known, event, chain)
            ]
        return tuple(states)

    def _event(self, example: Example, chain: Chain) -> Event:
        """Give the input that began a chain; a frame with all that its receiver knows of it."""
        moment = chain.fired[0][1]
        event = example.event(moment)
        trail: tuple[str, ...] = ()
        for name, inner in chain.fired:
            frame = self._chains.frame(name.machine, inner.scope.input or "")
            if frame is not None:
                trail = self.meaning.model.codec.trail(frame)
                event = Event(event.machine, event.input, example.parameters(inner))
        return Event(event.machine, event.input, event.parameters, trail)

    def _written(self, state: State, written: State, slots: dict[str, int]) -> State:
        for name, slot in slots.items():
            if name.startswith(("register ", "word ")):
                state = state.having(slot, written.slots[slot])
        return state

    def _followed(
        self, example: Example, state: State, event: Event, chain: Chain
    ) -> Iterator[State]:
        """Yield the states after the interpreter fired these rules."""
        names = [name for name, _ in chain.fired]
        fields: dict[str, Value] = {
            name.removeprefix(f"{REPLY}."): example.value(meant, 0)
            for moment in chain.replies
            for name, meant in moment.parameters.items()
            if name.startswith(f"{REPLY}.")
        }
        model = self.meaning.model
        for taken in step(model, state, event):
            left = _after(names, taken.rules)
            if left is None:
                continue
            if not chain.replies or not taken.outputs:
                if not left:
                    yield taken.state
                continue
            output = taken.outputs[-1]
            expected = expected_fields(model, taken.state, output)
            whole = {n: concrete(v) for n, v in expected.items()} | fields
            late = later_fields(model, taken.state, output, whole)[0]
            whole |= {n: concrete(v) for n, v in late.items() if n not in fields}
            for then in afterwards(model, taken.state, output, whole):
                if not _after(left, then.rules):
                    yield then.state


def _pair(one: tuple[str, str], other: tuple[str, str]) -> frozenset[tuple[str, str]]:
    return frozenset((one, other))


def _identity(value: Meant) -> object:
    """Give what tells values apart that are written differently."""
    if isinstance(value, Content):
        return value.name, key_of(value.length)
    return value if isinstance(value, str) else key_of(value)


def _after(names: list[RuleName], fired: tuple[RuleName, ...]) -> list[RuleName] | None:
    """Give what is left of a list of rules after some fired; None where others fired first."""
    left = list(names)
    for rule in fired:
        if left and rule == left[0]:
            left = left[1:]
        elif not left or rule.machine != "ds402":
            return None if left else []
    return left


def _parameters(meaning: Meaning, example: Example, moment: Moment, values: Values) -> str:
    """Say the parameters of an input of which the trace depends."""
    known = values.numbers
    found = []
    for name, meant in moment.parameters.items():
        inside = meaning.symbols.inside(getattr(meant, "length", meant))
        if not inside & set(known) or name.startswith("before "):
            continue
        value = example.value(meant, 0)
        symbol = next(
            (values.known[s] for s in inside if values.known[s].label.endswith(name)), None
        )
        kind = None if symbol is None else symbol.kind
        said = str(value) if kind is None else typed_words(meaning.model, kind, value)
        if isinstance(value, bytes):
            said = f"{len(value)} bytes"
        found.append(f"{name} = {said}")
    return ", ".join(found)


def _row(meaning: Meaning, name: RuleName) -> Rule | Gap:
    machine = meaning.protocol.machines[name.machine]
    return next(row for row in rows_of(machine) if row.name == name.name)
