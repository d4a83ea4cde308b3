"""Copies within kernels: a slice's assignment compiles five times as long as a loop."""

from __future__ import annotations

from roadscan.compute.kernel_options import bare


@bare
def copy_values(values, out):
    """Values (n,) → the first n of `out` (n,), in its own kind of number."""
    for k in range(out.size):
        out[k] = values[k]
