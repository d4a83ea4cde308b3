"""Cells of the ground that pictures may show: heights, intensity, and what stands there."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pyarrow as pa
import scipy.spatial

from roadscan.assets import classes
from roadscan.assets.bins import cells_of, in_bins
from roadscan.assets.edges.tracks import tracks_of
from roadscan.assets.scene import Returns, Scene
from roadscan.compute.array_types import Float64, Int64

CELL_M: Final = 0.25
"""Edge of a cell (m), as of landscape areas; corners are multiples of it in the map."""
FARTHEST_M: Final = 12.0
"""Cells farther from all drives (m) are not looked at: a pixel spans too much of the ground there."""
_LOW_M: Final = (-0.3, 0.3)
"""Heights above the ground of returns that tell the intensity of a cell (m)."""
_STANDS_M: Final = (0.3, 2.5)
"""What returns from these heights above the ground (m) hides the ground of its cell from a camera."""
_PAST_END_M: Final = 1.0  # Places farther past the end of a drive than this (m) lie beside none.
_STANDING: Final = 2  # So many returns stand in a cell.
GROUND_CELLS: Final = pa.schema(
    [
        ("column", pa.int64()), ("row", pa.int64()), ("height_m", pa.float64()), ("intensity", pa.float32()),
        ("returns", pa.int32()), ("drive_m", pa.float32()), ("aside_m", pa.float32()), ("heading_rad", pa.float32()),
        ("stands", pa.bool_()),
        ("passes", pa.list_(pa.int32())), ("first_epoch_gps_ns", pa.int64()), ("last_epoch_gps_ns", pa.int64()),
    ]
)  # fmt: skip
"""A row a cell (easting // 0.25, northing // 0.25): height of bare earth at its middle, mean intensity of its low
returns, distance of the nearest drive, how far to the right of the road's first drive and that drive's heading there
(from east, counter-clockwise; NaN without one), and whether anything stands there."""


def ground_cells(scene: Scene) -> pa.Table:
    """Returns cells of the scene's tile whose ground is known, near a drive, by row and column."""
    tile, returns = scene.tile, scene.returns
    shape = round((tile.y_max_m - tile.y_min_m) / CELL_M), round((tile.x_max_m - tile.x_min_m) / CELL_M)
    if not len(scene.drive_xyh_m) or not len(returns):
        return GROUND_CELLS.empty_table()
    row, column = (at.reshape(-1) for at in np.indices(shape))
    x, y = tile.x_min_m + (column + 0.5) * CELL_M, tile.y_min_m + (row + 0.5) * CELL_M
    away, _ = scipy.spatial.cKDTree(scene.drive_xyh_m[:, :2]).query(
        np.column_stack([x, y]), distance_upper_bound=FARTHEST_M
    )
    height = scene.ground.height_at(x, y)
    known = np.flatnonzero(np.isfinite(away) & np.isfinite(height))
    number = np.full(row.size + 1, -1, np.int32)
    number[known] = np.arange(known.size)
    grid = (tile.x_min_m, tile.y_min_m, CELL_M)
    above, codes = scene.above_ground_m, scene.classes
    noise = np.isin(codes, (classes.LOW_NOISE, classes.HIGH_NOISE))
    stands = np.flatnonzero((above >= _STANDS_M[0]) & (above <= _STANDS_M[1]) & ~noise)
    standing, _ = in_bins(number[cells_of(returns.x_m[stands], returns.y_m[stands], grid, shape)], known.size)
    low = np.flatnonzero((above >= _LOW_M[0]) & (above <= _LOW_M[1]) & ~noise)
    if not low.size:
        return GROUND_CELLS.empty_table()
    starts, order = in_bins(number[cells_of(returns.x_m[low], returns.y_m[low], grid, shape)], known.size)
    rows, count = low[order], np.diff(starts)
    total = np.concatenate([[0.0], np.cumsum(returns.intensity[rows].astype(np.float64))])
    epochs, passes = returns.epoch_gps_ns[rows], returns.pass_id[rows]
    spans = list(zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True))
    first = [int(epochs[a:b].min()) if b > a else 0 for a, b in spans]
    last = [int(epochs[a:b].max()) if b > a else 0 for a, b in spans]
    seen_by = [np.unique(passes[a:b]).tolist() for a, b in spans]
    # What pictures show where no return lies is dated by the return nearest to it.
    dark = np.flatnonzero(count == 0)
    for k, near in zip(
        dark.tolist(), _nearest(returns, low, np.column_stack([x, y])[known][dark]).tolist(), strict=True
    ):
        first[k] = last[k] = int(returns.epoch_gps_ns[near])
        seen_by[k] = [int(returns.pass_id[near])]
    east, north = (round((returns.corner_m[k] + (tile.x_min_m, tile.y_min_m)[k]) / CELL_M) for k in (0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        intensity = (total[starts[1:]] - total[starts[:-1]]) / count
    return pa.table(
        {
            "column": east + column[known], "row": north + row[known], "height_m": height[known],
            "intensity": intensity.astype(np.float32), "returns": count.astype(np.int32),
            "drive_m": away[known].astype(np.float32), **_beside_drive(scene, np.column_stack([x, y])[known]),
            "stands": np.diff(standing) >= _STANDING,
            "passes": pa.array(seen_by, pa.list_(pa.int32())),
            "first_epoch_gps_ns": np.array(first, np.int64), "last_epoch_gps_ns": np.array(last, np.int64),
        },
        GROUND_CELLS,
    )  # fmt: skip


def _beside_drive(scene: Scene, places_m: Float64) -> dict[str, Any]:
    """Returns how far to the right (n,) of the first drive of a road places (n, 2) lie (m), and its heading (rad)."""
    tracks = list(tracks_of(scene.drive_xyh_m))
    if not tracks:
        return dict.fromkeys(("aside_m", "heading_rad"), np.full(len(places_m), np.nan, np.float32))
    stations, heading = (np.concatenate([getattr(one, name) for one in tracks]) for name in ("places", "heading"))
    _, at = scipy.spatial.cKDTree(stations).query(places_m)
    step, (east, north) = places_m - stations[at], heading[at].T
    aside = step[:, 0] * north - step[:, 1] * east
    aside[np.abs(step[:, 0] * east + step[:, 1] * north) > _PAST_END_M] = np.nan
    return {"aside_m": aside.astype(np.float32), "heading_rad": np.arctan2(north, east).astype(np.float32)}


def _nearest(returns: Returns, low: Int64, places_m: Float64) -> Int64:
    """Returns the rows (n,) of returns nearest to places (n, 2), among one of each cell that holds any."""
    xy = np.column_stack([returns.x_m[low], returns.y_m[low]])
    cell = np.floor(xy / CELL_M).astype(np.int64)
    _, one = np.unique(cell[:, 1] * 1_000_003 + cell[:, 0], return_index=True)
    _, near = scipy.spatial.cKDTree(xy[one]).query(places_m)
    return np.asarray(low[one[near]], np.int64)
