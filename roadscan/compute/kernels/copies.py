"""Copies arrays within kernels: an assignment to a slice takes five times as long to compile as a loop."""

from __future__ import annotations

from roadscan.compute.kernel_options import bare


@bare
def copy_values(values, out):
    """Copy values (n,) to the first n elements of `out` (n,), converted to its type."""
    for k in range(out.size):
        out[k] = values[k]
