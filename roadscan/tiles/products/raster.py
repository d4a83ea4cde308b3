"""Layout of raster products (north up, in the CRS's units, cloud-optimised GeoTIFF), and the quantities they show."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Self, get_args

import numpy as np
import numpy.typing as npt

from roadscan.core.crs import MapFrame
from roadscan.core.grid import QUANTA_PER_M, TileGrid, TileId
from roadscan.store.codecs.cog import BLOCK, About, Band, write_sparse_cog
from roadscan.tiles.cells import CellValues, TileCells
from roadscan.tiles.product import ProductContext

if TYPE_CHECKING:
    from rasterio.transform import Affine
    from rasterio.windows import Window


@dataclass(frozen=True)
class CellBox:
    """A rectangle of cells, numbered over the whole map: cell 0 starts at the map's origin."""

    west: int
    """Column of the first cell."""
    south: int
    """Row of the first cell."""
    width: int
    height: int
    edges_m: tuple[float, float] | None = None
    """Edges of a cell (m), east and north, of a grid other than the map's; None for the context's cells."""

    @classmethod
    def around(cls, tiles: Iterable[TileId], grid: TileGrid) -> Self:
        """Return the smallest box that contains all cells of `tiles` (at least one)."""
        columns, rows = zip(*tiles, strict=True)
        n, west, south = grid.cells_per_edge, min(columns), min(rows)
        return cls(west * n, south * n, (max(columns) + 1 - west) * n, (max(rows) + 1 - south) * n)

    @property
    def north(self) -> int:
        """Row after the last cell."""
        return self.south + self.height

    def grown(self, cells: int) -> CellBox:
        """Return the box with `cells` more on every side."""
        return CellBox(
            self.west - cells, self.south - cells, self.width + 2 * cells, self.height + 2 * cells, self.edges_m
        )

    def transform(self, context: ProductContext) -> Affine:
        """Return the transform from (column, row) from the north-west corner to the map, in the CRS's unit."""
        from rasterio.transform import Affine

        if self.edges_m is not None:
            unit_m, (east, north) = context.map.horizontal_unit_m, self.edges_m
            return Affine(
                east / unit_m, 0.0, self.west * east / unit_m, 0.0, -north / unit_m, self.north * north / unit_m
            )
        unit_quanta = QUANTA_PER_M * context.map.horizontal_unit_m
        cell = context.grid.cell_quanta
        pixel = cell / unit_quanta
        return Affine(pixel, 0.0, self.west * cell / unit_quanta, 0.0, -pixel, self.north * cell / unit_quanta)

    def tile_window(self, tile: TileId, edge: int) -> tuple[int, int, int, int]:
        """Return columns and rows (first, end, first, end) of a tile of `edge` squared cells, cut off at the box."""
        left = tile.column * edge - self.west
        top = self.north - (tile.row + 1) * edge
        return max(left, 0), min(left + edge, self.width), max(top, 0), min(top + edge, self.height)

    def block(self, column: int, row: int) -> Window:
        """Return the window of a block by its column and row, counted from the north-west."""
        from rasterio.windows import Window

        left, top = column * BLOCK, row * BLOCK
        return Window(left, top, min(BLOCK, self.width - left), min(BLOCK, self.height - top))

    def blocks(self) -> Iterator[Window]:
        """Yield the windows of the blocks that cover the raster, row by row."""
        for row in range(-(-self.height // BLOCK)):
            for column in range(-(-self.width // BLOCK)):
                yield self.block(column, row)

    def blocks_under(self, tiles: Iterable[TileId], edge: int) -> list[Window]:
        """Yield the windows of the blocks that share a cell with one of `tiles`, row by row."""
        found: set[tuple[int, int]] = set()
        for tile in tiles:
            x0, x1, y0, y1 = self.tile_window(tile, edge)
            found |= {(y, x) for y in range(y0 // BLOCK, -(-y1 // BLOCK)) for x in range(x0 // BLOCK, -(-x1 // BLOCK))}
        return [self.block(column, row) for row, column in sorted(found)]


@functools.lru_cache(maxsize=16)
def height_unit(frame: MapFrame) -> str:
    """Return the name of the unit in which heights are written."""
    return frame.vertical_unit


def cell_image(cells: TileCells | CellValues, values: npt.NDArray[Any], dtype: str) -> npt.NDArray[Any]:
    """Return a (rows, columns) image of one value (n,) a cell, north up, NaN where no point lies."""
    edge = cells.cells_per_edge
    image = np.full((edge, edge), np.nan, dtype=dtype)
    image[edge - 1 - cells.row.astype(np.int64), cells.column] = values
    return image


def paste_tile(raster: Any, box: CellBox, tile: TileId, image: npt.NDArray[Any]) -> None:
    """Write a tile's (rows, columns) image into the first band of `raster`, as far as `box` reaches."""
    from rasterio.windows import Window

    edge = image.shape[0]
    left, top = tile.column * edge - box.west, box.north - (tile.row + 1) * edge
    x0, x1, y0, y1 = box.tile_window(tile, edge)
    if x0 < x1 and y0 < y1:
        raster.write(image[y0 - top : y1 - top, x0 - left : x1 - left], 1, window=Window(x0, y0, x1 - x0, y1 - y0))


@dataclass(frozen=True)
class SparseRaster:
    """Properties of a one-band raster whose pixels are written later."""

    box: CellBox
    band: Band
    dtype: str
    nodata: float
    context: ProductContext

    @contextlib.contextmanager
    def scratch(self, path: Path) -> Iterator[Any]:
        """Yield a raster in the file `path`, removed at the end; blocks never written take no room."""
        try:
            with self._create(path) as raster:
                yield raster
        finally:
            path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def cog(self, path: Path) -> Iterator[Any]:
        """Yield a raster to be filled; at the end it becomes a cloud-optimised GeoTIFF at `path`.

        Overviews halve the raster until it is small; each of their pixels is the mean of those below it that hold a
        value. The same pixels give the same bytes.
        """
        import rasterio

        scratch = path.with_name(path.name + ".scratch")
        try:
            with self._create(scratch) as raster:
                yield raster
            with rasterio.open(scratch) as raster:
                blocks = list(self._stored_blocks(raster))
                write_sparse_cog(
                    path,
                    (self.box.width, self.box.height),
                    self.dtype,
                    ((block.col_off, block.row_off, raster.read(1, window=block)) for block in blocks),
                    [block.flatten() for block in blocks],
                    about(self.box.transform(self.context), [self.band], self.context),
                )
        finally:
            scratch.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _create(self, path: Path) -> Iterator[Any]:
        import rasterio

        layout = {"tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK, "sparse_ok": True, "bigtiff": "IF_SAFER"}
        profile = {
            "driver": "GTiff",
            "width": self.box.width,
            "height": self.box.height,
            "count": 1,
            "dtype": self.dtype,
            "nodata": self.nodata,
            "transform": self.box.transform(self.context),
            "compress": "DEFLATE",
            "zlevel": 1,
        }
        with rasterio.open(path, "w+", **profile, **layout) as raster:
            yield raster

    def _stored_blocks(self, raster: Any) -> Iterator[Window]:
        """Return the windows of the blocks that were written."""
        for block in self.box.blocks():
            place = f"BLOCK_OFFSET_{block.col_off // BLOCK}_{block.row_off // BLOCK}"
            if raster.get_tag_item(place, "TIFF", bidx=1) is not None:
                yield block


def about(
    transform: Affine,
    bands: Sequence[Band],
    context: ProductContext,
    tile: TileId | None = None,
    more: Sequence[tuple[str, str]] = (),
) -> About:
    """Return the metadata of a raster; `more`: names and values of further metadata."""
    height = "local" if context.map.is_local else context.map.height
    items = [("ROADSCAN_SURVEY", context.survey_id), ("ROADSCAN_HEIGHT", height)]
    if tile is not None:
        items.append(("ROADSCAN_TILE", str(tile)))
    return About(context.map, transform, tuple(bands), context.date, (*items, *more))


Quantity = Literal["height", "intensity", "count", "height_std"]
"""Robust height, mean intensity, number of points, standard deviation of the heights."""

QUANTITIES: Final[tuple[Quantity, ...]] = get_args(Quantity)


def band_of(quantity: Quantity, context: ProductContext) -> Band:
    """Return the band that shows a quantity; heights are in the unit of the map's heights."""
    unit = height_unit(context.map)
    return {
        "height": Band("height", unit),
        "intensity": Band("intensity", "digital number"),
        "count": Band("count", "points"),
        "height_std": Band("height standard deviation", unit),
    }[quantity]


COLUMNS: Final[dict[Quantity, str]] = {
    "height": "height_robust_m",
    "intensity": "intensity_mean",
    "count": "count",
    "height_std": "height_std_m",
}
"""The column of cells that each quantity draws."""


def in_unit(quantity: Quantity, values: npt.NDArray[Any], context: ProductContext) -> npt.NDArray[Any]:
    """Return (n,) values of a quantity's column in the unit of its band."""
    return values.astype(np.float64) / context.map.vertical_unit_m if quantity in ("height", "height_std") else values
