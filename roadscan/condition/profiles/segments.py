"""Segments of a road with one value of an index each: of one length, or between fixed stations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ProfileError


class Segments(NamedTuple):
    """Beginnings and ends of segments."""

    from_m: Float64
    """(segments,) station of the beginning (m)."""
    to_m: Float64
    """(segments,) station of the end (m)."""


def segments_of(
    first_m: float, last_m: float, length_m: float | None = None, stations_m: Sequence[float] | None = None
) -> Segments:
    """Divide the way between two stations into segments.

    Parameters
    ----------
    length_m : of each segment from `first_m` on; the last one may be shorter. One segment in all by default.
    stations_m : ends of segments, in place of a length; what lies outside the profile is left out.

    Raises
    ------
    ProfileError
        where the length is not positive, both are given, or fewer than two stations meet the profile.
    """
    if length_m is not None and stations_m is not None:
        raise ProfileError("a length of segments and fixed stations", expected="one of them")
    if stations_m is not None:
        ends: Float64 = np.unique(np.asarray(stations_m, np.float64))
        if not np.isfinite(ends).all():
            raise ProfileError(f"a station {ends[~np.isfinite(ends)][0]}", expected="finite numbers, in metres")
        inside = (ends[1:] > first_m) & (ends[:-1] < last_m) if ends.size > 1 else np.zeros(0, bool)
        if not inside.any():
            raise ProfileError(
                f"{ends.size} stations, none of whose segments meets the profile",
                expected=f"two or more, between {first_m:g} and {last_m:g} m",
            )
        return Segments(ends[:-1][inside], ends[1:][inside])
    if length_m is None:
        return Segments(np.array([first_m]), np.array([last_m]))
    if not 0.0 < length_m < np.inf:
        raise ProfileError(f"segments of {length_m:g} m", expected="a finite length above 0 m")
    # A remainder of less than a millionth of a segment is rounding.
    count = max(1, int(np.ceil((last_m - first_m) / length_m - 1e-6)))
    ends = np.asarray(first_m + length_m * np.arange(count + 1), np.float64)
    ends[-1] = last_m
    return Segments(ends[:-1], ends[1:])
