"""Readings with an epoch each, placed chunk by chunk, or points of a tile, put on the piles of their tiles' rows."""

from __future__ import annotations

import numpy as np

from roadscan.kernels.accumulate import find_cells
from roadscan.kernels.options import kernel
from roadscan.kernels.placing import CHUNK, place_mirror, place_returns
from roadscan.kernels.row_piles import TAKEN, pile_up, put_on_own_piles


@kernel
def work_arrays(size, tiles):
    """Arrays for the places, classes and cells of so many readings, and what is known of so many active tiles."""
    return (
        np.empty(size), np.empty(size), np.empty(size), np.empty(size, np.uint8), np.empty(size, np.int32),
        (np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int32)),
        np.full(tiles, -1, np.int32),
    )  # fmt: skip


@kernel
def pile_returns(
    epochs, pose_epochs, x, y, z, intensity, gain, passes, poses, limits, quanta_per_m, corner, cell_quanta, tile_rows,
    spans, sigmas, interval_sigmas, ends, piles, fates, first,
):  # fmt: skip
    """Place returns and put those in active tiles on their piles.

    Parameters
    ----------
    epochs : (n,) int64, GPS ns at which each return was measured; passes : (n,) int32, −1 for none.
    pose_epochs, x, y, z, limits, quanta_per_m : as in ``place_returns``; poses : tuple (mounting, knots,
    coefficients, valid, lattice, table, centres, charts).
    intensity, gain, corner, cell_quanta, tile_rows, spans, sigmas, interval_sigmas, ends, piles, fates : as in
    ``row_piles.pile_up``.
    first : int, return to begin with.

    Returns
    -------
    int, the return before which the piles ran short of free blocks; n at the end.
    """
    mounting, knots, coefficients, valid, lattice, table, centres, charts = poses
    east, north, height, classes, intervals, cells, known = work_arrays(CHUNK, spans.shape[0])
    for start in range(first, epochs.size, CHUNK):
        if piles[4].size - piles[5][TAKEN] < CHUNK:
            return start
        end = min(start + CHUNK, epochs.size)
        n = end - start
        place_returns(
            start, end, pose_epochs, x, y, z, mounting, knots, coefficients, valid, lattice, table, centres, charts,
            limits, quanta_per_m, east, north, height, classes, intervals, fates,
        )  # fmt: skip
        pile_up(
            east[:n], north[:n], height[:n], classes[:n], epochs[start:end], intervals[:n], passes[start:end],
            intensity[start:end], gain, corner, cell_quanta, cells, tile_rows, spans, sigmas, interval_sigmas, known,
            ends, piles, fates,
        )  # fmt: skip
    return epochs.size


@kernel
def pile_mirror(
    profile_epochs, epochs, ranges, origins, directions, scale, reading_period_ns, intensity, gain, passes, poses,
    limits, quanta_per_m, corner, cell_quanta, tile_rows, spans, sigmas, interval_sigmas, ends, piles, fates, first,
):  # fmt: skip
    """Place the readings of profiles that a mirror measures one after another; put those in active tiles on piles.

    Parameters
    ----------
    profile_epochs, ranges, origins, directions, scale, reading_period_ns : as in ``place_mirror``.
    epochs : (n · m,) int64, GPS ns of the readings; intensity : (n · m,); passes : (n · m,) int32.
    first : int, profile to begin with.
    Others, and what is returned, as in :func:`pile_returns`.
    """
    mounting, knots, coefficients, valid, lattice, table, centres, charts = poses
    m = ranges.shape[1]
    profiles = max(CHUNK // m, 1)
    size = profiles * m
    east, north, height, classes, intervals, cells, known = work_arrays(size, spans.shape[0])
    for start in range(first, profile_epochs.size, profiles):
        if piles[4].size - piles[5][TAKEN] < size:
            return start
        end = min(start + profiles, profile_epochs.size)
        a, b = start * m, end * m
        n = b - a
        place_mirror(
            start, end, profile_epochs, ranges, origins, directions, scale, reading_period_ns,
            mounting, knots, coefficients, valid, lattice, table, centres, charts,
            limits, quanta_per_m, east, north, height, classes, intervals, fates,
        )  # fmt: skip
        pile_up(
            east[:n], north[:n], height[:n], classes[:n], epochs[a:b], intervals[:n], passes[a:b],
            intensity[a:b], gain, corner, cell_quanta, cells, tile_rows, spans, sigmas, interval_sigmas, known,
            ends, piles, fates,
        )  # fmt: skip
    return profile_epochs.size


@kernel
def pile_points(x, y, height, passes, intensity, cell_quanta, ends, piles, first):
    """Put the points of one tile on its piles.

    Parameters
    ----------
    x, y, height : (n,) int32, quanta, x and y from the tile's south-west corner.
    passes : (n,) int32, number of each point's pass among the accumulator's; best few after one another.
    intensity : (n,) uint16.
    ends : (edge,) int32, in/out, of the tile; piles : as in ``row_piles.put_on_piles``.
    first : int, point to begin with.

    Returns
    -------
    int, the point before which the piles ran short of free blocks; n at the end.
    """
    column, row = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    start = first
    while start < x.size:
        if piles[4].size - piles[5][TAKEN] < CHUNK:
            return start
        end, last = start, min(start + CHUNK, x.size)
        while end < last and passes[end] == passes[start]:
            end += 1
        n = end - start
        find_cells(x[start:end], y[start:end], 1.0 / cell_quanta, column, row)
        put_on_own_piles(column[:n], row[:n], height[start:end], intensity[start:end], passes[start], ends, piles)
        start = end
    return start
