"""Prepares the geometry of flat profiles, whose readings are taken at one instant near the sensor, for kernels."""

from __future__ import annotations

import functools
from typing import Final

import numpy as np

from roadscan.core.scan_geometry import ScanGeometry
from roadscan.georeference.kernels.flat_profiles import FlatProfiles

REACH_M: Final = 8.0
"""Farthest that a reading may lie from the middle of its profile. Over 8 m the map departs from a plane by
s²/2R = 5 µm (R the Earth's radius), and a 32-bit float resolves 0.6 µm."""

EVERY_RAW_RANGE: Final = (np.uint16(1), np.uint16(65_535))
"""Lowest and highest raw range of a return."""


@functools.lru_cache(maxsize=64)
def flat_profiles(geometry: ScanGeometry, range_min_m: float, range_max_m: float) -> FlatProfiles | None:
    """Flat profiles of a geometry between range limits; None where each reading has to be georeferenced singly."""
    if geometry.reading_period_ns > 0.0:
        return None
    low, high = geometry.raw_limits(range_min_m, range_max_m)
    origins, directions = geometry.rays()
    reach_m = [geometry.range_offset_m + geometry.range_step_m * raw for raw in (low, high)]
    ends = np.concatenate([(origins + far_m * directions)[:, 1:] for far_m in reach_m])
    middle = (ends.min(axis=0) + ends.max(axis=0)) / 2.0
    if np.hypot(*(ends - middle).T).max() > REACH_M:
        return None
    rays = np.stack([*(origins[:, 1:] - middle).T, *directions[:, 1:].T]).astype(np.float32)
    return FlatProfiles(
        rays=np.ascontiguousarray(rays),
        middle=(float(middle[0]), float(middle[1])),
        scale=(np.float32(geometry.range_offset_m), np.float32(geometry.range_step_m)),
        raw_limits=(np.uint16(low), np.uint16(high)),
    )
