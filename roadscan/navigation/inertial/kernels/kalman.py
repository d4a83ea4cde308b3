"""Error-state Kalman filter of an inertial navigation system.

The nominal state is mechanised at the IMU's rate and corrected at each update (closed loop; Groves 2013, section
14.2.4). Covariances are carried from *node* to node: epochs of GNSS, and others between them where they are far apart.
Updates are whitened: with the Cholesky factor L of the innovation's covariance S the rows L⁻¹H, the columns P Hᵀ L⁻ᵀ
and L⁻¹ y are all that is kept of one, for the way back (:mod:`roadscan.navigation.inertial.kernels.kalman_smoother`).
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel
from roadscan.navigation.inertial.kernels.kalman_states import (
    GNSS_POSITION,
    GNSS_VELOCITY,
    KINDS,
    NAVIGATION,
    NON_HOLONOMIC,
    Interval,
    Offer,
    Present,
)
from roadscan.navigation.inertial.kernels.kalman_transition import advance, note, predict
from roadscan.navigation.inertial.kernels.kalman_updates import apply, offered, prepare


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
