"""The first place at which rays meet a raster of heights."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import kernel

NO_GROUND = -1.0
"""Distance of a ray that meets no known height within its reach (m)."""
BELOW = -2.0
"""Distance of a ray that went below the ground where no height is known: what it shows lies in between (m)."""


@kernel
def first_hits(heights, corner, edge_m, eye, way, limits, distance_m):
    """Compute how far along each ray the ground is met first.

    The ray is followed in steps of half a cell. It meets the ground where it comes below the height of the cell, if it
    was above a known cell within `limits[1]` before, or is not more than `limits[2]` below.

    Parameters
    ----------
    heights : (rows, columns) float64 from south to north and west to east (m); NaN where none is known.
    corner : (2,) easting and northing of the raster's south-western corner (m).
    edge_m : edge of a cell (m).
    eye : (3,) where the rays begin: easting, northing, height (m).
    way : (n, 3) unit vectors of the map.
    limits : (3,) reach, widest gap and greatest depth (m).
    distance_m : (n,) float64, written; `NO_GROUND` or `BELOW` where the ground is not met.
    """
    step = 0.5 * edge_m
    for i in range(way.shape[0]):
        distance_m[i] = NO_GROUND
        above, over = -1.0, 0.0
        for k in range(int(limits[0] / step) + 1):
            along = k * step
            column = math.floor((eye[0] + along * way[i, 0] - corner[0]) / edge_m)
            row = math.floor((eye[1] + along * way[i, 1] - corner[1]) / edge_m)
            if row < 0 or column < 0 or row >= heights.shape[0] or column >= heights.shape[1]:
                continue
            ground = heights[row, column]
            if np.isnan(ground):
                continue
            past = eye[2] + along * way[i, 2] - ground
            if past > 0.0:
                above, over = along, past
            elif above >= 0.0 and along - above <= limits[1]:
                distance_m[i] = above + (along - above) * over / (over - past)
                break
            elif -past <= limits[2]:
                distance_m[i] = along
                break
            else:
                distance_m[i] = BELOW
                break
