"""Classes of stationary things beside and over the road: vegetation, buildings, wires, noise."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.cubes import EDGE_M, Cubes
from roadscan.assets.ground.grid import Grid, grid_over
from roadscan.assets.kernels import voxels
from roadscan.assets.kernels.standing_classes import ALONE, LEAFY, WALL, WIRE, standing_classes
from roadscan.assets.overheads import overhead_classes
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box
from roadscan.compute.array_types import Float32
from roadscan.compute.kernel_options import read_only
from roadscan.core.extras import cv2

Bools = npt.NDArray[np.bool_]

REACH_M: Final = 8.0
"""A roof of 6 m, with the cubes around that tell its scatter, lies within this (m)."""
_PLANAR, _UPRIGHT, _THICK = 0.4, 0.25, 0.4
"""A cube is part of an upright plane with at least this planarity, at most this upward part of its normal, and at most
this thickness (cubes)."""
_WALL_CUBES, _WALL_M, _WALL_LENGTH_M = 2, 1.5, 4.0
"""Least number of such cubes of a wall above one another, also half of all there, its least height and length (m)."""
_FOOT_M: Final = 1.8
"""A wall is seen below this height (m): a crown is not."""
_CUBES_UP: Final = 1 << 20
"""A level higher than any cube."""
_IN_LEAVES: Final = 0.6
"""Surfaces with more scattering around are no wall, even in front of one."""
_LEAFY: Final = 0.2
"""Mean scattering of the columns around from which things are vegetation."""
_MEDIUM_M, _HIGH_M = 0.5, 2.0
"""Heights from which vegetation is medium and high (m)."""
_ROOF_M, _ROOF_LENGTH_M = 2.5, 6.0
"""Least height and length of a roof (m)."""
_WIRE_LINEAR, _WIRE_LEVEL, _WIRE_M, _WIRE_LENGTH_M = 0.8, 0.4, 4.0, 3.0
"""Least linearity of a wire, greatest upward part of its direction, least height and length (m)."""
_NEAR_M: Final = 15.0
"""An isolated return is noise within this distance of the sensor (m)."""
_CODES: Final = (
    classes.UNCLASSIFIED, classes.LOW_VEGETATION, classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION,
    classes.BUILDING, classes.WIRE, classes.HIGH_NOISE,
)  # fmt: skip
_LOW_M: Final = 0.3
"""Returns up to this height (m) that do not lie on the ground are low vegetation, where the ground is rough."""


def surroundings(
    returns: Returns,
    above_m: Float32,
    found: npt.NDArray[np.uint8],
    cubes: Cubes,
    window: Box,
    drive_xyh_m: npt.NDArray[np.float64],
) -> npt.NDArray[np.uint8]:
    """Returns classes (n,): those of `found`, and in place of `UNCLASSIFIED` what stands there."""
    grid = grid_over(window, EDGE_M)
    features, bits = cubes.features, np.zeros(len(cubes.place), np.uint8)
    over = bits
    if bits.size:
        leafy, wire = leaves(cubes, grid), wires(cubes, grid)
        walls, roofs = walls_and_roofs(cubes, grid)
        over = overhead_classes(cubes, grid, leafy, wire | walls, drive_xyh_m)
        buildings = (walls | roofs) & (features[:, voxels.SCATTERING] <= _IN_LEAVES)
        bits |= LEAFY * leafy.view(np.uint8)
        bits |= WALL * buildings.view(np.uint8)
        bits |= WIRE * wire.view(np.uint8)
        bits |= ALONE * (features[:, voxels.NUMBER] <= 1).view(np.uint8)
    place = tuple(map(read_only, (returns.x_m, returns.y_m, returns.height_m)))
    sensor = tuple(map(read_only, (returns.sensor_x_m, returns.sensor_y_m, returns.sensor_height_m)))
    out = found.copy()
    standing_classes(above_m, cubes.number, bits, place, sensor, (_LOW_M, _MEDIUM_M, _HIGH_M, _NEAR_M), _CODES, out)
    if over.any():
        own = np.append(over, np.uint8(0))[cubes.number]
        rows = np.flatnonzero((own > 0) & (found == classes.UNCLASSIFIED))
        out[rows] = own[rows]
    return out


def leaves(cubes: Cubes, grid: Grid) -> Bools:
    """Returns a mask (cubes,) of those in columns that scatter in all directions, with those around."""
    row, column = cubes.place[:, 0], cubes.place[:, 1]
    number, scattering = np.zeros(grid.shape), np.zeros(grid.shape)
    np.add.at(number, (row, column), 1.0)
    np.add.at(scattering, (row, column), cubes.features[:, voxels.SCATTERING].astype(np.float64))
    sums = [
        cv2.boxFilter(a, cv2.CV_64F, (3, 3), None, (-1, -1), False, cv2.BORDER_CONSTANT) for a in (number, scattering)
    ]
    return np.asarray((sums[1] >= _LEAFY * sums[0])[row, column])


def walls_and_roofs(cubes: Cubes, grid: Grid) -> tuple[Bools, Bools]:
    """Returns masks (cubes,) of walls, the large upright planes, and of roofs: other large planes, above a person."""
    place, features = cubes.place, cubes.features
    row, column = place[:, 0], place[:, 1]
    planar = (features[:, voxels.PLANARITY] >= _PLANAR) & (features[:, voxels.THICKNESS] <= _THICK)
    upright = planar & (features[:, voxels.NORMAL_UP] <= _UPRIGHT)
    many, all_there = np.zeros(grid.shape, np.int64), np.zeros(grid.shape, np.int64)
    top, low = np.zeros(grid.shape, np.int64), np.full(grid.shape, _CUBES_UP)
    np.add.at(many, (row[upright], column[upright]), 1)
    np.add.at(all_there, (row, column), 1)
    np.maximum.at(top, (row[upright], column[upright]), place[upright, 2] + 1)
    np.minimum.at(low, (row, column), place[:, 2].astype(np.int64))
    walls = (many >= _WALL_CUBES) & (top * EDGE_M >= _WALL_M) & (2 * many >= all_there) & (low * EDGE_M < _FOOT_M)
    walls = long_ones(walls, _WALL_LENGTH_M)
    roof = planar & ~upright & (place[:, 2] * EDGE_M >= _ROOF_M)
    roofs = np.zeros(grid.shape, np.bool_)
    roofs[row[roof], column[roof]] = True
    roofs = long_ones(
        cv2.morphologyEx(roofs.view(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)) > 0, _ROOF_LENGTH_M
    )
    return np.asarray(walls[row, column]), np.asarray(roofs[row, column] & roof)


def long_ones(cells: Bools, least_m: float) -> Bools:
    """Returns a mask (rows, columns) of groups of cells, a cell wider, that are no shorter than `least_m`."""
    wider = cv2.dilate(cells.view(np.uint8), np.ones((3, 3), np.uint8))
    count, label, boxes, _ = cv2.connectedComponentsWithStats(wider, connectivity=8)
    keep = (
        np.hypot(boxes[:count, cv2.CC_STAT_WIDTH], boxes[:count, cv2.CC_STAT_HEIGHT]) * EDGE_M >= least_m + 2 * EDGE_M
    )
    keep[0] = False
    around = cv2.dilate(keep[label].view(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(around > 0)


def wires(cubes: Cubes, grid: Grid) -> Bools:
    """Returns a mask (cubes,) of wires: linear, level and high, with nothing else in their columns above a person."""
    place, features = cubes.place, cubes.features
    row, column = place[:, 0], place[:, 1]
    linear = (features[:, voxels.LINEARITY] >= _WIRE_LINEAR) & (features[:, voxels.ALONG_UP] <= _WIRE_LEVEL)
    linear &= place[:, 2] * EDGE_M >= _WIRE_M
    if not linear.any():
        return linear
    high = place[:, 2] * EDGE_M >= _ROOF_M
    wire, others = np.zeros(grid.shape, np.int64), np.zeros(grid.shape, np.int64)
    np.add.at(wire, (row[linear], column[linear]), 1)
    np.add.at(others, (row[high & ~linear], column[high & ~linear]), 1)
    count, label, boxes, _ = cv2.connectedComponentsWithStats(
        ((wire > 0) & (wire >= others)).view(np.uint8), connectivity=8
    )
    keep = np.hypot(boxes[:count, cv2.CC_STAT_WIDTH], boxes[:count, cv2.CC_STAT_HEIGHT]) * EDGE_M >= _WIRE_LENGTH_M
    keep[0] = False
    return np.asarray(linear & keep[label[row, column]])
