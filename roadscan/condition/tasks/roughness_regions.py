"""Computes roughness regions along roads from cells: a table of regions, one of sections, and a picture."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
import pyarrow as pa

from roadscan.condition.road_line import Lane, RoadLine
from roadscan.condition.roughness_regions.on_road import Stretch, points_of, section_regions, station_and_offset
from roadscan.condition.roughness_regions.picture import DrawnSection, draw_regions
from roadscan.condition.roughness_regions.regions import Region, SectionRegions
from roadscan.condition.roughness_regions.settings import RoughnessRegionsConfig
from roadscan.condition.tasks.lines import Roads
from roadscan.condition.tasks.tasks import PieceTask
from roadscan.condition.tasks.tiles_beside import tiles_beside
from roadscan.core.extras import can_draw
from roadscan.core.grid import TileGrid
from roadscan.core.ids import TileId
from roadscan.navigation.tasks.recorded_pictures import NOT_DRAWN
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.compute import damaged_file, reason_of
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import bytes_digest, file_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.schema import table_schema
from roadscan.store.writer import parquet_bytes
from roadscan.tiles.products.geo_table import write_geo_table
from roadscan.tiles.tasks.cell_files import read_cells
from roadscan.tiles.tasks.tiles import TaskResult

REGIONS: Final = "roughness_regions"
REGION_SECTIONS: Final = "roughness_sections"
REGION_PICTURES: Final = "roughness_pictures"
_OUTPUTS: Final = (REGIONS, REGION_SECTIONS, REGION_PICTURES)
_PIECE_SECTIONS: Final = 10
"""Sections in a file; each is computed independently."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Some sections of a road; it holds no data."""

    line: RoadLine
    lanes: tuple[Lane, ...]
    number: int
    sections_m: tuple[tuple[float, float], ...]
    cells: tuple[OutputRecord, ...]
    """Records of the tiles along it with cells."""
    key: str

    @property
    def unit(self) -> str:
        """Its name in the manifest."""
        return f"{self.line.road}/{self.number:06d}"


RegionTask: TypeAlias = PieceTask[Piece, RoughnessRegionsConfig]


def plan_pieces(
    roads: Roads, tiles: Mapping[TileId, OutputRecord], grid: TileGrid, settings: RoughnessRegionsConfig | None
) -> list[Piece]:
    """Return all pieces of roads with a tile with cells; empty without settings."""
    if settings is None:
        return []
    common = key_of(code_digest(f"{__name__}:regions_of_pieces"), settings.model_dump(mode="json"), grid)
    found = []
    long_m = _PIECE_SECTIONS * settings.section_m
    for road, line in sorted(roads.lines.items()):
        last_m = line.first_m + line.length_m
        for number in range(math.floor(line.first_m / long_m), math.ceil(last_m / long_m)):
            ends = [number * long_m + k * settings.section_m for k in range(_PIECE_SECTIONS + 1)]
            sections = tuple((a, b) for a, b in itertools.pairwise(ends) if b > line.first_m and a < last_m)
            part = line.stretch(sections[0][0] - 20.0, sections[-1][1] + 20.0)
            lanes = tuple(
                lane.stretch(sections[0][0], sections[-1][1])
                for lane in roads.lanes
                if lane.road == road and lane.last_m > sections[0][0] and lane.first_m < sections[-1][1]
            )
            beside = tiles_beside(part, sections[0][0], sections[-1][1], settings.width_m / 2 + 1.0, grid)
            own = tuple(tiles[t] for t in beside if t in tiles)
            if own and lanes:
                shape = [part.road, part.first_m, part.nodes_m.tolist(), sections]
                shape += [[v.sign, v.width_m, v.first_m, v.offset_m.tolist()] for v in lanes]
                key = key_of(common, shape, [(r.unit, r.digest) for r in own])
                found.append(Piece(part, lanes, number, sections, own, key))
    return found


def due_pieces(pieces: Sequence[Piece], manifest: Manifest) -> list[Piece]:
    """Those that are missing or stale."""
    names = _OUTPUTS if can_draw() else _OUTPUTS[:-1]
    return [p for p in pieces if not all(manifest.is_current(n, p.unit, p.key) for n in names)]


def regions_of_pieces(task: RegionTask) -> TaskResult:
    """Compute and write regions, sections and picture of the pieces of a task (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    damaged: set[str] = set()
    for one in task.pieces:
        try:
            found = list(_sections(task, one))
            records += [_write_sections(task, one, found), _write_regions(task, one, found), _draw(task, one, found)]
        except Exception as error:  # noqa: BLE001  one piece's fault must not stop the others
            failures.append((one.unit, reason_of(error)))
            damaged.add(damaged_file(error))
    return TaskResult.of(records, failures, damaged)


def _sections(task: RegionTask, piece: Piece) -> Iterator[SectionRegions]:
    points = []
    for record in sorted(piece.cells, key=lambda r: r.unit):
        bounds = task.grid.bounds(TileId.parse(record.unit))
        cells = read_cells(task.store, record, task.grid.cells_per_edge)
        corner = (bounds.easting_min_m, bounds.northing_min_m)
        points.append(points_of(cells, corner, task.grid.cell_m, task.settings.cell_m))
    for from_m, to_m in piece.sections_m:
        yield section_regions(points, Stretch(piece.line, piece.lanes, from_m, to_m), task.settings)


def _write_sections(task: RegionTask, piece: Piece, found: Sequence[SectionRegions]) -> OutputRecord:
    schema, settings = table_schema(REGION_SECTIONS), task.settings
    rows = []
    for (from_m, to_m), one in zip(piece.sections_m, found, strict=True):
        fates = [c.fate for c in one.clusters]
        rows.append({
            "road": piece.line.road,
            "station_from_m": from_m,
            "station_to_m": to_m,
            "readings": one.readings,
            "measured_m2": one.measured_m2,
            "dim_below": _known(one.dim_below),
            "bright_above": _known(one.bright_above),
            "dim_below_8bit": one.thresholds[0] if one.thresholds else None,
            "bright_above_8bit": one.thresholds[1] if one.thresholds else None,
            "least_density_per_m2": settings.least_density_per_m2,
            "largest_height_sigma_m": settings.largest_height_sigma_m,
            "least_contrast": settings.least_contrast,
            "regions": fates.count("reported"),
            "small": one.small + fates.count("small"),
            "sparse": fates.count("sparse"),
            "off_the_surface": fates.count("off_the_surface"),
            "no_contrast": fates.count("no_contrast"),
        })  # fmt: skip
    content = parquet_bytes(pa.Table.from_pylist(rows, schema.arrow()), schema)
    target = f"{schema.location}/{piece.unit}.parquet"
    task.store.write_bytes(target, content, lasting=False)
    return OutputRecord(REGION_SECTIONS, piece.unit, piece.key, target, len(content), bytes_digest(content))


def _write_regions(task: RegionTask, piece: Piece, found: Sequence[SectionRegions]) -> OutputRecord:
    """Write the regions as GeoParquet; no file without any."""
    schema = table_schema(REGIONS)
    both = [(ends, r) for ends, one in zip(piece.sections_m, found, strict=True) for r in one.regions]
    if not both:
        return OutputRecord(REGIONS, piece.unit, piece.key, "", 0, "")
    rows = [_row(piece, ends, r) for ends, r in both]
    order = sorted(range(len(rows)), key=lambda k: (rows[k]["station_m"], rows[k]["offset_m"]))
    table = pa.Table.from_pylist([rows[k] for k in order], schema.arrow())
    shapes = np.array([*(both[k][1].outline for k in order), None], object)[:-1]
    target = f"{schema.location}/{piece.unit}.parquet"
    with task.store.scratch() as folder:
        path = folder / "regions.parquet"
        write_geo_table(path, table, "outline", shapes, ["Polygon"], task.context, counterclockwise=True)
        size, digest = path.stat().st_size, file_digest(path)
        task.store.publish(path, target)
    return OutputRecord(REGIONS, piece.unit, piece.key, target, size, digest)


def _row(piece: Piece, ends: tuple[float, float], one: Region) -> dict[str, Any]:
    middle, measured = one.outline.centroid, one.severity
    station, offset = station_and_offset(piece.line, (middle.x, middle.y), 0.5 * sum(ends))
    return {
        "road": piece.line.road,
        "station_m": station,
        "offset_m": offset,
        "section_from_m": ends[0],
        "section_to_m": ends[1],
        "area_m2": one.area_m2,
        "dim_area_m2": one.dim_area_m2,
        "readings": one.readings,
        "density_per_m2": one.density_per_m2,
        "height_sigma_m": one.height_sigma_m,
        "intensity": measured.intensity,
        "contrast": _known(measured.contrast),
        "residual_mean_m": _known(measured.residual_mean_m),
        "residual_sigma_m": _known(measured.residual_sigma_m),
        "around_sigma_m": _known(measured.around_sigma_m),
        "easting_m": middle.x,
        "northing_m": middle.y,
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _draw(task: RegionTask, piece: Piece, found: Sequence[SectionRegions]) -> OutputRecord:
    """Draw the sections with regions; no file without any."""
    drawn = [
        DrawnSection(f"{piece.line.road}, station {a:g} to {b:g} m", one.raster.values, one.raster.measured,
                     one.raster.corner_m, one.raster.cell_m, tuple(one.local_outlines()))
        for (a, b), one in zip(piece.sections_m, found, strict=True)
        if one.raster is not None and one.regions
    ]  # fmt: skip
    if not drawn:
        return OutputRecord(REGION_PICTURES, piece.unit, piece.key, "", 0, "")
    if not can_draw():
        return OutputRecord(REGION_PICTURES, piece.unit, NOT_DRAWN, "", 0, "")
    target = f"products/{REGION_PICTURES}/{piece.unit.replace('/', '_')}.png"
    with task.store.scratch() as folder:
        path = folder / "regions.png"
        draw_regions(path, drawn)
        size, digest = path.stat().st_size, file_digest(path)
        task.store.publish(path, target)
    return OutputRecord(REGION_PICTURES, piece.unit, piece.key, target, size, digest)
