"""Whole runs beside the sensors' own speed: a triangulation pair, an HDL-32E, a SICK.

Every run is a fresh process with a fresh store, computing as ``roadscan run --workers 2`` does; figures are medians.
*End to end* is from the stored readings and the trajectory to the finished products; ingest stands by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks import same_grid, surveys
from benchmarks.by_hand import by_hand
from benchmarks.measured_run import Runs, measured_runs
from benchmarks.roofline import roofline, triad_bytes_per_s
from benchmarks.settings import Settings, bench_folder
from benchmarks.timing import Figure

END_TO_END = ("navigate", "footprints", "tiles", "products")
_WARM_UP = {"pair": 2.0, "hdl32e": 3.0, "sick": 60.0}
"""Metres or seconds of the run that is not counted: it compiles what has not been compiled."""
_BARS = {"pair": 1.0, "hdl32e": 60.0, "sick": 1000.0}
_NAMES = {"pair": "(a) pair", "hdl32e": "(b) HDL-32E", "sick": "(c) SICK"}


def figures(folder: Path) -> Iterator[Figure]:
    """The three surveys, then the same work by other means."""
    size, kept = Settings.current(), bench_folder(folder)
    for threads in (1, 2):
        yield Figure(f"this machine: triad, {threads} threads", triad_bytes_per_s(threads) / 1e9, "GB/s")
    rates = {}
    for name, length in (("pair", size.pair_m), ("hdl32e", size.hdl_s), ("sick", size.sick_s)):
        if not length:
            continue
        make = getattr(surveys, name)
        measured_runs(make(kept, _WARM_UP[name]), folder, size.workers, repeats=1)
        runs = measured_runs(make(kept, length), folder, size.workers, size.repeats)
        rates[name] = rate(runs, *END_TO_END)
        yield from of_runs(runs)
    if size.sample_m:
        yield from _by_hand(folder, surveys.pair(kept, size.sample_m), rates.get("pair"))
    if size.las_points:
        yield from same_grid.figures(folder, size.las_points)


def of_runs(runs: Runs) -> Iterator[Figure]:
    """Speed a stage and end to end, bytes, memory; the sensor's own speed stands beside them."""
    survey, name = runs.survey, _NAMES[runs.survey.name]
    sensor = survey.readings / survey.recorded_s / 1e6
    count = f"{survey.readings / 1e6:,.1f} M readings, {survey.recorded_s:,.1f} s"
    for stage in ("ingest", "adjust", *(s for s in END_TO_END if runs.wall_s(s) > 0.05)):
        yield Figure(f"{name}: {stage}", rate(runs, stage), "M/s", sensor, "the sensor")
    made = ", ".join(runs.figures[0]["products"])
    yield Figure(f"{name}: end to end ({made}; {count})", rate(runs, *END_TO_END), "M/s", sensor, "the sensor")
    for what, stages in (("ingest", ("ingest",)), ("end to end", END_TO_END)):
        yield Figure(
            f"{name}: {what}, times real time", survey.recorded_s / runs.wall_s(*stages), "x", _BARS[survey.name], "bar"
        )
    yield Figure(f"{name}: start of {runs.workers} workers, once a run", runs.figure("start_s"), "s")
    per_reading = 1e9 * runs.cpu_s(*END_TO_END) / survey.readings
    yield Figure(f"{name}: processor time end to end", per_reading, "ns/reading")
    yield _stage_roofline(runs)
    raw = survey.raw_bytes / survey.readings
    yield Figure(f"{name}: stored", runs.figure("reading_bytes") / survey.readings, "B/reading", raw, "raw logs")
    yield Figure(f"{name}: tiles and products", runs.figure("tile_bytes") / runs.figure("cells"), "B/cell")
    yield Figure(f"{name}: peak memory of a worker", runs.figure("worker_mb"), "MiB", 1536.0, "bar")
    yield Figure(f"{name}: peak memory of the first process", runs.figure("main_mb"), "MiB")


def rate(runs: Runs, *stages: str) -> float:
    """Million readings a second."""
    return runs.survey.readings / runs.wall_s(*stages) / 1e6


def _stage_roofline(runs: Runs) -> Figure:
    """The tiles stage against memory: bytes that it cannot do without, reading and decoding the raw readings.

    They are read as they are stored, written decoded (3 bytes: range and intensity), and read again.
    """
    stored = runs.figure("reading_bytes") / runs.survey.readings
    line = roofline(stored + 2 * 3, 1e6 * rate(runs, "tiles"), runs.workers)
    limit, what = line.limit_readings_per_s / 1e6, f"{_NAMES[runs.survey.name]}: tiles against memory"
    return Figure(what, line.readings_per_s / 1e6, "M/s", limit, line.line())


def _by_hand(folder: Path, survey: surveys.BenchSurvey, here: float | None) -> Iterator[Figure]:
    done = by_hand(survey, folder)
    theirs = done.readings_per_s / 1e6
    name = "(a) pair, by hand: NumPy, SciPy, pyproj, rasterio, laspy"
    for step, seconds in done.seconds.items():
        yield Figure(f"{name}: {step}", done.readings / seconds / 1e6, "M/s")
    if here is None:
        yield Figure(f"{name}: end to end", theirs, "M/s")
    else:
        yield Figure("(a) pair: end to end", here, "M/s", theirs, f"by hand, one process, {done.readings / 1e6:.0f} M")
