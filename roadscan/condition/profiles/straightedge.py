"""Rolling straightedge: height of its middle above or below the line between its end wheels.

The beam stands on a wheel at either end and has a third in its middle, whose height above the mean of the other two is
the deviation, as the rolling straightedges of EN 13036-5/-7 and of US specifications (3 m, 10 ft, 16 ft) measure it
(public descriptions; the texts were not at hand, and compliance is not claimed).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.steps import roll_beam, roll_wheel
from roadscan.condition.profiles.profiles import heights_of, stations_of
from roadscan.condition.profiles.quarter_car import COARSEST_M
from roadscan.core.errors import ProfileError

LENGTHS_M = {"3 m": 3.0, "10 ft": 3.048, "16 ft": 4.8768}
"""Usual lengths of beams (m)."""


def straightedge_mm(
    x_m: npt.ArrayLike, height_m: npt.ArrayLike, length_m: float = 3.0, *, wheel_radius_m: float = 0.0
) -> Float64:
    """Return the deviation (n,) of a rolling straightedge's middle at each sample, positive over a bump (mm).

    NaN where the beam reaches beyond the profile, stands over a gap of more than a foot, or has no height under its
    middle.

    Parameters
    ----------
    x_m, height_m : (n,) stations, ascending, and heights, NaN where there is none (m).
    length_m : between the end wheels (m).
    wheel_radius_m : of all three wheels; they touch at a point where it is 0 (m).

    Raises
    ------
    ProfileError
        where the stations do not ascend, or the profile is shorter than the beam.
    """
    x = stations_of(x_m)
    heights = heights_of(height_m, x.size)[0]
    if not 0.0 < length_m <= x[-1] - x[0] or not 0.0 <= wheel_radius_m < 0.5 * length_m:
        raise ProfileError(
            f"a straightedge of {length_m:g} m with wheels of {wheel_radius_m:g} m on a profile of {x[-1] - x[0]:g} m",
            expected="a beam that is shorter than the profile, on wheels that are shorter than the beam",
        )
    there = np.isfinite(heights)
    found = np.full(x.size, np.nan)
    if there.sum() > 2:
        xs, hs = x[there], heights[there]
        wheel, deviation = np.empty(xs.size), np.empty(xs.size)
        roll_wheel(xs, hs, wheel_radius_m, wheel)
        roll_beam(xs, wheel, length_m, COARSEST_M, deviation)
        found[there] = 1e3 * deviation
    return found
