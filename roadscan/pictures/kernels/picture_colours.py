"""The picture with the finest resolution at a point, and the point's colour in it.

Points are processed one by one, so the result for one does not depend on the others.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import kernel
from roadscan.pictures.kernels.lens import FOCAL_X, FOCAL_Y, HEIGHT, WIDTH, place_of

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
