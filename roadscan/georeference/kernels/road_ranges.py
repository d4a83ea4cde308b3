"""Removes readings off the road from profiles: their ranges become 0 (no return)."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel


@kernel
def keep_road(kinds, first_kind, ranges, counts):
    """Set the ranges of readings of the classes from `first_kind` on to 0, and count them.

    Parameters
    ----------
    kinds : (n,) uint8, class of each reading; first_kind : int.
    ranges : (n,) uint16, in/out; counts : (k,) int64, in/out, readings of the classes from `first_kind` on.
    """
    for j in range(kinds.size):
        ranges[j] = ranges[j] if kinds[j] < first_kind else np.uint16(0)
    for k in range(counts.size):
        total = 0
        for j in range(kinds.size):
            total += kinds[j] == first_kind + k
        counts[k] += total
