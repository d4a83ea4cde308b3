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
ROW_SHIFT, ROW_TURN, PARAMETERS = 13, 16, 19
"""Indices of what a rolling shutter adds: the way (m) and the turn (rad) of the camera from row to row, along its axes;
number of all parameters."""
ROW_ROUNDS = 12
"""Rounds in which a point finds the row that is exposed when it is there, at most: of a point 3 m away at 100 km/h and
40 µs a row, what is left falls to a fifth from round to round."""
ROW_SETTLED_PX = 1e-3  # Rows that change by less than this (pixels) are found.
LEAST_AHEAD_M = 0.1  # Least depth of a point in front of the camera (m).


@inlined
def pixel_of(a, b, ahead, square, lens):
    """Return u, v of a point in camera axes and the square of its distance; NaN where it is not shown."""
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
    return u, v


@inlined
def place_of(x, y, z, axes, lens):
    """Return u, v (pixels) of a point and the square of its distance (m²); u and v are NaN where it is not shown.

    Parameters
    ----------
    x, y, z : from the eye to the point (m).
    axes : (3, 3) camera axes (x right, y down, z ahead) from those of x, y, z.
    lens : (19,) parameters in the order above.
    """
    a = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
    b = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
    ahead = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
    square = a * a + b * b + ahead * ahead
    u, v = pixel_of(a, b, ahead, square, lens)
    moves = False
    for k in range(ROW_SHIFT, PARAMETERS):
        moves = moves or lens[k] != 0.0
    if moves:
        for _ in range(ROW_ROUNDS):
            before, rows = v, v - 0.5 * (lens[HEIGHT] - 1.0)
            c, d, e = (
                a - rows * (lens[ROW_SHIFT] + lens[ROW_TURN + 1] * ahead - lens[ROW_TURN + 2] * b),
                b - rows * (lens[ROW_SHIFT + 1] + lens[ROW_TURN + 2] * a - lens[ROW_TURN] * ahead),
                ahead - rows * (lens[ROW_SHIFT + 2] + lens[ROW_TURN] * b - lens[ROW_TURN + 1] * a),
            )
            u, v = pixel_of(c, d, e, c * c + d * d + e * e, lens)
            if not abs(v - before) > ROW_SETTLED_PX:
                break
    return u, v, square
