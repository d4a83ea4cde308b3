"""Finds the carriageway in a profile: the surface, connected without a step, with the most readings.

Step 4 of :mod:`roadscan.georeference.road_profiles`.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.compute.kernels.arrays import copy_values
from roadscan.georeference.kernels.readings import CLASS_KEPT

CLASS_SCATTERED, CLASS_OFF_ROAD = 10, 12
"""Classes of objects behind which the road continues, and of readings beyond the road's edge."""

SETTINGS = (
    "bin", "share", "gate", "scatter_factor", "scatter_readings", "grazing", "chord", "step", "noise_factor", "slope",
    "window", "window_readings", "bridge",
)  # fmt: skip
"""Order of the `settings` tuple; lengths in metres, angles in radians (``georeference.road_profiles``)."""
(
    BIN, SHARE, GATE, SCATTER_FACTOR, SCATTER_READINGS, GRAZING, CHORD, STEP, NOISE_FACTOR, SLOPE,
    WINDOW, WINDOW_READINGS, BRIDGE,
) = range(13)  # fmt: skip

PENDING_ABOVE, PENDING_BELOW = np.uint8(254), np.uint8(255)  # Set until the road is found to continue or end.
REJOIN = 3
"""The road continues behind an object or a hole if this many readings in a row lie on its line."""

NO_LINE = (0.0,) * 5
"""Sums of a line before its first reading."""


@inlined
def line_at(line, y):
    """Return the height at y of the least-squares line with the sums `line`: count, Σy, Σup, Σy², Σy up."""
    count, sum_y, sum_up, sum_yy, sum_y_up = line
    spread = count * sum_yy - sum_y * sum_y
    slope = (count * sum_y_up - sum_y * sum_up) / spread if spread > 1e-6 * count * count else 0.0
    return (sum_up + slope * (count * y - sum_y)) / count


@inlined
def counted_in(line, y, up, sign):
    """Return the sums of a line after adding a reading, or after removing one for sign −1."""
    return (
        line[0] + sign,
        line[1] + sign * y,
        line[2] + sign * up,
        line[3] + sign * y * y,
        line[4] + sign * y * up,
    )


@inner
def follow_road(y, up, height, spread, start, way, settings, trail, head, line, kinds):
    """Step 4: follow the road outwards from reading `start` as long as readings continue its line.

    Parameters
    ----------
    spread : (n,) float64, what the noise adds to the tolerance (m); way : +1 or −1.
    trail : (n,) int32, in/out: readings of the line so far; head : int64, how many; line : (5,) tuple, their sums.
    kinds : (n,) uint8, in/out.
    """
    n = y.size
    step, slope, bridge = settings[STEP], settings[SLOPE], settings[BRIDGE]
    window, window_readings = settings[WINDOW], np.int64(settings[WINDOW_READINGS])
    tail = np.int64(0)
    origin_y, origin_up = y[start], up[start]
    last, since, good = start, np.int64(-1), 0
    end = n if way > 0 else -1
    j = start + way
    while j != end:
        if kinds[j] == CLASS_KEPT:
            gap = abs(y[j] - y[last])
            if gap > bridge:
                break
            over = up[j] - origin_up - line_at(line, y[j] - origin_y)
            most = step + spread[j] + slope * gap
            fits = abs(over) <= most
            if since >= 0 and not fits:
                # The line has passed through a hole: the road behind it is as high above the datum as before it.
                before = (height[trail[tail]] + height[trail[tail + 1]] + height[trail[tail + 2]]) / 3.0
                near = step + spread[j]
                deepest = before
                for i in range(tail, head):
                    deepest = min(deepest, height[trail[i]])
                fits = deepest < before - near and abs(height[j] - before) <= near
            if fits and since < 0:
                trail[head] = j
                head += 1
                line = counted_in(line, y[j] - origin_y, up[j] - origin_up, 1.0)
                last = j
            elif fits:
                good += 1
                if good == REJOIN:
                    for i in range(since, j + way, way):
                        if kinds[i] == CLASS_KEPT:
                            trail[head] = i
                            head += 1
                            line = counted_in(line, y[i] - origin_y, up[i] - origin_up, 1.0)
                        elif kinds[i] == PENDING_ABOVE:
                            kinds[i] = CLASS_SCATTERED
                        elif kinds[i] == PENDING_BELOW:
                            kinds[i] = CLASS_KEPT
                    last, since, good = j, np.int64(-1), 0
            else:
                since = j if since < 0 else since
                good = 0
                kinds[j] = PENDING_ABOVE if over > 0.0 else PENDING_BELOW
            while head - tail > window_readings and abs(y[last] - y[trail[tail]]) > window:
                line = counted_in(line, y[trail[tail]] - origin_y, up[trail[tail]] - origin_up, -1.0)
                tail += 1
        j += way
    first = j if since < 0 else since
    while first != end:
        kind = kinds[first]
        if (kind == CLASS_KEPT) | (kind == PENDING_ABOVE) | (kind == PENDING_BELOW):
            kinds[first] = CLASS_OFF_ROAD
        first += way


@inner
def road_from(start, y, up, height, spread, settings, trail, kinds):
    """Step 4 from one reading: follow the road both ways, beginning with the line through the readings around it.

    Readings that begin the line differ from the start by no more than the gate in `height`.

    Returns
    -------
    int, how many readings are left as road.
    """
    n = y.size
    window, window_readings = settings[WINDOW], np.int64(settings[WINDOW_READINGS])
    for way in (-1, 1):
        line, head = NO_LINE, np.int64(0)
        # The line includes readings on both sides of the start, so both ways begin with the same readings.
        first = start
        while (
            first - way >= 0
            and first - way < n
            and (abs(y[first - way] - y[start]) <= 0.5 * window or abs(first - way - start) < window_readings)
        ):
            first -= way
        i = first
        while i != start + way:
            if kinds[i] == CLASS_KEPT and abs(height[i] - height[start]) <= settings[GATE]:
                trail[head] = i
                head += 1
                line = counted_in(line, y[i] - y[start], up[i] - up[start], 1.0)
            i += way
        follow_road(y, up, height, spread, start, way, settings, trail, head, line, kinds)
    return count_kept(kinds)


@inner
def count_kept(kinds):
    """Return the number of readings classified as road."""
    kept = 0
    for j in range(kinds.size):
        kept += kinds[j] == CLASS_KEPT
    return kept


@kernel
def mark_off_road(y, up, height, spread, settings, trail, trial, best, kinds):
    """Step 4: mark readings off the carriageway, which is the connected surface with the most readings.

    The middle reading is tried first; others only where it reaches less than half of all.
    best, trial : (n,) uint8, scratch.
    """
    n = y.size
    every = count_kept(kinds)
    most, found = 0, 0
    copy_values(kinds, best)
    for share in (8, 4, 12, 2, 14):
        start, seen = np.int64(-1), 0
        for j in range(n):
            if kinds[j] == CLASS_KEPT:
                if 16 * seen >= share * every:
                    start = j
                    break
                seen += 1
        if start < 0 or (most > 0 and best[start] == CLASS_KEPT):
            continue
        copy_values(kinds, trial)
        found = road_from(start, y, up, height, spread, settings, trail, trial)
        if found > most:
            most = found
            copy_values(trial, best)
        if 2 * most >= every:
            break
    copy_values(best, kinds)


@kernel
def keep_road(kinds, first_kind, ranges, counts):
    """Set the ranges of readings of the classes from `first_kind` on to 0, and count them.

    Parameters
    ----------
    kinds : (n,) uint8, class of each reading; first_kind : int.
    ranges : (n,) uint16, in/out; counts : (k,) int64, in/out, readings of the classes from `first_kind` on.
    """
    for j in range(kinds.size):
        ranges[j] = ranges[j] if kinds[j] < first_kind else np.uint16(0)
    for k in range(counts.size):
        total = 0
        for j in range(kinds.size):
            total += kinds[j] == first_kind + k
        counts[k] += total
