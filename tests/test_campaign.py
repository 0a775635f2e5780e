"""The only place for tests of campaigns: several workers give the verdicts that one gives."""

from __future__ import annotations

import os
import signal
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from short import DRIVE, FAULT, SMALL, same, shorten

from ecatspec.conformance import campaign
from ecatspec.conformance.adapter import AdapterError
from ecatspec.conformance.campaign import Job, Workers, crew, stands
from ecatspec.conformance.devices import UserError, load
from ecatspec.conformance.pools import Died
from ecatspec.conformance.results import begin, read
from ecatspec.conformance.runner import run_device
from ecatspec.conformance.steps import Judged, Knowledge, Learned, Search, Trial
from ecatspec.conformance.verdict import Outcome, Verdict
from ecatspec.generators.case import Case

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ecatspec.conformance.pools import Answer
    from ecatspec.conformance.steps import Step


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)


def job_of(device: str, dut: str) -> Job:
    return Job(device, load(device).digest, dut, "", 10.0)


# --- what a verdict rests on ----------------------------------------------------------------------

CASE = Case("one", "one", "al", ())


def judged(outcome: Outcome, met: str = "", signature: str = "") -> Judged:
    verdict = Verdict("one", outcome, "one", signature=signature)
    return Judged("one", verdict, Learned(), frozenset(met.split()))


def knowing(choices: str = "", believed: str = "", signatures: str = "") -> Knowledge:
    ways = (dict(word.split("=") for word in words.split()) for words in (choices, believed))
    return Knowledge(*ways, frozenset(signatures.split()))


@pytest.mark.parametrize(
    ("step", "found", "used", "known", "does"),
    [
        (Trial(CASE), judged(Outcome.PASS, "a"), knowing("a=x"), knowing("a=x"), True),
        (Trial(CASE), judged(Outcome.PASS, "a"), knowing("a=x"), knowing("a=x b=y"), True),
        (Trial(CASE), judged(Outcome.PASS, "a b"), knowing("a=x"), knowing("a=x b=y"), False),
        (Trial(CASE), judged(Outcome.PASS, "a"), knowing("a=x"), knowing("a=y"), False),
        (Trial(CASE), judged(Outcome.PASS), knowing("a=x"), knowing(), False),
        (Trial(CASE), judged(Outcome.FAIL), knowing("a=x"), knowing("a=x b=y"), False),
        (Trial(CASE), judged(Outcome.FAIL), knowing("a=x"), knowing("a=x", "", "s"), True),
        (Trial(CASE), judged(Outcome.INCONCLUSIVE), knowing(), knowing("b=y"), False),
        (Trial(CASE), judged(Outcome.SKIPPED), knowing(), knowing("b=y", "c=z"), True),
        (Trial(CASE), judged(Outcome.PASS), knowing("", "c=z"), knowing(), False),
        (Trial(CASE, long=True), judged(Outcome.PASS), knowing(), knowing("", "", "s"), True),
        (
            Trial(CASE, long=True),
            judged(Outcome.FAIL, "", "s"),
            knowing(),
            knowing("", "", "s"),
            False,
        ),
        (
            Trial(CASE, long=True),
            judged(Outcome.FAIL, "", "s"),
            knowing("", "", "s"),
            knowing("", "", "s t"),
            True,
        ),
        (Search(1, 2), judged(Outcome.PASS), knowing(), knowing("", "", "s"), False),
        (Search(1, 2), judged(Outcome.PASS, "a"), knowing(), knowing("a=x"), False),
        (Search(1, 2), judged(Outcome.PASS, "a"), knowing(), knowing("b=x"), True),
    ],
)
def test_a_verdict_stands_that_rests_on_nothing_new(
    step: Step, found: Judged, used: Knowledge, known: Knowledge, *, does: bool
) -> None:
    assert stands(step, found, used, known) is does


# --- crews ----------------------------------------------------------------------------------------


class Now:
    """An answer that is there."""

    def __init__(self, call: Callable[[], object]) -> None:
        self.call = call

    def result(self) -> object:
        return self.call()

    def done(self) -> bool:
        return True


class Here:
    """A pool of this process: `deaths` says after how many calls a worker dies."""

    at_once = 5
    size = 3

    def __init__(self, *deaths: int) -> None:
        self.deaths = set(deaths)
        self.calls = 0

    def submit(self, function: Callable[..., object], *arguments: object) -> Answer:
        self.calls += 1
        if self.calls in self.deaths:
            return Now(self._die)
        found = function(*arguments)
        return Now(lambda: found)

    @staticmethod
    def _die() -> object:
        raise Died


@pytest.fixture
def desk() -> Iterator[None]:
    yield
    campaign.release()


@pytest.mark.usefixtures("desk")
@pytest.mark.parametrize(
    ("device", "dut"), [(SMALL, "model"), (SMALL, FAULT), (DRIVE, "model")]
)
def test_several_workers_give_the_verdicts_of_one(device: str, dut: str) -> None:
    # six shards ahead in the same process: none knows what those before it have told
    alone = run_device(device, dut)
    pool = Here(1, 4, 9)
    workers = Workers(job_of(device, dut), pool)
    same(run_device(device, dut, crew=workers), alone)
    assert pool.calls * pool.at_once > len(alone.verdicts) + 3 * pool.at_once


@pytest.mark.usefixtures("desk")
def test_choices_that_contradict_each_other_are_judged_as_one_process_does() -> None:
    """A device that goes one way first and another later fails, whoever judges the two."""
    alone = run_device(SMALL, "model:fault=counter_stands_in_safeop")
    again = run_device(SMALL, "model:fault=counter_stands_in_safeop", crew=Workers(
        job_of(SMALL, "model:fault=counter_stands_in_safeop"), Here()
    ))
    same(again, alone)


@pytest.mark.usefixtures("desk")
def test_a_campaign_is_interrupted_and_goes_on(tmp_path: Path) -> None:
    alone = run_device(SMALL, FAULT)
    file = tmp_path / "run"

    def progress(number: int, _total: int, _name: str) -> None:
        if number == 40:
            raise KeyboardInterrupt

    workers = Workers(job_of(SMALL, FAULT), Here())
    part = run_device(SMALL, FAULT, crew=workers, keep=partial(begin, file), progress=progress)
    assert part.interrupted
    assert read(file).verdicts == part.verdicts == alone.verdicts[: len(part.verdicts)]
    assert part.verdicts
    # alone, though it was begun by several
    same(run_device(SMALL, FAULT, keep=partial(begin, file, resume=True)), alone)


@pytest.mark.usefixtures("desk")
def test_what_a_worker_must_not_do() -> None:
    other = Job(SMALL, "0" * 64, "model", "", 10.0)
    with pytest.raises(UserError, match="a worker has other texts of reference"):
        campaign.describe(other)
    described = campaign.describe(job_of(SMALL, "model"))
    with pytest.raises(UserError, match="describes itself otherwise"):
        campaign.judge(job_of(SMALL, "model"), {**described, "name": "x"}, (), knowing())
    with pytest.raises(AdapterError, match="did you mean 'model'"):
        campaign.describe(job_of(SMALL, "modle"))


@pytest.mark.usefixtures("desk")
def test_workers_that_die_again_and_again_end_the_run() -> None:
    workers = Workers(job_of(SMALL, "model"), Here(*range(2, 99)))
    with pytest.raises(AdapterError, match=r"workers died 4 times .*; see why, and go on"):
        run_device(SMALL, "model", crew=workers)


# --- processes ------------------------------------------------------------------------------------


def children() -> set[int]:
    """The workers that this process has."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text("utf-8").rpartition(")")[2].split()[1])
            words = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if parent == os.getpid() and b"spawn_main" in words:
            found.add(int(entry.name))
    return found


@contextmanager
def killing(at: int) -> Iterator[tuple[Callable[[int, int, str], None], list[int]]]:
    """Give a progress that kills a worker."""
    killed: list[int] = []

    def progress(number: int, _total: int, _name: str) -> None:
        if number == at and not killed:
            killed.append(min(children()))
            os.kill(killed[0], signal.SIGKILL)

    yield progress, killed


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the workers in /proc")
def test_a_worker_that_dies_takes_no_case_with_it(tmp_path: Path) -> None:
    alone = run_device(SMALL, FAULT)
    file = tmp_path / "run"
    with killing(45) as (progress, killed), crew(job_of(SMALL, FAULT), 2, "") as workers:
        found = run_device(SMALL, FAULT, crew=workers, keep=partial(begin, file), progress=progress)
    assert killed
    same(found, alone)
    assert read(file).verdicts == alone.verdicts, "none lost, none twice"
    assert not children(), "no worker is left"
