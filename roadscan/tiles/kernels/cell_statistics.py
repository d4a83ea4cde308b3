"""Statistics of a tile's cells from their heights as integers, to the bit independent of the readings' order."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare, bare_inlined, bare_inner, kernel
from roadscan.compute.kernels.arrays import BINS, bounds_of, smallest
from roadscan.compute.kernels.column_statistics import LANES, REACH, statistics_of_64, store_group
from roadscan.compute.kernels.slots import (
    COUNTS,
    LIGHT_SHIFT,
    LIGHTS,
    MARK_SHIFT,
    PASSES,
    SLOT_HEIGHTS,
    SLOT_SIZE,
    WORD_SHIFT,
    WORDS,
    chained_cells,
    open_group,
    prefetch,
    put_apart,
    slot_statistics_of_8,
    slot_statistics_of_28,
)
from roadscan.compute.kernels.streaks import lowest_bit
from roadscan.tiles.kernels.accumulate import header_of, release


class CellColumns(NamedTuple):
    """Columns for c cells with a reading, in order of row and column, of up to p passes each."""

    column: npt.NDArray[np.uint16]
    """(c,) in the tile."""
    row: npt.NDArray[np.uint16]
    """(c,)"""
    readings: npt.NDArray[np.uint32]
    """(c,)"""
    height_mean_m: npt.NDArray[np.float64]
    """(c,)"""
    height_robust_m: npt.NDArray[np.float64]
    """(c,) mean of the heights near the median."""
    height_min_m: npt.NDArray[np.float64]
    """(c,)"""
    height_max_m: npt.NDArray[np.float64]
    """(c,)"""
    height_std_m: npt.NDArray[np.float32]
    """(c,)"""
    intensity_mean: npt.NDArray[np.float32]
    """(c,)"""
    pass_offsets: npt.NDArray[np.int32]
    """(c + 1,) first pass of each cell, and the end."""
    pass_ids: npt.NDArray[np.uint16]
    """(c · p,) ids of each cell's passes, ascending."""


@bare_inlined
def write_statistics(out, lane, cell, columns):
    """Write a lane of `out`, see ``column_statistics.statistics_of``, as the statistics of a cell."""
    columns.height_mean_m[cell], columns.height_robust_m[cell] = out[0, lane], out[1, lane]
    columns.height_min_m[cell], columns.height_max_m[cell] = out[2, lane], out[3, lane]
    columns.height_std_m[cell], columns.intensity_mean[cell] = np.float32(out[4, lane]), np.float32(out[5, lane])


_MEAN, _ROBUST, _LOW, _HIGH, _DEVIATION, _BRIGHT = range(6)  # Rows of the statistics.


def select_arrays(most: int) -> tuple[Any, ...]:
    """Return the working arrays of `statistics_of_full`; `most`: heights that a cell may have."""
    return np.empty(most, np.int32), np.empty(BINS, np.int32), np.empty(most + 1, np.int32)


@bare
def differences(heights, base, out):
    """Write heights (n,) int32 relative to a base into out (≥ n,) int32."""
    for k in range(heights.size):
        out[k] = heights[k] - base


@bare
def distances(heights, middle, out):
    """Write distances of heights (n,) int32 from another into out (≥ n,) int32."""
    for k in range(heights.size):
        out[k] = abs(heights[k] - middle)


@bare_inner
def sums_of(heights, middle, reach):
    """Return sum and sum of squares of (n,) int32 less a middle, number within reach, and their sum."""
    total, squares, used, near = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for k in range(heights.size):
        d = np.int64(heights[k]) - middle
        inside = np.int64((d <= reach) & (d >= -reach))
        total += d
        squares += d * d
        used += inside
        near += d * inside
    return total, squares, used, near


@bare
def statistics_of_full(heights, light, floor, quantum_m, select, out, lane):
    """Write the statistics of one cell of n readings, as ``column_statistics.statistics_of``, into out[:, lane].

    heights : (n,) int32; light : int64, sum of intensities; select : work, see :func:`select_arrays`.
    """
    work, bins, found = select
    n, base = heights.size, heights[0]
    differences(heights, base, work)
    median = smallest(work[:n], (n - 1) // 2, bins, found)
    middle = np.int64(base) + median
    distances(heights, np.int32(middle), work)
    low, high = bounds_of(heights)
    reach = np.int64(math.floor(max(REACH * smallest(work[:n], (n - 1) // 2, bins, found), floor)))
    total, squares, used, near = sums_of(heights, middle, reach)
    average = total / n
    out[_MEAN, lane] = (middle + average) * quantum_m
    out[_ROBUST, lane] = (middle + near / used) * quantum_m
    out[_LOW, lane] = low * quantum_m
    out[_HIGH, lane] = high * quantum_m
    out[_DEVIATION, lane] = math.sqrt(max(squares / n - average * average, 0.0)) * quantum_m
    out[_BRIGHT, lane] = light / n


AHEAD = 2
"""Number of groups whose slots are prefetched."""
STATISTICS = 6
"""Number of statistics: mean, robust, lowest and highest height, standard deviation, mean intensity."""
AT_ONCE = 64
"""Most heights of a cell for which sixteen cells are processed together; fuller cells are processed singly."""


def work_arrays(most: int) -> tuple[Any, ...]:
    """Return the working arrays of `finish_cells`; `most`: heights that a cell may have."""
    pairs, table = np.zeros((SLOT_HEIGHTS // 2, LANES), np.int32), np.zeros((AT_ONCE, LANES), np.int32)
    rows, out = np.zeros((4, LANES), np.int32), np.zeros((STATISTICS, LANES))
    return pairs, table, *rows, out, np.empty(most, np.int32), select_arrays(most)


@bare
def find_groups(groups, chain, found):
    """Find the groups of a tile that have an element, in order, and the largest number of slots of a cell.

    groups : (g,) int32; found : (g + AHEAD,) int32, out, the numbers of these groups.

    Returns
    -------
    count, most : int.
    """
    count, most = np.uint64(0), 1
    for group in range(np.uint64(groups.size)):
        found[count] = group
        count += np.uint64(groups[group] >= 0)
    for k in range(count):
        first_slot = np.int64(groups[found[k]]) * LANES
        longer = chained_cells(chain, np.uint64(first_slot))
        while longer:
            slots, slot = 0, first_slot + np.int64(lowest_bit(longer))
            while slot >= 0:
                slots += 1
                slot = np.int64(chain[slot])
            most = max(most, slots)
            longer &= longer - np.uint64(1)
    for k in range(np.uint64(AHEAD)):
        found[count + k] = found[count - np.uint64(1)] if count > 0 else 0
    return np.int64(count), most


@bare_inlined
def add_chains(first_slot, longer, pool, heights, counts, light, marks):
    """Add the heights of further slots of a group's cells, relative to the base of the cell's first slot.

    longer : uint64, a bit for each cell that has further slots.
    heights : (AT_ONCE, LANES) int32, in/out, as far as it reaches; counts, light, marks : (LANES,) int32, in/out; light
    only serves cells of up to AT_ONCE heights: that of fuller ones may not fit.
    """
    bases, chain, slots = pool.bases, pool.chain, pool.slots
    unseen = longer
    while unseen:
        further = np.uint64(chain[first_slot + np.int64(lowest_bit(unseen))])
        prefetch(slots, further * np.uint64(SLOT_SIZE))
        unseen &= unseen - np.uint64(1)
    while longer:
        lane = np.int64(lowest_bit(longer))
        longer &= longer - np.uint64(1)
        slot = np.int64(chain[first_slot + lane])
        while slot >= 0:
            header = header_of(slot, pool)
            size = np.int32(header & np.uint64(COUNTS))
            shift = bases[slot] - bases[first_slot + lane]
            for k in range(min(size, AT_ONCE - counts[lane])):
                heights[counts[lane] + k, lane] = np.int32(slots[slot * SLOT_SIZE + k]) + shift
            counts[lane] += size
            light[lane] += np.int32((header >> np.uint64(LIGHT_SHIFT)) & np.uint64(LIGHTS))
            marks[lane] |= np.int32(header >> np.uint64(MARK_SHIFT))
            slot = np.int64(chain[slot])


@bare_inner
def gather_many(first_slot, pool, heights):
    """Collect all heights (quanta) of a cell as int32; return their number and the sum of their intensities."""
    n, light, slot = 0, np.int64(0), first_slot
    while slot >= 0:
        header = header_of(slot, pool)
        light += np.int64((header >> np.uint64(LIGHT_SHIFT)) & np.uint64(LIGHTS))
        for k in range(np.int64(header & np.uint64(COUNTS))):
            heights[n] = pool.bases[slot] + np.int32(pool.slots[slot * SLOT_SIZE + k])
            n += 1
        slot = np.int64(pool.chain[slot])
    return n, light


@bare_inlined
def write_passes(first_slot, marks, numbers, pool, written, pass_ids):
    """Write the ids of a cell's passes, ascending. Return the end of what is written."""
    if numbers.size <= PASSES:
        for p in range(numbers.size):
            if (marks >> p) & 1:
                pass_ids[written] = numbers[p]
                written += 1
        return written
    for p in range(numbers.size):
        slot, seen = first_slot, False
        while slot >= 0:
            header = header_of(slot, pool)
            word = np.int64((header >> np.uint64(WORD_SHIFT)) & np.uint64(WORDS))
            own = np.int64(header >> np.uint64(MARK_SHIFT))
            seen |= (word == p // PASSES) & ((own >> (p % PASSES)) & 1 == 1)
            slot = np.int64(pool.chain[slot])
        if seen:
            pass_ids[written] = numbers[p]
            written += 1
    return written


@bare
def finish_cells(groups, found, taken, edge, pool, floor, quantum_m, numbers, work, columns):
    """Write the statistics of all cells of a tile with a reading, and free its groups.

    Parameters
    ----------
    groups : (g,) int32, in/out, of the tile, −1 everywhere when done; pool : Pool.
    found, taken : from :func:`find_groups`.
    edge : int64, cells along a tile's edge.
    floor : float64, distance from the median (quanta) up to which heights always count; quantum_m : float64, m.
    numbers : (p,) uint16, ascending, ids of the passes by their numbers.
    work : as :func:`work_arrays` makes them, for all heights of the fullest cell.
    columns : CellColumns, out, with room for all cells of the tile's groups.

    Returns
    -------
    cells, ids : int, how many cells and pass ids were written.
    """
    slots, bases, chain = pool.slots, pool.bases, pool.chain
    pairs, heights, counts, light, marks, own_bases, out, many, select = work
    per_row = (edge + LANES - 1) // LANES
    cell, written = 0, 0
    for k in range(taken):
        group = np.int64(found[k])
        element = np.int64(groups[group])
        later = np.uint64(groups[found[k + AHEAD]]) * np.uint64(LANES * SLOT_SIZE)
        for lane in range(LANES):
            prefetch(slots, later + np.uint64(lane * SLOT_SIZE))
        prefetch(chain, later // np.uint64(SLOT_SIZE))
        prefetch(bases, later // np.uint64(SLOT_SIZE))
        first_slot = element * LANES
        open_group(slots, np.uint64(first_slot * SLOT_SIZE), pairs, counts, light, marks)
        longer = chained_cells(chain, np.uint64(first_slot))
        if longer:
            put_apart(pairs, heights)
            add_chains(first_slot, longer, pool, heights, counts, light, marks)
        most, least = np.int32(0), counts[0]
        for lane in range(LANES):
            most, least = max(most, counts[lane]), min(least, counts[lane])
            own_bases[lane] = bases[first_slot + lane]
        if most <= 8 and not longer:
            slot_statistics_of_8(pairs, counts, light, own_bases, floor, quantum_m, out)
        elif not longer:
            slot_statistics_of_28(pairs, counts, light, own_bases, floor, quantum_m, out)
        elif most <= AT_ONCE:
            statistics_of_64(heights, counts, light, own_bases, floor, quantum_m, out)
        else:
            for lane in range(LANES):
                if counts[lane] > 0:
                    n, shine = gather_many(first_slot + lane, pool, many)
                    statistics_of_full(many[:n], shine, floor, quantum_m, select, out, lane)
        if least > 0 and numbers.size == 1:
            store_group(
                out, counts, np.uint16((group % per_row) * LANES), np.uint16(group // per_row), np.uint64(cell),
                np.int32(written), numbers[0], columns,
            )  # fmt: skip
            cell += LANES
            written += LANES
            release(element, longer, pool)
            groups[group] = -1
            continue
        for lane in range(LANES):
            if counts[lane] > 0:
                columns.column[cell] = (group % per_row) * LANES + lane
                columns.row[cell] = group // per_row
                columns.readings[cell] = counts[lane]
                write_statistics(out, lane, cell, columns)
                columns.pass_offsets[cell] = written
                written = write_passes(first_slot + lane, marks[lane], numbers, pool, written, columns.pass_ids)
                cell += 1
        release(element, longer, pool)
        groups[group] = -1
    columns.pass_offsets[cell] = written
    return cell, written


_BINS = 1 << 15  # Bins of the highest bits of a 32-bit number of 0 and above.


@kernel
def totals(count, intensity, height):
    """Return sums over cells: points, intensities of the points, heights.

    Parameters
    ----------
    count : (n,) uint32; intensity : (n,) float32, mean of a cell's points; height : (n,) float64.
    """
    points, light, high = 0, 0.0, 0.0
    for i in range(count.size):
        points += np.int64(count[i])
        light += np.float64(intensity[i]) * np.float64(count[i])
        high += height[i]
    return points, light, high


@kernel
def _bins(bits, counts):
    for i in range(bits.size):
        counts[bits[i] >> np.uint32(16)] += 1


@kernel
def _within(bits, first, last, found):
    """Collect the numbers of some bins; `found` has room for one more."""
    n = 0
    for i in range(bits.size):
        own = bits[i] >> np.uint32(16)
        found[n] = bits[i]
        n += np.int64(own >= first) & np.int64(own <= last)


def median(values: npt.NDArray[np.float32]) -> float:
    """Return the median of (n ≥ 1,) float32 of 0 and above; their bits sort like the numbers, so bins are counted."""
    bits = (values + np.float32(0.0)).view(np.uint32)
    counts = np.zeros(_BINS, np.int64)
    _bins(bits, counts)
    upto = np.cumsum(counts)
    low, high = (bits.size - 1) // 2, bits.size // 2
    first, last = np.searchsorted(upto, (low, high), side="right")
    found = np.empty(int(upto[last] - upto[first] + counts[first]) + 1, np.uint32)
    _within(bits, first, last, found)
    found = np.sort(found[:-1])
    below = int(upto[first] - counts[first])
    return float((found[[low - below, high - below]].view(np.float32)).mean())
