"""Timing of a function: the best of several runs, after a warm-up."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One measured figure, beside what it is compared with."""

    what: str
    value: float
    unit: str
    other: float | None = None
    against: str = ""


def best_seconds(function: Callable[[], object], runs: int = 3) -> float:
    """Shortest wall time of `runs` calls, after one that is not counted (compilation, caches)."""
    function()
    times = []
    for _ in range(runs):
        started = time.perf_counter()
        function()
        times.append(time.perf_counter() - started)
    return min(times)
