"""Regions of the surface: those that the survey file states, and those that the coarse model of a drive shows.

A piece is a span of GPS time at whole multiples of its length, with the profiles of a few seconds before and after
it. So a region has the same corners however the readings lie in files, and whichever worker searches it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.core.crs import LOCAL_WORLD, MapFrame
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.grid import TileId
from roadscan.core.survey import Survey
from roadscan.footprints.footprints import FootprintRanges
from roadscan.formats.vectors.road_lines import place_in_map
from roadscan.formats.vectors.vector_layer import (
    chosen_layer,
    feature_batches,
    gdal_faults,
    layer_info,
    layer_names,
    shapes_of,
)
from roadscan.georeference.place import Placement, ProfilePoints
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.plan.road import looks_across
from roadscan.georeference.sources import (
    Georeferencer,
    MapSettings,
    RawSlice,
    ReadingSource,
    geometry_of,
    read_rows,
    road_key,
)
from roadscan.run.engine.compute import Compute, run_bundles
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import file_digest
from roadscan.store.logs import DataFile
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.surface.regions import CoarseSettings, Region, Stretch, coarse_model, find_regions
from roadscan.surface.settings import RegionSettings, SurfaceConfig
from roadscan.surface.tile import Regions
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.geo_table import read_geo_table, write_geo_table
from roadscan.tiles.tasks.wanted_products import product_context

_EXPECTED: Final = "a layer of polygons"
_POLYGONS: Final = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)


def stated_regions(survey: Survey) -> Regions | None:
    """Returns polygons that the survey file names, on its map; None where the surface is made everywhere.

    Raises
    ------
    ConfigError, FormatError, CrsError
        if the layer cannot be read as stated, or a feature of it is no polygon that lies in the map.
    """
    stated = SurfaceConfig.stated(survey)
    if stated is None or stated.polygons is None:
        return None
    path = survey.resolve(stated.polygons)
    if not path.is_file():
        raise ConfigError("the layer of polygons does not exist", change="check surface.polygons", file=path)
    return Regions(_placed(_shapes(path), _crs(path, stated.polygons_crs), survey.frame(), path))


def _shapes(path: Path) -> npt.NDArray[Any]:
    with gdal_faults(path, _EXPECTED):
        layer = chosen_layer(layer_names(path), None, path)
        geometry = layer_info(path, layer).get("geometry_name") or ""
    parts = [shapes_of(batch, geometry) for batch in feature_batches(path, layer, _EXPECTED)]
    shapes = np.concatenate(parts) if parts else np.empty(0, object)
    holds_ground = ~(shapely.is_missing(shapes) | shapely.is_empty(shapes))
    sound = np.isin(shapely.get_type_id(shapes), _POLYGONS) & shapely.is_valid(shapes) | ~holds_ground
    if not sound.all():
        raise ConfigError(
            f"feature {int(np.flatnonzero(~sound)[0])} of the layer (counted from 0) is no sound polygon",
            expected="polygons whose rings do not cross themselves",
            change="mend the feature, or take it out of the layer",
            file=path,
        )
    shapes = shapes[holds_ground]  # a feature without area is skipped
    if not shapes.size:
        raise ConfigError("the layer has no polygon", expected="at least one", file=path)
    return np.asarray(shapes)


def _crs(path: Path, stated: str | None) -> str:
    with gdal_faults(path, _EXPECTED):
        own = layer_info(path)["crs"]
    crs = stated or own
    if crs is None:
        raise ConfigError(
            "the layer of polygons does not name its CRS",
            change=f'state surface.polygons_crs, such as "EPSG:25832" or "{LOCAL_WORLD}"',
            file=path,
        )
    return str(crs)


def _placed(shapes: npt.NDArray[Any], crs: str, frame: MapFrame, path: Path) -> npt.NDArray[Any]:
    placed = shapely.transform(shapely.force_2d(shapes), place_in_map(crs, frame, path))
    bad = ~(np.isfinite(shapely.bounds(placed)).all(axis=1) & shapely.is_valid(placed))
    if bad.any():
        raise ConfigError(
            f"feature {int(np.flatnonzero(bad)[0])} of the layer (counted from 0) does not lie in the map",
            expected="polygons near the survey",
            file=path,
        )
    return np.asarray(placed)


REGIONS: Final = "regions"

_READINGS: Final = 1_500_000
"""Approximate readings of a piece: its working arrays need a hundred bytes each."""
_LONGEST_S: Final = 64  # Longest piece (s).
_MARGIN_NS: Final = 4 * NS_PER_S  # Time before and after a piece whose profiles are used too (ns).
_EVERY_NS: Final = 2_500_000
"""Of denser profiles one in each such span (ns) is used: at 50 km/h every 35 mm."""
_CHUNK_ROWS: Final = 4_000  # Rows of profiles converted at a time.
_BUNDLE: Final = 20_000_000  # Readings of a bundle of pieces, about.


@dataclass(frozen=True)
class RegionPiece:
    """A span of a sensor's profiles in one run; it carries no data."""

    store: Store
    ground: MapSettings
    context: ProductContext
    settings: RegionSettings
    source: ReadingSource
    slices: tuple[RawSlice, ...]
    """Row groups that may contain profiles of the span and its margins."""
    start_gps_ns: int
    end_gps_ns: int
    readings: int
    """Approximate number of readings."""
    key: str

    @property
    def unit(self) -> str:
        """Returns its name in the manifest."""
        return f"{self.source.run}/{self.source.sensor}/{self.start_gps_ns // NS_PER_S}"


def searched_sources(plan: SurveyPlan) -> list[tuple[ReadingSource, tuple[DataFile, ...]]]:
    """Returns profiles whose coarse model is searched, with their files; none where the survey does not ask for it.

    Raises
    ------
    ConfigError
        where there are no profiles across the road.
    """
    config = SurfaceConfig.stated(plan.survey)
    if config is None or config.regions != "found":
        return []
    sources = [(s, files) for s, files in plan.sources if s.table == "scans" and _sees_the_road(s)]
    if not sources and any(s.table == "scans" for s, _ in plan.sources):
        raise none_across({s.sensor for s, _ in plan.sources})
    return sources


def none_across(sensors: Iterable[str]) -> ConfigError:
    """Returns the error of a survey whose regions are sought in profiles, and whose sensors have none across the road.

    sensors : names of those that it has.
    """
    return ConfigError(
        f'surface.regions = "found" needs profiles across the road; there is {", ".join(sorted(sensors))}',
        expected="scans of a sensor that looks down, its x along the driving direction",
        change='take regions = "everywhere" or "polygons"',
    )


def region_pieces(plan: SurveyPlan) -> list[RegionPiece]:
    """Returns all pieces of the drives that are searched; errors as of :func:`searched_sources`."""
    config, sources = SurfaceConfig.stated(plan.survey), searched_sources(plan)
    if config is None or not sources:
        return []
    context = product_context(plan)
    return [p for s, files in sources for p in _pieces(plan, context, config.search, s, files)]


def _sees_the_road(source: ReadingSource) -> bool:
    return source.road is not None or looks_across(source.mountings.mountings[0])


def _pieces(
    plan: SurveyPlan,
    context: ProductContext,
    settings: RegionSettings,
    source: ReadingSource,
    files: Sequence[DataFile],
) -> Iterator[RegionPiece]:
    geometry = geometry_of(source)
    held = [(f, np.array(source.spans(f.group_spans), np.int64).reshape(-1, 2)) for f in files if f.group_spans]
    if geometry is None or not held:
        return
    every = np.concatenate([spans for _, spans in held])
    seconds = max(float(every.max() - every.min()) / NS_PER_S, 1.0)
    rate = geometry.readings * min(sum(f.rows for f in files) / seconds, NS_PER_S / _EVERY_NS)
    length = _length_ns(rate)
    code = code_digest("roadscan.surface.tasks.found_regions:regions_of_piece")
    common = [code, source.key, *road_key(source), settings.model_dump(mode="json"), length]
    near: dict[int, list[tuple[DataFile, npt.NDArray[np.int64]]]] = {}
    for file, spans in held:
        for number in sorted({n for a, b in _numbers(spans, length) for n in range(a, b + 1)}):
            near.setdefault(number, []).append((file, spans))
    numbers = {n for a, b in (every // length).tolist() for n in range(a, b + 1)}
    for number in sorted(numbers):
        start, end = number * length, (number + 1) * length
        slices: list[RawSlice] = []
        inputs: list[Any] = []
        for file, spans in near[number]:
            groups = np.flatnonzero((spans[:, 1] >= start - _MARGIN_NS) & (spans[:, 0] < end + _MARGIN_NS))
            if groups.size:
                whole = (int(spans[groups].min()), int(spans[groups].max()))
                share = file.bytes * groups.size // len(spans)
                slices.append(RawSlice(source, file.path, tuple(groups.tolist()), (whole,), share))
                inputs.append([file.digest, groups.tolist()])
        span = np.array([[start - _MARGIN_NS, end + _MARGIN_NS]])
        corrections = plan.corrections.digests(source, span, plan.ground.max_gap_s).tolist()
        work, key = round(rate * length / NS_PER_S), key_of(common, start, inputs, corrections)
        yield RegionPiece(
            plan.store, plan.ground, context, settings, source, tuple(slices), start, end, work, key
        )  # fmt: skip


def _numbers(spans: npt.NDArray[np.int64], length: int) -> list[list[int]]:
    """Returns first and last number of the pieces that spans (k, 2) may touch with their margins."""
    found: list[list[int]] = ((spans + np.array([-_MARGIN_NS, _MARGIN_NS])) // length).tolist()
    return found


def _length_ns(readings_a_second: float) -> int:
    """Returns the length of pieces: the longest power of two of seconds whose readings fit (ns)."""
    length_s = 1
    while length_s < _LONGEST_S and 2 * length_s * readings_a_second <= _READINGS:
        length_s *= 2
    return length_s * NS_PER_S


def find_due_regions(
    plan: SurveyPlan, manifest: Manifest, compute: Compute, report: Callable[[int, int], None] = lambda _a, _b: None
) -> list[tuple[str, str]]:
    """Search regions in the pieces that are missing or stale; returns what failed."""
    due = _due(region_pieces(plan), manifest)
    failed = run_bundles(regions_of_piece, due, lambda p: p.readings, _BUNDLE, manifest, compute, report)
    return [(f"{REGIONS} {piece.unit}", reason) for piece, reason in failed]


def regions_of_piece(piece: RegionPiece) -> OutputRecord:
    """Find the regions of a piece of drive and write them, where there are any (runs on a worker)."""
    found = [(part, one.roughness_m) for one in _found(piece) for part in _polygons(one)]
    shapes = np.array([part for part, _ in found], object)
    if not shapes.size:
        return OutputRecord(REGIONS, piece.unit, piece.key, "", 0, "")
    middle = shapely.get_coordinates(shapely.centroid(shapes))
    columns = {
        "run": [piece.source.run] * len(shapes),
        "sensor": [piece.source.sensor] * len(shapes),
        "start_gps_ns": [piece.start_gps_ns] * len(shapes),
        "end_gps_ns": [piece.end_gps_ns] * len(shapes),
        "roughness_m": [rough for _, rough in found],
        "area_m2": shapely.area(shapes).tolist(),
        "easting_m": middle[:, 0].tolist(),
        "northing_m": middle[:, 1].tolist(),
    }
    target = f"tables/{REGIONS}/{piece.unit}.parquet"
    with piece.store.scratch() as folder:
        path = folder / "regions.parquet"
        table = pa.table(columns).cast(table_schema(REGIONS).arrow())
        write_geo_table(path, table, "outline", shapes, ["Polygon"], piece.context)
        size, digest = path.stat().st_size, file_digest(path)
        piece.store.publish(path, target)
    return OutputRecord(REGIONS, piece.unit, piece.key, target, size, digest)


def _found(piece: RegionPiece) -> list[Region]:
    """Returns regions of a piece that reach into its span: those in margins belong to its neighbours."""
    placer = Georeferencer(piece.store, piece.ground, piece.slices)
    placement = placer.placement(piece.source)
    points = _profiles(piece, placement)
    poses = placement.trajectory.poses(points.epoch_gps_ns)
    points, rows = _at(points, poses.found), np.flatnonzero(poses.found)
    if not points.kept.any():
        return []
    body, rotation = poses.position_world_m[rows], poses.world_from_body[rows]
    lever = np.empty((rows.size, 3))
    for own, mounting in placement.mountings.pieces(points.epoch_gps_ns):
        lever[own] = mounting.lever_arm_body_m
    sensor = body + np.einsum("nij,nj->ni", rotation, lever)
    path = piece.ground.map.map_from_world(placement.trajectory.world, sensor)[:, :2]
    classes = np.where(points.kept, 0, 1).astype(np.uint8)
    stretch = Stretch.of_points(points.easting_m, points.northing_m, points.height_m, classes, path)
    inside = (points.epoch_gps_ns >= piece.start_gps_ns) & (points.epoch_gps_ns < piece.end_gps_ns)
    within = stretch.along_m[inside]
    found = find_regions(coarse_model(stretch, CoarseSettings()), piece.settings)
    return [r for r in found if ((within >= r.span_m[0]) & (within <= r.span_m[1])).any()]


def _profiles(piece: RegionPiece, placement: Placement) -> ProfilePoints:
    """Returns profiles of the span and its margins by their epochs, one in each :data:`_EVERY_NS`."""
    geometry = geometry_of(piece.source)
    if geometry is None:
        raise ConfigError(f"{piece.source.run}/{piece.source.sensor} has no profiles", expected="scans")
    none = np.zeros((0, geometry.readings))
    parts = [ProfilePoints(np.zeros(0, np.int64), none, none, none, none.astype(bool))]
    for one in piece.slices:
        for group in one.groups:
            for batch in read_rows(piece.store, one.source, one.file, [group]).combine_chunks().to_batches():
                epochs = batch.column("epoch_gps_ns").to_numpy()
                near = (epochs >= piece.start_gps_ns - _MARGIN_NS) & (epochs < piece.end_gps_ns + _MARGIN_NS)
                rows = np.flatnonzero(near)
                rows = rows[np.sort(np.unique(epochs[rows] // _EVERY_NS, return_index=True)[1])]
                chunks = (batch.take(rows[k : k + _CHUNK_ROWS]) for k in range(0, rows.size, _CHUNK_ROWS))
                parts += [placement.by_profile(chunk, geometry) for chunk in chunks]
    joined = ProfilePoints(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(ProfilePoints)))
    order = np.argsort(joined.epoch_gps_ns, kind="stable")
    first = np.unique(joined.epoch_gps_ns[order] // _EVERY_NS, return_index=True)[1]
    return _at(joined, order[first])


def _at(points: ProfilePoints, rows: npt.NDArray[Any]) -> ProfilePoints:
    return ProfilePoints(*(getattr(points, f.name)[rows] for f in fields(points)))


def _polygons(one: Region) -> list[Any]:
    """Returns an outline as valid polygons: it may cross itself where the vehicle turned on the spot."""
    parts = shapely.get_parts(shapely.make_valid(one.polygon))
    return [p for p in shapely.get_parts(parts) if p.geom_type == "Polygon" and p.area > 0.0]


@dataclass(frozen=True)
class FoundRegions:
    """Regions found in the pieces of all drives."""

    regions: Regions
    """Regions of the pieces that are current."""
    due: tuple[RegionPiece, ...]
    """Pieces that were not searched yet, or failed."""
    gone: tuple[OutputRecord, ...]
    """Records of pieces that no longer exist."""

    def waiting(self, footprints: FootprintRanges) -> set[TileId]:
        """Returns tiles in which a piece that is due may have readings."""
        f = footprints
        touched = np.zeros(f.tile_row.size, bool)
        for piece in self.due:
            own = np.array([s.source.key == piece.source.key for s in f.slices], bool)[f.slice_index]
            touched |= own & (f.first_epoch_gps_ns < piece.end_gps_ns) & (f.last_epoch_gps_ns >= piece.start_gps_ns)
        return set(map(TileId, f.tile_column[touched].tolist(), f.tile_row[touched].tolist()))


def load_found_regions(plan: SurveyPlan, manifest: Manifest) -> FoundRegions:
    """Returns regions that were found in the current readings."""
    pieces = region_pieces(plan)
    due = _due(pieces, manifest)
    current = {p.unit for p in pieces} - {p.unit for p in due}
    records = manifest.of(REGIONS)
    context = product_context(plan)
    files = [records[unit] for unit in sorted(current) if records[unit].path]
    shapes = [np.empty(0, object), *(read_geo_table(read_recorded(plan.store, r), context)[1] for r in files)]
    known = {p.unit for p in pieces}
    gone = tuple(r for unit, r in records.items() if unit not in known)
    return FoundRegions(Regions(np.concatenate(shapes)), tuple(due), gone)


def _due(pieces: Sequence[RegionPiece], manifest: Manifest) -> list[RegionPiece]:
    return [p for p in pieces if not manifest.is_current(REGIONS, p.unit, p.key)]
