"""Contrast of ground returns to the surface around them, and its mean over cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.assets.bins import cells_of, in_bins
from roadscan.assets.classes import PERSON, VEHICLE
from roadscan.assets.kernels.paint_levels import contrasts, paint_levels, paint_sums, scan_lines, seen_on_ground
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box, Scene
from roadscan.compute.array_types import Float32, Float64, Int64
from roadscan.compute.kernel_options import read_only

CELL_M: Final = 0.05
"""Edge of a cell of paint (m); cells lie on a grid of the map."""
ON_GROUND_M: Final = 0.1  # Returns within this height of the ground (m) are on it.
_LEVEL_CELL_M: Final = 0.5  # Edge of a cell of brightness (m).
_LEVEL_HALF: Final = 2
"""Half width of the surroundings (cells): they are 2.5 m wide."""
_USUAL_STEP, _USUAL_SIZE = 3, 9
"""The usual brightness is a median over 13 m, of every third cell."""
_DARKEST: Final = 0.9
"""Surroundings darker than this share of the usual brightness (fresh bitumen, water) count as this bright."""
ROUGHEST_M: Final = 0.03  # Ground that scatters more (m) is not searched for paint.
_ROUGH_M: Final = 0.12
"""Weights of the height's scatter about its mean fall within this distance (m)."""
SMOOTH_M: Final = 0.06
"""1 σ of the weights of the returns around a cell (m)."""
_FEWEST_PER_M2: Final = 40.0
"""With fewer returns (1/m²), only few would hit a stripe."""
_FLATTEST: Final = 0.1
"""Least sine of the angle between beam and road: below it a beam's footprint is ten times as long as it is wide."""
_LINE_NS: Final = 20_000_000  # A scan line is what one laser sees within this time (ns).
_LEAST_NOISE: Final = 0.06  # Least 1 σ of a return's contrast.
_CLIP: Final = (-0.5, 2.0)
"""Bounds of contrasts: glints are clipped to these."""


@dataclass(frozen=True, eq=False)
class Contrast:
    """Ground returns (n,) of a scene with their contrast, and rasters (rows, columns) of cells of the window."""

    rows: Int64
    """(n,) rows of the scene's returns."""
    x_m: Float64
    y_m: Float64
    height_m: Float64
    contrast: Float64
    """(n,) intensity over that of the surface around, less 1; 0 on the surface, 1 where it is twice as bright."""
    noise: Float64
    """(n,) 1 σ of the contrast of returns on the surface around."""
    line: Int64
    """(n,) number of the scan line: what one laser saw within 20 ms."""
    cell: Int64
    """(n,) cell of each return: row · columns + column."""
    box: Box
    """The extent of the scene, from the corner of its returns."""
    mean: Float32
    """Mean contrast, weighted over the returns around each cell; 0 where there are none."""
    sigma: Float32
    """Its standard deviation; infinite where there are none."""
    dense_cells: int = 0
    """Number of cells in which enough returns lie on the ground."""
    rough_cells: int = 0
    """Those of them that scatter by too much: no paint is sought there."""

    def cell_of(self, x_m: Float64, y_m: Float64) -> Int64:
        """Returns the cell of points (n,) within the window."""
        rows, columns = self.mean.shape
        column = np.clip(((x_m - self.box.x_min_m) / CELL_M).astype(np.int64), 0, columns - 1)
        row = np.clip(((y_m - self.box.y_min_m) / CELL_M).astype(np.int64), 0, rows - 1)
        return np.asarray(row * columns + column, np.int64)


def contrast_of(scene: Scene) -> Contrast:
    """Returns the contrast of a scene's returns that lie on the ground and on no vehicle or person."""
    found = scene.returns
    window = scene.extent
    rows = _on_surface(scene, window)
    x, y, intensity = found.x_m[rows], found.y_m[rows], found.intensity[rows].astype(np.float64)
    contrast, noise = np.empty(rows.size), np.empty(rows.size)
    grid = (float(window.x_min_m), float(window.y_min_m), _LEVEL_CELL_M)
    contrasts(x, y, intensity, grid, *_levels(x, y, intensity, window), (*_CLIP, _LEAST_NOISE), contrast, noise)
    shape = round((window.y_max_m - window.y_min_m) / CELL_M), round((window.x_max_m - window.x_min_m) / CELL_M)
    cell = np.maximum(cells_of(x, y, (grid[0], grid[1], CELL_M), shape), 0).astype(np.int64)
    mean, sigma, counts = _means(cell, contrast, noise, scene.above_ground_m[rows], shape, ROUGHEST_M)
    heights = found.height_m[rows]
    return Contrast(rows, x, y, heights, contrast, noise, _lines(found, rows), cell, window, mean, sigma, *counts)


def _on_surface(scene: Scene, box: Box) -> Int64:
    """Returns rows of the returns on the ground and on no road user, without those that a beam met at a small angle,
    where it is known where the sensor stood.
    """
    r, looked_at = scene.returns, np.ones(256, np.bool_)
    looked_at[[VEHICLE, PERSON]] = False
    rows = np.empty(len(r), np.int64)
    place = tuple(map(read_only, (r.x_m, r.y_m, r.height_m)))
    sensor = tuple(map(read_only, (r.sensor_x_m, r.sensor_y_m, r.sensor_height_m)))
    limits = (ON_GROUND_M, _FLATTEST)
    count = seen_on_ground(place, sensor, scene.above_ground_m, looked_at[scene.classes], limits, tuple(box), rows)
    return np.asarray(rows[:count].copy())


def _lines(found: Returns, rows: Int64) -> Int64:
    """Returns the number (n,) of the scan line of each return at `rows`."""
    out = np.empty(rows.size, np.int64)
    scan_lines(rows, read_only(found.epoch_gps_ns), found.sensor, found.laser, _LINE_NS, out)
    return out


def _levels(x: Float64, y: Float64, intensity: Float64, window: Box) -> tuple[Float64, Float64]:
    """Brightness (rows, columns) of the surface around cells, and what 84 % of the returns on it do not exceed."""
    from scipy import ndimage

    edge = _LEVEL_CELL_M
    sides = window.y_max_m - window.y_min_m, window.x_max_m - window.x_min_m
    shape = int(np.ceil(sides[0] / edge)), int(np.ceil(sides[1] / edge))
    own = cells_of(x, y, (float(window.x_min_m), float(window.y_min_m), edge), shape)
    first, order = in_bins(own, shape[0] * shape[1])
    level, upper = np.empty(shape), np.empty(shape)
    paint_levels(intensity[order], first, _LEVEL_HALF, level, upper)
    known = np.isfinite(level)
    if not known.any():
        return np.ones(shape), np.ones(shape)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = level[tuple(nearest)]
    usual = ndimage.median_filter(filled[::_USUAL_STEP, ::_USUAL_STEP], _USUAL_SIZE, mode="nearest")
    usual = np.maximum(usual.repeat(_USUAL_STEP, 0).repeat(_USUAL_STEP, 1)[: shape[0], : shape[1]], 1e-6)
    return np.maximum(filled, _DARKEST * usual), upper[tuple(nearest)]


def _means(
    cell: Int64, contrast: Float64, noise: Float64, height: Float32, shape: tuple[int, int], roughest_m: float
) -> tuple[Float32, Float32, tuple[int, int]]:
    """Returns the weighted mean of the contrast around each cell, and its standard deviation; none where it is rougher.

    The last are the numbers of cells with enough returns, and of rough ones among them.
    """
    from roadscan.core.extras import cv2

    sums = np.zeros((shape[0] * shape[1], 5), np.float32)
    paint_sums(cell, contrast, noise, height, sums)
    number, contrasted, noisy, high, squares = map(np.asarray, cv2.split(sums.reshape(*shape, 5)))

    def raster(counts: Float32, sigma_m: float) -> Float32:
        reach = 2 * int(np.ceil(3 * sigma_m / CELL_M)) + 1
        blurred = cv2.GaussianBlur(counts, (reach, reach), sigma_m / CELL_M, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(blurred, np.float32)

    weight = raster(number, SMOOTH_M)
    area = 4.0 * np.pi * (SMOOTH_M / CELL_M) ** 2
    known = weight >= _FEWEST_PER_M2 * CELL_M**2
    dense = int(np.count_nonzero(known))
    near = np.maximum(raster(number, _ROUGH_M), 1e-9)
    middle = raster(high, _ROUGH_M) / near
    known &= raster(squares, _ROUGH_M) / near - middle**2 <= roughest_m**2
    mean = np.where(known, raster(contrasted, SMOOTH_M) / np.maximum(weight, 1e-9), 0.0)
    variance = raster(noisy, SMOOTH_M / np.sqrt(2.0)) / area / np.maximum(weight, 1e-9) ** 2
    sigma = np.where(known, np.sqrt(variance), np.inf).astype(np.float32)
    return mean.astype(np.float32), sigma, (dense, dense - int(np.count_nonzero(known)))
