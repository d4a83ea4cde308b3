"""Scatter of the returns above the ground in cubes: linear, planar or in all directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.grid import grid_over
from roadscan.assets.kernels import voxels
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box

EDGE_M: Final = 0.3
"""Edge of a cube (m); features are those of three by three by three cubes."""
LAYERS: Final = 64
"""Cubes above one another: up to 19 m above the ground."""


@dataclass(frozen=True, eq=False)
class Cubes:
    """Cubes that contain returns."""

    number: npt.NDArray[np.int32]
    """(n,) number of each return's cube, -1 for none."""
    place: npt.NDArray[np.int32]
    """(cubes, 3) row, column and layer from the window's corner and the ground."""
    features: npt.NDArray[np.float32]
    """(cubes, 7), columns as in :mod:`roadscan.assets.kernels.voxels`."""

    def of_returns(self, column: int, otherwise: float = np.nan) -> npt.NDArray[np.float32]:
        """Returns a feature (n,) of each return's cube."""
        values = np.append(self.features[:, column], np.float32(otherwise))
        return np.asarray(values[self.number])


def cubes_of(returns: Returns, above_m: npt.NDArray[np.float32], chosen: npt.NDArray[np.bool_], window: Box) -> Cubes:
    """Returns the cubes of the chosen returns (n,), with the scatter in each cube and its neighbours."""
    grid = grid_over(window, EDGE_M)
    index = np.full((*grid.shape, LAYERS), -1, np.int32)
    number = np.empty(len(returns), np.int32)
    place = np.empty((int(np.count_nonzero(chosen)), 3), np.int32)
    per_m = 1.0 / EDGE_M
    count = voxels.numbered(returns.x_m, returns.y_m, above_m, chosen, grid.origin, per_m, index, number, place)
    place = place[:count].copy()
    sums = np.zeros((count, voxels.MOMENTS))
    voxels.moments(returns.x_m, returns.y_m, above_m, number, grid.origin, per_m, place, sums)
    features = np.empty((count, 7), np.float32)
    voxels.features(index, place, sums, features)
    return Cubes(number, place, features)
