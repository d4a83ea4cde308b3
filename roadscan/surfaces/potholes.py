"""Potholes of a window of surface: where it lies well below the ground around, in a compact form.

1. *Blocks* (5 cm) of cells, counted from the map's origin, have mean heights.
2. *Ground* of a block: the 60 % quantile of the means of opposite blocks within `window_m`, in each of four sectors.
   The mean of two opposite blocks is the plane's height here, whatever its slope, and a hole pulls few of them down.
   A block that lies `min_depth_m` below the lowest sector is in a pothole: along a rut there is a sector as low, and
   along a kerb as well but for the 0.15 m beside it, which is a long strip (4). A hole that reaches into that strip is
   lost with it. Within 0.3 m of the border of what was measured no pothole begins.
3. *Outline*: cells that lie `edge_depth_m` or more below the ground, in the neighbourhood of such a block, and not in a
   thin line; cells without a height between others (up to 2 cm) have the mean depth of those. Ground is here the lowest
   of the sectors whose means agree, because seen across its rim a hole has no ground; it is bilinear between blocks.
4. Each tile has the pieces of its own cells; :func:`join_potholes` unites those that touch and judges the whole: area,
   depth, elongation (length over the diameter of the largest circle in it: a rut and the strip beside a kerb are deep
   as well, but long).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import shapely
from rasterio.features import shapes
from scipy.ndimage import label

from roadscan.kernels.ground import ground
from roadscan.kernels.valleys import fill_holes
from roadscan.model.distress import PotholeDetection, PotholeJoining
from roadscan.surfaces.heights import HEIGHT_STEP_M, HeightWindow

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
UInt8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

_SECTORS = 4
_SLACK_M = 0.002
_KNOWN_PAIRS = 0.3
_NEAR_BLOCKS = 5
"""A hole's cells lie at most this far from a block that is deep enough."""
_KNOWN_CELLS = 0.25
_THIN_M = 0.03
"""Parts narrower than this are no pothole (cracks that meet it)."""


@dataclass(frozen=True)
class PotholePiece:
    """The part of a pothole in a tile, or one that may be none."""

    outline: Any
    """shapely Polygon along the sides of cells on the map (m)."""
    area_m2: float
    volume_m3: float
    depth_max_m: float
    """Of a cell (m)."""
    block_depth_max_m: float
    """Of a block, that is the mean of its cells, below the lowest ground around (m)."""


@dataclass(frozen=True)
class Pothole:
    """A pothole, over all tiles."""

    area_m2: float
    depth_mean_m: float
    depth_max_m: float
    volume_m3: float
    length_m: float
    """Longer side of the smallest rectangle around it (m)."""
    breadth_m: float
    outline: Any
    """shapely Polygon on the map (m)."""
    pieces: Int64
    """Which pieces it is made of."""


def halo_cells(config: PotholeDetection, cell_m: float) -> int:
    """Cells that a window needs beyond those of which potholes are wanted."""
    block = _block_cells(config, cell_m)
    return block * (_rings(config) + _NEAR_BLOCKS + 2) + 2 * _thin_cells(cell_m)


def pothole_pieces(window: HeightWindow, config: PotholeDetection) -> list[PotholePiece]:
    """What may be potholes, of the window's inner cells."""
    blocks = _Blocks.of(window, config)
    depth = blocks.lowest_m - blocks.height_m
    with np.errstate(invalid="ignore"):
        seeds = depth >= config.min_depth_m
    if not seeds.any():
        return []
    square = np.ones((2 * _NEAR_BLOCKS + 1, 2 * _NEAR_BLOCKS + 1), np.uint8)
    near = cv2.dilate(seeds.astype(np.uint8), square).astype(np.bool_)
    cells = _bridged(blocks.depth_m(window), _thin_cells(window.cell_m) // 3)
    with np.errstate(invalid="ignore"):
        low = (cells >= config.edge_depth_m) & blocks.of_cells(near, window, absent=0)
    thin = _thin_cells(window.cell_m)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (thin, thin))
    low = cv2.morphologyEx(low.astype(np.uint8), cv2.MORPH_OPEN, disc).astype(np.bool_)
    inner = np.zeros_like(low)
    halo = window.halo
    inner[halo : low.shape[0] - halo, halo : low.shape[1] - halo] = True
    return _pieces(window, low & inner, cells, blocks.of_cells(depth, window, absent=np.nan))


def _bridged(depth_m: Float64, reach: int) -> Float64:
    """Depths with holes up to 2 · `reach` cells wide filled from their rims: a cell without a reading is no ground."""
    known = (~np.isnan(depth_m)).astype(np.uint8)
    holes = cv2.morphologyEx(known, cv2.MORPH_CLOSE, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > known
    row, column = np.nonzero(holes[1:-1, 1:-1])
    fill_holes(depth_m, row + 1, column + 1, reach)
    return depth_m


def join_potholes(pieces: Sequence[PotholePiece], config: PotholeJoining) -> list[Pothole]:
    """Potholes of the pieces of all tiles, from south to north."""
    if not pieces:
        return []
    outlines = [one.outline for one in pieces]
    united = shapely.get_parts(shapely.union_all(outlines))
    inside = [one.representative_point() for one in outlines]
    whole, piece = shapely.STRtree(inside).query(united, predicate="intersects")
    found = []
    for k, outline in enumerate(united):
        own = np.sort(piece[whole == k])
        one = _pothole(outline, [pieces[p] for p in own.tolist()], own)
        deep = max((pieces[p].block_depth_max_m for p in own.tolist()), default=0.0) >= config.min_depth_m
        compact = one.length_m <= config.max_elongation * _widest_m(outline)
        if deep and one.area_m2 >= config.min_area_m2 and compact:
            found.append(one)
    return sorted(found, key=lambda p: p.outline.bounds[1::-1])


def _widest_m(outline: Any) -> float:
    """Diameter of the largest circle in an outline, islands counted: a strip along a bent kerb is narrow."""
    return 2.0 * float(shapely.maximum_inscribed_circle(shapely.Polygon(outline.exterior)).length)


def _pothole(outline: Any, pieces: Sequence[PotholePiece], own: Int64) -> Pothole:
    area, volume = sum(p.area_m2 for p in pieces), sum(p.volume_m3 for p in pieces)
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(outline))
    sides = sorted(float(np.hypot(*(corners[k + 1] - corners[k]))) for k in range(2))
    depth = max((p.depth_max_m for p in pieces), default=0.0)
    return Pothole(area, volume / area if area else 0.0, depth, volume, sides[1], sides[0], outline, own)


@dataclass(frozen=True)
class _Blocks:
    """Whole blocks of a window; arrays (rows, columns) of blocks, NaN where too little was measured."""

    size: int
    """Cells along a block's edge."""
    skipped: tuple[int, int]
    """Rows and columns of cells before the first whole block."""
    height_m: Float64
    ground_m: Float64
    lowest_m: Float64
    """The ground seen in that direction in which it is lowest."""

    @classmethod
    def of(cls, window: HeightWindow, config: PotholeDetection) -> _Blocks:
        """Mean heights and ground."""
        size = _block_cells(config, window.cell_m)
        skipped = (-window.first_row % size, -window.first_column % size)
        heights = window.height_m[skipped[0] :, skipped[1] :]
        rows, columns = heights.shape[0] // size, heights.shape[1] // size
        cells = heights[: rows * size, : columns * size].reshape(rows, size, columns, size)
        known = ~np.isnan(cells)
        steps = np.where(known, np.rint(np.where(known, cells, 0.0) / HEIGHT_STEP_M), 0.0).astype(np.int64)
        total, count = steps.sum(axis=(1, 3)), known.sum(axis=(1, 3))
        enough = count >= _KNOWN_CELLS * size * size
        mean = np.where(enough, total * HEIGHT_STEP_M / np.maximum(count, 1), np.nan)
        agreed, lowest = np.empty(mean.shape), np.empty(mean.shape)
        away = _opposite(_rings(config))
        ground(mean, away, round(_KNOWN_PAIRS * away.shape[1]), _SLACK_M, agreed, lowest)
        return cls(size, skipped, mean, agreed, lowest)

    def of_cells(self, values: npt.NDArray[Any], window: HeightWindow, *, absent: float) -> npt.NDArray[Any]:
        """Each cell the value of its block."""
        rows, columns = (
            (np.arange(n) - skipped) // self.size for n, skipped in zip(window.raw_m.shape, self.skipped, strict=True)
        )
        padded = np.pad(values, 1, constant_values=absent)
        return np.asarray(
            padded[np.ix_(*(np.clip(k + 1, 0, n - 1) for k, n in zip((rows, columns), padded.shape, strict=True)))]
        )

    def depth_m(self, window: HeightWindow) -> Float64:
        """Depth of each cell below the ground, bilinear between the middles of blocks."""
        padded = np.pad(self.ground_m, 1, constant_values=np.nan)
        low, share = [], []
        for n, skipped, limit in zip(window.raw_m.shape, self.skipped, padded.shape, strict=True):
            place = (np.arange(n) - skipped + 0.5) / self.size + 0.5
            first = np.clip(np.floor(place), 0, limit - 2)
            low.append(first.astype(np.int64))
            share.append(np.clip(place - first, 0.0, 1.0))
        (i, j), (u, v) = low, (share[0][:, None], share[1][None, :])
        level = (1 - u) * (1 - v) * padded[np.ix_(i, j)] + (1 - u) * v * padded[np.ix_(i, j + 1)]
        level = level + (u * (1 - v) * padded[np.ix_(i + 1, j)] + u * v * padded[np.ix_(i + 1, j + 1)])
        nearest = self.of_cells(self.ground_m, window, absent=np.nan)
        return np.asarray(np.where(np.isnan(level), nearest, level) - window.height_m)


def _block_cells(config: PotholeDetection, cell_m: float) -> int:
    return max(1, round(config.block_m / cell_m))


def _rings(config: PotholeDetection) -> int:
    """Blocks from the middle of the window to its border."""
    return max(1, round(config.window_m / config.block_m))


def _thin_cells(cell_m: float) -> int:
    return max(3, math.ceil(_THIN_M / cell_m) | 1)


@functools.cache
def _opposite(rings: int) -> Int64:
    """(4, p, 2) rows and columns to one of each pair of opposite blocks, by sectors of 45 degrees."""
    step = np.arange(-rings, rings + 1)
    row, column = (a.ravel() for a in np.meshgrid(step, step, indexing="ij"))
    half = (row > 0) | ((row == 0) & (column > 0))
    away = np.stack([row[half], column[half]], axis=-1)
    sector = np.floor(np.arctan2(away[:, 0], away[:, 1]) / (np.pi / _SECTORS) + 0.5).astype(np.int64) % _SECTORS
    fewest = np.bincount(sector).min()
    nearest = np.argsort((away**2).sum(axis=1), kind="stable")
    kept = [away[nearest[sector[nearest] == k][:fewest]] for k in range(_SECTORS)]
    return np.ascontiguousarray(np.stack(kept), dtype=np.int64)


def _pieces(window: HeightWindow, low: Bool, depth_m: Float64, block_depth_m: Float64) -> list[PotholePiece]:
    numbers, count = label(low)
    if not count:
        return []
    outlines: dict[int, Any] = {}
    for shape, number in shapes(numbers.astype(np.int32), mask=low, connectivity=4):
        rings = [window.map_m(*np.array(ring, np.float64).T[::-1]) for ring in shape["coordinates"]]
        outlines[int(number)] = shapely.normalize(shapely.Polygon(rings[0], rings[1:]))
    own = numbers[low]
    area = np.bincount(own, minlength=count + 1) * window.cell_m**2
    steps = np.rint(depth_m[low] / HEIGHT_STEP_M)
    volume = np.bincount(own, steps, count + 1) * (HEIGHT_STEP_M * window.cell_m**2)
    deepest, block = np.zeros(count + 1), np.zeros(count + 1)
    np.maximum.at(deepest, own, depth_m[low])
    np.fmax.at(block, own, block_depth_m[low])
    return [
        PotholePiece(outlines[k], float(area[k]), float(volume[k]), float(deepest[k]), float(block[k]))
        for k in range(1, count + 1)
    ]
