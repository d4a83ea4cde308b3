"""How near a kernel comes to what this machine's memory allows (Williams, Waterman, Patterson 2009).

The bandwidth is that of the triad a = b + s · c of STREAM (McCalpin 1995) over arrays far larger than the caches,
counted as STREAM counts it: 24 bytes an element (reading a line before it is overwritten is not counted).
"""

from __future__ import annotations

import functools
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np

_ELEMENTS = 20_000_000
"""Of each array: 160 MB."""
_RUNS = 7


@numba.njit(cache=True, nogil=True)
def triad(a, b, c, scale):
    """a = b + scale · c."""
    for i in range(a.size):
        a[i] = b[i] + scale * c[i]


@dataclass(frozen=True)
class Roofline:
    """A kernel's rate beside what memory allows."""

    bytes_per_reading: float
    """Bytes that the kernel has to move for a reading, as its author states them."""
    readings_per_s: float
    bandwidth_bytes_per_s: float

    @property
    def limit_readings_per_s(self) -> float:
        """What memory allows."""
        return self.bandwidth_bytes_per_s / self.bytes_per_reading

    @property
    def fraction(self) -> float:
        """Share of that limit which is reached."""
        return self.readings_per_s / self.limit_readings_per_s

    def line(self) -> str:
        """One line for a table."""
        return (
            f"{self.bytes_per_reading:.3g} bytes a reading of {self.bandwidth_bytes_per_s / 1e9:.1f} GB/s (triad) "
            f"allow {self.limit_readings_per_s / 1e6:,.0f} M readings/s"
        )


def roofline(bytes_per_reading: float, readings_per_s: float, threads: int = 2) -> Roofline:
    """A kernel's rate against the triad of as many threads, measured now (once a process)."""
    return Roofline(bytes_per_reading, readings_per_s, triad_bytes_per_s(threads))


@functools.cache
def triad_bytes_per_s(threads: int, elements: int = _ELEMENTS) -> float:
    """Best of several triads."""
    parts = [_arrays(elements // threads) for _ in range(threads)]
    times = []
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(_RUNS + 1):  # the first compiles and touches the pages
            started = time.perf_counter()
            for done in [pool.submit(triad, *part, 3.0) for part in parts]:
                done.result()
            times.append(time.perf_counter() - started)
    return threads * (elements // threads) * 24 / min(times[1:])


def _arrays(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros(size), np.ones(size), np.full(size, 2.0)
