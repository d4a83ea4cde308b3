"""CRS of GeoTIFF keys (OGC 19-008), as GDAL reads them: keys that name a CRS, and keys that define one by parameters.

The keys are put into a picture of one cell, which GDAL opens. Only keys whose values lie inside their tables get there.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
import pyproj
from pyproj.crs.crs import CompoundCRS
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError as ProjCrsError

from roadscan.store.codecs.cog import without_place_warning

DIRECTORY: Final = 34_735  # TIFF tag of the keys (OGC 19-008)
DOUBLES: Final = 34_736  # TIFF tag of their numbers
TEXTS: Final = 34_737
"""TIFF tags of the keys, of their numbers and of their texts; LAS gives its records the same numbers."""

_MOST_KEYS: Final = 1_000
"""Largest accepted number of keys: the standard defines some 50."""
_SHORT, _LONG, _DOUBLE, _ASCII = 3, 4, 12, 2  # TIFF field types
_SAME_PLACE_M: Final = 1e-3
"""Two CRS are equal if they place a point less than this apart (m): parameters are written with limited digits."""

_SAME_UNIT_M: Final = 1e-12
"""Units are equal within this (m): programs round them; the foot and the survey foot differ by 6e-7 m."""

_FALSE_ORIGIN: Final = ("False easting", "False northing", "Easting at false origin", "Northing at false origin")


class KeyedCrs(NamedTuple):
    """CRS stated by GeoTIFF keys."""

    crs: pyproj.CRS | None
    """Compound where the keys state a vertical datum, even one without a name; None where they state no CRS."""
    false_origin_units: tuple[pyproj.CRS, pyproj.CRS] | None = None
    """The CRS with a false origin in its unit, and with one in metres, where PROJ knows neither and both can be
    meant: older programs wrote metres whatever the unit."""


def short_keys(directory: bytes) -> dict[int, int]:
    """Return the values of the keys with a single short number, by key."""
    return {key: value for key, at, count, value in _entries(directory) if at == 0 and count == 1}


def crs_of_keys(records: Mapping[int, bytes]) -> KeyedCrs:
    """Return the CRS that keys state.

    Parameters
    ----------
    records : content of the tags or records `DIRECTORY`, `DOUBLES` and `TEXTS`, by number.

    Raises
    ------
    pyproj.exceptions.CRSError
        where GDAL or PROJ cannot make a CRS of what the keys state.
    """
    picture = _picture(records)
    if picture is None:
        return KeyedCrs(None)
    own_unit = _read(picture, "DEFAULT")
    if own_unit is None:
        return KeyedCrs(None)
    horizontal = own_unit.sub_crs_list[0] if own_unit.is_compound else own_unit
    if not horizontal.is_projected or horizontal.axis_info[0].unit_conversion_factor == 1.0:
        return KeyedCrs(_renamed(own_unit))
    metres = _read(picture, "BROKEN")
    if metres is None or not _false_origin(horizontal) or metres == own_unit:
        return KeyedCrs(_renamed(own_unit))
    renamed = [_renamed(own_unit), _renamed(metres)]
    known = [one for one in renamed if known_crs(_horizontal(one)) is not None]
    if len(known) == 1:
        return KeyedCrs(known[0])
    return KeyedCrs(renamed[0], (renamed[0], renamed[1]))


def known_crs(crs: pyproj.CRS) -> pyproj.CRS | None:
    """Return the registered CRS equal to a projected one in datum, unit and placement; None where there is none.

    Those that PROJ finds alike are tried, and those of its name, such as the one in feet beside the one in metres.
    """
    if not crs.is_projected:
        return None
    alike = [(one.auth_name, one.code) for one in crs.list_authority(min_confidence=25)]
    named = query_crs_info(auth_name="EPSG", pj_types=PJType.PROJECTED_CRS)
    alike += [(one.auth_name, one.code) for one in named if one.name.split(" (")[0] == crs.name.split(" (")[0]]
    registered = (pyproj.CRS.from_authority(*code) for code in dict.fromkeys(alike))
    return next((one for one in registered if _is(crs, one)), None)


def _is(crs: pyproj.CRS, registered: pyproj.CRS) -> bool:
    area, datums = registered.area_of_use, (crs.datum, registered.datum)
    if area is None or datums[0] is None or datums[1] is None or datums[0].name != datums[1].name:
        return False
    units = [float(one.axis_info[0].unit_conversion_factor) for one in (crs, registered)]
    if abs(units[0] - units[1]) > _SAME_UNIT_M:
        return False
    places = np.array([[area.west, area.west, area.east], [area.south, area.north, area.north]])
    own, other = (np.array(pyproj.Proj(one)(*places)) * units[0] for one in (crs, registered))
    return bool(np.isfinite(own).all() and np.abs(own - other).max() < _SAME_PLACE_M)


def _horizontal(crs: pyproj.CRS) -> pyproj.CRS:
    return crs.sub_crs_list[0] if crs.is_compound else crs


def _renamed(crs: pyproj.CRS) -> pyproj.CRS:
    """Return the CRS with its registered name; an unregistered one keeps no code, which would contradict it."""
    if crs.is_compound:
        return CompoundCRS(name=crs.name, components=[_renamed(crs.sub_crs_list[0]), crs.sub_crs_list[1]])
    if not crs.is_projected:
        return crs
    parts = crs.to_json_dict()
    parts.pop("id", None)
    return known_crs(crs) or pyproj.CRS.from_json_dict(parts)


def _false_origin(crs: pyproj.CRS) -> bool:
    operation = crs.coordinate_operation
    return operation is not None and any(p.value for p in operation.params if p.name in _FALSE_ORIGIN)


def _read(picture: bytes, linear_units: str) -> pyproj.CRS | None:
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.io import MemoryFile

    options = {"GTIFF_LINEAR_UNITS": linear_units, "GTIFF_REPORT_COMPD_CS": "YES", "GTIFF_SRS_SOURCE": "GEOKEYS"}
    try:
        with without_place_warning(), rasterio.Env(**options), MemoryFile(picture) as file, file.open() as opened:
            text = opened.crs.to_wkt() if opened.crs else ""
    except RasterioError as error:
        raise ProjCrsError(f"GDAL does not read the GeoTIFF keys: {error}") from error
    return pyproj.CRS.from_wkt(text) if text else None


def _entries(directory: bytes) -> list[tuple[int, int, int, int]]:
    """Return key, tag of its value, count and value or place, sorted by key, without invalid keys."""
    if len(directory) < 8:
        return []
    claimed = struct.unpack_from("<H", directory, 6)[0]
    count = min(claimed, len(directory) // 8 - 1, _MOST_KEYS)
    found = [struct.unpack_from("<4H", directory, 8 * (n + 1)) for n in range(count)]
    return sorted({one[0]: (one[0], one[1], one[2], one[3]) for one in found if one[0]}.values())


def _picture(records: Mapping[int, bytes]) -> bytes | None:
    """Return a TIFF of one cell with the keys; None without any."""
    directory, doubles = records.get(DIRECTORY, b""), records.get(DOUBLES, b"")
    texts = records.get(TEXTS, b"")
    room = {0: 1, DOUBLES: len(doubles) // 8, TEXTS: len(texts)}
    keys = [
        one
        for one in _entries(directory)
        if one[1] in room and (one[2] == 1 if one[1] == 0 else one[3] + one[2] <= room[one[1]])
    ]
    if not keys:
        return None
    head = struct.unpack_from("<3H", directory)
    packed = b"".join(struct.pack("<4H", *key) for key in [(*head, len(keys)), *keys])
    one = struct.pack("<I", 1)
    tags = [
        (256, _LONG, one), (257, _LONG, one), (258, _SHORT, struct.pack("<H", 8)), (259, _SHORT, struct.pack("<H", 1)),
        (262, _SHORT, struct.pack("<H", 1)), (273, _LONG, struct.pack("<I", 8)), (277, _SHORT, struct.pack("<H", 1)),
        (278, _LONG, one), (279, _LONG, one), (DIRECTORY, _SHORT, packed),
        *([(DOUBLES, _DOUBLE, doubles[: room[DOUBLES] * 8])] if room[DOUBLES] else []),
        *([(TEXTS, _ASCII, texts)] if texts else []),
    ]  # fmt: skip
    return _tiff(tags)


def _tiff(tags: list[tuple[int, int, bytes]]) -> bytes:
    """Return a little-endian TIFF of the tags, whose one cell is byte 8."""
    sizes = {_SHORT: 2, _LONG: 4, _DOUBLE: 8, _ASCII: 1}
    body, entries = bytearray(8), b""  # the cell, padded to an even byte
    for tag, kind, content in tags:
        count = len(content) // sizes[kind]
        if len(content) <= 4:
            entries += struct.pack("<HHI", tag, kind, count) + content.ljust(4, b"\0")
        else:
            entries += struct.pack("<HHII", tag, kind, count, 8 + len(body))
            body += content + bytes(len(content) % 2)
    return (
        struct.pack("<2sHI", b"II", 42, 8 + len(body)) + bytes(body) + struct.pack("<H", len(tags)) + entries + bytes(4)
    )
