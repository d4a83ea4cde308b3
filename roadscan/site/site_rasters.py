"""Rasters of a survey as square pictures of ever larger pixels: height, shaded relief, intensity, pavement.

Pictures of the finest levels come from cells and overviews of the tiles; a coarser one is the mean of the pixels of the
pictures below it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float32
from roadscan.core.errors import StoreError
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.strict import Strict
from roadscan.tiles.cells import overview_factors
from roadscan.tiles.product import LoadCells, TileSummary
from roadscan.tiles.products.hillshade import HillshadeOptions, shade
from roadscan.tiles.products.pavement import IntensityOptions, ShadedOptions

Raster: TypeAlias = Literal["height", "hillshade", "intensity", "pavement_intensity", "pavement_shaded"]
RASTERS: Final[tuple[Raster, ...]] = ("height", "hillshade", "intensity")
"""Rasters of every survey."""
PAVEMENT: Final[tuple[Raster, ...]] = ("pavement_intensity", "pavement_shaded")
"""Rasters of a survey with these products, in the greys of their settings."""

HEIGHT_STEP_M: Final = 1e-4  # unit of stored heights
COARSER: Final = 4
"""Pixels of a coarser level along the edge of one of the next."""
_COARSEST_PICTURES: Final = 4  # pictures of the coarsest level at the most
_WANTED_PX: Final = 512  # largest edge of a picture
_LEAST_PX: Final = 250  # smallest edge of a picture
_TILES_HELD: Final = 12  # tiles in memory


class Place(NamedTuple):
    """A picture: its level, and its index to the east and to the north, counted from the map's origin."""

    level: int
    column: int
    row: int


@dataclass(frozen=True)
class Pyramid:
    """Levels of pixels over the tiles of a survey."""

    grid: TileGrid
    tiles: tuple[TileId, ...]

    @cached_property
    def tile_px(self) -> int:
        """Pixels along an edge of a picture: a part or a multiple of a tile's cells, 512 or fewer."""
        edge = self.grid.cells_per_edge
        fits = [px for px in range(_WANTED_PX, _LEAST_PX - 1, -1) if edge % px == 0 or px % edge == 0]
        return fits[0] if fits else _WANTED_PX

    @cached_property
    def factors(self) -> tuple[int, ...]:
        """Cells along an edge of a pixel, by level: those of the tiles' overviews, and then ever four times as many,
        until few pictures hold the survey.
        """
        found = [1, *overview_factors(self.grid.cells_per_edge)]
        while len(self._lattice(found[-1])) > _COARSEST_PICTURES and found[-1] * self.grid.cell_m < 1e5:
            found.append(found[-1] * COARSER)
        return tuple(found)

    @property
    def stored_levels(self) -> int:
        """Number of levels that come from the tiles themselves."""
        return 1 + len(overview_factors(self.grid.cells_per_edge))

    def pixel_m(self, level: int) -> float:
        """Return the edge of a pixel (m)."""
        return self.factors[level] * self.grid.cell_m

    def places(self, level: int) -> npt.NDArray[np.int64]:
        """Return (n, 2) column and row of the pictures with a tile, tile by tile for the finest levels."""
        found = self._lattice(self.factors[level])
        per_tile = max(1, self.grid.cells_per_edge // (self.factors[level] * self.tile_px))
        order = np.lexsort((found[:, 0], found[:, 1], found[:, 0] // per_tile, found[:, 1] // per_tile))
        ordered: npt.NDArray[np.int64] = found[order]
        return ordered

    def holds(self, place: Place) -> bool:
        """Return True for a picture with a tile."""
        if place.level >= self.stored_levels:
            return (place.column, place.row) in self._coarse(place.level)
        edge_px = self.grid.cells_per_edge // self.factors[place.level]
        ends = [(first * self.tile_px, (first + 1) * self.tile_px - 1) for first in (place.column, place.row)]
        columns, rows = (range(low // edge_px, high // edge_px + 1) for low, high in ends)
        return any(TileId(c, r) in self._known for r in rows for c in columns)

    def runs(self, level: int) -> list[list[Any]]:
        """Return rows of pictures, each with first and last column of its runs."""
        found = self._lattice(self.factors[level])
        found = found[np.lexsort((found[:, 0], found[:, 1]))]
        column, row = found[:, 0], found[:, 1]
        starts = np.flatnonzero((np.diff(row, prepend=row[0] - 1) != 0) | (np.diff(column, prepend=column[0] - 2) != 1))
        ends = np.append(starts[1:], len(found)) - 1
        told: list[list[Any]] = []
        for y, first, last in zip(row[starts].tolist(), column[starts].tolist(), column[ends].tolist(), strict=True):
            if not told or told[-1][0] != y:
                told.append([y, []])
            told[-1][1].append([first, last])
        return told

    def tiles_in(self, level: int, place: Place) -> list[TileId]:
        """Return the tiles that a picture and the ring of pixels around it may touch."""
        edge_px = self.grid.cells_per_edge // self.factors[level]
        west, south = place.column * self.tile_px - 1, place.row * self.tile_px - 1
        columns = range(west // edge_px, (west + self.tile_px + 1) // edge_px + 1)
        rows = range(south // edge_px, (south + self.tile_px + 1) // edge_px + 1)
        return [TileId(c, r) for r in rows for c in columns if TileId(c, r) in self._known]

    @cached_property
    def _known(self) -> frozenset[TileId]:
        return frozenset(self.tiles)

    def _coarse(self, level: int) -> frozenset[tuple[int, int]]:
        """Return the pictures of a level above those of the tiles: few."""
        if level not in self._coarse_places:
            self._coarse_places[level] = frozenset((c, r) for c, r in self._lattice(self.factors[level]).tolist())
        return self._coarse_places[level]

    @cached_property
    def _coarse_places(self) -> dict[int, frozenset[tuple[int, int]]]:
        return {}

    def _lattice(self, factor: int) -> npt.NDArray[np.int64]:
        """Return (n, 2) pictures of pixels of this many cells, unordered."""
        size, edge = self.tile_px * factor, self.grid.cells_per_edge
        low = np.array(self.tiles, np.int64).reshape(-1, 2) * edge
        first, last = low // size, (low + edge - 1) // size
        reach = int((last - first).max(initial=0)) + 1
        shifts = [(c, r) for r in range(reach) for c in range(reach)]
        found = [np.minimum(first + shift, last) for shift in shifts]
        return np.unique(np.concatenate(found), axis=0)


@dataclass(frozen=True)
class Scales:
    """Conversion of values to integers: value = offset + step · number."""

    height_offset_m: float
    intensity_step: float

    @classmethod
    def of(cls, summaries: Iterable[TileSummary]) -> Scales:
        """Return scales: heights from a whole metre below the lowest, intensities up to twice the brightest mean."""
        known = list(summaries)
        lowest = min((one.height_min_m for one in known), default=0.0)
        brightest = max((one.intensity_mean for one in known), default=255.0)
        return cls(float(math.floor(lowest)) - 1.0, max(2.0 * brightest, 1.0) / 255.0)


class Window(NamedTuple):
    """Values of a picture and of a ring of pixels around it; NaN where no data is."""

    height_m: npt.NDArray[np.float64]
    """(px + 2, px + 2) north up."""
    intensity: Float32
    """(px + 2, px + 2)"""


class TileWindows:
    """Windows of the levels that come from the tiles, with a cache of a few tiles."""

    def __init__(self, pyramid: Pyramid, load: LoadCells) -> None:
        self._pyramid, self._load = pyramid, load
        self._tiles: dict[tuple[int, TileId], Window] = {}
        self._last: tuple[Place, Window] | None = None

    def window(self, place: Place) -> Window:
        """Return the values of a picture."""
        if self._last is not None and self._last[0] == place:
            return self._last[1]
        edge = self._pyramid.tile_px
        empty = Window(np.full((edge + 2, edge + 2), np.nan), np.full((edge + 2, edge + 2), np.nan, np.float32))
        for tile in self._pyramid.tiles_in(place.level, place):
            self._paste(empty, place, tile)
        self._last = (place, empty)
        return empty

    def _paste(self, window: Window, place: Place, tile: TileId) -> None:
        own, edge = self._tile(place.level, tile), self._pyramid.tile_px
        size = own.height_m.shape[0]
        left, low = tile.column * size - (place.column * edge - 1), tile.row * size - (place.row * edge - 1)
        top = edge + 2 - (low + size)
        across = slice(max(left, 0), min(left + size, edge + 2))
        down = slice(max(top, 0), min(top + size, edge + 2))
        part = (slice(down.start - top, down.stop - top), slice(across.start - left, across.stop - left))
        window.height_m[down, across] = own.height_m[part]
        window.intensity[down, across] = own.intensity[part]

    def _tile(self, level: int, tile: TileId) -> Window:
        """Return the pixels of a tile, north up, without a ring."""
        if (level, tile) in self._tiles:
            return self._tiles[level, tile]
        factor, size = self._pyramid.factors[level], self._pyramid.grid.cells_per_edge // self._pyramid.factors[level]
        height, intensity = np.full((size, size), np.nan), np.full((size, size), np.nan, np.float32)
        if factor == 1:
            cells = self._load(tile)
            if cells is None:
                raise StoreError(f"tile {tile} is listed and has no cells", change="run the survey again")
            places = (size - 1 - cells.row.astype(np.int64), cells.column)
            height[places], intensity[places] = cells.height_robust_m, cells.intensity_mean
        else:
            pixels = self._load.overview(tile, factor)
            if pixels is None:
                raise StoreError(f"tile {tile} is listed and has no cells", change="run the survey again")
            places = (size - 1 - pixels.row.astype(np.int64), pixels.column)
            height[places], intensity[places] = pixels.height_m, pixels.intensity
        while len(self._tiles) >= _TILES_HELD:
            self._tiles.pop(next(iter(self._tiles)))
        self._tiles[level, tile] = Window(height, intensity)
        return self._tiles[level, tile]


def write_picture(
    path: Path, raster: Raster, window: Window, pixel_m: float, scales: Scales, settings: Strict | None = None
) -> None:
    """Write a raster's picture as PNG: grey with opacity, or a height as a 24-bit number in red, green and blue.

    settings : of the product that a raster of the pavement is named after.
    """
    if raster in ("hillshade", "pavement_shaded"):
        light = settings if isinstance(settings, ShadedOptions) else HillshadeOptions()
        grey = shade(window.height_m, pixel_m, light)
        _write_grey(path, grey, grey > 0)
    elif raster == "pavement_intensity" and isinstance(settings, IntensityOptions):
        counts = window.intensity[1:-1, 1:-1].astype(np.float64)
        known = ~np.isnan(counts)
        steps = (np.where(known, counts, 0.0) - settings.black) * (254.0 / (settings.white - settings.black))
        _write_grey(path, np.floor(np.clip(steps, 0.0, 254.0) + 1.5).astype(np.uint8), known)
    elif raster == "intensity":
        inner = window.intensity[1:-1, 1:-1]
        known = ~np.isnan(inner)
        number = np.rint(np.where(known, inner, 0.0) / scales.intensity_step)
        _write_grey(path, np.minimum(number, 255.0).astype(np.uint8), known)
    else:
        inner_m = window.height_m[1:-1, 1:-1]
        known = ~np.isnan(inner_m)
        number = np.rint((np.where(known, inner_m, scales.height_offset_m) - scales.height_offset_m) / HEIGHT_STEP_M)
        _write_number(path, np.clip(number, 0, 2**24 - 1).astype(np.uint32), known)


def coarser_picture(
    path: Path, raster: Raster, below: Callable[[Place], Path | None], place: Place, tile_px: int
) -> None:
    """Write a picture from those of the next finer level in it: the mean of each four by four known pixels."""
    from PIL import Image

    bands = 4 if raster == "height" else 2
    whole = np.zeros((COARSER * tile_px, COARSER * tile_px, bands), np.uint8)
    for right in range(COARSER):
        for up in range(COARSER):
            finer = below(Place(place.level - 1, COARSER * place.column + right, COARSER * place.row + up))
            if finer is None:
                continue
            with Image.open(finer, formats=("PNG",)) as image:
                top = (COARSER - 1 - up) * tile_px
                whole[top : top + tile_px, right * tile_px : (right + 1) * tile_px] = np.asarray(image)
    blocks = whole.reshape(tile_px, COARSER, tile_px, COARSER, bands)
    known = blocks[..., -1] > 0
    count = known.sum(axis=(1, 3))
    number = blocks[..., 0].astype(np.int64)
    if bands == 4:
        number = (number << 16) | (blocks[..., 1].astype(np.int64) << 8) | blocks[..., 2]
    mean = np.rint((number * known).sum(axis=(1, 3)) / np.maximum(count, 1))
    if bands == 4:
        _write_number(path, mean.astype(np.uint32), count > 0)
    else:
        _write_grey(path, mean.astype(np.uint8), count > 0)


def _write_grey(path: Path, grey: npt.NDArray[np.uint8], known: npt.NDArray[np.bool_]) -> None:
    opacity = np.where(known, 255, 0).astype(np.uint8)
    _save(path, [np.where(known, grey, 0).astype(np.uint8), opacity])


def _write_number(path: Path, number: npt.NDArray[np.uint32], known: npt.NDArray[np.bool_]) -> None:
    held = np.where(known, number, 0)
    bytes_of = [((held >> shift) & 255).astype(np.uint8) for shift in (16, 8, 0)]
    _save(path, [*bytes_of, np.where(known, 255, 0).astype(np.uint8)])


def _save(path: Path, bands: Sequence[npt.NDArray[np.uint8]]) -> None:
    from PIL import Image

    Image.fromarray(np.stack(bands, axis=-1)).save(path, format="PNG", compress_level=6)
