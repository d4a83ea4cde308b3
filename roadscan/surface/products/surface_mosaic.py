"""``surface_mosaic``: the reconstructed surface of the whole survey, one raster a band."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar, cast

import numpy as np
from pydantic import Field

from roadscan.core.ids import TileId
from roadscan.core.strict import Strict
from roadscan.store.codecs.cog import Pixels, write_sparse_cog
from roadscan.store.codecs.tiff import check_cog
from roadscan.surface.products.surface import SurfaceBand, surface_band
from roadscan.surface.products.surface_files import READS, SurfaceFiles, need_bands, sheet_edge_m, surface_box
from roadscan.tiles.product import LoadCells, Output, ProductContext, SurveyProduct, TileSummary
from roadscan.tiles.products.raster import CellBox, about
from roadscan.tiles.products.sheets import (
    Sheet,
    check_index,
    cut_sheets,
    dated,
    index_name,
    index_output,
    sheet_of,
    unknown_output,
    write_index,
)


class SurfaceMosaicOptions(Strict):
    """Settings of `surface_mosaic`."""

    bands: tuple[SurfaceBand, ...] = Field(default=("height",), min_length=1)
    """Rasters to write, of those that `surface` has: height, raw_height, origin, intensity."""
    sheet_m: float | None = Field(default=None, gt=0)
    """Edge of a sheet (m), rounded down to whole tiles; a survey no larger than that is one file. Left out, an
    edge has 20,000 cells of the surface: 100 m at cells of 5 mm."""


class SurfaceMosaic(SurveyProduct):
    """Cloud-optimised float32 GeoTIFFs of the reconstructed surface, NaN in its holes, one a band.

    Pixels are those of the tiles' files of `surface`, bit by bit. Large surveys are cut into sheets, which
    ``BAND.vrt`` joins. Each tile's file is read once a band, and memory does not grow with the survey. Overviews halve
    the raster until it is small: the mean of those pixels that have a value.
    """

    name: ClassVar[str] = "surface_mosaic"
    title: ClassVar[str] = "reconstructed surface of the whole survey as GeoTIFFs (smoothed height, origin, intensity)"
    options: ClassVar[type[Strict]] = SurfaceMosaicOptions
    default: ClassVar[bool] = False
    reads: ClassVar[tuple[str, ...]] = READS

    def check_reads(self, options: Strict, read: Mapping[str, Strict]) -> None:
        """Raise where the files of `surface` lack a band."""
        need_bands(self.name, cast(SurfaceMosaicOptions, options).bands, read)

    def outputs(self, tiles: Sequence[TileId], options: Strict, context: ProductContext) -> list[Output]:
        """Returns the sheets of each band, followed by the index that joins them."""
        settings = cast(SurfaceMosaicOptions, options)
        edge_m = sheet_edge_m(settings.sheet_m, context)
        found: list[Output] = []
        for band in settings.bands:
            sheets = cut_sheets(band, tiles, edge_m, context.grid)
            found += [Output(sheet.name, sheet.tiles) for sheet in sheets]
            found += index_output(band, sheets)
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
        """Write one sheet, or the index of a band."""
        settings = cast(SurfaceMosaicOptions, options)
        edge_m = sheet_edge_m(settings.sheet_m, context)
        for band in settings.bands:
            if output.name == index_name(band):
                sheets = cut_sheets(band, output.tiles, edge_m, context.grid)
                box_of = partial(surface_box, context=context)
                write_index(path, sheets, surface_band(band, context), "float32", context, box_of)
                return
            sheet = sheet_of(band, output, edge_m, context.grid)
            if sheet is not None:
                _write_sheet(band, sheet, load_cells, dated(context, tiles, sheet.tiles), path)
                return
        raise unknown_output(output)

    def check(self, path: Path) -> None:
        """Compare every byte of a sheet with its stored digest; of an index, check its geometry."""
        check_surface_sheet(path)


def check_surface_sheet(path: Path) -> None:
    """Raise :class:`roadscan.core.errors.StoreError` unless `path` is a whole sheet, or an index."""
    with path.open("rb") as stream:
        is_index = stream.read(1) == b"<"
    if is_index:
        check_index(path)
    else:
        check_cog(path)


def _write_sheet(band: SurfaceBand, sheet: Sheet, load_cells: LoadCells, context: ProductContext, path: Path) -> None:
    box, files = surface_box(sheet.tiles, context), SurfaceFiles(load_cells, context)
    write_sparse_cog(
        path,
        (box.width, box.height),
        "float32",
        _images(band, sheet, files, box),
        [files.place(tile, box) for tile in sheet.tiles],
        about(box.transform(context), [surface_band(band, context)], context),
    )


def _images(band: SurfaceBand, sheet: Sheet, files: SurfaceFiles, box: CellBox) -> Iterator[tuple[int, int, Pixels]]:
    for tile in sheet.tiles:
        left, top, width, height = files.place(tile, box)
        image = files.image(tile, band)
        yield left, top, np.full((height, width), np.nan, np.float32) if image is None else image
