"""Direct georeferencing: readings, poses and the local form of the map → points in quanta.

    p_world = t + R_world←body · (R_body←sensor · p_sensor + l_body)
    map     = chart(p_world)

The chart is the second-order expansion of the map projection about the centre of a small box of world
space (see ``roadscan.points.charts``); the box is chosen by the pose, so a point never depends on which
other readings were computed with it. Coordinates leave as whole quanta (10 µm).
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.kernels.options import inlined, kernel
from roadscan.kernels.poses import attitude_at, interval, position_at

KEPT, NO_POSE, RANGE, HEIGHT, OUTSIDE, NO_RETURN = 0, 1, 2, 3, 4, 5
"""Fates of a reading, the indices of the kernels' `fates` counters."""
FATES = 6

CLASS_KEPT, CLASS_NO_RETURN, CLASS_NO_POSE, CLASS_TOO_NEAR, CLASS_TOO_FAR, CLASS_TOO_LOW, CLASS_TOO_HIGH = range(7)
"""Classes of a reading; the window counts in its fate only."""

LIMITS = ("range_min", "range_max", "height_min", "height_max", "above_body_min", "above_body_max")
"""Order of the `limits` array (m)."""

NO_FORMS = ((0.0,) * 6,) * 4
"""Forms of a reading without a pose."""


@inlined
def box_of(px, py, pz, lattice):
    """Indices of the lattice box that holds a world position (m); lattice: (edge, first x, first y, first z)."""
    return (
        np.int64(math.floor(px / lattice[0]) - lattice[1]),
        np.int64(math.floor(py / lattice[0]) - lattice[2]),
        np.int64(math.floor(pz / lattice[0]) - lattice[3]),
    )


@inlined
def chart_index(box, table):
    """Chart of a box, −1 where none was made; table: (nx, ny, nz) int32."""
    x, y, z = box
    inside = 0 <= x < table.shape[0] and 0 <= y < table.shape[1] and 0 <= z < table.shape[2]
    return table[x, y, z] if inside else np.int32(-1)


@inlined
def expansion(charts, k, a):
    """Coefficients of map coordinate `a` in chart `k`: 1, x, y, z, xx, xy, xz, yy, yz, zz."""
    c = charts
    return (
        c[k, a, 0], c[k, a, 1], c[k, a, 2], c[k, a, 3], c[k, a, 4],
        c[k, a, 5], c[k, a, 6], c[k, a, 7], c[k, a, 8], c[k, a, 9],
    )  # fmt: skip


@inlined
def map_value(c, dx, dy, dz):
    """One map coordinate (m) at an offset (m) from the chart's centre, with its expansion `c`."""
    return (
        c[0]
        + dx * (c[1] + c[4] * dx + c[5] * dy + c[6] * dz)
        + dy * (c[2] + c[7] * dy + c[8] * dz)
        + dz * (c[3] + c[9] * dz)
    )


@inlined
def tile_and_rest(quanta, tile_quanta):
    """Tile number of a coordinate (quanta, int64), and its quanta from the tile's edge.

    A floored division without the slow instruction: multiply, then mend the last unit.
    """
    tile = np.int64(math.floor(quanta * (1.0 / tile_quanta)))
    rest = quanta - tile * tile_quanta
    if rest < 0:
        tile -= 1
        rest += tile_quanta
    elif rest >= tile_quanta:
        tile += 1
        rest -= tile_quanta
    return tile, rest


@inlined
def is_wanted(column, row, window):
    """True for a tile inside the window (first column, first row, end column, end row)."""
    return window[0] <= column < window[2] and window[1] <= row < window[3]


@inlined
def profile_form(c, ox, oy, oz, axis_y, axis_z):
    """A map coordinate over the profile's plane: (constant, y, z, y², y z, z²) coefficients.

    c : expansion of the coordinate; ox, oy, oz : sensor origin from the chart's centre (m);
    axis_y, axis_z : the sensor's y and z axes in the world (its x does not occur in a profile).
    """
    gx = c[1] + 2.0 * c[4] * ox + c[5] * oy + c[6] * oz
    gy = c[2] + c[5] * ox + 2.0 * c[7] * oy + c[8] * oz
    gz = c[3] + c[6] * ox + c[8] * oy + 2.0 * c[9] * oz
    ax, ay, az = axis_y
    bx, by, bz = axis_z
    return (
        map_value(c, ox, oy, oz),
        gx * ax + gy * ay + gz * az,
        gx * bx + gy * by + gz * bz,
        ax * (c[4] * ax + c[5] * ay + c[6] * az) + ay * (c[7] * ay + c[8] * az) + c[9] * az * az,
        2.0 * (c[4] * ax * bx + c[7] * ay * by + c[9] * az * bz)
        + c[5] * (ax * by + ay * bx) + c[6] * (ax * bz + az * bx) + c[8] * (ay * bz + az * by),
        bx * (c[4] * bx + c[5] * by + c[6] * bz) + by * (c[7] * by + c[8] * bz) + c[9] * bz * bz,
    )  # fmt: skip


@inlined
def form_value(f, y, z):
    """Value of :func:`profile_form` at sensor coordinates y, z (m)."""
    return f[0] + y * (f[1] + f[3] * y + f[4] * z) + z * (f[2] + f[5] * z)


@kernel
def profile_forms(epoch, k, mounting, knots, coefficients, valid, lattice, table, centres, charts):
    """Map coordinates of a profile's plane at one epoch, in trajectory interval `k`.

    Returns
    -------
    placed : bool, False where there is no pose.
    forms : easting, northing, height as :func:`profile_form`; last, the body's height in the first place.
    """
    if k < 0 or not valid[k]:
        return False, NO_FORMS
    c = interval(coefficients, k)
    u = (epoch - knots[k]) / (knots[k + 1] - knots[k])
    px, py, pz = position_at(c, u)
    chart = chart_index(box_of(px, py, pz, lattice), table)
    if chart < 0:
        return False, NO_FORMS
    r = attitude_at(c, u)
    px -= centres[chart, 0]
    py -= centres[chart, 1]
    pz -= centres[chart, 2]
    b = mounting
    ox = px + (r[0] * b[9] + r[1] * b[10] + r[2] * b[11])
    oy = py + (r[3] * b[9] + r[4] * b[10] + r[5] * b[11])
    oz = pz + (r[6] * b[9] + r[7] * b[10] + r[8] * b[11])
    axis_y = (
        r[0] * b[1] + r[1] * b[4] + r[2] * b[7],
        r[3] * b[1] + r[4] * b[4] + r[5] * b[7],
        r[6] * b[1] + r[7] * b[4] + r[8] * b[7],
    )
    axis_z = (
        r[0] * b[2] + r[1] * b[5] + r[2] * b[8],
        r[3] * b[2] + r[4] * b[5] + r[5] * b[8],
        r[6] * b[2] + r[7] * b[5] + r[8] * b[8],
    )
    height_chart = expansion(charts, chart, 2)
    return True, (
        profile_form(expansion(charts, chart, 0), ox, oy, oz, axis_y, axis_z),
        profile_form(expansion(charts, chart, 1), ox, oy, oz, axis_y, axis_z),
        profile_form(height_chart, ox, oy, oz, axis_y, axis_z),
        (map_value(height_chart, px, py, pz), 0.0, 0.0, 0.0, 0.0, 0.0),
    )
