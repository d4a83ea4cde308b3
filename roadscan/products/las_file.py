"""How every point product lies in its file: LAS 1.4, its CRS as WKT, coordinates in the CRS's own unit, a digest."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt
from laspy.header import GpsTimeType
from laspy.vlrs.known import WktCoordinateSystemVlr
from lazrs import LazrsError
from pyproj.exceptions import CRSError

from roadscan.model.crs import MapFrame
from roadscan.model.errors import ConfigError, CrsError, StoreError
from roadscan.points.cloud import QUANTA_PER_M
from roadscan.products.base import ProductContext
from roadscan.products.raster import SOFTWARE

VLR_USER_ID: Final = "roadscan"
VLR_RECORD_ID: Final = 1

ONE_OF_ONE: Final = 0x11
"""Return number and number of returns in the byte that holds both."""

_CHUNK_POINTS: Final = 1_000_000
_INT32_MAX: Final = 2**31 - 1


@dataclass(frozen=True)
class Axis:
    """One coordinate as LAS stores it: value = stored · scale + offset, in the CRS's unit."""

    stored: npt.NDArray[np.int32]
    scale: float
    offset: float
    error_max_m: float
    """Largest difference between a point and what a reader gets back (m)."""


Axes = tuple[Axis, Axis, Axis]


def axis(quanta: npt.NDArray[Any], corner_quanta: int, scale_m: float, unit_m: float, product: str) -> Axis:
    """Store `quanta` (n,) from `corner_quanta`; offsets are whole units, so that all tiles share one lattice.

    Raises :class:`ConfigError` where the scale is too fine for 32 bits.
    """
    unit_quanta = QUANTA_PER_M * unit_m
    scale = _scale(scale_m, unit_m)
    offset = float(math.floor(corner_quanta / unit_quanta))
    steps = np.rint((quanta + (corner_quanta - offset * unit_quanta)) / (unit_quanta * scale))
    if steps.size and np.abs(steps).max() > _INT32_MAX:
        raise ConfigError(f"{product}.scale_m = {scale_m:g} is too fine for these coordinates", change="make it larger")
    true_m = (quanta.astype(np.float64) + corner_quanta) / QUANTA_PER_M
    error_m = np.abs((steps * scale + offset) * unit_m - true_m)
    return Axis(steps.astype(np.int32), scale, offset, float(error_m.max(initial=0.0)))


def rounding_errors(axes: Axes) -> dict[str, float]:
    """Largest rounding error of each coordinate (m), to the nanometre."""
    return {name: round(one.error_max_m, 9) for name, one in zip("xyz", axes, strict=True)}


def new_header(point_format: int, axes: Axes, context: ProductContext, product: str) -> laspy.LasHeader:
    """Header of LAS 1.4 with scales, offsets, CRS and date, all of them the same whenever it is made."""
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales = np.array([one.scale for one in axes])
    header.offsets = np.array([one.offset for one in axes])
    header.creation_date = context.date
    header.generating_software = SOFTWARE
    header.system_identifier = "OTHER"
    header.global_encoding.gps_time_type = GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    header.vlrs.append(WktCoordinateSystemVlr(_wkt1(context.map, product)))
    return header


def set_coordinates(record: Any, axes: Axes) -> None:
    """Fill the three coordinates of a point record."""
    for name, one in zip("XYZ", axes, strict=True):
        record[name] = one.stored


def write_points(path: Path, header: laspy.LasHeader, record: Any, facts: Mapping[str, Any], compress: bool) -> None:
    """Write a whole file: the points, and `facts` with a digest of the points in a variable-length record."""
    digest = _Digest(header)
    digest.add(record.array)
    stated = json.dumps({**facts, "blake2b": digest.text()}, sort_keys=True).encode("ascii")
    header.vlrs.append(laspy.VLR(VLR_USER_ID, VLR_RECORD_ID, "survey, tile, rounding", stated))
    backend = laspy.LazBackend.Lazrs if compress else None
    with path.open("wb") as stream:
        writer = laspy.LasWriter(stream, header, do_compress=compress, laz_backend=backend, closefd=False)
        writer.write_points(record)
        writer.close()


def check_points(path: Path) -> None:
    """Decode every point and compare number, box and digest with what the header states."""
    try:
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            _check_points(reader, path)
    except (laspy.LaspyException, LazrsError, OSError, ValueError, EOFError) as error:
        raise StoreError(f"the point file cannot be read: {error}", change="make it again", file=path) from error


def _scale(scale_m: float, unit_m: float) -> float:
    if unit_m == 1.0:
        return scale_m
    exponent = math.floor(math.log10(scale_m / unit_m))
    leading = scale_m / unit_m / 10.0**exponent
    step = max(digit for digit in (1, 2, 5) if digit <= leading or digit == 1)
    return float(f"{step}e{exponent}")


@functools.lru_cache(maxsize=16)
def _wkt1(frame: MapFrame, product: str) -> str:
    try:
        return frame.wkt("WKT1_GDAL")
    except CRSError as error:
        raise CrsError(
            f"map.crs '{frame.crs}' cannot be written as WKT 1",
            expected="a CRS that LAS 1.4 can state (WKT of OGC 01-009)",
            change=f"choose another CRS, or leave the product '{product}' out",
        ) from error


class _Digest:
    """BLAKE2b (128 bits) of point records as they lie in a LAS file, and of what gives them their place."""

    def __init__(self, header: laspy.LasHeader) -> None:
        self._state = hashlib.blake2b(digest_size=16)
        wkt = [vlr.string for vlr in header.vlrs.get("WktCoordinateSystemVlr")]
        self._state.update(repr((header.scales.tolist(), header.offsets.tolist(), wkt)).encode())

    def add(self, records: npt.NDArray[np.void]) -> None:
        self._state.update(np.ascontiguousarray(records).view(np.uint8).data)

    def text(self) -> str:
        return self._state.hexdigest()


def _check_points(reader: laspy.LasReader, path: Path) -> None:
    header = reader.header
    stated = _stated_facts(header, path)
    digest, count = _Digest(header), 0
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for chunk in _chunks(reader):
        count += len(chunk)
        digest.add(chunk.array)
        xyz = np.stack([chunk.x, chunk.y, chunk.z])
        low, high = np.minimum(low, xyz.min(axis=1)), np.maximum(high, xyz.max(axis=1))
    if count != header.point_count or count == 0:
        raise StoreError(f"{count} points", expected=f"the {header.point_count} of the header", file=path)
    if not (np.allclose(low, header.mins, atol=1e-9) and np.allclose(high, header.maxs, atol=1e-9)):
        raise StoreError("points lie outside the header's box", change="make the file again", file=path)
    if digest.text() != stated.get("blake2b"):
        raise StoreError("the points do not match their digest", change="make the file again", file=path)


def _chunks(reader: laspy.LasReader) -> Iterator[Any]:
    for chunk in reader.chunk_iterator(_CHUNK_POINTS):
        if len(chunk) == 0:
            return
        yield chunk


def _stated_facts(header: laspy.LasHeader, path: Path) -> dict[str, Any]:
    records = [v for v in header.vlrs if v.user_id == VLR_USER_ID and v.record_id == VLR_RECORD_ID]
    if not records or not header.global_encoding.wkt:
        raise StoreError("the file has no CRS or no record of roadscan", change="make the file again", file=path)
    facts: dict[str, Any] = json.loads(records[0].record_data)
    return facts
