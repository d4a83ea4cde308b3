"""Whole runs of simulated surveys: speed a stage, one tile of 2 km, memory of a worker over 1 and 4 km."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.timing import Figure
from roadscan.core.grid import TileId
from roadscan.core.survey import Survey
from roadscan.demo.demo import summarise
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Selection, Session
from roadscan.run.stage import stages
from roadscan.simulate import Scene, simulate
from roadscan.store.logs import read_log_records
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.survey.run import run_stages


def figures(folder: Path) -> Iterator[Figure]:
    """One core throughout: tasks run in this process."""
    long = road(folder / "2km", 2000.0, spacing_m=0.05, lidar=True)
    seconds = {}
    for stage in stages():
        started = time.perf_counter()
        run_stages(run_of(long), [stage])
        seconds[stage.name] = time.perf_counter() - started
    readings = summarise(long).readings / 1e6
    for name, value in seconds.items():
        yield Figure(f"2 km, two heads and lidar, {readings:.0f} M readings: {name}", readings / value, "M/s")
    yield from one_tile(long)
    yield from memory(folder)


def one_tile(survey_file: Path) -> Iterator[Figure]:
    """Reprocess the fullest tile in a warm process."""
    run = run_of(survey_file)
    records = [r for r in Manifest(run.store).of("tile").values() if r.path]
    fullest = max(records, key=lambda r: r.figures()["points"])
    selection = Selection(named=(TileId.parse(fullest.unit),))
    started = time.perf_counter()
    again = run_of(survey_file, selection)
    run_stages(again)
    yield Figure("one tile of 2 km, all stages (bar: 3)", time.perf_counter() - started, "s")
    raw = sum(f.bytes for r in read_log_records(run.store) for t in ("scans", "returns") for f in r.tables.get(t, ()))
    yield Figure("one tile of 2 km, raw bytes read (bar: 3)", 100 * again.raw_bytes_read / raw, "%")


def memory(folder: Path) -> Iterator[Figure]:
    """Peak memory of a process that runs a whole survey."""
    peaks = {}
    for length in (1000.0, 4000.0):
        survey_file = road(folder / f"{length:.0f}m", length, spacing_m=0.05, lidar=False)
        peaks[length] = peak_mb(survey_file)
    yield Figure("peak memory, 4 km (bar: within 10 % of 1 km)", peaks[4000.0], "MB", peaks[1000.0], "1 km")


def peak_mb(survey_file: Path) -> float:
    """Peak resident memory of `roadscan run --workers 0` (MB)."""
    script = (
        "import json, resource, sys; from benchmarks.bench_pipeline import run_of; from pathlib import Path;"
        "from roadscan.survey.run import run_stages; run_stages(run_of(Path(sys.argv[1])));"
        "print(json.dumps(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))"
    )
    out = subprocess.run([sys.executable, "-c", script, str(survey_file)], check=True, capture_output=True, text=True)
    return float(json.loads(out.stdout.splitlines()[-1])) / 1024


def road(folder: Path, length_m: float, *, spacing_m: float, lidar: bool) -> Path:
    """The demo's road, longer, driven once at 25 m/s."""
    scene = Scene.load("demo").changed(
        length_m=length_m,
        profilers={"spacing_m": spacing_m},
        lidar={"on": lidar},
        vehicle={"speed_m_per_s": 25.0},
        road={"lead_m": 45.0},
        passes=[{"lane": 2, "direction": "forward"}],
    )
    return simulate(scene, folder).survey_file


def run_of(survey_file: Path, selection: Selection | None = None) -> Session:
    """A run in this process."""
    survey = Survey.load(survey_file)
    return Session(survey, Store(survey.store_url, survey.config.id), Inline(), selection)
