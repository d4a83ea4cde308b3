"""Rays of pixels, pixels of points, and how these change with points and with the lens.

Axes are OpenCV's (x right, y down, z along the optical axis); pixels count from the centre of the upper left one. A
perspective lens distorts as Brown (1971) has it, with OpenCV's signs; a picture of 360° has even steps of longitude and
latitude (Snyder 1987, plate carrée).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.extras import cv2
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import Interior
from roadscan.pictures.kernels.lens import (
    AROUND,
    FOLD,
    HEIGHT,
    ROW_ROUNDS,
    ROW_SETTLED_PX,
    ROW_SHIFT,
    ROW_TURN,
    WIDTH,
)
from roadscan.pictures.kernels.lens import (
    PARAMETERS as NUMBERS,
)
from roadscan.store.small_tables import read_small
from roadscan.store.store import Store

PARAMETERS: Final = ("focal_x_px", "focal_y_px", "centre_x_px", "centre_y_px", "k1", "k2", "p1", "p2", "k3")
"""The parameters of a lens in the order of its derivatives."""
_ROUNDS, _SETTLED = 200, 1e-13
"""The inversion of the distortion ends after so many steps, or at a smaller change of the tangents."""
_INVERTED_PX: Final = 1e-3
"""Largest error of the inversion (pixels); a pixel beyond has no ray, as beyond the fold of the lens."""
_OF_SHIFT, _OF_LENS = slice(3, 6), slice(6, 15)
"""Columns of OpenCV's derivatives: by a shift of the points, and by `PARAMETERS`."""


def rays_of(lens: Lens, pixel: Float64) -> Float64:
    """Returns unit vectors (m, 3) of pixels (m, 2: u, v); NaN where the distortion has no inverse."""
    pixel = np.ascontiguousarray(pixel, np.float64).reshape(-1, 2)
    if lens.is_around:
        longitude, latitude = ((pixel - lens.parameters[2:4]) / lens.parameters[:2]).T
        level = np.cos(latitude)
        return np.column_stack([np.sin(longitude) * level, np.sin(latitude), np.cos(longitude) * level])
    found = straightened(lens, pixel)
    turn = lens.row_motion[1]
    ray = np.column_stack([found, np.ones(len(found))])
    wrong = ~(np.linalg.norm(projected(lens, ray) - pixel, axis=1) < _INVERTED_PX)
    wrong |= (found**2).sum(axis=1) >= lens.fold
    ray[wrong] = np.nan
    if turn.any():
        ray += _rows(lens, pixel[:, 1])[:, None] * np.cross(turn, ray)
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True), np.float64)


def eye_shifts_m(lens: Lens, pixel: Float64) -> Float64:
    """Returns where the camera was (m, 3; m, its axes) when the rows of pixels (m, 2) were exposed, from where it was
    at the middle row.
    """
    return np.asarray(_rows(lens, np.reshape(pixel, (-1, 2))[:, 1])[:, None] * lens.row_motion[0])


def _rows(lens: Lens, v_px: Float64) -> Float64:
    """Returns rows (m,) from the middle one."""
    return np.asarray(v_px - 0.5 * (lens.size_px[1] - 1))


def ray_slopes(lens: Lens, pixel: Float64) -> Float64:
    """Returns derivatives (m, 3, 2) of the unit vectors by u and v, over a pixel about each (m, 2)."""
    steps = 0.5 * np.eye(2)
    return np.stack([rays_of(lens, pixel + step) - rays_of(lens, pixel - step) for step in steps], axis=-1)


def pixels_of(lens: Lens, point: Float64) -> Float64:
    """Returns pixels (m, 2: u, v) of points (m, 3); NaN behind the camera and beyond the lens's fold."""
    point = np.ascontiguousarray(point, np.float64).reshape(-1, 3)
    pixel = _still_pixels_of(lens, point)
    shift, turn = lens.row_motion
    for _ in range(ROW_ROUNDS if shift.any() or turn.any() else 0):
        rows = _rows(lens, pixel[:, 1])[:, None]
        before, pixel = pixel, _still_pixels_of(lens, point - rows * (shift + np.cross(turn, point)))
        if not (np.abs(pixel - before) > ROW_SETTLED_PX).any():
            break
    return pixel


def _still_pixels_of(lens: Lens, point: Float64) -> Float64:
    """Returns pixels (m, 2) of points (m, 3) in the axes that the camera has when their rows are exposed."""
    if lens.is_around:
        return lens.parameters[:2] * _angles(point) + lens.parameters[2:4]
    out = np.full((len(point), 2), np.nan)
    ahead = _is_seen(lens, point)
    out[ahead] = projected(lens, point[ahead])
    return out


def derivatives(lens: Lens, point: Float64) -> tuple[Float64, Float64, Float64]:
    """Returns pixels (m, 2) of points (m, 3), and their derivatives by the point (m, 2, 3) and by `PARAMETERS`
    (m, 2, 9); NaN behind the camera and beyond the lens's fold.
    """
    point = np.ascontiguousarray(point, np.float64).reshape(-1, 3)
    if lens.is_around:
        return _derivatives_around(lens, point)
    pixel, by_point = np.full((len(point), 2), np.nan), np.full((len(point), 2, 3), np.nan)
    by_lens = np.full((len(point), 2, len(PARAMETERS)), np.nan)
    ahead = _is_seen(lens, point)
    if ahead.any():
        found, slopes = cv2.projectPoints(point[ahead], *_NO_TURN, matrix_of(lens), lens.parameters[4:9])
        slopes = np.asarray(slopes).reshape(-1, 2, slopes.shape[1])
        pixel[ahead], by_point[ahead] = found.reshape(-1, 2), slopes[:, :, _OF_SHIFT]
        by_lens[ahead] = slopes[:, :, _OF_LENS]
    return pixel, by_point, by_lens


def straightened(lens: Lens, pixel: Float64) -> Float64:
    """Returns tangents (m, 2) of pixels (m, 2) of a perspective lens, where its distortion has an inverse."""
    if not len(pixel):
        return np.zeros((0, 2))
    settled = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ROUNDS, _SETTLED)
    flat = np.ascontiguousarray(pixel, np.float64).reshape(-1, 1, 2)
    found = cv2.undistortPoints(flat, matrix_of(lens), lens.parameters[4:9].copy(), criteria=settled)
    return np.asarray(found, np.float64).reshape(-1, 2)


def projected(lens: Lens, point: Float64) -> Float64:
    """Returns pixels (m, 2) of points (m, 3) of a perspective lens, which lie ahead."""
    if not len(point):
        return np.zeros((0, 2))
    ahead = np.ascontiguousarray(point, np.float64).reshape(-1, 1, 3)
    found, _ = cv2.projectPoints(ahead, *_NO_TURN, matrix_of(lens), lens.parameters[4:9].copy())
    return np.asarray(found, np.float64).reshape(-1, 2)


def matrix_of(lens: Lens) -> Float64:
    """Returns the camera matrix (3, 3) of a perspective lens."""
    fx, fy, cx, cy = lens.parameters[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


_NO_TURN: Final = (np.zeros(3), np.zeros(3))  # Points are in the camera's axes already: no turn, no shift.


def _is_seen(lens: Lens, point: Float64) -> npt.NDArray[np.bool_]:
    """Returns a mask (m,) of the points that lie ahead, before the fold of the lens."""
    with np.errstate(divide="ignore", invalid="ignore"):
        square = (point[:, 0] ** 2 + point[:, 1] ** 2) / point[:, 2] ** 2
    return np.asarray((point[:, 2] > 0.0) & (square < lens.fold))


def _angles(point: Float64) -> Float64:
    """Returns longitude and latitude (m, 2) of points (m, 3) around the camera."""
    x, y, z = point.T
    return np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))])


def _derivatives_around(lens: Lens, point: Float64) -> tuple[Float64, Float64, Float64]:
    """Returns the same of a picture of 360°, which has no distortion."""
    x, y, z = point.T
    level2 = x * x + z * z
    level, whole2 = np.sqrt(level2), level2 + y * y
    by_point, by_lens = np.zeros((len(point), 2, 3)), np.zeros((len(point), 2, len(PARAMETERS)))
    by_point[:, 0, 0], by_point[:, 0, 2] = z / level2, -x / level2
    by_point[:, 1, 0], by_point[:, 1, 2] = -x * y / (level * whole2), -z * y / (level * whole2)
    by_point[:, 1, 1] = level / whole2
    angles = _angles(point)
    by_lens[:, 0, 0], by_lens[:, 1, 1] = angles.T
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    focal, centre = lens.parameters[:2], lens.parameters[2:4]
    return focal * angles + centre, focal[:, None] * by_point, by_lens


TABLE: Final = "camera_corrections"
COLUMNS: Final = (*PARAMETERS, "clock_s", "line_time_s")
"""Columns of the table, in the order of the values."""


JOINT_TABLE: Final = "camera_covariances"
JOINT: Final = 21
"""Errors of a picture that are known jointly: 6 of its pose, 6 of the mounting, 9 of the lens (`PARAMETERS`)."""


_POSE: Final = slice(0, 6)
"""Errors of the pose among those of a picture: each epoch has its own."""
_REST: Final = slice(6, JOINT)
"""Errors of mounting and lens among them: all pictures of a camera share these."""


@dataclass(frozen=True, eq=False)
class JointCovariances:
    """What an adjustment found of the errors of a camera's pictures in a run, at k epochs."""

    epochs_gps_ns: Int64
    """(k,)"""
    covariance: Float64
    """(k, 21, 21)"""
    later: tuple[Float64, ...] = ()
    """(k) of arrays (l, 6, 6): the pose (rows) with those of the next epochs (columns)."""

    def at(self, epochs_gps_ns: Int64) -> Float64:
        """Returns covariances (n, 21, 21); they change linearly in between."""
        before, share = self._place(epochs_gps_ns)
        after, part = np.minimum(before + 1, self.epochs_gps_ns.size - 1), share[:, None, None]
        return np.asarray((1.0 - part) * self.covariance[before] + part * self.covariance[after])

    def between(self, first_gps_ns: int, second_gps_ns: int, fading_s: float) -> Float64 | None:
        """Returns the covariance (6, 6) of the pose at one epoch (rows) with that at another; None where none is told.

        Errors change from epoch to epoch as a process with independent steps does, so that the covariance of a pose
        with itself is that of :meth:`at`. Beyond the last epoch that is told, what is not due to mounting and lens
        fades with a time constant.
        """
        if first_gps_ns > second_gps_ns:
            found = self.between(second_gps_ns, first_gps_ns, fading_s)
            return None if found is None else found.T
        if not self.later:
            return None
        places, shares = self._place(np.array([first_gps_ns, second_gps_ns]))
        (a, b), (s, t) = places.tolist(), shares.tolist()
        reach = a + min(len(self.later[a]), len(self.later[min(a + 1, len(self.later) - 1)]) + 1)
        if b + (t > 0.0) <= reach:
            found = sum(
                one * other * self._knots(a + i, b + j)
                for i, one in ((0, 1.0 - s), (1, s)) if one
                for j, other in ((0, 1.0 - t), (1, t)) if other
            )  # fmt: skip
            if a == b and s > 0.0:
                step = self._knots(a, a) + self._knots(a + 1, a + 1) - self._knots(a, a + 1) - self._knots(a + 1, a)
                found = found + (min(s, t) - s * t) * step
            return np.asarray(found)
        last = int(self.epochs_gps_ns[reach])
        near = self.between(first_gps_ns, last, fading_s)
        one, middle, other = self.at(np.array([first_gps_ns, last, second_gps_ns]))
        by_rest = one[_POSE, _REST] @ np.linalg.pinv(one[_REST, _REST], hermitian=True)
        fade = np.exp(-(second_gps_ns - last) / NS_PER_S / fading_s)
        return np.asarray(by_rest @ other[_REST, _POSE] + fade * (near - by_rest @ middle[_REST, _POSE]))

    def _place(self, epochs_gps_ns: Int64) -> tuple[Int64, Float64]:
        """Returns the number of the epoch before each (n,), and the share of the way to the next one, 0 to 1."""
        since, known = ((e - self.epochs_gps_ns[0]).astype(np.float64) for e in (epochs_gps_ns, self.epochs_gps_ns))
        at = np.interp(since, known, np.arange(known.size, dtype=np.float64))
        before = np.minimum(at.astype(np.int64), known.size - 1)
        return before, at - before

    def _knots(self, a: int, b: int) -> Float64:
        """Returns the covariance (6, 6) of the poses at two of the epochs."""
        if a > b:
            return self._knots(b, a).T
        return self.covariance[a, _POSE, _POSE] if a == b else self.later[a][b - a - 1]


def load_joint_covariances(store: Store, run: str, sensor: str) -> JointCovariances | None:
    """Returns what an adjustment found for a camera in a run; None without."""
    table = read_small(store, JOINT_TABLE)
    rows = [] if table is None else [r for r in table.to_pylist() if (r["run"], r["sensor"]) == (run, sensor)]
    if not rows:
        return None
    upper = np.triu_indices(JOINT)
    found = np.zeros((len(rows), JOINT, JOINT))
    found[:, upper[0], upper[1]] = found[:, upper[1], upper[0]] = [row["covariance"] for row in rows]
    told = all(row.get("later") is not None for row in rows)
    later = tuple(np.array(row["later"]).reshape(-1, 6, 6) for row in rows) if told else ()
    return JointCovariances(np.array([row["epoch_gps_ns"] for row in rows], np.int64), found, later)


def load_camera_changes(store: Store) -> Mapping[str, Float64]:
    """Returns what is added to the cameras (11,), `COLUMNS`, by sensor."""
    table = read_small(store, TABLE)
    rows = [] if table is None else table.to_pylist()
    return {row["sensor"]: np.array([float(row[name]) for name in COLUMNS]) for row in rows}


def changed(interior: Interior, change: Float64 | None) -> Interior:
    """Returns an interior orientation with a change (11,) of its lens; clock and row time are applied to epochs."""
    if change is None or not np.any(change):
        return interior
    stated = [*interior.focal_px, *interior.principal_px, *interior.distortion]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (np.array(stated) + change[: len(PARAMETERS)]).tolist()
    update = {"focal_px": (fx, fy), "principal_px": (cx, cy), "distortion": (k1, k2, p1, p2, k3)}
    return interior.model_copy(update=update)


def row_ns(interior: Interior, change: Float64 | None) -> float:
    """Returns the time (ns) from the exposure of a row to that of the row below; 0 of a global shutter."""
    found = 0.0 if change is None else float(change[COLUMNS.index("line_time_s")])
    return 1e3 * interior.line_time_us + found * NS_PER_S


def clock_ns(change: Float64 | None) -> int:
    """Returns what is added to the stamps of a camera's pictures (ns)."""
    return 0 if change is None else round(float(change[COLUMNS.index("clock_s")]) * NS_PER_S)


_STILL: Final = (0.0,) * (NUMBERS - ROW_SHIFT)  # A camera that does not move from row to row.


@dataclass(frozen=True)
class Lens:
    """Interior orientation of a camera, and the parts of its pictures that show the vehicle."""

    parameters: Float64
    """(19,) as the kernel takes them."""
    own_vehicle_px: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Polygons of pixels (u, v) that show the survey vehicle."""

    @classmethod
    def of(cls, interior: Interior, own_vehicle_px: tuple[tuple[tuple[float, float], ...], ...] = ()) -> Self:
        """Returns the lens from the rig's values."""
        k1, k2, _, _, k3 = interior.distortion
        size = float(interior.width_px), float(interior.height_px)
        around = float(interior.model == "equirectangular")
        lens = [*interior.focal_px, *interior.principal_px, *interior.distortion, _fold(k1, k2, k3), *size, around]
        return cls(np.array([*lens, *_STILL]), own_vehicle_px)

    @property
    def size_px(self) -> tuple[int, int]:
        """Returns width and height of the pictures."""
        return round(float(self.parameters[WIDTH])), round(float(self.parameters[HEIGHT]))

    @property
    def fold(self) -> float:
        """Returns the square of the tangent from which on the distortion is ambiguous."""
        return float(self.parameters[FOLD])

    @property
    def row_motion(self) -> tuple[Float64, Float64]:
        """Returns way (3,; m) and turn (3,; rad) of the camera from row to row, along its axes, in one picture of a
        rolling shutter; 0 elsewhere.
        """
        return self.parameters[ROW_SHIFT:ROW_TURN], self.parameters[ROW_TURN:]

    def moving(self, row_motion: Float64) -> Lens:
        """Returns the lens in a picture during which the camera moved by so much (6,) from row to row."""
        return replace(self, parameters=np.concatenate([self.parameters[:ROW_SHIFT], row_motion]))

    @property
    def is_around(self) -> bool:
        """Returns True for pictures of 360°."""
        return bool(self.parameters[AROUND])

    @functools.cached_property
    def hidden(self) -> Bool:
        """Mask (height, width) of pixels that show the vehicle; (0, 0) where none does. Computed on demand."""
        if not self.own_vehicle_px:
            return np.zeros((0, 0), np.bool_)
        drawn = np.zeros(self.size_px[::-1], np.uint8)
        for polygon in self.own_vehicle_px:
            cv2.fillPoly(drawn, [np.rint(polygon).astype(np.int32)], 1)
        return drawn.astype(np.bool_)


def _fold(k1: float, k2: float, k3: float) -> float:
    """Returns the square of the tangent at which the distorted radius stops growing: the model is ambiguous beyond."""
    roots = np.polynomial.Polynomial([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3]).trim().roots()
    real = roots[np.abs(roots.imag) < 1e-9].real
    return float(min(real[real > 0.0], default=np.inf))
