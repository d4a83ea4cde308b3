"""Pose interpolation: cubic Hermite in position and on the rotation group.

Interval k runs from knot k to knot k + 1; u in [0, 1] is the part of it that has passed.

    position(u) = c0 + c1 u + c2 u² + c3 u³
    attitude(u) = q_k ⊗ exp(φ(u)),  φ(u) = d1 u + d2 u² + d3 u³   (rotation vector, body axes)

Slopes at a knot are the derivative of the polynomial through the five nearest knots of the same
unbroken piece (three or two where it has no more), so an interval depends on six knots only and the
result never on how much of the trajectory was loaded. Working in the tangent space of the interval's
first attitude (Kim, Kim and Shin 1995, "A general construction scheme for unit quaternion curves")
keeps attitude on the group; heading passes 360° without a jump.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, inner, kernel

POSITION = slice(0, 12)
"""Columns of an interval's coefficients: c0, c1, c2, c3 of x, then of y, then of z."""
ROTATION = slice(12, 21)
"""d1, d2, d3 of the rotation vector's x, then y, then z."""
QUATERNION = slice(21, 25)
"""w, x, y, z of the attitude at the interval's start (world from body)."""
COEFFICIENTS = 25  # Length of a row of coefficients: 12 of position, 9 of rotation, 4 of the quaternion.


class PoseIntervals(NamedTuple):
    """A trajectory as intervals between knots, in which poses are interpolated."""

    knots: npt.NDArray[np.int64]
    """(n,) GPS ns, strictly ascending."""
    coefficients: npt.NDArray[np.float64]
    """(n − 1, 25) of the intervals; columns POSITION, ROTATION, QUATERNION."""
    valid: npt.NDArray[np.bool_]
    """(n − 1,) False for an interval without poses."""


@inlined
def rotation_vector(w, x, y, z):
    """Return the logarithm of a unit quaternion: the rotation vector (rad) of the shorter way round."""
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    return scale * x, scale * y, scale * z


@inlined
def relative(a, b):
    """Return the quaternion conj(a) ⊗ b: attitude b relative to attitude a."""
    return (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3],
        a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2],
        a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1],
        a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0],
    )


@kernel
def slope_weights(times, at, weights):
    """Weights w with f'(at) = Σ w_j f(times_j) for the polynomial through all the given times.

    Parameters
    ----------
    times : (m,) float64, distinct; at : float64, one of them.
    weights : (m,) float64, out. First derivative of Lagrange's form at a node.
    """
    m = times.size
    centre = 0
    for j in range(m):
        if times[j] == at:
            centre = j
    total = 0.0
    for j in range(m):
        if j == centre:
            continue
        weight = 1.0 / (times[j] - at)
        for k in range(m):
            if k not in (j, centre):
                weight *= (at - times[k]) / (times[j] - times[k])
        weights[j] = weight
        total += weight
    weights[centre] = -total


@kernel
def interval_coefficients(epochs, positions, quaternions, max_gap_ns, coefficients, valid):
    """Compute the coefficients of every interval between knots.

    Parameters
    ----------
    epochs : (n,) int64, GPS ns, strictly ascending.
    positions : (n, 3) float64, world frame, m.
    quaternions : (n, 4) float64, unit, world from body.
    max_gap_ns : int64; a longer interval has no pose and ends a piece.
    coefficients : (n − 1, 25) float64, out; columns POSITION, ROTATION, QUATERNION.
    valid : (n − 1,) bool, out.
    """
    n = epochs.size
    velocity = np.zeros((n, 3))
    rate = np.zeros((n, 3))
    first = 0
    while first < n:
        end = first + 1
        while end < n and epochs[end] - epochs[end - 1] <= max_gap_ns:
            end += 1
        _slopes(epochs, positions, quaternions, first, end, velocity, rate)
        first = end
    for k in range(n - 1):
        gap = epochs[k + 1] - epochs[k]
        valid[k] = gap <= max_gap_ns
        if valid[k]:
            _interval(gap * 1e-9, k, positions, quaternions, velocity, rate, coefficients[k])


@kernel
def _slopes(epochs, positions, quaternions, first, end, velocity, rate):
    """Velocity (m/s, world) and body rate (rad/s, body) at knots first…end − 1 of one unbroken piece."""
    size = min(5, end - first)
    if size < 2:
        return
    times = np.empty(size)
    weights = np.empty(size)
    for i in range(first, end):
        start = min(max(i - size // 2, first), end - size)
        for j in range(size):
            times[j] = (epochs[start + j] - epochs[i]) * 1e-9
        slope_weights(times, 0.0, weights)
        for j in range(size):
            k = start + j
            w, x, y, z = relative(quaternions[i], quaternions[k])
            rx, ry, rz = rotation_vector(w, x, y, z)
            for a in range(3):
                velocity[i, a] += weights[j] * (positions[k, a] - positions[i, a])
            rate[i, 0] += weights[j] * rx
            rate[i, 1] += weights[j] * ry
            rate[i, 2] += weights[j] * rz


@inlined
def cross(a, b):
    """Cross product of two tuples."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inner
def _interval(dt, k, positions, quaternions, velocity, rate, out):
    for a in range(3):
        step = positions[k + 1, a] - positions[k, a]
        start, stop = dt * velocity[k, a], dt * velocity[k + 1, a]
        out[4 * a] = positions[k, a]
        out[4 * a + 1] = start
        out[4 * a + 2] = 3.0 * step - 2.0 * start - stop
        out[4 * a + 3] = start + stop - 2.0 * step
    w, x, y, z = relative(quaternions[k], quaternions[k + 1])
    turn = rotation_vector(w, x, y, z)
    # dφ/dt at the end: the inverse right Jacobian of SO(3) takes the body rate there (Solà 2018, eq. 144).
    angle2 = turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]
    if angle2 < 1e-8:
        factor = 1.0 / 12.0 + angle2 / 720.0
    else:
        angle = math.sqrt(angle2)
        factor = 1.0 / angle2 - (1.0 + math.cos(angle)) / (2.0 * angle * math.sin(angle))
    end_rate = (rate[k + 1, 0], rate[k + 1, 1], rate[k + 1, 2])
    once = cross(turn, end_rate)
    twice = cross(turn, once)
    for a in range(3):
        start, stop = dt * rate[k, a], dt * (end_rate[a] + 0.5 * once[a] + factor * twice[a])
        out[12 + 3 * a] = start
        out[13 + 3 * a] = 3.0 * turn[a] - 2.0 * start - stop
        out[14 + 3 * a] = start + stop - 2.0 * turn[a]
    for a in range(4):
        out[21 + a] = quaternions[k, a]


@inlined
def find_interval(epoch, epochs, k):
    """Return the interval that contains `epoch`, searched from interval `k` on; −1 outside the knots.

    An interval holds its first knot, the last one both of its knots, whatever `k` is.
    """
    n = epochs.size
    if n < 2 or epoch < epochs[0] or epoch > epochs[n - 1]:
        found = -1
    else:
        found = min(max(k, 0), n - 2)
        if epoch < epochs[found] or epoch >= epochs[min(found + 2, n - 1)]:
            found = min(np.searchsorted(epochs, epoch, side="right") - 1, n - 2)
        elif epoch >= epochs[found + 1] and found < n - 2:
            found += 1
    return found


NO_INTERVAL = (0.0,) * COEFFICIENTS  # The interval that a loop starts from before it has found one.


@inlined
def interval(coefficients, k):
    """Return the coefficients of interval `k` as a tuple.

    Loops keep the tuple of the current interval: handing an array to a function costs two atomic
    operations for its reference count, more than the arithmetic of a reading.
    """
    c = coefficients
    return (
        c[k, 0], c[k, 1], c[k, 2], c[k, 3], c[k, 4], c[k, 5], c[k, 6], c[k, 7], c[k, 8], c[k, 9], c[k, 10], c[k, 11],
        c[k, 12], c[k, 13], c[k, 14], c[k, 15], c[k, 16], c[k, 17], c[k, 18], c[k, 19], c[k, 20],
        c[k, 21], c[k, 22], c[k, 23], c[k, 24],
    )  # fmt: skip


@inlined
def attitude_at(c, u):
    """Return the world-from-body matrix, row by row, at fraction `u` of an interval with coefficients `c` (a tuple)."""
    vx = u * (c[12] + u * (c[13] + u * c[14]))
    vy = u * (c[15] + u * (c[16] + u * c[17]))
    vz = u * (c[18] + u * (c[19] + u * c[20]))
    a = vx * vx + vy * vy + vz * vz
    if a < 0.0625:
        # cos(|φ|/2) and sin(|φ|/2)/|φ|; the next term is below 1e-15.
        ew = 1.0 - a * (0.125 - a * (1.0 / 384.0 - a * (1.0 / 46080.0 - a / 10321920.0)))
        es = 0.5 - a * (1.0 / 48.0 - a * (1.0 / 3840.0 - a * (1.0 / 645120.0 - a / 185794560.0)))
    else:
        angle = math.sqrt(a)
        ew, es = math.cos(0.5 * angle), math.sin(0.5 * angle) / angle
    ex, ey, ez = es * vx, es * vy, es * vz
    w = c[21] * ew - c[22] * ex - c[23] * ey - c[24] * ez
    x = c[21] * ex + c[22] * ew + c[23] * ez - c[24] * ey
    y = c[21] * ey - c[22] * ez + c[23] * ew + c[24] * ex
    z = c[21] * ez + c[22] * ey - c[23] * ex + c[24] * ew
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@inlined
def position_at(c, u):
    """Return the world position (m) at fraction `u` of an interval with coefficients `c` (a tuple)."""
    return (
        c[0] + u * (c[1] + u * (c[2] + u * c[3])),
        c[4] + u * (c[5] + u * (c[6] + u * c[7])),
        c[8] + u * (c[9] + u * (c[10] + u * c[11])),
    )


@kernel
def interpolate(queries, poses, positions, rotations, found):
    """Interpolate the poses at many epochs.

    Parameters
    ----------
    queries : (m,) int64, GPS ns, any order (ascending is fastest).
    positions : (m, 3) float64, out, world frame, m.
    rotations : (m, 9) float64, out, world from body, row by row.
    found : (m,) bool, out; False where the trajectory has no pose (gap, or outside its span).
    """
    knots, coefficients, valid = poses
    k = 0
    start, end = np.int64(1), np.int64(0)
    usable = False
    c = NO_INTERVAL
    for i in range(queries.size):
        epoch = queries[i]
        if not (start <= epoch < end):
            k = find_interval(epoch, knots, k)
            usable = k >= 0 and valid[k]
            start, end = np.int64(1), np.int64(0)
            if usable:
                c = interval(coefficients, k)
                start, end = knots[k], knots[k + 1]
        found[i] = usable
        if usable:
            u = (epoch - start) / (end - start)
            positions[i, 0], positions[i, 1], positions[i, 2] = position_at(c, u)
            r = attitude_at(c, u)
            for a in range(9):
                rotations[i, a] = r[a]
