"""Patches of the road as one traverse saw them near a place: cells along and across, and the pose that saw them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from roadscan.adjust.kernels.patch_cells import Cells, Frame, cell_numbers, fill_cells, local_axes
from roadscan.adjust.places import Place
from roadscan.compute.array_types import Float64, Int32, Int64, UInt16
from roadscan.core.errors import NavigationError

Shift: TypeAlias = tuple[float, float, float]
"""Shift of a whole traverse: north, east, down (m, local level)."""


@dataclass(frozen=True)
class PassReadings:
    """Readings of one traverse near a place, georeferenced with the recorded or the corrected poses."""

    run: int
    """Index of the run."""
    sensor: str
    easting_m: Float64
    """(n,) map."""
    northing_m: Float64
    height_m: Float64
    """(n,) NaN where the reading does not count."""
    intensity: UInt16
    """(n,)"""
    pose: Int32
    """(n,) row of each reading's pose."""
    epoch_gps_ns: Int64
    """(p,) epochs of the poses, ascending."""
    body_m: Float64
    """(p, 3) easting, northing and height of the body's origin."""
    level_from_body: Float64
    """(p, 3, 3) north, east, down from body axes."""
    convergence_rad: float = 0.0
    """Angle of grid north, clockwise from true north."""
    laser: npt.NDArray[np.uint8] | None = None
    """(n,) of the sparse returns of a lidar, of which planes are compared instead of cells; 0 where it is not known."""

    @property
    def returns(self) -> bool:
        """Returns whether they are those of a lidar."""
        return self.laser is not None

    def __post_init__(self) -> None:
        n, p = self.pose.size, self.epoch_gps_ns.size
        shapes = [a.shape for a in (self.easting_m, self.northing_m, self.height_m, self.intensity)]
        if shapes != [(n,)] * 4 or self.body_m.shape != (p, 3) or self.level_from_body.shape != (p, 3, 3):
            raise NavigationError(
                f"readings of '{self.sensor}': columns of shapes {shapes}, poses {self.body_m.shape} and "
                f"{self.level_from_body.shape}",
                expected=f"({n},), and ({p}, 3) and ({p}, 3, 3), one for each of its epochs",
            )

    def pose_at(self, epoch_gps_ns: int) -> int:
        """Returns the row of the pose nearest to an epoch."""
        after = int(np.searchsorted(self.epoch_gps_ns, epoch_gps_ns))
        if after in (0, self.epoch_gps_ns.size):
            return min(after, self.epoch_gps_ns.size - 1)
        before, behind = self.epoch_gps_ns[after - 1], self.epoch_gps_ns[after]
        return after if behind - epoch_gps_ns < epoch_gps_ns - before else after - 1

    def arm_body_m(self, point_m: Float64, pose: Int64) -> Float64:
        """Vectors (k, 3) from the body's origin to points (k, 3; easting, northing, height), axes of bodies (k,)."""
        away = level_from_map(point_m - self.body_m[pose], self.convergence_rad)
        return np.asarray(np.einsum("nji,nj->ni", self.level_from_body[pose], away))


def shifted(readings: PassReadings, shift_level_m: Float64) -> PassReadings:
    """Returns the readings of a traverse and its poses, shifted together (3,; north, east, down)."""
    if not np.any(shift_level_m):
        return readings
    away = map_from_level(np.asarray(shift_level_m, np.float64)[None], readings.convergence_rad)[0]
    return replace(
        readings, easting_m=readings.easting_m + away[0], northing_m=readings.northing_m + away[1],
        height_m=readings.height_m + away[2], body_m=readings.body_m + away,
    )  # fmt: skip


def level_from_map(vector_m: Float64, convergence_rad: float) -> Float64:
    """Returns vectors (n, 3) of the map (easting, northing, height) as north, east, down of the local level."""
    e, n, h = np.asarray(vector_m).T
    c, s = math.cos(convergence_rad), math.sin(convergence_rad)
    return np.stack([c * n - s * e, s * n + c * e, -h], axis=-1)


def map_from_level(vector_m: Float64, convergence_rad: float) -> Float64:
    """Returns vectors (n, 3) of the local level (north, east, down) as easting, northing, height of the map."""
    n, e, d = np.asarray(vector_m).T
    c, s = math.cos(convergence_rad), math.sin(convergence_rad)
    return np.stack([c * e - s * n, c * n + s * e, -d], axis=-1)


@dataclass(frozen=True)
class Inside:
    """The readings of a traverse that lie inside a patch."""

    along_m: Float64
    """(n,) from the middle of the patch."""
    across_m: Float64
    """(n,) to the right."""
    height_m: Float64
    intensity: UInt16
    pose: Int32
    number: Int32
    """(n,) cell, row · edge + column."""


@dataclass(frozen=True)
class Patch:
    """A square of road, centred at a place, as cells (along, across); the axis across is positive to the right."""

    place: Place
    readings: PassReadings
    inside: Inside
    cell_m: float
    height_m: Float64
    """(k, k); NaN where there are too few readings."""
    sigma_m: Float64
    """(k, k) 1 σ of the height from the spread of the cell's readings, noise and texture alike."""
    used: Int32
    """(k, k) number of readings in the height."""
    intensity: Float64
    """(k, k) mean."""
    pose: int
    """Row of the pose in the middle of the readings."""

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """Returns a mask (k, k) of the cells with a height."""
        return np.isfinite(self.height_m)

    @property
    def epoch_gps_ns(self) -> int:
        """Returns the epoch of the pose in the middle of the readings."""
        return int(self.readings.epoch_gps_ns[self.pose])

    @cached_property
    def middle_m(self) -> Float64:
        """Returns coordinates (k,) of the middles of rows along, and of columns across."""
        edge = len(self.height_m)
        return np.asarray((np.arange(edge) + 0.5 - 0.5 * edge) * self.cell_m)


def patch_of(place: Place, readings: PassReadings, cell_m: float, least_readings: int) -> Patch | None:
    """Returns the cells of a traverse at a place; None where it saw nothing of it.

    cell_m : edge of a cell. least_readings : a cell with fewer has no height.
    """
    edge = max(round(2.0 * place.radius_m / cell_m), 4)
    count = np.zeros(edge * edge, np.int64)
    inside = _inside(place, readings, cell_m, edge, count)
    if inside.pose.size == 0:
        return None
    cells = Cells._make(np.empty(edge * edge, t) for t in (np.float64, np.float64, np.int32, np.float64))
    fill_cells(inside.number, inside.height_m, inside.intensity, count, least_readings, cells)
    usual = np.nanmedian(cells.spread_m) if np.isfinite(cells.spread_m).any() else math.nan
    # Quartiles of a handful of readings are unreliable.
    spread = np.sqrt((cells.spread_m**2 + usual**2) / 2.0)
    sigma = np.where(np.isfinite(spread), spread, usual) / np.sqrt(np.maximum(cells.used, 1))
    shape = (edge, edge)
    return Patch(
        place, readings, inside, cell_m, cells.height_m.reshape(shape), sigma.reshape(shape), cells.used.reshape(shape),
        cells.intensity.reshape(shape), int(np.median(inside.pose)),
    )  # fmt: skip


def _inside(place: Place, readings: PassReadings, cell_m: float, edge: int, count: Int64) -> Inside:
    """Returns the readings inside the cells of a place, and counts them into `count`."""
    along, across = np.empty(readings.pose.size), np.empty(readings.pose.size)
    local_axes(readings.easting_m, readings.northing_m, frame_of(place), along, across)
    number = np.empty(along.size, np.int32)
    cell_numbers(along, across, 0.5 * edge * cell_m, cell_m, edge, number, count)
    which = np.flatnonzero(number >= 0)
    return Inside(
        along[which], across[which], readings.height_m[which], readings.intensity[which], readings.pose[which],
        number[which],
    )  # fmt: skip


def frame_of(place: Place) -> Frame:
    """Returns the axes of a place, as kernels take them."""
    return Frame(place.easting_m, place.northing_m, math.sin(place.heading_rad), math.cos(place.heading_rad))


def map_from_axes(place: Place, along_m: Float64, across_m: Float64, height_m: Float64) -> Float64:
    """Returns points (n, 3) of the map from coordinates (n,) along and across a place, and heights."""
    sine, cosine = math.sin(place.heading_rad), math.cos(place.heading_rad)
    easting = place.easting_m + along_m * sine + across_m * cosine
    northing = place.northing_m + along_m * cosine - across_m * sine
    return np.stack([easting, northing, height_m], axis=-1)
