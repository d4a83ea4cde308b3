"""Changes that an adjustment makes to mountings, and bounds on how far its corrections move poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, MapFrame, geodetic_from_world
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned, rph_from_rotation
from roadscan.core.rig import Mounting, Mountings
from roadscan.poses.trajectory import Corrections, Poses, Trajectory, world_from_ned

_LEAST_SHIFT_M: Final = 0.05  # Smallest allowance of a shift.
_LEAST_TURN_RAD: Final = 0.0005  # Smallest allowance of a turn.
_STEP: Final = 4.0  # Each allowance is this many times the one before it.
_MOST_STEPS: Final = 8  # Number of allowances; a larger correction is an error.


class Allowance(NamedTuple):
    """The largest corrections for which bounds on recorded poses still hold."""

    shift_m: float
    """Horizontal shift. A vertical movement changes no place on the map."""
    turn_rad: float
    """Angle of the small rotation."""

    @property
    def is_none(self) -> bool:
        """True where no correction is allowed for."""
        return self.shift_m == 0.0 and self.turn_rad == 0.0

    def moved_m(self, arm_m: float) -> float:
        """Return how far (m) a point on the ground moves at most that lies `arm_m` from the body's origin.

        Between its knots the corrected trajectory is not the recorded one with a correction that is linear in time: it
        is interpolated through corrected knots. With even knots that swings over by at most 3/8 of the largest
        correction (cubic Hermite with slopes through five knots: |slope| ≤ 1.5 per knot, times u (1 − u) ≤ 1/4), with
        uneven ones by more, where corrections change from one knot to the next by their size. So the bound is twice
        the correction.
        """
        return 2.0 * (self.shift_m + self.turn_rad * arm_m)


NO_CORRECTION: Final = Allowance(0.0, 0.0)  # Bounds hold for the recorded poses only.


def allowance_for(corrections: Corrections | None, mounting: tuple[float, float] = (0.0, 0.0)) -> Allowance:
    """Return the smallest allowance that covers the corrections, in steps of four from 0.05 m and 0.5 mrad on.

    Without corrections it is the first step, within which most later corrections stay.

    Parameters
    ----------
    corrections : of one run; None where it has none.
    mounting : shift (m) and turn (rad) that are added to the mounting of the sensor.

    Raises
    ------
    ValueError
        where corrections are beyond all reason (819 m, 8 rad).
    """
    shift, turn = largest(corrections)
    return Allowance(_step(shift + mounting[0], _LEAST_SHIFT_M), _step(turn + mounting[1], _LEAST_TURN_RAD))


def largest(corrections: Corrections | None) -> tuple[float, float]:
    """Return the largest horizontal shift (m) and turn (rad) of corrections."""
    if corrections is None or corrections.epochs_gps_ns.size == 0:
        return 0.0, 0.0
    shift: npt.NDArray[np.float64] = np.hypot(*corrections.north_east_down_m[:, :2].T)
    turn = np.linalg.norm(corrections.roll_pitch_heading_rad, axis=1)
    return float(shift.max()), float(turn.max())


def _step(value: float, least: float) -> float:
    for number in range(_MOST_STEPS):
        if value <= least * _STEP**number:
            return least * _STEP**number
    raise ValueError(f"a correction of {value:g}")


@dataclass(frozen=True)
class Seat:
    """The stated lever arm and beam direction of a sensor, on which a change of its mounting acts."""

    lever_body_m: Float64
    """(3,) or (n, 3) lever arm."""
    beam_body: Float64
    """(3,) or (n, 3) direction of its beams where all are parallel; NaN where they fan out from its origin."""

    @classmethod
    def of(cls, mountings: Mountings, epochs_gps_ns: Int64 | int, *, parallel: bool) -> Self:
        """Return the seats (n, 3) at epochs (n,), or (3,) at one, of a sensor whose beams are parallel, or fan out."""
        levers = np.array([one.lever_arm_body_m for one in mountings.mountings])
        beams = np.array([np.array(one.body_from_sensor)[:, 2] for one in mountings.mountings])
        at = np.searchsorted(np.array(mountings.since_gps_ns[1:], np.int64), epochs_gps_ns, side="right")
        return cls(levers[at], (beams if parallel else np.full(beams.shape, np.nan))[at])

    def by_scale(self, arm_body_m: Float64) -> Float64:
        """Return the movement (n, 3), body axes, of points at arms (n, 3) from the body's origin for scale 1."""
        beam = np.broadcast_to(self.beam_body, arm_body_m.shape)
        away = arm_body_m - self.lever_body_m
        along = np.einsum("ni,ni->n", away, beam)[:, None] * beam
        return np.where(np.isfinite(beam), along, away)


NO_SEAT: Final = Seat(np.zeros(3), np.full(3, np.nan))
"""Placeholder where no sensor is concerned."""


@dataclass(frozen=True)
class MountingChange:
    """A change of the mounting that rig file or calibration state: a longer lever arm, a turn after the boresight,
    and a scale of the ranges.
    """

    lever_arm_body_m: tuple[float, float, float]
    """Forward, right, down (m)."""
    turn_rad: tuple[float, float, float]
    """Small rotation vector about the axes of the body."""
    range_scale: float = 0.0
    """Ranges are longer by this share."""

    @classmethod
    def of(cls, values: Float64) -> Self:
        """Build the change from seven numbers: lever arm, turn, scale."""
        a, b, c, d, e, f, scale = (float(v) for v in values)
        return cls((a, b, c), (d, e, f), scale)

    @property
    def values(self) -> Float64:
        """Return (7,) numbers: lever arm (m), turn (rad), scale."""
        return np.array([*self.lever_arm_body_m, *self.turn_rad, self.range_scale])

    def rounded(self, steps: tuple[float, float, float]) -> Self:
        """Return the change in whole steps of the lever arm (m), of the turn (rad) and of the scale."""
        every = np.repeat(steps, (3, 3, 1))
        return self.of(every * np.round(self.values / every))

    @property
    def largest(self) -> tuple[float, float]:
        """Return the length of the shift (m), and the turn (rad) that moves points as far as turn and scale do."""
        return float(np.linalg.norm(self.lever_arm_body_m)), float(
            np.linalg.norm(self.turn_rad) + abs(self.range_scale)
        )

    def moved_m(self, arm_m: float) -> float:
        """Return how far (m) it moves a point that lies `arm_m` from the body's origin, at most."""
        shift_m, turn_rad = self.largest
        return shift_m + arm_m * turn_rad

    def applied(self, mountings: Mountings, *, parallel: bool) -> Mountings:
        """Apply the change to all mountings of a sensor; `parallel`: its beams run along its z, and only z is a range.

        A mounting then stretches: what it turns, it makes longer by the scale.
        """
        return Mountings(
            mountings.since_gps_ns, tuple(self._one(mounting, parallel=parallel) for mounting in mountings.mountings)
        )

    def _one(self, mounting: Mounting, *, parallel: bool) -> Mounting:
        from scipy.spatial.transform import Rotation

        rotation, lever = mounting.arrays()
        turned = Rotation.from_rotvec(self.turn_rad).as_matrix() @ rotation
        turned *= 1.0 + self.range_scale * np.array([0.0, 0.0, 1.0] if parallel else [1.0, 1.0, 1.0])
        forward, right, down = (lever + self.lever_arm_body_m).tolist()
        return Mounting((forward, right, down), tuple((float(r[0]), float(r[1]), float(r[2])) for r in turned))

    def moves_level(self, level_from_body: Float64, arm_body_m: Float64, seat: Seat) -> Float64:
        """Return the movement (n, 3; north, east, down) of points at arms (n, 3) from the body's origin.

        seat : of the sensor that saw them.
        """
        turned = np.cross(np.broadcast_to(self.turn_rad, arm_body_m.shape), arm_body_m - seat.lever_body_m)
        moved = self.lever_arm_body_m + turned + self.range_scale * seat.by_scale(arm_body_m)
        return np.asarray(np.einsum("nij,nj->ni", level_from_body, moved))


@dataclass(frozen=True)
class Fix:
    """Position and heading of the vehicle at one epoch."""

    longitude_deg: float
    """NaN where the trajectory lives in a local frame."""
    latitude_deg: float
    heading_deg: float
    """Clockwise from true north (local frame: from its y axis), 0–360."""


@dataclass(frozen=True)
class Travel:
    """Cumulative distances at a trajectory's knots."""

    trajectory: Trajectory

    @cached_property
    def _knots_m(self) -> Float64:
        steps = np.linalg.norm(np.diff(self.trajectory.position_world_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def distance_m(self, epochs_gps_ns: Int64) -> Float64:
        """Return (n,) metres travelled since the trajectory's first knot; beyond its ends, those of the ends."""
        knots = self.trajectory.epochs_gps_ns
        since = (epochs_gps_ns - knots[0]).astype(np.float64)
        travelled: Float64 = np.interp(since, (knots - knots[0]).astype(np.float64), self._knots_m)
        return travelled

    def fix(self, epoch_gps_ns: int) -> Fix:
        """Position and heading at an epoch.

        Raises
        ------
        NavigationError
            where there is no pose.
        """
        pose = self.trajectory.poses(np.array([epoch_gps_ns]), strict=True)
        if self.trajectory.world == LOCAL_WORLD:
            longitude = latitude = math.nan
            world_from_ned = ENU_FROM_NED
        else:
            longitude, latitude = geodetic_from_world(self.trajectory.world, pose.position_world_m)[0, :2].tolist()
            world_from_ned = ecef_from_ned(math.radians(latitude), math.radians(longitude))
        _, _, heading = rph_from_rotation(world_from_ned.T @ pose.world_from_body[0])
        return Fix(longitude, latitude, math.degrees(float(heading)) % 360.0)


_STEP_M = 10.0  # Length (m) of the line to true north whose map direction gives the convergence.


@dataclass(frozen=True)
class LevelPoses:
    """Poses at p epochs."""

    epoch_gps_ns: Int64
    """(p,)"""
    body_m: Float64
    """(p, 3) easting, northing and height of the body's origin."""
    level_from_body: Float64
    """(p, 3, 3) north, east, down from body axes."""
    convergence_rad: Float64
    """(p,) grid north is this far clockwise from true north."""

    @property
    def heading_rad(self) -> Float64:
        """(p,) of the vehicle, clockwise from grid north."""
        return np.asarray(
            np.arctan2(self.level_from_body[:, 1, 0], self.level_from_body[:, 0, 0]) - self.convergence_rad
        )


def level_poses(trajectory: Trajectory, frame: MapFrame, epochs_gps_ns: Int64) -> LevelPoses:
    """Return the poses of those of the epochs (n,) that have one, in their order."""
    found = trajectory.poses(epochs_gps_ns)
    keep = found.found
    poses = Poses(epochs_gps_ns[keep], found.position_world_m[keep], found.world_from_body[keep], keep[keep])
    axes = world_from_ned(trajectory.world, poses.position_world_m)
    body = frame.map_from_world(trajectory.world, poses.position_world_m)
    north = frame.map_from_world(trajectory.world, poses.position_world_m + _STEP_M * axes[:, :, 0])
    away = north[:, :2] - body[:, :2]
    return LevelPoses(
        poses.epochs_gps_ns,
        body,
        np.einsum("nji,njk->nik", axes, poses.world_from_body),
        np.asarray(-np.arctan2(away[:, 0], away[:, 1])),
    )
