"""Cubes of returns that hang in the air on a straight level line: what might be part of a wire."""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa
from scipy.spatial import cKDTree

from roadscan.assets import classes
from roadscan.assets.bins import in_bins
from roadscan.assets.scene import Box, Scene
from roadscan.assets.upright.pieces import seen_by
from roadscan.assets.wires.kernels.lines_through import lines_through
from roadscan.compute.array_types import Int64

CUBE_M: Final = 0.25
"""Edge of a cube (m). Cubes lie on the map's grid, so that no cut moves them."""
_LOWEST_M: Final = 3.0
"""Least height above the ground (m): lower wires hang over no way."""
_EDGE_M: Final = 4.0
"""Cubes so far (m) outside of a tile tell of the spans in it."""
_CROWD_CUBES: Final = 40
"""Cubes with returns among the 125 about one: three conductors side by side fill no more, foliage and fronts do."""
_CROWD: Final = 2.5  # Reach of those 125 (cubes).
_NEAR_M: Final = 1.5
"""Cubes up to this distance (m) tell of a line: a wire is straight to 2 mm over 3 m, with a sag of 0.5 m in 25 m."""
_LIMITS: Final = np.array([CUBE_M, 0.5, 0.35, 0.07, 0.15, 0.6])
"""Bin along a line (m); least distance of its second cube (m); greatest slope; radius (m), within which noise keeps the
middles of cubes; inner and outer radius of the tube (m) in which other things are counted."""
_LEAST_BINS: Final = 5
"""Least number of the twelve bins with returns on the line."""
_VEGETATION: Final = (classes.LOW_VEGETATION, classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION)
_NO_WIRE: Final = (classes.GROUND, classes.ROAD, classes.LOW_NOISE, classes.PERSON)
_LEVELS: Final = np.arange(2, 9)
"""Cubes below and above one (0.5 to 2.25 m) in which a wall, a crown or a roof shows itself."""
_MOST_CUBES: Final = 20
"""More of the 63 cubes below, or of those above, belong to a wall or a crown: a line in it is no wire."""
PIECE_SCHEMA: Final = pa.schema(
    [
        ("easting_m", pa.float64()), ("northing_m", pa.float64()), ("height_m", pa.float64()),
        ("clearance_m", pa.float64()), ("way_east", pa.float64()), ("way_north", pa.float64()),
        ("way_up", pa.float64()), ("filled", pa.int64()), ("beside", pa.int64()), ("crowd", pa.int64()),
        ("below", pa.int64()), ("above", pa.int64()), ("leafy", pa.float64()), ("returns", pa.int64()),
        ("passes", pa.list_(pa.int32())), ("first_epoch_gps_ns", pa.int64()), ("last_epoch_gps_ns", pa.int64()),
    ]
)  # fmt: skip
"""A row for each cube of a line. `filled` bins of the line; cubes `beside` it, in the `crowd` about it, `below` and
`above` it; `leafy` is the share of its returns that are vegetation."""


def thin_cubes(scene: Scene) -> tuple[pa.Table, list[Int64]]:
    """Returns the cubes that lie on a straight level line in the air, and the rows of each: of the tile and its edge.

    The edge of 4 m holds the least length of a span, so that the same returns are its own wherever squares are cut.
    """
    returns = scene.returns
    rows = np.flatnonzero((scene.above_ground_m >= _LOWEST_M) & ~np.isin(scene.classes, _NO_WIRE))
    if not rows.size:
        return PIECE_SCHEMA.empty_table(), []
    east, north = returns.corner_m
    xyh = np.column_stack([returns.x_m[rows], returns.y_m[rows], returns.height_m[rows]])
    cell = np.floor((xyh + np.array([east, north, 0.0])) / CUBE_M).astype(np.int64)
    low = cell.min(axis=0) - 1 - (_LEVELS[-1] + 1)
    _, columns, layers = cell.max(axis=0) + 2 + (_LEVELS[-1] + 1) - low
    packed = (cell - low) @ [columns * layers, layers, 1]  # one number a cube; that of a cube beside it is so much more
    cubes_with, first, own, number = np.unique(packed, return_index=True, return_inverse=True, return_counts=True)
    places = cell[first]
    middle = np.column_stack([np.bincount(own, xyh[:, k]) for k in range(3)]) / number[:, None]
    tile = scene.tile
    inside = Box(tile.x_min_m - _EDGE_M, tile.y_min_m - _EDGE_M, tile.x_max_m + _EDGE_M, tile.y_max_m + _EDGE_M).holds(
        middle[:, 0], middle[:, 1]
    )
    crowd = cKDTree(places).query_ball_point(places, _CROWD, p=np.inf, return_length=True)
    chosen = np.flatnonzero(inside & (crowd <= _CROWD_CUBES))
    about = cKDTree(middle).query_ball_point(middle[chosen], _NEAR_M, return_sorted=True)
    starts = np.cumsum([0, *map(len, about)])
    near = np.concatenate([np.asarray(one, np.int64) for one in about]) if len(about) else np.empty(0, np.int64)
    filled, beside = np.empty(chosen.size, np.int64), np.empty(chosen.size, np.int64)
    line = np.zeros((chosen.size, 3))
    lines_through(middle, chosen, starts, near, _LIMITS, filled, beside, line)
    steps = [(i * columns + j) * layers for i in (-1, 0, 1) for j in (-1, 0, 1)]
    below, above = (_filled(cubes_with, chosen, np.add.outer(steps, way * _LEVELS).ravel()) for way in (-1, 1))
    kept = np.flatnonzero((filled >= _LEAST_BINS) & (below <= _MOST_CUBES) & (above <= _MOST_CUBES))
    cubes = chosen[kept]
    bounds, order = in_bins(own.astype(np.int32), len(places))
    held = [rows[order[bounds[k] : bounds[k + 1]]] for k in cubes.tolist()]
    seen = [seen_by(scene, one) for one in held]
    ground = scene.ground.height_at(middle[cubes, 0], middle[cubes, 1])
    table = pa.table(
        {
            "easting_m": east + middle[cubes, 0], "northing_m": north + middle[cubes, 1],
            "height_m": middle[cubes, 2], "clearance_m": middle[cubes, 2] - ground,
            "way_east": line[kept, 0], "way_north": line[kept, 1], "way_up": line[kept, 2], "filled": filled[kept],
            "beside": beside[kept], "crowd": crowd[cubes], "below": below[kept], "above": above[kept],
            "leafy": [float(np.isin(scene.classes[one], _VEGETATION).mean()) for one in held],
            **{name: [one[name] for one in seen] for name in PIECE_SCHEMA.names[-4:]},
        },
        schema=PIECE_SCHEMA,
    )  # fmt: skip
    return table, held


def _filled(cubes_with: Int64, chosen: Int64, steps: Int64) -> Int64:
    """Returns how many of the cubes some steps from each chosen one (n,) hold returns; cubes are packed, ascending."""
    asked = cubes_with[chosen][:, None] + steps
    at = np.minimum(np.searchsorted(cubes_with, asked), cubes_with.size - 1)
    return np.asarray((cubes_with[at] == asked).sum(axis=1))
