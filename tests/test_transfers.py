"""Tests of transfers in any order: no sound device is blamed, a bad one is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import pytest
from hypothesis import HealthCheck, Phase, reject, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
    run_state_machine_as_test,
)

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.run.device_link import Deviation, InconclusiveError
from ecatspec.conformance.run.session import Session
from ecatspec.generators.cases.bringup import request, way_to
from ecatspec.generators.cases.case import NO_LIMITS, Probe, Repeat, SendFrame, SendSegments
from ecatspec.generators.cases.client import Ask, Begin, Move, Segment, played
from ecatspec.generators.cases.transfers import abort, normal_download, pattern, upload
from ecatspec.generators.random.strategies import begins, commands, downloads, moves, uploads
from ecatspec.model.core.compilation import Model
from ecatspec.model.oracle.oracle import Oracle

DEVICE = "reference"
PLAIN = load(DEVICE)
LONGEST = 120
SMALL = 64, 128
SHORTEST = 6
"""Moves of a failure at most, after the bring-up."""
TARGETS = ((0x2030, 0), (0x2023, 0), (0x2003, 0), (0x2010, 3), (0x2042, 0))
"""Entries that hold much, little, a number, one with a range, and one for PREOP alone."""
FAULTS = (
    "toggle_ignored",
    "short_transfer_taken",
    "duplicate_served",
    "repeat_unknown",
)


def limits(name: str) -> int:
    number = PLAIN.parameters[name].value[0]
    value = getattr(number, "value", None)
    assert isinstance(value, int)
    return value


LOW, HIGH = limits("minimal_mailbox"), limits("maximal_mailbox")
EDGES = (LOW, LOW + 1, 64, 128, HIGH)
sizes = st.sampled_from(EDGES) | st.integers(LOW, HIGH)
truths = st.booleans()
targets = st.sampled_from(TARGETS)


@dataclass(frozen=True)
class Line:
    """A device and the texts that judge it, over mailboxes of one size."""

    session: Session


@cache
def line(mailbox: str, fault: str = "") -> Line:
    model = Model(load(DEVICE, mailbox), closed=True)
    adapter = make(DEVICE, {"mailbox": mailbox} | ({"fault": fault} if fault else {}))
    return Line(Session(adapter, model, Oracle(model)))


@cache
def drawn(kind: str, mailbox: str) -> st.SearchStrategy[Move]:
    model = line(mailbox).session.model
    kinds: dict[str, st.SearchStrategy[Move]] = {
        "any": moves(model, NO_LIMITS),
        "begin": begins(model, NO_LIMITS),
        "upload": uploads(model, NO_LIMITS),
        "small": downloads(model),
        "command": commands(model),
    }
    return kinds[kind]


class Transfers(RuleBasedStateMachine):
    """A client that knows where its transfer stands, and does not keep to it."""

    fault = ""
    made: tuple[Move, ...] = ()
    """The moves of the last run: those of the shortest failure in the end."""

    @initialize(out=sizes, back=sizes)
    def power_on(self, out: int, back: int) -> None:
        if self.fault:  # the texts are compiled for each size
            out, back = SMALL
        self.mailbox = f"{out}:{back}"
        self.session = line(self.mailbox, self.fault).session
        self.moves: list[Move] = []
        self.open = ""
        type(self).made = ()
        self.session.begin({})
        for stimulus in way_to(self.session.model, "PREOP"):
            self.session.apply(stimulus)

    def move(self, *new: Move) -> None:
        """Do moves as one step; what the client knows of its transfer comes from those before."""
        done = len(self.moves)
        for each in new:
            match each:
                case Begin():
                    self.open = "download"
                case SendFrame(frame="sdo_upload_request"):
                    self.open = "upload"
                case _:
                    pass
        self.moves += new
        type(self).made = tuple(self.moves)
        try:
            for stimulus in played(self.moves, NO_LIMITS, self.session.model)[done:]:
                self.session.apply(stimulus)
        except InconclusiveError:
            reject()  # more is possible than can be followed, which is nobody's fault

    @rule(key=st.sampled_from(TARGETS[:2]), size=st.integers(2, LONGEST))
    def begin_long_download(self, key: tuple[int, int], size: int) -> None:
        self.move(Begin(key, pattern(size), 0))

    @rule(key=targets, size=st.integers(0, LONGEST), first=st.integers(0, LONGEST))
    def begin_download(self, key: tuple[int, int], size: int, first: int) -> None:
        self.move(Begin(key, pattern(size), first))

    @rule(data=st.data(), kind=st.sampled_from(["any", "begin", "upload", "small", "command"]))
    def do_anything(self, data: st.DataObject, kind: str) -> None:
        self.move(data.draw(drawn(kind, self.mailbox)))

    @precondition(lambda self: self.open == "download")
    @rule(count=st.integers(0, LONGEST))
    def send_segment(self, count: int) -> None:
        self.move(Segment(count))

    @precondition(lambda self: self.open == "download")
    @rule(count=st.integers(0, LONGEST), right=truths, honest=truths)
    def send_odd_segment(self, count: int, *, right: bool, honest: bool) -> None:
        self.move(Segment(count, right, honest))

    @rule(key=targets)
    def download(self, key: tuple[int, int]) -> None:
        """A whole download of what the entry takes."""
        entry = self.session.model.dictionary.entries[key]
        value = pattern(100) if key in TARGETS[:2] else b"\1\0\0\0"
        assert entry.access.value == "rw"
        for stimulus in normal_download(self.session.model, key, value):
            self.move(stimulus)

    @rule(key=targets, unread=truths)
    def ask(self, key: tuple[int, int], *, unread: bool) -> None:
        self.move(replace(upload(*key), unread=unread))

    @rule(key=targets)
    def read_all(self, key: tuple[int, int]) -> None:
        self.move(upload(*key), SendSegments())

    @precondition(lambda self: self.open == "upload")
    @rule(right=truths)
    def ask_for_segment(self, *, right: bool) -> None:
        self.move(Ask(right))

    @precondition(lambda self: self.open)
    @rule(key=targets)
    def give_up(self, key: tuple[int, int]) -> None:
        self.move(abort(*key, 0))

    @rule()
    def repeat(self) -> None:
        self.move(Repeat())

    @rule(key=targets)
    def say_it_twice(self, key: tuple[int, int]) -> None:
        self.move(upload(*key), replace(upload(*key), same_counter=True))

    @rule()
    def restart(self) -> None:
        model = self.session.model
        self.move(*(request(model.row("al_state", name)) for name in ("INIT", "PREOP")))

    @rule()
    def probe(self) -> None:
        self.move(Probe())


SEARCH = settings(
    max_examples=20,
    stateful_step_count=12,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)


def test_the_sound_device_is_not_blamed() -> None:
    run_state_machine_as_test(Transfers, settings=SEARCH)


def fails(moves_: list[Move], fault: str) -> bool:
    session = line("{}:{}".format(*SMALL), fault).session
    session.begin({})
    stimuli = played(moves_, NO_LIMITS, session.model)
    try:
        for stimulus in (*way_to(session.model, "PREOP"), *stimuli):
            session.apply(stimulus)
    except Deviation:
        return True
    except InconclusiveError:
        return False
    return False


def shortened(moves_: list[Move], fault: str) -> list[Move]:
    """Leave out moves as long as the run fails: Hypothesis takes minutes for it."""
    for number in reversed(range(len(moves_))):
        fewer = moves_[:number] + moves_[number + 1 :]
        if fails(fewer, fault):
            return shortened(fewer, fault)
    return moves_


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found_and_its_run_is_short(fault: str) -> None:
    class Faulty(Transfers):
        pass

    Faulty.fault = fault
    search = settings(
        SEARCH,
        max_examples=2000,
        database=None,
        derandomize=True,
        print_blob=False,
        phases=(Phase.generate,),
        report_multiple_bugs=False,
    )
    with pytest.raises(Deviation):
        run_state_machine_as_test(Faulty, settings=search)
    run = list(Faulty.made)
    assert fails(run, fault)
    assert not fails(run, "")
    short = shortened(run, fault)
    assert 1 <= len(short) <= SHORTEST, short


def test_a_client_goes_on_where_its_moves_have_led() -> None:
    model = line("64:64").session.model
    made: list[Move] = [Begin((0x2023, 0), pattern(60), 10), Segment(20), Segment(30)]
    stimuli = played(made, NO_LIMITS, model)
    assert played(made[:2], NO_LIMITS, model) == stimuli[:2]
    values = [s.fields["value"] for s in stimuli if isinstance(s, SendFrame)]
    assert values == [pattern(60)[:10], pattern(60)[10:30], pattern(60)[30:60]]
    toggles = [s.fields["toggle"] for s in stimuli[1:] if isinstance(s, SendFrame)]
    assert toggles == [0, 1]
