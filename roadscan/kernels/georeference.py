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
from roadscan.kernels.poses import attitude_at, find_interval, position_at

KEPT, NO_POSE, RANGE, HEIGHT, OUTSIDE, NO_RETURN = 0, 1, 2, 3, 4, 5
"""Fates of a reading, the indices of the kernels' `fates` counters."""
FATES = 6

NO_FORMS = ((0.0,) * 6,) * 4
"""Forms of a profile without a pose."""

LIMITS = ("range_min", "range_max", "height_min", "height_max", "above_body_min", "above_body_max")
"""Order of the `limits` array (m)."""


@inlined
def chart_index(px, py, pz, lattice, table):
    """Chart of the lattice box that holds a world position, −1 where none was made.

    lattice : (4,) float64 box edge (m) and the indices of the first box; table : (nx, ny, nz) int32.
    """
    ix = int(math.floor(px / lattice[0]) - lattice[1])
    iy = int(math.floor(py / lattice[0]) - lattice[2])
    iz = int(math.floor(pz / lattice[0]) - lattice[3])
    inside = 0 <= ix < table.shape[0] and 0 <= iy < table.shape[1] and 0 <= iz < table.shape[2]
    return table[ix, iy, iz] if inside else -1


@inlined
def map_value(c, dx, dy, dz):
    """One map coordinate (m) at an offset (m) from the chart's centre; c: (10,) coefficients."""
    return (
        c[0]
        + dx * (c[1] + c[4] * dx + c[5] * dy + c[6] * dz)
        + dy * (c[2] + c[7] * dy + c[8] * dz)
        + dz * (c[3] + c[9] * dz)
    )


@inlined
def passes_heights(height, body_height, limits):
    """True for a height inside the absolute limits and those relative to the body."""
    above = height - body_height
    return limits[2] <= height <= limits[3] and limits[4] <= above <= limits[5]


@inlined
def write_point(east, north, height, quanta_per_m, tile_quanta, window, tiles, quanta, at):
    """Write a point (m) as tile and quanta at index `at`; False where its tile is not wanted."""
    x, y = math.floor(east * quanta_per_m + 0.5), math.floor(north * quanta_per_m + 0.5)
    column, row = x // tile_quanta, y // tile_quanta
    wanted = window[0] <= column < window[2] and window[1] <= row < window[3]
    if wanted:
        tiles[at, 0] = column
        tiles[at, 1] = row
        quanta[at, 0] = x - column * tile_quanta
        quanta[at, 1] = y - row * tile_quanta
        quanta[at, 2] = math.floor(height * quanta_per_m + 0.5)
    return wanted


@kernel
def georeference_returns(
    pose_epochs, xyz, mounting, knots, coefficients, valid, lattice, table, centres, charts,
    limits, quanta_per_m, tile_quanta, window, rows, tiles, quanta, fates,
):  # fmt: skip
    """Place returns of a spinning lidar (or any readings with their own epoch and position).

    Parameters
    ----------
    pose_epochs : (n,) int64, GPS ns of the pose that places each return.
    xyz : (n, 3) float32, sensor frame, m.
    mounting : (3, 4) float64, body from sensor | lever arm (m).
    knots, coefficients, valid : the trajectory (``kernels.poses``).
    lattice, table : see :func:`chart_index`; centres : (c, 3); charts : (c, 3, 10).
    limits : (6,) float64, see LIMITS.
    quanta_per_m : float64; tile_quanta : int64, edge of a tile.
    window : (4,) int64, first column, first row, end column, end row of the tiles wanted.
    rows : (n,) int32, out, index of the return; tiles : (n, 2) int32, out, column and row;
    quanta : (n, 3) int32, out, x and y from the tile's south-west corner, and height.
    fates : (6,) int64, in/out, counts by fate.

    Returns
    -------
    int, how many points were written.
    """
    made = 0
    k = 0
    for i in range(pose_epochs.size):
        x, y, z = float(xyz[i, 0]), float(xyz[i, 1]), float(xyz[i, 2])
        distance2 = x * x + y * y + z * z
        if not (limits[0] * limits[0] <= distance2 <= limits[1] * limits[1]):
            fates[RANGE] += 1
            continue
        k = find_interval(pose_epochs[i], knots, k)
        if k < 0 or not valid[k]:
            fates[NO_POSE] += 1
            continue
        c = coefficients[k]
        u = (pose_epochs[i] - knots[k]) / (knots[k + 1] - knots[k])
        px, py, pz = position_at(c, u)
        chart = chart_index(px, py, pz, lattice, table)
        if chart < 0:
            fates[NO_POSE] += 1
            continue
        r = attitude_at(c, u)
        bx = mounting[0, 0] * x + mounting[0, 1] * y + mounting[0, 2] * z + mounting[0, 3]
        by = mounting[1, 0] * x + mounting[1, 1] * y + mounting[1, 2] * z + mounting[1, 3]
        bz = mounting[2, 0] * x + mounting[2, 1] * y + mounting[2, 2] * z + mounting[2, 3]
        px -= centres[chart, 0]
        py -= centres[chart, 1]
        pz -= centres[chart, 2]
        dx = px + (r[0] * bx + r[1] * by + r[2] * bz)
        dy = py + (r[3] * bx + r[4] * by + r[5] * bz)
        dz = pz + (r[6] * bx + r[7] * by + r[8] * bz)
        height = map_value(charts[chart, 2], dx, dy, dz)
        if not passes_heights(height, map_value(charts[chart, 2], px, py, pz), limits):
            fates[HEIGHT] += 1
            continue
        east = map_value(charts[chart, 0], dx, dy, dz)
        north = map_value(charts[chart, 1], dx, dy, dz)
        if not write_point(east, north, height, quanta_per_m, tile_quanta, window, tiles, quanta, made):
            fates[OUTSIDE] += 1
            continue
        rows[made] = i
        made += 1
        fates[KEPT] += 1
    return made


@inlined
def profile_form(c, ox, oy, oz, axis_y, axis_z):
    """A map coordinate over the profile's plane: (constant, y, z, y², y z, z²) coefficients.

    c : (10,) chart; ox, oy, oz : sensor origin from the chart's centre (m);
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
    c = coefficients[k]
    u = (epoch - knots[k]) / (knots[k + 1] - knots[k])
    px, py, pz = position_at(c, u)
    chart = chart_index(px, py, pz, lattice, table)
    if chart < 0:
        return False, NO_FORMS
    r = attitude_at(c, u)
    px -= centres[chart, 0]
    py -= centres[chart, 1]
    pz -= centres[chart, 2]
    b = mounting
    ox = px + (r[0] * b[0, 3] + r[1] * b[1, 3] + r[2] * b[2, 3])
    oy = py + (r[3] * b[0, 3] + r[4] * b[1, 3] + r[5] * b[2, 3])
    oz = pz + (r[6] * b[0, 3] + r[7] * b[1, 3] + r[8] * b[2, 3])
    axis_y = (
        r[0] * b[0, 1] + r[1] * b[1, 1] + r[2] * b[2, 1],
        r[3] * b[0, 1] + r[4] * b[1, 1] + r[5] * b[2, 1],
        r[6] * b[0, 1] + r[7] * b[1, 1] + r[8] * b[2, 1],
    )
    axis_z = (
        r[0] * b[0, 2] + r[1] * b[1, 2] + r[2] * b[2, 2],
        r[3] * b[0, 2] + r[4] * b[1, 2] + r[5] * b[2, 2],
        r[6] * b[0, 2] + r[7] * b[1, 2] + r[8] * b[2, 2],
    )
    return True, (
        profile_form(charts[chart, 0], ox, oy, oz, axis_y, axis_z),
        profile_form(charts[chart, 1], ox, oy, oz, axis_y, axis_z),
        profile_form(charts[chart, 2], ox, oy, oz, axis_y, axis_z),
        (map_value(charts[chart, 2], px, py, pz), 0.0, 0.0, 0.0, 0.0, 0.0),
    )


@kernel
def georeference_profiles(
    epochs, ranges, origins, directions, scale, reading_period_ns,
    mounting, knots, coefficients, valid, lattice, table, centres, charts,
    limits, quanta_per_m, tile_quanta, window, rows, readings, tiles, quanta, fates,
):  # fmt: skip
    """Place the readings of a line scanner's profiles.

    A profile measured at once has one pose, and its map coordinates are quadratic forms in the
    sensor's y and z, exact to the chart's own order; a profile of a turning mirror
    (`reading_period_ns` > 0) has a pose a reading.

    Parameters
    ----------
    epochs : (n,) int64, GPS ns of each profile's first reading.
    ranges : (n, m) uint16, raw, 0 no return.
    origins, directions : (m, 3) float64, sensor frame, m; x is 0 (``ScanGeometry.rays``).
    scale : (2,) float64, range_offset_m, range_step_m.
    reading_period_ns : float64.
    rows : (n·m,) int32, out, index of the profile; readings : (n·m,) int32, out, index in the profile.
    Others as in :func:`georeference_returns`.

    Returns
    -------
    int, how many points were written.
    """
    made = 0
    k = 0
    count = ranges.shape[1]
    for i in range(epochs.size):
        forms = NO_FORMS
        placed = False
        for j in range(count):
            if j == 0 or reading_period_ns > 0.0:
                epoch = epochs[i] + np.int64(math.floor(j * reading_period_ns + 0.5))
                k = find_interval(epoch, knots, k)
                placed, forms = profile_forms(
                    epoch, k, mounting, knots, coefficients, valid, lattice, table, centres, charts
                )
            if ranges[i, j] == 0:
                fates[NO_RETURN] += 1
                continue
            distance = scale[0] + scale[1] * ranges[i, j]
            if not (limits[0] <= distance <= limits[1]):
                fates[RANGE] += 1
                continue
            if not placed:
                fates[NO_POSE] += 1
                continue
            y = origins[j, 1] + distance * directions[j, 1]
            z = origins[j, 2] + distance * directions[j, 2]
            height = form_value(forms[2], y, z)
            if not passes_heights(height, forms[3][0], limits):
                fates[HEIGHT] += 1
                continue
            east, north = form_value(forms[0], y, z), form_value(forms[1], y, z)
            if not write_point(east, north, height, quanta_per_m, tile_quanta, window, tiles, quanta, made):
                fates[OUTSIDE] += 1
                continue
            rows[made] = i
            readings[made] = j
            made += 1
            fates[KEPT] += 1
    return made
