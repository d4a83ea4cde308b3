"""Files of a square: its returns with their classes as LAZ, and bare earth as a GeoTIFF."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.classes import CLASS_NAMES
from roadscan.assets.scene import Box, GroundModel, Returns
from roadscan.core.errors import StoreError
from roadscan.core.grid import QUANTA_PER_M, TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.store.codecs.cog import Band, dense_image, raster_settings, write_cog
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.las import LasOptions, write_las
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


_OWN_CODES: Final = {code: name for code, name in CLASS_NAMES.items() if code >= 64}
"""LAS leaves the meaning of these codes to the file, which names them."""


def classified_points(returns: Returns, classes: npt.NDArray[np.uint8], square: TileId, tile: Box) -> TilePoints:
    """Returns returns (n,) of a square as points, each with its class (n,); `tile` is the square as they have it."""
    values = (returns.x_m, tile.x_min_m), (returns.y_m, tile.y_min_m), (returns.height_m, 0.0)
    quanta = [(np.rint(v * QUANTA_PER_M) - round(first * QUANTA_PER_M)).astype(np.int32) for v, first in values]
    return TilePoints(
        tile=square,
        x_quanta=quanta[0],
        y_quanta=quanta[1],
        height_quanta=quanta[2],
        epoch_gps_ns=returns.epoch_gps_ns,
        intensity=np.clip(np.rint(returns.intensity), 0, 65535).astype(np.uint16),
        classification=classes,
        pass_id=returns.pass_id,
        extra={"return_number": returns.return_number, "number_of_returns": returns.number_of_returns},
    )


def write_classified(path: Path, points: TilePoints, squares: TileGrid, context: ProductContext) -> None:
    """Write the points of a square (one or more) as LAZ, with the names of the user-defined classes."""
    codes, counts = np.unique(points.classification, return_counts=True)
    facts = {
        "survey": context.survey_id,
        "square": str(points.tile),
        "height": context.map.height,
        "classes": {str(code): int(count) for code, count in zip(codes.tolist(), counts.tolist(), strict=True)},
    }
    write_las(path, points, LasOptions(scale_m=1e-3), replace(context, grid=squares), facts, _OWN_CODES)
