"""Rauch–Tung–Striebel smoother, which runs backwards over the filter's record, and poses between its nodes.

In the form of Bryson and Frazier (Bierman 1973, "Fixed interval smoothing with discrete measurements") an adjoint
vector λ and matrix Λ run backwards, and no covariance is inverted:

    before an update   λ ← λ − Hᵀ(S⁻¹ y + Kᵀ λ),  Λ ← (I − K H)ᵀ Λ (I − K H) + Hᵀ S⁻¹ H
    before a step      λ ← Φᵀ λ,  Λ ← Φᵀ Λ Φ
    smoothed           δx = −P λ,  P − P Λ P

Λ is symmetric to the last bit after each step. The shortened forms in use here, as (I − K H)ᵀ Λ (I − K H) multiplied
out, shrink an error of Λ only where it is symmetric; an antisymmetric one from rounding would pass all updates
unchanged, grow with each Φ, and make the covariances at the start of a long drive indefinite.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.navigation.inertial.kernels.kalman_states import NAVIGATION, cross_rows, decays, level_axes
from roadscan.navigation.inertial.kernels.strapdown import EARTH_RATE_RAD_PER_S, exponential, matrix, product, unit


@kernel
def smooth_backwards(nodes, layout, record, updates, correction, covariance, values, sigmas):
    """Run the adjoint backwards over all nodes.

    Parameters
    ----------
    nodes : Nodes; layout : Layout; record : Record; updates : Updates, from
        :func:`roadscan.navigation.inertial.kernels.kalman.filter_forwards`.
    correction : (k, 9) out, to be added to the nominal states after each node's updates.
    covariance : (k, 9, 9) out.
    values, sigmas : (j, n − 9) out, smoothed states at the reported nodes and their σ, NaN for a negative variance.
    """
    n = layout.size
    adjoint, information = np.zeros(n), np.zeros((n, n))
    work, decay = np.zeros((n, n)), np.empty(n)
    for k in range(nodes.bound.size - 1, -1, -1):
        _smoothed(record.rows[k], adjoint, information, work, correction[k], covariance[k])
        at = nodes.report[k]
        if at >= 0:
            _smoothed_values(record.covariance[at], record.values[at], adjoint, information, values[at], sigmas[at])
        for u in range(record.first_update[k + 1] - 1, record.first_update[k] - 1, -1):
            _adjoint_update(
                updates.row[u], updates.gain[u], updates.innovation[u], updates.size[u], adjoint, information, work
            )
        if k > 0:
            decays(record.keep[k], nodes.colour_keep[k], layout, decay)
            _adjoint_step(record.transition[k], decay, adjoint, information, work)


@kernel
def _smoothed(rows, adjoint, information, work, correction, covariance):
    """Compute correction (9,) and covariance (9, 9) of the navigation states of a node with rows (9, n) of P."""
    n = adjoint.size
    for i in range(NAVIGATION):
        total = 0.0
        for j in range(n):
            total += rows[i, j] * adjoint[j]
            work[i, j] = 0.0
        correction[i] = -total
        for m in range(n):
            f = rows[i, m]
            for j in range(n):
                work[i, j] += f * information[m, j]
    for i in range(NAVIGATION):
        for j in range(i + 1):
            total = rows[i, j]
            for m in range(n):
                total -= work[i, m] * rows[j, m]
            covariance[i, j] = total
            covariance[j, i] = total


@inner
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
        sigmas[i - 9] = math.sqrt(variance)


@inner
def _adjoint_update(row, gain, innovation, size, adjoint, information, z):
    """Update λ and Λ to those before a whitened update; z: (n, n) scratch, of which `size` rows are used."""
    n = adjoint.size
    inner, factor = np.zeros((3, 3)), np.zeros(3)
    for c in range(size):
        total = innovation[c]
        for j in range(n):
            z[c, j] = 0.0
            total += gain[c, j] * adjoint[j]
        factor[c] = total
        for m in range(n):
            f = gain[c, m]
            for j in range(n):
                z[c, j] += f * information[m, j]
    for c in range(size):
        for j in range(n):
            adjoint[j] -= factor[c] * row[c, j]
        for d in range(size):
            total = 1.0 if c == d else 0.0
            for j in range(n):
                total += z[c, j] * gain[d, j]
            inner[c, d] = 0.5 * total
    for c in range(size):
        for d in range(size):
            for j in range(n):
                z[c, j] -= inner[c, d] * row[d, j]
    _downdate(row, z, size, information)


@inner
def _downdate(row, z, size, information):
    """Subtract: Λ ← Λ − rowᵀ z − zᵀ row; a symmetric Λ stays symmetric to the last bit."""
    n = information.shape[0]
    for c in range(size):
        for i in range(n):
            f, g = row[c, i], z[c, i]
            for j in range(n):
                information[i, j] -= f * z[c, j] + g * row[c, j]


@inner
def _adjoint_step(phi, decay, adjoint, information, work):
    """Apply λ ← Φᵀλ and Λ ← ΦᵀΛΦ; phi: (9, inertial) rows of navigation, decay: (n,) diagonal of the others.

    One triangle is worked out and copied to the other.
    """
    n, mixed = adjoint.size, phi.shape[1]
    part = np.zeros(mixed)
    for i in range(NAVIGATION):
        for j in range(mixed):
            part[j] += adjoint[i] * phi[i, j]
    for j in range(n):
        kept = adjoint[j] * decay[j] if j >= NAVIGATION else 0.0
        adjoint[j] = kept + (part[j] if j < mixed else 0.0)
    _times_transition(information, phi, decay, work)
    for i in range(n):
        for j in range(i + 1):
            information[i, j] = decay[i] * work[i, j] if i >= NAVIGATION else 0.0
    for m in range(NAVIGATION):
        for i in range(mixed):
            f = phi[m, i]
            if f != 0.0:
                for j in range(i + 1):
                    information[i, j] += f * work[m, j]
    for i in range(n):
        for j in range(i):
            information[j, i] = information[i, j]


@inner
def _times_transition(information, phi, decay, out):
    """Compute (n, n) Λ Φ."""
    n = decay.size
    for i in range(n):
        for j in range(n):
            out[i, j] = information[i, j] * decay[j] if j >= NAVIGATION else 0.0
        for m in range(NAVIGATION):
            f = information[i, m]
            for j in range(phi.shape[1]):
                out[i, j] += f * phi[m, j]


class Poses(NamedTuple):
    """Poses of the IMU reference point at e selected bounds."""

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
    """Distribute corrections and covariances of the nodes over the bounds between them.

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
        u = (b - bound[k]) / (bound[upper] - bound[k]) if upper > k else 0.0
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
        # From the IMU to the reference point, and its movement in a turn.
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
            level_axes(track.position[b, 0], track.position[b, 1], track.position[b, 2], level)
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
    """Write σ of roll, pitch, heading from the covariance of a small rotation about north, east, down.

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
    poses.sigma_rph[e, 0] = math.sqrt(along) / flat
    poses.sigma_rph[e, 1] = math.sqrt(sh * sh * nn - 2.0 * ch * sh * ne + ch * ch * ee)
    poses.sigma_rph[e, 2] = math.sqrt(tan * tan * along + 2.0 * tan * (ch * nd + sh * ed) + dd)


@inner
def _levelled(covariance, level, reach, out):
    """Covariances (3, 3, 3) of position at the end of `reach` (m, ECEF), attitude and velocity, north-east-down."""
    moved = np.zeros((3, 3))
    cross = np.zeros((3, 3))
    cross_rows(reach[0], reach[1], reach[2], cross, 0, 0, -1.0)
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
