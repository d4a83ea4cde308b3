"""Bare earth of a window: which returns lie on it, and its raster."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.dense import dense_ground
from roadscan.assets.ground.grid import grid_over
from roadscan.assets.ground.raster import ground_model
from roadscan.assets.ground.sparse import sparse_ground
from roadscan.assets.ground.surface import Found, Place
from roadscan.assets.scene import GroundModel
from roadscan.kernels.assets.heights import heights_above
from roadscan.kernels.assets.lowest import counts

Float32 = npt.NDArray[np.float32]

DENSE_PER_M2: Final = 4
"""Median number of returns of the square metres that hold any, from which the data are those of a scanner on the road:
scanners from the air give about one."""
_NOISE_M: Final = 0.3
"""A return is noise that lies below the ground by more."""


class BareEarth(NamedTuple):
    """What is known of the ground of a window."""

    model: GroundModel
    above_m: Float32
    """(n,) height of each return above bare earth (m), NaN where it is not known."""
    on_ground: npt.NDArray[np.bool_]
    """(n,) returns that lie on it."""
    below: npt.NDArray[np.bool_]
    """(n,) returns that lie below it: noise."""


def bare_earth(place: Place) -> BareEarth:
    """Ground of the returns of a window."""
    found = ground_returns(place)
    model = ground_model(place, found)
    above = np.empty(len(place.returns), np.float32)
    corner = np.array([model.x_min_m, model.y_min_m])
    x, y, z = place.returns.x_m, place.returns.y_m, place.returns.height_m
    heights_above(x, y, z, corner, 1.0 / model.cell_m, model.height_m, above)
    return BareEarth(model, above, found.on_ground, ~found.on_ground & (above < -_NOISE_M))


def ground_returns(place: Place) -> Found:
    """Returns on the ground by the filter that the settings name."""
    return dense_ground(place) if is_dense(place) else sparse_ground(place)


def is_dense(place: Place) -> bool:
    """Whether the returns of the window lie as dense as those of a scanner on the road."""
    grid = grid_over(place.window, 1.0)
    found = np.zeros(grid.shape, np.int32)
    counts(place.returns.x_m, place.returns.y_m, grid.origin, 1.0, found)
    held = found[found > 0]
    return bool(held.size and np.median(held) >= DENSE_PER_M2)
