"""``surface_hillshade``: a shaded relief of the reconstructed surface with light from the north-west."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar, Final, cast

import numpy as np

from roadscan.core.errors import StoreError
from roadscan.core.ids import TileId
from roadscan.core.strict import Strict
from roadscan.store.codecs.cog import Pixels, write_sparse_cog
from roadscan.store.codecs.grey_picture import check_picture
from roadscan.surface.products.surface_files import READS, SurfaceFiles, cells_m, need_bands, sheet_edge_m, surface_box
from roadscan.surface.products.surface_mosaic import check_surface_sheet
from roadscan.tiles.product import LoadCells, Output, ProductContext, SurveyProduct, TileSummary
from roadscan.tiles.products.hillshade import (
    SHADE_BAND,
    HillshadeOptions,
    shade_in_strips,
    with_empty_rim,
    with_neighbours,
)
from roadscan.tiles.products.raster import about
from roadscan.tiles.products.relief_picture import PNG_SIGNATURE, MeanPixels, write_picture
from roadscan.tiles.products.sheets import (
    Sheet,
    cut_sheets,
    dated,
    index_name,
    index_output,
    sheet_of,
    unknown_output,
    write_index,
)

_STEM: Final = "hillshade"
_PICTURE: Final = "hillshade.png"


class SurfaceHillshade(SurveyProduct):
    """8-bit hillshade (Horn 1981) of the reconstructed surface as a cloud-optimised GeoTIFF, and a PNG of it all.

    As `hillshade`, of the heights in the tiles' files of `surface`: 1 (in the shade) to 255 (facing the light); 0,
    transparent in the picture, is a hole of the surface. Slopes across the borders of tiles and sheets use the
    neighbour's cells, so no seam shows. Memory does not grow with the survey.
    """

    name: ClassVar[str] = "surface_hillshade"
    title: ClassVar[str] = "shaded relief of the reconstructed surface, as a GeoTIFF and as a picture"
    options: ClassVar[type[Strict]] = HillshadeOptions
    default: ClassVar[bool] = False
    reads: ClassVar[tuple[str, ...]] = READS

    def check_reads(self, options: Strict, read: Mapping[str, Strict]) -> None:
        """Raise where the files of `surface` have no heights."""
        need_bands(self.name, ("height",), read)

    def outputs(self, tiles: Sequence[TileId], options: Strict, context: ProductContext) -> list[Output]:
        """Returns sheets, the index that joins them, and the picture."""
        edge_m = sheet_edge_m(cast(HillshadeOptions, options).sheet_m, context)
        everything = tuple(sorted(tiles))
        sheets = cut_sheets(_STEM, everything, edge_m, context.grid)
        known = frozenset(everything)
        found = [Output(sheet.name, with_neighbours(sheet, known)) for sheet in sheets]
        found += index_output(_STEM, sheets)
        return [*found, Output(_PICTURE, everything)] if everything else []

    def write(
        self,
        output: Output,
        tiles: Sequence[TileSummary],
        load_cells: LoadCells,
        options: Strict,
        context: ProductContext,
        path: Path,
    ) -> None:
        """Write one sheet, the index, or the picture."""
        settings = cast(HillshadeOptions, options)
        edge_m = sheet_edge_m(settings.sheet_m, context)
        sheet = sheet_of(_STEM, output, edge_m, context.grid)
        if output.name == index_name(_STEM):
            sheets = cut_sheets(_STEM, output.tiles, edge_m, context.grid)
            write_index(path, sheets, SHADE_BAND, "uint8", context, partial(surface_box, context=context))
        elif output.name == _PICTURE:
            _write_picture(output, SurfaceFiles(load_cells, context), settings, path)
        elif sheet is not None:
            files = SurfaceFiles(load_cells, dated(context, tiles, output.tiles))
            _write_sheet(sheet, frozenset(output.tiles), files, settings, path)
        else:
            raise unknown_output(output)

    def check(self, path: Path) -> None:
        """Decode the picture; compare every byte of a sheet with its digest; of an index, check its geometry."""
        with path.open("rb") as stream:
            is_picture = stream.read(1) == PNG_SIGNATURE[:1]
        if is_picture:
            check_picture(path, "LA")
        else:
            check_surface_sheet(path)


def _write_sheet(
    sheet: Sheet, known: frozenset[TileId], files: SurfaceFiles, light: HillshadeOptions, path: Path
) -> None:
    box = surface_box(sheet.tiles, files.context)

    def images() -> Iterator[tuple[int, int, Pixels]]:
        east, north = cells_m(files.context)
        for tile in sheet.tiles:
            left, top, width, height = files.place(tile, box)
            around = files.heights_around(tile, known)
            empty = np.zeros((height, width), np.uint8)
            yield left, top, empty if around is None else shade_in_strips(around, east, light, north)

    write_sparse_cog(
        path,
        (box.width, box.height),
        "uint8",
        images(),
        [files.place(tile, box) for tile in sheet.tiles],
        about(box.transform(files.context), [SHADE_BAND], files.context),
    )


def _write_picture(output: Output, files: SurfaceFiles, options: HillshadeOptions, path: Path) -> None:
    box = surface_box(output.tiles, files.context)
    east, north = cells_m(files.context)
    longest_m = max(box.width * east, box.height * north)
    right, down = (math.ceil(longest_m / options.picture_px / edge - 1e-9) for edge in (east, north))  # nearly square
    pixels = MeanPixels.over(box.height, box.width, (down, right))
    for tile in output.tiles:
        heights = files.image(tile, "height")
        if heights is not None:
            _add(pixels, heights * np.float64(files.context.map.vertical_unit_m), files.place(tile, box))
    if not pixels.count.any():
        raise StoreError("no tile of the survey has a surface", change="look at the settings of [surface]")
    around = with_empty_rim(pixels.trimmed())
    write_picture(path, shade_in_strips(around, right * east, options, down * north))


def _add(pixels: MeanPixels, heights_m: Pixels, place: tuple[int, int, int, int]) -> None:
    row, column = np.nonzero(~np.isnan(heights_m))
    pixels.add(row + place[1], column + place[0], heights_m[row, column].astype(np.float64))
