"""Landscape areas: planted or grown areas beside the road."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import shapely
from pydantic import Field

from roadscan.assets import classes
from roadscan.assets.bins import cells_of, in_bins
from roadscan.assets.green.colours import FINE, FINE_M
from roadscan.assets.kernels.low_returns import low_moments
from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.scene import Scene
from roadscan.assets.upright.panels import panels_of
from roadscan.assets.upright.slices import touching
from roadscan.compute.array_types import Bool, Float64, Int64
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
_MARGIN_M: Final = 15.0
"""Cells are judged so far beyond a tile (m): openings and pools reach three metres."""
_LARGEST_HOLE_M2: Final = 0.5  # Smaller holes in green ground are dry patches (m²).
_POOLED: Final = np.ones((3, 3), np.uint8)
"""A cell is judged with those around it, which widens areas by one."""
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

    Long upright surfaces are excluded, and an opening removes narrow areas.
    """
    tile, window = scene.tile, scene.window
    margin = int(min(tile.x_min_m - window.x_min_m, _MARGIN_M) / CELL_M)
    corner = np.array([tile.x_min_m, tile.y_min_m]) - margin * CELL_M
    inner = tuple(round((high - low) / CELL_M) for low, high in
                  ((tile.y_min_m, tile.y_max_m), (tile.x_min_m, tile.x_max_m)))  # fmt: skip
    shape = (inner[0] + 2 * margin, inner[1] + 2 * margin)
    sums = _sums(scene, _flat_ones(scene), corner, shape)
    counted, rough = _roughness(sums)
    road = _cells_with(scene, classes.ROAD, corner, shape) & counted
    even = road_roughness_m(scene, rough, road)
    if even is None:
        return PIECE_SCHEMA.empty_table()
    ratio = rough / even
    chosen = (counted & (ratio >= options.rough_ratio)).astype(np.uint8)
    walls = _cells_with(scene, classes.BUILDING, corner, shape).view(np.uint8)
    chosen[cv2.dilate(walls, _POOLED, iterations=2) > 0] = 0
    chosen = cv2.erode(cv2.morphologyEx(chosen, cv2.MORPH_OPEN, _WIDE), _POOLED)
    grown = (chosen > 0) & ~road & (sums[..., 0] > 0)
    edge = np.zeros(shape, np.bool_)
    edge[margin : margin + inner[0], margin : margin + inner[1]] = True
    return _table(scene, grown & edge, ratio / options.rough_ratio, corner)


def roughness_of_road_m(scene: Scene) -> float | None:
    """Returns the median scatter of the road's heights in pooled cells of a scene (m); None where it has no road."""
    box = scene.extent
    corner = np.array([box.x_min_m, box.y_min_m])
    shape = round((box.y_max_m - box.y_min_m) / CELL_M), round((box.x_max_m - box.x_min_m) / CELL_M)
    counted, rough = _roughness(_sums(scene, _low_ones(scene), corner, shape))
    return road_roughness_m(scene, rough, _cells_with(scene, classes.ROAD, corner, shape) & counted)


def road_roughness_m(scene: Scene, rough_m: Float64, road: Bool) -> float | None:
    """Returns the scatter of the heights of the survey's road (m), from cells (rows, columns) where it is not known."""
    return scene.statistics.of("road_roughness_m", 0.5, lambda: rough_m[road])


def _roughness(sums: Float64) -> tuple[Bool, Float64]:
    """Returns which cells (rows, columns) have enough returns around them, and how these scatter (m)."""
    pooled = [cv2.boxFilter(s, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
              for s in np.moveaxis(sums[..., :3], -1, 0)]  # fmt: skip
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


def _sums(scene: Scene, counted: Bool, corner: Float64, shape: tuple[int, int]) -> Float64:
    returns = scene.returns
    sums = np.zeros((*shape, 4))
    limits = np.array(_LOW_M)
    low_moments(
        returns.x_m, returns.y_m, scene.above_ground_m, returns.intensity, counted, limits, corner, CELL_M, sums
    )
    return sums


def _cells_with(scene: Scene, code: int, corner: Float64, shape: tuple[int, int]) -> Bool:
    """Returns a mask (rows, columns) of cells with returns of a class."""
    rows = np.flatnonzero(scene.classes == code)
    grid = (float(corner[0]), float(corner[1]), CELL_M)
    cell = cells_of(scene.returns.x_m[rows], scene.returns.y_m[rows], grid, shape)
    out = np.zeros(shape[0] * shape[1], np.bool_)
    out[cell[cell >= 0]] = True
    return out.reshape(shape)


def _table(scene: Scene, chosen: Bool, ratio: Float64, corner: Float64) -> pa.Table:
    """Returns rows of the chosen cells, by row and column."""
    returns, columns = scene.returns, chosen.shape[1]
    low = np.flatnonzero((scene.above_ground_m >= _LOW_M[0]) & (scene.above_ground_m <= _LOW_M[1]))
    grid = (float(corner[0]), float(corner[1]), CELL_M)
    cell = cells_of(returns.x_m[low], returns.y_m[low], grid, chosen.shape)
    held = np.flatnonzero(chosen.ravel())
    number = np.full(chosen.size + 1, -1, np.int32)
    number[held] = np.arange(held.size)
    starts, order = in_bins(number[cell], held.size)
    row, column = held // columns, held % columns
    middle = [corner[k] + (v + 0.5) * CELL_M for k, v in enumerate((column, row))]
    height = scene.ground.height_at(*middle)
    kept = np.flatnonzero(np.isfinite(height) & (np.diff(starts) > 0))
    rows = low[order]
    epochs, passes = returns.epoch_gps_ns[rows], returns.pass_id[rows]
    spans = [(int(starts[k]), int(starts[k + 1])) for k in kept]
    east, north = (round((returns.corner_m[k] + corner[k]) / CELL_M) for k in (0, 1))
    probability = ratio[row, column] ** 2 / (1.0 + ratio[row, column] ** 2)
    return pa.table(
        {
            "column": east + column[kept], "row": north + row[kept], "height_m": height[kept],
            "probability": probability[kept], "returns": np.diff(starts)[kept],
            "passes": pa.array([np.unique(passes[a:b]).tolist() for a, b in spans], pa.list_(pa.int32())),
            "first_epoch_gps_ns": np.array([int(epochs[a:b].min()) for a, b in spans], np.int64),
            "last_epoch_gps_ns": np.array([int(epochs[a:b].max()) for a, b in spans], np.int64),
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


class Outline(NamedTuple):
    """The shape of an area on the map (m), by how much it may be simplified, and 1 σ of its edge (m)."""

    shape: shapely.Geometry
    simple_m: float
    sigma_m: float


def outline_of(pieces: pa.Table, cells: Int64) -> Outline:
    """Returns the outline of some cells; parts of cells are known of those that pictures show."""
    column, row = (np.asarray(pieces[name])[cells] for name in ("column", "row"))
    if "mask" not in pieces.column_names:
        return Outline(area_of(column, row), 1.04 * CELL_M, CELL_M)
    mask, sigma = (np.asarray(pieces[name])[cells] for name in ("mask", "sigma_m"))
    if (mask == WHOLE).all() and (sigma == CELL_M).all():
        return Outline(area_of(column, row), 1.04 * CELL_M, CELL_M)
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
