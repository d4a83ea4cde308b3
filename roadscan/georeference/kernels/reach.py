"""Bounds where readings can lie on the map from poses alone: the tiles that a row group may touch.

What a sensor may have seen at one instant is a box in its frame: of a profile the rectangle from its nearest to its
farthest range, of a lidar the box around its returns. Between two instants of an unbroken trajectory,

    map(p, t) ∈ (1 − s) A₀(p) + s A₁(p) ⊕ margin,   s = (t − t₀) / (t₁ − t₀)

with A₀, A₁ the first-order map of the sensor's frame at both ends. Over a box of p that is a zonotope: the box's
half edges and half the motion are its generators. The margin, derived in :func:`frames_between`, covers all else, so
a tile that is not marked holds no reading. Where poses are corrected afterwards, `moved` bounds how far on the ground
that moves a reading; on the map it is that times the chart's slope, and widens the margin.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.georeference.kernels.readings import box_of, chart_index, expansion, map_value
from roadscan.georeference.kernels.tile_set import add_tile, mark_zonotope, take, tile_set
from roadscan.poses.kernels.poses import attitude_at, find_interval, interval, position_at

SLACK_M = 0.001
"""Allowance for rounding: float32 coordinates to 1 km, whole quanta, nanoseconds."""
CHART_SLACK = 4e-13
"""Disagreement of neighbouring charts over distance³ (1/m²): sixteen times 1/R², the Earth's radius R."""
STEP_M = 1.0
"""A box moves by about this between two evaluated poses, unless its path bends by BEND_M sooner."""
BEND_M = 0.03  # Departure from a straight path at which another pose is evaluated.
FAR_STEP_M, FAR_BEND_M = 3.0, 0.05
"""The same for boxes of returns, which are far larger."""
LEAST_STEP_NS = 100_000
"""Least time between two evaluated poses: poses that jump then widen the margin and do not stop the loop."""
MOST_TILES = 8192
"""Most tiles of a row group."""
SAMPLE_M = 5.0
"""The readings of a piece are distributed over places at this spacing along the range."""

FIRST, LAST, SINE, COSINE, OFFSET, HALF_WIDTH, HALF_SINE, HALF_COSINE, BLOCK = range(9)
"""Columns of a profile's pieces, see :class:`SpannedProfiles`."""


class SpannedProfiles(NamedTuple):
    """Profiles of row groups whose range spans are known."""

    epochs: npt.NDArray[np.int64]
    """(n,) GPS ns of each profile's first reading, ascending in a group."""
    low: npt.NDArray[np.uint16]
    """(n, m) least raw range of the readings of each block, 0 without any."""
    high: npt.NDArray[np.uint16]
    """(n, m) greatest raw range, likewise."""
    starts: npt.NDArray[np.int64]
    """(g + 1,) first profile of each group."""
    pieces: npt.NDArray[np.float64]
    """(p, 9) what a profile is cut into: its first and last reading (FIRST, LAST) and its block of `low` and `high`;
    sine and cosine of the direction its ranges run along, from z towards y; its offset from the sensor's origin and its
    half width across that (m); sine and cosine of half the angle between its outer beams."""
    scale: tuple[float, float]
    """Range of a raw 0 and step between raw ranges (m)."""
    reading_period_ns: float
    """From one reading of a profile to the next; 0 where all are measured at once."""


@inlined
def norm3(x, y, z):
    """Return the length of a vector."""
    return math.sqrt(x * x + y * y + z * z)


@inlined
def norm_of(a, b, x, y, z):
    """Return the length of the vector of a |first| + b |second| … of three axes' coefficients (second, third)."""
    return norm3(a * abs(x[0]) + b * abs(x[1]), a * abs(y[0]) + b * abs(y[1]), a * abs(z[0]) + b * abs(z[1]))


@inner
def motion_bounds(poses):
    """Return the largest speed and acceleration of the body in each interval.

    With φ(t) the rotation vector of an interval, ω = J(φ) φ' where |J| ≤ 1 and |J'| ≤ |φ'| / 2 (J = ∫₀¹ exp(−s φ) ds;
    Solà 2018, eq. 143), so |R b|' ≤ |φ'| |b| and |R b|'' ≤ (|ω|² + |ω'|) |b| ≤ (3/2 |φ'|² + |φ''|) |b|.

    Returns
    -------
    (n − 1, 4) float64: of the position speed (m/s) and acceleration (m/s²); of a point at the end of an arm b of 1 m
    the same, to be multiplied by the arm.
    """
    knots, coefficients, valid = poses
    out = np.zeros((valid.size, 4))
    for k in range(valid.size):
        if valid[k]:
            c = interval(coefficients, k)
            dt = (knots[k + 1] - knots[k]) * 1e-9
            speed = norm3(
                abs(c[1]) + 2.0 * abs(c[2]) + 3.0 * abs(c[3]),
                abs(c[5]) + 2.0 * abs(c[6]) + 3.0 * abs(c[7]),
                abs(c[9]) + 2.0 * abs(c[10]) + 3.0 * abs(c[11]),
            )
            rate = norm3(
                abs(c[12]) + 2.0 * abs(c[13]) + 3.0 * abs(c[14]),
                abs(c[15]) + 2.0 * abs(c[16]) + 3.0 * abs(c[17]),
                abs(c[18]) + 2.0 * abs(c[19]) + 3.0 * abs(c[20]),
            )
            bend = norm_of(2.0, 6.0, (c[2], c[3]), (c[6], c[7]), (c[10], c[11]))
            twist = norm_of(2.0, 6.0, (c[13], c[14]), (c[16], c[17]), (c[19], c[20]))
            out[k, 0] = speed / dt
            out[k, 1] = bend / (dt * dt)
            out[k, 2] = rate / dt
            out[k, 3] = (1.5 * rate * rate + twist) / (dt * dt)
    return out


@kernel
def stretch(k, since, until, arm, step_m, bend_m, poses, motion):
    """Return how far to go from `since` (ns), in interval `k`, before another pose is evaluated; at most to `until`.

    arm : m, of the farthest point from the body's origin; step_m, bend_m : how far that point may move, and depart from
    a straight way; motion : from :func:`motion_bounds`.

    Returns
    -------
    last : interval that the stretch ends in; end : int64, ns.
    speed, bend : largest speed (m/s) and acceleration (m/s²) of a point `arm` metres from the body's origin.
    """
    knots, valid = poses.knots, poses.valid
    way, speed, bend = 0.0, 0.0, 0.0
    end = since
    while True:
        own_speed, own_bend = motion[k, 0] + arm * motion[k, 2], motion[k, 1] + arm * motion[k, 3]
        speed, bend = max(speed, own_speed), max(bend, own_bend)
        limit = min(until, knots[k + 1])
        by_way = end + np.int64(min((step_m - way) / max(own_speed, 1e-6), 1e6) * 1e9)
        by_bend = since + np.int64(min(math.sqrt(8.0 * bend_m / max(bend, 1e-9)), 1e6) * 1e9)
        stop = max(min(by_way, by_bend), since + LEAST_STEP_NS, end)
        if stop < limit:
            return k, stop, speed, bend
        way += own_speed * (limit - end) * 1e-9
        end = limit
        if end == until or k + 1 == valid.size or not valid[k + 1]:
            return k, end, speed, bend
        k += 1


@inner
def chart_near(px, py, pz, within, charts):
    """Return the chart of a world position, or of one `within` metres along the axes; −1 where there is none."""
    lattice, table, centres = charts.lattice, charts.table, charts.centres_world_m
    chart = chart_index(box_of(px, py, pz, lattice), lattice, table, centres)
    for corner in range(8):
        if chart < 0:
            chart = chart_index(
                box_of(
                    px + (within if corner & 1 else -within),
                    py + (within if corner & 2 else -within),
                    pz + (within if corner & 4 else -within),
                    lattice,
                ),
                lattice,
                table,
                centres,
            )
    return chart


@inlined
def gradient(c, x, y, z):
    """Return the gradient of a map coordinate at an offset (m) from the chart's centre, from its expansion `c`."""
    return (
        c[1] + 2.0 * c[4] * x + c[5] * y + c[6] * z,
        c[2] + c[5] * x + 2.0 * c[7] * y + c[8] * z,
        c[3] + c[6] * x + c[8] * y + 2.0 * c[9] * z,
    )


@inlined
def curvature(c):
    """Return the Frobenius norm of the quadratic part of an expansion (1/m)."""
    return math.sqrt(
        c[4] * c[4] + c[7] * c[7] + c[9] * c[9] + 0.5 * (c[5] * c[5] + c[6] * c[6] + c[8] * c[8])
    )  # fmt: skip


@inlined
def along_axes(c, x, y, z, r, b):
    """Return a map coordinate at the sensor's origin, and its slopes along the sensor's axes.

    c : expansion; x, y, z : body from the chart's centre (m); r : world from body (9,); b : mounting (12,).
    """
    ox = x + (r[0] * b[9] + r[1] * b[10] + r[2] * b[11])
    oy = y + (r[3] * b[9] + r[4] * b[10] + r[5] * b[11])
    oz = z + (r[6] * b[9] + r[7] * b[10] + r[8] * b[11])
    gx, gy, gz = gradient(c, ox, oy, oz)
    bx = gx * r[0] + gy * r[3] + gz * r[6]
    by = gx * r[1] + gy * r[4] + gz * r[7]
    bz = gx * r[2] + gy * r[5] + gz * r[8]
    return (
        map_value(c, ox, oy, oz),
        bx * b[0] + by * b[3] + bz * b[6],
        bx * b[1] + by * b[4] + bz * b[7],
        bx * b[2] + by * b[5] + bz * b[8],
    )


NOWHERE = (0.0,) * 8  # A frame that stands in where there is no chart.
NO_DISK = (0.0, 0.0, math.inf)  # Disk without a limit.


@inlined
def pose_at(epoch, k, poses):
    """Return position and attitude at an epoch of interval `k`."""
    c = interval(poses.coefficients, k)
    u = (epoch - poses.knots[k]) / (poses.knots[k + 1] - poses.knots[k])
    return position_at(c, u), attitude_at(c, u)


@inner
def frames_between(k0, t0, k1, t1, speed, bend, reach, moved_m, georeference):
    """Return the sensor's frame on the map between two instants of an unbroken piece of the trajectory.

    For a fixed point p of the sensor's frame, |p| ≤ reach, g(t) is a map coordinate of it. Its slope is continuous
    (cubic Hermite), so it departs from the chord of g(t₀), g(t₁) by at most (t₁ − t₀)² / 8 · max |g''| (error of linear
    interpolation), and |g''| ≤ |∇| a + 2 |Q| v² with ∇ and Q the chart's slope and quadratic part, v and a from
    :func:`stretch`. At both ends g departs from its first order about the sensor's origin by at most |Q| reach². The
    margin is the sum, with :data:`SLACK_M` and the disagreement of charts.

    Parameters
    ----------
    k0, t0, k1, t1 : intervals and epochs (ns) of the two instants; speed, bend : v (m/s) and a (m/s²) between them.
    moved_m : how far corrections may move p on the ground.

    Returns
    -------
    found : bool, False where there is no chart.
    middle, half : (8,) tuples, half the sum and half the difference of both ends: easting at the sensor's origin,
        its slopes along the sensor's axes x, y, z; the same of the northing.
    margin : m, along easting and northing.
    """
    b, poses, charts = georeference.mounting, georeference.poses, georeference.charts
    centres, coefficients = charts.centres_world_m, charts.coefficients
    dt = (t1 - t0) * 1e-9
    (x0, y0, z0), r0 = pose_at(t0, k0, poses)
    (x1, y1, z1), r1 = pose_at(t1, k1, poses)
    chart = chart_near(x0, y0, z0, speed * dt, charts)
    if chart < 0:
        return False, NOWHERE, NOWHERE, 0.0
    cx, cy, cz = centres[chart, 0], centres[chart, 1], centres[chart, 2]
    east, north = expansion(coefficients, chart, 0), expansion(coefficients, chart, 1)
    x0, y0, z0, x1, y1, z1 = x0 - cx, y0 - cy, z0 - cz, x1 - cx, y1 - cy, z1 - cz
    e0, e1 = along_axes(east, x0, y0, z0, r0, b), along_axes(east, x1, y1, z1, r1, b)
    n0, n1 = along_axes(north, x0, y0, z0, r0, b), along_axes(north, x1, y1, z1, r1, b)
    away = norm3(x0, y0, z0) + speed * dt + norm3(b[9], b[10], b[11]) + reach
    curved = max(curvature(east), curvature(north))
    slope = max(norm3(east[1], east[2], east[3]), norm3(north[1], north[2], north[3])) + 2.0 * curved * away
    margin = (
        0.125 * dt * dt * (slope * bend + 2.0 * curved * speed * speed)
        + curved * reach * reach
        + slope * moved_m
        + SLACK_M + (CHART_SLACK * away * away * away if curved > 0.0 else 0.0)
    )  # fmt: skip
    middle = (
        0.5 * (e0[0] + e1[0]), 0.5 * (e0[1] + e1[1]), 0.5 * (e0[2] + e1[2]), 0.5 * (e0[3] + e1[3]),
        0.5 * (n0[0] + n1[0]), 0.5 * (n0[1] + n1[1]), 0.5 * (n0[2] + n1[2]), 0.5 * (n0[3] + n1[3]),
    )  # fmt: skip
    half = (
        0.5 * (e1[0] - e0[0]), 0.5 * (e1[1] - e0[1]), 0.5 * (e1[2] - e0[2]), 0.5 * (e1[3] - e0[3]),
        0.5 * (n1[0] - n0[0]), 0.5 * (n1[1] - n0[1]), 0.5 * (n1[2] - n0[2]), 0.5 * (n1[3] - n0[3]),
    )  # fmt: skip
    return True, middle, half, margin


@inner
def nearest_and_farthest(low, high, block, first, end):
    """Return the least `low`, the greatest `high` (n, m) of the rows with a reading, and the number of these rows."""
    near, far, rows = 65535, 0, 0
    for i in range(first, end):
        if high[i, block] > 0:
            near = min(near, np.int64(low[i, block]))
            far = max(far, np.int64(high[i, block]))
            rows += 1
    return near, far, rows


@inner
def mark_piece(pieces, p, nearest_m, farthest_m, readings, frames, found, count):
    """Add the tiles of one piece of a profile, swept between two poses; return the number of tiles.

    pieces : (p, 9) as of :class:`SpannedProfiles`, p the one meant; readings : how many to share out;
    frames : (middle, half, margin) of :func:`frames_between`.
    """
    m, h, margin = frames
    tile_m = found.tile_m
    across = pieces[p, HALF_WIDTH] + farthest_m * pieces[p, HALF_SINE]
    low = nearest_m * pieces[p, HALF_COSINE]
    along, r = 0.5 * (farthest_m - low), 0.5 * (farthest_m + low)
    sine, cosine = pieces[p, SINE], pieces[p, COSINE]
    y, z = pieces[p, OFFSET] * cosine + r * sine, -pieces[p, OFFSET] * sine + r * cosine
    range_e, range_n = m[2] * sine + m[3] * cosine, m[6] * sine + m[7] * cosine
    across_e, across_n = m[2] * cosine - m[3] * sine, m[6] * cosine - m[7] * sine
    motion_e, motion_n = h[0] + y * h[2] + z * h[3], h[4] + y * h[6] + z * h[7]
    rest = max(
        abs(h[2] * sine + h[3] * cosine) * along + abs(h[2] * cosine - h[3] * sine) * across,
        abs(h[6] * sine + h[7] * cosine) * along + abs(h[6] * cosine - h[7] * sine) * across,
    )
    e, n = m[0] + y * m[2] + z * m[3], m[4] + y * m[6] + z * m[7]
    g = (
        range_e * along, range_n * along, across_e * across, across_n * across, motion_e, motion_n, 0.0, 0.0,
    )  # fmt: skip
    count = mark_zonotope(e, n, g, margin + rest, NO_DISK, found, count)
    samples = min(1 + np.int64(2.0 * along * math.sqrt(range_e * range_e + range_n * range_n) / SAMPLE_M), 8)
    for s in range(samples):
        if count >= 0:
            t = (2.0 * s + 1.0) / samples - 1.0
            column, row = math.floor((e + t * g[0]) / tile_m), math.floor((n + t * g[1]) / tile_m)
            count = add_tile(column, row, readings / samples, found, count)
    return count


@inner
def mark_profiles(t0, t1, first, end, profiles, limits, frames, found, count):
    """Add the tiles of all pieces of some profiles between two poses; return the number of tiles.

    t0, t1 : GPS ns of the poses; first, end : the profiles that have readings between them; profiles : SpannedProfiles.
    """
    epochs, low, high, _, pieces, scale, reading_period_ns = profiles
    at_once = reading_period_ns == 0.0
    block = -1
    near, far, rows = 0, 0, 0
    for p in range(pieces.shape[0]):
        if not at_once or np.int64(pieces[p, BLOCK]) != block:
            block = np.int64(pieces[p, BLOCK])
            a, b = first, end
            if not at_once:  # one nanosecond more, since epochs of readings are rounded
                while a < b and epochs[a] + math.ceil(pieces[p, LAST] * reading_period_ns) + 1 < t0:
                    a += 1
                while a < b and epochs[b - 1] + math.floor(pieces[p, FIRST] * reading_period_ns) - 1 > t1:
                    b -= 1
            near, far, rows = nearest_and_farthest(low, high, block, a, b)
        nearest_m = max(scale[0] + scale[1] * near, limits.range_min_m)
        farthest_m = min(scale[0] + scale[1] * far, limits.range_max_m)
        if rows > 0 and nearest_m <= farthest_m and count >= 0:
            readings = rows * (pieces[p, LAST] - pieces[p, FIRST] + 1.0)
            count = mark_piece(pieces, p, nearest_m, farthest_m, readings, frames, found, count)
    return count


@kernel
def reach_of_profiles(profiles, georeference, allowance, tile_m):
    """Return the tiles that the profiles of row groups may touch.

    Parameters
    ----------
    profiles : SpannedProfiles; georeference : Georeference, of which limits of heights and quanta do not matter.
    allowance : (shift, turn), how far the poses may be moved (m) and turned (rad) afterwards.
    tile_m : float64, edge of a tile.

    Returns
    -------
    tiles : (t, 3) int64, group, column, row.
    readings : (t,) int64, about how many readings of the group lie there.
    unbounded : (g,) bool, True for groups that may touch too many tiles; nothing is known of them.
    """
    epochs, low, high, starts, pieces, scale, reading_period_ns = profiles
    mounting, poses, limits = georeference.mounting, georeference.poses, georeference.limits
    knots, valid = poses.knots, poses.valid
    touched = tile_set(MOST_TILES, tile_m)
    out_tiles, out_readings = np.empty((1024, 3), np.int64), np.empty(1024, np.int64)
    unbounded = np.zeros(starts.size - 1, np.bool_)
    made = 0
    motion = motion_bounds(poses)
    lever = norm3(mounting[9], mounting[10], mounting[11])
    lag = np.int64(math.ceil(reading_period_ns * pieces[-1, LAST]))
    widest = np.abs(pieces[:, OFFSET]).max() + pieces[:, HALF_WIDTH].max()
    for group in range(starts.size - 1):
        first, stop = starts[group], starts[group + 1]
        count, far = 0, 0
        for block in range(high.shape[1]):
            far = max(far, nearest_and_farthest(low, high, block, first, stop)[1])
        reach = math.hypot(min(scale[0] + scale[1] * far, limits.range_max_m), widest)
        moved = allowance[0] + allowance[1] * (reach + lever)
        k, t0, until = np.int64(-1), np.int64(0), np.int64(0)
        if far > 0 and first < stop and knots.size > 1:
            t0, until = max(epochs[first], knots[0]), min(epochs[stop - 1] + lag, knots[-1])
            k = find_interval(t0, knots, 0)
        end = first
        while 0 <= k < valid.size and t0 <= until and count >= 0:
            while first < stop - 1 and epochs[first] + lag < t0:
                first += 1
            t0 = max(t0, epochs[first])
            while k + 1 < valid.size and (knots[k + 1] < t0 or not valid[k]):
                k += 1
            t0 = max(t0, knots[k])
            if not valid[k] or t0 > until:
                break
            k1, t1, speed, bend = stretch(k, t0, until, reach + lever, STEP_M, BEND_M, poses, motion)
            after = k1
            end = max(end, first)
            while end < stop and epochs[end] <= t1:
                end += 1
            if end > first:
                t2 = max(min(t1, epochs[end - 1] + lag), t0)
                while k1 > k and knots[k1] > t2:
                    k1 -= 1
                found, middle, half, margin = frames_between(k, t0, k1, t2, speed, bend, reach, moved, georeference)
                if found:
                    frames = (middle, half, margin)
                    count = mark_profiles(t0, t2, first, end, profiles, limits, frames, touched, count)
            t0, k = t1 + 1, after
        unbounded[group] = count < 0
        out_tiles, out_readings, made = take(group, touched, count, made, out_tiles, out_readings)
    return out_tiles[:made], out_readings[:made], unbounded


@inlined
def disk_radius(m, reach):
    """Return the horizontal reach on the map (m): the greatest singular value of the frame's slopes times the reach."""
    ee = m[1] * m[1] + m[2] * m[2] + m[3] * m[3]
    nn = m[5] * m[5] + m[6] * m[6] + m[7] * m[7]
    en = m[1] * m[5] + m[2] * m[6] + m[3] * m[7]
    return math.sqrt(0.5 * (ee + nn) + math.hypot(0.5 * (ee - nn), en)) * reach


@inner
def mark_box(centre, edge, reach, frames, found, count):
    """Add the tiles of a box of the sensor's frame within its reach, swept between two poses.

    centre, edge : (3,) tuples, the box's centre and half its edges (m); frames : as for :func:`mark_piece`.
    """
    m, h, margin = frames
    x, y, z = centre
    a, b, c = edge
    motion_e, motion_n = h[0] + x * h[1] + y * h[2] + z * h[3], h[4] + x * h[5] + y * h[6] + z * h[7]
    rest = max(abs(h[1]) * a + abs(h[2]) * b + abs(h[3]) * c, abs(h[5]) * a + abs(h[6]) * b + abs(h[7]) * c)
    e, n = m[0] + x * m[1] + y * m[2] + z * m[3], m[4] + x * m[5] + y * m[6] + z * m[7]
    g = (m[1] * a, m[5] * a, m[2] * b, m[6] * b, m[3] * c, m[7] * c, motion_e, motion_n)
    turned = math.hypot(norm3(h[1], h[2], h[3]), norm3(h[5], h[6], h[7])) * reach
    disk = (m[0], m[4], disk_radius(m, reach) + turned + math.hypot(h[0], h[4]) + 2.0 * margin)
    return mark_zonotope(e, n, g, margin + rest, disk, found, count)


@inner
def share_out(readings, e, n, found, count):
    """Distribute readings over tiles by their distance from a place, with weights 1 / (d² + tile²)."""
    tile_m, _, tiles, weights = found
    total = 0.0
    for i in range(count):
        de, dn = (tiles[i, 0] + 0.5) * tile_m - e, (tiles[i, 1] + 0.5) * tile_m - n
        weights[i] = 1.0 / (de * de + dn * dn + tile_m * tile_m)
        total += weights[i]
    for i in range(count):
        weights[i] *= readings / total


@kernel
def reach_of_returns(spans, boxes, readings, georeference, allowance, tile_m):
    """Return the tiles that the returns of row groups may touch.

    Parameters
    ----------
    spans : (g, 2) int64, GPS ns, first and last epoch of the poses that place each group; none where the last is less.
    boxes : (g, 3, 2) float64, least and greatest sensor coordinate along each axis, m; may be infinite.
    readings : (g,) int64, returns of each group; the greatest range may be infinite.
    Others, and what is returned, as in :func:`reach_of_profiles`.
    """
    mounting, poses, farthest_m = georeference.mounting, georeference.poses, georeference.limits.range_max_m
    knots, valid = poses.knots, poses.valid
    touched = tile_set(MOST_TILES, tile_m)
    out_tiles, out_readings = np.empty((1024, 3), np.int64), np.empty(1024, np.int64)
    unbounded = np.zeros(readings.size, np.bool_)
    made = 0
    motion = motion_bounds(poses)
    lever = norm3(mounting[9], mounting[10], mounting[11])
    for group in range(readings.size):
        box = boxes[group]
        x0, x1 = max(box[0, 0], -farthest_m), min(box[0, 1], farthest_m)
        y0, y1 = max(box[1, 0], -farthest_m), min(box[1, 1], farthest_m)
        z0, z1 = max(box[2, 0], -farthest_m), min(box[2, 1], farthest_m)
        corner = norm3(max(abs(x0), abs(x1)), max(abs(y0), abs(y1)), max(abs(z0), abs(z1)))
        reach = min(corner, farthest_m)
        moved = allowance[0] + allowance[1] * (reach + lever)
        empty = x0 > x1 or y0 > y1 or z0 > z1
        if not (reach < math.inf or empty):
            unbounded[group] = True
            continue
        centre = (0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (z0 + z1))
        edge = (0.5 * (x1 - x0), 0.5 * (y1 - y0), 0.5 * (z1 - z0))
        count, looked = 0, 0
        e, n = 0.0, 0.0
        k, t0, until = np.int64(-1), np.int64(0), np.int64(0)
        if spans[group, 0] <= spans[group, 1] and not empty and knots.size > 1:
            t0, until = max(spans[group, 0], knots[0]), min(spans[group, 1], knots[-1])
            k = find_interval(t0, knots, 0)
        while 0 <= k < valid.size and t0 <= until and count >= 0:
            while k + 1 < valid.size and (knots[k + 1] < t0 or not valid[k]):
                k += 1
            t0 = max(t0, knots[k])
            if not valid[k] or t0 > until:
                break
            k1, t1, speed, bend = stretch(k, t0, until, reach + lever, FAR_STEP_M, FAR_BEND_M, poses, motion)
            found, middle, half, margin = frames_between(k, t0, k1, t1, speed, bend, reach, moved, georeference)
            if found:
                frames = (middle, half, margin)
                count = mark_box(centre, edge, reach, frames, touched, count)
                e, n, looked = e + middle[0], n + middle[4], looked + 1
            t0, k = t1 + 1, k1
        if count > 0:
            share_out(readings[group], e / looked, n / looked, touched, count)
        unbounded[group] = count < 0
        out_tiles, out_readings, made = take(group, touched, count, made, out_tiles, out_readings)
    return out_tiles[:made], out_readings[:made], unbounded
