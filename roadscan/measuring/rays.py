"""Rays of pixels: the way back through a lens."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.extras import cv2
from roadscan.pictures.views import Lens

Float64 = npt.NDArray[np.float64]

_ROUNDS, _SETTLED = 200, 1e-13
"""The inversion of the distortion ends after so many steps, or at a smaller change of the tangents."""
_INVERTED_PX: Final = 1e-3
"""Largest error of the inversion (pixels); a pixel beyond has no ray, as beyond the fold of the lens."""


def rays_of(lens: Lens, pixel: Float64) -> Float64:
    """Return unit vectors (m, 3) in camera axes (x right, y down, z ahead) of pixels (m, 2: u, v).

    NaN where the distortion has no inverse. Pixels count from the centre of the upper left one. Brown (1971) with the
    signs of OpenCV, or equirectangular (Snyder 1987, plate carrée).
    """
    pixel = np.ascontiguousarray(pixel, np.float64).reshape(-1, 2)
    fx, fy, cx, cy = lens.parameters[:4]
    if lens.is_around:
        longitude, latitude = (pixel[:, 0] - cx) / fx, (pixel[:, 1] - cy) / fy
        level = np.cos(latitude)
        return np.column_stack([np.sin(longitude) * level, np.sin(latitude), np.cos(longitude) * level])
    if not len(pixel):
        return np.zeros((0, 3))
    matrix, distortion = matrix_of(lens), lens.parameters[4:9]
    settled = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ROUNDS, _SETTLED)
    found = cv2.undistortPoints(pixel.reshape(-1, 1, 2), matrix, distortion, criteria=settled).reshape(-1, 2)
    ray = np.column_stack([found, np.ones(len(found))])
    back, _ = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), matrix, distortion)
    wrong = ~(np.linalg.norm(back.reshape(-1, 2) - pixel, axis=1) < _INVERTED_PX)
    wrong |= (found**2).sum(axis=1) >= lens.parameters[9]
    ray[wrong] = np.nan
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True), np.float64)


def pixels_of(lens: Lens, point: Float64) -> Float64:
    """Return pixels (m, 2: u, v) of points (m, 3) in camera axes; NaN behind the camera and beyond the lens's fold."""
    point = np.ascontiguousarray(point, np.float64).reshape(-1, 3)
    fx, fy, cx, cy = lens.parameters[:4]
    if lens.is_around:
        x, y, z = point.T
        return np.column_stack([fx * np.arctan2(x, z) + cx, fy * np.arctan2(y, np.hypot(x, z)) + cy])
    out = np.full((len(point), 2), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        square = (point[:, 0] ** 2 + point[:, 1] ** 2) / point[:, 2] ** 2
    ahead = (point[:, 2] > 0.0) & (square < lens.parameters[9])
    if ahead.any():
        found, _ = cv2.projectPoints(point[ahead], np.zeros(3), np.zeros(3), matrix_of(lens), lens.parameters[4:9])
        out[ahead] = found.reshape(-1, 2)
    return out


def ray_slopes(lens: Lens, pixel: Float64) -> Float64:
    """Return derivatives (m, 3, 2) of the unit vectors by u and v, over a pixel about each (m, 2)."""
    steps = 0.5 * np.eye(2)
    return np.stack([rays_of(lens, pixel + step) - rays_of(lens, pixel - step) for step in steps], axis=-1)


def matrix_of(lens: Lens) -> Float64:
    """Return the camera matrix (3, 3) of a perspective lens."""
    fx, fy, cx, cy = lens.parameters[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
