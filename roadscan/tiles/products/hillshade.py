"""``hillshade``: the surface as light from the north-west would show it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol, Self, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.strict import Strict
from roadscan.store.codecs.cog import Band, raster_settings, without_place_warning
from roadscan.store.codecs.image_files import check_picture
from roadscan.tiles.kernels.grey_pictures import shade_raster
from roadscan.tiles.product import Cells, LoadCells, Output, ProductContext, SurveyProduct, TileSummary
from roadscan.tiles.products.raster import (
    CellBox,
    Sheet,
    SparseRaster,
    cell_image,
    check_sheet,
    cut_sheets,
    dated,
    index_name,
    index_output,
    paste_tile,
    sheet_of,
    unknown_output,
    values_in,
    write_index,
)

PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"

_EMPTY: Final = 0  # Grey of a pixel without a height.


@dataclass(frozen=True)
class MeanPixels:
    """Mean heights in pixels of several cells, north up."""

    steps: tuple[int, int]
    """Cells along the edges of a pixel: down, and to the right."""
    total: Float64
    """(rows, columns) sum of the heights (m)."""
    count: Float64

    @classmethod
    def over(cls, rows: int, columns: int, steps: tuple[int, int]) -> Self:
        """Create empty pixels over so many rows and columns of cells."""
        shape = -(-rows // steps[0]), -(-columns // steps[1])
        return cls(steps, np.zeros(shape), np.zeros(shape))

    def add(self, row: Int64, column: Int64, heights_m: Float64) -> None:
        """Add cells: row and column (n,) from the north-west, and their heights (n,)."""
        down, right = self.steps
        number = (row // down) * self.total.shape[1] + column // right
        pixel, inverse = np.unique(number, return_inverse=True)
        self.total.reshape(-1)[pixel] += np.bincount(inverse, weights=heights_m)
        self.count.reshape(-1)[pixel] += np.bincount(inverse)

    def trimmed(self) -> Float64:
        """Return (rows, columns) mean heights, NaN where empty, without empty rows and columns at the edges."""
        with np.errstate(invalid="ignore"):
            heights_m = self.total / self.count
        known = self.count > 0
        rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        return heights_m[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def write_picture(path: Path, grey: npt.NDArray[np.uint8]) -> None:
    """Write (rows, columns) of grey as a PNG in which 0 is transparent."""
    from rasterio.shutil import copy as translate

    opaque = np.where(grey == _EMPTY, 0, 255).astype(np.uint8)
    with raster_settings(), without_place_warning(), _in_memory(grey, opaque) as picture:
        translate(picture, str(path), driver="PNG", zlevel=6)


@contextmanager
def _in_memory(*bands: npt.NDArray[np.uint8]) -> Iterator[Any]:
    import rasterio

    rows, columns = bands[0].shape
    with rasterio.open(
        "picture", "w+", driver="MEM", width=columns, height=rows, count=len(bands), dtype="uint8"
    ) as raster:
        for number, band in enumerate(bands, start=1):
            raster.write(band, number)
        yield raster


STEM: Final = "hillshade"
PICTURE: Final = "hillshade.png"
_HEIGHT: Final = "height_robust_m"  # Column of cells that is drawn.
SHADE_BAND: Final = Band("hillshade", "")


class HillshadeOptions(Strict):
    """Settings of the hillshade."""

    azimuth_deg: float = Field(default=315.0, ge=0, lt=360)
    """Where the light comes from, clockwise from map north (degrees)."""
    altitude_deg: float = Field(default=45.0, gt=0, le=90)
    """Height of the light above the horizon (degrees)."""
    z_factor: float = Field(default=3.0, gt=0)
    """Exaggeration: heights are multiplied by this (ruts and cracks are flat things)."""
    picture_px: int = Field(default=2000, ge=16, le=20_000)
    """Longest edge of the PNG picture (pixels), before empty margins are cut off; a pixel is a whole number of
    cells."""
    sheet_m: float | None = Field(default=None, gt=0)
    """Edge of a sheet (m), rounded down to whole tiles; a survey no larger than that is one file. Left out, an
    edge has 20,000 cells: 1000 m at cells of 5 cm."""


class Hillshade(SurveyProduct):
    """8-bit hillshade (Horn 1981) as a cloud-optimised GeoTIFF, and a PNG picture of the whole survey.

    Values are 1 (in the shade) to 255 (facing the light); 0, transparent in the picture, is empty. Slopes
    across the borders of tiles and sheets use the neighbour's cells, so no seam shows. In the picture a
    pixel of several cells is the mean of their heights, shaded after the averaging.
    """

    name: ClassVar[str] = "hillshade"
    title: ClassVar[str] = "shaded relief of the surface, as a GeoTIFF and as a picture for pages and reports"
    version: ClassVar[int] = 2
    options: ClassVar[type[Strict]] = HillshadeOptions
    default_cells: ClassVar[Cells] = "coarse"

    def outputs(self, tiles: Sequence[TileId], options: Strict, context: ProductContext) -> list[Output]:
        """Sheets, the index that joins them, and the picture."""
        return shaded_outputs(tiles, cast(HillshadeOptions, options).sheet_m, context.grid)

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
        sheet = sheet_of(STEM, output, settings.sheet_m, context.grid)
        if output.name == index_name(STEM):
            sheets = cut_sheets(STEM, output.tiles, settings.sheet_m, context.grid)
            write_index(path, sheets, SHADE_BAND, "uint8", context)
        elif output.name == PICTURE:
            _write_picture(sorted(output.tiles), load_cells, settings, context, path)
        elif sheet is not None:
            surface = Surface(output.tiles, base_below(tiles, output), load_cells)
            _write_sheet(sheet, surface, settings, dated(context, tiles, output.tiles), path)
        else:
            raise unknown_output(output)

    def check(self, path: Path) -> None:
        """Decode all of a sheet or picture; of an index, check its geometry."""
        with path.open("rb") as stream:
            start = stream.read(1)
        if start == PNG_SIGNATURE[:1]:
            check_picture(path, "LA")
        else:
            check_sheet(path)


@dataclass(frozen=True)
class Surface:
    """Tiles whose heights are drawn, relative to a base near them to keep float arithmetic precise."""

    tiles: Sequence[TileId]
    base_m: float
    load_cells: LoadCells

    def images(self) -> Iterator[tuple[TileId, Float64]]:
        """Yield tiles and their (rows, columns) heights above the base (m), NaN where no point lies; row by row."""
        for tile in sorted(self.tiles, key=lambda t: (-t.row, t.column)):
            cells = values_in(tile, _HEIGHT, self.load_cells)
            yield tile, cell_image(cells, cells.values - self.base_m, "float64")


class Light(Protocol):
    """Settings of a shaded picture."""

    @property
    def azimuth_deg(self) -> float:
        """Direction of the light, clockwise from map north (degrees)."""

    @property
    def altitude_deg(self) -> float:
        """Height of the light above the horizon (degrees)."""

    @property
    def z_factor(self) -> float:
        """Exaggeration of the heights."""


def shade(
    heights_m: npt.NDArray[np.floating[Any]], cell_m: float, options: Light, cell_north_m: float | None = None
) -> npt.NDArray[np.uint8]:
    """Return the shade of the inner cells of (rows + 2, columns + 2) heights: 1 to 255, 0 where unknown.

    Parameters
    ----------
    heights_m : north up, NaN where unknown. A missing neighbour is the continuation of the opposite one through the
        centre, or level with the centre where that is missing too.
    cell_m : edge of a cell (m); that towards east, where that towards north is stated.
    """
    azimuth, altitude = math.radians(options.azimuth_deg), math.radians(options.altitude_deg)
    horizontal, exaggeration = math.cos(altitude), options.z_factor / 8.0
    heights = np.array(heights_m, np.float64, order="C")  # one kind of array, for which the kernel is compiled
    picture = np.empty((heights.shape[0] - 2, heights.shape[1] - 2), np.uint8)
    shade_raster(
        heights, exaggeration / cell_m, exaggeration / (cell_north_m or cell_m),
        horizontal * math.sin(azimuth), horizontal * math.cos(azimuth), math.sin(altitude), picture,
    )  # fmt: skip
    return picture


def with_empty_rim(heights_m: Float64) -> Float64:
    """Return (rows + 2, columns + 2) heights with unknown ones around them."""
    return np.pad(heights_m, 1, constant_values=np.nan)


def shaded_outputs(tiles: Sequence[TileId], sheet_m: float | None, grid: TileGrid) -> list[Output]:
    """Return sheets with the neighbours that their slopes need, the index that joins them, and the picture of all."""
    everything = tuple(sorted(tiles))
    sheets, known = cut_sheets(STEM, everything, sheet_m, grid), frozenset(everything)
    found = [Output(sheet.name, with_neighbours(sheet, known)) for sheet in sheets]
    found += index_output(STEM, sheets)
    return [*found, Output(PICTURE, everything)] if everything else []


def with_neighbours(sheet: Sheet, everything: frozenset[TileId]) -> tuple[TileId, ...]:
    """Return the tiles of a sheet and those of the survey that touch one of them, in order.

    A sheet has all of the survey's tiles within its box, so only those at the box's rim have others around them.
    """
    columns, rows = ({of(t[k] for t in sheet.tiles) for of in (min, max)} for k in (0, 1))
    rim = [t for t in sheet.tiles if t.column in columns or t.row in rows]
    around = {TileId(t.column + right, t.row + up) for t in rim for right in (-1, 0, 1) for up in (-1, 0, 1)}
    return tuple(sorted([*sheet.tiles, *(around & everything).difference(sheet.tiles)]))


def base_below(tiles: Sequence[TileSummary], output: Output) -> float:
    """Return whole metres at or below the lowest height of the tiles of `output`."""
    members = set(output.tiles)
    return float(math.floor(min(one.height_min_m for one in tiles if one.tile in members)))


def _write_sheet(
    sheet: Sheet, surface: Surface, options: HillshadeOptions, context: ProductContext, path: Path
) -> None:
    from rasterio.windows import Window

    box = CellBox.around(sheet.tiles, context.grid)
    shaded = SparseRaster(box, SHADE_BAND, "uint8", _EMPTY, context)
    with raster_settings(), shaded.cog(path) as raster, _heights(surface, box, context, path) as heights:
        for block in box.blocks_under(sheet.tiles, context.grid.cells_per_edge):
            halo = Window(block.col_off, block.row_off, block.width + 2, block.height + 2)
            raster.write(shade(heights.read(1, window=halo), context.grid.cell_m, options), 1, window=block)


@contextmanager
def _heights(surface: Surface, box: CellBox, context: ProductContext, path: Path) -> Iterator[Any]:
    """Write heights over `box` and one cell around it into a scratch raster."""
    around = SparseRaster(box.grown(1), Band("height", "metre"), "float64", np.nan, context)
    with around.scratch(path.with_name(path.name + ".heights.scratch")) as raster:
        for tile, image in surface.images():
            paste_tile(raster, around.box, tile, image)
        yield raster


def _write_picture(
    tiles: Sequence[TileId], load_cells: LoadCells, options: HillshadeOptions, context: ProductContext, path: Path
) -> None:
    box = CellBox.around(tiles, context.grid)
    step = -(-max(box.width, box.height) // options.picture_px)
    heights_m = _mean_heights(tiles, load_cells, box, step).trimmed()
    cell_m = step * context.grid.cell_m
    write_picture(path, shade(with_empty_rim(heights_m), cell_m, options))


def _mean_heights(tiles: Sequence[TileId], load_cells: LoadCells, box: CellBox, step: int) -> MeanPixels:
    """Return means of the heights in pixels of `step` squared cells, north up."""
    pixels = MeanPixels.over(box.height, box.width, (step, step))
    for tile in tiles:
        cells = values_in(tile, _HEIGHT, load_cells)
        edge = cells.cells_per_edge
        column = tile.column * edge - box.west + cells.column.astype(np.int64)
        pixels.add(box.north - 1 - tile.row * edge - cells.row.astype(np.int64), column, cells.values)
    return pixels
