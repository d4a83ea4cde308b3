"""The `surface` files of many tiles as one raster: the position of each tile in it, and its pixels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError, StoreError
from roadscan.core.grid import Bounds
from roadscan.core.ids import TileId
from roadscan.core.strict import Strict
from roadscan.surface.products.surface import SurfaceBand, SurfaceOptions, surface_band
from roadscan.surface.window import GridWindow
from roadscan.tiles.product import LoadCells, ProductContext
from roadscan.tiles.products.raster import CellBox

if TYPE_CHECKING:
    from rasterio.windows import Window

READS: Final = ("surface",)

_SHEET_CELLS: Final = 20_000  # Default edge of a sheet (cells).


def need_bands(product: str, wanted: Iterable[SurfaceBand], read: Mapping[str, Strict]) -> None:
    """Raise :class:`ConfigError` unless the files of `surface` contain the bands of which a product is made."""
    held = SurfaceOptions.parse(read[READS[0]].model_dump()).bands
    missing = [band for band in wanted if band not in held]
    if missing:
        raise ConfigError(
            f"'{product}' is made of the band {missing[0]} of 'surface', which has the bands {', '.join(held)}",
            expected=f"a surface with {missing[0]}",
            change=f'add "{missing[0]}" to products.options.surface.bands',
        )


def cells_m(context: ProductContext) -> tuple[float, float]:
    """Returns the edges of a cell of the surface, east and north (m)."""
    if context.surface_cell_m is None:
        raise ConfigError("the survey has no reconstructed surface", change="add the section [surface]")
    return context.surface_cell_m


def sheet_edge_m(stated_m: float | None, context: ProductContext) -> float:
    """Returns the edge of a sheet (m): as stated, or 20,000 cells of the surface."""
    return stated_m or _SHEET_CELLS * max(cells_m(context))


def surface_box(tiles: Iterable[TileId], context: ProductContext) -> CellBox:
    """Returns the smallest box of the surface's cells that covers `tiles` (at least one)."""
    columns, rows = zip(*((t.column, t.row) for t in tiles), strict=True)
    first = context.grid.bounds(TileId(min(columns), min(rows)))
    last = context.grid.bounds(TileId(max(columns), max(rows)))
    east, north = cells_m(context)
    window = GridWindow.over(
        Bounds(first.easting_min_m, first.northing_min_m, last.easting_max_m, last.northing_max_m), east, north
    )
    return CellBox(window.first_column, window.first_row, window.columns, window.rows, (east, north))


@dataclass(frozen=True)
class SurfaceFiles:
    """Files of `surface`, read one after another without a cache."""

    load: LoadCells
    context: ProductContext

    def place(self, tile: TileId, box: CellBox) -> tuple[int, int, int, int]:
        """Column and row of a tile's first pixel in a box, from its north-west corner, and its width and height."""
        own = surface_box((tile,), self.context)
        return own.west - box.west, box.north - own.north, own.width, own.height

    def image(self, tile: TileId, band: SurfaceBand, part: Window | None = None) -> npt.NDArray[np.float32] | None:
        """Returns (rows, columns) of a band, or of a part of it, north up; None where the tile has no surface.

        Raises
        ------
        StoreError
            if the file is not one of this surface.
        """
        from rasterio.errors import RasterioError
        from rasterio.io import MemoryFile

        content = self.load.file(READS[0], tile)
        if content is None:
            return None
        own = surface_box((tile,), self.context)
        try:
            with MemoryFile(content) as memory, memory.open(driver="GTiff") as raster:
                if (raster.width, raster.height) != (own.width, own.height):
                    raise StoreError(
                        f"the surface of tile {tile} has {raster.width} × {raster.height} cells",
                        expected=f"{own.width} × {own.height}",
                        change="run the survey again",
                    )
                number = list(raster.descriptions).index(surface_band(band, self.context).description) + 1
                pixels: npt.NDArray[Any] = raster.read(number, window=part)
        except (RasterioError, ValueError) as error:
            raise StoreError(f"the surface of tile {tile} cannot be read: {error}", change="make it again") from error
        return pixels.astype(np.float32, copy=False)

    def heights_around(self, tile: TileId, known: frozenset[TileId]) -> npt.NDArray[np.float64] | None:
        """Returns heights (rows + 2, columns + 2) (m) of a tile and of the cells around it, NaN where there is none.

        None where the tile has no surface; of its neighbours among `known` only the border is decoded.
        """
        heights = self.image(tile, "height")
        if heights is None:
            return None
        rows, columns = heights.shape
        around = np.full((rows + 2, columns + 2), np.nan)
        around[1:-1, 1:-1] = heights
        for right in (-1, 0, 1):
            for up in (-1, 0, 1):
                other = TileId(tile.column + right, tile.row + up)
                if other != tile and other in known:
                    self._border(other, right, up, around)
        return around * self.context.map.vertical_unit_m

    def _border(self, other: TileId, right: int, up: int, around: npt.NDArray[np.float64]) -> None:
        """Copy the pixels of a neighbour that touch a tile into its rim."""
        from rasterio.windows import Window

        size = surface_box((other,), self.context)
        column, width = {-1: (size.width - 1, 1), 0: (0, size.width), 1: (0, 1)}[right]
        row, height = {1: (size.height - 1, 1), 0: (0, size.height), -1: (0, 1)}[up]
        line = self.image(other, "height", Window(column, row, width, height))
        if line is not None:
            rim = {-1: slice(0, 1), 0: slice(1, -1), 1: slice(-1, None)}
            around[rim[-up], rim[right]] = line
