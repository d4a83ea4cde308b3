"""Profiles measured at once, near the sensor: their readings → places on the map, or straight into cells.

All readings of such a profile have one pose and lie in one plane, a few metres across. There the map is linear to a
few µm (``points.flat_profiles`` holds the reach to that), so each map coordinate is

    value = anchor + p + q · y + r · z

with the sensor's y and z counted from the middle of the profile. The anchor is a whole number of cells (or quanta);
what is left fits 32-bit floats with a resolution below a tenth of a quantum, and sixteen readings fit a register.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.kernels.accumulate import NOWHERE, PIECE, accumulate
from roadscan.kernels.georeference import (
    CLASS_NO_POSE,
    CLASS_NO_RETURN,
    CLASS_TOO_FAR,
    CLASS_TOO_HIGH,
    CLASS_TOO_LOW,
    CLASS_TOO_NEAR,
    HEIGHT,
    KEPT,
    NO_POSE,
    NO_RETURN,
    OUTSIDE,
    RANGE,
    form_value,
    is_wanted,
    profile_forms,
    tile_and_rest,
)
from roadscan.kernels.options import bare, bare_inlined
from roadscan.kernels.poses import find_interval

HALF = np.float32(0.5)


@bare_inlined
def anchored(form, middle, quanta_per_m):
    """A form of ``profile_forms`` about the profile's middle (y, z): anchor in whole quanta, and (p, q, r)."""
    y, z = middle
    value = form_value(form, y, z) * quanta_per_m
    anchor = np.int64(math.floor(value))
    return anchor, (
        np.float32(value - anchor),
        np.float32((form[1] + 2.0 * form[3] * y + form[4] * z) * quanta_per_m),
        np.float32((form[2] + form[4] * y + 2.0 * form[5] * z) * quanta_per_m),
    )


@bare_inlined
def on_plane(plane, y, z):
    """Value of a plane (p, q, r)."""
    return plane[0] + plane[1] * y + plane[2] * z


@bare_inlined
def planes_of(epoch, k, middle, quanta_per_m, limits, poses):
    """Planes of a profile's easting, northing and height, with the lowest and highest height kept above the anchor.

    Returns
    -------
    placed : bool; anchors : (3,) tuple of int64, easting, northing and height (quanta); planes : three (p, q, r);
    heights : (2,) tuple of float32.
    """
    mounting, knots, coefficients, valid, lattice, table, centres, charts = poses
    placed, forms = profile_forms(epoch, k, mounting, knots, coefficients, valid, lattice, table, centres, charts)
    east_anchor, east = anchored(forms[0], middle, quanta_per_m)
    north_anchor, north = anchored(forms[1], middle, quanta_per_m)
    up_anchor, up = anchored(forms[2], middle, quanta_per_m)
    body = forms[3][0]
    lowest = max(limits[2], body + limits[4]) * quanta_per_m - up_anchor
    highest = min(limits[3], body + limits[5]) * quanta_per_m - up_anchor
    return (
        placed,
        (east_anchor, north_anchor, up_anchor),
        (east, north, up),
        (np.float32(lowest), np.float32(highest)),
    )


@bare_inlined
def whole_cells(anchor, cell_quanta):
    """Cells up to an anchor (int32), and half a quantum more than what is left of it (float32, exact)."""
    cells = math.floor((anchor + 0.5) / cell_quanta)
    return np.int32(cells), np.float32(anchor - np.int64(cells) * cell_quanta + 0.5)


@bare_inlined
def class_of(raw, height, raw_limits, heights):
    """Class of a reading that a filter leaves out; `height` above the anchor."""
    if raw == 0:
        return CLASS_NO_RETURN
    if raw < raw_limits[0]:
        return CLASS_TOO_NEAR
    if raw > raw_limits[1]:
        return CLASS_TOO_FAR
    return CLASS_TOO_LOW if height < heights[0] else CLASS_TOO_HIGH


@bare_inlined
def fate_of(kind):
    """Fate of a class other than kept."""
    if kind == CLASS_NO_RETURN:
        return NO_RETURN
    if kind == CLASS_NO_POSE:
        return NO_POSE
    return RANGE if kind in (CLASS_TOO_NEAR, CLASS_TOO_FAR) else HEIGHT


@bare
def place_profile(
    raw, y0, z0, dy, dz, scale, planes, rests, per_cell, first, raw_limits, heights, column, row, height
):  # fmt: skip
    """Cells and heights of readings of a profile. A function of its own: inside a larger one it stays scalar.

    Parameters
    ----------
    raw : (n,) uint16; y0, z0, dy, dz : (n,) float32, rays, see :func:`accumulate_profiles`; planes : three (p, q, r).
    rests : (2,) tuple of float32, easting and northing left over from :func:`whole_cells`; per_cell : float32.
    first : (3,) tuple of int32, cells to the anchors, east and north, and the anchor of the heights (quanta).
    column, row, height : (n,) int32, out; column NOWHERE for readings that a filter leaves out.
    """
    east, north, up = planes
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


@bare
def count_out_of_range(raw, raw_limits):
    """How many readings have no return, and how many have one that is too near or too far."""
    silent, within = np.uint32(0), np.uint32(0)
    for j in range(raw.size):
        silent = np.uint32(silent + np.uint32(raw[j] == 0))
        within = np.uint32(within + np.uint32((raw[j] != 0) & (raw[j] >= raw_limits[0]) & (raw[j] <= raw_limits[1])))
    return np.int64(silent), raw.size - np.int64(silent) - np.int64(within)


@bare
def reach_of_kept(column, height):
    """How many readings are kept, and their lowest and highest height (int64)."""
    good, low, high = 0, np.int32(2**31 - 1), np.int32(-(2**31))
    for j in range(column.size):
        keep = column[j] != NOWHERE
        good += keep
        low = min(low, height[j] if keep else low)
        high = max(high, height[j] if keep else high)
    return good, np.int64(low), np.int64(high)


@bare
def accumulate_profiles(
    epochs, ranges, intensity, gain, passes, rays, middle, scale, poses, raw_limits, limits, quanta_per_m,
    corner, cell_quanta, edge, tile_rows, groups, pool, work, spans, sigmas, interval_sigmas, fates, first,
):  # fmt: skip
    """Count the readings of profiles into the cells of active tiles.

    Parameters
    ----------
    epochs : (n,) int64, GPS ns; ranges : (n, m) uint16, raw, 0 no return; intensity : (n, m) uint8; gain : uint32,
    what 8 bits are multiplied by.
    passes : (n,) int32, number of each profile's pass among the accumulator's, −1 where it is in none.
    rays : (4, m) float32: y and z of the rays' origins from the middle of the profile (m), y and z of their directions.
    middle : (2,) tuple, y and z (m, sensor); scale : (2,) tuple of float32, range_offset_m, range_step_m.
    poses : tuple (mounting, knots, coefficients, valid, lattice, table, centres, charts), as ``georeference_profiles``.
    raw_limits : (2,) tuple of uint16, lowest and highest raw range kept; limits : (6,) tuple, see LIMITS.
    quanta_per_m : float64; corner : (2,) tuple of int64, south-west corner of
    tile_rows[0, 0] (quanta).
    cell_quanta, edge : int64, edge of a cell; cells along a tile's edge.
    tile_rows, groups, pool, work : see ``kernels.accumulate``.
    spans : (a, 2) int64, in/out, first and last epoch of each active tile.
    sigmas : (a, 2) float64, in/out, largest σ of the poses; interval_sigmas : (knots − 1, 2) float64.
    fates : (6,) int64, in/out, counts of readings by fate.
    first : int, profile to begin with.

    Returns
    -------
    int, the profile before which the pool ran short of free elements; n at the end.
    """
    count = ranges.shape[1]
    per_cell = np.float32(1.0 / cell_quanta)
    column, row, height, of_runs, touched = work
    knots, free, held = poses[1], pool[4], pool[6]
    for tile in range(touched.size):
        touched[tile] = 0
    k = 0
    for i in range(first, epochs.size):
        if free.size - held[0] < 2 * count:
            return i
        k = find_interval(epochs[i], knots, k)
        placed, anchors, planes, heights = planes_of(epochs[i], k, middle, quanta_per_m, limits, poses)
        if not placed:
            silent, _ = count_out_of_range(ranges[i], raw_limits)
            fates[NO_RETURN] += silent
            fates[NO_POSE] += count - silent
            continue
        first_column, east_rest = whole_cells(anchors[0] - corner[0], cell_quanta)
        first_row, north_rest = whole_cells(anchors[1] - corner[1], cell_quanta)
        base = np.int32(anchors[2])
        wanted, counted = 0, 0
        for start in range(0, count, PIECE):
            end = min(start + PIECE, count)
            n = end - start
            raw = ranges[i, start:end]
            y0, z0, dy, dz = rays[0, start:end], rays[1, start:end], rays[2, start:end], rays[3, start:end]
            place_profile(
                raw, y0, z0, dy, dz, scale, planes, (east_rest, north_rest),
                per_cell, (first_column, first_row, base), raw_limits, heights, column, row, height,
            )  # fmt: skip
            silent, apart = count_out_of_range(raw, raw_limits)
            good, low, high = reach_of_kept(column[:n], height)
            wanted += good
            within = n - silent - apart
            fates[NO_RETURN] += silent
            fates[RANGE] += apart
            fates[HEIGHT] += within - good
            if good > 0 and passes[i] >= 0:
                counted += accumulate(
                    column[:n], row[:n], height, low, high,
                    intensity[i, start:end], gain, passes[i], of_runs, tile_rows, groups, edge, pool, touched,
                )  # fmt: skip
        fates[KEPT] += counted
        fates[OUTSIDE] += wanted - counted
        for tile in range(touched.size):
            if touched[tile]:
                touched[tile] = 0
                spans[tile, 0] = min(spans[tile, 0], epochs[i])
                spans[tile, 1] = max(spans[tile, 1], epochs[i])
                sigmas[tile, 0] = max(sigmas[tile, 0], interval_sigmas[k, 0])
                sigmas[tile, 1] = max(sigmas[tile, 1], interval_sigmas[k, 1])
    return epochs.size


@bare
def georeference_flat_profiles(
    epochs, ranges, rays, middle, scale, poses, raw_limits, limits, quanta_per_m, tile_quanta, window,
    rows, readings, tiles, quanta, fates, classes,
):  # fmt: skip
    """Place the readings of profiles as points.

    Parameters
    ----------
    epochs … quanta_per_m : as in :func:`accumulate_profiles`.
    tile_quanta : int64, edge of a tile; window : (4,) tuple of int64, see ``is_wanted``.
    rows : (n·m,) int32, out, index of the profile; readings : (n·m,) int32, out, index in the profile.
    tiles : (n·m, 2) int32, out, column and row; quanta : (n·m, 3) int32, out, x and y from the tile's corner, height.
    fates : (6,) int64, in/out; classes : (n·m,) uint8, out, the class of each reading left out, or (0,).

    Returns
    -------
    int, how many points were written.
    """
    made = 0
    count = ranges.shape[1]
    knots, k = poses[1], 0
    for i in range(epochs.size):
        k = find_interval(epochs[i], knots, k)
        placed, anchors, planes, heights = planes_of(epochs[i], k, middle, quanta_per_m, limits, poses)
        for j in range(count):
            raw = ranges[i, j]
            distance = scale[0] + scale[1] * np.float32(raw)
            y = rays[0, j] + distance * rays[2, j]
            z = rays[1, j] + distance * rays[3, j]
            h = on_plane(planes[2], y, z)
            if not (placed and raw_limits[0] <= raw <= raw_limits[1] and heights[0] <= h <= heights[1]):
                kind = class_of(raw, h, raw_limits, heights) if placed or raw == 0 else CLASS_NO_POSE
                fates[fate_of(kind)] += 1
                if classes.size:
                    classes[i * count + j] = kind
                continue
            column, east = tile_and_rest(anchors[0] + np.int64(np.floor(on_plane(planes[0], y, z) + HALF)), tile_quanta)
            row, north = tile_and_rest(anchors[1] + np.int64(np.floor(on_plane(planes[1], y, z) + HALF)), tile_quanta)
            if not is_wanted(column, row, window):
                fates[OUTSIDE] += 1
                continue
            rows[made] = i
            readings[made] = j
            tiles[made, 0] = column
            tiles[made, 1] = row
            quanta[made, 0] = east
            quanta[made, 1] = north
            quanta[made, 2] = anchors[2] + np.int64(np.floor(h + HALF))
            made += 1
            fates[KEPT] += 1
    return made
