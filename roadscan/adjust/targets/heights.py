"""Height of the road at a place, from a robust surface through the readings around it."""

from __future__ import annotations

import numpy as np

from roadscan.adjust.targets.settings import TargetSettings
from roadscan.adjust.targets.values import HeightFind, TargetReadings
from roadscan.compute.array_types import Float64
from roadscan.compute.robust import SIGMA_OF_MAD

_LEAST_COUNT = 12  # With fewer readings there is no height.
_CURVED_COUNT = 60  # From this many readings on, the surface has terms of second degree.
_CUT = 4.685
"""Constant of Tukey's biweight: 95 % efficiency for normal residuals."""
_ROUNDS = 30  # Rounds of re-weighting.
_BLOCKS = 6
"""Blocks along an edge: residuals within a block are taken as correlated."""
_LEAST_USED = 0.5  # A surface must use at least this share of the readings.
_LEAST_SCALE_M = 1e-6  # Least scale of the residuals (m), against division by zero.


def height_at(readings: TargetReadings, easting_m: float, northing_m: float, settings: TargetSettings) -> HeightFind:
    """Returns the surface's height at a place of the map, and its σ, from the readings within `height_radius_m`.

    The surface is a plane, with the three terms of second degree where there are readings enough: a rut bends by a
    millimetre over 0.3 m. It minimises Tukey's biweight of the residuals, begun from their least absolute sum. Its
    covariance is the sandwich of Huber (1967) with sums of blocks, so that texture and noise that neighbours share
    count as shared.
    Without readings on opposite sides of the place, a height is not given: it would be extrapolated.
    """
    place = np.stack([readings.easting_m - easting_m, readings.northing_m - northing_m], axis=-1)
    near = (np.hypot(*place.T) <= settings.height_radius_m) & np.isfinite(readings.height_m)
    place, height = place[near] / settings.height_radius_m, readings.height_m[near]
    if height.size < _LEAST_COUNT:
        return _none(height.size, f"{height.size} readings within {settings.height_radius_m:g} m")
    if not _surrounds(place):
        return _none(height.size, "the readings lie to one side of it")
    design: Float64 = np.column_stack([np.ones(height.size), place])
    if height.size >= _CURVED_COUNT:
        design = np.column_stack([design, place**2, place[:, 0] * place[:, 1]])
    level = float(np.median(height))
    plane, weight = _robust_plane(design, height - level)
    used = float((weight > 0.0).mean())
    if used < _LEAST_USED:
        return _none(height.size, f"only {used:.0%} of the readings lie on one surface")
    left = height - level - design @ plane
    sigma = float(np.hypot(np.sqrt(_variance(design, left, weight, place)), settings.sigma_plane_m))
    rise = plane[1:3] / settings.height_radius_m
    return HeightFind(level + float(plane[0]), sigma, float(rise[0]), float(rise[1]), height.size, used, "")


def _none(count: int, why_not: str) -> HeightFind:
    nan = float("nan")
    return HeightFind(nan, nan, nan, nan, count, 0.0, why_not)


def _surrounds(place: Float64) -> bool:
    """Returns whether every half plane through the origin, narrowed by 10°, contains a reading."""
    azimuth = np.sort(np.arctan2(place[:, 1], place[:, 0]))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
    return bool(gaps.max() < np.radians(190.0))


def _robust_plane(design: Float64, height: Float64) -> tuple[Float64, Float64]:
    """Coefficients (c,) of the columns of the design, and weights (n,) by iteratively re-weighted least squares."""
    weight: Float64 = np.ones(height.size)
    plane: Float64 = np.zeros(design.shape[1])
    for turn in range(_ROUNDS):
        before = plane
        weighted = design * weight[:, None]
        plane = np.asarray(np.linalg.lstsq(weighted.T @ design, weighted.T @ height, rcond=None)[0], np.float64)
        left: Float64 = np.abs(height - design @ plane)
        scale = max(SIGMA_OF_MAD * float(np.median(left)), _LEAST_SCALE_M)
        if turn < _ROUNDS // 3:
            weight = 1.0 / np.maximum(left, 0.1 * scale)
        else:
            weight = np.maximum(1.0 - (left / (_CUT * scale)) ** 2, 0.0) ** 2
            if np.abs(plane - before).max() < 1e-7:
                break
    return plane, weight


def _variance(design: Float64, left: Float64, weight: Float64, place: Float64) -> float:
    """Returns the variance of the surface's height in the middle."""
    block = np.clip(((place + 1.0) / 2.0 * _BLOCKS).astype(np.int64), 0, _BLOCKS - 1)
    number = block[:, 0] * _BLOCKS + block[:, 1]
    scores = design * (weight * left)[:, None]
    summed = np.stack([np.bincount(number, column, _BLOCKS**2) for column in scores.T], axis=-1)
    groups = np.unique(number).size
    root = np.sqrt(weight)
    slope = root * (5.0 * root - 4.0)  # derivative of the biweight's influence
    bread = np.linalg.pinv((design * slope[:, None]).T @ design)
    meat = summed.T @ summed * groups / max(groups - design.shape[1], 1)
    return float((bread @ meat @ bread)[0, 0])
