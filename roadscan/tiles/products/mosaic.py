"""``mosaic``: the cells of the whole survey, one raster a quantity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, cast

import numpy as np
from pydantic import Field

from roadscan.core.grid import TileId
from roadscan.core.strict import Strict
from roadscan.store.codecs.cog import raster_settings
from roadscan.tiles.product import Cells, LoadCells, Output, ProductContext, SurveyProduct, TileSummary
from roadscan.tiles.products.raster import (
    COLUMNS,
    QUANTITIES,
    CellBox,
    Quantity,
    Sheet,
    SparseRaster,
    band_of,
    cell_image,
    check_sheet,
    cut_sheets,
    dated,
    in_unit,
    index_name,
    outputs_of_bands,
    paste_tile,
    sheet_of,
    unknown_output,
    values_in,
    write_index,
)


class MosaicOptions(Strict):
    """Settings of the mosaic."""

    sheet_m: float | None = Field(default=None, gt=0)
    """Edge of a sheet (m), rounded down to whole tiles; a survey no larger than that is one file. Left out, an
    edge has 20,000 cells: 1000 m at cells of 5 cm."""
    quantities: tuple[Quantity, ...] = Field(default=QUANTITIES, min_length=1)
    """Rasters to write: height (robust), intensity (mean), count (points), height_std (standard deviation)."""


class Mosaic(SurveyProduct):
    """Cloud-optimised float32 GeoTIFFs over the whole survey, NaN where no point lies, one a quantity.

    Large surveys are cut into sheets, which ``QUANTITY.vrt`` joins. Each tile is read once a quantity, and
    memory does not grow with the survey: a sheet is put together in a scratch file beside its path.
    """

    name: ClassVar[str] = "mosaic"
    title: ClassVar[str] = "cells of the whole survey as GeoTIFFs (height, intensity, count, standard deviation)"
    version: ClassVar[int] = 2
    options: ClassVar[type[Strict]] = MosaicOptions
    default_cells: ClassVar[Cells] = "coarse"

    def outputs(self, tiles: Sequence[TileId], options: Strict, context: ProductContext) -> list[Output]:
        """Sheets of each quantity, followed by the index that joins them."""
        settings = cast(MosaicOptions, options)
        return outputs_of_bands(settings.quantities, tiles, settings.sheet_m, context.grid)

    def write(
        self,
        output: Output,
        tiles: Sequence[TileSummary],
        load_cells: LoadCells,
        options: Strict,
        context: ProductContext,
        path: Path,
    ) -> None:
        """Write one sheet, or the index of a quantity."""
        settings = cast(MosaicOptions, options)
        for quantity in settings.quantities:
            if output.name == index_name(quantity):
                sheets = cut_sheets(quantity, output.tiles, settings.sheet_m, context.grid)
                write_index(path, sheets, band_of(quantity, context), "float32", context)
                return
            sheet = sheet_of(quantity, output, settings.sheet_m, context.grid)
            if sheet is not None:
                _write_sheet(quantity, sheet, load_cells, dated(context, tiles, sheet.tiles), path)
                return
        raise unknown_output(output)

    def check(self, path: Path) -> None:
        """Decode every block and compare with the stored digest; of an index, check its geometry."""
        check_sheet(path)


def _write_sheet(quantity: Quantity, sheet: Sheet, load_cells: LoadCells, context: ProductContext, path: Path) -> None:
    raster = SparseRaster(
        CellBox.around(sheet.tiles, context.grid), band_of(quantity, context), "float32", np.nan, context
    )
    with raster_settings(), raster.cog(path) as canvas:
        for tile in sheet.tiles:
            cells = values_in(tile, COLUMNS[quantity], load_cells)
            paste_tile(canvas, raster.box, tile, cell_image(cells, in_unit(quantity, cells.values, context), "float32"))
