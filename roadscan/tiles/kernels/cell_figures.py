"""Sums and medians over a tile's cells."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import kernel

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
