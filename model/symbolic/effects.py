"""Proves what can be seen: states told apart, choices with an effect."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from ecatspec.model.core.compiled import rows_of
from ecatspec.model.symbolic.concretisation import Example
from ecatspec.model.symbolic.obligations import Finding, Obligation, Status
from ecatspec.model.symbolic.symbolic_state import Anything, Content, Moment
from ecatspec.model.symbolic.terms import Answer, Term, equal, negated, with_value
from ecatspec.spec.language.ir import Gap, Name
from ecatspec.spec.language.nodes import nodes_in
from ecatspec.spec.language.scope import Scope

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.symbolic.smt_encoding import Meaning
    from ecatspec.model.symbolic.terms import Solver
    from ecatspec.spec.language.ir import Protocol, Register, RegisterField, Word


# --- states told apart ----------------------------------------------------------------------------


def told_apart(meaning: Meaning, solver: Solver, obligation: Obligation) -> Finding | None:
    """Prove that two states of a machine never look the same; None where none is shown at all.

    Conditions are as the texts assume, choices that are open go the first way.
    """
    protocol = meaning.protocol
    machine = obligation.group
    slot = f"{machine}.state"
    shown = [(holder, bits) for holder, bits in _shown(protocol) if _speaks(meaning, bits, slot)]
    names = {name: value for value, name in meaning.model.state_names(machine).items()}
    if not shown or len(names) < 2:  # noqa: PLR2004  two states are told apart
        return None
    for one, other in itertools.combinations(names, 2):
        formulas: list[Term] = []
        for holder, bits in shown:
            seen = []
            for side, state in (("one", one), ("other", other)):
                world = meaning.world(f"{side} ").having({slot: names[state]})
                moment = Moment(world, Scope(), f"{side} {holder}.{bits.name}", {})
                assert bits.shows is not None
                formulas.append(meaning.truth(bits.shows.condition, moment))
                value = meaning.value(bits.shows.value, moment, bits.type)
                seen.append(meaning.typed(value, bits.name, bits.type, moment.key))
            first, second = seen
            assert not isinstance(first, Content)
            assert not isinstance(second, Content)
            formulas.append(equal(first, second))
        formulas += _assumed(meaning, formulas)
        answer, values = solver.example(formulas)
        if answer is Answer.UNKNOWN:
            return Finding(obligation, Status.UNKNOWN, (f"{one} and {other}: the solver gave up",))
        if values is not None:
            example = Example(meaning, values)
            line = f"{one} and {other} look the same in {', '.join(sorted({h for h, _ in shown}))}"
            fields = tuple(
                f"{holder}.{bits.name} = {_seen(meaning, example, holder, bits, names[one])}"
                for holder, bits in shown
            )
            places = tuple(bits.at for _, bits in shown)
            return Finding(obligation, Status.REFUTED, (line, *fields), places)
    return Finding(obligation, Status.PROVED, (f"{len(names)} states, each looks different",))


def _assumed(meaning: Meaning, formulas: list[Term]) -> list[Term]:
    """Give conditions as the texts assume them, and choices that are open at their first way."""
    found = []
    for name in frozenset[str]().union(*map(meaning.symbols.inside, formulas)):
        kind, _, rest = name.partition(" ")
        term = meaning.symbols.known[name].term
        if kind == "choice":
            found.append(equal(term, 0))
        elif kind == "condition":
            assumed = meaning.protocol.conditions[rest.partition(" ")[0]].assumed
            found.append(equal(term, assumed))
    return found


def _seen(meaning: Meaning, example: Example, holder: str, bits: RegisterField, state: int) -> str:
    slot = next(s for s in meaning.kinds if s.endswith(".state") and s in _slots(meaning, bits))
    world = meaning.world("one ").having({slot: state})
    assert bits.shows is not None
    moment = Moment(world, Scope(), f"one {holder}.{bits.name}", {})
    value = meaning.value(bits.shows.value, moment, bits.type)
    known = example.value(value, "any" if isinstance(value, Anything) else 0)
    return "yes" if known is True else "no" if known is False else str(known)


def _shown(protocol: Protocol) -> Iterator[tuple[str, RegisterField]]:
    holders: list[Register | Word] = [*protocol.registers.values(), *protocol.words.values()]
    for holder in holders:
        for bits in holder.fields:
            if bits.shows is not None:
                yield holder.name, bits


def _speaks(meaning: Meaning, bits: RegisterField, slot: str) -> bool:
    return slot in _slots(meaning, bits)


def _slots(meaning: Meaning, bits: RegisterField) -> frozenset[str]:
    assert bits.shows is not None
    moment = Moment(meaning.world(), Scope(), "shown", {})
    value = meaning.value(bits.shows.value, moment, bits.type)
    if isinstance(value, Content | Anything):
        return frozenset()
    return meaning.symbols.inside(value)


# --- choices --------------------------------------------------------------------------------------


def has_effect(meaning: Meaning, solver: Solver, obligation: Obligation) -> Finding:
    """Prove that an alternative decides about something: a guard, or a value that is told."""
    protocol = meaning.protocol
    choice, way = obligation.group, obligation.name
    symbol = f"choice {choice}"
    mine = meaning.alternative(choice, way)
    others = [n for n in range(len(protocol.choices[choice].alternatives)) if n != mine]
    meaning.choice(choice)
    for machine in protocol.machines.values():
        world = meaning.world()
        for row in rows_of(machine):
            key = f"effect {machine.name}.{row.input}"
            moment = Moment(world, Scope(machine.name, row.input), key, {})
            guard = meaning.truth(row.guard, moment)
            if symbol not in meaning.symbols.inside(guard):
                continue
            here = with_value(guard, symbol, mine, meaning.symbols)
            for other in others:
                there = with_value(guard, symbol, other, meaning.symbols)
                if solver.ask((negated(equal(here, there)),)) is Answer.YES:
                    line = f"it decides whether {machine.name}.{row.name} fires"
                    return Finding(obligation, Status.PROVED, (line,), (row.at,))
    for where, expressions in _told(protocol):
        if any(_mentions(protocol, expression, choice) for expression in expressions):
            line = f"it decides about a value of {where}"
            return Finding(obligation, Status.PROVED, (line,))
    at = protocol.choices[choice].at
    line = f"no rule does anything else where {choice} is {way}"
    return Finding(obligation, Status.REFUTED, (line,), (at,))


def _told(protocol: Protocol) -> Iterator[tuple[str, tuple[object, ...]]]:
    """Yield the expressions that give values: of rules, of what is shown, of replies."""
    for machine in protocol.machines.values():
        for rule in rows_of(machine):
            if not isinstance(rule, Gap):
                parts = (rule.updates, rule.stores, rule.sends, rule.gives, rule.after, rule.laters)
                yield f"{machine.name}.{rule.name}", parts
    for holder, bits in _shown(protocol):
        yield f"{holder}.{bits.name}", (bits.shows,)
    for frame in protocol.frames.values():
        yield frame.name, tuple(item.reply for item in frame.fields)


def _mentions(protocol: Protocol, expression: object, choice: str) -> bool:
    seen: set[str] = set()

    def inside(part: object) -> bool:
        for node in nodes_in(part):
            if isinstance(node, Name):
                if node.path == choice:
                    return True
                definition = protocol.definitions.get(node.path)
                if definition is not None and node.path not in seen:
                    seen.add(node.path)
                    if inside(definition.value):
                        return True
        return False

    return inside(expression)
