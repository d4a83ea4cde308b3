"""The surface on the higher side of an edge, and the rasters that ways across it look at."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa

from roadscan.assets import classes
from roadscan.assets.edges.find import free_edges
from roadscan.assets.edges.line_pieces import (
    NODE_COLUMNS,
    columns_of,
    cut_at,
    dense_by_node,
    line_schema,
    pieces_table,
)
from roadscan.assets.edges.steps import HeightRaster, gaussian, raster_of
from roadscan.assets.kernels import step_profiles
from roadscan.assets.scene import Scene, once_a_scene, once_a_tile
from roadscan.compute.array_types import Bool, Float64

FIRST_M: Final = 0.3
"""The transect begins this far (m) behind the middle of the edge's face."""
REACH_M: Final = 7.0
"""A surface is followed this far (m) from its edge; tiles need a halo of a metre more."""
HOLE_M: Final = 0.8  # A surface ends at a hole of this width (m).
SLOPE: Final = 0.15  # A steeper surface ends (m/m).
ROUGH_M: Final = 0.03  # A rougher surface ends (m).
OBSTACLE_M: Final = (0.35, 2.2)
"""An object between these heights above the ground (m) ends a surface."""
TRANSECT_COLUMNS: Final = ("width_m", "ends_down", "ends_known", "outer_height_m", "slope", "middle_height_m")
BESIDE_PIECES: Final = line_schema((*NODE_COLUMNS, *TRANSECT_COLUMNS))
"""Columns of a line's piece, and at each node the surface behind it: width, whether an edge down ends it and whether
its end is known (0 or 1), height at its end and in its middle, and slope outward."""
_OPEN: Final = (classes.VEHICLE, classes.PERSON, classes.LOW_NOISE, classes.HIGH_NOISE)


class Beside(NamedTuple):
    """Rasters (rows, columns) that transects cross."""

    height_m: Float64
    rough_m: Float64
    blocked: Bool
    edge_x: Float64
    edge_y: Float64


@once_a_tile
def pieces_beside(scene: Scene) -> pa.Table:
    """Returns rows of `BESIDE_PIECES`: the scene's edges within its tile with the surface on their higher side."""
    parts = [part for nodes in _edges_with_transects(scene) for part in cut_at(nodes, scene.tile)]
    return pieces_table(parts, scene, raster_of(scene), BESIDE_PIECES)


@once_a_scene
def _edges_with_transects(scene: Scene) -> list[Float64]:
    raster, edges = raster_of(scene), free_edges(scene)
    return [_with_transects(columns_of(edge), beside_of(scene), raster) for edge in edges]


@once_a_scene
def beside_of(scene: Scene) -> Beside:
    """Returns rasters of a scene for transects that end at its edges."""
    raster = raster_of(scene)
    known = raster.count > 0
    height = smooth(np.where(known, raster.height_m, 0.0), known, 1.5)
    rest = np.where(known, np.square(np.where(known, raster.height_m, 0.0) - np.nan_to_num(height)), 0.0)
    rough = np.sqrt(np.nan_to_num(smooth(rest, known, 3.0)))
    edge_x, edge_y = np.zeros(known.shape), np.zeros(known.shape)
    for edge in free_edges(scene):
        x, y = dense_by_node(columns_of(edge)[:, :2], raster.cell_m / 2)
        ux, uy = np.gradient(x), np.gradient(y)
        length = np.maximum(np.hypot(ux, uy), 1e-9)
        row, column = raster.cells_of(x, y)
        edge_x[row, column], edge_y[row, column] = uy / length, -ux / length
    return Beside(height, rough, _blocked(scene, raster), edge_x, edge_y)


def smooth(values: Float64, known: Bool, sigma_cells: float) -> Float64:
    """Returns the mean (rows, columns) of known values around each cell; NaN where none is near."""
    weight = gaussian(known.astype(np.float64), sigma_cells, 2.5)
    total = gaussian(values, sigma_cells, 2.5)
    return np.where(weight > 0.02, total / np.maximum(weight, 0.02), np.nan)


def _blocked(scene: Scene, raster: HeightRaster) -> Bool:
    """Returns a mask of cells where two returns or more stand above the ground."""
    above, closed = scene.above_ground_m, np.ones(256, np.bool_)
    closed[list(_OPEN)] = False
    stands = (above > OBSTACLE_M[0]) & (above < OBSTACLE_M[1]) & closed[scene.classes] & (raster.cell >= 0)
    number = np.bincount(raster.cell[stands], minlength=raster.count.size)
    return np.asarray(number.reshape(raster.count.shape) >= 2)


def _with_transects(nodes: Float64, beside: Beside, raster: HeightRaster) -> Float64:
    """Returns nodes (n, columns) with the columns of the surface behind them."""
    ux, uy = np.gradient(nodes[:, 0]), np.gradient(nodes[:, 1])
    length = np.maximum(np.hypot(ux, uy), 1e-9)
    start = np.column_stack([nodes[:, :2], uy / length, -ux / length])
    out = np.empty((len(nodes), step_profiles.TRANSECT_RESULTS))
    grid: Any = (raster.x_min_m, raster.y_min_m, raster.cell_m)
    step_profiles.walk(start, *beside, grid, (FIRST_M, REACH_M, HOLE_M, SLOPE, ROUGH_M), out)
    end = out[:, step_profiles.END]
    known = np.isin(end, (step_profiles.OBSTACLE, step_profiles.STEP_DOWN, step_profiles.STEP_UP, step_profiles.BENT))
    return np.column_stack([
        nodes, out[:, step_profiles.WIDTH], end == step_profiles.STEP_DOWN, known, out[:, step_profiles.OUTER_HEIGHT],
        out[:, step_profiles.SLOPE], out[:, step_profiles.MIDDLE_HEIGHT],
    ])  # fmt: skip
