"""A camera's lens on arrays: rays of pixels, pixels of points, and how these change with points and parameters.

Axes are OpenCV's (x right, y down, z along the optical axis). A perspective lens distorts as Brown (1971) has it, with
OpenCV's signs; a picture of 360° has even steps of longitude and latitude (Snyder 1987, plate carrée).
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.camera import Interior

Float64 = npt.NDArray[np.float64]

PARAMETERS: Final = ("focal_x_px", "focal_y_px", "centre_x_px", "centre_y_px", "k1", "k2", "p1", "p2", "k3")
"""The parameters of a lens in the order of its derivatives."""
_STEPS: Final = 20  # Steps of Newton's method towards an undistorted place; 6 suffice within 60° of the axis.
_WITHIN: Final = 1e-12  # Change of a tangent at which they end.


def parameters(interior: Interior) -> Float64:
    """Returns the parameters (9,) of a lens, `PARAMETERS`."""
    return np.array([*interior.focal_px, *interior.principal_px, *interior.distortion])


def with_parameters(interior: Interior, values: Float64) -> Interior:
    """Returns a lens with other parameters (9,)."""
    fx, fy, cx, cy, *distortion = (float(v) for v in values)
    k1, k2, p1, p2, k3 = distortion
    update = {"focal_px": (fx, fy), "principal_px": (cx, cy), "distortion": (k1, k2, p1, p2, k3)}
    return interior.model_copy(update=update)


def rays(interior: Interior, pixel: Float64) -> Float64:
    """Returns unit vectors (n, 3), OpenCV's axes, of pixels (n, 2: u, v); NaN where the lens has no ray."""
    bent = (pixel - interior.principal_px) / np.array(interior.focal_px)
    if interior.model == "equirectangular":
        turn, dip = bent.T
        return np.stack([np.cos(dip) * np.sin(turn), np.sin(dip), np.cos(dip) * np.cos(turn)], axis=-1)
    straight = bent.copy()
    for _ in range(_STEPS):
        found, slope = _distorted(interior, straight)
        away = found - bent
        area = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
        step = np.stack(
            [
                (slope[:, 1, 1] * away[:, 0] - slope[:, 0, 1] * away[:, 1]) / area,
                (slope[:, 0, 0] * away[:, 1] - slope[:, 1, 0] * away[:, 0]) / area,
            ],
            axis=-1,
        )
        straight = straight - step
        if np.nanmax(np.abs(step), initial=0.0) < _WITHIN:
            break
    folded = (np.abs(_distorted(interior, straight)[0] - bent) > 1e-6).any(axis=1)
    straight[folded] = np.nan
    ray = np.column_stack([straight, np.ones(len(straight))])
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def projected(interior: Interior, point: Float64) -> Float64:
    """Returns pixels (n, 2: u, v) of points (n, 3), OpenCV's axes; NaN of points that are not in front of the lens."""
    return derivatives(interior, point)[0]


def derivatives(interior: Interior, point: Float64) -> tuple[Float64, Float64, Float64]:
    """Returns pixels (n, 2) of points (n, 3), and their derivatives by the point (n, 2, 3) and by `PARAMETERS`
    (n, 2, 9).
    """
    focal = np.array(interior.focal_px)
    if interior.model == "equirectangular":
        bent, by_point = _angles(point)
        by_lens = np.zeros((len(point), 2, len(PARAMETERS)))
    else:
        ahead = np.where(point[:, 2] > 0.0, point[:, 2], np.nan)
        straight = point[:, :2] / ahead[:, None]
        bent, slope = _distorted(interior, straight)
        by_straight = np.zeros((len(point), 2, 3))
        by_straight[:, 0, 0] = by_straight[:, 1, 1] = 1.0 / ahead
        by_straight[:, :, 2] = -straight / ahead[:, None]
        by_point = slope @ by_straight
        by_lens = _by_distortion(straight)
    by_lens[:, :, 4:] *= focal[:, None]
    by_lens[:, 0, 0], by_lens[:, 1, 1] = bent.T
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    return focal * bent + interior.principal_px, focal[:, None] * by_point, by_lens


def _distorted(interior: Interior, straight: Float64) -> tuple[Float64, Float64]:
    """Returns distorted tangents (n, 2) of straight ones, and their derivatives (n, 2, 2)."""
    k1, k2, p1, p2, k3 = interior.distortion
    x, y = straight.T
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    grows = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    across = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    down = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    bent = np.stack([across, down], axis=-1)
    slope = np.empty((len(straight), 2, 2))
    slope[:, 0, 0] = radial + x * x * grows + 2.0 * p1 * y + 6.0 * p2 * x
    slope[:, 0, 1] = slope[:, 1, 0] = x * y * grows + 2.0 * p1 * x + 2.0 * p2 * y
    slope[:, 1, 1] = radial + y * y * grows + 6.0 * p1 * y + 2.0 * p2 * x
    return bent, slope


def _by_distortion(straight: Float64) -> Float64:
    """Returns derivatives (n, 2, 9) of distorted tangents by the lens; those of focal length and centre are 0."""
    x, y = straight.T
    r2 = x * x + y * y
    found = np.zeros((len(straight), 2, len(PARAMETERS)))
    found[:, :, 4] = r2[:, None] * straight
    found[:, :, 5] = (r2**2)[:, None] * straight
    found[:, :, 8] = (r2**3)[:, None] * straight
    found[:, 0, 6], found[:, 1, 6] = 2.0 * x * y, r2 + 2.0 * y * y
    found[:, 0, 7], found[:, 1, 7] = r2 + 2.0 * x * x, 2.0 * x * y
    return found


def _angles(point: Float64) -> tuple[Float64, Float64]:
    """Returns longitude and latitude (n, 2) of points around the camera, and their derivatives (n, 2, 3)."""
    x, y, z = point.T
    level2 = x * x + z * z
    level, whole2 = np.sqrt(level2), level2 + y * y
    by_point = np.zeros((len(point), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = z / level2, -x / level2
    by_point[:, 1, 0], by_point[:, 1, 2] = -x * y / (level * whole2), -z * y / (level * whole2)
    by_point[:, 1, 1] = level / whole2
    return np.stack([np.arctan2(x, z), np.arctan2(y, level)], axis=-1), by_point
