"""Faint cracks, too shallow to show in single cells: candidates from three lines end to end, then fits of a strip."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel

HALF_LENGTH = 10
"""Rows (or columns) of cells to each side to which a strip is fitted."""
HALF_BREADTH = 3
"""Cells to each side of a strip's axis to which it is fitted."""
HALF_DRAWN = 8
"""Rows (or columns) to each side over which a strip is drawn."""
SLOPES, SLOPE_STEP = 15, 0.05
"""Number of slopes tried about that of the candidate, and their step (cells across per cell along)."""
STEEPEST = 1.0 + SLOPE_STEP * (SLOPES // 2)  # Steepest slope of a strip (cells across per cell along).
HALF_CUT = 26
"""Cells across that the steepest strip needs: 1.35 · 10, its axis up to 4 aside, and 8 beside that."""
NEXT_FROM, NEXT_TO, NEXT_ASIDE = 11, 18, 24
"""Cells along a strip between which another continues it, and how far aside of its peak that may lie."""
FIELDS = 8
"""Fields of a strip: significance (σ), down (1) or along (0) the columns, slope, axis, width (cells), volume, level
(σ), and the sum of squared shares that determine the volume."""
LAGS = 3  # Greatest lag (cells) of the products that measure correlated noise.
ASIDE_FROM, ASIDE_TO = 4, 8
"""Distances (cells) from the axis between which the noise is measured."""


@inlined
def larger(a, b):
    """Returns the larger one."""
    return a if a > b else b


@inner
def depth_row(ground, median, count, least, scale, absent, depth):
    """Compute the depth of each median of a line below the ground, times `scale`; 0 of too few heights. All (n,)."""
    for j in range(depth.size):
        sound = (count[j] >= least) & (ground[j] < absent)
        depth[j] = np.float32((ground[j] - median[j]) * scale) if sound else np.float32(0.0)


@kernel
def line_depths(ground, median, count, least, scale, absent, margin, depth):
    """Apply :func:`depth_row` to a grid; (rows, columns), `depth` float32 with an untouched margin."""
    rows, n = ground.shape
    for i in range(rows):
        depth_row(ground[i], median[i], count[i], least, scale, absent, depth[i + margin, margin : margin + n])


@inner
def chain_row(middle, a, b, c, d, e, f, direction, best, best_direction):
    """Add to a line's depth the deepest of three before it and of three behind it; store it if it is the largest."""
    for j in range(best.size):
        depth = (middle[j] + larger(larger(a[j], b[j]), c[j])) + larger(larger(d[j], e[j]), f[j])
        better = depth > best[j]
        best[j] = depth if better else best[j]
        best_direction[j] = direction if better else best_direction[j]


@inlined
def moved(depth, margin, down, right, i, n):
    """Returns row i, shifted by so many cells."""
    return depth[i + margin + down, margin + right : margin + right + n]


@kernel
def chain_lines(depth, margin, down, right, aside_down, aside_right, direction, best, best_direction):
    """Chain three lines of one direction end to end, the outer two up to a cell aside.

    Parameters
    ----------
    depth : (rows + 2 margin, columns + 2 margin) float32, of the line about each cell.
    down, right : from the middle of a line to the middle of the next; aside_down, aside_right : one cell across it.
    best, best_direction : (rows, columns) float32 and uint8, in/out, the deepest chain so far.
    """
    rows, n = best.shape
    for i in range(rows):
        chain_row(
            moved(depth, margin, 0, 0, i, n),
            moved(depth, margin, down - aside_down, right - aside_right, i, n),
            moved(depth, margin, down, right, i, n),
            moved(depth, margin, down + aside_down, right + aside_right, i, n),
            moved(depth, margin, -down - aside_down, -right - aside_right, i, n),
            moved(depth, margin, -down, -right, i, n),
            moved(depth, margin, -down + aside_down, -right + aside_right, i, n),
            direction,
            best[i],
            best_direction[i],
        )


@inlined
def is_peak(chain, contrast, strongest, i, j):
    """Returns whether a cell has the deepest chain of 5 × 5, of equal ones the first, and nothing strong in 7 × 7."""
    if contrast[i, j] > strongest:
        return False
    own = chain[i, j]
    for a in range(-2, 3):
        for b in range(-2, 3):
            other = chain[i + a, j + b]
            if other > own or (other == own and (a < 0 or (a == 0 and b < 0))):
                return False
    for a in range(-3, 4):
        for b in range(-3, 4):
            if contrast[i + a, j + b] > strongest:
                return False
    return True


@kernel
def mark_peaks(row, column, chain, contrast, strongest, peak):
    """Mark the candidates that are peaks; see :func:`is_peak`.

    row, column : (n,) int64; chain, contrast : (rows + 6, columns + 6) float32, three cells more at each end;
    peak : (n,) bool, out.
    """
    for t in range(row.size):
        peak[t] = is_peak(chain, contrast, strongest, row[t] + 3, column[t] + 3)


@inlined
def covered(away, width):
    """Returns the share of a strip's width that lies in a cell `away` from its axis (cells)."""
    low, high = max(-0.5, away - 0.5 * width), min(0.5, away + 0.5 * width)
    return max(high - low, 0.0) / width


@inlined
def cell_at(row, column, along, across, steep):
    """Returns the cell so far along a strip and across it."""
    return (row + along, column + across) if steep else (row + across, column + along)


@inlined
def cut_out(values, row, column, steep, slope, half, absent, height, there):
    """Copy the cells that strips about a peak may use, so that they run down; absent ones are 0 and not `there`.

    half : cells to each side of the first slope's line.
    """
    for along in range(-HALF_LENGTH, HALF_LENGTH + 1):
        centre = int(np.floor(slope * along))
        for across in range(max(centre - half, -HALF_CUT), min(centre + half + 1, HALF_CUT) + 1):
            i, j = cell_at(row, column, along, across, steep)
            value = values[i, j]
            counts = value < absent
            height[along + HALF_LENGTH, across + HALF_CUT] = value if counts else np.float32(0.0)
            there[along + HALF_LENGTH, across + HALF_CUT] = np.float32(1.0) if counts else np.float32(0.0)


@inlined
def best_axis(height, slope, total):
    """Returns slope and axis of the lowest line, one or two cells wide, and its depth (σ of its mean).

    Missing cells count as level ground.

    height : (2 HALF_LENGTH + 1, 2 HALF_CUT + 1); total : (2 HALF_BREADTH + 1,) float32, scratch.
    """
    best, best_slope, axis = np.float32(0.0), slope, 0.0
    half = np.float32(np.sqrt(0.5))
    for k in range(SLOPES):
        tried = slope + SLOPE_STEP * (k - SLOPES // 2)
        total[:] = 0.0
        for along in range(2 * HALF_LENGTH + 1):
            first = HALF_CUT - HALF_BREADTH + int(np.floor(tried * (along - HALF_LENGTH) + 0.5))
            for across in range(2 * HALF_BREADTH + 1):
                total[across] -= height[along, first + across]
        for across in range(2 * HALF_BREADTH + 1):
            if total[across] > best:
                best, best_slope, axis = total[across], tried, float(across - HALF_BREADTH)
            if across > 0:
                two = half * (total[across] + total[across - 1])
                if two > best:
                    best, best_slope, axis = two, tried, across - HALF_BREADTH - 0.5
    return best / np.sqrt(2 * HALF_LENGTH + 1), best_slope, axis


@inlined
def fit_strip(height, there, slope, axis, width):
    """Returns volume, level and gain of a strip of given axis and width, by least squares.

    Heights (σ) are level − volume · share of the strip in the cell. Gain² is the reduction of the sum of squares.
    """
    n, k, kk, r, kr = 0.0, 0.0, 0.0, 0.0, 0.0
    for along in range(2 * HALF_LENGTH + 1):
        centre = axis + slope * (along - HALF_LENGTH)
        nearest = int(np.floor(centre + 0.5))
        for across in range(nearest - HALF_BREADTH, nearest + HALF_BREADTH + 1):
            value, weight = height[along, HALF_CUT + across], there[along, HALF_CUT + across]
            share = covered(centre - across, width) * weight
            n += weight
            k += share
            kk += share * share
            r += value
            kr += share * value
    spread = kk - k * k / n if n > 0.0 else 0.0
    sound = spread > 0.0
    volume = (k * r / n - kr) / spread if sound else 0.0
    return volume, (r + volume * k) / n if sound else 0.0, volume * np.sqrt(spread) if sound else 0.0


@inlined
def try_axes(height, there, slope, axis, quarters, width, strip):
    """Store the best of three slopes and of axes up to so many quarters of a cell aside, if it gains more."""
    for a in range(-1, 2):
        tried = min(max(slope + SLOPE_STEP * a, -STEEPEST), STEEPEST)
        for b in range(-quarters, quarters + 1):
            volume, level, gain = fit_strip(height, there, tried, axis + 0.25 * b, width)
            if gain > strip[0]:
                strip[0], strip[2], strip[3] = gain, tried, axis + 0.25 * b
                strip[4], strip[5], strip[6] = width, volume, level


@inlined
def variance_of_lines(height, there, slope, axis):
    """Returns the variance of the mean of two lines beside a strip, relative to that of independent cells of σ = 1.

    From products of cells up to LAGS apart along the line and one across, on both sides of the strip.
    """
    total = 0.0
    for lag in range(LAGS + 1):
        for aside in range(-1, 2):
            if lag == 0 and aside < 0:
                continue
            product, n = 0.0, 0.0
            for along in range(2 * HALF_LENGTH + 1 - lag):
                centre = axis + slope * (along - HALF_LENGTH)
                first = HALF_CUT + int(np.floor(centre + 0.5))
                second = HALF_CUT + int(np.floor(centre + slope * lag + 0.5)) + aside
                for across in range(ASIDE_FROM, ASIDE_TO):
                    a, b = height[along, first - across], height[along + lag, second - across]
                    c, d = height[along, first + across], height[along + lag, second + across]
                    product += a * b + c * d
                    n += there[along, first - across] * there[along + lag, second - across]
                    n += there[along, first + across] * there[along + lag, second + across]
            weight = 1.0 if lag == 0 or aside != 0 else 2.0
            total += weight * product / n if n > 0.0 else 0.0
    return total


@kernel
def fit_strips(values, margin, row, column, steep, slope, widths, least, noted, allowed, absent, strips):
    """Fit a strip about each peak.

    Slope and axis are those that gain most with the first width; then the width, and slope and axis once more.

    Parameters
    ----------
    values : (rows + 2 margin, columns + 2 margin) float32, heights above the ground (σ), `absent` where none counts.
    row, column : (n,) int64, the peaks; steep : (n,) bool, whether their lines run rather down the columns; slope :
        (n,) cells across for each along. widths : (m,) cells, tried. least : axes less low are not fitted (σ).
    noted, allowed : a strip of that significance has it lessened where the noise beside it is not independent, its
        lines of more than the allowed variance.
    strips : (n, FIELDS) float64, out; gain 0 where there is none.
    """
    height = np.zeros((2 * HALF_LENGTH + 1, 2 * HALF_CUT + 1), np.float32)
    there = np.zeros((2 * HALF_LENGTH + 1, 2 * HALF_CUT + 1), np.float32)
    total = np.empty(2 * HALF_BREADTH + 1, np.float32)
    for t in range(row.size):
        strips[t, :] = 0.0
        cut_out(values, row[t] + margin, column[t] + margin, steep[t], slope[t], 12, absent, height, there)
        low, first_slope, first_axis = best_axis(height, slope[t], total)
        if low < least:
            continue
        strips[t, 1] = 1.0 if steep[t] else 0.0
        try_axes(height, there, first_slope, first_axis, 3, widths[0], strips[t])
        for c in range(1, widths.size):
            volume, level, gain = fit_strip(height, there, strips[t, 2], strips[t, 3], widths[c])
            if gain > strips[t, 0]:
                strips[t, 0], strips[t, 4], strips[t, 5], strips[t, 6] = gain, widths[c], volume, level
        if strips[t, 4] != widths[0]:
            try_axes(height, there, strips[t, 2], strips[t, 3], 1, strips[t, 4], strips[t])
        strips[t, 7] = (strips[t, 0] / strips[t, 5]) ** 2 if strips[t, 0] > 0.0 else 0.0
        if strips[t, 0] >= noted:
            cut_out(values, row[t] + margin, column[t] + margin, steep[t], slope[t], 18, absent, height, there)
            variance = variance_of_lines(height, there, strips[t, 2], strips[t, 3])
            strips[t, 0] /= np.sqrt(max(1.0, variance / allowed))


@inlined
def goes_on(row, column, strips, t, number):
    """Returns whether another strip's axis lies within two cells of the axis of strip t, before or behind it."""
    steep, slope, axis = strips[t, 1] > 0.5, strips[t, 2], strips[t, 3]
    for distance in range(NEXT_FROM, NEXT_TO + 1):
        for side in range(-1, 2, 2):
            along = side * distance
            centre = int(np.floor(axis + slope * along))
            for across in range(max(centre - 6, -NEXT_ASIDE), min(centre + 7, NEXT_ASIDE) + 1):
                i, j = cell_at(row[t] + NEXT_ASIDE, column[t] + NEXT_ASIDE, along, across, steep)
                other = number[i, j]
                if other >= 0:
                    same = (strips[other, 1] > 0.5) == steep
                    aside = across + (strips[other, 3] if same else 0.0) - axis - slope * along
                    turned = abs(strips[other, 2] - slope) if same else 0.0
                    if abs(aside) <= 2.0 and turned < 0.35:
                        return True
    return False


@kernel
def confirm_strips(row, column, strips, number, alone, confirmed):
    """Mark the strips that gain `alone`, and those that another one continues.

    number : (rows + 2 NEXT_ASIDE, columns + 2 NEXT_ASIDE) int32, which strip that may confirm another has its peak
    there, −1 for none; confirmed : (n,) bool, out. Others as of :func:`fit_strips`.
    """
    for t in range(row.size):
        if strips[t, 0] >= alone:
            confirmed[t] = True
        else:
            named = number[row[t] + NEXT_ASIDE, column[t] + NEXT_ASIDE] == t
            confirmed[t] = named and goes_on(row, column, strips, t, number)


@kernel
def draw_strips(row, column, strips, confirmed, gain, level, share):
    """Draw the confirmed strips; where two overlap the one that gains more.

    gain, level, share : (rows, columns) float32, in/out: gain (0 where none), height above the ground (σ), and the
    share of a cell in its height.
    """
    rows, columns = gain.shape
    for t in range(row.size):
        won, steep, slope, axis = strips[t, 0], strips[t, 1] > 0.5, strips[t, 2], strips[t, 3]
        width, volume, ground = strips[t, 4], strips[t, 5], strips[t, 6]
        if not confirmed[t]:
            continue
        spread = strips[t, 7]
        for along in range(-HALF_DRAWN, HALF_DRAWN + 1):
            centre = axis + slope * along
            nearest = int(np.floor(centre + 0.5))
            for across in range(nearest - 2, nearest + 3):
                i, j = cell_at(row[t], column[t], along, across, steep)
                part = covered(centre - across, width)
                if part > 0.01 and 0 <= i < rows and 0 <= j < columns and np.float32(won) > gain[i, j]:
                    gain[i, j] = won
                    level[i, j] = ground - volume * part
                    share[i, j] = part * part / spread + 1.0 / (7 * (2 * HALF_LENGTH + 1))
