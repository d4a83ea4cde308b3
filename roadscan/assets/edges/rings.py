"""How much of a step single rings of a lidar show: between rings, errors of poses and of lasers look like steps."""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy.spatial

from roadscan.assets.scene import Returns
from roadscan.compute.array_types import Float64, Int64

_RING_NS: Final = 20_000_000
"""Returns of one laser in one such interval (ns) are of one ring: a turn takes 50 ms or more."""
_ALONG_M: Final = 0.7  # Returns this near to a node (m) tell of its step …
_ACROSS_M: Final = (0.03, 0.5)  # … where they lie so far aside of the edge (m).
_NODES: Final = 3  # Nodes that may lie so near to a return.
_STEADY_M2: Final = 0.16
"""Weight of no slope along a ring (m²): (20 mm / 0.05)², 1 σ of heights along it and of the slope of a side."""


def share_within_rings(returns: Returns, rows: Int64, place: Float64, step_m: Float64) -> Float64:
    """Returns the share (n,) of the step at each node that rings on both sides of it show; NaN where there is none.

    Parameters
    ----------
    rows : (k,) the returns of the ground near the nodes.
    place : (n, 4) x, y and the unit vector along the edge, the higher side to its right.
    step_m : (n,) NaN where none was measured.
    """
    x, y, count = returns.x_m[rows], returns.y_m[rows], len(place)
    tree = scipy.spatial.cKDTree(place[:, :2])
    away, nearest = tree.query(np.column_stack([x, y]), range(1, _NODES + 1), distance_upper_bound=_ALONG_M)
    at, rank = np.nonzero(np.isfinite(away))
    node = nearest[at, rank].astype(np.int64)
    across = (x[at] - place[node, 0]) * place[node, 3] - (y[at] - place[node, 1]) * place[node, 2]
    beside = (np.abs(across) > _ACROSS_M[0]) & (np.abs(across) < _ACROSS_M[1])
    at, node, across = at[beside], node[beside], across[beside]
    rings = len(rows) + 1
    parts, part = np.unique(node * rings + _rings(returns, rows)[at], return_inverse=True)
    owner, side = parts // rings, 2 * part + (across > 0.0)  # in turn the low and the high side of a ring at a node
    number = np.bincount(side, minlength=2 * len(parts))
    height = returns.height_m[rows[at]]
    level, middle = (np.bincount(side, v, len(number)) / np.maximum(number, 1) for v in (height, across))
    off = across - middle[side]
    slope = np.bincount(node, off * (height - level[side]), count) / (np.bincount(node, off * off, count) + _STEADY_M2)
    rise = np.diff(level.reshape(-1, 2))[:, 0] - slope[owner] * np.diff(middle.reshape(-1, 2))[:, 0]
    weight = number.reshape(-1, 2).min(axis=1)
    total, number = (np.bincount(owner, v, count) for v in (weight * rise, weight))
    known = (number > 0) & (step_m > 0.0)
    return np.where(known, total / np.where(known, number * step_m, 1.0), np.nan)


def _rings(returns: Returns, rows: Int64) -> Int64:
    """Returns the number (k,) of the ring, what one laser draws in one turn, of some returns."""
    columns = (returns.pass_id, returns.sensor, returns.laser, returns.epoch_gps_ns // _RING_NS)
    drawn_by = np.stack([column[rows].astype(np.int64) for column in columns])
    order, number = np.lexsort(drawn_by), np.empty(len(rows), np.int64)
    number[order] = np.cumsum((np.diff(drawn_by[:, order], prepend=-1) != 0).any(axis=0))
    return number
