"""Cross-sections without holes, in the form that kernels take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64
from roadscan.condition.lane_data import CrossSections, LaneData

_NOISIER: Final = 10.0
"""Factor on the lane's σ that shows readings of another kind of sensor; within one kind σ varies two- or threefold."""
_NOISY_M: Final = 1e-3
"""Below this σ, noise adds less to a depth than a rut has: the depth under a wire is some three σ too large."""


def noisy(c: CrossSections) -> Bool:
    """Return (n,) True where σ of a cross-section's heights is over ten times that of the lane and over 1 mm.

    So it is where a drive ends, and a lidar alone saw the road from afar: noise makes depths and texture there.
    """
    sigma = _sigma_of(c.sigma_m)
    known = np.isfinite(sigma)
    usual = float(np.median(sigma[known])) if known.any() else np.inf
    return np.nan_to_num(sigma) > max(_NOISIER * usual, _NOISY_M)


def _sigma_of(sigma_m: Float64) -> Float64:
    """Return (n,) medians of rows; NaN where none is known."""
    rows = (row[~np.isnan(row)] for row in sigma_m)
    return np.array([np.median(own) if own.size else np.nan for own in rows], np.float64)


@dataclass(frozen=True, eq=False)
class WholeSections:
    """Cross-sections of which enough was measured; missing heights are bridged by straight lines."""

    rows: npt.NDArray[np.int64]
    """(k,) their indices among the lane's cross-sections."""
    height_m: Float64
    """(k, m)"""
    sigma_m: Float64
    """(k,) median standard deviation of a height; NaN where not known."""
    noisy: Bool
    """(n,) True for the lane's cross-sections that are left out for their noise (:func:`noisy`)."""

    @classmethod
    def of(cls, lane: LaneData) -> WholeSections:
        """Select those that are not noisy, with at least `least_share` measured, also of both ends, but for a tenth."""
        c = lane.cross_sections
        known = ~np.isnan(c.height_m)
        m = c.offset_m.size
        tenth = max(m // 10, 1)
        ends = known[:, :tenth].any(axis=1) & known[:, -tenth:].any(axis=1)
        left_out = noisy(c)
        rows = np.flatnonzero((c.share >= lane.config.least_share) & ends & ~left_out)
        height = np.empty((rows.size, m))
        for k, row in enumerate(rows.tolist()):
            height[k] = np.interp(c.offset_m, c.offset_m[known[row]], c.height_m[row, known[row]])
        return cls(rows, height, _sigma_of(c.sigma_m[rows]), left_out)

    def spread(self, values: Float64, count: int) -> Float64:
        """Expand (count,) values to all cross-sections of the lane: NaN where too little was measured."""
        out = np.full(count, np.nan)
        out[self.rows] = values
        return out
