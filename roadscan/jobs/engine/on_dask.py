"""Tasks on a Dask cluster: one of roadscan's own, or one that runs elsewhere."""

from __future__ import annotations

import contextlib
import functools
import gc
import logging
import os
import queue
import signal
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import resource_tracker
from typing import Any, TypeVar

import dask
from distributed import Client, KilledWorker, LocalCluster
from distributed.protocol import pickle
from tornado.ioloop import PeriodicCallback

from roadscan.jobs.engine.compute import Done
from roadscan.model.errors import RoadscanError
from roadscan.model.stopping import Stopped

T = TypeVar("T")
R = TypeVar("R")

QUIET_CLIENT = {
    "distributed.admin.low-level-log-length": 50,
    "distributed.admin.large-graph-warning-threshold": "1GB",
}
"""Settings of Dask: its log of messages holds whole tasks, by default the last 1,000 of each worker; and nobody who
runs a survey can change how large a task is."""

MEMORY_KEPT = {
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
    "MALLOC_ARENA_MAX": 1,
    "MALLOC_MMAP_MAX_": 0,
    "MALLOC_TOP_PAD_": 64 << 20,
    "MALLOC_TRIM_THRESHOLD_": 1 << 30,
}
"""Environment of a worker: arrays lie in memory that the process has touched before, in large pages.

Dask asks for the opposite (freed memory goes back to the system at once). Then each array of more than 128 kB is fresh
memory, whose first touch costs a sixth of a worker's time. Only glibc reads these names.
"""

ONE_THREAD = {"OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1}
"""Environment of a worker, as Dask sets it by default: there is a process a core."""

QUIET_CLUSTER = QUIET_CLIENT | {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.comm.timeouts.connect": "60s",
    "distributed.scheduler.allowed-failures": 0,
    "distributed.deploy.lost-worker-timeout": "1d",
    "distributed.nanny.pre-spawn-environ": MEMORY_KEPT | ONE_THREAD,
}
"""Settings of a cluster of roadscan's own: a worker's memory is bounded by the size of its blocks, so Dask's spilling
and pausing stay out of the way; nobody looks at its figures, of which it would take hundreds a second; what is tried
again when a worker dies, :meth:`OnDask.map` decides; and a worker that dies twice within Dask's 15 s would not be
started anew, but closed."""

_HELD_A_THREAD = 2
"""Tasks of each worker thread that the scheduler holds at least, while there are any …"""

_MORE_HELD = 28
"""… and more in all while many wait, so that messages carry several of tasks that end quickly."""

_TOGETHER_S = 0.02
"""How long results wait for half of the others at most, so that one message asks for them all."""

_LOST_S = 30.0
"""Without a worker for so long, a nanny has given up."""


class OnDask:
    """Runs tasks on a Dask cluster; a bounded number is handed out at a time."""

    def __init__(self, client: Client, workers: int | None = None) -> None:
        """`workers` is how many there are when all are alive, where that is known."""
        self._client, self._workers = client, workers

    @property
    def workers(self) -> int:
        """Threads of all workers, also of those that are started anew."""
        return self._alive() if self._workers is None else self._workers

    def _alive(self) -> int:
        return int(max(1, sum(self._client.nthreads().values())))

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        """Run all tasks, most of them at the same time; a task is tried once more if its worker dies.

        Those that waited at the same worker die with it. So all of them are tried again when the others have ended, on
        half of the threads and no more than are alive, where none waits behind another: what dies there is at fault
        itself.
        """
        threads = self.workers
        died: list[T] = []
        for done in self._ended(function, tasks, lambda left: _HELD_A_THREAD * threads + min(_MORE_HELD, left // 4)):
            if isinstance(done.error, KilledWorker):
                died.append(done.task)
            else:
                yield done
        for done in self._ended(function, died, lambda _: max(1, min(threads // 2, self._alive()))):
            yield Done(done.task, None, _death()) if isinstance(done.error, KilledWorker) else done

    def send(self, function: Callable[[T], R], tasks: Sequence[T]) -> list[Any]:
        """Hand some tasks to the scheduler; returns their futures.

        Tasks travel as bytes: the scheduler hands them on without importing or holding what they name.
        """
        keys = [f"{function.__name__}-{uuid.uuid4().hex}" for _ in tasks]
        sent = [pickle.dumps((function, task)) for task in tasks]
        return list(self._client.map(_called, sent, key=keys, pure=False, retries=0))

    def _ended(
        self, function: Callable[[T], R], tasks: Sequence[T], held: Callable[[int], int]
    ) -> Iterator[Done[T, R]]:
        """Tasks as they end; `held` says how many the scheduler holds while so many are left to hand out."""
        running: dict[str, T] = {}
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()

        def hand_out(first: int) -> int:
            left = len(tasks) - first
            chosen = tasks[first : first + max(held(left) - len(running), 0)] if left else []
            if chosen:
                futures = self.send(function, chosen)
                running.update((future.key, task) for future, task in zip(futures, chosen, strict=True))
                for future in futures:
                    future.add_done_callback(ended.put)
            return first + len(chosen)

        handed_out = hand_out(0)
        while running:
            futures = _taken(ended, len(running) // 2)
            own = [running.pop(future.key) for future in futures]
            handed_out = hand_out(handed_out)
            results = self._client.gather({future.key: future for future in futures}, errors="skip")
            for future, task in zip(futures, own, strict=True):
                error = future.exception() if future.status != "finished" else None
                future.release()
                yield Done(task, None if error is not None else pickle.loads(results.pop(future.key)), error)


def _death() -> RoadscanError:
    return RoadscanError(
        "each worker that began this task died of it",
        expected="a worker that lives",
        change="most often memory is short: give fewer workers (--workers), or smaller tiles ([tiles] size_m)",
    )


def _taken(ended: queue.SimpleQueue[Any], wanted: int) -> list[Any]:
    """The next futures to end: as many as are wanted, or those of a moment."""
    taken = [ended.get()]
    until = time.perf_counter() + _TOGETHER_S
    with contextlib.suppress(queue.Empty):
        while len(taken) < wanted and (left_s := until - time.perf_counter()) > 0:
            taken.append(ended.get(timeout=left_s))
        while True:
            taken.append(ended.get_nowait())
    return taken


def _called(sent: bytes) -> bytes:
    """Result of a function and its task, as :class:`OnDask` sends them (runs on a worker).

    It is made to bytes while the task runs: a result that cannot be is the task's error then, and one whose worker dies
    of it counts as a death.
    """
    function, task = pickle.loads(sent)
    result: bytes = pickle.dumps(function(task))
    _freeze()
    return result


@functools.cache
def _freeze() -> None:
    """Tell Python's collector, once a process, that what was loaded for a first task stays.

    Else it looks through all of that again and again while records are made.
    """
    gc.collect()
    gc.freeze()


@contextlib.contextmanager
def connected(scheduler: str) -> Iterator[OnDask]:
    """The cluster of a scheduler (an address such as ``tcp://host:8786``); where it has no worker, tasks wait for one.

    Raises
    ------
    RoadscanError
        No scheduler answers.
    """
    with dask.config.set(QUIET_CLIENT):
        try:
            client = Client(scheduler, timeout="30s")
        except (OSError, ValueError) as error:
            raise RoadscanError(
                f"no Dask scheduler answers at {scheduler}", expected="tcp://host:port", change=str(error)
            ) from error
        with client:
            yield OnDask(client)


@contextlib.contextmanager
def embedded(workers: int | None = None) -> Iterator[OnDask]:
    """A cluster of roadscan's own: so many processes on this machine (None: one a core).

    Where the program is asked to stop, the workers are killed: else each would finish its task first.
    """
    with contextlib.ExitStack() as opened:
        opened.enter_context(dask.config.set(QUIET_CLUSTER))
        with _held_back(), _without_interrupts():
            cluster = opened.enter_context(
                LocalCluster(
                    n_workers=workers or dask.system.CPU_COUNT,
                    threads_per_worker=1,
                    dashboard_address=":0",
                    silence_logs="CRITICAL",  # of a worker that dies, the run itself says what is lost
                )
            )
        client = opened.enter_context(Client(cluster))
        workers = len(cluster.workers)
        _keep_alive(cluster, workers)
        try:
            yield OnDask(client, workers)
        except Stopped:
            logging.disable()  # what closes from here on is bound to miss its workers
            _kill(cluster)
            raise


@contextlib.contextmanager
def _held_back() -> Iterator[None]:
    """Hand requests to stop on at the end: a cluster that is half opened leaves processes and semaphores behind."""
    if threading.current_thread() is not threading.main_thread():  # it alone is told of signals
        yield
        return
    came: list[int] = []
    before = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)}
    handled = [one for one, handler in before.items() if callable(handler)]
    for one in handled:
        signal.signal(one, lambda number, _frame: came.append(number))
    try:
        yield
    finally:
        for one in handled:
            signal.signal(one, before[one])
        for number in came[:1]:
            signal.raise_signal(number)


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Threads that are started meanwhile, and all processes that these start, do not see Ctrl-C.

    A terminal sends it to all processes of a run. The run ends its workers itself.
    """
    if not hasattr(signal, "pthread_sigmask"):  # no such masks on this system
        yield
        return
    resource_tracker.ensure_running()  # where it is started later, it lets SIGINT through in the thread that does so
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _kill(cluster: LocalCluster) -> None:
    """End all workers at once; what they had not finished is not in the store."""
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)


def _keep_alive(cluster: LocalCluster, workers: int) -> None:
    """Replace nannies that have had no worker for a while: one that cannot start its worker anew does not try again."""
    since_s: dict[Any, float] = {}

    def look() -> None:
        now_s = time.monotonic()
        for name, nanny in list(cluster.workers.items()):
            if nanny.is_alive():
                since_s.pop(name, None)
            elif now_s - since_s.setdefault(name, now_s) > _LOST_S:
                del cluster.workers[name], since_s[name]
        cluster.scale(workers)

    looks = PeriodicCallback(look, _LOST_S / 10 * 1000)
    cluster.periodic_callbacks["keep-alive"] = looks
    cluster.loop.add_callback(looks.start)
