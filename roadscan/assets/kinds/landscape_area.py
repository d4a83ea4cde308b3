"""Landscape areas: planted or grown areas beside the road."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import shapely
from pydantic import Field

from roadscan.assets import classes
from roadscan.assets.bins import cells_of, in_bins, sums_around
from roadscan.assets.green.colours import FINE, FINE_M
from roadscan.assets.kernels.low_returns import low_moments
from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.pass_heights import CellGrid, PassMoments, heights_of_one_pass_m, pass_moments
from roadscan.assets.scene import Scene
from roadscan.assets.upright.panels import panels_of
from roadscan.assets.upright.slices import touching
from roadscan.compute.array_types import Bool, Float32, Float64, Int64
from roadscan.core.extras import cv2
from roadscan.core.strict import Strict

CELL_M: Final = 0.25  # Edge of a cell (m).
_LEAST_RETURNS: Final = 6
"""Least number of returns of a cell with the eight around it."""
_LOW_M: Final = (-0.3, 1.0)
"""Heights above the ground of plants, and of the ground below them (m)."""
_LOW: Final = (
    classes.UNCLASSIFIED, classes.GROUND, classes.LOW_VEGETATION, classes.MEDIUM_VEGETATION, classes.ROAD,
)  # fmt: skip
_LONG_M: Final = 2.0
"""Upright surfaces longer than this (m) are rails, fences and walls."""
_WIDE: Final = np.ones((7, 7), np.uint8)
"""Walls, rails, kerbs and fences, with a cell to each side, are narrower than this (cells)."""
_SMOOTH: Final = 2
"""So many smooth cells in a square of that width are gaps between plants."""
_SEEN_SHARE: Final = 0.5
"""Share of the cells of such a square that must be seen, and rough."""
_GAP: Final = np.ones((5, 5), np.uint8)
"""Unseen cells between grown ones are filled in gaps narrower than this (cells): 1 m, as rings of sparse scanners leave
them."""
_WALL_M: Final = (1.0, 2.5)
"""Heights above the ground at which a wall stands (m): lower lie plants, and higher hang crowns."""
_CORE: Final = np.ones((5, 5), np.uint8)
"""Cells that are this far within an area, and so pool none outside, tell its level."""
_LEVELS: Final = 15
"""Edge of the square in which both sides of an edge are compared (cells): 3.75 m."""
_WHOLE_SHARE: Final = 1000.0
"""Shares are counted in thousandths, whose sums are exact."""
_MOST: Final = 0.5
"""Share of a cell's low returns that must lie on the road, so that it is no bed's."""
_RIM: Final = 3
"""Cells that a rim may be wide: what a beam returns behind the top of plants lies up to 0.75 m behind it."""
_RIM_LEVELS: Final = 7
"""Edge of the square whose grown cells tell how many returns one has (cells)."""
_THIN: Final = 0.4
"""A cell at the rim with less than this share of the returns of those around it is thin."""
_CROSS: Final = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
"""A cell and those that share a side with it."""
_MARGIN_M: Final = 15.0
"""Cells are judged so far beyond a tile (m), or as far as the kind reaches."""
_LARGEST_HOLE_M2: Final = 0.5  # Smaller holes in green ground are dry patches (m²).
_POOLED: Final = np.ones((3, 3), np.uint8)
"""A cell is judged with those around it, which widens areas by up to one."""
PIECE_SCHEMA: Final = pa.schema(
    [
        ("column", pa.int64()), ("row", pa.int64()), ("height_m", pa.float64()), ("probability", pa.float64()),
        ("returns", pa.int64()), ("passes", pa.list_(pa.int32())), ("first_epoch_gps_ns", pa.int64()),
        ("last_epoch_gps_ns", pa.int64()),
    ]
)  # fmt: skip
"""A row a cell of the map's grid of 0.25 m (easting // 0.25, northing // 0.25)."""


class LandscapeOptions(Strict):
    """What counts as a landscape area."""

    least_area_m2: float = Field(default=4.0, gt=0.0)
    """Smaller areas are left out (m²)."""
    rough_ratio: float = Field(default=3.0, gt=1.0)
    """A cell is grown over whose heights scatter this many times as much as the road's."""


def grown_cells(scene: Scene, options: LandscapeOptions) -> pa.Table:
    """Returns cells of the tile that are probably grown over: areas whose heights scatter more than the road's.

    Long upright surfaces are excluded, and so are narrow areas.
    """
    tile, window = scene.tile, scene.window
    margin = int(min(tile.x_min_m - window.x_min_m, _MARGIN_M) / CELL_M)
    corner = np.array([tile.x_min_m, tile.y_min_m]) - margin * CELL_M
    inner = tuple(round((high - low) / CELL_M) for low, high in
                  ((tile.y_min_m, tile.y_max_m), (tile.x_min_m, tile.x_max_m)))  # fmt: skip
    shape = (inner[0] + 2 * margin, inner[1] + 2 * margin)
    flat = _flat_ones(scene)
    grid = CellGrid(corner, CELL_M, shape)
    moments = pass_moments(scene, flat, np.array(_LOW_M), grid)
    even = _road_roughness_m(scene, moments, grid)
    if even is None:
        return PIECE_SCHEMA.empty_table()
    above = heights_of_one_pass_m(scene, flat, moments, options.rough_ratio * even, grid)
    off = np.abs(above) > options.rough_ratio * even
    sums = _sums(scene, above, flat, grid, off.astype(np.float32))
    counted, rough = _roughness(sums)
    ratio = rough / even
    wall = _cells_with(scene, classes.BUILDING, corner, shape, _WALL_M).view(np.uint8)
    wall = cv2.dilate(wall, _POOLED, iterations=2) > 0
    is_rough = counted & (ratio >= options.rough_ratio) & ~wall
    wide = _wide_ones(is_rough, (counted & ~is_rough) | wall, counted)
    driven = (scene.classes == classes.ROAD).astype(np.float32)
    every = _sums(scene, above, np.ones(flat.size, np.bool_), grid, driven)
    is_road = counted & (every[..., 3] >= _MOST * every[..., 0])
    grown = _up_to_edge(wide, is_rough, counted & ~is_rough & ~wall, sums[..., 0], sums[..., 3]) & ~is_road
    unseen = sums[..., 0] == 0
    grown = grown | (_closed(grown) & wide & unseen)
    inside = np.zeros(shape, np.bool_)
    inside[margin : margin + inner[0], margin : margin + inner[1]] = True
    grown = _without_thin_rim(grown, every[..., 0])
    return _table(scene, grown, inside, ratio / options.rough_ratio, corner)


def _closed(cells: Bool) -> Bool:
    """Returns cells (rows, columns) with the gaps between them."""
    return np.asarray(cv2.morphologyEx(cells.view(np.uint8), cv2.MORPH_CLOSE, _GAP) > 0)


def _wide_ones(rough: Bool, smooth: Bool, counted: Bool) -> Bool:
    """Returns cells (rows, columns) of rough ground that is wide.

    Cells that too few returns hit speak for neither side: those between rough ones belong to them.
    """
    size = _WIDE.shape[0]
    fits = (sums_around(smooth, size) <= _SMOOTH) & (sums_around(rough, size) >= _SEEN_SHARE * size**2)
    wide = (cv2.dilate(fits.view(np.uint8), _WIDE) > 0) & rough
    return np.asarray(_closed(wide) & (wide | ~counted))


def _up_to_edge(wide: Bool, rough: Bool, smooth: Bool, number: Float64, off: Float64) -> Bool:
    """Returns those of some cells (rows, columns) that lie on the grown side of the edge.

    It lies midway between the share of returns that are off the ground (`off`, of the `number` in a cell) within the
    area and on smooth ground beside it. Cells count alike: the front of a bed returns many more beams than the ground.
    """
    seen = number > 0
    share = sums_around(np.rint(_WHOLE_SHARE * off / np.maximum(number, 1.0)), 3) / np.maximum(
        sums_around(seen, 3), 1.0
    )
    share = np.rint(share)
    within = (cv2.erode(wide.view(np.uint8), _CORE) > 0) & (rough | smooth)
    beside = smooth & ~(cv2.dilate(wide.view(np.uint8), _POOLED) > 0)
    levels, known = [], []
    for cells in (within, beside):
        known.append(sums_around(cells, _LEVELS))
        levels.append(sums_around(np.where(cells, share, 0.0), _LEVELS) / np.maximum(known[-1], 1.0))
    return np.asarray(wide & seen & ((share >= 0.5 * (levels[0] + levels[1])) | (known[0] == 0.0)))


def _without_thin_rim(grown: Bool, number: Float64) -> Bool:
    """Returns cells (rows, columns) without those at the rim that few returns hit.

    Behind the top of plants or a rail a beam whose halves meet both returns from a place between them, on nothing.
    """
    for _ in range(_RIM):
        around = sums_around(np.where(grown, number, 0.0), _RIM_LEVELS) / np.maximum(
            sums_around(grown, _RIM_LEVELS), 1.0
        )
        rim = grown & ~(cv2.erode(grown.view(np.uint8), _CROSS, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0)
        grown = grown & ~(rim & (number < _THIN * around))
    return grown


def roughness_of_road_m(scene: Scene) -> float | None:
    """Returns the median scatter of the road's heights in pooled cells of a scene (m); None where it has no road."""
    box = scene.extent
    corner = np.array([box.x_min_m, box.y_min_m])
    shape = round((box.y_max_m - box.y_min_m) / CELL_M), round((box.x_max_m - box.x_min_m) / CELL_M)
    grid = CellGrid(corner, CELL_M, shape)
    return _road_roughness_m(scene, pass_moments(scene, _low_ones(scene), np.array(_LOW_M), grid), grid)


def _road_roughness_m(scene: Scene, moments: PassMoments, grid: CellGrid) -> float | None:
    """Returns how the heights of the survey's road scatter within passes (m): by this scene where it is not known."""

    def of_scene() -> Float64:
        road = _cells_with(scene, classes.ROAD, grid.corner, grid.shape, _LOW_M)
        return np.asarray(moments.scatter_m()[road & (moments.sums[:, 0].sum(axis=0) >= _LEAST_RETURNS)])

    return scene.statistics.of("road_roughness_m", 0.5, of_scene)


def _roughness(sums: Float64) -> tuple[Bool, Float64]:
    """Returns which cells (rows, columns) have enough returns around them, and how these scatter (m)."""
    pooled = [sums_around(sums[..., k], 3) for k in range(3)]
    n = np.maximum(pooled[0], 1.0)
    return pooled[0] >= _LEAST_RETURNS, np.sqrt(np.maximum(pooled[2] / n - (pooled[1] / n) ** 2, 1e-8))


def _low_ones(scene: Scene) -> Bool:
    """Returns a mask (n,) of the returns that are plants or ground."""
    low = np.zeros(256, np.bool_)
    low[list(_LOW)] = True
    return np.asarray(low[scene.classes])


def _flat_ones(scene: Scene) -> Bool:
    """Returns a mask (n,) of those that lie on no long upright surface."""
    counted = _low_ones(scene)
    for panel in panels_of(scene):
        if float(np.hypot(*np.diff(panel.xy_m, axis=0).T).sum()) > _LONG_M:
            counted[panel.rows] = False
    return counted


def _sums(scene: Scene, above_m: Float32, counted: Bool, grid: CellGrid, values: Float32) -> Float64:
    """Returns sums (rows, columns, 4) over the low returns of cells that count: n, Σh, Σh², and Σ of values (n,)."""
    sums, limits = np.zeros((*grid.shape, 4)), np.array(_LOW_M)
    low_moments(scene.returns.x_m, scene.returns.y_m, above_m, values, counted, limits, grid.corner, grid.cell_m, sums)
    return sums


def _cells_with(
    scene: Scene, code: int, corner: Float64, shape: tuple[int, int], between_m: tuple[float, float] | None = None
) -> Bool:
    """Returns a mask (rows, columns) of cells with returns of a class, at some heights above the ground (m)."""
    rows = np.flatnonzero(scene.classes == code)
    if between_m is not None:
        above = scene.above_ground_m[rows]
        rows = rows[(above >= between_m[0]) & (above <= between_m[1])]
    grid = (float(corner[0]), float(corner[1]), CELL_M)
    cell = cells_of(scene.returns.x_m[rows], scene.returns.y_m[rows], grid, shape)
    out = np.zeros(shape[0] * shape[1], np.bool_)
    out[cell[cell >= 0]] = True
    return out.reshape(shape)


def _table(scene: Scene, grown: Bool, inside: Bool, ratio: Float64, corner: Float64) -> pa.Table:
    """Returns rows of the grown cells that lie inside, by row and column."""
    returns, columns = scene.returns, grown.shape[1]
    low = np.flatnonzero((scene.above_ground_m >= _LOW_M[0]) & (scene.above_ground_m <= _LOW_M[1]))
    grid = (float(corner[0]), float(corner[1]), CELL_M)
    cell = cells_of(returns.x_m[low], returns.y_m[low], grid, grown.shape)
    # What no return hit is as what lies up to two cells from it, beyond the tile too.
    some = np.flatnonzero(grown & (cv2.dilate(inside.view(np.uint8), _GAP) > 0))
    number = np.full(grown.size + 1, -1, np.int32)
    number[some] = np.arange(some.size)
    starts, order = in_bins(number[cell], some.size)
    row, column = some // columns, some % columns
    middle = [corner[k] + (v + 0.5) * CELL_M for k, v in enumerate((column, row))]
    height = scene.ground.height_at(*middle)
    rows, count = low[order], np.diff(starts)
    epochs, seen_by = returns.epoch_gps_ns[rows], returns.pass_id[rows]
    probability = ratio[row, column] ** 2 / (1.0 + ratio[row, column] ** 2)
    first, last = np.zeros(some.size, np.int64), np.zeros(some.size, np.int64)
    passes: list[list[int]] = [[] for _ in range(some.size)]
    for k in np.flatnonzero(count).tolist():
        span = slice(int(starts[k]), int(starts[k + 1]))
        first[k], last[k] = epochs[span].min(), epochs[span].max()
        passes[k] = np.unique(seen_by[span]).tolist()
    for k in np.flatnonzero(count == 0).tolist():
        near = np.flatnonzero((count > 0) & (np.abs(row - row[k]) <= 2) & (np.abs(column - column[k]) <= 2))
        if near.size:
            first[k], last[k], probability[k] = first[near].min(), last[near].max(), np.mean(probability[near])
            passes[k] = sorted({one for other in near.tolist() for one in passes[other]})
    kept = np.flatnonzero(np.isfinite(height) & inside[row, column] & np.array([len(p) > 0 for p in passes], np.bool_))
    east, north = (round((returns.corner_m[k] + corner[k]) / CELL_M) for k in (0, 1))
    return pa.table(
        {
            "column": east + column[kept], "row": north + row[kept], "height_m": height[kept],
            "probability": probability[kept], "returns": count[kept],
            "passes": pa.array([passes[k] for k in kept.tolist()], pa.list_(pa.int32())),
            "first_epoch_gps_ns": first[kept], "last_epoch_gps_ns": last[kept],
        },
        PIECE_SCHEMA,
    )  # fmt: skip


WHOLE: Final = (1 << FINE * FINE) - 1
"""The mask of a cell that belongs to its area as a whole."""


def components(column: Int64, row: Int64) -> list[Int64]:
    """Returns numbers of the cells of each area: cells that share a side; areas by their first cell (row, column)."""
    if column.size == 0:
        return []
    order = np.lexsort((column, row))
    width = int(column.max() - column.min()) + 3
    flat = (row[order] - row.min()) * width + (column[order] - column.min())
    label = touching(flat, (1, width))
    by_label = np.argsort(label, kind="stable")
    parts = np.split(order[by_label], np.flatnonzero(np.diff(label[by_label])) + 1)
    return sorted(parts, key=lambda p: (int(row[p[0]]), int(column[p[0]])))


def area_of(column: Int64, row: Int64, cell_m: float = CELL_M) -> shapely.Geometry:
    """Returns the union of cells of the map's grid (easting and northing, m)."""
    order = np.lexsort((column, row))
    column, row = column[order], row[order]
    ends = np.flatnonzero((np.diff(column) != 1) | (np.diff(row) != 0))
    first, last = np.append(0, ends + 1), np.append(ends, column.size - 1)
    runs = shapely.box(column[first] * cell_m, row[first] * cell_m, (column[last] + 1) * cell_m,
                       (row[first] + 1) * cell_m)  # fmt: skip
    return shapely.union_all(runs, grid_size=1e-3)


def through_middles(shape: shapely.Geometry) -> shapely.Geometry:
    """Returns an area of cells whose outline goes through the middles of the cells' sides.

    So steps lie at both sides of a slant line, half a cell away, and simplifying shifts no side by a whole one.
    """
    parts = []
    sides = shapely.segmentize(shape, 1.01 * CELL_M)
    for one in getattr(sides, "geoms", [sides]):
        rings = [shapely.get_coordinates(ring) for ring in (one.exterior, *one.interiors)]
        rings = [0.5 * (ring[:-1] + ring[1:]) for ring in rings]
        parts.append(shapely.Polygon(rings[0], rings[1:]))
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)


class Outline(NamedTuple):
    """The shape of an area on the map (m), by how much it may be simplified, and 1 σ of its edge (m)."""

    shape: shapely.Geometry
    simple_m: float
    sigma_m: float


def outline_of(pieces: pa.Table, cells: Int64) -> Outline:
    """Returns the outline of some cells; parts of cells are known of those that pictures show."""
    column, row = (np.asarray(pieces[name])[cells] for name in ("column", "row"))
    if "mask" not in pieces.column_names:
        return Outline(through_middles(area_of(column, row)), 0.52 * CELL_M, CELL_M)
    mask, sigma = (np.asarray(pieces[name])[cells] for name in ("mask", "sigma_m"))
    if (mask == WHOLE).all() and (sigma == CELL_M).all():
        return Outline(through_middles(area_of(column, row)), 0.52 * CELL_M, CELL_M)
    bit = np.arange(FINE * FINE)
    held, part = np.nonzero((mask[:, None] >> bit) & 1)
    fine = column[held] * FINE + part % FINE, row[held] * FINE + part // FINE
    number = row * (1 << 32) + column
    around = [np.isin(number + step, number) for step in (1, -1, 1 << 32, -(1 << 32))]
    edge = ~np.all(around, axis=0) | (mask != WHOLE)
    return Outline(
        without_small_holes(area_of(*fine, cell_m=FINE_M)),
        1.04 * FINE_M,
        float(np.sqrt(np.mean(np.square(sigma[edge if edge.any() else ~edge])))),
    )


def without_small_holes(shape: shapely.Geometry) -> shapely.Geometry:
    """Returns an area without holes that are as small as a dry patch."""
    parts = [
        shapely.Polygon(one.exterior, [r for r in one.interiors if shapely.Polygon(r).area > _LARGEST_HOLE_M2])
        for one in getattr(shape, "geoms", [shape])
    ]
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)


def cells_with_green(pieces: pa.Table, green: pa.Table) -> pa.Table:
    """Returns cells of landscape areas with `mask` and `sigma_m`, by row and column: those that are grown over, whole
    unless pictures show green ground beside them, and those that are green.
    """
    number, other = (t["row"].to_numpy() * (1 << 32) + t["column"].to_numpy() for t in (pieces, green))
    shown = np.isin(number, other)
    own = pieces.filter(pa.array(~shown))
    own = own.append_column("mask", pa.array(np.full(own.num_rows, WHOLE, np.int32)))
    own = own.append_column("sigma_m", pa.array(np.full(own.num_rows, CELL_M)))
    planted = green.filter(pa.array(green["mask"].to_numpy() != 0))
    both = pa.concat_tables([own, planted.select(own.column_names)])
    return both.sort_by([("row", "ascending"), ("column", "ascending")])


class LandscapeArea(AssetKind):
    """Areas of cells that are grown over, or green in pictures; one may lie within a sidewalk's."""

    name = "landscape_area"
    title = "Landscape Areas"
    curve = "areas"
    options = LandscapeOptions
    piece_schema = PIECE_SCHEMA
    sees_green = True
    reach_m = 11.0

    def evidence(self, scene: Scene, options: LandscapeOptions) -> Evidence:
        """Returns cells of the tile."""
        return Evidence(grown_cells(scene, options))

    def with_pictures(self, pieces: pa.Table, shown: pa.Table) -> pa.Table:
        """Returns cells that are grown over or green, with the parts of each that belong to the area, and σ."""
        return cells_with_green(pieces, shown)

    def objects(
        self, pieces: pa.Table, options: LandscapeOptions, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields a polygon for each area."""
        columns = {n: np.asarray(pieces[n]) for n in ("column", "row", "height_m", "probability", "returns")}
        first, last = np.asarray(pieces["first_epoch_gps_ns"]), np.asarray(pieces["last_epoch_gps_ns"])
        passes = pieces["passes"].to_pylist()
        for cells in components(columns["column"], columns["row"]):
            outline = outline_of(pieces, cells)
            height = float(np.mean(columns["height_m"][cells]))
            shown = cells[columns["returns"][cells] > 0]
            for polygon in getattr(outline.shape, "geoms", [outline.shape]) if shown.size else ():
                if polygon.area >= options.least_area_m2:
                    yield AssetObject(
                        shapely.force_3d(polygon.simplify(outline.simple_m), height), outline.sigma_m, 0.05,
                        float(np.mean(columns["probability"][cells])), int(columns["returns"][cells].sum()),
                        len({p for i in cells.tolist() for p in passes[i]}), int(first[shown].min()),
                        int(last[shown].max()), {"area_m2": float(polygon.area)},
                    )  # fmt: skip
