"""Bare earth of a window: the returns on it, its raster, planes as a filter of its own, and the road.

Planes are fitted to returns one after another. Sairam, Nagarajan, Ornitz (2016), "Development of mobile mapping system
for 3D road asset inventory", Sensors 16, 367, section 3.3.2: RANSAC finds the plane of most returns, then that of most
returns which the planes before left over, and what no plane holds is no ground. What is added here: planes are those of
squares of the map, they are not steep, and returns high above the lowest ones around take no part.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.dense import dense_ground
from roadscan.assets.ground.sparse import sparse_ground
from roadscan.assets.ground.surface import Found, Grid, Place, Surface, distances, filled, grid_over, is_dense
from roadscan.assets.kernels.ground import cell_heights, planes
from roadscan.assets.kernels.low_returns import heights_above, lowest_returns
from roadscan.assets.scene import Box, GroundModel, Statistics
from roadscan.compute.array_types import Bool, Float32
from roadscan.core.extras import cv2

_TIMES, _LEAST_M = 2.5, 0.01
"""Returns of a cell count within this many standard deviations of their mean, and at least within this distance (m).
"""
_SEVERAL: Final = 5
"""Least number of returns for their scatter."""
_UNKNOWN_M: Final = 0.05
"""Scatter of returns where no cell shows it (m)."""
_GROWTH: Final = 0.05
"""σ of an interpolated height over its distance from seen ground: parts of two recorded streets that were hidden and
interpolated again was wrong by so much (m/m, RMS)."""


def ground_model(place: Place, found: Found) -> GroundModel:
    """Returns heights of the cells in which ground was seen; between them a membrane, as far as the settings say."""
    grid = grid_over(place.window, place.settings.cell_m)
    x, y = place.returns.x_m, place.returns.y_m
    middle, half = np.zeros(grid.shape, np.float32), np.full(grid.shape, np.inf, np.float32)
    for _ in range(2):
        sums = np.zeros((*grid.shape, 3))
        cell_heights(x, y, found.above_m, found.on_ground, grid.origin, 1.0 / grid.cell_m, middle, half, sums)
        middle, scatter = means(sums, middle)
        half = np.maximum(np.float32(_TIMES) * scatter, np.float32(_LEAST_M))
    seen = sums[..., 0] > 0
    height = filled(found.base.at(grid) + middle, seen, grid)
    away = distances(seen, grid.cell_m)
    sigma = sigmas(sums[..., 0], scatter, away, grid, place.statistics)
    for array in (height, sigma):
        array[(away > place.settings.reach_m) | ~seen.any()] = np.nan
    return GroundModel(grid.x_min_m, grid.y_min_m, grid.cell_m, height, seen, sigma)


def sigmas(
    count: npt.NDArray[np.float64], scatter: Float32, away_m: Float32, grid: Grid, statistics: Statistics
) -> Float32:
    """Returns 1 σ (rows, columns) of the heights of cells: of a mean where returns were seen, else by distance.

    count : returns of each cell; scatter : their standard deviation (m), which few returns underestimate: it is no less
    than the median of the survey.
    """
    seen = count > 0
    several = count >= _SEVERAL
    told = statistics.of("ground_scatter_m", 0.5, lambda: scatter[several])
    usual = np.float32(_UNKNOWN_M if told is None else told)
    single = np.where(several, scatter, np.maximum(scatter, usual))
    mean = (single / np.sqrt(np.maximum(count, 1.0))).astype(np.float32)
    return np.asarray(np.hypot(filled(mean, seen, grid), np.where(seen, 0.0, _GROWTH * away_m)), np.float32)


def means(sums: npt.NDArray[np.float64], middle: Float32) -> tuple[Float32, Float32]:
    """Returns means and standard deviations (rows, columns) of cells from their sums about `middle`; 0 of none."""
    held = np.maximum(sums[..., 0], 1.0)
    mean = sums[..., 1] / held
    variance = np.maximum(sums[..., 2] / held - mean * mean, 0.0)
    return (middle + mean).astype(np.float32), np.sqrt(variance).astype(np.float32)


_BLOCK_M: Final = 10.0
"""Planes are sought in squares of the map of this edge (m)."""
_CELL_M: Final = 0.5  # Edge of a cell of the lowest returns (m).
_ABOVE_LOWEST_M, _AROUND_M = 0.5, 1.5
"""Returns take part up to this height above the lowest one within this distance: roofs of cars do not (m, m)."""
_STEEPEST_PLANE: Final = 0.5
"""Steepest slope of a plane (m/m)."""
_DENSE, _SPARSE = (0.06, 30), (0.3, 6)
"""Vertical reach of a plane (m) and least number of returns on it, in dense and in sparse data."""
_PLANES, _DRAWS, _JUDGES = 8, 120, 1500
"""Most planes of a square, draws of a plane, and returns that judge a draw."""


def plane_ground(place: Place) -> Found:
    """Returns a mask of returns on planes near the lowest returns around."""
    returns = place.returns
    x, y, z = returns.x_m, returns.y_m, returns.height_m
    grid = grid_over(place.window, _CELL_M)
    taking_part = np.flatnonzero(z - lowest_around(place, grid) <= _ABOVE_LOWEST_M)
    column = np.floor((returns.corner_m[0] + x[taking_part]) / _BLOCK_M).astype(np.int64)
    row = np.floor((returns.corner_m[1] + y[taking_part]) / _BLOCK_M).astype(np.int64)
    order = np.lexsort([taking_part, column, row])
    rows, row, column = taking_part[order], row[order], column[order]
    begins = np.flatnonzero(np.concatenate([[True], (np.diff(row) != 0) | (np.diff(column) != 0)]))
    found = np.zeros(rows.size, np.bool_)
    if rows.size:
        keys = (row[begins].astype(np.uint64) << np.uint64(40)) ^ (column[begins].astype(np.uint64) << np.uint64(16))
        middle = np.array([place.window.x_min_m, place.window.y_min_m])
        begin = np.append(begins, rows.size).astype(np.int64)
        reach_m, least = _DENSE if is_dense(place) else _SPARSE
        counts = np.array([_PLANES, _DRAWS, _JUDGES, least])
        planes(x[rows] - middle[0], y[rows] - middle[1], z[rows], begin, keys, reach_m, _STEEPEST_PLANE, counts, found)
    on_ground = np.zeros(len(returns), np.bool_)
    on_ground[rows[found]] = True
    return above_planes(place, grid, on_ground)


def lowest_around(place: Place, grid: Grid) -> npt.NDArray[np.float32]:
    """Returns the lowest height (n,) near each return."""
    returns = place.returns
    lowest = np.full(grid.shape, np.inf, np.float32)
    lowest_returns(returns.x_m, returns.y_m, returns.height_m, grid.origin, 1.0 / grid.cell_m, lowest)
    side = 2 * round(_AROUND_M / grid.cell_m) + 1
    lowest = np.asarray(cv2.erode(lowest, np.ones((side, side), np.uint8)))
    row = np.clip(((returns.y_m - grid.y_min_m) / grid.cell_m).astype(np.int64), 0, grid.rows - 1)
    column = np.clip(((returns.x_m - grid.x_min_m) / grid.cell_m).astype(np.int64), 0, grid.columns - 1)
    return np.asarray(lowest[row, column])


def above_planes(place: Place, grid: Grid, on_ground: Bool) -> Found:
    """Returns the surface through the lowest of the returns on planes, and heights above it."""
    returns = place.returns
    lowest = np.full(grid.shape, np.inf, np.float32)
    x, y, z = returns.x_m, returns.y_m, returns.height_m
    lowest_returns(x[on_ground], y[on_ground], z[on_ground], grid.origin, 1.0 / grid.cell_m, lowest)
    base = Surface(grid, filled(lowest, np.isfinite(lowest), grid))
    above = np.empty(len(returns), np.float32)
    heights_above(x, y, z, grid.origin, 1.0 / grid.cell_m, base.height_m, above)
    return Found(base, above, on_ground)


ROAD_REACH_M: Final = 8.0
"""Road reaches this far to both sides of the drive (m)."""
_DRIVEN_M: Final = 1.25
"""Ground this near to the drive (m) was driven on."""
_STEEPEST_ROAD: Final = 0.08
"""Slope between neighbouring cells that is no kerb: 20 mm over a quarter of a metre (m/m)."""
_APART_M: Final = 10.0
"""Poses farther apart (m) are not joined to a path."""
_PLUS: Final = np.ones((3, 3), np.uint8)  # The eight neighbours of a cell, and itself.


def road_cells(ground: GroundModel, drive_xyh_m: npt.NDArray[np.float64]) -> Bool:
    """Returns a mask (rows, columns) of the cells of bare earth that are road; they were seen.

    drive_xyh_m : (p, 4) x, y, height and pass.
    """
    driven = driven_cells(ground, drive_xyh_m)
    if not driven.any():
        return driven
    away = distances(driven, ground.cell_m)
    even = (steps(ground.height_m) <= _STEEPEST_ROAD * ground.cell_m) & (away < ROAD_REACH_M)
    inner = cv2.erode(even.view(np.uint8), _PLUS)
    count, label = cv2.connectedComponents(inner, connectivity=4)
    reached = np.zeros(count, np.bool_)
    reached[label[(away <= _DRIVEN_M) & (inner > 0)]] = True
    reached[0] = False
    wider = cv2.dilate(reached[label].view(np.uint8), _PLUS) > 0
    return np.asarray(wider & ground.seen)


def driven_cells(ground: GroundModel, drive_xyh_m: npt.NDArray[np.float64]) -> Bool:
    """Returns a mask (rows, columns) of the cells on the paths of the drives."""
    cells = np.zeros(ground.height_m.shape, np.uint8)
    place = np.floor((drive_xyh_m[:, :2] - [ground.x_min_m, ground.y_min_m]) / ground.cell_m).astype(np.int32)
    joined = np.hypot(*np.diff(drive_xyh_m[:, :2], axis=0).T) < _APART_M
    joined &= drive_xyh_m[1:, 3] == drive_xyh_m[:-1, 3]
    for k in np.flatnonzero(joined):
        cv2.line(cells, place[k].tolist(), place[k + 1].tolist(), 1)
    return cells > 0


def steps(height_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Returns the greatest difference (rows, columns) between each cell's height and those of its four neighbours (m).

    It is infinite beside cells whose height is not known.
    """
    out = np.zeros(height_m.shape, np.float32)
    for axis in (0, 1):
        step = np.abs(np.diff(height_m, axis=axis))
        step[np.isnan(step)] = np.inf
        before = np.insert(step, 0, 0.0, axis=axis)
        after = np.insert(step, step.shape[axis], 0.0, axis=axis)
        out = np.maximum(out, np.maximum(before, after))
    return out


_NOISE_M: Final = 0.3
"""A return farther below the ground (m) is noise."""


class BareEarth(NamedTuple):
    """The ground of a window."""

    model: GroundModel
    above_m: Float32
    """(n,) height of each return above bare earth (m), NaN where it is not known."""
    on_ground: Bool
    """(n,) returns that lie on it."""
    below: Bool
    """(n,) returns that lie below it: noise."""

    def within(self, rows: npt.NDArray[np.int64], window: Box) -> BareEarth:
        """Returns the ground of a part of the window: some of its returns (k,), and the cells of a box."""
        model = within(self.model, window) or self.model
        return BareEarth(model, self.above_m[rows], self.on_ground[rows], self.below[rows])


def bare_earth(place: Place) -> BareEarth:
    """Returns the ground under the returns of a window."""
    found = ground_returns(place)
    model = ground_model(place, found)
    above = np.empty(len(place.returns), np.float32)
    corner = np.array([model.x_min_m, model.y_min_m])
    x, y, z = place.returns.x_m, place.returns.y_m, place.returns.height_m
    heights_above(x, y, z, corner, 1.0 / model.cell_m, model.height_m, above)
    return BareEarth(model, above, found.on_ground, ~found.on_ground & (above < -_NOISE_M))


def within(model: GroundModel, box: Box) -> GroundModel | None:
    """Returns the cells of a model whose middle lies in a box; None without any."""
    rows, columns = model.height_m.shape
    x = model.x_min_m + (np.arange(columns) + 0.5) * model.cell_m
    y = model.y_min_m + (np.arange(rows) + 0.5) * model.cell_m
    c = np.flatnonzero((x >= box.x_min_m) & (x < box.x_max_m))
    r = np.flatnonzero((y >= box.y_min_m) & (y < box.y_max_m))
    if not (c.size and r.size):
        return None
    part = slice(int(r[0]), int(r[-1]) + 1), slice(int(c[0]), int(c[-1]) + 1)
    return GroundModel(
        model.x_min_m + int(c[0]) * model.cell_m, model.y_min_m + int(r[0]) * model.cell_m, model.cell_m,
        model.height_m[part], model.seen[part], None if model.sigma_m is None else model.sigma_m[part],
    )  # fmt: skip


def ground_returns(place: Place) -> Found:
    """Returns a mask of returns on the ground, by the filter that the settings name."""
    if place.settings.method == "planes":
        return plane_ground(place)
    return dense_ground(place) if is_dense(place) else sparse_ground(place)
