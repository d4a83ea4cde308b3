"""From raw profiles to the coarse model: segmentation, placing on the map, splines and median, regions of interest.

A kilometre of street with kerbs, pavements, a parked car and potholes, cast here in closed form: once as a SICK LMS 200
sees it (75 scans a second of 361 readings at 50 km/h), once as a triangulation head does (2,000 readings of 2.04 m, a
profile each 20 mm at 50 km/h, and at the pair's own 28,000 profiles a second). Seconds are those of the thread's own
processor time, the best of several runs; the real-time factor is driving time over that.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from benchmarks.timing import Figure
from roadscan.core.rig import ScanGeometry
from roadscan.core.settings.segmentation import SegmentationConfig
from roadscan.georeference.road_profiles import segmented
from roadscan.surface.regions import CoarseSettings, RegionSettings, Stretch, coarse_model, find_regions

LENGTH_M, SPEED_M_PER_S = 1000.0, 50.0 / 3.6
PIECE_M = 100.0
"""Road in memory at a time."""
SICK = ScanGeometry(kind="polar", readings=361, first=np.pi / 2, step=-np.radians(0.5), range_step_m=0.001)
HEAD = ScanGeometry(
    kind="cartesian", readings=2000, first=-1.02, step=2.04 / 1999, range_offset_m=0.8, range_step_m=5e-5
)
FULL_RATE_PER_S = 28_000.0

Float64 = npt.NDArray[np.float64]
T = TypeVar("T")


def figures(folder: Path) -> Iterator[Figure]:
    """Real-time factors and costs of a SICK, and of a triangulation head."""
    sick = _Course.drive(SICK, SPEED_M_PER_S / 75.0, 0.006, 2.2)
    yield from _measured("SICK", sick, SPEED_M_PER_S / 75.0)
    head = _Course.drive(HEAD, 0.02, 0.0003, 2.0)
    rate = yield from _measured("head, a profile each 20 mm", head, 0.02)
    yield Figure("head at its full 28,000 profiles/s: real-time factor", rate / FULL_RATE_PER_S, "")


def _measured(name: str, course: _Course, step_m: float) -> Generator[Figure, None, float]:
    """Seconds a kilometre of each step, and the factor of all; returns profiles a second."""
    settings = CoarseSettings()
    classes, first = _best(lambda: segmented(course.ranges, course.geometry, SegmentationConfig()))
    stretch, second = _best(lambda: course.stretch(classes))
    model, third = _best(lambda: coarse_model(stretch, settings))
    found, fourth = _best(lambda: find_regions(model, RegionSettings()))
    per_km = LENGTH_M / PIECE_M
    steps = {
        "segmentation": first, "profiles as lines on the map": second, "splines and median": third,
        "regions of interest": fourth,
    }  # fmt: skip
    for what, seconds in steps.items():
        yield Figure(f"{name}: {what}, a km", seconds * per_km, "s")
    coarse = first + second + third
    drive_s = len(course.ranges) * step_m / SPEED_M_PER_S
    yield Figure(f"{name}: road readings kept", 100.0 * float((classes == 0)[course.is_road].mean()), "%", 99.0, "bar")
    others = ~course.is_road & (course.ranges > 0)
    yield Figure(f"{name}: others rejected", 100.0 * float((classes != 0)[others].mean()), "%", 97.0, "bar")
    yield Figure(f"{name}: regions found of {course.potholes} potholes", len(found), "")
    yield Figure(f"{name}: coarse model, real-time factor", drive_s / coarse, "", 100.0, "bar for the SICK")
    yield Figure(f"{name}: with regions, real-time factor", drive_s / sum(steps.values()), "")
    return len(course.ranges) / coarse


def _best(function: Callable[[], T], runs: int = 5) -> tuple[T, float]:
    """Result of a function, and its least processor time (s) after a run that is not counted."""
    result, least = function(), np.inf
    for _ in range(runs):
        started = time.thread_time()
        result = function()
        least = min(least, time.thread_time() - started)
    return result, least


@dataclass(frozen=True)
class _Course:
    """Profiles of 100 m of street, and where their readings lie."""

    geometry: ScanGeometry
    ranges: npt.NDArray[np.uint16]
    is_road: npt.NDArray[np.bool_]
    along_m: Float64
    potholes: int

    @classmethod
    def drive(cls, geometry: ScanGeometry, step_m: float, noise_m: float, above_m: float) -> _Course:
        """Cast the street: a carriageway from −4.6 to 2.4 m, kerbs of 12 cm, a car each 15 m, potholes each 20 m."""
        draw = np.random.default_rng(5)
        along = np.arange(0.0, PIECE_M, step_m)
        origins, directions = geometry.rays()
        y0, dy, dz = origins[:, 1], directions[:, 1], directions[:, 2]
        down = np.maximum(dz, 1e-9)
        aside = 0.15 * np.sin(along[:, None] / 9.0)
        right = 2.4 if geometry is SICK else 0.7
        flat = above_m / down
        y = y0 + flat * dy + aside
        for _ in range(4):  # the crossfall
            flat = (above_m + 0.025 * np.abs(y + 1.1)) / down
            y = y0 + flat * dy + aside
        curb = np.where(y > right, np.maximum(right - y0 - aside, 0.0) / np.maximum(dy, 1e-9), np.inf)
        curb = np.where(y < -4.6, np.maximum(4.6 + y0 + aside, 0.0) / np.maximum(-dy, 1e-9), curb)
        top = flat - 0.12 / down
        beside = (y > right) | (y < -4.6)
        range_m = np.where(beside, np.maximum(top, np.minimum(curb, flat)), flat)
        x = along[:, None]
        hole = np.hypot(np.mod(x, 20.0) - 10.0, y - 0.3)
        range_m += np.where(beside, 0.0, 0.05 * np.clip(1.0 - (hole / 0.3) ** 4, 0.0, None) ** 2 / down)
        car = np.where(dy < 0.0, (-3.0 - y0 - aside) / np.minimum(dy, -1e-9), np.inf)
        hit = (np.mod(x, 15.0) < 4.5) & (car < range_m) & (above_m - car * dz < 1.4)
        range_m = np.where(hit, car, range_m)
        range_m += draw.normal(0.0, noise_m, range_m.shape)
        value = np.round((range_m - geometry.range_offset_m) / geometry.range_step_m)
        limit = 30_000 if geometry is SICK else 65_535
        seen = (value > 0) & (value < limit) & (draw.random(value.shape) > 0.002)
        raw = np.where(seen, value, 0).astype(np.uint16)
        return cls(geometry, raw, ~beside & ~hit & (raw > 0), along, int(PIECE_M / 20.0))

    def stretch(self, classes: npt.NDArray[np.uint8]) -> Stretch:
        """Readings on the map, for a drive to the north-east."""
        origins, directions = self.geometry.rays()
        range_m = self.geometry.range_offset_m + self.geometry.range_step_m * self.ranges
        across = origins[:, 1] + range_m * directions[:, 1]
        height = 100.0 - range_m * directions[:, 2]
        east, north = np.sin(0.7), np.cos(0.7)
        path = np.stack([self.along_m * east, self.along_m * north], axis=-1)
        return Stretch.of_points(path[:, :1] + across * north, path[:, 1:] - across * east, height, classes, path)
