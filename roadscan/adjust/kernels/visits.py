"""Meetings of the swaths of tracks: for each lead sample of a track, the other visits of the road beside it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, kernel

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
