"""Writes points of readings with an epoch each, chunk by chunk, and interpolates positions between ticks."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import bare_inner, kernel
from roadscan.georeference.kernels.readings import (
    CLASS_KEPT,
    KEPT,
    OUTSIDE,
    Placed,
    is_wanted,
    tile_and_rest,
    write_point,
)
from roadscan.georeference.kernels.timed_readings import CHUNK, place_mirror, place_returns


@kernel
def places(n):
    """Return arrays for the map positions of n readings."""
    return Placed(np.empty(n), np.empty(n), np.empty(n), np.empty(n, np.uint8), np.empty(n, np.int32))


@bare_inner
def keep_points(first, n, made, placed, window, out):
    """Append the readings that are kept and lie in the window; write the classes of all where requested.

    Parameters
    ----------
    first : int64, number of the first reading; made : int64, points written before.
    placed : Placed, of which the first n are the readings; window : Window; out : Points, rows of numbers of readings.

    Returns
    -------
    int, how many points are written now.
    """
    if out.classes.size:
        for i in range(n):
            out.classes[first + i] = placed.classes[i]
    for i in range(n):
        if placed.classes[i] != CLASS_KEPT:
            continue
        across = tile_and_rest(np.int64(placed.east[i]), window.tile_quanta)
        along = tile_and_rest(np.int64(placed.north[i]), window.tile_quanta)
        if not is_wanted(across[0], along[0], window.tiles):
            out.fates[OUTSIDE] += 1
            continue
        write_point(made, first + i, across, along, np.int64(placed.height[i]), out)
        made += 1
        out.fates[KEPT] += 1
    return made


@kernel
def georeference_returns(returns, georeference, window, out):
    """Georeference returns and write the points in the window; return the number of points written.

    returns : Returns; georeference : Georeference; window : Window; out : Points of as many rows as there are returns.
    """
    placed = places(CHUNK)
    made = np.int64(0)
    for start in range(0, returns.epochs.size, CHUNK):
        end = min(start + CHUNK, returns.epochs.size)
        place_returns(start, end, returns, georeference, placed, out.fates)
        made = keep_points(start, end - start, made, placed, window, out)
    return made


@kernel
def georeference_mirror(profiles, georeference, window, out):
    """Georeference the readings of a mirror's profiles and write the points in the window; return their number.

    profiles : MirrorProfiles; others as in :func:`georeference_returns`, with a row of `out` for each reading.
    """
    m = profiles.ranges.shape[1]
    at_once = max(CHUNK // m, 1)
    placed = places(at_once * m)
    made = np.int64(0)
    for start in range(0, profiles.epochs.size, at_once):
        end = min(start + at_once, profiles.epochs.size)
        place_mirror(start, end, profiles, georeference, placed, out.fates)
        made = keep_points(start * m, (end - start) * m, made, placed, window, out)
    for i in range(made):
        out.readings[i] = out.rows[i] % m
        out.rows[i] //= m
    return made


@kernel
def between_ticks(epochs, step, first, number, at, out):
    """Interpolate positions at epochs.

    Parameters
    ----------
    epochs : (n,) int64, ns; step : int64, ns from tick to tick; first : int64, epoch of tick 0 divided by the step.
    number : (t,) int64, row in `at` of each tick from the first on; the next tick's row follows a needed one's.
    at : (k, 3) float64, places at ticks; NaN where there is none.
    out : (3, n) float64, out.
    """
    i, length = 0, float(step)
    while i < epochs.size:  # epochs ascend, so many of them share a tick
        tick = epochs[i] // step
        begin, row, last = tick * step, number[tick - first], i + 1
        while last < epochs.size and begin <= epochs[last] < begin + step:
            last += 1
        for axis in range(3):
            before, after = at[row, axis], at[row + 1, axis]
            for k in range(i, last):
                share = (epochs[k] - begin) / length
                out[axis, k] = before * (1.0 - share) + after * share
        i = last
