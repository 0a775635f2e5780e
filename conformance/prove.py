"""Reports the proofs of devices as a table and as data."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor, wait
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.render.tables import Sheet
from ecatspec.model.symbolic.obligations import WORDING, Finding, Kind, Status
from ecatspec.spec.language.ir import STANDARD
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from concurrent.futures import Future
    from multiprocessing.queues import SimpleQueue

    from ecatspec.spec.language.ir import ObjectEntry, Protocol

_REFERENCE: Final = "reference"
"""The texts of this name and of names that begin so lend their objects to the standard."""
_LOOK: Final = 0.1
"""Seconds after which the parent looks what its workers tell."""


@dataclass(frozen=True, slots=True)
class Timed:
    """How an obligation ended, and the seconds of the processor that it took."""

    finding: Finding
    seconds: float


@dataclass(frozen=True, slots=True)
class Proofs:
    """All that was proved of one specification, or not."""

    device: str
    timed: tuple[Timed, ...]

    @property
    def refuted(self) -> bool:
        """Whether something is wrong."""
        return any(t.finding.status is Status.REFUTED for t in self.timed)

    @property
    def seconds(self) -> float:
        """The time of the processor for all of it."""
        return sum(timed.seconds for timed in self.timed)


def prove(
    device: str, protocol: Protocol, progress: Callable[[int, int, str], None] | None = None
) -> Proofs:
    """Prove what there is to be proved of a specification.

    Raises:
        ModuleNotFoundError: The solver is not installed.

    """
    from ecatspec.model.symbolic.proofs import Prover

    samples = sample_objects() if protocol.name == STANDARD else ()
    timed: list[Timed] = []
    last = time.process_time()
    for finding in Prover(protocol, samples).findings():
        now = time.process_time()
        timed.append(Timed(finding, now - last))
        last = now
        if progress is not None:
            progress(0, 0, f"{device}: {finding.obligation}")
    return Proofs(device, tuple(timed))


# --- several at once ------------------------------------------------------------------------------


def prove_all(
    protocols: Mapping[str, Protocol], progress: Callable[[int, int, str], None] | None = None
) -> Iterator[Proofs]:
    """Prove several specifications by name, as many at once as there are processors.

    The proofs come in the order of the names. `progress` is told how many specifications are done,
    of how many, and what is being proved. Whoever stops early ends the workers too.

    Raises:
        ModuleNotFoundError: The solver is not installed.

    """
    if len(protocols) == 1 or _processors() == 1:
        for name, protocol in protocols.items():
            yield prove(name, protocol, progress)
        return
    if find_spec("z3") is None:
        raise ModuleNotFoundError(name="z3")
    spawn = multiprocessing.get_context("spawn")
    told: SimpleQueue[str] = spawn.SimpleQueue()
    others = set(multiprocessing.active_children())
    workers = ProcessPoolExecutor(
        min(len(protocols), _processors()), spawn, initializer=_begin, initargs=(told,)
    )
    ended = False
    try:
        asked = {name: workers.submit(_proved, name, text) for name, text in protocols.items()}
        for future in asked.values():
            _watch(future, tuple(asked.values()), told, progress)
            yield future.result()
        ended = True
    finally:
        if not ended:
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
        workers.shutdown(cancel_futures=True)


def _processors() -> int:
    """Give how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _watch(
    future: Future[Proofs],
    all_of_them: tuple[Future[Proofs], ...],
    told: SimpleQueue[str],
    progress: Callable[[int, int, str], None] | None,
) -> None:
    """Wait for one proof, and pass on what the workers tell meanwhile."""
    done = False
    while not done:
        done = bool(wait((future,), _LOOK).done)
        while not told.empty():
            what = told.get()
            if progress is not None:
                progress(sum(each.done() for each in all_of_them), len(all_of_them), what)


_told: SimpleQueue[str] | None = None
"""Where a worker says what it proves; None in the parent."""


def _begin(told: SimpleQueue[str]) -> None:
    """Begin a worker: Ctrl-C ends it at once and without words, its parent has them."""
    global _told  # noqa: PLW0603  a worker has no other place for what it is begun with
    _told = told
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _proved(name: str, protocol: Protocol) -> Proofs:
    """Prove one specification in a worker."""
    return prove(name, protocol, lambda _done, _total, what: _tell(what))


def _tell(what: str) -> None:
    if _told is not None:
        _told.put(what)


# --- objects for the standard ---------------------------------------------------------------------


def sample_objects() -> tuple[ObjectEntry, ...]:
    """Give objects of every kind, for the standard, which has hardly any of its own.

    Of the reference texts those are taken that no other is like, and those that words speak of.
    """
    found: dict[tuple[int, int], ObjectEntry] = {}
    known: set[tuple[object, ...]] = set()
    for name in device_names():
        if not name.startswith(_REFERENCE):
            continue
        protocol = load_device(name)
        worded = {word.key for word in protocol.words.values()}
        whole: dict[int, list[ObjectEntry]] = {}
        for entry in protocol.objects:
            whole.setdefault(entry.index, []).append(entry)
        for entries in whole.values():
            kinds = {_likeness(entry) for entry in entries}
            if kinds - known or any((e.index, e.subindex) in worded for e in entries):
                known |= kinds
                found |= {(e.index, e.subindex): e for e in entries}
    return tuple(found[key] for key in sorted(found))


def _likeness(entry: ObjectEntry) -> tuple[object, ...]:
    return (
        type(entry.type),
        entry.access,
        entry.states,
        entry.read_states,
        entry.constant,
        entry.low is None,
        entry.subindex == 0,
    )


# --- report ---------------------------------------------------------------------------------------


def proof_sheet(proofs: Proofs) -> Sheet:
    """Give one line for every kind of obligation and every machine."""
    groups: dict[tuple[Kind, str], list[Timed]] = {}
    for timed in proofs.timed:
        obligation = timed.finding.obligation
        group = "" if obligation.kind is Kind.CHOICE else obligation.group
        groups.setdefault((obligation.kind, group), []).append(timed)
    rows = tuple(
        (
            kind.value,
            group,
            *(sum(t.finding.status is status for t in found) for status in Status),
            f"{sum(t.seconds for t in found):.2f}",
        )
        for (kind, group), found in sorted(
            groups.items(), key=lambda item: (tuple(Kind).index(item[0][0]), item[0][1])
        )
    )
    columns = ("what", "machine", *(status.value for status in Status), "seconds")
    title = f"{proofs.device}: {len(proofs.timed)} obligations in {proofs.seconds:.1f} s"
    return Sheet("proofs", title, columns, rows)


def details(proofs: Proofs) -> Iterator[str]:
    """Yield the lines for what is refuted, and shorter ones for what is bounded or not known."""
    for timed in proofs.timed:
        finding = timed.finding
        if finding.status is Status.REFUTED:
            yield f"{proofs.device}: refuted: {finding.obligation}"
            yield from (f"    {line}" for line in finding.lines)
            yield from (f"    at {at}" for at in dict.fromkeys(finding.places))
        elif finding.status is Status.UNKNOWN:
            yield f"{proofs.device}: unknown: {finding.obligation}: {finding.lines[0]}"
        elif finding.status is Status.BOUNDED and finding.obligation.kind is Kind.PROPERTY:
            yield f"{proofs.device}: bounded({finding.depth}): {finding.obligation}"


def as_data(every: Iterable[Proofs]) -> list[dict[str, object]]:
    """Give proofs as data."""
    return [
        {
            "device": proofs.device,
            "seconds": round(proofs.seconds, 3),
            "obligations": [
                {
                    "kind": timed.finding.obligation.kind.name.lower(),
                    "group": timed.finding.obligation.group,
                    "name": timed.finding.obligation.name,
                    "asks": WORDING[timed.finding.obligation.kind],
                    "status": timed.finding.status.value,
                    "depth": timed.finding.depth,
                    "lines": list(timed.finding.lines),
                    "places": [str(at) for at in timed.finding.places],
                    "seconds": round(timed.seconds, 3),
                }
                for timed in proofs.timed
            ],
        }
        for proofs in every
    ]
