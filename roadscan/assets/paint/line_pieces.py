"""Pieces of painted lines in a tile: straight, and cut at the tile's border."""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.assets.paint.detection import Paint
from roadscan.assets.paint.stripes import Stripe
from roadscan.assets.scene import Box, Scene
from roadscan.compute.array_types import Float64

LINE_PIECES: Final = pa.schema(
    [
        *(pa.field(f"{end}_{axis}_m", pa.float64()) for end in ("begin", "end") for axis in ("x", "y", "height")),
        pa.field("begin_seen", pa.bool_()),
        pa.field("end_seen", pa.bool_()),
        pa.field("width_m", pa.float64()),
        pa.field("contrast", pa.float64()),
        pa.field("sigma_across_m", pa.float64()),
        pa.field("sigma_height_m", pa.float64()),
        pa.field("probability", pa.float64()),
        pa.field("returns", pa.int64()),
        pa.field("passes", pa.list_(pa.uint16())),
        pa.field("first_epoch_gps_ns", pa.int64()),
        pa.field("last_epoch_gps_ns", pa.int64()),
    ]
)
"""A straight piece of a line: its ends in the map, and whether bare ground was seen beyond them."""

_SHORTEST_M: Final = 0.01  # Shorter pieces are left out (m).


def line_pieces(scene: Scene, paint: Paint) -> pa.Table:
    """Returns pieces of lines within the scene's tile, in the order of the paint's lines."""
    rows = [piece for stripe in paint.lines if (piece := _piece(scene, paint, stripe)) is not None]
    return pa.Table.from_pylist(rows, schema=LINE_PIECES)


def _piece(scene: Scene, paint: Paint, stripe: Stripe) -> dict[str, object] | None:
    """Returns the part of a stripe in the tile."""
    span = _within(stripe, scene.tile)
    if span is None:
        return None
    begin, end = stripe.at(span[0]), stripe.at(span[1])
    found, returns = paint.contrast, scene.returns
    along, _ = stripe.coordinates(found.x_m[stripe.returns], found.y_m[stripe.returns])
    own = stripe.returns[(along >= span[0]) & (along <= span[1])]
    seen = returns.at(found.rows[own if own.size else stripe.returns])
    heights = scene.ground.height_at([begin[0], end[0]], [begin[1], end[1]])
    east, north = returns.corner_m
    return {
        "begin_x_m": east + begin[0], "begin_y_m": north + begin[1], "begin_height_m": float(heights[0]),
        "end_x_m": east + end[0], "end_y_m": north + end[1], "end_height_m": float(heights[1]),
        "begin_seen": stripe.begin_seen and span[0] == stripe.begin_m,
        "end_seen": stripe.end_seen and span[1] == stripe.end_m,
        "width_m": stripe.width_m,
        "contrast": stripe.contrast,
        "sigma_across_m": stripe.sigma_across_m,
        "sigma_height_m": height_sigma(seen.height_m - scene.ground.height_at(seen.x_m, seen.y_m)),
        "probability": stripe.probability,
        "returns": len(seen) if own.size else 0,
        "passes": [int(p) for p in np.unique(seen.pass_id)],
        "first_epoch_gps_ns": int(seen.epoch_gps_ns.min()),
        "last_epoch_gps_ns": int(seen.epoch_gps_ns.max()),
    }  # fmt: skip


def height_sigma(above_m: Float64) -> float:
    """Returns 1 σ (m) of the mean height of returns (n,) that lie this high above the ground model."""
    if above_m.size < 2:
        return 0.05
    return float(np.std(above_m) / np.sqrt(above_m.size) + abs(float(np.median(above_m))))


def _within(stripe: Stripe, box: Box) -> tuple[float, float] | None:
    """Returns where the centre line runs inside a box (Liang and Barsky, 1984), from its middle; None outside."""
    low, high = stripe.begin_m, stripe.end_m
    for axis, (least, greatest) in enumerate(((box.x_min_m, box.x_max_m), (box.y_min_m, box.y_max_m))):
        place, step = float(stripe.middle_m[axis]), float(stripe.along[axis])
        if abs(step) < 1e-12:
            if not least <= place < greatest:
                return None
            continue
        near, far = sorted(((least - place) / step, (greatest - place) / step))
        low, high = max(low, near), min(high, far)
    return (low, high) if high - low >= _SHORTEST_M else None
