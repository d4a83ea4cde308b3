"""Upright cylinders through returns on the side that sensors saw."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel

_ROUNDS = 12  # Rounds of Gauss–Newton, at most.
_INNER = 0.04
"""Share of the offsets across the sight lines that is left out at each end."""
_LEAST_OF_SECTOR = 15
"""Least number of returns seen from one direction for a width."""
LEAST_RADIUS_M, MOST_RADIUS_M = 0.01, 0.6  # Bounds of a radius (m).
_STIFF = 0.002
"""Weight of an upright axis, per return."""


@inlined
def _width(sorted_values):
    """Returns the distance between the inner quantiles of sorted values (n,)."""
    n = sorted_values.size
    out = 0.0
    for share, sign in ((1.0 - _INNER, 1.0), (_INNER, -1.0)):
        at = share * (n - 1)
        k = min(int(at), n - 2) if n > 1 else 0
        step = sorted_values[k + 1] - sorted_values[k] if n > 1 else 0.0
        out += sign * (sorted_values[k] + (at - k) * step)
    return out


@kernel
def radius_across(across, kept, sector):
    """Half the width of evenly spread offsets, seen from one direction each: the weighted median of all directions.

    About the axis itself, an error of the axis would widen the shaft, and a wider shaft push the axis away.
    across : (n,) offsets (m); kept : (n,) which count; sector : (n,) int64 direction, ascending.
    """
    n = across.size
    widths, weights = np.empty(n), np.empty(n)
    buffer = np.empty(n)
    found, first = 0, 0
    while first < n:
        last, held = first, 0
        while last < n and sector[last] == sector[first]:
            if kept[last] > 0.0:
                buffer[held] = across[last]
                held += 1
            last += 1
        if held >= _LEAST_OF_SECTOR:
            widths[found], weights[found] = _width(np.sort(buffer[:held])), held
            found += 1
        first = last
    if found == 0:
        held = 0
        for i in range(n):
            if kept[i] > 0.0:
                buffer[held] = across[i]
                held += 1
        widths[0], weights[0], found = _width(np.sort(buffer[:held])), 1.0, 1
    order = np.argsort(widths[:found], kind="mergesort")
    total = weights[:found].sum()
    reached = 0.0
    middle = widths[order[found - 1]]
    for k in range(found):
        reached += weights[order[k]]
        if reached >= 0.5 * total:
            middle = widths[order[k]]
            break
    return min(max(0.5 * middle / (1.0 - 2.0 * _INNER), LEAST_RADIUS_M), MOST_RADIUS_M)


@kernel
def fit_cylinder(table, sector, lean, state, work):
    """Returns the root mean square distance from the fitted cylinder (m), and the number of returns used.

    table : (n, 5) x, y, height past the middle, and the unit vector towards the sensor, seen from above; sector : (n,)
    int64 direction of that vector, ascending; lean : the axis may lean; state : (5,) x, y, slopes of both with height,
    radius: where to begin, and what is found; work : (n, 4) working space.
    """
    n = table.shape[0]
    normal, right = np.empty((4, 4)), np.empty(4)
    a = np.empty(4)
    total, square = float(n), 0.0
    for turn in range(_ROUNDS):
        radius = state[4]
        total = 0.0
        for i in range(n):
            dx = table[i, 0] - state[0] - state[2] * table[i, 2]
            dy = table[i, 1] - state[1] - state[3] * table[i, 2]
            work[i, 0] = table[i, 3] * dy - table[i, 4] * dx
            work[i, 1] = table[i, 3] * dx + table[i, 4] * dy
            work[i, 2] = 1.0 if turn < 2 or math.hypot(dx, dy) < 2.0 * radius + 0.05 else 0.0
            total += work[i, 2]
        if total < 5.0:
            work[:, 2] = 1.0
            total = float(n)
        radius = radius_across(work[:, 0], work[:, 2], sector)
        state[4] = radius
        held = 0
        for i in range(n):
            across = work[i, 0]
            work[i, 1] -= math.sqrt(max(radius * radius - across * across, 0.04 * radius * radius))
            if work[i, 2] > 0.0:
                work[held, 3] = abs(work[i, 1])
                held += 1
        scale = 1.5 * max(np.median(work[:held, 3]), 0.005)
        spread = max(radius / math.sqrt(3.0), 0.01)
        normal[:], right[:] = 0.0, 0.0
        square = 0.0
        for i in range(n):
            if work[i, 2] == 0.0:
                continue
            across, miss = work[i, 0], work[i, 1]
            square += miss * miss
            weight = 1.0 / max(1.0, abs(miss) / (2.0 * scale)) / scale
            sx, sy, past = table[i, 3], table[i, 4], table[i, 2]
            for part in range(2):
                a[0], a[1] = (sx, sy) if part == 0 else (-sy, sx)
                a[2], a[3] = a[0] * past, a[1] * past
                w = weight * weight if part == 0 else 1.0 / (spread * spread)
                value = miss if part == 0 else across
                for p in range(4):
                    right[p] += w * a[p] * value
                    for q in range(4):
                        normal[p, q] += w * a[p] * a[q]
        for p in range(4):
            normal[p, p] += 1e-9
        stiff = total * _STIFF / (scale * scale) if lean else 1e12
        normal[2, 2] += stiff
        normal[3, 3] += stiff
        move = np.linalg.solve(normal, right)
        state[:4] += move
        if np.abs(move).max() < 1e-5 and turn > 2:
            break
    return math.sqrt(square / total), total
