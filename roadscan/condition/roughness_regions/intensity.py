"""Normalises intensity for range and incidence, and divides it into three classes."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64

_STEEPEST_RAD: Final = np.radians(80.0)
"""Largest angle of incidence that is corrected: beyond it, the cosine is constant, lest glancing returns dominate."""


def normalised_intensity(
    intensity: Float64, range_m: Float64, incidence_rad: Float64, reference_range_m: float
) -> Float64:
    """Return (n,) intensities as from `reference_range_m` at right angles: I · (R / R₀)² / cos θ.

    The lidar equation of an extended Lambertian target (Höfle & Pfeifer 2007, equation 6, without the atmosphere). For
    sensors whose intensity is the received power; one that has already been corrected for range stays as it is.

    Parameters
    ----------
    intensity, range_m : (n,); incidence_rad : (n,) angle between the beam and the surface's normal, held at 80°.
    """
    cosine = np.cos(np.minimum(np.abs(incidence_rad), _STEEPEST_RAD))
    normalised: Float64 = intensity * (range_m / reference_range_m) ** 2 / cosine
    return normalised


def three_classes(values: npt.NDArray[np.uint8]) -> tuple[int, int] | None:
    """Return two thresholds t₁ < t₂ that divide 8-bit values into ≤ t₁, ≤ t₂ and above (Otsu 1979, three classes).

    Of all pairs, the one with the greatest variance between the classes, of equals the first; None with fewer than
    three different values.
    """
    counts = np.bincount(values.ravel(), minlength=256).astype(np.float64)
    if np.count_nonzero(counts) < 3:
        return None
    weight, moment = np.cumsum(counts), np.cumsum(counts * np.arange(256))

    def between(q: Float64, m: Float64) -> Float64:
        """Weight times squared mean: a class's contribution to the variance between classes, up to a constant."""
        return np.divide(m * m, q, out=np.zeros_like(m), where=q > 0.0)

    first, second = weight[:, None], weight[None, :]
    middle = between(second - first, moment[None, :] - moment[:, None])
    total = between(weight, moment)[:, None] + middle + between(weight[-1] - weight, moment[-1] - moment)[None, :]
    allowed = (first > 0) & (second > first) & (second < weight[-1])
    best = int(np.argmax(np.where(allowed, total, -1.0)))
    return best // 256, best % 256
