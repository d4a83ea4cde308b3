"""Charts approximate the map projection near the vehicle, and give kernels what georeferences a sensor's readings.

PROJ places a million points a second; a chart places a hundred times as many. World space is cut into
boxes of 200 m; about the centre of each box the map coordinates are expanded to second order from 19
positions projected by PROJ. Within 300 m of a centre the expansion departs from PROJ by less than
2 µm (third order: d³/R² with the Earth's radius R); tests hold it to that.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, MapFrame
from roadscan.core.errors import NavigationError
from roadscan.core.grid import QUANTA_PER_M
from roadscan.core.rig import Mounting, ScanGeometry
from roadscan.georeference.kernels import readings
from roadscan.georeference.kernels.flat_profiles import FlatProfiles
from roadscan.georeference.kernels.readings import Georeference, Limits
from roadscan.poses.trajectory import Trajectory

BOX_M = 200.0  # Edge of a box: within 300 m of its centre an expansion errs by less than 2 µm.
STEP_M = 100.0
"""Step of the finite differences; truncation is far below the 1 nm of PROJ."""

_MOST_BOXES = 1 << 27
"""Most boxes of the table (0.5 GB): the box of a drive over 100 km across all axes."""
_FOLDED = (127, 251, 509)
"""Edges (boxes) of smaller tables, which are tried where poses lie so far apart that no road joins them."""

_PAIRS = ((0, 1), (0, 2), (1, 2))  # Pairs of axes of the mixed second derivatives.


@dataclass(frozen=True)
class Charts:
    """Charts of the boxes that a trajectory passes, as arrays for the kernels."""

    lattice: Float64
    """(4,) box edge (m), and the indices of the first box along x, y, z."""
    table: npt.NDArray[np.int32]
    """(nx, ny, nz) chart of each box, its indices modulo the shape; −1 where none is needed."""
    centres: Float64
    """(c, 3) world, m."""
    coefficients: Float64
    """(c, 3, 10): easting, northing, height; 1, x, y, z, xx, xy, xz, yy, yz, zz."""


def charts_along(frame: MapFrame, world: str, positions_world_m: Float64) -> Charts:
    """Return charts for all boxes that contain a position (n, 3; world, m) of a trajectory, and for their neighbours.

    The neighbours serve poses between two knots that lie in a box which neither knot lies in.
    """
    if world == LOCAL_WORLD and frame.is_local:
        return _identity()
    boxes = np.floor(positions_world_m / BOX_M).astype(np.int64)
    enters = np.append(True, (np.diff(boxes, axis=0) != 0).any(axis=1))  # sorting all poses would dominate the time
    visited = np.unique(boxes[enters], axis=0)
    steps = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    unique = np.unique((visited[:, None, :] + steps).reshape(-1, 3), axis=0)
    first = unique.min(axis=0)
    table = _table(unique - first)
    made = [_chart(frame, world, (int(b[0]), int(b[1]), int(b[2]))) for b in unique]
    return Charts(
        lattice=np.array([BOX_M, *first], dtype=np.float64),
        table=table,
        centres=((unique + 0.5) * BOX_M).astype(np.float64),
        coefficients=np.stack(made),
    )


def _table(boxes: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
    """Return the (nx, ny, nz) table with the number of each box (b, 3) at its indices modulo the shape; −1 elsewhere.

    The shape is that of all boxes. Where poses step by hundreds of kilometres it is smaller, such that no two boxes
    share a place: positions between them are never looked up.
    """
    whole = (boxes.max(axis=0) + 1).tolist()
    shapes = [whole] if math.prod(whole) <= _MOST_BOXES else [[edge] * 3 for edge in _FOLDED]
    for shape in shapes:
        folded = boxes % shape
        if shape is whole or len(np.unique(folded, axis=0)) == len(boxes):
            table = np.full(shape, -1, dtype=np.int32)
            table[tuple(folded.T)] = np.arange(len(boxes))
            return table
    far_km = float(np.linalg.norm(boxes.max(axis=0) * BOX_M)) / 1000
    raise NavigationError(
        f"poses that are needed together lie {far_km:,.0f} km apart",
        expected="a drive: poses of some minutes lie near one another",
        change="`roadscan status` names the steps of the trajectory; take what is wrong out of its log",
    )


def _identity() -> Charts:
    coefficients = np.zeros((1, 3, 10))
    for a in range(3):
        coefficients[0, a, 1 + a] = 1.0
    half = 1e9
    return Charts(np.array([2 * half, -1.0, -1.0, -1.0]), np.zeros((2, 2, 2), np.int32), np.zeros((1, 3)), coefficients)


@functools.lru_cache(maxsize=20_000)
def _chart(frame: MapFrame, world: str, box: tuple[int, int, int]) -> Float64:
    """Return the (3, 10) second-order expansion of the map about the centre of a box, by central differences."""
    centre = (np.array(box) + 0.5) * BOX_M
    axes = np.eye(3) * STEP_M
    corners = [s * axes[a] + t * axes[b] for a, b in _PAIRS for s in (1, -1) for t in (1, -1)]
    offsets = np.concatenate([np.zeros((1, 3)), axes, -axes, np.array(corners)])
    value = frame.map_from_world(world, centre + offsets)
    out = np.empty((3, 10))
    out[:, 0] = value[0]
    for a in range(3):
        forward, back = value[1 + a], value[4 + a]
        out[:, 1 + a] = (forward - back) / (2 * STEP_M)
        out[:, (4, 7, 9)[a]] = (forward - 2 * value[0] + back) / (2 * STEP_M**2)
    for index, column in enumerate((5, 6, 8)):
        pp, pm, mp, mm = value[7 + 4 * index : 11 + 4 * index]
        out[:, column] = (pp - pm - mp + mm) / (4 * STEP_M**2)
    return out


def georeference_of(mounting: Mounting, trajectory: Trajectory, charts: Charts, limits: Limits) -> Georeference:
    """Return the structure that kernels take, from a mounting, a trajectory, charts and limits."""
    rotation, lever = mounting.arrays()
    lattice = tuple(charts.lattice.tolist())
    return Georeference(
        mounting=(*rotation.ravel().tolist(), *lever.tolist()),
        poses=trajectory.intervals,
        charts=readings.Charts(lattice, charts.table, charts.centres, charts.coefficients),
        limits=limits,
        quanta_per_m=float(QUANTA_PER_M),
    )


REACH_M: Final = 8.0
"""Farthest that a reading may lie from the middle of its profile. Over 8 m the map departs from a plane by
s²/2R = 5 µm (R the Earth's radius), and a 32-bit float resolves 0.6 µm."""

EVERY_RAW_RANGE: Final = (np.uint16(1), np.uint16(65_535))
"""Lowest and highest raw range of a return."""


@functools.lru_cache(maxsize=64)
def flat_profiles(geometry: ScanGeometry, range_min_m: float, range_max_m: float) -> FlatProfiles | None:
    """Flat profiles of a geometry between range limits; None where each reading has to be georeferenced singly."""
    if geometry.reading_period_ns > 0.0:
        return None
    low, high = geometry.raw_limits(range_min_m, range_max_m)
    origins, directions = geometry.rays()
    reach_m = [geometry.range_offset_m + geometry.range_step_m * raw for raw in (low, high)]
    ends = np.concatenate([(origins + far_m * directions)[:, 1:] for far_m in reach_m])
    middle = (ends.min(axis=0) + ends.max(axis=0)) / 2.0
    if np.hypot(*(ends - middle).T).max() > REACH_M:
        return None
    rays = np.stack([*(origins[:, 1:] - middle).T, *directions[:, 1:].T]).astype(np.float32)
    return FlatProfiles(
        rays=np.ascontiguousarray(rays),
        middle=(float(middle[0]), float(middle[1])),
        scale=(np.float32(geometry.range_offset_m), np.float32(geometry.range_step_m)),
        raw_limits=(np.uint16(low), np.uint16(high)),
    )
