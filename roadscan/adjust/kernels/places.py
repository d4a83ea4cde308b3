"""Kernels of places of overlap and of the patches there.

Meetings of the swaths of tracks: for each lead sample of a track, the other visits of the road beside it. Readings near
a place as cells in the axes of the road, and moments of points about the plane of their group. Two images of one place
shifted against each other: their correlation, and their difference when aligned.

Pictures are arrays (rows, columns) with NaN where nothing was seen. A cell (r, c) of the first lies at (r + dr, c + dc)
of the second.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare, inlined, kernel
from roadscan.compute.kernels.arrays import catmull_rom, sampled

SLACK_M = 0.25
"""Overlap of segments beyond their ends (m): in a bend the strips beside two of them leave a wedge."""


class Samples(NamedTuple):
    """Evenly spaced samples of all tracks, one track after another."""

    easting_m: npt.NDArray[np.float64]
    """(n,) map."""
    northing_m: npt.NDArray[np.float64]
    height_m: npt.NDArray[np.float64]
    heading_rad: npt.NDArray[np.float64]
    """(n,) clockwise from grid north."""
    since_s: npt.NDArray[np.float64]
    """(n,) time since an epoch common to all tracks."""
    left_m: npt.NDArray[np.float64]
    """(n,) reach to the left; negative where a sensor sees only the right."""
    right_m: npt.NDArray[np.float64]
    track: npt.NDArray[np.int32]
    """(n,) number of the track."""
    joined: npt.NDArray[np.bool_]
    """(n,) whether the track continues to the next sample."""


class Bins(NamedTuple):
    """Samples sorted into square bins."""

    order: npt.NDArray[np.int64]
    """(n,) samples by bin, ascending within each."""
    key: npt.NDArray[np.int64]
    """(n,) bin of each, ascending."""
    edge_m: float
    rows: int
    """Bins along northing; the key is column · rows + row."""
    easting_m: float
    """West edge of column 0."""
    northing_m: float


class Limits(NamedTuple):
    """Criteria of a visit."""

    return_s: float
    """A track that returns within this time does not count as another visit."""
    height_apart_m: float
    """Tracks farther apart in height lie on different levels of a junction."""


class Visits(NamedTuple):
    """Visits of the cross-lines of lead samples, written by `visits`."""

    lead: npt.NDArray[np.int64]
    """(v,) number of the lead."""
    first: npt.NDArray[np.int64]
    """(v,) first and last sample whose segment sees part of the cross-line."""
    last: npt.NDArray[np.int64]
    low_m: npt.NDArray[np.float64]
    """(v,) part of the cross-line that is seen, offset from the lead (right positive)."""
    high_m: npt.NDArray[np.float64]


@inlined
def _clipped(low, high, at_zero, slope, least, most):
    """Returns the part of [low, high] where least ≤ at_zero + slope · u ≤ most."""
    if abs(slope) < 1e-12:
        if at_zero < least or at_zero > most:
            return 1.0, 0.0
        return low, high
    a, b = (least - at_zero) / slope, (most - at_zero) / slope
    return max(low, min(a, b)), min(high, max(a, b))


@inlined
def _seen(samples, i, j):
    """Returns the part (low, high) of the cross-line of sample `i` that the segment from `j` to `j + 1` sees."""
    x, y = samples.easting_m, samples.northing_m
    along_x, along_y = x[j + 1] - x[j], y[j + 1] - y[j]
    length = math.hypot(along_x, along_y)
    low, high = -samples.left_m[i], samples.right_m[i]
    if length < 1e-9:
        return 1.0, 0.0
    along_x, along_y = along_x / length, along_y / length
    right_x, right_y = math.cos(samples.heading_rad[i]), -math.sin(samples.heading_rad[i])
    away_x, away_y = x[i] - x[j], y[i] - y[j]
    low, high = _clipped(
        low, high, away_x * along_x + away_y * along_y, right_x * along_x + right_y * along_y, -SLACK_M,
        length + SLACK_M,
    )  # fmt: skip
    return _clipped(
        low, high, away_x * along_y - away_y * along_x, right_x * along_y - right_y * along_x, -samples.left_m[j],
        samples.right_m[j],
    )  # fmt: skip


@inlined
def _meets(samples, i, j, limits):
    """Returns whether the segment from sample `j` can be a visit beside sample `i` at all."""
    if not samples.joined[j] or abs(samples.height_m[j] - samples.height_m[i]) > limits.height_apart_m:
        return False
    return samples.track[j] != samples.track[i] or abs(samples.since_s[j] - samples.since_s[i]) >= limits.return_s


@kernel
def _near(samples, bins, i, limits, out, low, high):
    """Number of segments that see part of the cross-line of sample `i`; parts go to `low` and `high`, ascending."""
    column = math.floor((samples.easting_m[i] - bins.easting_m) / bins.edge_m)
    row = math.floor((samples.northing_m[i] - bins.northing_m) / bins.edge_m)
    count = 0
    for c in range(column - 1, column + 2):
        last = c * bins.rows + min(row + 1, bins.rows - 1)
        k = np.searchsorted(bins.key, c * bins.rows + max(row - 1, 0))
        while k < bins.key.size and bins.key[k] <= last:
            j = bins.order[k]
            k += 1
            if not _meets(samples, i, j, limits):
                continue
            a, b = _seen(samples, i, j)
            if b <= a:
                continue
            if count < out.size:
                n = count
                while n > 0 and out[n - 1] > j:
                    out[n], low[n], high[n] = out[n - 1], low[n - 1], high[n - 1]
                    n -= 1
                out[n], low[n], high[n] = j, a, b
            count += 1
    return count


@kernel
def visits(samples, bins, lead, limits, found):
    """Write the visits of each lead's cross-line; returns how many there are, also where `found` is too short.

    Parameters
    ----------
    samples : Samples. bins : Bins of an edge no shorter than any reach and segment together.
    lead : (m,) int64, samples that places are sought beside. limits : Limits.
    found : Visits, out, by lead, track and time.
    """
    size = 64
    near, low, high = np.empty(size, np.int64), np.empty(size), np.empty(size)
    total = 0
    for k in range(lead.size):
        count = _near(samples, bins, lead[k], limits, near, low, high)
        if count > size:
            size = 2 * count
            near, low, high = np.empty(size, np.int64), np.empty(size), np.empty(size)
            count = _near(samples, bins, lead[k], limits, near, low, high)
        before = -1
        for n in range(count):
            j = near[n]
            goes_on = before >= 0 and samples.track[j] == samples.track[before]
            if goes_on and samples.since_s[j] - samples.since_s[before] < limits.return_s:
                if total <= found.lead.size:
                    found.last[total - 1] = j
                    found.low_m[total - 1] = min(low[n], found.low_m[total - 1])
                    found.high_m[total - 1] = max(high[n], found.high_m[total - 1])
            else:
                if total < found.lead.size:
                    found.lead[total], found.first[total], found.last[total] = k, j, j
                    found.low_m[total], found.high_m[total] = low[n], high[n]
                total += 1
            before = j
    return total


class Spread(NamedTuple):
    """Layout of places across the road."""

    overlap_m: float
    """Narrowest strip that counts."""
    inset_m: float
    """Places keep this far from the edges of a strip, where it is wide enough."""


class Meetings(NamedTuple):
    """Places on cross-lines of leads and the visits that meet there, written by `meetings`."""

    lead: npt.NDArray[np.int64]
    """(p,) number of the lead."""
    offset_m: npt.NDArray[np.float64]
    """(p,) right positive."""
    place: npt.NDArray[np.int64]
    """(q,) place and visit of each membership."""
    visit: npt.NDArray[np.int64]


@inlined
def _is_later(samples, visit_sample, lead_sample):
    """Returns whether a visit comes after the lead in the order of tracks and time."""
    a, b = samples.track[visit_sample], samples.track[lead_sample]
    return a > b or (a == b and samples.since_s[visit_sample] > samples.since_s[lead_sample])


@inlined
def _covers(found, v, offset, margin):
    return found.low_m[v] + margin <= offset <= found.high_m[v] - margin


@kernel
def meetings(samples, found, lead, spread, aside, alone, out):
    """Write the fewest places that meet all visits of each lead; returns the numbers of places and memberships.

    Visits are intervals of the cross-line; the greedy choice by their right ends meets all of them with the fewest
    places. A place that a track before the lead's sees is left to that one.

    Parameters
    ----------
    samples : Samples. found : Visits, as `visits` wrote them. lead : (m,) int64.
    spread : Spread. aside : (m,) float64 in [−1, 1], where within a wide strip the place of a lead lies; NaN: as near
        to the track as the strip lets it.
    alone : (m,) bool, leads that make a place without any other visit.
    out : Meetings, out, long enough for a place and a membership for every visit and every lead, and visits once more
        by each place of a lead.
    """
    places, members, end = 0, 0, 0
    margin = 0.5 * spread.overlap_m
    for k in range(lead.size):
        begin = end
        while end < found.lead.size and found.lead[end] == k:
            end += 1
        size = end - begin
        met = np.zeros(size, np.bool_)
        order = np.argsort(found.high_m[begin:end])
        made = 0
        for n in range(size):
            v = begin + order[n]
            low, high = found.low_m[v], found.high_m[v]
            if met[order[n]] or high - low < spread.overlap_m or not _is_later(samples, found.first[v], lead[k]):
                continue
            for o in range(n, size):
                w = begin + order[o]
                a, b = max(low, found.low_m[w]), min(high, found.high_m[w])
                if b - a >= spread.overlap_m and not met[order[o]] and _is_later(samples, found.first[w], lead[k]):
                    low, high = a, b
                    met[order[o]] = True
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            free = max(half - spread.inset_m, 0.0)
            offset = min(max(0.0, middle - free), middle + free) if math.isnan(aside[k]) else middle + free * aside[k]
            left_to_another = False
            for w in range(begin, end):
                if not _is_later(samples, found.first[w], lead[k]) and _covers(found, w, offset, margin):
                    left_to_another = True
            if left_to_another:
                continue
            out.lead[places], out.offset_m[places] = k, offset
            for w in range(begin, end):
                if _is_later(samples, found.first[w], lead[k]) and _covers(found, w, offset, margin - 1e-9):
                    out.place[members], out.visit[members] = places, w
                    members += 1
            places += 1
            made += 1
        if made == 0 and alone[k]:
            seen_before = False
            for w in range(begin, end):
                seen_before |= _covers(found, w, 0.0, 0.0)
            if not seen_before:
                out.lead[places], out.offset_m[places] = k, 0.0
                places += 1
    return places, members


@kernel
def feet(samples, place_x, place_y, first, last, out):
    """Compute the position of each visit beside a place, on its track: sample and part of its segment, as one number.

    Parameters
    ----------
    place_x, place_y : (q,) float64, map, m. first, last : (q,) int64, segments of the visit.
    out : (q,) float64, out: sample + part in [0, 1].
    """
    x, y = samples.easting_m, samples.northing_m
    for q in range(first.size):
        best = math.inf
        for j in range(first[q], last[q] + 1):
            if not samples.joined[j]:
                continue
            along_x, along_y = x[j + 1] - x[j], y[j + 1] - y[j]
            square = along_x * along_x + along_y * along_y
            part = ((place_x[q] - x[j]) * along_x + (place_y[q] - y[j]) * along_y) / max(square, 1e-18)
            part = min(max(part, 0.0), 1.0)
            away = math.hypot(place_x[q] - x[j] - part * along_x, place_y[q] - y[j] - part * along_y)
            if away < best:
                best = away
                out[q] = j + part


MOST = 32
"""Readings of a cell from which its height is computed; an even choice where there are more."""
QUARTILES_OF_SIGMA = 1.349
"""Distance of the quartiles of a normal distribution, in σ."""


class Frame(NamedTuple):
    """Axes of a place."""

    easting_m: float
    """Centre, map."""
    northing_m: float
    sine: float
    """Sine of the heading of the axis along, clockwise from grid north."""
    cosine: float


class Cells(NamedTuple):
    """Cells (along, across) of a patch, written by `fill_cells`."""

    height_m: npt.NDArray[np.float64]
    """Mean of the middle half of the heights; NaN in cells with too few."""
    spread_m: npt.NDArray[np.float64]
    """1 σ of one reading about it, from the quartiles."""
    used: npt.NDArray[np.int32]
    """Number of readings in the height."""
    intensity: npt.NDArray[np.float64]
    """Mean of the same readings; NaN as the height."""


@kernel
def local_axes(easting_m, northing_m, frame, along_m, across_m):
    """Write coordinates (n,) along and across (right positive) from the place."""
    for i in range(easting_m.size):
        e, n = easting_m[i] - frame.easting_m, northing_m[i] - frame.northing_m
        along_m[i] = e * frame.sine + n * frame.cosine
        across_m[i] = e * frame.cosine - n * frame.sine


@kernel
def cell_numbers(along_m, across_m, half_m, cell_m, edge, number, count):
    """Write the cell (n,) of each reading, row · edge + column, −1 outside, and add to the counts (edge · edge,)."""
    for i in range(along_m.size):
        r, c = math.floor((along_m[i] + half_m) / cell_m), math.floor((across_m[i] + half_m) / cell_m)
        number[i] = -1
        if 0 <= r < edge and 0 <= c < edge:
            number[i] = r * edge + c
            count[r * edge + c] += 1


@kernel
def fill_cells(number, height_m, intensity, count, least, cells):
    """Write height, spread and intensity of cells.

    Parameters
    ----------
    number : (n,) int32, cell of each reading, −1: none. height_m : (n,) float64. intensity : (n,) uint16.
    count : (c,) int64, readings of each cell. least : int, a cell with fewer has no height.
    cells : Cells, out, of arrays (c,).
    """
    size = count.size
    begin = np.zeros(size + 1, np.int64)
    for k in range(size):
        begin[k + 1] = begin[k] + min(count[k], MOST)
    held, light = np.empty(begin[size]), np.zeros(size)
    seen, kept = np.zeros(size, np.int64), np.zeros(size, np.int64)
    for i in range(number.size):
        k = number[i]
        if k < 0:
            continue
        # The readings whose share of the cell's passes a whole number: MOST of them, evenly.
        before = seen[k] * MOST // count[k]
        seen[k] += 1
        if (count[k] <= MOST or seen[k] * MOST // count[k] > before) and math.isfinite(height_m[i]):
            n = begin[k] + kept[k]
            while n > begin[k] and held[n - 1] > height_m[i]:
                held[n] = held[n - 1]
                n -= 1
            held[n] = height_m[i]
            light[k] += intensity[i]
            kept[k] += 1
    for k in range(size):
        n = kept[k]
        cells.used[k] = n
        if n < least or n == 0:
            cells.height_m[k], cells.spread_m[k], cells.intensity[k] = math.nan, math.nan, math.nan
            continue
        low, high = begin[k] + n // 4, begin[k] + n - n // 4
        total = 0.0
        for j in range(low, high):
            total += held[j]
        cells.height_m[k] = total / (high - low)
        cells.spread_m[k] = (held[high - 1] - held[low]) / QUARTILES_OF_SIGMA if n >= 4 else math.nan
        cells.intensity[k] = light[k] / n


class Splat(NamedTuple):
    """Sums of readings over the cells of an image, (rows, columns), in/out of `splat`."""

    mass: npt.NDArray[np.float64]
    """Sum of weights."""
    height: npt.NDArray[np.float64]
    """Sum of weight · height."""
    intensity: npt.NDArray[np.float64]


@kernel
def splat(along_m, across_m, height_m, intensity, number, road_m, deepest_m, level_m, cell_m, out):
    """Add readings to the four cells around each, by nearness; those far from the height of their cell are skipped.

    Parameters
    ----------
    along_m, across_m : (n,) float64, from the corner of the picture. height_m : (n,) float64. intensity : (n,) uint16.
    number : (n,) int32, cell of `road_m` of each reading. road_m : (c,) float64.
    deepest_m : float64, farther from its cell's height a reading is no road. level_m : float64, taken off all heights.
    cell_m : float64. out : Splat, in/out.
    """
    rows, columns = out.mass.shape
    for i in range(number.size):
        u, v = along_m[i] / cell_m - 0.5, across_m[i] / cell_m - 0.5
        if not (0.0 <= u < rows - 1.0 and 0.0 <= v < columns - 1.0):
            continue
        if not abs(height_m[i] - road_m[number[i]]) <= deepest_m:
            continue
        h, w = height_m[i] - level_m, float(intensity[i])
        r, c = int(u), int(v)
        for j in range(2):
            for k in range(2):
                part = (u - r if j else 1.0 - u + r) * (v - c if k else 1.0 - v + c)
                out.mass[r + j, c + k] += part
                out.height[r + j, c + k] += part * h
                out.intensity[r + j, c + k] += part * w


@bare
def add_moments(point_m, group, kept, count, total_m, squares_m2):
    """Add count, sum and second moments about the origin of the points of each group.

    Parameters
    ----------
    point_m : (n, 3), near the origin of their group, or digits are lost.
    group : (n,)
    kept : (n,) points that count.
    count : (g,) int64, changed in place.
    total_m : (g, 3), changed in place.
    squares_m2 : (g, 6) of xx, xy, xz, yy, yz, zz, changed in place.
    """
    for n in range(group.size):
        if not kept[n]:
            continue
        g = group[n]
        x, y, z = point_m[n, 0], point_m[n, 1], point_m[n, 2]
        count[g] += 1
        total_m[g, 0] += x
        total_m[g, 1] += y
        total_m[g, 2] += z
        squares_m2[g, 0] += x * x
        squares_m2[g, 1] += x * y
        squares_m2[g, 2] += x * z
        squares_m2[g, 3] += y * y
        squares_m2[g, 4] += y * z
        squares_m2[g, 5] += z * z


@bare
def leave_out_far(point_m, group, mean_m, normal, limit_m, kept):
    """Reject points that lie farther than a limit from the plane of their group.

    Parameters
    ----------
    mean_m, normal : (g, 3) of the plane of each group.
    limit_m : (g,); negative where no point of the group counts.
    kept : (n,) changed in place.
    """
    for n in range(group.size):
        if kept[n]:
            g = group[n]
            away = 0.0
            for a in range(3):
                away += (point_m[n, a] - mean_m[g, a]) * normal[g, a]
            kept[n] = abs(away) <= limit_m[g]


@kernel
def correlate(first, second, every, row, column, least, out):
    """Write normalised correlations of two images over a grid of shifts.

    Parameters
    ----------
    first, second : (rows, columns) float64. every : int, every so-manieth cell of a row and of a column of the first is
        used.
    row, column : (a,), (b,) int64, shifts in cells.
    least : int, shifts with fewer cells in common get NaN.
    out : (a, b) float64, out.
    """
    rows, columns = first.shape
    for a in range(row.size):
        for b in range(column.size):
            count, x, y, xx, yy, xy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for r in range(0, rows, every):
                s = r + row[a]
                if not 0 <= s < rows:
                    continue
                for c in range(
                    max(0, -column[b] + every - 1) // every * every, min(columns, columns - column[b]), every
                ):
                    v, w = first[r, c], second[s, c + column[b]]
                    if math.isfinite(v + w):
                        count += 1
                        x += v
                        y += w
                        xx += v * v
                        yy += w * w
                        xy += v * w
            out[a, b] = math.nan
            if count >= least:
                p, q = xx - x * x / count, yy - y * y / count
                if p > 0.0 and q > 0.0:
                    out[a, b] = (xy - x * y / count) / math.sqrt(p * q)


class Laid(NamedTuple):
    """Cell-by-cell figures of the second image aligned with the first, written by `lay_upon`."""

    left: npt.NDArray[np.float64]
    """(rows, columns) first − second; NaN where either was not seen."""
    first_slope: npt.NDArray[np.float64]
    """(rows, columns, 2) by column and by row, per cell."""
    second_slope: npt.NDArray[np.float64]


@kernel
def lay_upon(first, second, down, right, out):
    """Write differences and slopes of two images, the second moved back by (down, right) cells.

    Parameters
    ----------
    first, second : (rows, columns) float64. down, right : float64, shift of the second in rows and columns.
    out : Laid, out.
    """
    rows, columns = first.shape
    kr, kc = math.floor(down), math.floor(right)
    t, s = catmull_rom(down - kr), catmull_rom(right - kc)
    for r in range(rows):
        for c in range(columns):
            out.left[r, c] = math.nan
            inside = 1 <= r < rows - 1 and 1 <= c < columns - 1 and 1 <= r + kr < rows - 2 and 1 <= c + kc < columns - 2
            if not inside:
                continue
            there, across, along = sampled(second, r + kr, c + kc, s, t)
            out.left[r, c] = first[r, c] - there
            out.first_slope[r, c, 0] = 0.5 * (first[r, c + 1] - first[r, c - 1])
            out.first_slope[r, c, 1] = 0.5 * (first[r + 1, c] - first[r - 1, c])
            out.second_slope[r, c, 0] = across
            out.second_slope[r, c, 1] = along
            if not math.isfinite(out.first_slope[r, c, 0] + out.first_slope[r, c, 1]):
                out.left[r, c] = math.nan
