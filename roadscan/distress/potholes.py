"""Potholes in a window of the surface: compact areas well below all of their surroundings.

1. *Blocks* (5 cm) of cells have mean heights, depths below what stands around, and ground
   (``distress/potholes.py``). Where what was measured ends before a hole's rim, the hole is not known.
2. *Outline*: cells that lie `edge_depth_m` or more below the ground, near a block that is `min_depth_m` deep, and not
   in a thin line; cells without a height between others (up to 2 cm) have the mean depth of those. Ground is bilinear
   between blocks.
3. *Rim*: what lies between the outline and the rim is less deep than `edge_depth_m`. Its area follows from how fast the
   area of the hole shrinks with depth, A(d) ~ (D − d)^k with the greatest depth D: of a hole with a paraboloid's form k
   is 1, of a cone 2, of one with upright walls 0; the mean depth over the outline's area determines it.
4. Each tile has the pieces of its cells; :func:`join_potholes` unites those that touch and judges the whole: area,
   depth, elongation (length over the diameter of the largest circle in it).

Blocks of a surface's cells: each one's depth below its surroundings, and the ground above it.

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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.extras import cv2
from roadscan.distress.kernels.crack_response import fill_holes
from roadscan.distress.settings import PotholeDetection, PotholeJoining
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


_THIN_M = 0.03
"""Parts narrower than this (m) are no pothole, such as cracks that meet it."""
_MOST_POWER = 2.0
"""Greatest exponent of the area's law: that of a cone, since nothing opens wider towards its rim."""
_ROUNDED = 1.5
"""Standard deviation of the area between outline and rim (a share of it): rounded rims reach farther than the power
law, by 1.1 to 2 times of it in the simulator's potholes of 30 to 100 mm."""


_HIDDEN_PER_M = 0.8
"""Floor that a wall hides per metre of depth (m/m): heads look at their lines under angles of 15 to 35 degrees."""
_MOST_HIDDEN_M = 0.15  # A wall hides no more of the floor than this (m).
_SIGMA_HIDDEN = 0.3
"""Standard deviation of the area hidden by walls, as a share of it."""
_SIGMA_OUTLINE_M = 0.003
"""Standard deviation of an outline's position (m): half a cell of 5 mm and the spot of a reading."""
_SIGMA_DEPTH = 0.03
"""Standard deviation of a greatest depth, as a share of it: the lowest of many cells lies below the floor."""
_SIGMA_GROUND_M = 0.002
"""Standard deviation of the ground above a hole (m): texture and unevenness of the surroundings."""


@dataclass(frozen=True)
class PotholePiece:
    """The part of a possible pothole that lies in one tile."""

    outline: Any
    """shapely Polygon along the sides of cells on the map (m)."""
    area_m2: float
    volume_m3: float
    depth_max_m: float
    """Greatest depth of a cell (m)."""
    block_depth_max_m: float
    """Greatest mean depth of a block below the lowest of its surroundings (m)."""
    edge_depth_m: float
    """Depth at which its outline runs (m)."""
    hidden_m2: float = 0.0
    """Part of its area without a reading, hidden from the sensor by a wall."""


@dataclass(frozen=True)
class Pothole:
    """A pothole, joined over all tiles."""

    area_m2: float
    """Inside the outline, where the hole is `edge_depth_m` or more deep."""
    sigma_area_m2: float
    hidden_m2: float
    """Part of that area without a reading, hidden by its walls."""
    rim_area_m2: float
    """Inside the rim, estimated."""
    sigma_rim_area_m2: float
    depth_mean_m: float
    depth_max_m: float
    sigma_depth_max_m: float
    volume_m3: float
    sigma_volume_m3: float
    length_m: float
    """Longer side of the smallest rectangle around it (m)."""
    breadth_m: float
    outline: Any
    """shapely Polygon on the map (m)."""
    pieces: Int64
    """Indices of the pieces that it consists of."""


def halo_cells(config: PotholeDetection, cell_m: float) -> int:
    """Returns the margin of smoothed cells that a window needs around those in which potholes are wanted."""
    return 3 * _thin_cells(cell_m) + _hidden_cells(cell_m)


def around_cells(config: PotholeDetection, cell_m: float) -> int:
    """Returns the margin of cells before smoothing that a window needs around those in which potholes are wanted."""
    return halo_cells(config, cell_m) + (blocks_around(config) + 2) * block_cells(config, cell_m)


def pothole_pieces(window: HeightWindow, config: PotholeDetection) -> list[PotholePiece]:
    """Returns the possible potholes in the window's inner cells."""
    blocks = Blocks.of(_measured_part(window, block_cells(config, window.cell_m)), config)
    if not (blocks.depth_m > 0.0).any():
        return []
    margin = halo_cells(config, window.cell_m)
    part = window.part(*((own.start - margin, own.stop + margin) for own in window.inner()))
    cells = _bridged(blocks.below_ground_m(part), _thin_cells(window.cell_m) // 3)
    hidden = _hidden(cells, config.edge_depth_m, window.cell_m)
    with np.errstate(invalid="ignore"):
        low = (cells >= config.edge_depth_m).astype(np.uint8)
    thin = _thin_cells(window.cell_m)
    low = cv2.morphologyEx(low, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (thin, thin)))
    own = np.zeros(low.shape, np.bool_)
    own[part.inner()] = low[part.inner()] > 0
    return _pieces(part, own, cells, hidden, blocks.of_cells(blocks.depth_m, part), config.edge_depth_m)


def _hidden(depth_m: Float64, edge_depth_m: float, cell_m: float) -> Bool:
    """Returns a mask of the cells without a reading that the walls of a hole hide; they get the hole's depth.

    A triangulating head sees no floor behind a wall: up to `_HIDDEN_PER_M` metres of it a metre of depth. Ground beside
    a hole is seen, so what has no reading there and touches the hole is a part of it.
    """
    void = np.isnan(depth_m)
    reach = np.where(depth_m >= edge_depth_m, np.minimum(_HIDDEN_PER_M * depth_m, _MOST_HIDDEN_M), 0.0)
    floor = np.where(depth_m >= edge_depth_m, depth_m, 0.0)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for _ in range(_hidden_cells(cell_m)):
        reach = np.where(void, np.maximum(reach, cv2.dilate(reach, cross) - cell_m), reach)
        floor = np.where(void & (reach > 0.0), np.maximum(floor, cv2.dilate(floor, cross)), floor)
    hidden = np.asarray(void & (reach > 0.0))
    depth_m[hidden] = floor[hidden]
    return hidden


def _measured_part(window: HeightWindow, size: int) -> HeightWindow:
    """Returns row and column slices of the whole blocks from the first to the last with a reading."""
    known = ~np.isnan(window.raw_m)
    spans = []
    for axis, first in ((1, window.first_row), (0, window.first_column)):
        at = np.flatnonzero(known.any(axis=axis)) + first
        low, high = (int(at[0]) // size, int(at[-1]) // size + 1) if at.size else (0, 0)
        spans.append((low * size - first, high * size - first))
    return window.part(*spans)


def _bridged(depth_m: Float64, reach: int) -> Float64:
    """Returns depths with gaps up to 2 · `reach` cells wide filled from their rims: such gaps are not ground."""
    known = (~np.isnan(depth_m)).astype(np.uint8)
    holes = cv2.morphologyEx(known, cv2.MORPH_CLOSE, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > known
    row, column = np.nonzero(holes[1:-1, 1:-1])
    fill_holes(depth_m, row + 1, column + 1, reach)
    return depth_m


def join_potholes(pieces: Sequence[PotholePiece], config: PotholeJoining) -> list[Pothole]:
    """Returns the potholes that the pieces of all tiles form, from south to north."""
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
    """Returns the diameter of the largest circle in an outline, holes filled (m): a strip along a kerb is narrow."""
    return 2.0 * float(shapely.maximum_inscribed_circle(shapely.Polygon(outline.exterior)).length)


def _pothole(outline: Any, pieces: Sequence[PotholePiece], own: Int64) -> Pothole:
    area, volume = sum(p.area_m2 for p in pieces), sum(p.volume_m3 for p in pieces)
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(outline))
    sides = sorted(float(np.hypot(*(corners[k + 1] - corners[k]))) for k in range(2))
    depth = max((p.depth_max_m for p in pieces), default=0.0)
    mean = volume / area if area else 0.0
    rim = rim_area_m2(area, mean, depth, max((p.edge_depth_m for p in pieces), default=0.0))
    hidden = sum(p.hidden_m2 for p in pieces)
    sigma_area = math.hypot(_SIGMA_OUTLINE_M * float(outline.length), _SIGMA_HIDDEN * hidden)
    sigma_rim = math.hypot(_ROUNDED * (rim - area), sigma_area)
    sigma_depth = math.hypot(_SIGMA_DEPTH * depth, _SIGMA_GROUND_M)
    sigma_volume = math.hypot(sigma_depth / max(depth, 1e-9) * volume, sigma_area * mean)
    return Pothole(
        area, sigma_area, hidden, rim, sigma_rim, mean, depth, sigma_depth, volume, sigma_volume, sides[1], sides[0],
        outline, own,
    )  # fmt: skip


def rim_area_m2(area_m2: float, depth_mean_m: float, depth_max_m: float, edge_depth_m: float) -> float:
    """Returns the area inside the rim of a hole (m²) from that inside its outline, which runs at `edge_depth_m`."""
    below, mean = depth_max_m - edge_depth_m, depth_mean_m - edge_depth_m
    if below <= 0.0 or mean <= 0.0:
        return area_m2
    power = min(max(below / mean - 1.0, 0.0), _MOST_POWER)
    return float(area_m2 * (depth_max_m / below) ** power)


def _hidden_cells(cell_m: float) -> int:
    return math.ceil(_MOST_HIDDEN_M / cell_m)


def _thin_cells(cell_m: float) -> int:
    return max(3, math.ceil(_THIN_M / cell_m) | 1)


def _pieces(
    window: HeightWindow, low: Bool, depth_m: Float64, hidden: Bool, block_depth_m: Float64, edge_depth_m: float
) -> list[PotholePiece]:
    from rasterio.features import shapes
    from scipy.ndimage import label

    numbers, count = label(low)
    if not count:
        return []
    outlines: dict[int, Any] = {}
    for shape, number in shapes(numbers.astype(np.int32), mask=low, connectivity=4):
        rings = [window.map_m(*np.array(ring, np.float64).T[::-1]) for ring in shape["coordinates"]]
        outlines[int(number)] = shapely.normalize(shapely.Polygon(rings[0], rings[1:]))
    own = numbers[low]
    area = np.bincount(own, minlength=count + 1) * window.cell_m**2
    unseen = np.bincount(own, hidden[low], count + 1) * window.cell_m**2
    steps = np.rint(depth_m[low] / HEIGHT_STEP_M)
    volume = np.bincount(own, steps, count + 1) * (HEIGHT_STEP_M * window.cell_m**2)
    deepest, block = np.zeros(count + 1), np.zeros(count + 1)
    np.maximum.at(deepest, own, depth_m[low])
    np.fmax.at(block, own, block_depth_m[low])
    return [
        PotholePiece(
            outlines[k],
            float(area[k]),
            float(volume[k]),
            float(deepest[k]),
            float(block[k]),
            edge_depth_m,
            float(unseen[k]),
        )
        for k in range(1, count + 1)
    ]
