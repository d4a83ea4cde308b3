"""Counts readings into cells in one pass, and the pool of memory that keeps their heights until a tile is finished.

The pool allocates slots of 64 bytes, sixteen at a time. The heights of a cell are stored in a *slot*
(``compute.kernels.slots``). Sixteen adjacent cells along a row of a tile form a *group*. With its first reading, a
group gets an *element* of the pool: a slot for each of its cells. A cell with more readings, or with heights too far
from the base for 16 bits, or of more passes than a header has bits for, chains spare slots behind its first one.

The order of the readings affects the layout in memory, but not the statistics (``tiles.kernels.cell_statistics``).

Neighbouring readings of a profile mostly lie in one cell, so readings are counted in *streaks*: the cell is looked up
once per streak, and the heights of a streak are stored as one vector. Flat profiles, whose readings are taken at one
instant near the sensor, are counted without writing points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare, bare_inlined, bare_inner
from roadscan.compute.kernels.arrays import bounds_of
from roadscan.compute.kernels.column_statistics import LANES
from roadscan.compute.kernels.slots import (
    COUNTS,
    FARTHEST,
    LAST,
    LIGHT_SHIFT,
    MARK_SHIFT,
    PASSES,
    SLOT_HEADERS,
    SLOT_HEIGHTS,
    SLOT_SIZE,
    VECTOR,
    WORD_SHIFT,
    WORDS,
    prefetch,
    store_heights,
)
from roadscan.compute.kernels.streaks import AT_ONCE, find_known_slots, find_streaks, lowest_bit, sum_up
from roadscan.georeference.kernels.flat_profiles import HALF, on_plane, planes_of
from roadscan.georeference.kernels.readings import HEIGHT, KEPT, NO_POSE, NO_RETURN, OUTSIDE, RANGE
from roadscan.poses.kernels.poses import find_interval


class Pool(NamedTuple):
    """c elements of LANES slots each."""

    slots: npt.NDArray[np.int16]
    """(c · LANES · SLOT_SIZE,) beginning with a line of the cache."""
    headers: npt.NDArray[np.uint64]
    """(c · LANES · SLOT_HEADERS,) the same memory; of each slot the last is its header."""
    bases: npt.NDArray[np.int32]
    """(c · LANES,) height (quanta) from which those of each slot are counted."""
    chain: npt.NDArray[np.int32]
    """(c · LANES,) next slot of the cell, −1 for none."""
    free: npt.NDArray[np.int32]
    """(c,) stack of free elements."""
    spare: npt.NDArray[np.int32]
    """(c · LANES,) stack of spare slots."""
    held: npt.NDArray[np.int64]
    """(2,) elements in use, spare slots."""


@bare_inlined
def header_of(slot, pool):
    """Return the header of a slot."""
    return pool.headers[slot * SLOT_HEADERS + SLOT_HEADERS - 1]


@bare_inlined
def header_of_pass(number):
    """Return what a pass sets in a header, its bit and its word (uint64)."""
    word, bit = np.uint64(number // PASSES), np.uint64(number % PASSES)
    return (word << np.uint64(WORD_SHIFT)) | (np.uint64(1) << (bit + np.uint64(MARK_SHIFT)))


@bare_inlined
def new_group(height, pool):
    """Take an element from the free list, with empty slots based on a height (quanta)."""
    e = pool.free[pool.held[0]]
    pool.held[0] += 1
    for slot in range(np.uint64(e) * np.uint64(LANES), np.uint64(e + 1) * np.uint64(LANES)):
        pool.headers[slot * np.uint64(SLOT_HEADERS) + np.uint64(SLOT_HEADERS - 1)] = 0
        pool.bases[slot] = height
        pool.chain[slot] = -1
    return e


@bare_inlined
def new_slot(height, pool):
    """Take an empty slot from the spare ones; if there is none, turn an element into spare slots."""
    held, spare = pool.held, pool.spare
    if held[1] == 0:
        e = new_group(height, pool)
        for lane in range(LANES):
            spare[lane] = e * LANES + LANES - 1 - lane
        held[1] = LANES
    held[1] -= 1
    slot = spare[held[1]]
    pool.headers[slot * SLOT_HEADERS + SLOT_HEADERS - 1] = 0
    pool.bases[slot] = height
    pool.chain[slot] = -1
    return slot


@bare_inlined
def slot_with_room(own, size, low, high, word, pool):
    """Return a slot of the chain from `own` that takes `size` more heights from `low` to `high`; −1 where none does."""
    slot = np.int64(own)
    while slot >= 0:
        header = header_of(slot, pool)
        used = np.int64(header & np.uint64(COUNTS))
        base = np.int64(pool.bases[slot])
        fits = (used + size <= SLOT_HEIGHTS) & (low - base >= -FARTHEST) & (high - base <= FARTHEST)
        if fits & ((used == 0) | (header & np.uint64(WORDS << WORD_SHIFT) == word)):
            return slot
        slot = np.int64(pool.chain[slot])
    return slot


@bare_inlined
def longer_chain(own, height, pool):
    """Insert a new slot after `own`, before the older ones, which are full."""
    slot = np.int64(new_slot(height, pool))
    pool.chain[slot] = pool.chain[own]
    pool.chain[own] = slot
    return slot


@bare_inlined
def release(element, longer, pool):
    """Free a group's element and the further slots of its cells; longer: uint64, a bit for each such cell."""
    held, chain = pool.held, pool.chain
    while longer:
        slot = np.int64(chain[element * LANES + np.int64(lowest_bit(longer))])
        longer &= longer - np.uint64(1)
        while slot >= 0:
            pool.spare[held[1]] = slot
            held[1] += 1
            slot = np.int64(chain[slot])
    held[0] -= 1
    pool.free[held[0]] = element


NOWHERE = -(1 << 30)
"""Column of a reading that does not count: outside every tile."""
AHEAD = 12
"""Number of streaks whose slots are prefetched."""
PIECE = 1024
"""Readings per pass of the loops: their working arrays fit the first-level cache."""


class Heights(NamedTuple):
    """Cells and heights of readings."""

    column: npt.NDArray[np.int32]
    """(n,) cell from the south-west corner of the box of tiles; NOWHERE for readings that a filter leaves out."""
    row: npt.NDArray[np.int32]
    """(n,)"""
    height: npt.NDArray[np.int32]
    """(n + VECTOR,) quanta of the map; what follows the n-th is read, but not counted."""


class Streaks(NamedTuple):
    """Up to n streaks, each of readings in one cell."""

    starts: npt.NDArray[np.uint32]
    """(n + 1,) first reading of each streak, and the end."""
    sums: npt.NDArray[np.uint32]
    """(n + 1,) sum of the intensities before each reading."""
    columns: npt.NDArray[np.int32]
    """(n + 16,) cell of each streak."""
    rows: npt.NDArray[np.int32]
    """(n + 16,)"""
    slots: npt.NDArray[np.int32]
    """(n + 16,) first slot of the streak's cell, −1 outside the active tiles."""


class CountingWork(NamedTuple):
    """Working arrays for one piece of readings at a time."""

    readings: Heights
    streaks: Streaks
    touched: npt.NDArray[np.uint8]
    """(a,) 1 for each active tile with a reading."""


def work_arrays(tiles: int) -> CountingWork:
    """Return working arrays for so many active tiles."""
    streaks = Streaks(
        starts=np.empty(PIECE + 1, np.uint32),
        sums=np.empty(PIECE + 1, np.uint32),
        columns=np.zeros(PIECE + AT_ONCE, np.int32),
        rows=np.zeros(PIECE + AT_ONCE, np.int32),
        slots=np.empty(PIECE + AT_ONCE, np.int32),
    )
    readings = Heights(np.empty(PIECE, np.int32), np.empty(PIECE, np.int32), np.zeros(PIECE + VECTOR, np.int32))
    return CountingWork(readings, streaks, np.zeros(tiles, np.uint8))


@bare_inner
def count_slowly(own, heights, intensity, gain, first, end, mark, pool):
    """Count readings `first` to `end` − 1 one by one into the cell that begins with slot `own`."""
    headers, bases = pool.headers, pool.bases
    for j in range(first, end):
        height = np.int64(heights[j])
        word = mark & np.uint64(WORDS << WORD_SHIFT)
        slot = slot_with_room(own, 1, height, height, word, pool)
        if slot < 0:
            slot = longer_chain(own, height, pool)
        at = slot * SLOT_HEADERS + SLOT_HEADERS - 1
        pool.slots[slot * SLOT_SIZE + np.int64(headers[at] & np.uint64(COUNTS))] = np.int16(height - bases[slot])
        shine = np.uint64(gain) * np.uint64(intensity[j])
        headers[at] = (headers[at] + np.uint64(1) + (shine << np.uint64(LIGHT_SHIFT))) | mark


@bare_inlined
def slot_of_streak(own, heights, first, end, word, pool):
    """Return the slot with room for a streak in the cell that begins with `own`; −1 where heights are too far apart."""
    low, high = np.int64(heights[first]), np.int64(heights[first])
    for j in range(first, end):
        low, high = min(low, np.int64(heights[j])), max(high, np.int64(heights[j]))
    slot = slot_with_room(own, np.int64(end - first), low, high, word, pool)
    if slot < 0 and high - low <= FARTHEST:
        slot = longer_chain(own, low, pool)
    return slot


@bare_inlined
def store_streak(heights, first, size, base, slots, slot, used):
    """Write the heights of a streak after the `used` ones of the slot that begins at `slot`.

    A whole vector is written, not the part of one, which takes AMD's Zen 4 twenty cycles: what lies beyond the streak's
    heights is overwritten by the next streak, or by the header, which is written last.
    """
    if used <= np.uint64(LAST):
        store_heights(heights, first, base, slots, slot + used)
        return
    for k in range(size):
        slots[slot + used + k] = np.int16(heights[first + k] - base)


@bare_inlined
def tile_at(x, y, edge, tile_rows):
    """Return the south-west cell of the tile that contains cell (x, y), and its row in `groups`, −1 where inactive."""
    across, along = x // edge, y // edge
    inside = (along >= 0) & (along < tile_rows.shape[0]) & (across >= 0) & (across < tile_rows.shape[1])
    return across * edge, along * edge, np.int64(tile_rows[along, across]) if inside else np.int64(-1)


@bare_inner
def find_slots(heights, streaks, count, active, pool, touched):
    """Write the first slot of each streak's cell, −1 outside the active tiles, into `streaks`. Takes new groups.

    heights : (n,) int32, of the readings; count : uint64, streaks.
    """
    starts, _, columns, rows, slots = streaks
    groups, edge = active.groups, active.edge
    per_row, per_tile = (edge + LANES - 1) // LANES, groups.shape[1]
    table = groups.reshape(-1)
    west, south, tile = np.int64(NOWHERE), np.int64(NOWHERE), np.int64(-1)
    block = np.uint64(0)
    while block < count:
        own = (np.int32(west), np.int32(south), np.int32(edge if tile >= 0 else 0), np.int32(per_row))
        at = np.uint64(max(tile, 0) * per_tile)
        unknown = find_known_slots(columns, rows, block, count, own, np.int32(NOWHERE), table, at, slots)
        while unknown:
            streak = block + lowest_bit(unknown)
            unknown &= unknown - np.uint64(1)
            x, y = np.int64(columns[streak]), np.int64(rows[streak])
            if not (west <= x < west + edge and south <= y < south + edge):
                west, south, tile = tile_at(x, y, edge, active.rows)
                if tile >= 0:
                    touched[tile] = 1
            if tile < 0:
                continue
            place = np.uint64(tile * per_tile + (y - south) * per_row + ((x - west) >> 4))
            found = table[place]
            if found < 0:
                found = new_group(heights[np.uint64(starts[streak])], pool)
                table[place] = found
            slots[streak] = found * LANES + ((x - west) & 15)
        block += np.uint64(AT_ONCE)


@bare
def accumulate(readings, bounds, intensity, gain, number, work, active, pool):
    """Count readings into the cells of active tiles.

    Parameters
    ----------
    readings : Heights; bounds : (2,) tuple of int, no height lies below the first or above the second.
    intensity : (n,) unsigned; gain : uint32; their product takes at most 16 bits.
    number : int, of the readings' pass among the accumulator's.
    work : CountingWork, of which the readings are not used.
    active : ActiveTiles; pool : Pool, of which at least 2 n elements have to be free.

    Returns
    -------
    int, how many readings were counted; the other wanted ones lie outside the active tiles.
    """
    column, row, heights = readings
    low, high = bounds
    streaks = work.streaks
    starts, sums, columns, rows, slots = streaks
    bases, headers = pool.bases, pool.headers
    mark = header_of_pass(number)
    word = mark & np.uint64(WORDS << WORD_SHIFT)
    sum_up(intensity, sums)
    count = find_streaks(column, row, starts, columns, rows)
    find_slots(heights, streaks, count, active, pool, work.touched)
    counted = np.int64(0)
    for streak in range(count):
        prefetch(pool.slots, np.uint64(slots[streak + np.uint64(AHEAD)]) * np.uint64(SLOT_SIZE))
        if slots[streak] < 0:
            continue
        own = np.uint64(slots[streak])
        first, end = np.uint64(starts[streak]), np.uint64(starts[streak + np.uint64(1)])
        counted += np.int64(end - first)
        while first < end:
            size = min(end - first, np.uint64(VECTOR))
            slot, base = own, np.int64(bases[own])
            at = slot * np.uint64(SLOT_HEADERS) + np.uint64(SLOT_HEADERS - 1)
            header = headers[at]
            used = header & np.uint64(COUNTS)
            fits = (used + size <= np.uint64(SLOT_HEIGHTS)) & (low - base >= -FARTHEST) & (high - base <= FARTHEST)
            if not (fits & (header & np.uint64(WORDS << WORD_SHIFT) == word)):
                other = slot_of_streak(own, heights, first, first + size, word, pool)
                if other < 0:
                    count_slowly(own, heights, intensity, gain, first, first + size, mark, pool)
                    first += size
                    continue
                slot = np.uint64(other)
                base, at = np.int64(bases[slot]), slot * np.uint64(SLOT_HEADERS) + np.uint64(SLOT_HEADERS - 1)
                header = headers[at]
                used = header & np.uint64(COUNTS)
            store_streak(heights, first, size, np.int32(base), pool.slots, slot * np.uint64(SLOT_SIZE), used)
            shine = np.uint64(gain) * np.uint64(sums[first + size] - sums[first])
            headers[at] = (header + size + (shine << np.uint64(LIGHT_SHIFT))) | mark
            first += size
    return counted


@bare_inlined
def end_of_pass(passes, start, most):
    """Return the end of the readings of one pass from `start` on, at most so many."""
    end, last = start, min(start + most, passes.size)
    while end < last and passes[end] == passes[start]:
        end += 1
    return end


@bare
def accumulate_cells(readings, passes, intensity, active, pool, work, fates, first):
    """Count readings whose cells are known, best in the order of cells.

    Parameters
    ----------
    readings : Heights, all in active tiles.
    passes : (n,) int32, number of the reading's pass among the accumulator's; intensity : (n,) uint16.
    active : ActiveTiles; pool : Pool; work : CountingWork.
    fates : (≥ FATES,) int64, in/out, readings that were kept.
    first : int, reading to begin with.

    Returns
    -------
    int, the reading before which the pool ran short of free elements; n at the end.
    """
    column, row, heights = readings
    start = first
    while start < column.size:
        if pool.free.size - pool.held[0] < 2 * PIECE:
            return start
        end = end_of_pass(passes, start, PIECE)
        own = Heights(column[start:end], row[start:end], heights[start : end + VECTOR])
        bounds = bounds_of(heights[start:end])
        fates[KEPT] += accumulate(
            own, bounds, intensity[start:end], np.uint32(1), passes[start], work, active, pool
        )  # fmt: skip
        start = end
    return start


@bare
def accumulate_points(x, y, height, passes, intensity, active, pool, work, first):
    """Count the points of one tile into its cells.

    Parameters
    ----------
    x, y, height : (n,) int32, quanta, x and y from the tile's south-west corner, not negative.
    passes : (n,) int32, number of each point's pass among the accumulator's; intensity : (n,) uint16.
    active : ActiveTiles, the tile alone; pool : Pool; work : CountingWork.
    first : int, point to begin with.

    Returns
    -------
    int, the point before which the pool ran short of free elements; n at the end.
    """
    column, row, heights = work.readings
    start = first
    while start < x.size:
        if pool.free.size - pool.held[0] < 2 * PIECE:
            return start
        end = end_of_pass(passes, start, PIECE)
        n = end - start
        find_cells(x[start:end], y[start:end], 1.0 / active.cell_quanta, column, row)
        for j in range(n):
            heights[j] = height[start + j]
        own = Heights(column[:n], row[:n], heights)
        accumulate(
            own, bounds_of(heights[:n]), intensity[start:end], np.uint32(1), passes[start], work, active, pool
        )  # fmt: skip
        start = end
    return start


@bare
def find_cells(x, y, per_cell, column, row):
    """Write the cells (≥ n,) int32, out, of points; x, y: (n,) int32, quanta from the tile's south-west corner."""
    for j in range(x.size):
        column[j] = np.int32(np.floor((x[j] + 0.5) * per_cell))
        row[j] = np.int32(np.floor((y[j] + 0.5) * per_cell))


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
