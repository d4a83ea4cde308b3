"""Fits a target's picture by least squares: its middle to a few hundredths of a pixel, with σ.

The grey values of the picture are those of two levels, with the target's edges between them as its plane projects, and
blurred by a Gaussian. So the middle is that of the target, and not of the ellipse as which a circle is seen (its
eccentricity: Dold 1996, Luhmann 2014). Of a chequered target both edges turn by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float32, Float64
from roadscan.core.extras import cv2
from roadscan.pictures.targets.aim import Eye, Pose, across
from roadscan.pictures.targets.candidates import Candidate

_LARGEST_PX: Final = 56.0
"""A target larger than this is reduced before it is fitted (pixels)."""
_BLUR_PX: Final = 0.6  # blur with which the search begins (σ, pixels)
_SHARPEST_PX: Final = 0.3
"""Least blur (σ, pixels): a pixel alone makes as much, and with less the middle would depend on no grey value."""
_MOST_BLUR_PX: Final = 4.0  # largest blur of a target that counts (σ, pixels)
_ALIKE: Final = 0.25
"""Two fits are alike where what they leave unexplained differs by less than this share."""
_WORST_FIELD: Final = 0.16
"""RMS of the misfit in any quarter of a target, as a share of its contrast, up to which it counts: more is hidden."""
_MOVE_PX: Final = 6.0  # largest move of the middle from the candidate's (pixels)
_SIZE_SIGMA: Final = 0.15  # 1 σ of its size, as a logarithm
_NOISE: Final = 4.0  # σ of grey values with which the search begins
_LEAST_PIXELS: Final = 24  # pixels that a target has at least
_CORRELATED: Final = 2.0
"""Factor of σ: neighbouring pixels err together (compression, light), which the sum over them does not know."""
_LEAST_SIGMA_PX: Final = 0.02  # least stated σ (pixels)
_ROUNDS: Final = 30  # most evaluations of the gradient
_SETTLED: Final = 1e-6  # change of the sum of squares at which the search ends
_HOPELESS: Final = 0.8  # correlation after the first search below which there is no second
_LEVEL: Final = 1e-9  # least variance of a pattern that has two levels


@dataclass(frozen=True, eq=False)
class Fitted:
    """A target as fitted."""

    pixel: Float64
    """(2,) its middle."""
    sigma_px: float
    """1 σ of each coordinate; the larger of both."""
    likeness: float
    """Correlation of the picture with the fitted target."""
    contrast: float
    """White less black (grey values)."""
    blur_px: float
    """σ of the blur."""
    turned: float
    """How far it stands from how it was taken to stand: largest of its tilts (tangent)."""
    size: float
    """Its size over the candidate's."""
    worst_field: float
    """Largest RMS of the misfit in one of its quarters, as a share of the contrast."""


def fit(picture: Float32, eye: Eye, candidate: Candidate) -> Fitted | None:
    """Return a candidate fitted to a picture (height, width); None where too little of it is in the picture."""
    from scipy.optimize import least_squares

    window = _Window.of(picture, eye, candidate)
    if window is None:
        return None
    noise, start = _NOISE, window.start()
    for number in range(2):
        found = least_squares(window.residuals, start, x_scale="jac", ftol=_SETTLED, max_nfev=_ROUNDS, args=(noise,))
        start = found.x
        if number == 0 and window.told(found.x, found.jac).likeness < _HOPELESS:
            break
        left = window.misfit(found.x)
        noise = max(float(np.sqrt(left @ left / max(left.size - found.x.size - 2, 1))), 0.5)
    return window.told(found.x, found.jac)


@dataclass(frozen=True, eq=False)
class _Window:
    """The pixels of a candidate, and the rays through them."""

    eye: Eye
    candidate: Candidate
    grey: Float64
    """(h, w)"""
    ray: Float64
    """(h, w, 3)"""
    step: int
    """Pixels of the picture along an edge of one of these."""
    used: npt.NDArray[np.bool_]
    """(h, w)"""
    middle_px: Float64
    """(2,) of the candidate."""

    @classmethod
    def of(cls, picture: Float32, eye: Eye, candidate: Candidate) -> _Window | None:
        """Return the window of a candidate."""
        pose, half = candidate.pose, candidate.half_m
        corners = [a * pose.right + b * pose.down for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
        corner = pose.middle_m + half * np.array(corners)
        if (corner[:, 2] <= 0.1 * pose.middle_m[2]).any():
            return None
        outline = eye.pixels(corner)
        step = max(int(np.ceil(np.ptp(outline, axis=0).max() / _LARGEST_PX)), 1)
        size = np.array(eye.size_px)
        low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 2 * step, 0)
        high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 2 * step + 1, size)
        count = (high - low) // step
        if (count < 4).any():
            return None
        part = picture[low[1] : low[1] + step * count[1], low[0] : low[0] + step * count[0]]
        if step > 1:
            part = cv2.resize(part, tuple(count.tolist()), interpolation=cv2.INTER_AREA)
        column, row = (low[k] + step * (np.arange(count[k]) + 0.5) - 0.5 for k in (0, 1))
        pixel = np.stack(np.meshgrid(column, row), axis=-1)
        ray = eye.rays(pixel.reshape(-1, 2)).reshape(*pixel.shape[:2], 3)
        middle = eye.pixels(pose.middle_m)[0]
        whole = cls(eye, candidate, part.astype(np.float64), ray, step, np.ones(part.shape, np.bool_), middle)
        used = candidate.shape.contains(*whole.in_plane(whole.start())[:2])
        return replace(whole, used=used) if used.sum() >= _LEAST_PIXELS else None

    @property
    def _is_chequered(self) -> bool:
        return self.candidate.shape.style == "checker"

    def start(self) -> Float64:
        """Return first values: move of the middle (pixels), two turns or tilts, size and blur as logarithms."""
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.log(_BLUR_PX)])[
            [0, 1, 2, 3, 5] if self._is_chequered else slice(6)
        ]

    def in_plane(self, values: Float64) -> tuple[Float64, Float64, tuple[Float64, Float64]]:
        """Return places (h, w) of the pixels in the target's plane, in half edges, and their change in a pixel."""
        pose = self._pose(values)
        normal = pose.normal
        share = (pose.middle_m @ normal) / (self.ray @ normal)
        past = self.ray * share[..., None] - pose.middle_m
        half = self.candidate.half_m * (1.0 if self._is_chequered else float(np.exp(values[4])))
        x, y = past @ pose.right / half, past @ pose.down / half
        if self._is_chequered:
            (c1, c2), (s1, s2) = np.cos(values[2:4]), np.sin(values[2:4])
            x, y = c1 * x + s1 * y, c2 * y - s2 * x
            return x, y, (self._change(x), self._change(y))
        change = self._change(np.hypot(x, y))
        return x, y, (change, change)

    def misfit(self, values: Float64) -> Float64:
        """Return grey values less those of the fitted target (n,)."""
        pattern, grey = self._pattern(values), self.grey[self.used]
        middle = pattern.mean()
        spread = float(((pattern - middle) ** 2).mean())
        slope = 0.0 if spread < _LEVEL else float(((pattern - middle) * (grey - grey.mean())).mean()) / spread
        return np.asarray(grey - grey.mean() - slope * (pattern - middle))

    def residuals(self, values: Float64, noise: float) -> Float64:
        """Return what least squares make small: misfits, and how far the target stands from what is known of it."""
        known = np.maximum(np.abs(values[:2]) - _MOVE_PX, 0.0)
        if not self._is_chequered:
            known = np.concatenate([known, values[2:4] / self.candidate.pose.tilt_sigma, values[4:5] / _SIZE_SIGMA])
        return np.concatenate([self.misfit(values) / noise, known])

    def told(self, values: Float64, jacobian: Float64) -> Fitted:
        """Return what the fit says."""
        pattern, grey = self._pattern(values), self.grey[self.used]
        variance = np.linalg.pinv(jacobian.T @ jacobian)
        sigma = _CORRELATED * float(np.sqrt(np.linalg.eigvalsh(variance[:2, :2])[-1]))
        apart = np.cov(pattern, grey)
        likeness = apart[0, 1] / np.sqrt(max(apart[0, 0] * apart[1, 1], _LEVEL))
        contrast = 2.0 * apart[0, 1] / max(apart[0, 0], _LEVEL)
        if self._is_chequered:  # which of its fields are black is not known
            likeness, contrast = abs(likeness), abs(contrast)
        return Fitted(
            self.middle_px + values[:2], max(sigma, _LEAST_SIGMA_PX), float(likeness), float(contrast),
            float(np.exp(values[-1])) * self.step, float(np.abs(values[2:4]).max()),
            1.0 if self._is_chequered else float(np.exp(values[4])),
            self._worst_field(values) / max(abs(float(contrast)), 1.0),
        )  # fmt: skip

    def _worst_field(self, values: Float64) -> float:
        """Return the largest RMS of the misfit in one of the target's quarters (grey values)."""
        x, y, _ = self.in_plane(values)
        quarter = (2 * (x > 0.0) + (y > 0.0))[self.used]
        left = self.misfit(values)
        return max(float(np.sqrt((left[quarter == k] ** 2).mean())) for k in range(4) if (quarter == k).any())

    def _pattern(self, values: Float64) -> Float64:
        """Return how white the used pixels (n,) are."""
        x, y, per_px = self.in_plane(values)
        blur = float(np.clip(np.exp(values[-1]), _SHARPEST_PX, 50.0))
        used = (np.maximum(per_px[0][self.used], 1e-9), np.maximum(per_px[1][self.used], 1e-9))
        return self.candidate.shape.white(x[self.used], y[self.used], used, blur)

    def _pose(self, values: Float64) -> Pose:
        """Return the target's pose of some values."""
        pose = self.candidate.pose
        ray = self.eye.rays((self.middle_px + values[:2])[None])[0]
        middle = ray * pose.middle_m[2]
        if self._is_chequered:
            return replace(pose, middle_m=middle)
        normal = pose.normal + values[2] * pose.right + values[3] * pose.down
        normal = normal / np.linalg.norm(normal)
        right = pose.right - (pose.right @ normal) * normal
        right = right / np.linalg.norm(right)
        return Pose(middle, right, across(normal, right), pose.tilt_sigma)

    @staticmethod
    def _change(values: Float64) -> Float64:
        """Return the length of the gradient (h, w) in a pixel."""
        return np.asarray(np.hypot(*np.gradient(values)))


def best_turned(picture: Float32, eye: Eye, candidate: Candidate, found: Fitted, poses: Sequence[Pose]) -> Fitted:
    """Return the best fit of a round target over the ways in which it may stand.

    A circle that leans to one side looks nearly like one that leans to the other, and its middle lies elsewhere. Where
    two of them fit alike, σ holds half of what is between their middles.
    """
    ray = eye.rays(found.pixel[None])[0]
    starts = [replace(candidate, pose=replace(p, middle_m=ray * candidate.pose.middle_m[2])) for p in poses]
    fits = [found, *(one for start in starts if (one := fit(picture, eye, start)) is not None)]
    best = max(fits, key=lambda one: one.likeness)
    alike = [one.pixel for one in fits if best.likeness - one.likeness < _ALIKE * (1.0 - best.likeness)]
    apart = max(float(np.linalg.norm(one - best.pixel)) for one in alike)
    return replace(best, sigma_px=float(np.hypot(best.sigma_px, 0.5 * apart)))


def is_target(found: Fitted, most_sigma_px: float, least_likeness: float) -> str:
    """Return why a fitted target is none; empty where nothing speaks against it."""
    if found.likeness < least_likeness:
        return f"its picture is like the target by {found.likeness:.2f} only"
    if found.worst_field > _WORST_FIELD:
        return f"a quarter of it differs by {100 * found.worst_field:.0f} % of the contrast: hidden, or in shadow"
    if found.blur_px > _MOST_BLUR_PX:
        return f"its edges are blurred by {found.blur_px:.1f} pixels"
    if found.sigma_px > most_sigma_px:
        return f"its middle is known to {found.sigma_px:.2f} pixels only"
    return ""
