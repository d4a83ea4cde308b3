"""Quantiles of values that are sorted."""

from __future__ import annotations

from roadscan.compute.kernel_options import inlined


@inlined
def sorted_quantile(held, share):
    """Returns the number below which a share of sorted values (n,) lies, interpolated as NumPy does."""
    place = (held.size - 1) * share
    i = int(place)
    low, high, past = held[i], held[min(i + 1, held.size - 1)], place - i
    return high - (high - low) * (1.0 - past) if past >= 0.5 else low + (high - low) * past
