"""Matches of two pictures: alike, along the epipolar line that the poses predict, and in agreement with one another.

The sky of a picture by itself: from the upper border down to the first edge of each column (Shen & Wang 2013).

The strength of that edge is the one with which what lies above is most uniform, and what lies below as well; the sky is
the brighter of the two. A smooth wall that ends above the picture looks alike, so other evidence has to agree: the
horizon, and the distance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float32, Float64, Int64, UInt8
from roadscan.core.extras import cv2
from roadscan.core.gpstime import NS_PER_S
from roadscan.pictures.exposures import Exposures
from roadscan.pictures.settings import PictureTiesConfig

_WIDTH_PX: Final = 320  # Width of the reduced picture (px).
_STRENGTHS: Final = (8, 12, 16, 24, 32, 48, 64, 96, 128)
"""Strengths of an edge that are tried: sums of differences of grey values (Sobel, 3 × 3) of the reduced picture."""
_UNIFORM: Final = 2.0
"""Weight of the variance of the sky beside that of the ground, as Shen & Wang have it."""
_LEAST: Final = 0.02  # Share of the picture that a sky has, at least.


def sky_of(picture: UInt8) -> Bool:
    """Returns a mask (rows, columns) of a reduced grey picture that shows what may be sky; all False where none is."""
    height, width = picture.shape
    size = min(_WIDTH_PX, width), max(1, round(height * min(_WIDTH_PX, width) / width))
    small = cv2.GaussianBlur(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), (5, 5), 0)
    edge = np.abs(cv2.Sobel(small, cv2.CV_16S, 1, 0).astype(np.int32))
    edge += np.abs(cv2.Sobel(small, cv2.CV_16S, 0, 1).astype(np.int32))
    best, found = np.inf, np.zeros(small.shape, bool)
    grey = small.astype(np.float64)
    for strength in _STRENGTHS:
        strong = edge > strength
        border = np.where(strong.any(axis=0), strong.argmax(axis=0), small.shape[0])
        sky = np.arange(small.shape[0])[:, None] < border
        if not sky.any() or sky.all():
            continue
        energy = _UNIFORM * float(grey[sky].var()) + float(grey[~sky].var())
        if energy < best and grey[sky].mean() > grey[~sky].mean():
            best, found = energy, sky
    return found if found.mean() >= _LEAST else np.zeros(small.shape, bool)


def is_at(sky: Bool, pixel: npt.NDArray[np.float32], size_px: tuple[int, int]) -> Bool:
    """Returns whether pixels (k, 2) of a picture lie in its sky."""
    rows, columns = sky.shape
    column = np.clip(pixel[:, 0] * columns / size_px[0], 0, columns - 1).astype(np.int64)
    row = np.clip(pixel[:, 1] * rows / size_px[1], 0, rows - 1).astype(np.int64)
    return np.asarray(sky[row, column])


DESCRIPTOR: Final = 128
"""Numbers of a descriptor."""
_CONTRAST: Final = 0.01
"""Least contrast of a feature; a quarter of Lowe's, since asphalt is dull and the best of each cell are kept."""
_CELLS: Final = (12, 8)
"""Columns and rows of the cells over which features are spread."""
_LARGE_PX: Final = 4.0
"""Diameter of a feature (px) beyond which it comes after all smaller ones of its cell: its middle moves as it is seen
from nearer, by some hundredths of a pixel a picture and always the same way, which bends a long drive."""
FARTHEST: Final = 0.75
"""Distance of two descriptors of unit length, at most: those of unlike places differ by 1.0 in the median."""
_SCALE: Final = 255.0  # Scale of a descriptor's roots, which lie between 0 and 1, as bytes.
_SAME_PX: Final = 1e-3  # Features so near each other (px) are one place with two directions.


@dataclass(frozen=True)
class Features:
    """k features."""

    pixel: Float32
    """(k, 2) u, v from the centre of the upper left pixel."""
    size_px: Float32
    """(k,) diameter."""
    descriptor: UInt8
    """(k, 128) roots of the shares of the gradients, times 255."""
    of_sky: Bool
    """(k,) True of what the picture by itself takes for sky."""
    hidden: int = 0
    """Features that were left out, as they lie on what the rig file says to be the vehicle."""

    def __len__(self) -> int:
        """Returns the number of features."""
        return len(self.pixel)


def features_of(picture: UInt8, most: int, hidden: Bool | None = None) -> Features:
    """Returns the features of a grey picture (height, width), at most `most` of them.

    Parameters
    ----------
    hidden : (height, width) True where nothing is looked for, such as on the vehicle itself; (0, 0): nowhere.
    """
    height, width = picture.shape
    finder = cv2.SIFT.create(nfeatures=0, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    every = finder.detect(picture, None)
    found = [one for one in every if hidden is None or not hidden.size or not hidden[_pixel(one, picture)]]
    left_out, none = len(every) - len(found), np.zeros(0, np.float32)
    if not found:
        nothing = np.zeros((0, DESCRIPTOR), np.uint8)
        return Features(none.reshape(0, 2), none, nothing, np.zeros(0, bool), left_out)
    values = np.array([(*one.pt, one.size, one.response, one.angle) for one in found])
    order = np.lexsort(
        (values[:, 4], values[:, 2], values[:, 0], values[:, 1], -values[:, 3], values[:, 2] > _LARGE_PX)
    )
    order = order[_first_at_place(values[order, :2])]
    rows = order[_spread(values[order, :2], (width, height), most)]
    kept, raw = finder.compute(picture, [found[k] for k in rows.tolist()])
    place = np.array([one.pt for one in kept], np.float32).reshape(-1, 2)
    size = np.array([one.size for one in kept], np.float32)
    share = raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-9)
    descriptor = np.clip(np.rint(_SCALE * np.sqrt(share)), 0, _SCALE).astype(np.uint8)
    return Features(place, size, descriptor, is_at(sky_of(picture), place, (width, height)), left_out)


def alike(first: UInt8, second: UInt8) -> Bool:
    """Returns whether pairs (k,) of descriptors (k, 128) are of places that look alike."""
    one, other = (values.astype(np.float32) for values in (first, second))
    length = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    likeness = np.einsum("ni,ni->n", one, other) / np.maximum(length, 1e-6)
    return np.asarray(2.0 - 2.0 * likeness < FARTHEST**2)


def _pixel(point: cv2.KeyPoint, picture: UInt8) -> tuple[int, int]:
    """Returns row and column of the pixel of a feature."""
    column, row = (int(value + 0.5) for value in point.pt)
    return min(row, picture.shape[0] - 1), min(column, picture.shape[1] - 1)


def _first_at_place(place_px: npt.NDArray[np.float64]) -> Int64:
    """Returns rows of the first feature at each place, in order."""
    _, first = np.unique(np.rint(place_px / _SAME_PX).astype(np.int64), axis=0, return_index=True)
    return np.sort(first).astype(np.int64)


def _spread(place_px: npt.NDArray[np.float64], size: tuple[int, int], most: int) -> Int64:
    """Returns rows of features, best first as they come, of which each cell of the picture gives as many as it can."""
    columns, rows = _CELLS
    column = np.clip(place_px[:, 0] * columns / size[0], 0, columns - 1).astype(np.int64)
    row = np.clip(place_px[:, 1] * rows / size[1], 0, rows - 1).astype(np.int64)
    cell = row * columns + column
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(columns * rows))
    rank = np.empty(cell.size, np.int64)
    rank[order] = np.arange(cell.size) - starts[cell[order]]
    # The first of each cell, then the second of each, and so on.
    chosen = np.lexsort((np.arange(cell.size), rank))[:most]
    return np.sort(chosen).astype(np.int64)


_RATIO: Final = 0.85
"""Distance to the best descriptor over that to the second best in the band, at most; Lowe (2004) takes 0.8 over all."""
_STEPS: Final = 12  # Rounds of re-weighting from the width of the band down to the noise of a feature.
_NOISE_PX: Final = 1.0
"""1 σ of the place of a feature across the epipolar line (px), for the last rounds."""
_WITHIN: Final = 3.0  # A match lies within so many σ of the epipolar line, in the end.
_LEAST_MATCHES: Final = 12
"""Matches of two pictures, at least: with fewer, chance agrees as well with five unknowns."""
_LEAST_BASE_M: Final = 1e-3
"""Two pictures that were taken nearer to each other (m) have no epipolar lines."""
_LOOSEST_RAD: Final = 0.1
"""1 σ of the direction of the base, at most (rad): beyond it the band would be the picture."""
_NEAR_EPIPOLE: Final = 0.02
"""Sine of the angle between a ray and the base below which a ray has no epipolar line."""


@dataclass(frozen=True)
class Relative:
    """The second camera as seen from the first, by the poses."""

    turn: Float64
    """(3, 3) second camera's axes from the first's."""
    base: Float64
    """(3,) centre of the second camera in the first one's axes (m)."""
    sigma_turn_rad: float
    """1 σ of the turn about each axis."""
    sigma_direction_rad: float
    """1 σ of the direction of the base about each axis."""


def matches(
    first: tuple[Float64, UInt8], second: tuple[Float64, UInt8], relative: Relative, pixel_rad: float
) -> tuple[Int64, int]:
    """Returns rows (m, 2) of the features of two pictures that show the same place, and how many other ones look alike
    but contradict the epipolar geometry: what moved, and what is alike by chance.

    Candidates are mutually the best in the band about the epipolar line that follows from the σ of the poses. The
    relative pose is then estimated from all of them, with weights that become narrower from round to round (graduated
    non-convexity, Blake & Zisserman 1987) and the poses as prior; what lies beyond 3 px of its line is left out.

    Parameters
    ----------
    first, second : rays (k, 3) in the camera's axes, unit length, and descriptors (k, 128).
    pixel_rad : angle of a pixel.
    """
    none = np.zeros((0, 2), np.int64)
    if np.linalg.norm(relative.base) < _LEAST_BASE_M or not len(first[0]) or not len(second[0]):
        return none, 0
    # A base that is known badly in relation to its length turns the epipolar lines.
    sigma = float(np.hypot(relative.sigma_turn_rad, min(relative.sigma_direction_rad, _LOOSEST_RAD)))
    band = _WITHIN * (sigma + _NOISE_PX * pixel_rad)
    pairs = _alike(first, second, relative, band)
    if len(pairs) < _LEAST_MATCHES:
        return none, len(pairs)
    rays = first[0][pairs[:, 0]], second[0][pairs[:, 1]]
    away = _fitted(rays, relative, band, _NOISE_PX * pixel_rad)
    kept = np.abs(away) <= _WITHIN * _NOISE_PX * pixel_rad
    found = pairs[kept] if int(kept.sum()) >= _LEAST_MATCHES else none
    return found, len(pairs) - len(found)


def _alike(first: tuple[Float64, UInt8], second: tuple[Float64, UInt8], relative: Relative, band: float) -> Int64:
    """Returns rows (m, 2) of features that are each other's best within a band about the epipolar lines (rad)."""
    one, other = (_unit(own[1]) for own in (first, second))
    likeness = one @ other.T
    base = relative.base / np.linalg.norm(relative.base)
    normal = np.cross(base, first[0])
    steep = np.linalg.norm(normal, axis=1)
    turned = second[0] @ relative.turn
    normal = (normal / np.maximum(steep, _NEAR_EPIPOLE)[:, None]).astype(np.float32)
    off = np.abs(normal @ turned.T.astype(np.float32))
    # At small angles to the base a line is known no better than the base's direction: the band takes them all.
    likeness[off > np.float32(band)] = -1.0
    rows = np.arange(len(one))
    best = likeness.argmax(axis=1)
    top = likeness[rows, best]
    mutual = likeness.argmax(axis=0)[best] == rows
    likeness[rows, best] = -1.0
    distance, next_best = np.sqrt(np.maximum(2.0 - 2.0 * top, 0.0)), np.sqrt(2.0 - 2.0 * likeness.max(axis=1))
    good = mutual & (distance < FARTHEST) & (distance < _RATIO * next_best) & (top > -1.0)
    return np.stack([rows[good], best[good]], axis=-1).astype(np.int64)


def _unit(descriptor: UInt8) -> Float32:
    values = descriptor.astype(np.float32)
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6), np.float32)


def _fitted(rays: tuple[Float64, Float64], relative: Relative, band: float, noise: float) -> Float64:
    """Returns the angle (m,) of each match to its epipolar line, for the relative pose that most of them agree with."""
    from scipy.spatial.transform import Rotation

    turn, base = relative.turn.copy(), relative.base / np.linalg.norm(relative.base)
    sigma_base = min(relative.sigma_direction_rad, _LOOSEST_RAD)
    prior = 1.0 / np.array([*[relative.sigma_turn_rad**2] * 3, *[sigma_base**2] * 2])
    total = np.zeros(5)
    for scale in np.geomspace(max(band, noise), noise, _STEPS):
        residual, slope, across = _epipolar(rays, turn, base)
        weight = 1.0 / (1.0 + (residual / scale) ** 2) ** 2 / scale**2
        matrix = (slope * weight[:, None]).T @ slope + np.diag(prior)
        step = np.linalg.solve(matrix, -(slope * weight[:, None]).T @ residual - prior * total)
        total = total + step
        turn = Rotation.from_rotvec(step[:3]).as_matrix() @ turn
        base = base + across @ step[3:]
        base = base / np.linalg.norm(base)
    return _epipolar(rays, turn, base)[0]


def _epipolar(rays: tuple[Float64, Float64], turn: Float64, base: Float64) -> tuple[Float64, Float64, Float64]:
    """Returns angles (m,) to the epipolar planes, derivatives (m, 5) by a turn of the second camera and a turn of the
    base, and the two directions (3, 2) in which the base turns.
    """
    one, other = rays
    turned = other @ turn
    normal = np.cross(base, one)
    steep = np.maximum(np.linalg.norm(normal, axis=1), _NEAR_EPIPOLE)
    residual = np.einsum("ni,ni->n", normal, turned) / steep
    helper = np.eye(3)[int(np.argmin(np.abs(base)))]
    first = np.cross(base, helper)
    first /= np.linalg.norm(first)
    across = np.stack([first, np.cross(base, first)], axis=-1)
    # exp(ω) turn: the ray becomes turnᵀ exp(−ω) ray, so it changes by turnᵀ (ray × ω).
    in_second = normal @ turn.T
    by_turn = np.cross(in_second, other)
    by_base = np.stack([np.einsum("ni,ni->n", np.cross(across[:, k], one), turned) for k in (0, 1)], axis=-1)
    return residual, np.concatenate([by_turn, by_base], axis=1) / steep[:, None], across


_SAME_VISIT_NS: Final = 20 * NS_PER_S
"""Pictures of one camera so near in time (ns) are neighbours; later ones are a revisit."""
_MOST_NEAR: Final = 400
"""Pictures around a place that are looked at for revisits; a vehicle that waits takes many."""


def pairs_of(exposures: Exposures, settings: PictureTiesConfig) -> Int64:
    """Returns pairs (p, 2) of pictures, the earlier number first, in order."""
    if not len(exposures):
        return np.zeros((0, 2), np.int64)
    axis = exposures.world_from_opencv[:, :, 2]
    alike = float(np.cos(np.radians(settings.revisit_deg)))
    found = {(a, b) for a, b in _neighbours(exposures, settings) if axis[a] @ axis[b] >= alike}
    if settings.revisits:
        found |= set(_revisits(exposures, settings, axis, alike))
    return np.array(sorted(found), np.int64).reshape(-1, 2)


def _neighbours(exposures: Exposures, settings: PictureTiesConfig) -> Iterator[tuple[int, int]]:
    """Yields each picture with those that the same camera took after it, a step apart each."""
    eye, epoch = exposures.eye_world_m, exposures.epoch_gps_ns
    for camera in np.unique(exposures.camera).tolist():
        rows = np.flatnonzero(exposures.camera == camera)
        rows = rows[np.argsort(epoch[rows], kind="stable")]
        for k, first in enumerate(rows.tolist()):
            last, count = first, 0
            for other in rows[k + 1 :].tolist():
                if epoch[other] - epoch[first] > _SAME_VISIT_NS or count == settings.neighbours:
                    break
                if np.linalg.norm(eye[other] - eye[last]) < settings.shortest_step_m:
                    continue
                last, count = other, count + 1
                yield min(first, other), max(first, other)


def _revisits(
    exposures: Exposures, settings: PictureTiesConfig, axis: Float64, alike: float
) -> Iterator[tuple[int, int]]:
    """Yields each picture with the nearest of each other camera, and of its own at another time."""
    from scipy.spatial import cKDTree

    eye, epoch, camera = exposures.eye_world_m, exposures.epoch_gps_ns, exposures.camera
    worlds = [exposures.cameras[k].world for k in camera.tolist()]
    for world in sorted(set(worlds)):
        rows = np.flatnonzero([own == world for own in worlds])
        tree = cKDTree(eye[rows])
        distances, near = tree.query(eye[rows], k=min(_MOST_NEAR, rows.size), distance_upper_bound=settings.revisit_m)
        for first, away, others in zip(
            rows.tolist(), np.atleast_2d(distances.T).T, np.atleast_2d(near.T).T, strict=True
        ):
            taken: dict[tuple[int, int], int] = {}
            for other in rows[others[np.isfinite(away)]].tolist():
                same = camera[other] == camera[first]
                if other == first or (same and abs(epoch[other] - epoch[first]) <= _SAME_VISIT_NS):
                    continue
                visit = (int(camera[other]), int(epoch[other] // _SAME_VISIT_NS) if same else 0)
                if axis[first] @ axis[other] >= alike and taken.get(visit, 0) < settings.revisits:
                    taken[visit] = taken.get(visit, 0) + 1
                    yield min(first, other), max(first, other)
