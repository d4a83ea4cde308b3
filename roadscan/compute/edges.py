"""Edges of a road along a drive or a reference line, and painted lines, from rasters of stations and offsets."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import runs_of
from roadscan.compute.kernels.edge_across import best_path, best_places, step_and_bend


class AcrossSettings(NamedTuple):
    """Settings of the search for an edge along a road. One setting serves all data."""

    along_m: float = 1.0
    """Half the length of the window along the road."""
    across_m: float = 0.7
    """Width of the window on each side."""
    floor_step_m: float = 0.012
    floor_bend: float = 0.025
    """Standard deviations of a step (m) and of a change of slope (m/m) that no number of heights takes away."""
    most: float = 6.0
    """Evidence (σ) of one cell counts up to this."""
    chance: float = 2.0
    """Evidence (σ) that chance gives as well: it is taken off."""
    farther_cost: float = 0.12
    """Evidence (σ) that a metre farther from the drive costs: the first edge is the road's."""
    move_m: float = 0.3
    """Farthest that the edge moves aside from station to station."""
    move_cost: float = 4.0
    """Evidence (σ) that a metre aside costs."""
    mean_over_m: float = 10.0
    """Evidence of a station is its mean along the path over this length."""


class EdgePath(NamedTuple):
    """An edge along a road; arrays have one value per station."""

    cell: npt.NDArray[np.int64]
    """(stations,) offset, in cells."""
    evidence: Float64
    """(stations,) mean evidence (σ) of the path around each station, less what chance gives."""


DEFAULT: Final = AcrossSettings()


def evidence_across(
    value: Float64, sigma: Float64, spacing_m: tuple[float, float], settings: AcrossSettings = DEFAULT
) -> tuple[Float64, Float64]:
    """Steps and bends across a road, each over its σ and positive where values rise or bend up outward.

    Parameters
    ----------
    value : (stations, offsets) heights (m) or others from the middle of the road outward, NaN where none is known.
    sigma : (stations, offsets) their standard deviations.
    spacing_m : of stations and of offsets.

    Returns
    -------
    Two arrays (stations, offsets), NaN where a side has too few values.
    """
    known = np.isfinite(value)
    weight = np.where(known, 1.0 / np.square(np.where(known, sigma, 1.0)), 0.0)
    step, bend = np.empty_like(weight), np.empty_like(weight)
    window = (max(round(settings.along_m / spacing_m[0]), 1), max(round(settings.across_m / spacing_m[1]), 2))
    floors = (settings.floor_step_m, settings.floor_bend)
    step_and_bend(np.where(known, value, 0.0), weight, spacing_m[1], window, floors, step, bend)
    return step, bend


def counted(evidence: Float64, settings: AcrossSettings = DEFAULT) -> Float64:
    """Return how much evidence (σ) counts: its size up to the limit, less that of chance; 0 where there is none."""
    size = np.abs(evidence)
    return np.where(np.isnan(size), 0.0, np.minimum(size, settings.most) - settings.chance)


def path_along(
    found: Float64, spacing_m: tuple[float, float], settings: AcrossSettings = DEFAULT, within_m: float | None = None
) -> EdgePath:
    """Return the path of most evidence (stations, offsets) along a road.

    within_m : each station's place is that of the best path this far (m) along the road on both sides; what lies
        farther away does not change it. None: there is one best path over all stations.
    """
    import scipy.ndimage

    evidence = found - settings.farther_cost * spacing_m[1] * np.arange(found.shape[1])
    reach, cost = moved_cells(spacing_m[1], settings), settings.move_cost * spacing_m[1]
    path = np.zeros(len(found), np.int64)
    if within_m is None:
        best_path(evidence, reach, cost, np.empty_like(found), np.empty(found.shape, np.int64), path)
    else:
        room = np.empty((2, found.shape[1])), np.empty(found.shape[1])
        best_places(evidence, reach, cost, round(within_m / spacing_m[0]), *room, path)
    own = found[np.arange(len(found)), path] if found.size else np.zeros(0)
    width = max(round(settings.mean_over_m / spacing_m[0]), 1)
    return EdgePath(path, scipy.ndimage.uniform_filter1d(own, width, mode="nearest") if own.size else own)


def moved_cells(spacing_m: float, settings: AcrossSettings = DEFAULT) -> int:
    """Return how many cells an edge moves aside from station to station at the most."""
    return max(round(settings.move_m / spacing_m), 1)


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
