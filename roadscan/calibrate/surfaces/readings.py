"""Readings with their poses, cut into pieces of equal pose error: the input of the search for common surfaces."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from roadscan.calibrate.evidence import Seen, Traverse
from roadscan.calibrate.kernels.surface_patches import place
from roadscan.calibrate.rotations import exponential
from roadscan.calibrate.unknowns import Estimate
from roadscan.compute.array_types import Float64, Int32, Int64
from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S


@dataclass(frozen=True)
class Readings:
    """Readings of one sensor in one drive over the place."""

    sensor: str
    drive: str
    """Name of the drive: readings of one drive see a place from one direction, at one time."""
    point_sensor_m: Float64
    """(n, 3) sensor axes."""
    pose: Int32
    """(n,) row of each reading's pose."""
    epoch_gps_ns: Int64
    """(p,) epochs of the poses."""
    position_world_m: Float64
    """(p, 3) IMU reference point."""
    world_from_body: Float64
    """(p, 3, 3)."""

    def __post_init__(self) -> None:
        poses = len(self.epoch_gps_ns)
        if self.point_sensor_m.shape != (self.pose.size, 3):
            raise NavigationError(
                f"readings of '{self.sensor}' in {self.drive}: points of shape {self.point_sensor_m.shape}",
                expected=f"({self.pose.size}, 3), one for each of the poses' rows",
            )
        if self.position_world_m.shape != (poses, 3) or self.world_from_body.shape != (poses, 3, 3):
            raise NavigationError(
                f"readings of '{self.sensor}' in {self.drive}: poses of shapes {self.position_world_m.shape} and "
                f"{self.world_from_body.shape}",
                expected=f"({poses}, 3) and ({poses}, 3, 3), one for each epoch",
            )
        if self.pose.size and not 0 <= int(self.pose.min()) <= int(self.pose.max()) < poses:
            raise NavigationError(
                f"readings of '{self.sensor}' in {self.drive} name the poses {self.pose.min()} to {self.pose.max()}",
                expected=f"rows of the {poses} poses",
            )

    @property
    def key(self) -> tuple[str, str]:
        """Sensor and drive."""
        return self.sensor, self.drive


@dataclass(frozen=True)
class Pieces:
    """Drives cut into pieces of `piece_ns`; a piece's number is its count since GPS time began."""

    piece_ns: int

    @classmethod
    def of_seconds(cls, piece_s: float) -> Pieces:
        """Return pieces of so many seconds."""
        return cls(round(piece_s * NS_PER_S))

    def numbers(self, epoch_gps_ns: Int64) -> Int64:
        """Return the number (n,) of the piece of each epoch (n,)."""
        return epoch_gps_ns // self.piece_ns

    def middle_gps_ns(self, number: int) -> int:
        """Return the epoch in the middle of a piece."""
        return number * self.piece_ns + self.piece_ns // 2

    def drift_m(self, traverses: Mapping[int, Traverse]) -> float:
        """Return 1 σ of the difference of a pose's position from the mean of its piece: largest axis, worst traverse.

        A Gauss–Markov process departs from its mean over a short time T by σ · √(T / 3τ), root mean square
        (integrated random walk of density 2 σ² / τ, variance within a window T / 6).
        """
        piece_s = self.piece_ns / NS_PER_S
        return max(
            (
                max(t.sigma_north_east_down_m) * math.sqrt(piece_s / (3.0 * t.time_constant_s))
                for t in traverses.values()
            ),
            default=0.0,
        )

    def traverses(
        self,
        readings: Iterable[Readings],
        world_from_ned: Float64,
        sigma_north_east_down_m: tuple[float, float, float],
        sigma_roll_pitch_heading_rad: tuple[float, float, float],
        time_constant_s: float,
    ) -> dict[int, Traverse]:
        """Return the estimator's traverses, one for each piece with readings, with the stated errors of the poses.

        Raises
        ------
        NavigationError
            where two drives share a piece: they overlap in time.
        """
        found: dict[int, Traverse] = {}
        for one in readings:
            for number in np.unique(self.numbers(one.epoch_gps_ns)).tolist():
                known = found.get(number)
                if known is not None and known.run != one.drive:
                    raise NavigationError(
                        f"the drives {known.run} and {one.drive} overlap in time",
                        expected="drives one after another, farther apart than a piece",
                    )
                found[number] = Traverse(
                    one.drive,
                    self.middle_gps_ns(number),
                    sigma_north_east_down_m,
                    sigma_roll_pitch_heading_rad,
                    world_from_ned,
                    time_constant_s,
                )
        return found


@dataclass(frozen=True)
class Placed:
    """Positions of readings with an estimate's mountings and corrections, in a level frame of the place.

    The level frame is the world turned so that z is up at the place.
    """

    readings: Readings
    number: Int64
    """(p,) number of the piece of each pose."""
    position_m: Float64
    """(p, 3) corrected, level axes."""
    rotation: Float64
    """(p, 3, 3) level axes from body, corrected."""
    body_from_sensor: Float64
    lever_arm_m: Float64
    level_from_world: Float64

    @cached_property
    def place_m(self) -> Float64:
        """(n, 3) positions of all readings, level axes."""
        out = np.empty_like(self.readings.point_sensor_m)
        place(
            self.readings.point_sensor_m,
            self.readings.pose,
            self.position_m,
            self.rotation,
            self.body_from_sensor,
            self.lever_arm_m,
            out,
        )
        return out

    def seen(self, place_m: Float64, pose: Int64, position_m: Float64 | None = None) -> Seen:
        """Return places (n, 3), level axes, as the sensor would have seen them from poses (n,).

        position_m : (n, 3) corrected positions in place of those of `pose`, level axes.
        """
        offset = np.zeros((pose.size, 3)) if position_m is None else position_m - self.position_m[pose]
        body = np.einsum("nji,nj->ni", self.rotation[pose], place_m - self.position_m[pose] - offset)
        return Seen(
            self.readings.sensor,
            (body - self.lever_arm_m) @ self.body_from_sensor,
            self.readings.position_world_m[pose] + offset @ self.level_from_world,
            self.readings.world_from_body[pose],
            self.number[pose],
        )


def level_from_world(readings: Sequence[Readings]) -> Float64:
    """Return (3, 3) axes with z against the mean down axis of the body over all poses, and x along the first pose.

    Patches then lie across the drive: all of a row were seen with the same poses.
    """
    down = np.sum([one.world_from_body[:, :, 2].sum(axis=0) for one in readings], axis=0)
    up = -down / np.linalg.norm(down)
    forward = readings[0].world_from_body[0, :, 0]
    x = forward - (forward @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def placed(
    one: Readings, estimate: Estimate, pieces: Pieces, traverses: Mapping[int, Traverse], level: Float64
) -> Placed:
    """Compute the positions of readings with the mountings and the mean correction of an estimate.

    Parameters
    ----------
    traverses : axes of the corrections' shifts.
    level : (3, 3), see :func:`level_from_world`.
    """
    rotation, lever = estimate.mountings[one.sensor].arrays()
    number = pieces.numbers(one.epoch_gps_ns)
    shift, turn = _mean_correction(np.unique(number), estimate, traverses)
    corrected = one.world_from_body @ exponential(turn)
    return Placed(
        one,
        number,
        (one.position_world_m + shift) @ level.T,
        level @ corrected,
        rotation,
        lever,
        level,
    )


def _mean_correction(number: Int64, estimate: Estimate, traverses: Mapping[int, Traverse]) -> tuple[Float64, Float64]:
    """Return the shift (3,), world axes, and turn (3,), body axes, that the pieces of a drive have in common.

    What is left between pieces stays in the ties: corrections that jump from piece to piece would tear images.
    """
    known = [(piece, estimate.corrections[piece]) for piece in number.tolist() if piece in estimate.corrections]
    if not known:
        return np.zeros(3), np.zeros(3)
    shifts = [traverses[piece].world_from_ned @ one.shift_north_east_down_m for piece, one in known]
    return np.mean(shifts, axis=0), np.mean([one.turn_roll_pitch_heading_rad for _, one in known], axis=0)
