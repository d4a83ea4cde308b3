"""Mountings from the simulated yard, over many seeds: of the profiler pair, and of the lidar.

Profilers: from overlaps alone, and together with stop and go of the IMUs in the heads. Lidar: from planes.
Where the evidence leaves an axis open, its error is that of the start. `ROADSCAN_SEEDS` says how many seeds (20),
`ROADSCAN_PARTS` which of the parts ("overlap stop_and_go lidar"), `ROADSCAN_DRIVES` how many drives of the profilers
from overlaps alone (8).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.calibration_yard import (
    LIDAR_HEADINGS_DEG,
    Yard,
    head_orientations,
    lidar_yard,
    mounting_error,
    profiler_yard,
)
from benchmarks.timing import Figure
from roadscan.calibrate.estimator import Calibration, calibrate
from roadscan.calibrate.evidence import Evidence, Orientation
from roadscan.calibrate.surfaces.heights import HeightTies
from roadscan.calibrate.surfaces.objects import HeadTies, cell_heights
from roadscan.calibrate.surfaces.planes import LevelPoints, PlaneTies, level_from_world, placed
from roadscan.calibrate.unknowns import Estimate
from roadscan.core.settings.calibration import CalibrationSettings

BORESIGHT_DEG, LEVER_MM, OVERLAP_MM = 0.003, 3.0, 0.3
TRAJECTORIES = {
    "errorless trajectory": (0.0, 0.0),
    "2 mm, 0.0015°": (0.002, 0.0015),
    "6 mm, 0.004°": (0.006, 0.004),
}
"""Position (m), roll and pitch (degrees; heading twice that), Gauss–Markov of 60 s; the last is the scene's."""
TACTICAL = "2 mm, 0.0015°"
"""A solution of tactical grade, smoothed."""
AXES = ("forward", "right", "down", "roll", "pitch", "heading")
_SCALE = np.repeat([1e3, np.degrees(1.0)], 3)
"""To mm and degrees."""
_CELL_M, _LEAST_READINGS = 0.01, 4
"""Edge of a cell in which heights are compared (m), and readings of each head in it."""
_EVEN = 4.0
"""Cells with a variance above this multiple of the usual one lie on an edge."""

Solve = Callable[[int], tuple[Yard, Calibration]]


def figures(folder: Path) -> Iterator[Figure]:
    """Errors over all seeds: of each seed the worst, then root mean squares with the largest beside them."""
    parts = os.environ.get("ROADSCAN_PARTS", "overlap stop_and_go lidar").split()
    drives = int(os.environ.get("ROADSCAN_DRIVES", "8"))
    if "overlap" in parts:
        for name, level in TRAJECTORIES.items():
            yield from _seeds(f"heads, {name}", lambda seed, level=level: _overlap(seed, drives, level))
    if "stop_and_go" in parts:
        yield from _seeds(f"heads with stop and go, {TACTICAL}", lambda seed: _with_stop_and_go(seed, folder))
    if "lidar" in parts:
        yield from _seeds(f"lidar, {TACTICAL}", _lidar)


def _overlap(seed: int, drives: int, level: tuple[float, float]) -> tuple[Yard, Calibration]:
    yard = profiler_yard(seed, drives, *level)
    return yard, solved(yard)


def _with_stop_and_go(seed: int, folder: Path) -> tuple[Yard, Calibration]:
    drives, rounds = (int(os.environ.get(f"ROADSCAN_{name}", n)) for name, n in (("DRIVES", "16"), ("ROUNDS", "6")))
    yard = profiler_yard(seed, drives, *TRAJECTORIES[TACTICAL], length_m=3.5)
    return yard, solved(yard, head_orientations(yard, folder / f"heads-{seed}", rounds))


def _lidar(seed: int) -> tuple[Yard, Calibration]:
    yard = lidar_yard(seed, *TRAJECTORIES[TACTICAL], headings_deg=2 * LIDAR_HEADINGS_DEG)
    evidence = PlaneTies(yard.readings, yard.pieces, yard.traverses)
    return yard, calibrate(yard.priors, evidence, yard.traverses, CalibrationSettings())


def solved(yard: Yard, orientations: Sequence[Orientation] = ()) -> Calibration:
    """Calibrate the heads with heights, the strip they both see, and their orientations where there are any."""
    heights, strip = (find(yard.readings, yard.pieces, yard.traverses) for find in (HeightTies, HeadTies))

    def evidence(estimate: Estimate) -> list[Evidence]:
        return [*heights(estimate), *strip(estimate), *orientations]

    return calibrate(yard.priors, evidence, yard.traverses, CalibrationSettings())


def _seeds(name: str, solve: Solve) -> Iterator[Figure]:
    """Of each seed its worst error against the bar, then all seeds' figures."""
    seeds = int(os.environ.get("ROADSCAN_SEEDS", "20"))
    errors, sigmas, overlaps, seconds = [], [], [], []
    for seed in range(1, seeds + 1):
        started = time.perf_counter()
        yard, found = solve(seed)
        seconds.append(time.perf_counter() - started)
        for sensor, one in found.sensors.items():
            error, sigma = _SCALE * mounting_error(one.mounting, yard.true[sensor]), _SCALE * one.sigma
            yield _of_seed(f"{name}, seed {seed}, {sensor}", error, sigma, one.not_determined)
            errors.append(error)
            sigmas.append(sigma)
        if len(found.sensors) > 1:
            overlaps.append(overlap_mm(yard, found))
    yield from _table(f"{name}, {seeds} seeds", np.array(errors), np.array(sigmas))
    if overlaps:
        yield Figure(f"{name}: heads' overlap beyond noise", max(overlaps), "mm", OVERLAP_MM, "the bar; worst seed")
    yield Figure(f"{name}: simulation and calibration", float(np.mean(seconds)), "s")


def _of_seed(name: str, error: np.ndarray, sigma: np.ndarray, left: Sequence[str]) -> Figure:
    """The boresight's worst axis against the bar; beside it all errors with their σ."""
    each = ", ".join(f"{a} {e:+.4f} ({s:.4f})" for a, e, s in zip(AXES, error, sigma, strict=True))
    kept = f"; not determined: {', '.join(left)}" if left else ""
    return Figure(name, float(np.abs(error[3:]).max()), "deg", BORESIGHT_DEG, f"the bar; mm, deg: {each}{kept}")


def _table(name: str, errors: np.ndarray, sigmas: np.ndarray) -> Iterator[Figure]:
    normed = errors / sigmas
    for axis, label in enumerate(AXES):
        unit, bar = ("mm", LEVER_MM) if axis < 3 else ("deg", BORESIGHT_DEG)
        rms, worst = float(np.sqrt(np.mean(errors[:, axis] ** 2))), float(np.abs(errors[:, axis]).max())
        normal, stated = float(np.sqrt(np.mean(normed[:, axis] ** 2))), float(np.sqrt(np.mean(sigmas[:, axis] ** 2)))
        within = int(np.sum(np.abs(errors[:, axis]) <= bar))
        against = (
            f"the bar; worst {worst:.4g}, within {within} of {len(errors)}, "
            f"normalised RMS {normal:.2f}, stated σ {stated:.4g}"
        )
        yield Figure(f"{name}: {label}", rms, unit, bar, against)


def overlap_mm(yard: Yard, found: Calibration) -> float:
    """Difference of the heads beyond noise where both see a place, root mean square over the drives."""
    estimate = Estimate(found.mountings, {}, {}, found.corrections)
    level = level_from_world(yard.readings)
    at = [placed(one, estimate, yard.pieces, yard.traverses, level) for one in yard.readings]
    by_drive: dict[str, list] = {}
    for one in at:
        by_drive.setdefault(one.readings.drive, []).append(one)
    return 1e3 * float(np.sqrt(np.mean([_beyond_noise_m2(a, b) for a, b in by_drive.values()])))


def _beyond_noise_m2(first: LevelPoints, second: LevelPoints) -> float:
    """Mean squared difference (m²) of two heads in cells that both see, less the scatter of the readings within them.

    Cells across an edge have no one height and are left out: those whose readings scatter far more than usual.
    """
    near, other = (cell_heights(one.place_m, _CELL_M, _LEAST_READINGS) for one in (first, second))
    _, a, b = np.intersect1d(near.key, other.key, assume_unique=True, return_indices=True)
    noise = near.variance_m2[a] + other.variance_m2[b]
    even = noise <= _EVEN * np.median(noise)
    away = (near.height_m[a] - other.height_m[b])[even]
    return max(float(np.mean(away**2)) - float(noise[even].mean()), 0.0)
