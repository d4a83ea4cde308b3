"""Steps of the ground: a fine raster of robust low heights, and height, significance and place of possible edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import scipy.ndimage

from roadscan.assets import classes
from roadscan.assets.bins import cells_of
from roadscan.assets.kernels.low_returns import low_heights
from roadscan.assets.kernels.step_filter import (
    CHUNK,
    FRAME,
    WORK,
    convolve,
    sizes_of,
    step_response,
    strips,
    take_excess,
    thin,
    window_means,
)
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.kernel_options import read_only
from roadscan.core.extras import cv2


def gaussian(values: Float64, sigma_cells: float, truncate: float) -> Float64:
    """Returns values (rows, columns) through a Gaussian, up to `truncate` σ; the raster is mirrored at its edges."""
    away = np.arange(int(truncate * sigma_cells + 0.5) + 1)
    half = np.exp(-0.5 / (sigma_cells * sigma_cells) * away**2)
    weights = half / np.concatenate([half[:0:-1], half]).sum()
    out, between = np.empty(values.shape), np.empty(values.shape)
    line = np.empty(values.shape[1] + 2 * away[-1])
    convolve(read_only(np.ascontiguousarray(values)), weights, line, between, out)
    return out


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
LEAST_STEP_M: Final = 0.015  # Lower steps are none (m).
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
    used: Bool
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


def may_be_ground(scene: Scene) -> Bool:
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


def _beside_vehicles(scene: Scene, cell: npt.NDArray[np.int32], shape: tuple[int, int]) -> Bool:
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


class StepSettings(NamedTuple):
    """How steps are sought. One setting for all data."""

    directions: int = 16
    """Directions of edges over half a turn."""
    half_along_m: float = 0.5
    """Half the length of the window along the edge."""
    across_m: float = 0.4
    """Width of the window on each side of the edge."""
    slope_sigma: float = 0.05
    """Standard deviation of the slope of a side about that of the ground at large (m/m)."""
    floor_m: float = 0.005
    """Standard deviation of a step however many returns it has: unevenness as long as the window."""
    around_m: float = 5.0
    """Width of the surroundings whose steps of the same direction show the scatter beyond that of the lines."""
    least_evidence: float = 2.0
    """Least significance (step over its σ) of a place."""
    least_m: float = LEAST_STEP_M
    greatest_m: float = 0.32


class Places(NamedTuple):
    """Places of possible edges; the higher side lies to the right of their direction."""

    x_m: Float64
    y_m: Float64
    heading_x: Float64
    """Unit vector along the edge."""
    heading_y: Float64
    evidence: Float64
    """The step over its standard deviation."""
    step_m: Float64
    """Height of the step."""

    def at(self, rows: npt.NDArray[np.int64]) -> Places:
        """Returns the places at `rows`, indices (m,)."""
        return Places(*(column[rows] for column in self))


DEFAULT: Final = StepSettings()
_CLIPPED: Final = 4.0  # Greatest significance that counts in the scatter.
_STILL: Final = 0.5  # Significance that counts for a cell without steps.
_PRIOR: Final = 0.06  # Weight of the prior scatter, as a share of the cells.
_MEAN_SIZE: Final = math.sqrt(2.0 / math.pi)
"""Mean of the absolute value of a normal variable."""


def step_places(raster: HeightRaster, settings: StepSettings = DEFAULT) -> Places:
    """Returns places where the ground steps, in the order of rows and columns: a matched filter in every direction.

    Each side of the edge gets a line across it, of cells within `half_along_m` along and `across_m` across; the step is
    the difference of both lines at the edge, and its evidence the step over its σ, which grows with the scatter of the
    cells about the lines. A place is kept for its most significant direction, unless a neighbour across exceeds it.
    """
    whole, part = raster, _part(raster, settings)
    raster = replace(raster, **{name: getattr(raster, name)[part] for name in ("count", "height_m", "sigma_m")})
    first = part[0].start, part[1].start
    best = np.zeros((4, *raster.count.shape))
    ground = [slope[part] for slope in whole.slopes]
    field = _framed(raster, whole.level_m, ground)
    active = _active(raster, settings)
    still = field.inner((raster.count > 0) & ~active)
    freedom, active = field.inner(_freedom(raster, settings)), field.inner(active)
    slopes = [field.inner(slope) for slope in ground]
    reach = round(settings.across_m / raster.cell_m)
    wanted = cv2.dilate(active.view(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    wanted = wanted.reshape(len(wanted), -1, CHUNK).max(axis=2) > 0
    strip, work = np.zeros((3, *field.weight.shape)), np.empty((WORK, CHUNK))
    step, evidence = np.empty(active.shape), np.empty(active.shape)
    surroundings = _Surroundings.of(active, round(settings.around_m / raster.cell_m))
    constants = (settings.slope_sigma**-2, settings.floor_m)
    limits = (settings.least_evidence, settings.least_m, settings.greatest_m)
    for k in range(settings.directions):
        angle = math.pi * k / settings.directions
        u, v = (math.cos(angle), math.sin(angle)), (math.sin(angle), -math.cos(angle))
        strips(*field, _along(u, settings, raster.cell_m), wanted, work, strip)
        strip[:, :, FRAME + raster.count.shape[1] :] = 0.0  # no strip lies beyond the raster
        across = _across(v, settings, raster.cell_m)
        step_response(strip, freedom, active, (*slopes, v), across, constants, work, step, evidence)
        surroundings.take_excess(evidence, still)
        thin(step, evidence, float(k), v, limits, first, best)
    return _places(raster, best, first, settings)


def _part(raster: HeightRaster, settings: StepSettings) -> tuple[slice, slice]:
    """Returns rows and columns of the raster whose surroundings, as far as a step reaches, contain a height."""
    margin, known = round(settings.around_m / raster.cell_m) + 1, raster.count > 0
    parts = []
    for axis, size in enumerate(known.shape):
        held = np.flatnonzero(known.any(axis=1 - axis))
        first, last = (int(held[0]), int(held[-1])) if held.size else (0, 0)
        parts.append(slice(max(first - margin, 0), min(last + margin + 1, size)))
    return parts[0], parts[1]


class _Field(NamedTuple):
    """Rasters with a frame, padded to a whole number of chunks of columns, as the kernels need them."""

    weight: Float64
    height_m: Float64
    slope_x: Float64
    slope_y: Float64

    def inner(self, raster: Any) -> Any:
        """Returns a raster without a frame (rows, columns padded to whole chunks); the padding is 0 or False."""
        columns = self.weight.shape[1] - 2 * FRAME
        return np.pad(raster, ((0, 0), (0, columns - raster.shape[1])))


def _framed(raster: HeightRaster, level_m: float, slopes: Sequence[Float64]) -> _Field:
    more = -raster.count.shape[1] % CHUNK
    height = np.where(raster.count > 0, raster.height_m - level_m, 0.0)
    frame = ((FRAME, FRAME), (FRAME, FRAME + more))
    return _Field(*(np.pad(one, frame) for one in (raster.weight, height, *slopes)))


class _Surroundings(NamedTuple):
    """Buffers for the means of the surroundings of cells."""

    size: int
    """Width of the surroundings (cells)."""
    wanted: tuple[int, int]
    """First of the rows in which steps are sought, and the one after the last."""
    counted: Float64
    sizes: Float64
    means: Float64
    between: Float64
    line: Float64

    @classmethod
    def of(cls, active: Bool, size: int) -> Self:
        """Returns the buffers for steps that are sought in some cells (rows, columns)."""
        rows, columns = active.shape
        looked_at = np.flatnonzero(active.any(axis=1))
        wanted = (int(looked_at[0]), int(looked_at[-1]) + 1) if looked_at.size else (0, 0)
        between, line = np.zeros((rows + 2, columns)), np.zeros(columns + size)
        counted, sizes = np.empty(active.shape), np.empty(active.shape)
        return cls(size, wanted, counted, sizes, np.empty((2, rows, columns)), between, line)

    def take_excess(self, evidence: Float64, still: Bool) -> None:
        """Divide steps over their σ by the excess scatter of steps of one direction around each cell over chance.

        Rings of a lidar whose lasers or sweeps disagree look like steps everywhere around; a kerb is alone.
        still : cells without a step of any kind near.
        """
        sizes_of(evidence, still, (_STILL, _CLIPPED), self.counted, self.sizes)
        for value, mean in ((self.counted, self.means[0]), (self.sizes, self.means[1])):
            window_means(value, self.size, self.wanted, self.between, self.line, mean)
        take_excess(evidence, *self.means, (_PRIOR, _PRIOR * _STILL), _MEAN_SIZE)


def _along(u: tuple[float, float], settings: StepSettings, cell_m: float) -> Float64:
    """Returns (k, 4) cells of a strip along u, as :func:`strips` needs them."""
    half = round(settings.half_along_m / cell_m)
    k = np.arange(-half, half + 1)
    cells = np.unique(np.column_stack([np.rint(k * u[0]), np.rint(k * u[1])]), axis=0)
    return np.column_stack([cells, cells * cell_m])


def _across(v: tuple[float, float], settings: StepSettings, cell_m: float) -> Float64:
    """Returns (s, 3) strips of the right side, as :func:`step_response` needs them."""
    j = np.arange(1, round(settings.across_m / cell_m) + 1)
    return np.column_stack([np.rint(j * v[0]), np.rint(j * v[1]), j * cell_m])


def _freedom(raster: HeightRaster, settings: StepSettings) -> Float64:
    """Returns the number (rows, columns) of cells with a height in the window around each cell, in any direction."""
    wide = round((settings.half_along_m + settings.across_m) / raster.cell_m) + 1
    share = scipy.ndimage.uniform_filter((raster.count > 0).astype(np.float64), wide, mode="constant")
    return np.asarray(share * 4.0 * settings.half_along_m * settings.across_m / raster.cell_m**2)


def _active(raster: HeightRaster, settings: StepSettings) -> Bool:
    """Returns a mask of cells near which heights differ by as much as the least step."""
    wide, known = round(2.0 * settings.across_m / raster.cell_m) + 1, raster.count > 0
    window = np.ones((wide, wide), np.uint8)
    top = cv2.dilate(np.where(known, raster.height_m, -np.inf), window, borderType=cv2.BORDER_REPLICATE)
    bottom = cv2.erode(np.where(known, raster.height_m, np.inf), window, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.isfinite(top) & (top - bottom >= settings.least_m))


def _places(raster: HeightRaster, best: Float64, first: tuple[int, int], settings: StepSettings) -> Places:
    """Returns the places of the cells with a step; first : row and column of the raster at which `best` begins."""
    row, column = np.nonzero(best[0] > 0.0)
    evidence, step, direction, offset = best[:, row, column]
    row, column = row + first[0], column + first[1]
    angle = math.pi * direction / settings.directions
    ux, uy = np.cos(angle), np.sin(angle)
    x = raster.x_min_m + (column + 0.5 + offset * uy) * raster.cell_m
    y = raster.y_min_m + (row + 0.5 - offset * ux) * raster.cell_m
    turn = np.where(step >= 0.0, 1.0, -1.0)
    return Places(x, y, ux * turn, uy * turn, evidence, np.abs(step))
