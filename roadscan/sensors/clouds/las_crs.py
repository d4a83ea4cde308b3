"""In which CRS and units the points of a LAS file are: what the file says, held against the survey file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal, Self, TypeAlias

import pyproj
from pyproj.exceptions import CRSError as ProjCrsError

from roadscan.model.crs import crs_from_text
from roadscan.model.errors import ConfigError, CrsError, Missing
from roadscan.sensors.base import LogSource
from roadscan.sensors.clouds.las_file import UNREADABLE, Cloud, brief

LengthUnit: TypeAlias = Literal["metre", "foot", "us_survey_foot"]

UNIT_M: Final[dict[LengthUnit, float]] = {"metre": 1.0, "foot": 0.3048, "us_survey_foot": 1200 / 3937}
"""Length of the units that `options.vertical_unit` names."""

_EPSG_UNIT_M: Final = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}
_EPSG_CODES: Final = range(1024, 32_767)
_LINEAR_UNIT_KEY: Final = 3076
_VERTICAL_CRS_KEY: Final = 4096
_VERTICAL_UNIT_KEY: Final = 4099
_SAME_UNIT: Final = 1e-9

_IGNORED: Final = Missing("options.ignore_file_crs", True)


@dataclass(frozen=True)
class CloudUnits:
    """What the coordinates are, once the file and the survey file agree."""

    crs: str
    """Horizontal CRS, or "local"."""
    horizontal_unit_m: float
    """Length of the unit of x and y (m)."""
    vertical_unit_m: float
    """Length of the unit of z (m)."""

    @classmethod
    def of(cls, source: LogSource, cloud: Cloud, *, ignore_file: bool, vertical_unit: LengthUnit | None) -> Self:
        """Compare what the file and the survey file say.

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
                raise _two_crs(source, written.crs)
            return cls("local", 1.0, UNIT_M[vertical_unit or "metre"])
        crs = _agreed(source, written.crs)
        horizontal = _horizontal(crs)
        if not horizontal.is_projected:
            raise CrsError(
                f"the points' CRS is '{horizontal.name}', not a projected one",
                expected="easting and northing",
                change="export the cloud in a projected CRS, or state the right one with options.ignore_file_crs",
                file=source.path,
                missing=_IGNORED,
            )
        unit_m = float(horizontal.axis_info[0].unit_conversion_factor)
        _check_linear_unit(source, written, unit_m)
        heights = _Heights.of(crs)
        if heights.kind is None:
            heights = written.heights
        _check_heights(source, heights)
        name = source.crs if source.crs is not None and not crs.is_compound else _name(horizontal)
        return cls(name, unit_m, _vertical_unit_m(source, heights, vertical_unit, unit_m))


@dataclass(frozen=True)
class _Heights:
    """What a CRS says of its heights."""

    kind: Literal["ellipsoidal", "orthometric"] | None = None
    name: str = ""
    unit_m: float | None = None

    @classmethod
    def of(cls, crs: pyproj.CRS | None) -> Self:
        if crs is None:
            return cls()
        vertical = crs if crs.is_vertical else next((part for part in crs.sub_crs_list if part.is_vertical), None)
        if vertical is not None:
            unit_m = float(vertical.axis_info[-1].unit_conversion_factor)
            return cls("ellipsoidal" if "ellips" in vertical.name.lower() else "orthometric", vertical.name, unit_m)
        if not crs.is_compound and len(crs.axis_info) == 3:
            return cls("ellipsoidal", crs.name, float(crs.axis_info[2].unit_conversion_factor))
        return cls()


@dataclass(frozen=True)
class _Written:
    """What the file itself says."""

    crs: pyproj.CRS | None = None
    heights: _Heights = _Heights()
    linear_unit_m: float | None = None

    @classmethod
    def of(cls, source: LogSource, cloud: Cloud) -> Self:
        keys = _geo_keys(cloud)
        try:
            crs = pyproj.CRS.from_wkt(cloud.head.wkt) if cloud.head.wkt else cloud.reader.header.parse_crs()
            vertical = keys.get(_VERTICAL_CRS_KEY, 0)
            heights = _Heights.of(crs)
            if heights.kind is None and vertical in _EPSG_CODES:
                heights = _Heights.of(pyproj.CRS.from_epsg(vertical))
        except (ProjCrsError, *UNREADABLE) as error:
            raise CrsError(
                f"the file's CRS cannot be understood: {brief(error)}",
                expected="WKT or GeoTIFF keys known to PROJ",
                change='state crs = "EPSG:…" and options.ignore_file_crs = true',
                file=source.path,
                missing=_IGNORED,
            ) from error
        if heights.unit_m is None:
            heights = _Heights(heights.kind, heights.name, _EPSG_UNIT_M.get(keys.get(_VERTICAL_UNIT_KEY, 0)))
        return cls(crs, heights, _EPSG_UNIT_M.get(keys.get(_LINEAR_UNIT_KEY, 0)))


def _geo_keys(cloud: Cloud) -> dict[int, int]:
    """Values of the GeoTIFF keys that hold one short number, by key."""
    keys: dict[int, int] = {}
    for record in cloud.reader.header.vlrs:
        for key in getattr(record, "geo_keys", []):
            if key.tiff_tag_location == 0:
                keys[int(key.id)] = int(key.value_offset)
    return keys


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


def _check_heights(source: LogSource, heights: _Heights) -> None:
    if heights.kind is not None and heights.kind != source.height:
        also = " (and geoid, to change them into another kind)" if heights.kind == "orthometric" else ""
        raise CrsError(
            f"heights are {heights.kind} by their CRS ({heights.name}), the survey file says {source.height}",
            expected="one kind of height",
            change=f'set height = "{heights.kind}" for this log{also}',
            file=source.path,
            missing=Missing("height", heights.kind),
        )


def _vertical_unit_m(
    source: LogSource, heights: _Heights, vertical_unit: LengthUnit | None, horizontal_unit_m: float
) -> float:
    stated = UNIT_M[vertical_unit] if vertical_unit else None
    if stated is not None and heights.unit_m is not None and abs(heights.unit_m - stated) > _SAME_UNIT:
        raise ConfigError(
            f"options.vertical_unit is '{vertical_unit}', the file says a unit of {heights.unit_m:.9g} m",
            expected="one vertical unit",
            file=source.path,
        )
    known = heights.unit_m if heights.unit_m is not None else stated
    if known is None and horizontal_unit_m != 1.0:
        raise CrsError(
            f"eastings are in a unit of {horizontal_unit_m:.9g} m, and nothing says the unit of z",
            file=source.path,
            missing=Missing("options.vertical_unit", choices=("metre", "foot", "us_survey_foot")),
        )
    return 1.0 if known is None else known
