"""The trajectory of a run, its pose at any epoch, and how far an adjustment moves poses and mountings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, MapFrame, geodetic_from_world
from roadscan.core.errors import NavigationError
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned, rph_from_rotation
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.rig import Mounting, Mountings
from roadscan.poses.kernels.poses import COEFFICIENTS, PoseIntervals, interpolate, interval_coefficients

STENCIL_KNOTS = 3
"""Number of knots beyond each end of a span that poses within it depend on."""


@dataclass(frozen=True)
class Corrections:
    """Knots of a run's trajectory correction (``schemas/corrections.toml``); linear between knots."""

    epochs_gps_ns: Int64
    """(k,) ascending."""
    north_east_down_m: Float64
    """(k, 3), added to the position, local level axes (local frame: y, x, −z)."""
    roll_pitch_heading_rad: Float64
    """(k, 3), small rotation vector about the body's axes."""
    sigma: Float64 | None = None
    """(k, 6) 1 σ of the corrected poses: north, east, down (m), turns about body axes (rad); NaN where unknown."""

    def at(self, epochs_gps_ns: Int64) -> tuple[Float64, Float64]:
        """Return position (n, 3) and rotation (n, 3) corrections; beyond the ends, those of the ends."""
        since = (epochs_gps_ns - self.epochs_gps_ns[0]).astype(np.float64)
        knots = (self.epochs_gps_ns - self.epochs_gps_ns[0]).astype(np.float64)
        columns = [
            np.interp(since, knots, values[:, a])
            for values in (self.north_east_down_m, self.roll_pitch_heading_rad)
            for a in range(3)
        ]
        return np.stack(columns[:3], axis=-1), np.stack(columns[3:], axis=-1)

    def sigma_ned_m(self, epochs_gps_ns: Int64) -> Float64 | None:
        """Return 1 σ (n, 3) of corrected positions; None where it is not known."""
        if self.sigma is None or not np.isfinite(self.sigma[:, :3]).all():
            return None
        since = (epochs_gps_ns - self.epochs_gps_ns[0]).astype(np.float64)
        knots = (self.epochs_gps_ns - self.epochs_gps_ns[0]).astype(np.float64)
        return np.stack([np.interp(since, knots, self.sigma[:, a]) for a in range(3)], axis=-1)


@dataclass(frozen=True)
class Poses:
    """Poses at n epochs."""

    epochs_gps_ns: Int64
    position_world_m: Float64
    """(n, 3); NaN where there is no pose."""
    world_from_body: Float64
    """(n, 3, 3); NaN where there is no pose."""
    found: npt.NDArray[np.bool_]
    """(n,) False in a gap and outside the trajectory."""


@dataclass(frozen=True)
class Trajectory:
    """Recorded poses of one run in one world frame.

    Poses between knots are cubic on position and on the rotation group, see ``poses/kernels/poses.py``.
    """

    world: str
    """World frame of the positions."""
    epochs_gps_ns: Int64
    """(n,) strictly ascending."""
    position_world_m: Float64
    """(n, 3)."""
    quaternion_world_from_body: Float64
    """(n, 4), unit, scalar first."""
    max_gap_s: float = 1.0
    """Between knots farther apart there is no pose."""
    sigma_ned_m: Float64 | None = None
    """(n, 3) stated 1 σ of the positions, local level (local frame: y, x, −z); NaN where none is stated."""

    @classmethod
    def of(
        cls,
        world: str,
        epochs_gps_ns: Int64,
        position_world_m: Float64,
        quaternion: Float64,
        max_gap_s: float = 1.0,
        sigma_ned_m: Float64 | None = None,
    ) -> Trajectory:
        """Build a trajectory: sort, keep the first pose of a repeated epoch, and normalise the quaternions."""
        order = np.argsort(epochs_gps_ns, kind="stable")
        epochs = np.ascontiguousarray(epochs_gps_ns[order])
        keep = np.concatenate([[True], np.diff(epochs) > 0]) if epochs.size else np.zeros(0, dtype=bool)
        unit = quaternion[order][keep]
        unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
        sigma = None if sigma_ned_m is None else sigma_ned_m[order][keep]
        return cls(world, epochs[keep], np.ascontiguousarray(position_world_m[order][keep]), unit, max_gap_s, sigma)

    @property
    def span_gps_ns(self) -> tuple[int, int]:
        """First and last epoch of the trajectory."""
        if self.epochs_gps_ns.size == 0:
            raise NavigationError("the trajectory is empty", expected="at least two poses")
        return int(self.epochs_gps_ns[0]), int(self.epochs_gps_ns[-1])

    def gaps(self) -> list[tuple[int, int]]:
        """Pairs of epochs between which there is no pose."""
        where = np.flatnonzero(np.diff(self.epochs_gps_ns) > self._max_gap_ns)
        return [(int(self.epochs_gps_ns[k]), int(self.epochs_gps_ns[k + 1])) for k in where]

    def corrected(self, corrections: Corrections | None) -> Trajectory:
        """Return the trajectory with an adjustment's corrections applied."""
        if corrections is None or corrections.epochs_gps_ns.size == 0 or self.epochs_gps_ns.size == 0:
            return self
        shift, turn = corrections.at(self.epochs_gps_ns)
        sigma = corrections.sigma_ned_m(self.epochs_gps_ns)
        position = self.position_world_m + np.einsum("nij,nj->ni", self._world_from_ned(), shift)
        return Trajectory(
            self.world,
            self.epochs_gps_ns,
            position,
            _turned(self.quaternion_world_from_body, turn),
            self.max_gap_s,
            self.sigma_ned_m if sigma is None else sigma,
        )

    def interval_sigmas_m(self) -> Float64:
        """Largest 1 σ (n − 1, 2) of the poses of each interval between knots, horizontal and down; inf where not known.

        Horizontal is √(σ_north² + σ_east²), the larger one of the interval's two knots.
        """
        intervals = max(self.epochs_gps_ns.size - 1, 0)
        if self.sigma_ned_m is None:
            return np.full((intervals, 2), np.inf)
        sigma = np.column_stack([np.hypot(self.sigma_ned_m[:, 0], self.sigma_ned_m[:, 1]), self.sigma_ned_m[:, 2]])
        known: Float64 = np.where(np.isnan(sigma), np.inf, sigma)
        return np.maximum(known[:-1], known[1:])

    def poses(self, epochs_gps_ns: Int64, *, strict: bool = False) -> Poses:
        """Interpolate poses at epochs.

        Parameters
        ----------
        epochs_gps_ns : (n,) int64, any order.
        strict : raise where an epoch has no pose.

        Raises
        ------
        NavigationError
            if `strict` and an epoch lies outside the trajectory or in a gap.
        """
        n = epochs_gps_ns.size
        position, rotation = np.full((n, 3), np.nan), np.full((n, 9), np.nan)
        found = np.zeros(n, dtype=bool)
        interpolate(epochs_gps_ns, self.intervals, position, rotation, found)
        if strict and not found.all():
            self._refuse(int(epochs_gps_ns[np.flatnonzero(~found)[0]]), int((~found).sum()))
        return Poses(epochs_gps_ns, position, rotation.reshape(n, 3, 3), found)

    @cached_property
    def intervals(self) -> PoseIntervals:
        """Return the intervals between the knots in the form that kernels take."""
        size = max(self.epochs_gps_ns.size - 1, 0)
        coefficients = np.zeros((size, COEFFICIENTS))
        valid = np.zeros(size, dtype=bool)
        if size:
            interval_coefficients(
                self.epochs_gps_ns,
                self.position_world_m,
                self.quaternion_world_from_body,
                self._max_gap_ns,
                coefficients,
                valid,
            )
        return PoseIntervals(self.epochs_gps_ns, coefficients, valid)

    @property
    def _max_gap_ns(self) -> int:
        return round(self.max_gap_s * NS_PER_S)

    def _world_from_ned(self) -> Float64:
        """(n, 3, 3) world from local level at each knot."""
        return world_from_ned(self.world, self.position_world_m)

    def _refuse(self, epoch: int, count: int) -> None:
        first, last = self.span_gps_ns
        gaps = [g for g in self.gaps() if g[0] < epoch < g[1]]
        where = (
            f"in a gap of {(gaps[0][1] - gaps[0][0]) / NS_PER_S:.2f} s"
            if gaps
            else f"outside the trajectory ({iso_from_gps_ns(first)} to {iso_from_gps_ns(last)})"
        )
        raise NavigationError(
            f"{count} epochs have no pose, the first, {iso_from_gps_ns(epoch)}, lies {where}",
            expected=f"poses no more than {self.max_gap_s:g} s apart around it",
            change="check the clocks of log and trajectory, or raise navigation.max_gap_s",
        )


def world_from_ned(world: str, position_world_m: Float64) -> Float64:
    """Return the local level axes (n, 3, 3; north, east, down) at positions (n, 3) of a world frame."""
    if world == LOCAL_WORLD:
        return np.broadcast_to(ENU_FROM_NED, (len(position_world_m), 3, 3))
    geodetic = geodetic_from_world(world, position_world_m)
    return ecef_from_ned(np.radians(geodetic[:, 1]), np.radians(geodetic[:, 0]))


def _turned(quaternion: Float64, turn: Float64) -> Float64:
    """Return the attitudes (n, 4) q ⊗ exp(turn), turned by small rotation vectors (n, 3) about body axes."""
    angle = np.linalg.norm(turn, axis=1)
    half = 0.5 * turn * np.sinc(angle / (2 * np.pi))[:, None]
    w2, (x2, y2, z2) = np.cos(0.5 * angle), half.T
    w1, x1, y1, z1 = quaternion.T
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )


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
            from_ned = ENU_FROM_NED
        else:
            longitude, latitude = geodetic_from_world(self.trajectory.world, pose.position_world_m)[0, :2].tolist()
            from_ned = ecef_from_ned(math.radians(latitude), math.radians(longitude))
        _, _, heading = rph_from_rotation(from_ned.T @ pose.world_from_body[0])
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
