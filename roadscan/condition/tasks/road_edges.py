"""Computes edges of roads from cells beside the lanes: a table of edges by station, and the road's surface."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.condition.edge_raster import tile_points
from roadscan.condition.road_edges import (
    KINDS,
    LEAD_M,
    RoadEdges,
    RoadStretch,
    RoadSurface,
    reach_m,
    road_edges,
    road_surfaces,
)
from roadscan.condition.road_line import Roads
from roadscan.condition.settings import ConditionConfig, RoadEdgesConfig
from roadscan.condition.tasks.stretches import EDGE_PIECE_M, EDGES, edge_unit
from roadscan.condition.tasks.tasks import PieceTask, tiles_beside
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.survey import Survey
from roadscan.formats.vectors.polygons import check_polygons, read_polygons
from roadscan.formats.vectors.road_lines import sidecars
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.run.engine.compute import damaged_file, reason_of
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import bytes_digest, file_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.tiles.cells import read_cells
from roadscan.tiles.products.geo_table import write_geo_table
from roadscan.tiles.tasks.tiles import TaskResult

SURFACES: Final = "road_surface"
_OUTPUTS: Final = (EDGES, SURFACES)


@dataclass(frozen=True, eq=False)
class EdgePiece:
    """A piece of a road; it holds no heights."""

    stretch: RoadStretch
    cells: tuple[OutputRecord, ...]
    """Records of the tiles beside it with cells."""
    polygons: bytes
    """The stated road surface near it as WKB; empty where none is stated."""
    key: str

    @property
    def unit(self) -> str:
        """Its name in the manifest."""
        return edge_unit(self.stretch.line.road, int(self.stretch.from_m) // EDGE_PIECE_M)


EdgeTask: TypeAlias = PieceTask[EdgePiece, RoadEdgesConfig]


def check_edge_polygons(survey: Survey) -> None:
    """Open the layer of polygons, where the survey file states one.

    Raises
    ------
    FormatError, ConfigError, CrsError
        if it does not exist, cannot be read as stated, or cannot be brought into the map.
    """
    config = ConditionConfig.stated(survey)
    if config is not None and config.road_edges is not None and config.road_edges.polygons is not None:
        settings, frame = config.road_edges, survey.frame()
        check_polygons(survey.resolve(config.road_edges.polygons), settings.polygons_crs, frame)


@dataclass(frozen=True, eq=False)
class StatedSurface:
    """The road's surface from the survey file's layer of polygons."""

    shape: shapely.Geometry
    digests: tuple[str, ...]
    """Digests of the layer's files."""


def stated_surface(plan: SurveyPlan, settings: RoadEdgesConfig | None) -> StatedSurface | None:
    """Return the polygons of the survey file; None where it states none."""
    if settings is None or settings.polygons is None:
        return None
    path = plan.survey.resolve(settings.polygons)
    shape = read_polygons(path, settings.polygons_crs, plan.ground.map)
    return StatedSurface(shape, tuple(file_digest(file) for file in (path, *sidecars(path))))


def plan_edges(
    roads: Roads,
    tiles: Mapping[TileId, OutputRecord],
    grid: TileGrid,
    settings: RoadEdgesConfig | None,
    stated: StatedSurface | None,
) -> list[EdgePiece]:
    """Return all pieces of roads with a lane and a tile with cells beside it; empty without settings."""
    if settings is None:
        return []
    common = key_of(
        code_digest(f"{__name__}:edges_of_pieces"), settings.model_dump(mode="json", exclude={"polygons"}), grid
    )
    found = []
    for road, line in sorted(roads.lines.items()):
        for number in range(line.first_m // EDGE_PIECE_M, math.ceil((line.first_m + line.length_m) / EDGE_PIECE_M)):
            from_m, to_m = float(number * EDGE_PIECE_M), float((number + 1) * EDGE_PIECE_M)
            ends = from_m - LEAD_M - 5.0, to_m + LEAD_M + 5.0
            lanes = tuple(
                lane.stretch(*ends)
                for lane in roads.lanes
                if lane.road == road and lane.last_m > from_m and lane.first_m < to_m
            )
            part, away = line.stretch(*ends), reach_m(lanes, settings.reach_m)
            beside = tiles_beside(part, *ends, away, grid) if lanes else []
            own = tuple(tiles[t] for t in beside if t in tiles)
            if not own:
                continue
            polygons = b""
            if stated is not None:
                near = shapely.LineString(part.places(np.arange(*ends), 0.0)[:, :2]).buffer(away + 5.0)
                polygons = shapely.to_wkb(shapely.intersection(stated.shape, near))
            shape = [part.road, part.first_m, part.nodes_m.tolist(), from_m, to_m, bytes_digest(polygons)]
            shape += [[v.sign, v.width_m, v.first_m, v.offset_m.tolist()] for v in lanes]
            key = key_of(common, shape, [(r.unit, r.digest) for r in own])
            found.append(EdgePiece(RoadStretch(part, lanes, from_m, to_m), own, polygons, key))
    return found


def due_edges(pieces: Sequence[EdgePiece], manifest: Manifest) -> list[EdgePiece]:
    """Return those that are missing or stale."""
    return [p for p in pieces if not all(manifest.is_current(n, p.unit, p.key) for n in _OUTPUTS)]


def edges_of_pieces(task: EdgeTask) -> TaskResult:
    """Compute and write edges and surface of the pieces of a task (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    damaged: set[str] = set()
    for one in task.pieces:
        try:
            found = _edges(task, one)
            records += [_write_edges(task, one, found), _write_surface(task, one, found)]
        except Exception as error:  # noqa: BLE001  one piece's fault must not stop the others
            failures.append((one.unit, reason_of(error)))
            damaged.add(damaged_file(error))
    return TaskResult.of(records, failures, damaged)


def _edges(task: EdgeTask, piece: EdgePiece) -> RoadEdges:
    points = []
    for record in sorted(piece.cells, key=lambda r: r.unit):
        bounds = task.grid.bounds(TileId.parse(record.unit))
        cells = read_cells(task.store, record, task.grid.cells_per_edge)
        points.append(tile_points(cells, (bounds.easting_min_m, bounds.northing_min_m), task.grid.cell_m))
    polygons = shapely.from_wkb(piece.polygons) if piece.polygons else None
    return road_edges(points, piece.stretch, task.settings.reach_m, task.settings.largest_sigma_m, polygons)


def _write_edges(task: EdgeTask, piece: EdgePiece, found: RoadEdges) -> OutputRecord:
    schema = table_schema(EDGES)
    tables = []
    for side, edge in found.sides.items():
        rows = np.flatnonzero(np.isfinite(edge.offset_m) & (found.station_m < piece.stretch.to_m - 1e-6))
        place = piece.stretch.line.places(found.station_m[rows], edge.offset_m[rows])

        def known(values: npt.NDArray[np.float64], rows: npt.NDArray[np.int64] = rows) -> pa.Array:
            return pa.array(values[rows], pa.float64(), from_pandas=True)

        columns = {
            "road": pa.array([piece.stretch.line.road] * rows.size, pa.string()),
            "side": pa.array([side] * rows.size, pa.string()),
            "station_m": known(found.station_m),
            "offset_m": known(edge.offset_m),
            "sigma_offset_m": known(edge.found.sigma_m),
            "told_by": pa.array([KINDS[k] for k in edge.found.kind[rows].tolist()], pa.string()),
            "evidence": known(edge.found.evidence),
            "drop_m": known(edge.found.drop_m),
            "sigma_drop_m": known(edge.found.sigma_drop_m),
            "easting_m": pa.array(place[:, 0]),
            "northing_m": pa.array(place[:, 1]),
        }
        tables.append(pa.table(columns, schema=schema.arrow()))
    content = parquet_bytes(pa.concat_tables(tables), schema)
    target = f"{schema.location}/{piece.unit}.parquet"
    task.store.write_bytes(target, content, lasting=False)
    return OutputRecord(EDGES, piece.unit, piece.key, target, len(content), bytes_digest(content))


def _write_surface(task: EdgeTask, piece: EdgePiece, found: RoadEdges) -> OutputRecord:
    """Write the road's surface as GeoParquet; no file where both edges are known nowhere."""
    schema = table_schema(SURFACES)
    parts = list(road_surfaces(found, piece.stretch.line))
    if not parts:
        return OutputRecord(SURFACES, piece.unit, piece.key, "", 0, "")
    table = pa.Table.from_pylist([_row(piece, one) for one in parts], schema.arrow())
    shapes = np.array([*(one.outline for one in parts), None], object)[:-1]
    target = f"{schema.location}/{piece.unit}.parquet"
    with task.store.scratch() as folder:
        path = folder / "surface.parquet"
        write_geo_table(path, table, "outline", shapes, ["Polygon"], task.context, counterclockwise=True)
        size, digest = path.stat().st_size, file_digest(path)
        task.store.publish(path, target)
    return OutputRecord(SURFACES, piece.unit, piece.key, target, size, digest)


def _row(piece: EdgePiece, one: RoadSurface) -> dict[str, Any]:
    known = math.isfinite(one.sigma_width_m)
    return {
        "road": piece.stretch.line.road,
        "station_from_m": one.from_m,
        "station_to_m": one.to_m,
        "width_mean_m": one.width_m,
        "sigma_width_m": one.sigma_width_m if known else None,
        "area_m2": one.outline.area,
        "sigma_area_m2": one.sigma_width_m * (one.to_m - one.from_m) if known else None,
    }
