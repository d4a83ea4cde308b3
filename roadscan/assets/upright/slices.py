"""Compact components of horizontal slices: the cross-sections of shafts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.bins import in_bins
from roadscan.assets.kernels.slices import fill_slices, label_slices, owners
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Float64, Int64

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
def usable(scene: Scene) -> npt.NDArray[np.bool_]:
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
    cells = _not_zero(counts.reshape(-1))
    labels, boxes = np.zeros(counts.shape, np.int32), np.empty((cells.size, 5), np.int32)
    found = label_slices(counts, cells, labels, boxes, np.empty(max(cells.size, 1), np.int64))
    boxes = boxes[:found]
    widest = round(WIDEST_M / CELL_M)
    compact = (boxes[:, 2] - boxes[:, 1] < widest) & (boxes[:, 4] - boxes[:, 3] < widest)
    number = np.full(found + 1, -1, np.int32)
    number[1:][compact] = np.arange(int(compact.sum()), dtype=np.int32)
    owner, sums = np.empty(len(returns), np.int32), np.zeros((int(compact.sum()), 3))
    owners(returns.x_m, returns.y_m, cell, labels.reshape(-1), number, owner, sums)
    x, y = sums[:, 1] / sums[:, 0], sums[:, 2] / sums[:, 0]
    return Slices((window.x_min_m, window.y_min_m), counts, boxes[compact, 0].astype(np.int64), x, y, owner)


def _not_zero(counts: npt.NDArray[np.uint16]) -> Int64:
    """Returns numbers of the cells with returns, ascending: most are empty, so four are tested together."""
    some = counts[: counts.size // 4 * 4].view(np.uint64)
    cells = (4 * np.flatnonzero(some)[:, None] + np.arange(4)).reshape(-1)
    cells = np.concatenate([cells, np.arange(4 * some.size, counts.size)])
    return np.asarray(cells[counts[cells] > 0], np.int64)


def around(slices: Slices, x_m: float, y_m: float, reach_m: float) -> npt.NDArray[Any]:
    """Returns counts (slices, r, c) of the cells within `reach_m` of a place, a square of them."""
    column, row = int((x_m - slices.corner_m[0]) / CELL_M), int((y_m - slices.corner_m[1]) / CELL_M)
    reach = round(reach_m / CELL_M)
    return slices.counts[
        :, max(row - reach, 0) : max(row + reach + 1, 0), max(column - reach, 0) : max(column + reach + 1, 0)
    ]
