"""The reference site through raw logs: 3.3 km, 12 runs, control each 300 m or 825 m, a check point each 25 m.

The logs are simulated, and the stages from ingest to adjustment run as for any survey. What counts is the height of the
adjusted surface at the check points against the true one. Beside it stands what the best linear unbiased estimate from
the true statistics is expected to reach, from :mod:`benchmarks.bench_reference_site`.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bench_reference_site import BARS, REPEATABILITY_MM, SITE, BestEstimate
from benchmarks.settings import Settings
from benchmarks.timing import Figure
from roadscan.jobs.engine.compute_on import compute_on
from roadscan.jobs.run import run_stages
from roadscan.jobs.session import Reporter, Session
from roadscan.jobs.stage import stage_named
from roadscan.model.survey import Survey
from roadscan.simulate import Scene, simulate, truth
from roadscan.tables.sql import query
from roadscan.tables.store import Store

STAGES = ("ingest", "navigate", "footprints", "adjust")
CHECK_SPACING_M = 25.0
OFFSET_M = 1.9
"""Control and check points lie in the middle of the lane that all runs drive."""
_OFF = {"on": False}


def figures(folder: Path) -> Iterator[Figure]:
    """By spacing of the control and mode: mean absolute height error and repeatability."""
    size = Settings.current()
    for spacing, (alone, together) in BARS.items():
        name = folder / f"site-{spacing:.0f}"
        survey_file = simulate(scene(spacing, size.reference_m, size.reference_runs), name).survey_file
        road = replace(SITE, control_spacing_m=spacing, length_m=size.reference_m, runs=size.reference_runs)
        checks = np.linspace(0.0, road.length_m, 102)[1:-1]
        for mode, bar in (("each_pass", alone), ("joint", together)):
            error = errors(survey_file, name / "store", mode)
            best = 1e3 * BestEstimate.of(road, checks, joint=mode == "joint").expected
            what = f"{spacing:.0f} m, {'all runs' if mode == 'joint' else 'each run alone'}, from raw logs"
            mean = 1e3 * float(np.nanmean(np.abs(error)))
            yield Figure(f"{what}: mean absolute height error (bar {bar})", mean, "mm", best, "best, expected")
            if mode == "joint":
                spread = 1e3 * float(np.nanmean(np.nanstd(error, axis=0, ddof=1)))
                yield Figure(f"{what}: repeatability (bar {REPEATABILITY_MM})", spread, "mm")
        shutil.rmtree(name)


def scene(spacing_m: float, length_m: float, runs: int) -> Scene:
    """The reference site, longer: points without paint, profilers alone, a post-processor's errors."""
    points = [("gcp", float(s)) for s in np.arange(0.0, length_m + 0.1, spacing_m)]
    points += [("check", float(s)) for s in np.arange(CHECK_SPACING_M / 2, length_m, CHECK_SPACING_M)]
    targets = [
        {"station_m": min(max(s, 1.0), length_m - 1.0), "offset_m": OFFSET_M, "role": role}
        for role, s in sorted(points)
    ]
    bare: dict[str, Any] = {
        k: [] for k in ("joints", "cracks", "alligators", "potholes", "patches", "stains", "tyre_marks")
    }
    return Scene.load("reference_site").changed(
        length_m=length_m,
        road={"alignment": [{"kind": "straight", "length_m": length_m + 200.0}], "targets": targets, **bare},
        passes=[{"lane": 2, "offset_m": (-0.2, 0.0, 0.2)[k % 3]} for k in range(runs)],
        roadside={"poles": [], "trees": []},
        profilers={"spacing_m": 0.05, "readings": 400, "head_imus": None},
        lidar=_OFF, imu=_OFF, gnss=_OFF, encoder=_OFF, camera=_OFF,
        vehicle={"speed_m_per_s": 100 / 3.6, "standstill_s": 0.0},
        noise={
            "position_m": 0.010, "down_m": 0.015, "time_constant_s": 120.0, "attitude_deg": 0.004, "heading_deg": 0.008,
            "attitude_time_constant_s": 60.0, "control_m": 0.002,
        },
    )  # fmt: skip


def errors(survey_file: Path, folder: Path, mode: str) -> np.ndarray:
    """Height error (runs, checks) of the adjusted surface at the check points (m); NaN where a run did not see one."""
    survey = Survey.load(survey_file)
    values = survey.config.model_dump() | {"rig": survey.rig.model_dump()}
    values["adjust"] |= {"mode": mode}
    values["adjust"]["ties"]["cell_m"] = 0.05
    store = Store(str(folder), survey.config.id)
    with compute_on(Settings.current().workers) as compute:
        session = Session(Survey.parse(values, folder=survey.folder), store, compute, None, Reporter())
        run_stages(session, [stage_named(name) for name in STAGES])
    statement = "SELECT name, run, easting_m, northing_m, height_after_m FROM control_residuals WHERE role = 'check'"
    found = query(store, statement).to_pandas()
    known, surveyed = truth.load(survey_file.parent), surveyed_heights(survey_file.parent)
    true = known.height_m(found.easting_m, found.northing_m)
    found["error"] = true - (found.name.map(surveyed) - found.height_after_m)
    return found.pivot(index="run", columns="name", values="error").to_numpy()


def surveyed_heights(folder: Path) -> dict[str, float]:
    """Height of each control and check point as the survey states it."""
    with (folder / "control.csv").open() as stream:
        return {row["name"]: float(row["height_m"]) for row in csv.DictReader(stream)}
