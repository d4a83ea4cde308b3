"""Readings with an epoch each, placed chunk by chunk; those in active tiles are handed on with their cells."""

from __future__ import annotations

import math

import numpy as np

from roadscan.kernels.accumulate import NOWHERE, tile_at
from roadscan.kernels.georeference import CLASS_KEPT, OUTSIDE
from roadscan.kernels.options import bare, kernel
from roadscan.kernels.placing import CHUNK, place_mirror, place_returns


@bare
def find_active(
    east, north, height, classes, passes, epochs, intervals, corner, cell_quanta, edge,
    tile_rows, spans, sigmas, interval_sigmas, first, column, row, heights, origin, found, fates,
):  # fmt: skip
    """Append the readings that fall into active tiles to `column` …; note their epochs and σ with the tiles.

    Parameters
    ----------
    east, north, height, classes : (n,), as ``place_returns`` gives them.
    passes : (n,) int32, −1 for a reading that is in none; epochs : (n,) int64; intervals : (n,) int32.
    corner, cell_quanta, edge, tile_rows, spans, sigmas, interval_sigmas : as in :func:`find_returns`.
    first : int, number of the first reading.
    column, row, heights, origin : (≥ found + n,) int32, out: cell, quanta, number of the reading.
    found : int, readings that stand in them.
    fates : (6,) int64, in/out: wanted readings outside the active tiles.

    Returns
    -------
    int, readings that stand in them now.
    """
    per_cell = 1.0 / cell_quanta
    begun, wanted = found, 0
    west, south, tile, known = np.int64(-(1 << 40)), np.int64(-(1 << 40)), np.int64(-1), np.int64(-1)
    for i in range(classes.size):
        if classes[i] != CLASS_KEPT:
            continue
        wanted += 1
        x = math.floor((east[i] - corner[0] + 0.5) * per_cell)
        y = math.floor((north[i] - corner[1] + 0.5) * per_cell)
        # What lies far outside must not come back into the box when it is cut to 32 bits.
        if not ((x > NOWHERE) & (x < -NOWHERE) & (y > NOWHERE) & (y < -NOWHERE)) or passes[i] < 0:
            continue
        if not (west <= x < west + edge and south <= y < south + edge):
            west, south, tile = tile_at(np.int64(x), np.int64(y), edge, tile_rows)
            known = -1
        if tile < 0:
            continue
        if intervals[i] != known:
            known = np.int64(intervals[i])
            sigmas[tile, 0] = max(sigmas[tile, 0], interval_sigmas[known, 0])
            sigmas[tile, 1] = max(sigmas[tile, 1], interval_sigmas[known, 1])
        spans[tile, 0] = min(spans[tile, 0], epochs[i])
        spans[tile, 1] = max(spans[tile, 1], epochs[i])
        column[found], row[found], heights[found] = np.int32(x), np.int32(y), np.int32(height[i])
        origin[found] = np.int32(first + i)
        found += 1
    fates[OUTSIDE] += wanted - (found - begun)
    return found


@kernel
def find_returns(
    epochs, pose_epochs, x, y, z, passes, poses, limits, quanta_per_m, corner, cell_quanta, edge,
    tile_rows, spans, sigmas, interval_sigmas, column, row, heights, origin, fates,
):  # fmt: skip
    """Place returns, and find the cells of those that fall into active tiles.

    Parameters
    ----------
    epochs : (n,) int64, GPS ns at which each return was measured; passes : (n,) int32, −1 for none.
    pose_epochs, x, y, z, limits, quanta_per_m : as in ``place_returns``; poses : tuple (mounting, knots,
    coefficients, valid, lattice, table, centres, charts).
    corner : (2,) tuple of int64, south-west corner of tile_rows[0, 0] (quanta); cell_quanta : int64, edge of a cell.
    edge : int64, cells along a tile's edge; tile_rows : (rows, columns) int32, −1 for tiles that are not active.
    spans : (a, 2) int64, in/out, first and last epoch of each active tile.
    sigmas : (a, 2) float64, in/out, largest σ of the poses; interval_sigmas : (k, 2) float64, a row more than
    intervals.
    column, row, heights, origin : (≥ n,) int32, out, as in :func:`find_active`.
    fates : (6,) int64, in/out.

    Returns
    -------
    int, readings found.
    """
    mounting, knots, coefficients, valid, lattice, table, centres, charts = poses
    east, north, height = np.empty(CHUNK), np.empty(CHUNK), np.empty(CHUNK)
    classes, intervals = np.empty(CHUNK, np.uint8), np.empty(CHUNK, np.int32)
    found = 0
    for start in range(0, epochs.size, CHUNK):
        end = min(start + CHUNK, epochs.size)
        n = end - start
        place_returns(
            start, end, pose_epochs, x, y, z, mounting, knots, coefficients, valid, lattice, table, centres, charts,
            limits, quanta_per_m, east, north, height, classes, intervals, fates,
        )  # fmt: skip
        found = find_active(
            east[:n], north[:n], height[:n], classes[:n], passes[start:end], epochs[start:end], intervals[:n],
            corner, cell_quanta, edge, tile_rows, spans, sigmas, interval_sigmas,
            start, column, row, heights, origin, found, fates,
        )  # fmt: skip
    return found


@kernel
def find_mirror(
    profile_epochs, epochs, ranges, passes, origins, directions, scale, reading_period_ns,
    poses, limits, quanta_per_m, corner, cell_quanta, edge,
    tile_rows, spans, sigmas, interval_sigmas, column, row, heights, origin, fates,
):  # fmt: skip
    """Place the readings of profiles that a mirror measures one after another; find the cells of the active ones.

    Parameters
    ----------
    profile_epochs, ranges, origins, directions, scale, reading_period_ns : as in ``place_mirror``.
    epochs : (n · m,) int64, GPS ns of the readings; passes : (n · m,) int32.
    Others, and what is returned, as in :func:`find_returns`.
    """
    mounting, knots, coefficients, valid, lattice, table, centres, charts = poses
    m = ranges.shape[1]
    profiles = max(CHUNK // m, 1)
    size = profiles * m
    east, north, height = np.empty(size), np.empty(size), np.empty(size)
    classes, intervals = np.empty(size, np.uint8), np.empty(size, np.int32)
    found = 0
    for start in range(0, profile_epochs.size, profiles):
        end = min(start + profiles, profile_epochs.size)
        a, b = start * m, end * m
        n = b - a
        place_mirror(
            start, end, profile_epochs, ranges, origins, directions, scale, reading_period_ns,
            mounting, knots, coefficients, valid, lattice, table, centres, charts,
            limits, quanta_per_m, east, north, height, classes, intervals, fates,
        )  # fmt: skip
        found = find_active(
            east[:n], north[:n], height[:n], classes[:n], passes[a:b], epochs[a:b], intervals[:n],
            corner, cell_quanta, edge, tile_rows, spans, sigmas, interval_sigmas,
            a, column, row, heights, origin, found, fates,
        )  # fmt: skip
    return found
