"""Tables of assets, one a kind: their places along the roads, the poses' uncertainty, and the files made from them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.files.layers import GEOMETRIES, Layer, write_dxf, write_geojson, write_geopackage
from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.objects import OBJECTS
from roadscan.assets.tasks.picture_work import PicturePlan
from roadscan.assets.tasks.plan import AssetPlan, WantedKind
from roadscan.compute.array_types import Float64, Int64
from roadscan.condition.road_line import Lane, Roads
from roadscan.core.rig import UNMOUNTED, Mountings
from roadscan.georeference.plan.plan import trajectory_source
from roadscan.georeference.sensor_places import sensor_places
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_trajectory, pose_sigma
from roadscan.run.keys import code_digest, key_of
from roadscan.store.asset_schema import ASSET_FOLDER, AssetSchema
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded, recorded_table
from roadscan.store.small_tables import small_path
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext, publish_file
from roadscan.tiles.products.geo_table import read_geo_table, write_geo_table

_BESIDE_M: Final = 50.0
"""Assets farther from all lines (m) have no road."""
_BEYOND_M: Final = 1.0
"""Stations count this far beyond a line's ends (m)."""


class Along(NamedTuple):
    """Positions of n places along the roads; None and NaN where there is none."""

    road: list[str | None]
    station_m: npt.NDArray[np.float64]
    offset_m: npt.NDArray[np.float64]
    lane: list[int | None]


def along_roads(places_m: npt.NDArray[np.float64], roads: Roads) -> Along:
    """Road, station, offset and lane of places (n, 2) on the map (m), relative to the nearest reference line."""
    count = len(places_m)
    road: list[str | None] = [None] * count
    lane: list[int | None] = [None] * count
    station, offset = np.full(count, np.nan), np.full(count, np.nan)
    lines = [line for _, line in sorted(roads.lines.items())]
    if not (count and lines):
        return Along(road, station, offset, lane)
    drawn = [shapely.LineString(line.nodes_m) for line in lines]
    points = shapely.points(places_m)
    away = np.stack([shapely.distance(one, points) for one in drawn])
    nearest = np.argmin(away, axis=0)
    for number, line in enumerate(lines):
        own = np.flatnonzero((nearest == number) & (away[number] <= _BESIDE_M))
        guess = line.first_m + shapely.line_locate_point(drawn[number], points[own])
        at, beside = line.along(places_m[own], guess)
        held = (at >= line.first_m - _BEYOND_M) & (at <= line.first_m + line.length_m + _BEYOND_M)
        held &= np.abs(np.abs(beside) - away[number][own]) < _BEYOND_M
        own, at, beside = own[held], at[held], beside[held]
        station[own], offset[own] = at, beside
        lanes = [one for one in roads.lanes if one.road == line.road]
        for row, s, o in zip(own.tolist(), at, beside, strict=True):
            road[row], lane[row] = line.road, _lane(lanes, float(s), float(o))
    return Along(road, station, offset, lane)


def _lane(lanes: list[Lane], station_m: float, offset_m: float) -> int | None:
    """Returns the number of a place's lane: its name where that is a number, else counted from the left."""
    for number, one in enumerate(lanes, 1):
        if one.first_m <= station_m <= one.last_m:
            middle = float(one.offsets(np.array([station_m]))[0])
            if abs(offset_m - middle) <= one.width_m / 2:
                return int(one.name) if one.name.isdecimal() else number
    return None


_TICK_NS: Final = 1_000_000_000
"""Interval of the poses that are used (ns)."""
_REACH_M: Final = 100.0
"""Farthest distance (m) from which anything is seen."""


@dataclass(frozen=True, eq=False)
class Drives:
    """Poses (k,) of all drives, one a second."""

    places_m: Float64
    """(k, 2) easting and northing."""
    epochs_gps_ns: Int64
    sigma: Float64
    """(k, 6) of north, east, down (m), roll, pitch, heading (rad)."""

    def sigma_m(self, places_m: Float64, seen_gps_ns: Int64) -> Float64:
        """Returns the 1 σ (n, 2) that poses give to places (n, 2), horizontal (of each axis) and down.

        It is the root mean square of the poses within 100 m while a place was seen. Errors of angles count with the
        distance to the nearest one of them.

        Parameters
        ----------
        seen_gps_ns : (n, 2) first and last epoch that shows each.
        """
        import scipy.spatial

        found = np.zeros((len(places_m), 2))
        if not len(self.places_m):
            return found
        tree = scipy.spatial.cKDTree(self.places_m)
        for number, (place, (first, last)) in enumerate(zip(places_m, seen_gps_ns.tolist(), strict=True)):
            near = np.array(sorted(tree.query_ball_point(place, _REACH_M)), np.intp)
            epochs = self.epochs_gps_ns[near]
            near = near[(epochs >= first - _TICK_NS) & (epochs <= last + _TICK_NS)]
            if not near.size:
                near = np.array([tree.query(place)[1]], np.intp)
            away = float(np.hypot(*(self.places_m[near] - place).T).min())
            north, east, down, roll, pitch, heading = np.mean(self.sigma[near] ** 2, axis=0)
            found[number] = (north + east + away**2 * heading) / 2, down + away**2 * max(roll, pitch)
        return np.sqrt(found)


def drives_key(plan: AssetPlan) -> str:
    """Returns the key of what :func:`load_drives` reads."""
    survey, runs = plan.survey, [source.run for source in _sources(plan)]
    settings = survey.survey.config.navigation.calibration
    files = [
        [r.run, [f.digest for name in ("trajectory", "trajectory_accuracy") for f in r.tables.get(name, ())]]
        for r in survey.records
        if r.run in runs
    ]
    path = small_path("corrections")
    corrections = bytes_digest(survey.store.read_bytes(path)) if survey.store.exists(path) else ""
    return key_of(files, corrections, settings.traverse_sigma_m, settings.traverse_sigma_deg)


def load_drives(plan: AssetPlan) -> Drives:
    """Returns poses of the runs in which assets are sought; those of clouds without a trajectory are not known."""
    survey, parts = plan.survey, []
    for source in _sources(plan):
        spans = [span for file in source.files for span in file.group_spans]
        whole = (min(first for first, _ in spans), max(last for _, last in spans))
        trajectory = load_trajectory(survey.store, source, [whole], survey.ground.max_gap_s)
        knots = np.flatnonzero(np.diff(trajectory.epochs_gps_ns // _TICK_NS, prepend=-1))
        epochs = trajectory.epochs_gps_ns[knots]
        if epochs.size < 2:
            continue
        sigma = pose_sigma(survey.store, survey.records, source, epochs, survey.survey.config.navigation.calibration)
        if trajectory.sigma_ned_m is not None:  # of the adjustment, where it states any
            adjusted = trajectory.sigma_ned_m[knots]
            sigma[:, :3] = np.where(np.isfinite(adjusted), adjusted, sigma[:, :3])
        places = sensor_places(trajectory, survey.ground.map, Mountings.one(UNMOUNTED), epochs)[:, :2]
        known = np.isfinite(places).all(axis=1)
        parts.append((places[known], epochs[known], sigma[known]))
    if not parts:
        return Drives(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, 6)))
    return Drives(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def with_pose_sigma(rows: pa.Table, drives: Drives) -> pa.Table:
    """Returns rows of objects whose σ of the place includes that of the poses."""
    places = np.column_stack([rows["easting_m"].to_numpy(), rows["northing_m"].to_numpy()])
    seen = np.column_stack([rows["first_epoch_gps_ns"].to_numpy(), rows["last_epoch_gps_ns"].to_numpy()])
    sigma = drives.sigma_m(places, seen)
    for column, name in enumerate(("sigma_horizontal_m", "sigma_height_m")):
        index = rows.schema.get_field_index(name)
        values = pa.array(np.hypot(rows[name].to_numpy(), sigma[:, column]))
        rows = rows.set_column(index, rows.schema.field(index), values)
    return rows


def _sources(plan: AssetPlan) -> list[TrajectorySource]:
    runs = {s.run for s, _ in plan.survey.sources if s.trajectory is not None and s.sensor in plan.sensors}
    own = {run: trajectory_source(run, plan.survey.records) for run in runs} | dict(plan.ways)
    return [source for _, source in sorted(own.items()) if source.files]


TABLES: Final = "assets"
"""Manifest name of the tables and files, and of their folder."""


@dataclass(frozen=True)
class TableTask:
    """A table to be written."""

    schema: AssetSchema
    objects: tuple[OutputRecord, ...]
    seen: tuple[OutputRecord, ...]
    """What pictures show of them."""
    key: str

    @property
    def unit(self) -> str:
        """Returns its file."""
        return f"{self.schema.table}.parquet"


@dataclass(frozen=True)
class FileTask:
    """A file to be made from tables."""

    unit: str
    tables: tuple[tuple[AssetSchema, OutputRecord], ...]
    key: str
    write: Callable[[Path, Sequence[Layer], ProductContext], None]


def plan_tables(
    kinds: Sequence[WantedKind],
    manifest: Manifest,
    places_key: str,
    context: ProductContext,
    pictures: PicturePlan,
) -> list[TableTask]:
    """Returns a table for each kind; `places_key` is that of the roads and drives."""
    code = code_digest("roadscan.assets.tasks.tables:write_table")
    held = manifest.of(OBJECTS)
    tasks = []
    for one in kinds:
        own = tuple(r for unit, r in sorted(held.items()) if unit.startswith(f"{one.name}/") and r.path)
        schema = one.schema
        said = [[c.name, c.type] for c in schema.columns]
        seen = pictures.records(one.name, manifest)
        read = [(r.unit, r.digest) for r in (*own, *seen)]
        key = key_of(code, said, schema.geometry, read, places_key, context.map)
        tasks.append(TableTask(schema, own, seen, key))
    return tasks


def plan_files(
    kinds: Sequence[WantedKind], manifest: Manifest, config: AssetsConfig, context: ProductContext
) -> list[FileTask]:
    """Returns the files that the survey asks for, of the existing tables."""
    held = manifest.of(TABLES)
    tables = tuple(
        (one.schema, held[unit])
        for one in sorted(kinds, key=lambda k: k.name)
        if (unit := f"{one.schema.table}.parquet") in held
    )
    wanted: list[tuple[str, tuple[tuple[AssetSchema, OutputRecord], ...], Callable[..., None]]] = []
    if "gpkg" in config.exports:
        wanted.append(("assets.gpkg", tables, write_geopackage))
    if "dxf" in config.exports:
        wanted.append(("assets.dxf", tables, write_dxf))
    if "geojson" in config.exports:
        wanted += [(f"{schema.table}.geojson", ((schema, record),), _one_geojson) for schema, record in tables]
    code = code_digest("roadscan.assets.tasks.tables:write_file")
    return [
        FileTask(unit, own, key_of(code, unit, [(r.unit, r.digest) for _, r in own], context.map), write)
        for unit, own, write in wanted
        if own
    ]


def _one_geojson(path: Path, layers: Sequence[Layer], context: ProductContext) -> None:
    write_geojson(path, layers[0], context)


def write_table(task: TableTask, roads: Roads, drives: Drives, store: Store, context: ProductContext) -> OutputRecord:
    """Write a kind's table: the objects of all clusters, with positions along the roads, and σ of the poses."""
    schema = task.schema.arrow()
    parts = [recorded_table(store, r).cast(schema) for r in task.objects]
    rows = with_pose_sigma(pa.concat_tables([schema.empty_table(), *parts]).combine_chunks(), drives)
    along = along_roads(np.column_stack([rows["easting_m"].to_numpy(), rows["northing_m"].to_numpy()]), roads)
    told: Mapping[str, pa.Array] = {
        "road": pa.array(along.road, pa.string()),
        "station_m": pa.array(along.station_m, from_pandas=True),
        "offset_m": pa.array(along.offset_m, from_pandas=True),
        "lane": pa.array(along.lane, pa.int32()),
    }
    for name, values in told.items():
        index = rows.schema.get_field_index(name)
        rows = rows.set_column(index, rows.schema.field(index), values)
    rows = _with_pictures(rows, [recorded_table(store, r) for r in task.seen])
    rows = rows.sort_by([(name, "ascending") for name in ("road", "station_m", "easting_m", "northing_m", "object")])
    shapes = shapely.from_wkb(rows["geometry"].to_numpy())
    with store.scratch() as folder:
        path = folder / task.unit
        kind = GEOMETRIES[task.schema.geometry]
        write_geo_table(path, rows.drop_columns(["geometry"]), "geometry", shapes, [kind], context)
        detail = f'{{"objects": {rows.num_rows}}}'
        return publish_file(store, path, f"{ASSET_FOLDER}/{task.unit}", TABLES, task.unit, task.key, detail)


def _with_pictures(rows: pa.Table, seen: Sequence[pa.Table]) -> pa.Table:
    """Returns rows of objects with the results from pictures."""
    if not seen:
        return rows
    told = {one["object"]: one for part in seen for one in part.to_pylist()}
    values = [json.loads(told[name]["told"]) if name in told else {} for name in rows["object"].to_pylist()]
    named = [told[name]["pictures"] if name in told else None for name in rows["object"].to_pylist()]
    columns: dict[str, list[Any]] = {"pictures": named}
    for name in sorted({name for one in values for name in one}):
        columns[name] = [one.get(name, known) for one, known in zip(values, rows[name].to_pylist(), strict=True)]
    for name, column in columns.items():
        index = rows.schema.get_field_index(name)
        rows = rows.set_column(index, rows.schema.field(index), pa.array(column, rows.schema.field(index).type))
    return rows


def write_file(task: FileTask, store: Store, context: ProductContext) -> OutputRecord:
    """Write a file of tables."""
    layers = [read_layer(schema, record, store, context) for schema, record in task.tables]
    with store.scratch() as folder:
        path = folder / task.unit
        task.write(path, layers, context)
        return publish_file(store, path, f"{ASSET_FOLDER}/{task.unit}", TABLES, task.unit, task.key)


def read_layer(schema: AssetSchema, record: OutputRecord, store: Store, context: ProductContext) -> Layer:
    """Returns rows and geometries of a table."""
    rows, shapes = read_geo_table(read_recorded(store, record), context)
    return Layer(schema.table, schema.geometry, rows, shapes)
