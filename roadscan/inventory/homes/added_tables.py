"""What people add to a GeoPackage of the inventory, and values that are not of their column's type."""

from __future__ import annotations

import contextlib
import datetime as dt
import re
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyproj
import shapely

from roadscan.core.crs import MapFrame, accuracy_words, best_operation, crs_from_text
from roadscan.core.errors import CrsError
from roadscan.core.witness import Witness
from roadscan.inventory.home import HomeError

STYLES: Final = "layer_styles"
_NAMES: Final = {
    "gpkg_contents": "table_name", "gpkg_geometry_columns": "table_name", "gpkg_extensions": "table_name",
    "gpkg_data_columns": "table_name", "gpkg_ogr_contents": "table_name", "gpkg_tile_matrix": "table_name",
    "gpkg_tile_matrix_set": "table_name", "gpkg_metadata_reference": "table_name", "sqlite_sequence": "name",
    "gpkg_data_column_constraints": "constraint_name", "gpkg_spatial_ref_sys": "srs_id",
}  # fmt: skip
"""Tables that describe others, and the column that names the described table."""
_OF_OGR: Final = re.compile(r"(rtree|gpkg|trigger_(insert|delete)_feature_count)_")
"""Triggers and indexes that a program makes for each layer; those of the published layers are recreated."""


def keep_added(published: Path, new: Path) -> None:
    """Copy people's additions from a published GeoPackage into the one that replaces it.

    A table, view, index or trigger is an addition if the new file has none of its name; a style, if it differs from
    what the publication wrote. Rows are copied by SQLite alone: no trigger of a spatial index runs.

    Raises
    ------
    HomeError
        where it cannot be copied.
    """
    try:
        with contextlib.closing(sqlite3.connect(new)) as connection:
            connection.execute("ATTACH ? AS old", [f"{published}"])
            with connection:
                _copy(connection, published)
    except sqlite3.Error as error:
        raise HomeError(
            f"what people added to the GeoPackage cannot be kept: {error}",
            change="move their layers and tables into another file, and publish again; it is as it was",
            file=published,
        ) from error


def _copy(connection: sqlite3.Connection, published: Path) -> None:
    # Another program may drop a layer and leave its describing rows behind: these are skipped.
    objects = connection.execute(
        """SELECT type, name, tbl_name, sql FROM old.sqlite_master
           WHERE name NOT IN (SELECT name FROM main.sqlite_master) AND name NOT LIKE 'sqlite_%' ORDER BY rowid"""
    ).fetchall()
    published_tables = {name for (name,) in connection.execute("SELECT name FROM main.sqlite_master")}
    shadows = {name for _, name, kind, *_ in connection.execute("PRAGMA old.table_list") if kind == "shadow"}
    made = {name for kind, name, *_ in objects if kind == "table"} - shadows
    for is_virtual in (False, True):
        for kind, name, _, sql in objects:
            if kind == "table" and name in made and sql.upper().startswith("CREATE VIRTUAL") == is_virtual:
                connection.execute(sql)
                _copy_rows(connection, name, name)
    for name, column in _NAMES.items():
        _copy_descriptions(connection, name, column, published, published_tables)
    _copy_styles(connection)
    for kind, name, table, sql in objects:
        if kind != "table" and sql and not (table in published_tables and _OF_OGR.match(name)):
            connection.execute(sql)


def _columns(connection: sqlite3.Connection, schema: str, table: str) -> list[str]:
    """Returns the columns of a table that store values; none where there is no such table."""
    return [name for _, name, *_, hidden in connection.execute(f'PRAGMA {schema}.table_xinfo("{table}")') if not hidden]


def _copy_rows(connection: sqlite3.Connection, table: str, name: str) -> None:
    columns = ", ".join(f'"{one}"' for one in _columns(connection, "old", table))
    try:
        connection.execute(f'INSERT INTO main."{name}" (rowid, {columns}) SELECT rowid, {columns} FROM old."{table}"')
    except sqlite3.OperationalError:  # a table without rowid, or a virtual one
        connection.execute(f'INSERT INTO main."{name}" ({columns}) SELECT {columns} FROM old."{table}"')


def _copy_descriptions(
    connection: sqlite3.Connection, table: str, column: str, published: Path, published_tables: set[str]
) -> None:
    """Copy the rows that describe people's additions, of a table that both files have."""
    there = _columns(connection, "main", table)
    shared = [one for one in _columns(connection, "old", table) if one in there and one != "id"]
    if column not in shared:
        return
    if table == "gpkg_spatial_ref_sys":
        _check_systems(connection, published)
    names, values = ", ".join(f'"{one}"' for one in shared), ", ".join(f'o."{one}"' for one in shared)
    same = " AND ".join(f'm."{one}" IS o."{one}"' for one in shared)
    known = ", ".join("?" for _ in published_tables)
    connection.execute(
        f"""INSERT OR IGNORE INTO main."{table}" ({names}) SELECT {values} FROM old."{table}" o
            WHERE (o."{column}" IS NULL OR o."{column}" NOT IN ({known}))
            AND NOT EXISTS (SELECT 1 FROM main."{table}" m WHERE {same})
            AND NOT EXISTS (SELECT 1 FROM main."{table}" m WHERE m."{column}" = o."{column}")""",
        sorted(published_tables),
    )


def _check_systems(connection: sqlite3.Connection, published: Path) -> None:
    """Raise HomeError where one number names another CRS in the new file: only numbers without an authority can."""
    clash = connection.execute(
        """SELECT o.srs_id, o.srs_name FROM old.gpkg_spatial_ref_sys o JOIN main.gpkg_spatial_ref_sys m USING (srs_id)
           WHERE o.organization_coordsys_id IS NOT m.organization_coordsys_id OR lower(o.organization) = 'none'
           AND o.definition IS NOT m.definition"""
    ).fetchone()
    if clash is not None:
        raise HomeError(
            f"a layer that people added has the CRS {clash[0]} ({clash[1]}), which is another one in the new file",
            change="move that layer into another file, and publish again; it is as it was",
            file=published,
        )


def _copy_styles(connection: sqlite3.Connection) -> None:
    """Copy styles that people wrote or changed: a publication's style bears its commit's instant, QGIS sets another."""
    if not _columns(connection, "old", STYLES):
        return
    theirs = connection.execute(
        f"""SELECT o.id, m.id FROM old.{STYLES} o LEFT JOIN main.{STYLES} m
            ON m.f_table_name = o.f_table_name AND m.styleName = o.styleName
            WHERE o.owner IS NOT 'roadscan' OR julianday(o.update_time) NOT IN
            (SELECT julianday(at) FROM old.roadscan_inventory)"""
    ).fetchall()
    there = _columns(connection, "main", STYLES)
    names = ", ".join(f'"{one}"' for one in _columns(connection, "old", STYLES) if one in there and one != "id")
    for old, new in theirs:
        connection.execute(f"DELETE FROM main.{STYLES} WHERE id = ?", [new])
        connection.execute(
            f"""UPDATE main.{STYLES} SET useAsDefault = 0 WHERE (f_table_name, 1) IN
                (SELECT f_table_name, useAsDefault FROM old.{STYLES} WHERE id = ?)""",
            [old],
        )
        connection.execute(f"INSERT INTO main.{STYLES} ({names}) SELECT {names} FROM old.{STYLES} WHERE id = ?", [old])


STORED_VALUES: Final = Witness(
    name="stored_values",
    input="inventory edits",
    fault="A cell of a GeoPackage holds what its column cannot: a text in a number, 3.7 in a whole number, a day that "
    "there is not.",
    asks="the type under which SQLite stores each cell",
    does="the row is named with what arrived, and not taken in",
    told=("error",),
)
_WANTED: Final = {
    "double": "a number", "int32": "a whole number", "int64": "a whole number", "string": "a text",
    "bool": "true or false (1 or 0)", "date32[day]": "a date such as 2026-05-04",
}  # fmt: skip
_STORED: Final = {"double": ("real", "integer"), "string": ("text",)}
"""Storage classes of SQLite that a column of each type may have, beside null."""


class OddValue(NamedTuple):
    """A cell whose value is not of its column's type."""

    fid: int
    asset_id: str | None
    column: str
    reason: str


def odd_values(file: Path, layer: str, schema: pa.Schema) -> list[OddValue]:
    """Returns the cells of a layer whose values are not of their column's type, by row; of the columns in `schema`."""
    with contextlib.closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)) as connection:
        connection.text_factory = lambda content: content.decode("utf-8", "replace")
        there = {name for _, name, *_ in connection.execute(f'PRAGMA table_info("{layer}")')}
        found = [odd for field in schema if field.name in there for odd in _of_column(connection, layer, field, there)]
    return sorted(found)


def _of_column(connection: sqlite3.Connection, layer: str, field: pa.Field, there: set[str]) -> Iterator[OddValue]:
    kind = str(field.type)
    if kind not in _WANTED:
        return
    stored = ", ".join(f"'{one}'" for one in ("null", *_STORED.get(kind, ())))
    name = '"asset_id"' if "asset_id" in there else "NULL"
    query = f"""SELECT rowid, {name}, typeof("{field.name}"), "{field.name}" FROM "{layer}"
                WHERE typeof("{field.name}") NOT IN ({stored})"""
    for fid, asset_id, held, value in connection.execute(query):
        if not _is_value(kind, held, value):
            asset = asset_id if isinstance(asset_id, str) and asset_id else None
            yield OddValue(fid, asset, field.name, f"{field.name} is {_shown(held, value)}, expected {_WANTED[kind]}")


def _is_value(kind: str, held: str, value: Any) -> bool:
    """Returns True if a stored value is valid in a column that permits several storage classes."""
    if kind == "bool":
        return held in ("integer", "real") and value in (0, 1)
    if kind in ("int32", "int64"):
        most = 2 ** (int(kind.removeprefix("int")) - 1)
        return held in ("integer", "real") and float(value).is_integer() and -most <= value < most
    return kind == "date32[day]" and held == "text" and _is_day(value)


def _is_day(text: str) -> bool:
    """Returns True for a day, and for a day at midnight, as some programs write it."""
    try:
        moment = dt.datetime.fromisoformat(text)
    except ValueError:
        return False
    return moment.time() == dt.time(0)


def _shown(held: str, value: Any) -> str:
    if held == "text":
        return f"the text '{value[:40]}'" if value else "an empty text"
    return f"{len(value)} bytes" if held == "blob" else f"{value:.15g}" if held == "real" else str(value)


CRS_OF_EDITS: Final = Witness(
    name="crs_of_edits",
    input="inventory edits",
    fault="A layer was exported to another CRS than the map's, or states none.",
    asks="the CRS that the layer states (of PostGIS: the SRID of each geometry), against that of the map",
    does="coordinates are transformed where PROJ knows the operation within map.max_datum_error_m; otherwise the layer "
    "is refused",
    told=("error",),
)

Shapes = npt.NDArray[Any]
_WAY_OUT: Final = "export the layer in the map's CRS, with heights as the map has them, and pull again"


def into_map(stated: str | None, frame: MapFrame, layer: str, home: str) -> Callable[[Shapes], Shapes]:
    """Returns the transformation of a layer's geometries into the map.

    Parameters
    ----------
    stated : CRS that the layer states, as PROJ reads it; None where it states none.
    layer, home : as errors name them.

    Raises
    ------
    HomeError
        where the layer states no CRS and the map has one, or the reverse; or PROJ does not know the operation exactly.
    """
    crs = None if stated is None else _known(stated, layer, home)
    if crs is not None and (crs.is_engineering or crs.name.startswith("Undefined")):
        crs = None
    if frame.crs is None or crs is None:
        if frame.crs is None and crs is None:
            return lambda shapes: shapes
        arrived = "states no CRS" if crs is None else f"is in {_title(crs)}"
        raise HomeError(
            f"the layer '{layer}' {arrived}",
            expected="a local frame, without a CRS" if frame.crs is None else f"the map's, {frame.crs}",
            change="give the layer the CRS that its coordinates are in" if crs is None else _WAY_OUT,
            file=home,
        )
    target = crs_from_text(frame.crs)
    horizontal, is_3d = _parts(crs, frame, layer, home)
    if target.equals(horizontal, ignore_axis_order=True):
        return lambda shapes: shapes
    if is_3d:
        horizontal, target = horizontal.to_3d(), target.to_3d()
    operation = _operation(horizontal, target, frame.max_datum_error_m, layer, home)
    return lambda shapes: _transformed(shapes, operation, heights=is_3d)


def _known(stated: str, layer: str, home: str) -> pyproj.CRS:
    try:
        return crs_from_text(stated, f"the CRS of the layer '{layer}',")
    except CrsError as error:
        raise HomeError(str(error), change=_WAY_OUT, file=home) from error


def _parts(crs: pyproj.CRS, frame: MapFrame, layer: str, home: str) -> tuple[pyproj.CRS, bool]:
    """Returns the horizontal part of a layer's CRS, and whether its ellipsoidal heights are transformed too.

    A CRS of two axes has no heights: programs export them as they are.
    """
    if crs.is_compound:
        horizontal, vertical = crs.sub_crs_list[:2]
        if frame.vertical_crs is not None and crs_from_text(frame.vertical_crs).equals(vertical):
            return horizontal, False
    elif len(crs.axis_info) < 3:
        return crs, False
    elif frame.height == "ellipsoidal" and frame.vertical_unit_m == 1.0:
        return crs.to_2d(), True
    raise HomeError(
        f"the heights of the layer '{layer}' are those of {_title(crs)}",
        expected=f"{frame.height} heights of the map" + (f", {frame.vertical_crs}" if frame.vertical_crs else ""),
        change=_WAY_OUT,
        file=home,
    )


def _operation(source: pyproj.CRS, target: pyproj.CRS, limit_m: float, layer: str, home: str) -> pyproj.Transformer:
    best = best_operation(source, target)
    if best is not None and best.accuracy <= limit_m:
        return best
    raise HomeError(
        f"the layer '{layer}' is in {_title(source)}, and the way from there into the map's {_title(target)} is "
        f"{accuracy_words(best)}",
        expected=f"an operation within map.max_datum_error_m = {limit_m:g}",
        change=_WAY_OUT,
        file=home,
    )


def _transformed(shapes: Shapes, operation: pyproj.Transformer, *, heights: bool) -> Shapes:
    """Returns transformed geometries; empty and missing ones are unchanged."""

    def moved(places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        out = places.copy()
        used = 3 if heights and places.shape[1] == 3 and np.isfinite(places[:, 2]).all() else 2
        out[:, :used] = np.column_stack(operation.transform(*places[:, :used].T))
        return out

    out = shapes.copy()
    for has_z in (False, True):
        of_kind = (shapely.has_z(shapes) == has_z) & ~shapely.is_missing(shapes)
        if of_kind.any():
            out[of_kind] = shapely.transform(shapes[of_kind], moved, include_z=has_z)
    return out


def _title(crs: pyproj.CRS) -> str:
    authority = crs.to_authority()
    return crs.name if authority is None else f"{':'.join(authority)} ({crs.name})"
