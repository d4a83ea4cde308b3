"""Steps of the ground in every direction: how high, how sure, and where exactly, as places of possible edges."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.ndimage

from roadscan.assets.edges.raster import HeightRaster
from roadscan.kernels.assets.step_filter import step_response, strips, thin

Float64 = npt.NDArray[np.float64]


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
    """Standard deviation of a step that no number of returns takes away: unevenness as long as the window."""
    around_m: float = 5.0
    """Width of the surroundings whose steps of the same direction tell the scatter that the lines do not show."""
    least_evidence: float = 2.0
    """Least step over its σ for a place to be looked at."""
    least_m: float = 0.015
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
        """The places at `rows`, indices (m,)."""
        return Places(*(column[rows] for column in self))


DEFAULT: Final = StepSettings()
_CLIPPED: Final = 4.0
_STILL: Final = 0.5
_PRIOR: Final = 0.06
_MEAN_SIZE: Final = math.sqrt(2.0 / math.pi)
"""Mean of the absolute value of a normal variable."""


def step_places(raster: HeightRaster, settings: StepSettings = DEFAULT) -> Places:
    """Places where the ground steps, in the order of rows and columns: a matched filter in every direction.

    Each side of the edge gets a line across it, of cells within `half_along_m` along and `across_m` across; the step is
    the difference of both lines at the edge, and its evidence the step over its σ, which grows with the scatter of the
    cells about the lines. A place is kept for the direction that tells most, where no neighbour across tells more.
    """
    shape = raster.count.shape
    best = np.zeros((4, *shape))
    slope_x, slope_y = raster.slopes()
    weight, level = raster.weight, float(np.nanmedian(raster.height_m)) if (raster.count > 0).any() else 0.0
    height = np.where(raster.count > 0, raster.height_m - level, 0.0)
    freedom, active = _freedom(raster, settings), _active(raster, settings)
    still = (raster.count > 0) & ~active
    strip, step, evidence = np.empty((3, *shape)), np.empty(shape), np.empty(shape)
    constants = (settings.slope_sigma**-2, settings.floor_m)
    limits = (settings.least_evidence, settings.least_m, settings.greatest_m)
    for k in range(settings.directions):
        angle = math.pi * k / settings.directions
        u, v = (math.cos(angle), math.sin(angle)), (math.sin(angle), -math.cos(angle))
        strips(weight, height, slope_x, slope_y, _along(u, settings, raster.cell_m), strip)
        slope = slope_x * v[0] + slope_y * v[1]
        step_response(strip, freedom, active, slope, _across(v, settings, raster.cell_m), constants, step, evidence)
        evidence /= _excess(evidence, still, settings, raster.cell_m)
        thin(step, evidence, float(k), v, limits, best)
    return _places(raster, best, settings)


def _along(u: tuple[float, float], settings: StepSettings, cell_m: float) -> Float64:
    """(k, 4) cells of a strip along u, as :func:`strips` wants them."""
    half = round(settings.half_along_m / cell_m)
    k = np.arange(-half, half + 1)
    cells = np.unique(np.column_stack([np.rint(k * u[0]), np.rint(k * u[1])]), axis=0)
    return np.column_stack([cells, cells * cell_m])


def _across(v: tuple[float, float], settings: StepSettings, cell_m: float) -> Float64:
    """(s, 3) strips of the right side, as :func:`step_response` wants them."""
    j = np.arange(1, round(settings.across_m / cell_m) + 1)
    return np.column_stack([np.rint(j * v[0]), np.rint(j * v[1]), j * cell_m])


def _freedom(raster: HeightRaster, settings: StepSettings) -> Float64:
    """(rows, columns) cells with a height in the window around each cell, any direction of it."""
    wide = round((settings.half_along_m + settings.across_m) / raster.cell_m) + 1
    share = scipy.ndimage.uniform_filter((raster.count > 0).astype(np.float64), wide, mode="constant")
    return np.asarray(share * 4.0 * settings.half_along_m * settings.across_m / raster.cell_m**2)


def _active(raster: HeightRaster, settings: StepSettings) -> npt.NDArray[np.bool_]:
    """Cells near which heights differ by as much as the least step."""
    wide, known = round(2.0 * settings.across_m / raster.cell_m) + 1, raster.count > 0
    top = scipy.ndimage.maximum_filter(np.where(known, raster.height_m, -np.inf), wide)
    bottom = scipy.ndimage.minimum_filter(np.where(known, raster.height_m, np.inf), wide)
    return np.asarray(np.isfinite(top) & (top - bottom >= settings.least_m))


def _excess(evidence: Float64, still: npt.NDArray[np.bool_], settings: StepSettings, cell_m: float) -> Float64:
    """(rows, columns) how much more than by chance steps of one direction scatter around each cell; 1 at least.

    Rings of a lidar whose lasers or sweeps disagree make steps along themselves everywhere around; a kerb is alone.
    still : cells without a step of any kind near.
    """
    wide = round(settings.around_m / cell_m)
    size = np.where(still, _STILL, np.minimum(np.abs(evidence), _CLIPPED))
    share = scipy.ndimage.uniform_filter((still | (evidence != 0.0)).astype(np.float64), wide, mode="constant")
    mean = (scipy.ndimage.uniform_filter(size, wide, mode="constant") + _PRIOR * _STILL) / (share + _PRIOR)
    return np.asarray(np.maximum(mean / _MEAN_SIZE, 1.0))


def _places(raster: HeightRaster, best: Float64, settings: StepSettings) -> Places:
    row, column = np.nonzero(best[0] > 0.0)
    evidence, step, direction, offset = best[:, row, column]
    angle = math.pi * direction / settings.directions
    ux, uy = np.cos(angle), np.sin(angle)
    x = raster.x_min_m + (column + 0.5 + offset * uy) * raster.cell_m
    y = raster.y_min_m + (row + 0.5 - offset * ux) * raster.cell_m
    turn = np.where(step >= 0.0, 1.0, -1.0)
    return Places(x, y, ux * turn, uy * turn, evidence, np.abs(step))
