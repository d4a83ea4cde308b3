"""Settings of GDAL (through rasterio) for raster products."""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from roadscan.core.crs import MapFrame

if TYPE_CHECKING:
    from rasterio.crs import CRS

_CACHE_BYTES: Final = 64 * 2**20  # block cache of GDAL


@functools.lru_cache(maxsize=16)
def raster_crs(frame: MapFrame) -> CRS:
    """Return the CRS of the map for rasterio, compound where a vertical CRS is named."""
    from rasterio.crs import CRS

    return CRS.from_wkt(frame.wkt())


@contextlib.contextmanager
def raster_settings() -> Iterator[None]:
    """Run GDAL with one file per raster, one thread, and a block cache of constant size."""
    import rasterio

    with rasterio.Env(GDAL_PAM_ENABLED="NO", GDAL_NUM_THREADS="1", GDAL_CACHEMAX=_CACHE_BYTES):
        yield


@contextlib.contextmanager
def without_place_warning() -> Iterator[None]:
    """Suppress rasterio's warning about files without georeference, such as pictures."""
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield
