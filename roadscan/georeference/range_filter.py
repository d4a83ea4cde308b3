"""Range filter for turns (Yu and others 2007, eq. 3): readings beyond the crossing of successive profiles.

    RF(r) = keep where r · cos θ ≤ d_crit = Δs / sin Δθ, else remove

**What is meant.** Δs is the arc between successive profiles, measured along the path of the sensor, and Δθ, here, the
change of heading between them. The paper calls Δθ the scanner's angular resolution, but takes the filter from work on
scanning façades from a vehicle (Früh, Jain, Zakhor 2005, *Data processing algorithms for generating textured 3D
building façade meshes from laser scans and camera images*), whose redundancy arises where the vehicle turns: the
planes of two successive scans that differ in heading by Δθ cross at the distance Δs / sin Δθ, the radius of the turn,
on its inner side. Nearer, the profiles cover the road in the order of driving. Beyond, they cover it again, the other
way round, and where they lie around the crossing, one spot is read from many poses. On the outer side profiles fan
out: they never overlap, and all readings are kept. A resolution of the scanner would cut every profile, straight
ones too, at Δs / sin 0.5° (3.4 m at 3 cm a profile).

r · cos θ is the reading's horizontal distance from the sensor across the path.

``georeference.turns`` takes heading and path over at least `base_m` of path, so that the noise of
successive headings is no turn. A vehicle that stands has no arc: it is not turning.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.array_types import Bool, Float64
from roadscan.core.settings.segmentation import RangeFilter


def limits_of_turns(arc_m: Float64, turn_rad: Float64, settings: RangeFilter) -> Float64:
    """Return limits (n, 2) to the left and right (m), from arcs (n,), negative backwards, and heading changes (n,)."""
    limits = np.full((arc_m.size, 2), np.inf)
    turning = (np.abs(turn_rad) > 1e-9) & (arc_m != 0.0)
    critical = np.abs(arc_m) / np.sin(np.clip(np.abs(turn_rad), 1e-9, math.pi / 2))
    critical[~turning | (critical > settings.radius_max_m)] = np.inf
    left = arc_m * turn_rad < 0.0
    limits[left, 0] = critical[left]
    limits[~left, 1] = critical[~left]
    return limits


def kept_in_turns(across_m: Float64, limits_m: Float64) -> Bool:
    """Which readings (n, m) are kept, by their horizontal distance across the path (n, m), right positive (m)."""
    kept: Bool = (across_m >= -limits_m[:, :1]) & (across_m <= limits_m[:, 1:])
    return kept
