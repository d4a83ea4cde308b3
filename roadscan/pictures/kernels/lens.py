"""The place of a point in a picture.

A picture is a pinhole with Brown–Conrady distortion (Brown 1971; signs and axes of OpenCV: x right, y down, z along
the optical axis), or equirectangular: longitude to the right and latitude downwards in even steps (Snyder 1987, plate
carrée).
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined

FOCAL_X, FOCAL_Y, CENTRE_X, CENTRE_Y, K1, K2, P1, P2, K3, FOLD, WIDTH, HEIGHT, AROUND = range(13)
"""Indices of a lens's parameters; FOLD: square of the tangent up to which its radius grows; AROUND: 1 for a picture
of 360°, whose focal length is in pixels a radian."""
LEAST_AHEAD_M = 0.1  # Least depth of a point in front of the camera (m).


@inlined
def place_of(x, y, z, axes, lens):
    """Return u, v (pixels) of a point and the square of its distance (m²); u and v are NaN where it is not shown.

    Parameters
    ----------
    x, y, z : from the eye to the point (m).
    axes : (3, 3) camera axes (x right, y down, z ahead) from those of x, y, z.
    lens : (13,) parameters in the order above.
    """
    a = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
    b = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
    ahead = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
    square = a * a + b * b + ahead * ahead
    u, v = np.nan, np.nan
    if lens[AROUND] > 0.0:
        if square >= LEAST_AHEAD_M * LEAST_AHEAD_M:
            u = lens[FOCAL_X] * math.atan2(a, ahead) + lens[CENTRE_X]
            v = lens[FOCAL_Y] * math.atan2(b, math.hypot(a, ahead)) + lens[CENTRE_Y]
    elif ahead >= LEAST_AHEAD_M:
        a /= ahead
        b /= ahead
        r2 = a * a + b * b
        if r2 < lens[FOLD]:
            radial = 1.0 + r2 * (lens[K1] + r2 * (lens[K2] + r2 * lens[K3]))
            u = a * radial + 2.0 * lens[P1] * a * b + lens[P2] * (r2 + 2.0 * a * a)
            v = b * radial + lens[P1] * (r2 + 2.0 * b * b) + 2.0 * lens[P2] * a * b
            u = lens[FOCAL_X] * u + lens[CENTRE_X]
            v = lens[FOCAL_Y] * v + lens[CENTRE_Y]
    return u, v, square
