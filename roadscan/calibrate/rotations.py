"""Small rotations as vectors: exponential, logarithm and their derivatives, for stacks of any shape."""

from __future__ import annotations

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.frames import quaternion_from_rotation


def cross_matrix(vector: Float64) -> Float64:
    """Return (…, 3, 3) with cross_matrix(v) @ w = v × w, of vectors (…, 3)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def exponential(vector: Float64) -> Float64:
    """Return rotation matrices (…, 3, 3) of rotation vectors (…, 3), rad. Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    turn = cross_matrix(vector)
    rotation: Float64 = (
        np.eye(3) + np.sinc(angle / np.pi) * turn + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * turn @ turn
    )
    return rotation


def logarithm(rotation: Float64) -> Float64:
    """Return rotation vectors (…, 3), rad, of rotation matrices (…, 3, 3), the shorter way round."""
    quaternion = quaternion_from_rotation(rotation)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    small = sine < 1e-12
    scale = np.where(small, 2.0, 2.0 * np.arctan2(sine, quaternion[..., :1]) / np.where(small, 1.0, sine))
    vector: Float64 = scale * quaternion[..., 1:]
    return vector


def left_jacobian(vector: Float64) -> Float64:
    """Return J (3, 3) with exp(v + dv) ≈ exp(J dv) exp(v), for a vector (3,) of less than a turn.

    Barfoot (2017), State Estimation for Robotics, eq. 7.77a; J(−v) is the right Jacobian.
    """
    angle = float(np.linalg.norm(vector))
    turn = cross_matrix(vector)
    if angle < 1e-4:
        return np.asarray(np.eye(3) + 0.5 * turn + turn @ turn / 6.0)
    first = (1.0 - np.cos(angle)) / angle**2
    second = (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * turn + second * turn @ turn)
