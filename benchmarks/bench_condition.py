"""Indices of one profile: samples a second of a core, beside a loop over NumPy's matrices as it is usually written.

Then the memory of a process that computes the condition of lanes of 0.5, 1 and 2 km from their tiles.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from benchmarks.bench_lanes import RoughSurvey, rough_scene
from benchmarks.timing import Figure, thread_seconds
from roadscan.condition.kernels.quarter_car import roll
from roadscan.condition.profiles.profiles import GOLDEN_CAR, RULES, SPEED_M_PER_S
from roadscan.condition.profiles.ride import ride
from roadscan.condition.profiles.texture import texture_segments
from roadscan.condition.profiles.unevenness import road_spectrum, straightedge_mm

SAMPLES = 1_000_000
PLAIN_SAMPLES = 20_000
LENGTHS_M = (500.0, 1000.0, 2000.0)


def figures(folder: Path) -> Iterator[Figure]:
    """IRI at three spacings, then the other indices, then memory."""
    yield from rates()
    yield from memory(folder)


def rates() -> Iterator[Figure]:
    """Samples a second."""
    rng = np.random.default_rng(0)
    h = np.cumsum(rng.normal(0.0, 3e-4, SAMPLES))
    stations = {
        "a sample each 25 mm": 0.025 * np.arange(SAMPLES),
        "a sample each 250 mm": 0.25 * np.arange(SAMPLES),
        "10 to 40 mm, at random": np.cumsum(rng.uniform(0.01, 0.04, SAMPLES)),
    }
    plain = PLAIN_SAMPLES / thread_seconds(lambda: plain_iri(h[:PLAIN_SAMPLES], 0.25), 3) / 1e6
    for name, x in stations.items():
        yield Figure(
            f"IRI, {name}", kernel_rate(x, h[None]), "M samples/s", plain, "a loop over NumPy's 4 × 4 matrices"
        )
    x = stations["a sample each 25 mm"]
    eight = np.repeat(h[None, : SAMPLES // 8], 8, axis=0)
    yield Figure("IRI, eight profiles at once", kernel_rate(x[: SAMPLES // 8], eight), "M samples/s")
    yield rate("IRI with its checks", lambda: ride(x, h))
    yield rate("spectrum", lambda: road_spectrum(x, h))
    yield rate("straightedge of 3 m", lambda: straightedge_mm(x, h, 3.0))
    fine = 5e-5 * np.arange(SAMPLES)
    yield rate("texture, a sample each 50 µm", lambda: texture_segments(fine, 1e-3 * rng.normal(size=SAMPLES)))


def memory(folder: Path) -> Iterator[Figure]:
    """Peak memory of a process that follows a lane, which does all tasks itself, as a worker does some of them."""
    first, spent = 0.0, {}
    for length_m in LENGTHS_M:
        passes = [{"lane": 2, "speed_m_per_s": 27.7}]
        scene = rough_scene(2.0, length_m, passes=passes, profilers={"spacing_m": 0.1, "readings": 100})
        made = RoughSurvey.made(scene, folder / f"{length_m:.0f}m")
        _used(made.file, "ingest navigate footprints tiles")
        peak_mb, spent[length_m] = _used(made.file, "condition")
        first = first or peak_mb
        yield Figure(f"condition of {length_m / 1000:g} km of lane: peak memory", peak_mb, "MiB", first, "0.5 km")
    # The difference leaves out what starting and compiling cost.
    more_km = (LENGTHS_M[-1] - LENGTHS_M[0]) / 1000
    each = (spent[LENGTHS_M[-1]] - spent[LENGTHS_M[0]]) / more_km
    yield Figure("condition of a kilometre more of lane, 50 mm cells, with its pictures (bar 20)", each, "core-s")


def _used(survey_file: Path, stages: str) -> tuple[float, float]:
    """Peak resident memory (MiB) and processor time (s) of a process of its own that does some stages."""
    script = (
        "import json, resource, sys, time; from pathlib import Path; from benchmarks.bench_lanes import RoughSurvey;"
        "from roadscan.survey.run import run_stages; from roadscan.run.stage import stage_named;"
        "run_stages(RoughSurvey(Path(sys.argv[1])).session('store'), [stage_named(n) for n in sys.argv[2].split()]);"
        "print(json.dumps([resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, time.process_time()]))"
    )
    command = [sys.executable, "-c", script, str(survey_file), stages]
    out = subprocess.run(command, check=True, capture_output=True, text=True)
    peak_mb, spent_s = json.loads(out.stdout.splitlines()[-1])
    return float(peak_mb), float(spent_s)


def kernel_rate(x: np.ndarray, heights: np.ndarray) -> float:
    """Million samples a second of the kernel alone."""
    response, measured = np.empty(heights.shape), np.empty(heights.shape)
    seconds = thread_seconds(lambda: roll(x, heights, GOLDEN_CAR, RULES, False, response, measured), 9)
    return heights.size / seconds / 1e6


def rate(what: str, function: object) -> Figure:
    """Million samples a second of a whole function."""
    assert callable(function)
    return Figure(what, SAMPLES / thread_seconds(function, 3) / 1e6, "M samples/s")


def plain_iri(h: np.ndarray, step: float) -> float:
    """IRI (m/km) with a transition matrix and a product of it for each sample."""
    k1, k2, c, mu = 653.0, 63.3, 6.0, 0.15
    motion = np.array([[0, 1, 0, 0], [-k2, -c, k2, c], [0, 0, 0, 1], [k2 / mu, c / mu, -(k1 + k2) / mu, -c / mu]])
    transition = expm(motion * step / SPEED_M_PER_S)
    push = np.linalg.solve(motion, (transition - np.eye(4)) @ np.array([0.0, 0.0, 0.0, k1 / mu]))
    slope = np.diff(h) / step
    start = (h[round(11 / step)] - h[0]) / 11.0
    state, total = np.array([start, 0.0, start, 0.0]), 0.0
    for s in slope:
        state = transition @ state + push * s
        total += abs(state[2] - state[0])
    return 1e3 * total / slope.size
