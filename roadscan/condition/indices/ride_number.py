"""Ride number of a section, of both wheel paths together.

Formula and sources: :mod:`roadscan.condition.ride_number`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData
from roadscan.condition.of_sections.wheel_paths import LEAD_M, NOISES, spread_of, wheel_paths
from roadscan.condition.ride_number import ride_number, ride_number_of, ride_number_ride


class RideNumber(ConditionIndex):
    """The rating that road users would give."""

    name: ClassVar[str] = "ride_number"
    title: ClassVar[str] = "ride number, the rating of road users from 0 to 5"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("ride_number", "1", "Rating that road users would give, from 0 to 5, of both wheel paths"),
    )
    drawn: ClassVar[tuple[str, ...]] = ("ride_number",)
    lead_m: ClassVar[float] = LEAD_M

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Values of sections."""
        for from_m, to_m in lane.sections_m:
            yield _of_section(lane, from_m, to_m)


def _of_section(lane: LaneData, from_m: float, to_m: float) -> Value:
    paths = wheel_paths(lane, from_m, to_m)
    share = min(path.share for path in paths.values())
    reason = next((path.reason for path in paths.values() if path.reason), "")
    value = sigma = np.nan
    if not reason:
        index = []
        for k, path in enumerate(paths.values()):
            on = ride_number_ride(path.profile.distance_m, path.with_noise(k * NOISES))
            index.append(ride_number_of(on, path.ends).profile_index[:, 0])
        tried = ride_number(np.array(index))
        value, sigma = float(tried[0]), spread_of(tried)
        reason = "" if np.isfinite(value) else "a step that no road has"
    return Value("ride_number", "section", from_m, to_m, value, sigma, share, reason)
