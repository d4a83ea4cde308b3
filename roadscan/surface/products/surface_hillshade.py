"""``surface_hillshade``: a shaded relief of the reconstructed surface with light from the north-west."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar, Final, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.core.errors import StoreError
from roadscan.core.grid import TileId
from roadscan.core.strict import Strict
from roadscan.store.codecs import SOFTWARE
from roadscan.store.codecs.cog import Pixels, write_sparse_cog
from roadscan.store.codecs.image_files import check_picture, write_png
from roadscan.surface.products.surface import (
    READS,
    SurfaceFiles,
    cells_m,
    check_surface_sheet,
    need_bands,
    sheet_edge_m,
    surface_box,
)
from roadscan.surface.tile import EMPTY, SurfaceTile
from roadscan.tiles.product import LoadCells, Output, ProductContext, SurfaceProduct, SurveyProduct, TileSummary
from roadscan.tiles.products.hillshade import (
    PICTURE,
    PNG_SIGNATURE,
    SHADE_BAND,
    STEM,
    HillshadeOptions,
    MeanPixels,
    shade,
    shaded_outputs,
    with_empty_rim,
    write_picture,
)
from roadscan.tiles.products.raster import (
    Sheet,
    about,
    cut_sheets,
    dated,
    index_name,
    sheet_of,
    unknown_output,
    write_index,
)


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
        return shaded_outputs(tiles, edge_m, context.grid)

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
        sheet = sheet_of(STEM, output, edge_m, context.grid)
        if output.name == index_name(STEM):
            sheets = cut_sheets(STEM, output.tiles, edge_m, context.grid)
            write_index(path, sheets, SHADE_BAND, "uint8", context, partial(surface_box, context=context))
        elif output.name == PICTURE:
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
            yield left, top, empty if around is None else shade(around, east, light, north)

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
    write_picture(path, shade(around, right * east, options, down * north))


def _add(pixels: MeanPixels, heights_m: Pixels, place: tuple[int, int, int, int]) -> None:
    row, column = np.nonzero(~np.isnan(heights_m))
    pixels.add(row + place[1], column + place[0], heights_m[row, column].astype(np.float64))


Grey = npt.NDArray[np.uint8]

_GAP_PX: Final = 16  # Gap between the halves (pixels).


class SurfacePicturesOptions(Strict):
    """Settings of `surface_pictures`."""

    azimuth_deg: float = Field(default=315.0, ge=0, lt=360)
    """Where the light comes from, clockwise from map north (degrees)."""
    altitude_deg: float = Field(default=45.0, gt=0, le=90)
    """Height of the light above the horizon (degrees)."""
    z_factor: float = Field(default=3.0, gt=0)
    """Exaggeration: heights are multiplied by this (ruts and cracks are flat things)."""


class SurfacePictures(SurfaceProduct):
    """A PNG a tile: on the left the shaded heights before smoothing, on the right those after it.

    As figures 3, 6, 7 and 8 of Yu et al. (2007): one light (Horn 1981), north up, over the part of the tile that holds
    heights. A pixel is a cell; where its edges differ, it is repeated along the longer one. 0, transparent, is empty,
    and so is the gap between the halves.
    """

    name: ClassVar[str] = "surface_pictures"
    title: ClassVar[str] = "shaded surface of a tile before and after smoothing, side by side (PNG)"
    suffix: ClassVar[str] = ".png"
    version: ClassVar[int] = 2
    default: ClassVar[bool] = False
    options: ClassVar[type[Strict]] = SurfacePicturesOptions

    def write(self, surface: SurfaceTile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the picture."""
        light = cast(SurfacePicturesOptions, options)
        halves = [_shaded(heights, surface, light) for heights in (surface.raw_m, surface.height_m)]
        gap = np.zeros((halves[0].shape[0], _GAP_PX), np.uint8)
        about = {"Software": SOFTWARE, "Title": f"{self.name} {context.survey_id} {surface.tile}: before | after"}
        write_png(path, np.concatenate([halves[0], gap, halves[1]], axis=1), min(surface.cell_m), about, smooth=True)

    def check(self, path: Path) -> None:
        """Decode the picture."""
        check_picture(path)


def _shaded(heights_m: npt.NDArray[np.float64], surface: SurfaceTile, light: SurfacePicturesOptions) -> Grey:
    """Returns the shade of the part of the tile that has heights, north up, in square pixels."""
    rows, columns = _seen(surface)
    part = heights_m[rows.start - 1 : rows.stop + 1, columns.start - 1 : columns.stop + 1][::-1]
    east_m, north_m = surface.cell_m
    grey = shade(part, east_m, light, north_m)
    least = min(east_m, north_m)
    return np.repeat(np.repeat(grey, round(north_m / least), axis=0), round(east_m / least), axis=1)


def _seen(surface: SurfaceTile) -> tuple[slice, slice]:
    """Returns row and column slices of the smallest box of the tile's cells with a height."""
    known = surface.origin[surface.inner] != EMPTY
    spans = [np.flatnonzero(known.any(axis=axis)) + surface.halo for axis in (1, 0)]
    rows, columns = (slice(int(s[0]), int(s[-1]) + 1) for s in spans)
    return rows, columns
