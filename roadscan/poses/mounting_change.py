"""Changes that an adjustment makes to the mounting of a sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.rig import Mounting, Mountings


@dataclass(frozen=True)
class Seat:
    """The stated lever arm and beam direction of a sensor, on which a change of its mounting acts."""

    lever_body_m: Float64
    """(3,) or (n, 3) lever arm."""
    beam_body: Float64
    """(3,) or (n, 3) direction of its beams where all are parallel; NaN where they fan out from its origin."""

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

    @property
    def largest(self) -> tuple[float, float]:
        """Return the length of the shift (m), and the turn (rad) that moves points as far as turn and scale do."""
        return float(np.linalg.norm(self.lever_arm_body_m)), float(
            np.linalg.norm(self.turn_rad) + abs(self.range_scale)
        )

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
