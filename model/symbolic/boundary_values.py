"""Boundary vectors: inputs on both sides of every comparison of a guard.

For a rule that is reached, in the world right before it, each comparison that depends on what the
MainDevice sends is put to the solver: just below, on, and just above its edge, where all else is
so that this comparison alone decides whether the rule fires.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, TypeAlias

from ecatspec.model.core.compilation import MAILBOX
from ecatspec.model.core.compiled import rows_of
from ecatspec.model.core.object_dictionary import CROWDED
from ecatspec.model.core.register_map import AREAS, SYNC_MANAGERS
from ecatspec.model.core.state import Event, RuleName
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.symbolic.concretisation import Example
from ecatspec.model.symbolic.guard_atoms import OFFSETS, Guards, Side, compares, constraints
from ecatspec.model.symbolic.minimal_values import Refined
from ecatspec.model.symbolic.renewed_solver import ForgetfulSolver
from ecatspec.model.symbolic.search import Search
from ecatspec.model.symbolic.smt_encoding import Meaning
from ecatspec.model.symbolic.symbolic_execution import Chains
from ecatspec.model.symbolic.symbolic_state import Anything, Content
from ecatspec.model.symbolic.terms import (
    Answer,
    Term,
    all_of,
    compared,
    counted,
    equal,
    key_of,
    negated,
    settled,
)
from ecatspec.spec.language.functions import REPLY
from ecatspec.spec.language.kinds import bounds_of
from ecatspec.spec.language.pretty_expressions import pretty_expression
from ecatspec.spec.language.scope import frame_fields

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from ecatspec.model.symbolic.search import Way
    from ecatspec.model.symbolic.symbolic_state import Fired, Meant, Moment
    from ecatspec.model.symbolic.terms import Values
    from ecatspec.spec.language.ir import Expression, Gap, Protocol, Rule, Span

_BEFORE: Final = "before "
"""So begin the names of what a register or word held before; nobody sends that."""
_REGISTER: Final = "register "
_COUNTER: Final = "counter"


@dataclass(frozen=True, slots=True)
class Boundary:
    """Inputs that bring one comparison of a rule's guard to one side of one of its edges.

    `number` counts the edges of the rule's guard from 1; `edge` is the value there, `value` what
    is compared with it. `written` are fields of registers before the first of the `events`, where
    the comparison speaks of them; parameters that do not matter are left out of the events.
    """

    rule: RuleName
    number: int
    side: Side
    atom: str
    at: Span
    value: int
    edge: int
    written: Mapping[str, Mapping[str, int]] = field(hash=False)
    events: tuple[Event, ...]


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A comparison, or a rule (`atom` is empty), of which there is no boundary vector, and why."""

    rule: RuleName
    atom: str
    reason: str


_Vector: TypeAlias = "tuple[tuple[object, dict[str, tuple[int | bool | None, ...]]], ...]"
_Inputs: TypeAlias = "tuple[tuple[Moment, Moment], ...]"


@dataclass(frozen=True, slots=True)
class _Edge:
    """One edge of a comparison: what is compared, with what, and on which sides."""

    number: int
    leaf: Expression
    value: Term
    edge: Term
    sides: tuple[Side, ...]
    spoken: frozenset[str]
    """The symbols of both."""
    settings: frozenset[str]
    """Of these what SyncManagers are set to."""


@dataclass(frozen=True, slots=True)
class _Place:
    """A rule right before it fires: what holds there, and what the MainDevice has sent."""

    name: RuleName
    row: Rule | Gap
    moment: Moment
    conditions: Term
    sent: frozenset[str]
    """The symbols of the last input."""
    inputs: _Inputs
    """Every input of the trace as it came, and what is known of it: the innermost layout."""
    up_to_last: tuple[Term, ...]
    """What holds before the last input."""
    stamps: frozenset[str]
    """Of the worlds in which objects may have changed."""


class Boundaries:
    """The boundary vectors of one specification; `left_out` grows while they are looked for."""

    def __init__(self, protocol: Protocol, machines: Collection[str] = ()) -> None:
        """Take the texts, and of which machines the rules count: of all where none is named."""
        self.protocol = protocol
        self._machines = machines or tuple(protocol.machines)
        self.meaning = Meaning(protocol, abstract=False)
        self.left_out: list[LeftOut] = []
        self._guards = Guards(self.meaning)
        self._search = Search(self.meaning)
        self._chains = Chains(self.meaning)
        self._solver = ForgetfulSolver(self.meaning.symbols)
        self._refined = Refined(self.meaning, self._solver, VirtualSubDevice(protocol).state)
        self._seen: set[object] = set()
        self._frames: set[str] = set()
        self._vectors: dict[tuple[int, Side], list[_Vector]] = {}
        self._ways: dict[tuple[object, ...], tuple[Term, ...]] = {}

    def found(self) -> Iterator[Boundary]:
        """Yield the vectors in the order of the texts; of two that are the same the first."""
        rows = {
            RuleName(machine.name, row.name): row
            for machine in self.protocol.machines.values()
            if machine.name in self._machines
            for row in rows_of(machine)
            if row.guard is not None and any(map(compares, self._guards.parts(row, machine.name)))
        }
        ways = self._search.cover(rows.keys())
        for name, row in rows.items():
            way = ways.get(name)
            if way is None:
                self.left_out.append(LeftOut(name, "", "no way to the rule was found"))
                continue
            place = self._place(name, row, way)
            edges = tuple(self._edges(place))
            yield from self._of_place(place, edges)
            yield from self._of_frame(place, len(edges))

    def reasons(self) -> Counter[str]:
        """Give how many comparisons or rules were left out, by the reason."""
        return Counter(each.reason for each in self.left_out)

    # --- right before a rule ----------------------------------------------------------------------

    def _place(self, name: RuleName, row: Rule | Gap, way: Way) -> _Place:
        chain = way.steps[-1][1]
        position = next(n for n, (fired, _) in enumerate(chain.fired) if fired == name)
        moment = chain.fired[position][1]
        machine = self.protocol.machines[name.machine]
        own = key_of(self._chains.enabled(row, machine, moment))
        keys = [key_of(term) for term in way.conditions]
        before = way.conditions[: keys.index(own)] if own in keys else way.conditions
        somewhere = self._chains.enabled(replace(row, guard=None), machine, moment)
        inputs = (
            *(self._input(step.fired) for _, step in way.steps[:-1]),
            self._input(chain.fired[: position + 1]),
        )
        fired = [pair for _, step in way.steps[:-1] for pair in step.fired]
        stamps = {each.world.stamp for _, each in (*fired, *chain.fired[: position + 1])} - {""}
        return _Place(
            name,
            row,
            moment,
            all_of((*before, somewhere, *self._carried(inputs))),
            frozenset(self._symbols_of(inputs[-1])),
            inputs,
            (*way.steps[-2][1].conditions, *self._carried(inputs[:-1])) if way.steps[1:] else (),
            frozenset(stamps),
        )

    def _input(self, fired: Fired) -> tuple[Moment, Moment]:
        """Give an input as it came, and what is known of it: of a frame by its receiver."""
        known = fired[0][1]
        for _, moment in fired:
            if self._frame(moment) is not None:
                known = moment
        return fired[0][1], known

    def _carried(self, inputs: _Inputs) -> Iterator[Term]:
        """Yield that every message fits into the mailbox."""
        model = self.meaning.model
        room = model.parameter("mailbox_out", "length") - model.codec.size(MAILBOX)
        for came, _ in inputs:
            length = came.parameters.get("length")
            if came.scope.machine == MAILBOX and length is not None:
                assert not isinstance(length, Content | Anything)
                yield compared("<=", length, room)

    def _symbols_of(self, came: tuple[Moment, Moment]) -> set[str]:
        """Give the symbols of what the MainDevice sends with one input."""
        return {symbol for _, meant in self._parameters(came[1]) for symbol in self._symbols(meant)}

    def _parameters(self, known: Moment) -> Iterator[tuple[str, Meant]]:
        """Yield what the MainDevice chooses of an input, in the order of the names."""
        codec = self.meaning.model.codec
        frame = self._frame(known)
        for name, meant in sorted(known.parameters.items(), key=lambda pair: pair[0]):
            chosen = not name.startswith((_BEFORE, f"{REPLY}.")) and name != CROWDED
            if frame is not None:
                chosen = name in codec.field_names(frame) and not codec.is_derived(frame, name)
            if chosen:
                yield name, meant

    def _frame(self, known: Moment) -> str | None:
        return self._chains.frame(known.scope.machine or "", known.scope.input or "")

    def _symbols(self, meant: Meant) -> frozenset[str]:
        match meant:
            case Anything():
                return frozenset()
            case Content(length=length, name=name):
                inside = self.meaning.symbols.inside(length)
                number = f"number({name})"
                return inside | {number} if number in self.meaning.symbols.known else inside
            case _:
                return self.meaning.symbols.inside(meant)

    # --- edges ------------------------------------------------------------------------------------

    def _edges(self, place: _Place) -> Iterator[_Edge]:
        """Yield the edges of all comparisons of a guard, of numbers and of truths."""
        number = 0
        for leaf in self._guards.parts(place.row, place.name.machine):
            for value, edge, sides in self._guards.edges(leaf, place.moment):
                number += 1
                spoken = self._symbols(value) | self._symbols(edge)
                # what comes last is varied: the SyncManagers stay as the device wants them
                varied = () if spoken & place.sent else filter(_is_setting, spoken)
                settings = frozenset(varied)
                yield _Edge(number, leaf, value, edge, sides, spoken, settings)

    # --- vectors ----------------------------------------------------------------------------------

    def _of_place(self, place: _Place, edges: tuple[_Edge, ...]) -> Iterator[Boundary]:
        for edge in edges:
            atom = pretty_expression(edge.leaf)
            if not edge.settings and not edge.spoken & place.sent:
                why = "it depends on nothing that the MainDevice sends"
                self.left_out.append(LeftOut(place.name, atom, why))
                continue
            ways = [self._truth_of(place, {id(edge.leaf): chosen}) for chosen in (True, False)]
            wanted = (place.conditions, negated(equal(*ways)))
            solved = [(side, *self._solved(place, edge, side, wanted)) for side in edge.sides]
            for side, _, values in solved:
                if values is not None:
                    yield from self._new(self._boundary(place, edge, side, values))
            if not any(there for _, there, _ in solved):
                self.left_out.append(LeftOut(place.name, atom, "it decides nothing there"))

    def _of_frame(self, place: _Place, number: int) -> Iterator[Boundary]:
        """Yield the constants of a frame, and what the mailbox holds; of each frame once."""
        frame = self._frame(place.inputs[-1][1])
        if frame is None or frame in self._frames:
            return
        taken = (place.conditions, self._truth_of(place, {}))
        usual = self._usual(self._related(taken))
        values = self._values(place, self._sent(place.inputs), (*taken, *usual))
        if values is None:
            return
        self._frames.add(frame)
        example = Example(self.meaning, values)
        *before, last = (self._event(example, *came, counters=False) for came in place.inputs)
        types = frame_fields(self.protocol, frame)
        for each in constraints(self.meaning, frame):
            number += 1
            low, high = bounds_of(self.protocol, types[each.field]) or (0, 0)
            for side in each.sides:
                value = each.edge + OFFSETS[side]
                if low <= value <= high:
                    parameters = {**last.parameters, each.field: value}
                    event = Event(last.machine, last.input, parameters, last.trail)
                    events = (*before, event)
                    yield from self._new(
                        Boundary(
                            place.name,
                            number,
                            side,
                            each.text,
                            each.at,
                            value,
                            each.edge,
                            {},
                            events,
                        )
                    )

    def _truth_of(self, place: _Place, chosen: Mapping[int, bool]) -> Term:
        assert place.row.guard is not None
        return self._guards.truth(place.row.guard, place.moment, chosen)

    def _solved(
        self, place: _Place, edge: _Edge, side: Side, wanted: tuple[Term, ...]
    ) -> tuple[bool, Values | None]:
        """Tell whether there is one side of an edge, and with which smallest values.

        There are no values where those of another rule are on that side too.
        """
        beside = counted("+", edge.edge, OFFSETS[side])
        assert beside is not None
        wanted = (*wanted, equal(edge.value, beside))
        if self._solver.ask(wanted) is not Answer.YES:
            return False, None
        shared = self._vectors.setdefault((id(edge.leaf), side), [])
        if not edge.settings and any(self._has(place, wanted, vector) for vector in shared):
            return True, None
        names = self._related(wanted)
        sent = self._sent(place.inputs)
        if edge.settings:
            sent |= set(filter(_is_setting, names))
        wanted = (*wanted, *self._settings(names - edge.settings))
        choices, conditions = self._choices(names), self._conditions(names)
        usual = (*choices, *conditions)
        for more in ((*usual, *self._way(place)), usual, choices, ()):
            values = self._values(place, sent, (*wanted, *more))
            if values is not None:
                shared.append(self._vector(place, values))
                return True, values
        return False, None

    def _sent(self, inputs: _Inputs) -> set[str]:
        return {symbol for came in inputs for symbol in self._symbols_of(came)}

    def _vector(self, place: _Place, values: Values) -> _Vector:
        """Give what an example sends, in a form that does not depend on the place."""
        return tuple(
            (
                self._shape(came),
                {
                    name: tuple(values.of(each) for each in sorted(self._symbols(meant)))
                    for name, meant in self._parameters(came[1])
                },
            )
            for came in place.inputs
        )

    def _shape(self, came: tuple[Moment, Moment]) -> object:
        return came[0].scope, self._frame(came[1])

    def _has(self, place: _Place, wanted: tuple[Term, ...], vector: _Vector) -> bool:
        """Tell whether what was sent for another rule is on this side here too."""
        if [shape for shape, _ in vector] != [self._shape(came) for came in place.inputs]:
            return False
        pins = []
        for (_, sent), came in zip(vector, place.inputs, strict=True):
            for name, meant in self._parameters(came[1]):
                symbols = sorted(self._symbols(meant))
                for symbol, value in zip(symbols, sent.get(name, ()), strict=False):
                    if value is not None:
                        pins.append(equal(self.meaning.symbols.known[symbol].term, value))
        formulas = (*wanted, *pins)
        lemmas = self._refined.lemmas(self._related(formulas))
        return self._solver.ask((*formulas, *lemmas)) is Answer.YES

    def _way(self, place: _Place) -> tuple[Term, ...]:
        """Give the inputs before the last one, as small as can be where all is as usual."""
        key = tuple(map(key_of, place.up_to_last))
        if key not in self._ways:
            names = self._related(place.up_to_last)
            usual = self._usual(names)
            sent = self._sent(place.inputs[:-1])
            values = self._values(place, sent, (*place.up_to_last, *usual))
            self._ways[key] = () if values is None else self._pinned(sent, values)
        return self._ways[key]

    def _values(self, place: _Place, sent: set[str], formulas: tuple[Term, ...]) -> Values | None:
        state = place.moment.world.get("al.state")
        al_state = state if isinstance(state, int) else None
        return self._refined.smallest(formulas, sent, al_state, place.stamps)

    def _pinned(self, sent: set[str], values: Values) -> tuple[Term, ...]:
        """Give that what is sent is as in an example."""
        return tuple(
            equal(self.meaning.symbols.known[name].term, values.numbers[name])
            for name in sorted(sent & values.numbers.keys())
        )

    def _related(self, formulas: Iterable[Term]) -> set[str]:
        return self._refined.related(formulas)

    def _conditions(self, names: set[str]) -> tuple[Term, ...]:
        """Give that conditions are as the texts assume, and that nothing crowds."""
        found = []
        for name in sorted(names):
            kind, _, rest = name.partition(" ")
            term = self.meaning.symbols.known[name].term
            if kind == "condition":
                assumed = self.protocol.conditions[rest.partition(" ")[0]].assumed
                found.append(equal(term, assumed))
            elif name.startswith(CROWDED):
                found.append(negated(term))
        return tuple(found)

    def _choices(self, names: set[str]) -> tuple[Term, ...]:
        """Give that choices that are open go the first way."""
        known = self.meaning.symbols.known
        return tuple(
            equal(known[name].term, 0) for name in sorted(names) if name.startswith("choice ")
        )

    def _usual(self, names: set[str]) -> tuple[Term, ...]:
        return (*self._choices(names), *self._conditions(names), *self._settings(names))

    def _settings(self, names: set[str]) -> tuple[Term, ...]:
        """Give that SyncManagers lie where the device has its areas."""
        found = []
        for manager, area in AREAS.items():
            for part in ("start", "length"):
                name = f"{_REGISTER}{manager}.{part}"
                fixed = part == "start" or manager in SYNC_MANAGERS
                if name in names and fixed:
                    term = self.meaning.symbols.known[name].term
                    found.append(equal(term, self.meaning.model.parameter(area, part)))
        return tuple(found)

    def _boundary(self, place: _Place, edge: _Edge, side: Side, values: Values) -> Boundary:
        example = Example(self.meaning, values)
        counters = any(
            edge.spoken & self._symbols(known.parameters.get(_COUNTER, 0))
            for _, known in place.inputs
        )
        written: dict[str, dict[str, int]] = {}
        if edge.settings:
            for name in sorted(filter(_is_setting, values.numbers)):
                register, _, part = name.removeprefix(_REGISTER).partition(".")
                written.setdefault(register, {})[part] = int(values.numbers[name])
        return Boundary(
            place.name,
            edge.number,
            side,
            pretty_expression(edge.leaf),
            edge.leaf.at,
            self._number(edge.value, values),
            self._number(edge.edge, values),
            written,
            tuple(self._event(example, *came, counters=counters) for came in place.inputs),
        )

    def _number(self, term: Term, values: Values) -> int:
        number = settled(term, values.numbers, self.meaning.symbols)
        assert number is not None
        return int(number)

    def _event(self, example: Example, came: Moment, known: Moment, *, counters: bool) -> Event:
        frame = self._frame(known)
        trail = () if frame is None else self.meaning.model.codec.trail(frame)
        parameters = {
            name: example.value(meant, 0)
            for name, meant in self._parameters(known)
            if (counters or name != _COUNTER)
            and self._symbols(meant) & example.values.numbers.keys()
        }
        return Event(came.scope.machine or "", came.scope.input or "", parameters, trail)

    def _new(self, boundary: Boundary) -> Iterator[Boundary]:
        events = [(e.machine, e.input, e.trail, e.parameters) for e in boundary.events]
        key = repr((boundary.written, events))
        if key not in self._seen:
            self._seen.add(key)
            yield boundary


def _is_setting(symbol: str) -> bool:
    """Tell whether a symbol is what a SyncManager was set to before the first input."""
    register, dot, _ = symbol.removeprefix(_REGISTER).partition(".")
    manager = register.removesuffix("_activation")
    return symbol.startswith(_REGISTER) and bool(dot) and manager in AREAS
