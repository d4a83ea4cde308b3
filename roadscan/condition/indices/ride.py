"""Ride of the wheel paths: the International Roughness Index and the Ride Number.

International roughness index of the wheel paths, mean and half-car index, localised roughness.

Of each section the golden car begins 100 m before it (or where the profile begins), so that a section's
value depends on nothing farther away: what is left of the beginning after 100 m is below a millionth. Formulas and
sources: :mod:`roadscan.condition.profiles.ride`.

Ride number of a section, of both wheel paths together.

Formula and sources: :mod:`roadscan.condition.profiles.ride`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData
from roadscan.condition.profiles.profiles import RULES, SEVERE_M
from roadscan.condition.profiles.ride import (
    Ride,
    Segments,
    iri_of,
    mean_roughness_index,
    ride,
    ride_number,
    ride_number_of,
    ride_number_ride,
    rolling_iri,
)
from roadscan.condition.wheel_paths import (
    LEAD_M,
    NOISES,
    Cleared,
    WheelPath,
    greatest_of,
    spread_of,
    wheel_paths,
    without_noise,
)
from roadscan.core.counted import listed
from roadscan.core.witness import Witness

SEVERE_STEP: Final = Witness(
    name="severe_step",
    input="condition",
    fault="Neighbouring heights of a wheel path differ by more than a road does.",
    asks=f"Heights of neighbours: more than {SEVERE_M:g} m apart they are a kerb, the edge of a pothole or a fault.",
    does=f"A step of up to {RULES.highest_step_m:g} m is kept in the roughness, a higher one is left out of it.",
    told=("findings",),
)


_NAMED: Final = 6
"""Most stations of steps that a section names; the others are counted."""


class Iri(ConditionIndex):
    """Roughness of sections."""

    name: ClassVar[str] = "iri"
    title: ClassVar[str] = "international roughness index (golden car, 80 km/h) and its relatives"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("iri_left_m_per_km", "m/km", "International roughness index of the left wheel path"),
        Quantity("iri_right_m_per_km", "m/km", "The same of the right wheel path"),
        Quantity("mri_m_per_km", "m/km", "Mean roughness index: the mean of both"),
        Quantity("hri_m_per_km", "m/km", "Half-car roughness index: IRI of the mean of both profiles"),
        Quantity("iri_local_max_m_per_km", "m/km", "Greatest rolling IRI over 7.62 m of either wheel path"),
    )
    drawn: ClassVar[tuple[str, ...]] = ("iri_left_m_per_km", "iri_right_m_per_km")
    lead_m: ClassVar[float] = LEAD_M

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return the values of sections."""
        for from_m, to_m in lane.sections_m:
            yield from self._section(lane, from_m, to_m)

    def _section(self, lane: LaneData, from_m: float, to_m: float) -> Iterator[Value]:
        paths = wheel_paths(lane, from_m, to_m)
        found = {side: _told(path) for side, path in paths.items()}
        for side, told in found.items():
            yield Value(f"iri_{side}_m_per_km", "section", from_m, to_m, told.iri, told.sigma, told.share, told.reason,
                        SEVERE_STEP.finds("", f"{side} wheel path: {told.steps}.") if told.steps else None)  # fmt: skip
        left, right = found["left"], found["right"]
        share, reason = min(left.share, right.share), left.reason or right.reason
        mean = float(mean_roughness_index(np.array(left.iri), np.array(right.iri)))
        spread = _sigma_of_mean(left.cleared, right.cleared)
        yield Value("mri_m_per_km", "section", from_m, to_m, mean, spread, share, reason)
        half, spread = _half_car(paths["left"], paths["right"]) if np.isfinite(mean) else (np.nan, np.nan)
        yield Value("hri_m_per_km", "section", from_m, to_m, half, spread, share, reason)
        local = max(left, right, key=lambda told: told.local)
        known = np.isfinite(left.local) and np.isfinite(right.local)
        worst, spread = (local.local, local.sigma_local) if known else (np.nan, np.nan)
        yield Value("iri_local_max_m_per_km", "section", from_m, to_m, worst, spread, share, reason)


class _Told:
    """Roughness of a wheel path in a section."""

    def __init__(self, share: float, reason: str) -> None:
        self.local = self.sigma_local = np.nan
        self.cleared = Cleared(np.nan, np.nan, reason)
        self.steps = ""
        self.share, self.reason = share, reason

    @property
    def iri(self) -> float:
        return self.cleared.value

    @property
    def sigma(self) -> float:
        return self.cleared.sigma


def _told(path: WheelPath) -> _Told:
    told = _Told(path.share, path.reason)
    if path.reason:
        return told
    on = ride(path.profile.distance_m, path.tried())
    rough = iri_of(on, path.ends).iri_m_per_km[:, 0]
    if np.isnan(rough[0]):
        told.reason = on.faults[0] or "a step that no road has"
        return told
    told.cleared = without_noise(rough)
    told.reason = told.cleared.reason
    if told.reason:
        return told
    most = greatest_of(rolling_iri(on)[[0, *range(2, 2 + NOISES)]][:, path.inside])
    told.local, told.sigma_local = float(most[0]), spread_of(most)
    noted = on.notes(path.ends)[0][0]
    told.steps = _steps(on, path, noted)
    start = f"the profile begins in it: its first {RULES.start_m:g} m depend on how the car begins"
    told.reason = "; ".join(one for one in (start if "start" in noted else "", told.steps) if one)
    return told


def _steps(on: Ride, path: WheelPath, noted: str) -> str:
    """Describe where the wheel path steps as roads do not, and what was done; empty where it does not."""
    found = []
    station, way = path.profile.station_m, path.profile.distance_m
    broken = on.breaks[0]
    left_out = f"more than {RULES.highest_step_m:g} m, which no car rolls over, and is left out"
    kept = f"more than {SEVERE_M:g} m, as at a kerb, and is kept"
    for word, places, done in (("jump", broken.jump_m, left_out), ("step", broken.severe_m, kept)):
        if word in noted:
            own = places[(places >= path.ends.from_m[0]) & (places <= path.ends.to_m[0])]
            at = list(dict.fromkeys(f"{one:.1f}" for one in np.interp(own, way, station).tolist()))
            found.append(f"at station {listed(at, _NAMED)} the road steps by {done}")
    return "; ".join(found)


def _sigma_of_mean(left: Cleared, right: Cleared) -> float:
    """Standard deviation of the mean of two wheel paths: noises are independent, the poses' wander is common."""
    if not np.isfinite(left.sigma + right.sigma):
        return np.nan
    spread = float(np.std(0.5 * (left.drawn + right.drawn), ddof=1))
    return float(np.hypot(spread, 0.5 * np.hypot(left.rest, right.rest)))


def _half_car(left: WheelPath, right: WheelPath) -> tuple[float, float]:
    """Return the IRI of the mean of two wheel paths, and its standard deviation; the noises of both are independent."""
    x = 0.5 * (left.profile.distance_m + right.profile.distance_m)
    on = ride(x, 0.5 * (left.tried() + right.tried(NOISES)))
    ends = Segments(*(0.5 * (a + b) for a, b in zip(left.ends, right.ends, strict=True)))
    cleared = without_noise(iri_of(on, ends).iri_m_per_km[:, 0])
    return cleared.value, cleared.sigma


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
