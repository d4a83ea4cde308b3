"""Which way the lane runs at each tile, from when the tiles were first seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from roadscan.model.ids import TileId
from roadscan.products.base import TileSummary

_TILES_AROUND = 4.0
_WITHIN_S = 20.0


def lane_azimuths_rad(tiles: Sequence[TileSummary]) -> dict[TileId, float]:
    """Direction of travel at each tile, clockwise from map north, NaN where no neighbour tells.

    It is the slope of place over time: the regression of the centres of the tiles up to 4 away on their first epochs,
    of those that were seen within 20 s. Tiles side by side cancel out; on straights and wide bends it is good to a few
    degrees.
    """
    if not tiles:
        return {}
    place = np.array([[t.tile.column, t.tile.row] for t in tiles], dtype=np.float64)
    seconds = np.array([t.first_epoch_gps_ns - tiles[0].first_epoch_gps_ns for t in tiles]) * 1e-9
    near = cKDTree(place).query_ball_point(place, _TILES_AROUND + 1e-9)
    return {one.tile: _azimuth(k, place, seconds, np.sort(near[k])) for k, one in enumerate(tiles)}


def _azimuth(
    own: int, place: npt.NDArray[np.float64], seconds: npt.NDArray[np.float64], near: npt.NDArray[np.int64]
) -> float:
    near = near[np.abs(seconds[near] - seconds[own]) <= _WITHIN_S]
    time = seconds[near] - seconds[near].mean()
    if not (time != 0.0).any():
        return float("nan")
    east, north = time @ (place[near] - place[near].mean(axis=0))
    return float(np.arctan2(east, north))
