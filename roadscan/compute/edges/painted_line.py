"""Detects painted lines along a road from intensities across it."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.compute.flags import runs_of

LINE_M: Final = 0.6
"""Painted lines are narrower than this."""
PAINT: Final = 0.25
"""Least contrast of a painted line: how much brighter it is than the road beside it (share of its intensity)."""
_NARROWEST_M: Final = 0.05  # Least width of a painted line between the points of half its contrast.
_WIDEST_M: Final = 0.4  # Greatest width.
_ALIKE: Final = 0.6
"""Lines with at least this share of the brightest line's contrast count; the innermost of them marks the lane."""


class PaintedLine(NamedTuple):
    """A painted line across the way."""

    middle_m: float
    """Place of its middle on the axis across."""
    width_m: float
    contrast: float
    """By how much it is brighter than the road beside it (share of its intensity)."""


def without_lines(grey: Float64, spacing_m: float) -> Float64:
    """Return intensities (s, o) without what is brighter than its surroundings and narrower than a painted line may be.

    spacing_m : across the road; NaN, where nothing is known, stays.
    """
    import scipy.ndimage

    cells = round(LINE_M / spacing_m)
    cells += 1 - cells % 2
    low = scipy.ndimage.minimum_filter(np.where(np.isnan(grey), np.inf, grey), (1, cells), mode="nearest")
    opened = scipy.ndimage.maximum_filter(np.where(np.isinf(low), -np.inf, low), (1, cells), mode="nearest")
    return np.where(np.isnan(grey) | np.isinf(opened), np.nan, opened)


def painted_line(grey: Float64, surface: Float64, away_m: Float64) -> PaintedLine | None:
    """Return the painted line on a way across a road; None where there is none.

    Parameters
    ----------
    grey : (o,) intensities from the lane outward; surface : (o,) the same without lines (:func:`without_lines`).
    away_m : (o,) ascending places on the way (m), evenly spaced.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        bright = np.nan_to_num((grey - surface) / surface, nan=0.0, posinf=0.0, neginf=0.0)
    greatest = float(bright.max(initial=0.0))
    if greatest < PAINT:
        return None
    for first, end in runs_of(bright >= _ALIKE * greatest).tolist():
        peak = float(bright[first:end].max())
        low, high = (_crossing(bright, away_m, start, step, 0.5 * peak) for start, step in ((first, -1), (end - 1, 1)))
        if low is not None and high is not None and _NARROWEST_M <= high - low <= _WIDEST_M:
            return PaintedLine(0.5 * (low + high), high - low, peak)
    return None


def _crossing(bright: Float64, away_m: Float64, start: int, step: int, level: float) -> float | None:
    """Return where the brightness falls below a level on the way from a cell; None where it does not."""
    k = start
    while 0 <= k + step < bright.size:
        if bright[k + step] < level:
            share = (bright[k] - level) / (bright[k] - bright[k + step])
            return float(away_m[k] + share * (away_m[k + step] - away_m[k]))
        k += step
    return None
