"""The strip of road that a sensor sees, relative to its vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.poses.level import LevelPoses

_SHARE = 2.0
"""Per cent of the readings that lie beyond either side."""
WHOLE: Final = 1.0 / (1.0 - 0.02 * _SHARE)
"""Ratio of the width of all evenly spread readings of a profile to that of the strip."""


@dataclass(frozen=True)
class Swath:
    """The area of a sensor's readings, from the body's origin, along the vehicle's heading and to its right (m)."""

    forward_m: float
    """Middle, ahead."""
    right_m: float
    """Middle, to the right."""
    half_width_m: float
    """From the middle to either side."""
    half_length_m: float
    """From the middle ahead and behind."""
    below_m: float
    """Middle, below the body's origin."""


def swath_of(points_m: Float64, poses: LevelPoses, pose: npt.NDArray[np.int64]) -> Swath:
    """Returns the strip that contains most of the points (n, 3; easting, northing, height) that poses (n,) saw."""
    away = points_m - poses.body_m[pose]
    sine, cosine = np.sin(poses.heading_rad)[pose], np.cos(poses.heading_rad)[pose]
    forward, right = away[:, 0] * sine + away[:, 1] * cosine, away[:, 0] * cosine - away[:, 1] * sine
    back, front = np.percentile(forward, [_SHARE, 100.0 - _SHARE])
    left, end = np.percentile(right, [_SHARE, 100.0 - _SHARE])
    return Swath(
        float(np.median(forward)), float(left + end) / 2, float(end - left) / 2, float(front - back) / 2,
        float(-np.median(away[:, 2])),
    )  # fmt: skip
