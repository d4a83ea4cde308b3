"""Measures what work costs where it runs: host and process, begin and end, bytes read and written, memory."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Generic, TypeVar

import psutil

from roadscan.store.store import bytes_put

T = TypeVar("T")
R = TypeVar("R")

_NOTE: Final = "roadscan_cost"
"""Attribute of an error that a task raised, with what the task had cost until then."""


@dataclass(frozen=True)
class Cost:
    """What some work of one process cost."""

    host: str
    process: int
    """Its id on that host."""
    began_ns: int
    """When it began, by the clock of the host (Unix ns)."""
    seconds: float
    bytes_read: int | None
    """Bytes that the process read from files meanwhile, those of its code too; None where the system does not count
    them. What comes from an object store is not counted."""
    bytes_written: int
    """Bytes of the files that it put into the store."""
    peak_memory_bytes: int | None
    """Most memory that the process has held since it began; None where the system does not say."""


class Meter:
    """Measures from its creation on."""

    def __init__(self) -> None:
        self.began_ns, self._began_s = time.time_ns(), time.perf_counter()
        self._read, self._put = _bytes_read(), bytes_put()

    def cost(self) -> Cost:
        """Return what this process did since the beginning."""
        read = _bytes_read()
        return Cost(
            host=socket.gethostname(),
            process=os.getpid(),
            began_ns=self.began_ns,
            seconds=time.perf_counter() - self._began_s,
            bytes_read=None if read is None or self._read is None else read - self._read,
            bytes_written=bytes_put() - self._put,
            peak_memory_bytes=_peak_memory_bytes(),
        )


@dataclass(frozen=True)
class Costly(Generic[R]):
    """A result with what it cost."""

    result: R
    cost: Cost


@dataclass(frozen=True)
class Measured(Generic[T, R]):
    """A function whose result comes with its cost; an error that it raises carries the cost too."""

    function: Callable[[T], R]

    @property
    def __name__(self) -> str:
        """Return the function's name, under which a scheduler shows its tasks."""
        return self.function.__name__

    def __call__(self, task: T) -> Costly[R]:
        """Do the task."""
        meter = Meter()
        try:
            return Costly(self.function(task), meter.cost())
        except Exception as error:
            setattr(error, _NOTE, meter.cost())
            raise


def cost_of_error(error: Exception | None) -> Cost | None:
    """Return what a failed task had cost; None where its worker could not say (it died)."""
    cost = getattr(error, _NOTE, None)
    return cost if isinstance(cost, Cost) else None


def _bytes_read() -> int | None:
    try:
        return int(psutil.Process().io_counters().read_chars)
    except (AttributeError, OSError, psutil.Error):  # systems that do not count them
        return None


def _peak_memory_bytes() -> int | None:
    """Linux alone tells it of this program: what `getrusage` returns may be that of the one that started it."""
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return None
