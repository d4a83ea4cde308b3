"""Outlines of plates in space, by their shapes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.compute.ways import way_along

_POINTS: Final = 48  # Points of an outline.


def plate_outline(shape: str, width_m: float, height_m: float) -> Float64:
    """Returns points (48, 2: right, up) around the outline of a plate about the middle of its bounding box (m).

    A shape that is not known is taken for a rectangle.
    """
    corners = _CORNERS.get(shape, _CORNERS["rectangle"]) * [width_m, height_m]
    if shape == "round":
        return corners
    closed = np.vstack([corners, corners[:1]])
    along = way_along(closed)
    at = np.arange(_POINTS) * along[-1] / _POINTS
    return np.column_stack([np.interp(at, along, closed[:, k]) for k in (0, 1)])


def on_plate(plane: Float64, middle_m: Float64, facing_deg: float, tilt_deg: float) -> Float64:
    """Places (n, 3: easting, northing, height) of points (n, 2: right as seen from the front, up) on a plate."""
    right, up, _ = plate_axes(facing_deg, tilt_deg)
    return np.asarray(middle_m + plane[:, :1] * right + plane[:, 1:] * up)


def plate_axes(facing_deg: float, tilt_deg: float) -> tuple[Float64, Float64, Float64]:
    """Returns unit vectors to the right as seen from the front, upwards on the plate, and out of its front."""
    a, t = math.radians(facing_deg), math.radians(tilt_deg)
    normal = np.array([math.sin(a) * math.cos(t), math.cos(a) * math.cos(t), math.sin(t)])
    right = np.array([-math.cos(a), math.sin(a), 0.0])
    return right, np.cross(normal, right), normal


def _polygon(count: int, first_deg: float) -> Float64:
    """Returns the corners of a regular polygon in a bounding box of 1 by 1."""
    angle = np.deg2rad(first_deg + 360.0 / count * np.arange(count))
    corners = np.column_stack([np.cos(angle), np.sin(angle)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    return np.asarray((corners - (low + high) / 2) / (high - low))


# Corners of plates, in shares of their width and height from the middle.
_CORNERS: Final[Mapping[str, Float64]] = {
    "rectangle": np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]),
    "round": _polygon(_POINTS, 0.0),
    "octagon": _polygon(8, 22.5),
    "diamond": _polygon(4, 0.0),
    "triangle": _polygon(3, 90.0),
    "triangle down": _polygon(3, 270.0),
}
SHAPES: Final[Sequence[str]] = tuple(_CORNERS)
"""Shapes that pictures are compared with."""
