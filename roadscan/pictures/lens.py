"""Rays of pixels, pixels of points, and how these change with points and with the lens.

Axes are OpenCV's (x right, y down, z along the optical axis); pixels count from the centre of the upper left one. A
perspective lens distorts as Brown (1971) has it, with OpenCV's signs; a picture of 360° has even steps of longitude and
latitude (Snyder 1987, plate carrée).
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.extras import cv2
from roadscan.pictures.kernels.lens import ROW_ROUNDS, ROW_SETTLED_PX
from roadscan.pictures.views import Lens

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
