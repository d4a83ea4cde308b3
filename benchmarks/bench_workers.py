"""How much faster more workers are than one, on a machine of few cores: each worker has the same small share of a core.

Shares are set by control groups, which takes a system with their version 1 and the right to make them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks import surveys
from benchmarks.measured_run import Runs, Way, measured_in_turns, measured_runs
from benchmarks.pipeline import END_TO_END
from benchmarks.settings import Settings, bench_folder
from benchmarks.timing import Figure


def figures(folder: Path) -> Iterator[Figure]:
    """Wall time of one worker over that of several, each with the same share of a core."""
    size, kept = Settings.current(), bench_folder(folder)
    spacing_m = size.scaling_spacing_mm / 1e3
    measured_runs(surveys.short_pair(kept, spacing_m), folder, 1, repeats=1)  # compiles
    survey = surveys.pair(kept, 1000 * size.workers_km, spacing_m)
    one: Runs | None = None
    for workers in (1, 2, 4, 8):
        (runs,) = measured_in_turns(survey, folder, [Way(share=size.workers_share)], workers, repeats=1)
        one = one or runs
        wall_s, alone_s = runs.wall_s(*END_TO_END), one.wall_s(*END_TO_END)
        name = f"{survey.length_m / 1000:g} km, {workers} of {size.workers_share:g} cores"
        yield Figure(f"{name}: end to end", wall_s, "s", alone_s, "1 worker")
        yield Figure(f"{name}: faster than one", alone_s / wall_s, "x", workers, "even")
        yield Figure(f"{name}: processor time", runs.cpu_s(*END_TO_END), "s", one.cpu_s(*END_TO_END), "1 worker")
        yield Figure(f"{name}: peak memory of a worker", runs.figure("worker_mb"), "MiB")
        yield Figure(f"{name}: peak memory of the first process", runs.figure("main_mb"), "MiB")
