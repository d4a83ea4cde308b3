"""Candidates for targets: places of a picture that, seen straight from before, correlate with the target's shape."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float32, Float64
from roadscan.core.extras import cv2
from roadscan.pictures.targets.aim import Aim, Eye, Pose
from roadscan.pictures.targets.shapes import Shape

_HALF_PX: Final = (6.0, 8.0)
"""Half an edge of a target in the straightened picture: as many pixels as it has, within these limits."""
_SOFT: Final = 0.4  # σ of the blur that goes before a reduction (pixels of the reduced picture)
_MOST_M: Final = 6.0
"""Farthest distance from a target's stated place, in its own plane, that is searched (m)."""
_SCALES: Final = (0.88, 1.0, 1.14)
"""Sizes of shapes that are compared, as shares of the stated one: distances are off, too."""
_TURNS_DEG: Final = (0.0, 22.5, 45.0, 67.5)  # turns of a chequered target in its plane; 90 degrees swap its colours
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
        turns = _TURNS_DEG if shape.style == "checker" else (0.0,)
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
