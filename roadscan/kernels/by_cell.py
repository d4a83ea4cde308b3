"""Readings with an epoch each, from their places into the order of cells.

A turning mirror or a lidar looks elsewhere with every reading: counted as they come, each reading waits for the cells'
memory. A few hundred thousand at once, sorted by cell, walk through it, and many fall into one cell after another.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.kernels.line_access import VECTOR
from roadscan.kernels.options import bare

DIGIT = 11
"""Bits that are sorted at a time: the ends of so many lists stay in the first cache."""
BAND_SHIFT = 14
"""Heights of a cell are sorted by bands of 2^14 quanta (16 cm), two of which share a line."""


@bare
def bits_of(number):
    """Bits that a number from 0 to `number` takes."""
    bits = np.uint64(0)
    while number > 0:
        number >>= 1
        bits += np.uint64(1)
    return bits


@bare
def span_of(values):
    """Smallest and largest of (n,) int32, as int64."""
    low, high = values[0], values[0]
    for i in range(values.size):
        low, high = min(low, values[i]), max(high, values[i])
    return np.int64(low), np.int64(high)


@bare
def sort_by_cell(column, row, heights, keys, others, ends):
    """Order of readings by row, column and band of height; within a band as they come.

    Parameters
    ----------
    column, row, heights : (n,) int32.
    keys, others : (n,) uint64, work; ends : (2 ** DIGIT,) int64, work.

    Returns
    -------
    sorted : keys or others; order : their lowest bits, as many as the second value, are positions.
    bits : uint64.
    """
    n = column.size
    (west, east), (south, north), (low, high) = span_of(column), span_of(row), span_of(heights)
    place, bands = bits_of(n), bits_of((high - low) >> BAND_SHIFT)
    columns, rows = bits_of(east - west), bits_of(north - south)
    for i in range(n):
        band = np.uint64((np.int64(heights[i]) - low) >> BAND_SHIFT)
        cell = (np.uint64(np.int64(row[i]) - south) << columns) | np.uint64(np.int64(column[i]) - west)
        keys[i] = (((cell << bands) | band) << place) | np.uint64(i)
    shift, last = place, place + bands + columns + rows
    mask = np.uint64((1 << DIGIT) - 1)
    while shift < last:
        ends[:] = 0
        for i in range(n):
            ends[np.int64((keys[i] >> shift) & mask)] += 1
        begin = np.int64(0)
        for digit in range(ends.size):
            count = ends[digit]
            ends[digit] = begin
            begin += count
        for i in range(n):
            digit = np.int64((keys[i] >> shift) & mask)
            others[ends[digit]] = keys[i]
            ends[digit] += 1
        keys, others = others, keys
        shift += np.uint64(DIGIT)
    return keys, place


@bare
def gather_sorted(
    keys, place, column, row, heights, origin, passes, intensity, gain,
    out_column, out_row, out_heights, out_passes, out_intensity,
):  # fmt: skip
    """Put readings into the order of `keys`; pass and intensity are those of the readings `origin`.

    gain : uint32, what intensity is multiplied by; the product takes at most 16 bits.
    """
    mask = (np.uint64(1) << place) - np.uint64(1)
    for i in range(keys.size):
        k = np.int64(keys[i] & mask)
        out_column[i], out_row[i], out_heights[i] = column[k], row[k], heights[k]
        out_passes[i] = passes[origin[k]]
        out_intensity[i] = np.uint16(gain * np.uint32(intensity[origin[k]]))


@bare
def into_order(found, arrays, passes, intensity, gain):
    """Sort `found` readings by cell.

    Parameters
    ----------
    arrays : what :func:`order_arrays` makes; its first four hold the readings (``kernels.placed_cells``).
    passes : (n,) int32, intensity : (n,) unsigned, of all readings; gain : uint32.
    """
    column, row, heights, origin, keys, others, ends = arrays[:7]
    if found > 0:
        sorted_keys, place = sort_by_cell(
            column[:found], row[:found], heights[:found], keys[:found], others[:found], ends
        )
        gather_sorted(sorted_keys, place, column, row, heights, origin, passes, intensity, gain, *arrays[7:])


def order_arrays(size: int) -> tuple[Any, ...]:
    """Arrays for so many readings: found, four; work, three; sorted, column, row, height, pass and intensity."""
    return (
        *(np.empty(size, np.int32) for _ in range(4)),
        np.empty(size, np.uint64), np.empty(size, np.uint64), np.empty(1 << DIGIT, np.int64),
        np.empty(size, np.int32), np.empty(size, np.int32), np.zeros(size + VECTOR, np.int32),
        np.empty(size, np.int32), np.empty(size, np.uint16),
    )  # fmt: skip
