"""Whole runs beside the sensors' own speed: a triangulation pair, an HDL-32E, a SICK, on each class of processor.

Every run is a fresh process with a fresh store, computing as ``roadscan run --workers 2`` does; figures are medians.
*A default run* is what a user waits for: all stages of the survey file as it is, from the raw logs to the last product.
*From stored readings* is what a survey that is ingested takes with the poses as they were recorded, to 5 mm or 5 cm
cells, GeoTIFF and LAZ of 100 mm. Where other work keeps the machine busy, only figures by processor time hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks import same_grid, surveys
from benchmarks.by_hand import by_hand
from benchmarks.measured_run import Runs, Way, measured_in_turns, processors
from benchmarks.pipeline import DEFAULT, END_TO_END
from benchmarks.roofline import roofline, triad_bytes_per_s
from benchmarks.settings import Settings, bench_folder
from benchmarks.timing import Figure

_WARM_UP = {"pair": 2.0, "hdl32e": 3.0, "sick": 60.0}
"""Metres or seconds of the run that is not counted: it compiles what has not been compiled."""
_STORED_BARS = {"pair": {"AVX2": 1.0, "AVX-512": 1.5}, "hdl32e": {"AVX2": 30.0, "AVX-512": 60.0}}
"""Times real time from stored readings to products that are wanted."""
_DEFAULT_BARS = {"pair": {"AVX2": 0.6, "AVX-512": 1.0}, "hdl32e": {"AVX2": 10.0, "AVX-512": 20.0}}
"""Times real time of a default run that are wanted."""
_BY_HAND_BARS = {"AVX2": 60.0, "AVX-512": 100.0}
"""How much faster than by hand is wanted."""
_STORED_BYTES_BAR = 4.5
"""Bytes that a lidar's return may take in the store."""
_ADJUST_BAR = 0.1
"""Processor time of the adjustment, of that of the tiles."""
_LEAST_SHARE = 0.005
"""Stages with a smaller share of a run's processor time are left out."""
_NAMES = {"pair": "(a) pair", "hdl32e": "(b) HDL-32E", "sick": "(c) SICK"}


def figures(folder: Path) -> Iterator[Figure]:
    """The three surveys, then the same work by other means."""
    size, kept = Settings.current(), bench_folder(folder)
    for threads in (1, 2):
        yield Figure(f"this machine: triad, {threads} threads", triad_bytes_per_s(threads) / 1e9, "GB/s")
    ways = [Way(processor, products) for processor in processors() for products in ((), (DEFAULT,))]
    pairs: list[Runs] = []
    for name, length in (("pair", size.pair_m), ("hdl32e", size.hdl_s), ("sick", size.sick_s)):
        if not length:
            continue
        make = getattr(surveys, name)
        measured_in_turns(make(kept, _WARM_UP[name]), folder, ways, size.workers, repeats=1)
        done = measured_in_turns(make(kept, length), folder, ways, size.workers, size.repeats)
        stored, default = done[::2], done[1::2]
        pairs += stored if name == "pair" else []
        for one in stored:
            yield from _from_stored(one)
        for one in default:
            yield from _by_default(one)
        yield from _of_survey(stored[0])
    if size.sample_m:
        yield from _by_hand(folder, surveys.pair(kept, size.sample_m), pairs)
    if size.las_points:
        yield from same_grid.figures(folder, size.las_points)


def _name(runs: Runs) -> str:
    return f"{_NAMES[runs.survey.name]}, {runs.way.processor}"


def _from_stored(runs: Runs) -> Iterator[Figure]:
    """Speed from stored readings to products on a class of processor, and of the stages that it is made of."""
    survey, name = runs.survey, f"{_name(runs)}: from stored readings"
    bar = _STORED_BARS.get(survey.name, {}).get(runs.way.processor)
    yield Figure(f"{name}, times real time", runs.real_time(*END_TO_END), "x", bar, "bar")
    yield Figure(f"{name}, the same by processor time", runs.real_time(*END_TO_END, by_processor=True), "x", bar, "bar")
    yield from _stages(runs, name, END_TO_END)


def _by_default(runs: Runs) -> Iterator[Figure]:
    """Speed of a default run, from raw logs to the last product, and each stage's share."""
    survey, name = runs.survey, f"{_name(runs)}: default run"
    bar = _DEFAULT_BARS.get(survey.name, {}).get(runs.way.processor)
    yield Figure(f"{name}, times real time", runs.real_time(*runs.stages), "x", bar, "bar")
    yield Figure(
        f"{name}, the same by processor time", runs.real_time(*runs.stages, by_processor=True), "x", bar, "bar"
    )
    yield from _stages(runs, name, runs.stages)
    share = runs.cpu_s("adjust") / runs.cpu_s("tiles")
    yield Figure(f"{name}, adjust against tiles", share, "x", _ADJUST_BAR, "bar")


def _stages(runs: Runs, name: str, stages: Sequence[str]) -> Iterator[Figure]:
    """Processor time of stages a reading, beside that of all; the ratio is a stage's share."""
    whole = runs.cpu_s(*stages)
    for stage in stages:
        if runs.cpu_s(stage) > _LEAST_SHARE * whole:
            yield Figure(f"{name}, {stage}", _ns(runs, runs.cpu_s(stage)), "ns", _ns(runs, whole), "ns a reading, all")


def _ns(runs: Runs, seconds: float) -> float:
    return 1e9 * seconds / runs.survey.readings


def _of_survey(runs: Runs) -> Iterator[Figure]:
    """Bytes and memory, and the tiles stage beside the memory's bandwidth."""
    survey, name = runs.survey, _NAMES[runs.survey.name]
    sensor = survey.readings / survey.recorded_s / 1e6
    made = ", ".join(runs.figures[0]["products"])
    count = f"{survey.readings / 1e6:,.1f} M readings, {survey.recorded_s:,.1f} s"
    yield Figure(f"{name}: from stored ({made}; {count})", rate(runs, *END_TO_END), "M/s", sensor, "the sensor")
    yield Figure(f"{name}: start of {runs.workers} workers, once a run", runs.figure("start_s"), "s")
    yield _stage_roofline(runs)
    bar = _STORED_BYTES_BAR if survey.name == "hdl32e" else survey.raw_bytes / survey.readings
    against = "bar" if survey.name == "hdl32e" else "raw logs"
    yield Figure(f"{name}: stored", runs.figure("reading_bytes") / survey.readings, "B/reading", bar, against)
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


def _by_hand(folder: Path, survey: surveys.BenchSurvey, pairs: Sequence[Runs]) -> Iterator[Figure]:
    """The same by NumPy in one process, and how much faster roadscan's two workers are, both by processor time."""
    done = by_hand(survey, folder)
    name = "(a) pair, by hand: NumPy, SciPy, pyproj, rasterio, laspy"
    for step, seconds in done.seconds.items():
        yield Figure(f"{name}: {step}", done.readings / seconds / 1e6, "M/s")
    yield Figure(f"{name}: all", done.readings_per_s / 1e6, "M/s")
    for runs in pairs:
        ratio = runs.workers * runs.survey.readings / runs.cpu_s(*END_TO_END) / done.readings_per_s
        what, bar = f"{_name(runs)}: from stored readings, against by hand", _BY_HAND_BARS[runs.way.processor]
        yield Figure(what, ratio, "x", bar, "bar")
