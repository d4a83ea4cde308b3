"""How every point product lies in its file: LAS 1.4, its CRS as WKT, coordinates in the CRS's own unit, a digest."""

from __future__ import annotations

import datetime as dt
import functools
import hashlib
import io
import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import laspy
import lazrs
import numpy as np
import numpy.typing as npt
from blake3 import blake3
from laspy.header import GpsTimeType
from laspy.vlrs.known import LasZipVlr, WktCoordinateSystemVlr
from laspy.vlrs.vlrlist import VLRList
from lazrs import LazrsError
from pyproj.exceptions import CRSError

from roadscan.model.crs import MapFrame
from roadscan.model.errors import ConfigError, CrsError, StoreError
from roadscan.points.cloud import QUANTA_PER_M
from roadscan.products.laz_points import write_compressed
from roadscan.products.raster import SOFTWARE

VLR_USER_ID: Final = "roadscan"
VLR_RECORD_ID: Final = 1

ONE_OF_ONE: Final = 0x11
"""Return number and number of returns in the byte that holds both."""

_VLR: Final = struct.Struct("<H16sHH32s")
_ABOUT_FACTS: Final = b"survey, tile, rounding"
_DATE, _POINT_DATA, _VLRS, _OFFSETS, _COUNTS = 90, 96, 100, 155, 247
"""Places in the header of LAS 1.4."""
_EXTRA_BYTES, _LEAST, _GREATEST = 192, 64, 88
"""Of a further dimension: its description (LAS 1.4 R15, table 24), and places in it."""

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


@dataclass(frozen=True)
class Layout:
    """What the files of a product share: kind of points, their steps, the CRS."""

    point_format: int
    further: tuple[tuple[str, str, str], ...]
    """Further dimensions: name, NumPy type, description."""
    scales: tuple[float, ...]
    """Of the three coordinates."""
    map: MapFrame
    product: str
    """Named in errors."""

    @property
    def header(self) -> laspy.LasHeader:
        """Header of LAS 1.4 without a date or points; not to be changed."""
        return _header(self)

    @property
    def records(self) -> np.dtype[np.void]:
        """A point record as it lies in the file."""
        kind: np.dtype[np.void] = self.header.point_format.dtype()
        return kind


@functools.lru_cache(maxsize=16)
def _header(layout: Layout) -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=layout.point_format)
    header.scales = np.array(layout.scales)
    header.offsets = np.zeros(3)
    header.creation_date = dt.date(2000, 1, 1)
    header.generating_software = SOFTWARE
    header.system_identifier = "OTHER"
    header.global_encoding.gps_time_type = GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    header.vlrs.append(WktCoordinateSystemVlr(_wkt1(layout.map, layout.product)))
    for name, kind, about in layout.further:
        header.add_extra_dim(laspy.ExtraBytesParams(name, np.dtype(kind), about))
    return header


def set_coordinates(record: Any, axes: Axes) -> None:
    """Fill the three coordinates of a point record."""
    for name, one in zip("XYZ", axes, strict=True):
        record[name] = one.stored


def write_points(
    path: Path,
    layout: Layout,
    axes: Axes,
    records: npt.NDArray[np.void],
    facts: Mapping[str, Any],
    date: dt.date,
    compress: bool,
) -> None:
    """Write a whole file: the points, and `facts` with a digest of the points in a variable-length record.

    Parameters
    ----------
    records : (n,) of the layout's type, 1 or more.
    date : stands as the date of creation, so that the same points give the same bytes.
    """
    offsets = [one.offset for one in axes]
    digest = _Digest(layout.scales, offsets, [_wkt1(layout.map, layout.product)])
    digest.add(records)
    stated = json.dumps({**facts, "blake3": digest.text()}, sort_keys=True).encode("ascii")
    head, laszip = _head(layout, compress)
    with path.open("wb") as stream:
        stream.write(_filled(layout, head, len(laszip), axes, records, stated, date))
        stream.write(_VLR.pack(0, VLR_USER_ID.encode(), VLR_RECORD_ID, len(stated), _ABOUT_FACTS) + stated + laszip)
        if compress:
            write_compressed(stream, _laz(layout), records, layout.point_format)
        else:
            stream.write(records.view(np.uint8).data)


def _filled(
    layout: Layout,
    head: bytes,
    laszip_bytes: int,
    axes: Axes,
    records: npt.NDArray[np.void],
    stated: bytes,
    date: dt.date,
) -> bytearray:
    """The head with what differs from file to file (LAS 1.4 R15, table 3)."""
    filled = bytearray(head)
    struct.pack_into("<HH", filled, _DATE, date.timetuple().tm_yday, date.year)
    vlrs = struct.unpack_from("<I", head, _VLRS)[0] + 1 + (laszip_bytes > 0)
    struct.pack_into("<II", filled, _POINT_DATA, len(head) + _VLR.size + len(stated) + laszip_bytes, vlrs)
    ends = [float(edge) * a.scale + a.offset for a in axes for edge in (a.stored.max(), a.stored.min())]
    struct.pack_into("<9d", filled, _OFFSETS, *(a.offset for a in axes), *ends)
    returns = np.bincount(records["bit_fields"] & 15, minlength=16)[1:]
    struct.pack_into("<16Q", filled, _COUNTS, records.size, *returns.tolist())
    for number, (name, kind, _) in enumerate(layout.further):
        at = len(head) + _EXTRA_BYTES * (number - len(layout.further))
        code = {"u": "Q", "i": "q", "f": "d"}[np.dtype(kind).kind]
        struct.pack_into(f"<{code}", filled, at + _LEAST, records[name].min().item())
        struct.pack_into(f"<{code}", filled, at + _GREATEST, records[name].max().item())
    return filled


@functools.lru_cache(maxsize=16)
def _head(layout: Layout, compress: bool) -> tuple[bytes, bytes]:
    """Header and variable-length records as laspy writes them for no points, and the record that belongs to LAZ."""
    header = layout.header
    stream = io.BytesIO()
    header.are_points_compressed = compress
    header.write_to(stream)
    last = VLRList()
    if compress:
        last.append(LasZipVlr(_laz(layout).record_data()))
    laszip = io.BytesIO()
    last.write_to(laszip)
    return stream.getvalue(), laszip.getvalue()


def _laz(layout: Layout) -> lazrs.LazVlr:
    kind = layout.header.point_format
    return lazrs.LazVlr.new_for_compression(kind.id, kind.num_extra_bytes)


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
    """BLAKE3 (128 bits) of point records as they lie in a LAS file, and of what gives them their place.

    Files of older versions state BLAKE2b.
    """

    def __init__(self, scales: Sequence[float], offsets: Sequence[float], wkt: list[str], name: str = "blake3") -> None:
        self._state = blake3() if name == "blake3" else hashlib.blake2b(digest_size=16)
        self._state.update(repr((list(scales), list(offsets), wkt)).encode())

    def add(self, records: npt.NDArray[np.void]) -> None:
        self._state.update(np.ascontiguousarray(records).view(np.uint8).data)

    def text(self) -> str:
        digest: bytes = self._state.digest(length=16) if isinstance(self._state, blake3) else self._state.digest()
        return digest.hex()


def _check_points(reader: laspy.LasReader, path: Path) -> None:
    header = reader.header
    stated = _stated_facts(header, path)
    wkt = [vlr.string for vlr in header.vlrs.get("WktCoordinateSystemVlr")]
    name = "blake2b" if "blake2b" in stated else "blake3"
    digest, count = _Digest(header.scales.tolist(), header.offsets.tolist(), wkt, name), 0
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
    if digest.text() != stated.get(name):
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
