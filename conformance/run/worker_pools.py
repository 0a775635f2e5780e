"""Pools of workers: processes of this machine, or a cluster.

A pool hands calls to workers and gives answers. What is asked, and what is done with an answer, is
none of its business.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.util import Finalize
from typing import TYPE_CHECKING, Any, Final, Protocol

from ecatspec.conformance.base.adapter import AdapterError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from concurrent.futures import Future

    import distributed

_PATIENCE: Final = 30.0
"""Seconds in which a cluster without workers may get one."""


class Died(Exception):  # noqa: N818  the death of a worker is no error of who asked
    """The worker that was to answer is dead."""


class Answer(Protocol):
    """What comes of a call."""

    def result(self) -> Any:  # noqa: ANN401  it is that of any function
        """Wait for the answer; raise Died if none will come."""

    def done(self) -> bool:
        """Tell whether there is an answer already."""


class Pool(Protocol):
    """Workers."""

    at_once: int
    """How many steps one gets at a time: enough that asking costs little beside judging."""

    @property
    def size(self) -> int:
        """How many there are."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Answer:  # noqa: ANN401
        """Have a worker call a function."""


# --- processes ------------------------------------------------------------------------------------


class _Local:
    """The answer of a process."""

    def __init__(self, future: Future[Any]) -> None:
        self._future = future

    def result(self) -> Any:  # noqa: ANN401
        try:
            return self._future.result()
        except BrokenProcessPool:
            raise Died from None

    def done(self) -> bool:
        return self._future.done() and not isinstance(self._future.exception(), BrokenProcessPool)


class _Processes:
    """Processes of this machine; if one dies all are replaced."""

    def __init__(self, size: int, release: Callable[[], None]) -> None:
        self.at_once = 4
        self._size = size
        self._release = release
        self._executor = self._open()

    @property
    def size(self) -> int:
        return self._size

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Answer:  # noqa: ANN401
        try:
            return _Local(self._executor.submit(function, *arguments))
        except BrokenProcessPool:
            self.close()
            self._executor = self._open()
            return _Local(self._executor.submit(function, *arguments))

    def close(self) -> None:
        self._executor.shutdown(wait=True, cancel_futures=True)

    def _open(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")  # no thread and no lock is copied
        return ProcessPoolExecutor(self._size, context, _begin, (self._release,))


def _begin(release: Callable[[], None]) -> None:
    """Prepare a worker: Ctrl-C is for who asks, and when that one dies the worker ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Finalize(None, release, exitpriority=0)
    threading.Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def process_pool(size: int, release: Callable[[], None]) -> Iterator[Pool]:
    """Open a number of processes; each calls `release` at its end."""
    pool = _Processes(size, release)
    try:
        yield pool
    finally:
        pool.close()


# --- a cluster ------------------------------------------------------------------------------------


class _Remote:
    """The answer of a cluster, which tries again by itself where a worker dies."""

    def __init__(self, cluster: _Cluster, future: distributed.Future[Any]) -> None:
        self._cluster = cluster
        self._future = future

    def result(self) -> Any:  # noqa: ANN401
        while True:
            try:
                return self._cluster.answer(self._future)
            except TimeoutError:
                self._cluster.see_workers()

    def done(self) -> bool:
        return bool(self._future.done())


class _Cluster:
    """The workers of a dask cluster."""

    def __init__(self, address: str, client: distributed.Client) -> None:
        self.at_once = 16
        self._address = address
        self._client = client

    @property
    def size(self) -> int:
        """Give how many there are now: some may come later."""
        return max(1, len(self._client.scheduler_info(n_workers=-1)["workers"]))

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Answer:  # noqa: ANN401
        return _Remote(self, self._client.submit(function, *arguments, pure=False))

    def answer(self, future: distributed.Future[Any]) -> Any:  # noqa: ANN401
        from distributed import KilledWorker
        from distributed.client import FutureCancelledError
        from distributed.comm.core import CommClosedError

        try:
            return future.result(timeout=_PATIENCE)
        except KilledWorker:
            raise Died from None
        except (FutureCancelledError, CommClosedError):
            raise self._lost("is gone") from None

    def see_workers(self) -> None:
        """See that somebody is there to answer."""
        with suppress(TimeoutError):
            self._client.wait_for_workers(1, timeout=_PATIENCE)
            return
        raise self._lost("has no worker")

    def _lost(self, what: str) -> AdapterError:
        hint = f"start workers by `dask worker {self._address}` and go on with --resume"
        return AdapterError(f"the cluster at {self._address} {what}; {hint}")


@contextmanager
def cluster_pool(address: str, release: Callable[[], None]) -> Iterator[Pool]:
    """Reach the cluster at an address; each of its workers calls `release` at the end.

    Raises:
        AdapterError: There is none, or the package is missing.

    """
    try:
        from distributed import Client
    except ModuleNotFoundError:
        message = 'a cluster needs a package: pip install "ecatspec[cluster]"'
        raise AdapterError(message) from None
    try:
        client = Client(address, timeout=_PATIENCE / 3, set_as_default=False)
    except (OSError, ValueError) as error:
        hint = "start one by `dask scheduler` and give the address that it prints"
        raise AdapterError(f"no cluster answers at {address} ({error}); {hint}") from None
    with client:
        pool = _Cluster(address, client)
        pool.see_workers()
        try:
            yield pool
        finally:
            client.run(release)
