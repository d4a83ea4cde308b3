"""Least and greatest raw range of each block of readings in a profile."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel


@kernel
def block_ranges(ranges, size):
    """Return the least and greatest raw range of each block of readings.

    Parameters
    ----------
    ranges : (n, m) uint16, 0 no return; size : readings of a block, the last may have fewer.

    Returns
    -------
    low, high : (n, ceil(m / size)) uint16, 0 where a block has no return.
    """
    n, m = ranges.shape
    blocks = (m + size - 1) // size
    low, high = np.zeros((n, blocks), np.uint16), np.zeros((n, blocks), np.uint16)
    for i in range(n):
        for b in range(blocks):
            near, far = 65536, 0
            for j in range(b * size, min((b + 1) * size, m)):
                value = np.int64(ranges[i, j])
                far = max(far, value)
                near = min(near, value if value > 0 else 65536)
            if far > 0:
                low[i, b] = near
                high[i, b] = far
    return low, high
