"""Occluders of views: voxels in which returns lie on a surface, and when a vehicle stood in them."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.assets import classes
from roadscan.assets.scene import Scene

EDGE_M: Final = 0.5
"""Edge of a voxel (m); voxels are anchored at the map's origin and at height 0."""
SCREENS: Final = pa.schema(
    [(name, pa.int32()) for name in ("column", "row", "level")]
    + [(name, pa.int64()) for name in ("first_epoch_gps_ns", "last_epoch_gps_ns")]
)
"""Voxels that hide what is behind them: number to the east, to the north and upwards, and from when to when."""
ALWAYS: Final = (np.iinfo(np.int64).min, np.iinfo(np.int64).max)
_LEAST_RETURNS: Final = 3  # Least number of returns of an occluder.
_LEAST_ABOVE_M: Final = 0.3  # Least height of its returns above the ground (m).
_LEAST_ACROSS_M: Final = 0.3
"""Narrower things (m), such as a post, hide nothing."""
_NO_SCREEN: Final = (
    classes.GROUND, classes.ROAD, classes.LOW_NOISE, classes.HIGH_NOISE, classes.PERSON, classes.WIRE,
)  # fmt: skip


def screens_of(scene: Scene) -> pa.Table:
    """Returns voxels (:data:`SCREENS`) of the scene's tile that hide what is behind them, by column, row and level.

    A voxel is one where three returns or more lie 0.3 m or more above the ground and spread by 0.3 m or more across.
    One that holds a vehicle hides things from its first return to its last, any other always.
    """
    r, codes = scene.returns, scene.classes
    taken = scene.tile.holds(r.x_m, r.y_m) & (scene.above_ground_m > _LEAST_ABOVE_M) & ~np.isin(codes, _NO_SCREEN)
    rows = np.flatnonzero(taken)
    if not rows.size:
        return SCREENS.empty_table()
    east, north, height = r.x_m[rows] + r.corner_m[0], r.y_m[rows] + r.corner_m[1], r.height_m[rows]
    voxel = np.floor(np.column_stack([east, north, height]) / EDGE_M).astype(np.int64)
    is_vehicle = codes[rows] == classes.VEHICLE
    order = np.lexsort((voxel[:, 2], voxel[:, 1], voxel[:, 0], is_vehicle))
    voxel, is_vehicle = voxel[order], is_vehicle[order]
    new = np.append(True, (np.diff(voxel, axis=0) != 0).any(axis=1) | (np.diff(is_vehicle.astype(np.int8)) != 0))
    first = np.flatnonzero(new)

    def spread(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        own = values[order]
        return np.asarray(np.maximum.reduceat(own, first) - np.minimum.reduceat(own, first))

    across = np.maximum(spread(east), spread(north))
    kept = (np.diff(np.append(first, rows.size)) >= _LEAST_RETURNS) & (across >= _LEAST_ACROSS_M)
    epoch = r.epoch_gps_ns[rows][order]
    vehicle = is_vehicle[first]
    begin = np.where(vehicle, np.minimum.reduceat(epoch, first), ALWAYS[0])
    end = np.where(vehicle, np.maximum.reduceat(epoch, first), ALWAYS[1])
    places = voxel[first][kept]
    found = pa.table([*(pa.array(c, pa.int32()) for c in places.T), pa.array(begin[kept]), pa.array(end[kept])],
                     schema=SCREENS)  # fmt: skip
    return found.sort_by([(name, "ascending") for name in SCREENS.names])
