"""Coarse surface: a cubic spline along each profile, sampled at even steps across the road, and a 3 × 3 median."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel

NOTHING, MEASURED, INTERPOLATED, FILLED = 0, 1, 2, 3
"""Origins of a node of the coarse model."""


@kernel
def natural_spline(x, z, first, end, bend, work):
    """Compute second derivatives `bend` of the natural cubic spline through knots `first` to `end` − 1.

    The tridiagonal system of the spline's moments (de Boor 1978, *A Practical Guide to Splines*, chapter IV), solved by
    elimination without pivoting: it is strictly diagonally dominant.

    Parameters
    ----------
    x : (k,) float64, strictly ascending; z : (k,) float64; bend : (k,) float64, out; work : (k,) float64, scratch.
    """
    bend[first] = 0.0
    bend[end - 1] = 0.0
    if end - first < 3:
        return
    work[first] = 0.0
    for i in range(first + 1, end - 1):
        left, right = x[i] - x[i - 1], x[i + 1] - x[i]
        rise = (z[i + 1] - z[i]) / right - (z[i] - z[i - 1]) / left
        pivot = 2.0 * (left + right) - left * work[i - 1]
        work[i] = right / pivot
        bend[i] = (6.0 * rise - left * bend[i - 1]) / pivot
    for i in range(end - 2, first, -1):
        bend[i] -= work[i] * bend[i + 1]


@kernel
def knots_of(across, height, classes, first_node, per_m, sums, x, z, low, high, node):
    """Find the knots of one profile: the mean of the road readings nearest to each node.

    Parameters
    ----------
    across, height : (m,) float64, m; classes : (m,) uint8, 0 the road.
    first_node : int64, number of the first node; per_m : float64, nodes a metre.
    sums : (K, 5) float64, scratch, zero on entry and on return: Σ across, Σ height, count, first and last reading.
    x, z : (K,) float64, out, knots; low, high : (K,) int32, out, their first and last reading; node : (K,) int32, out.

    Returns
    -------
    int, how many knots there are.
    """
    nodes = sums.shape[0]
    for j in range(across.size):
        if classes[j] == 0:
            k = np.int64(np.floor(across[j] * per_m + 0.5)) - first_node
            if 0 <= k < nodes:
                if sums[k, 2] == 0.0:
                    sums[k, 3] = j
                sums[k, 0] += across[j]
                sums[k, 1] += height[j]
                sums[k, 2] += 1.0
                sums[k, 4] = j
    count = 0
    for k in range(nodes):
        if sums[k, 2] > 0.0:
            x[count] = sums[k, 0] / sums[k, 2]
            z[count] = sums[k, 1] / sums[k, 2]
            low[count], high[count] = np.int32(sums[k, 3]), np.int32(sums[k, 4])
            node[count] = k
            count += 1
            sums[k, 0], sums[k, 1], sums[k, 2] = 0.0, 0.0, 0.0
    return count


@inlined
def end_level(z, first, end):
    """Returns the mean height of the knots `first` to `end` − 1."""
    total = 0.0
    for i in range(first, end):
        total += z[i]
    return total / (end - first)


@kernel
def spline_profiles(across, height, classes, every, first_node, spacing, reach, fill, surface, origin):
    """Compute heights of profiles at even steps across the road.

    Parameters
    ----------
    across, height : (n, m) float64, of the readings, m; classes : (n, m) uint8, 0 the road.
    every : int64, from one measured reading to the next (2 where a mirror measures every second one in a turn).
    first_node : int64; node k lies at (first_node + k) · spacing; spacing : float64, m.
    reach : float64, widest gap between neighbouring readings that is interpolated (m).
    fill : float64, widest hole that is filled (m).
    surface : (n, K) float64, out, m, NaN where there is nothing; origin : (n, K) uint8, out.
    """
    nodes = surface.shape[1]
    sums = np.zeros((nodes, 5))
    x, z, bend, work = np.empty(nodes), np.empty(nodes), np.empty(nodes), np.empty(nodes)
    low, high, node = np.empty(nodes, np.int32), np.empty(nodes, np.int32), np.empty(nodes, np.int32)
    surface[:, :] = np.nan
    origin[:, :] = NOTHING
    for p in range(across.shape[0]):
        count = knots_of(across[p], height[p], classes[p], first_node, 1.0 / spacing, sums, x, z, low, high, node)
        begin, before = 0, -1
        while begin < count:
            end = begin + 1
            while end < count and (
                node[end] - node[end - 1] == 1
                or (x[end] - x[end - 1] <= reach and max(low[end] - high[end - 1], low[end - 1] - high[end]) <= every)
            ):
                end += 1
            natural_spline(x, z, begin, end, bend, work)
            spline_piece(x, z, bend, node, begin, end, first_node, spacing, surface[p], origin[p])
            if before >= 0 and x[begin] - x[begin - 1] <= fill:
                a = end_level(z, max(before, begin - 3), begin)
                b = end_level(z, begin, min(begin + 3, end))
                for k in range(node[begin - 1] + 1, node[begin]):
                    share = (k - node[begin - 1]) / (node[begin] - node[begin - 1])
                    surface[p, k] = a + share * (b - a)
                    origin[p, k] = FILLED
            before = begin
            begin = end


@inner
def spline_piece(x, z, bend, node, begin, end, first_node, spacing, surface, origin):
    """Evaluate the spline of knots `begin` to `end` − 1 at the nodes from its first to its last.

    Beyond its ends, by half a step at most, a natural spline goes on as a straight line.
    """
    k, last = node[begin], node[end - 1]
    if end - begin == 1:
        surface[k] = z[begin]
    slope = 0.0
    for i in range(begin, end - 1):
        h = x[i + 1] - x[i]
        rise = (z[i + 1] - z[i]) / h
        slope = rise - h * (2.0 * bend[i] + bend[i + 1]) / 6.0
        square, cube = 0.5 * bend[i], (bend[i + 1] - bend[i]) / (6.0 * h)
        d = (first_node + k) * spacing - x[i]
        if d < 0.0:
            surface[k] = z[i] + d * slope
            k += 1
            d = (first_node + k) * spacing - x[i]
        while d <= h and k <= last:
            surface[k] = z[i] + d * (slope + d * (square + d * cube))
            k += 1
            d = (first_node + k) * spacing - x[i]
        slope = rise + h * (bend[i] + 2.0 * bend[i + 1]) / 6.0
    if k == last and end - begin > 1:
        surface[k] = z[end - 1] + ((first_node + k) * spacing - x[end - 1]) * slope
    for k in range(node[begin], last + 1):
        origin[k] = INTERPOLATED
    for i in range(begin, end):
        origin[node[i]] = MEASURED


@inner
def median_of_rows(above, here, below, out):
    """Compute medians of 3 × 3 neighbourhoods (K − 2,) of three rows (K,) where all nine are present.

    Columns are sorted first; the median of nine is that of the largest lowest, the middle middle and the smallest
    highest (Smith 1996, *Implementing median filters in XC4000E FPGAs*).
    """
    for k in range(out.size):
        a0, a1, a2 = above[k], here[k], below[k]
        b0, b1, b2 = above[k + 1], here[k + 1], below[k + 1]
        c0, c1, c2 = above[k + 2], here[k + 2], below[k + 2]
        a0, a1 = min(a0, a1), max(a0, a1)
        a1, a2 = min(a1, a2), max(a1, a2)
        a0, a1 = min(a0, a1), max(a0, a1)
        b0, b1 = min(b0, b1), max(b0, b1)
        b1, b2 = min(b1, b2), max(b1, b2)
        b0, b1 = min(b0, b1), max(b0, b1)
        c0, c1 = min(c0, c1), max(c0, c1)
        c1, c2 = min(c1, c2), max(c1, c2)
        c0, c1 = min(c0, c1), max(c0, c1)
        low = max(a0, b0, c0)
        high = min(a2, b2, c2)
        middle = max(min(a1, b1), min(max(a1, b1), c1))
        out[k] = max(min(low, middle), min(max(low, middle), high))


@inner
def median_of_some(surface, p, k, some):
    """Returns the median of those of the 3 × 3 nodes around (p, k) that exist; of an even number the mean of two.

    some : (9,) float64, scratch.
    """
    count = 0
    for i in range(max(p - 1, 0), min(p + 2, surface.shape[0])):
        for j in range(max(k - 1, 0), min(k + 2, surface.shape[1])):
            value = surface[i, j]
            if not np.isnan(value):
                at = count
                while at > 0 and some[at - 1] > value:
                    some[at] = some[at - 1]
                    at -= 1
                some[at] = value
                count += 1
    return 0.5 * (some[(count - 1) // 2] + some[count // 2])


@kernel
def median_filter(surface, out):
    """Apply a 3 × 3 median to a surface (n, K); NaN stays NaN and does not count in other medians."""
    n, nodes = surface.shape
    some, quick = np.empty(9), np.empty(nodes)
    gaps = np.zeros(nodes + 2, np.int32)
    for p in range(n):
        whole = 0 < p < n - 1 and nodes > 2
        if whole:
            median_of_rows(surface[p - 1], surface[p], surface[p + 1], quick[1 : nodes - 1])
            count_gaps(surface[p - 1], surface[p], surface[p + 1], gaps[1 : nodes + 1])
        for k in range(nodes):
            if np.isnan(surface[p, k]):
                out[p, k] = np.nan
            elif whole and 0 < k < nodes - 1 and gaps[k] + gaps[k + 1] + gaps[k + 2] == 0:
                out[p, k] = quick[k]
            else:
                out[p, k] = median_of_some(surface, p, k, some)


@inner
def count_gaps(above, here, below, gaps):
    """Count the missing ones of the three nodes of each column (K,)."""
    for k in range(gaps.size):
        gaps[k] = np.isnan(above[k]) + np.isnan(here[k]) + np.isnan(below[k])


PATCH_SUMS = 10
"""Sums of a patch: count, Σx, Σy, Σz, Σxx, Σxy, Σyy, Σxz, Σyz, Σzz; x along, y across, z height."""


@kernel
def sum_patches(along, surface, first_node, spacing, patch, nodes_a_patch, first_row, first_column, sums):
    """Add the nodes of a surface to the sums of square patches of the street.

    Parameters
    ----------
    along : (n,) float64, of the profiles, m; surface : (n, K) float64, m, NaN where there is nothing.
    patch : float64, edge (m); nodes_a_patch : int64, steps of `spacing` in it.
    first_row, first_column : int64, numbers of the first patch; sums : (rows, columns, 10) float64, in/out.
    """
    nodes = surface.shape[1]
    for p in range(surface.shape[0]):
        x = along[p]
        row = np.int64(np.floor(x / patch)) - first_row
        k = 0
        while k < nodes:
            column = (first_node + k) // nodes_a_patch
            end = min((column + 1) * nodes_a_patch - first_node, nodes)
            n, sy, sz, syy, syz, szz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(k, end):
                z = surface[p, i]
                w = 0.0 if np.isnan(z) else 1.0
                z = 0.0 if np.isnan(z) else z
                y = w * (first_node + i) * spacing
                n += w
                sy += y
                sz += z
                syy += y * y
                syz += y * z
                szz += z * z
            one = sums[row, column - first_column]
            one[0] += n
            one[1] += n * x
            one[2] += sy
            one[3] += sz
            one[4] += n * x * x
            one[5] += x * sy
            one[6] += syy
            one[7] += x * sz
            one[8] += syz
            one[9] += szz
            k = end
