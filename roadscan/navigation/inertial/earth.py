"""The Earth's level axes, normal gravity and rotation (WGS 84).

WGS 84; other datums differ by far less than an accelerometer resolves.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.navigation.inertial.kernels.strapdown import EARTH_RATE_RAD_PER_S, geodetic_of, gravity_at

EARTH_RATE_ECEF_RAD_PER_S: Final[Float64] = np.array([0.0, 0.0, EARTH_RATE_RAD_PER_S])  # ECEF axes.


def ecef_from_level(position_ecef_m: Float64) -> Float64:
    """Return rotations (n, 3, 3) from north-east-down to ECEF at positions (n, 3). Groves (2013), eq. 2.150."""
    found = np.empty((len(position_ecef_m), 5))
    geodetic_of(np.ascontiguousarray(position_ecef_m), found)
    sa, ca, so, co, _ = found.T
    rows = [[-sa * co, -so, -ca * co], [-sa * so, co, -ca * so], [ca, np.zeros_like(ca), -sa]]
    axes: Float64 = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return axes


def gravity_ecef(position_ecef_m: Float64) -> Float64:
    """Return normal gravity (3,) at a position (3,), ECEF axes (m/s²)."""
    size, *up = gravity_at(*(float(x) for x in position_ecef_m))
    gravity: Float64 = -size * np.array(up)
    return gravity
