"""Tests of seeded walks, of tokens of cases, and of shrinking."""

from __future__ import annotations

import base64
import json
import random
import re
import zlib
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, get_args

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.run.dut_knowledge import SHAPE
from ecatspec.conformance.run.runner import Runner
from ecatspec.conformance.run.shrink import shortest
from ecatspec.generators.cases.bringup import WAY_UP
from ecatspec.generators.cases.case import (
    NO_LIMITS,
    Case,
    Happen,
    Limits,
    Probe,
    ReadInitial,
    Repeat,
    SendFrame,
    SetUpProcessData,
    Stimulus,
    Wait,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
    WriteUntilTaken,
)
from ecatspec.generators.cases.case_codec import case_of, check, from_data, to_data, token_of
from ecatspec.generators.covers.malformed_cover import family_cover
from ecatspec.generators.random import stable_random
from ecatspec.generators.random.strategies import traces
from ecatspec.generators.random.walk_alphabet import ground
from ecatspec.generators.random.walks import walk
from ecatspec.generators.suite import GENERATORS
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.register_map import SYNC_MANAGERS
from ecatspec.model.core.values import UNKNOWN

if TYPE_CHECKING:
    from collections.abc import Callable


DEVICES = (
    "reference",
    "reference-drive",
    "afag-se-power",
    "beckhoff-el6720",
    "kollmorgen-akd",
    "kollmorgen-s300",
    "metronix-dis2",
)
STEPS = 60
WALKS = 8
EVERY_FEATURE = (
    *("complete_access", "data_in_initiate", "empty_download", "mailbox_restart", "malformed"),
    *("oversized", "repeat"),
)
FAULTS = ("toggle_ignored", "short_transfer_taken", "duplicate_served")


@cache
def model_of(device: str) -> Model:
    return Model(load(device))


@cache
def events(device: str) -> frozenset[str]:
    return frozenset(f"{event.machine}.{event.input}" for event in model_of(device).locals)


def walked(device: str, seed: int, steps: int = STEPS, limits: Limits = NO_LIMITS) -> Case:
    return walk(model_of(device), limits, events(device), seed, steps)


def runner_of(device: str, fault: str = "") -> Runner:
    adapter = make(device, {"fault": fault} if fault else {})
    return Runner(model_of(device), adapter, adapter.describe())


# --- walks ----------------------------------------------------------------------------------------


def test_the_same_arguments_give_the_same_walk() -> None:
    again = walk(Model(load("reference-drive")), NO_LIMITS, events("reference-drive"), 7, STEPS)
    assert again == walked("reference-drive", 7)
    assert again.name == f"walk/7_{STEPS}"
    assert walked("reference-drive", 8).stimuli != again.stimuli


def test_a_longer_walk_begins_like_a_shorter_one() -> None:
    long = walked("reference-drive", 3, STEPS).stimuli
    for steps in (0, 1, 17, STEPS - 1):
        assert walked("reference-drive", 3, steps).stimuli == long[:steps]


def test_only_the_one_stable_function_of_random_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = [walked("reference-drive", seed) for seed in range(10)]

    class Bare:
        def __init__(self, seed: int) -> None:
            self.random = random.Random(seed).random

    monkeypatch.setattr(stable_random, "Random", Bare)
    assert [walked("reference-drive", seed) for seed in range(10)] == wanted


@pytest.mark.parametrize(("seed", "steps"), [(-1, 5), (0, -1)])
def test_a_walk_of_negative_numbers_is_refused(seed: int, steps: int) -> None:
    with pytest.raises(ValueError, match="from 0 on"):
        walked("reference", seed, steps)


def test_walks_do_all_that_there_is_to_do() -> None:
    stimuli = [s for seed in range(60) for s in walked("reference-drive", seed).stimuli]
    looks = {ReadInitial, WriteUntilTaken}  # what these tell depends on what was before
    assert {type(stimulus) for stimulus in stimuli} == set(get_args(Stimulus)) - looks
    assert {s.event for s in stimuli if isinstance(s, Happen)} == events("reference-drive")
    frames = {s.frame for s in stimuli if isinstance(s, SendFrame)}
    assert {"sdo_download_expedited", "sdo_download_normal", "sdo_download_segment"} <= frames
    assert {"sdo_upload_request", "sdo_upload_segment", "sdo_abort", "mailbox"} <= frames
    assert {"information_list_request", "information_entry_request"} <= frames


def test_walks_take_mailboxes_away_in_every_state_and_write_all_objects() -> None:
    model = model_of("reference-drive")
    asked = set()
    for seed in range(180):
        last = model.row("al_state", "INIT")
        for stimulus in walked("reference-drive", seed).stimuli:
            match stimulus:
                case WriteRegister("al_control", fields):
                    last = fields["requested"]
                case WriteRegister(name, {"enabled": 0}) if name.startswith(SYNC_MANAGERS):
                    asked.add(last)
                case _:
                    pass
    assert {model.row("al_state", name) for name in WAY_UP} <= asked
    written = ground(model, NO_LIMITS).written
    assert any(model.image.configures(entry.index) for entry in written)


def test_walks_raise_only_what_can_be_raised() -> None:
    one = frozenset({"al.sync_lost"})
    for raisable in (frozenset[str](), one):
        made = [walk(model_of("reference-drive"), NO_LIMITS, raisable, n, STEPS) for n in range(30)]
        happened = {s.event for case in made for s in case.stimuli if isinstance(s, Happen)}
        assert happened == raisable


def test_walks_do_without_what_does_not_get_through() -> None:
    limits = Limits(0, 7, frozenset(EVERY_FEATURE))
    model = model_of("reference-drive")
    preop, init = (model.row("al_state", name) for name in ("PREOP", "INIT"))
    cases = family_cover(model, NO_LIMITS)
    malformed = {c.stimuli[-2] for c in cases if c.feature == "malformed"}
    for seed in range(40):
        alive = False
        for stimulus in walked("reference-drive", seed, limits=limits).stimuli:
            assert not isinstance(stimulus, Repeat)
            match stimulus:
                case SendFrame(frame, fields):
                    value = fields.get("value", b"")
                    assert isinstance(value, bytes)
                    assert not fields.get("complete_access")
                    if frame == "sdo_download_normal":
                        assert not value
                        assert fields["size"]
                    assert len(value) <= 7
                    assert stimulus not in malformed
                case WriteRegister("al_control", fields):
                    alive = alive or fields["requested"] == preop
                    assert not (alive and fields["requested"] == init)
                case _:
                    pass


@pytest.mark.parametrize("device", DEVICES)
def test_no_sound_device_is_blamed_and_walks_get_deep(device: str) -> None:
    runner = runner_of(device)
    for seed in range(WALKS):
        verdict = runner.executor.judge(walked(device, seed))
        assert verdict.outcome is Outcome.PASS, (seed, verdict.reason, verdict.observed)
    machines = {rule.machine for rule in runner.known.rules}
    assert {"al", "mailbox", "sdo", "sdo_information", "process_data"} <= machines
    assert "al.safeop_to_op" in set(map(str, runner.known.rules))
    assert len(runner.known.rules) >= 40


@pytest.mark.parametrize("fault", FAULTS)
def test_walks_find_faults(fault: str) -> None:
    device = "reference"
    runner = runner_of(device, fault)
    found = (runner.executor.judge(walked(device, seed)) for seed in range(120))
    verdict = next(v for v in found if v.outcome in BLAMING)

    def fails(case: Case) -> bool:
        runner.known.choices = dict(SHAPE)
        again = runner.executor.judge(case)
        return again.outcome in BLAMING and again.signature == verdict.signature

    seed = int(verdict.case.removeprefix("walk/").partition("_")[0])
    short = shortest(walked(device, seed), fails)
    assert fails(short)
    assert len(short.stimuli) <= 14
    assert runner_of(device).executor.judge(short).outcome is Outcome.PASS


# --- tokens ---------------------------------------------------------------------------------------

PLAIN = Case("a/b", "a title", "sdo", (Probe(), Wait(5)), "PREOP", 1, "number_edge", "repeat")
GOLDEN = (
    "case.eNotjb0KAjEQhF9Ftg6IhU16aw9bEUkuc0cgP8cmQeTIu7tRu_lmmJmdFpjaGKSJsYkmRUswq3Bq0YKfcCvED"
    "OYNFre4LJRMHBVztAMAV4Sm2-U6CW-M0JzkJ0Wl-tiCJ33fSZpawmxBXf3xZfy4jH7mXDDnNJbO_aGo-hq-H4ef6h-lhTdl"
)
"""A token of an earlier edition: it must mean the same for ever."""


def packed(data: object) -> str:
    text = data if isinstance(data, bytes) else json.dumps(data).encode()
    return "case." + base64.urlsafe_b64encode(zlib.compress(text)).decode().rstrip("=")


@pytest.mark.parametrize("generator", ["configuration", "process", "mailbox", "sdo", "families"])
def test_cases_of_a_suite_survive(generator: str) -> None:
    model = model_of("reference-drive")
    for case in GENERATORS[generator](model, NO_LIMITS):
        token = token_of(case)
        assert re.fullmatch(r"[A-Za-z0-9._-]+", token)
        again = case_of(token)
        assert again == case
        assert from_data(json.loads(json.dumps(to_data(case)))) == case
        check(again, model)


@settings(max_examples=30)
@given(traces(model_of("reference-drive"), raisable=["al.sync_lost"]), st.integers(0, 3))
def test_drawn_cases_survive(stimuli: list[Stimulus], prelude: int) -> None:
    case = Case("drawn/1", "drawn", "al", tuple(stimuli), None, min(prelude, len(stimuli)))
    assert case_of(token_of(case)) == case
    check(case, model_of("reference-drive"))


def test_walks_survive() -> None:
    for seed in range(20):
        case = walked("reference-drive", seed)
        assert case_of(token_of(case)) == case


def test_equal_cases_have_one_token() -> None:
    one = SendFrame("sdo_abort", {"index": 1, "flags": 1})
    other = SendFrame("sdo_abort", {"flags": True, "index": 1})
    assert one == other
    tokens = {token_of(replace(PLAIN, stimuli=(s, Probe()))) for s in (one, other)}
    assert len(tokens) == 1


def test_a_token_of_an_earlier_edition_is_read() -> None:
    assert case_of(GOLDEN) == PLAIN


def test_what_is_no_number_and_no_bytes_has_no_token() -> None:
    odd = replace(PLAIN, stimuli=(SendFrame("mailbox", {"payload": UNKNOWN}), Probe()))
    with pytest.raises(ValueError, match="'payload'"):
        token_of(odd)


def test_defaults_take_no_room() -> None:
    bare = Case("a", "b", "c", (SetUpProcessData(), SendFrame("mailbox", {})))
    assert to_data(bare) == {
        "name": "a",
        "title": "b",
        "layer": "c",
        "stimuli": [
            {"do": "set_up_process_data"},
            {"do": "send_frame", "frame": "mailbox", "fields": {}},
        ],
    }


GOOD = to_data(PLAIN)
STRANGE = {
    "no object": [],
    "another key": GOOD | {"extra": 1},
    "nothing": {},
    "a title of numbers": GOOD | {"title": 5},
    "a title over two lines": GOOD | {"title": "a\nb"},
    "a title without end": GOOD | {"title": "a" * 500},
    "a prelude beyond": GOOD | {"prelude": 3},
    "a prelude below": GOOD | {"prelude": -1},
    "a true prelude": GOOD | {"prelude": True},
    "stimuli that are none": GOOD | {"stimuli": {}},
    "a stimulus that is none": GOOD | {"stimuli": [3]},
    "an unknown stimulus": GOOD | {"stimuli": [{"do": "explode"}]},
    "a stimulus with more": GOOD | {"stimuli": [{"do": "probe", "x": 1}]},
    "a wait of a year": GOOD | {"stimuli": [{"do": "wait", "microseconds": 31_536_000_000_000}]},
    "half a wait": GOOD | {"stimuli": [{"do": "wait", "microseconds": 0.5}]},
    "no writes": GOOD | {"stimuli": [{"do": "write_registers", "writes": []}]},
    "a huge number": GOOD
    | {"stimuli": [{"do": "write_outputs", "words": {"control_word": 1 << 70}}]},
    "odd hex": GOOD
    | {"stimuli": [{"do": "send_frame", "frame": "mailbox", "fields": {"payload": {"hex": "0"}}}]},
    "two values": GOOD
    | {
        "stimuli": [
            {"do": "send_frame", "frame": "mailbox", "fields": {"payload": {"hex": "", "b": 1}}}
        ]
    },
    "a text as a field": GOOD
    | {"stimuli": [{"do": "send_frame", "frame": "mailbox", "fields": {"payload": "00"}}]},
    "many stimuli": GOOD | {"stimuli": [{"do": "probe"}] * 10_001},
}


@pytest.mark.parametrize("name", STRANGE)
def test_strange_data_are_refused_in_one_line(name: str) -> None:
    with pytest.raises(ValueError, match=" ") as caught:
        case_of(packed(STRANGE[name]))
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 300


HOSTILE = {
    "a bomb": packed(b" " * (20 << 20)),
    "deep": packed(b"[" * 100_000),
    "a key twice": packed(b'{"name": "a", "name": "b"}'),
    "a long number": packed(b'{"name": ' + b"1" * 10_000 + b"}"),
    "not text": packed(b"\xff\xfe"),
    "something behind": "case."
    + base64.urlsafe_b64encode(zlib.compress(b"{}") + b"more").decode().rstrip("="),
    "half of it": token_of(PLAIN)[:30],
    "a line more": token_of(PLAIN) + "\n",
    "another prefix": "walk/3_60",
    "empty": "",
    "nothing in it": "case.",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_tokens_are_refused_in_one_line(name: str) -> None:
    with pytest.raises(ValueError, match=" ") as caught:
        case_of(HOSTILE[name])
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 200


plain_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)
keys = st.sampled_from([*GOOD, "do", "fields", "words", "hex"])


@given(st.dictionaries(keys, plain_json).map(lambda odd: {**GOOD, **odd}) | plain_json)
@example(GOOD)
def test_odd_data_give_a_case_or_one_line(data: object) -> None:
    try:
        case = from_data(data)
    except ValueError as error:
        said = str(error)
        if len(said.splitlines()) != 1:
            raise
    else:
        assert case_of(token_of(case)) == case


@given(st.text(max_size=30).map(lambda text: "case." + text) | st.text(max_size=30))
def test_odd_words_give_one_line(word: str) -> None:
    with pytest.raises(ValueError, match=" ") as caught:
        case_of(word)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("stimulus", "missing"),
    [
        (WriteRegister("nowhere", {}), "register 'nowhere'"),
        (WriteRegister("al_control", {"wish": 1}), "field of al_control 'wish'"),
        (WriteRegister("al_control", {"requested": 16}), "room for 16 in al_control.requested"),
        (WriteRegisters((WriteRegister("nowhere", {}),)), "register 'nowhere'"),
        (SendFrame("letter", {}), "frame 'letter'"),
        (SendFrame("mailbox", {"colour": 1}), "field of mailbox 'colour'"),
        (SetUpProcessData({"nowhere": {}}), "register 'nowhere'"),
        (SetUpProcessData(longer={"sync_manager_0": 1}), "SyncManager 'sync_manager_0'"),
        (WriteOutputs({"oath": 1}), "word 'oath'"),
        (Happen("al.earthquake"), "local event 'al.earthquake'"),
    ],
)
def test_a_case_of_other_texts_is_refused(stimulus: Stimulus, missing: str) -> None:
    with pytest.raises(ValueError, match="stimulus 1: reference has no ") as caught:
        check(Case("a", "b", "al", (Probe(), stimulus)), model_of("reference"))
    assert missing in str(caught.value)


# --- shrinking ------------------------------------------------------------------------------------


def waits(case: Case) -> list[int]:
    return [s.microseconds for s in case.stimuli if isinstance(s, Wait)]


@given(
    st.lists(st.integers(0, 5000), min_size=1, max_size=30),
    st.integers(0, 3),
    st.data(),
)
def test_what_is_left_is_what_is_needed(
    times: list[int], prelude: int, data: st.DataObject
) -> None:
    prelude = min(prelude, len(times) - 1)
    rest = range(prelude, len(times))
    wanted = data.draw(st.lists(st.sampled_from(rest), unique=True, max_size=4).map(sorted))
    case = Case("a", "b", "al", tuple(map(Wait, times)), None, prelude)
    marks = [times[place] for place in wanted]

    def fails(tried: Case) -> bool:
        left = iter(waits(tried)[prelude:])
        return all(any(time >= mark for time in left) for mark in marks)

    short = shortest(case, fails, 5000)
    assert waits(short)[:prelude] == times[:prelude]
    assert sorted(waits(short)[prelude:]) == sorted(marks)
    assert shortest(case, fails, 5000) == short


def long_frame(case: Case) -> bool:
    values = [s.fields.get("value") for s in case.stimuli if isinstance(s, SendFrame)]
    return any(isinstance(value, bytes) and len(value) >= 3 and value[2] for value in values)


def high_bit(case: Case) -> bool:
    return any(isinstance(s, WriteOutputs) and s.words.get("a", 0) & 32 for s in case.stimuli)


def below(case: Case) -> bool:
    longer = [s.longer for s in case.stimuli if isinstance(s, SetUpProcessData)]
    return any(own.get("sync_manager_2", 0) <= -2 for own in longer)


FULL = SendFrame("x", {"value": b"\1\2\3\4\5\6\7", "index": 77}, same_counter=True, unread=True)
MIXED: tuple[Stimulus, ...] = (
    Probe(),
    FULL,
    WriteOutputs({"a": 0x37, "b": 5}),
    SetUpProcessData({"sync_manager_2": {"mode": 1}}, {"sync_manager_2": -7}),
)


@pytest.mark.parametrize(
    ("fails", "left"),
    [
        (long_frame, SendFrame("x", {"value": b"\0\0\3", "index": 0})),
        (high_bit, WriteOutputs({"a": 32})),
        (below, SetUpProcessData({}, {"sync_manager_2": -2})),
    ],
)
def test_values_become_simple(fails: Callable[[Case], bool], left: Stimulus) -> None:
    assert shortest(Case("a", "b", "al", MIXED), fails).stimuli == (left,)


def test_tries_are_bounded_and_every_answer_fails() -> None:
    case = Case("a", "b", "al", tuple(map(Wait, range(40))))
    for tries in (1, 2, 10, 50):
        tried: list[Case] = []

        def fails(again: Case, tried: list[Case] = tried) -> bool:
            tried.append(again)
            return sum(waits(again)) >= 100

        short = shortest(case, fails, tries)
        assert len(tried) <= tries
        assert sum(waits(short)) >= 100


def test_a_case_that_passes_is_not_made_shorter() -> None:
    with pytest.raises(ValueError, match="does not fail"):
        shortest(Case("a", "b", "al", (Probe(),)), lambda _: False)
