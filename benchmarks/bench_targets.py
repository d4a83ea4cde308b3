"""Control targets in intensities: how many of 500 are found, new and worn, how well, and what else passes for one.

Targets of 0.30 m with a black centre of 0.06 m on the simulator's road, readings each 5 × 10 mm from any direction
with noise of 4 digital numbers, stated places with σ 50 mm. Worn paint has half the contrast and lacks 30 % in
patches of some centimetres. "Other things" are places of a road with stains, tyre marks, lane markings, discs of
other sizes, seals of cracks, stop bars and crossings. Chequered targets are those of
:mod:`benchmarks.painted_targets`, drawn by OpenCV.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.painted_targets import (
    NEW,
    READING,
    TARGET,
    WORN,
    Reading,
    Sample,
    SimulatedRoad,
    Wear,
    furnished_road,
    other_places,
    painted_sample,
)
from benchmarks.timing import Figure
from roadscan.adjust.settings import TargetSettings
from roadscan.adjust.targets.find import find_target
from roadscan.adjust.targets.shapes import Chequered, Shape, TargetFind

Float64 = npt.NDArray[np.float64]

TARGETS, PAINTED, EMPTY = 500, 30, 300
"""Targets of the simulator, of each painted kind, and places without one."""
PLACE_BAR_MM = 1.5
SETTINGS = TargetSettings()


@dataclass(frozen=True)
class Outcome:
    """What was found of some targets."""

    found: int
    wrong: int
    """Found elsewhere: farther than 50 mm from the truth."""
    errors_mm: Float64
    """(found,) distance from the truth."""
    squared: Float64
    """(found,) normalised squared error of the place, 2 expected."""
    height_squared: Float64
    """(found,) the same of the height, 1 expected."""
    milliseconds: float
    """Median of the processor's time for one."""

    @classmethod
    def of(cls, make: Callable[[np.random.Generator], Sample], count: int) -> Outcome:
        """Search for the targets of seeds 0, 1, …"""
        finds, times = [], []
        for seed in range(count):
            sample = make(np.random.default_rng(seed))
            started = time.thread_time()
            found = find_target(sample.readings, sample.expected, SETTINGS)
            times.append(time.thread_time() - started)
            if found.found:
                finds.append(_errors(found, sample))
        errors, squared, heights = np.array(finds).reshape(-1, 3).T
        wrong = int((errors > 50.0).sum())
        return cls(len(finds) - wrong, wrong, errors, squared, heights, float(np.median(times)) * 1e3)


def _errors(found: TargetFind, sample: Sample) -> tuple[float, float, float]:
    off = np.array([found.easting_m, found.northing_m]) - sample.true_m[:2]
    squared = float(off @ np.linalg.solve(found.covariance_m2, off))
    return float(np.hypot(*off)) * 1e3, squared, ((found.height_m - sample.true_m[2]) / found.sigma_height_m) ** 2


def figures(folder: Path) -> Iterator[Figure]:
    """Targets found, errors, and false ones."""
    road = SimulatedRoad.of()
    yield from _of("new paint", road.sample, TARGETS, 500)
    yield from _of("worn paint", lambda rng: road.sample(rng, READING, WORN), TARGETS, 490)
    yield from _false()
    blurred = Reading(footprint_m=0.004)
    kinds: list[tuple[str, Callable[[np.random.Generator], Sample]]] = []
    for name, wear in (("new", NEW), ("worn", WORN)):
        kinds.append((f"spot of σ 4 mm, {name}", _painted(TARGET, blurred, wear)))
        for quadrants, shape in ((4, Chequered(0.3, 4)), (2, Chequered(0.3, 2))):
            kinds += [(f"{quadrants} quadrants, {name}", _painted(shape, READING, wear))]
    for name, make in kinds:
        yield from _of(name, make, PAINTED, None)


def _painted(shape: Shape, reading: Reading, wear: Wear) -> Callable[[np.random.Generator], Sample]:
    return lambda rng: painted_sample(rng, shape, reading, wear)


def _of(name: str, make: Callable[[np.random.Generator], Sample], count: int, bar: int | None) -> Iterator[Figure]:
    outcome = Outcome.of(make, count)
    rms = float(np.sqrt(np.mean(outcome.errors_mm**2)))
    yield Figure(f"{name}: found of {count}", outcome.found, "", bar, "bar" if bar else "")
    yield Figure(f"{name}: found elsewhere", outcome.wrong, "", 0, "bar")
    yield Figure(f"{name}: RMS distance from the truth", rms, "mm", PLACE_BAR_MM, "bar")
    beyond = int((outcome.errors_mm > PLACE_BAR_MM).sum())
    yield Figure(f"{name}: farther than {PLACE_BAR_MM:g} mm from the truth", beyond, "", 0, "bar")
    yield Figure(f"{name}: largest distance from the truth", float(outcome.errors_mm.max()), "mm")
    yield Figure(f"{name}: normalised squared error of the place", float(outcome.squared.mean()) / 2, "", 1.0, "honest")
    yield Figure(f"{name}: of the height", float(outcome.height_squared.mean()), "", 1.0, "honest")
    yield Figure(f"{name}: time for one, median", outcome.milliseconds, "ms", 50.0, "bar")


def _false() -> Iterator[Figure]:
    """Places without a target that pass for one."""
    road = furnished_road()
    passed: list[str] = []
    for seed in range(EMPTY):
        rng = np.random.default_rng(seed)
        what, station, offset = other_places()[seed % len(other_places())]
        sample = road.empty(rng, station_m=station + rng.normal(0.0, 0.15), offset_m=offset + rng.normal(0.0, 0.15))
        if find_target(sample.readings, sample.expected, SETTINGS).status != "missed":
            passed.append(what)
    name = ", ".join(sorted(set(passed)))
    yield Figure(f"other things: taken for a target, of {EMPTY} {name}".strip(), len(passed), "", 0, "bar")
