"""``kilometre``: a network from far away, a sheet a kilometre of the map, from the tiles' overviews."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, cast, get_args

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.core.errors import StoreError
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.strict import Strict
from roadscan.store.codecs.cog import Band, write_sparse_cog
from roadscan.tiles.cells import Level, overview_factors
from roadscan.tiles.product import Cells, LoadCells, Output, ProductContext, SurveyProduct, TileSummary
from roadscan.tiles.products.hillshade import SHADE_BAND, Light, base_below, shade, with_neighbours
from roadscan.tiles.products.raster import (
    CellBox,
    Sheet,
    about,
    band_of,
    check_sheet,
    cut_sheets,
    dated,
    index_name,
    index_output,
    sheet_of,
    unknown_output,
    write_index,
)

View = Literal["height", "intensity", "shaded"]
"""Mean robust height, mean intensity, shaded relief of the heights."""

_TYPES: Final[dict[View, str]] = {"height": "float32", "intensity": "float32", "shaded": "uint8"}


class KilometreOptions(Strict):
    """Settings of the kilometre sheets."""

    pixels_m: tuple[float, ...] = Field(default=(0.04, 0.16), min_length=1)
    """Edges of the pixels (m), each a set of sheets; the overview of the tiles that is nearest by ratio is taken, for
    tiles of 10 m with cells of 5 mm those of 40 and 200 mm."""
    views: tuple[View, ...] = Field(default=get_args(View), min_length=1)
    """Rasters to write: height (mean of the robust heights), intensity (mean), shaded (relief)."""
    sheet_m: float = Field(default=1000.0, gt=0)
    """Edge of a sheet (m), rounded down to whole tiles and counted from the map's origin; a survey no larger than
    that is one file."""
    azimuth_deg: float = Field(default=315.0, ge=0, lt=360)
    """Where the light comes from, clockwise from map north (degrees)."""
    altitude_deg: float = Field(default=45.0, gt=0, le=90)
    """Height of the light above the horizon (degrees)."""
    z_factor: float = Field(default=3.0, gt=0)
    """Exaggeration: heights are multiplied by this."""


class Kilometre(SurveyProduct):
    """Cloud-optimised GeoTIFFs of large pixels, a sheet a kilometre of the map, joined by ``VIEW_PIXEL.vrt``.

    ``height_40mm_553_6020.tif`` holds the heights between eastings 553 and 554 km and northings 6020 and 6021 km in
    pixels of 40 mm. Heights and intensities are float32, NaN where no point lies; the shaded relief (Horn 1981) is
    8 bits from 1 to 255, 0 where empty, and uses the neighbours' pixels, so no seam shows. Pixels are means of
    a tile's cells. A sheet reads the overviews of its tiles (and of those around it) one after another: time and
    memory do not grow with the survey, and only sheets whose tiles changed are made again.
    """

    name: ClassVar[str] = "kilometre"
    title: ClassVar[str] = "sheets of a kilometre in large pixels (height, intensity, relief), for whole networks"
    version: ClassVar[int] = 2
    options: ClassVar[type[Strict]] = KilometreOptions
    default_cells: ClassVar[Cells] = "fine"

    def outputs(self, tiles: Sequence[TileId], options: Strict, context: ProductContext) -> list[Output]:
        """Sheets of each view and pixel, followed by the index that joins them."""
        settings = cast(KilometreOptions, options)
        everything = frozenset(tiles)
        sheets = cut_sheets("", tiles, settings.sheet_m, context.grid)  # the same for all, as names without stem
        index = index_output("", sheets)
        plain = [Output(s.name, s.tiles) for s in sheets] + index
        wanted = sheets if "shaded" in settings.views else ()
        shaded = [Output(s.name, with_neighbours(s, everything)) for s in wanted] + index
        return [
            replace(one, name=raster.stem + one.name)
            for raster in _rasters(settings, context)
            for one in (shaded if raster.view == "shaded" else plain)
        ]

    def write(
        self,
        output: Output,
        tiles: Sequence[TileSummary],
        load_cells: LoadCells,
        options: Strict,
        context: ProductContext,
        path: Path,
    ) -> None:
        """Write one sheet, or the index of a view."""
        settings = cast(KilometreOptions, options)
        for raster in _rasters(settings, context):
            grid = raster.context.grid
            if output.name == index_name(raster.stem):
                sheets = cut_sheets(raster.stem, output.tiles, settings.sheet_m, grid)
                write_index(path, sheets, raster.band, _TYPES[raster.view], raster.context)
                return
            sheet = sheet_of(raster.stem, output, settings.sheet_m, grid)
            if sheet is not None:
                drawn = replace(raster, context=dated(raster.context, tiles, output.tiles))
                _write_sheet(
                    drawn, sheet, _Overviews(output, base_below(tiles, output), raster, load_cells), settings, path
                )
                return
        raise unknown_output(output)

    def check(self, path: Path) -> None:
        """Compare every byte of a sheet with its stored digest; of an index, check its geometry."""
        check_sheet(path)


@dataclass(frozen=True)
class _Raster:
    """One view in pixels of one size; the cells of the context's grid are these pixels."""

    view: View
    factor: int
    context: ProductContext

    @property
    def stem(self) -> str:
        """File name without sheet and suffix."""
        return f"{self.view}_{round(self.context.grid.cell_m * 1000)}mm"

    @property
    def band(self) -> Band:
        """Its band."""
        return SHADE_BAND if self.view == "shaded" else band_of(self.view, self.context)


def _rasters(options: KilometreOptions, context: ProductContext) -> Iterator[_Raster]:
    """Return the requested rasters; two pixel sizes with the same nearest overview become one."""
    grid = context.grid
    known = overview_factors(grid.cells_per_edge) or (1,)
    factors = {min(known, key=lambda f: (max(f / r, r / f), f)) for r in (m / grid.cell_m for m in options.pixels_m)}
    for view in options.views:
        for factor in sorted(factors):
            pixels = TileGrid(grid.size_m, grid.size_m / (grid.cells_per_edge // factor))
            yield _Raster(view, factor, replace(context, grid=pixels))


class _Overviews:
    """Overviews of the tiles of a sheet, read row by row from the north; each is loaded once."""

    def __init__(self, output: Output, base_m: float, raster: _Raster, load_cells: LoadCells) -> None:
        self._tiles = frozenset(output.tiles)
        self._base_m = base_m
        self._raster = raster
        self._load = load_cells
        self._near: dict[TileId, Level] = {}

    def image(self, tile: TileId, light: Light) -> npt.NDArray[Any]:
        """Return the (rows, columns) image of a tile, north up, in the unit of the band."""
        raster, level = self._raster, self._level(tile)
        unit_m = raster.context.map.vertical_unit_m
        edge = raster.context.grid.cells_per_edge
        if raster.view == "shaded":
            return shade(self._heights_around(tile, edge), raster.context.grid.cell_m, light)
        image = np.full((edge, edge), np.nan, np.float32)
        values = level.intensity if raster.view == "intensity" else level.height_m / unit_m
        image[edge - 1 - level.row.astype(np.int64), level.column] = values
        return image

    def _heights_around(self, tile: TileId, edge: int) -> npt.NDArray[np.float64]:
        """Return (edge + 2, edge + 2) heights above the base (m) of a tile and the pixels around it."""
        heights_m = np.full((edge + 2, edge + 2), np.nan)
        for right in (-1, 0, 1):
            for up in (-1, 0, 1):
                other = TileId(tile.column + right, tile.row + up)
                if other not in self._tiles:
                    continue
                level = self._level(other)
                x, y = level.column.astype(np.int64) + right * edge + 1, edge - level.row.astype(np.int64) - up * edge
                inside = (x >= 0) & (x < edge + 2) & (y >= 0) & (y < edge + 2)
                heights_m[y[inside], x[inside]] = level.height_m[inside] - self._base_m
        self._near = {near: level for near, level in self._near.items() if near.row <= tile.row + 1}
        return heights_m

    def _level(self, tile: TileId) -> Level:
        if self._raster.view != "shaded":
            self._near.clear()
        if tile not in self._near:
            level = self._load.overview(tile, self._raster.factor)
            if level is None:
                raise StoreError(f"tile {tile} is listed and has no cells", change="run the survey again")
            self._near[tile] = level
        return self._near[tile]


def _write_sheet(raster: _Raster, sheet: Sheet, overviews: _Overviews, light: Light, path: Path) -> None:
    edge, box = raster.context.grid.cells_per_edge, CellBox.around(sheet.tiles, raster.context.grid)
    corners = {t: (t.column * edge - box.west, box.north - (t.row + 1) * edge) for t in sheet.tiles}
    write_sparse_cog(
        path,
        (box.width, box.height),
        _TYPES[raster.view],
        ((*corners[tile], overviews.image(tile, light)) for tile in sheet.tiles),
        [(*corner, edge, edge) for corner in corners.values()],
        about(box.transform(raster.context), [raster.band], raster.context),
    )
