"""``kilometre``: a network from far away, a sheet a kilometre of the map, from the tiles' overviews."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, cast, get_args

import numpy as np
import numpy.typing as npt
import rasterio
from pydantic import Field
from rasterio.errors import RasterioError

from roadscan.model.errors import StoreError
from roadscan.model.ids import TileId
from roadscan.model.strict import Strict
from roadscan.products.base import Cells, LoadCells, Output, ProductContext, SurveyProduct, TileSummary
from roadscan.products.hillshade import SHADE_BAND, Surface, base_below, with_neighbours, write_shaded_sheet
from roadscan.products.quantities import band_of
from roadscan.products.raster import Band, CellBox, SparseRaster, paste_tile, raster_settings, without_place_warning
from roadscan.products.sheets import (
    Sheet,
    check_sheet,
    cut_sheets,
    dated,
    index_name,
    index_output,
    sheet_of,
    unknown_output,
    write_index,
)
from roadscan.tiles.grid import TileGrid
from roadscan.tiles.pyramid import Level, overview_factors

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
    a tile's cells. A sheet reads the overviews of its own tiles (and of those around it) one after another: time and
    memory do not grow with the survey, and only sheets whose tiles changed are made again.
    """

    name: ClassVar[str] = "kilometre"
    title: ClassVar[str] = "sheets of a kilometre in large pixels (height, intensity, relief), for whole networks"
    options: ClassVar[type[Strict]] = KilometreOptions
    default_cells: ClassVar[Cells] = "fine"

    def outputs(self, tiles: Sequence[TileSummary], options: Strict, context: ProductContext) -> list[Output]:
        """Sheets of each view and pixel, followed by the index that joins them."""
        settings = cast(KilometreOptions, options)
        everything = frozenset(one.tile for one in tiles)
        found: list[Output] = []
        for raster in _rasters(settings, context):
            sheets = cut_sheets(raster.stem, everything, settings.sheet_m, raster.context.grid)
            found += [
                Output(s.name, with_neighbours(s, everything) if raster.view == "shaded" else s.tiles) for s in sheets
            ]
            found += index_output(raster.stem, sheets)
        return found

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
                if raster.view == "shaded":
                    write_shaded_sheet(sheet, _surface(drawn, output, tiles, load_cells), settings, drawn.context, path)
                else:
                    _write_sheet(drawn, sheet, load_cells, path)
                return
        raise unknown_output(output)

    def check(self, path: Path) -> None:
        """Decode every block and compare with the stored digest; of an index, check its geometry."""
        check_sheet(path, _stored_type(path))


@dataclass(frozen=True)
class _Raster:
    """One view in pixels of one size; the context's grid has those pixels for cells."""

    view: View
    factor: int
    context: ProductContext

    @property
    def stem(self) -> str:
        """Name of its files without sheet and suffix."""
        return f"{self.view}_{round(self.context.grid.cell_m * 1000)}mm"

    @property
    def band(self) -> Band:
        """Its band."""
        return SHADE_BAND if self.view == "shaded" else band_of(self.view, self.context)

    def image(self, tile: TileId, load_cells: LoadCells, base_m: float = 0.0) -> npt.NDArray[Any]:
        """(rows, columns) of a tile, north up, NaN where no point lies: intensities, or heights above a base.

        Heights are in the unit of the map's heights; for the relief, in metres.
        """
        level = _overview(tile, self.factor, load_cells)
        edge = self.context.grid.cells_per_edge
        image = np.full((edge, edge), np.nan, np.float64 if self.view == "shaded" else np.float32)
        unit_m = self.context.map.vertical_unit_m if self.view == "height" else 1.0
        values = level.intensity if self.view == "intensity" else (level.height_m - base_m) / unit_m
        image[edge - 1 - level.row.astype(np.int64), level.column] = values
        return image


def _rasters(options: KilometreOptions, context: ProductContext) -> Iterator[_Raster]:
    """What the settings ask for; two pixel sizes that have the same nearest overview are one."""
    grid = context.grid
    known = overview_factors(grid.cells_per_edge) or (1,)
    factors = {min(known, key=lambda f: (max(f / r, r / f), f)) for r in (m / grid.cell_m for m in options.pixels_m)}
    for view in options.views:
        for factor in sorted(factors):
            pixels = TileGrid(grid.size_m, grid.size_m / (grid.cells_per_edge // factor))
            yield _Raster(view, factor, replace(context, grid=pixels))


def _overview(tile: TileId, factor: int, load_cells: LoadCells) -> Level:
    level = load_cells.overview(tile, factor)
    if level is None:
        raise StoreError(f"tile {tile} is listed and has no cells", change="run the survey again")
    return level


def _surface(raster: _Raster, output: Output, tiles: Sequence[TileSummary], load_cells: LoadCells) -> Surface:
    base_m = base_below(tiles, output)
    return Surface(output.tiles, lambda tile: raster.image(tile, load_cells, base_m))


def _write_sheet(raster: _Raster, sheet: Sheet, load_cells: LoadCells, path: Path) -> None:
    context = raster.context
    canvas = SparseRaster(CellBox.around(sheet.tiles, context.grid), raster.band, "float32", np.nan, context)
    with raster_settings(), canvas.cog(path) as file:
        for tile in sheet.tiles:
            paste_tile(file, canvas.box, tile, raster.image(tile, load_cells))


def _stored_type(path: Path) -> str:
    """Type of a sheet's pixels, so far as the file can be read."""
    try:
        with without_place_warning(), rasterio.open(path) as raster:
            return "uint8" if raster.dtypes[0] == "uint8" else "float32"
    except RasterioError:
        return "float32"
