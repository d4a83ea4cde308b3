"""Lag of one sensor's strip behind another's along the way, from the correlation of heights or intensities."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.strips.strip import ALONG_M

FARTHEST_M: Final = 15.0
"""Lags are searched this far (m) to both sides: 0.9 s at 60 km/h."""
_SMOOTH_M: Final = 5.0
"""Features longer than this (m) are removed from a strip: grades and bends are alike at every lag."""
_BLOCKS: Final = 6
"""Blocks of the strip, each left out in turn: their agreement gives σ."""
_LEAST_CELLS: Final = 200  # With fewer cells in common (of 0.1 m by 0.5 m) no lag is computed.
_LEAST_LIKENESS: Final = 0.3
"""Strips whose best correlation is lower show no lag."""
_LEAST_SIGMA_M: Final = ALONG_M / 5
"""A peak is located no better than this share of a cell (m)."""
_EQUAL: Final = 0.9
"""Peaks of at least this share of the highest are as good: dashes of paint repeat, and the least shift is taken."""
_SIGMAS: Final = 3.0
"""A lag is reported only if its correlation exceeds that at lag 0 by this many σ."""


class Lag(NamedTuple):
    """One strip lies `lag_m` farther along the way than another."""

    lag_m: float
    sigma_m: float
    likeness: float
    """Correlation at this lag."""
    repeats: bool
    """True where another lag is about as likely: dashes of paint repeat, and the least lag was taken."""


def lag_of(one: Float64, other: Float64) -> Lag | None:
    """Returns how far `other` lies ahead of `one`; both (n, q) cells along and across the way, NaN where unseen.

    The σ is that of the jackknife over six blocks of the strip (Efron and Stein 1981). None where they have too little
    in common, or where their correlation shows no lag.
    """
    width = round(_SMOOTH_M / ALONG_M)
    first, second = _sharp(one, width), _sharp(other, width)
    if (np.isfinite(first) & np.isfinite(second)).sum() < _LEAST_CELLS:
        return None
    steps = np.arange(-round(FARTHEST_M / ALONG_M), round(FARTHEST_M / ALONG_M) + 1)
    sums = np.stack([_sums(first, second, int(step)) for step in steps])
    whole = _likeness(sums.sum(axis=1))
    if not np.isfinite(whole[steps == 0]).all() or np.nanmax(whole) < _LEAST_LIKENESS:
        return None
    without = [_likeness(sums.sum(axis=1) - sums[:, block]) for block in range(_BLOCKS)]
    middle, at = steps.size // 2, _summit(whole)
    places = np.array([_summit(one) for one in without])
    rises = np.array([one[round(at / ALONG_M) + middle] - one[middle] for one in without])
    scale = (_BLOCKS - 1) / np.sqrt(_BLOCKS)
    if abs(at) > ALONG_M and rises.mean() < _SIGMAS * scale * rises.std():
        return None  # the peak is no higher than its surroundings
    sigma_m = float(np.hypot(scale * places.std(), _LEAST_SIGMA_M))
    return Lag(at, sigma_m, float(np.nanmax(whole)), _summits(whole).size > 1)


def _sharp(picture: Float64, width: int) -> Float64:
    """Returns a strip without features longer than so many cells along the way."""
    seen = np.isfinite(picture)
    base = np.nanmean(picture) if seen.any() else 0.0
    sums, counts = (_running(values, width) for values in (np.where(seen, picture - base, 0.0), seen.astype(float)))
    return np.where(seen & (counts > width / 3), picture - base - sums / np.maximum(counts, 1.0), np.nan)


def _running(values: Float64, width: int) -> Float64:
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    number = np.arange(len(values))
    after, before = np.minimum(number + width // 2 + 1, len(values)), np.maximum(number - width // 2, 0)
    return np.asarray(total[after] - total[before])


def _sums(one: Float64, other: Float64, step: int) -> Float64:
    """Returns sums (blocks, 6) over the cells that both strips have, with `other` moved back by so many cells."""
    rows = len(one)
    low, high = max(0, -step), rows - max(0, step)
    a, b = one[low:high], other[low + step : high + step]
    both = np.isfinite(a) & np.isfinite(b)
    a, b = np.where(both, a, 0.0), np.where(both, b, 0.0)
    rowwise = np.stack([both.sum(1), a.sum(1), b.sum(1), (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)], axis=-1)
    block = np.arange(low, high) * _BLOCKS // rows
    found = np.zeros((_BLOCKS, 6))
    np.add.at(found, block, rowwise)
    return found


def _likeness(sums: Float64) -> Float64:
    """Returns correlations (k,) from sums (k, 6); NaN with too few cells."""
    n, a, b, aa, bb, ab = sums.T
    n = np.maximum(n, 1.0)
    spread = np.sqrt(np.maximum((aa - a * a / n) * (bb - b * b / n), 1e-30))
    return np.where(sums[:, 0] >= _LEAST_CELLS, (ab - a * b / n) / spread, np.nan)


def _summits(likeness: Float64) -> npt.NDArray[np.int64]:
    """Returns the indices of the peaks that are about as high as the highest."""
    padded = np.pad(np.nan_to_num(likeness, nan=-1.0), 1, constant_values=-1.0)
    is_top = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    highest = float(padded.max())
    return np.flatnonzero(is_top & (padded[1:-1] >= highest - (1.0 - _EQUAL) * abs(highest)))


def _summit(likeness: Float64) -> float:
    """Returns the least lag (m) of the peaks about as high as the highest, interpolated by a parabola."""
    middle = likeness.size // 2
    k = min(_summits(likeness).tolist(), key=lambda step: abs(step - middle))
    if not 0 < k < likeness.size - 1:
        return float((k - middle) * ALONG_M)
    before, top, after = np.nan_to_num(likeness[k - 1 : k + 2], nan=-1.0)
    bend = before - 2 * top + after
    return float((k - middle + ((before - after) / (2 * bend) if bend < 0.0 else 0.0)) * ALONG_M)
