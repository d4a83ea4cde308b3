"""Features of the processor that kernels are compiled for."""

from __future__ import annotations

import numba

from roadscan.compute.numba_internals import host_features


def compiles_for(*features: str) -> bool:
    """Return True if kernels are compiled for a processor with all these features (LLVM's names)."""
    stated = numba.config.CPU_FEATURES
    if numba.config.DISABLE_JIT or (stated is None and numba.config.CPU_NAME is not None):
        return False
    known = host_features() if stated is None else stated
    return {f"+{feature}" for feature in features} <= set(known.split(","))
