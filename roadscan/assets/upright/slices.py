"""Horizontal slices of a scene: compact components, the cross-sections of shafts; and an index of returns by place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.bins import in_bins
from roadscan.assets.kernels.buckets import count_buckets, fill_buckets
from roadscan.assets.kernels.shafts import fill_slices
from roadscan.assets.scene import Box, Returns, Scene, once_a_scene
from roadscan.compute.array_types import Bool, Float64, Int64


def touching(flat: Int64, steps: Iterable[int]) -> npt.NDArray[np.int32]:
    """Returns the number (n,) of the connected piece of each cell.

    Parameters
    ----------
    flat : (n,) numbers of the cells, ascending, each once: rows and layers apart so far that no step leaves them.
    steps : differences of the numbers of cells that touch, those that are positive.
    """
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    edges = [np.empty((0, 2), np.int64)]
    for step in steps:
        at = np.searchsorted(flat, flat + step)
        met = (at < flat.size) & (flat[np.minimum(at, flat.size - 1)] == flat + step)
        edges.append(np.column_stack([np.flatnonzero(met), at[met]]))
    joined = np.concatenate(edges)
    graph = sparse.coo_matrix((np.ones(len(joined), np.int8), (joined[:, 0], joined[:, 1])), shape=(flat.size,) * 2)
    label: npt.NDArray[np.int32] = connected_components(graph, directed=False)[1]
    return label


CELL_M: Final = 0.1  # Edge of a cell (m).
SLICE_M: Final = 0.2  # Height of a slice (m).
LOWEST_M: Final = 0.2
"""Height above the ground at which slices start (m): below are kerbs, grass and the ground's noise."""
SLICES: Final = 60
"""Number of slices: up to 12.2 m above the ground."""
WIDEST_M: Final = 1.1
"""Greatest width of a component that can be the slice of a shaft (m)."""
SET_APART: Final = (
    classes.GROUND, classes.ROAD, classes.SIDEWALK, classes.MARKING, classes.KERB, classes.LOW_NOISE,
    classes.HIGH_NOISE, classes.VEHICLE, classes.PERSON,
)  # fmt: skip
"""Classes of which nothing upright consists."""


@dataclass(frozen=True, eq=False)
class Slices:
    """Returns of a scene in horizontal slices of 0.2 m, parallel to the ground, on cells of 0.1 m."""

    corner_m: tuple[float, float]
    """Plan coordinates of cell (0, 0)."""
    counts: npt.NDArray[np.uint16]
    """(slices, rows, columns) returns."""
    level: Int64
    """(k,) slice of each compact component."""
    x_m: Float64
    """(k,) mean of its returns; y likewise."""
    y_m: Float64
    owner: npt.NDArray[np.int32]
    """(n,) compact component of each return of the scene; −1: none."""

    def members(self) -> tuple[Int64, Int64]:
        """Returns the returns sorted by their component, and the beginning of each component (k + 1,)."""
        starts, order = in_bins(self.owner, self.level.size)
        return order, starts


@once_a_scene
def usable(scene: Scene) -> Bool:
    """Returns a mask (n,) of the returns that may belong to something upright: no ground, vehicles, people or noise."""
    lookup = np.ones(256, np.bool_)
    lookup[list(SET_APART)] = False
    return lookup[scene.classes] & np.isfinite(scene.above_ground_m)


@once_a_scene
def usable_above_m(scene: Scene) -> npt.NDArray[np.float32]:
    """Height (n,) above the ground of the returns that may belong to something upright; NaN of all others."""
    return np.where(usable(scene), scene.above_ground_m, np.float32(np.nan))


@once_a_scene
def slices_of(scene: Scene) -> Slices:
    """Returns the slices of a scene, and their compact components: cells that touch, at most 1.1 m wide."""
    returns, window = scene.returns, scene.extent
    columns = int(np.ceil((window.x_max_m - window.x_min_m) / CELL_M - 1e-9))
    rows = int(np.ceil((window.y_max_m - window.y_min_m) / CELL_M - 1e-9))
    counts = np.zeros((SLICES, rows, columns), np.uint16)
    cell = np.empty(len(returns), np.int64)
    corner = np.array([window.x_min_m, window.y_min_m, LOWEST_M])
    fill_slices(returns.x_m, returns.y_m, usable_above_m(scene), corner, CELL_M, SLICE_M, counts, cell)
    held = np.flatnonzero(cell >= 0)
    cells, own = np.unique(cell[held], return_inverse=True)
    level, rest = np.divmod(cells, rows * columns)
    row, column = np.divmod(rest, columns)
    wide = columns + 1  # a free cell beside each row, and a free row beside each slice
    label = touching((level * (rows + 1) + row) * wide + column, (1, wide - 1, wide, wide + 1))
    starts, order = in_bins(label, int(label.max(initial=-1)) + 1)
    first = starts[:-1]
    span = [np.maximum.reduceat(v[order], first) - np.minimum.reduceat(v[order], first) for v in (row, column)]
    compact = np.maximum(*span) < round(WIDEST_M / CELL_M)
    number = np.where(compact, np.cumsum(compact) - 1, -1)
    owner = np.full(len(returns), -1, np.int32)
    owner[held] = number[label[own]]
    held = np.flatnonzero(owner >= 0)
    count = np.bincount(owner[held], minlength=int(compact.sum()))
    x, y = (np.bincount(owner[held], v[held], count.size) / count for v in (returns.x_m, returns.y_m))
    return Slices((window.x_min_m, window.y_min_m), counts, level[order[first]][compact], x, y, owner)


def around(slices: Slices, x_m: float, y_m: float, reach_m: float) -> npt.NDArray[Any]:
    """Returns counts (slices, r, c) of the cells within `reach_m` of a place, a square of them."""
    column, row = int((x_m - slices.corner_m[0]) / CELL_M), int((y_m - slices.corner_m[1]) / CELL_M)
    reach = round(reach_m / CELL_M)
    return slices.counts[
        :, max(row - reach, 0) : max(row + reach + 1, 0), max(column - reach, 0) : max(column + reach + 1, 0)
    ]


_CELL_M: Final = 1.0  # Edge of a cell (m).


@dataclass(frozen=True, eq=False)
class Places:
    """Returns that may belong to something upright, sorted by cells of a metre."""

    window: Box
    returns: Returns
    """Those of the scene, which is not referenced: the cache would keep it in memory."""
    rows: Int64
    x_m: Float64
    """Places of these rows."""
    y_m: Float64
    starts: Int64
    shape: tuple[int, int]

    def within(self, x_m: float, y_m: float, reach_m: float) -> Int64:
        """Returns the returns within reach of a place, seen from above, in order of their number."""
        window = self.window
        u, v = (x_m - window.x_min_m) / _CELL_M, (y_m - window.y_min_m) / _CELL_M
        reach = reach_m / _CELL_M
        first, last = max(int(u - reach), 0), min(int(u + reach), self.shape[1] - 1)
        parts = [np.zeros(0, np.int64)]
        for row in range(max(int(v - reach), 0), min(int(v + reach), self.shape[0] - 1) + 1):
            if last >= first:
                begin = row * self.shape[1]
                some = slice(self.starts[begin + first], self.starts[begin + last + 1])
                near = (self.x_m[some] - x_m) ** 2 + (self.y_m[some] - y_m) ** 2 <= reach_m**2
                parts.append(self.rows[some][near])
        return np.sort(np.concatenate(parts))


@once_a_scene
def places_of(scene: Scene) -> Places:
    """Returns the index of a scene's returns without ground, vehicles, people and noise."""
    window, returns = scene.window, scene.returns
    rows = int(np.ceil((window.y_max_m - window.y_min_m) / _CELL_M - 1e-9))
    columns = int(np.ceil((window.x_max_m - window.x_min_m) / _CELL_M - 1e-9))
    corner = np.array([window.x_min_m, window.y_min_m])
    counted = usable(scene)
    starts = np.zeros(rows * columns + 1, np.int64)
    count_buckets(returns.x_m, returns.y_m, counted, corner, _CELL_M, (rows, columns), starts)
    order = np.empty(int(starts[-1]), np.int64)
    fill_buckets(returns.x_m, returns.y_m, counted, corner, _CELL_M, (rows, columns), starts.copy(), order)
    return Places(window, returns, order, returns.x_m[order], returns.y_m[order], starts, (rows, columns))


@once_a_scene
def ground_light(scene: Scene) -> float:
    """Returns the median intensity of the ground of the survey; infinite where there is none."""
    light = scene.statistics.known("ground_light")
    if light is not None:
        return light
    ground = (scene.classes == classes.GROUND) | (scene.classes == classes.ROAD)
    return float(np.median(scene.returns.intensity[ground])) if ground.any() else float("inf")
