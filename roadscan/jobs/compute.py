"""Where tasks run: in this process, on an embedded Dask cluster, or on a scheduler's."""

from __future__ import annotations

import contextlib
import functools
import gc
import logging
import os
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from roadscan.model.errors import RoadscanError

T = TypeVar("T")
R = TypeVar("R")

_OBJECTS = 100_000
"""New objects that Python's collector waits for."""

FEW_MESSAGES_KEPT = {"distributed.admin.low-level-log-length": 50}
"""Setting of Dask: its log of messages holds whole tasks, by default the last 1,000 of each worker."""

QUIET_CLUSTER = FEW_MESSAGES_KEPT | {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.admin.large-graph-warning-threshold": "1GB",
    "distributed.comm.timeouts.connect": "60s",
}
"""Settings of a cluster of roadscan's own: a worker's memory is bounded by the size of its blocks, so Dask's spilling
and pausing stay out of the way; nobody looks at its figures, of which it would take hundreds a second, nor can change
how large a task is."""

_HELD_A_THREAD = 2
"""Tasks of each worker thread that the scheduler holds at least, while there are any …"""

_MORE_HELD = 28
"""… and more in all while many wait, so that messages carry several of tasks that end quickly."""

_TOGETHER_S = 0.02
"""How long results wait for half of the others at most, so that one message asks for them all."""


@dataclass(frozen=True)
class Done(Generic[T, R]):
    """A task that ended: with a result, or with the error that stopped it."""

    task: T
    result: R | None
    error: Exception | None


def reason_of(error: Exception | None) -> str:
    """Why a task gave nothing, for the list of failures."""
    if error is None:
        return "the worker gave no result"
    return str(error) if isinstance(error, RoadscanError) else f"{type(error).__name__}: {error}"


class Made(Sequence[T]):
    """Tasks that are made when they are handed out: while workers are at the first, and not all in memory."""

    def __init__(self, pieces: Sequence[Any], make: Callable[[Any], T]) -> None:
        self._pieces, self._make = pieces, make

    def __len__(self) -> int:
        return len(self._pieces)

    def __getitem__(self, place: Any) -> Any:
        """One task, or some."""
        return [*map(self._make, self._pieces[place])] if isinstance(place, slice) else self._make(self._pieces[place])

    def __iter__(self) -> Iterator[T]:
        return map(self._make, self._pieces)


class Compute(Protocol):
    """Runs a function over tasks; results come in any order."""

    @property
    def workers(self) -> int:
        """How many tasks run at the same time."""
        ...

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks; an error of one does not stop the others."""
        ...


@contextlib.contextmanager
def rare_collections() -> Iterator[None]:
    """Let Python look for cycles among its objects less often.

    A run keeps hundreds of thousands of records and makes no cycles: looking for them takes a third of its time.
    """
    before = gc.get_threshold()
    gc.set_threshold(_OBJECTS, before[1], before[2])
    try:
        yield
    finally:
        gc.set_threshold(*before)


class Inline:
    """Runs tasks one after another in this process (tests, debugging, one tile)."""

    workers = 1

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks in order."""
        for task in tasks:
            try:
                yield Done(task, function(task), None)
            except Exception as error:  # noqa: BLE001  one unit's fault must not stop the others
                yield Done(task, None, error)


class OnDask:
    """Runs tasks on a Dask cluster; a bounded number is handed out at a time."""

    def __init__(self, client: Any) -> None:
        self._client = client

    @property
    def workers(self) -> int:
        """Threads of all workers."""
        return int(max(1, sum(self._client.nthreads().values())))

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks, most of them at the same time; a task is tried once more if its worker dies.

        Tasks travel as bytes: the scheduler hands them on without importing or holding what they name.
        """
        from distributed import as_completed  # slow to import

        threads = self.workers
        running: dict[str, T] = {}
        queue = as_completed(raise_errors=False)

        def hand_out(first: int) -> int:
            held = _HELD_A_THREAD * threads + min(_MORE_HELD, (len(tasks) - first) // 4)
            chosen = tasks[first : first + max(held - len(running), 0)]
            if chosen:
                futures = self.send(function, chosen)
                running.update((future.key, task) for future, task in zip(futures, chosen, strict=True))
                queue.update(futures)
            return first + len(chosen)

        handed_out = hand_out(0)
        for batch in queue.batches():
            ended = batch + _others(queue, len(running) // 2 - len(batch))
            own = [running.pop(future.key) for future in ended]
            handed_out = hand_out(handed_out)
            results = self._client.gather({future.key: future for future in ended}, errors="skip")
            for future, task in zip(ended, own, strict=True):
                error = future.exception() if future.status != "finished" else None
                future.release()
                yield Done(task, None if error is not None else results.pop(future.key), error)

    def send(self, function: Callable[[T], R], tasks: Sequence[T]) -> list[Any]:
        """Hand some tasks to the scheduler; returns their futures."""
        from distributed.protocol import pickle  # slow to import

        keys = [f"{function.__name__}-{uuid.uuid4().hex}" for _ in tasks]
        sent = [pickle.dumps((function, task)) for task in tasks]
        return list(self._client.map(_called, sent, key=keys, pure=False, retries=0))


def _others(queue: Any, wanted: int) -> list[Any]:
    """Futures that end soon: as many as are wanted, or those of the next moment."""
    ended: list[Any] = queue.next_batch(block=False)
    until = time.perf_counter() + _TOGETHER_S
    while len(ended) < wanted and time.perf_counter() < until:
        time.sleep(_TOGETHER_S / 10)
        ended += queue.next_batch(block=False)
    return ended


def _called(sent: bytes) -> Any:
    """Result of a function and its task, as :class:`OnDask` sends them (runs on a worker)."""
    from distributed.protocol import pickle  # slow to import

    function, task = pickle.loads(sent)
    result = function(task)
    _freeze()
    return result


@functools.cache
def _freeze() -> None:
    """Tell Python's collector, once a process, that what was loaded for a first task stays.

    Else it looks through all of that again and again while records are made.
    """
    gc.collect()
    gc.freeze()


class WhenNeeded:
    """Opens the cluster at the first task: a run with nothing to do starts none."""

    def __init__(self, stack: contextlib.ExitStack, workers: int | None, scheduler: str | None) -> None:
        self._stack = stack
        self._workers = workers
        self._scheduler = scheduler
        self._opened: OnDask | None = None

    @property
    def workers(self) -> int:
        """Workers asked for; those of a cluster that runs elsewhere are known once it is opened."""
        if self._scheduler is not None:
            return self._open().workers
        return self._workers or os.cpu_count() or 1

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks on the cluster."""
        if not tasks:
            return
        yield from self._open().map(function, tasks)

    def _open(self) -> OnDask:
        if self._opened is None:
            import dask  # slow to import

            self._stack.enter_context(dask.config.set(FEW_MESSAGES_KEPT))
            client = _connect(self._scheduler) if self._scheduler is not None else _embedded(self._stack, self._workers)
            self._opened = OnDask(self._stack.enter_context(client))
        return self._opened


@contextlib.contextmanager
def compute_on(workers: int | None = None, scheduler: str | None = None) -> Iterator[Compute]:
    """Compute on `scheduler` (an address) or on an embedded cluster of `workers` processes.

    Parameters
    ----------
    workers : number of worker processes; 0 computes in this process; None takes one a core.
    scheduler : address such as ``tcp://host:8786``.
    """
    if scheduler is None and workers == 0:
        yield Inline()
        return
    logging.getLogger("distributed").setLevel(logging.ERROR)  # a run says itself what failed and why
    with contextlib.ExitStack() as stack:
        yield WhenNeeded(stack, workers, scheduler)


def _connect(scheduler: str) -> Any:
    from distributed import Client  # slow to import

    try:
        return Client(scheduler, timeout="30s")
    except (OSError, ValueError) as error:
        raise RoadscanError(
            f"no Dask scheduler answers at {scheduler}", expected="tcp://host:port", change=str(error)
        ) from error


def _embedded(stack: contextlib.ExitStack, workers: int | None) -> Any:
    import dask
    from distributed import Client, LocalCluster

    stack.enter_context(dask.config.set(QUIET_CLUSTER))
    cluster = LocalCluster(
        n_workers=workers or dask.system.CPU_COUNT, threads_per_worker=1, dashboard_address=":0", silence_logs="ERROR"
    )
    return Client(stack.enter_context(cluster))
