"""Frames and rotations.

Sensor → body (x forward, y right, z down) → local level (north-east-down) → ECEF.
Matrices read target-from-source: ``ecef_from_body`` turns body vectors into ECEF.
Quaternions are scalar first (w, x, y, z).
"""

from __future__ import annotations

from itertools import permutations
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError

Float64 = npt.NDArray[np.float64]

DIRECTIONS: Final = {"f": "forward", "r": "right", "d": "down", "b": "back", "l": "left", "u": "up"}
"""Words for the letters that name axes."""

_UNIT: Final = {**dict(zip("frd", np.eye(3), strict=True)), **dict(zip("blu", -np.eye(3), strict=True))}  # body axes


def _right_handed() -> dict[str, Float64]:
    """Return the right-handed rotations whose columns are body directions, by their three letters."""
    every = {"".join(letters): np.column_stack([_UNIT[c] for c in letters]) for letters in permutations(_UNIT, 3)}
    return {axes: matrix + 0.0 for axes, matrix in every.items() if np.linalg.det(matrix) > 0.5}  # avoids −0


BODY_FROM_AXES: Final[dict[str, Float64]] = _right_handed()
"""Body (forward, right, down) from the 24 axis-aligned mountings; the letters say where x, y, z point."""

ENU_FROM_NED: Final[Float64] = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # its own inverse


def body_from_axes(axes: str) -> Float64:
    """(3, 3) rotation from maker's axes `axes` (such as ``"flu"``) to body."""
    if axes not in BODY_FROM_AXES:
        raise ConfigError(f"axes '{axes}'", expected="one of " + ", ".join(BODY_FROM_AXES))
    return BODY_FROM_AXES[axes]


def rotation_from_rph(roll_rad: npt.ArrayLike, pitch_rad: npt.ArrayLike, heading_rad: npt.ArrayLike) -> Float64:
    """Level (north-east-down) from body, Z-Y-X order.

    R = Rz(heading) · Ry(pitch) · Rx(roll); heading is clockwise from north.

    Parameters
    ----------
    roll_rad, pitch_rad, heading_rad : broadcastable to (n,), radians.

    Returns
    -------
    (n, 3, 3) float64, or (3, 3) for scalars. Groves (2013), eq. 2.22, transposed.
    """
    roll, pitch, heading = np.broadcast_arrays(
        *(np.asarray(a, dtype=np.float64) for a in (roll_rad, pitch_rad, heading_rad))
    )
    cr, sr, cp, sp, ch, sh = (
        f(a) for a in (roll, pitch, heading) for f in (np.cos, np.sin)
    )  # fmt: skip
    rows = [
        [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
        [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rph_from_rotation(level_from_body: Float64) -> tuple[Float64, Float64, Float64]:
    """Return roll, pitch, heading (rad, heading in [0, 2π)) of (…, 3, 3) north-east-down-from-body rotations."""
    r = level_from_body
    roll = np.arctan2(r[..., 2, 1], r[..., 2, 2])
    pitch = -np.arcsin(np.clip(r[..., 2, 0], -1.0, 1.0))
    heading = np.mod(np.arctan2(r[..., 1, 0], r[..., 0, 0]), 2 * np.pi)
    # The remainder of a tiny negative angle rounds up to the full turn itself.
    return roll, pitch, np.where(heading < 2 * np.pi, heading, 0.0)


def ecef_from_ned(latitude_rad: npt.ArrayLike, longitude_rad: npt.ArrayLike) -> Float64:
    """ECEF from north-east-down at a geodetic position: (n, 3, 3), or (3, 3) for scalars.

    Groves (2013), eq. 2.150, transposed; the paper's equation 3 (Mandli, Nagarajan and others
    2016, Sensors 16, 367) writes the same with east-north-up columns.
    """
    lat, lon = np.broadcast_arrays(
        np.asarray(latitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64)
    )
    sa, ca, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    rows = [
        [-sa * co, -so, -ca * co],
        [-sa * so, co, -ca * so],
        [ca, np.zeros_like(ca), -sa],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def quaternion_from_rotation(rotation: Float64) -> Float64:
    """Unit quaternions (…, 4), w ≥ 0, of rotation matrices (…, 3, 3). Shepperd (1978)."""
    r = np.asarray(rotation, dtype=np.float64)
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    diagonal = np.stack([trace, r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]], axis=-1)
    squares = 1.0 + 2.0 * diagonal
    squares[..., 0] = 1.0 + trace
    squares[..., 1:] -= trace[..., None]
    # Row k of `candidates` is the quaternion scaled by its component k.
    yz, zy = r[..., 2, 1], r[..., 1, 2]
    xz, zx = r[..., 0, 2], r[..., 2, 0]
    xy, yx = r[..., 1, 0], r[..., 0, 1]
    candidates = np.stack(
        [
            np.stack([squares[..., 0], yz - zy, xz - zx, xy - yx], axis=-1),
            np.stack([yz - zy, squares[..., 1], xy + yx, xz + zx], axis=-1),
            np.stack([xz - zx, xy + yx, squares[..., 2], yz + zy], axis=-1),
            np.stack([xy - yx, xz + zx, yz + zy, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)
    chosen = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    chosen = chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
    positive: Float64 = np.where(chosen[..., :1] < 0, -chosen, chosen)
    return positive


def rotation_from_quaternion(quaternion: Float64) -> Float64:
    """Rotation matrices (…, 3, 3) of quaternions (…, 4), scalar first, any length but zero."""
    q = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


SENSOR_FROM_OPENCV: Final[Float64] = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation from OpenCV's axes (right, down, forward) to sensor axes (forward, right, down)."""
