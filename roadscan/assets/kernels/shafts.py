"""Shafts: horizontal slices of returns, components along an axis, upright cylinders, and what lies about a shaft."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from roadscan.assets import classes
from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.compute.kernels.arrays import median, sort, sorted_quantile

REACHES_M = (0.3, 0.2, 0.15)
"""Components this near to the axis (m) belong to it, round after round."""


@inlined
def _mean(v):
    """Returns the mean of v (n,)."""
    total = 0.0
    for k in range(v.size):
        total += v[k]
    return total / v.size


@inlined
def _slope(t, v):
    """Returns the slope of v (n,) over t (n,), whose mean is 0."""
    mean, total, squares = _mean(v), 0.0, 0.0
    for k in range(t.size):
        total += t[k] * (v[k] - mean)
        squares += t[k] * t[k]
    return total / max(squares, 1e-9)


@inner
def _distinct(level, kept):
    """Returns the numbers (k,) that occur in level (n,) where `kept` is true, ascending."""
    some, found = level[kept], 0
    sort(some)
    for k in range(some.size):
        if k == 0 or some[k] != some[k - 1]:
            some[found] = some[k]
            found += 1
    return some[:found]


@kernel
def near_axis(x, y, level, seed, most_lean, kept):
    """Compute which components lie near the straight axis through most of them: kept (n,) bool.

    x, y : (n,) places (m); level : (n,) int64 number of the slice; seed : (2,) place of one (m); most_lean : greatest
    shift of the axis from slice to slice, in x and y each (m).
    """
    kept[:] = True
    ax, ay, bx, by = seed[0], seed[1], 0.0, 0.0
    for reach in REACHES_M:
        past, across, along = level[kept].astype(np.float64), x[kept], y[kept]
        if past.size == 0:
            return
        middle = _mean(past)
        for k in range(past.size):
            past[k] -= middle
        if _distinct(level, kept).size >= 4:
            bx = min(max(_slope(past, across), -most_lean), most_lean)
            by = min(max(_slope(past, along), -most_lean), most_lean)
        for k in range(past.size):
            across[k] -= bx * past[k]
            along[k] -= by * past[k]
        ax, ay = median(across), median(along)
        for k in range(x.size):
            away = level[k] - middle
            kept[k] = math.hypot(x[k] - ax - bx * away, y[k] - ay - by * away) <= reach


@kernel
def longest_run(level, gap, least, kept):
    """Keep of the kept components (n,) those in the run of levels with the most; the lower run where equal.

    level : (n,) int64; gap : greatest step from a level to the next of a run; least : shorter runs keep none.
    """
    held = _distinct(level, kept)
    best, first, begin = 0, 0, 0
    for k in range(held.size + 1):
        if k == held.size or (k > 0 and held[k] - held[k - 1] > gap):
            if k - begin > best:
                best, first = k - begin, begin
            begin = k
    for i in range(level.size):
        kept[i] = kept[i] and best >= least and held[first] <= level[i] <= held[first + best - 1]


@kernel
def widths_of_levels(xyh, level, least, shares, widths):
    """Compute the diagonal of the box about the middle returns of each level: widths (levels,); unset of too few.

    xyh : (n, 3) returns (m); level : (n,) int64; least : number of returns; shares : (2,) of those below the box and
    below its end, along x and y each.
    """
    count, x, y = np.zeros(widths.size, np.int64), np.empty(level.size), np.empty(level.size)
    for i in range(level.size):
        count[level[i]] += 1
    for k in range(widths.size):
        if count[k] == 0 or count[k] < least:
            continue
        many = 0
        for i in range(level.size):
            if level[i] == k:
                x[many], y[many] = xyh[i, 0], xyh[i, 1]
                many += 1
        sort(x[:many])
        sort(y[:many])
        across = sorted_quantile(x[:many], shares[1]) - sorted_quantile(x[:many], shares[0])
        widths[k] = math.hypot(across, sorted_quantile(y[:many], shares[1]) - sorted_quantile(y[:many], shares[0]))


@kernel
def returns_about(counts, level, cell_m, reach_m):
    """Returns the number of returns in cells within reach of the middle one, in some slices.

    counts : (slices, rows, columns) returns of each cell; level : (n,) int64, slices, each as often as one likes.
    """
    _, rows, columns = counts.shape
    total, seen = 0, 0
    for k in level:
        if seen >> k & 1:
            continue
        seen |= 1 << k
        for r in range(rows):
            for c in range(columns):
                if math.hypot(c - columns // 2, r - rows // 2) * cell_m <= reach_m:
                    total += counts[k, r, c]
    return total


class Part(IntEnum):
    """Numbers of returns: on the shaft, beside it (on it too), in rings, in its lower and upper half, below, above."""

    ON_IT, BESIDE, RING_1, RING_2, RING_3, ON_LOWER, NEAR_LOWER, ON_UPPER, NEAR_UPPER = range(9)
    BELOW, OVER, GOES_ON, LEAVES, OWN_LEAVES, BUILDING, OWN_BUILDING = range(9, 16)


RINGS = (Part.RING_1, Part.RING_2, Part.RING_3)
"""The rings about a shaft, from its surface outwards."""
_ON_IT, _BESIDE, _RING_1, _ON_LOWER, _NEAR_LOWER = 0, 1, 2, 5, 6  # as :class:`Part` has them
_BELOW, _OVER, _GOES_ON, _LEAVES, _BUILDING = 9, 10, 11, 12, 14  # likewise
_LEAVES_FROM, _LEAVES_TO = classes.LOW_VEGETATION, classes.HIGH_VEGETATION  # Classes between them are vegetation.
_GRASS_M = 0.1  # Lower returns (m) are grass and the noise of the ground.
_GOES_ON_M = 1.0  # A shaft goes on where returns lie on its axis up to so far above its top (m).


@kernel
def about_shaft(returns, near, axis, heights, edges, slot_ns, number, sectors, on_it, slots):
    """Count the returns about a shaft by where they lie and what they are.

    Parameters
    ----------
    returns : x, y, height (m), class and time (ns) of all returns.
    near : (k,) int64, rows of those near the shaft.
    axis : x, y (m) at a height (m), slopes in x and y, radius (m).
    heights : of the ground (m), and of the lower and upper end of the shaft above it.
    edges : from the surface of the shaft outwards (m): what may lie on it, three rings.
    slot_ns : length of a slot of time.
    number : (16,) int64, added to: returns of each :class:`Part`.
    sectors : (s,) int64, added to: returns beside the shaft, not on it, by direction.
    on_it : (k, 3) float64, out: x and y from the axis, height above the ground of the returns on the shaft.
    slots : (2,) int64, out: slots in which the shaft was seen, and others in which something beside or above it was.
    """
    x, y, height, kind, epoch = returns
    ground, low, top = heights
    middle = 0.5 * (low + top)
    own, other, owns, others = np.empty(near.size, np.int64), np.empty(near.size, np.int64), 0, 0
    for k in range(near.size):
        i = near[k]
        past, above = height[i] - axis[2], height[i] - ground
        right, ahead = x[i] - (axis[0] + axis[3] * past), y[i] - (axis[1] + axis[4] * past)
        away = math.hypot(right, ahead) - axis[5]
        close, higher, half = away <= edges[2], above > top, 2 if above >= middle else 0
        leaf, built = _LEAVES_FROM <= kind[i] <= _LEAVES_TO, kind[i] == classes.BUILDING
        number[_BELOW] += _GRASS_M < above < low and close
        number[_OVER] += higher and close
        number[_GOES_ON] += higher and away <= edges[0] and above < top + _GOES_ON_M
        beside = low <= above <= top
        if beside and away <= edges[0]:
            on_it[owns, 0], on_it[owns, 1], on_it[owns, 2] = right, ahead, above
            own[owns] = epoch[i] // slot_ns
            owns += 1
            number[_ON_LOWER + half] += 1
            number[_LEAVES + 1] += leaf
            number[_BUILDING + 1] += built
        elif beside or higher:
            other[others] = epoch[i] // slot_ns
            others += 1
        if beside:
            number[_BESIDE] += 1
            number[_LEAVES] += leaf
            number[_BUILDING] += built
            number[_NEAR_LOWER + half] += close
            for ring in range(3):
                number[_RING_1 + ring] += edges[ring] < away <= edges[ring + 1]
            if away > edges[0]:
                turn = math.floor(math.atan2(ahead, right) / (2.0 * math.pi / sectors.size))
                sectors[int(turn) % sectors.size] += 1
    number[_ON_IT] += owns
    slots[0], slots[1] = _distinct_of_both(own[:owns], other[:others])


@inner
def _distinct_of_both(own, other):
    """Returns how many numbers occur in `own`, and how many more in `other`; both are sorted."""
    sort(own)
    sort(other)
    first, second, k = 0, 0, 0
    for i in range(own.size):
        first += i == 0 or own[i] != own[i - 1]
    for i in range(other.size):
        if i == 0 or other[i] != other[i - 1]:
            while k < own.size and own[k] < other[i]:
                k += 1
            second += k == own.size or own[k] != other[i]
    return first, second


@kernel
def fill_slices(x, y, above, corner, cell_m, slice_m, counts, cell_of):
    """Count returns into the cells of their slice, and write the flat number of each return's cell (-1: none).

    x, y : (n,) float64, places (m); above : (n,) float32, height above the ground (m), NaN where that is not known;
    corner : (x, y, height) of cell (0, 0, 0); counts : (slices, rows, columns) uint16, saturating; cell_of : (n,)
    int64.
    """
    slices, rows, columns = counts.shape
    for i in range(x.size):
        cell_of[i] = -1
        height = above[i] - corner[2]
        if not height >= 0.0:
            continue
        k = int(height / slice_m)
        u, v = (x[i] - corner[0]) / cell_m, (y[i] - corner[1]) / cell_m
        if k >= slices or u < 0.0 or v < 0.0 or u >= columns or v >= rows:
            continue
        r, c = int(v), int(u)
        if counts[k, r, c] < 65535:
            counts[k, r, c] += 1
        cell_of[i] = (k * rows + r) * columns + c


@kernel
def slices_above_one_another(row, column, level, reach, foot, masks, scores):
    """Write for each component the number of slices with a component within `reach` cells of its middle.

    It is 0 where none of the `foot` lowest slices does.
    row, column, level : (n,) int64 cell of the middle, and slice (0 … 62); masks : (rows, columns) int64, zeroed;
    scores : (n,) int64.
    """
    rows, columns = masks.shape
    for i in range(row.size):
        masks[row[i], column[i]] |= 1 << level[i]
    for i in range(row.size):
        mask = masks[row[i], column[i]]
        for r in range(max(row[i] - reach, 0), min(row[i] + reach + 1, rows)):
            for c in range(max(column[i] - reach, 0), min(column[i] + reach + 1, columns)):
                mask |= masks[r, c]
        ones = 0
        if mask & ((1 << foot) - 1) == 0:
            mask = 0
        while mask != 0:
            mask &= mask - 1
            ones += 1
        scores[i] = ones


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
            sort(buffer[:held])
            width, k = _width(buffer[:held]), found
            while k > 0 and widths[k - 1] > width:
                widths[k], weights[k] = widths[k - 1], weights[k - 1]
                k -= 1
            widths[k], weights[k] = width, held
            found += 1
        first = last
    if found == 0:
        held = 0
        for i in range(n):
            if kept[i] > 0.0:
                buffer[held] = across[i]
                held += 1
        sort(buffer[:held])
        widths[0], weights[0], found = _width(buffer[:held]), 1.0, 1
    total, reached, middle = 0.0, 0.0, widths[found - 1]
    for k in range(found):
        total += weights[k]
    for k in range(found):
        reached += weights[k]
        if reached >= 0.5 * total:
            middle = widths[k]
            break
    return min(max(0.5 * middle / (1.0 - 2.0 * _INNER), LEAST_RADIUS_M), MOST_RADIUS_M)


@kernel
def fit_cylinder(table, sector, lean, state, work):
    """Returns the root mean square distance from the fitted cylinder (m), and the number of returns used.

    table : (n, 5) x, y, height past the middle, and the unit vector towards the sensor, seen from above; sector : (n,)
    int64 direction of that vector, ascending; lean : the axis may lean; state : (5,) x, y, slopes of both with height,
    radius: where to begin, and what is found; work : (n, 3) working space.
    """
    n = table.shape[0]
    normal, right = np.empty((4, 4)), np.empty(4)
    a, away = np.empty(4), np.empty(n)
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
            for i in range(n):
                work[i, 2] = 1.0
            total = float(n)
        radius = radius_across(work[:, 0], work[:, 2], sector)
        state[4] = radius
        held = 0
        for i in range(n):
            across = work[i, 0]
            work[i, 1] -= math.sqrt(max(radius * radius - across * across, 0.04 * radius * radius))
            if work[i, 2] > 0.0:
                away[held] = abs(work[i, 1])
                held += 1
        scale = 1.5 * max(median(away[:held]), 0.005)
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
        largest = 0.0
        for p in range(4):
            state[p] += move[p]
            largest = max(largest, abs(move[p]))
        if largest < 1e-5 and turn > 2:
            break
    return math.sqrt(square / total), total
