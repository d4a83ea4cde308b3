"""Map coordinates of readings with an epoch each: returns of a spinning lidar, readings of a rotating mirror.

Poses are not evaluated for each reading. An interval between two knots of the trajectory is cut into equal *pose
steps* no longer than :data:`STEP_NS`; the exact pose is taken at four epochs of a step, a third of it apart, and
sensor origin, sensor axes and the body's height run between them as cubics in time. A cubic through four points
d apart departs from its function f by at most d⁴ max|f⁗| / 24 (Lagrange's remainder). Positions between knots are
cubics, so they stay exact. A point at distance r of a body that turns at ω with the angular acceleration α and
the angular jerk β has |f⁗| ≤ r (ω⁴ + 6 ω² α + 3 α² + 4 ω β). For 100 m, 300 °/s and 5 rad/s² that is
1.65·10⁵ m/s⁴, and with d = 1.7 ms the departure is 0.05 µm, whatever the body's acceleration; 1 µm is reached
at β = 1,400 rad/s³, more than a sudden change of α by 5 rad/s² makes of the trajectory's interpolation.

Steps depend on the trajectory's knots alone, never on the readings: a point does not depend on which others are
georeferenced with it, no step crosses a knot, and gaps begin and end exactly where they do. A step's chart is that of
its middle: in 5 ms the vehicle goes far less than the margin of a chart.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import bare_inner, inlined, inner, kernel
from roadscan.georeference.kernels.readings import (
    CLASS_KEPT,
    CLASS_NO_POSE,
    CLASS_NO_RETURN,
    CLASS_TOO_FAR,
    CLASS_TOO_HIGH,
    CLASS_TOO_LOW,
    CLASS_TOO_NEAR,
    HEIGHT,
    KEPT,
    NO_POSE,
    NO_RETURN,
    OUTSIDE,
    RANGE,
    Georeferenced,
    Returns,
    box_of,
    chart_index,
    expansion,
    is_wanted,
    map_value,
    tile_and_rest,
    write_point,
)
from roadscan.poses.kernels.poses import attitude_at, find_interval, interval, position_at

STEP_NS = 5_000_000
"""Longest pose step: one an interval of a trajectory at 200 Hz."""
CHUNK = 2048
"""Readings per chunk: the buffers stay in a core's second-level cache, and a pose step serves most of a chunk."""

FIRST_EPOCH, END_EPOCH = np.iinfo(np.int64).min, np.iinfo(np.int64).max
ORIGIN, AXES, BODY_HEIGHT, SENSOR_AT = 0, 3, 12, 13
"""Columns that :func:`sensor_at` writes: 3 of the origin, 9 of the axes, the body's height; and their number."""


@inlined
def sensor_at(c, u, b, centre, height_chart, out):
    """Write sensor origin (m, from a chart's centre), axes as matrix world ← sensor by rows, and body height (m)."""
    px, py, pz = position_at(c, u)
    r = attitude_at(c, u)
    px, py, pz = px - centre[0], py - centre[1], pz - centre[2]
    out[ORIGIN] = px + (r[0] * b[9] + r[1] * b[10] + r[2] * b[11])
    out[ORIGIN + 1] = py + (r[3] * b[9] + r[4] * b[10] + r[5] * b[11])
    out[ORIGIN + 2] = pz + (r[6] * b[9] + r[7] * b[10] + r[8] * b[11])
    for i in range(3):
        for j in range(3):
            out[AXES + 3 * i + j] = r[3 * i] * b[j] + r[3 * i + 1] * b[3 + j] + r[3 * i + 2] * b[6 + j]
    out[BODY_HEIGHT] = map_value(height_chart, px, py, pz)


@bare_inner
def pose_step(epoch, k, georeference, nodes, motion):
    """Compute the pose step that contains an epoch (GPS ns); `k` is the interval to search from.

    Parameters
    ----------
    nodes : (4, 13) float64, scratch: :func:`sensor_at` at the step's four epochs.
    motion : (4, 13) float64, out: coefficients 1, s, s², s³ of the same thirteen, s from −1 to 1 over the step.

    Returns
    -------
    first, end : int64, GPS ns, the span that this step serves, end exclusive.
    k : interval, −1 outside the trajectory; chart : −1 without a pose.
    per_ns : s is (epoch − first) · per_ns − 1.
    """
    knots, coefficients, valid = georeference.poses
    lattice, table, centres, charts = georeference.charts
    n = knots.size
    k = find_interval(epoch, knots, k)
    first, end = FIRST_EPOCH, END_EPOCH
    per_ns = 0.0
    chart = np.int64(-1)
    if k < 0:
        if n >= 2 and epoch < knots[0]:
            end = knots[0]
        elif n >= 2:
            first = knots[n - 1] + 1
    elif not valid[k]:
        first, end = knots[k], knots[k + 1]
    else:
        gap = knots[k + 1] - knots[k]
        steps = (gap + STEP_NS - 1) // STEP_NS
        length = (gap + steps - 1) // steps
        number = min((epoch - knots[k]) // length, steps - 1)
        first = knots[k] + number * length
        end = min(first + length, knots[k + 1])
        per_ns = 2.0 / length
        begin = np.float64(number * length)
        c = interval(coefficients, k)
        px, py, pz = position_at(c, (begin + 0.5 * length) / gap)
        chart = np.int64(chart_index(box_of(px, py, pz, lattice), lattice, table, centres))
        if chart >= 0:
            height_chart = expansion(charts, chart, 2)
            for a in range(4):
                u = (begin + a * length / 3.0) / gap
                sensor_at(c, u, georeference.mounting, centres[chart], height_chart, nodes[a])
            for a in range(SENSOR_AT):
                outer, inner = nodes[3, a] + nodes[0, a], nodes[2, a] + nodes[1, a]
                outer_step, inner_step = nodes[3, a] - nodes[0, a], nodes[2, a] - nodes[1, a]
                motion[0, a] = (9.0 * inner - outer) / 16.0
                motion[1, a] = (27.0 * inner_step - outer_step) / 16.0
                motion[2, a] = (9.0 * outer - 9.0 * inner) / 16.0
                motion[3, a] = (9.0 * outer_step - 27.0 * inner_step) / 16.0
    if k == n - 2 and end == knots[n - 1]:
        end += 1  # the last knot belongs to the last interval
    return first, end, k, chart, per_ns


@inlined
def cubic(motion, a):
    """Return the coefficients 1, s, s², s³ of the a-th of a step's motion."""
    return motion[0, a], motion[1, a], motion[2, a], motion[3, a]


@inlined
def at(c, s):
    """Return the value of a cubic at s."""
    return c[0] + s * (c[1] + s * (c[2] + s * c[3]))


@bare_inner
def place_step(step, motion, georeference, readings, begin, end, out):
    """Georeference readings `begin` to `end` − 1, all of one pose step; see :func:`place_ranged`.

    One loop without branches: it vectorises. step : (3,) tuple, the step's first epoch, part of it a ns, its chart.
    """
    first, per_ns, chart = step
    ox, oy, oz = cubic(motion, ORIGIN), cubic(motion, ORIGIN + 1), cubic(motion, ORIGIN + 2)
    xx, xy, xz = cubic(motion, AXES), cubic(motion, AXES + 1), cubic(motion, AXES + 2)
    yx, yy, yz = cubic(motion, AXES + 3), cubic(motion, AXES + 4), cubic(motion, AXES + 5)
    zx, zy, zz = cubic(motion, AXES + 6), cubic(motion, AXES + 7), cubic(motion, AXES + 8)
    body = cubic(motion, BODY_HEIGHT)
    charts = georeference.charts.coefficients
    to_east, to_north, to_height = expansion(charts, chart, 0), expansion(charts, chart, 1), expansion(charts, chart, 2)
    _, _, lowest, highest, deepest, tallest = georeference.limits
    quanta_per_m = georeference.quanta_per_m
    epochs, classes = readings.epochs[begin:end], out.classes[begin:end]
    x, y, z = readings.x[begin:end], readings.y[begin:end], readings.z[begin:end]
    east, north, height = out.east[begin:end], out.north[begin:end], out.height[begin:end]
    for i in range(epochs.size):
        s = (epochs[i] - first) * per_ns - 1.0
        dx = at(ox, s) + (at(xx, s) * x[i] + at(xy, s) * y[i] + at(xz, s) * z[i])
        dy = at(oy, s) + (at(yx, s) * x[i] + at(yy, s) * y[i] + at(yz, s) * z[i])
        dz = at(oz, s) + (at(zx, s) * x[i] + at(zy, s) * y[i] + at(zz, s) * z[i])
        up = map_value(to_height, dx, dy, dz)
        above = up - at(body, s)
        low = (up < lowest) | (above < deepest)
        fits = (up >= lowest) & (up <= highest) & (above >= deepest) & (above <= tallest)
        kind = np.uint8(CLASS_KEPT) if fits else (np.uint8(CLASS_TOO_LOW) if low else np.uint8(CLASS_TOO_HIGH))
        own = classes[i]
        classes[i] = own if own else kind
        east[i] = np.floor(map_value(to_east, dx, dy, dz) * quanta_per_m + 0.5)
        north[i] = np.floor(map_value(to_north, dx, dy, dz) * quanta_per_m + 0.5)
        height[i] = np.floor(up * quanta_per_m + 0.5)


@inlined
def returns_of(readings, first, end):
    """Return readings `first` to `end` − 1 of :class:`Returns`."""
    return Returns(readings.epochs[first:end], readings.x[first:end], readings.y[first:end], readings.z[first:end])


@inlined
def placed_of(out, first, end):
    """Return positions `first` to `end` − 1 of :class:`Georeferenced`."""
    return Georeferenced(
        out.east[first:end], out.north[first:end], out.height[first:end], out.classes[first:end],
        out.intervals[first:end],
    )  # fmt: skip


@inner
def place_ranged(readings, georeference, out, fates):
    """Georeference readings whose ranges are classified already.

    Parameters
    ----------
    readings : Returns in float64.
    out : Georeferenced; what is CLASS_KEPT on entry gets the class of its pose and height.
    fates : (≥ FATES,) int64, in/out, counts of the readings left out, by fate.
    """
    nodes, motion = np.empty((4, SENSOR_AT)), np.empty((4, SENSOR_AT))
    epochs, classes, intervals = readings.epochs, out.classes, out.intervals
    n = epochs.size
    k = np.int64(0)
    i = 0
    while i < n:
        first, end, k, chart, per_ns = pose_step(epochs[i], k, georeference, nodes, motion)
        stop = i + 1
        while stop < n and first <= epochs[stop] < end:
            stop += 1
        if chart >= 0:
            place_step((first, per_ns, chart), motion, georeference, readings, i, stop, out)
        for j in range(i, stop):
            intervals[j] = k
            if chart < 0 and classes[j] == CLASS_KEPT:
                classes[j] = CLASS_NO_POSE
        i = stop
    no_return, no_pose, out_of_range, kept = 0, 0, 0, 0
    for i in range(n):
        kind = classes[i]
        no_return += kind == CLASS_NO_RETURN
        no_pose += kind == CLASS_NO_POSE
        out_of_range += (kind == CLASS_TOO_NEAR) | (kind == CLASS_TOO_FAR)
        kept += kind == CLASS_KEPT
    fates[NO_RETURN] += no_return
    fates[NO_POSE] += no_pose
    fates[RANGE] += out_of_range
    fates[HEIGHT] += n - kept - no_return - no_pose - out_of_range


@kernel
def place_returns(start, end, returns, georeference, out, fates):
    """Georeference returns `start` to `end` − 1 of a spinning lidar (or any readings with epoch and position each).

    Call it for about :data:`CHUNK` returns at a time; how they are divided changes no bit of a result.

    Parameters
    ----------
    returns : Returns in float32; georeference : Georeference.
    out : Georeferenced of at least end − start readings; the places of returns `start` and those behind it.
    fates : (≥ FATES,) int64, in/out, counts of the returns left out, by fate.
    """
    n = end - start
    nearest, farthest = georeference.limits.range_min_m, georeference.limits.range_max_m
    near, far = nearest * nearest, farthest * farthest
    epochs, sx, sy, sz = np.empty(n, np.int64), np.empty(n), np.empty(n), np.empty(n)
    own_epochs, own_x, own_y, own_z = returns_of(returns, start, end)
    classes = out.classes
    for i in range(n):
        epochs[i] = own_epochs[i]
        a, b, c = np.float64(own_x[i]), np.float64(own_y[i]), np.float64(own_z[i])
        sx[i], sy[i], sz[i] = a, b, c
        distance2 = a * a + b * b + c * c
        outside = np.uint8(CLASS_TOO_NEAR) if distance2 < near else np.uint8(CLASS_TOO_FAR)
        classes[i] = np.uint8(CLASS_KEPT) if (distance2 >= near) & (distance2 <= far) else outside
    place_ranged(Returns(epochs, sx, sy, sz), georeference, placed_of(out, 0, n), fates)


@kernel
def place_mirror(start, end, profiles, georeference, out, fates):
    """Georeference profiles `start` to `end` − 1 of a rotating mirror; every reading has an epoch.

    Call it for as many profiles as make about :data:`CHUNK` readings.

    Parameters
    ----------
    profiles : MirrorProfiles.
    out : Georeferenced of at least (end − start) · m readings, profile by profile.
    Others as in :func:`place_returns`.
    """
    ranges, profile_epochs = profiles.ranges, profiles.epochs
    m = ranges.shape[1]
    n = (end - start) * m
    epochs, sx, sy, sz = np.empty(n, np.int64), np.zeros(n), np.empty(n), np.empty(n)
    later, rays = np.empty(m, np.int64), np.empty((4, m))
    for j in range(m):
        later[j] = np.int64(np.floor(j * profiles.reading_period_ns + 0.5))
        rays[0, j], rays[1, j] = profiles.origins[j, 1], profiles.directions[j, 1]
        rays[2, j], rays[3, j] = profiles.origins[j, 2], profiles.directions[j, 2]
    nearest, farthest = georeference.limits.range_min_m, georeference.limits.range_max_m
    offset, step = profiles.scale
    for p in range(end - start):
        raw, epoch, base = ranges[start + p], profile_epochs[start + p], p * m
        own_epochs, own_y, own_z = epochs[base : base + m], sy[base : base + m], sz[base : base + m]
        own_classes = out.classes[base : base + m]
        for j in range(m):
            distance = offset + step * raw[j]
            own_epochs[j] = epoch + later[j]
            own_y[j] = rays[0, j] + distance * rays[1, j]
            own_z[j] = rays[2, j] + distance * rays[3, j]
            outside = np.uint8(CLASS_TOO_NEAR) if distance < nearest else np.uint8(CLASS_TOO_FAR)
            kind = np.uint8(CLASS_KEPT) if (distance >= nearest) & (distance <= farthest) else outside
            own_classes[j] = kind if raw[j] else np.uint8(CLASS_NO_RETURN)
    place_ranged(Returns(epochs, sx, sy, sz), georeference, placed_of(out, 0, n), fates)


@kernel
def places(n):
    """Return arrays for the map positions of n readings."""
    return Georeferenced(np.empty(n), np.empty(n), np.empty(n), np.empty(n, np.uint8), np.empty(n, np.int32))


@bare_inner
def keep_points(first, n, made, placed, window, out):
    """Append the readings that are kept and lie in the window; write the classes of all where requested.

    Parameters
    ----------
    first : int64, number of the first reading; made : int64, points written before; window : Window.
    placed : Georeferenced, of which the first n are the readings; out : Points, rows of numbers of readings.

    Returns
    -------
    int, how many points are written now.
    """
    if out.classes.size:
        for i in range(n):
            out.classes[first + i] = placed.classes[i]
    for i in range(n):
        if placed.classes[i] != CLASS_KEPT:
            continue
        across = tile_and_rest(np.int64(placed.east[i]), window.tile_quanta)
        along = tile_and_rest(np.int64(placed.north[i]), window.tile_quanta)
        if not is_wanted(across[0], along[0], window.tiles):
            out.fates[OUTSIDE] += 1
            continue
        write_point(made, first + i, across, along, np.int64(placed.height[i]), out)
        made += 1
        out.fates[KEPT] += 1
    return made


@kernel
def georeference_returns(returns, georeference, window, out):
    """Georeference returns and write the points in the window; return the number of points written.

    returns : Returns; georeference : Georeference; window : Window; out : Points of as many rows as there are returns.
    """
    placed = places(CHUNK)
    made = np.int64(0)
    for start in range(0, returns.epochs.size, CHUNK):
        end = min(start + CHUNK, returns.epochs.size)
        place_returns(start, end, returns, georeference, placed, out.fates)
        made = keep_points(start, end - start, made, placed, window, out)
    return made


@kernel
def georeference_mirror(profiles, georeference, window, out):
    """Georeference the readings of a mirror's profiles and write the points in the window; return their number.

    profiles : MirrorProfiles; others as in :func:`georeference_returns`, with a row of `out` for each reading.
    """
    m = profiles.ranges.shape[1]
    at_once = max(CHUNK // m, 1)
    placed = places(at_once * m)
    made = np.int64(0)
    for start in range(0, profiles.epochs.size, at_once):
        end = min(start + at_once, profiles.epochs.size)
        place_mirror(start, end, profiles, georeference, placed, out.fates)
        made = keep_points(start * m, (end - start) * m, made, placed, window, out)
    for i in range(made):
        out.readings[i] = out.rows[i] % m
        out.rows[i] //= m
    return made


@kernel
def between_ticks(epochs, step, first, number, at, out):
    """Interpolate positions at epochs.

    Parameters
    ----------
    epochs : (n,) int64, ns; step : int64, ns from tick to tick; first : int64, epoch of tick 0 divided by the step.
    number : (t,) int64, row in `at` of each tick from the first on; the next tick's row follows a needed one's.
    at : (k, 3) float64, places at ticks; NaN where there is none.
    out : (3, n) float64, out.
    """
    i, length = 0, float(step)
    while i < epochs.size:  # epochs ascend, so many of them share a tick
        tick = epochs[i] // step
        begin, row, last = tick * step, number[tick - first], i + 1
        while last < epochs.size and begin <= epochs[last] < begin + step:
            last += 1
        for axis in range(3):
            before, after = at[row, axis], at[row + 1, axis]
            for k in range(i, last):
                share = (epochs[k] - begin) / length
                out[axis, k] = before * (1.0 - share) + after * share
        i = last
