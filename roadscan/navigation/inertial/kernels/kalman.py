"""Error-state Kalman filter of an inertial navigation system.

The nominal state is mechanised at the IMU's rate and corrected at each update (closed loop; Groves 2013, section
14.2.4). Covariances are carried from *node* to node: epochs of GNSS, and others between them where they are far apart.
Updates are whitened: with the Cholesky factor L of the innovation's covariance S the rows L⁻¹H, the columns P Hᵀ L⁻ᵀ
and L⁻¹ y are all that is kept of one, for the way back (:mod:`roadscan.navigation.inertial.kernels.kalman_smoother`).

Prediction of the filter from node to node: mechanisation, transition and noise.

The transition is made of integrals that are summed step by step; only its rows of position, velocity and attitude
differ from a diagonal, and only they are multiplied.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.navigation.inertial.kernels.kalman_states import (
    ACCEL_BIAS,
    ACCEL_SCALE,
    ATTITUDE,
    GNSS_POSITION,
    GNSS_VELOCITY,
    GYRO_BIAS,
    GYRO_SCALE,
    KINDS,
    NAVIGATION,
    NON_HOLONOMIC,
    VELOCITY,
    WITHOUT_SCALES,
    Interval,
    Offer,
    Present,
    cross_rows,
    decays,
)
from roadscan.navigation.inertial.kernels.kalman_updates import apply, offered, prepare
from roadscan.navigation.inertial.kernels.strapdown import (
    EARTH_RATE_RAD_PER_S,
    SEMI_MAJOR_M,
    gravity_field,
    matrix,
    strapdown_step,
)


@kernel
def filter_forwards(steps, nodes, fixes, model, layout, start, track, record, updates):
    """Run the filter over all nodes.

    Parameters
    ----------
    steps : Steps; nodes : Nodes; fixes : Fixes; model : Model; layout : Layout; start : Start.
    track : Track; record : Record; updates : Updates, all out.

    Returns
    -------
    Number of updates.
    """
    n = layout.size
    present = Present(
        start.quaternion.copy(),
        start.velocity.copy(),
        start.position.copy(),
        start.values.copy(),
        start.covariance.copy(),
    )
    interval = Interval(np.zeros((10, 3, 3)), np.zeros((4, 3)), np.zeros(3), np.zeros(2))
    offer = Offer(np.zeros((3, n)), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(n))
    work = np.zeros((NAVIGATION, n))
    note(track, 0, present.quaternion, present.velocity, present.position)
    count = 0
    distrust = 0.0
    for k in range(nodes.bound.size):
        if k > 0:
            advance(k, steps, nodes, model, layout, present, interval, track, record)
            predict(k, nodes, model, layout, present, interval, record, work)
            distrust += interval.length[0]
        record.first_update[k] = count
        for j in range(NAVIGATION):
            record.applied[k, j] = 0.0
        prepare(nodes, k, model, present, offer)
        for kind in range(KINDS):
            size = offered(kind, k, nodes, fixes, model, layout, track, present, interval, offer)
            if size == 0:
                continue
            limit = model.outlier[size]
            if kind == GNSS_POSITION and distrust > model.patience_s:
                limit = math.inf
            _report(kind, k, size, offer, count, updates)
            apply(present, offer, size, limit, count, updates)
            for j in range(NAVIGATION):
                record.applied[k, j] += offer.shift[j]
            if kind == GNSS_POSITION and updates.weight[count] == 1.0:
                distrust = 0.0
            count += 1
        _keep(k, nodes.report[k], present, record)
    record.first_update[nodes.bound.size] = count
    return count


@inlined
def _keep(k, report, present, record):
    """Record what the smoother needs of a node, and all states where they are reported."""
    p = present.covariance
    n = p.shape[0]
    for i in range(NAVIGATION):
        for j in range(n):
            record.rows[k, i, j] = p[i, j]
    if report >= 0:
        for i in range(n):
            for j in range(n):
                record.covariance[report, i, j] = p[i, j]
        for j in range(n - NAVIGATION):
            record.values[report, j] = present.values[j]


@inlined
def _report(kind, k, size, offer, at, updates):
    """Return the residual in the axes of the table: level for GNSS, those of the update for the others."""
    y, level = offer.innovation, offer.level
    updates.kind[at], updates.node[at] = kind, k
    first = 1 if kind == NON_HOLONOMIC else 0
    for j in range(3):
        if kind <= GNSS_VELOCITY:
            updates.residual[at, j] = level[0, j] * y[0] + level[1, j] * y[1] + level[2, j] * y[2]
        else:
            updates.residual[at, j] = y[j - first] if first <= j < first + size else math.nan


@kernel
def advance(k, steps, nodes, model, layout, present, interval, track, record):
    """Mechanise the steps between nodes k − 1 and k, and sum up the integrals of their transition.

    Changes `present` (all but its covariance), `interval`, rows of `track` and `record.transition`, `record.keep`.
    """
    values = present.values
    q = (present.quaternion[0], present.quaternion[1], present.quaternion[2], present.quaternion[3])
    v = (present.velocity[0], present.velocity[1], present.velocity[2])
    r = (present.position[0], present.position[1], present.position[2])
    field = gravity_field(r[0], r[1], r[2])
    before = v
    interval.sums[:] = 0.0
    interval.ways[:] = 0.0
    seconds, loose = 0.0, 0.0
    scaled = layout.inertial > WITHOUT_SCALES
    for s in range(nodes.bound[k - 1], nodes.bound[k]):
        dt = steps.seconds[s]
        turn = _corrected(steps.turn, s, values, 0, 6, scaled, dt)
        push = _corrected(steps.push, s, values, 3, 9, scaled, dt)
        c0, v0 = matrix(q), v
        q, v, r, gain = strapdown_step(q, v, r, turn, push, dt, field)
        _accumulate(interval.sums, interval.ways, c0, matrix(q), v0, v, turn, push, gain, dt, scaled)
        seconds += dt
        loose = max(loose, steps.loose[s])
        note(track, s + 1, q, v, r)
        for j in range(3):
            track.rate[s + 1, j] = turn[j] / dt
    interval.length[0], interval.length[1] = seconds, loose
    for j in range(4):
        present.quaternion[j] = q[j]
    for j in range(3):
        present.velocity[j], present.position[j] = v[j], r[j]
        interval.acceleration[j] = (v[j] - before[j]) / seconds
    record.keep[k] = math.exp(-seconds / model.bias_seconds)
    _transition(interval.sums, interval.ways, seconds, field, scaled, record.transition[k])


@inlined
def note(track, at, q, v, r):
    """Record a nominal state."""
    for j in range(4):
        track.quaternion[at, j] = q[j]
    for j in range(3):
        track.velocity[at, j] = v[j]
        track.position[at, j] = r[j]


@inlined
def _corrected(stated, s, values, bias, scale, scaled, dt):
    """Return an increment without bias and scale error: stated = (1 + scale) · true + bias."""
    x = stated[s, 0] - values[bias] * dt
    y = stated[s, 1] - values[bias + 1] * dt
    z = stated[s, 2] - values[bias + 2] * dt
    if scaled:
        x /= 1.0 + values[scale]
        y /= 1.0 + values[scale + 1]
        z /= 1.0 + values[scale + 2]
    return x, y, z


@inlined
def _accumulate(sums, ways, c0, c1, v0, v1, turn, push, gain, dt, scaled):
    """Add one step to the integrals of an :class:`Interval`."""
    fx, fy, fz = gain
    wx, wy = 0.5 * (v0[0] + v1[0]), 0.5 * (v0[1] + v1[1])
    wz = 0.5 * (v0[2] + v1[2])
    for j in range(3):
        m0, m1, m2 = 0.5 * (c0[j] + c1[j]), 0.5 * (c0[3 + j] + c1[3 + j]), 0.5 * (c0[6 + j] + c1[6 + j])
        # Integrals of position first: they use those of velocity at the beginning, plus half of the step.
        a0, a1, a2 = sums[0, 0, j], sums[0, 1, j], sums[0, 2, j]
        h0, h1, h2 = a0 + 0.5 * m0 * dt, a1 + 0.5 * m1 * dt, a2 + 0.5 * m2 * dt
        b0, b1, b2 = fy * h2 - fz * h1, fz * h0 - fx * h2, fx * h1 - fy * h0
        sums[5, 0, j] += h0 * dt
        sums[5, 1, j] += h1 * dt
        sums[5, 2, j] += h2 * dt
        sums[7, 0, j] += (sums[3, 0, j] + 0.5 * b0) * dt
        sums[7, 1, j] += (sums[3, 1, j] + 0.5 * b1) * dt
        sums[7, 2, j] += (sums[3, 2, j] + 0.5 * b2) * dt
        sums[3, 0, j] += b0
        sums[3, 1, j] += b1
        sums[3, 2, j] += b2
        sums[0, 0, j] = a0 + m0 * dt
        sums[0, 1, j] = a1 + m1 * dt
        sums[0, 2, j] = a2 + m2 * dt
        if scaled:
            t, f = turn[j], push[j]
            h0, h1, h2 = (
                sums[1, 0, j] + 0.5 * m0 * t,
                sums[1, 1, j] + 0.5 * m1 * t,
                sums[1, 2, j] + 0.5 * m2 * t,
            )
            b0, b1, b2 = fy * h2 - fz * h1, fz * h0 - fx * h2, fx * h1 - fy * h0
            sums[8, 0, j] += (sums[4, 0, j] + 0.5 * b0) * dt
            sums[8, 1, j] += (sums[4, 1, j] + 0.5 * b1) * dt
            sums[8, 2, j] += (sums[4, 2, j] + 0.5 * b2) * dt
            sums[4, 0, j] += b0
            sums[4, 1, j] += b1
            sums[4, 2, j] += b2
            sums[1, 0, j] += m0 * t
            sums[1, 1, j] += m1 * t
            sums[1, 2, j] += m2 * t
            sums[6, 0, j] += (sums[2, 0, j] + 0.5 * m0 * f) * dt
            sums[6, 1, j] += (sums[2, 1, j] + 0.5 * m1 * f) * dt
            sums[6, 2, j] += (sums[2, 2, j] + 0.5 * m2 * f) * dt
            sums[2, 0, j] += m0 * f
            sums[2, 1, j] += m1 * f
            sums[2, 2, j] += m2 * f
        # Row j of Cᵀ[v×]: column j of C crossed with v.
        sums[9, j, 0] += (m1 * wz - m2 * wy) * dt
        sums[9, j, 1] += (m2 * wx - m0 * wz) * dt
        sums[9, j, 2] += (m0 * wy - m1 * wx) * dt
        ways[3, j] += (m0 * wx + m1 * wy + m2 * wz) * dt
        ways[1, j] += (ways[0, j] + 0.5 * gain[j]) * dt
        ways[0, j] += gain[j]
        ways[2, j] += turn[j]


@inner
def _transition(sums, ways, seconds, field, scaled, phi):
    """Compute rows of position, velocity and attitude of the transition (9, inertial) over an interval."""
    phi[:] = 0.0
    size, ux, uy, uz = field[0], field[1], field[2], field[3]
    up = (ux, uy, uz)
    k = size / SEMI_MAJOR_M
    for i in range(3):
        for j in range(3):
            one = 1.0 if i == j else 0.0
            gradient = -k * (one - 3.0 * up[i] * up[j])
            phi[i, j] = one + 0.5 * gradient * seconds * seconds
            phi[3 + i, j] = gradient * seconds
            phi[i, 3 + j] = one * seconds
            phi[3 + i, 3 + j] = one
            phi[6 + i, 6 + j] = one
            phi[i, GYRO_BIAS + j] = sums[7, i, j]
            phi[3 + i, GYRO_BIAS + j] = sums[3, i, j]
            phi[6 + i, GYRO_BIAS + j] = -sums[0, i, j]
            phi[i, ACCEL_BIAS + j] = -sums[5, i, j]
            phi[3 + i, ACCEL_BIAS + j] = -sums[0, i, j]
            if scaled:
                phi[i, GYRO_SCALE + j] = sums[8, i, j]
                phi[3 + i, GYRO_SCALE + j] = sums[4, i, j]
                phi[6 + i, GYRO_SCALE + j] = -sums[1, i, j]
                phi[i, ACCEL_SCALE + j] = -sums[6, i, j]
                phi[3 + i, ACCEL_SCALE + j] = -sums[2, i, j]
    cross_rows(ways[1, 0], ways[1, 1], ways[1, 2], phi, 0, 6, -1.0)
    cross_rows(ways[0, 0], ways[0, 1], ways[0, 2], phi, 3, 6, -1.0)
    # Rotation of the Earth: ψ and δv relative to ECEF axes.
    turn = EARTH_RATE_RAD_PER_S * seconds
    phi[6, 7] += turn
    phi[7, 6] -= turn
    phi[3, 4] += 2.0 * turn
    phi[4, 3] -= 2.0 * turn
    phi[0, 4] += turn * seconds
    phi[1, 3] -= turn * seconds


@kernel
def predict(k, nodes, model, layout, present, interval, record, work):
    """Apply P ← Φ P Φᵀ + Q over the interval that ends at node k; the other states decay."""
    p, phi, values = present.covariance, record.transition[k], present.values
    n = layout.size
    decay = np.empty(n)
    decays(record.keep[k], nodes.colour_keep[k], layout, decay)
    _moved_rows(p, phi, work)
    for i in range(9, n):
        values[i - 9] *= decay[i]
        for j in range(9):
            p[i, j] = decay[i] * work[j, i]
            p[j, i] = p[i, j]
        for j in range(9, n):
            p[i, j] *= decay[i] * decay[j]
    for i in range(3):
        p[GYRO_BIAS + i, GYRO_BIAS + i] += model.gyro_bias**2 * (1.0 - record.keep[k] ** 2)
        p[ACCEL_BIAS + i, ACCEL_BIAS + i] += model.accel_bias**2 * (1.0 - record.keep[k] ** 2)
        if layout.colour >= 0:
            p[layout.colour + i, layout.colour + i] += 1.0 - nodes.colour_keep[k] ** 2
    if layout.delay >= 0:
        p[layout.delay, layout.delay] += model.delay_wander**2 * interval.length[0]
    _add_noise(k, nodes, model, present, interval, phi)


@inner
def _moved_rows(p, phi, work):
    """Compute rows of navigation: work (9, n) ← Φ P, and the block Φ P Φᵀ of them in `p`."""
    n, mixed = p.shape[0], phi.shape[1]
    for i in range(9):
        for j in range(n):
            work[i, j] = 0.0
        for m in range(mixed):
            f = phi[i, m]
            if f != 0.0:
                for j in range(n):
                    work[i, j] += f * p[m, j]
    for i in range(9):
        for j in range(i + 1):
            total = 0.0
            for m in range(mixed):
                total += work[i, m] * phi[j, m]
            p[i, j] = total
            p[j, i] = total


@inner
def _add_noise(k, nodes, model, present, interval, phi):
    """Add noise of gyroscopes and accelerometers, and of motion in a silence of the IMU.

    Noise early in the interval reaches the states behind: integrals of white noise (Groves 2013, 14.2.6).
    """
    p = present.covariance
    seconds, loose = interval.length[0], interval.length[1]
    c = matrix((present.quaternion[0], present.quaternion[1], present.quaternion[2], present.quaternion[3]))
    turn, push = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for m in range(3):
                both = c[3 * i + m] * c[3 * j + m] * seconds
                turn[i, j] += both * nodes.rate_noise[k, m]
                push[i, j] += both * nodes.force_noise[k, m]
    for i in range(3):
        p[ATTITUDE + i, ATTITUDE + i] += (model.loose_rate * loose) ** 2
        p[VELOCITY + i, VELOCITY + i] += (model.loose_force * loose) ** 2
        p[i, i] += (model.loose_force * loose * loose) ** 2 / 4.0
        for j in range(3):
            p[ATTITUDE + i, ATTITUDE + j] += turn[i, j]
            p[i, j] += push[i, j] * seconds * seconds / 3.0
            p[i, VELOCITY + j] += 0.5 * push[i, j] * seconds
            p[VELOCITY + j, i] += 0.5 * push[i, j] * seconds
            cross, total = 0.0, 0.0
            for m in range(3):
                cross += phi[VELOCITY + i, ATTITUDE + m] * turn[m, j]
                for o in range(3):
                    total += phi[VELOCITY + i, ATTITUDE + m] * turn[m, o] * phi[VELOCITY + j, ATTITUDE + o]
            p[VELOCITY + i, ATTITUDE + j] += 0.5 * cross
            p[ATTITUDE + j, VELOCITY + i] += 0.5 * cross
            p[VELOCITY + i, VELOCITY + j] += push[i, j] + total / 3.0
