"""Chooses where a run's tasks run: in this process, on an embedded Dask cluster, or on a scheduler's cluster."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from roadscan.core.errors import ConfigError
from roadscan.run.engine.compute import Compute, Done, Inline, R, T

if TYPE_CHECKING:
    from roadscan.run.engine.on_dask import OnDask


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
            from roadscan.run.engine.embedded import embedded  # slow to import
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
