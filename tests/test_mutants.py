"""Tests of mutants: texts as built, mistakes in them, and what finds these."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Final, TypeAlias

import pytest

from ecatspec.conformance.adapters.in_process import Guarded
from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.mutation import kill_analysis
from ecatspec.conformance.mutation.fates import Fate
from ecatspec.conformance.mutation.kill_analysis import analyse
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.complete.faults import kills
from ecatspec.generators.complete.finite_cover import complete_suites
from ecatspec.generators.complete.suites import state_cover_suite
from ecatspec.generators.mutation.equivalents import Equivalents
from ecatspec.generators.mutation.mutants import DEFINE, Operator, mutants
from ecatspec.generators.suite import GENERATORS, all_cases
from ecatspec.model.analysis.as_built import as_built
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import device_names, load_device, load_faults, load_file, plant
from ecatspec.spec.language.pretty_expressions import pretty_expression

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.conformance.mutation.fates import Analysis
    from ecatspec.generators.cases.case import Case, Limits
    from ecatspec.generators.mutation.mutants import Mutant
    from ecatspec.model.core.state import Event, Step
    from ecatspec.spec.language.ir import Definition, Protocol, Rule

DRIVE = "reference-drive"
SMALL = "reference"
on_small, on_drive = (pytest.mark.xdist_group(f"mutants of {name}") for name in (SMALL, DRIVE))
"""What is shown and proved of the device stays in one process: it is worked out once there."""


def written(folder: Path, text: str) -> Protocol:
    """A device of the standard and some more lines."""
    file = folder / "planted.ecs"
    file.write_text(f'device planted extends standard "x"\n\n{text}', encoding="utf-8")
    return load_file(file)


# --- texts as built -------------------------------------------------------------------------------

MACHINE = """
machine extra "a machine"
  states   al_state { INIT, PREOP, SAFEOP } initial INIT
  variable count : u8 = 0
  variable truth : bool = false
  variable code  : al_status_code = no_error
  variable other : al_status_code = no_error
  input    event(number: u8, flag: bool)

  rule planted [AL-01]
    from INIT on event
    when number in { 1, 3..5 } and flag and count < number
    goto PREOP
    set  count = 7,
         truth = true,
         code = any,
         other = no_error

  rule back [AL-01]
    from PREOP on event
    when refused_in_op == stay and flag
    goto SAFEOP

  rule stayed [AL-01]
    from SAFEOP on event
    when refused_in_op == stay
    goto INIT

  rule dropped [AL-01]
    from SAFEOP on event
    when refused_in_op == drop_to_safeop
    goto PREOP
"""


def guards(protocol: Protocol) -> dict[str, str]:
    return {
        rule.name: "" if rule.guard is None else pretty_expression(rule.guard)
        for rule in protocol.machines["extra"].rules
    }


def test_a_rule_that_cannot_fire_is_gone_and_what_holds_is_not_asked(tmp_path: Path) -> None:
    protocol = written(tmp_path, MACHINE)
    whole = guards(protocol)
    assert guards(as_built(protocol)) == {"planted": whole["planted"], "dropped": ""}


def test_choices_go_as_given(tmp_path: Path) -> None:
    protocol = written(tmp_path, MACHINE)
    whole = guards(protocol)
    built = as_built(protocol, {"refused_in_op": "stay"})
    assert guards(built) == {"planted": whole["planted"], "back": "flag", "stayed": ""}
    assert built.pins["refused_in_op"].alternative == "stay"


def test_what_a_text_pins_is_not_chosen(tmp_path: Path) -> None:
    protocol = written(tmp_path, f"pin refused_in_op = stay [AL-01]\n{MACHINE}")
    built = as_built(protocol, {"refused_in_op": "drop_to_safeop"})
    assert guards(built).keys() == {"planted", "back", "stayed"}


def test_every_choice_goes_one_way() -> None:
    built = as_built(load_device(DRIVE))
    assert built.pins.keys() == built.choices.keys()


FOLDED = {
    "always": "true",
    "not always": "false",
    "always and al.error": "al.error",
    "al.error and always": "al.error",
    "never and al.error": "false",
    "never or al.error": "al.error",
    "al.error or never": "al.error",
    "always or al.error": "true",
    "al.error and mailbox_accepted": "al.error and mailbox_accepted",
    "al.error or al.identified and never": "al.error",
    "not (al.error and always)": "not al.error",
    "if always then 1 else 2": "1",
    "if never then 1 else 2": "2",
    "if al.error then always else not never": "true",
    "if al.error then always and fed else never": "if al.error then fed else false",
    "length(sdo.data) == 0 and always": "length(sdo.data) == 0",
    "length(sdo.data) == (if never then 1 else 2)": "length(sdo.data) == 2",
    "length(sdo.data) in { 7, (if always then 1 else 2) }": "length(sdo.data) in { 7, 1 }",
    "lesser(if always then 1 else 2, sdo.size) > 3": "lesser(1, sdo.size) > 3",
}


def test_folding(tmp_path: Path) -> None:
    lines = [
        'define always "x" = refused_in_op == drop_to_safeop [AL-01]',
        'define never "x" = refused_in_op == stay [AL-01]',
        *(f'define planted_{n} "x" = {text} [AL-01]' for n, text in enumerate(FOLDED)),
    ]
    built = as_built(written(tmp_path, "\n".join(lines)))
    found = {
        text: pretty_expression(built.definitions[f"planted_{n}"].value)
        for n, text in enumerate(FOLDED)
    }
    assert found == FOLDED


Exchange = tuple[str, tuple[object, ...], object]


class Recorder:
    """An adapter that keeps what it was asked since power-on, and what the device answered."""

    def __init__(self, adapter: Adapter) -> None:
        self.adapter = adapter
        self.log: list[Exchange] = []

    def reset(self) -> None:
        self.log = []
        self.adapter.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        answer = self.adapter.read(address, length)
        self.log.append(("read", (address, length), answer))
        return answer

    def write(self, address: int, data: bytes) -> int:
        answer = self.adapter.write(address, data)
        self.log.append(("write", (address, data), answer))
        return answer

    def advance(self, seconds: float) -> None:
        self.adapter.advance(seconds)
        self.log.append(("advance", (seconds,), None))

    def local(self, event: str) -> None:
        self.adapter.local(event)  # type: ignore[attr-defined]
        self.log.append(("local", (event,), None))

    def close(self) -> None:
        self.adapter.close()

    def describe(self) -> Description:
        return self.adapter.describe()


def adapter_of(protocol: Protocol) -> Guarded:
    return Guarded(VirtualAdapter(VirtualSubDevice(protocol), described(protocol)))


def few(model: Model, limits: Limits, depth: str) -> Iterator[Case]:
    """Yield a short case of each kind."""
    kinds: set[tuple[str, ...]] = set()
    for case in all_cases(model, limits, depth):
        kind = tuple(case.name.split("/")[:2])
        if kind not in kinds and len(case.stimuli) < 12:
            kinds.add(kind)
            yield case


def test_a_device_as_built_answers_as_the_device() -> None:
    protocol = load_device(DRIVE)
    model = Model(protocol)
    recorder = Recorder(adapter_of(protocol))
    runner = Runner(model, recorder, recorder.describe())
    built = adapter_of(as_built(protocol))
    asked: Counter[str] = Counter()
    for case in few(model, NO_LIMITS, "quick"):
        assert runner.executor.judge(case).outcome is Outcome.PASS
        asked[case.layer] += 1
        built.reset()
        for name, arguments, answer in recorder.log:
            assert getattr(built, name)(*arguments) == answer, case.name
    assert asked.keys() == {
        *("al", "coe", "ds402", "mailbox", "process_data", "sdo", "sdo_information"),
    }


# --- mistakes -------------------------------------------------------------------------------------


@cache
def built_of(device: str) -> Protocol:
    return as_built(load_device(device))


@cache
def mutants_of(device: str) -> tuple[Mutant, ...]:
    return tuple(mutants(built_of(device)))


PLANTED = {
    (Operator.NEGATED, "number in { 1, 3..5 } and flag and count < number"): {
        "not (number in { 1, 3..5 } and flag and count < number)"
    },
    (Operator.UNCHECKED, "number in { 1, 3..5 } and flag and count < number"): {
        "flag and count < number",
        "number in { 1, 3..5 } and count < number",
        "number in { 1, 3..5 } and flag",
    },
    (Operator.NARROWED, "number in { 1, 3..5 }"): {"number in { 3..5 }", "number in { 1 }"},
    (Operator.OFF_BY_ONE, "1"): {"0", "2"},
    (Operator.OFF_BY_ONE, "3"): {"2", "4"},
    (Operator.OFF_BY_ONE, "5"): {"4", "6"},
    (Operator.OFF_BY_ONE, "count < number"): {"count <= number"},
    (Operator.WRONG_TARGET, "PREOP"): {"stays", "SAFEOP"},
    (Operator.UPDATE_DROPPED, "count = 7"): {"nothing"},
    (Operator.UPDATE_DROPPED, "truth = true"): {"nothing"},
    (Operator.UPDATE_DROPPED, "other = no_error"): {"nothing"},
    (Operator.WRONG_VALUE, "other = no_error"): {"al_status_code.unspecified_error"},
    (Operator.WRONG_VALUE, "count = 7"): {"0"},
    (Operator.WRONG_VALUE, "truth = true"): {"false"},
}


def test_each_operator_gives_what_it_says(tmp_path: Path) -> None:
    """What is left open cannot go wrong: nothing is done to `code = any`."""
    protocol = written(tmp_path, MACHINE)
    found = [mutant for mutant in mutants(protocol) if mutant.place == "extra.planted"]
    said: dict[tuple[Operator, str], set[str]] = {}
    for mutant in found:
        said.setdefault((mutant.operator, mutant.before), set()).add(mutant.after)
        first, *others = mutant.protocol.machines["extra"].rules
        assert (first.name, [rule.name for rule in others]) == (
            "planted",
            ["back", "stayed", "dropped"],
        )
    assert said == PLANTED
    assert len(found) == sum(map(len, PLANTED.values()))


def test_a_mutant_does_what_it_says(tmp_path: Path) -> None:
    protocol = written(tmp_path, MACHINE)
    for mutant in mutants(protocol):
        if mutant.place != "extra.planted":
            continue
        rule = mutant.protocol.machines["extra"].rules[0]
        assert rule.guard is not None
        updates = {u.variable: pretty_expression(u.value) for u in rule.updates}
        match mutant.operator:
            case Operator.NEGATED | Operator.UNCHECKED:
                assert pretty_expression(rule.guard) == mutant.after
            case Operator.NARROWED:
                assert pretty_expression(rule.guard).startswith(mutant.after)
            case Operator.OFF_BY_ONE:
                assert mutant.after in pretty_expression(rule.guard)
            case Operator.WRONG_TARGET:
                assert (rule.target or "stays") == mutant.after
            case Operator.UPDATE_DROPPED:
                assert updates.keys() == {"count", "truth", "code", "other"} - {
                    mutant.before.split()[0]
                }
            case _:
                assert updates[mutant.before.split()[0]] == mutant.after


def dropped(device: str, place: str) -> dict[str, tuple[frozenset[str], bool]]:
    return {
        mutant.before: (mutant.machines, mutant.follows)
        for mutant in mutants_of(device)
        if mutant.place == place and mutant.operator is Operator.OUTPUT_DROPPED
    }


def test_a_dropped_output_names_the_machines_that_it_concerns() -> None:
    assert dropped(DRIVE, "al.init_to_preop") == {
        "give mailbox.start": (frozenset({"al", "mailbox"}), False)
    }
    assert dropped(DRIVE, "ds402.mains_back") == {"later ds402.look": (frozenset({"ds402"}), False)}
    assert dropped(DRIVE, "sdo.upload_no_object") == {
        "send sdo_abort": (frozenset({"sdo", "shown"}), True)
    }
    machine = built_of(DRIVE).machines["sdo"]
    storing = {f"sdo.{rule.name}" for rule in machine.rules if rule.stores}
    assert storing
    assert all(any(b.startswith("store ") for b in dropped(DRIVE, p)) for p in storing)


def test_a_wrong_definition_concerns_all_that_speak_of_it() -> None:
    alive = [m for m in mutants_of(DRIVE) if m.place == f"{DEFINE}mailbox_alive"]
    assert {(m.operator, m.after) for m in alive} == {
        (Operator.NEGATED, "not (mailbox_demanded and mailbox_set)"),
        (Operator.UNCHECKED, "mailbox_set"),
        (Operator.UNCHECKED, "mailbox_demanded"),
    }
    assert {m.machines for m in alive} == {frozenset({"emergency", "mailbox", "shown"})}
    assert not any(m.follows for m in alive)


def parts(protocol: Protocol) -> dict[str, Rule | Definition]:
    """Give all rules and definitions by place."""
    found: dict[str, Rule | Definition] = {
        f"{machine.name}.{rule.name}": rule
        for machine in protocol.machines.values()
        for rule in machine.rules
    }
    return found | {f"{DEFINE}{name}": each for name, each in protocol.definitions.items()}


def test_each_mutant_differs_in_one_place_and_no_two_are_the_same() -> None:
    built = parts(built_of(DRIVE))
    seen: Counter[object] = Counter()
    for mutant in mutants_of(DRIVE):
        wrong = parts(mutant.protocol)
        assert [p for p, part in wrong.items() if part is not built[p]] == [mutant.place]
        assert wrong.keys() == built.keys()
        assert wrong[mutant.place] != built[mutant.place], str(mutant)
        assert mutant.at == built[mutant.place].at
        repaired = {
            name: replace(machine, rules=built_of(DRIVE).machines[name].rules)
            for name, machine in mutant.protocol.machines.items()
        }
        definitions = built_of(DRIVE).definitions
        sound = replace(mutant.protocol, machines=repaired, definitions=definitions)
        assert sound == built_of(DRIVE)
        seen[mutant.place, repr(wrong[mutant.place])] += 1
    assert set(seen.values()) == {1}


@pytest.mark.parametrize("device", device_names())
def test_no_two_mutants_are_described_alike(device: str) -> None:
    described = Counter((m.place, m.operator, m.before, m.after) for m in mutants_of(device))
    assert described
    assert set(described.values()) == {1}


def test_mistakes_in_the_same_words_say_which_one_they_are() -> None:
    """`subindex > 0` and `... != 0` stand there; both numbers can be off by one."""
    found = [
        m.before
        for m in mutants_of(DRIVE)
        if (m.place, m.after) == (f"{DEFINE}entry_locked", "1")
        and m.operator is Operator.OFF_BY_ONE
    ]
    assert found == [f"0 (number {n} of 3)" for n in (1, 2, 3)]


NUMBERS = {
    Operator.NEGATED: 246,
    Operator.UNCHECKED: 500,
    Operator.NARROWED: 42,
    Operator.OFF_BY_ONE: 231,
    Operator.WRONG_VALUE: 377,
    Operator.WRONG_TARGET: 273,
    Operator.UPDATE_DROPPED: 162,
    Operator.OUTPUT_DROPPED: 129,
}


def test_golden_numbers() -> None:
    assert Counter(mutant.operator for mutant in mutants_of(DRIVE)) == NUMBERS


def test_a_check_is_what_lets_other_inputs_through() -> None:
    assert {mutant.operator for mutant in mutants_of(DRIVE) if mutant.checks} == {
        *(Operator.NEGATED, Operator.UNCHECKED, Operator.NARROWED, Operator.OFF_BY_ONE),
    }


# --- kill analysis --------------------------------------------------------------------------------


@cache
def few_cases() -> kill_analysis._Ground:
    """What the small device shows in a suite of few cases."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kill_analysis, "all_cases", few)
        patch.setattr(kill_analysis, "complete_suites", lambda *_: ())
        patch.setattr(kill_analysis, "_equivalents", lambda *_: proofs(SMALL))
        return kill_analysis._Ground(SMALL, "quick", None)  # noqa: SLF001  made once for all tests


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Analysis]:
    """Analyse some mutants of the small device with few cases."""
    ground = few_cases()
    monkeypatch.setattr(kill_analysis, "_Ground", lambda *_: ground)

    def analysed(*sample: Mutant, own: bool = False, only: str = "") -> Analysis:
        monkeypatch.setattr(kill_analysis, "mutants", lambda _: iter(sample))
        return analyse(SMALL, own=own, only=only, depth="quick")

    return analysed


def wrong_in(device: str, mistake: Mistake) -> Mutant:
    """Give the mutant of a device that has this wrong; what was there may be its beginning."""
    place, operator, before, *rest = mistake
    after = rest[0] if rest else "nothing"
    (found,) = (
        mutant
        for mutant in mutants_of(device)
        if (mutant.place, mutant.operator, mutant.after) == (place, operator, after)
        and mutant.before.startswith(before)
    )
    return found


def named(place: str, operator: Operator, before: str, after: str = "nothing") -> Mutant:
    """Give the mutant of the small device that has this wrong."""
    return wrong_in(SMALL, (place, operator, before, after))


Mistake: TypeAlias = "tuple[str, Operator, str] | tuple[str, Operator, str, str]"
WRONG = Operator.WRONG_VALUE
SILENT = Operator.OUTPUT_DROPPED
EARLY = Operator.UNCHECKED
DROPPED = Operator.UPDATE_DROPPED
UNSPECIFIED = "al_status_code.unspecified_error"
TOO_HIGH = "too_high(index, subindex, value)"
WHOLE = "object_exists(sdo.index) and not is_plain_variable(sdo.index)"
LOST = "not error and mailbox_wrong and mailbox_support == present"
TOLERATED = ("mailbox.nothing_repeated", DROPPED, "acknowledged")
FATES: Final[Mapping[Mistake, tuple[Fate, str]]] = {
    ("al.bootstrap_refused", EARLY, "free and", "free"): (Fate.KILLED, "AL-04"),
    ("sdo.upload_no_object", SILENT, "send sdo_abort"): (Fate.KILLED, "SDO-07"),
    ("al.preop_to_safeop", WRONG, "code = no_error", UNSPECIFIED): (Fate.EQUIVALENT, ""),
    ("al.safeop_to_op", DROPPED, "identified"): (Fate.EQUIVALENT, ""),
    ("sdo_information.list_goes_on", Operator.NEGATED, "left > 0", "not (left > 0)"): (
        Fate.KILLED,
        "INF-04",
    ),
    TOLERATED: (Fate.TOLERATED, ""),
    ("sdo.value_too_high", EARLY, "value_fits", TOO_HIGH): (Fate.EQUIVALENT, ""),
    ("sdo.value_taken_by_segments", SILENT, "store value"): (Fate.UNNOTICED, ""),
}
"""What becomes of a mutant, and a clause that is cited."""


def test_what_becomes_of_mutants(monkeypatch: pytest.MonkeyPatch) -> None:
    sample = [named(*mistake) for mistake in FATES]
    names = [case.name for case in few(Model(load_device(SMALL)), NO_LIMITS, "quick")]
    monkeypatch.setattr(kill_analysis, "all_cases", few)
    monkeypatch.setattr(kill_analysis, "complete_suites", lambda *_: ())
    monkeypatch.setattr(kill_analysis, "mutants", lambda _: iter(sample))
    told: list[str] = []
    found = analyse(SMALL, depth="quick", workers=2, progress=lambda _, __, what: told.append(what))
    assert [each.mutant for each in found.fated] == sample
    for each, (fate, clause) in zip(found.fated, FATES.values(), strict=True):
        assert each.fate is fate, str(each.mutant)
        assert each.case in (names if fate in {Fate.KILLED, Fate.TOLERATED} else [""])
        assert (clause in each.clauses) if clause else not each.clauses, str(each.mutant)
    assert found.cases == len(names)
    assert told[: len(names)] == [f"{SMALL}: {name}" for name in names]
    assert set(told[len(names) :]) == {f"{SMALL}: {mutant.place}" for mutant in sample}

    assert (found.count(Fate.KILLED), found.count(Fate.UNNOTICED, SILENT)) == (3, 1)
    assert (found.score(), found.score(SILENT), found.score(WRONG)) == (0.75, 0.5, 1.0)
    assert list(found.survivors()) == [f"{mutant.at}: {mutant}" for mutant in sample[-1:]]


@on_small
def test_a_mutant_with_a_rule_that_means_nothing_is_killed(small: Callable[..., Analysis]) -> None:
    place = "sdo_information.object_undeclared_described"
    (found,) = small(named(place, SILENT, "send information_object")).fated
    assert (found.fate, found.case) == (Fate.KILLED, "sdo_information/no_object/0000")


def hang() -> None:
    while True:
        pass


def fail() -> None:
    raise ZeroDivisionError


@on_small
@pytest.mark.parametrize("end", [hang, fail])
def test_a_mutant_that_does_not_come_up_is_killed(
    small: Callable[..., Analysis], monkeypatch: pytest.MonkeyPatch, end: Callable[[], None]
) -> None:
    wrong = named(*TOLERATED)
    reset = VirtualSubDevice.reset

    def ending(device: VirtualSubDevice) -> None:
        reset(device)
        if device.model.protocol is wrong.protocol:
            end()

    monkeypatch.setattr(VirtualSubDevice, "reset", ending)
    monkeypatch.setattr(kill_analysis, "PATIENCE", 1.0)
    (found,) = small(wrong).fated
    assert (found.fate, found.case) == (Fate.KILLED, "power-on")


@on_small
@pytest.mark.parametrize("end", [hang, fail])
def test_a_mutant_that_fails_or_hangs_is_killed(
    small: Callable[..., Analysis], monkeypatch: pytest.MonkeyPatch, end: Callable[[], None]
) -> None:
    wrong = named(*TOLERATED)
    react = VirtualSubDevice.react

    def ending(device: VirtualSubDevice, event: Event) -> Step:
        taken = react(device, event)
        if wrong.place in map(str, taken.rules) and device.model.protocol is wrong.protocol:
            end()
        return taken

    monkeypatch.setattr(VirtualSubDevice, "react", ending)
    monkeypatch.setattr(kill_analysis, "PATIENCE", 1.0)
    (found,) = small(wrong).fated
    assert found.fate is Fate.KILLED
    assert "MBX-21" in found.clauses


@on_small
def test_the_shortcuts_change_nothing(small: Callable[..., Analysis]) -> None:
    """A plain run of all cases blames those mutants that are called killed, and no others."""
    device = load_device(SMALL)
    cases = list(few(Model(device), NO_LIMITS, "quick"))
    found = small(*(named(*mistake) for mistake in [*FATES][1:]), *mutants_of(SMALL)[10::900])
    for each in found.fated:
        adapter = adapter_of(each.mutant.protocol)
        runner = Runner(Model(device), adapter, adapter.describe())
        blamed = next((c.name for c in cases if runner.executor.judge(c).outcome in BLAMING), "")
        assert bool(blamed) is (each.fate is Fate.KILLED), f"{each.mutant}: {blamed or each.case}"
    assert {each.fate for each in found.fated} == set(Fate)


@on_small
def test_the_finite_machines_speak_when_no_case_is_left(
    small: Callable[..., Analysis], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What shows in the last of many cases only is a mistake, whatever else is the same."""
    wrong = named("al.bootstrap_refused", EARLY, "free and", "free")
    ground = few_cases()
    heard = kill_analysis.Heard(wrong.protocol)
    telling = next(shown for shown in ground.shown if heard.differs(shown.log))
    silent = next(shown for shown in ground.shown if not heard.differs(shown.log))
    monkeypatch.setattr(ground, "_touched", lambda *_: [*[silent] * 100, telling])
    monkeypatch.setattr(ground, "_equal", lambda *_: True)
    (found,) = small(wrong).fated
    assert (found.fate, found.case) == (Fate.KILLED, telling.case.name)


def test_the_finite_machines_know_no_times(monkeypatch: pytest.MonkeyPatch) -> None:
    model = Model(load_device(DRIVE))
    cases = [c for c in GENERATORS["process"](model, NO_LIMITS) if c.name.endswith("/watchdog")]
    monkeypatch.setattr(kill_analysis, "all_cases", lambda *_: cases)
    monkeypatch.setattr(kill_analysis, "complete_suites", lambda *_: ())
    monkeypatch.setattr(kill_analysis, "_machines", lambda *_: [])
    monkeypatch.setattr(kill_analysis, "_equivalents", lambda *_: None)
    ground = kill_analysis._Ground(DRIVE, "quick", None)  # noqa: SLF001  the fates, without a report
    monkeypatch.setattr(ground, "explored", ground.steps)
    monkeypatch.setattr(ground, "_explored", lambda _: True)
    shorter = wrong_in(DRIVE, (f"{DEFINE}watchdog_time", Operator.OFF_BY_ONE, "2", "1"))
    unseen = wrong_in(DRIVE, ("al.safeop_to_op", DROPPED, "identified"))
    assert ground.fate(shorter).fate is Fate.UNNOTICED
    assert ground.fate(unseen).fate is Fate.EQUIVALENT


# --- proofs ---------------------------------------------------------------------------------------

IN_VAIN: Final[Mapping[str, Mistake]] = {
    "the device raises no emergency": ("emergency.emergency_sent", SILENT, "send emergency"),
    "no text of this device refuses segments for their size": (
        "sdo.segment_of_wrong_size",
        SILENT,
        "send sdo_abort",
    ),
    "of several codes the first is sent, which is that of the other rule": (
        "sdo.upload_no_object",
        EARLY,
        "not complete and no_object",
        "no_object",
    ),
    "nothing is under way when a request comes": (
        "sdo_information.object_described",
        Operator.WRONG_TARGET,
        "WAITING",
        "stays",
    ),
    "nobody can tell in which state it rests": (
        "sdo_information.answer_complete",
        Operator.WRONG_TARGET,
        "WAITING",
        "LISTING",
    ),
    "what only changes that state need not come": (
        "mailbox.started",
        SILENT,
        "give sdo_information.start",
    ),
    "the device has no state BOOT": ("al.boot_kept", Operator.WRONG_TARGET, "stays", "SAFEOP"),
    "the object 0x1000 is declared": (
        "sdo_information.object_missing",
        Operator.OFF_BY_ONE,
        "0x1000",
        "0x1001",
    ),
    "the value has four bits": (f"{DEFINE}no_service", Operator.OFF_BY_ONE, "15", "16"),
    "what changes nothing need not be asked for": (
        "ds402.fault_stays",
        EARLY,
        "not reset or cause",
        "cause",
    ),
    "a device need not be told what it holds": (
        "sdo.upload_complete",
        EARLY,
        "length(data) >= size and not sdo.complete and declared(sdo.index, sdo.subindex)",
        "length(data) >= size and not sdo.complete",
    ),
    "what is uploaded, and no object as a whole, is declared": (
        "sdo.upload_ended",
        EARLY,
        "sdo.complete or not declared(sdo.index, sdo.subindex)",
        "sdo.complete",
    ),
    "no variable is uploaded as a whole": (
        f"{DEFINE}transfer_value",
        EARLY,
        WHOLE,
        "object_exists(sdo.index)",
    ),
    "a download in segments was of the right length when it began": (
        "sdo.object_taken_by_segments",
        EARLY,
        "complete and exact and complete_in_range(index, subindex, value) and segmented",
        "complete and complete_in_range(index, subindex, value) and segmented",
    ),
    "the last entry of no object has a range": (
        "sdo.object_out_of_range",
        EARLY,
        "complete and exact and not complete_in_range(index, subindex, value)",
        "exact and not complete_in_range(index, subindex, value)",
    ),
    "what comes next is taken alike in both states": (
        "sdo_information.description_fragment",
        Operator.WRONG_TARGET,
        "stays",
        "WAITING",
    ),
    "the watchdog expires in OP only": (
        "al.watchdog_in_safeop",
        Operator.WRONG_TARGET,
        "stays",
        "OP",
    ),
    "nothing but a PDO has bits": (
        f"{DEFINE}too_many_bits",
        EARLY,
        "is_mapping(index) and subindex == 0 and",
        "subindex == 0 and pdo_bits(index, number(value)) > pdo_capacity * 8",
    ),
    "what is left open stays as it is": (
        "ds402.mode_not_taken",
        EARLY,
        "not mode_offered and not mode_overruled",
        "not mode_offered",
    ),
}
"""Mistakes of the drive that are none, and why."""
OPEN: Final[tuple[Mistake, ...]] = (
    (f"{DEFINE}no_protocol", Operator.OFF_BY_ONE, "6", "5"),
    ("al.mailbox_taken_away", EARLY, LOST, "mailbox_wrong and mailbox_support == present"),
)
"""Mistakes of the drive that show only where the texts say nothing."""
REAL: Final[tuple[Mistake, ...]] = (
    ("al.init_to_preop", Operator.WRONG_TARGET, "PREOP", "BOOT"),
    ("sdo_information.object_missing", Operator.OFF_BY_ONE, "0x1000", "0x0FFF"),
    (f"{DEFINE}no_service", Operator.OFF_BY_ONE, "15", "14"),
    ("ds402.fault_reset_15", EARLY, "reset and not cause", "reset"),
    ("mailbox.mail_too_short", DROPPED, "last = counter"),
    ("sdo_information.list_begun", Operator.WRONG_TARGET, "LISTING", "stays"),
    ("sdo_information.object_described", Operator.WRONG_TARGET, "WAITING", "LISTING"),
    ("mailbox.started", SILENT, "give sdo.start"),
    ("sdo.download_begun", DROPPED, "expected_toggle = false"),
    ("sdo.upload_expedited", SILENT, "send sdo_upload_expedited"),
    ("al.watchdog_in_op", Operator.WRONG_TARGET, "SAFEOP", "stays"),
    (
        f"{DEFINE}too_many_bits",
        EARLY,
        "is_mapping(index) and subindex == 0 and",
        "is_mapping(index) and pdo_bits(index, number(value)) > pdo_capacity * 8",
    ),
    ("ds402.shutdown_2", EARLY, "shutdown_commanded and power", "power"),
    (f"{DEFINE}no_protocol", Operator.OFF_BY_ONE, "6", "7"),
)


@cache
def proofs(device: str) -> Equivalents:
    built = built_of(device)
    return Equivalents(built, described(built).locals)


@cache
def some_proved() -> tuple[Mutant, ...]:
    """Give mutants of the small device that are proved to do the same."""
    return tuple(mutant for mutant in mutants_of(SMALL)[::5] if proofs(SMALL).proved(mutant))


@on_drive
@pytest.mark.parametrize("why", IN_VAIN)
def test_the_solver_proves_that_a_mistake_is_none(why: str) -> None:
    assert proofs(DRIVE).proved(wrong_in(DRIVE, IN_VAIN[why])), why


@on_drive
@pytest.mark.parametrize("mistake", REAL, ids=lambda mistake: mistake[0])
def test_the_solver_proves_nothing_of_a_mistake(mistake: Mistake) -> None:
    assert not proofs(DRIVE).proved(wrong_in(DRIVE, mistake))


@on_drive
@pytest.mark.parametrize("mistake", OPEN, ids=lambda mistake: mistake[0])
def test_the_solver_proves_that_a_mistake_shows_only_where_the_texts_end(mistake: Mistake) -> None:
    mutant = wrong_in(DRIVE, mistake)
    assert not proofs(DRIVE).proved(mutant)
    assert proofs(DRIVE).left_open(mutant)
    assert not proofs(DRIVE).proved(mutant)


@on_drive
@pytest.mark.parametrize("mistake", REAL, ids=lambda mistake: mistake[0])
def test_a_mistake_shows_where_the_texts_say_something(mistake: Mistake) -> None:
    assert not proofs(DRIVE).left_open(wrong_in(DRIVE, mistake))


@on_small
def test_what_shows_only_where_the_texts_end_is_tolerated(small: Callable[..., Analysis]) -> None:
    mutant = wrong_in(SMALL, OPEN[0])
    (found,) = small(mutant).fated
    assert (found.fate, found.case) == (Fate.TOLERATED, "")


@on_small
def test_what_is_proved_to_do_the_same_answers_the_same() -> None:
    ground = few_cases()
    assert len({mutant.place for mutant in some_proved()}) > 10
    for mutant in some_proved():
        heard = kill_analysis.Heard(mutant.protocol)
        for shown in ground.shown[::3]:
            assert not heard.differs(shown.log), f"{mutant}: {shown.case.name}"


@on_small
def test_a_proof_spares_the_cases(small: Callable[..., Analysis]) -> None:
    (found,) = small(some_proved()[0]).fated
    assert (found.fate, found.case) == (Fate.EQUIVALENT, "")


@on_small
def test_a_step_that_does_not_end_is_another_step(
    small: Callable[..., Analysis], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kill_analysis, "step", lambda *_: hang())
    monkeypatch.setattr(kill_analysis, "PATIENCE", 0.05)
    (found,) = small(named("sdo.upload_no_object", SILENT, "send sdo_abort")).fated
    assert found.fate is Fate.KILLED


# --- cases that were missing ----------------------------------------------------------------------

EDGES = "kollmorgen-s300"
AFAG = "afag-se-power"
TARGET = Operator.WRONG_TARGET
MISSING: Final[Mapping[str, tuple[str, Mistake]]] = {
    "server: sdo/server/": (DRIVE, ("sdo.upload_no_object", TARGET, "IDLE", "stays")),
    "mailbox: mailbox/refused_": (DRIVE, ("mailbox.mail_too_short", DROPPED, "last = counter")),
    "transfers: sdo/transfer/over": (DRIVE, ("mailbox.started", SILENT, "give sdo.start")),
    "events: al/events/OP/sync_lost": (AFAG, ("al.sync_lost_kept", TARGET, "stays", "INIT")),
    "drive: ds402/quick_stop/switch_on/enable_operation/word_": (
        EDGES,
        ("ds402.row_5_second", TARGET, "SWITCHED_ON", "stays"),
    ),
    "configuration: sdo/configuration/watchdog/1C12": (
        AFAG,
        ("al.watchdog_kept", TARGET, "stays", "INIT"),
    ),
    "complete: sdo/complete_and_single/": (
        DRIVE,
        ("sdo.upload_normal", DROPPED, "complete = false"),
    ),
    "information: sdo_information/object/": (
        DRIVE,
        ("sdo_information.description_goes_on", TARGET, "TELLING", "stays"),
    ),
    "transfers: sdo/transfer/beyond_and": (
        DRIVE,
        ("sdo.segment_beyond", EARLY, "toggle ==", "too_much and not sdo.late"),
    ),
    "transfers: sdo/transfer/too_early_and": (
        DRIVE,
        (
            "sdo.segment_last_too_early",
            EARLY,
            "toggle ==",
            "last and not too_much and received < size and not sdo.late",
        ),
    ),
    "server: sdo/server/idle/download_read_only_too_short": (
        DRIVE,
        (
            "sdo.download_too_short",
            EARLY,
            "not complete and present and writable_now",
            (
                "not complete and present and not size_allowed(index, subindex, size)"
                " and size < size_of(index, subindex)"
            ),
        ),
    ),
    "configuration: sdo/configuration/last_entry_in_segments_while_counted": (
        DRIVE,
        (
            "sdo.object_taken_by_segments",
            EARLY,
            "complete and exact",
            "exact and complete_in_range(index, subindex, value) and segmented",
        ),
    ),
    "transitions: al/sync_manager_0_shortest": (
        DRIVE,
        (
            f"{DEFINE}mailbox_wrong",
            Operator.OFF_BY_ONE,
            "sync_manager_0.length < minimal_mailbox",
            "sync_manager_0.length <= minimal_mailbox",
        ),
    ),
    "drive: ds402/early/": (EDGES, ("ds402.row_1", TARGET, "SWITCH_ON_DISABLED", "stays")),
    "drive: ds402/while_stopping/": (
        DRIVE,
        (
            "ds402.enable_operation_16",
            EARLY,
            "enable_commanded and quick_stop_stays",
            "enable_commanded",
        ),
    ),
    "drive: ds402/while_testing/": (
        DRIVE,
        ("ds402.initialised_before", TARGET, "stays", "NOT_READY"),
    ),
    "drive: ds402/unwatched/again": (
        DRIVE,
        ("process_data.outputs_taken_unwatched", DROPPED, "image = image"),
    ),
    "drive: ds402/disabled/": (
        DRIVE,
        ("al.process_data_taken_away", SILENT, "give ds402.disconnected"),
    ),
    "drive: ds402/mode_mapped/": (
        DRIVE,
        (
            f"{DEFINE}mode_overruled",
            EARLY,
            "al.state == OP and not cyclic",
            "not cyclic and mapped(0x1C12, 0x6060, 0)",
        ),
    ),
    "drive: ds402/quick_stop_code_8/stopped": (
        DRIVE,
        ("ds402.stopped_and_stays", TARGET, "stays", "FAULT_REACTION_ACTIVE"),
    ),
    "process: process_data/disabled_both": (
        DRIVE,
        (
            "al.process_data_taken_away",
            Operator.WRONG_VALUE,
            "code = one of { 0x0017, 0x001C, 0x001D, 0x001E }",
            "al_status_code.no_error",
        ),
    ),
    "process: process_data/longest_watchdog": (
        DRIVE,
        (f"{DEFINE}watchdog_time", Operator.OFF_BY_ONE, "25", "24"),
    ),
    "process: process_data/watchdog_not_triggered": (
        DRIVE,
        (
            f"{DEFINE}watchdog_on",
            EARLY,
            "sync_manager_2.watchdog_trigger",
            "watchdog_process_data.time > 0",
        ),
    ),
    "process: process_data/watchdog_off": (
        DRIVE,
        (
            "process_data.expired_in_op",
            EARLY,
            "al.state == OP and watchdog_on",
            "al.state == OP",
        ),
    ),
    "configuration: sdo/configuration/all_counted/1C12": (
        DRIVE,
        (
            f"{DEFINE}entries_impossible",
            EARLY,
            "pdos_impossible or objects_impossible",
            "objects_impossible",
        ),
    ),
    "configuration: sdo/configuration/map_as_much_as_it_holds/": (
        DRIVE,
        (f"{DEFINE}too_many_bits", Operator.OFF_BY_ONE, "8", "7"),
    ),
    "configuration: sdo/configuration/map_too_much/": (
        DRIVE,
        (f"{DEFINE}too_many_bits", Operator.OFF_BY_ONE, "8", "9"),
    ),
}
"""By a generator and the names of its cases: a device, and a mistake in it that they find."""


@pytest.mark.parametrize("where", MISSING)
def test_a_mistake_is_found_by_the_cases_for_it(where: str) -> None:
    generator, _, begin = where.partition(": ")
    device, mistake = MISSING[where]
    model = Model(load_device(device))
    every = GENERATORS[generator](model, NO_LIMITS)
    cases = [case for case in every if case.name.startswith(begin)]
    blamed = []
    for protocol in (built_of(device), wrong_in(device, mistake).protocol):
        adapter = adapter_of(protocol)
        runner = Runner(model, adapter, adapter.describe())
        blamed.append([c.name for c in cases if runner.executor.judge(c).outcome in BLAMING])
    assert cases
    assert not blamed[0]
    assert blamed[1]


@on_small
def test_own_are_the_rules_of_the_device(small: Callable[..., Analysis]) -> None:
    rule = named("al.safeop_to_op", DROPPED, "identified")
    mine = replace(rule, at=replace(rule.at, file="mine.ecs"))
    assert [each.mutant for each in small(rule, mine, own=True).fated] == [mine]
    assert [each.mutant for each in small(rule, mine).fated] == [rule, mine]


@on_small
def test_without_mutants_nothing_is_missed(small: Callable[..., Analysis]) -> None:
    assert small().score() == 1.0


@on_small
def test_only_mistakes_with_certain_words(
    small: Callable[..., Analysis], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = [named(*mistake) for mistake in list(FATES)[:2]]
    assert [each.mutant for each in small(one, other, only=one.place).fated] == [one]
    monkeypatch.setattr(kill_analysis, "_Ground", None)  # told before anything is run
    with pytest.raises(UserError, match=r"no mutant of reference has 'nonsense' in its descr"):
        analyse(SMALL, only="nonsense")


def test_a_device_that_is_blamed_as_it_is_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    cases = all_cases(Model(load_device(SMALL)), NO_LIMITS, "quick")
    toggles = [case for case in cases if "toggle" in case.name]
    monkeypatch.setattr(kill_analysis, "all_cases", lambda *_: toggles)
    faulty = plant(load_device(SMALL), load_faults()["toggle_ignored"])
    monkeypatch.setattr(kill_analysis, "as_built", lambda _: as_built(faulty))
    with pytest.raises(UserError, match=r"reference is blamed without a mistake in sdo/.*repair"):
        analyse(SMALL, depth="quick")


def test_the_single_faults_of_finite_machines_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kill_analysis, "all_cases", lambda *_: ())
    monkeypatch.setattr(kill_analysis, "mutants", lambda _: iter(()))
    monkeypatch.setattr(kill_analysis, "_equivalents", lambda *_: None)
    model = Model(load_device(SMALL))
    (suite,) = complete_suites(model, NO_LIMITS, (), {}, "default")
    first = replace(suite, suite=state_cover_suite(suite.found.machine))
    monkeypatch.setattr(kill_analysis, "complete_suites", lambda *_: iter((first,)))
    found = analyse(SMALL)
    (table,) = found.tables
    machine = suite.found.machine
    assert (table.name, table.states, table.inputs) == ("AL", 30, len(machine.inputs))
    assert table.kills == kills(machine, first.suite.trie())
    assert 0 < table.kills.score < 1
    assert kills(machine, suite.suite.trie()).score == 1
    assert found.cases == first.suite.tests
