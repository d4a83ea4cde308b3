"""Heights of the surveyed ground around pictures: rasters for rays to meet, and planes through the finest cells."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about
from roadscan.core.grid import Bounds, TileGrid, TileId
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store
from roadscan.tiles.cells import overview_factors, read_cells, read_overview
from roadscan.tiles.tasks.tile_figures import summary_of
from roadscan.tiles.tasks.tile_plan import OVERVIEWS, TILE

T = TypeVar("T")

_COARSE_M: Final = 0.21
"""Largest edge (m) of the pixels that rays are first compared with."""
_KEPT_TILES: Final = 48  # Tiles whose coarse heights stay in memory.
_KEPT_CELLS: Final = 6  # Tiles whose cells stay in memory: up to 100 MB each.
_RADII_M: Final = (0.06, 0.12, 0.25, 0.5, 1.0)
"""A plane goes through the cells within the smallest of these radii that holds enough of them (m)."""
_LEAST_CELLS: Final = 12  # A plane needs so many cells …
_LEAST_SPREAD: Final = 0.2
"""… whose standard deviation in their narrowest direction is at least this share of the radius (0.5 evenly spread)."""
_OUTLYING: Final = 4.0
"""Cells farther from the plane than so many times their scatter take no part in it."""


class Raster(NamedTuple):
    """Coarse heights of a part of the map."""

    heights_m: Float64
    """(rows, columns) from south to north and west to east; NaN where nothing is known."""
    corner_m: Float64
    """(2,) easting and northing of its south-western corner."""
    edge_m: float


class Plane(NamedTuple):
    """The ground near a place."""

    height_m: float
    """At the place."""
    slope: Float64
    """(2,) rise of the plane by easting and northing."""
    sigma_m: float
    """1 σ of the height of a point of the ground about the plane, that of the plane included."""
    common_sigma_m: float
    """1 σ of the heights of the whole tile, from the poses that measured it; 0 where nothing states it."""


@dataclass(frozen=True, eq=False)
class Ground:
    """The cells of a survey, read tile by tile."""

    store: Store
    grid: TileGrid
    cells: Mapping[TileId, OutputRecord]
    overviews: Mapping[TileId, OutputRecord]
    _coarse: OrderedDict[TileId, tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Float64]]
    _fine: OrderedDict[TileId, Float64]

    @classmethod
    def of(cls, store: Store, grid: TileGrid, manifest: Manifest) -> Ground:
        """Return the ground of a survey's tiles; nothing is read."""
        cells = {TileId.parse(r.unit): r for r in manifest.of(TILE).values() if r.path}
        known = {TileId.parse(r.unit): r for r in manifest.of(OVERVIEWS).values() if r.path}
        overviews = {tile: r for tile, r in known.items() if tile in cells and cells[tile].key == r.key}
        return cls.from_records(store, grid, cells, overviews)

    @classmethod
    def from_records(
        cls,
        store: Store,
        grid: TileGrid,
        cells: Mapping[TileId, OutputRecord],
        overviews: Mapping[TileId, OutputRecord],
    ) -> Ground:
        """Return the ground of some tiles; nothing is read."""
        return cls(store, grid, cells, overviews, OrderedDict(), OrderedDict())

    @property
    def coarse_factor(self) -> int:
        """Cells along an edge of a coarse pixel."""
        fits = [f for f in overview_factors(self.grid.cells_per_edge) if f * self.grid.cell_m <= _COARSE_M]
        return max(fits, default=1)

    def tiles_in(self, box: Bounds) -> list[TileId]:
        """Return the tiles with cells that meet a box, by row and column."""
        low, high = (self.grid.tile_at(*c) for c in ((box.easting_min_m, box.northing_min_m),
                                                     (box.easting_max_m, box.northing_max_m)))  # fmt: skip
        rows, columns = range(low.row, high.row + 1), range(low.column, high.column + 1)
        if len(rows) * len(columns) > len(self.cells):
            found = [t for t in self.cells if t.row in rows and t.column in columns]
            return sorted(found, key=lambda t: (t.row, t.column))
        return [t for r in rows for c in columns if (t := TileId(c, r)) in self.cells]

    def raster(self, box: Bounds) -> Raster:
        """Return coarse heights of the tiles that meet a box of the map."""
        tiles = self.tiles_in(box)
        factor = self.coarse_factor
        edge, per_tile = factor * self.grid.cell_m, self.grid.cells_per_edge // factor
        if not tiles:
            return Raster(np.full((1, 1), np.nan), np.array([box.easting_min_m, box.northing_min_m]), edge)
        first = min(t.column for t in tiles), min(t.row for t in tiles)
        last = max(t.column for t in tiles), max(t.row for t in tiles)
        shape = (last[1] - first[1] + 1) * per_tile, (last[0] - first[0] + 1) * per_tile
        heights = np.full(shape, np.nan)
        for tile in tiles:
            row, column, height = _kept(self._coarse, tile, self._read_coarse, _KEPT_TILES)
            heights[(tile.row - first[1]) * per_tile + row, (tile.column - first[0]) * per_tile + column] = height
        corner = self.grid.bounds(TileId(*first))
        return Raster(heights, np.array([corner.easting_min_m, corner.northing_min_m]), edge)

    def plane(self, easting_m: float, northing_m: float) -> Plane | None:
        """Return the plane through the cells nearest to a place; None where there are too few of them."""
        place = np.array([easting_m, northing_m])
        for radius in _RADII_M:
            near = self._near(place, radius)
            found = _plane(near - [*place, 0.0], radius)
            if found is not None:
                tile = self.grid.tile_at(easting_m, northing_m)
                record = self.cells.get(tile)
                summary = None if record is None else summary_of(record)
                common = None if summary is None else summary.sigma_down_m
                return Plane(found[0], found[1], found[2], common or 0.0)
        return None

    def height_m(self, easting_m: float, northing_m: float, radius_m: float) -> float:
        """Return the median height of the coarse pixels within a radius of a place; NaN where there are none (m)."""
        box = Bounds(easting_m - radius_m, northing_m - radius_m, easting_m + radius_m, northing_m + radius_m)
        raster = self.raster(box)
        row, column = np.nonzero(np.isfinite(raster.heights_m))
        east = raster.corner_m[0] + (column + 0.5) * raster.edge_m - easting_m
        north = raster.corner_m[1] + (row + 0.5) * raster.edge_m - northing_m
        held = raster.heights_m[row, column][np.hypot(east, north) <= radius_m]
        return float(np.median(held)) if held.size else math.nan

    def _near(self, place: Float64, radius_m: float) -> Float64:
        """Return centres and heights (k, 3) of the cells within a radius of a place."""
        low, high = place - radius_m, place + radius_m
        parts = [np.zeros((0, 3))]
        for tile in self.tiles_in(Bounds(float(low[0]), float(low[1]), float(high[0]), float(high[1]))):
            points = _kept(self._fine, tile, self._read_fine, _KEPT_CELLS)
            first, last = np.searchsorted(points[:, 1], [low[1], high[1]])
            own = points[first:last]
            parts.append(own[np.hypot(own[:, 0] - place[0], own[:, 1] - place[1]) <= radius_m])
        return np.concatenate(parts)

    def _read_fine(self, tile: TileId) -> Float64:
        cells, corner = read_cells(self.store, self.cells[tile], self.grid.cells_per_edge), self.grid.bounds(tile)
        known = np.isfinite(cells.height_robust_m)
        east = corner.easting_min_m + (cells.column[known] + 0.5) * self.grid.cell_m
        north = corner.northing_min_m + (cells.row[known] + 0.5) * self.grid.cell_m
        return np.column_stack([east, north, cells.height_robust_m[known]])  # by row: from south to north

    def _read_coarse(self, tile: TileId) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Float64]:
        factor = self.coarse_factor
        if factor > 1 and tile in self.overviews:
            level = read_overview(self.store, self.overviews[tile], factor)
            return level.row.astype(np.int64), level.column.astype(np.int64), level.height_m
        cells = read_cells(self.store, self.cells[tile], self.grid.cells_per_edge)
        known = np.isfinite(cells.height_robust_m)
        row, column = (a[known].astype(np.int64) // factor for a in (cells.row, cells.column))
        width = self.grid.cells_per_edge // factor
        pixel, index = np.unique(row * width + column, return_inverse=True)
        height = np.bincount(index, cells.height_robust_m[known]) / np.bincount(index)
        return pixel // width, pixel % width, height


def _plane(near: Float64, radius_m: float) -> tuple[float, Float64, float] | None:
    """Return height and slope at the origin of the plane through points (k, 3), and σ of a point about it."""
    if len(near) < _LEAST_CELLS:
        return None
    spread = np.linalg.eigvalsh(np.cov(near[:, :2].T))[0]
    if spread < (_LEAST_SPREAD * radius_m) ** 2:
        return None
    level = float(np.median(near[:, 2]))
    design, heights = np.column_stack([np.ones(len(near)), near[:, :2]]), near[:, 2] - level
    used = np.ones(len(near), np.bool_)
    for _ in range(3):
        values = np.linalg.lstsq(design[used], heights[used], rcond=None)[0]
        residual = heights - design @ values
        scatter = max(scatter_about(residual[used], 0.0), 1e-6)
        used = np.abs(residual) <= _OUTLYING * scatter
        if used.sum() < _LEAST_CELLS:
            return None
    cofactor = np.linalg.inv(design[used].T @ design[used])
    return float(values[0]) + level, np.asarray(values[1:], np.float64), float(scatter * np.sqrt(1.0 + cofactor[0, 0]))


def _kept(held: OrderedDict[TileId, T], tile: TileId, read: Callable[[TileId], T], most: int) -> T:
    """Return what is known of a tile, read where it is not in memory."""
    if tile not in held:
        held[tile] = read(tile)
    held.move_to_end(tile)
    while len(held) > most:
        held.popitem(last=False)
    return held[tile]
