"""Ride number of a section, of both wheel paths together.

Formula and sources: :mod:`roadscan.condition.profiles.ride_number`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData
from roadscan.condition.of_sections.wheel_paths import (
    LEAD_M,
    NOISES,
    Cleared,
    WheelPath,
    wheel_paths,
    without_noise,
)
from roadscan.condition.profiles.ride_number import ride_number, ride_number_of, ride_number_ride

_WIDEST_M: Final = 0.07
"""Largest standard deviation of the weights of a height's window: that of cells of 0.1 m."""


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
        """Return the values of sections."""
        for from_m, to_m in lane.sections_m:
            yield _of_section(lane, from_m, to_m)


def _of_section(lane: LaneData, from_m: float, to_m: float) -> Value:
    paths = wheel_paths(lane, from_m, to_m)
    share = min(path.share for path in paths.values())
    reason = next((path.reason for path in paths.values() if path.reason), "")
    if not reason and lane.window_m2 > _WIDEST_M**2:
        reason = (
            f"heights each {lane.config.profile_spacing_m:g} m of cells of {lane.cell_m:g} m show no waves short enough"
        )
    if reason:
        return Value("ride_number", "section", from_m, to_m, np.nan, np.nan, share, reason)
    found = [_profile_index(path, k * NOISES) for k, path in enumerate(paths.values())]
    reason = next((one.reason for one in found if one.reason), "")
    index, sigma = (np.array(values) for values in zip(*(one[:2] for one in found), strict=True))
    value = float(ride_number(index))
    if not np.isfinite(value):
        reason = reason or "a step that no road has"
    return Value("ride_number", "section", from_m, to_m, value, _sigma(value, index, sigma), share, reason)


def _profile_index(path: WheelPath, first_stream: int) -> Cleared:
    on = ride_number_ride(path.profile.distance_m, path.tried(first_stream))
    return without_noise(ride_number_of(on, path.ends).profile_index[:, 0])


def _sigma(value: float, index: Float64, sigma: Float64) -> float:
    """Return the standard deviation of a ride number, from those of the profile indices of its paths."""
    both = float(np.sqrt(np.mean(index**2)))
    return 160.0 * value * float(np.hypot(*(index * sigma))) / (2.0 * both) if both else 0.0
