"""Counts flat profiles, whose readings are taken at one instant near the sensor, into cells without writing points."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inlined, bare_inner
from roadscan.georeference.kernels.flat_profiles import HALF, on_plane, planes_of
from roadscan.georeference.kernels.readings import HEIGHT, KEPT, NO_POSE, NO_RETURN, OUTSIDE, RANGE
from roadscan.poses.kernels.poses import find_interval
from roadscan.tiles.kernels.accumulate import NOWHERE, PIECE, Heights, accumulate


class Plane(NamedTuple):
    """Map positions of a profile's readings in 32 bits, relative to its anchor."""

    maps: tuple[tuple[float, ...], ...]
    """Planes (p, q, r) of easting, northing and height, see ``georeference.kernels.flat_profiles``."""
    rests: tuple[float, float]
    """Remainders of easting and northing from :func:`whole_cells`."""
    first: tuple[int, int, int]
    """Cells to the anchor, east and north, and the height of the anchor (quanta)."""
    per_cell: float
    """Cells per quantum."""
    heights: tuple[float, float]
    """Lowest and highest height that is kept, relative to the anchor."""


@bare_inlined
def whole_cells(anchor, cell_quanta):
    """Return the cells up to an anchor (int32), and the remainder plus half a quantum (float32, exact)."""
    cells = math.floor((anchor + 0.5) / cell_quanta)
    return np.int32(cells), np.float32(anchor - np.int64(cells) * cell_quanta + 0.5)


@bare_inlined
def plane_of(anchors, maps, heights, active):
    """Return the :class:`Plane` of what ``planes_of`` returns."""
    first_column, east_rest = whole_cells(anchors[0] - active.corner_quanta[0], active.cell_quanta)
    first_row, north_rest = whole_cells(anchors[1] - active.corner_quanta[1], active.cell_quanta)
    first = (first_column, first_row, np.int32(anchors[2]))
    return Plane(maps, (east_rest, north_rest), first, np.float32(1.0 / active.cell_quanta), heights)


@bare_inner
def place_profile(raw, rays, scale, raw_limits, plane, out):
    """Compute cells and heights of a profile's readings. A separate function: inside a larger one it stays scalar.

    Parameters
    ----------
    raw : (n,) uint16; rays : four (n,) float32, see ``FlatProfiles``; scale, raw_limits : as there.
    plane : Plane; out : Heights, column NOWHERE for readings that a filter leaves out.
    """
    east, north, up = plane.maps
    y0, z0, dy, dz = rays
    rests, first, per_cell, heights = plane.rests, plane.first, plane.per_cell, plane.heights
    column, row, height = out
    for j in range(raw.size):
        distance = scale[0] + scale[1] * np.float32(raw[j])
        y = y0[j] + distance * dy[j]
        z = z0[j] + distance * dz[j]
        h = on_plane(up, y, z)
        keep = (raw[j] >= raw_limits[0]) & (raw[j] <= raw_limits[1]) & (h >= heights[0]) & (h <= heights[1])
        e = np.int32(np.floor((np.floor(on_plane(east, y, z) + HALF) + rests[0]) * per_cell))
        s = np.int32(np.floor((np.floor(on_plane(north, y, z) + HALF) + rests[1]) * per_cell))
        column[j] = e + first[0] if keep else np.int32(NOWHERE)
        row[j] = s + first[1]
        height[j] = np.int32(np.floor(h + HALF)) + first[2]


@bare_inner
def count_out_of_range(raw, raw_limits):
    """Return how many readings have no return, and how many have one that is too near or too far."""
    silent, within = np.uint32(0), np.uint32(0)
    for j in range(raw.size):
        silent = np.uint32(silent + np.uint32(raw[j] == 0))
        within = np.uint32(within + np.uint32((raw[j] != 0) & (raw[j] >= raw_limits[0]) & (raw[j] <= raw_limits[1])))
    return np.int64(silent), raw.size - np.int64(silent) - np.int64(within)


@bare_inner
def reach_of_kept(column, height):
    """Return the number of kept readings, and their lowest and highest height (int64)."""
    good, low, high = 0, np.int32(2**31 - 1), np.int32(-(2**31))
    for j in range(column.size):
        keep = column[j] != NOWHERE
        good += keep
        low = min(low, height[j] if keep else low)
        high = max(high, height[j] if keep else high)
    return good, np.int64(low), np.int64(high)


@bare_inlined
def note_pose(epoch, sigmas, active, touched):
    """Record the epoch and σ of a profile with the tiles that it touched; clear `touched`."""
    for tile in range(touched.size):
        if touched[tile]:
            touched[tile] = 0
            active.spans[tile, 0] = min(active.spans[tile, 0], epoch)
            active.spans[tile, 1] = max(active.spans[tile, 1], epoch)
            active.sigmas[tile, 0] = max(active.sigmas[tile, 0], sigmas[0])
            active.sigmas[tile, 1] = max(active.sigmas[tile, 1], sigmas[1])


@bare
def accumulate_profiles(ranges, measured, flat, georeference, active, pool, work, fates, first):
    """Count the readings of profiles into the cells of active tiles.

    Parameters
    ----------
    ranges : (n, m) uint16, raw, 0 no return.
    measured : Measured, of the n profiles; intensity (n, m).
    flat : FlatProfiles; georeference : Georeference; active : ActiveTiles; pool : Pool; work : CountingWork.
    fates : (≥ FATES,) int64, in/out, counts of readings by fate.
    first : int, profile to begin with.

    Returns
    -------
    int, the profile before which the pool ran short of free elements; n at the end.
    """
    epochs, passes, intensity, gain, interval_sigmas = measured
    rays, middle, scale, raw_limits = flat
    column, row, height = work.readings
    count = ranges.shape[1]
    for tile in range(work.touched.size):
        work.touched[tile] = 0
    k = 0
    for i in range(first, epochs.size):
        if pool.free.size - pool.held[0] < 2 * count:
            return i
        k = find_interval(epochs[i], georeference.poses.knots, k)
        placed, anchors, maps, heights = planes_of(epochs[i], k, middle, georeference)
        if not placed:
            silent, _ = count_out_of_range(ranges[i], raw_limits)
            fates[NO_RETURN] += silent
            fates[NO_POSE] += count - silent
            continue
        plane = plane_of(anchors, maps, heights, active)
        wanted, counted = 0, 0
        for start in range(0, count, PIECE):
            end = min(start + PIECE, count)
            n = end - start
            raw = ranges[i, start:end]
            own = (rays[0, start:end], rays[1, start:end], rays[2, start:end], rays[3, start:end])
            place_profile(raw, own, scale, raw_limits, plane, work.readings)
            silent, apart = count_out_of_range(raw, raw_limits)
            good, low, high = reach_of_kept(column[:n], height)
            wanted += good
            within = n - silent - apart
            fates[NO_RETURN] += silent
            fates[RANGE] += apart
            fates[HEIGHT] += within - good
            if good > 0 and passes[i] >= 0:
                readings = Heights(column[:n], row[:n], height)
                shine = intensity[i, start:end]
                counted += accumulate(readings, (low, high), shine, gain, passes[i], work, active, pool)
        fates[KEPT] += counted
        fates[OUTSIDE] += wanted - counted
        note_pose(epochs[i], (interval_sigmas[k, 0], interval_sigmas[k, 1]), active, work.touched)
    return epochs.size
