"""Finds control targets in pictures whose poses are known within a few decimetres.

Fits a target's picture by least squares: its middle to a few hundredths of a pixel, with σ.

The grey values of the picture are those of two levels, with the target's edges between them as its plane projects, and
blurred by a Gaussian. So the middle is that of the target, and not of the ellipse as which a circle is seen (its
eccentricity: Dold 1996, Luhmann 2014). Of a chequered target both edges turn by themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float32, Float64
from roadscan.core.extras import cv2
from roadscan.pictures.exposures import read_picture
from roadscan.pictures.placed import Pictures
from roadscan.pictures.settings import PictureTargetsConfig
from roadscan.pictures.targets.candidates import Aim, Candidate, Eye, Pose, Shape, TargetPoint, across, aims, candidates
from roadscan.store.codecs.image_files import ImageError
from roadscan.store.schema import table_schema

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


Read: TypeAlias = Callable[[int], Float32 | None]
"""Returns the grey values (height, width) of a picture by its number; None where it cannot be read."""

TABLE: Final = "picture_points"
"""Table of points measured in pictures."""
_TRIED: Final = 4  # candidates that are fitted
_APART_PX: Final = 3.0  # finds nearer together than this are one (pixels)
_LEAST_LIKENESS: Final = 0.88  # correlation of a picture with a fitted target that counts
_LEAST_CONTRAST: Final = 25.0  # white less black of a target that counts (grey values)
_SURE: Final = 0.97  # correlation of a fitted target beside which others need no fit …
_SURELY: Final = 0.15  # … where no candidate elsewhere comes nearer than this to its own likeness
_CLEARER: Final = 0.04  # by how much the better of two finds has to be likelier to count


@dataclass(frozen=True, eq=False)
class Sought:
    """A target that may be in a picture, and what was found of it."""

    picture: int
    """Number of the picture."""
    aim: Aim
    found: Fitted | None
    reason: str
    """Why it was not found; empty where it was."""


def found_rows(pictures: Pictures, sought: Iterable[Sought]) -> pa.Table:
    """Return the rows of the table `picture_points` of what was found, in the table's order."""
    rows = [_row(pictures, one, one.found) for one in sought if one.found is not None]
    rows.sort(key=lambda row: (str(row["point"]), str(row["picture"]), str(row["run"]), str(row["sensor"])))
    return pa.Table.from_pylist(rows, schema=table_schema(TABLE).arrow())


def seek(
    pictures: Pictures,
    points: Sequence[TargetPoint],
    settings: PictureTargetsConfig | None = None,
    read: Read | None = None,
) -> Iterator[Sought]:
    """Yield each target that may be in a picture, picture by picture, found or with the reason why not.

    Parameters
    ----------
    pictures : with their stated poses and lenses; a picture that cannot be read, or is of another size than its lens
        is for, costs itself alone.
    points : control points, where they were surveyed.
    settings : how far poses may be off, and what counts as a target.
    read : gives grey values; from the pictures' files where left out.
    """
    settings = settings or PictureTargetsConfig()
    places = np.array([p.place_map_m for p in points], np.float64).reshape(-1, 3)
    worlds = [pictures.map.world_from_map(world, places) for world in pictures.worlds]
    listed = list(points)
    for number in range(len(pictures)):
        eye = Eye.of(pictures.views, number)
        if eye.lens.is_around or not listed:
            continue
        aimed = list(aims(eye, worlds[pictures.views.world[number]], listed, settings))
        picture = (read or _reader(pictures))(number) if aimed else None
        if picture is not None and picture.shape != eye.size_px[::-1]:
            picture = None
        for aim in aimed:
            if picture is None:
                yield Sought(
                    number, aim, None, "the picture cannot be read, or is of another size than its lens is for"
                )
                continue
            others = np.array([one.pixel for one in aimed if one is not aim]).reshape(-1, 2)
            found, reason = _find(picture, eye, aim, others, settings)
            yield Sought(number, aim, found, reason)


def _reader(pictures: Pictures) -> Read:
    """Return what reads grey values from the pictures' files, without the rotation that a viewer would apply."""

    def read(number: int) -> Float32 | None:
        try:
            grey = read_picture(pictures.path(number), pictures.views.lens_of(number).size_px, grey=True)
        except (ImageError, OSError):
            return None
        return grey.astype(np.float32)

    return read


def _find(
    picture: Float32, eye: Eye, aim: Aim, others: Float64, settings: PictureTargetsConfig
) -> tuple[Fitted | None, str]:  # fmt: skip
    """Return the target that is aimed at, or why it was not found.

    others : (k, 2) where other targets are expected in this picture: a find nearer to one of them is that.
    """
    target = aim.point.target
    tried = _distinct(candidates(picture, eye, aim, [Shape.of(target, style) for style in target.styles]), eye)
    good: list[Fitted] = []
    reason = "nothing there looks like it"
    for candidate in tried:
        found = fit(picture, eye, candidate)
        if found is not None and candidate.shape.radii and found.likeness >= _LEAST_LIKENESS:
            found = best_turned(picture, eye, candidate, found, aim.poses)
        if found is None:
            continue
        against = _against(found, aim, others, settings)
        if against:
            reason = against if reason.startswith("nothing") else reason
            continue
        good.append(found)
        rest = [one.likeness for one in tried if _is_elsewhere(eye, one, found)]
        if found.likeness > _SURE and max(rest, default=0.0) < candidate.likeness - _SURELY:
            return found, ""
    good.sort(key=lambda one: -one.likeness)
    if not good:
        return None, reason
    best = good[0]
    rivals = [one for one in good[1:] if np.linalg.norm(one.pixel - best.pixel) > _APART_PX]
    if any(best.likeness - one.likeness < _CLEARER for one in rivals):
        return None, "two places look like it"
    return best, ""


def _is_elsewhere(eye: Eye, candidate: Candidate, found: Fitted) -> bool:
    """Return whether a candidate is another place than what was found."""
    return bool(np.linalg.norm(eye.pixels(candidate.pose.middle_m)[0] - found.pixel) > _APART_PX)


def _distinct(found: list[Candidate], eye: Eye) -> list[Candidate]:
    """Return the likeliest candidates, of those of one shape in one place the best."""
    kept: list[Candidate] = []
    for one in found:
        pixel = eye.pixels(one.pose.middle_m)[0]
        twin = any(
            other.shape.style == one.shape.style
            and np.linalg.norm(eye.pixels(other.pose.middle_m)[0] - pixel) < _APART_PX
            and abs(float(other.pose.normal @ one.pose.normal)) > 0.9
            for other in kept
        )
        if not twin:
            kept.append(one)
        if len(kept) == _TRIED:
            break
    return kept


def _against(found: Fitted, aim: Aim, others: Float64, settings: PictureTargetsConfig) -> str:
    """Return why a fitted candidate is not the target; empty where nothing speaks against it."""
    away = float(np.linalg.norm(found.pixel - aim.pixel))
    if away > aim.reach_px + _APART_PX:
        return f"what looks like it is {away:.0f} pixels from where the pose says"
    if len(others) and np.linalg.norm(others - found.pixel, axis=1).min() < away:
        return "what looks like it is nearer to another target"
    if found.contrast < _LEAST_CONTRAST:
        return f"its contrast is {found.contrast:.0f} grey values"
    return is_target(found, settings.most_sigma_px, _LEAST_LIKENESS)


def _row(pictures: Pictures, one: Sought, found: Fitted) -> dict[str, object]:
    log = pictures.logs[pictures.log[one.picture]]
    return {
        "run": log.run, "sensor": log.sensor, "picture": pictures.files[one.picture], "point": one.aim.point.name,
        "u_px": float(found.pixel[0]), "v_px": float(found.pixel[1]), "sigma_px": found.sigma_px, "source": "found",
    }  # fmt: skip
