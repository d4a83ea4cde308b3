"""Finds CRS and units of a LAS file's points: the file's statements, checked against the survey file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, Self, TypeAlias

import numpy as np
import pyproj
from pyproj.exceptions import CRSError as ProjCrsError

from roadscan.core.crs import NO_HEIGHTS, HeightKind, StatedHeights, crs_from_text, heights_of, vertical_of
from roadscan.core.errors import ConfigError, CrsError, Missing, brief
from roadscan.formats.clouds.las_file import Cloud, unreadable
from roadscan.ingest.reading.format import LogSource
from roadscan.store.codecs.geo_keys import DIRECTORY, DOUBLES, TEXTS, crs_of_keys, short_keys

LengthUnit: TypeAlias = Literal["metre", "foot", "us_survey_foot"]

UNIT_M: Final[dict[LengthUnit, float]] = {"metre": 1.0, "foot": 0.3048, "us_survey_foot": 1200 / 3937}
"""Lengths of the units of `options.vertical_unit` (m)."""

_EPSG_UNIT_M: Final = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}  # EPSG codes of units, with their lengths (m)
_PROJECTION: Final = "LASF_Projection"
_KEY_RECORDS: Final = (DIRECTORY, DOUBLES, TEXTS)
_WITHOUT_UNIT: Final = range(5_001, 5_300)
"""Values of GeoTIFF key 4096 (GeoTIFF 1.0) that name a vertical datum without a unit of heights."""
_LINEAR_UNIT_KEY: Final = 3076  # unit of x and y
_VERTICAL_CRS_KEY: Final = 4096  # vertical CRS
_VERTICAL_UNIT_KEY: Final = 4099  # unit of z
_SAME_UNIT: Final = 1e-9  # largest difference of equal units (m)

_VERTICAL_WKT: Final = re.compile(r"\b(?:VERT_?CS|VERTCRS|VERTICALCRS)\s*[\[(]")
_UNIT_WKT: Final = re.compile(r'\b(?:LENGTH)?UNIT\s*[\[(]\s*"([^"]*)"')
_UNIT_WORDS: Final = (("survey", 1200 / 3937), ("metre", 1.0), ("meter", 1.0), ("foot", 0.3048), ("feet", 0.3048))
"""Words in names of units, with their lengths (m); the first match counts."""
_VERTICAL_UNIT: Final = Missing("options.vertical_unit", choices=("metre", "foot", "us_survey_foot"))
_IGNORED: Final = Missing("options.ignore_file_crs", True)
_WORLD: Final = "EPSG:4326"
_ONE_PLACE_M: Final = 5.0
"""Two statements of one CRS may differ by this much (m): datum shifts that one of them leaves out."""


@dataclass(frozen=True)
class CloudUnits:
    """The coordinates' CRS and units, after comparing file and survey file."""

    crs: str
    """Horizontal CRS, or "local"."""
    height: HeightKind
    """Kind of the heights."""
    horizontal_unit_m: float
    """Length of the unit of x and y (m)."""
    vertical_unit_m: float
    """Length of the unit of z (m)."""
    vertical_crs: str | None = None
    """Authority code of the vertical CRS of z, where one is named and PROJ knows it."""

    @classmethod
    def of(cls, source: LogSource, cloud: Cloud, *, ignore_file: bool, vertical_unit: LengthUnit | None) -> Self:
        """Compare the statements of the file and the survey file.

        Raises
        ------
        CrsError
            if neither names a CRS, if they contradict each other, or if the points are not in a projected CRS.
        """
        written = _Written() if ignore_file else _Written.of(source, cloud)
        if written.crs is None and source.crs is None:
            source = replace(source, crs=source.defaults.crs)
        if source.crs == "local":
            if written.crs is not None:
                _check_projected(source, _horizontal(written.crs))
                raise _two_crs(source, written.crs)
            height = source.any_height or "ellipsoidal"  # z of the frame, which has no kind
            return cls("local", height, 1.0, UNIT_M[vertical_unit or "metre"])
        crs = _agreed(source, written.crs)
        horizontal = _horizontal(crs)
        _check_projected(source, horizontal)
        unit_m = float(horizontal.axis_info[0].unit_conversion_factor)
        _check_linear_unit(source, written, unit_m)
        heights, units = _agreed_heights(source, crs, written)
        height = source.need_height(
            heights.kind, f"their CRS ({heights.name})", "options.ignore_file_crs = true if the file is wrong"
        )
        name = source.crs if source.crs is not None and not crs.is_compound else _name(horizontal)
        vertical = vertical_of(crs) or (None if written.crs is None else vertical_of(written.crs))
        return cls(name, height, unit_m, _vertical_unit_m(source, units, vertical_unit, unit_m), vertical)


@dataclass(frozen=True)
class _Written:
    """Statements of the file."""

    crs: pyproj.CRS | None = None
    heights: StatedHeights = NO_HEIGHTS
    linear_unit_m: float | None = None
    """Unit of x and y by a GeoTIFF key."""
    units_m: tuple[tuple[str, float], ...] = ()
    """Units of z that the file states, with their sources; a single one unless the file contradicts itself."""

    @classmethod
    def of(cls, source: LogSource, cloud: Cloud) -> Self:
        records = {
            r.record_id: r.record_data_bytes()
            for r in cloud.reader.header.vlrs
            if r.user_id == _PROJECTION and r.record_id in _KEY_RECORDS
        }
        wkt = cloud.wkt
        try:
            if wkt:
                crs = pyproj.CRS.from_wkt(wkt)
                _check_one_crs(source, cloud, crs, records)
                heights = heights_of(crs)
                if heights.kind is None and (nested := _nested_vertical(wkt)):
                    heights = heights_of(pyproj.CRS.from_wkt(nested))
                return cls(crs, heights, None, tuple(_units_named(heights)) + tuple(_unit_words(wkt, heights)))
            keyed = crs_of_keys(records)
        except unreadable(ProjCrsError) as error:
            raise CrsError(
                f"the file's CRS cannot be understood: {brief(error)}",
                expected="WKT or GeoTIFF keys known to PROJ",
                change='state crs = "EPSG:…" and options.ignore_file_crs = true',
                file=source.path,
                missing=_IGNORED,
            ) from error
        if keyed.false_origin_units is not None and source.crs is None:
            raise _two_origins(source, *keyed.false_origin_units)
        keys = short_keys(records.get(DIRECTORY, b""))
        heights = NO_HEIGHTS if keyed.crs is None else heights_of(keyed.crs)
        by_key = _EPSG_UNIT_M.get(keys.get(_VERTICAL_UNIT_KEY, 0))
        if keys.get(_VERTICAL_CRS_KEY, 0) in _WITHOUT_UNIT:
            heights = heights._replace(unit_m=by_key)
        units = list(_units_named(heights))
        if by_key is not None:
            units.append((f"GeoTIFF key {_VERTICAL_UNIT_KEY}", by_key))
        return cls(keyed.crs, heights, _EPSG_UNIT_M.get(keys.get(_LINEAR_UNIT_KEY, 0)), tuple(units))


def _check_one_crs(source: LogSource, cloud: Cloud, crs: pyproj.CRS, records: Mapping[int, bytes]) -> None:
    """Refuse a file whose WKT and GeoTIFF keys put its points at two places."""
    try:
        keyed = crs_of_keys(dict(records)).crs if records else None
    except unreadable(ProjCrsError, CrsError):
        return  # keys beside a WKT that holds are often rests of another program
    corner = np.asarray(cloud.reader.header.mins[:2], np.float64)
    if keyed is None or not np.isfinite(corner).all():
        return
    places = [
        pyproj.Transformer.from_crs(one.to_2d(), _WORLD, always_xy=True).transform(*corner) for one in (crs, keyed)
    ]
    if not np.isfinite(places).all():
        return
    apart_m = pyproj.Geod(ellps="WGS84").inv(*places[0], *places[1])[2]
    if apart_m > _ONE_PLACE_M:
        raise CrsError(
            f"the file states two CRS: its WKT says {crs.name}, its GeoTIFF keys {keyed.name}; its points would lie "
            f"{apart_m / 1000:,.3f} km apart",
            expected="one CRS",
            change='state crs = "EPSG:…" and options.ignore_file_crs = true',
            file=source.path,
            missing=_IGNORED,
        )


def _units_named(heights: StatedHeights) -> Iterator[tuple[str, float]]:
    if heights.unit_m is not None:
        yield f"the vertical CRS ({heights.name or 'without a name'})", heights.unit_m


def _nested_vertical(wkt: str) -> str:
    """Return the WKT of a vertical CRS inside a horizontal one, which PROJ ignores; "" where there is none."""
    found = _VERTICAL_WKT.search(wkt)
    if found is None:
        return ""
    depth, quoted = 0, False
    for at in range(found.start(), len(wkt)):
        quoted ^= wkt[at] == '"'
        depth += 0 if quoted else (wkt[at] in "[(") - (wkt[at] in "])")
        if depth == 0 and not quoted and wkt[at] in "])":
            return wkt[found.start() : at + 1]
    return ""


def _unit_words(wkt: str, heights: StatedHeights) -> Iterator[tuple[str, float]]:
    """Yield the unit of z by its name, where its factor says another."""
    vertical = _nested_vertical(wkt)
    named = _UNIT_WKT.search(vertical)
    if named is None or heights.unit_m is None:
        return
    unit_m = next((m for words, m in _UNIT_WORDS if words in named[1].lower().replace("_", " ")), None)
    if unit_m is not None and abs(unit_m - heights.unit_m) > _SAME_UNIT:
        yield f"the name of its unit ({named[1]})", unit_m


def _two_origins(source: LogSource, own_unit: pyproj.CRS, metres: pyproj.CRS) -> CrsError:
    return CrsError(
        f"the GeoTIFF keys define '{own_unit.name}' with a false origin that may be in its unit of "
        f"{own_unit.axis_info[0].unit_conversion_factor:.9g} m or, as older programs wrote it, in metres; neither is a "
        "CRS that PROJ knows",
        expected="one CRS",
        change='state crs = "EPSG:…" or its WKT, and options.ignore_file_crs = true',
        file=source.path,
        missing=_IGNORED,
    )


def _check_projected(source: LogSource, horizontal: pyproj.CRS) -> None:
    if not horizontal.is_projected:
        raise CrsError(
            f"the points' CRS is '{horizontal.name}', not a projected one"
            + (": x and y are longitude and latitude in degrees" if horizontal.is_geographic else ""),
            expected="easting and northing",
            change="export the cloud in a projected CRS; or, if the file names the wrong one, state the right crs "
            "and options.ignore_file_crs = true",
            file=source.path,
            missing=_IGNORED,
        )


def _agreed(source: LogSource, written: pyproj.CRS | None) -> pyproj.CRS:
    if source.crs is None:
        if written is None:
            raise CrsError(
                "neither the file nor the survey file says which CRS the points are in",
                expected="a CRS",
                change='add crs = "EPSG:…" (or crs = "local") to this log',
                file=source.path,
                missing=Missing("crs"),
            )
        return written
    stated = crs_from_text(source.crs)
    if written is not None and not _same(_horizontal(stated), _horizontal(written)):
        raise _two_crs(source, written)
    return stated


def _two_crs(source: LogSource, written: pyproj.CRS) -> CrsError:
    return CrsError(
        f"the survey file says the points are in {source.crs}, the file says {_name(_horizontal(written))[:80]} "
        f"({written.name})",
        expected="one CRS",
        change="correct crs, leave it out, or set options.ignore_file_crs = true if the file is wrong",
        file=source.path,
        missing=_IGNORED,
    )


def _horizontal(crs: pyproj.CRS) -> pyproj.CRS:
    if crs.is_compound:
        return _horizontal(crs.sub_crs_list[0])
    if crs.is_bound and crs.source_crs is not None:
        return _horizontal(crs.source_crs)
    return crs.to_2d()


def _same(one: pyproj.CRS, other: pyproj.CRS) -> bool:
    authority = one.to_authority(min_confidence=90)
    return one.equals(other, ignore_axis_order=True) or (
        authority is not None and authority == other.to_authority(min_confidence=90)
    )


def _name(crs: pyproj.CRS) -> str:
    authority = crs.to_authority(min_confidence=90)
    return ":".join(authority) if authority else str(crs.to_wkt())


def _check_linear_unit(source: LogSource, written: _Written, unit_m: float) -> None:
    stated = written.linear_unit_m
    if stated is not None and abs(stated - unit_m) > _SAME_UNIT:
        raise CrsError(
            f"GeoTIFF key {_LINEAR_UNIT_KEY} says a unit of {stated:.9g} m, the CRS {unit_m:.9g} m",
            expected="one horizontal unit",
            change="state the right crs and options.ignore_file_crs = true",
            file=source.path,
            missing=_IGNORED,
        )


def _agreed_heights(
    source: LogSource, crs: pyproj.CRS, written: _Written
) -> tuple[StatedHeights, tuple[tuple[str, float], ...]]:
    """Return heights of the agreed CRS, or else of the file; and the units of z, each with its source.

    Raises
    ------
    CrsError
        where the stated CRS and the file say different kinds.
    """
    stated = heights_of(crs)
    if stated.kind is None or crs is written.crs:
        return written.heights, written.units_m
    if written.heights.kind not in (None, stated.kind):
        raise CrsError(
            f"heights are {written.heights.kind} by the file's CRS ({written.heights.name}), and {stated.kind} by the "
            f"stated one ({stated.name})",
            expected="one kind of height",
            change="correct crs, or set options.ignore_file_crs = true if the file is wrong",
            file=source.path,
            missing=_IGNORED,
        )
    return stated, (*_units_named(stated), *written.units_m)


def _vertical_unit_m(
    source: LogSource, units: Sequence[tuple[str, float]], vertical_unit: LengthUnit | None, horizontal_unit_m: float
) -> float:
    """Return the length of the unit of z (m)."""
    lengths = {round(unit_m / _SAME_UNIT): unit_m for _, unit_m in units}
    stated = UNIT_M[vertical_unit] if vertical_unit else None
    if stated is None and len(lengths) > 1:
        raise CrsError(
            "the file states two units of z: " + ", ".join(f"{by} {unit_m:.9g} m" for by, unit_m in units),
            expected="one vertical unit",
            change="state the right one",
            file=source.path,
            missing=_VERTICAL_UNIT,
        )
    if stated is not None and lengths and all(abs(unit_m - stated) > _SAME_UNIT for unit_m in lengths.values()):
        raise ConfigError(
            f"options.vertical_unit is '{vertical_unit}', the file says a unit of {units[0][1]:.9g} m",
            expected="one vertical unit",
            file=source.path,
        )
    known = stated if stated is not None else next(iter(lengths.values()), None)
    if known is None and horizontal_unit_m != 1.0:
        raise CrsError(
            f"eastings are in a unit of {horizontal_unit_m:.9g} m, and nothing says the unit of z",
            file=source.path,
            missing=_VERTICAL_UNIT,
        )
    return 1.0 if known is None else known
