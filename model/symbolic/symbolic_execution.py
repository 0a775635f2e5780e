"""Executes one input to completion symbolically: every way through the rules.

A chain is one way: the rules that fire one after another, what has to hold for it, and the world
after it. Worlds hold symbols, so that one chain stands for every state and every input.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ecatspec.model.core.compilation import MAILBOX
from ecatspec.model.core.compiled import rows_of, timers_of
from ecatspec.model.core.expressions import before
from ecatspec.model.core.interpreter import DELIVER, RESEND
from ecatspec.model.core.state import RuleName
from ecatspec.model.symbolic.smt_encoding import is_written
from ecatspec.model.symbolic.symbolic_state import (
    Anything,
    Arrival,
    Chain,
    Content,
    Fired,
    Meeting,
    Moment,
)
from ecatspec.model.symbolic.terms import Term, all_of, any_of, counted, equal
from ecatspec.spec.language.functions import REPLY
from ecatspec.spec.language.ir import Bool, Bytes, Gap, InputKind, Rule
from ecatspec.spec.language.kinds import width_of
from ecatspec.spec.language.nodes import names_in
from ecatspec.spec.language.scope import Scope, frame_fields

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from ecatspec.model.symbolic.smt_encoding import Meaning
    from ecatspec.model.symbolic.symbolic_state import Meant, World
    from ecatspec.spec.language.ir import Give, Machine, Send

_BYTE: Final = 8
_DEEPEST: Final = 12
"""Maximum number of rules in a row; texts that give each other events would never end."""


class Chains:
    """The chains of one specification.

    `possible` cuts what cannot be, `wanted` what nobody asks for; `meet` is told of
    every input on the way; `settle` gives the world after words may have moved machines.
    """

    def __init__(
        self,
        meaning: Meaning,
        possible: Callable[[tuple[Term, ...]], bool] | None = None,
        *,
        wanted: Callable[[str, Rule | Gap, World, Fired], bool] | None = None,
        meet: Callable[[Meeting], None] | None = None,
        settle: Callable[[World], tuple[World, tuple[Term, ...]]] | None = None,
    ) -> None:
        """Take the meaning of the texts."""
        self._meaning = meaning
        self._protocol = meaning.protocol
        self._possible = possible or (lambda _: True)
        self._wanted = wanted or (lambda *_: True)
        self._meet = meet or (lambda _: None)
        self._settle = settle or (lambda world: (world, ()))
        self._rules: dict[tuple[str, str], tuple[Rule | Gap, ...]] = {
            (machine.name, source.name): tuple(
                row for row in rows_of(machine) if row.input == source.name
            )
            for machine in self._protocol.machines.values()
            for source in machine.inputs
        }
        self._inputs = {
            (machine.name, source.name): source
            for machine in self._protocol.machines.values()
            for source in machine.inputs
        }
        self._touched: dict[tuple[str, str], frozenset[str]] = {}
        self._beneath: dict[tuple[str, str], frozenset[RuleName]] = {}
        self.cut: set[RuleName] = set()
        """The rules that take inputs beyond where chains end that are too long."""
        self.moved_by_words = frozenset(
            slot
            for target in self._inputs
            if self._inputs[target].kind == InputKind.WORD
            for slot in self.touched(*target)
        )
        """The slots that words may change."""

    # --- what comes from outside ------------------------------------------------------------------

    def roots(self) -> tuple[tuple[str, str], ...]:
        """Give the inputs that nothing in the texts has to give."""
        given = {
            give.target
            for machine in self._protocol.machines.values()
            for rule in machine.rules
            for give in (*rule.gives, *(rule.after.gives if rule.after else ()))
        }
        timers = timers_of(self._protocol)
        found = []
        for (machine, name), source in self._inputs.items():
            target = f"{machine}.{name}"
            inner = source.kind == InputKind.FRAME and machine != MAILBOX
            event = source.kind == InputKind.EVENT and target in given and target not in timers
            if not inner and not event:
                found.append((machine, name))
        return tuple(found)

    def frame(self, machine: str, name: str) -> str | None:
        """Give the frame that an input is, None for another kind of input."""
        source = self._inputs[machine, name]
        return source.origin[0] if source.kind == InputKind.FRAME else None

    def beneath(self, machine: str, name: str) -> frozenset[RuleName]:
        """Give the rules that an input may lead to, by what they give as well."""
        key = machine, name
        if key not in self._beneath:
            self._beneath[key] = frozenset()
            rows = self._rules[key]
            own = frozenset(RuleName(machine, row.name) for row in rows)
            self._beneath[key] = own.union(*(self.led_to(machine, row) for row in rows))
        return self._beneath[key]

    def neighbours(self, machine: str) -> list[str]:
        """Give the machines of which a machine reads something, or that give it inputs."""
        meaning = self._meaning
        found: set[str] = set()
        world = meaning.world("any ")
        for (owner, name), rows in self._rules.items():
            if owner != machine:
                if any(r.machine == machine for row in rows for r in self.led_to(owner, row)):
                    found.add(owner)
                continue
            moment = Moment(world, Scope(owner, name), f"any {owner}.{name}", {})
            for row in rows:
                inside = meaning.symbols.inside(meaning.truth(row.guard, moment))
                slots = {symbol.removeprefix("any ") for symbol in inside} & set(meaning.kinds)
                found |= {slot.partition(".")[0] for slot in slots}
        return sorted(found & set(self._protocol.machines))

    def led_to(self, machine: str, row: Rule | Gap) -> frozenset[RuleName]:
        """Give the rules that one may lead to by what it gives."""
        if isinstance(row, Gap):
            return frozenset()
        gives = (*row.gives, *(row.after.gives if row.after else ()))
        targets = [target for give in gives for target in self._targets(machine, give)]
        return frozenset[RuleName]().union(*(self.beneath(*target) for target in targets))

    def arrive(
        self, world: World, machine: str, name: str, *, anew: bool, key: str = ""
    ) -> tuple[World, Arrival]:
        """Give the world and the input that comes to it; `anew`: registers or words were written.

        Without `anew` the world is taken as the one in which they were written already. `key` is
        another one for every input of a trace.
        """
        source = self._inputs[machine, name]
        parameters: dict[str, Meant] = {}
        if source.kind in {InputKind.WRITE, InputKind.WORD}:
            word = source.kind == InputKind.WORD
            changes: dict[str, Meant] = {}
            single = len(source.origin) == 1
            for origin in source.origin:
                holder = self._protocol.words if word else self._protocol.registers
                if not word and not is_written(self._protocol, origin):
                    continue
                for bits in holder[origin].fields:
                    slot = f"{'word' if word else 'register'} {origin}.{bits.name}"
                    if anew:
                        label = f"{origin}.{bits.name}"
                        changes[slot] = self._meaning.of_kind(f"{label} @{key}", label, bits.type)
                    if single:
                        now = changes[slot] if anew else world.get(slot)
                        parameters[bits.name] = now
                        if anew:
                            parameters[before(bits.name)] = world.get(slot)
            world = world.having(changes)
            return world, Arrival(machine, name, parameters, key=key)
        if source.kind == InputKind.FRAME and len(source.origin) == 1:
            fields, holds = self._frame(world, source.origin[0], {}, key)
            return world, Arrival(machine, name, fields, holds, key)
        return world, Arrival(machine, name, parameters, key=key)

    def _frame(
        self, world: World, frame: str, outer: Mapping[str, Meant], key: str
    ) -> tuple[dict[str, Meant], tuple[Term, ...]]:
        """Give the fields of a frame that came, and what has to hold of them."""
        meaning = self._meaning
        key = f"{key}/{frame}"
        fields: dict[str, Meant] = dict(outer)
        holds: list[Term] = []
        for name, value in meaning.model.codec.fixed(frame).items():
            if not isinstance(value, int):
                continue
            known = outer.get(name)
            if known is not None and not isinstance(known, Content | Anything):
                holds.append(equal(known, value))
            fields[name] = value
        body: Content | None = None
        for layout in meaning.model.codec.trail(frame):
            inside = Moment(world, Scope(frame=layout), key, fields)
            bits = 0
            lengths: Term = 0
            last: Content | None = None
            for item in self._protocol.frames[layout].fields:
                if not isinstance(item.type, Bytes):
                    bits += width_of(self._protocol, item.type) or 0
                    continue
                if item.name not in fields:
                    fields[item.name] = meaning.of_kind(f"{item.name} @{key}", item.name, item.type)
                last = fields[item.name]  # type: ignore[assignment]
                assert isinstance(last, Content)
                if item.type.length is not None:
                    length = meaning.value(item.type.length, inside, None)
                    if not isinstance(length, Content | Anything):
                        holds.append(equal(last.length, length))
                lengths = _sum(lengths, last.length)
            if body is not None:
                holds.append(equal(body.length, _sum(lengths, bits // _BYTE)))
            body = last
        types = frame_fields(self._protocol, frame)
        for name, kind in types.items():
            if name not in fields:
                fields[name] = meaning.of_kind(f"{name} @{key}", name, kind)
        return fields, tuple(holds)

    # --- one input --------------------------------------------------------------------------------

    def run(
        self,
        world: World,
        arrival: Arrival,
        conditions: tuple[Term, ...] = (),
        fired: Fired = (),
    ) -> Iterator[Chain]:
        """Yield every way in which the rules take an input, and what they give each other.

        `fired` are the rules that led to it.
        """
        machine = self._protocol.machines[arrival.machine]
        key = f"{arrival.key}/{len(fired)} {machine.name}.{arrival.input}"
        scope = Scope(machine.name, arrival.input)
        moment = Moment(world, scope, key, dict(arrival.parameters))
        conditions = (*conditions, *arrival.conditions)
        rows = tuple(
            (row, self.enabled(row, machine, moment))
            for row in self._rules[machine.name, arrival.input]
            if self._wanted(machine.name, row, world, fired)
        )
        self._meet(Meeting(moment, conditions, rows, fired))
        for row, here in rows:
            holds = conditions if here is True else (*conditions, here)
            if here is False or not self._possible(holds):
                continue
            now = (*fired, (RuleName(machine.name, row.name), moment))
            if isinstance(row, Gap):
                yield Chain(world, holds, now, gap=True)
            elif len(now) < _DEEPEST:
                chain = Chain(world, holds, now)
                yield from self._apply(machine, row, moment, chain, arrival.key)
            else:
                self._cut_off(now)

    def _cut_off(self, fired: Fired) -> None:
        """Keep in mind which rules a chain leaves out that is not followed to its end.

        They take what its last rule gives, and what others give that had more than that to give.
        """
        names = [name for name, _ in fired]
        work = [name for name in names if name is names[-1] or len(self._given_by(name)) > 1]
        while work:
            name = work.pop()
            taking = {
                RuleName(target[0], row.name)
                for give in self._given_by(name)
                for target in self._targets(name.machine, give)
                for row in self._rules[target]
            }
            work += taking - self.cut
            self.cut |= taking

    def _given_by(self, name: RuleName) -> tuple[Give, ...]:
        rows = rows_of(self._protocol.machines[name.machine])
        row = next(row for row in rows if row.name == name.name)
        if isinstance(row, Gap):
            return ()
        return (*row.gives, *(row.after.gives if row.after else ()))

    def enabled(self, row: Rule | Gap, machine: Machine, moment: Moment) -> Term:
        """Give what holds where the machine is in a source of the rule, and its guard is true."""
        state = moment.world.get(f"{machine.name}.state")
        assert not isinstance(state, Content | Anything)
        values = {
            name: value for value, name in self._meaning.model.state_names(machine.name).items()
        }
        if set(row.sources) == set(machine.states):
            here: Term = True
        else:
            here = any_of(equal(state, values[source]) for source in row.sources)
        if here is False:
            return False
        return all_of((here, self._meaning.truth(row.guard, moment)))

    def _apply(
        self, machine: Machine, rule: Rule, moment: Moment, chain: Chain, key: str
    ) -> Iterator[Chain]:
        meaning = self._meaning
        changes = self._updates(rule, moment)
        if rule.target is not None:
            values = {name: v for v, name in meaning.model.state_names(machine.name).items()}
            changes[f"{machine.name}.state"] = values[rule.target]
        given = [a for give in rule.gives for a in self._given(machine, give, moment, key)]
        stamp = moment.key if rule.stores or rule.take else None
        world = chain.world.having(changes, stamp)
        conditions, between = chain.conditions, chain.between
        if stamp is not None:
            between = (*between, (world, conditions))
            world, more = self._settle(world)
            conditions = (*conditions, *more)
        done = Chain(world, conditions, chain.fired, between=between)
        chains: Iterator[Chain] = iter((done,))
        for ways in given:
            chains = self._then(chains, ways)
        if rule.after is not None:
            chains = self._after(chains, machine, rule, moment, key)
        yield from chains

    def _then(self, chains: Iterator[Chain], ways: tuple[Arrival, ...]) -> Iterator[Chain]:
        for chain in chains:
            if chain.gap or not ways:
                yield chain
                continue
            for arrival in ways:
                for then in self.run(chain.world, arrival, chain.conditions, chain.fired):
                    yield replace(
                        then,
                        between=chain.between + then.between,
                        replies=chain.replies + then.replies,
                    )

    def _after(
        self,
        chains: Iterator[Chain],
        machine: Machine,
        rule: Rule,
        moment: Moment,
        origin: str,
    ) -> Iterator[Chain]:
        """Go on once the frame is fixed: what it holds is what the rule says of it."""
        assert rule.after is not None
        send = rule.sends[-1] if rule.sends else None
        for chain in chains:
            if chain.gap:
                yield chain
                continue
            frame = None if send is None else send.frame
            scope = replace(moment.scope, reply=frame)
            key = f"{moment.key} reply"
            later = Moment(chain.world, scope, key, dict(moment.parameters))
            if send is not None:
                self._reply(send, moment, later)
            changes = self._changes(machine, rule.after.updates, later)
            given = [
                a for give in rule.after.gives for a in self._given(machine, give, later, origin)
            ]
            between = (*chain.between, (chain.world, chain.conditions))
            sent = replace(
                chain,
                world=chain.world.having(changes),
                between=between,
                replies=(*chain.replies, later),
            )
            later_chains: Iterator[Chain] = iter((sent,))
            for ways in given:
                later_chains = self._then(later_chains, ways)
            yield from later_chains

    def _reply(self, send: Send, moment: Moment, later: Moment) -> None:
        types = frame_fields(self._protocol, send.frame)
        late = [
            (name, value)
            for name, value in send.fields
            if any(path.startswith(f"{REPLY}.") for path in names_in(value))
        ]
        for name, value in send.fields:
            if (name, value) not in late:
                meant = self._meaning.value(value, moment, types[name])
                later.parameters[f"{REPLY}.{name}"] = self._meaning.typed(
                    meant, name, types[name], later.key
                )
        for name, value in late:
            meant = self._meaning.value(value, later, types[name])
            later.parameters[f"{REPLY}.{name}"] = self._meaning.typed(
                meant, name, types[name], later.key
            )

    def _updates(self, rule: Rule, moment: Moment) -> dict[str, Meant]:
        machine = self._protocol.machines[moment.scope.machine or ""]
        return self._changes(machine, rule.updates, moment)

    def _changes(self, machine: Machine, updates: tuple, moment: Moment) -> dict[str, Meant]:  # type: ignore[type-arg]
        changes: dict[str, Meant] = {}
        for update in updates:
            slot = (
                update.variable if "." in update.variable else f"{machine.name}.{update.variable}"
            )
            kind = self._meaning.kinds[slot]
            value = self._meaning.value(update.value, moment, kind)
            changes[slot] = self._meaning.typed(value, slot, kind, moment.key)
        return changes

    def _given(
        self, machine: Machine, give: Give, moment: Moment, key: str
    ) -> Iterator[tuple[Arrival, ...]]:
        """Yield for an event that a rule gives the inputs of which one comes."""
        if give.target == RESEND:
            return
        if give.target == DELIVER:
            yield tuple(self._taken(machine, moment, key))
            return
        owner, _, name = give.target.partition(".")
        parameters = {}
        kinds = dict(self._inputs[owner, name].parameters)
        for argument, value in give.arguments:
            meant = self._meaning.value(value, moment, kinds.get(argument))
            kind = kinds.get(argument, Bool())
            parameters[argument] = self._meaning.typed(meant, argument, kind, moment.key)
        yield (Arrival(owner, name, parameters, key=key),)

    def _taken(self, machine: Machine, moment: Moment, key: str) -> Iterator[Arrival]:
        for (owner, name), source in self._inputs.items():
            if owner == machine.name or source.kind != InputKind.FRAME:
                continue
            for origin in source.origin:
                fields, holds = self._frame(moment.world, origin, moment.parameters, moment.key)
                if len(source.origin) > 1:
                    shared = set(frame_fields(self._protocol, source.origin[0]))
                    fields = {name: fields[name] for name in fields if name in shared}
                if all_of(holds) is not False:
                    yield Arrival(owner, name, fields, holds, key)

    # --- what an input can change -----------------------------------------------------------------

    def touched(self, machine: str, name: str) -> frozenset[str]:
        """Give the slots that an input may change, by what it leads to as well."""
        key = machine, name
        if key not in self._touched:
            self._touched[key] = frozenset()
            while True:
                found = frozenset(self._changed_by(machine, name))
                if found == self._touched[key]:
                    break
                self._touched[key] = found
        return self._touched[key]

    def _changed_by(self, machine: str, name: str) -> Iterator[str]:
        for row in self._rules[machine, name]:
            if isinstance(row, Gap):
                continue
            if row.target is not None:
                yield f"{machine}.state"
            after = row.after
            for update in (*row.updates, *(after.updates if after else ())):
                yield update.variable if "." in update.variable else f"{machine}.{update.variable}"
            for give in (*row.gives, *(after.gives if after else ())):
                for target in self._targets(machine, give):
                    yield from self.touched(*target)
            if row.stores or row.take:
                for target, source in self._inputs.items():
                    if source.kind == InputKind.WORD:
                        yield from self.touched(*target)

    def _targets(self, machine: str, give: Give) -> list[tuple[str, str]]:
        if give.target == RESEND:
            return []
        if give.target == DELIVER:
            return [
                target
                for target, source in self._inputs.items()
                if source.kind == InputKind.FRAME and target[0] != machine
            ]
        owner, _, name = give.target.partition(".")
        return [(owner, name)]


def _sum(one: Term, other: Term) -> Term:
    total = counted("+", one, other)
    assert total is not None
    return total
