"""A scene with the plainest ground there is, so that tests of edges do not depend on another ground filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.ndimage

from roadscan.assets import classes
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box, GroundModel, Scene


def simple_scene(returns: Returns, tile: Box, halo_m: float, drive: np.ndarray[Any, Any]) -> Scene:
    """The lowest return in cells of 0.5 m, opened over 3 m, is the ground; what stands 0.6 m above it is an object."""
    window = Box(tile.x_min_m - halo_m, tile.y_min_m - halo_m, tile.x_max_m + halo_m, tile.y_max_m + halo_m)
    inside = returns.at(window.holds(returns.x_m, returns.y_m))
    columns = int(np.ceil((window.x_max_m - window.x_min_m) / 0.5))
    rows = int(np.ceil((window.y_max_m - window.y_min_m) / 0.5))
    lowest = np.full((rows, columns), np.inf)
    row = ((inside.y_m - window.y_min_m) / 0.5).astype(int).clip(0, rows - 1)
    column = ((inside.x_m - window.x_min_m) / 0.5).astype(int).clip(0, columns - 1)
    np.minimum.at(lowest, (row, column), inside.height_m)
    seen = np.isfinite(lowest)
    near = scipy.ndimage.distance_transform_edt(~seen, return_indices=True)[1]
    filled = lowest[near[0], near[1]]
    opened = scipy.ndimage.grey_opening(filled, 9)
    ground = np.where(filled - opened > 0.5, opened, filled)
    model = GroundModel(window.x_min_m, window.y_min_m, 0.5, ground.astype(np.float32), seen)
    above = (inside.height_m - model.height_at(inside.x_m, inside.y_m)).astype(np.float32)
    code = np.where(above < 0.3, classes.GROUND, classes.UNCLASSIFIED).astype(np.uint8)
    return Scene(inside, tile, window, model, above, code, drive)
