"""Cells of the map that are planted or grown over: what stands on them, how rough and how bright they are."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely
from pydantic import Field

from roadscan.assets import classes
from roadscan.assets.scene import Scene
from roadscan.assets.touching import touching
from roadscan.assets.upright.pieces import passes_of
from roadscan.kernels.assets.grown_cells import ground_moments
from roadscan.model.strict import Strict

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

CELL_M: Final = 0.5
_LEAST_RETURNS: Final = 6
_GROUND: Final = (classes.GROUND, classes.ROAD, classes.SIDEWALK, classes.MARKING, classes.KERB)
_GROWN: Final = (classes.LOW_VEGETATION, classes.MEDIUM_VEGETATION)
PIECE_SCHEMA: Final = pa.schema(
    [
        ("column", pa.int64()), ("row", pa.int64()), ("height_m", pa.float64()), ("probability", pa.float64()),
        ("returns", pa.int64()), ("passes", pa.list_(pa.int32())), ("first_epoch_gps_ns", pa.int64()),
        ("last_epoch_gps_ns", pa.int64()),
    ]
)  # fmt: skip
"""A row a cell of the map's grid of 0.5 m (easting // 0.5, northing // 0.5)."""


class LandscapeOptions(Strict):
    """What counts as a landscape area."""

    least_area_m2: float = Field(default=4.0, gt=0.0)
    """Smaller areas are left out (m²)."""
    rough_ratio: float = Field(default=2.0, gt=1.0)
    """A cell is rough whose height scatters this many times as much as the road's."""
    bright_ratio: float = Field(default=1.2, gt=1.0)
    """A cell beside the road is as bright as grass at this multiple of the road's median intensity."""


def grown_cells(scene: Scene, options: LandscapeOptions) -> pa.Table:
    """Cells of the tile that are probably grown over: plants stand on them, or they are rough or as bright as grass."""
    returns, tile = scene.returns, scene.tile
    kind = np.zeros(256, np.uint8)
    kind[list(_GROUND)], kind[list(_GROWN)] = 1, 2
    kinds = kind[scene.classes]
    columns = int(np.ceil((tile.x_max_m - tile.x_min_m) / CELL_M - 1e-9))
    rows = int(np.ceil((tile.y_max_m - tile.y_min_m) / CELL_M - 1e-9))
    corner = np.array([tile.x_min_m, tile.y_min_m])
    sums = np.zeros((rows, columns, 9))
    above = scene.above_ground_m.astype(np.float64)
    ground_moments(returns.x_m, returns.y_m, above, returns.intensity, kinds, corner, CELL_M, sums)
    counted = sums[..., 0] >= _LEAST_RETURNS
    rough, bright = _roughness(sums), sums[..., 7] / np.maximum(sums[..., 0], 1.0)
    road = _road_cells(scene, counted.shape, corner) & counted
    if not road.any():
        return PIECE_SCHEMA.empty_table()
    plain, dark = float(np.median(rough[road])), float(np.median(bright[road]))
    plants = np.minimum(sums[..., 8] / np.maximum(sums[..., 0] + sums[..., 8], 1.0), 1.0)
    z = -3.0 + 8.0 * plants
    z += np.where(counted, 3.0 * (np.clip(rough / max(plain, 1e-4) / options.rough_ratio, 0.0, 2.0) - 0.7), 0.0)
    z += np.where(counted & (bright > options.bright_ratio * dark), 3.0, 0.0)
    probability = 1.0 / (1.0 + np.exp(-z))
    chosen = (probability >= 0.5) & ~road & ((sums[..., 0] + sums[..., 8]) >= _LEAST_RETURNS)
    return _table(scene, chosen, probability, kinds > 0)


def _roughness(sums: Float64) -> Float64:
    """Standard deviation (rows, columns) of the ground's height about a plane in each cell (m)."""
    n = np.maximum(sums[..., 0], 1.0)
    u, v, h, uh, vh, hh = (sums[..., k] / n for k in range(1, 7))
    spread = CELL_M**2 / 12.0
    square = hh - h * h - ((uh - u * h) ** 2 + (vh - v * h) ** 2) / spread
    return np.sqrt(np.maximum(square, 1e-8))


def _road_cells(scene: Scene, shape: tuple[int, ...], corner: Float64) -> npt.NDArray[np.bool_]:
    """Cells (rows, columns) that hold returns of the road."""
    on_road = np.flatnonzero(scene.classes == classes.ROAD)
    column = np.floor((scene.returns.x_m[on_road] - corner[0]) / CELL_M).astype(np.int64)
    row = np.floor((scene.returns.y_m[on_road] - corner[1]) / CELL_M).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    out = np.zeros(shape, np.bool_)
    out[row[inside], column[inside]] = True
    return out


def _table(
    scene: Scene, chosen: npt.NDArray[np.bool_], probability: Float64, counted: npt.NDArray[np.bool_]
) -> pa.Table:
    """Rows of the chosen cells."""
    returns, tile = scene.returns, scene.tile
    at = np.flatnonzero(counted & tile.holds(returns.x_m, returns.y_m))
    column = np.floor((returns.x_m[at] - tile.x_min_m) / CELL_M).astype(np.int64)
    row = np.floor((returns.y_m[at] - tile.y_min_m) / CELL_M).astype(np.int64)
    inside = chosen[row, column]
    at, flat = at[inside], (row * chosen.shape[1] + column)[inside]
    order = np.argsort(flat, kind="stable")
    parts = np.split(at[order], np.flatnonzero(np.diff(flat[order])) + 1) if at.size else []
    first = (
        round((returns.corner_m[0] + tile.x_min_m) / CELL_M), round((returns.corner_m[1] + tile.y_min_m) / CELL_M),
    )  # fmt: skip
    found: list[dict[str, Any]] = []
    for part in parts:
        c = int((returns.x_m[part[0]] - tile.x_min_m) / CELL_M)
        r = int((returns.y_m[part[0]] - tile.y_min_m) / CELL_M)
        epochs = returns.epoch_gps_ns[part]
        height = float(scene.ground.height_at(tile.x_min_m + (c + 0.5) * CELL_M, tile.y_min_m + (r + 0.5) * CELL_M))
        if np.isfinite(height):
            found.append(
                {
                    "column": first[0] + c, "row": first[1] + r, "height_m": height,
                    "probability": float(probability[r, c]), "returns": int(part.size),
                    "passes": passes_of(scene, part), "first_epoch_gps_ns": int(epochs.min()),
                    "last_epoch_gps_ns": int(epochs.max()),
                }
            )  # fmt: skip
    return pa.Table.from_pylist(found, schema=PIECE_SCHEMA)


def components(column: Int64, row: Int64) -> list[Int64]:
    """Numbers of the cells of each area: cells that share a side; areas by their first cell (row, column)."""
    if column.size == 0:
        return []
    order = np.lexsort((column, row))
    width = int(column.max() - column.min()) + 3
    flat = (row[order] - row.min()) * width + (column[order] - column.min())
    label = touching(flat, (1, width))
    by_label = np.argsort(label, kind="stable")
    parts = np.split(order[by_label], np.flatnonzero(np.diff(label[by_label])) + 1)
    return sorted(parts, key=lambda p: (int(row[p[0]]), int(column[p[0]])))


def area_of(column: Int64, row: Int64) -> shapely.Geometry:
    """Union of cells of the map's grid (easting and northing, m)."""
    return shapely.union_all(
        shapely.box(column * CELL_M, row * CELL_M, (column + 1) * CELL_M, (row + 1) * CELL_M), grid_size=1e-3
    )
