"""Tables of assets, one a kind, and the files made from them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets.files.layers import GEOMETRIES, Layer, write_dxf, write_geojson, write_geopackage
from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.along_roads import along_roads
from roadscan.assets.tasks.drives import Drives, with_pose_sigma
from roadscan.assets.tasks.kinds import WantedKind
from roadscan.assets.tasks.objects import OBJECTS
from roadscan.assets.tasks.picture_work import PicturePlan
from roadscan.condition.tasks.lines import Roads
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.asset_schema import ASSET_FOLDER, AssetSchema
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded, recorded_table
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.geo_table import read_geo_table, write_geo_table
from roadscan.tiles.tasks.tile_files import publish_file

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
