"""Faulting: steps in the wheel paths at joints and transverse cracks.

Straight lines are fitted to the heights from 0.1 to 0.5 m before and behind a joint. The fault is their difference
there, positive where the approach slab stands higher than the departure slab, so that the road falls in the direction
of travel (LTPP distress identification manual, FHWA-HRT-13-092; AASHTO R 36 as public descriptions have it; no
compliance is claimed). Joints are known by

* transverse cracks of the product `cracks` that cross both wheel paths,
* their spacing, where the survey file states `joint_spacing_m`: `joint_station_m` says where one lies, else the joints
  that cracks and steps show,
* a step: the greatest within half a metre, at least 3 mm high and three times its standard deviation, most of which
  happens within 0.2 m, and beside which the other wheel path has one of more than half its height within 0.3 m: a joint
  crosses the lane, and unevenness of a metre does not.

A joint that is known by a crack or by the spacing counts in the mean however small its step is. A step of more than
0.1 m is a kerb that is crossed, or the edge of a hole: it is listed, and is no joint.

σ of a fault holds the noise of the heights, and the unevenness of the road itself over the metre around the joint: how
far such steps scatter at all places of the section.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about
from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.kernels.steps import step_heights
from roadscan.condition.lane_data import LaneData, Profile
from roadscan.condition.profiles.profiles import SEVERE_M
from roadscan.condition.wheel_paths import bridged

_NEAR_M: Final = 0.1  # Lines are fitted from this distance …
_FAR_M: Final = 0.5  # … to this distance before and behind a joint.
_APART_M: Final = 0.5  # Joints closer to one another are one joint.
_LEAST_M: Final = 0.003  # Least height of a step that shows a joint.
_SUDDEN: Final = 0.75  # Least share of a step that happens within `_NEAR_M`.
_BESIDE_M: Final = 0.3  # Largest distance along the lane of the step in the other wheel path.
_HALF: Final = 0.6  # Least height of that step, as a share of this one.
_LEAD_M: Final = 2.0  # Length before and behind a section that lines reach into.
_MM: Final = 1e3  # Millimetres in a metre.
_PATH_HALF_M: Final = 0.375
"""Half of the width of a wheel path that a crack crosses (m)."""
_SPACED_M: Final = 0.1
"""Largest distance of a joint from its place by the spacing (m)."""


class Faulting(ConditionIndex):
    """Steps in the wheel paths."""

    name: ClassVar[str] = "faulting"
    title: ClassVar[str] = "height of steps in the wheel paths, as at joints"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("step_left_mm", "mm", "Fault in the left wheel path, positive where the approach slab is higher"),
        Quantity("step_right_mm", "mm", "The same of the right wheel path"),
        Quantity("faulting_mean_mm", "mm", "Mean fault of the joints of a section that are known, without sign"),
        Quantity("faulting_max_mm", "mm", "Greatest fault of a joint of a section, without sign"),
        Quantity("joints", "number", "Joints of a section, by their cracks, their spacing or their steps"),
    )  # fmt: skip
    needs_cracks: ClassVar[bool] = True
    lead_m: ClassVar[float] = _LEAD_M

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return steps one by one, and values of sections."""
        phase_m = _phase_m(lane)
        for from_m, to_m in lane.sections_m:
            sides = {side: _Side.of(profile, from_m, to_m, lane) for side, profile in lane.profiles.items()}
            joints = _joints(lane, sides, (from_m, to_m), phase_m)
            for joint in joints:
                for side, (at, height, sigma) in joint.faults.items():
                    yield Value(f"step_{side}_mm", "cross_section", at, at, height, sigma, 1.0)
            yield from self._section(from_m, to_m, joints, min(s.share for s in sides.values()), lane)

    def _section(
        self, from_m: float, to_m: float, joints: list[_Joint], share: float, lane: LaneData
    ) -> Iterator[Value]:
        names = ("faulting_mean_mm", "faulting_max_mm", "joints")
        if share < lane.config.least_share:
            reason = f"{100 * share:.0f} % of the wheel paths were measured"
            yield from (Value(name, "section", from_m, to_m, np.nan, np.nan, share, reason) for name in names)
            return
        kerbs = [joint for joint in joints if joint.height_mm > _MM * SEVERE_M]
        joints = [joint for joint in joints if joint.height_mm <= _MM * SEVERE_M]
        remark = _remark(joints, len(kerbs))
        yield Value("joints", "section", from_m, to_m, float(len(joints)), np.nan, share, remark)
        found = np.array([fault[1:] for joint in joints for fault in joint.faults.values()]).reshape(-1, 2)
        heights, sigma = np.abs(found[:, 0]), found[:, 1]
        if not heights.size:
            yield from (Value(name, "section", from_m, to_m, 0.0, np.nan, share) for name in names[:2])
            return
        k = int(np.argmax(heights))
        spread = float(np.sqrt(np.mean(sigma**2)))
        yield Value("faulting_mean_mm", "section", from_m, to_m, float(heights.mean()), spread, share, remark)
        yield Value("faulting_max_mm", "section", from_m, to_m, float(heights[k]), float(sigma[k]), share)


class _Joint(NamedTuple):
    """A joint of a section."""

    known_by: Literal["cracks", "spacing", "steps"]
    station_m: float
    faults: dict[str, tuple[float, float, float]]
    """Station (m), fault and its standard deviation (mm) by wheel path."""

    @property
    def height_mm(self) -> float:
        """Greatest fault of both wheel paths, without sign."""
        return max(abs(height) for _, height, _ in self.faults.values())


def _remark(joints: list[_Joint], kerbs: int) -> str:
    """Return how joints are found, which are missed, and how many steps are no joints."""
    beside = f"steps of more than {_MM * SEVERE_M:g} mm that are no joints: {kerbs}" if kerbs else ""
    return "; ".join(part for part in (_known_by(joints), beside) if part)


def _known_by(joints: list[_Joint]) -> str:
    if not joints:
        return ""
    count = {word: sum(joint.known_by == word for joint in joints) for word in ("cracks", "spacing", "steps")}
    known = ", ".join(f"{number} by {word}" for word, number in count.items() if number)
    if count["spacing"] or count["cracks"]:
        return f"joints are known: {known}"
    return f"joints are known: {known}; those with less than {_MM * _LEAST_M:g} mm are not found"


def _joints(
    lane: LaneData, sides: dict[str, _Side], between_m: tuple[float, float], phase_m: float | None
) -> list[_Joint]:
    """Return the joints of a section by station; one found in several ways counts once."""
    found: list[_Joint] = []

    def new(station_m: float) -> bool:
        inside = between_m[0] - 1e-6 <= station_m < between_m[1] - 1e-6
        return inside and all(abs(station_m - joint.station_m) > _APART_M for joint in found)

    for places in _cracked(lane):
        faults = {side: sides[side].fault_at(at, 0.0) for side, at in places.items()}
        station = float(np.mean(list(places.values())))
        if new(station):
            found.append(_Joint("cracks", station, _known(faults)))
    if phase_m is not None and lane.config.joint_spacing_m is not None:
        spacing = lane.config.joint_spacing_m
        first, last = (int(np.ceil((end - phase_m) / spacing)) for end in between_m)
        for station in (phase_m + spacing * np.arange(first, last)).tolist():
            if new(station):
                faults = {side: own.fault_at(station, _SPACED_M) for side, own in sides.items()}
                found.append(_Joint("spacing", station, _known(faults)))
    steps = [(fault, side) for side, other in (("left", "right"), ("right", "left"))
             for fault in sides[side].steps(sides[other])]  # fmt: skip
    own = list[_Joint]()
    for fault, side in sorted(steps):
        beside = next((joint for joint in own if abs(joint.station_m - fault[0]) <= _APART_M), None)
        if beside is not None:
            beside.faults.setdefault(side, fault)
        elif new(fault[0]):
            own.append(_Joint("steps", fault[0], {side: fault}))
    for joint in own:
        missing = {side: one for side, one in sides.items() if side not in joint.faults}
        joint.faults.update(_known({side: one.fault_at(joint.station_m, _SPACED_M) for side, one in missing.items()}))
    return sorted((joint for joint in found + own if joint.faults), key=lambda joint: joint.station_m)


def _known(faults: Mapping[str, tuple[float, float, float] | None]) -> dict[str, tuple[float, float, float]]:
    return {side: fault for side, fault in faults.items() if fault is not None}


def _cracked(lane: LaneData) -> Iterator[dict[str, float]]:
    """Return stations at which transverse cracks cross both wheel paths, by wheel path."""
    for crack in lane.cracks or ():
        places = {}
        for side, sign in (("left", -1.0), ("right", 1.0)):
            on = np.abs(crack.own_m - sign * lane.config.wheel_paths_m) <= _PATH_HALF_M
            if on.any():
                places[side] = float(crack.station_m[on].mean())
        if crack.kind == "transverse" and len(places) == 2:
            yield places


def _phase_m(lane: LaneData) -> float | None:
    """Return the station of a joint of the stated spacing; None where none is stated, or its place is unknown."""
    spacing = lane.config.joint_spacing_m
    if spacing is None or lane.config.joint_station_m is not None:
        return lane.config.joint_station_m
    stations = [at for places in _cracked(lane) for at in places.values()]
    for from_m, to_m in lane.sections_m:
        sides = {side: _Side.of(profile, from_m, to_m, lane) for side, profile in lane.profiles.items()}
        for side, other in (("left", "right"), ("right", "left")):
            stations += [at for at, _, _ in sides[side].steps(sides[other])]
    if not stations:
        return None
    # Use the largest group of joints that agree modulo the spacing, so that chance steps do not matter.
    around = np.asarray(stations) % spacing
    away = np.abs((around[:, None] - around + 0.5 * spacing) % spacing - 0.5 * spacing) <= 2.0 * _SPACED_M
    best = around[int(np.argmax(away.sum(axis=1)))]
    near = (around - best + 0.5 * spacing) % spacing - 0.5 * spacing
    return float(best + np.median(near[np.abs(near) <= 2.0 * _SPACED_M]))


def _unevenness_m(found: Float64) -> float:
    """Return the robust scatter of steps (n, 3) at all places of a section, less the noise of their heights (m)."""
    height, sigma = found[np.isfinite(found[:, :2]).all(axis=1), :2].T
    if not height.size:
        return 0.0
    scatter = scatter_about(height, 0.0)
    return math.sqrt(max(scatter**2 - float(np.median(sigma)) ** 2, 0.0))


@dataclass(frozen=True, eq=False)
class _Side:
    """Possible steps of a wheel path."""

    profile: Profile
    inside: npt.NDArray[np.bool_]
    """(n,) True for places in the section itself."""
    found: Float64
    """(n, 3) height of a step, its standard deviation (m), and the share of it that happens at once."""
    share: float
    uneven_m: float
    """Standard deviation of steps caused by the road's unevenness."""

    @classmethod
    def of(cls, profile: Profile, from_m: float, to_m: float, lane: LaneData) -> _Side:
        part = bridged(profile.between(from_m - _LEAD_M, to_m + _LEAD_M), lane.config.largest_gap_m)
        inside = (part.station_m >= from_m - 1e-6) & (part.station_m < to_m - 1e-6)
        due = max((to_m - from_m) / lane.config.profile_spacing_m, 1.0)
        found = np.full((part.height_m.size, 3), np.nan)
        if part.height_m.size > 2:
            step_heights(part.distance_m, part.height_m, part.known_sigma_m, (_NEAR_M, _FAR_M), found)
        share = min(1.0, float((~np.isnan(part.height_m[inside])).sum()) / due)
        return cls(part, inside, found, share, _unevenness_m(found))

    def fault_at(self, station_m: float, reach_m: float) -> tuple[float, float, float] | None:
        """Return station (m), fault and standard deviation (mm) at a joint, or at the greatest step within reach of it.

        The greatest counts only where it is three standard deviations high: a level joint has none.
        """
        away = np.abs(self.profile.station_m - station_m)
        known = np.flatnonzero(np.isfinite(self.found[:, 0]) & (away <= max(reach_m, _NEAR_M)))
        if not known.size:
            return None
        k = int(known[np.argmin(away[known])])
        near = known[away[known] <= reach_m]
        if near.size:
            high = int(near[np.argmax(np.abs(self.found[near, 0]))])
            k = high if abs(self.found[high, 0]) >= 3.0 * np.nan_to_num(self.found[high, 1]) else k
        return float(self.profile.station_m[k]), *self._fault(k)

    def _fault(self, k: int) -> tuple[float, float]:
        """Fault at a place and its standard deviation (mm): a rise in the direction of travel is negative."""
        height, sigma, _ = self.found[k].tolist()
        return -_MM * height, _MM * math.hypot(sigma, self.uneven_m)

    def steps(self, other: _Side) -> Iterator[tuple[float, float, float]]:
        """Return station (m), fault and standard deviation (mm) of each step that the other wheel path has as well."""
        height, sigma, sudden = self.found.T
        size, station = np.abs(height), self.profile.station_m
        fits = (
            (size >= _LEAST_M)
            & (size >= 3.0 * np.nan_to_num(sigma))
            & (sudden * height >= _SUDDEN * size * size)
            & self.inside
        )
        for k in np.flatnonzero(fits).tolist():
            near = np.abs(station - station[k]) <= _APART_M
            beside = other.found[np.abs(other.profile.station_m - station[k]) <= _BESIDE_M, 0]
            same = np.nan_to_num(beside * np.sign(height[k])).max(initial=0.0)
            if size[k] >= np.nan_to_num(size[near]).max() and same >= _HALF * size[k]:
                yield float(station[k]), *self._fault(k)
