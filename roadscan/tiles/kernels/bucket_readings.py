"""Puts readings with an epoch each, or points of a tile, into the buckets of their tiles' rows."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel
from roadscan.georeference.kernels.timed_points import places
from roadscan.georeference.kernels.timed_readings import CHUNK, place_mirror, place_returns
from roadscan.tiles.kernels.accumulate import end_of_pass, find_cells
from roadscan.tiles.kernels.active_tiles import Measured
from roadscan.tiles.kernels.row_buckets import TAKEN, Places, fill_buckets, put_in_own_buckets


@inlined
def places_in_tiles(n, tiles):
    """Return arrays for the cells of n readings and for the σ of so many active tiles."""
    return Places(np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32), np.full(tiles, -1, np.int32))


@inlined
def part_of(measured, first, end):
    """Return readings `first` to `end` − 1 of :class:`Measured`."""
    return Measured(
        measured.epochs[first:end], measured.passes[first:end], measured.intensity[first:end], measured.gain,
        measured.interval_sigmas_m,
    )  # fmt: skip


@kernel
def bucket_returns(returns, measured, georeference, active, buckets, fates, first):
    """Georeference returns and put those in active tiles into their buckets.

    Parameters
    ----------
    returns : Returns; measured : Measured, of the same n returns; georeference : Georeference.
    active : ActiveTiles; buckets : Buckets; fates : (≥ FATES,) int64, in/out, counts by fate.
    first : int, return to begin with.

    Returns
    -------
    int, the return before which the buckets ran short of free blocks; n at the end.
    """
    placed, own = places(CHUNK), places_in_tiles(CHUNK, active.spans.shape[0])
    n = returns.epochs.size
    for start in range(first, n, CHUNK):
        if buckets.free.size - buckets.held[TAKEN] < CHUNK:
            return start
        end = min(start + CHUNK, n)
        place_returns(start, end, returns, georeference, placed, fates)
        fill_buckets(placed, part_of(measured, start, end), own, active, buckets, fates)
    return n


@kernel
def bucket_mirror(profiles, measured, georeference, active, buckets, fates, first):
    """Georeference the readings of a mirror's profiles and put those in active tiles into their buckets.

    Parameters
    ----------
    profiles : MirrorProfiles; measured : Measured, of the n · m readings.
    first : int, profile to begin with.
    Others, and what is returned, as in :func:`bucket_returns`.
    """
    n, m = profiles.ranges.shape
    at_once = max(CHUNK // m, 1)
    size = at_once * m
    placed, own = places(size), places_in_tiles(size, active.spans.shape[0])
    for start in range(first, n, at_once):
        if buckets.free.size - buckets.held[TAKEN] < size:
            return start
        end = min(start + at_once, n)
        place_mirror(start, end, profiles, georeference, placed, fates)
        fill_buckets(placed, part_of(measured, start * m, end * m), own, active, buckets, fates)
    return n


@kernel
def bucket_points(x, y, height, passes, intensity, cell_quanta, ends, buckets, first):
    """Put the points of one tile into its buckets.

    Parameters
    ----------
    x, y, height : (n,) int32, quanta, x and y from the tile's south-west corner.
    passes : (n,) int32, number of each point's pass among the accumulator's; best few after one another.
    intensity : (n,) uint16.
    ends : (edge,) int32, in/out, of the tile's buckets; buckets : Buckets.
    first : int, point to begin with.

    Returns
    -------
    int, the point before which the buckets ran short of free blocks; n at the end.
    """
    column, row = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    start = first
    while start < x.size:
        if buckets.free.size - buckets.held[TAKEN] < CHUNK:
            return start
        end = end_of_pass(passes, start, CHUNK)
        n = end - start
        find_cells(x[start:end], y[start:end], 1.0 / cell_quanta, column, row)
        put_in_own_buckets(column[:n], row[:n], height[start:end], intensity[start:end], passes[start], ends, buckets)
        start = end
    return start
