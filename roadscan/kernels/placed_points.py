"""Readings with an epoch each become rows of points: placed chunk by chunk, those wanted written one after another."""

from __future__ import annotations

import numpy as np

from roadscan.kernels.georeference import CLASS_KEPT, KEPT, OUTSIDE, is_wanted, tile_and_rest
from roadscan.kernels.options import kernel
from roadscan.kernels.placing import CHUNK, place_mirror, place_returns


@kernel
def keep_points(
    first, made, east, north, height, classes, tile_quanta, window, rows, tiles, quanta, fates, marks
):  # fmt: skip
    """Append the readings that are kept and lie in the window; classes go to `marks` unless it is empty.

    Parameters
    ----------
    first : int64, number of the first reading; made : int64, points written before.
    east, north, height : (n,) float64, whole quanta; classes : (n,) uint8.
    Others as in :func:`georeference_returns`; `rows` are numbers of readings.

    Returns
    -------
    int, how many points are written now.
    """
    if marks.size:
        for i in range(classes.size):
            marks[first + i] = classes[i]
    for i in range(classes.size):
        if classes[i] != CLASS_KEPT:
            continue
        column, x = tile_and_rest(np.int64(east[i]), tile_quanta)
        row, y = tile_and_rest(np.int64(north[i]), tile_quanta)
        if not is_wanted(column, row, window):
            fates[OUTSIDE] += 1
            continue
        rows[made] = first + i
        tiles[made, 0] = column
        tiles[made, 1] = row
        quanta[made, 0] = x
        quanta[made, 1] = y
        quanta[made, 2] = np.int64(height[i])
        made += 1
        fates[KEPT] += 1
    return made


@kernel
def georeference_returns(
    pose_epochs, x, y, z, mounting, knots, coefficients, valid, lattice, table, centres, charts,
    limits, quanta_per_m, tile_quanta, window, rows, tiles, quanta, fates, marks,
):  # fmt: skip
    """Place returns and keep those in the window.

    Parameters
    ----------
    tile_quanta : int64, edge of a tile.
    window : (4,) tuple of int64, first column, first row, end column, end row of the tiles wanted.
    rows : (n,) int32, out, index of the return; tiles : (n, 2) int32, out, column and row;
    quanta : (n, 3) int32, out, x and y from the tile's south-west corner, and height.
    fates : (6,) int64, in/out, counts by fate.
    marks : (n,) uint8, out, class of every return; or (0,) where not wanted.
    Others as in :func:`~roadscan.kernels.placing.place_returns`.

    Returns
    -------
    int, how many points were written.
    """
    east, north, height = np.empty(CHUNK), np.empty(CHUNK), np.empty(CHUNK)
    classes, intervals = np.empty(CHUNK, np.uint8), np.empty(CHUNK, np.int32)
    made = np.int64(0)
    for start in range(0, pose_epochs.size, CHUNK):
        end = min(start + CHUNK, pose_epochs.size)
        place_returns(
            start, end, pose_epochs, x, y, z, mounting, knots, coefficients, valid, lattice, table, centres, charts,
            limits, quanta_per_m, east, north, height, classes, intervals, fates,
        )  # fmt: skip
        n = end - start
        made = keep_points(
            start, made, east[:n], north[:n], height[:n], classes[:n],
            tile_quanta, window, rows, tiles, quanta, fates, marks,
        )  # fmt: skip
    return made


@kernel
def georeference_mirror(
    profile_epochs, ranges, origins, directions, scale, reading_period_ns,
    mounting, knots, coefficients, valid, lattice, table, centres, charts,
    limits, quanta_per_m, tile_quanta, window, rows, readings, tiles, quanta, fates, marks,
):  # fmt: skip
    """Place the readings of a turning mirror's profiles and keep those in the window.

    Parameters
    ----------
    rows : (n·m,) int32, out, index of the profile; readings : (n·m,) int32, out, index in the profile.
    Others as in :func:`~roadscan.kernels.placing.place_mirror` and :func:`georeference_returns`.

    Returns
    -------
    int, how many points were written.
    """
    m = ranges.shape[1]
    profiles = max(CHUNK // m, 1)
    east, north, height = np.empty(profiles * m), np.empty(profiles * m), np.empty(profiles * m)
    classes, intervals = np.empty(profiles * m, np.uint8), np.empty(profiles * m, np.int32)
    made = np.int64(0)
    for start in range(0, profile_epochs.size, profiles):
        end = min(start + profiles, profile_epochs.size)
        place_mirror(
            start, end, profile_epochs, ranges, origins, directions, scale, reading_period_ns,
            mounting, knots, coefficients, valid, lattice, table, centres, charts,
            limits, quanta_per_m, east, north, height, classes, intervals, fates,
        )  # fmt: skip
        n = (end - start) * m
        made = keep_points(
            start * m, made, east[:n], north[:n], height[:n], classes[:n],
            tile_quanta, window, rows, tiles, quanta, fates, marks,
        )  # fmt: skip
    for i in range(made):
        readings[i] = rows[i] % m
        rows[i] //= m
    return made
