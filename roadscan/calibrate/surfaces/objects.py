"""Ties to a calibration object of known shape: steps that the vehicle straddles, seen by two heads or more.

Each step's top is a plane at a known height above the ground the object stands on. Readings that fall on a top, well
away from its edges, are tied to its height in the object's axes; the object's pose is estimated with the
mountings. Two heads that both reproduce the object agree with one another. Edges are not used: between two profiles
nothing says where one lies.

Ties between two heads that see the same strip in one drive, and the agreement of their heights.

The strip where the profiles of two heads overlap is narrow, and both see it with one trajectory: any difference there
comes from their mountings alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import scipy

from roadscan.calibrate.evidence import Known, Seen, Ties, Traverse
from roadscan.calibrate.surfaces.planes import LevelPoints, Pieces, Readings, level_from_world, placed
from roadscan.calibrate.unknowns import Estimate, ObjectPose
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import scatter_about
from roadscan.core.errors import NavigationError

Steps = Sequence[tuple[float, float, float]]

KIND: Final = "object"
EDGE_MARGINS_M: Final = (0.08, 0.05, 0.03)
"""Readings nearer to an edge are not used: the first limit at first, the later ones as the mountings improve."""

_CELL_M: Final = 0.02  # Edge of a cell whose readings are averaged.
_LEAST: Final = 4  # Least number of readings of a cell, and of cells that two heads have in common.
_NOISE_M: Final = 2e-5  # Least σ of a reading's height that is assumed.
_SEARCH_M: Final = 0.3  # The object is searched for within this distance of its stated place.
_TRUNCATED_M: Final = 0.008  # Height residuals count up to this in the search.
_MOST: Final = 40_000  # Approximate number of readings in the search.
_SURROUNDING_M: Final = 0.8  # Width of the ground around the object that is used.
_GATE_M: Final = 0.02  # Readings farther than this from the median offset are not of the top.


def heights_of(steps: Steps, x_m: Float64, y_m: Float64) -> tuple[Float64, Float64]:
    """Object's height (n,) at positions in its axes, 0 beside it, and the distance (n,) to the nearest edge (m).

    steps : length (x), width (y) and height above the ground of each step, all about the same middle.
    """
    height, margin = np.zeros(x_m.shape), np.full(x_m.shape, np.inf)
    for length, width, top in sorted(steps, key=lambda step: step[2]):
        # Distance from the rectangle's outline, inside and outside.
        dx, dy = np.abs(x_m) - length / 2, np.abs(y_m) - width / 2
        inside = (dx < 0) & (dy < 0)
        outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0))
        margin = np.minimum(margin, np.where(inside, np.minimum(-dx, -dy), outside))
        height[inside] = top
    return height, margin


def find_object(readings: Sequence[Readings], estimate: Estimate, steps: Steps, about: ObjectPose) -> ObjectPose:
    """Find the position and heading of an object near a stated place that fit the heights best.

    Raises
    ------
    NavigationError
        where hardly any reading falls on it.
    """
    level = level_from_world(readings)
    pieces, nothing = Pieces.of_seconds(1.0), dict[int, Traverse]()
    size = max(max(length, width) for length, width, _ in steps) / 2 + _SURROUNDING_M
    places, heights = [], []
    for one in readings:
        there = placed(one, estimate, pieces, nothing, level).place_m - level @ about.position_world_m
        there = there[np.hypot(there[:, 0], there[:, 1]) < size + _SEARCH_M]
        heights.append(there[np.hypot(there[:, 0], there[:, 1]) > size - _SURROUNDING_M / 2, 2])
        places.append(_above_ground(there, size - _SURROUNDING_M / 2))
    cloud = np.concatenate(places)
    if len(cloud) < 200:
        raise NavigationError(
            f"{len(cloud)} readings lie about the calibration object",
            expected="drives over it",
            change="check easting_m, northing_m and the runs of this evidence",
        )
    cloud = cloud[:: max(1, len(cloud) // _MOST)]
    ahead = level @ about.world_from_object[:, 0]
    heading = float(np.arctan2(ahead[1], ahead[0]))

    def misfit(pose: Float64) -> float:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        x, y = cloud[:, 0] - pose[0], cloud[:, 1] - pose[1]
        height, _ = heights_of(steps, c * x + s * y, c * y - s * x)
        above = cloud[:, 2] - height
        above = above - np.median(above)
        return float(np.minimum(above**2, _TRUNCATED_M**2).mean())

    grid = np.arange(-_SEARCH_M, _SEARCH_M + 0.01, 0.05)
    turns = heading + np.radians([-8.0, -4.0, 0.0, 4.0, 8.0])
    starts = [np.array([x, y, turn]) for turn in turns for x in grid for y in grid]
    best = min(starts, key=misfit)
    found = scipy.optimize.minimize(
        misfit, best, method="Nelder-Mead", options={"initial_simplex": _simplex(best), "xatol": 1e-4}
    )
    x, y, turn = found.x
    c, s = np.cos(turn), np.sin(turn)
    ground = float(np.median(np.concatenate(heights)))
    level_from_object = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    position = about.position_world_m + level.T @ np.array([x, y, ground])
    return ObjectPose(position, level.T @ level_from_object, about.sigma_m, about.sigma_rad)


def _above_ground(place_m: Float64, radius_m: float) -> Float64:
    """Return places (n, 3) with heights above the plane of the ground farther than a radius from the middle.

    A head that is not yet calibrated sees the ground tilted and too high or low; so seen, the object stands on it.
    """
    ground = np.hypot(place_m[:, 0], place_m[:, 1]) > radius_m
    if ground.sum() < 50:
        return place_m[:0]
    design = np.column_stack([np.ones(len(place_m)), place_m[:, :2]])
    plane, *_ = np.linalg.lstsq(design[ground], place_m[ground, 2], rcond=None)
    return np.column_stack([place_m[:, :2], place_m[:, 2] - design @ plane])


def _simplex(best: Float64) -> Float64:
    steps = np.diag([0.03, 0.03, 0.05])
    return np.vstack([best, best + steps])


@dataclass
class ObjectTies:
    """Finds the ties of an estimate; the estimator takes it as its evidence.

    Parameters
    ----------
    readings : of all sensors and drives over the object.
    name : of the object among those of the estimate.
    steps : its shape, see :func:`heights_of`.
    sigma_m : 1 σ of its surface.
    """

    readings: Sequence[Readings]
    pieces: Pieces
    traverses: Mapping[int, Traverse]
    name: str
    steps: Steps
    sigma_m: float
    _calls: int = field(default=0, repr=False)

    def __call__(self, estimate: Estimate) -> list[Ties]:
        """Ties with the places of this estimate; readings nearer to the edges count later."""
        margin = EDGE_MARGINS_M[min(self._calls, len(EDGE_MARGINS_M) - 1)]
        self._calls += 1
        level = level_from_world(self.readings)
        found: dict[str, list[tuple[Seen, Float64, Float64]]] = {}
        for one in self.readings:
            at = placed(one, estimate, self.pieces, self.traverses, level)
            tied = self._of(at, estimate.objects[self.name], level, margin)
            if tied is not None:
                found.setdefault(one.sensor, []).append(tied)
        return [_joined(parts, self.name) for parts in found.values()]

    def _of(
        self, at: LevelPoints, pose: ObjectPose, level: Float64, margin_m: float
    ) -> tuple[Seen, Float64, Float64] | None:
        """Return means of the readings of one sensor and drive in small cells on the tops, and their σ."""
        world = at.place_m @ level - pose.position_world_m
        local = world @ pose.world_from_object
        height, away = heights_of(self.steps, local[:, 0], local[:, 1])
        # Only tops that rise clearly above the ground's unevenness are recognised.
        on_top = np.flatnonzero((height > 0.0) & (away > margin_m))
        off = local[on_top, 2] - height[on_top]
        # The error of one head in one drive is the same everywhere, but for its tilt.
        on_top = on_top[np.abs(off - np.median(off)) < _GATE_M] if on_top.size else on_top
        if on_top.size < _LEAST:
            return None
        cell = np.floor(local[on_top, :2] / _CELL_M).astype(np.int64)
        _, number, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        number = number.ravel()
        mean = np.stack([np.bincount(number, at.place_m[on_top, a]) / count for a in range(3)], axis=-1)
        off = local[on_top, 2] - height[on_top]
        middle = np.bincount(number, off) / count
        variance = np.bincount(number, (off - middle[number]) ** 2) / np.maximum(count - 1, 1)
        first = np.full(count.size, -1, dtype=np.int64)
        first[number[::-1]] = on_top[::-1]
        kept = count >= _LEAST
        if not kept.any():
            return None
        usual = max(float(np.median(variance[kept])), _NOISE_M**2)
        rows = first[kept]
        # The error of a top is common to all readings on it, so it does not average out.
        _, top, sharing = np.unique(height[rows], return_inverse=True, return_counts=True)
        sigma = np.sqrt(usual / count[kept] + self.sigma_m**2 * sharing[top.ravel()])
        target = (mean[kept] @ level - pose.position_world_m) @ pose.world_from_object
        target[:, 2] = height[rows]
        seen = at.seen(mean[kept], at.readings.pose[rows].astype(np.int64))
        return seen, target, sigma


def _joined(parts: Sequence[tuple[Seen, Float64, Float64]], name: str) -> Ties:
    seen = [p for p, _, _ in parts]
    sigma = np.concatenate([s for _, _, s in parts])
    weight = np.zeros((sigma.size, 1, 3))
    weight[:, 0, 2] = 1.0 / sigma
    return Ties(
        KIND,
        Seen(
            seen[0].sensor,
            np.concatenate([p.point_sensor_m for p in seen]),
            np.concatenate([p.position_world_m for p in seen]),
            np.concatenate([p.world_from_body for p in seen]),
            np.concatenate([p.traverse for p in seen]),
        ),
        Known(np.concatenate([t for _, t, _ in parts]), name),
        weight,
    )


_COMPARED_CELL_M: Final = 0.01  # Edge of a cell in which heights are compared.
_EVEN: Final = 4.0
"""Cells with a variance above this multiple of the usual one lie on an edge."""
_FLOOR_M: Final = 2e-5  # Added to the limit for outlying differences: rounding.
_COMMON_M: Final = 1e-4
"""1 σ of an error that the whole strip of a drive shares (m)."""
_OUTLYING: Final = 4.0  # A difference farther from the median than this many σ is left out.


@dataclass(frozen=True)
class CellHeights:
    """Mean heights of the cells of a level frame that hold enough readings."""

    key: Int64
    height_m: Float64
    variance_m2: Float64
    """Of the mean."""
    middle_m: Float64
    """(m, 2) mean x and y of the cell's readings."""
    reading: Int64
    """(m,) index of one of them."""


def cell_heights(place_m: Float64, cell_m: float, least: int) -> CellHeights:
    """Returns the cells with at least so many of the places (n, 3; m, level frame)."""
    whole = np.floor(place_m[:, :2] / cell_m).astype(np.int64)
    key, inverse = np.unique((whole[:, 0] << 32) + whole[:, 1], return_inverse=True)
    count = np.bincount(inverse)
    # Relative to the mean height, since squares of heights above sea level would lose all digits.
    height = place_m[:, 2] - place_m[:, 2].mean()
    mean = np.bincount(inverse, height) / count
    square = np.bincount(inverse, (height - mean[inverse]) ** 2)
    enough = count >= least
    variance = square[enough] / (count[enough] - 1) / count[enough]
    origin = place_m[0, :2] if len(place_m) else np.zeros(2)
    middle = np.stack([np.bincount(inverse, place_m[:, k] - origin[k]) / count for k in (0, 1)], axis=-1) + origin
    reading = np.zeros(key.size, dtype=np.int64)
    reading[inverse] = np.arange(inverse.size)
    return CellHeights(key[enough], mean[enough] + place_m[:, 2].mean(), variance, middle[enough], reading[enough])


@dataclass
class HeadTies:
    """Finds ties between heads in the strip that both see; the estimator takes it as its evidence.

    Parameters
    ----------
    readings : of all heads and drives. pieces : how drives are cut.
    traverses : the pieces' errors of poses, as the estimator has them.
    """

    readings: Sequence[Readings]
    pieces: Pieces
    traverses: Mapping[int, Traverse]

    def __call__(self, estimate: Estimate) -> list[Ties]:
        """Ties of heights, one a cell that both heads of a drive see; none where their profiles do not overlap."""
        level = level_from_world(self.readings)
        drives: dict[str, list[LevelPoints]] = {}
        for one in self.readings:
            at = placed(one, estimate, self.pieces, self.traverses, level)
            drives.setdefault(one.drive, []).append(at)
        pairs = [pair for heads in drives.values() for pair in itertools.combinations(heads, 2)]
        return [ties for first, second in pairs if (ties := _strip(first, second, level)) is not None]


def _strip(first: LevelPoints, second: LevelPoints, level_from_world: Float64) -> Ties | None:
    """Return the ties of two heads in one drive."""
    if first.readings.sensor == second.readings.sensor:
        return None
    own, other = (cell_heights(one.place_m, _COMPARED_CELL_M, _LEAST) for one in (first, second))
    _, a, b = np.intersect1d(own.key, other.key, assume_unique=True, return_indices=True)
    if a.size < _LEAST:
        return None
    variance = own.variance_m2[a] + other.variance_m2[b]
    away = own.height_m[a] - other.height_m[b]
    spread = scatter_about(away, float(np.median(away)))
    kept = (variance <= _EVEN * np.median(variance)) & (np.abs(away - np.median(away)) <= _OUTLYING * spread + _FLOOR_M)
    if kept.sum() < _LEAST:
        return None
    a, b, variance = a[kept], b[kept], variance[kept]
    # An error that all cells share does not average out.
    sigma = np.sqrt(variance + _COMMON_M**2 * variance.size)
    weight = level_from_world[None, 2:3, :] / sigma[:, None, None]
    return Ties("overlap, heads", _seen(first, own, a), _seen(second, other, b), weight)


def _seen(one: LevelPoints, cells: CellHeights, which: Int64) -> Seen:
    """Return mean places of cells as the head would have seen them from the pose of one of their readings."""
    place = np.concatenate([cells.middle_m[which], cells.height_m[which, None]], axis=1)
    return one.seen(place, one.readings.pose[cells.reading[which]].astype(np.int64))
