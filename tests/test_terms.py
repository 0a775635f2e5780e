"""Tests of solver terms: they mean what the interpreter does."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from random import Random
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("z3")

from ecatspec.generators.cases.bringup import has_process_data, mailbox_settings, request
from ecatspec.generators.cases.case import SetUpProcessData, WriteOutputs
from ecatspec.generators.cases.play import play
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.compiled import rows_of
from ecatspec.model.core.expressions import Environment, before
from ecatspec.model.core.functions import PLAIN
from ecatspec.model.core.interpreter import step
from ecatspec.model.core.observables import usual_mailbox
from ecatspec.model.core.state import Event, RuleName
from ecatspec.model.core.values import UNKNOWN, Pattern, Value
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.symbolic.smt_encoding import Meaning
from ecatspec.model.symbolic.symbolic_execution import Chains
from ecatspec.model.symbolic.symbolic_state import Content, Moment
from ecatspec.model.symbolic.terms import (
    Answer,
    Solver,
    Symbols,
    all_of,
    any_of,
    counted,
    either,
    equal,
    negated,
    settled,
    two_of,
)
from ecatspec.spec.language.arithmetic import DIVISIONS
from ecatspec.spec.language.ir import (
    AnyValue,
    Binary,
    Bool,
    Bytes,
    Conditional,
    In,
    InputKind,
    Literal,
    Name,
    Range,
    SInt,
    Unary,
)
from ecatspec.spec.language.kinds import bounds_of, kind_of_ref
from ecatspec.spec.language.load import load_device
from ecatspec.spec.language.logic import COMPARED, LOGIC
from ecatspec.spec.language.nodes import nodes_in
from ecatspec.spec.language.references import UnresolvedName
from ecatspec.spec.language.scope import Scope, resolve

if TYPE_CHECKING:
    from ecatspec.model.core.state import State
    from ecatspec.spec.language.ir import Expression, Type

DEVICES = ("reference-drive", "kollmorgen-s300")
COMMANDS = 1 << 16
STRIDE = 0x3FB
"""Every so many control words: all bits in all combinations of neighbours."""


# --- terms ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", ["+", "-", "*", "/", "%"])
def test_numbers_are_calculated_as_the_interpreter_does(sign: str) -> None:
    symbols = Symbols()
    number = symbols.number("n", "n", None, (-9, 9))
    for value, other in itertools.product(range(-9, 10), range(1, 5)):
        wanted = {
            "+": value + other, "-": value - other, "*": value * other,
            "/": value // other, "%": value % other,
        }[sign]  # fmt: skip
        term = counted(sign, number, other)
        assert term is not None
        assert settled(term, {"n": value}, symbols) == wanted
        assert counted(sign, value, other) == wanted


def test_what_the_solver_divides_otherwise_is_not_calculated() -> None:
    number = Symbols().number("n", "n", None, (0, 9))
    assert counted("/", number, -2) is None
    assert counted("%", 3, 0) is None
    assert counted("&", number, 3) is None


def test_logic_folds_what_is_known() -> None:
    symbols = Symbols()
    truth = symbols.truth("t", "t", None)
    assert all_of((truth, False)) is False
    assert any_of((truth, True)) is True
    assert all_of((True, truth)) is truth
    assert either(True, 1, 2) == 1  # noqa: FBT003
    assert two_of((True, False, True)) is True
    assert two_of((True, False)) is False
    assert equal(truth, True) is truth  # noqa: FBT003
    solver = Solver(symbols)
    assert solver.ask((truth, negated(truth))) is Answer.NO
    assert solver.ask((two_of((truth, negated(truth), truth)),)) is Answer.YES


# --- agreement with the interpreter ---------------------------------------------------------------


@cache
def models(device: str, *, conditions: bool) -> tuple[Meaning, Model]:
    """The terms and the interpreter of a device whose conditions are all decided one way."""
    protocol = load_device(device)
    decided = {
        name: replace(condition, assumed=conditions)
        for name, condition in protocol.conditions.items()
    }
    protocol = replace(protocol, conditions=decided)
    return Meaning(protocol, abstract=False), Model(protocol, assuming=True)


@cache
def reachable(device: str) -> tuple[State, ...]:
    """States of the virtual SubDevice on random walks from power-on."""
    protocol = load_device(device)
    model = Model(protocol)
    random = Random(7)
    dut = VirtualSubDevice(protocol)
    found = {dut.state: None}
    ways = [request(model.row("al_state", name)) for name in ("INIT", "PREOP", "SAFEOP", "OP")]
    for _ in range(4):
        dut.reset()
        play(model, dut, mailbox_settings(model))
        for _ in range(14):
            stimuli = [random.choice(ways)]
            if has_process_data(model):
                stimuli += random.choice(([], [WriteOutputs()], [SetUpProcessData()]))  # type: ignore[arg-type]
            play(model, dut, stimuli)
            found[dut.state] = None
    return tuple(found)


def drawn(random: Random, bounds: tuple[int, int]) -> int:
    low, high = bounds
    near = [low, high, min(high, low + 1), max(low, high - 1), random.randint(low, high)]
    return random.choice([*near, random.randint(low, min(high, low + 12))])


def shaken(random: Random, model: Model, state: State) -> State:
    """The state with some variables, choices, registers and words at other values."""
    protocol = model.protocol
    for machine in protocol.machines.values():
        names = list(model.state_names(machine.name))
        if random.random() < 0.5:
            state = state.having(model.slots[f"{machine.name}.state"], random.choice(names))
        for variable in machine.variables:
            if random.random() < 0.5:
                slot = model.slots[f"{machine.name}.{variable.name}"]
                state = state.having(slot, of_type(random, model, variable.type))
    for name, choice in protocol.choices.items():
        if name not in protocol.pins and random.random() < 0.5:
            way = random.choice(choice.alternatives).name
            state = state.having(model.slots[f"choice {name}"], way)
    for name, slot in model.slots.items():
        if name.startswith("word ") and random.random() < 0.7:
            size = protocol.words[name.removeprefix("word ")].size
            state = state.having(slot, random.getrandbits(8 * size))
    return state


def of_type(random: Random, model: Model, kind: Type) -> Value:
    match kind:
        case Bool():
            return random.random() < 0.5
        case Bytes():
            size = random.choice((0, 1, 2, 4, 7))
            return random.randbytes(size)[:2].ljust(size, b"\0")
        case _:
            return drawn(random, bounds_of(model.protocol, kind) or (0, 100))


def event_of(random: Random, model: Model, machine: str, name: str, state: State) -> Event:
    """An input with random parameters; what comes from a register or word is what that holds."""
    protocol = model.protocol
    source = next(i for i in protocol.machines[machine].inputs if i.name == name)
    parameters: dict[str, Value] = {}
    scope = Scope(machine, name)
    names = [p for p, _ in source.parameters]
    if source.kind == InputKind.FRAME:
        names = list(model.codec.field_names(source.origin[0]))
    if source.kind == InputKind.OUTPUTS:
        names = ["image"]
    if source.kind in {InputKind.WRITE, InputKind.WORD} and len(source.origin) == 1:
        holder = (protocol.words if source.kind == InputKind.WORD else protocol.registers)[
            source.origin[0]
        ]
        raw = state.slots[
            model.slots[f"{'word' if source.kind == InputKind.WORD else 'register'} {holder.name}"]
        ]
        assert isinstance(raw, int)
        for bits in holder.fields:
            value = raw >> bits.low & ((1 << (bits.high - bits.low + 1)) - 1)
            truth = isinstance(bits.type, Bool)
            parameters[bits.name] = bool(value) if truth else value
            parameters[before(bits.name)] = of_type(random, model, bits.type)
        names = ["cyclic"] if source.kind == InputKind.WORD else []
    entries = list(model.dictionary.entries) or [(0, 0)]
    index, subindex = random.choice(entries)
    for parameter in names:
        try:
            kind = kind_of_ref(protocol, resolve(protocol, parameter, scope), scope)
        except UnresolvedName:
            continue
        assert kind is not None
        parameters[parameter] = of_type(random, model, kind)  # type: ignore[arg-type]
    if random.random() < 0.8 and "index" in parameters:
        parameters["index"] = index
        if "subindex" in parameters:
            parameters["subindex"] = subindex
    parameters["request in work"] = random.random() < 0.5
    return Event(machine, name, parameters)


def numbers_of(
    meaning: Meaning, model: Model, state: State, event: Event, moment: Moment
) -> dict[str, int | bool]:
    """The values of all symbols that a state and an input give, by the name of the symbol."""
    found: dict[str, int | bool] = {}

    def put(meant: object, value: Value | None) -> None:
        if isinstance(meant, Content) and isinstance(value, bytes):
            put(meant.length, len(value))
            found[f"number({meant.name})"] = int.from_bytes(value, "little")
        elif isinstance(value, int) and not isinstance(meant, int | str):
            for symbol in meaning.symbols.inside(meant):
                found[symbol] = value

    protocol = model.protocol
    for name, slot in model.slots.items():
        value = state.slots[slot]
        kind, _, holder = name.partition(" ")
        if kind == "choice":
            found[name] = meaning.alternative(holder, str(value))
        elif kind in {"register", "word"} and isinstance(value, int):
            layout = (protocol.registers if kind == "register" else protocol.words)[holder]
            for bits in layout.fields:
                raw = value >> bits.low & ((1 << (bits.high - bits.low + 1)) - 1)
                truth = isinstance(bits.type, Bool)
                put(moment.world.get(f"{name}.{bits.name}"), bool(raw) if truth else raw)
        elif name in meaning.kinds:
            put(moment.world.get(name), value)
    for parameter, value in event.parameters.items():
        if parameter not in moment.parameters:
            kind_of = Bool() if isinstance(value, bool) else None
            if parameter.startswith("before ") or parameter == "request in work":
                kind_of = Bool()
                value = bool(value)  # noqa: PLW2901
            meant = (
                meaning.of_kind(f"{parameter} @{moment.key}", parameter, kind_of)
                if kind_of
                else meaning.parameter(moment, parameter)
            )
            moment.parameters[parameter] = meant
        put(moment.parameters[parameter], value)
    for name, condition in protocol.conditions.items():
        found[f"condition {name} @{moment.key}"] = condition.assumed
    return found


def answers(
    meaning: Meaning,
    model: Model,
    environment: Environment,
    numbers: dict[str, int | bool],
    inside: frozenset[str],
) -> None:
    """Add what the dictionary answers in this state."""
    functions = PLAIN | model.dictionary.functions | model.image.functions
    for name in inside & set(meaning.answers.asked):
        function, values = meaning.answers.asked[name]
        arguments: list[Value] = []
        for value in values:
            if isinstance(value, Content):
                known = environment.parameters.get(value.name.partition(" @")[0])
                arguments.append(known if isinstance(known, bytes) else b"")
            else:
                number = settled(value, numbers, meaning.symbols)
                arguments.append(-1 if number is None else number)
        if -1 in arguments:
            continue
        try:
            answer = functions[function](environment, tuple(arguments))
        except StopIteration:  # an index that is no assignment
            continue
        if isinstance(answer, int):
            numbers[name] = answer


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("conditions", [False, True])
def test_guards_and_updates_agree_with_the_interpreter(device: str, conditions: bool) -> None:  # noqa: FBT001
    meaning, model = models(device, conditions=conditions)
    protocol = model.protocol
    random = Random(f"{device} {conditions}")
    guards: dict[RuleName, set[bool]] = {}
    updated: set[str] = set()
    for machine in protocol.machines.values():
        for source in machine.inputs:
            scope = Scope(machine.name, source.name)
            moment = Moment(meaning.world(), scope, f"agree {machine.name}.{source.name}", {})
            rows = [r for r in rows_of(machine) if r.input == source.name]
            terms = {r.name: meaning.truth(r.guard, moment) for r in rows}
            inside = frozenset[str]().union(*map(meaning.symbols.inside, terms.values()))
            for _ in range(40):
                state = shaken(random, model, random.choice(reachable(device)))
                event = event_of(random, model, machine.name, source.name, state)
                environment = Environment(state.slots, state.objects, event.parameters)
                numbers = numbers_of(meaning, model, state, event, moment)
                answers(meaning, model, environment, numbers, inside)
                for item in rows:
                    compiled = model.named(RuleName(machine.name, item.name))
                    says = True if compiled.guard is None else compiled.guard(environment)
                    means = settled(terms[item.name], numbers, meaning.symbols)
                    if isinstance(says, Pattern) or means is None:
                        continue
                    assert means == says, (machine.name, item.name, event, numbers)
                    guards.setdefault(compiled.name, set()).add(bool(says))
                    for (slot, getter), update in zip(
                        compiled.updates, getattr(item, "updates", ()), strict=False
                    ):
                        name = next(n for n, s in model.slots.items() if s == slot)
                        meant = meaning.value(update.value, moment, meaning.kinds[name])
                        wanted = getter(environment)
                        if isinstance(meant, str | Content) or not isinstance(wanted, int):
                            continue
                        found = settled(meant, numbers, meaning.symbols)
                        if found is not None:
                            assert found == wanted, (machine.name, item.name, name)
                            updated.add(name)
    rules = sum(len(rows_of(machine)) for machine in protocol.machines.values())
    assert len(guards) > rules * 0.9
    assert sum(len(seen) == 2 for seen in guards.values()) > rules * 0.3
    assert len(updated) > 8


# --- logic with what is not known -----------------------------------------------------------------

TRUTHS = ("al.error", "sdo.complete")
NUMBERS = ("sdo.index", "sdo.size")
CONDITIONS = ("mailbox_checked", "watchdog_in_safeop")
KNOWN = st.none() | st.integers(0, 12)


def expressions() -> st.SearchStrategy[Expression]:
    """Truths made of what is known, of what may be known, of conditions, and of `any`."""
    names = st.sampled_from(NUMBERS).map(Name)
    plain = st.one_of(st.integers(0, 12).map(Literal), names)
    numbers = st.recursive(
        plain,
        lambda inner: st.one_of(
            st.builds(Binary, st.sampled_from("+-"), inner, inner),
            st.builds(Binary, st.sampled_from("*/%"), inner, st.integers(0, 3).map(Literal)),
        ),
        max_leaves=3,
    )
    items = st.lists(numbers | st.builds(Range, numbers, numbers), min_size=1, max_size=2)
    compared = st.builds(Binary, st.sampled_from(sorted(COMPARED)), numbers, numbers)
    leaves = st.one_of(
        st.booleans().map(Literal),
        st.sampled_from((*TRUTHS, *CONDITIONS)).map(Name),
        compared,
        st.builds(Binary, st.just("=="), numbers, st.just(AnyValue())),
        st.builds(In, numbers, items.map(tuple)),
    )
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.builds(Unary, st.just("not"), inner),
            st.builds(Binary, st.sampled_from(sorted(LOGIC)), inner, inner),
            st.builds(Conditional, inner, inner, inner),
        ),
        max_leaves=5,
    )


@cache
def reference() -> tuple[Meaning, Model]:
    protocol = load_device("reference")
    return Meaning(protocol), Model(protocol)


@given(
    expression=expressions(),
    numbers=st.tuples(KNOWN, KNOWN),
    truths=st.tuples(st.none() | st.booleans(), st.none() | st.booleans()),
)
def test_what_the_interpreter_knows_the_solver_proves(
    expression: Expression,
    numbers: tuple[int | None, ...],
    truths: tuple[bool | None, ...],
) -> None:
    meaning, model = reference()
    held = dict(zip((*NUMBERS, *TRUTHS), (*numbers, *truths), strict=True))
    state = model.initial
    for name, value in held.items():
        state = state.having(model.slots[name], UNKNOWN if value is None else value)
    says = model.expression(expression, Scope(), Bool())(Environment(state.slots, {}, {}))
    known = {name: value for name, value in held.items() if value is not None}
    means = meaning.truth(expression, Moment(meaning.world().having(known), Scope(), "known", {}))
    if isinstance(says, bool):
        differs = negated(equal(means, says))
        assert Solver(meaning.symbols).ask((differs,)) is Answer.NO
    else:
        open_ = {name for name, value in held.items() if value is None} | set(CONDITIONS)
        parts = tuple(nodes_in(expression))
        assert any(
            isinstance(part, AnyValue)
            or (isinstance(part, Name) and part.path in open_)
            or (isinstance(part, Binary) and part.operator in DIVISIONS)
            for part in parts
        )


# --- solver against brute force -------------------------------------------------------------------


def commands(device: str) -> tuple[Meaning, Model, list[State]]:
    """A drive in OP in each of its states, conditions as assumed."""
    meaning, model = (
        Meaning(load_device(device), abstract=False),
        Model(load_device(device), assuming=True),
    )
    base = model.initial.having(model.slots["al.state"], model.row("al_state", "OP"))
    option = model.protocol.words["quick_stop_code"].key
    assert option is not None
    base = base.keeping(option, b"\2\0")
    slot = model.slots["ds402.state"]
    return meaning, model, [base.having(slot, value) for value in model.state_names("ds402")]


def test_every_control_word_is_taken_by_one_rule_as_the_solver_proves() -> None:
    meaning, model, states = commands("reference-drive")
    world = meaning.world()
    moment = Moment(world, Scope("ds402", "command"), "brute", {})
    machine = meaning.protocol.machines["ds402"]
    chains, solver = Chains(meaning), Solver(meaning.symbols)
    rows = [r for r in rows_of(machine) if r.input == "command"]
    here = [chains.enabled(r, machine, moment) for r in rows]
    assert solver.ask((two_of(here),)) is Answer.NO
    assert solver.ask((negated(any_of(here)),)) is Answer.NO
    # all bits that guards speak of, and one that they do not: others cannot matter
    fields = {b.name: b.low for b in meaning.protocol.words["control_word"].fields}
    spoken = {
        symbol.rpartition(".")[2]
        for term in here
        for symbol in meaning.symbols.inside(term)
        if symbol.startswith("word control_word.")
    }
    assert spoken == {
        "switch_on",
        "enable_voltage",
        "quick_stop",
        "enable_operation",
        "fault_reset",
    }
    word = model.slots["word control_word"]
    for state in states:
        for bits in itertools.product((0, 1), repeat=len(spoken)):
            raw = sum(bit << fields[name] for bit, name in zip(bits, sorted(spoken), strict=True))
            for other, reset in itertools.product((0, 0x100), (False, True)):
                now = state.having(word, raw | other)
                taken = step(model, now, Event("ds402", "command", {"reset": reset}))
                assert all(done.rules for done in taken)  # a gap is one, too
                assert len({done.rules[0] for done in taken}) == 1


def test_the_solver_counts_the_control_words_of_each_rule_as_brute_force_does() -> None:
    meaning, model, states = commands("reference-drive")
    machine = meaning.protocol.machines["ds402"]
    chains, solver = Chains(meaning), Solver(meaning.symbols)
    word = model.slots["word control_word"]
    fields = meaning.protocol.words["control_word"].fields
    for state in states:
        environment = Environment(state.slots, {}, {"reset": True})
        current = state.slots[model.slots["ds402.state"]]
        for compiled in model.rules("ds402", "command"):
            item = next(r for r in rows_of(machine) if r.name == compiled.name.name)
            if current not in compiled.sources:
                continue
            world = meaning.world().having(
                {f"ds402.{v.name}": value for v in machine.variables
                 if isinstance(value := state.slots[model.slots[f"ds402.{v.name}"]], bool)}
                | {"ds402.state": current}
            )  # fmt: skip
            moment = Moment(world, Scope("ds402", "command"), "count", {"reset": True})
            here = chains.enabled(item, machine, moment)
            for raw in range(0, COMMANDS, STRIDE):
                values = state.having(word, raw)
                environment = Environment(values.slots, {}, {"reset": True})
                holds = compiled.guard is None or compiled.guard(environment)
                wanted = bool(holds)
                numbers: dict[str, int | bool] = {
                    f"word control_word.{b.name}": bool(raw >> b.low & 1)
                    for b in fields if isinstance(b.type, Bool)
                }  # fmt: skip
                for name, choice in meaning.protocol.choices.items():
                    slot = model.slots[f"choice {name}"]
                    names = [way.name for way in choice.alternatives]
                    numbers[f"choice {name}"] = names.index(str(state.slots[slot]))
                found = settled(here, numbers, meaning.symbols)
                if found is not None:
                    assert found == wanted, (compiled.name, hex(raw))
    assert solver.questions == 0


def test_unknown_to_the_interpreter_is_open_to_the_solver() -> None:
    protocol = load_device("reference-drive")
    meaning, model = Meaning(protocol), Model(protocol)
    machine = protocol.machines["mailbox"]
    chains, solver = Chains(meaning), Solver(meaning.symbols)
    moment = Moment(meaning.world(), Scope("mailbox", "mail"), "open", {})
    rows = {r.name: r for r in rows_of(machine)}
    taken = chains.enabled(rows["mail_taken"], machine, moment)
    refused = chains.enabled(rows["mail_refused"], machine, moment)
    odd = meaning.parameter(moment, "channel")
    assert not isinstance(odd, str | Content)
    given = equal(odd, 1)
    # a device may refuse an odd header or take it, but never both
    assert solver.ask((given, taken)) is Answer.YES
    assert solver.ask((given, refused)) is Answer.YES
    assert solver.ask((taken, refused)) is Answer.NO
    state = model.initial.having(model.slots["al.state"], model.row("al_state", "PREOP"))
    state = state.having(model.slots["choice mailbox_support"], "present")
    for name, value in usual_mailbox(model).items():
        state = state.having(model.slots[name], value)
    fields: dict[str, Value] = {
        "channel": 1, "reserved": 0, "address": 0, "counter": 0, "length": 8, "priority": 0,
        "type": model.row("mailbox_type", "coe"), "payload": bytes(8),
    }  # fmt: skip
    steps = step(model, state, Event("mailbox", "mail", fields, ("mailbox",)))
    assert {done.rules[0].name for done in steps} == {"mail_taken", "mail_refused"}


def test_signed_numbers_keep_their_sign() -> None:
    meaning = Meaning(load_device("reference"))
    number = meaning.of_kind("s", "s", SInt(8))
    assert not isinstance(number, str | Content)
    solver = Solver(meaning.symbols)
    assert solver.ask((equal(number, -128),)) is Answer.YES
    assert solver.ask((equal(number, 128),)) is Answer.NO
