"""``geotiff``: height, intensity and count of a tile's cells."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.core.strict import Strict
from roadscan.store.codecs.cog import Image, check_cog, sparse_image, write_cog
from roadscan.tiles.cells import Level, pyramid_of
from roadscan.tiles.product import ProductContext, Tile, TileProduct
from roadscan.tiles.products.raster import CellBox, Quantity, about, band_of

STEPS: Final[dict[Quantity, float]] = {
    "height": 2.0**-15,
    "intensity": 1.0,
    "count": 1.0,
    "height_std": 2.0**-20,
}
"""Pixels are whole multiples of this. Bits below it are noise that takes time and room; float32 itself has no finer
heights from 256 m on."""

_SMALLEST_OVERVIEW: Final = 32  # Fewest pixels along an edge of an overview.


class GeoTiffOptions(Strict):
    """Settings of `geotiff`."""

    bands: tuple[Quantity, ...] = Field(default=("height", "intensity", "count"), min_length=1)
    """Bands in their order: height (robust, rounded to 2⁻¹⁵ of its unit), intensity (mean, rounded to a whole
    number), count (points), height_std (standard deviation of the heights, rounded to 2⁻²⁰ of the unit)."""


class GeoTiff(TileProduct):
    """One cloud-optimised GeoTIFF a tile: float32 bands, NaN where no point lies, and overviews.

    The bands are the robust height (in the unit of the map's heights), the mean intensity and the number of
    points; the standard deviation of the heights can be added. The georeference is in the CRS's unit.
    Overviews have pixels of 2, 8 and 32 cells, or the numbers nearest to these that divide the tile (10, 40 and
    200 mm for 10 m tiles of 5 mm cells), while they are 32 pixels or more: the mean of the cells' heights, the mean
    intensity of all points, the mean number of points a cell that holds one.

    Images are DEFLATE in blocks of up to 512 pixels, those without a cell left out.

    The metadata items `ROADSCAN_SIGMA_HEIGHT_M` and `ROADSCAN_SIGMA_HORIZONTAL_M` state the largest 1 σ (metres) of the
    poses that placed the tile's readings, after the adjustment, as the table `tiles` does; they are left out where a
    trajectory states no σ. They say nothing of the noise of single readings, which the band height_std shows.
    """

    name: ClassVar[str] = "geotiff"
    title: ClassVar[str] = "cells of a tile as a GeoTIFF (height, intensity, count) with overviews, for GIS"
    suffix: ClassVar[str] = ".tif"
    version: ClassVar[int] = 6
    options: ClassVar[type[Strict]] = GeoTiffOptions

    def write(self, tile: Tile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the tile's bands; only blocks that hold a cell are made."""
        bands = cast(GeoTiffOptions, options).bands
        images = [_image(tile, bands, context), *_overviews(tile, bands, context)]
        place = CellBox.around([tile.cells.tile], context.grid).transform(context)
        of_bands = [band_of(b, context) for b in bands]
        write_cog(path, images, about(place, of_bands, context, tile.cells.tile, _sigmas(tile)))

    def check(self, path: Path) -> None:
        """Compare every byte with the stored digest."""
        check_cog(path)


def _sigmas(tile: Tile) -> list[tuple[str, str]]:
    """Return metadata items of the σ that are known."""
    known = (("HEIGHT", tile.sigma_height_m), ("HORIZONTAL", tile.sigma_horizontal_m))
    return [(f"ROADSCAN_SIGMA_{name}_M", f"{sigma_m:.6f}") for name, sigma_m in known if sigma_m is not None]


def _image(tile: Tile, bands: tuple[Quantity, ...], context: ProductContext) -> Image:
    cells, unit_m = tile.cells, context.map.vertical_unit_m
    sources: dict[Quantity, tuple[npt.NDArray[Any], float]] = {
        "height": (cells.height_robust_m, 1 / unit_m),
        "intensity": (cells.intensity_mean, 1.0),
        "count": (cells.count, 1.0),
        "height_std": (cells.height_std_m, 1 / unit_m),
    }
    return sparse_image(cells.cells_per_edge, cells.column, cells.row, ((*sources[b], STEPS[b]) for b in bands))


def _overviews(tile: Tile, bands: tuple[Quantity, ...], context: ProductContext) -> list[Image]:
    cells, unit_m = tile.cells, context.map.vertical_unit_m
    edge = cells.cells_per_edge
    levels = [level for level in tile.overviews if edge // level.factor >= _SMALLEST_OVERVIEW]
    spread = levels
    if "height_std" in bands:
        deviations = cells.height_std_m.astype(np.float64)
        factors = [level.factor for level in levels]
        spread = pyramid_of(dataclasses.replace(cells, height_robust_m=deviations), factors)
    sources: dict[Quantity, Callable[[Level, Level], tuple[npt.NDArray[Any], float]]] = {
        "height": lambda level, _: (level.height_m, 1 / unit_m),
        "intensity": lambda level, _: (level.intensity, 1.0),
        "count": lambda level, _: (level.count / level.cells, 1.0),
        "height_std": lambda _, of_std: (of_std.height_m, 1 / unit_m),
    }
    return [
        sparse_image(
            edge // level.factor, level.column, level.row, [(*sources[b](level, of_std), STEPS[b]) for b in bands]
        )
        for level, of_std in zip(levels, spread, strict=True)
    ]
