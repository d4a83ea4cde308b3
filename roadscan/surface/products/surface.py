"""``surface``: the reconstructed surface of a tile as a GeoTIFF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, Literal, cast

import numpy as np
from pydantic import Field

from roadscan.compute.array_types import Float32
from roadscan.core.strict import Strict
from roadscan.store.codecs.cog import Band, dense_image, write_cog
from roadscan.store.codecs.tiff import check_cog
from roadscan.surface.tile import EMPTY, SurfaceTile
from roadscan.tiles.product import ProductContext, SurfaceProduct
from roadscan.tiles.products.raster import about, height_unit

if TYPE_CHECKING:
    from rasterio.transform import Affine

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
