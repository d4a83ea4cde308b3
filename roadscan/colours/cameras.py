"""Pictures as seen from the map: the place and the axes of each, in coordinates of the map."""

from __future__ import annotations

from typing import Final

import numpy as np

from roadscan.colours.kernels.looks import Camera
from roadscan.compute.array_types import Float64
from roadscan.pictures.placed import Pictures

_STEP_M: Final = 20.0
"""Distance (m) over which the turn from the map to the world is taken. The map is straight to 1 mm within 50 m: 0.02
pixels."""


def eyes_m(pictures: Pictures) -> Float64:
    """Returns easting, northing and height (n, 3) of the cameras (m)."""
    out = np.empty((len(pictures), 3))
    for number, world in enumerate(pictures.worlds):
        own = pictures.views.world == number
        if own.any():
            out[own] = pictures.map.map_from_world(world, pictures.views.eye_world_m[own])
    return out


def cameras_of(pictures: Pictures, origin_m: Float64) -> list[Camera]:
    """Returns the pictures as kernels take them; their places count from `origin_m` (3,) in the map."""
    if not len(pictures):
        return []
    views, eyes = pictures.views, eyes_m(pictures)
    return [
        Camera(eyes[n] - origin_m, _axes(pictures, n, eyes[n]), views.lens_of(n).parameters)
        for n in range(len(pictures))
    ]


def _axes(pictures: Pictures, number: int, eye_m: Float64) -> Float64:
    """Returns camera axes (3, 3) from the map: the camera's from the world's, and the world's from the map's there."""
    around = np.concatenate([eye_m + _STEP_M * np.eye(3), eye_m - _STEP_M * np.eye(3)])
    world = pictures.map.world_from_map(pictures.worlds[pictures.views.world[number]], around)
    turn = ((world[:3] - world[3:]) / (2.0 * _STEP_M)).T
    return np.ascontiguousarray(pictures.views.opencv_from_world[number] @ turn)
