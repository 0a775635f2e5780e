"""Judges the work items of a run by several workers, with the verdicts of one.

Steps are handed out a few at a time with what was known of the device then, and taken back in their
order. A verdict counts if it rests on nothing that the steps before it have told meanwhile;
otherwise the step is judged again. docs/decisions/0016 has the reasons.
"""

from __future__ import annotations

import threading
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Final, NoReturn

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.base.adapter import AdapterError, Description
from ecatspec.conformance.base.devices import UserError, load
from ecatspec.conformance.base.verdict import CAUSED, Outcome
from ecatspec.conformance.base.work_items import Judged, Knowledge, Search
from ecatspec.conformance.run.case_executor import CaseExecutor
from ecatspec.conformance.run.dut_knowledge import ways_of
from ecatspec.conformance.run.worker_pools import Died, cluster_pool, process_pool
from ecatspec.model.core.compilation import Model

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.conformance.base.work_items import Step
    from ecatspec.conformance.run.worker_pools import Answer, Pool

_AHEAD: Final = 2
"""Shards under way for each worker: one is judged, one waits."""
_DEATHS: Final = 3
"""Maximum number of deaths of workers in a row."""


@dataclass(frozen=True, slots=True)
class Job:
    """What a worker must have to judge a step of a run."""

    device: str
    digest: str
    dut: str
    mailbox: str
    hang_timeout: float
    choices: tuple[str, ...] = ()
    accepted: Mapping[str, str] = field(default_factory=dict)
    """The findings that are known, by their identity, and why."""


# --- in a worker ----------------------------------------------------------------------------------


class _Bench:
    """The one device of this process, and the run that it is there for."""

    def __init__(self) -> None:
        self.lock = threading.Lock()  # a worker of a cluster may have several threads
        self._job: Job | None = None
        self._executor: CaseExecutor | None = None

    def executor(self, job: Job) -> CaseExecutor:
        """Give the executor of a run, with its device."""
        if self._executor is None or self._job != job:
            self.clear()
            protocol = load(job.device, job.mailbox)
            if protocol.digest != job.digest:
                what = f"a worker has other texts of {job.device} than the one who asks"
                raise UserError(f"{what}; install the same ecatspec on all machines")
            adapter = open_adapter(
                job.dut, job.device, mailbox=job.mailbox, hang_timeout=job.hang_timeout
            )
            self._job = job
            description = adapter.describe()
            self._executor = CaseExecutor(
                Model(protocol, closed=description.closed_dictionary),
                adapter,
                description,
                accepted=job.accepted,
                given=ways_of(protocol, job.choices),
            )
        return self._executor

    def clear(self) -> None:
        """Let go of the device."""
        if self._executor is not None:
            self._executor.adapter.close()
        self._job = self._executor = None


_BENCH: Final = _Bench()


def describe(job: Job) -> Mapping[str, object]:
    """Give what the device of a worker says of itself."""
    with _BENCH.lock:
        return _BENCH.executor(job).description.to_json()


def judge(
    job: Job, described: Mapping[str, object], steps: Sequence[Step], knowledge: Knowledge
) -> list[Judged]:
    """Judge steps in a worker, as one who knows just this; nothing else decides the verdicts."""
    with _BENCH.lock:
        executor = _BENCH.executor(job)
        if executor.description.to_json() != described:
            name = executor.description.name
            raise UserError(f"{name} describes itself otherwise than the first; use equal devices")
        found = []
        for step in steps:
            executor.known.restore(knowledge)
            found.append(executor.take(step))
            knowledge = knowledge.after(found[-1])
        return found


def release() -> None:
    """Let go of the device of a worker."""
    with _BENCH.lock:
        _BENCH.clear()


# --- who asks -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """Stands for devices that the workers have: it describes them, and cannot reach them."""

    description: Description

    def reset(self) -> None:
        """Refuse."""
        self._refuse()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Refuse."""
        self._refuse(address, length)

    def write(self, address: int, data: bytes) -> int:
        """Refuse."""
        self._refuse(address, data)

    def advance(self, seconds: float) -> None:
        """Refuse."""
        self._refuse(seconds)

    def close(self) -> None:
        """Nothing to release."""

    def describe(self) -> Description:
        """What a worker said."""
        return self.description

    def _refuse(self, *_: object) -> NoReturn:
        message = f"{self.description.name} is at the workers; nothing reaches it from here"
        raise AdapterError(message)


@dataclass(slots=True)
class _Shard:
    """Steps that a worker judges, with what was known when they were handed out."""

    steps: Sequence[Step]
    knowledge: Knowledge
    answer: Answer


class Workers:
    """The crew that judges a run in several processes."""

    def __init__(self, job: Job, pool: Pool) -> None:
        """Take the job and open workers."""
        self._job = job
        self._pool = pool
        self._deaths = 0

    def adapter(self) -> Adapter:
        """Give what stands for the devices of the workers."""
        while True:
            try:
                told = self._pool.submit(describe, self._job).result()
                return Elsewhere(Description.from_json(told))
            except Died:
                self._died("came up")

    def judge(
        self, steps: Iterable[Step], known: Callable[[], Knowledge], description: Description
    ) -> Iterator[Judged]:
        """Yield the judged steps in their order, each with the verdict that one worker gives."""
        described = description.to_json()

        def shard(own: Sequence[Step]) -> _Shard:
            knowledge = known()
            answer = self._pool.submit(judge, self._job, described, own, knowledge)
            return _Shard(own, knowledge, answer)

        left = iter(steps)
        under_way: deque[_Shard] = deque()
        while True:
            while len(under_way) < _AHEAD * self._pool.size and (
                own := tuple(islice(left, self._pool.at_once))
            ):
                under_way.append(shard(own))
            if not under_way:
                return
            first = under_way.popleft()
            try:
                found: list[Judged] = first.answer.result()
            except Died:
                self._died(f"judged {first.steps[0].name} or what follows")
                others = (s if s.answer.done() else shard(s.steps) for s in under_way)
                under_way = deque((shard(first.steps), *others))
                continue
            used = first.knowledge
            for number, (step, judged) in enumerate(zip(first.steps, found, strict=True)):
                if not stands(step, judged, used, known()):
                    under_way.appendleft(shard(first.steps[number:]))
                    break
                used = used.after(judged)
                self._deaths = 0
                yield judged

    def _died(self, doing: str) -> None:
        self._deaths += 1
        if self._deaths > _DEATHS:
            hint = "see why, and go on with --resume"
            raise AdapterError(f"workers died {self._deaths} times while they {doing}; {hint}")


def stands(step: Step, judged: Judged, used: Knowledge, known: Knowledge) -> bool:
    """Tell whether a verdict that rests on `used` is the one that `known` leads to as well."""
    outcome, signature = judged.verdict.outcome, judged.verdict.signature
    if outcome is Outcome.SKIPPED:
        return True  # the device was not asked
    if used.believed != known.believed:
        return False
    if any(known.choices.get(name) != way for name, way in used.choices.items()):
        return False
    new = known.choices.keys() - used.choices.keys()
    if isinstance(step, Search):
        # whatever it found, it looked for a cause that was not known
        return not new & judged.met and used.signatures == known.signatures
    if outcome is Outcome.PASS:
        return not new & judged.met
    if outcome in CAUSED:
        # a case tells of the first cause that is not known
        first = signature not in used.signatures
        return not new and first == (signature not in known.signatures)
    return not new


@contextmanager
def crew(job: Job, workers: int, address: str) -> Iterator[Workers]:
    """Open the workers of a run: processes of this machine, or those of a cluster.

    Raises:
        AdapterError: There is no cluster at the address, or no package to reach it.

    """
    with cluster_pool(address, release) if address else process_pool(workers, release) as pool:
        yield Workers(job, pool)
