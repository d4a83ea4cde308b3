"""Attenuators: low boxes at the ends of guardrails and barriers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.kinds.landscape_area import components
from roadscan.assets.probabilities import logistic
from roadscan.assets.scene import Scene
from roadscan.assets.upright.panels import panels_of
from roadscan.assets.upright.pieces import seen_by
from roadscan.assets.upright.slices import usable
from roadscan.compute.array_types import Int64

_CELL_M: Final = 0.2  # Edge of a cell (m).
_LOW_M: Final = 0.2  # Returns above this height (m) are used.
_HIGH_M: Final = (0.5, 1.3)  # Height of a box (m).
_LENGTH_M: Final = (1.5, 10.0)  # Length of a box (m).
_WIDTH_M: Final = (0.35, 1.4)  # Width of a box (m).
_LEAST_RETURNS: Final = 40  # Least number of returns of a box.
_LONG_M: Final = 5.0  # Longer surfaces (m) are barriers.
PIECE_SCHEMA: Final = pa.schema(
    [
        ("ring", pa.list_(pa.list_(pa.float64()))), ("ground_m", pa.float64()), ("asset_height_m", pa.float64()),
        ("length_m", pa.float64()), ("width_m", pa.float64()), ("returns", pa.int64()),
        ("passes", pa.list_(pa.int32())), ("first_epoch_gps_ns", pa.int64()), ("last_epoch_gps_ns", pa.int64()),
    ]
)  # fmt: skip
"""A row for each box: its corners in the map (easting, northing), and its figures."""


def boxes_of(scene: Scene) -> pa.Table:
    """Boxes 0.5–1.3 m high, 1.5–10 m long and 0.35–1.4 m wide whose middle lies in the tile; no long barriers."""
    returns = scene.returns
    above = scene.above_ground_m
    free = usable(scene) & (above > _LOW_M)
    for panel in panels_of(scene):
        if float(np.hypot(*np.diff(panel.xy_m, axis=0).T).sum()) > _LONG_M:
            free[panel.rows] = False
    rows = np.flatnonzero(free)
    column = np.floor(returns.x_m[rows] / _CELL_M).astype(np.int64)
    row = np.floor(returns.y_m[rows] / _CELL_M).astype(np.int64)
    if rows.size == 0:
        return PIECE_SCHEMA.empty_table()
    width = int(column.max() - column.min()) + 2
    flat = (row - row.min()) * width + column - column.min()
    cells, owner = np.unique(flat, return_inverse=True)
    label = np.empty(cells.size, np.int64)
    for k, part in enumerate(components(cells % width, cells // width)):
        label[part] = k
    order = np.argsort(label[owner], kind="stable")
    parts = np.split(rows[order], np.flatnonzero(np.diff(label[owner][order])) + 1)
    found = [_box(scene, np.sort(p)) for p in parts if p.size >= _LEAST_RETURNS]
    return pa.Table.from_pylist([f for f in found if f is not None], schema=PIECE_SCHEMA)


def _box(scene: Scene, rows: Int64) -> dict[str, Any] | None:
    returns = scene.returns
    highest = float(scene.above_ground_m[rows].max())
    if not _HIGH_M[0] <= highest <= _HIGH_M[1] + 0.3:
        return None
    top = float(np.quantile(scene.above_ground_m[rows], 0.98))
    if not _HIGH_M[0] <= top <= _HIGH_M[1]:
        return None
    points = np.column_stack([returns.x_m[rows], returns.y_m[rows]])
    rectangle = shapely.minimum_rotated_rectangle(shapely.MultiPoint(points))
    if rectangle.geom_type != "Polygon":
        return None
    ring = shapely.get_coordinates(rectangle)
    sides = np.hypot(*np.diff(ring, axis=0).T)
    long, wide = float(sides.max()), float(sides.min())
    middle = rectangle.centroid
    if not (_LENGTH_M[0] <= long <= _LENGTH_M[1] and _WIDTH_M[0] <= wide <= _WIDTH_M[1]):
        return None
    if not bool(scene.tile.holds(middle.x, middle.y)):
        return None
    ground = float(scene.ground.height_at(middle.x, middle.y))
    if not math.isfinite(ground):
        return None
    return {
        "ring": (ring + np.array(returns.corner_m)).tolist(), "ground_m": ground, "asset_height_m": top,
        "length_m": long, "width_m": wide, **seen_by(scene, rows),
    }  # fmt: skip


_NEAR_END_M: Final = 2.0  # Greatest distance of a box to the end of a line (m).
_LEAST_LINE_M: Final = 4.0
"""Least length of a shielded line (m)."""


class Attenuator(AssetKind):
    """Boxes within 2 m of an end of a guardrail or a barrier."""

    name = "attenuator"
    title = "Attenuator"
    curve = "surfaces"
    after = ("guardrail", "barrier")
    piece_schema = PIECE_SCHEMA

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns boxes of the tile."""
        return Evidence(boxes_of(scene))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields boxes at the end of a line that they shield."""
        lines = [o.geometry for kind in self.after for o in others.get(kind, ()) if o.geometry.length > _LEAST_LINE_M]
        if not lines:
            return
        ends = shapely.multipoints([end for line in lines for end in (line.coords[0][:2], line.coords[-1][:2])])
        for row in pieces.to_pylist():
            box = shapely.Polygon([(*p, row["ground_m"]) for p in row["ring"]])
            away = float(shapely.distance(shapely.force_2d(box), ends))
            if away > _NEAR_END_M:
                continue
            probability = logistic(0.0, [(-1.0, away), (0.02, min(row["returns"], 100))])
            values = {name: row[name] for name in ("asset_height_m", "length_m", "width_m")}
            yield AssetObject(
                box, 0.05, 0.03, probability, row["returns"], len(row["passes"]), row["first_epoch_gps_ns"],
                row["last_epoch_gps_ns"], values, 0.05,
            )  # fmt: skip
