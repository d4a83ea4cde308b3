"""``surface``: the reconstructed surface of a tile as a GeoTIFF."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar, Final, Literal, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field
from rasterio.transform import Affine

from roadscan.model.strict import Strict
from roadscan.products.base import ProductContext, SurfaceProduct
from roadscan.products.geotiff import BLOCK, description, layout
from roadscan.products.packer import Packer
from roadscan.products.raster import Band, height_unit
from roadscan.products.tiff import Page, check_tiff, tiff_parts
from roadscan.surfaces.tile import EMPTY, SurfaceTile

SurfaceBand = Literal["height", "raw_height", "origin", "intensity"]
Float32 = npt.NDArray[np.float32]

HEIGHT_STEP: Final = 2.0**-15
"""Heights are whole multiples of this, in the unit of the map's heights, as those of `geotiff`."""

_OVERVIEWS: Final = (4, 16)
_SMALLEST_OVERVIEW: Final = 32


class SurfaceOptions(Strict):
    """Settings of `surface`."""

    bands: tuple[SurfaceBand, ...] = Field(default=("height", "origin", "intensity"), min_length=1)
    """Bands in their order: height (smoothed) and raw_height (as measured), both rounded to 2⁻¹⁵ of their unit; origin
    (1 measured, 2 interpolated, 3 filled); intensity (rounded to a whole number)."""


class Surface(SurfaceProduct):
    """One cloud-optimised GeoTIFF a tile: float32 bands, NaN where there is no surface, and overviews.

    Pixels are the cells of the surface's own grid, north up, in the CRS's own unit: those whose centre lies in the
    tile. Overviews have pixels of 4 and 16 cells, while they are 32 pixels or more: the mean of the heights and
    intensities, the best of the origins.
    """

    name: ClassVar[str] = "surface"
    title: ClassVar[str] = "reconstructed surface of a tile as a GeoTIFF (smoothed height, origin, intensity), for GIS"
    suffix: ClassVar[str] = ".tif"
    options: ClassVar[type[Strict]] = SurfaceOptions

    def write(self, surface: SurfaceTile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the tile's bands; only blocks that hold a height are made."""
        names = cast(SurfaceOptions, options).bands
        bands = [_band(name, surface, context) for name in names]
        packer = Packer()
        pages = [_page(bands, False, packer)]
        for factor in _OVERVIEWS:
            if min(bands[0].shape) >= factor * _SMALLEST_OVERVIEW:
                small = [_reduced(b, factor, name == "origin") for b, name in zip(bands, names, strict=True)]
                pages.append(_page(small, True, packer))
        about = description(surface.tile, _place(surface, context), [_of(n, context) for n in names], context)
        first = dataclasses.replace(pages[0], tags=(*pages[0].tags, *about))
        with path.open("wb") as stream:
            stream.writelines(tiff_parts([first, *pages[1:]]))

    def check(self, path: Path) -> None:
        """Compare every byte with the stored digest."""
        check_tiff(path)


def _of(name: SurfaceBand, context: ProductContext) -> Band:
    unit = height_unit(context.map)
    return {
        "height": Band("height", unit),
        "raw_height": Band("height before smoothing", unit),
        "origin": Band("origin: 1 measured, 2 interpolated, 3 filled", ""),
        "intensity": Band("intensity", "digital number"),
    }[name]


def _band(name: SurfaceBand, surface: SurfaceTile, context: ProductContext) -> Float32:
    """(rows, columns) of the tile itself, north up."""
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
    """Means of `factor` squared pixels, or their least; NaN where none is known."""
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


def _page(bands: list[Float32], reduced: bool, packer: Packer) -> Page:
    """Encode and compress an image, block by block."""
    height, width = bands[0].shape
    edge = min(BLOCK, -(-max(height, width) // 16) * 16)
    blocks = [
        _block(band[top : top + edge, left : left + edge], edge, packer)
        for band in bands
        for top in range(0, height, edge)
        for left in range(0, width, edge)
    ]
    return Page(layout(width, height, edge, len(bands), reduced), blocks)


def _block(part: Float32, edge: int, packer: Packer) -> bytes | None:
    """One block after TIFF's floating-point predictor (TIFF Technical Note 3): bytes by significance, differenced."""
    if np.isnan(part).all():
        return None
    whole = np.full((edge, edge), np.nan, ">f4")
    whole[: part.shape[0], : part.shape[1]] = part
    planes = whole.view(np.uint8).reshape(edge, edge, 4).transpose(0, 2, 1).reshape(edge, 4 * edge)
    coded = planes.copy()
    np.subtract(planes[:, 1:], planes[:, :-1], out=coded[:, 1:])
    return packer.pack(coded.ravel())


def _place(surface: SurfaceTile, context: ProductContext) -> Affine:
    """Map position, in the CRS's own unit, of a (column, row) counted from the north-west corner."""
    box, unit_m = surface.window.grown(-surface.halo).bounds(), context.map.horizontal_unit_m
    east, north = (edge / unit_m for edge in surface.cell_m)
    return Affine(east, 0.0, box.easting_min_m / unit_m, 0.0, -north, box.northing_max_m / unit_m)
