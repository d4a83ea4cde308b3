"""Mountings of the profiler pair from short drives over the simulated yard, over many seeds.

`ROADSCAN_SEEDS` says how many (20), `ROADSCAN_DRIVES` how many drives each (8).
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.calibration_yard import Yard, mounting_error, profiler_yard
from benchmarks.timing import Figure
from roadscan.model.calibration import CalibrationSettings
from roadscan.navigation.calibration.estimator import Calibration, calibrate
from roadscan.navigation.calibration.surfaces.heads import agreement
from roadscan.navigation.calibration.surfaces.heights import HeightTies
from roadscan.navigation.calibration.surfaces.readings import level_from_world, placed
from roadscan.navigation.calibration.unknowns import Estimate

BORESIGHT_DEG, LEVER_MM, OVERLAP_MM = 0.003, 3.0, 0.3
TRAJECTORIES = {
    "errorless trajectory": (0.0, 0.0),
    "2 mm, 0.0015°": (0.002, 0.0015),
    "6 mm, 0.004°": (0.006, 0.004),
}
"""Position (m), roll and pitch (degrees; heading twice that), Gauss–Markov of 60 s; the last is the scene's."""
AXES = ("forward", "right", "down", "roll", "pitch", "heading")


def figures(folder: Path) -> Iterator[Figure]:
    """Errors over all seeds and both heads: root mean square, and the largest beside it; then normalised errors."""
    seeds, drives = (int(os.environ.get(f"ROADSCAN_{name}", n)) for name, n in (("SEEDS", 20), ("DRIVES", 8)))
    for name, (position_m, attitude_deg) in TRAJECTORIES.items():
        errors, normed, overlaps, seconds = [], [], [], []
        for seed in range(1, seeds + 1):
            yard = profiler_yard(seed, drives, position_m, attitude_deg)
            started = time.perf_counter()
            found = solved(yard)
            seconds.append(time.perf_counter() - started)
            for sensor, one in found.sensors.items():
                error = mounting_error(one.mounting, yard.true[sensor])
                errors.append(error)
                normed.append(error / one.sigma)
            overlaps.append(overlap_mm(yard, found))
        yield from _table(f"{name}, {seeds} seeds", np.array(errors), np.array(normed))
        yield Figure(f"{name}: heads' overlap beyond noise", max(overlaps), "mm", OVERLAP_MM, "the bar; worst seed")
        yield Figure(f"{name}: time of a calibration", float(np.mean(seconds)), "s")


def _table(name: str, errors: np.ndarray, normed: np.ndarray) -> Iterator[Figure]:
    for axis, label in enumerate(AXES):
        values = 1e3 * errors[:, axis] if axis < 3 else np.degrees(errors[:, axis])
        unit, bar = ("mm", LEVER_MM) if axis < 3 else ("deg", BORESIGHT_DEG)
        rms, worst = float(np.sqrt(np.mean(values**2))), float(np.abs(values).max())
        normal = float(np.sqrt(np.mean(normed[:, axis] ** 2)))
        yield Figure(f"{name}: {label}", rms, unit, bar, f"the bar; worst {worst:.4g}, normalised RMS {normal:.2f}")


def solved(yard: Yard) -> Calibration:
    """Calibrate with heights alone."""
    evidence = HeightTies(yard.readings, yard.pieces, yard.traverses)
    return calibrate(yard.priors, evidence, yard.traverses, CalibrationSettings())


def overlap_mm(yard: Yard, found: Calibration) -> float:
    """Difference of the heads beyond noise where both see a place, root mean square over the drives."""
    estimate = Estimate(found.mountings, {}, {}, found.corrections)
    level = level_from_world(yard.readings)
    at = [placed(one, estimate, yard.pieces, yard.traverses, level) for one in yard.readings]
    by_drive: dict[str, list] = {}
    for one in at:
        by_drive.setdefault(one.readings.drive, []).append(one)
    return 1e3 * float(np.sqrt(np.mean([agreement(a, b).beyond_noise_m ** 2 for a, b in by_drive.values()])))
