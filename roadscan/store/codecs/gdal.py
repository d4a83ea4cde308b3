"""GDAL, by way of rasterio, as raster products need it."""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Iterator
from typing import Final

import rasterio
from rasterio.crs import CRS
from rasterio.errors import NotGeoreferencedWarning

from roadscan.core.crs import MapFrame

_CACHE_BYTES: Final = 64 * 2**20


@functools.lru_cache(maxsize=16)
def raster_crs(frame: MapFrame) -> CRS:
    """CRS of the map, compound where a vertical CRS is named, as rasterio holds it."""
    return CRS.from_wkt(frame.wkt())


@contextlib.contextmanager
def raster_settings() -> Iterator[None]:
    """GDAL with one file a raster, one thread, and a block cache that does not grow."""
    with rasterio.Env(GDAL_PAM_ENABLED="NO", GDAL_NUM_THREADS="1", GDAL_CACHEMAX=_CACHE_BYTES):
        yield


@contextlib.contextmanager
def without_place_warning() -> Iterator[None]:
    """Keep rasterio from warning of a file without georeference: a picture."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield
