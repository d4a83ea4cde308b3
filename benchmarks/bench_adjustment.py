"""The adjustment at the size of a network: 100 km × 4 passes with a tie every 5 m, solved with its covariance."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.drawn_road import Road, control, drawn_errors, ties
from benchmarks.settings import Settings
from benchmarks.timing import Figure
from roadscan.adjust.adjustment import AdjustmentSettings, adjust
from roadscan.adjust.observations import Observations

FALSE_SHARE = 0.05
"""Of the ties are false matches, so that rounds of re-weighting are part of what is timed."""


def figures(_: Path) -> Iterator[Figure]:
    """Time and memory, in a process of its own."""
    length_km = Settings.current().adjustment_km
    command = [sys.executable, "-m", "benchmarks.bench_adjustment", str(length_km)]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    rows, unknowns, seconds, core_seconds, gigabytes, rounds, down_mm, nees = map(float, found)
    what = f"{length_km:g} km × 4 passes"
    yield Figure(f"{what}: observations", rows, "")
    yield Figure(f"{what}: unknowns", unknowns, "")
    yield Figure(f"{what}: solved with covariance (bar: 300)", seconds, "s")
    yield Figure(f"{what}: time of a core", core_seconds, "s")
    yield Figure(f"{what}: rounds of weighting", rounds, "")
    yield Figure(f"{what}: memory of the process (bar: 4)", gigabytes, "GiB")
    yield Figure(f"{what}: height error at the knots, RMS", down_mm, "mm")
    yield Figure(f"{what}: normalised squared error of heights", nees, "")


def main(length_km: float) -> None:
    """Solve once, and print the figures."""
    road = Road(1000.0 * length_km, 4, 5.0, 1000.0, lane_m=3.5)
    rng = np.random.default_rng(1)
    settings = AdjustmentSettings()
    seen = np.arange(0.0, road.length_m, road.speed_m_s * 1.7)
    drawn = drawn_errors(road, np.concatenate([road.ties_m, road.control_m, seen]), rng)
    joined = Observations.joined([ties(road, drawn, rng), control(road, drawn, rng)])
    small = Observations.joined([joined.chosen(np.arange(200) * (joined.size // 200))])
    adjust(small, road.priors(), settings.model_copy(update={"knot_spacing_s": 60.0}))  # compiles
    false = rng.uniform(size=joined.size) < FALSE_SHARE
    joined.observed_m[false] += rng.uniform(-0.1, 0.1, int(false.sum()))
    started, core = time.perf_counter(), time.process_time()
    found = adjust(joined, road.priors(), settings)
    seconds, core = time.perf_counter() - started, time.process_time() - core
    error, sigma = [], []
    for run in range(road.runs):
        epochs = road.epochs(seen)
        shift, _ = found.corrections(found.runs[run]).at(epochs)
        error.append(drawn.at(run, seen)[:, 2] - shift[:, 2])
        sigma.append(found.sigma_of(run, epochs, np.tile(np.eye(6)[2], (seen.size, 1))))
    errors, sigmas = np.concatenate(error), np.concatenate(sigma)
    gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    unknowns = 6 * sum(k.size for k in found.epochs_gps_ns)
    print(joined.size, unknowns, seconds, core, gigabytes, found.rounds)
    print(1e3 * np.sqrt(np.mean(errors**2)), np.mean((errors / sigmas) ** 2))


if __name__ == "__main__":
    main(float(sys.argv[1]))
