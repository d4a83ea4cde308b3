"""Candidates for targets: places of a picture that, seen straight from before, correlate with the target's shape."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import erf

from roadscan.compute.array_types import Float32, Float64
from roadscan.core.extras import cv2
from roadscan.pictures.lens import Lens, projected, straightened
from roadscan.pictures.settings import PictureTarget, PictureTargetsConfig, TargetStyle
from roadscan.pictures.views import Views

_FIELD: Final = 0.85
"""Part of a chequered target that is compared, in half edges: its outline belongs to what is around it."""


@dataclass(frozen=True)
class Shape:
    """The edges of a target."""

    style: TargetStyle
    radii: tuple[float, ...]
    """Radii of its circles in half edges, from the inside; none of a chequered one."""
    reach: float
    """How far from its middle it is compared, in half edges."""
    is_white: bool
    """Whether its middle is white; a chequered one has none."""

    @classmethod
    def of(cls, target: PictureTarget, style: TargetStyle) -> Shape:
        """Return the shape of a style."""
        if style == "ring":
            return cls(style, target.ring, 0.5 * (1.0 + target.ring[1]) if target.ring[1] < 1.0 else 1.0, True)
        if style == "disc":
            return cls(style, (target.centre, 1.0), 0.95, False)
        return cls(style, (), _FIELD, False)

    def contains(self, x: Float64, y: Float64) -> npt.NDArray[np.bool_]:
        """Return whether places belong to what is compared."""
        if self.style == "checker":
            return np.asarray(np.maximum(np.abs(x), np.abs(y)) <= self.reach)
        return np.asarray(np.hypot(x, y) <= self.reach)

    def white(self, x: Float64, y: Float64, per_px: tuple[Float64, Float64], blur_px: float) -> Float64:
        """Return how white (−1 … 1) places in half edges are, of a target whose picture is blurred by a Gaussian.

        per_px : change of x and of y in a pixel, at each place, of a chequered target; of a round one the first is the
            change of the distance from the middle.
        blur_px : its σ (pixels).
        """
        soft = np.sqrt(2.0) * blur_px
        if self.style == "checker":
            return np.asarray(erf(x / (soft * per_px[0])) * erf(-y / (soft * per_px[1])))
        away = np.hypot(x, y)
        value = np.full(np.shape(away), 1.0 if self.is_white else -1.0)
        for k, radius in enumerate(self.radii):
            sign = -1.0 if (k % 2 == 0) == self.is_white else 1.0
            value = value + sign * (1.0 + erf((away - radius) / (soft * per_px[0])))
        return np.asarray(value)


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


_HALF_PX: Final = (6.0, 8.0)
"""Half an edge of a target in the straightened picture: as many pixels as it has, within these limits."""
_SOFT: Final = 0.4  # σ of the blur that goes before a reduction (pixels of the reduced picture)
_MOST_M: Final = 6.0
"""Farthest distance from a target's stated place, in its own plane, that is searched (m)."""
_SCALES: Final = (0.88, 1.0, 1.14)
"""Sizes of shapes that are compared, as shares of the stated one: distances are off, too."""
_IN_PLANE_DEG: Final = (
    0.0,
    22.5,
    45.0,
    67.5,
)  # turns of a chequered target in its plane; 90 degrees swap its colours
_LEAST: Final = 0.55  # normalised correlation of a candidate
_BEST: Final = 3  # candidates of one way to stand
_FLAT: Final = 1e-3  # correlations of places without contrast are not finite or above 1 by this


@dataclass(frozen=True, eq=False)
class Candidate:
    """A place that looks like a target."""

    shape: Shape
    pose: Pose
    """With the middle that was found, and turned as found."""
    half_m: float
    """Half of its edge, as found."""
    likeness: float
    """Normalised correlation."""


def candidates(picture: Float32, eye: Eye, aim: Aim, shapes: list[Shape]) -> list[Candidate]:
    """Return candidates for a target in a picture (height, width), the likeliest first."""
    found: list[Candidate] = []
    for pose in aim.poses:
        straight = _Straight.of(picture, eye, aim, pose)
        if straight is not None:
            for shape in shapes:
                found += straight.matches(shape)
    return sorted(found, key=lambda one: -one.likeness)


@dataclass(frozen=True, eq=False)
class _Straight:
    """The picture of a target's plane as it would look from straight before it."""

    picture: Float32
    known: npt.NDArray[np.uint8]
    """Whether each of its pixels is in the picture."""
    pose: Pose
    half_m: float
    low: Float64
    """(2,) place of its first pixel in the plane: right and down of the middle (m)."""
    pitch_m: float

    @classmethod
    def of(cls, picture: Float32, eye: Eye, aim: Aim, pose: Pose) -> _Straight | None:
        """Return the part of the plane that may hold the target; None where too little of it is in the picture."""
        half = 0.5 * aim.point.target.size_m
        low, high = _extent(eye, aim, pose, half)
        seen_px = half * eye.focal_px / float(pose.middle_m[2])
        pitch = half / min(max(seen_px, _HALF_PX[0]), _HALF_PX[1])
        count = np.maximum(np.ceil((high - low) / pitch).astype(int), 1)
        right, down = np.meshgrid(low[0] + pitch * np.arange(count[0]), low[1] + pitch * np.arange(count[1]))
        point = pose.middle_m + right[..., None] * pose.right + down[..., None] * pose.down
        pixel = np.full((*right.shape, 2), -1e6)
        ahead = point[..., 2] > 0.2 * pose.middle_m[2]
        if not ahead.any():
            return None
        pixel[ahead] = eye.pixels(point[ahead])
        width, height = eye.size_px
        known = ((pixel >= 0.0) & (pixel <= [width - 1, height - 1])).all(axis=-1)
        if known.sum() < (half / pitch) ** 2:
            return None
        corner = np.maximum(np.floor(pixel[known].min(axis=0)).astype(int) - 2, 0)
        end = np.ceil(pixel[known].max(axis=0)).astype(int) + 3
        part = picture[corner[1] : end[1], corner[0] : end[0]]
        reduced = seen_px / _HALF_PX[1]
        if reduced > 1.0:
            part = cv2.GaussianBlur(part, (0, 0), _SOFT * reduced)
        at = (pixel - corner).astype(np.float32)
        shown = cv2.remap(part, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return cls(shown, np.asarray(known, np.uint8), pose, half, low, pitch)

    def matches(self, shape: Shape) -> Iterator[Candidate]:
        """Yield the best places of a shape."""
        turns = _IN_PLANE_DEG if shape.style == "checker" else (0.0,)
        best: list[tuple[float, float, float, float, float]] = []
        for scale in _SCALES:
            for turn in turns:
                best += [(*one, scale, turn) for one in self._peaks(shape, scale, turn)]
        best.sort(reverse=True)
        for likeness, column, row, scale, turn in best[:_BEST]:
            offset = self.low + self.pitch_m * np.array([column, row])
            middle = self.pose.middle_m + offset[0] * self.pose.right + offset[1] * self.pose.down
            c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
            right, down = c * self.pose.right + s * self.pose.down, c * self.pose.down - s * self.pose.right
            yield Candidate(shape, Pose(middle, right, down, self.pose.tilt_sigma), scale * self.half_m, likeness)

    def _peaks(self, shape: Shape, scale: float, turn_deg: float) -> Iterator[tuple[float, float, float]]:
        """Yield likeness, column and row of local maxima of the correlation."""
        half_px = scale * self.half_m / self.pitch_m
        reach = math.ceil(shape.reach * half_px * (math.sqrt(2.0) if turn_deg else 1.0))
        side = 2 * reach + 1
        if min(self.picture.shape) < side:
            return
        c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
        x, y = np.meshgrid(np.arange(-reach, reach + 1) / half_px, np.arange(-reach, reach + 1) / half_px)
        x, y = c * x + s * y, c * y - s * x
        per_px = np.full_like(x, 1.0 / half_px)
        pattern = shape.white(x, y, (per_px, per_px), 0.6).astype(np.float32)
        mask = shape.contains(x, y).astype(np.float32)
        likeness = cv2.matchTemplate(self.picture, pattern, cv2.TM_CCOEFF_NORMED, mask=mask)
        whole = cv2.matchTemplate(self.known.astype(np.float32), mask, cv2.TM_CCORR) >= 0.98 * mask.sum()
        usable = np.isfinite(likeness) & (np.abs(likeness) <= 1.0 + _FLAT) & whole
        likeness = np.where(usable, np.abs(likeness) if shape.style == "checker" else likeness, 0.0).astype(np.float32)
        top = cv2.dilate(likeness, np.ones((5, 5), np.uint8))
        rows, columns = np.nonzero((likeness >= top) & (likeness > _LEAST))
        order = np.argsort(-likeness[rows, columns], kind="stable")[:_BEST]
        for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
            yield float(likeness[row, column]), float(column + reach), float(row + reach)


def _extent(eye: Eye, aim: Aim, pose: Pose, half_m: float) -> tuple[Float64, Float64]:
    """Return the least and greatest place in a target's plane (m, from its middle) that may be searched."""
    width, height = eye.size_px
    steps = np.linspace(-1.0, 1.0, 9)
    box = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * aim.reach_px + aim.pixel
    inside = np.clip(box, 0.0, [width - 1, height - 1])
    ray = eye.rays(inside)
    facing = ray @ pose.normal
    share = (pose.middle_m @ pose.normal) / np.where(np.abs(facing) < 1e-9, np.nan, facing)
    past = ray * share[:, None] - pose.middle_m
    usable = share > 0.0
    place = np.stack([past @ pose.right, past @ pose.down], axis=-1)[usable]
    margin = 1.5 * half_m
    if not len(place):
        return np.full(2, -margin), np.full(2, margin)
    return np.maximum(place.min(axis=0), -_MOST_M) - margin, np.minimum(place.max(axis=0), _MOST_M) + margin
