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
from roadscan.kernels.poses import NO_INTERVAL, attitude_at, find_interval, interval, position_at

KEPT, NO_POSE, RANGE, HEIGHT, OUTSIDE, NO_RETURN = 0, 1, 2, 3, 4, 5
"""Fates of a reading, the indices of the kernels' `fates` counters."""
FATES = 6

CLASS_KEPT, CLASS_NO_RETURN, CLASS_NO_POSE, CLASS_TOO_NEAR, CLASS_TOO_FAR, CLASS_TOO_LOW, CLASS_TOO_HIGH = range(7)
"""Classes of a reading; the window counts in its fate only."""

LIMITS = ("range_min", "range_max", "height_min", "height_max", "above_body_min", "above_body_max")
"""Order of the `limits` array (m)."""

NO_CHART = ((0.0,) * 10,) * 3
NO_FORMS = ((0.0,) * 6,) * 4
"""Chart and forms of a reading without a pose."""


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
def passes_heights(height, body_height, limits):
    """True for a height inside the absolute limits and those relative to the body."""
    above = height - body_height
    return limits[2] <= height <= limits[3] and limits[4] <= above <= limits[5]


@inlined
def mark(classes, index, kind):
    """Write the class of a reading, where classes are wanted: for `None` the compiler leaves all of it out."""
    if classes is not None:
        classes[index] = kind


@inlined
def range_class(distance, nearest):
    """Class of a reading outside the range limits (m)."""
    return CLASS_TOO_NEAR if distance < nearest else CLASS_TOO_FAR


@inlined
def height_class(height, body_height, limits):
    """Class of a height that :func:`passes_heights` refuses."""
    return CLASS_TOO_LOW if height < limits[2] or height - body_height < limits[4] else CLASS_TOO_HIGH


@inlined
def tile_and_rest(value_m, quanta_per_m, tile_quanta):
    """Tile number of a coordinate (m), and its quanta from the tile's edge.

    A floored division without the slow instruction: multiply, then mend the last unit.
    """
    quanta = np.int64(math.floor(value_m * quanta_per_m + 0.5))
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


@kernel
def georeference_returns(
    pose_epochs, xyz, mounting, knots, coefficients, valid, lattice, table, centres, charts,
    limits, quanta_per_m, tile_quanta, window, rows, tiles, quanta, fates, classes,
):  # fmt: skip
    """Place returns of a spinning lidar (or any readings with their own epoch and position).

    Parameters
    ----------
    pose_epochs : (n,) int64, GPS ns of the pose that places each return.
    xyz : (n, 3) float32, sensor frame, m.
    mounting : (12,) tuple, body from sensor (row by row), lever arm (m).
    knots, coefficients, valid : the trajectory (``kernels.poses``).
    lattice : (4,) tuple, see :func:`box_of`; table : (nx, ny, nz) int32; centres : (c, 3); charts : (c, 3, 10).
    limits : (6,) tuple of float64, see LIMITS.
    quanta_per_m : float64; tile_quanta : int64, edge of a tile.
    window : (4,) tuple of int64, first column, first row, end column, end row of the tiles wanted.
    rows : (n,) int32, out, index of the return; tiles : (n, 2) int32, out, column and row;
    quanta : (n, 3) int32, out, x and y from the tile's south-west corner, and height.
    fates : (6,) int64, in/out, counts by fate.
    classes : (n,) uint8, in/out, 0 on entry; the class of each reading that a filter leaves out is written. Or None.

    Returns
    -------
    int, how many points were written.
    """
    made = 0
    k = 0
    start, end = np.int64(1), np.int64(0)
    usable = False
    c = NO_INTERVAL
    box = (np.int64(-1), np.int64(-1), np.int64(-1))
    chart = np.int32(-1)
    east_chart, north_chart, height_chart = NO_CHART
    cx, cy, cz = 0.0, 0.0, 0.0
    b = mounting
    for i in range(pose_epochs.size):
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        distance2 = x * x + y * y + z * z
        if not (limits[0] * limits[0] <= distance2 <= limits[1] * limits[1]):
            fates[RANGE] += 1
            mark(classes, i, range_class(distance2, limits[0] * limits[0]))
            continue
        epoch = pose_epochs[i]
        if not (start <= epoch < end):
            k = find_interval(epoch, knots, k)
            usable = k >= 0 and valid[k]
            start, end = np.int64(1), np.int64(0)
            if usable:
                c = interval(coefficients, k)
                start, end = knots[k], knots[k + 1]
        if not usable:
            fates[NO_POSE] += 1
            mark(classes, i, CLASS_NO_POSE)
            continue
        u = (epoch - start) / (end - start)
        px, py, pz = position_at(c, u)
        here = box_of(px, py, pz, lattice)
        if here != box or chart < 0:
            box = here
            chart = chart_index(box, table)
            if chart < 0:
                fates[NO_POSE] += 1
                mark(classes, i, CLASS_NO_POSE)
                continue
            cx, cy, cz = centres[chart, 0], centres[chart, 1], centres[chart, 2]
            east_chart = expansion(charts, chart, 0)
            north_chart = expansion(charts, chart, 1)
            height_chart = expansion(charts, chart, 2)
        r = attitude_at(c, u)
        bx = b[0] * x + b[1] * y + b[2] * z + b[9]
        by = b[3] * x + b[4] * y + b[5] * z + b[10]
        bz = b[6] * x + b[7] * y + b[8] * z + b[11]
        px -= cx
        py -= cy
        pz -= cz
        dx = px + (r[0] * bx + r[1] * by + r[2] * bz)
        dy = py + (r[3] * bx + r[4] * by + r[5] * bz)
        dz = pz + (r[6] * bx + r[7] * by + r[8] * bz)
        height = map_value(height_chart, dx, dy, dz)
        body_height = map_value(height_chart, px, py, pz)
        if not passes_heights(height, body_height, limits):
            fates[HEIGHT] += 1
            mark(classes, i, height_class(height, body_height, limits))
            continue
        column, east = tile_and_rest(map_value(east_chart, dx, dy, dz), quanta_per_m, tile_quanta)
        row, north = tile_and_rest(map_value(north_chart, dx, dy, dz), quanta_per_m, tile_quanta)
        if not is_wanted(column, row, window):
            fates[OUTSIDE] += 1
            continue
        rows[made] = i
        tiles[made, 0] = column
        tiles[made, 1] = row
        quanta[made, 0] = east
        quanta[made, 1] = north
        quanta[made, 2] = math.floor(height * quanta_per_m + 0.5)
        made += 1
        fates[KEPT] += 1
    return made


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


@kernel
def georeference_profiles(
    epochs, ranges, origins, directions, scale, reading_period_ns,
    mounting, knots, coefficients, valid, lattice, table, centres, charts,
    limits, quanta_per_m, tile_quanta, window, rows, readings, tiles, quanta, fates, classes,
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
    scale : (2,) tuple, range_offset_m, range_step_m.
    reading_period_ns : float64.
    rows : (n·m,) int32, out, index of the profile; readings : (n·m,) int32, out, index in the profile.
    classes : (n·m,) uint8, in/out, or None.
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
                mark(classes, i * count + j, CLASS_NO_RETURN)
                continue
            distance = scale[0] + scale[1] * ranges[i, j]
            if not (limits[0] <= distance <= limits[1]):
                fates[RANGE] += 1
                mark(classes, i * count + j, range_class(distance, limits[0]))
                continue
            if not placed:
                fates[NO_POSE] += 1
                mark(classes, i * count + j, CLASS_NO_POSE)
                continue
            y = origins[j, 1] + distance * directions[j, 1]
            z = origins[j, 2] + distance * directions[j, 2]
            height = form_value(forms[2], y, z)
            if not passes_heights(height, forms[3][0], limits):
                fates[HEIGHT] += 1
                mark(classes, i * count + j, height_class(height, forms[3][0], limits))
                continue
            column, east = tile_and_rest(form_value(forms[0], y, z), quanta_per_m, tile_quanta)
            row, north = tile_and_rest(form_value(forms[1], y, z), quanta_per_m, tile_quanta)
            if not is_wanted(column, row, window):
                fates[OUTSIDE] += 1
                continue
            rows[made] = i
            readings[made] = j
            tiles[made, 0] = column
            tiles[made, 1] = row
            quanta[made, 0] = east
            quanta[made, 1] = north
            quanta[made, 2] = math.floor(height * quanta_per_m + 0.5)
            made += 1
            fates[KEPT] += 1
    return made
