"""``surface``: the reconstructed surface of a tile as a GeoTIFF."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.compute.array_types import Float32
from roadscan.core.errors import ConfigError, StoreError
from roadscan.core.grid import Bounds, TileId
from roadscan.core.strict import Strict
from roadscan.store.codecs.cog import Band, Pixels, check_cog, dense_image, write_cog, write_sparse_cog
from roadscan.surface.tile import EMPTY, GridWindow, SurfaceTile
from roadscan.tiles.product import LoadCells, Output, ProductContext, SurfaceProduct, SurveyProduct, TileSummary
from roadscan.tiles.products.raster import (
    CellBox,
    Sheet,
    about,
    check_index,
    cut_sheets,
    dated,
    height_unit,
    index_name,
    outputs_of_bands,
    sheet_of,
    unknown_output,
    write_index,
)

if TYPE_CHECKING:
    from rasterio.transform import Affine
    from rasterio.windows import Window


SurfaceBand = Literal["height", "raw_height", "origin", "intensity"]

HEIGHT_STEP: Final = 2.0**-15
"""Heights are whole multiples of this, in the unit of the map's heights, as in `geotiff`."""

_OVERVIEWS: Final = (4, 16)  # Edges (cells) of the pixels of overviews.
_SMALLEST_OVERVIEW: Final = 32  # Overviews have at least this many pixels a side.


class SurfaceOptions(Strict):
    """Settings of `surface`."""

    bands: tuple[SurfaceBand, ...] = Field(default=("height", "origin", "intensity"), min_length=1)
    """Bands in their order: height (smoothed) and raw_height (as measured), both rounded to 2⁻¹⁵ of their unit; origin
    (1 measured, 2 interpolated, 3 filled); intensity (rounded to a whole number)."""


class Surface(SurfaceProduct):
    """One cloud-optimised GeoTIFF a tile: float32 bands, NaN where there is no surface, and overviews.

    Pixels are the cells of the surface's grid, north up, in the CRS's unit: those whose centre lies in the
    tile. Overviews have pixels of 4 and 16 cells, while they are 32 pixels or more: the mean of the heights and
    intensities, the best of the origins.
    """

    name: ClassVar[str] = "surface"
    title: ClassVar[str] = "reconstructed surface of a tile as a GeoTIFF (smoothed height, origin, intensity), for GIS"
    suffix: ClassVar[str] = ".tif"
    version: ClassVar[int] = 2
    options: ClassVar[type[Strict]] = SurfaceOptions

    def write(self, surface: SurfaceTile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the tile's bands; only blocks that contain a height are written."""
        names = cast(SurfaceOptions, options).bands
        bands = [_band(name, surface, context) for name in names]
        images = [dense_image(bands)]
        for factor in _OVERVIEWS:
            if min(bands[0].shape) >= factor * _SMALLEST_OVERVIEW:
                small = [_reduced(b, factor, name == "origin") for b, name in zip(bands, names, strict=True)]
                images.append(dense_image(small))
        place = _place(surface, context)
        write_cog(path, images, about(place, [surface_band(n, context) for n in names], context, surface.tile))

    def check(self, path: Path) -> None:
        """Compare every byte with the stored digest."""
        check_cog(path)


def surface_band(name: SurfaceBand, context: ProductContext) -> Band:
    """Returns name and unit of a band, as the files state them."""
    unit = height_unit(context.map)
    return {
        "height": Band("height", unit),
        "raw_height": Band("height before smoothing", unit),
        "origin": Band("origin: 1 measured, 2 interpolated, 3 filled", ""),
        "intensity": Band("intensity", "digital number"),
    }[name]


def _band(name: SurfaceBand, surface: SurfaceTile, context: ProductContext) -> Float32:
    """Returns (rows, columns) of the tile itself, north up."""
    known = surface.origin[surface.inner] != EMPTY
    if name in ("height", "raw_height"):
        heights = surface.height_m if name == "height" else surface.raw_m
        scale = 1.0 / (context.map.vertical_unit_m * HEIGHT_STEP)
        values = np.rint(heights[surface.inner] * scale) * HEIGHT_STEP
    elif name == "origin":
        values = np.where(known, surface.origin[surface.inner], np.nan)
    else:
        values = np.rint(surface.intensity[surface.inner])
    return np.where(known, values, np.nan)[::-1].astype(np.float32)


def _reduced(band: Float32, factor: int, best: bool) -> Float32:
    """Returns means of `factor` squared pixels, or their least; NaN where none is known."""
    rows, columns = (-(-n // factor) for n in band.shape)
    whole = np.full((rows * factor, columns * factor), np.nan, np.float32)
    whole[: band.shape[0], : band.shape[1]] = band
    parts = whole.reshape(rows, factor, columns, factor)
    known = ~np.isnan(parts)
    if best:
        least = np.where(known, parts, np.inf).min(axis=(1, 3))
        return np.where(np.isinf(least), np.nan, least).astype(np.float32)
    with np.errstate(invalid="ignore"):
        means = np.where(known, parts, 0.0).sum(axis=(1, 3), dtype=np.float64) / known.sum(axis=(1, 3))
    return np.asarray(means, np.float32)


def _place(surface: SurfaceTile, context: ProductContext) -> Affine:
    """Returns the map position, in the CRS's unit, of a (column, row) counted from the north-west corner."""
    from rasterio.transform import Affine

    box, unit_m = surface.window.grown(-surface.halo).bounds(), context.map.horizontal_unit_m
    east, north = (edge / unit_m for edge in surface.cell_m)
    return Affine(east, 0.0, box.easting_min_m / unit_m, 0.0, -north, box.northing_max_m / unit_m)


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
        return outputs_of_bands(settings.bands, tiles, sheet_edge_m(settings.sheet_m, context), context.grid)

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
