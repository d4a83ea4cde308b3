"""Edges of the carriageway on both sides of a drive, and the surface on the higher side of an edge."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import scipy.ndimage
import scipy.spatial
import shapely

from roadscan.assets import classes
from roadscan.assets.edges.find import free_edges
from roadscan.assets.edges.line_pieces import (
    NODE_COLUMNS,
    CutEdge,
    columns_of,
    cut_at,
    dense_by_node,
    line_schema,
    pieces_table,
)
from roadscan.assets.edges.profiles import smooth_line, stops
from roadscan.assets.edges.steps import HeightRaster, gaussian, raster_of
from roadscan.assets.kernels import step_profiles
from roadscan.assets.scene import Scene, once_a_scene, once_a_tile
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.edges import edge_along, moved_cells

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


STATION_M: Final = 0.5  # Distance of stations along the drive (m).
_LATTICE_M: Final = 3.0
"""Stations lie where the drive crosses a lattice of this edge (m), and evenly between: wherever it enters a scene."""
_WITHIN_M: Final = 7.0
"""Edges this far along the drive (m) tell where one lies: with the mean of its evidence, 5 m, and the window of a step,
1 m, they lie within the halo of a square."""
NEAREST_M: Final = 0.8  # Edges are sought from this distance to the drive (m) …
FARTHEST_M: Final = 14.0
"""… to this distance (m)."""
SAME_ROAD_M: Final = 8.0
"""A drive this near (m) to an earlier one is on the same road: its edges are found from the earlier."""
KERB_EVIDENCE: Final = 6.0  # Evidence of a cell at a kerb.
BARRIER_EVIDENCE: Final = 3.0  # Evidence of a cell where something stands.
LEAST_EVIDENCE: Final = 0.6  # Least evidence of an edge at a station.
_FEWEST: Final = 5  # Stations of an edge.
_AT_KERB_M: Final = 0.4  # An edge so near to its kerb (m) lies on it.
_INSIDE_M: Final = (0.45, 0.95)
"""The height of an edge follows from the road this far inside it (m, from and to)."""
EDGE_COLUMNS: Final = (*NODE_COLUMNS, "by_surface", "by_kerb", "by_barrier", "right", "evidence")


class Track(NamedTuple):
    """Stations of a drive: places (n, 2) and unit vectors (n, 2) along it."""

    places: Float64
    heading: Float64


def tracks_of(drive_xyh_m: Float64) -> Iterator[Track]:
    """Yields stations each half metre of each pass, where no earlier pass drove beside it."""
    earlier = np.zeros((0, 2))
    for number in np.unique(drive_xyh_m[:, 3]):
        driven = drive_xyh_m[drive_xyh_m[:, 3] == number, :2]
        step = np.hypot(*np.diff(driven, axis=0).T) if len(driven) > 1 else np.zeros(0)
        driven = driven[np.append(True, step > 0.02)]
        if len(driven) < 2 or float(np.hypot(*np.diff(driven, axis=0).T).sum()) < 2.0 * STATION_M:
            continue
        # A jump means that the vehicle left the window between.
        jumps = np.flatnonzero(np.hypot(*np.diff(driven, axis=0).T) > 5.0) + 1
        for part in np.split(driven, jumps):
            if len(part) >= 2:
                yield from _stations(part, earlier)
        earlier = np.concatenate([earlier, driven])


def _stations(part: Float64, earlier: Float64) -> Iterator[Track]:
    places = stops(part, STATION_M, _LATTICE_M)
    smooth = scipy.ndimage.gaussian_filter1d(places, 4.0, axis=0, mode="nearest", truncate=2.0)
    heading = np.gradient(smooth, axis=0)
    heading /= np.maximum(np.hypot(*heading.T), 1e-9)[:, None]
    free = np.ones(len(places), np.bool_)
    if len(earlier):
        free = scipy.spatial.cKDTree(earlier).query(places)[0] > SAME_ROAD_M
    number, count = scipy.ndimage.label(free)
    for k in range(1, count + 1):
        rows = number == k
        if rows.sum() >= 4:
            yield Track(places[rows], heading[rows])


@once_a_tile
def road_edges(scene: Scene) -> list[CutEdge]:
    """Edges beside the drives within the scene's tile: nodes (n, `EDGE_COLUMNS`) in the direction of the drive."""
    return [part for nodes in _edges_of_drives(scene) for part in cut_at(nodes, scene.tile)]


@once_a_scene
def _edges_of_drives(scene: Scene) -> list[Float64]:
    """Returns the same of the whole scene."""
    raster = raster_of(scene)
    if len(scene.drive_xyh_m) < 2 or not (raster.count > 0).any():
        return []
    kerbs = shapely.STRtree([shapely.LineString(columns_of(edge)[:, :2]) for edge in free_edges(scene)])
    found: list[Float64] = []
    for track in tracks_of(scene.drive_xyh_m):
        for right in (False, True):
            found += _one_side(track, right, scene, kerbs)
    return found


def _one_side(track: Track, right: bool, scene: Scene, kerbs: shapely.STRtree) -> Iterator[Float64]:
    """Yields runs of nodes of one side's edge."""
    raster, beside = raster_of(scene), beside_of(scene)
    out = np.column_stack([track.heading[:, 1], -track.heading[:, 0]]) * (1.0 if right else -1.0)
    offset = np.arange(NEAREST_M, FARTHEST_M, raster.cell_m)
    x = track.places[:, :1] + offset * out[:, :1]
    y = track.places[:, 1:] + offset * out[:, 1:]
    row, column = raster.cells_of(x, y)
    height = beside.height_m[row, column]
    inside = (x >= raster.x_min_m) & (y >= raster.y_min_m)
    inside &= x < raster.x_min_m + raster.count.shape[1] * raster.cell_m
    inside &= y < raster.y_min_m + raster.count.shape[0] * raster.cell_m
    height = np.where(inside, height, np.nan)
    up = np.zeros(height.shape, np.bool_)
    # Kerbs are one cell wide: with steps of a whole cell a transect could miss some between two samples.
    for step in (0.0, raster.cell_m / 2):
        r, c = raster.cells_of(x + step * out[:, :1], y + step * out[:, 1:])
        up |= beside.edge_x[r, c] * out[:, :1] + beside.edge_y[r, c] * out[:, 1:] > 0.5
    stands = beside.blocked[row, column] & inside
    behind = np.cumsum(stands, axis=1) > 3
    known = np.where(up & inside, KERB_EVIDENCE, np.where(stands & ~behind, BARRIER_EVIDENCE, 0.0))
    height = np.where(behind, np.nan, height)
    sigma = np.full(height.shape, 0.008)
    found = edge_along(height, sigma, (STATION_M, raster.cell_m), known, within_m=_WITHIN_M)
    at = np.arange(len(offset))[None, :] == found.cell[:, None]
    near = scipy.ndimage.binary_dilation(at, np.ones((1, 5)))
    by_kerb = scipy.ndimage.median_filter((near & up).any(axis=1).astype(np.float64), 5)
    by_barrier = scipy.ndimage.median_filter((near & stands).any(axis=1).astype(np.float64), 5)
    lines = np.column_stack([np.take_along_axis(a, found.cell[:, None], axis=1)[:, 0] for a in (x, y)])
    good = (found.evidence.round(6) >= LEAST_EVIDENCE) & np.take_along_axis(inside, found.cell[:, None], axis=1)[:, 0]
    for rows in _runs(good, found.cell, moved_cells(raster.cell_m)):
        line = _snapped(smooth_line(lines[rows], np.ones(len(rows))), by_kerb[rows] > 0.5, kerbs)
        level = _road_level(line, out[rows], beside, scene)
        nodes = np.zeros((len(rows), len(EDGE_COLUMNS)))
        nodes[:, 3:5] = np.nan
        nodes[:, :3] = np.column_stack([line, level])
        nodes[:, EDGE_COLUMNS.index("sigma_m")] = np.where(by_kerb[rows] > 0.5, 0.02, 0.15)
        nodes[:, EDGE_COLUMNS.index("seen")] = 1.0
        nodes[:, -4:] = np.column_stack(
            [by_kerb[rows], by_barrier[rows], np.full(len(rows), float(right)), found.evidence[rows]]
        )
        yield nodes


def _runs(good: Bool, cell: Int64, moved: int) -> Iterator[Int64]:
    """Yields the rows of five stations or more in a run; where another edge is nearer to the best, a run ends."""
    begins = np.append(True, np.abs(np.diff(cell)) > moved) | ~good
    number = np.cumsum(begins)
    for one in np.unique(number[good]).tolist():
        rows = np.flatnonzero((number == one) & good)
        if len(rows) >= _FEWEST:
            yield rows


def _road_level(line: Float64, out: Float64, beside: Beside, scene: Scene) -> Float64:
    """Returns heights (n,) of the road at points (n, 2) of its edge, extrapolated from inside."""
    raster = raster_of(scene)
    near, far = (beside.height_m[raster.cells_of(*(line - away * out).T)] for away in _INSIDE_M)
    level = near + (near - far) * _INSIDE_M[0] / (_INSIDE_M[1] - _INSIDE_M[0])
    here = beside.height_m[raster.cells_of(*line.T)]
    for other in (near, here, scene.ground.height_at(*line.T), np.nanmedian(beside.height_m)):
        level = np.where(np.isfinite(level), level, other)
    return level


def _snapped(line: Float64, at_kerb: Bool, kerbs: shapely.STRtree) -> Float64:
    """Returns points (n, 2) of a line, those at a kerb moved onto it."""
    moved, rows = line.copy(), np.flatnonzero(at_kerb)
    near, at = kerbs.query_nearest(shapely.points(line[rows]), max_distance=_AT_KERB_M, all_matches=False)
    ways = shapely.shortest_line(shapely.points(line[rows[near]]), kerbs.geometries[at])
    moved[rows[near]] = shapely.get_coordinates(ways).reshape(-1, 2, 2)[:, 1]
    return moved
