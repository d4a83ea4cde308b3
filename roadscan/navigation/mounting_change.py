"""What an adjustment adds to the mounting of a sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from roadscan.model.rig import Mounting, Mountings

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MountingChange:
    """Added to the mounting that rig file or calibration state: a longer lever arm, and a turn after the boresight."""

    lever_arm_body_m: tuple[float, float, float]
    """Forward, right, down (m)."""
    turn_rad: tuple[float, float, float]
    """Small rotation vector about the axes of the body."""

    @classmethod
    def of(cls, values: Float64) -> Self:
        """From six numbers: lever arm, turn."""
        a, b, c, d, e, f = (float(v) for v in values)
        return cls((a, b, c), (d, e, f))

    @property
    def values(self) -> Float64:
        """(6,) lever arm (m), turn (rad)."""
        return np.array([*self.lever_arm_body_m, *self.turn_rad])

    @property
    def largest(self) -> tuple[float, float]:
        """Length of the shift (m) and angle of the turn (rad)."""
        return float(np.linalg.norm(self.lever_arm_body_m)), float(np.linalg.norm(self.turn_rad))

    def applied(self, mountings: Mountings) -> Mountings:
        """All mountings of the sensor with the change."""
        return Mountings(mountings.since_gps_ns, tuple(self._one(mounting) for mounting in mountings.mountings))

    def _one(self, mounting: Mounting) -> Mounting:
        rotation, lever = mounting.arrays()
        turned = Rotation.from_rotvec(self.turn_rad).as_matrix() @ rotation
        forward, right, down = (lever + self.lever_arm_body_m).tolist()
        return Mounting((forward, right, down), tuple((float(r[0]), float(r[1]), float(r[2])) for r in turned))

    def moves_level(self, level_from_body: Float64, arm_body_m: Float64, lever_body_m: Float64) -> Float64:
        """By how much (n, 3; north, east, down) it moves points that lie at arms (n, 3) from the body's origin.

        lever_body_m : (3,) or (n, 3) lever arm of the sensor that saw them.
        """
        turned = np.cross(np.broadcast_to(self.turn_rad, arm_body_m.shape), arm_body_m - lever_body_m)
        return np.asarray(np.einsum("nij,nj->ni", level_from_body, self.lever_arm_body_m + turned))
