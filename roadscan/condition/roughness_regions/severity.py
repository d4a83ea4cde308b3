"""Severity of a region: its heights and its intensity relative to the road around it."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from roadscan.compute.robust import scatter_about
from roadscan.condition.roughness_regions.points import RoadPoints
from roadscan.condition.roughness_regions.surface import fit


class Severity(NamedTuple):
    """Measures of a region; NaN where the road around was not measured."""

    contrast: float
    """Share by which its median intensity is lower than that of the road around."""
    intensity: float
    """Median intensity of its points."""
    residual_mean_m: float
    """Mean height above the surface of the road around: negative where it has sunk."""
    residual_sigma_m: float
    """Standard deviation of these heights: the roughness (Kumar et al. 2015)."""
    around_sigma_m: float
    """The same for the road around, by the median of its absolute residuals: noise and texture."""


UNKNOWN: Final = Severity(*5 * (float("nan"),))  # Nothing was measured around it.


def severity(own: RoadPoints, around: RoadPoints) -> Severity:
    """Compute measures of a region's points relative to those of the road around it.

    The surface is one of the second degree, by a robust fit (Tukey's biweight) to the road around: Kumar et al. (2015)
    fit a grid of the points themselves, which follows what it is to measure.
    """
    lacking = float("nan")
    if not len(own):
        return UNKNOWN
    intensity = float(np.median(own.intensity))
    beside = float(np.median(around.intensity)) if len(around) else 0.0
    contrast = 1.0 - intensity / beside if beside > 0.0 else lacking
    surface = fit(around.x_m, around.y_m, around.height_m)
    if surface is None:
        return Severity(contrast, intensity, lacking, lacking, lacking)
    above = surface.residuals_m(own.x_m, own.y_m, own.height_m)
    rest = surface.residuals_m(around.x_m, around.y_m, around.height_m)
    readings = float(own.readings.sum())
    mean = float(np.sum(own.readings * above)) / readings
    sigma = float(np.sqrt(np.sum(own.readings * (above - mean) ** 2) / readings))
    return Severity(contrast, intensity, mean, sigma, scatter_about(rest, float(np.median(rest))))
