"""Small loops over arrays: copies, quantiles of sorted values, k-th smallest numbers, and bounds of profiles."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inner, inlined, inner, kernel


@bare
def copy_values(values, out):
    """Copy values (n,) to the first n elements of `out` (n,), converted to its type."""
    for k in range(out.size):
        out[k] = values[k]


@inlined
def sorted_quantile(held, share):
    """Returns the number below which a share of sorted values (n,) lies, interpolated as NumPy does."""
    place = (held.size - 1) * share
    i = int(place)
    low, high, past = held[i], held[min(i + 1, held.size - 1)], place - i
    return high - (high - low) * (1.0 - past) if past >= 0.5 else low + (high - low) * past


_ONE = np.uint16(1)  # Subtracted from raw ranges in their type, so that 0 (no return) wraps to the largest number.


@kernel
def range_bounds(ranges, low, high):
    """Write the lowest and the highest range of each profile's returns (not 0); 0 for profiles without any.

    Parameters
    ----------
    ranges
        (n, m) uint16, raw.
    low, high
        (n,) uint16, out.
    """
    for k in range(ranges.shape[0]):
        least, most = np.uint16(65535), np.uint16(0)
        for i in range(ranges.shape[1]):
            value = ranges[k, i]
            below = np.uint16(value - _ONE)  # 0 (no return) wraps to the largest number
            least = below if below < least else least
            most = value if value > most else most
        low[k], high[k] = np.uint16(least + _ONE), most


BINS = 256  # Bins of one pass over the numbers.
_FEW = 48
"""Up to this many numbers are sorted directly."""


@bare
def bounds_of(values):
    """Return the least and greatest of (n,) int32, n > 0."""
    low, high = values[0], values[0]
    for i in range(values.size):
        low, high = min(low, values[i]), max(high, values[i])
    return np.int64(low), np.int64(high)


@bare
def _count(values, low, shift, bins):
    bins[:] = 0
    for i in range(values.size):
        bins[np.uint64(np.int64(values[i]) - low) >> shift] += np.int32(1)


@bare_inner
def _of_bin(values, low, shift, wanted, found):
    n = 0
    for i in range(values.size):
        found[n] = values[i]
        n += np.int64((np.uint64(np.int64(values[i]) - low) >> shift) == wanted)
    return n


@bare
def sort_few(values):
    """Sort few numbers (n,) by insertion."""
    for i in range(1, values.size):
        own, j = values[i], i
        while j > 0 and values[j - 1] > own:
            values[j] = values[j - 1]
            j -= 1
        values[j] = own


@bare
def smallest(values, k, bins, found):
    """Return the k-th smallest (from 0) of numbers.

    Parameters
    ----------
    values : (n,) int32, n > k; they may change places. bins : (BINS,) int32, found : (≥ n + 1,) int32, work.

    Returns
    -------
    int64
    """
    while values.size > _FEW:
        low, high = bounds_of(values)
        shift, span = np.uint64(0), high - low
        while span >= BINS:
            span >>= 1
            shift += np.uint64(1)
        _count(values, low, shift, bins)
        bin_, before = 0, 0
        while before + bins[bin_] <= k:
            before += bins[bin_]
            bin_ += 1
        if shift == 0:
            return low + bin_
        n = _of_bin(values, low, shift, np.uint64(bin_), found)
        for i in range(n):
            values[i] = found[i]
        values, k = values[:n], k - before
    sort_few(values)
    return np.int64(values[k])


@inner
def selected(values, k):
    """Return the k-th smallest (from 0) of (n,) float64, which change places (Hoare, 1961, algorithm 65).

    NumPy's median and sorts compile for a second in each kernel that calls them.
    """
    low, high = 0, values.size - 1
    while low < high:
        pivot, i, j = values[k], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return values[k]


@inner
def median(values):
    """Return the median of (n,) float64, n > 0, which change places."""
    half = values.size // 2
    high = selected(values, half)
    if values.size % 2 == 1:
        return high
    low = values[0]
    for k in range(1, half):
        low = max(low, values[k])
    return (low + high) / 2.0


@kernel
def sort(values):
    """Sort numbers (n,) in place, none of them NaN (Hoare, 1961, algorithm 64)."""
    waiting, many = np.empty((64, 2), np.int64), 0  # the longer part of each split: at most log2(n) of them
    low, high = 0, values.size - 1
    while True:
        if high - low < 16:  # left to insertion
            if many == 0:
                break
            many -= 1
            low, high = waiting[many, 0], waiting[many, 1]
            continue
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        first = j - low < high - i
        waiting[many, 0], waiting[many, 1] = (i, high) if first else (low, j)
        low, high = (low, j) if first else (i, high)
        many += 1
    sort_few(values)


@inlined
def catmull_rom(s):
    """Return Catmull–Rom weights of four neighbours at fraction `s` between the middle two, then their derivatives."""
    return (
        s * (-0.5 + s * (1.0 - 0.5 * s)), 1.0 + s * s * (-2.5 + 1.5 * s),
        s * (0.5 + s * (2.0 - 1.5 * s)), s * s * (-0.5 + 0.5 * s),
        -0.5 + s * (2.0 - 1.5 * s), s * (-5.0 + 4.5 * s), 0.5 + s * (4.0 - 4.5 * s), s * (-1.0 + 1.5 * s),
    )  # fmt: skip


@inlined
def sampled(image, r, c, s, t):
    """Return value and derivatives by column and row (per cell) of an image beyond (r, c), with weights `s` and `t`."""
    value, along, across = 0.0, 0.0, 0.0
    for j in range(4):
        a, b, d, e = image[r - 1 + j, c - 1], image[r - 1 + j, c], image[r - 1 + j, c + 1], image[r - 1 + j, c + 2]
        row = s[0] * a + s[1] * b + s[2] * d + s[3] * e
        value += t[j] * row
        along += t[j] * (s[4] * a + s[5] * b + s[6] * d + s[7] * e)
        across += t[4 + j] * row
    return value, along, across
