"""Visibility: the number of passes that had a place in sight, and the surfaces that hide places from cameras.

Passes are counted for the ground of each cell and for the air above it by height. Returns show where a sensor looked. A
return's ray passed all places on its way, saw its hit, and did not see what lies behind. A pass had a place in sight
where enough of its rays reached it, and no fewer than were stopped before. Where nothing came back, as from the sky,
rays are not known; there a place counts as in sight if it is above one that is, unless half of the rays expected from
lower places were stopped before it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.assets import classes
from roadscan.assets.kernels.sight import Places, Rays, follow_rays
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Bool

CELL_M: Final = 0.5
"""Edge of the cells (m), whose corners are multiples of it."""
BANDS_M: Final = (-0.3, 0.5, 1.5, 3.0, 5.0, 8.0)
"""Heights above the ground (m) between which a cell's places lie."""
PASSES: Final = ("passes_ground", "passes_low", "passes_middle", "passes_high", "passes_top")
"""Columns of the passes, one a band, upwards."""
_REACH_M: Final = 30.0
"""Places farther from the sensor (m) do not count as seen."""
_HIT_M: Final = 0.5  # A hit counts as passed this far to both sides along the ray (m).
_LEAST_RAYS: Final = 50.0
"""Fewer rays show neither that a place was seen nor that something stood before it. A pole of 0.1 m gets a fifth of
the rays of its cell."""
_MOST_RAYS: Final = 120_000
"""Of more rays of a pass, each second, third … is followed."""


def passes_in_sight(scene: Scene) -> pa.Table:
    """Returns cells of the scene's tile that any pass had in sight: column, row, ground height, passes by height.

    Only cells whose middles lie in the tile and of which the ground is known are returned.
    """
    (east, north), box, ground = scene.returns.corner_m, scene.tile, scene.ground
    least = np.array([_cells_before(east + box.x_min_m), _cells_before(north + box.y_min_m)])
    most = np.array([_cells_before(east + box.x_max_m), _cells_before(north + box.y_max_m)])
    columns, rows = np.maximum(most - least, 0).tolist()
    corner = least * CELL_M - np.array([east, north])
    x = corner[0] + (np.arange(columns) + 0.5) * CELL_M
    y = corner[1] + (np.arange(rows) + 0.5) * CELL_M
    height = ground.height_at(*np.meshgrid(x, y)).astype(np.float32)
    counted = np.zeros((rows, columns, len(PASSES)), np.int32)
    for rays, share in _rays_of_passes(scene):
        passed, hidden = (np.zeros(counted.shape, np.uint32) for _ in range(2))
        places = Places(np.ascontiguousarray(corner, np.float64), CELL_M, height, np.array(BANDS_M))
        follow_rays(rays, places, _REACH_M, _HIT_M, passed, hidden)
        counted += in_sight(passed * share, hidden * share)
    at = np.flatnonzero(counted.any(axis=2))
    table = {
        "column": pa.array(least[0] + at % max(columns, 1), pa.int32()),
        "row": pa.array(least[1] + at // max(columns, 1), pa.int32()),
        "ground_height_m": pa.array(height.reshape(-1)[at], pa.float32()),
    }
    by_band = counted.reshape(-1, len(PASSES))[at]
    table |= {name: pa.array(by_band[:, band], pa.int32()) for band, name in enumerate(PASSES)}
    return pa.table(table)


def in_sight(passed: npt.NDArray[np.floating], hidden: npt.NDArray[np.floating]) -> Bool:
    """Whether a pass had places (rows, columns, bands) in sight, by how many rays reached them and how many did not."""
    seen: Bool = (passed >= _LEAST_RAYS) & (passed >= hidden)
    per_m = (passed + hidden) / np.diff(BANDS_M)
    for band in range(1, seen.shape[2]):
        # rays that passed may not have come back, so those that were stopped are compared with the bands below
        expected = per_m[:, :, 1:band].max(axis=2, initial=0.0) * (BANDS_M[band + 1] - BANDS_M[band])
        is_open = hidden[:, :, band] < np.maximum(_LEAST_RAYS, 0.5 * expected)
        seen[:, :, band] |= is_open & seen[:, :, band - 1]
    return seen


def _cells_before(place_m: float) -> int:
    """Returns the number of the first cell whose middle does not lie before a place."""
    return int(np.ceil(place_m / CELL_M - 0.5))


def _rays_of_passes(scene: Scene) -> list[tuple[Rays, float]]:
    """Returns rays of each pass, and the number of returns that each of them represents."""
    returns = scene.returns
    is_known = np.isfinite(returns.sensor_x_m) & np.isfinite(returns.sensor_height_m)
    found = []
    for one in np.unique(returns.pass_id[is_known]):
        rows = np.flatnonzero(is_known & (returns.pass_id == one))
        share = 1 + rows.size // _MOST_RAYS
        rows = rows[::share]
        ends = returns.sensor_x_m, returns.sensor_y_m, returns.sensor_height_m, returns.x_m, returns.y_m
        found.append((Rays(*(v[rows] for v in (*ends, returns.height_m))), float(share)))
    return found


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
