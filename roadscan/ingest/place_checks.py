"""Finds records where no road is: points outside the area of their CRS, fixes at latitude 0, longitude 0. One such
place would enlarge every extent, so it is left out before its row is stored.
"""

from __future__ import annotations

import functools
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyproj
from pyproj.exceptions import ProjError

from roadscan.compute.array_types import Bool, Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import RoadscanError
from roadscan.core.witness import Witness
from roadscan.ingest.reading.format import LogHeader
from roadscan.ingest.reading.records import GRID_MAX_M

VERSION: Final = 2
"""Raised when other records are left out, so that logs of clouds and GNSS are read again."""

FAR_POINT: Final = Witness(
    "far_point",
    input="cloud",
    fault="Single points lie far away: a coordinate overflowed when a program wrote the file.",
    asks="the area in which the cloud's CRS is used, as PROJ states it",
    does="a point over 10° outside that area is left out",
    told=("rejects",),
)
NO_FIX_GNSS: Final = Witness(
    "gnss_no_fix",
    input="gnss, imu, encoder",
    fault="A receiver without a fix writes latitude 0, longitude 0 as if it were a place.",
    asks="the position: 0, 0 to the millimetre, or the centre of the Earth",
    does="such an epoch is left out",
    told=("rejects",),
)

BEYOND_DEG: Final = 10.0
"""Points farther outside the area of their CRS are left out, as `preflight` refuses such positions (degrees)."""
NO_FIX: Final = "the position is latitude 0, longitude 0, or the centre of the Earth: there was no fix"
_OUTSIDE: Final = f"the point lies over {BEYOND_DEG:g}° outside the area of the cloud's CRS"
_NO_FIX_M: Final = 1e-3  # positions this near to latitude 0, longitude 0, or to the Earth's centre are no fix

PLACED: Final = ("cloud", "gnss")
"""Tables whose rows are checked."""

Fault = tuple[npt.NDArray[np.int64], str]


def place_faults(table: str, batch: pa.RecordBatch, header: LogHeader) -> list[Fault]:
    """Return the rows of a batch where no road is, with the reason; none for tables that are not in `PLACED`."""
    if table == "cloud":
        return _cloud_faults(batch, header.attributes)
    if table == "gnss" and header.attributes.get("world_frame", LOCAL_WORLD) != LOCAL_WORLD:
        world = _columns(batch, "x_world_m", "y_world_m", "z_world_m")
        return _faults((without_fix(world), NO_FIX))
    return []


def without_fix(position_world_m: Float64) -> Bool:
    """Return which geocentric positions (n, 3) are latitude 0, longitude 0, or the centre of the Earth."""
    with np.errstate(invalid="ignore"):
        x, y, z = position_world_m.T
        at_zero: Bool = (np.hypot(y, z) < _NO_FIX_M) & (x > -_NO_FIX_M)
    return at_zero


def _cloud_faults(batch: pa.RecordBatch, attributes: dict[str, Any]) -> list[Fault]:
    x, y = _columns(batch, "x_m", "y_m").T
    west, south, east, north = _box_m(str(attributes.get("crs") or LOCAL_WORLD))
    return _faults((~((x >= west) & (x <= east) & (y >= south) & (y <= north)), _OUTSIDE))


def _columns(batch: pa.RecordBatch, *names: str) -> Float64:
    values = [batch.column(name).to_numpy(zero_copy_only=False) for name in names]
    return np.stack(values, axis=-1).astype(np.float64)


def _faults(*found: tuple[Bool, str]) -> list[Fault]:
    return [(np.flatnonzero(bad), reason) for bad, reason in found if bad.any()]


@functools.lru_cache(maxsize=64)
def _box_m(crs: str) -> tuple[float, float, float, float]:
    """Return west, south, east, north (m) of a CRS's area and 10° around it; of the whole Earth where it has none."""
    whole = (-GRID_MAX_M, -GRID_MAX_M, GRID_MAX_M, GRID_MAX_M)
    try:
        known = None if crs == LOCAL_WORLD else crs_from_text(crs)
    except RoadscanError:
        return whole
    area = None if known is None else known.area_of_use
    if known is None or area is None or known.geodetic_crs is None or not known.is_projected:
        return whole
    south, north = max(area.south - BEYOND_DEG, -89.0), min(area.north + BEYOND_DEG, 89.0)
    longitudes = np.linspace(area.west - BEYOND_DEG, area.west + (area.east - area.west) % 360.0 + BEYOND_DEG, 41)
    degrees = np.stack(np.meshgrid(longitudes, np.linspace(south, north, 41)), axis=-1).reshape(-1, 2)
    unit_m = float(known.axis_info[0].unit_conversion_factor)
    try:
        to_map = pyproj.Transformer.from_crs(known.geodetic_crs, known.to_2d(), always_xy=True)
        places = np.stack(to_map.transform(*degrees.T), axis=-1) * unit_m
    except ProjError:
        return whole
    places = places[np.isfinite(places).all(axis=1)]
    low, high = (places.min(axis=0), places.max(axis=0)) if len(places) else (whole[:2], whole[2:])
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
