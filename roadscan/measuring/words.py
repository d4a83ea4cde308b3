"""Measured places as GeoJSON and as rows of a table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.crs import MapFrame, crs_from_text
from roadscan.core.errors import ConfigError
from roadscan.measuring.measure import Measured, MeasuredPlace, length_of

_DEGREE_DECIMALS, _METRE_DECIMALS = 9, 4
"""Decimals of degrees (0.1 mm) and of metres in GeoJSON."""

COLUMNS = (
    "u_px", "v_px", "easting_m", "northing_m", "height_m", "sigma_easting_m", "sigma_northing_m", "sigma_height_m",
    "distance_m", "incidence_deg", "reason", "warning",
)  # fmt: skip
"""Columns of measured places; numbers are NaN where a pixel has no place, and `reason` says why."""


def place_rows(places: Sequence[MeasuredPlace]) -> list[dict[str, Any]]:
    """Return a row a place, with the columns `COLUMNS`."""
    rows = []
    for one in places:
        values = (
            one.u_px, one.v_px, *one.place_m.tolist(), *one.sigma_m.tolist(), one.distance_m, one.incidence_deg,
            one.reason, one.warning,
        )  # fmt: skip
        rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows


def write_geojson_of(path: Path, measured: Measured, frame: MapFrame) -> int:
    """Write what :func:`geojson_of` returns, and return how many places it has; ConfigError where none has one."""
    document = geojson_of(measured, frame)
    path.write_text(json.dumps(document, indent=1, ensure_ascii=False))
    return len(document["features"][0]["properties"]["vertices"])


def geojson_of(measured: Measured, frame: MapFrame) -> dict[str, Any]:
    """Return the line through measured places as GeoJSON, or the point of one.

    Longitude and latitude are in WGS 84 by RFC 7946 where the map has a CRS, else they are the map's metres;
    heights stay as the map has them. Properties hold picture, camera, run, length, and place and 1 σ of each vertex.

    Raises
    ------
    ConfigError
        where no pixel has a place.
    """
    kept = [one for one in measured.places if not one.reason]
    if not kept:
        reasons = "; ".join(sorted({one.reason for one in measured.places}))
        raise ConfigError(f"nothing was measured: {reasons}", expected="a pixel that shows surveyed ground")
    places = np.array([one.place_m for one in kept])
    coordinates = np.round(_coordinates(places, frame), _DEGREE_DECIMALS).tolist()
    single = len(kept) == 1
    length_m, sigma_length_m = length_of(kept)
    geometry = {"type": "Point" if single else "LineString", "coordinates": coordinates[0] if single else coordinates}
    about = {
        "run": measured.run, "camera": measured.camera, "picture": measured.file.name,
        "sigma_assumed": measured.assumed,
        "left_out": len(measured.places) - len(kept), "length_m": round(length_m, _METRE_DECIMALS),
        "sigma_length_m": round(sigma_length_m, _METRE_DECIMALS),
        "vertices": [{n: _rounded(v) for n, v in row.items() if n != "reason"} for row in place_rows(kept)],
    }  # fmt: skip
    feature = {"type": "Feature", "geometry": geometry, "properties": about}
    return {"type": "FeatureCollection", "features": [feature]}


def _coordinates(places: Float64, frame: MapFrame) -> Float64:
    if frame.crs is None:
        return places
    from pyproj import Transformer

    turned = Transformer.from_crs(crs_from_text(frame.crs), "OGC:CRS84", always_xy=True)
    unit_m = frame.horizontal_unit_m
    lon, lat = turned.transform(places[:, 0] / unit_m, places[:, 1] / unit_m)
    return np.column_stack([lon, lat, places[:, 2]])


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, _METRE_DECIMALS) if np.isfinite(value) else None
    return value
