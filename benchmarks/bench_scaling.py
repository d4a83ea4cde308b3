"""What a kilometre costs as the drive grows, with one and two workers: the pair, thinned out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks import surveys
from benchmarks.measured_run import Runs, measured_runs
from benchmarks.pipeline import END_TO_END, FROM_LOGS
from benchmarks.settings import Settings, bench_folder
from benchmarks.timing import Figure


def figures(folder: Path) -> Iterator[Figure]:
    """Each length beside the shortest, two workers beside one."""
    size, kept = Settings.current(), bench_folder(folder)
    lengths = [float(km) for km in size.scaling_km.split(",")]
    repeats = max(1, size.repeats // 2)
    spacing_m = size.scaling_spacing_mm / 1e3
    measured_runs(surveys.short_pair(kept, spacing_m), folder, 1, repeats=1)  # compiles
    ones: dict[float, Runs] = {}
    for workers in (1, 2):
        first: Runs | None = None
        for km in lengths:
            runs = measured_runs(surveys.pair(kept, 1000 * km, spacing_m), folder, workers, repeats)
            first = first or runs
            yield from _costs(runs, first)
            if workers == 1:
                ones[km] = runs
            else:
                yield from _speedup(ones[km], runs)


def _costs(runs: Runs, first: Runs) -> Iterator[Figure]:
    """Costs a kilometre, beside those of the shortest drive."""
    km = runs.survey.length_m / 1000
    name = f"{km:g} km, {runs.workers} worker{'s' if runs.workers > 1 else ''}"
    against = f"{first.survey.length_m / 1000:g} km"

    def beside(what: str, unit: str, value: float, other: float) -> Figure:
        return Figure(f"{name}: {what}", value, unit, other, against)

    def per_km(one: Runs, what: str) -> float:
        values = {
            "ingest": one.cpu_s("ingest"),
            "end to end": one.cpu_s(*END_TO_END),
            "stored": one.figure("reading_bytes") / 1e6,
            "written": one.figure("tile_bytes") / 1e6,
            "tasks": one.tasks(*FROM_LOGS),
        }
        return values[what] / (one.survey.length_m / 1000)

    yield beside("processor time of ingest", "s/km", per_km(runs, "ingest"), per_km(first, "ingest"))
    yield beside("processor time end to end", "s/km", per_km(runs, "end to end"), per_km(first, "end to end"))
    yield beside("readings stored", "MB/km", per_km(runs, "stored"), per_km(first, "stored"))
    yield beside("tiles and products", "MB/km", per_km(runs, "written"), per_km(first, "written"))
    yield beside("tasks", "/km", per_km(runs, "tasks"), per_km(first, "tasks"))
    yield beside("peak memory of a worker", "MiB", runs.figure("worker_mb"), first.figure("worker_mb"))
    yield beside("peak memory of the first process", "MiB", runs.figure("main_mb"), first.figure("main_mb"))


def _speedup(one: Runs, two: Runs) -> Iterator[Figure]:
    """Wall time of one worker over that of two; the start of the workers is not counted."""
    km = one.survey.length_m / 1000
    ratio = one.wall_s(*END_TO_END) / two.wall_s(*END_TO_END)
    yield Figure(f"{km:g} km: two workers against one, end to end", ratio, "x", 1.8, "bar")
    yield Figure(f"{km:g} km: two workers against one, ingest", one.wall_s("ingest") / two.wall_s("ingest"), "x")
