"""Distances along a sequence of places."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


def way_along(places_m: Float64) -> Float64:
    """Return (n,) horizontal distances (m) from the first of places (n, ≥ 2) along the line through them."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places_m[:, :2], axis=0).T))])
