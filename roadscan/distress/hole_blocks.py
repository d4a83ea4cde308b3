"""Blocks of a surface's cells: each one's depth below its surroundings, and the ground above it.

1. *Slope* of the ground: the median of those nearby, one for each square of five blocks. Neither holes nor kerbs, which
   are in few of the pairs of blocks compared, pull at it.
2. *Depth*: in 16 directions, the highest mean of three blocks in a row above a plane of that slope, as far as the
   largest hole is wide; the lowest of these 16 less the block. A kerb makes no hole, because away from it nothing
   stands higher, nor does a rut, which is open along the road; a hole beside a kerb or in a rut stays one. Most of a
   hole's walls are steep somewhere (`min_wall_slope`): hollows of an uneven road are not.
3. *Ground*: each ray meets the rim where it gets as high as the lowest of the 16, less a share of the depth, and
   continues flat. The ground above the block is that height, extrapolated by the median slope beyond the rim (a crown
   is no hollow); the mean of all rays by distance, without those that end on higher ground, such as that behind a kerb.

Blocks are counted from the map's origin, and each depends on those within a stated distance alone
(:func:`blocks_around`), in whole numbers of `HEIGHT_STEP_M`: a block has the same bits in every window.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.extras import cv2
from roadscan.distress.settings import PotholeDetection
from roadscan.surface.heights import HEIGHT_STEP_M, HeightWindow
from roadscan.surface.kernels.ground import depths, grounds, slopes

_RAYS = 16  # Rays from each block, evenly spread over the circle.
_BEYOND_M = 0.25
"""Rays reach this much (m) beyond the largest hole, to see its rim."""
_WALL_BLOCKS = 3  # Blocks over whose length the least slope of a wall is measured.
_NEAR_SHARE = 0.3
"""A hole's cells lie at most this share of the largest hole's size from a block that is deep enough."""
_APART_M = 0.2
"""The slope is measured between blocks this far apart (m)."""
_NODE_BLOCKS = 5
"""Edge (blocks) of the squares that share one slope."""
_KNOWN_CELLS = 0.25  # A block has a height if at least this share of its cells was measured.


def block_cells(config: PotholeDetection, cell_m: float) -> int:
    """Returns the number of cells along the edge of a block."""
    return max(1, round(config.block_m / cell_m))


def blocks_around(config: PotholeDetection) -> int:
    """Returns how many blocks to each side the ground above a cell depends on."""
    return 1 + _near_blocks(config) + _NODE_BLOCKS // 2 + _ray_blocks(config)


@dataclass(frozen=True)
class Blocks:
    """Whole blocks of a window; arrays (rows, columns) of blocks, NaN where too little was measured."""

    size: int
    """Number of cells along a block's edge."""
    first: tuple[int, int]
    """Row and column on the map of the first block."""
    height_m: Float64
    """Mean of the cells before smoothing."""
    slope_m: Float64
    """(rows, columns, 2) rise of the ground over one block, towards north and east."""
    depth_m: Float64
    """Depth below the lowest of the surroundings; NaN where it is less than `min_depth_m` or the walls are gentle."""
    config: PotholeDetection

    @classmethod
    def of(cls, window: HeightWindow, config: PotholeDetection) -> Blocks:
        """Returns the blocks of a window with mean heights, slopes and depths."""
        size = block_cells(config, window.cell_m)
        skipped = (-window.first_row % size, -window.first_column % size)
        first = (window.first_row + skipped[0]) // size, (window.first_column + skipped[1]) // size
        height = _means(window.raw_m[skipped[0] :, skipped[1] :], size)
        block_m = size * window.cell_m
        slope = _slopes(height, first, block_m, config)
        depth = np.empty(height.shape)
        wall_m = config.min_wall_slope * _WALL_BLOCKS * block_m
        depths(height, slope, _rays(_ray_blocks(config)), config.min_depth_m, wall_m, depth)
        return cls(size, first, height, slope, depth, config)

    def of_cells(self, values: npt.NDArray[Any], window: HeightWindow) -> npt.NDArray[Any]:
        """Returns for each cell of a window the value of its block, NaN beyond the blocks."""
        padded, places = self._placed(values, window)
        block = [np.clip(cells // self.size + 1, 0, m - 1) for cells, m in places]
        return np.asarray(padded[np.ix_(*block)])

    def below_ground_m(self, window: HeightWindow) -> Float64:
        """Returns each cell's depth below the ground, bilinear between block centres; NaN where no hole is near."""
        ground = self._ground_m()
        padded, places = self._placed(ground, window)
        low, share = [], []
        for cells, limit in places:
            place = (cells + 0.5) / self.size + 0.5
            whole = np.clip(np.floor(place), 0, limit - 2)
            low.append(whole.astype(np.int64))
            share.append(np.clip(place - whole, 0.0, 1.0))
        (i, j), (u, v) = low, (share[0][:, None], share[1][None, :])
        level = (1 - u) * (1 - v) * padded[np.ix_(i, j)] + (1 - u) * v * padded[np.ix_(i, j + 1)]
        level = level + (u * (1 - v) * padded[np.ix_(i + 1, j)] + u * v * padded[np.ix_(i + 1, j + 1)])
        nearest = self.of_cells(ground, window)
        return np.asarray(np.where(np.isnan(level), nearest, level) - window.height_m)

    def _placed(self, values: npt.NDArray[Any], window: HeightWindow) -> tuple[Float64, list[tuple[Int64, int]]]:
        """Returns values with a border of NaN and, by axis, the window's cells from the first block and their count."""
        padded = np.pad(values, 1, constant_values=np.nan)
        starts = zip(window.raw_m.shape, (window.first_row, window.first_column), self.first, padded.shape, strict=True)
        return padded, [(np.arange(n) + (cell - first * self.size), m) for n, cell, first, m in starts]

    def _ground_m(self) -> Float64:
        """Returns the ground of the blocks near deep ones."""
        side = 2 * _near_blocks(self.config) + 1
        near = cv2.dilate((self.depth_m > 0.0).astype(np.uint8), np.ones((side, side), np.uint8))
        row, column = (a.astype(np.int64) for a in np.nonzero(near))
        found = np.empty(row.size)
        grounds(self.height_m, self.slope_m, _rays(_ray_blocks(self.config)), row, column, found)
        ground = np.full(self.height_m.shape, np.nan)
        ground[row, column] = found
        return ground


def _means(heights: Float64, size: int) -> Float64:
    """Returns the mean heights of whole blocks."""
    rows, columns = heights.shape[0] // size, heights.shape[1] // size
    cells = heights[: rows * size, : columns * size].reshape(rows, size, columns, size)
    known = ~np.isnan(cells)
    steps = np.rint(np.where(known, cells, 0.0) / HEIGHT_STEP_M)
    total, count = steps.sum(axis=(1, 3)), known.sum(axis=(1, 3))  # a sum of whole numbers: exact in any order
    enough = count >= _KNOWN_CELLS * size * size
    return np.asarray(np.where(enough, total * HEIGHT_STEP_M / np.maximum(count, 1), np.nan))


def _slopes(height: Float64, first: tuple[int, int], block_m: float, config: PotholeDetection) -> Float64:
    """Returns (rows, columns, 2) rise over a block: one a square of `_NODE_BLOCKS`, counted from the map's origin."""
    low = [k // _NODE_BLOCKS for k in first]
    count = [(k + n - 1) // _NODE_BLOCKS - k // _NODE_BLOCKS + 1 for k, n in zip(first, height.shape, strict=True)]
    node = [
        (np.arange(n) + k) * _NODE_BLOCKS + _NODE_BLOCKS // 2 - f for k, n, f in zip(low, count, first, strict=True)
    ]
    row, column = (a.ravel() for a in np.meshgrid(*node, indexing="ij"))
    apart = max(1, round(_APART_M / block_m))
    found = np.empty((row.size, 2))
    slopes(height, row, column, _ray_blocks(config), apart * np.eye(2, dtype=np.int64), apart * block_m, found)
    own = [(np.arange(n) + f) // _NODE_BLOCKS - k for n, f, k in zip(height.shape, first, low, strict=True)]
    return np.ascontiguousarray(found.reshape(*count, 2)[np.ix_(*own)] * block_m)


def _ray_blocks(config: PotholeDetection) -> int:
    return max(4, math.ceil((config.max_size_m + _BEYOND_M) / config.block_m))


def _near_blocks(config: PotholeDetection) -> int:
    return math.ceil(_NEAR_SHARE * config.max_size_m / config.block_m) + 2


@functools.cache
def _rays(blocks: int) -> Int64:
    """Returns (16, n, 2) rows and columns of the blocks along each ray, outwards."""
    angle = np.arange(_RAYS) * (2 * np.pi / _RAYS)
    step = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    return np.ascontiguousarray(np.rint(step[:, None] * np.arange(1, blocks + 1)[None, :, None]), dtype=np.int64)
