"""Error-state Kalman filter of an inertial navigation system, and its smoother.

Errors are what has to be added to the nominal state: position and velocity in ECEF axes, attitude as a small rotation ψ
about ECEF axes (true = exp(ψ×) · nominal). The nominal state is mechanised at the IMU's rate and corrected at each
update (closed loop; Groves 2013, section 14.2.4). Covariances are carried from *node* to node; the transition between two
nodes is made of integrals that are summed along the way, so its rows of position, velocity and attitude are the only
ones that are ever multiplied.

The smoother is Rauch's, Tung's and Striebel's in the form of Bryson and Frazier (Bierman 1973, "Fixed interval
smoothing with discrete measurements"): an adjoint vector λ and matrix Λ run backwards, no covariance is inverted,

    before an update   λ ← λ − Hᵀ(S⁻¹ y + Kᵀ λ),  Λ ← (I − K H)ᵀ Λ (I − K H) + Hᵀ S⁻¹ H
    before a step      λ ← Φᵀ λ,  Λ ← Φᵀ Λ Φ
    smoothed           δx = −P λ,  P − P Λ P

Updates are whitened: with the Cholesky factor L of S the
rows L⁻¹H, the columns P Hᵀ L⁻ᵀ and L⁻¹ y are all that is kept of one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.kernels.inertial import (
    EARTH_RATE_RAD_PER_S,
    SEMI_MAJOR_M,
    exponential,
    geodetic,
    gravity_field,
    matrix,
    product,
    strapdown_step,
    unit,
)
from roadscan.kernels.options import inlined, kernel

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCEL_BIAS = 0, 3, 6, 9, 12
GYRO_SCALE, ACCEL_SCALE = 15, 18
"""Columns of the states that all solutions have; scales only where the layout says 21 inertial states."""
NAVIGATION = 9

GNSS_POSITION, GNSS_VELOCITY, ODOMETER, NON_HOLONOMIC, ZERO_VELOCITY, ZERO_ROTATION = 0, 1, 2, 3, 4, 5
KINDS = 6


class Layout(NamedTuple):
    """Columns of the states that not every solution has, −1 where it has not."""

    size: int
    """Number of states."""
    inertial: int
    """States that a transition mixes: 15, with scales 21."""
    antenna: int
    """Lever arm of the antenna from the IMU, body axes (3)."""
    axle: int
    """Lever arm of the point that moves only forwards, from the IMU, body axes (3)."""
    tilt: int
    """Pitch and heading of the direction of travel against the body's axes (2)."""
    scale: int
    """Scale error of the odometer (1)."""
    colour: int
    """Time-correlated error of the GNSS position, north, east, down, in units of its σ (3)."""
    delay: int
    """How far the IMU's stamps are ahead of GNSS time (1, s)."""
    lag: int
    """How far the velocities of GNSS lag behind its positions (1, s)."""


class Steps(NamedTuple):
    """Steps of the mechanisation, s of them."""

    seconds: Float64
    turn: Float64
    """(s, 3) rad, IMU axes, as from :func:`roadscan.kernels.inertial.increments`."""
    push: Float64
    """(s, 3) m/s."""
    loose: Float64
    """(s,) seconds for which no sample was there."""


class Nodes(NamedTuple):
    """Where covariances are worked out, k of them; the first is the start."""

    bound: Int64
    """(k,) steps before it."""
    colour_keep: Float64
    """(k,) how much of the coloured GNSS error stays over the interval that ends there, 0 to 1."""
    gnss: Int64
    """(k,) row of `Fixes`, −1 for none."""
    still: npt.NDArray[np.bool_]
    """(k,) the vehicle stood over the interval that ends there."""
    travel: Float64
    """(k,) metres that the odometer counted over the interval, NaN where there is none."""
    constrained: npt.NDArray[np.bool_]
    """(k,) non-holonomic constraint over the interval."""
    report: Int64
    """(k,) row of the reported states, −1 for none."""
    rate_noise: Float64
    """(k, 3) noise of the gyroscopes over the interval, IMU axes, rad²/s."""
    force_noise: Float64
    """(k, 3) noise of the accelerometers, m²/s³."""


class Fixes(NamedTuple):
    """GNSS solutions, m of them."""

    position: Float64
    """(m, 3) ECEF, m; NaN for none."""
    white: Float64
    """(m, 3, 3) covariance of the part that is independent from epoch to epoch, north-east-down, m²."""
    coloured: Float64
    """(m, 3) σ of the part that is correlated in time, m."""
    velocity: Float64
    """(m, 3) north-east-down, m/s; NaN for none."""
    velocity_variance: Float64
    """(m, 3) m²/s²."""


class Model(NamedTuple):
    """Noise and geometry."""

    gyro_bias: float
    """σ, rad/s."""
    accel_bias: float
    """σ, m/s²."""
    bias_seconds: float
    """Time constant of both."""
    body_from_imu: Float64
    """(3, 3)."""
    travel_sigma: float
    """Of the odometer's speed, m/s."""
    travel_share: float
    """And the part that grows with speed (slip)."""
    side_sigma: float
    """Of the non-holonomic constraint to the side, m/s."""
    side_slip: float
    """Side-slip angle of the axle for each m/s² of acceleration to the side, rad."""
    up_sigma: float
    """Upwards, m/s."""
    zero_sigma: float
    """Of a standing vehicle's velocity, m/s."""
    zero_rate_sigma: float
    """Of its rotation, rad/s."""
    loose_rate: float
    """Rotation that nobody measured in a gap of the IMU, rad/s."""
    loose_force: float
    """Acceleration in it, m/s²."""
    outlier: Float64
    """(4,) squared normalised innovation by component from which an update of 1, 2, 3 components counts less."""
    patience_s: float
    """After that long of positions that count less in a row they count in full again: then the filter errs."""
    delay_wander: float
    """How the IMU's clock wanders: random walk, s/√s."""
    interval_s: float
    """Length of interval that the σ of constraints hold for; their noise is white, so longer ones weigh more."""


class Start(NamedTuple):
    """State at the first node."""

    quaternion: Float64
    """(4,) ECEF from IMU."""
    velocity: Float64
    position: Float64
    values: Float64
    """(n − 9,) nominal values of the states behind attitude."""
    covariance: Float64
    """(n, n)."""


class Track(NamedTuple):
    """Nominal states at all bounds, before the update of a node."""

    quaternion: Float64
    """(s + 1, 4) ECEF from IMU."""
    velocity: Float64
    """(s + 1, 3)."""
    position: Float64
    """(s + 1, 3)."""
    rate: Float64
    """(s + 1, 3) rad/s against inertial space, IMU axes, over the step that ends there."""


class Record(NamedTuple):
    """What the way back needs."""

    transition: Float64
    """(k, 9, inertial) of the interval that ends at a node."""
    keep: Float64
    """(k,) of the biases."""
    rows: Float64
    """(k, 9, n) covariance of navigation states with all states, after the node's updates."""
    applied: Float64
    """(k, 9) what the node's updates added to the nominal state."""
    first_update: Int64
    """(k + 1,)."""
    values: Float64
    """(j, n − 9) at the reported nodes, nominal."""
    covariance: Float64
    """(j, n, n) there."""


class Updates(NamedTuple):
    """All updates in their order, u of them."""

    row: Float64
    """(u, 3, n) whitened L⁻¹ H."""
    gain: Float64
    """(u, 3, n) whitened (P Hᵀ L⁻ᵀ)ᵀ."""
    innovation: Float64
    """(u, 3) whitened L⁻¹ y."""
    size: Int64
    """(u,) components."""
    kind: Int64
    node: Int64
    residual: Float64
    """(u, 3) as reported."""
    normalised: Float64
    weight: Float64


@inlined
def _cross_rows(x, y, z, out, top, left, sign):
    """out[top:, left:] = sign · [x y z]×."""
    out[top, left], out[top, left + 1], out[top, left + 2] = 0.0, -sign * z, sign * y
    out[top + 1, left], out[top + 1, left + 1], out[top + 1, left + 2] = sign * z, 0.0, -sign * x
    out[top + 2, left], out[top + 2, left + 1], out[top + 2, left + 2] = -sign * y, sign * x, 0.0


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
    n, mixed = layout.size, layout.inertial
    p = start.covariance.copy()
    values = start.values.copy()
    work = np.zeros((n, n))
    h, noise, y = np.zeros((3, n)), np.zeros((3, 3)), np.zeros(3)
    level, body = np.zeros((3, 3)), np.zeros((3, 3))
    turn_noise, push_noise = np.zeros((3, 3)), np.zeros((3, 3))
    sums = np.zeros((10, 3, 3))
    ways = np.zeros((6, 3))
    shift = np.zeros(n)
    q = (start.quaternion[0], start.quaternion[1], start.quaternion[2], start.quaternion[3])
    v = (start.velocity[0], start.velocity[1], start.velocity[2])
    r = (start.position[0], start.position[1], start.position[2])
    _note(track, 0, q, v, r)
    count = 0
    streak = 0.0
    last_good = 0.0
    now = 0.0
    gained = (0.0, 0.0, 0.0)
    for k in range(nodes.bound.size):
        if k > 0:
            begin, end = nodes.bound[k - 1], nodes.bound[k]
            field = gravity_field(r[0], r[1], r[2])
            before = v
            sums[:] = 0.0
            ways[:] = 0.0
            seconds = 0.0
            loose = 0.0
            for s in range(begin, end):
                dt = steps.seconds[s]
                turn = _corrected(steps.turn, s, values, 0, 6, mixed, dt)
                push = _corrected(steps.push, s, values, 3, 9, mixed, dt)
                c0 = matrix(q)
                v0 = v
                q, v, r, gain = strapdown_step(q, v, r, turn, push, dt, field)
                _accumulate(sums, ways, c0, matrix(q), v0, v, turn, push, gain, dt, mixed)
                seconds += dt
                loose = max(loose, steps.loose[s])
                _note(track, s + 1, q, v, r)
                for j in range(3):
                    track.rate[s + 1, j] = turn[j] / dt
            now += seconds
            keep = math.exp(-seconds / model.bias_seconds)
            for j in range(6):
                values[j] *= keep
            record.keep[k] = keep
            gained = ((v[0] - before[0]) / seconds, (v[1] - before[1]) / seconds, (v[2] - before[2]) / seconds)
            phi = record.transition[k]
            _transition(sums, ways, seconds, field, mixed, phi)
            c = matrix(q)
            for i in range(3):
                for j in range(3):
                    turn_noise[i, j], push_noise[i, j] = 0.0, 0.0
                    for m in range(3):
                        both = c[3 * i + m] * c[3 * j + m] * seconds
                        turn_noise[i, j] += both * nodes.rate_noise[k, m]
                        push_noise[i, j] += both * nodes.force_noise[k, m]
            _predict(p, phi, work, keep, nodes.colour_keep[k], seconds, loose, turn_noise, push_noise, model, layout)
            if layout.colour >= 0:
                for j in range(3):
                    values[layout.colour - 9 + j] *= nodes.colour_keep[k]
        else:
            seconds = 0.0
        record.first_update[k] = count
        for j in range(9):
            record.applied[k, j] = 0.0
        c = matrix(q)
        for i in range(3):
            for j in range(3):
                body[i, j] = (
                    c[3 * i] * model.body_from_imu[j, 0]
                    + c[3 * i + 1] * model.body_from_imu[j, 1]
                    + c[3 * i + 2] * model.body_from_imu[j, 2]
                )
        g = nodes.gnss[k]
        if g >= 0:
            s_lat, c_lat, s_lon, c_lon, _ = geodetic(r[0], r[1], r[2])
            level[0, 0], level[0, 1], level[0, 2] = -s_lat * c_lon, -s_lon, -c_lat * c_lon
            level[1, 0], level[1, 1], level[1, 2] = -s_lat * s_lon, c_lon, -c_lat * s_lon
            level[2, 0], level[2, 1], level[2, 2] = c_lat, 0.0, -s_lat
        for kind in range(KINDS):
            size = 0
            first = 0
            if kind == GNSS_POSITION and g >= 0 and not math.isnan(fixes.position[g, 0]):
                size = 3
                _gnss_position(fixes, g, q, v, r, body, level, values, layout, h, y, noise)
            elif kind == GNSS_VELOCITY and g >= 0 and not math.isnan(fixes.velocity[g, 0]):
                size = 3
                rate = (0.0, 0.0, 0.0)
                if k > 0:
                    at = nodes.bound[k]
                    rate = (track.rate[at, 0], track.rate[at, 1], track.rate[at, 2])
                _gnss_velocity(fixes, g, v, gained, rate, body, level, values, layout, model, h, y, noise)
            elif kind == ODOMETER and k > 0 and not nodes.still[k] and not math.isnan(nodes.travel[k]):
                size = 1
                _travel(sums, ways, seconds, nodes.travel[k], values, layout, model, h, y, noise, 0)
            elif kind == NON_HOLONOMIC and k > 0 and not nodes.still[k] and nodes.constrained[k]:
                size = 2
                first = 1
                _travel(sums, ways, seconds, 0.0, values, layout, model, h, y, noise, 1)
            elif kind == ZERO_VELOCITY and k > 0 and nodes.still[k]:
                size = 3
                h[:] = 0.0
                noise[:] = 0.0
                for i in range(3):
                    h[i, VELOCITY + i] = 1.0
                    y[i] = -v[i]
                    noise[i, i] = model.zero_sigma**2 * model.interval_s / seconds
            elif kind == ZERO_ROTATION and k > 0 and nodes.still[k]:
                size = 3
                _zero_rotation(ways, seconds, matrix(q), nodes.rate_noise[k], model, h, y, noise)
            if size == 0:
                continue
            trusting = kind == GNSS_POSITION and streak > model.patience_s
            limit = model.outlier[size] if not trusting else 1e300
            for j in range(3):
                updates.residual[count, j] = math.nan
            if kind <= GNSS_VELOCITY:
                for j in range(3):
                    updates.residual[count, j] = level[0, j] * y[0] + level[1, j] * y[1] + level[2, j] * y[2]
            else:
                for j in range(size):
                    updates.residual[count, first + j] = y[j]
            _update(p, h, y, noise, size, limit, count, updates, shift)
            updates.kind[count] = kind
            updates.node[count] = k
            if kind == GNSS_POSITION:
                if updates.weight[count] < 1.0:
                    streak = now - last_good
                else:
                    streak = 0.0
                    last_good = now
            count += 1
            for j in range(9):
                record.applied[k, j] += shift[j]
            for j in range(9, n):
                values[j - 9] += shift[j]
            r = (r[0] + shift[0], r[1] + shift[1], r[2] + shift[2])
            v = (v[0] + shift[3], v[1] + shift[4], v[2] + shift[5])
            q = unit(product(exponential(shift[6], shift[7], shift[8]), q))
        for i in range(9):
            for j in range(n):
                record.rows[k, i, j] = p[i, j]
        j = nodes.report[k]
        if j >= 0:
            record.values[j] = values
            record.covariance[j] = p
    record.first_update[nodes.bound.size] = count
    return count


@inlined
def _note(track, at, q, v, r):
    for j in range(4):
        track.quaternion[at, j] = q[j]
    for j in range(3):
        track.velocity[at, j] = v[j]
        track.position[at, j] = r[j]


@inlined
def _corrected(stated, s, values, bias, scale, mixed, dt):
    """Increment without bias and scale error: stated = (1 + scale) · true + bias."""
    x = stated[s, 0] - values[bias] * dt
    y = stated[s, 1] - values[bias + 1] * dt
    z = stated[s, 2] - values[bias + 2] * dt
    if mixed > 15:
        x /= 1.0 + values[scale]
        y /= 1.0 + values[scale + 1]
        z /= 1.0 + values[scale + 2]
    return x, y, z


@inlined
def _accumulate(sums, ways, c0, c1, v0, v1, turn, push, gain, dt, mixed):
    """Add one step to the integrals of an interval.

    sums: 0 ∫C, 1 ∫C diag(ω), 2 ∫C diag(f), 3 ∫[f×]∫C, 4 ∫[f×]∫C diag(ω), 5…8 integrals of 0, 2, 3, 4,
    9 ∫Cᵀ[v×]; ways: 0 ∫f, 1 ∫∫f (ECEF), 2 ∫ω, 3 ∫Cᵀv, 4 ∫push (IMU axes). C turns IMU axes into ECEF.
    """
    fx, fy, fz = gain
    wx, wy = 0.5 * (v0[0] + v1[0]), 0.5 * (v0[1] + v1[1])
    wz = 0.5 * (v0[2] + v1[2])
    for j in range(3):
        m0, m1, m2 = 0.5 * (c0[j] + c1[j]), 0.5 * (c0[3 + j] + c1[3 + j]), 0.5 * (c0[6 + j] + c1[6 + j])
        # Position's integrals first: they take velocity's at the begin, plus half of the step.
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
        if mixed > 15:
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
        ways[4, j] += push[j]
        ways[5, j] = push[j] / dt


@kernel
def _transition(sums, ways, seconds, field, mixed, phi):
    """Rows of position, velocity and attitude of the transition (9, mixed) over an interval."""
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
            if mixed > 15:
                phi[i, GYRO_SCALE + j] = sums[8, i, j]
                phi[3 + i, GYRO_SCALE + j] = sums[4, i, j]
                phi[6 + i, GYRO_SCALE + j] = -sums[1, i, j]
                phi[i, ACCEL_SCALE + j] = -sums[6, i, j]
                phi[3 + i, ACCEL_SCALE + j] = -sums[2, i, j]
    _cross_rows(ways[1, 0], ways[1, 1], ways[1, 2], phi, 0, 6, -1.0)
    _cross_rows(ways[0, 0], ways[0, 1], ways[0, 2], phi, 3, 6, -1.0)
    # The Earth turns: ψ and δv against ECEF axes.
    turn = EARTH_RATE_RAD_PER_S * seconds
    phi[6, 7] += turn
    phi[7, 6] -= turn
    phi[3, 4] += 2.0 * turn
    phi[4, 3] -= 2.0 * turn
    phi[0, 4] += turn * seconds
    phi[1, 3] -= turn * seconds


@kernel
def _predict(p, phi, work, keep, colour_keep, seconds, loose, turn_noise, push_noise, model, layout):
    """P ← Φ P Φᵀ + Q, with the noise of attitude and velocity over the interval (3, 3), ECEF."""
    n, mixed = layout.size, layout.inertial
    colour = layout.colour
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
    for i in range(9, n):
        di = keep if i < 15 else 1.0
        if colour >= 0 and colour <= i < colour + 3:
            di = colour_keep
        for j in range(9):
            p[i, j] = di * work[j, i]
            p[j, i] = p[i, j]
        if di != 1.0:
            for j in range(9, n):
                p[i, j] *= di
                p[j, i] *= di
    # Noise early in the interval reaches the states behind: integrals of white noise (Groves 2013, 14.2.6).
    for i in range(3):
        p[ATTITUDE + i, ATTITUDE + i] += (model.loose_rate * loose) ** 2
        p[VELOCITY + i, VELOCITY + i] += (model.loose_force * loose) ** 2
        p[i, i] += (model.loose_force * loose * loose) ** 2 / 4.0
        for j in range(3):
            p[ATTITUDE + i, ATTITUDE + j] += turn_noise[i, j]
            p[i, j] += push_noise[i, j] * seconds * seconds / 3.0
            p[i, VELOCITY + j] += 0.5 * push_noise[i, j] * seconds
            p[VELOCITY + j, i] += 0.5 * push_noise[i, j] * seconds
            cross, total = 0.0, 0.0
            for m in range(3):
                cross += phi[VELOCITY + i, ATTITUDE + m] * turn_noise[m, j]
                for o in range(3):
                    total += phi[VELOCITY + i, ATTITUDE + m] * turn_noise[m, o] * phi[VELOCITY + j, ATTITUDE + o]
            p[VELOCITY + i, ATTITUDE + j] += 0.5 * cross
            p[ATTITUDE + j, VELOCITY + i] += 0.5 * cross
            p[VELOCITY + i, VELOCITY + j] += push_noise[i, j] + total / 3.0
        p[GYRO_BIAS + i, GYRO_BIAS + i] += model.gyro_bias**2 * (1.0 - keep * keep)
        p[ACCEL_BIAS + i, ACCEL_BIAS + i] += model.accel_bias**2 * (1.0 - keep * keep)
        if colour >= 0:
            p[colour + i, colour + i] += 1.0 - colour_keep * colour_keep
    if layout.delay >= 0:
        p[layout.delay, layout.delay] += model.delay_wander**2 * seconds


@kernel
def _gnss_position(fixes, g, q, v, r, body, level, values, layout, h, y, noise):
    """Antenna's position against the predicted one, ECEF."""
    h[:] = 0.0
    a = layout.antenna - 9
    arm = np.zeros(3)
    for i in range(3):
        for j in range(3):
            arm[i] += body[i, j] * values[a + j]
            h[i, layout.antenna + j] = body[i, j]
        h[i, POSITION + i] = 1.0
        y[i] = fixes.position[g, i] - r[i] - arm[i]
    _cross_rows(arm[0], arm[1], arm[2], h, 0, ATTITUDE, -1.0)
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


@kernel
def _gnss_velocity(fixes, g, v, gained, rate, body, level, values, layout, model, h, y, noise):
    """Antenna's velocity against the predicted one, ECEF; `rate` of the IMU in its own axes, `gained` acceleration."""
    h[:] = 0.0
    a = layout.antenna - 9
    b = model.body_from_imu
    w = np.zeros(3)
    for i in range(3):
        for j in range(3):
            w[i] += b[i, j] * rate[j]
    # The Earth's own rate, in body axes, is not over ground.
    for i in range(3):
        w[i] -= body[2, i] * EARTH_RATE_RAD_PER_S
    l0, l1, l2 = values[a], values[a + 1], values[a + 2]
    swing = (w[1] * l2 - w[2] * l1, w[2] * l0 - w[0] * l2, w[0] * l1 - w[1] * l0)
    out = np.zeros(3)
    cross_rate, cross_arm = np.zeros((3, 3)), np.zeros((3, 3))
    _cross_rows(w[0], w[1], w[2], cross_rate, 0, 0, 1.0)
    _cross_rows(l0, l1, l2, cross_arm, 0, 0, 1.0)
    for i in range(3):
        h[i, VELOCITY + i] = 1.0
        for j in range(3):
            out[i] += body[i, j] * swing[j]
            for m in range(3):
                h[i, layout.antenna + j] += body[i, m] * cross_rate[m, j]
                for o in range(3):
                    h[i, GYRO_BIAS + j] += body[i, m] * cross_arm[m, o] * b[o, j]
    _cross_rows(out[0], out[1], out[2], h, 0, ATTITUDE, -1.0)
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
def _travel(sums, ways, seconds, travel, values, layout, model, h, y, noise, what):
    """Mean velocity of the axle over the interval, in the axes of travel: forwards (`what` 0), or aside and up (1).

    u = R Cᵀ v + ω × l; its direction is tilted against the body's axes by a pitch and a heading.
    """
    b = model.body_from_imu
    u, w = np.zeros(3), np.zeros(3)
    all_h = np.zeros((3, h.shape[1]))
    x = layout.axle - 9
    l0, l1, l2 = values[x], values[x + 1], values[x + 2]
    for i in range(3):
        for j in range(3):
            u[i] += b[i, j] * ways[3, j] / seconds
            w[i] += b[i, j] * ways[2, j] / seconds
    u[0] += w[1] * l2 - w[2] * l1
    u[1] += w[2] * l0 - w[0] * l2
    u[2] += w[0] * l1 - w[1] * l0
    cross_arm = np.zeros((3, 3))
    _cross_rows(l0, l1, l2, cross_arm, 0, 0, 1.0)
    _cross_rows(w[0], w[1], w[2], all_h, 0, layout.axle, 1.0)
    for i in range(3):
        for j in range(3):
            for m in range(3):
                all_h[i, VELOCITY + j] += b[i, m] * sums[0, j, m] / seconds
                all_h[i, ATTITUDE + j] += b[i, m] * sums[9, m, j] / seconds
                all_h[i, GYRO_BIAS + j] += cross_arm[i, m] * b[m, j]
    pitch, heading = values[layout.tilt - 9], values[layout.tilt - 8]
    sp, cp, sh, ch = math.sin(pitch), math.cos(pitch), math.sin(heading), math.cos(heading)
    for j in range(h.shape[1]):
        along, aside = ch * all_h[0, j] + sh * all_h[1, j], ch * all_h[1, j] - sh * all_h[0, j]
        down = all_h[2, j]
        all_h[0, j], all_h[1, j], all_h[2, j] = cp * along - sp * down, aside, sp * along + cp * down
    along, aside = ch * u[0] + sh * u[1], ch * u[1] - sh * u[0]
    forward, downward = cp * along - sp * u[2], sp * along + cp * u[2]
    all_h[0, layout.tilt], all_h[2, layout.tilt] = -downward, forward
    all_h[0, layout.tilt + 1], all_h[1, layout.tilt + 1], all_h[2, layout.tilt + 1] = cp * aside, -along, sp * aside
    noise[:] = 0.0
    if what == 0:
        counted = travel / seconds
        # A counter that does not know its direction counts up on the way back.
        if forward < -0.5 and counted > 0.0:
            counted = -counted
        for j in range(h.shape[1]):
            h[0, j] = all_h[0, j]
        h[0, layout.scale] = -counted
        y[0] = (1.0 + values[layout.scale - 9]) * counted - forward
        noise[0, 0] = (model.travel_sigma**2 + (model.travel_share * counted) ** 2) * model.interval_s / seconds
    else:
        for j in range(h.shape[1]):
            h[0, j] = all_h[1, j]
            h[1, j] = all_h[2, j]
        y[0] = -aside
        y[1] = -downward
        share = model.interval_s / seconds
        noise[0, 0] = (model.side_sigma**2 + (model.side_slip * w[2] * forward * forward) ** 2) * share
        noise[1, 1] = model.up_sigma**2 * share


@kernel
def _zero_rotation(ways, seconds, c, rate_noise, model, h, y, noise):
    """The body does not turn against the Earth: what the gyroscopes feel is the Earth's rate."""
    h[:] = 0.0
    noise[:] = 0.0
    rate = EARTH_RATE_RAD_PER_S
    for i in range(3):
        h[i, GYRO_BIAS + i] = -1.0
        y[i] = c[6 + i] * rate - ways[2, i] / seconds
        # −Cᵀ[Ω×]ψ with Ω along z.
        h[i, ATTITUDE] = -c[3 + i] * rate
        h[i, ATTITUDE + 1] = c[i] * rate
        noise[i, i] = model.zero_rate_sigma**2 * model.interval_s / seconds + rate_noise[i] / seconds


@kernel
def _update(p, h, y, noise, size, limit, at, updates, shift):
    """One update of `size` components; too large an innovation has its noise raised.

    The weight w of an outlier divides its noise: w = limit / normalised innovation (of one component), a
    redescending influence (compare Chang 2014, "Robust Kalman filtering based on Mahalanobis distance").
    """
    n = p.shape[0]
    ph = np.zeros((3, n))
    for c in range(size):
        for m in range(n):
            f = h[c, m]
            if f != 0.0:
                for j in range(n):
                    ph[c, j] += f * p[m, j]
    predicted, factor = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(size):
        for j in range(size):
            for m in range(n):
                predicted[i, j] += ph[i, m] * h[j, m]
    white = np.zeros(3)
    weight = 1.0
    normalised = _whiten(predicted, noise, 1.0, size, y, factor, white)
    if normalised > limit:
        weight = limit / normalised
        _whiten(predicted, noise, weight, size, y, factor, white)
    updates.normalised[at] = normalised
    updates.weight[at] = weight
    updates.size[at] = size
    row, gain = updates.row[at], updates.gain[at]
    for c in range(size):
        for j in range(n):
            a, b = h[c, j], ph[c, j]
            for m in range(c):
                a -= factor[c, m] * row[m, j]
                b -= factor[c, m] * gain[m, j]
            row[c, j] = a / factor[c, c]
            gain[c, j] = b / factor[c, c]
        updates.innovation[at, c] = white[c]
    for j in range(n):
        shift[j] = 0.0
    for c in range(size):
        for i in range(n):
            f = gain[c, i]
            shift[i] += f * white[c]
            for j in range(n):
                p[i, j] -= f * gain[c, j]


@kernel
def _whiten(predicted, noise, weight, size, y, factor, white):
    """Cholesky factor of the innovation's covariance, L⁻¹y, and its squared length by component."""
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


@kernel
def smooth_backwards(nodes, layout, record, updates, correction, covariance, values, sigmas):
    """Run the adjoint back over all nodes.

    Parameters
    ----------
    nodes : Nodes; layout : Layout; record : Record; updates : Updates, from :func:`filter_forwards`.
    correction : (k, 9) out, to be added to the nominal states after each node's updates.
    covariance : (k, 9, 9) out.
    values, sigmas : (j, n − 9) out, smoothed states at the reported nodes and their σ.
    """
    n, mixed = layout.size, layout.inertial
    adjoint, information = np.zeros(n), np.zeros((n, n))
    work, z, inner = np.zeros((n, n)), np.zeros((3, n)), np.zeros((3, 3))
    for k in range(nodes.bound.size - 1, -1, -1):
        rows = record.rows[k]
        for i in range(9):
            total = 0.0
            for j in range(n):
                total += rows[i, j] * adjoint[j]
                work[i, j] = 0.0
            correction[k, i] = -total
            for m in range(n):
                f = rows[i, m]
                for j in range(n):
                    work[i, j] += f * information[m, j]
        for i in range(9):
            for j in range(i + 1):
                total = rows[i, j]
                for m in range(n):
                    total -= work[i, m] * rows[j, m]
                covariance[k, i, j] = total
                covariance[k, j, i] = total
        at = nodes.report[k]
        if at >= 0:
            _smoothed_values(record.covariance[at], record.values[at], adjoint, information, values[at], sigmas[at])
        for u in range(record.first_update[k + 1] - 1, record.first_update[k] - 1, -1):
            _adjoint_update(updates, u, adjoint, information, z, inner)
        if k > 0:
            _adjoint_step(
                record.transition[k], record.keep[k], nodes.colour_keep[k], layout, mixed, adjoint, information, work
            )


@kernel
def _smoothed_values(p, nominal, adjoint, information, values, sigmas):
    n = p.shape[0]
    for i in range(9, n):
        total, variance = 0.0, p[i, i]
        for j in range(n):
            total += p[i, j] * adjoint[j]
            part = 0.0
            for m in range(n):
                part += information[j, m] * p[i, m]
            variance -= p[i, j] * part
        values[i - 9] = nominal[i - 9] - total
        sigmas[i - 9] = math.sqrt(max(variance, 0.0))


@kernel
def _adjoint_update(updates, u, adjoint, information, z, inner):
    n = adjoint.size
    size = updates.size[u]
    row, gain = updates.row[u], updates.gain[u]
    for c in range(size):
        total = updates.innovation[u, c]
        for j in range(n):
            z[c, j] = 0.0
            total += gain[c, j] * adjoint[j]
        inner[c, c] = total
    for c in range(size):
        for m in range(n):
            f = gain[c, m]
            for j in range(n):
                z[c, j] += f * information[m, j]
    for c in range(size):
        for j in range(n):
            adjoint[j] -= inner[c, c] * row[c, j]
    for c in range(size):
        for d in range(size):
            total = 1.0 if c == d else 0.0
            for j in range(n):
                total += z[c, j] * gain[d, j]
            inner[c, d] = 0.5 * total
    for c in range(size):
        for d in range(size):
            f = inner[c, d]
            for j in range(n):
                z[c, j] -= f * row[d, j]
    for c in range(size):
        for i in range(n):
            f, g = row[c, i], z[c, i]
            for j in range(n):
                information[i, j] -= f * z[c, j] + g * row[c, j]


@kernel
def _adjoint_step(phi, keep, colour_keep, layout, mixed, adjoint, information, work):
    """λ ← Φᵀλ and Λ ← ΦᵀΛΦ."""
    n, colour = layout.size, layout.colour
    for i in range(9, n):
        di = keep if i < 15 else 1.0
        if colour >= 0 and colour <= i < colour + 3:
            di = colour_keep
        if di != 1.0:
            adjoint[i] *= di
    part = np.zeros(mixed)
    for i in range(9):
        f = adjoint[i]
        for j in range(mixed):
            part[j] += f * phi[i, j]
    for j in range(mixed):
        adjoint[j] = part[j] if j < 9 else adjoint[j] + part[j]
    # work = Λ Φ
    for i in range(n):
        for j in range(9):
            work[i, j] = 0.0
        for j in range(9, n):
            work[i, j] = information[i, j]
        for j in range(9, 15):
            work[i, j] *= keep
        if colour >= 0:
            for j in range(colour, colour + 3):
                work[i, j] *= colour_keep
        for m in range(9):
            f = information[i, m]
            for j in range(mixed):
                work[i, j] += f * phi[m, j]
    for i in range(n):
        if i < 9:
            for j in range(n):
                information[i, j] = 0.0
        else:
            di = keep if i < 15 else 1.0
            if colour >= 0 and colour <= i < colour + 3:
                di = colour_keep
            for j in range(n):
                information[i, j] = di * work[i, j]
    for m in range(9):
        for i in range(mixed):
            f = phi[m, i]
            if f != 0.0:
                for j in range(n):
                    information[i, j] += f * work[m, j]


class Poses(NamedTuple):
    """Poses of the IMU reference point at chosen bounds, e of them."""

    position: Float64
    """(e, 3) ECEF."""
    quaternion: Float64
    """(e, 4) ECEF from body."""
    velocity: Float64
    """(e, 3) north-east-down."""
    covariance: Float64
    """(3, e, 3, 3) of position, attitude, velocity, north-east-down."""
    sigma_rph: Float64
    """(e, 3) σ of roll, pitch, heading, rad."""


@kernel
def spread(wanted, bound, track, applied, correction, covariance, smooth, arm_imu, imu_from_body, poses):
    """Corrections and covariances of the nodes, spread over the bounds between them.

    The correction of a smoothed state changes linearly from a node, after its updates, to the next, before them.
    Covariances change linearly too.

    Parameters
    ----------
    wanted : (e,) int64 bounds, ascending.
    bound : (k,) of the nodes; track : Track; applied, correction : (k, 9); covariance : (k, 9, 9).
    smooth : bool; False leaves the nominal states between nodes as they are.
    arm_imu : (3,) from the IMU to the reference point, IMU axes (m).
    imu_from_body : (4,) quaternion.
    poses : Poses, out.
    """
    back = (imu_from_body[0], imu_from_body[1], imu_from_body[2], imu_from_body[3])
    k = 0
    last = -1
    levelled = np.zeros((2, 3, 3, 3))
    level = np.zeros((3, 3))
    dx = np.zeros(9)
    for e in range(wanted.size):
        b = wanted[e]
        while k + 1 < bound.size and bound[k + 1] < b:
            k += 1
        upper = min(k + 1, bound.size - 1) if b > bound[k] else k
        if b > bound[k] and upper > k:
            u = (b - bound[k]) / (bound[upper] - bound[k])
        else:
            u = 0.0
        at_node = bound[upper] == b
        for j in range(9):
            if smooth:
                end = correction[upper, j] + applied[upper, j]
                dx[j] = end if upper == k else (1.0 - u) * correction[k, j] + u * end
            else:
                dx[j] = applied[upper, j] if at_node else 0.0
        q = (track.quaternion[b, 0], track.quaternion[b, 1], track.quaternion[b, 2], track.quaternion[b, 3])
        q = unit(product(exponential(dx[6], dx[7], dx[8]), q))
        c = matrix(q)
        # From the IMU to the reference point, and what it moves in a turn.
        w0 = track.rate[b, 0] - c[6] * EARTH_RATE_RAD_PER_S
        w1 = track.rate[b, 1] - c[7] * EARTH_RATE_RAD_PER_S
        w2 = track.rate[b, 2] - c[8] * EARTH_RATE_RAD_PER_S
        s0 = w1 * arm_imu[2] - w2 * arm_imu[1]
        s1 = w2 * arm_imu[0] - w0 * arm_imu[2]
        s2 = w0 * arm_imu[1] - w1 * arm_imu[0]
        for i in range(3):
            reach = c[3 * i] * arm_imu[0] + c[3 * i + 1] * arm_imu[1] + c[3 * i + 2] * arm_imu[2]
            poses.position[e, i] = track.position[b, i] + dx[i] + reach
        v0 = track.velocity[b, 0] + dx[3] + c[0] * s0 + c[1] * s1 + c[2] * s2
        v1 = track.velocity[b, 1] + dx[4] + c[3] * s0 + c[4] * s1 + c[5] * s2
        v2 = track.velocity[b, 2] + dx[5] + c[6] * s0 + c[7] * s1 + c[8] * s2
        if last != k:
            s_lat, c_lat, s_lon, c_lon, _ = geodetic(track.position[b, 0], track.position[b, 1], track.position[b, 2])
            level[0, 0], level[0, 1], level[0, 2] = -s_lat * c_lon, -s_lon, -c_lat * c_lon
            level[1, 0], level[1, 1], level[1, 2] = -s_lat * s_lon, c_lon, -c_lat * s_lon
            level[2, 0], level[2, 1], level[2, 2] = c_lat, 0.0, -s_lat
            arm = (
                c[0] * arm_imu[0] + c[1] * arm_imu[1] + c[2] * arm_imu[2],
                c[3] * arm_imu[0] + c[4] * arm_imu[1] + c[5] * arm_imu[2],
                c[6] * arm_imu[0] + c[7] * arm_imu[1] + c[8] * arm_imu[2],
            )
            _levelled(covariance[k], level, arm, levelled[0])
            _levelled(covariance[min(k + 1, bound.size - 1)], level, arm, levelled[1])
            last = k
        to_body = unit(product(q, back))
        for j in range(4):
            poses.quaternion[e, j] = to_body[j]
        for i in range(3):
            poses.velocity[e, i] = level[0, i] * v0 + level[1, i] * v1 + level[2, i] * v2
        for m in range(3):
            for i in range(3):
                for j in range(3):
                    poses.covariance[m, e, i, j] = (1.0 - u) * levelled[0, m, i, j] + u * levelled[1, m, i, j]
        _note_sigma_rph(poses, e, matrix(to_body), level)


@inlined
def _note_sigma_rph(poses, e, c, level):
    """σ of roll, pitch, heading from the covariance of a small rotation about north, east, down.

    c : ECEF from body, row by row; level : ECEF from north-east-down.
    """
    north = level[0, 0] * c[0] + level[1, 0] * c[3] + level[2, 0] * c[6]
    east = level[0, 1] * c[0] + level[1, 1] * c[3] + level[2, 1] * c[6]
    down = level[0, 2] * c[0] + level[1, 2] * c[3] + level[2, 2] * c[6]
    flat = max(math.hypot(north, east), 1e-9)
    ch, sh, tan = north / flat, east / flat, -down / flat
    nn, ee, ne = poses.covariance[1, e, 0, 0], poses.covariance[1, e, 1, 1], poses.covariance[1, e, 0, 1]
    dd, nd, ed = poses.covariance[1, e, 2, 2], poses.covariance[1, e, 0, 2], poses.covariance[1, e, 1, 2]
    along = ch * ch * nn + 2.0 * ch * sh * ne + sh * sh * ee
    poses.sigma_rph[e, 0] = math.sqrt(max(along, 0.0)) / flat
    poses.sigma_rph[e, 1] = math.sqrt(max(sh * sh * nn - 2.0 * ch * sh * ne + ch * ch * ee, 0.0))
    poses.sigma_rph[e, 2] = math.sqrt(max(tan * tan * along + 2.0 * tan * (ch * nd + sh * ed) + dd, 0.0))


@kernel
def _levelled(covariance, level, reach, out):
    """Covariances (3, 3, 3) of position at the end of `reach` (m, ECEF), attitude and velocity, north-east-down."""
    moved = np.zeros((3, 3))
    cross = np.zeros((3, 3))
    _cross_rows(reach[0], reach[1], reach[2], cross, 0, 0, -1.0)
    for i in range(3):
        for j in range(3):
            total = covariance[i, j]
            for m in range(3):
                total += cross[i, m] * covariance[6 + m, j] + covariance[i, 6 + m] * cross[j, m]
                for o in range(3):
                    total += cross[i, m] * covariance[6 + m, 6 + o] * cross[j, o]
            moved[i, j] = total
    for part in range(3):
        for i in range(3):
            for j in range(3):
                total = 0.0
                for m in range(3):
                    for o in range(3):
                        if part == 0:
                            value = moved[m, o]
                        elif part == 1:
                            value = covariance[6 + m, 6 + o]
                        else:
                            value = covariance[3 + m, 3 + o]
                        total += level[m, i] * value * level[o, j]
                out[part, i, j] = total
