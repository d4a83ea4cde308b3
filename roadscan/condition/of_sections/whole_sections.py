"""Cross-sections without holes, as kernels take them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.condition.lane_data import LaneData

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WholeSections:
    """Cross-sections of which enough was measured; what lacks in them is bridged by straight lines."""

    rows: npt.NDArray[np.int64]
    """(k,) which of the lane's cross-sections they are."""
    height_m: Float64
    """(k, m)"""
    sigma_m: Float64
    """(k,) median standard deviation of a height; NaN where not known."""

    @classmethod
    def of(cls, lane: LaneData) -> WholeSections:
        """Those with at least the share `least_share` measured, both ends included but for a tenth of the width."""
        c = lane.cross_sections
        known = ~np.isnan(c.height_m)
        m = c.offset_m.size
        tenth = max(m // 10, 1)
        ends = known[:, :tenth].any(axis=1) & known[:, -tenth:].any(axis=1)
        rows = np.flatnonzero((c.share >= lane.config.least_share) & ends)
        height = np.empty((rows.size, m))
        for k, row in enumerate(rows.tolist()):
            height[k] = np.interp(c.offset_m, c.offset_m[known[row]], c.height_m[row, known[row]])
        sigma = np.full(rows.size, np.nan)
        for k, row in enumerate(rows.tolist()):
            own = c.sigma_m[row][~np.isnan(c.sigma_m[row])]
            sigma[k] = np.median(own) if own.size else np.nan
        return cls(rows, height, sigma)

    def spread(self, values: Float64, count: int) -> Float64:
        """(count,) values of all cross-sections of the lane: NaN where too little was measured."""
        out = np.full(count, np.nan)
        out[self.rows] = values
        return out
