"""The one place that sets compiler options.

Kernels are serial and release the GIL: parallelism comes from Dask over blocks. `fastmath` stays off,
so that the order of operations, and with it every bit of the result, is the same everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

Kernel = Callable[..., Any]


def kernel(function: Kernel) -> Kernel:
    """Compile a loop over arrays once per machine, without the GIL."""
    compiled: Kernel = numba.njit(nogil=True, cache=True, error_model="numpy")(function)
    return compiled


def inlined(function: Kernel) -> Kernel:
    """Compile a piece of a kernel into its callers."""
    compiled: Kernel = numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)(function)
    return compiled
