"""Cross-sections of bare earth: heights on lines across a reference line, at stations along it."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from roadscan.assets.scene import GroundModel
from roadscan.compute.array_types import Float64

Bools = npt.NDArray[np.bool_]


class CrossSections(NamedTuple):
    """Bare earth at (stations, offsets); heights and σ are NaN where it is not known."""

    station_m: Float64
    """(s,) along the reference line."""
    offset_m: Float64
    """(k,) to the right of it."""
    x_m: Float64
    """(s, k) place in the frame of the ground model."""
    y_m: Float64
    height_m: Float64
    seen: Bools
    """True where ground was seen, False where its height is interpolated or not known."""
    sigma_m: Float64
    """1 σ of the heights: the noise of the returns where they were seen; elsewhere it grows with the distance."""

    def joined(self, other: Self) -> Self:
        """Same sections from two ground models, such as those of neighbouring tiles: seen heights first, then
        interpolated ones, each from this model before the other.
        """
        better = np.isnan(self.height_m) | (other.seen & ~self.seen)
        return self._replace(
            height_m=np.where(better, other.height_m, self.height_m),
            seen=np.where(better, other.seen, self.seen),
            sigma_m=np.where(better, other.sigma_m, self.sigma_m),
        )


def cross_sections(ground: GroundModel, line_xy_m: Float64, station_m: Float64, offset_m: Float64) -> CrossSections:
    """Returns bare earth on lines square to a reference line.

    Parameters
    ----------
    line_xy_m : (n, 2) the reference line in the frame of the ground model, in the direction of its stations, which
        count from its first point (m).
    station_m : (s,) where the sections stand; beyond the line's ends nothing is known.
    offset_m : (k,) to the right of the line.
    """
    place, right = stations(line_xy_m, station_m)
    x = place[:, :1] + right[:, :1] * offset_m
    y = place[:, 1:] + right[:, 1:] * offset_m
    row, column = cells(ground, x, y)
    on_raster = inside(ground, x, y)
    height = np.full(x.shape, np.nan)
    height[on_raster] = ground.height_at(x[on_raster], y[on_raster])
    known = np.isfinite(height)
    seen = known & ground.seen[row, column]
    sigma = np.full(height.shape, np.nan)
    if ground.sigma_m is not None:
        sigma[known] = ground.sigma_m[row, column][known]
    return CrossSections(np.asarray(station_m, np.float64), np.asarray(offset_m, np.float64), x, y, height, seen, sigma)


def stations(line_xy_m: Float64, station_m: Float64) -> tuple[Float64, Float64]:
    """Returns places (s, 2) at stations of a line (n, 2), and unit vectors (s, 2) to its right; NaN beyond its ends.

    The direction at a station is that of the line from half a metre before to half a metre behind it, so that it does
    not jump at the line's vertices.
    """
    steps = np.hypot(*np.diff(line_xy_m, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    beyond = (station_m < 0.0) | (station_m > along[-1])
    near = np.clip(station_m, 0.0, along[-1])
    at = [np.column_stack([np.interp(s, along, line_xy_m[:, k]) for k in (0, 1)]) for s in _about(near)]
    way = at[2] - at[0]
    way /= np.hypot(way[:, 0], way[:, 1])[:, None]
    place = np.where(beyond[:, None], np.nan, at[1])
    return place, np.column_stack([way[:, 1], -way[:, 0]])


def _about(station_m: Float64) -> tuple[Float64, Float64, Float64]:
    return station_m - 0.5, station_m, station_m + 0.5


def inside(ground: GroundModel, x_m: Float64, y_m: Float64) -> Bools:
    """Returns a mask of the places on the raster."""
    rows, columns = ground.height_m.shape
    u, v = (x_m - ground.x_min_m) / ground.cell_m, (y_m - ground.y_min_m) / ground.cell_m
    return np.asarray((u >= 0.0) & (u < columns) & (v >= 0.0) & (v < rows))


def cells(ground: GroundModel, x_m: Float64, y_m: Float64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Returns row and column of places, clamped to the raster."""
    rows, columns = ground.height_m.shape
    row = np.nan_to_num((y_m - ground.y_min_m) / ground.cell_m, nan=0.0)
    column = np.nan_to_num((x_m - ground.x_min_m) / ground.cell_m, nan=0.0)
    return (
        np.clip(np.floor(row), 0, rows - 1).astype(np.int64),
        np.clip(np.floor(column), 0, columns - 1).astype(np.int64),
    )
