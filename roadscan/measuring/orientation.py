"""Orientations of pictures in the conventions that other programs use.

Camera axes are OpenCV's: x right, y down, z ahead. Image axes of photogrammetry are x right, y up, z backwards.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from roadscan.calibrate.resection import SENSOR_FROM_OPENCV
from roadscan.compute.array_types import Float64
from roadscan.core.frames import rph_from_rotation

_IMAGE_FROM_CAMERA: Final = np.diag([1.0, -1.0, -1.0])
"""Image axes of photogrammetry (right, up, backwards) from OpenCV's (right, down, ahead); its own inverse."""


def nearest_rotation(matrix: Float64) -> Float64:
    """Return the rotations (n, 3, 3) nearest to matrices that also scale (n, 3, 3). Polar decomposition by SVD."""
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ v, np.float64)


def omega_phi_kappa_deg(map_from_camera: Float64) -> Float64:
    """Return ω, φ, κ (n, 3; degrees) of rotations (n, 3, 3) from camera axes to easting, northing, height.

    The image axes are turned into those of the map by Rx(ω) · Ry(φ) · Rz(κ) (Kraus 2007, Photogrammetry, B 3.3).
    """
    r = map_from_camera @ _IMAGE_FROM_CAMERA
    omega, phi = np.arctan2(-r[:, 1, 2], r[:, 2, 2]), np.arcsin(np.clip(r[:, 0, 2], -1.0, 1.0))
    kappa = np.arctan2(-r[:, 0, 1], r[:, 0, 0])
    out: Float64 = np.degrees(np.stack([omega, phi, kappa], axis=-1))
    return out


def yaw_pitch_roll_deg(ned_from_camera: Float64) -> Float64:
    """Return yaw, pitch, roll (n, 3; degrees) of the optical axes of rotations (n, 3, 3) from camera axes to NED.

    Yaw is clockwise from true north, from 0 to 360; pitch is upwards from the horizon; roll is about the optical axis,
    positive where the picture's right side is lowered.
    """
    roll, pitch, yaw = rph_from_rotation(ned_from_camera @ SENSOR_FROM_OPENCV.T)
    return np.degrees(np.stack([yaw, pitch, roll], axis=-1))
