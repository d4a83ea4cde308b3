"""Arrays: robust scatter, runs of true flags, distances along places."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt
import scipy

from roadscan.compute.array_types import Float64


def runs_of(flags: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Return first index and one past the last (r, 2) of each run of true flags (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2).astype(np.int64)


def without_holes(flags: npt.NDArray[np.bool_], most: int, is_closed: bool = False) -> npt.NDArray[np.bool_]:
    """Return flags (n,) that are true also in runs of at most so many false ones between true ones.

    is_closed : whether the last of them is followed by the first.
    """
    wide = np.pad(flags, most, mode="wrap" if is_closed else "constant")
    return np.asarray(scipy.ndimage.binary_closing(wide, np.ones(most + 1))[most : most + len(flags)], np.bool_)


def way_along(places_m: Float64) -> Float64:
    """Return (n,) horizontal distances (m) from the first of places (n, ≥ 2) along the line through them."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places_m[:, :2], axis=0).T))])


def smoothed_knots(path_m: Float64, knot_m: float, smoothing_m: float) -> tuple[Float64, Float64]:
    """Return (k,) distances (m) along a path and (k, 2) knots, smoothed by local parabolas (Savitzky and Golay 1964).

    Parameters
    ----------
    path_m : (n, ≥ 2) places in the order of travel.
    knot_m : distance between knots, about. smoothing_m : length of the way that a parabola follows.
    """
    along = way_along(path_m)
    count = int(along[-1] / knot_m) + 1
    at = np.linspace(0.0, along[-1], count)
    knots = np.column_stack([np.interp(at, along, path_m[:, a]) for a in range(2)])
    window = min(2 * round(smoothing_m / knot_m / 2) + 1, count - 1 + count % 2)
    if window > 3:
        knots = scipy.signal.savgol_filter(knots, window, 2, axis=0, mode="interp")
    return at, knots


SIGMA_OF_MAD: Final = 1.4826
"""Ratio of a normal distribution's standard deviation to its median absolute deviation: 1 / Φ⁻¹(3/4) (Hampel 1974)."""


def scatter_about(values: Float64, middle: float | Float64) -> float:
    """Return the robust standard deviation (1.4826 MAD) of values (n,) about a middle, or about one for each (n,)."""
    return SIGMA_OF_MAD * float(np.median(np.abs(values - middle)))


@cache
def length_limit(limit: float, rows: int) -> float:
    """Return the length of `rows` standard normal numbers that is exceeded as rarely as `limit` by one."""
    from scipy.special import chdtrc, chdtri

    # Farther out, probabilities underflow.
    usual = min(limit, 30.0)
    return float(np.sqrt(chdtri(rows, chdtrc(1, usual**2)))) + limit - usual
