"""Measurement updates of the filter: innovation, row and variance of each kind.

All functions fill an :class:`~roadscan.navigation.inertial.kernels.kalman_states.Offer`: innovation = row · errors +
noise.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.navigation.inertial.kernels.kalman_states import (
    ATTITUDE,
    GNSS_POSITION,
    GNSS_VELOCITY,
    GYRO_BIAS,
    NON_HOLONOMIC,
    ODOMETER,
    POSITION,
    VELOCITY,
    ZERO_VELOCITY,
    cross_rows,
    level_axes,
)
from roadscan.navigation.inertial.kernels.strapdown import EARTH_RATE_RAD_PER_S, exponential, matrix, product, unit


@kernel
def prepare(nodes, k, model, present, offer):
    """Compute the axes at node k: body, and level where there is a GNSS solution."""
    c = matrix((present.quaternion[0], present.quaternion[1], present.quaternion[2], present.quaternion[3]))
    for i in range(3):
        for j in range(3):
            offer.body[i, j] = 0.0
            for m in range(3):
                offer.body[i, j] += c[3 * i + m] * model.body_from_imu[j, m]
    if nodes.gnss[k] >= 0:
        level_axes(present.position[0], present.position[1], present.position[2], offer.level)


@kernel
def offered(kind, k, nodes, fixes, model, layout, track, present, interval, offer):
    """Fill `offer` with the measurement of a kind at node k; return its number of components, 0 where there is none."""
    g = nodes.gnss[k]
    size = 0
    offer.row[:] = 0.0
    offer.noise[:] = 0.0
    if kind == GNSS_POSITION:
        if g >= 0 and not math.isnan(fixes.position[g, 0]):
            size = 3
            _gnss_position(fixes, g, layout, present, offer)
    elif kind == GNSS_VELOCITY:
        if g >= 0 and not math.isnan(fixes.velocity[g, 0]):
            size = 3
            _gnss_velocity(fixes, g, track.rate[nodes.bound[k]], model, layout, present, interval, offer)
    elif k > 0 and nodes.still[k]:
        size = _standing(kind, nodes.rate_noise[k], model, present, interval, offer)
    elif k > 0:
        size = _travel(kind, nodes.travel[k], nodes.constrained[k], model, layout, present, interval, offer)
    return size


@inner
def _gnss_position(fixes, g, layout, present, offer):
    """Offer the antenna's position less the predicted one, ECEF."""
    h, y, noise, values = offer.row, offer.innovation, offer.noise, present.values
    v, r, body, level = present.velocity, present.position, offer.body, offer.level
    a = layout.antenna - 9
    arm = np.zeros(3)
    for i in range(3):
        for j in range(3):
            arm[i] += body[i, j] * values[a + j]
            h[i, layout.antenna + j] = body[i, j]
        h[i, POSITION + i] = 1.0
        y[i] = fixes.position[g, i] - r[i] - arm[i]
    cross_rows(arm[0], arm[1], arm[2], h, 0, ATTITUDE, -1.0)
    if layout.delay >= 0:
        for i in range(3):
            h[i, layout.delay] = v[i]
            y[i] -= v[i] * values[layout.delay - 9]
    for i in range(3):
        for j in range(3):
            if layout.colour >= 0:
                h[i, layout.colour + j] = level[i, j] * fixes.coloured[g, j]
                y[i] -= h[i, layout.colour + j] * values[layout.colour - 9 + j]
            total = 0.0
            for m in range(3):
                for o in range(3):
                    total += level[i, m] * fixes.white[g, m, o] * level[j, o]
            noise[i, j] = total


@inner
def _gnss_velocity(fixes, g, rate, model, layout, present, interval, offer):
    """Offer the antenna's velocity less the predicted one, ECEF; `rate` (3,) of the IMU in its axes."""
    h, y, noise, values = offer.row, offer.innovation, offer.noise, present.values
    v, gained, body, level = present.velocity, interval.acceleration, offer.body, offer.level
    a = layout.antenna - 9
    b = model.body_from_imu
    w = np.zeros(3)
    for i in range(3):
        for j in range(3):
            w[i] += b[i, j] * rate[j]
    # Velocity over ground excludes the Earth's rotation, given in body axes.
    for i in range(3):
        w[i] -= body[2, i] * EARTH_RATE_RAD_PER_S
    l0, l1, l2 = values[a], values[a + 1], values[a + 2]
    swing = (w[1] * l2 - w[2] * l1, w[2] * l0 - w[0] * l2, w[0] * l1 - w[1] * l0)
    out = np.zeros(3)
    cross_rate, cross_arm = np.zeros((3, 3)), np.zeros((3, 3))
    cross_rows(w[0], w[1], w[2], cross_rate, 0, 0, 1.0)
    cross_rows(l0, l1, l2, cross_arm, 0, 0, 1.0)
    for i in range(3):
        h[i, VELOCITY + i] = 1.0
        for j in range(3):
            out[i] += body[i, j] * swing[j]
            for m in range(3):
                h[i, layout.antenna + j] += body[i, m] * cross_rate[m, j]
                for o in range(3):
                    h[i, GYRO_BIAS + j] += body[i, m] * cross_arm[m, o] * b[o, j]
    cross_rows(out[0], out[1], out[2], h, 0, ATTITUDE, -1.0)
    for i in range(3):
        stated = 0.0
        for j in range(3):
            stated += level[i, j] * fixes.velocity[g, j]
            total = 0.0
            for m in range(3):
                total += level[i, m] * fixes.velocity_variance[g, m] * level[j, m]
            noise[i, j] = total
        y[i] = stated - v[i] - out[i]
        if layout.delay >= 0:
            h[i, layout.delay] = gained[i]
            y[i] -= gained[i] * values[layout.delay - 9]
        if layout.lag >= 0:
            h[i, layout.lag] = -gained[i]
            y[i] += gained[i] * values[layout.lag - 9]


@kernel
def _travel(kind, counted_m, constrained, model, layout, present, interval, offer):
    """Offer the axle's mean velocity over the interval in the axes of travel: forwards, or to the side and down.

    u = R Cᵀ v + ω × l, turned by the heading and the pitch of the direction of travel against the body. Only the
    components of a kind are offered: ODOMETER the first, NON_HOLONOMIC the two others.
    """
    if (kind == ODOMETER and math.isnan(counted_m)) or (kind == NON_HOLONOMIC and not constrained):
        return 0
    if kind not in (ODOMETER, NON_HOLONOMIC):
        return 0
    h, y, noise, values = offer.row, offer.innovation, offer.noise, present.values
    seconds = interval.length[0]
    rows = np.zeros((3, h.shape[1]))
    u, turning = _axle_velocity(model, layout, present, interval, rows)
    pitch, heading = values[layout.tilt - 9], values[layout.tilt - 8]
    sp, cp, sh, ch = math.sin(pitch), math.cos(pitch), math.sin(heading), math.cos(heading)
    for j in range(h.shape[1]):
        along, aside, down = ch * rows[0, j] + sh * rows[1, j], ch * rows[1, j] - sh * rows[0, j], rows[2, j]
        rows[0, j], rows[1, j], rows[2, j] = cp * along - sp * down, aside, sp * along + cp * down
    along, aside = ch * u[0] + sh * u[1], ch * u[1] - sh * u[0]
    forward, downward = cp * along - sp * u[2], sp * along + cp * u[2]
    rows[0, layout.tilt], rows[2, layout.tilt] = -downward, forward
    rows[0, layout.tilt + 1], rows[1, layout.tilt + 1], rows[2, layout.tilt + 1] = cp * aside, -along, sp * aside
    share = model.interval_s / seconds
    if kind == ODOMETER:
        counted = counted_m / seconds
        # A counter without direction counts up when reversing.
        if forward < -0.5 and counted > 0.0:
            counted = -counted
        for j in range(h.shape[1]):
            h[0, j] = rows[0, j]
        h[0, layout.scale] = -counted
        y[0] = (1.0 + values[layout.scale - 9]) * counted - forward
        noise[0, 0] = (model.travel_sigma**2 + (model.travel_share * counted) ** 2) * share
        return 1
    for j in range(h.shape[1]):
        h[0, j], h[1, j] = rows[1, j], rows[2, j]
    y[0], y[1] = -aside, -downward
    noise[0, 0] = (model.side_sigma**2 + (model.side_slip * turning * forward * forward) ** 2) * share
    noise[1, 1] = model.up_sigma**2 * share
    return 2


@inlined
def _axle_velocity(model, layout, present, interval, rows):
    """Return the axle's mean velocity in body axes (three numbers), its rows, and the rate of turn (rad/s)."""
    b, values = model.body_from_imu, present.values
    seconds = interval.length[0]
    x = layout.axle - 9
    l0, l1, l2 = values[x], values[x + 1], values[x + 2]
    u, w = np.zeros(3), np.zeros(3)
    arm = np.zeros((3, 3))
    cross_rows(l0, l1, l2, arm, 0, 0, 1.0)
    for i in range(3):
        for j in range(3):
            u[i] += b[i, j] * interval.ways[3, j] / seconds
            w[i] += b[i, j] * interval.ways[2, j] / seconds
            for m in range(3):
                rows[i, VELOCITY + j] += b[i, m] * interval.sums[0, j, m] / seconds
                rows[i, ATTITUDE + j] += b[i, m] * interval.sums[9, m, j] / seconds
                rows[i, GYRO_BIAS + j] += arm[i, m] * b[m, j]
    cross_rows(w[0], w[1], w[2], rows, 0, layout.axle, 1.0)
    moved = (
        u[0] + w[1] * l2 - w[2] * l1,
        u[1] + w[2] * l0 - w[0] * l2,
        u[2] + w[0] * l1 - w[1] * l0,
    )
    return moved, w[2]


@kernel
def _standing(kind, rate_noise, model, present, interval, offer):
    """Offer that the vehicle neither moves nor turns relative to the Earth: gyroscopes measure the Earth's rate."""
    h, y, noise = offer.row, offer.innovation, offer.noise
    seconds, rate = interval.length[0], EARTH_RATE_RAD_PER_S
    if kind in (ODOMETER, NON_HOLONOMIC):
        return 0
    share = model.interval_s / seconds
    c = matrix((present.quaternion[0], present.quaternion[1], present.quaternion[2], present.quaternion[3]))
    for i in range(3):
        if kind == ZERO_VELOCITY:
            h[i, VELOCITY + i] = 1.0
            y[i] = -present.velocity[i]
            noise[i, i] = model.zero_sigma**2 * share
        else:
            h[i, GYRO_BIAS + i] = -1.0
            y[i] = c[6 + i] * rate - interval.ways[2, i] / seconds
            # −Cᵀ[Ω×]ψ with Ω along z.
            h[i, ATTITUDE] = -c[3 + i] * rate
            h[i, ATTITUDE + 1] = c[i] * rate
            noise[i, i] = model.zero_rate_sigma**2 * share + rate_noise[i] / seconds
    return 3


@kernel
def apply(present, offer, size, limit, at, updates):
    """Apply one update of `size` components; the noise of an outlying innovation is raised.

    The weight w of an outlier divides its noise: w = limit / normalised innovation, whose influence falls off again
    (compare Chang 2014, "Robust Kalman filtering based on Mahalanobis distance").
    """
    p, h = present.covariance, offer.row
    n = p.shape[0]
    ph, predicted = np.zeros((3, n)), np.zeros((3, 3))
    for c in range(size):
        for m in range(n):
            f = h[c, m]
            if f != 0.0:
                for j in range(n):
                    ph[c, j] += f * p[m, j]
        for d in range(size):
            for m in range(n):
                predicted[c, d] += ph[c, m] * h[d, m]
    factor, white = np.zeros((3, 3)), np.zeros(3)
    weight = 1.0
    normalised = _whiten(predicted, offer.noise, 1.0, size, offer.innovation, factor, white)
    if normalised > limit:
        weight = limit / normalised
        _whiten(predicted, offer.noise, weight, size, offer.innovation, factor, white)
    updates.normalised[at], updates.weight[at], updates.size[at] = normalised, weight, size
    _whitened_rows(h, ph, factor, size, updates.row[at], updates.gain[at])
    gain, shift = updates.gain[at], offer.shift
    shift[:] = 0.0
    for c in range(size):
        updates.innovation[at, c] = white[c]
        for i in range(n):
            f = gain[c, i]
            shift[i] += f * white[c]
            for j in range(n):
                p[i, j] -= f * gain[c, j]
    _shifted(present, shift)


@inner
def _whitened_rows(h, ph, factor, size, row, gain):
    """Compute L⁻¹ H and (P Hᵀ L⁻ᵀ)ᵀ by forward substitution."""
    for c in range(size):
        for j in range(h.shape[1]):
            a, b = h[c, j], ph[c, j]
            for m in range(c):
                a -= factor[c, m] * row[m, j]
                b -= factor[c, m] * gain[m, j]
            row[c, j] = a / factor[c, c]
            gain[c, j] = b / factor[c, c]


@inlined
def _shifted(present, shift):
    """Add the estimated errors to the nominal state."""
    for j in range(3):
        present.position[j] += shift[POSITION + j]
        present.velocity[j] += shift[VELOCITY + j]
    for j in range(9, shift.size):
        present.values[j - 9] += shift[j]
    q = (present.quaternion[0], present.quaternion[1], present.quaternion[2], present.quaternion[3])
    q = unit(product(exponential(shift[ATTITUDE], shift[ATTITUDE + 1], shift[ATTITUDE + 2]), q))
    for j in range(4):
        present.quaternion[j] = q[j]


@inner
def _whiten(predicted, noise, weight, size, y, factor, white):
    """Compute the Cholesky factor of the innovation's covariance, L⁻¹y, and its squared length by component."""
    total = 0.0
    for i in range(size):
        for j in range(i + 1):
            value = predicted[i, j] + noise[i, j] / weight
            for m in range(j):
                value -= factor[i, m] * factor[j, m]
            factor[i, j] = math.sqrt(value) if i == j else value / factor[j, j]
        value = y[i]
        for m in range(i):
            value -= factor[i, m] * white[m]
        white[i] = value / factor[i, i]
        total += white[i] * white[i]
    return total / size
