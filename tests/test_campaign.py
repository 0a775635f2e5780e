"""Tests of campaigns: several workers give the verdicts that one gives."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from distributed import Client, LocalCluster
from short import DRIVE, FAULT, SMALL, same, shorten

from ecatspec.conformance import cli
from ecatspec.conformance.adapters.model import VirtualAdapter, described, make
from ecatspec.conformance.base.adapter import AdapterError, Description
from ecatspec.conformance.base.devices import UserError, load, pinned
from ecatspec.conformance.base.verdict import Outcome, Verdict
from ecatspec.conformance.base.work_items import Judged, Knowledge, Learned, Search, Trial
from ecatspec.conformance.results.run_file import begin, read
from ecatspec.conformance.run import campaign, runner
from ecatspec.conformance.run.campaign import Job, Workers, crew, stands
from ecatspec.conformance.run.dut_knowledge import SHAPE
from ecatspec.conformance.run.runner import Runner, run_device
from ecatspec.conformance.run.worker_pools import Died
from ecatspec.generators.cases.case import NO_LIMITS, Case
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.subdevice import VirtualSubDevice

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.conformance.base.work_items import Step
    from ecatspec.conformance.run.worker_pools import Answer


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)


JOB = Job(SMALL, load(SMALL).digest, "model", "", 10.0)


def job_of(device: str, dut: str) -> Job:
    return Job(device, load(device).digest, dut, "", 10.0)


# --- what a verdict rests on ----------------------------------------------------------------------

CASE = Case("one", "one", "al", ())


def judged(outcome: Outcome, met: str = "", signature: str = "") -> Judged:
    verdict = Verdict("one", outcome, "one", signature=signature)
    return Judged("one", verdict, Learned(), frozenset(met.split()))


def knowing(choices: str = "", believed: str = "", signatures: str = "") -> Knowledge:
    ways, beliefs = (
        {word.partition("=")[0]: word.partition("=")[2] for word in words.split()}
        for words in (choices, believed)
    )
    return Knowledge(ways, beliefs, frozenset(signatures.split()))


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


class Told:
    """A crew that was told what it says."""

    def __init__(self, *told: Judged) -> None:
        self.told = told

    def adapter(self) -> Adapter:
        raise NotImplementedError

    def judge(
        self, steps: Iterable[Step], _known: Callable[[], Knowledge], _description: Description
    ) -> Iterator[Judged]:
        for _, judged in zip(steps, self.told, strict=True):
            yield judged


def test_what_steps_told_is_known_afterwards() -> None:
    adapter = make(SMALL, {})
    one = Runner(Model(load(SMALL)), adapter, adapter.describe())
    one.known.believed = {"b": "x"}
    verdict = Verdict("one", Outcome.FAIL, "one", signature="s")
    learned = Learned({"a": "y"}, ("u",), ("for it",), ("al.to_init",))
    one.crew = Told(
        Judged("one", verdict, learned), Judged("one", verdict, Learned(refusals=("for it",)))
    )
    one.run([CASE, CASE], None, 2)
    assert one.verdicts == [verdict, verdict]
    assert one.known.snapshot() == Knowledge({**SHAPE, "a": "y"}, {"b": "x"}, frozenset({"s"}))
    assert (one.known.untold, one.known.refusals) == ({"u"}, {"for it": "one"})
    assert set(map(str, one.known.rules)) == {"al.to_init"}
    assert not one.known.moved
    one.crew = Told(
        Judged("one", verdict, Learned(disbelieved=True, moved=True)),
        Judged("one", verdict, Learned()),
    )
    one.run([CASE, CASE], None, 2)
    assert one.known.believed == {}
    assert one.known.moved


# --- crews ----------------------------------------------------------------------------------------


class Now:
    """An answer that is there, or None: that never comes."""

    def __init__(self, answer: object) -> None:
        self.answer = answer

    def result(self) -> object:
        if self.answer is None:
            raise Died
        return self.answer

    def done(self) -> bool:
        return self.answer is not None


class Here:
    """A pool of this process: `deaths` says after how many calls a worker dies."""

    at_once = 5
    size = 3

    def __init__(self, *deaths: int) -> None:
        self.deaths = set(deaths)
        self.calls = 0

    def submit(self, function: Callable[..., object], *arguments: object) -> Answer:
        self.calls += 1
        return Now(None if self.calls in self.deaths else function(*arguments))


@pytest.fixture
def desk() -> Iterator[None]:
    yield
    campaign.release()


@pytest.mark.usefixtures("desk")
@pytest.mark.parametrize(("device", "dut"), [(SMALL, "model"), (SMALL, FAULT), (DRIVE, "model")])
def test_several_workers_give_the_verdicts_of_one(device: str, dut: str) -> None:
    # six shards ahead in the same process: none knows what those before it have told
    alone = run_device(device, dut)
    pool = Here(1, 4, 9)
    workers = Workers(job_of(device, dut), pool)
    same(run_device(device, dut, crew=workers), alone)
    assert pool.calls * pool.at_once > len(alone.verdicts) + 3 * pool.at_once


class TwoFaced:
    """A device that goes one way at a choice or another, by what was written to it before."""

    def __init__(self, device: str) -> None:
        texts = load(device)
        self.faces = [
            VirtualAdapter(
                VirtualSubDevice(pinned(texts, {"refused_in_op": way})), described(texts)
            )
            for way in ("stay", "drop_to_safeop")
        ]
        self.written = 0
        self.shown: VirtualAdapter | None = None

    def reset(self) -> None:
        self.written, self.shown = 0, None
        for face in self.faces:
            face.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        first, second = (face.read(address, length) for face in self.faces)
        if first != second and self.shown is None:
            self.shown = self.faces[self.written % 2]
        return second if self.shown is self.faces[1] else first

    def write(self, address: int, data: bytes) -> int:
        self.written += sum(data)
        first, second = (face.write(address, data) for face in self.faces)
        return second if self.shown is self.faces[1] else first

    def advance(self, seconds: float) -> None:
        for face in self.faces:
            face.advance(seconds)

    def local(self, event: str) -> None:
        for face in self.faces:
            face.local(event)

    def close(self) -> None:
        pass

    def describe(self) -> Description:
        return self.faces[0].describe()


@pytest.mark.usefixtures("desk")
def test_a_device_that_contradicts_itself_is_blamed_as_by_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each worker alone would find nothing: that both ways were gone shows when they meet."""
    every = all_cases(Model(load(SMALL)), NO_LIMITS, "quick")
    refused = [case for case in every if "request_OP/" in case.name][:60]
    monkeypatch.setattr(runner, "all_cases", lambda *_: refused)
    for module in (runner, campaign):
        monkeypatch.setattr(module, "open_adapter", lambda *_, **__: TwoFaced(SMALL))
    alone = run_device(SMALL, "two-faced", depth="quick")
    blamed = alone.count(Outcome.FAIL)
    assert 0 < blamed < len(refused)
    same(run_device(SMALL, "two-faced", depth="quick", crew=Workers(JOB, Here())), alone)


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


def children(of: int) -> set[int]:
    """The workers that a process has."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text("utf-8").rpartition(")")[2].split()[1])
            words = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if parent == of and b"spawn_main" in words:
            found.add(int(entry.name))
    return found


@contextmanager
def killing(at: int) -> Iterator[tuple[Callable[[int, int, str], None], list[int]]]:
    """Give a progress that kills a worker."""
    killed: list[int] = []

    def progress(number: int, _total: int, _name: str) -> None:
        if number == at and not killed:
            killed.append(min(children(os.getpid())))
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
    assert not children(os.getpid()), "no worker is left"


_ORPHANS = """
import sys; sys.path = {path}
from ecatspec.conformance.run.campaign import Job, crew
from ecatspec.conformance.base.devices import load
if __name__ == "__main__":
    with crew(Job("reference", load("reference").digest, "model", "", 10.0), 2, "") as workers:
        workers.adapter()
        print("up", flush=True)
        sys.stdin.read()
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the workers in /proc")
def test_workers_end_with_who_asked(tmp_path: Path) -> None:
    script = tmp_path / "orphans.py"
    script.write_text(_ORPHANS.format(path=sys.path), encoding="utf-8")
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as asking:
        assert asking.stdout is not None
        assert asking.stdout.readline() == b"up\n"
        workers = children(asking.pid)
        asking.kill()
    assert workers
    until = time.monotonic() + 10
    while any(Path(f"/proc/{worker}/cmdline").exists() for worker in workers):
        assert time.monotonic() < until, "a worker lives on"
        time.sleep(0.05)


def test_two_workers_by_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = ("run", SMALL, "--only", "al", "--json", "--results")
    assert cli.main([*run, str(tmp_path / "one")]) == 0
    one = json.loads(capsys.readouterr().out)
    assert cli.main([*run, str(tmp_path / "two"), "--workers", "2"]) == 0
    two = json.loads(capsys.readouterr().out)
    for data in (one, two):
        data["results"][0]["seconds"] = 0
        del data["results"][0]["set_up"]["began"]
    assert one == two
    assert read(tmp_path / "one") == read(tmp_path / "two")
    for wrong, words in (
        (("--workers", "0"), "0 is not in the range"),
        (("--workers", "2", "--replay", "x"), "exclude each other"),
        (("--workers", "2", "--cluster", "tcp://127.0.0.1:1"), "exclude each other"),
        (("--workers", "2", "--dut", "modle"), "did you mean 'model'?"),
        (("--workers", "2", "--dut", "exec:/nonexistent"), "/nonexistent"),
        (("--cluster", "nonsense://x"), "no cluster answers at nonsense://x"),
    ):
        assert cli.main(["run", SMALL, *wrong]) == 2, wrong
        captured = capsys.readouterr()
        assert captured.out == ""
        assert words in captured.err
        assert captured.err.count("\n") == 1


# --- a cluster ------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")  # those of a package that is not ours
def test_a_worker_of_a_cluster_that_dies_takes_no_case_with_it(tmp_path: Path) -> None:
    alone = run_device(SMALL, FAULT)
    file = tmp_path / "run"
    killed: list[int] = []
    with (
        LocalCluster(
            n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        pids = list(client.run(os.getpid).values())
        assert len(set(pids)) == 2

        def progress(number: int, _total: int, _name: str) -> None:
            if number == 60 and not killed:
                killed.append(pids[0])
                os.kill(pids[0], signal.SIGKILL)

        with crew(job_of(SMALL, FAULT), 1, cluster.scheduler_address) as workers:
            keep = partial(begin, file)
            found = run_device(SMALL, FAULT, crew=workers, keep=keep, progress=progress)
    assert killed
    same(found, alone)
    assert read(file).verdicts == alone.verdicts, "none lost, none twice"
