"""Timing of a function: the best of several runs, after a warm-up."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One measured figure, beside what it is compared with."""

    what: str
    value: float
    unit: str
    other: float | None = None
    against: str = ""


def in_turns(
    functions: Sequence[Callable[[], object]], runs: int = 15, clock: Callable[[], float] = time.thread_time
) -> list[float]:
    """Shortest time of `runs` calls of each by a clock, after one that is not counted (compilation, caches).

    They take turns, so that one clock of the machine holds for all.
    """
    for function in functions:
        function()
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(runs):
        for function, own in zip(functions, times, strict=True):
            started = clock()
            function()
            own.append(clock() - started)
    return list(map(min, times))


def best_seconds(
    function: Callable[[], object], runs: int = 3, clock: Callable[[], float] = time.perf_counter
) -> float:
    """The same of one function."""
    return in_turns([function], runs, clock)[0]


def thread_seconds(function: Callable[[], object], runs: int = 5) -> float:
    """The same by the processor time of the calling thread."""
    return best_seconds(function, runs, time.thread_time)
