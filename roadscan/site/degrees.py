"""Converts degrees to the survey's map without a projection library: polynomials fitted to PROJ's results."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.crs import MapFrame
from roadscan.site.material import Box
from roadscan.site.parts.catalog import from_longitude_latitude, to_longitude_latitude

Float64 = npt.NDArray[np.float64]

_AROUND_M: Final = 2000.0
"""Margin around the survey (m): people also look for places beside the road."""
_WITHIN_M: Final = 0.05
"""Largest error of the polynomials (m): a tenth of what a street map shows when it is opened."""
_MOST: Final = 9
"""Highest degree: 55 numbers per axis; a survey that needs more spans continents."""
_ALONG: Final = 24
"""Places of the fit along each side; the check uses twice as many, between them."""


def degrees_on_map(frame: MapFrame, extent_m: Box | None) -> dict[str, Any] | None:
    """Return polynomials from longitude and latitude (degrees, WGS 84) to easting and northing (m).

    They are within 5 cm of PROJ over the survey and 2 km around it; None for a local map, and where none is as near.
    With x = (longitude − `middle`[0]) / `half`[0] and y of the latitude alike, each of -1 to 1, easting and northing
    are the sums of c · x^i · y^j over the terms i + j ≤ `degree`, i from 0, then j from 0.
    """
    if frame.crs is None or extent_m is None:
        return None
    west, south, east, north = extent_m
    edge = np.linspace(0.0, 1.0, 9)
    ring = np.array([(x, y) for x in edge for y in edge])
    size = np.array([east - west + 2 * _AROUND_M, north - south + 2 * _AROUND_M])
    lon_lat = to_longitude_latitude(frame)(np.array([west - _AROUND_M, south - _AROUND_M]) + ring * size)
    if not np.isfinite(lon_lat).all():
        return None
    low, high = lon_lat.min(axis=0), lon_lat.max(axis=0)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    onto_map = from_longitude_latitude(frame)
    fit, check = (_square(count) for count in (_ALONG, 2 * _ALONG + 1))
    wanted, checked = (onto_map(middle + places * half) for places in (fit, check))
    if not (np.isfinite(wanted).all() and np.isfinite(checked).all()):
        return None
    for degree in range(1, _MOST + 1):
        factors = np.linalg.lstsq(_terms(fit, degree), wanted, rcond=None)[0]
        error_m = float(np.abs(_terms(check, degree) @ factors - checked).max())
        if error_m <= _WITHIN_M:
            return {
                "middle": middle.tolist(), "half": half.tolist(), "degree": degree, "easting": factors[:, 0].tolist(),
                "northing": factors[:, 1].tolist(), "error_m": round(error_m, 4),
            }  # fmt: skip
    return None


def _square(count: int) -> Float64:
    steps = np.linspace(-1.0, 1.0, count)
    return np.array([(x, y) for x in steps for y in steps])


def _terms(places: Float64, degree: int) -> Float64:
    x, y = places.T
    return np.column_stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])
