"""Control points as passes saw them: times of passage, sightings, and the observations that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from roadscan.adjust.observations import FIXED, KINDS, MOUNTED, Observations, mount_partials, partials
from roadscan.adjust.places import PassReadings, Track, Traverse, level_from_map, map_from_level
from roadscan.adjust.settings import TargetSettings
from roadscan.adjust.targets.find import find_target
from roadscan.adjust.targets.fit import find_line
from roadscan.adjust.targets.shapes import (
    ExpectedTarget,
    HeightFind,
    Shape,
    SurveyedLine,
    TargetFind,
    TargetReadings,
    height_at,
)
from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about
from roadscan.core.counted import listed
from roadscan.core.gpstime import NS_PER_S
from roadscan.poses.trajectory import Corrections, MountingChange, Seat

SightStatus = Literal["found", "missed", "doubled", "moved", "picked", "height", "unseen"]
"""`height`: no target is looked for, the height alone was measured; `unseen`: not even that, or the pass did not see
the road where the target is looked for."""

_NEAR_M: Final = 3.0  # Longer steps of a track count as this long (m).
_LONGEST_NS: Final = 20 * NS_PER_S  # longest part of a traverse to either side of its nearest time (ns)


@dataclass(frozen=True)
class ControlPoint:
    """A surveyed point, in the map."""

    number: int
    name: str
    role: str
    """`gcp` or `check`."""
    code: str
    easting_m: float
    northing_m: float
    height_m: float
    sigma_horizontal_m: float
    sigma_height_m: float
    shape: Shape | SurveyedLine | None
    """None: no target is searched."""

    @property
    def is_of_line(self) -> bool:
        """Whether it stands for a surveyed line: it binds across the line, and in height where that was surveyed."""
        return isinstance(self.shape, SurveyedLine)


@dataclass(frozen=True)
class PickedPlace:
    """Place of a point's target that the user picked in the recorded poses of a run (map, m)."""

    easting_m: float
    northing_m: float
    sigma_m: float


@dataclass(frozen=True)
class Sighting:
    """What one pass saw of a point; NaN where not measured."""

    point: ControlPoint
    run: int
    sensor: str
    """Of the pose that `epoch_gps_ns` names: the one that saw the place in the mean."""
    status: SightStatus
    why_not: str
    epoch_gps_ns: int
    easting_m: float
    """Of the target, as the recorded poses show it."""
    northing_m: float
    covariance_m2: Float64
    """(2, 2) of easting and northing, without that of the poses."""
    height_m: float
    """Of the road at the target; at the surveyed place where none is looked for or none was found; NaN where there are
    several, and with them several heights."""
    sigma_height_m: float
    slope_east: float
    slope_north: float
    count: int
    contrast: float
    score: float
    arm_body_m: Float64
    """(3,) from the body's origin to the place, body axes: the mean of the readings that measured it."""
    level_from_body: Float64
    """(3, 3)"""
    convergence_rad: float
    find: TargetFind | None = None

    @property
    def is_placed(self) -> bool:
        """Whether the place was measured, and not the height alone: a target that lies elsewhere than surveyed counts
        where it lies, and the adjustment judges its survey.
        """
        return self.status in ("found", "moved", "picked")

    @property
    def observed(self) -> int:
        """Returns the number of observations that it gives."""
        return int(np.isfinite(self.height_m)) + 2 * self.is_placed


def passes_by(track: Track, easting_m: float, northing_m: float, radius_m: float, apart_s: float) -> list[Traverse]:
    """Returns spans in which a sensor saw a circle of the road, one for each passage.

    apart_s : a vehicle that returns after this time or more passes again.
    """
    east, north = easting_m - track.easting_m, northing_m - track.northing_m
    sine, cosine = np.sin(track.heading_rad), np.cos(track.heading_rad)
    along, across = east * sine + north * cosine, east * cosine - north * sine
    reach = radius_m + track.ahead_m + _step_m(track)
    beside = (across >= -np.asarray(track.left_m) - radius_m) & (across <= np.asarray(track.right_m) + radius_m)
    rows = np.flatnonzero((np.abs(along) <= reach) & beside)
    if not rows.size:
        return []
    epochs, found = track.epoch_gps_ns, []
    for visit in np.split(rows, np.flatnonzero(np.diff(epochs[rows]) > apart_s * NS_PER_S) + 1):
        first, last = int(epochs[visit[0]]), int(epochs[visit[-1]])
        nearest = int(epochs[visit[np.argmin(np.abs(along[visit]))]])
        found.append(
            Traverse(track.run, track.sensor, max(first, nearest - _LONGEST_NS), min(last, nearest + _LONGEST_NS))
        )
    return found


def _step_m(track: Track) -> float:
    """Returns the longest step between positions of a track (m); gaps count as 3 m."""
    steps = np.hypot(np.diff(track.easting_m), np.diff(track.northing_m))
    return float(min(steps.max(initial=0.0), _NEAR_M))


def sight(
    point: ControlPoint,
    heads: Sequence[PassReadings],
    settings: TargetSettings,
    sigma_pose_m: float,
    picked: PickedPlace | None = None,
) -> Sighting:
    """Returns what one pass saw of a point.

    Parameters
    ----------
    heads : readings of the sensors of the pass near the point, one at least.
    sigma_pose_m : 1 σ of the recorded poses on each horizontal axis.
    picked : stands in for what would be found.
    """
    readings = TargetReadings(
        easting_m=np.concatenate([h.easting_m for h in heads]),
        northing_m=np.concatenate([h.northing_m for h in heads]),
        height_m=np.concatenate([h.height_m for h in heads]),
        intensity=np.concatenate([h.intensity for h in heads]),
        sigma_horizontal_m=sigma_pose_m,
    )
    nan, none = float("nan"), np.full((2, 2), np.nan)
    status: SightStatus = "height"
    why_not, find = "", None
    place, covariance = np.array([nan, nan]), none
    if isinstance(point.shape, SurveyedLine):
        seen = find_line(readings, point.easting_m, point.northing_m, point.shape, settings)
        height = seen.height if np.isfinite(point.height_m) else HeightFind(nan, nan, nan, nan, seen.count, 0.0, "")
        at = np.array([point.easting_m, point.northing_m]) if seen.status != "found" else seen.place_m
        found = _with_pose(
            point, heads, at, height, settings.height_radius_m,
            (seen.status, seen.why_not, seen.place_m, seen.covariance_m2, None),
        )  # fmt: skip
        return replace(found, contrast=seen.contrast)
    if picked is not None:
        status, place = "picked", np.array([picked.easting_m, picked.northing_m])
        covariance = picked.sigma_m**2 * np.eye(2)
    elif point.shape is not None:
        expected = ExpectedTarget(
            point.name, point.easting_m, point.northing_m, point.height_m, point.sigma_horizontal_m, point.shape
        )
        find = find_target(readings, expected, settings)
        status, why_not = find.status, find.why_not
        if status in ("found", "moved"):
            place, covariance = np.array([find.easting_m, find.northing_m]), find.covariance_m2
    at = place if np.isfinite(place).all() else np.array([point.easting_m, point.northing_m])
    height = height_at(readings, float(at[0]), float(at[1]), settings)
    if not np.isfinite(height.height_m) and status in ("height", "missed"):
        status, why_not = "unseen", height.why_not
    if status == "doubled":
        nowhere = float("nan")
        height = replace(height, height_m=nowhere, sigma_m=nowhere, slope_east=nowhere, slope_north=nowhere)
    return _with_pose(point, heads, at, height, settings.height_radius_m, (status, why_not, place, covariance, find))


def sight_shifted(
    point: ControlPoint,
    heads: Sequence[PassReadings],
    settings: TargetSettings,
    sigma_pose_m: float,
    picked: PickedPlace | None,
    shift_level_m: Float64,
) -> Sighting:
    """Returns the same for a pass whose readings were shifted (3,; north, east, down), in the recorded poses."""
    east, north, up = map_from_level(shift_level_m[None], heads[0].convergence_rad)[0].tolist()
    if picked is not None:
        picked = replace(picked, easting_m=picked.easting_m + east, northing_m=picked.northing_m + north)
    one = sight(point, heads, settings, sigma_pose_m, picked)
    if one.is_placed or not np.isfinite(one.slope_east):
        height = one.height_m - up
    else:
        # At the surveyed place the shift moves it along a road that slopes.
        height = one.height_m - up + one.slope_east * east + one.slope_north * north
    return replace(one, easting_m=one.easting_m - east, northing_m=one.northing_m - north, height_m=height)


def _with_pose(
    point: ControlPoint,
    heads: Sequence[PassReadings],
    at: Float64,
    height: HeightFind,
    radius_m: float,
    found: tuple[SightStatus, str, Float64, Float64, TargetFind | None],
) -> Sighting:
    status, why_not, place, covariance, find = found
    away = [np.hypot(h.easting_m - at[0], h.northing_m - at[1]) for h in heads]
    seen = [k for k, a in enumerate(away) if a.size]
    if not seen:
        return _unseen(point, heads[0])
    number = min(seen, key=lambda k: float(away[k].min()))
    head, near = heads[number], away[number]
    reading = int(np.argmin(near))
    level = height.height_m if np.isfinite(height.height_m) else float(head.height_m[reading])
    # A lidar sees a place from far before it to far behind it: what is measured moves with the mean of their arms.
    first = sum(len(a) for a in away[:number])
    weight = height.weight[first : first + near.size] if height.weight.size else (near <= radius_m).astype(np.float64)
    used = np.flatnonzero(weight > 0.0)
    used, weight = (used, weight[used]) if used.size else (np.array([reading]), np.ones(1))
    poses = head.pose[used].astype(np.int64)
    arms = head.arm_body_m(np.broadcast_to([at[0], at[1], level], (poses.size, 3)), poses)
    arm = np.average(arms, axis=0, weights=weight)
    since = head.epoch_gps_ns[poses] - head.epoch_gps_ns[poses[0]]
    pose = int(poses[np.argmin(np.abs(since - np.average(since, weights=weight)))])
    return Sighting(
        point, head.run, head.sensor, status, why_not, int(head.epoch_gps_ns[pose]), float(place[0]), float(place[1]),
        covariance, height.height_m, height.sigma_m, height.slope_east, height.slope_north,
        find.count if find is not None else height.count, find.contrast if find is not None else float("nan"),
        find.score if find is not None else float("nan"), arm, head.level_from_body[pose], head.convergence_rad, find,
    )  # fmt: skip


def _unseen(point: ControlPoint, head: PassReadings) -> Sighting:
    nan = float("nan")
    return Sighting(
        point, head.run, head.sensor, "unseen", "no reading near it", 0, nan, nan, np.full((2, 2), nan), nan, nan, nan,
        nan, 0, nan, nan, np.full(3, nan), np.full((3, 3), nan), head.convergence_rad,
    )  # fmt: skip


def moved_m(
    one: Sighting, corrections: Corrections | None, mounting: tuple[MountingChange, Seat] | None = None
) -> Float64:
    """Movement of a sighting by corrections: easting, northing, height (3,) (m); without a place that of the
    height at its surveyed place, on a road that slopes.

    mounting : change of that of the sensor that saw it, and its seat.
    """
    if (corrections is None and mounting is None) or not np.isfinite(one.arm_body_m).all():
        return np.zeros(3)
    level = np.zeros((1, 3))
    if corrections is not None:
        shift, turn = corrections.at(np.array([one.epoch_gps_ns]))
        level = level + shift + one.level_from_body @ np.cross(turn[0], one.arm_body_m)
    if mounting is not None:
        change, seat = mounting
        level = level + change.moves_level(one.level_from_body[None], one.arm_body_m[None], seat)
    easting, northing, height = map_from_level(level, one.convergence_rad)[0]
    if not one.is_placed and np.isfinite(one.slope_east):
        height -= one.slope_east * easting + one.slope_north * northing
    return np.array([easting, northing, height])


@dataclass(frozen=True)
class SeenBy:
    """The sensor that saw a point."""

    number: int
    """Number among those whose mounting is estimated; −1: none."""
    seat: Seat
    """Its lever arm, and the direction of its beams, (3,) each."""


def observations_of(sightings: Sequence[Sighting], seen_by: Sequence[SeenBy] | None = None) -> Observations:
    """Returns height of each sighting, and two components of those with a place, in order of the sightings.

    The height is that along the normal of the road at a point without a target, whose place on the road is known by the
    poses alone. The components of a place are along the axes of its covariance, so that they are independent.

    seen_by : sensor of each sighting; without it, mountings are not estimated.
    """
    parts = [part for number, one in enumerate(sightings) for part in _of_one(number, one)]
    groups = np.array([int(part.group[0]) for part in parts], np.int64)
    joined = replace(Observations.joined(parts), group=groups)
    if seen_by is None or not joined.size:
        return joined
    each = [own for one, own in zip(sightings, seen_by, strict=True) for _ in range(one.observed)]
    seen = [one for one in sightings for _ in range(one.observed)]
    turned = np.array([one.level_from_body for one in seen])
    in_body = np.einsum("nji,nj->ni", turned, joined.partials[:, 0, :3])
    along = np.einsum("ni,ni->n", in_body, np.array([one.arm_body_m for one in seen]))
    seat = Seat(np.array([s.seat.lever_body_m for s in each]), np.array([s.seat.beam_body for s in each]))
    by_mounting = np.zeros((joined.size, 2, len(MOUNTED)))
    by_mounting[:, 0] = mount_partials(in_body, joined.partials[:, 0, 3:], along, seat)[0]
    sensor = np.array([[s.number, -1] for s in each], np.int32)
    return replace(joined, sensor=sensor, mount_partials=by_mounting)


def _of_one(number: int, one: Sighting) -> list[Observations]:
    parts = []
    point = one.point
    if np.isfinite(one.height_m):
        lift, normal = 1.0, np.array([[0.0, 0.0, 1.0]])
        if not one.is_placed:
            normal = np.array([[-one.slope_east, -one.slope_north, 1.0]])
            lift = float(1.0 / np.linalg.norm(normal))
        direction = level_from_map(normal * lift, one.convergence_rad)
        value, sigma = lift * (point.height_m - one.height_m), lift * one.sigma_height_m
        # On a road that slopes, a wrong surveyed place has another height.
        misplaced = 0.0 if one.is_placed else point.sigma_horizontal_m * float(np.hypot(*normal[0, :2]))
        surveyed = float(np.hypot(point.sigma_height_m, misplaced))
        parts.append(_observation("control_height", one, direction, value, (sigma, surveyed), 2 * number))
    if one.is_placed:
        away = np.array([point.easting_m - one.easting_m, point.northing_m - one.northing_m])
        variance, axes = np.linalg.eigh(one.covariance_m2)
        for axis, own in zip(axes.T, variance, strict=True):
            direction = level_from_map(np.array([[axis[0], axis[1], 0.0]]), one.convergence_rad)
            sigmas = (float(np.sqrt(own)), point.sigma_horizontal_m)
            parts.append(_observation("control_position", one, direction, float(axis @ away), sigmas, 2 * number + 1))
    return parts


def _observation(
    kind: str, one: Sighting, direction: Float64, value_m: float, sigma_m: tuple[float, float], group: int
) -> Observations:
    derivatives = np.zeros((1, 2, 6))
    derivatives[0, 0] = partials(direction, one.level_from_body[None], one.arm_body_m[None])[0]
    return Observations(
        np.array([KINDS.index(kind)], np.uint8), np.array([[one.run, FIXED]], np.int32),
        np.array([[one.epoch_gps_ns, 0]], np.int64), derivatives, np.array([value_m]), np.array([sigma_m[0]]),
        np.array([group], np.int64), np.array([one.point.number], np.int64), np.array([sigma_m[1]]),
    )  # fmt: skip


NAMED: Final = 8
"""At most this many points are named; of the rest the number is reported."""
_SIGMAS: Final = 4.0  # Heights agree after an exchange within this many σ.


@dataclass(frozen=True)
class WrongPoint:
    """A control point whose survey the other evidence contradicts."""

    name: str
    height_m: float
    """Surveyed minus predicted height; NaN where the height is right."""
    horizontal_m: float
    """Distance of the surveyed place from the predicted one; NaN where the place is right."""
    sigma_m: float
    """1 σ of the height's difference."""
    surveyed_height_m: float
    sigmas: float = float("nan")
    """Length of the normalised residual; NaN where it is not known."""
    limit: float = float("nan")
    """Length of the normalised residual from which a point is wrong."""
    alternatives: tuple[str, ...] = ()
    """Points that may be wrong instead."""

    def in_words(self) -> str:
        """Returns the fault in words."""
        parts, what = [], []
        if np.isfinite(self.height_m):
            parts.append(f"its surveyed height lies {self.height_m * 1e3:+.1f} mm")
            what.append("height")
        if np.isfinite(self.horizontal_m):
            parts.append(f"its surveyed place lies {self.horizontal_m * 1e3:.1f} mm")
            what.append("place")
        if not what:  # all others together contradict it, but none of them alone says by how much
            parts, what = ["its survey lies elsewhere"], ["survey"]
        text = f"{' and '.join(parts)} from what all other evidence says"
        if np.isfinite(self.sigmas):
            text += f" ({self.sigmas:.1f} σ, where {self.limit:.1f} σ are the limit)"
        if self.alternatives:
            names = listed(self.alternatives, NAMED)
            return f"{text}; it or {names} is wrong, and nothing tells which of them: none of their {what[0]}s counts"
        return f"{text}; its {' and its '.join(what)} does not count"


def datum_fault(sightings: Sequence[Sighting], largest_m: float) -> str:
    """Returns why no point can be used: their heights are in another datum than the map's; "" where they fit.

    largest_m : a median difference up to this is attributed to the poses.
    """
    away = np.array([one.point.height_m - one.height_m for one in sightings if np.isfinite(one.height_m)])
    if away.size == 0 or abs(float(np.median(away))) <= largest_m:
        return ""
    middle = float(np.median(away))
    spread = scatter_about(away, middle)
    return (
        f"the control points lie {middle:+.3f} m from the road that was measured (median of {away.size} sightings, "
        f"spread {spread:.3f} m): they are in another height datum or CRS than their [[control]] states, or the "
        "trajectories are; none of them is used"
    )


def far_in_height(
    sightings: Sequence[Sighting], largest_m: float, sigma_m: Sequence[float] | None = None
) -> dict[str, float]:
    """Returns points, by name, whose height differs by more than that from what most passes measured: surveyed minus
    (m).

    sigma_m : 1 σ of the recorded height at each sighting; in an outage a point may differ by four of them.
    """
    found: dict[str, list[float]] = {}
    allowed: dict[str, float] = {}
    for one, sigma in zip(sightings, sigma_m or [0.0] * len(sightings), strict=True):
        if np.isfinite(one.height_m):
            found.setdefault(one.point.name, []).append(one.point.height_m - one.height_m)
            allowed[one.point.name] = max(allowed.get(one.point.name, largest_m), _SIGMAS * sigma)
    middle = {name: float(np.median(values)) for name, values in found.items()}
    return {name: away for name, away in middle.items() if abs(away) > allowed[name]}


def swapped(wrong: Sequence[WrongPoint]) -> list[tuple[str, str]]:
    """Returns pairs of wrong points whose heights would be right if they were exchanged."""
    found: list[tuple[str, str]] = []
    for k, one in enumerate(wrong):
        for other in wrong[k + 1 :]:
            apart = one.surveyed_height_m - other.surveyed_height_m
            left = np.array([one.height_m - apart, other.height_m + apart])
            limit = _SIGMAS * np.array([one.sigma_m, other.sigma_m])
            if np.isfinite(left).all() and (np.abs(left) < limit).all():
                found.append((one.name, other.name))
    return found
