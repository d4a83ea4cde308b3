"""Samples stretches of lanes from cells: profiles, cross-sections, texture and painted lines.

A row depends on the cells around its place and on the line there, so it has the same bits however the lane is divided.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.condition.kernels.sampling import CellTable
from roadscan.condition.lane_data import SQUARE_M
from roadscan.condition.road_line import Lane, RoadLine, Roads
from roadscan.condition.settings import ConditionConfig, SectionConfig
from roadscan.condition.survey_lane import LaneHeights, reach_m, survey_lane
from roadscan.condition.tasks.tasks import tiles_of
from roadscan.core.errors import ConfigError, StoreError
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import damaged_file, reason_of
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store
from roadscan.surface.reconstruction import SurfaceGrid
from roadscan.surface.settings import SurfaceConfig
from roadscan.tiles.cells import TileCells, read_cells
from roadscan.tiles.product import ProductContext
from roadscan.tiles.tasks.tiles import TaskResult

EDGES: Final = "road_edge_offsets"
"""Table of the road's edges, which a task reads or makes piece by piece."""
EDGE_PIECE_M: Final = 100
"""Length of a piece of road whose edges are one file (m)."""


def edge_unit(road: str, number: int) -> str:
    """Return the name of a piece of a road in the manifest."""
    return f"{road}/{number:06d}"


def check_surface_cells(survey: Survey) -> None:
    """Raise :class:`ConfigError` where surface heights are requested and there is no surface on the tiles' cells."""
    config, surface = ConditionConfig.stated(survey), SurfaceConfig.stated(survey)
    if config is None or config.heights == "cells":
        return
    cell_m = survey.config.tiles.cell_m
    grid = TileGrid(survey.config.tiles.size_m, cell_m)
    made = survey.config.products.make
    if surface is None or (made is not None and "surface" not in made):
        raise ConfigError(
            'condition.heights = "surface", and the survey does not make the product `surface`',
            change="add the section [surface] and the product, or take the heights of cells",
        )
    if SurfaceGrid(grid, surface).cell_m != (cell_m, cell_m):
        east, north = SurfaceGrid(grid, surface).cell_m
        raise ConfigError(
            f'condition.heights = "surface", whose cells have {east:g} × {north:g} m',
            expected=f"those of the tiles, {cell_m:g} m",
            change="take the heights of cells",
        )


def read_surface(store: Store, record: OutputRecord, cells_per_edge: int, context: ProductContext) -> TileCells:
    """Return heights of a tile's surface as cells of one reading each, with unknown spread."""
    import rasterio  # slow to import

    with rasterio.MemoryFile(read_recorded(store, record)) as file, file.open() as raster:
        names = list(raster.descriptions)
        if "height" not in names or raster.shape != (cells_per_edge, cells_per_edge):
            raise StoreError(
                f"the surface has bands {names} of {raster.shape} pixels",
                expected=f"a band height of {cells_per_edge} × {cells_per_edge}",
                change="let products.options.surface.bands hold height",
                file=store.path(record.path),
            )
        image = raster.read(names.index("height") + 1)[::-1].astype(np.float64) * context.map.vertical_unit_m
    row, column = np.nonzero(~np.isnan(image))
    height, n = image[row, column], row.size
    nan, one = np.full(n, np.nan), np.ones(n, np.uint32)
    return TileCells(
        tile=TileId.parse(record.unit), cells_per_edge=cells_per_edge, column=column.astype(np.uint16),
        row=row.astype(np.uint16), count=one, height_mean_m=height, height_robust_m=height, height_min_m=nan,
        height_max_m=nan, height_std_m=nan.astype(np.float32), intensity_mean=nan.astype(np.float32),
        pass_count=np.zeros(n, np.uint16), pass_offsets=np.zeros(n + 1, np.int32), pass_ids=np.empty(0, np.uint16),
    )  # fmt: skip


PROFILES: Final = "profiles_longitudinal"
SURFACE_FILES: Final = "surface"
"""Product whose files contain the reconstructed surface."""
CROSS_SECTIONS: Final = "cross_sections"
LANE_TEXTURE: Final = "lane_texture"
LANE_LINES: Final = "lane_line_offsets"
OF_STRETCHES: Final = (CROSS_SECTIONS, PROFILES, LANE_TEXTURE, LANE_LINES)
"""Tables with one file for each stretch."""
STRETCH_M: Final = 50
"""Length of a stretch; it does not affect heights."""
_TASK_STRETCHES: Final = 8  # Stretches in a task.
_TILES_KEPT: Final = 12  # Tiles whose cells stay in memory.


@dataclass(frozen=True, eq=False)
class Stretch:
    """A stretch of a lane, from one station to the next; it holds no heights."""

    line: RoadLine
    lane: Lane
    from_m: float
    to_m: float
    cells: tuple[OutputRecord, ...]
    """Records of the tiles along it with cells."""
    key: str

    @property
    def unit(self) -> str:
        """Its name in the manifest."""
        return unit_of(self.lane, int(self.from_m) // STRETCH_M)


def unit_of(lane: Lane, number: int) -> str:
    """Return the name of a stretch in the manifest."""
    return f"{lane.road}/{lane.name}/{number:06d}"


@dataclass(frozen=True, eq=False)
class StretchTask:
    """A sequence of stretches. Sent to workers: it holds no data."""

    store: Store
    grid: TileGrid
    config: SectionConfig
    context: ProductContext
    stretches: tuple[Stretch, ...]

    @property
    def units(self) -> tuple[str, ...]:
        """Names of the stretches."""
        return tuple(s.unit for s in self.stretches)

    def singly(self) -> list[StretchTask]:
        """Return a task for each stretch."""
        return [replace(self, stretches=(one,)) for one in self.stretches]


def plan_stretches(
    roads: Roads, tiles: Mapping[TileId, OutputRecord], grid: TileGrid, config: SectionConfig
) -> list[Stretch]:
    """Return all stretches with a tile with cells, lane by lane."""
    code = code_digest("roadscan.condition.tasks.stretches:survey_stretches")
    names = set(SectionConfig.model_fields) - {"section_m", "largest_gap_m", "least_share", "lane_width_m"}
    settings = {name: value for name, value in config.model_dump(mode="json").items() if name in names}
    common = key_of(code, settings, grid)
    found: list[Stretch] = []
    for lane in roads.lanes:
        whole = roads.lines[lane.road]
        for number in range(lane.first_m // STRETCH_M, lane.last_m // STRETCH_M + 1):
            from_m, to_m = float(number * STRETCH_M), float((number + 1) * STRETCH_M)
            line, part = whole.stretch(from_m, to_m), lane.stretch(from_m, to_m)
            own = tuple(tiles[t] for t in _on_the_way(line, part, from_m, to_m, grid, config) if t in tiles)
            if own:
                shape = [line.first_m, line.nodes_m.tolist(), part.first_m, part.offset_m.tolist()]
                shape += [lane.sign, lane.width_m]
                key = key_of(common, shape, lane.first_m, lane.last_m, [(r.unit, r.digest) for r in own])
                found.append(Stretch(line, part, max(from_m, lane.first_m), min(to_m, lane.last_m + 1.0), own, key))
    return found


def _on_the_way(
    line: RoadLine, lane: Lane, from_m: float, to_m: float, grid: TileGrid, config: SectionConfig
) -> list[TileId]:
    station = np.arange(max(from_m, lane.first_m), min(to_m, lane.last_m) + 1.0)
    if station.size < 2:
        station = np.array([station[0], station[0] + 1.0]) if station.size else np.array([from_m, from_m + 1.0])
    at = station - line.first_m
    nodes = np.arange(len(line.nodes_m))
    # By NumPy, since `status` would load Numba for `line.places`. At the ends of a line, on a bend of 30 m and 5 m
    # beside it, the two differ by 83 mm, which the 0.2 m below cover; elsewhere by nothing.
    along, across = (np.interp(at, nodes, change) for change in np.gradient(line.nodes_m, axis=0).T)
    beside = lane.offsets(station) / np.hypot(along, across)
    east, north = (np.interp(at, nodes, coordinate) for coordinate in line.nodes_m.T)
    middle = np.column_stack([east + beside * across, north - beside * along])
    strip = shapely.LineString(middle).buffer(lane.width_m / 2 + reach_m(config, grid.cell_m) + 0.2)
    return tiles_of(strip, grid)


def due_stretches(stretches: Sequence[Stretch], manifest: Manifest) -> list[Stretch]:
    """Return those that are missing or stale."""
    return [s for s in stretches if not all(manifest.is_current(n, s.unit, s.key) for n in OF_STRETCHES)]


def stretch_tasks(
    due: Sequence[Stretch], store: Store, context: ProductContext, config: SectionConfig
) -> list[StretchTask]:
    """Return tasks of neighbouring stretches of a lane."""
    tasks: list[StretchTask] = []
    for _, own in itertools.groupby(due, key=lambda s: (s.lane.road, s.lane.name)):
        tasks += [StretchTask(store, context.grid, config, context, some) for some in _batches(list(own))]
    return tasks


def _batches(own: Sequence[Stretch]) -> Iterator[tuple[Stretch, ...]]:
    for first in range(0, len(own), _TASK_STRETCHES):
        yield tuple(own[first : first + _TASK_STRETCHES])


def survey_stretches(task: StretchTask) -> TaskResult:
    """Compute and write the tables of the stretches of a task (runs on a worker)."""
    tiles = _Tiles(task.store, task.context)
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    damaged: set[str] = set()
    for one in task.stretches:
        try:
            table = cell_table([tiles.read(r) for r in one.cells], task.grid.cell_m)
            heights = survey_lane(table, one.line, one.lane, (one.from_m, one.to_m), task.config)
            records += _write(task.store, one, heights)
        except Exception as error:  # noqa: BLE001  one stretch's fault must not stop the others
            failures.append((one.unit, reason_of(error)))
            damaged.add(damaged_file(error))
    return TaskResult.of(records, failures, damaged)


class _Tiles:
    """Cells of the tiles of some stretches; the latest ones stay in memory."""

    def __init__(self, store: Store, context: ProductContext) -> None:
        self._store, self._context = store, context
        self._kept: dict[str, TileCells] = {}

    def read(self, record: OutputRecord) -> TileCells:
        """Return the cells of a tile."""
        cells = self._kept.pop(record.unit, None)
        if cells is None:
            edge = self._context.grid.cells_per_edge
            of_surface = record.product == SURFACE_FILES
            cells = (
                read_surface(self._store, record, edge, self._context)
                if of_surface
                else read_cells(self._store, record, edge)
            )
        self._kept[record.unit] = cells
        while len(self._kept) > _TILES_KEPT:
            del self._kept[next(iter(self._kept))]
        return cells


def _write(store: Store, one: Stretch, held: LaneHeights) -> Iterator[OutputRecord]:
    """Write the files of a stretch."""
    columns_of = (_cross_columns, _profile_columns, _texture_columns, _line_columns)
    for name, columns in zip(OF_STRETCHES, (make(one, held) for make in columns_of), strict=True):
        schema = table_schema(name)
        rows = pa.table(columns, schema=schema.arrow())
        content, target = parquet_bytes(rows, schema), f"{schema.location}/{one.unit}.parquet"
        store.write_bytes(target, content, lasting=False)
        yield OutputRecord(name, one.unit, one.key, target, len(content), bytes_digest(content))


def _profile_columns(one: Stretch, held: LaneHeights) -> dict[str, pa.Array]:
    paths = held.paths
    station = np.concatenate([p.station_m for p in paths.values()])
    values = np.concatenate([p.values for p in paths.values()])
    places = np.concatenate([p.places for p in paths.values()])
    return {
        "road": pa.array([one.lane.road] * station.size, pa.string()),
        "lane": pa.array([one.lane.name] * station.size, pa.string()),
        "path": pa.array([name for name, p in paths.items() for _ in p.station_m], pa.string()),
        "station_m": pa.array(station),
        "offset_m": pa.array(np.concatenate([p.offset_m for p in paths.values()])),
        "easting_m": pa.array(places[:, 0]),
        "northing_m": pa.array(places[:, 1]),
        "height_m": pa.array(values[:, 0], from_pandas=True),
        "sigma_height_m": pa.array(values[:, 1].astype(np.float32), from_pandas=True),
        "share": pa.array(values[:, 2].astype(np.float32)),
    }


def _cross_columns(one: Stretch, held: LaneHeights) -> dict[str, pa.Array]:
    c = held.cross
    rows = len(c.height_m)
    return {
        "road": pa.array([one.lane.road] * rows, pa.string()),
        "lane": pa.array([one.lane.name] * rows, pa.string()),
        "station_m": pa.array(c.station_m),
        "offset_m": pa.array(c.middle_offset_m),
        "easting_m": pa.array(c.places[:, 0]),
        "northing_m": pa.array(c.places[:, 1]),
        "first_m": pa.array(np.full(rows, c.offset_m[0])),
        "step_m": pa.array(np.full(rows, c.offset_m[1] - c.offset_m[0])),
        "height_m": pa.array(c.base_m),
        "relative_height_m": _lists(c.height_m),
        "sigma_height_m": _lists(c.sigma_m),
    }


def _texture_columns(one: Stretch, held: LaneHeights) -> dict[str, pa.Array]:
    t = held.texture
    rows = t.station_m.size
    return {
        "road": pa.array([one.lane.road] * rows, pa.string()),
        "lane": pa.array([one.lane.name] * rows, pa.string()),
        "station_m": pa.array(t.station_m),
        "first_m": pa.array(np.full(rows, t.offset_m[0])),
        "step_m": pa.array(np.full(rows, SQUARE_M)),
        "texture_mm": _lists(t.texture_mm),
        "loss_mm": _lists(t.loss_mm),
        "mpd_mm": _lists(t.mpd_mm),
        "intensity": _lists(t.intensity),
        "passes_share": _lists(t.passes_share),
    }


def _line_columns(one: Stretch, held: LaneHeights) -> dict[str, pa.Array]:
    seen = held.lines
    rows = seen.station_m.size
    return {
        "road": pa.array([one.lane.road] * rows, pa.string()),
        "lane": pa.array([one.lane.name] * rows, pa.string()),
        "station_m": pa.array(seen.station_m),
        "side": pa.array(seen.side, pa.string()),
        "own_offset_m": pa.array(seen.own_m),
        "width_m": pa.array(seen.width_m),
        "contrast": pa.array(seen.contrast),
    }


def _lists(values: npt.NDArray[np.float64]) -> pa.Array:
    """Return a list of 32-bit floats for each row of values (rows, count)."""
    rows, count = values.shape
    ends = np.arange(0, rows * count + 1, max(count, 1), dtype=np.int32)[: rows + 1]
    element = pa.field("element", pa.float32(), nullable=False)
    flat = pa.array(np.ascontiguousarray(values, np.float32).ravel(), pa.float32())
    return pa.ListArray.from_arrays(ends, flat, type=pa.list_(element))


def cell_table(tiles: Sequence[TileCells], cell_m: float) -> CellTable:
    """Return the cells of tiles of one grid, in any order, as a table; `cell_m` is a cell's edge (m)."""
    held = sorted(tiles, key=lambda t: (t.tile.row, t.tile.column))
    edge = held[0].cells_per_edge if held else 1
    columns, rows = [t.tile.column for t in held] or [0], [t.tile.row for t in held] or [0]
    first = np.array([min(rows), min(columns)], np.int64)
    slot = np.full((max(rows) - min(rows) + 1, max(columns) - min(columns) + 1), -1, np.int32)
    starts = np.zeros((len(held), edge + 1), np.int64)
    before = 0
    for number, tile in enumerate(held):
        slot[tile.tile.row - first[0], tile.tile.column - first[1]] = number
        starts[number] = before + np.searchsorted(tile.row, np.arange(edge + 1))
        before += len(tile)
    count = _joined([t.count for t in held], np.float32)
    std = _joined([t.height_std_m for t in held], np.float32)
    return CellTable(
        slot=slot,
        first=first,
        row_start=starts,
        column=_joined([t.column for t in held], np.int32),
        height=_joined([t.height_robust_m for t in held], np.float64),
        noise=std * std * count,
        readings=count,
        intensity=_joined([t.intensity_mean for t in held], np.float32),
        passes=_joined([t.pass_count for t in held], np.float32),
        cell=np.array([cell_m, cell_m]),
        edge=np.array([edge, edge], np.int64),
    )


def _joined(parts: Sequence[np.ndarray], kind: type) -> np.ndarray:
    return np.concatenate([np.empty(0, kind), *(p.astype(kind, copy=False) for p in parts)])
