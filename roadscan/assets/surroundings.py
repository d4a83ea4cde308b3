"""Classes of stationary things beside and over the road, from the scatter of returns in cubes above the ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.bins import sums_around
from roadscan.assets.ground.surface import Grid, grid_over
from roadscan.assets.kernels import cubes
from roadscan.assets.kernels import cubes as voxels
from roadscan.assets.kernels.columns import mark_corridor
from roadscan.assets.kernels.cubes import ALONE, LEAFY, WALL, WIRE, standing_classes
from roadscan.assets.scene import Box, Returns
from roadscan.compute.array_types import Bool, Float32
from roadscan.compute.kernel_options import read_only
from roadscan.core.extras import cv2

EDGE_M: Final = 0.3
"""Edge of a cube (m); features are those of three by three by three cubes."""
LAYERS: Final = 64
"""Cubes above one another: up to 19 m above the ground."""


@dataclass(frozen=True, eq=False)
class Cubes:
    """Cubes that contain returns."""

    number: npt.NDArray[np.int32]
    """(n,) number of each return's cube, -1 for none."""
    place: npt.NDArray[np.int32]
    """(cubes, 3) row, column and layer from the window's corner and the ground."""
    features: npt.NDArray[np.float32]
    """(cubes, 7), columns as in :mod:`roadscan.assets.kernels.cubes`."""


def cubes_of(returns: Returns, above_m: npt.NDArray[np.float32], chosen: Bool, window: Box) -> Cubes:
    """Returns the cubes of the chosen returns (n,), with the scatter in each cube and its neighbours."""
    grid = grid_over(window, EDGE_M)
    index = np.full((*grid.shape, LAYERS), -1, np.int32)
    number = np.empty(len(returns), np.int32)
    place = np.empty((int(np.count_nonzero(chosen)), 3), np.int32)
    per_m = 1.0 / EDGE_M
    count = cubes.numbered(returns.x_m, returns.y_m, above_m, chosen, grid.origin, per_m, index, number, place)
    place = place[:count].copy()
    sums = np.zeros((count, cubes.MOMENTS))
    cubes.moments(returns.x_m, returns.y_m, above_m, number, grid.origin, per_m, place, sums)
    features = np.empty((count, 7), np.float32)
    cubes.features(index, place, sums, features)
    return Cubes(number, place, features)


_LOWEST_M: Final = 2.5
"""Least height of a structure over the path (m)."""
_CORRIDOR_M: Final = 1.5
"""Half width of the corridor of a drive (m)."""
_LEAST_CELLS: Final = 4
"""Least number of cells of the corridor under a structure."""
_LEAST_KNOWN: Final = 4
"""Fewer returns in a cube and those around lie in a plane whatever they hit: false ones of the sun's light would hang
together with crowns and span the road."""
_PLANAR: Final = 0.4  # Least planarity of a cube of a deck or of a wall.
_UPRIGHT: Final = 0.25  # Least upward part of the normal of a deck, greatest of that of a wall.
_BELOW_CUBES, _ABOVE_CUBES = 1, 4
"""Edges and parapets of a deck reach this far below and above its level cubes (cubes)."""
_DECK_CELLS: Final = 7
"""Least extent of a deck's lower face in both directions (cells of 0.3 m): that of a gantry is less."""
_ARM_CELLS: Final = 5
"""What hangs together with a deck and is narrower than this (cells of 0.3 m), as the arm of a lamp, is none of it."""


def overhead_classes(
    cubes: Cubes, grid: Grid, leafy: Bool, left_out: Bool, drive_xyh_m: npt.NDArray[np.float64]
) -> npt.NDArray[np.uint8]:
    """Returns the class (cubes,) of each cube: bridge deck, overhead structure, or 0 for neither.

    What hangs together 2.5 m above the ground or higher, seen from above, is a structure over the way where a drive
    passes beneath it. It is a bridge deck where it holds a level plane of 2.1 m by 2.1 m above that drive; its edges
    scatter in all directions as leaves do, and belong to it.

    Parameters
    ----------
    leafy : (cubes,) those that scatter as leaves do; left_out : (cubes,) those that are wires or walls.
    drive_xyh_m : (p, 4) x, y and height of the sensor (m) and the pass.
    """
    out = np.zeros(left_out.size, np.uint8)
    high = ~left_out & (cubes.place[:, 2] * EDGE_M >= _LOWEST_M)
    corridor = _corridors(grid, drive_xyh_m)
    row, column, layer = cubes.place.T
    if not (high & corridor[row, column]).any():
        return out
    known = high & (cubes.features[:, voxels.NUMBER] >= _LEAST_KNOWN)
    level = known & (cubes.features[:, voxels.PLANARITY] >= _PLANAR)
    level &= cubes.features[:, voxels.NORMAL_UP] > _UPRIGHT
    hanging = (known & ~leafy) | level
    cells = np.zeros(grid.shape, np.uint8)
    cells[row[hanging], column[hanging]] = 1
    count, label = cv2.connectedComponents(cv2.morphologyEx(cells, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)))
    over = np.bincount(label[corridor & (cells > 0)], minlength=count) >= _LEAST_CELLS
    over[0] = False
    faces = np.zeros(grid.shape, np.uint8)
    faces[row[level], column[level]] = 1
    faces = cv2.morphologyEx(faces, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    wide = cv2.morphologyEx(faces, cv2.MORPH_OPEN, np.ones((_DECK_CELLS, _DECK_CELLS), np.uint8)) > 0
    decks = np.bincount(label[wide & corridor], minlength=count) > 0
    own, no_arm = label[row, column], np.ones((_ARM_CELLS, _ARM_CELLS), np.uint8)
    out[high & ~leafy & over[own]] = classes.OVERHEAD_STRUCTURE
    for number in np.flatnonzero(over & decks).tolist():
        deck = cv2.morphologyEx((label == number).astype(np.uint8), cv2.MORPH_OPEN, no_arm)
        about = cv2.dilate(deck, np.ones((3, 3), np.uint8)) > 0
        layers = layer[level & (own == number)]
        near = high & (layer >= layers.min() - _BELOW_CUBES) & (layer <= layers.max() + _ABOVE_CUBES)
        out[near & about[row, column]] = classes.BRIDGE_DECK
    return out


def _corridors(grid: Grid, drive_xyh_m: npt.NDArray[np.float64]) -> Bool:
    """Returns a mask of cells (rows, columns) near the drives."""
    inside = np.zeros(grid.shape, np.bool_)
    for number in np.unique(drive_xyh_m[:, 3]).tolist():
        drive = drive_xyh_m[drive_xyh_m[:, 3] == number]
        x, y = np.ascontiguousarray(drive[:, 0]), np.ascontiguousarray(drive[:, 1])
        mark_corridor(x, y, _CORRIDOR_M, np.array(grid.origin), EDGE_M, inside)
    return inside


REACH_M: Final = 8.0
"""A roof of 6 m, with the cubes around that tell its scatter, lies within this (m)."""
_THICK: Final = 0.4
"""A cube is part of an upright plane with at least that planarity, at most that upward part of its normal, and at most
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


def leaves(cubes: Cubes, grid: Grid) -> Bool:
    """Returns a mask (cubes,) of those in columns that scatter in all directions, with those around."""
    row, column = cubes.place[:, 0], cubes.place[:, 1]
    number, scattering = np.zeros(grid.shape), np.zeros(grid.shape)
    np.add.at(number, (row, column), 1.0)
    np.add.at(scattering, (row, column), cubes.features[:, voxels.SCATTERING].astype(np.float64))
    return np.asarray((sums_around(scattering, 3) >= _LEAFY * sums_around(number, 3))[row, column])


def walls_and_roofs(cubes: Cubes, grid: Grid) -> tuple[Bool, Bool]:
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


def long_ones(cells: Bool, least_m: float) -> Bool:
    """Returns a mask (rows, columns) of groups of cells, a cell wider, that are no shorter than `least_m`."""
    wider = cv2.dilate(cells.view(np.uint8), np.ones((3, 3), np.uint8))
    count, label, boxes, _ = cv2.connectedComponentsWithStats(wider, connectivity=8)
    keep = (
        np.hypot(boxes[:count, cv2.CC_STAT_WIDTH], boxes[:count, cv2.CC_STAT_HEIGHT]) * EDGE_M >= least_m + 2 * EDGE_M
    )
    keep[0] = False
    around = cv2.dilate(keep[label].view(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(around > 0)


def wires(cubes: Cubes, grid: Grid) -> Bool:
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
