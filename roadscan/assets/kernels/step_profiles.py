"""Profiles across an edge: the step at each node, and transects outward over the surface beside it."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel

BIN_M = 0.01  # Width of a bin (m).
QUARTERS = 4
"""Parts of a window along the edge, of which COVERED is the share that was seen on both sides."""
NEAR_M = 0.35  # Heights this near to the node (m) count for COVERED.
HALF_BINS = 120
"""A profile reaches this many bins to each side."""
TIE = 1e-6
"""Rests that differ by less than this share are equal: rounding alone, which differs from scene to scene, would choose
among the places of a step that lies where nothing was seen."""
RESULTS = 11  # Number of columns.
OFFSET, STEP, SIGMA_STEP, FACE, TOP, SCATTER, RETURNS, SEEN_LOW, SEEN_HIGH, SIGMA_OFFSET, COVERED = range(RESULTS)
"""Columns of what :func:`fit_nodes` fills, all in metres except the number of returns."""


@kernel
def fit_nodes(node, x_m, y_m, z_m, starts, bins, along_m, search, prior, out):
    """Fill `out` (n, RESULTS) with the step at each node; SIGMA_STEP is NaN where it is not measurable.

    node : (n, 7) x, y (m), unit vector along the edge (higher side to its right), height (m) and the ground's slope at
    large along and across it (to the right). x_m, y_m, z_m : (m,) heights of the ground, sorted by bin. starts : the
    first of each bin. bins : (x_min_m, y_min_m, size_m, rows, columns). along_m : half the length of the window along
    the edge. search : (farthest offset (m), least and greatest face (m), depth of a side (m)). prior : (σ of a side's
    slope (m/m), σ of a height (m)). OFFSET : from the node to the upper edge, to the right. SCATTER : of strips of 0.1
    m about their side's line. SEEN_LOW : share of strips of 0.1 m with heights on the lower side, up to the farthest of
    at most 1.2 m; 0 of fewer than four. SEEN_HIGH : width with heights on the higher side, of at most 1.2 m. COVERED :
    share of the window along the edge with heights near it on both sides.
    """
    columns = int(bins[4])
    profile, near = np.empty((4, 2 * HALF_BINS)), np.empty((2, QUARTERS))
    sums, lines = np.empty((6, 2 * HALF_BINS + 1)), np.empty((7, 2 * HALF_BINS + 1))
    reach = np.sqrt(along_m * along_m + (BIN_M * HALF_BINS) ** 2)
    # Greatest distance of a bin's heights from its middle.
    corner = 0.708 * bins[2]
    for i in range(node.shape[0]):
        profile[:] = 0.0
        near[:] = 0.0
        out[i] = 0.0
        out[i, SIGMA_STEP] = np.nan
        c_low = max(int((node[i, 0] - reach - bins[0]) / bins[2]), 0)
        c_high = min(int((node[i, 0] + reach - bins[0]) / bins[2]), columns - 1)
        r_low = max(int((node[i, 1] - reach - bins[1]) / bins[2]), 0)
        r_high = min(int((node[i, 1] + reach - bins[1]) / bins[2]), int(bins[3]) - 1)
        ux, uy = node[i, 2], node[i, 3]
        for r in range(r_low, r_high + 1):
            for c in range(c_low, c_high + 1):
                ex = bins[0] + (c + 0.5) * bins[2] - node[i, 0]
                ey = bins[1] + (r + 0.5) * bins[2] - node[i, 1]
                if abs(ex * ux + ey * uy) > along_m + corner or abs(ex * uy - ey * ux) > BIN_M * HALF_BINS + corner:
                    continue
                for j in range(starts[r * columns + c], starts[r * columns + c + 1]):
                    ex, ey = x_m[j] - node[i, 0], y_m[j] - node[i, 1]
                    t, d = ex * ux + ey * uy, ex * uy - ey * ux
                    b = int(np.floor(d / BIN_M)) + HALF_BINS
                    if abs(t) <= along_m and 0 <= b < 2 * HALF_BINS:
                        z = z_m[j] - node[i, 4] - t * node[i, 5]
                        profile[0, b] += 1.0
                        profile[1, b] += d
                        profile[2, b] += z
                        profile[3, b] += z * z
                        if abs(d) <= NEAR_M:
                            near[0 if d < 0.0 else 1, min(int((t / along_m + 1.0) * 0.5 * QUARTERS), QUARTERS - 1)] = (
                                1.0
                            )
        accumulate(profile, sums)
        search_step(profile, sums, lines, search, prior, node[i, 6], out[i])
        out[i, COVERED] = np.sum(near[0] * near[1]) / QUARTERS


@inlined
def accumulate(profile, sums):
    """Compute running sums over bins of 1, d, d², z, d z and z²."""
    sums[:, 0] = 0.0
    for b in range(2 * HALF_BINS):
        n = profile[0, b]
        d = profile[1, b] / n if n > 0.0 else 0.0
        sums[0, b + 1] = sums[0, b] + n
        sums[1, b + 1] = sums[1, b] + n * d
        sums[2, b + 1] = sums[2, b] + n * d * d
        sums[3, b + 1] = sums[3, b] + profile[2, b]
        sums[4, b + 1] = sums[4, b] + d * profile[2, b]
        sums[5, b + 1] = sums[5, b] + profile[3, b]


@inlined
def line_between(sums, a, b, at_m, slope, precision):
    """Line through bins a to b: its height at `at_m`, its slope, its χ (m²), returns, and share of variance."""
    n = sums[0, b] - sums[0, a]
    if n < 4.0:
        return 0.0, 0.0, np.inf, n, np.inf
    d1, d2 = sums[1, b] - sums[1, a], sums[2, b] - sums[2, a]
    z1, zd, z2 = sums[3, b] - sums[3, a], sums[4, b] - sums[4, a], sums[5, b] - sums[5, a]
    s1, s2 = d1 - n * at_m, d2 - 2.0 * at_m * d1 + n * at_m * at_m + precision
    t1 = zd - at_m * z1 + precision * slope
    determinant = n * s2 - s1 * s1
    level = (s2 * z1 - s1 * t1) / determinant
    found = (n * t1 - s1 * z1) / determinant
    rest = max(z2 + precision * slope * slope - level * z1 - found * t1, 0.0)
    return level, found, rest, n, s2 / determinant


@inlined
def side_lines(profile, sums, ends, bounds, slope, precision, lines):
    """Fill `lines` with the lines of both sides at each bin where a face may begin or end.

    ends : first and last bin of the lower and the higher side. bounds : first and last bin that is asked for. lines :
    height, rest and returns of the lower side's line, then those of the higher side's, then the mean place of the bin's
    heights (bins).
    """
    for b in range(bounds[0], bounds[1] + 1):
        at = (b - HALF_BINS) * BIN_M
        low, _, rest_low, n_low, _ = line_between(sums, ends[0], b, at, slope, precision)
        high, _, rest_high, n_high, _ = line_between(sums, b, ends[1], at, slope, precision)
        lines[0, b], lines[1, b], lines[2, b] = low, rest_low, n_low
        lines[3, b], lines[4, b], lines[5, b] = high, rest_high, n_high
        n = profile[0, b]
        lines[6, b] = profile[1, b] / n / BIN_M + HALF_BINS if n > 0.0 else 0.0


@inlined
def search_step(profile, sums, lines, search, prior, slope, out):
    """Find offset and face of least rest, and fill a row of results; all candidates are compared over the same bins.

    Of neighbouring offsets with equal rests the middle one is taken.
    """
    precision = (prior[1] / prior[0]) ** 2
    farthest, narrow, wide = int(search[0] / BIN_M), int(search[1] / BIN_M), int(search[2] / BIN_M)
    first, last = HALF_BINS - farthest - int(search[3] / BIN_M), HALF_BINS + farthest + int(search[3] / BIN_M)
    bounds = (HALF_BINS - farthest - wide // 2, HALF_BINS + farthest + wide - wide // 2)
    side_lines(profile, sums, (first, last), bounds, slope, precision, lines)
    best, width, least, most = np.inf, -1, 0, 0
    for face in range(narrow, wide + 1, 2):
        # A wider face must explain more than chance would.
        doubt = 1.0 + 0.002 * (face - narrow)
        for e in range(-farthest, farthest + 1):
            begin = HALF_BINS + e - face // 2
            end = begin + face
            low, high = lines[0, begin], lines[3, end]
            if lines[2, begin] < 4.0 or lines[5, end] < 4.0 or high < low:
                continue
            rest = lines[1, begin] + lines[4, end]
            for k in range(begin, end):
                # It only grows.
                if rest * doubt > best * (1.0 + TIE):
                    break
                n = profile[0, k]
                if n > 0.0:
                    z = low + (lines[6, k] - begin) / face * (high - low)
                    rest += max(profile[3, k] - 2.0 * z * profile[2, k] + n * z * z, 0.0)
            rest *= doubt
            if rest < best * (1.0 - TIE):
                best, width, least, most = rest, face, e, e
            elif rest <= best * (1.0 + TIE) and face == width and e == most + 1:
                most = e
    if width < 0:
        return
    a = HALF_BINS + (least + most) // 2 - width // 2
    b = a + width
    low, slope_low, rest_low, n_low, var_low = line_between(sums, first, a, (a - HALF_BINS) * BIN_M, slope, precision)
    high, slope_high, rest_high, n_high, var_high = line_between(
        sums, b, last, (b - HALF_BINS) * BIN_M, slope, precision
    )
    noise = np.sqrt((rest_low + rest_high) / max(n_low + n_high - 4.0, 1.0))
    out[STEP] = high - low
    out[SIGMA_STEP] = np.sqrt((var_low + var_high) * noise * noise)
    out[OFFSET] = (b - HALF_BINS) * BIN_M
    out[FACE] = (b - a) * BIN_M
    out[TOP] = high
    out[RETURNS] = n_low + n_high
    scatter(profile, a, b, low, slope_low, high, slope_high, out)
    # A shift of the edge changes the rest by the returns in its way; it is known to where that is the noise's.
    near = max((sums[0, min(b + 10, 2 * HALF_BINS)] - sums[0, max(a - 10, 0)]) / (20.0 + b - a), 0.2)
    out[SIGMA_OFFSET] = min(BIN_M * (1.0 + 2.0 * noise * noise / max(near * (high - low) ** 2, 1e-9)), 0.3)


@inlined
def scatter(profile, a, b, low, slope_low, high, slope_high, out):
    """Fill SCATTER, SEEN_LOW and SEEN_HIGH from strips of 0.1 m beyond both ends of the face."""
    total, strips = 0.0, 0
    for side in range(2):
        seen, last = 0, 0
        for j in range(12):
            n, rest = 0.0, 0.0
            for k in range(10):
                at = a - 1 - 10 * j - k if side == 0 else b + 10 * j + k
                if 0 <= at < 2 * HALF_BINS and profile[0, at] > 0.0:
                    d = profile[1, at] / profile[0, at]
                    level = low + slope_low * (d - (a - HALF_BINS) * BIN_M)
                    if side == 1:
                        level = high + slope_high * (d - (b - HALF_BINS) * BIN_M)
                    n += profile[0, at]
                    rest += profile[2, at] - profile[0, at] * level
            if n > 0.0:
                seen += 1
                last = j + 1
                # Farther strips may bend away.
                total += min(abs(rest / n), 0.1) / (1.0 + 0.15 * j)
                strips += 1
        if side == 0:
            out[SEEN_LOW] = seen / last if seen >= 4 else 0.0
        else:
            out[SEEN_HIGH] = 0.1 * seen
    out[SCATTER] = total / max(strips, 1)


TRANSECT_RESULTS = 5  # Number of columns.
WIDTH, END, OUTER_HEIGHT, SLOPE, MIDDLE_HEIGHT = range(TRANSECT_RESULTS)
UNSEEN, OBSTACLE, STEP_DOWN, STEP_UP, BENT, FAR = range(6)
"""Ends of a transect: nothing known, an object, an edge down or up, a bend or a rough place, none."""


@kernel
def walk(node, height_m, rough_m, blocked, edge_x, edge_y, grid, limits, out):
    """Fill `out` (n, TRANSECT_RESULTS): width (m), its end, height at the end (m), slope outward, height in the middle.

    node : (n, 4) x, y (m) and the unit vector outward. height_m, rough_m : (rows, columns) smooth height, NaN where
    nothing is known near, and roughness (m). blocked : cells where something stands. edge_x, edge_y : unit vector to
    the higher side of an edge in the cell, 0 where there is none. grid : (x_min_m, y_min_m, cell_m). limits : (first
    and last distance (m), hole (m), greatest slope (m/m), greatest roughness (m)).
    """
    rows, columns = height_m.shape
    step = grid[2]
    count = int(limits[1] / step)
    levels = np.empty(count + 1)
    for i in range(node.shape[0]):
        known_at, end, hole = 0.0, float(FAR), 0.0
        n, s1, s2, z1, zs = 0.0, 0.0, 0.0, 0.0, 0.0
        levels[:] = np.nan
        for k in range(1, count + 1):
            t = limits[0] + (k - 1) * step
            if t > limits[1]:
                break
            c = int(np.floor((node[i, 0] + t * node[i, 2] - grid[0]) / step))
            r = int(np.floor((node[i, 1] + t * node[i, 3] - grid[1]) / step))
            if not (0 <= c < columns and 0 <= r < rows):
                end = UNSEEN
                break
            if blocked[r, c]:
                end = OBSTACLE
                break
            if t > limits[0] + 0.15 and (edge_x[r, c] != 0.0 or edge_y[r, c] != 0.0):
                outward = edge_x[r, c] * node[i, 2] + edge_y[r, c] * node[i, 3]
                if outward < -0.5:
                    end, known_at = STEP_DOWN, t
                    break
                if outward > 0.5:
                    end, known_at = STEP_UP, t
                    break
            z = height_m[r, c]
            if np.isnan(z):
                hole += step
                if hole > limits[2]:
                    end = UNSEEN
                    break
                continue
            hole = 0.0
            levels[k] = z
            before = levels[k - 5] if k > 5 else np.nan
            if rough_m[r, c] > limits[4] or abs(z - before) > limits[3] * 5.0 * step:
                end = BENT
                # Smooth heights bend before the edge.
                for m in range(1, 6):
                    ahead = t + m * step
                    c = int(np.floor((node[i, 0] + ahead * node[i, 2] - grid[0]) / step))
                    r = int(np.floor((node[i, 1] + ahead * node[i, 3] - grid[1]) / step))
                    if 0 <= c < columns and 0 <= r < rows:
                        outward = edge_x[r, c] * node[i, 2] + edge_y[r, c] * node[i, 3]
                        if abs(outward) > 0.5:
                            end, known_at = STEP_DOWN if outward < 0.0 else STEP_UP, ahead
                            break
                break
            known_at = t
            n += 1.0
            s1 += t
            s2 += t * t
            z1 += z
            zs += z * t
        spread = n * s2 - s1 * s1
        slope = (n * zs - s1 * z1) / spread if n >= 3.0 and spread > 0.0 else np.nan
        mean = z1 / n if n > 0.0 else np.nan
        out[i, WIDTH], out[i, END], out[i, SLOPE] = known_at, end, slope
        out[i, OUTER_HEIGHT] = mean + slope * (known_at - s1 / n) if n >= 3.0 else mean
        out[i, MIDDLE_HEIGHT] = mean
