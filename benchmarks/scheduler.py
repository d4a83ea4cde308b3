"""A Dask scheduler with its workers in processes of their own, whose memory and tasks are watched.

``python -m benchmarks.scheduler WORKERS``: is told its credentials on standard input, prints its address, and runs
until that input ends.
"""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import psutil
from distributed import Client, Security
from distributed.diagnostics.plugin import SchedulerPlugin

from roadscan.run.engine.compute_on import QUIET_CLUSTER, closed_cluster
from roadscan.run.engine.on_dask import QUIET_CLIENT


class Held(SchedulerPlugin):  # type: ignore[misc]
    """Keeps the largest number of tasks that the scheduler knew at the same time."""

    name = "held"

    def __init__(self, scheduler: Any) -> None:
        self.scheduler, self.most = scheduler, 0

    def transition(self, *_: Any, **__: Any) -> None:
        """Look whenever a task changes its state."""
        self.most = max(self.most, len(self.scheduler.tasks))


class Watched:
    """The scheduler's process, seen from outside."""

    def __init__(self, client: Any, pid: int) -> None:
        self._client, self._pid = client, pid

    def rss_bytes(self) -> int:
        """Resident memory now."""
        return int(psutil.Process(self._pid).memory_info().rss)

    def peak_bytes(self) -> int:
        """High-water mark of resident memory; what is resident now where the system keeps none."""
        with contextlib.suppress(OSError):
            for line in Path(f"/proc/{self._pid}/status").read_text().splitlines():
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) * 1024
        return self.rss_bytes()

    def cpu_s(self) -> float:
        """Processor time so far."""
        times = psutil.Process(self._pid).cpu_times()
        return float(times.user + times.system)

    def workers_cpu_s(self) -> float:
        """Processor time so far of the workers, which are its children."""
        times = [child.cpu_times() for child in psutil.Process(self._pid).children(recursive=True)]
        return float(sum(t.user + t.system for t in times))

    def most_tasks(self) -> int:
        """Most tasks held at a time."""
        return int(self._client.run_on_scheduler(_most))


def _most(dask_scheduler: Any) -> int:
    return int(dask_scheduler.plugins["held"].most)


@contextlib.contextmanager
def running_scheduler(workers: int) -> Iterator[tuple[Any, Watched]]:
    """A client of a scheduler that runs in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.scheduler", str(workers)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            security = Security.temporary()
            process.stdin.write(f"{pickle.dumps(security).hex()}\n")  # type: ignore[union-attr]
            process.stdin.flush()  # type: ignore[union-attr]
            address = process.stdout.readline().strip()  # type: ignore[union-attr]
            with dask.config.set(QUIET_CLIENT), Client(address, security=security, timeout="60s") as client:
                client.wait_for_workers(workers, timeout=60)
                yield client, Watched(client, process.pid)
        finally:
            process.stdin.close()  # type: ignore[union-attr]


def main() -> None:
    """Run until the standard input ends."""
    security = pickle.loads(bytes.fromhex(sys.stdin.readline()))
    with (
        tempfile.TemporaryDirectory() as folder,
        dask.config.set(QUIET_CLUSTER | {"temporary-directory": folder}),
        closed_cluster(int(sys.argv[1]), security) as cluster,
    ):
        cluster.scheduler.add_plugin(Held(cluster.scheduler))
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
