"""Readings with an epoch each go straight into cells: placed chunk by chunk, counted while they are in the cache."""

from __future__ import annotations

import numpy as np

from roadscan.kernels.accumulate import PIECE, accumulate_placed
from roadscan.kernels.georeference import CLASS_KEPT, KEPT, OUTSIDE
from roadscan.kernels.options import inlined, kernel
from roadscan.kernels.placing import CHUNK, place_mirror, place_returns


@inlined
def count_kept(classes, counted, fates):
    """Count the readings that no filter leaves out: in active tiles and passes, or elsewhere."""
    wanted = 0
    for i in range(classes.size):
        wanted += classes[i] == CLASS_KEPT
    fates[KEPT] += counted
    fates[OUTSIDE] += wanted - counted


@kernel
def accumulate_returns(
    epochs, pose_epochs, x, y, z, intensity, gain, passes, poses, limits, quanta_per_m, corner, cell_quanta, edge,
    tile_rows, groups, pool, work, spans, sigmas, interval_sigmas, fates,
    first,
):  # fmt: skip
    """Count returns into the cells of active tiles.

    Parameters
    ----------
    epochs : (n,) int64, GPS ns at which each return was measured; passes : (n,) int32, as in ``accumulate_placed``.
    pose_epochs, x, y, z, limits, quanta_per_m : as in ``place_returns``; poses : tuple (mounting, knots,
    coefficients, valid, lattice, table, centres, charts).
    intensity : (n,) uint16; gain : uint32, see ``accumulate``.
    corner … interval_sigmas : as in ``accumulate_placed``; interval_sigmas has a row more than intervals.
    fates : (6,) int64, in/out.
    first : int, return to begin with.

    Returns
    -------
    int, the return before which the pool ran short of free elements; n at the end.
    """
    mounting, knots, coefficients, valid, lattice, table, centres, charts = poses
    free, held = pool[4], pool[6]
    east, north, height = np.empty(CHUNK), np.empty(CHUNK), np.empty(CHUNK)
    classes, intervals = np.empty(CHUNK, np.uint8), np.empty(CHUNK, np.int32)
    for start in range(first, epochs.size, CHUNK):
        if free.size - held[0] < 2 * (CHUNK + PIECE):
            return start
        end = min(start + CHUNK, epochs.size)
        n = end - start
        place_returns(
            start, end, pose_epochs, x, y, z, mounting, knots, coefficients, valid, lattice, table, centres, charts,
            limits, quanta_per_m, east, north, height, classes, intervals, fates,
        )  # fmt: skip
        _, counted = accumulate_placed(
            east[:n], north[:n], height[:n], classes[:n], passes[start:end], intensity[start:end], gain,
            epochs[start:end], intervals[:n], corner, cell_quanta, edge,
            tile_rows, groups, pool, work, spans, sigmas, interval_sigmas, 0,
        )  # fmt: skip
        count_kept(classes[:n], counted, fates)
    return epochs.size


@kernel
def accumulate_mirror(
    profile_epochs, epochs, ranges, intensity, gain, passes, origins, directions, scale, reading_period_ns,
    poses, limits, quanta_per_m, corner, cell_quanta, edge,
    tile_rows, groups, pool, work, spans, sigmas, interval_sigmas, fates,
    first,
):  # fmt: skip
    """Count the readings of profiles that a mirror measures one after another into the cells of active tiles.

    Parameters
    ----------
    profile_epochs, ranges, origins, directions, scale, reading_period_ns : as in ``place_mirror``.
    epochs : (n · m,) int64, GPS ns of the readings; passes : (n · m,) int32; intensity : (n · m,) uint8.
    Others as in :func:`accumulate_returns`; `first` is a profile.

    Returns
    -------
    int, the profile before which the pool ran short of free elements; n at the end.
    """
    mounting, knots, coefficients, valid, lattice, table, centres, charts = poses
    free, held = pool[4], pool[6]
    m = ranges.shape[1]
    profiles = max(CHUNK // m, 1)
    size = profiles * m
    east, north, height = np.empty(size), np.empty(size), np.empty(size)
    classes, intervals = np.empty(size, np.uint8), np.empty(size, np.int32)
    for start in range(first, profile_epochs.size, profiles):
        if free.size - held[0] < 2 * (size + PIECE):
            return start
        end = min(start + profiles, profile_epochs.size)
        a, b = start * m, end * m
        n = b - a
        place_mirror(
            start, end, profile_epochs, ranges, origins, directions, scale, reading_period_ns,
            mounting, knots, coefficients, valid, lattice, table, centres, charts,
            limits, quanta_per_m, east, north, height, classes, intervals, fates,
        )  # fmt: skip
        _, counted = accumulate_placed(
            east[:n], north[:n], height[:n], classes[:n], passes[a:b], intensity[a:b], gain,
            epochs[a:b], intervals[:n], corner, cell_quanta, edge,
            tile_rows, groups, pool, work, spans, sigmas, interval_sigmas, 0,
        )  # fmt: skip
        count_kept(classes[:n], counted, fates)
    return profile_epochs.size
