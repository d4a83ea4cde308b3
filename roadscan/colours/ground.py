"""Heights of the road under an orthophoto: the lowest of the tiles' cells, without what stands on it, made smooth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.grid import Bounds
from roadscan.tiles.cells import TileCells

HALO_M: Final = 8.0
"""How far beyond a tile its cells tell of the road in it (m)."""
_LOWEST: Final = 0.1
"""Share of the heights in a cell of the ground that may lie below its lowest height: stray readings."""
_WINDOWS_M: Final = (1.0, 2.0, 4.0, 7.0)
"""Edges of the windows (m) within which something has to stand on the ground: a car lies within the largest
(progressive morphological filter, Zhang et al. 2003)."""
_SLOPE: Final = 0.12
"""Steepest ground (m a m) that is no thing."""
_LEAST_THING_M: Final = 0.08
"""Least height (m) of a thing: a kerb is ground."""
_SPREAD_M: Final = 0.06
"""Readings up to so far above the lowest height (m) are of the ground."""
_SMOOTH_M: Final = 0.35
"""1 σ (m) of the weights with which planes are fitted (moving least squares; Lancaster and Salkauskas 1981)."""
_LEAST_WEIGHT: Final = 0.02
"""Least share of known cells, by weight, where there is ground: holes up to a metre are closed."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights at the nodes of a lattice, row by row from the south, and their slopes."""

    origin_m: tuple[float, float]
    """Easting and northing of the first node."""
    step_m: float
    height_m: Float64
    """(rows, columns), NaN where there is no ground."""
    east: Float64
    """(rows, columns) slope to the east."""
    north: Float64

    def at(self, easting_m: Float64, northing_m: Float64) -> tuple[Float64, npt.NDArray[np.float32]]:
        """Returns heights (n,) at places of the map, NaN without ground, and unit normals (n, 3)."""
        from scipy.ndimage import map_coordinates

        place = np.stack([(northing_m - self.origin_m[1]) / self.step_m, (easting_m - self.origin_m[0]) / self.step_m])
        height, east, north = (
            map_coordinates(values, place, order=1, mode="nearest") for values in (self.height_m, self.east, self.north)
        )
        normal = np.stack([-east, -north, np.ones_like(east)], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        return np.asarray(height), np.asarray(normal, np.float32)


def ground_of(cells: Sequence[tuple[TileCells, Bounds]], box: Bounds, step_m: float) -> Ground | None:
    """Returns the ground of a box of the map, with the halo around it, from cells of tiles with their boxes."""
    low = (box.easting_min_m - HALO_M, box.northing_min_m - HALO_M)
    columns, rows = (
        round((high - first + HALO_M) / step_m)
        for high, first in zip((box.easting_max_m, box.northing_max_m), low, strict=True)
    )
    at, height = _readings(cells, low, step_m, (rows, columns))
    if not height.size:
        return None
    order = np.lexsort((height, at))
    at, height = at[order], height[order]
    first = np.flatnonzero(np.append(True, np.diff(at) != 0))
    count = np.diff(np.append(first, at.size))
    lowest = np.full(rows * columns, np.nan)
    lowest[at[first]] = height[first + (_LOWEST * count).astype(np.int64)]
    standing = _standing(lowest.reshape(rows, columns), step_m).ravel()
    of_ground = ~standing[at] & (height <= lowest[at] + _SPREAD_M) & (height >= lowest[at] - _SPREAD_M)
    number = np.bincount(at[of_ground], minlength=rows * columns).reshape(rows, columns)
    total = np.bincount(at[of_ground], height[of_ground], rows * columns).reshape(rows, columns)
    with np.errstate(invalid="ignore"):
        mean = total / number
    return _fitted(mean, low, step_m)


def _readings(
    cells: Sequence[tuple[TileCells, Bounds]], low: tuple[float, float], step_m: float, shape: tuple[int, int]
) -> tuple[npt.NDArray[np.int64], Float64]:
    """Returns the lattice cell (n,) and the height (n,) of each cell of the tiles that lies in the lattice."""
    places, heights = [np.zeros(0, np.int64)], [np.zeros(0)]
    for one, box in cells:
        edge_m = (box.easting_max_m - box.easting_min_m) / one.cells_per_edge
        column = np.floor((box.easting_min_m + (one.column + 0.5) * edge_m - low[0]) / step_m).astype(np.int64)
        row = np.floor((box.northing_min_m + (one.row + 0.5) * edge_m - low[1]) / step_m).astype(np.int64)
        inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        places.append(row[inside] * shape[1] + column[inside])
        heights.append(one.height_robust_m[inside])
    return np.concatenate(places), np.concatenate(heights)


def _standing(lowest_m: Float64, step_m: float) -> npt.NDArray[np.bool_]:
    """Returns a mask (rows, columns) of cells in which something stands on the ground."""
    from scipy.ndimage import distance_transform_edt, grey_opening

    known = ~np.isnan(lowest_m)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = lowest_m[tuple(nearest)]
    standing = ~known
    for window_m in _WINDOWS_M:
        size = 2 * round(window_m / step_m / 2) + 1
        opened = grey_opening(filled, (size, size), mode="nearest")
        standing |= filled - opened > _LEAST_THING_M + _SLOPE * window_m
    return np.asarray(standing)


def _fitted(mean_m: Float64, low: tuple[float, float], step_m: float) -> Ground | None:
    """Returns planes fitted around each cell of the lattice: their heights in its middle, and their slopes."""
    from scipy.ndimage import gaussian_filter

    known = ~np.isnan(mean_m)
    if not known.any():
        return None
    level = float(np.median(mean_m[known]))
    z = np.where(known, mean_m - level, 0.0)
    y, x = np.indices(mean_m.shape, dtype=np.float64)
    weight = known.astype(np.float64)

    def around(values: Float64) -> Float64:
        return np.asarray(gaussian_filter(values, _SMOOTH_M / step_m, mode="constant", truncate=3.0))

    w = around(weight)
    enough = w >= _LEAST_WEIGHT
    safe = np.maximum(w, 1e-12)
    mx, my, mz = (around(weight * v) / safe for v in (x, y, z))
    xx, yy, xy = (
        around(weight * a * b) / safe - ma * mb for a, b, ma, mb in ((x, x, mx, mx), (y, y, my, my), (x, y, mx, my))
    )
    xz, yz = (around(weight * a * z) / safe - ma * mz for a, ma in ((x, mx), (y, my)))
    steady = xx * yy - xy * xy + 1e-3 * (xx + yy) + 1e-9  # a little stiffness where cells lie in a line
    east, north = (xz * yy - yz * xy) / steady, (yz * xx - xz * xy) / steady
    height = np.where(enough, level + mz + east * (x - mx) + north * (y - my), np.nan)
    origin = (low[0] + 0.5 * step_m, low[1] + 0.5 * step_m)
    return Ground(origin, step_m, height, np.where(enough, east, 0.0) / step_m, np.where(enough, north, 0.0) / step_m)
