"""Where a run's tasks run: in this process, on a private Dask cluster, or on a scheduler's cluster."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Nanny, Scheduler, Security, SpecCluster, Worker
from distributed.worker_memory import parse_memory_limit
from tornado.ioloop import PeriodicCallback

from roadscan.core.errors import ConfigError, RunError
from roadscan.core.extras import need
from roadscan.core.private_folder import Code, check_private
from roadscan.core.stopping import Stopped
from roadscan.run.engine.compute import Compute, Done, Inline, R, T
from roadscan.run.engine.on_dask import QUIET_CLIENT, OnDask

LOOPBACK = "127.0.0.1"
"""Address on which everything listens, so that other machines cannot reach it."""

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
"""Environment of a worker, as Dask sets it by default: there is one process per core."""

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
    "distributed.scheduler.http.routes": [
        "distributed.http.scheduler.info",
        "distributed.http.health",
        "distributed.http.statics",
    ],
    "distributed.scheduler.dashboard.bokeh-application.allow_websocket_origin": [LOOPBACK, "localhost"],
}
"""Settings of a private cluster: a worker's memory is bounded by the size of its blocks, so Dask's spilling
and pausing stay out of the way; nobody looks at its figures, of which it would take hundreds a second; what is tried
again when a worker dies, :meth:`OnDask.map` decides; and a worker that dies twice within Dask's 15 s would not be
started anew, but closed. The last two are of the dashboard: it hands no request on to other machines, and no page of
another site that is open in a browser may read it."""

_STARTS = 3  # attempts to start the workers
_LOST_S = 30.0
"""Seconds without a worker after which a nanny has given up."""


class _ClosedScheduler(Scheduler):  # type: ignore[misc]
    """A scheduler that serves web pages only if a dashboard was requested."""

    def start_http_server(self, routes: Any, dashboard_address: str | None, *rest: Any, **more: Any) -> None:
        """Skip the server, which Dask would start on port 8787 in any case."""
        if dashboard_address is not None:
            super().start_http_server(routes, dashboard_address, *rest, **more)


class _ClosedWorker(Worker):  # type: ignore[misc]
    """A worker that serves no web page."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Skip the server, which Dask would start."""


@contextlib.contextmanager
def embedded(workers: int | None = None, dashboard: Callable[[str], None] | None = None) -> Iterator[OnDask]:
    """Run a private cluster with this many processes on this machine (None: one per core).

    All of them listen on loopback alone, and speak TLS with a key that is made here and dies with the cluster: who does
    not hold it is refused. Where the program is asked to stop, the workers are killed: else each would finish its task
    first.

    Parameters
    ----------
    workers : number of processes; None: one a core.
    dashboard : receives the address of the dashboard, which every user of this machine can open; None: there is none.

    Raises
    ------
    ConfigError
        A dashboard is asked for, and Bokeh, which draws it, is not installed.
    UnsafeFolderError
        Others could change the folder for temporary files: Dask loads code from there.
    RunError
        The workers end as soon as they start.
    """
    if dashboard is not None:
        need("bokeh", "--dashboard")
    with contextlib.ExitStack() as opened:
        opened.enter_context(dask.config.set(QUIET_CLUSTER | {"temporary-directory": opened.enter_context(_scratch())}))
        with _held_back(), _without_interrupts():
            number = workers or dask.system.CPU_COUNT
            cluster = opened.enter_context(_started(number, with_dashboard=dashboard is not None))
        client = opened.enter_context(Client(cluster))
        if dashboard is not None:
            dashboard(f"http://{LOOPBACK}:{cluster.scheduler.http_server.port}/status")
        _keep_alive(cluster, number)
        try:
            yield OnDask(client, number)
        except Stopped:
            logging.disable()  # workers are expected to disappear from here on
            _kill(cluster)
            raise


def _started(workers: int, *, with_dashboard: bool) -> SpecCluster:
    """Return the open cluster; where a worker dies during the start, all are started again."""
    reason: Exception | None = None
    for _ in range(_STARTS):
        try:
            return closed_cluster(workers, Security.temporary(), with_dashboard=with_dashboard)
        except (RuntimeError, OSError) as error:
            reason = error
    raise RunError(
        f"the {workers} workers could not be started ({reason})",
        expected="processes that live long enough to say that they are there",
        change="look for what ends them (memory, limits of processes), or compute in this process: --workers 0",
    ) from reason


def closed_cluster(workers: int, security: Security, *, with_dashboard: bool = False) -> SpecCluster:
    """Return a cluster like Dask's ``LocalCluster``, but private; it needs :data:`QUIET_CLUSTER` and a private folder.

    The key travels to the workers through a pipe from their parent. OpenSSL reads keys from files alone: for that
    moment, it lies in a folder that only this user can open.
    """
    quiet = "CRITICAL"  # the run itself reports what a dead worker loses
    shared = {"host": LOOPBACK, "protocol": "tls://", "security": security}
    nanny = {
        "cls": Nanny,
        "options": shared
        | {
            "nthreads": 1,
            "memory_limit": parse_memory_limit("auto", 1, workers, logger=logging.getLogger("distributed")),
            "silence_logs": quiet,
            "worker_class": _ClosedWorker,
        },
    }
    page = {"dashboard": with_dashboard, "dashboard_address": f"{LOOPBACK}:0" if with_dashboard else None}
    return SpecCluster(
        scheduler={"cls": _ClosedScheduler, "options": shared | {"port": 0} | page},
        workers=dict.fromkeys(range(workers), nanny),
        worker=nanny,
        security=security,
        silence_logs=quiet,
    )


@contextlib.contextmanager
def _scratch() -> Iterator[str]:
    """Create a folder for Dask's temporary files, accessible to this user only.

    Dask puts it into ``sys.path``. By itself it takes one below /tmp whose name everybody knows: who makes that folder
    first could have code of his loaded.
    """
    with tempfile.TemporaryDirectory(prefix="roadscan-", ignore_cleanup_errors=True) as folder:
        check_private(Path(folder), Code("the folder for temporary files", "TMPDIR"))
        try:
            yield folder
        finally:
            sys.path[:] = [place for place in sys.path if not place.startswith(folder)]


@contextlib.contextmanager
def _held_back() -> Iterator[None]:
    """Delay requests to stop until the end: a half-open cluster would leave processes and semaphores behind."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread receives signals
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
    """Keep Ctrl-C from threads that are started meanwhile, and from all their child processes.

    A terminal sends it to all processes of a run. The run ends its workers itself.
    """
    if not hasattr(signal, "pthread_sigmask"):  # systems without such masks
        yield
        return
    resource_tracker.ensure_running()  # started later, it would let SIGINT through in the thread that starts it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _kill(cluster: SpecCluster) -> None:
    """End all workers at once; their unfinished work is not in the store."""
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)


def _keep_alive(cluster: SpecCluster, workers: int) -> None:
    """Replace nannies that have had no worker for a while: one that failed to restart its worker does not try again."""
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


class WhenNeeded:
    """Opens the cluster at the first task, so that a run with nothing to do starts none."""

    def __init__(
        self,
        stack: contextlib.ExitStack,
        workers: int | None,
        scheduler: str | None,
        dashboard: Callable[[str], None] | None,
    ) -> None:
        self._stack = stack
        self._workers = workers
        self._scheduler = scheduler
        self._dashboard = dashboard
        self._opened: OnDask | None = None

    @property
    def workers(self) -> int:
        """Requested workers; those of an external cluster are known once it is opened."""
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
            from roadscan.run.engine.on_dask import connected

            scheduler = self._scheduler
            cluster = embedded(self._workers, self._dashboard) if scheduler is None else connected(scheduler)
            self._opened = self._stack.enter_context(cluster)
        return self._opened


@contextlib.contextmanager
def compute_on(
    workers: int | None = None, scheduler: str | None = None, dashboard: Callable[[str], None] | None = None
) -> Iterator[Compute]:
    """Compute on `scheduler` (an address) or on an embedded cluster of `workers` processes.

    Parameters
    ----------
    workers : number of worker processes; 0 computes in this process; None takes one a core.
    scheduler : address such as ``tls://host:8786``. Where neither it nor `workers` is given, the environment variable
        ``ROADSCAN_SCHEDULER`` may name one.
    dashboard : receives the address of the embedded cluster's dashboard when it opens; None: there is none.

    Raises
    ------
    ConfigError
        for a negative number of workers: nobody would do the tasks; for a dashboard without an embedded cluster.
    """
    if scheduler is None and workers is None and dashboard is None:
        scheduler = os.environ.get("ROADSCAN_SCHEDULER") or None
    if workers is not None and workers < 0:
        raise ConfigError(f"{workers} workers", expected="0 (compute in this process) or more")
    if dashboard is not None and (scheduler is not None or workers == 0):
        where = "this process computes" if scheduler is None else f"the scheduler {scheduler} has its own"
        raise ConfigError(
            f"a dashboard is asked for, and {where}", expected="an embedded cluster", change="leave it out"
        )
    if scheduler is None and workers == 0:
        yield Inline()
        return
    logging.getLogger("distributed").setLevel(logging.ERROR)  # a run itself reports what failed and why
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # a run that ends reconnects to no scheduler
    with contextlib.ExitStack() as stack:
        yield WhenNeeded(stack, workers, scheduler, dashboard)
