"""Computes roughness regions along roads from cells: a table of regions, one of sections, and a picture."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.condition.road_line import Lane, RoadLine, Roads
from roadscan.condition.roughness_rasters import RoadPoints, normalised_intensity
from roadscan.condition.roughness_regions import Region, SectionRegions, find_regions
from roadscan.condition.settings import RoughnessRegionsConfig
from roadscan.condition.tasks.tasks import PieceTask, tiles_beside
from roadscan.core.canvas import empty_figure
from roadscan.core.extras import can_draw
from roadscan.core.grid import TileGrid, TileId
from roadscan.navigation.tasks.recorded_pictures import NOT_DRAWN
from roadscan.run.engine.compute import damaged_file, reason_of
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import bytes_digest, file_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.tiles.cells import TileCells, read_cells
from roadscan.tiles.products.geo_table import write_geo_table
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


_FINER: Final = 4.0
"""Survey cells are joined to blocks of at most this fraction of a raster cell: closer points add no information."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """A piece of a road."""

    line: RoadLine
    lanes: tuple[Lane, ...]
    from_m: float
    to_m: float


def points_of(
    cells: TileCells, corner_m: tuple[float, float], survey_cell_m: float, raster_cell_m: float
) -> RoadPoints:
    """Return the cells of a tile as points: blocks of cells, each with the means of its readings.

    corner_m : easting and northing of the tile's south-west corner.
    """
    wide = max(1, int(raster_cell_m / _FINER / survey_cell_m + 1e-9))
    across = -(-cells.cells_per_edge // wide)
    block = (cells.row.astype(np.int64) // wide) * across + cells.column.astype(np.int64) // wide
    number, inverse = np.unique(block, return_inverse=True)
    count = cells.count.astype(np.float64)
    readings = np.bincount(inverse, count, number.size)

    def mean(values: npt.NDArray[np.generic]) -> Float64:
        found: Float64 = np.bincount(inverse, count * values.astype(np.float64), number.size) / readings
        return found

    easting = corner_m[0] + survey_cell_m * (mean(cells.column) + 0.5)
    northing = corner_m[1] + survey_cell_m * (mean(cells.row) + 0.5)
    base = float(cells.height_robust_m[0]) if len(cells) else 0.0
    height = base + mean(cells.height_robust_m - base)
    return RoadPoints.of(easting, northing, height, mean(cells.intensity_mean), readings)


def section_regions(points: Sequence[RoadPoints], piece: Stretch, settings: RoughnessRegionsConfig) -> SectionRegions:
    """Find the roughness regions of one section of a road.

    Parameters
    ----------
    points : of the tiles on its way, on the map; piece : the section, with its line and lanes a little longer.
    """
    middle = piece.line.places(np.array([0.5 * (piece.from_m + piece.to_m)]), 0.0)[0]
    origin = (float(middle[0]), float(middle[1]))
    heading = float(np.arctan2(middle[2], middle[3]))
    joined = RoadPoints.of(*(np.concatenate([getattr(p, n) for p in points] or [np.empty(0)]) for n in _COLUMNS))
    reach = np.hypot(piece.to_m - piece.from_m, settings.width_m)
    joined = joined.take(np.hypot(joined.x_m - origin[0], joined.y_m - origin[1]) <= reach)
    station, offset = piece.line.along(np.column_stack([joined.x_m, joined.y_m]), 0.5 * (piece.from_m + piece.to_m))
    own = (station >= piece.from_m) & (station < piece.to_m) & (np.abs(offset) <= settings.width_m / 2)
    from_lane = np.full(station.size, np.inf)
    on_lane = np.zeros(station.size, bool)
    for lane in piece.lanes:
        away = np.abs(offset - lane.offsets(station))
        from_lane = np.minimum(from_lane, away)
        on_lane |= (away <= lane.width_m / 2) & (station >= lane.first_m) & (station <= lane.last_m + 1.0)
    own &= on_lane if settings.road == "lanes" else True
    kept = joined.take(own)
    if settings.sensor_height_m is not None:
        height = settings.sensor_height_m
        reach_m, incidence = np.hypot(from_lane[own], height), np.arctan2(from_lane[own], height)
        level = normalised_intensity(kept.intensity, reach_m, incidence, height)
        kept = RoadPoints(kept.x_m, kept.y_m, kept.height_m, level, kept.readings)
    return find_regions(kept, origin, heading, settings)


_COLUMNS: Final = ("x_m", "y_m", "height_m", "intensity", "readings")


def station_and_offset(line: RoadLine, place_m: tuple[float, float], guess_m: float) -> tuple[float, float]:
    """Return station and offset of a place near a station."""
    station, offset = line.along(np.array([place_m]), guess_m)
    return float(station[0]), float(offset[0])


_DOTS_PER_INCH: Final = 110  # Resolution.
_WIDTH_IN: Final = 7.0  # Width of a section.
_OUTLINE: Final = "#d7301f"


@dataclass(frozen=True, eq=False)
class DrawnSection:
    """A section with its regions, x along the road and y to the left (m)."""

    title: str
    values: npt.NDArray[np.uint8]
    """(rows, columns) intensities from black to white, rows to the left."""
    measured: npt.NDArray[np.bool_]
    corner_m: tuple[float, float]
    cell_m: float
    outlines_m: tuple[npt.NDArray[Any], ...]
    """(k, 2) outline of each region."""


def draw_regions(path: Path, sections: Sequence[DrawnSection]) -> None:
    """Write the sections one below the other."""
    heights = [1.0 + _WIDTH_IN * one.values.shape[0] / one.values.shape[1] for one in sections]
    figure = empty_figure(_WIDTH_IN + 1.0, sum(heights), _DOTS_PER_INCH)
    axes = figure.subplots(len(sections), 1, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for one, section in zip(axes, sections, strict=True):
        rows, columns = section.values.shape
        x, y = section.corner_m
        extent = (x, x + columns * section.cell_m, y, y + rows * section.cell_m)
        shown = np.ma.masked_array(section.values, ~section.measured)
        one.set_facecolor("#dfe8f2")
        one.imshow(shown, cmap="gray", vmin=0, vmax=255, origin="lower", extent=extent, interpolation="nearest")
        for outline in section.outlines_m:
            one.plot(outline[:, 0], outline[:, 1], color=_OUTLINE, linewidth=1.4)
        one.set_title(section.title, fontsize=9, loc="left")
        one.set_xlabel("from the section's middle along the road (m)", fontsize=8)
        one.set_ylabel("to the left (m)", fontsize=8)
        one.tick_params(labelsize=7)
    figure.savefig(path, metadata={"Software": None})
