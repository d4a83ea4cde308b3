"""Writes and checks LAS 1.4 files of point products: CRS as WKT, coordinates in the CRS's unit, a digest."""

from __future__ import annotations

import copy
import datetime as dt
import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
from blake3 import blake3
from pyproj.exceptions import CRSError

from roadscan.core.crs import MapFrame
from roadscan.core.errors import CrsError, StoreError
from roadscan.store.codecs import SOFTWARE

if TYPE_CHECKING:
    import laspy

VLR_USER_ID: Final = "roadscan"
VLR_RECORD_ID: Final = 1  # record id of roadscan's facts

ONE_OF_ONE: Final = 0x11
"""Return number and number of returns in the byte that holds both."""
_RETURN_NUMBER: Final = 0x0F
"""Bits of the return number in that byte."""

_ABOUT_FACTS: Final = "survey, tile, rounding"
_CHUNK_POINTS: Final = 1_000_000  # points that are decoded at a time


@dataclass(frozen=True)
class Layout:
    """Common layout of a product's files: kind of points, scales, CRS."""

    point_format: int
    further: tuple[tuple[str, str, str], ...]
    """Extra dimensions: name, NumPy type, description."""
    scales: tuple[float, ...]
    """Scales of the three coordinates."""
    map: MapFrame
    product: str
    """Name of the product in errors."""
    class_names: tuple[tuple[int, str], ...] = ()
    """Names of classes that the file states (LAS 1.4 R15, Classification Lookup); left out without any."""

    @property
    def header(self) -> laspy.LasHeader:
        """Return a new header of LAS 1.4 without date or points."""
        header = copy.copy(_header(self))
        header.vlrs = header.vlrs  # this copies the list, and rebuilds the record of extra dimensions
        return header

    @property
    def records(self) -> np.dtype[np.void]:
        """Return the type of a point record as it lies in the file."""
        kind: np.dtype[np.void] = _header(self).point_format.dtype()
        return kind


@functools.lru_cache(maxsize=16)
def _header(layout: Layout) -> laspy.LasHeader:
    import laspy
    from laspy.header import GpsTimeType
    from laspy.vlrs.known import ClassificationLookupVlr, WktCoordinateSystemVlr

    header = laspy.LasHeader(version="1.4", point_format=layout.point_format)
    header.scales = np.array(layout.scales)
    header.offsets = np.zeros(3)
    header.creation_date = dt.date(2000, 1, 1)
    header.generating_software = SOFTWARE
    header.system_identifier = "OTHER"
    header.global_encoding.gps_time_type = GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    header.vlrs.append(WktCoordinateSystemVlr(_wkt1(layout.map, layout.product)))
    if layout.class_names:
        lookup = ClassificationLookupVlr()
        lookup.lookups = dict.fromkeys(range(256), "") | dict(layout.class_names)
        header.vlrs.append(lookup)
    for name, kind, about in layout.further:
        header.add_extra_dim(laspy.ExtraBytesParams(name, np.dtype(kind), about))
    return header


def write_points(
    path: Path,
    layout: Layout,
    offsets: Sequence[float],
    records: npt.NDArray[np.void],
    facts: Mapping[str, Any],
    date: dt.date,
    compress: bool,
) -> None:
    """Write a whole file: the points, and `facts` with a digest of the points in a variable-length record.

    Parameters
    ----------
    offsets : of the three coordinates.
    records : (n,) of the layout's type, 1 or more.
    date : stands as the date of creation, so that the same points give the same bytes.
    """
    import laspy
    import lazrs
    from laspy.vlrs.known import LasZipVlr

    digest = _Digest(layout.scales, offsets, [_wkt1(layout.map, layout.product)])
    digest.add(records)
    stated = json.dumps({**facts, "blake3": digest.text()}, sort_keys=True).encode("ascii")
    header = layout.header
    header.offsets, header.creation_date = np.array(offsets), date
    header.vlrs.append(laspy.VLR(VLR_USER_ID, VLR_RECORD_ID, _ABOUT_FACTS, stated))
    _state_points(header, records)
    content = np.ascontiguousarray(records).view(np.uint8)
    with path.open("wb") as stream:
        if not compress:
            header.write_to(stream)
            stream.write(content.data)
            return
        kind = header.point_format
        laz = lazrs.LazVlr.new_for_compression(kind.id, kind.num_extra_bytes)
        header.vlrs.append(LasZipVlr(laz.record_data()))
        header.are_points_compressed = True
        header.write_to(stream)
        compressor = lazrs.LasZipCompressor(stream, laz)
        compressor.compress_many(content)
        compressor.done()


def _state_points(header: laspy.LasHeader, records: npt.NDArray[np.void]) -> None:
    """Write into the header the number of points, their box, and the extremes of each extra dimension."""
    least, greatest = (
        np.array([getattr(records[axis], which)() for axis in "XYZ"]) * header.scales + header.offsets
        for which in ("min", "max")
    )
    header.point_count, header.mins, header.maxs = len(records), least, greatest
    returns = np.bincount(records["bit_fields"] & _RETURN_NUMBER, minlength=_RETURN_NUMBER + 1)
    header.number_of_points_by_return = returns[1:].astype(np.uint64)
    for one in _descriptions(header):
        _state_extremes(one, records[one.format_name()])


def _descriptions(header: laspy.LasHeader) -> list[Any]:
    """Return the header's descriptions of the extra dimensions."""
    return [one for vlr in header.vlrs.get("ExtraBytesVlr") for one in vlr.extra_bytes_structs]


def _state_extremes(description: Any, values: npt.NDArray[Any]) -> None:
    """Set the minimum and maximum of a dimension, because laspy 2.7 only uses the first point."""
    kind = {"u": np.uint64, "i": np.int64, "f": np.float64}[values.dtype.kind]
    np.frombuffer(description._min, kind)[0] = values.min()
    np.frombuffer(description._max, kind)[0] = values.max()


def check_points(path: Path) -> None:
    """Decode every point and compare number, box and digest with the header."""
    import laspy
    from lazrs import LazrsError

    try:
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            _check_points(reader, path)
    except (laspy.LaspyException, LazrsError, OSError, ValueError, EOFError) as error:
        raise StoreError(f"the point file cannot be read: {error}", change="make it again", file=path) from error


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
    """BLAKE3 (128 bits) of point records as they lie in a LAS file, and of the scales and offsets that place them.

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
