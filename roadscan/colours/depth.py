"""What pictures show: from the points around a picture, which distances are hidden, at an edge, or have moved away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.colours.kernels.depths import grow, nearest_in_pixels, slopes
from roadscan.colours.kernels.looks import LEAST_M, MOVED, MOVED_M, STEPS, UNKNOWN, VOTED, VOTED_M, Camera, project
from roadscan.compute.array_types import Float32, Int64, UInt8, UInt16
from roadscan.core.extras import cv2
from roadscan.pictures.kernels.lens import FOCAL_X, FOCAL_Y, HEIGHT, WIDTH

_MOST_PIXELS: Final = 500_000
"""Most pixels of a depth image: its pixels stand for so many of the picture's that it has no more."""
_BLOCK: Final = 16
"""Edge of the blocks (pixels) in which the gaps between points are measured."""
_MOST_GAP: Final = 8.0
"""Wider gaps (pixels from the nearest point) are not closed: nothing may be there."""
_OF_GAPS: Final = 92.0
"""Percentile of the distances to the nearest point in a block that counts as its gap."""
_THICKNESS_M: Final = 0.15
"""A point may lie so far behind the nearest one and still be seen (m): noise of ranges and poses, rough surfaces."""
_THICKNESS: Final = 0.01
"""The same as a share of its distance."""
_AROUND: Final = 12
"""Something was seen through a place where an opening of more than twice so many pixels was at the moment: leaves,
wires and the like are seen through, and stay."""
_OUTLINE: Final = 16
"""What moves is shown by the lines of one turn alone, and may reach so far beyond (pixels): twice the widest gap."""
_UNKNOWN_SLOPE: Final = 2.7
"""Slope (m a m across the ray) of a surface whose normal is not known: it is seen at 20 degrees."""
_HALF_OF_FAR: Final = 1.5
"""Before nothing, such as the sky, an edge reaches from its near side to so many times its distance."""
_OPENING_M: Final = 0.4
"""Openings up to twice as wide and high (m) are closed: a pane of a car is so high."""
_NEAREST_CLOSED_M, _CLOSED_WITHIN_M = 3.0, 40.0
"""Distances of the things whose openings are closed (m)."""
_CLOSED_STEP: Final = 2.0**0.5  # Openings are closed by distance, in steps of this factor.
_FAR: Final = np.float32(1e9)  # Stands for inf where OpenCV filters images (m).


@dataclass(frozen=True)
class DepthRule:
    """How depth images are made."""

    moment_ns: int
    """Points seen within this of the picture show where things that move were."""
    grazing_deg: float
    """Least angle between a ray and a surface that is seen."""
    edge_px: float
    """Points nearer to an edge in depth (pixels of the picture) do not count as seen."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Points (n,) around some pictures."""

    point_m: Float32
    """(n, 3) map, from the origin of the cameras."""
    normal: Float32
    """(n, 3) unit normals of their surfaces, NaN where unknown."""
    epoch_gps_ns: Int64

    def part(self, rows: slice) -> Seen:
        """Returns some of them."""
        return Seen(self.point_m[rows], self.normal[rows], self.epoch_gps_ns[rows])


@dataclass(frozen=True, eq=False)
class DepthImages:
    """What a picture shows, as `Depths` of the kernels has it: (rows, columns) stored distances."""

    nearest: UInt16
    farthest: UInt16
    moved: UInt16
    factor: int
    """Pixels of the picture along the edge of one of theirs."""


def depth_factor(lens: npt.NDArray[np.float64]) -> int:
    """Returns how many pixels of a picture lie along the edge of a pixel of its depth images."""
    return max(1, int(np.ceil(np.sqrt(lens[WIDTH] * lens[HEIGHT] / _MOST_PIXELS))))


@dataclass(frozen=True, eq=False)
class _Moment:
    """What was seen at the moment of a picture."""

    factor: int
    pixel: Float32
    """(n, 2) of all points, also those of other times, NaN where one is not shown."""
    distance_m: Float32
    """(n,) likewise."""
    at_once: npt.NDArray[np.bool_]
    """(n,) seen at the moment."""
    nearest_m: Float32
    """(rows, columns) of those."""
    which: npt.NDArray[np.int32]
    """(rows, columns) number of the nearest."""
    around_m: Float32
    """(rows, columns) its gaps closed, openings of leaves and wires as well."""
    turned: tuple[float, float]
    """Angle of a pixel of the image (rad), steepest slope."""


def depth_images(
    points: Seen, camera: Camera, own_epoch_gps_ns: int, reach_m: float, rule: DepthRule,
    moved: npt.NDArray[np.bool_] | None = None,
) -> DepthImages:  # fmt: skip
    """Returns what a picture shows, from the points around it.

    Points of the moment come first. Points of other times count unless something was seen through their place at the
    moment: such were things that moved. Nearest points of each pixel grow to discs that close the gaps (`grow`).

    moved : (n,) points that were seen through at other moments as well: they count at their own alone.
    """
    m = _moment(points, camera, own_epoch_gps_ns, reach_m, rule)
    moment, around, factor = m.nearest_m, m.around_m, m.factor
    counted = ~m.at_once if moved is None else ~m.at_once & ~moved
    other, others = _nearest(m.pixel, m.distance_m, np.flatnonzero(counted), factor, moment.shape)
    other[np.isfinite(around) & (around > other * (1.0 + MOVED) + MOVED_M)] = np.inf
    closer = other < moment
    front, which = np.where(closer, other, moment), np.where(closer, others, m.which)
    front, radius = _grown(front, _slopes(front, which, points, camera, m.turned))
    pixel_rad, steepest = m.turned
    known = np.isfinite(front)
    closed = _without_holes(front, pixel_rad)
    margin = rule.edge_px / factor
    at_edge, closed = _edges(np.where(known, front, closed), closed, radius, margin, steepest * pixel_rad)
    if moved is not None and moved.any():
        moving, _ = _nearest(m.pixel, m.distance_m, np.flatnonzero(m.at_once & moved), factor, moment.shape)
        closed = np.minimum(closed, cv2.erode(np.where(np.isfinite(moving), moving, _FAR), _disc(_OUTLINE)))
        known |= closed < _FAR
    nearest = np.where(known, at_edge, 0.0)
    farthest = np.where(known, closed * (1.0 + _THICKNESS) + _THICKNESS_M, np.inf)
    gone = np.where(np.isfinite(around), (around - MOVED_M) / (1.0 + MOVED), 0.0)
    return DepthImages(_stored(nearest), _stored(farthest), _stored(gone), factor)


def seen_through(
    points: Seen, camera: Camera, own_epoch_gps_ns: int, reach_m: float, rule: DepthRule
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Returns which points (n,) of other times were seen through at the moment of a picture, and which were there."""
    m = _moment(points, camera, own_epoch_gps_ns, reach_m, rule)
    rows = np.flatnonzero(~m.at_once & ~np.isnan(m.distance_m))
    place = ((m.pixel[rows] + 0.5) / m.factor).astype(np.int64)
    height, width = m.around_m.shape
    around = m.around_m[np.minimum(place[:, 1], height - 1), np.minimum(place[:, 0], width - 1)]
    distance = m.distance_m[rows]
    through, there = np.zeros(len(points.point_m), np.bool_), np.zeros(len(points.point_m), np.bool_)
    through[rows] = np.isfinite(around) & (around > distance * (1.0 + VOTED) + VOTED_M)
    there[rows] = np.isfinite(around) & (np.abs(around - distance) <= distance * _THICKNESS + _THICKNESS_M)
    return through, there


def _moment(points: Seen, camera: Camera, own_epoch_gps_ns: int, reach_m: float, rule: DepthRule) -> _Moment:
    factor = depth_factor(camera.lens)
    shape = (-(-int(camera.lens[HEIGHT]) // factor), -(-int(camera.lens[WIDTH]) // factor))
    pixel, distance = np.empty((len(points.point_m), 2), np.float32), np.empty(len(points.point_m), np.float32)
    project(points.point_m, camera, reach_m, pixel, distance)
    at_once = np.abs(points.epoch_gps_ns - own_epoch_gps_ns) <= rule.moment_ns
    pixel_rad = float(factor / np.sqrt(camera.lens[FOCAL_X] * camera.lens[FOCAL_Y]))
    steepest = float(1.0 / np.tan(np.radians(rule.grazing_deg)))
    moment, which = _nearest(pixel, distance, np.flatnonzero(at_once), factor, shape)
    around = _grown(moment, _slopes(moment, which, points, camera, (pixel_rad, steepest)))[0]
    disc = _disc(_AROUND)
    seen = np.isfinite(around)
    around = cv2.dilate(cv2.erode(np.where(seen, around, _FAR), disc), disc)
    around = np.where(seen & (around < _FAR), around, np.inf).astype(np.float32)
    return _Moment(factor, pixel, distance, at_once, moment, which, around, (pixel_rad, steepest))


def _nearest(
    pixel: Float32, distance_m: Float32, rows: Int64, factor: int, shape: tuple[int, int]
) -> tuple[Float32, npt.NDArray[np.int32]]:
    image, which = np.full(shape, np.inf, np.float32), np.zeros(shape, np.int32)
    nearest_in_pixels(pixel, distance_m, rows, float(factor), image, which)
    return image, which


def _slopes(
    sample_m: Float32, which: npt.NDArray[np.int32], points: Seen, camera: Camera, turned: tuple[float, float]
) -> Float32:
    """Returns how the surfaces at samples lie, as `slopes` has it; `turned`: angle of a pixel, steepest slope."""
    out = np.empty((*sample_m.shape, 3), np.float32)
    slopes(sample_m, which, points.point_m, points.normal, camera.eye_m, camera.axes, *turned, _UNKNOWN_SLOPE, out)
    return out


def _grown(sample_m: Float32, slope: Float32) -> tuple[Float32, Float32]:
    """Returns samples (height, width) with their gaps closed, and the radius of the discs by block (pixels)."""
    radius = _gaps(sample_m)
    out = np.empty_like(sample_m)
    grow(sample_m, slope, radius, _BLOCK, out)
    return out, radius


def _gaps(sample_m: Float32) -> Float32:
    """Returns the gap between samples by block of pixels (rows, columns): from 1 to the widest that is closed."""
    empty = (~np.isfinite(sample_m)).astype(np.uint8)
    height, width = sample_m.shape
    rows, columns = -(-height // _BLOCK), -(-width // _BLOCK)
    if empty.all():
        return np.ones((rows, columns), np.float32)
    away = np.full((rows * _BLOCK, columns * _BLOCK), np.nan, np.float32)
    away[:height, :width] = np.minimum(cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), _MOST_GAP)
    blocks = away.reshape(rows, _BLOCK, columns, _BLOCK).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    return np.clip(np.nanpercentile(blocks, _OF_GAPS, axis=-1) + 1.0, 1.0, _MOST_GAP).astype(np.float32)


def _without_holes(front_m: Float32, pixel_rad: float) -> Float32:
    """Returns a depth image without what is seen through narrow openings: panes of cars, crowns of trees, fences.

    A lidar passes glass and leaves, and what it saw behind is not what a picture shows there. An opening counts as
    narrow by its size in metres, at the distance of what is around it. A road that recedes has no opening: a window on
    it finds nothing nearer than its lower edge.
    """
    out = front_m.copy()
    finite = np.where(np.isfinite(front_m), front_m, _FAR)
    limit = _NEAREST_CLOSED_M
    while limit < _CLOSED_WITHIN_M:
        whole = round(_OPENING_M / limit / pixel_rad)
        if whole < 1:
            break
        box = np.ones((2 * whole + 1, 2 * whole + 1), np.uint8)
        opened = cv2.dilate(cv2.erode(finite, box), box)
        out = np.where(opened <= limit, np.minimum(out, opened), out)
        limit *= _CLOSED_STEP
    return np.where(out >= _FAR, np.inf, out).astype(np.float32)


def _edges(
    front_m: Float32, closed_m: Float32, radius: Float32, margin: float, steepest: float
) -> tuple[Float32, Float32]:
    """Returns the distance (height, width) below which a point lies at an edge, 0 far from edges, and `closed_m`
    where what lies behind an edge begins beside it.

    An edge is where the distance leaps from a pixel to the next by more than a surface does. Its near side reaches
    beyond the outermost point by the radius of the discs, so points within that and the margin are at the edge, if they
    lie nearer than half of the leap. Behind it a pixel within the margin shows the near side as well.
    """
    height, width = front_m.shape
    finite = np.where(np.isfinite(front_m), front_m, _FAR)
    beside = cv2.dilate(finite, np.ones((3, 3), np.uint8))
    leaps = (finite < _FAR) & (beside > finite * (1.0 + _THICKNESS + 1.5 * steepest) + _THICKNESS_M)
    half = np.where(leaps, np.minimum(0.5 * (finite + beside), _HALF_OF_FAR * finite), 0.0).astype(np.float32)
    whole = np.rint(np.repeat(np.repeat(radius, _BLOCK, axis=0), _BLOCK, axis=1)[:height, :width] + margin)
    out = np.zeros((height, width), np.float32)
    for reach in np.unique(whole).astype(int).tolist():
        own = whole == reach
        out[own] = cv2.dilate(half, _disc(reach))[own]
    near = cv2.erode(np.where(leaps, finite, _FAR), _disc(round(margin)))
    return out, np.minimum(closed_m, near)


def _disc(radius: int) -> UInt8:
    size = 2 * radius + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def _stored(distance_m: npt.NDArray[np.floating]) -> UInt16:
    """Returns distances as they are stored; inf stands for any."""
    with np.errstate(divide="ignore"):
        steps = STEPS * np.log(np.maximum(distance_m, LEAST_M) / LEAST_M)
    return np.where(np.isfinite(distance_m), np.minimum(steps, UNKNOWN - 1), UNKNOWN).astype(np.uint16)


_CUBE_M: Final = 0.5
"""Edge of the cubes (m); they are anchored at the origin of the points."""
_LEAST_POINTS: Final = 8  # Fewest points of a plane.
_FLAT: Final = 0.1
"""Largest share of the variance that may lie across a plane: more is a shrub, or a corner."""

_LOW_RELIEF_M: Final = 0.08
"""Points whose heights vary by no more (m, 1 σ) and that lie in no plane are ground with a kerb: it lies level."""


def normals_of(point_m: npt.NDArray[np.floating]) -> Float32:
    """Returns unit normals (n, 3) of points (n, 3); NaN where those around lie in no plane and are not level."""
    if not len(point_m):
        return np.zeros((0, 3), np.float32)
    low = np.floor(point_m.min(axis=0) / _CUBE_M)
    size = (np.floor(point_m.max(axis=0) / _CUBE_M) - low).astype(np.int64) + 1
    number = np.zeros(len(point_m), np.int64)
    for k in (2, 1, 0):  # column by column: there may be millions of points
        number = number * size[k] + (np.floor(point_m[:, k] / _CUBE_M) - low[k]).astype(np.int64)
    _, which, count = np.unique(number, return_inverse=True, return_counts=True)
    del number
    which = which.astype(np.int32)
    off = []
    for k in range(3):
        middle = np.bincount(which, point_m[:, k], count.size) / count
        off.append((point_m[:, k] - middle[which]).astype(np.float32))
    spread = np.empty((count.size, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            spread[:, i, j] = spread[:, j, i] = np.bincount(which, off[i] * off[j], count.size)
    values, vectors = np.linalg.eigh(spread)
    flat = (count >= _LEAST_POINTS) & (values[:, 0] <= _FLAT * values[:, 1]) & (values[:, 1] > 0.0)
    level = (count >= _LEAST_POINTS) & (spread[:, 2, 2] <= _LOW_RELIEF_M**2 * count)
    normal = np.where(flat[:, None], vectors[:, :, 0], np.where(level[:, None], [0.0, 0.0, 1.0], np.nan))
    return normal.astype(np.float32)[which]
