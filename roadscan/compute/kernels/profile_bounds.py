"""Least and greatest raw range of each profile."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel

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
