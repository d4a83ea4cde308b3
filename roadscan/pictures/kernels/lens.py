"""The place of a point in a picture.

A picture is a pinhole with Brown–Conrady distortion (Brown 1971; signs and axes of OpenCV: x right, y down, z along
the optical axis), or equirectangular: longitude to the right and latitude downwards in even steps (Snyder 1987, plate
carrée).

The picture with the finest resolution at a point, and the point's colour in it.

Points are processed one by one, so the result for one does not depend on the others.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel

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


REACH, SINE, BORDER = range(3)
"""Indices of the limits: square of the farthest distance (m²), sine of the least angle, pixels of the border."""


@kernel
def take_better(point_m, eye_m, turn, up, lens, limits, hidden, number, best, chosen, pixel):
    """Assign to a picture the points that it shows better than those before it.

    Better is finer: less distance over focal length, distance²/(fx · fy). Of equals the first stays.

    Parameters
    ----------
    point_m : (n, 3) float64, world frame (m).
    eye_m : (3,) where the camera was.
    turn : (3, 3) camera axes (x right, y down, z ahead) from world.
    up : (3,) unit vector.
    lens : (19,) parameters in the order of `roadscan.pictures.kernels.lens`.
    limits : (3,) in the order above.
    hidden : (height, width) bool, pixels that are not used; (0, 0) where there are none.
    number : the picture's number in `chosen`.
    best : (n,) float64, read and written; inf where no picture shows a point.
    chosen : (n,) int32, written.
    pixel : (n, 2) float64, u and v from the centre of the upper left pixel; written.
    """
    finer = 1.0 / (lens[FOCAL_X] * lens[FOCAL_Y])
    right, bottom = lens[WIDTH] - 1.0 - limits[BORDER], lens[HEIGHT] - 1.0 - limits[BORDER]
    for i in range(point_m.shape[0]):
        x = point_m[i, 0] - eye_m[0]
        y = point_m[i, 1] - eye_m[1]
        z = point_m[i, 2] - eye_m[2]
        square = x * x + y * y + z * z
        if not (square <= limits[REACH] and square * finer < best[i]):
            continue
        if -(x * up[0] + y * up[1] + z * up[2]) < limits[SINE] * math.sqrt(square):
            continue
        u, v, _ = place_of(x, y, z, turn, lens)
        if not (limits[BORDER] <= u <= right and limits[BORDER] <= v <= bottom):
            continue
        if hidden.size > 0 and hidden[int(v + 0.5), int(u + 0.5)]:
            continue
        best[i] = square * finer
        chosen[i] = number
        pixel[i, 0] = u
        pixel[i, 1] = v


@kernel
def sample(picture, pixel, colour):
    """Compute bilinear values of a picture, to the nearest whole number.

    Parameters
    ----------
    picture : (height, width, 3) uint8.
    pixel : (n, 2) float64, u and v within the picture, from the centre of the upper left pixel.
    colour : (n, 3) uint8, written, channels as in the picture.
    """
    last_row, last_column = picture.shape[0] - 1, picture.shape[1] - 1
    for i in range(pixel.shape[0]):
        column = min(int(pixel[i, 0]), last_column)
        row = min(int(pixel[i, 1]), last_row)
        below, beside = min(row + 1, last_row), min(column + 1, last_column)
        s = pixel[i, 0] - column
        t = pixel[i, 1] - row
        for c in range(3):
            above = (1.0 - s) * picture[row, column, c] + s * picture[row, beside, c]
            under = (1.0 - s) * picture[below, column, c] + s * picture[below, beside, c]
            colour[i, c] = np.uint8((1.0 - t) * above + t * under + 0.5)
