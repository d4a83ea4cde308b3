"""Clearance: the lowest structure, wire or branch above the path of each drive."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
import shapely
from pydantic import Field
from scipy.spatial import cKDTree

from roadscan.assets import classes
from roadscan.assets.kernels.columns import mark_corridor
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, KindOptions
from roadscan.assets.probabilities import logistic
from roadscan.assets.scene import SAME_LEVEL_M, Scene
from roadscan.assets.upright.pieces import passes_of
from roadscan.assets.upright.slices import ground_light, usable
from roadscan.compute.array_types import Float64, Int64

CELL_M: Final = 0.5  # Edge of a cell (m).
_SUPPORT_M: Final = 0.25  # Returns within this height above the lowest one support it (m).
_NOISE_M: Final = 0.1  # Returns within this height above the lowest one give its height (m).
_NEAR_M: Final = 12.0  # Returns nearer than this (m) always count.
_SAME_ROAD_M: Final = 0.5
"""Ground beside a drive differs by no more from the road under it (m): a kerb, the crossfall."""
PIECE_SCHEMA: Final = pa.schema(
    [
        ("pass_id", pa.int32()), ("easting_m", pa.float64()), ("northing_m", pa.float64()), ("height_m", pa.float64()),
        ("clearance_m", pa.float64()), ("returns", pa.int64()), ("vegetation", pa.float64()), ("bright", pa.float64()),
        ("thickness_m", pa.float64()), ("passes", pa.list_(pa.int32())), ("first_epoch_gps_ns", pa.int64()),
        ("last_epoch_gps_ns", pa.int64()),
    ]
)  # fmt: skip
"""A row for each cell of a drive's corridor with something above it."""


class ClearanceOptions(KindOptions):
    """Where clearance is looked for."""

    corridor_m: float = Field(default=3.0, gt=0.5, le=20.0)
    """Width of the corridor about each drive (m)."""
    lowest_m: float = Field(default=2.2, gt=0.5)
    """What hangs lower is no clearance but stands in the way (m)."""
    highest_m: float = Field(default=12.0, gt=1.0)
    """What hangs higher is of no interest (m)."""
    apart_m: float = Field(default=10.0, gt=0.5)
    """Along what hangs on for longer, the lowest places are listed at least this far apart (m)."""
    least_returns: int = Field(default=3, ge=1)
    """So many returns within 0.25 m above the lowest one bear it out; single ones are noise."""


def overhead_cells(scene: Scene, options: ClearanceOptions) -> pa.Table:
    """Returns the lowest supported return above each cell of the corridors of all drives, in the scene's tile."""
    returns, tile = scene.returns, scene.tile
    hanging = usable(scene) & (scene.above_ground_m >= options.lowest_m) & tile.holds(returns.x_m, returns.y_m)
    rows = np.flatnonzero(hanging)
    ranges = np.hypot(returns.x_m[rows] - returns.sensor_x_m[rows], returns.y_m[rows] - returns.sensor_y_m[rows])
    column = np.floor((returns.x_m[rows] - tile.x_min_m) / CELL_M).astype(np.int64)
    row = np.floor((returns.y_m[rows] - tile.y_min_m) / CELL_M).astype(np.int64)
    columns = int(np.ceil((tile.x_max_m - tile.x_min_m) / CELL_M - 1e-9))
    shape = (int(np.ceil((tile.y_max_m - tile.y_min_m) / CELL_M - 1e-9)), columns)
    corner = np.array([tile.x_min_m, tile.y_min_m])
    bright = 2.0 * ground_light(scene)
    found: list[dict[str, Any]] = []
    for pass_id, drive in _drives_of(scene):
        inside = np.zeros(shape, np.bool_)
        x, y = np.ascontiguousarray(drive[:, 0]), np.ascontiguousarray(drive[:, 1])
        mark_corridor(x, y, options.corridor_m / 2, corner, CELL_M, inside)
        under = np.flatnonzero(inside[row, column])
        road = np.full(rows.size, np.nan)
        road[under] = _roads_below(scene, rows[under], drive)
        above = returns.height_m[rows[under]] - road[under]
        under = under[(above >= options.lowest_m) & (above <= options.highest_m)]
        flat = row[under] * columns + column[under]
        under, flat = _near_enough(under, flat, ranges)
        order = np.lexsort((returns.height_m[rows[under]], flat))
        kept, cells = under[order], flat[order]
        for part in np.split(kept, np.flatnonzero(np.diff(cells)) + 1):
            one = _cell(scene, rows[part], options, bright, road[part])
            if one is not None:
                found.append({"pass_id": pass_id, **one})
    return pa.Table.from_pylist(found, schema=PIECE_SCHEMA)


def _drives_of(scene: Scene) -> Iterator[tuple[int, Float64]]:
    """Yields each pass with the places (p, 3) of its drive on all levels: x, y and height of the road."""
    on_ground = scene.drive_xyh_m.copy()
    on_ground[:, 2] = scene.ground.height_at(on_ground[:, 0], on_ground[:, 1])
    hidden = scene.hidden_xyh_m[np.isfinite(scene.hidden_xyh_m[:, 2])]
    for drive in (on_ground, hidden):
        for pass_id in np.unique(drive[:, 3]).tolist():
            yield int(pass_id), drive[drive[:, 3] == pass_id, :3]


def _roads_below(scene: Scene, rows: Int64, drive_xyh_m: Float64) -> Float64:
    """Returns the height (k,) above which some returns hang over a drive (p, 3), NaN where they do not.

    It is that of the ground under them, but where a drive has the ground of another level: there that of its road.
    What hangs above ground that is higher than the road hangs above another level.
    """
    x, y = scene.returns.x_m[rows], scene.returns.y_m[rows]
    _, at = cKDTree(drive_xyh_m[:, :2]).query(np.column_stack([x, y]))
    ground, road = scene.ground.height_at(x, y), drive_xyh_m[at, 2]
    below = np.where(np.abs(ground - road) > _SAME_ROAD_M, road, ground)
    return np.where(ground > road + SAME_LEVEL_M, np.nan, below)


def _near_enough(own: Int64, flat: Int64, ranges: Float64) -> tuple[Int64, Int64]:
    """Returns and cells without those seen from 1.5 times as far as the nearest of their cell, and past 12 m.

    A beam is wider far off, and meets an edge before its middle does.
    """
    if own.size == 0:
        return own, flat
    nearest = np.full(int(flat.max()) + 1, np.inf)
    np.minimum.at(nearest, flat, ranges[own])
    near = ranges[own] <= np.maximum(1.5 * nearest[flat], _NEAR_M)
    return own[near], flat[near]


def _cell(scene: Scene, part: Int64, options: ClearanceOptions, bright: float, road: Float64) -> dict[str, Any] | None:
    """Returns the lowest supported return of a cell, of rows sorted by height; road : height under each."""
    returns = scene.returns
    heights = returns.height_m[part]
    need = options.least_returns
    if part.size < need:
        return None
    supported = np.flatnonzero(heights[need - 1 :] - heights[: part.size - need + 1] <= _SUPPORT_M)
    if supported.size == 0:
        return None
    i = int(supported[0])
    low = part[i]
    near = part[(heights >= heights[i]) & (heights <= heights[i] + 2 * _SUPPORT_M)]
    x, y, height = float(returns.x_m[low]), float(returns.y_m[low]), _lowest(heights[i:])
    epochs = returns.epoch_gps_ns[near]
    return {
        "easting_m": returns.corner_m[0] + x, "northing_m": returns.corner_m[1] + y, "height_m": height,
        "clearance_m": height - float(road[i]), "returns": int(near.size),
        "vegetation": float(np.isin(scene.classes[near], classes.VEGETATION).mean()),
        "bright": float((returns.intensity[near] >= bright).mean()),
        "thickness_m": float(np.quantile(returns.height_m[near], 0.9) - height),
        "passes": passes_of(scene, near), "first_epoch_gps_ns": int(epochs.min()),
        "last_epoch_gps_ns": int(epochs.max()),
    }  # fmt: skip


def _lowest(heights: Float64) -> float:
    """Height of the lowest obstacle, of ascending heights: a tenth of the returns within 0.1 m lie below it.

    The lowest of many returns lies as far below a surface as their noise reaches.
    """
    near = heights[: int(np.searchsorted(heights, heights[0] + _NOISE_M, side="right"))]
    return float(near[near.size // 10])


def lowest_places(pieces: pa.Table, apart_m: float) -> list[dict[str, Any]]:
    """Returns the lowest cells of each drive, each at least so far from a lower one, with the obstacle's `type`."""
    rows = sorted(pieces.to_pylist(), key=lambda r: (r["pass_id"], r["clearance_m"], r["easting_m"], r["northing_m"]))
    out: list[dict[str, Any]] = []
    for pass_id in sorted({r["pass_id"] for r in rows}):
        own = [r for r in rows if r["pass_id"] == pass_id]
        places = np.array([[r["easting_m"], r["northing_m"]] for r in own])
        places -= places[0]
        tree = cKDTree(places)
        free = np.ones(len(own), np.bool_)
        for i, row in enumerate(own):
            if free[i]:
                about = tree.query_ball_point(places[i], apart_m)
                free[about] = False
                near = [own[j] for j in tree.query_ball_point(places[i], 1.5)]
                out.append({**row, "type": _type(row, near), "cells": len(near)})
    return out


def _type(row: dict[str, Any], near: list[dict[str, Any]]) -> str:
    """Returns the type of an obstacle, by its returns and those of the cells about it."""
    if row["bright"] > 0.5:
        return "sign"
    if row["vegetation"] > 0.5:
        return "branch"
    thin = max(r["thickness_m"] for r in near) < 0.06
    return "wire" if thin and len(near) <= 8 else "structure"


class Clearance(AssetKind):
    """Lowest places above the corridor of each drive."""

    name = "clearance"
    title = "Clearance"
    curve = "clearances"
    options = ClearanceOptions
    piece_schema = PIECE_SCHEMA

    def evidence(self, scene: Scene, options: ClearanceOptions) -> Evidence:
        """Returns cells of the tile with something above them."""
        return Evidence(overhead_cells(scene, options))

    def objects(
        self, pieces: pa.Table, options: ClearanceOptions, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields the lowest places of each drive, apart from one another."""
        for row in lowest_places(pieces, options.apart_m):
            probability = logistic(-1.0, [(0.3, min(row["returns"], 15)), (0.3, min(row["cells"], 5))])
            yield AssetObject(
                shapely.Point(row["easting_m"], row["northing_m"], row["height_m"]), 0.05, 0.02, probability,
                row["returns"], len(row["passes"]), row["first_epoch_gps_ns"], row["last_epoch_gps_ns"],
                {"clearance_m": row["clearance_m"], "type": row["type"]}, 0.02,
            )  # fmt: skip
