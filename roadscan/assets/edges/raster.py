"""The ground of a scene as a fine raster of robust low heights, in which edges are sought."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.bins import cells_of
from roadscan.assets.kernels.low_heights import low_heights
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.assets.smoothing import gaussian
from roadscan.compute.array_types import Float64
from roadscan.core.extras import cv2

CELL_M: Final = 0.1  # Edge of a cell (m).
DEPTH_M: Final = 0.12
"""Returns up to this height above the lowest one of a cell (m) count as its ground."""
REACH_M: Final = 0.45
"""Returns up to this above bare earth (m) may be ground: the filter may take the top of a kerb for an object."""
BESIDE_VEHICLE_M: Final = 0.15  # Ground this near to a vehicle is left out (m).
UNEVENNESS_M: Final = 0.004
"""Standard deviation of a cell's true height about a smooth surface (m), whatever the number of returns."""
_SEVERAL: Final = 4
"""Least number of heights of a cell for their scatter."""
COARSE_M: Final = 1.5
"""Standard deviation of the window from which the slope of the ground at large is computed (m)."""
NOT_GROUND: Final = (
    classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION, classes.BUILDING, classes.LOW_NOISE, classes.HIGH_NOISE,
    classes.WIRE, classes.VEHICLE, classes.PERSON, classes.POLE, classes.SIGN, classes.FENCE,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class HeightRaster:
    """Heights of cells. Row 0 is the southern one, column 0 the western one; coordinates as the scene's returns."""

    x_min_m: float
    y_min_m: float
    cell_m: float
    count: npt.NDArray[np.int32]
    """(rows, columns) returns of the ground; 0: no height."""
    height_m: Float64
    """(rows, columns) mean height; NaN where there is none."""
    sigma_m: Float64
    """(rows, columns) standard deviation of the mean; NaN where there is none."""
    spread_m: Float64
    """(rows, columns) standard deviation of the heights in a cell."""
    noise_m: float
    """Median of these over the survey's cells with four heights or more; 0 where there is none."""
    used: npt.NDArray[np.bool_]
    """(n,) returns of the scene that count as ground; none where the raster was made of cells."""
    cell: npt.NDArray[np.int32]
    """(n,) flat number of the cell of each return, −1 outside; none where the raster was made of cells."""

    @property
    def weight(self) -> Float64:
        """Returns one over the variance of a height (1/m²) (rows, columns), 0 where there is none."""
        return np.where(self.count > 0, 1.0 / np.square(np.where(self.count > 0, self.sigma_m, 1.0)), 0.0)

    @cached_property
    def level_m(self) -> float:
        """Returns the median height of its cells; 0 where none has one."""
        known = self.count > 0
        return float(np.median(self.height_m[known])) if known.any() else 0.0

    @cached_property
    def slopes(self) -> tuple[Float64, Float64]:
        """Returns the slope (rows, columns) of the ground at large along x and y (m/m)."""
        sigma = COARSE_M / self.cell_m
        known = (self.count > 0).astype(np.float64)
        level = self.level_m
        weight = gaussian(known, sigma, 3.0)
        total = gaussian(np.where(known > 0, self.height_m - level, 0.0), sigma, 3.0)
        smooth = np.where(weight > 1e-3, total / np.maximum(weight, 1e-3), 0.0)
        down, right = np.gradient(smooth, self.cell_m)
        near = weight > 1e-2
        return np.where(near, np.clip(right, -0.3, 0.3), 0.0), np.where(near, np.clip(down, -0.3, 0.3), 0.0)

    def cells_of(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Returns row and column of places (any shape), clipped to the raster."""
        rows, columns = self.count.shape
        x_m, y_m = np.broadcast_arrays(x_m, y_m)
        row = np.floor((np.asarray(y_m) - self.y_min_m) / self.cell_m).astype(np.int64)
        column = np.floor((np.asarray(x_m) - self.x_min_m) / self.cell_m).astype(np.int64)
        return np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)


def may_be_ground(scene: Scene) -> npt.NDArray[np.bool_]:
    """Returns a mask (n,) of the scene's returns that may be ground with edges."""
    above, looked_at = scene.above_ground_m, np.ones(256, np.bool_)
    looked_at[list(NOT_GROUND)] = False
    return (np.isnan(above) | (np.abs(above) <= REACH_M)) & looked_at[scene.classes]


@once_a_scene
def raster_of(scene: Scene) -> HeightRaster:
    """Returns the raster of a scene's extent; its cells are those of a grid that all tiles share."""
    window, used, returns = scene.extent, may_be_ground(scene), scene.returns
    x_min, y_min = (CELL_M * math.floor(v / CELL_M + 1e-6) for v in window[:2])
    columns = max(math.ceil((window.x_max_m - x_min) / CELL_M - 1e-6), 8)
    rows = max(math.ceil((window.y_max_m - y_min) / CELL_M - 1e-6), 8)
    cell = cells_of(returns.x_m, returns.y_m, (x_min, y_min, CELL_M), (rows, columns))
    used &= ~_beside_vehicles(scene, cell, (rows, columns))
    count = np.zeros(rows * columns, np.int32)
    mean, variance = np.zeros(rows * columns), np.zeros(rows * columns)
    low_heights(cell, returns.height_m, used, DEPTH_M, count, mean, variance)
    shape = (rows, columns)
    spread = np.sqrt(variance).reshape(shape)
    noise = scene.statistics.of("edge_noise_m", 0.5, lambda: spread[count.reshape(shape) >= _SEVERAL])
    raster = of_cells(x_min, y_min, CELL_M, count.reshape(shape), mean.reshape(shape), spread, noise or 0.0)
    return replace(raster, used=used, cell=cell)


def _beside_vehicles(scene: Scene, cell: npt.NDArray[np.int32], shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Returns a mask (n,) of returns at vehicles: the seen ground ends at their outline, which looks like a step."""
    vehicle = cell[scene.classes == classes.VEHICLE]
    number = np.bincount(vehicle[vehicle >= 0], minlength=shape[0] * shape[1]).reshape(shape)
    cells = math.ceil(BESIDE_VEHICLE_M / CELL_M)
    reach = np.arange(-cells, cells + 1) * CELL_M
    disc = np.hypot(reach, reach[:, None]) <= BESIDE_VEHICLE_M + 1e-9
    near = cv2.dilate((number >= 2).view(np.uint8), disc.astype(np.uint8)) > 0
    return np.append(near.ravel(), False)[cell]


def of_cells(
    x_min_m: float,
    y_min_m: float,
    cell_m: float,
    count: npt.NDArray[np.int32],
    mean_m: Float64,
    spread_m: Float64,
    noise_m: float | None = None,
) -> HeightRaster:
    """Returns a raster of cells whose mean height and spread are known.

    Parameters
    ----------
    x_min_m, y_min_m, cell_m : the corner of the first cell, and the edge of a cell (m).
    count : (rows, columns) heights in each cell, 0 where there is none.
    mean_m, spread_m : (rows, columns) their mean and standard deviation (m).
    noise_m : that of the survey; where it is left out, the raster's own.
    """
    if noise_m is None:
        several = count >= _SEVERAL
        noise_m = float(np.median(spread_m[several])) if several.any() else 0.0
    known = count > 0
    sigma = np.sqrt(UNEVENNESS_M**2 + max(noise_m, 0.001) ** 2 / np.maximum(count, 1))
    return HeightRaster(
        x_min_m, y_min_m, cell_m, count, np.where(known, mean_m, np.nan), np.where(known, sigma, np.nan), spread_m,
        noise_m, np.zeros(0, np.bool_), np.zeros(0, np.int32),
    )  # fmt: skip
