"""``pavement_intensity``, ``pavement_shaded``: what the pavement looks like, a picture a tile and a pixel a cell."""

from __future__ import annotations

import math
from abc import abstractmethod
from pathlib import Path
from typing import ClassVar, Final, Literal, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from roadscan.core.strict import Strict
from roadscan.store.codecs import SOFTWARE
from roadscan.store.codecs.image_files import check_picture, check_world_file, world_file, write_bmp, write_png
from roadscan.tiles.cells import TileCells
from roadscan.tiles.kernels.grey_pictures import grey_intensity, shade_cells
from roadscan.tiles.product import ProductContext, Tile, TileProduct
from roadscan.tiles.products.raster import CellBox

_WORLD_FILES: Final = {"png": ".pgw", "bmp": ".bpw"}


class PictureOptions(Strict):
    """Settings of all pictures of the pavement."""

    format: Literal["png", "bmp"] = "png"
    """Portable Network Graphics, compressed without loss and transparent where nothing was seen, or an uncompressed
    bitmap, black there."""


class IntensityOptions(PictureOptions):
    """Settings of the intensity picture."""

    black: float = Field(default=0.0)
    """Intensity (digital number) that is drawn black. The same for all tiles, so that their pictures match."""
    white: float = Field(default=65_535.0)
    """Intensity (digital number) that is drawn white; 65,535 is the brightest that a sensor says, of 8 bits or 16."""

    @model_validator(mode="after")
    def _in_order(self) -> IntensityOptions:
        if self.black >= self.white:
            raise ValueError(f"black {self.black:g} is not below white {self.white:g}")
        return self


class ShadedOptions(PictureOptions):
    """Settings of the shaded picture."""

    azimuth_deg: float = Field(default=315.0, ge=0, lt=360)
    """Where the light comes from, clockwise from map north (degrees)."""
    altitude_deg: float = Field(default=45.0, gt=0, le=90)
    """Height of the light above the horizon (degrees)."""
    z_factor: float = Field(default=1.0, gt=0)
    """Exaggeration: heights are multiplied by this."""


class _Picture(TileProduct):
    """A picture of the part of a tile with cells, and a world file beside it."""

    suffix: ClassVar[str] = ".png"
    version: ClassVar[int] = 3
    default: ClassVar[bool] = False
    smooth: ClassVar[bool]
    """True where lines of pixels resemble the line above them."""

    def suffix_for(self, options: Strict) -> str:
        """``.png`` or ``.bmp``."""
        return f".{cast(PictureOptions, options).format}"

    def companions(self, options: Strict) -> dict[str, str]:
        """Return the world file, with which a GIS georeferences the picture."""
        return {"place": _WORLD_FILES[cast(PictureOptions, options).format]}

    def write(self, tile: Tile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the picture and its world file."""
        kind = cast(PictureOptions, options).format
        box = _seen(tile.cells)
        picture = np.zeros((box.height, box.width), np.uint8)
        if len(tile.cells):
            self.draw(tile.cells, box, options, context, picture)
        cell_m = context.grid.cell_m
        if kind == "png":
            about = {"Software": SOFTWARE, "Title": f"{self.name} {context.survey_id} {tile.cells.tile}"}
            write_png(path, picture, cell_m, about, smooth=self.smooth)
        else:
            write_bmp(path, picture, cell_m)
        transform = _on_map(box, tile.cells, context).transform(context)
        path.with_suffix(_WORLD_FILES[kind]).write_text(world_file(transform), "ascii", newline="\n")

    @abstractmethod
    def draw(
        self,
        cells: TileCells,
        box: CellBox,
        options: Strict,
        context: ProductContext,
        picture: npt.NDArray[np.uint8],
    ) -> None:
        """Fill the picture (rows, columns) of `box`, in cells of the tile, with greys from 1 on."""

    def check(self, path: Path) -> None:
        """Decode a picture, of a world file its numbers."""
        if path.suffix in _WORLD_FILES.values():
            check_world_file(path)
        else:
            check_picture(path)


class PavementIntensity(_Picture):
    """8-bit grey picture of the mean intensity, a pixel a cell, north up, over the part of a tile that was seen.

    Grey is 1 at `black` and below, 255 at `white` and above, in even steps between; 0, transparent in a PNG, is
    empty. The world file beside it (``.pgw``, ``.bpw``) places it on the map, in the CRS's unit.
    """

    name: ClassVar[str] = "pavement_intensity"
    title: ClassVar[str] = "picture of the pavement's brightness, a pixel a cell (PNG or BMP with a world file)"
    options: ClassVar[type[Strict]] = IntensityOptions
    smooth: ClassVar[bool] = False

    def draw(
        self, cells: TileCells, box: CellBox, options: Strict, context: ProductContext, picture: npt.NDArray[np.uint8]
    ) -> None:
        """Draw the grey of each cell's intensity."""
        settings = cast(IntensityOptions, options)
        grey_intensity(
            cells.column, cells.row, cells.intensity_mean, settings.black, settings.white,
            box.west, box.north - 1, picture,
        )  # fmt: skip


class PavementShaded(_Picture):
    """8-bit shaded relief (Horn 1981) of the robust heights, a pixel a cell, as `hillshade` draws it.

    Values are 1 (in the shade) to 255 (facing the light); 0, transparent in a PNG, is empty. A tile's picture knows
    its cells alone: at its border the slope is that of its side. The world file beside it (``.pgw``, ``.bpw``)
    places it on the map, in the CRS's unit.
    """

    name: ClassVar[str] = "pavement_shaded"
    title: ClassVar[str] = "picture of the pavement in slanting light, a pixel a cell (PNG or BMP with a world file)"
    options: ClassVar[type[Strict]] = ShadedOptions
    smooth: ClassVar[bool] = True

    def draw(
        self, cells: TileCells, box: CellBox, options: Strict, context: ProductContext, picture: npt.NDArray[np.uint8]
    ) -> None:
        """Draw the shade of each cell."""
        settings = cast(ShadedOptions, options)
        azimuth, altitude = math.radians(settings.azimuth_deg), math.radians(settings.altitude_deg)
        level = math.cos(altitude)
        light = (level * math.sin(azimuth), level * math.cos(azimuth), math.sin(altitude))
        scale, *towards = (np.float32(v) for v in (settings.z_factor / (8.0 * context.grid.cell_m), *light))
        shade_cells(
            cells.column, cells.row, cells.height_robust_m, float(cells.height_robust_m[0]), scale, *towards,
            box.west, box.north - 1, np.empty((3, box.width + 2), np.float32), picture,
        )  # fmt: skip


def _seen(cells: TileCells) -> CellBox:
    """Return the smallest box around a tile's cells, relative to its corner; one cell where there are none."""
    if not len(cells):
        return CellBox(0, 0, 1, 1)
    west, south = int(cells.column.min()), int(cells.row[0])
    return CellBox(west, south, int(cells.column.max()) + 1 - west, int(cells.row[-1]) + 1 - south)


def _on_map(box: CellBox, cells: TileCells, context: ProductContext) -> CellBox:
    edge = context.grid.cells_per_edge
    return CellBox(cells.tile.column * edge + box.west, cells.tile.row * edge + box.south, box.width, box.height)
