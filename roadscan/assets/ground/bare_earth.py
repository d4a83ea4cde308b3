"""Bare earth of a window: the returns on it, and its raster."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.dense import dense_ground
from roadscan.assets.ground.planes import plane_ground
from roadscan.assets.ground.raster import ground_model
from roadscan.assets.ground.sparse import sparse_ground
from roadscan.assets.ground.surface import Found, Place, is_dense
from roadscan.assets.kernels.heights import heights_above
from roadscan.assets.scene import Box, GroundModel
from roadscan.compute.array_types import Float32

_NOISE_M: Final = 0.3
"""A return farther below the ground (m) is noise."""


class BareEarth(NamedTuple):
    """The ground of a window."""

    model: GroundModel
    above_m: Float32
    """(n,) height of each return above bare earth (m), NaN where it is not known."""
    on_ground: npt.NDArray[np.bool_]
    """(n,) returns that lie on it."""
    below: npt.NDArray[np.bool_]
    """(n,) returns that lie below it: noise."""

    def within(self, rows: npt.NDArray[np.int64], window: Box) -> BareEarth:
        """Returns the ground of a part of the window: some of its returns (k,), and the cells of a box."""
        model = within(self.model, window) or self.model
        return BareEarth(model, self.above_m[rows], self.on_ground[rows], self.below[rows])


def bare_earth(place: Place) -> BareEarth:
    """Returns the ground under the returns of a window."""
    found = ground_returns(place)
    model = ground_model(place, found)
    above = np.empty(len(place.returns), np.float32)
    corner = np.array([model.x_min_m, model.y_min_m])
    x, y, z = place.returns.x_m, place.returns.y_m, place.returns.height_m
    heights_above(x, y, z, corner, 1.0 / model.cell_m, model.height_m, above)
    return BareEarth(model, above, found.on_ground, ~found.on_ground & (above < -_NOISE_M))


def within(model: GroundModel, box: Box) -> GroundModel | None:
    """Returns the cells of a model whose middle lies in a box; None without any."""
    rows, columns = model.height_m.shape
    x = model.x_min_m + (np.arange(columns) + 0.5) * model.cell_m
    y = model.y_min_m + (np.arange(rows) + 0.5) * model.cell_m
    c = np.flatnonzero((x >= box.x_min_m) & (x < box.x_max_m))
    r = np.flatnonzero((y >= box.y_min_m) & (y < box.y_max_m))
    if not (c.size and r.size):
        return None
    part = slice(int(r[0]), int(r[-1]) + 1), slice(int(c[0]), int(c[-1]) + 1)
    return GroundModel(
        model.x_min_m + int(c[0]) * model.cell_m, model.y_min_m + int(r[0]) * model.cell_m, model.cell_m,
        model.height_m[part], model.seen[part], None if model.sigma_m is None else model.sigma_m[part],
    )  # fmt: skip


def ground_returns(place: Place) -> Found:
    """Returns a mask of returns on the ground, by the filter that the settings name."""
    if place.settings.method == "planes":
        return plane_ground(place)
    return dense_ground(place) if is_dense(place) else sparse_ground(place)
