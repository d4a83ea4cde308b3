"""Mean profile depth of texture profiles, after the steps of ISO 13473-1:2019.

The depth of a segment of 100 mm is the mean of the peaks of its two halves above its mean; MPD is the mean of the
depths of valid segments. How a profile is made ready, and what that was taken from, stands in
:mod:`roadscan.condition.profiles.texture`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.condition.profiles.segments import Segments
from roadscan.condition.profiles.texture import TextureSegment


class MeanProfileDepth(NamedTuple):
    """MPD of a stretch."""

    mpd_mm: float
    """Mean depth of its valid segments (mm); NaN where fewer than half are valid."""
    stdev_mm: float
    """Standard deviation of the depths (mm, n − 1); NaN of fewer than two."""
    valid: int
    """Number of valid segments."""
    segments: int
    """Number of segments that begin in the stretch."""


def segment_depth_mm(height_mm: Float64) -> float:
    """Return the depth (mm) of a segment from its heights (n,): mean of both halves' peaks above the mean of all."""
    middle = height_mm.size // 2
    return float(0.5 * (height_mm[:middle].max() + height_mm[middle:].max()) - height_mm.mean())


def mean_profile_depth(segments: Sequence[TextureSegment]) -> MeanProfileDepth:
    """Return the MPD of segments taken together."""
    depths = np.array([segment_depth_mm(one.height_mm) for one in segments if not one.note])
    enough = depths.size > 0 and 2 * depths.size >= len(segments)
    return MeanProfileDepth(
        float(depths.mean()) if enough else np.nan,
        float(depths.std(ddof=1)) if enough and depths.size > 1 else np.nan,
        depths.size,
        len(segments),
    )


def mean_profile_depths(segments: Sequence[TextureSegment], stretches: Segments) -> list[MeanProfileDepth]:
    """Return the MPD of each stretch, from the segments that begin in it."""
    begin = np.array([one.from_m for one in segments])
    found = []
    for first, last in zip(stretches.from_m, stretches.to_m, strict=True):
        # A segment of 100 mm that begins on a border, up to rounding, begins behind it.
        inside = np.flatnonzero((begin >= first - 1e-6) & (begin < last - 1e-6)).tolist()
        found.append(mean_profile_depth([segments[k] for k in inside]))
    return found
