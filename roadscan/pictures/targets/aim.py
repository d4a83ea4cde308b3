"""Where targets may be in pictures: what projects there, how large, and how far it may be off."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.pictures.lens import projected, straightened
from roadscan.pictures.settings import PictureTarget, PictureTargetsConfig
from roadscan.pictures.views import Lens, Views

_SIGMAS: Final = 3.0  # errors of the stated poses that are searched (σ)
_NEAREST_M: Final = 0.5  # targets nearer than this are not looked for
_TURNS_DEG: Final = (0.0, -40.0, 40.0)
"""Directions in which an upright target may face, from the one to the camera (degrees)."""
_FLAT_SIGMA: Final = 0.06  # 1 σ of a road's slope beside the camera's upright (tangent)
_UPRIGHT_SIGMA: Final = 0.35  # 1 σ of an upright target's turn beside the nearest of those directions (tangent)
_BORDER_PX: Final = 2.0  # a target's middle this near to the picture's border is not looked for (pixels)
_GRAZING: Final = 0.06  # least sine of the angle at which a target's plane is seen


@dataclass(frozen=True)
class TargetPoint:
    """A control point with a target, where it was surveyed."""

    name: str
    place_map_m: tuple[float, float, float]
    """Easting, northing, height."""
    target: PictureTarget


@dataclass(frozen=True, eq=False)
class Eye:
    """A picture's pose and lens."""

    eye_m: Float64
    """(3,) projection centre in the world."""
    turn: Float64
    """(3, 3) camera axes (right, down, ahead) from the world."""
    up: Float64
    """(3,) upwards, in camera axes."""
    lens: Lens

    @classmethod
    def of(cls, views: Views, number: int) -> Eye:
        """Return the eye of one of the views."""
        turn = views.opencv_from_world[number]
        return cls(views.eye_world_m[number], turn, turn @ views.up_world[number], views.lens_of(number))

    @property
    def focal_px(self) -> float:
        """Return the focal length (pixels)."""
        return float(np.sqrt(self.lens.parameters[0] * self.lens.parameters[1]))

    @property
    def size_px(self) -> tuple[int, int]:
        """Return width and height of the picture."""
        return self.lens.size_px

    def pixels(self, point_m: Float64) -> Float64:
        """Return pixels (n, 2) of points (n, 3) in camera axes, which lie ahead."""
        return projected(self.lens, np.reshape(point_m, (-1, 3)))

    def rays(self, pixel: Float64) -> Float64:
        """Return rays (n, 3) of pixels (n, 2) in camera axes, 1 ahead."""
        found = straightened(self.lens, np.reshape(pixel, (-1, 2)))
        return np.column_stack([found, np.ones(len(found))])


def across(first: Float64, second: Float64) -> Float64:
    """Return the cross product (3,) of two vectors, ten times as fast as NumPy's general one."""
    a, b, c = first.tolist()
    d, e, f = second.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


@dataclass(frozen=True, eq=False)
class Pose:
    """A target's middle and axes, in camera axes."""

    middle_m: Float64
    """(3,)"""
    right: Float64
    """(3,) unit vector in the target's plane."""
    down: Float64
    """(3,) unit vector in the target's plane, across it."""
    tilt_sigma: float
    """1 σ of how far its normal leans from there, each way (tangent)."""

    @property
    def normal(self) -> Float64:
        """Return the unit vector (3,) away from the camera."""
        return across(self.right, self.down)


@dataclass(frozen=True, eq=False)
class Aim:
    """A target that may be in a picture."""

    point: TargetPoint
    pixel: Float64
    """(2,) where it is by the stated pose."""
    reach_px: float
    """How far off it may be."""
    poses: tuple[Pose, ...]
    """Ways in which it may stand."""


def aims(eye: Eye, points_world_m: Float64, points: list[TargetPoint], settings: PictureTargetsConfig) -> Iterator[Aim]:
    """Yield the targets that may be in a picture, large enough to be measured.

    points_world_m : (n, 3) the points in the picture's world frame.
    """
    width, height = eye.size_px
    seen = (points_world_m - eye.eye_m) @ eye.turn.T
    away = np.linalg.norm(seen, axis=1)
    ahead = (seen[:, 2] > _NEAREST_M) & (away < settings.farthest_m)
    for i in np.flatnonzero(ahead).tolist():
        if not _is_before_fold(eye, seen[i]):
            continue
        pixel = eye.pixels(seen[i])[0]
        drift = np.hypot(settings.position_m / away[i], np.radians(settings.angle_deg))
        reach = _SIGMAS * float(drift) * eye.focal_px
        low, high = -reach + _BORDER_PX, np.array([width - 1, height - 1]) + reach - _BORDER_PX
        if (pixel < low).any() or (pixel > high).any():
            continue
        poses = tuple(p for p in _poses(eye, seen[i], points[i].target) if _is_large(eye, p, points[i], settings))
        if poses:
            yield Aim(points[i], pixel, reach, poses)


def _is_before_fold(eye: Eye, point_m: Float64) -> bool:
    """Return whether a point's tangent lies before the one at which the distortion folds over."""
    return float((point_m[:2] ** 2).sum() / point_m[2] ** 2) < eye.lens.fold


def _poses(eye: Eye, middle_m: Float64, target: PictureTarget) -> Iterator[Pose]:
    """Yield the ways in which a target may lie or stand."""
    back = -middle_m / np.linalg.norm(middle_m)
    if target.lies != "upright":
        yield _pose(middle_m, eye.up, back, _FLAT_SIGMA)
    if target.lies != "flat":
        level = back - (back @ eye.up) * eye.up
        level /= np.linalg.norm(level)
        aside = across(eye.up, level)
        for turn in np.radians(_TURNS_DEG):
            yield _pose(middle_m, np.cos(turn) * level + np.sin(turn) * aside, eye.up, _UPRIGHT_SIGMA)


def _pose(middle_m: Float64, towards: Float64, upper: Float64, tilt_sigma: float) -> Pose:
    """Return a target whose front looks in a direction, and whose upper edge in another."""
    down = -(upper - (upper @ towards) * towards)
    down = down / np.linalg.norm(down)
    return Pose(middle_m, across(down, -towards), down, tilt_sigma)


def _is_large(eye: Eye, pose: Pose, point: TargetPoint, settings: PictureTargetsConfig) -> bool:
    """Return whether a target is large enough in the picture."""
    sine = abs(float(pose.normal @ pose.middle_m)) / float(np.linalg.norm(pose.middle_m))
    least = point.target.size_m * eye.focal_px / float(pose.middle_m[2]) * sine
    return sine > _GRAZING and least >= settings.least_px
