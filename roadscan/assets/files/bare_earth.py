"""Bare earth of a square as a GeoTIFF: seen heights, and interpolated ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from roadscan.assets.scene import GroundModel
from roadscan.core.errors import StoreError
from roadscan.store.codecs.cog import Band, dense_image, write_cog
from roadscan.store.codecs.tiff import raster_settings
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.raster import about, height_unit


def write_bare_earth(path: Path, model: GroundModel, corner_m: tuple[float, float], context: ProductContext) -> None:
    """Write three bands: heights of cells where the ground was seen, heights with the holes bridged, and their 1 σ.

    A hole (under a vehicle, in the shade of a wall) is NaN in the first band; NaN in the second is not known at all.

    Parameters
    ----------
    corner_m : easting and northing of the corner that the model counts from.
    """
    from rasterio.transform import Affine

    unit_m, height_m = context.map.horizontal_unit_m, context.map.vertical_unit_m
    rows = model.height_m.shape[0]
    west = (corner_m[0] + model.x_min_m) / unit_m
    north = (corner_m[1] + model.y_min_m + rows * model.cell_m) / unit_m
    pixel = model.cell_m / unit_m
    place = Affine(pixel, 0.0, west, 0.0, -pixel, north)
    height = (model.height_m / height_m).astype(np.float32)[::-1]
    seen = np.where(model.seen[::-1], height, np.float32(np.nan)).astype(np.float32)
    unit = height_unit(context.map)
    sigma = np.full(height.shape, np.nan, np.float32)
    if model.sigma_m is not None:
        sigma = (model.sigma_m / height_m).astype(np.float32)[::-1]
    bands = [Band(f"bare earth, {what}", unit) for what in ("seen", "holes bridged", "1 sigma")]
    image = dense_image([np.ascontiguousarray(band) for band in (seen, height, sigma)])
    write_cog(path, [image], about(place, bands, context))


def read_bare_earth(content: bytes, corner_m: tuple[float, float], context: ProductContext) -> GroundModel:
    """Returns the model that :func:`write_bare_earth` wrote, from the corner that is given.

    Raises
    ------
    StoreError
        where the content is no such file.
    """
    import rasterio

    unit_m, height_m = context.map.horizontal_unit_m, context.map.vertical_unit_m
    try:
        with raster_settings(), rasterio.MemoryFile(content) as file, file.open() as raster:
            bands: npt.NDArray[np.float32] = raster.read()
            place = raster.transform
    except rasterio.errors.RasterioError as error:
        raise StoreError(f"the bare earth cannot be read: {error}", change="make it again") from error
    rows = bands.shape[1]
    cell_m = place.a * unit_m
    seen, height, sigma = (np.ascontiguousarray(band[::-1]) for band in bands)
    return GroundModel(
        place.c * unit_m - corner_m[0], place.f * unit_m - rows * cell_m - corner_m[1], cell_m,
        height * np.float32(height_m), ~np.isnan(seen), sigma * np.float32(height_m),
    )  # fmt: skip
