"""Search of a surveyed line in the readings of one pass: paint by its brightness, a kerb by the step of its face."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from roadscan.adjust.settings import TargetSettings
from roadscan.adjust.targets.shapes import HeightFind, SurveyedLine, TargetReadings, height_at
from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.arrays import scatter_about
from roadscan.compute.edges import LINE_M, painted_line, without_lines

_SLICES: Final = 8
"""Slices along the line that are measured separately: their scatter gives the σ of their mean."""
_LEAST: Final = 4  # With fewer slices the line is not found.
_CELL_M: Final = 0.02
"""Width of a cell across the line (m): four readings of a profiler, and a sixth of the narrowest line."""
_ALONG_M: Final = 10.0
"""1 σ of the place along the line (m): far more than errors of poses, so that it has no effect."""
_STRAY_M: Final = 0.03
"""Slices farther than this from the line through all of them (m) show something else."""
_DOUBLED_M: Final = 0.05
"""Lines farther apart than this (m) are two."""
_SIGMA_PAINT_M: Final = 0.003  # 1 σ by which the paint's middle misses the surveyed line (m).
_SIGMA_KERB_M: Final = 0.005
"""1 σ by which the face of a kerb misses the surveyed line (m): batter of the face."""
_STEP_M: Final = 0.04
"""Least step of a kerb (m)."""
_BESIDE_M: Final = (0.03, 0.15)
"""Heights at these distances (m) from the face, on either side, are those of the top and of the foot."""


@dataclass(frozen=True)
class LineFind:
    """A surveyed line near one of its points, as one pass shows it."""

    status: Literal["found", "missed", "doubled"]
    why_not: str
    place_m: Float64
    """(2,) easting and northing of the line abreast of the point; NaN where it was not found."""
    covariance_m2: Float64
    """(2, 2)"""
    height: HeightFind
    """Of the paint, or of the top of the kerb; without height where the line was not found."""
    count: int
    contrast: float
    """Of paint: share of the road's brightness; of a kerb: height of its face (m)."""


def find_line(
    readings: TargetReadings, easting_m: float, northing_m: float, line: SurveyedLine, settings: TargetSettings
) -> LineFind:
    """Returns the line where it crosses the normal of its surveyed point, within `search_radius_m` of it."""
    sine, cosine = np.sin(line.azimuth_rad), np.cos(line.azimuth_rad)
    east, north = readings.easting_m - easting_m, readings.northing_m - northing_m
    along, across = east * sine + north * cosine, east * cosine - north * sine
    reach_m = settings.search_radius_m + LINE_M
    near = (np.abs(along) <= line.half_m) & (np.abs(across) <= reach_m) & np.isfinite(readings.height_m)
    if int(near.sum()) < _SLICES * 10:
        return _missed(f"{int(near.sum())} readings near it")
    number = np.clip(((along + line.half_m) / (2.0 * line.half_m) * _SLICES).astype(np.int64), 0, _SLICES - 1)
    places, heights, contrasts = np.full(_SLICES, np.nan), np.full(_SLICES, np.nan), np.full(_SLICES, np.nan)
    for k in range(_SLICES):
        own = near & (number == k)
        values = readings.intensity[own].astype(np.float64) if line.kind == "paint" else readings.height_m[own]
        profile, at = _profile(values, across[own], reach_m)
        found = _paint(profile, at) if line.kind == "paint" else _kerb(profile, at)
        if found == "doubled":
            return _missed("two lines lie there", "doubled")
        if not isinstance(found, str) and abs(found[0]) <= settings.search_radius_m:
            places[k], heights[k], contrasts[k] = found
    return _joined(readings, (easting_m, northing_m), line, places, (heights, contrasts), settings)


def _joined(
    readings: TargetReadings,
    at: tuple[float, float],
    line: SurveyedLine,
    places: Float64,
    more: tuple[Float64, Float64],
    settings: TargetSettings,
) -> LineFind:
    """Returns the line through the slices that show it."""
    middle = ((np.arange(_SLICES) + 0.5) / _SLICES - 0.5) * 2.0 * line.half_m
    seen = np.isfinite(places)
    if seen.sum() < _LEAST:
        return _missed("nothing near its stated place looks like it")
    seen &= np.abs(places - np.median(places[seen])) <= _STRAY_M + np.abs(middle)
    design = np.stack([np.ones(_SLICES), middle], axis=-1)
    for _ in range(2):
        if seen.sum() < _LEAST:
            return _missed("what is seen near it is no line")
        fit = np.linalg.lstsq(design[seen], places[seen], rcond=None)[0]
        left = places - design @ fit
        seen &= np.abs(left) <= _STRAY_M
    if seen.sum() < _LEAST:
        return _missed("what is seen near it is no line")
    count = int(seen.sum())
    floor = _SIGMA_PAINT_M if line.kind == "paint" else _SIGMA_KERB_M
    scatter = float(np.sqrt(left[seen] @ left[seen] / max(count - 2, 1)))
    sigma = float(np.hypot(scatter / np.sqrt(count), floor))
    sine, cosine = np.sin(line.azimuth_rad), np.cos(line.azimuth_rad)
    normal, way = np.array([cosine, -sine]), np.array([sine, cosine])
    place = np.array(at) + float(fit[0]) * normal
    covariance = sigma**2 * np.outer(normal, normal) + _ALONG_M**2 * np.outer(way, way)
    heights, contrasts = (values[seen] for values in more)
    if line.kind == "paint":
        height = height_at(readings, float(place[0]), float(place[1]), settings)
    else:
        top = float(np.median(heights))
        spread = scatter_about(heights, top)
        height = HeightFind(
            top, float(np.hypot(spread / np.sqrt(count), _SIGMA_PAINT_M)), 0.0, 0.0, count, 1.0, ""
        )  # fmt: skip
    return LineFind("found", "", place, covariance, height, count, float(np.median(contrasts)))


def _missed(why_not: str, status: Literal["missed", "doubled"] = "missed") -> LineFind:
    nan = float("nan")
    none = HeightFind(nan, nan, nan, nan, 0, 0.0, why_not)
    return LineFind(status, why_not, np.full(2, nan), np.full((2, 2), nan), none, 0, nan)


def _profile(values: Float64, across_m: Float64, reach_m: float) -> tuple[Float64, Float64]:
    """Returns the median of the values in cells across, NaN where there are none, and the middles of the cells."""
    cells = round(2.0 * reach_m / _CELL_M)
    number = np.clip(((across_m + reach_m) / _CELL_M).astype(np.int64), 0, cells - 1)
    order = np.lexsort((values, number))
    sorted_numbers, sorted_values = number[order], values[order]
    first, count = np.searchsorted(sorted_numbers, np.arange(cells)), np.bincount(number, minlength=cells)
    profile, there = np.full(cells, np.nan), count > 0
    profile[there] = 0.5 * (
        sorted_values[first[there] + (count[there] - 1) // 2] + sorted_values[first[there] + count[there] // 2]
    )
    return profile, np.asarray((np.arange(cells) + 0.5) * _CELL_M - reach_m)


def _paint(grey: Float64, at_m: Float64) -> tuple[float, float, float] | str:
    """Returns place, no height, and contrast of the one painted line of a profile; why there is none."""
    known = np.isfinite(grey)
    if known.sum() < 10:
        return "missed"
    first, last = np.flatnonzero(known)[[0, -1]]
    at = at_m[first : last + 1]
    filled = np.interp(at, at_m[known], grey[known])
    surface = without_lines(filled[None], _CELL_M)[0]
    lines = [painted_line(filled, surface, at), painted_line(filled[::-1], surface[::-1], -at[::-1])]
    left, right = lines
    if left is None or right is None:
        return "missed"
    if abs(left.middle_m + right.middle_m) > _DOUBLED_M:
        return "doubled"
    return 0.5 * (left.middle_m - right.middle_m), float("nan"), left.contrast


def _kerb(height: Float64, at_m: Float64) -> tuple[float, float, float] | str:
    """Place of the face, height of the top and height of the face of a profile's one kerb; why there is none."""
    known = np.isfinite(height)
    if known.sum() < 10:
        return "missed"
    low, high = (_beside(height, known, side) for side in (-1, 1))
    step = np.nan_to_num(high - low)
    face = int(np.abs(step).argmax())
    size = abs(float(step[face]))
    if size < _STEP_M:
        return "missed"
    middle = 0.5 * float(low[face] + high[face])
    rising = (height - middle) * np.sign(step[face])
    near = known & (np.abs(at_m - at_m[face]) <= _BESIDE_M[1])
    below, above = at_m[near & (rising < 0.0)], at_m[near & (rising >= 0.0)]
    if not below.size or not above.size:
        return "missed"
    ends = (below.max(), above.min()) if step[face] > 0.0 else (below.min(), above.max())
    i, j = (int(np.abs(at_m - end).argmin()) for end in ends)
    share = (middle - height[i]) / (height[j] - height[i]) if height[j] != height[i] else 0.5
    place = float(at_m[i] + np.clip(share, 0.0, 1.0) * (at_m[j] - at_m[i]))
    return place, float(max(low[face], high[face])), size


def _beside(height: Float64, known: Bool, side: int) -> Float64:
    """Returns the median height beside each cell on one side; NaN with too few heights."""
    first, last = (round(metres / _CELL_M) for metres in _BESIDE_M)
    steps = np.arange(first, last + 1) * side
    rows = np.arange(height.size)[:, None] + steps
    inside = (rows >= 0) & (rows < height.size)
    values = np.where(inside, height[np.clip(rows, 0, height.size - 1)], np.nan)
    enough = np.isfinite(values).sum(axis=1) >= 2
    found = np.full(height.size, np.nan)
    found[enough] = np.nanmedian(values[enough], axis=1)
    return found
