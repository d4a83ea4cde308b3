"""Robust measures of scatter, which single wrong values do not change."""

from __future__ import annotations

from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64

SIGMA_OF_MAD: Final = 1.4826
"""Ratio of a normal distribution's standard deviation to its median absolute deviation: 1 / Φ⁻¹(3/4) (Hampel 1974)."""


def scatter_about(values: Float64, middle: float | Float64) -> float:
    """Return the robust standard deviation (1.4826 MAD) of values (n,) about a middle, or about one for each (n,)."""
    return SIGMA_OF_MAD * float(np.median(np.abs(values - middle)))
