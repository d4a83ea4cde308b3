"""Observations of an adjustment: each is one number that corrections of one or two poses explain.

A correction is that of `schemas/corrections.toml`: north, east, down (m, local level) and a small turn about the axes
of the body (rad). A point of the body, `arm_body_m` from its origin, moves in local level by

    d = position + R · (turn × arm),    R = level from body.

An observation with direction n (unit, local level) sees n · d of each of its ends, so its partial derivatives by the
six corrections are n and arm × (Rᵀ n) (Skaloud & Lichti 2006, linearised). Its second end counts negatively: after the
correction, the two ends agree along n.

The mounting of the sensor that saw an end moves the point as well: by a change of the lever arm, by a small turn about
the axes of the body at the sensor's origin, and by a scale of its ranges. Those derivatives are Rᵀ n,
(arm − lever arm) × (Rᵀ n), and that along the direction of the point's way from the sensor, of which a head with
parallel beams lengthens the part along its beams alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int32, Int64, UInt8
from roadscan.pictures.lens import COLUMNS
from roadscan.poses.movement import Seat

KINDS: Final = (
    "height_tie", "shift_tie", "plane_tie", "control_height", "control_position", "head_tie", "hand_tie",
    "picture_tie", "picture_control", "picture_depth", "picture_edge",
)  # fmt: skip
"""Height of one pass against another's; shift of one image or relief against another's; distance of two planes;
height, or a component of the place, of a control point; height of one head against that of another of the same pass;
what a person found in two passes; column or row of a tie point, or of a control point, in a picture; distance of a
tie point from a surface that a lidar saw; turn of a camera that range edges of a lidar show (rad)."""

COMPONENTS: Final = ("north_m", "east_m", "down_m", "roll_rad", "pitch_rad", "heading_rad")
"""The unknowns of a pose, in the order of the partial derivatives."""

MOUNTED: Final = ("forward_m", "right_m", "down_m", "roll_rad", "pitch_rad", "heading_rad", "range_scale")
"""The unknowns of a mounting: lever arm and a turn that follows the boresight, both along the axes of the body, and the
share by which ranges are longer."""

CAMERA: Final = COLUMNS
"""The unknowns of a camera beside its mounting: its lens (OpenCV's parameters), what is added to the stamps of its
pictures, and to the time between the exposures of two rows."""

COMMON: Final = ("first_laser", "second_laser", "roll")
"""Errors that ties of a lidar have in common: of the ranges of the lasers that saw their ends, and a roll that
all ties of one drive seem to show."""

FIXED: Final = -1
"""Run of an end that no correction moves: a control point, or a tie point of pictures."""


@dataclass(frozen=True)
class Observations:
    """n observations; `observed_m` = Σ over ends of partials · correction, plus noise of `sigma_m`."""

    kind: UInt8
    """(n,) index into `KINDS`."""
    run: Int32
    """(n, 2) index of the run of each end; `FIXED` for control."""
    epoch_gps_ns: Int64
    """(n, 2) epoch of the pose of each end; 0 for control."""
    partials: Float64
    """(n, 2, 6) derivatives by `COMPONENTS`, the sign of the end included; 0 for control."""
    observed_m: Float64
    """(n,) second end minus first along the direction, as the recorded poses place them; of control: surveyed minus
    measured."""
    sigma_m: Float64
    """(n,) 1 σ, without that of the poses."""
    group: Int64
    """(n,) observations of one group stand or fall together: the two components of one shift."""
    place: Int64
    """(n,) number of the place, or control point."""
    survey_sigma_m: Float64 = field(default_factory=lambda: np.zeros(0))
    """(n,) of control: 1 σ of the surveyed coordinate along the direction, apart from `sigma_m`, which is that of the
    measurement alone. All observations of a control point share the error of its survey. 0 for ties; zeros where none
    are given."""
    sensor: Int32 = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    """(n, 2) number of the sensor that saw each end; −1 where its mounting is not estimated."""
    mount_partials: Float64 = field(default_factory=lambda: np.zeros((0, 2, len(MOUNTED))))
    """(n, 2, 7) derivatives by `MOUNTED` of that sensor, the sign of the end included."""
    camera: Int32 = field(default_factory=lambda: np.zeros(0, np.int32))
    """(n,) number of the camera whose lens and clock are estimated, −1: none."""
    camera_partials: Float64 = field(default_factory=lambda: np.zeros((0, len(CAMERA))))
    """(n, 11) derivatives by `CAMERA` of that camera."""
    common: Int32 = field(default_factory=lambda: np.zeros((0, len(COMMON)), np.int32))
    """(n, 3) numbers of errors that ties have in common, `COMMON`; −1: none."""
    common_partials: Float64 = field(default_factory=lambda: np.zeros((0, len(COMMON))))
    """(n, 3) derivatives by each of them, in units of its prior σ."""

    def __post_init__(self) -> None:
        if len(self.camera) != self.kind.size or len(self.camera_partials) != self.kind.size:
            object.__setattr__(self, "camera", np.full(self.kind.size, -1, np.int32))
            object.__setattr__(self, "camera_partials", np.zeros((self.kind.size, len(CAMERA))))
        if len(self.sensor) != self.kind.size or len(self.mount_partials) != self.kind.size:
            object.__setattr__(self, "sensor", np.full((self.kind.size, 2), -1, np.int32))
            object.__setattr__(self, "mount_partials", np.zeros((self.kind.size, 2, len(MOUNTED))))
        if len(self.common) != self.kind.size:
            object.__setattr__(self, "common", np.full((self.kind.size, len(COMMON)), -1, np.int32))
            object.__setattr__(self, "common_partials", np.zeros((self.kind.size, len(COMMON))))
        if self.survey_sigma_m.size != self.kind.size:
            if self.survey_sigma_m.size:
                raise ValueError(f"{self.survey_sigma_m.size} σ of a survey for {self.kind.size} observations")
            object.__setattr__(self, "survey_sigma_m", np.zeros(self.kind.size))

    @property
    def size(self) -> int:
        """Returns the number of observations."""
        return self.kind.size

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Returns all of them, in order; groups are numbered anew."""
        if not parts:
            return cls.none()
        columns = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)}
        groups, last = [], 0
        for part in parts:
            _, own = np.unique(part.group, return_inverse=True)
            groups.append(own.astype(np.int64) + last)
            last += int(own.max()) + 1 if own.size else 0
        columns["group"] = np.concatenate(groups)
        return cls(**columns)

    @classmethod
    def none(cls) -> Self:
        """Returns an empty set."""
        return cls(
            np.zeros(0, np.uint8), np.zeros((0, 2), np.int32), np.zeros((0, 2), np.int64), np.zeros((0, 2, 6)),
            np.zeros(0), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64),
        )  # fmt: skip

    def chosen(self, which: npt.NDArray[np.bool_] | Int64) -> Self:
        """Returns a subset."""
        return type(self)(**{f.name: getattr(self, f.name)[which] for f in fields(self)})


def mount_partials(in_body: Float64, arm_turns: Float64, arm_along_m: Float64, seat: Seat) -> tuple[Float64, Float64]:
    """Returns derivatives of the movement along a direction by the mounting of a sensor (n, 7), and by a range (n,).

    Parameters
    ----------
    in_body : (n, 3) the direction in body axes.
    arm_turns : (n, 3) derivatives by a turn of the pose: arm × direction.
    arm_along_m : (n,) arm · direction.
    seat : of the sensor, rows (n, 3).
    """
    arm = arm_along_m[:, None] * in_body + np.cross(in_body, arm_turns)
    way = seat.by_scale(arm)
    by_scale = np.einsum("ni,ni->n", in_body, way)
    by_mounting = np.column_stack([in_body, arm_turns - np.cross(seat.lever_body_m, in_body), by_scale])
    return by_mounting, by_scale / np.maximum(np.linalg.norm(way, axis=-1), 1e-3)


def partials(direction_level: Float64, level_from_body: Float64, arm_body_m: Float64) -> Float64:
    """Returns derivatives (n, 6) of the movement along a direction by the corrections of a pose.

    Parameters
    ----------
    direction_level : (n, 3) unit vectors, north-east-down.
    level_from_body : (n, 3, 3) rotation of the recorded pose.
    arm_body_m : (n, 3) from the body's origin to the point, body axes (m).
    """
    in_body = np.einsum("nji,nj->ni", level_from_body, direction_level)
    return np.concatenate([direction_level, np.cross(arm_body_m, in_body)], axis=-1)
